"""``kalux evaluate``: its table and files, what it compares with, errors."""

from __future__ import annotations

import csv
import dataclasses
import json
import sys

import cv2
import numpy as np
import pytest

from kalux.calibration.values import Calibration
from kalux.evaluation import baselines
from kalux.evaluation.baselines import OPTIONAL, methods
from kalux.evaluation.held_out import evaluate_held_out, hold_out_frames
from kalux.planning import plan
from kalux.recording import open as open_recording
from kalux.writers import hdf5
from kalux.writers.calibration import save_calibration

from builders import colour_blocks, moving_blocks


@pytest.fixture(scope="session")
def with_truth(tmp_path_factory, write_recording, simulation):
    return write_recording(tmp_path_factory.mktemp("truth") / "rec.h5", ground_truth=simulation.truth())


def labels(out):
    return [line[:26].strip() for line in out.splitlines()[2:] if not line.startswith(("all", "wrote"))]


def test_frames_are_held_out_where_there_is_no_truth(cli, recording):
    found = cli("evaluate", recording)
    assert found.code == 0, found.err
    lines = found.out.splitlines()
    assert "held-out frames: every 2nd dropped" in lines[0]
    assert lines[1].split() == ["method", "MSE", "x100", "PSNR", "dB", "SSIM", "log-MSE", "x100", "rms", "z"]
    assert labels(found.out)[:7] == [m.label for n, m in methods().items() if n not in OPTIONAL]
    assert "images, " in lines[9]
    assert "pixels compared; data range 1" in lines[9]


@pytest.mark.parametrize(
    ("mosaic", "told"),
    [("RGGB", "of every pixel of the mosaic its own colour"), (None, "of RGB the luminance")],
)
def test_says_what_of_colours_is_compared(cli, write_recording, tmp_path, mosaic, told):
    _, made = colour_blocks(mosaic)
    path = write_recording(
        tmp_path / "rec.h5",
        sensor_size=made.scene.sensor_size,
        events=[made.events],
        frames=made.frames,
        contrast_threshold=None,
        mosaic=mosaic,
    )
    found = cli("evaluate", path, "--methods", "hold", "-o", tmp_path / "scores.csv")
    assert found.out.splitlines()[0].endswith(f"; {told}"), found.err
    assert told in (tmp_path / "scores.csv").read_text()


def test_truth_where_the_recording_has_it(cli, with_truth):
    found = cli("evaluate", with_truth, "--methods", "hold,default")
    assert "ground truth:" in found.out
    assert labels(found.out)[:2] == ["hold the last frame", "AKF default"]
    assert "held-out" in cli("evaluate", with_truth, "--hold-out-frames", "3", "--methods", "hold").out


def test_truth_from_a_file_is_that_of_the_recording(cli, recording, with_truth, simulation, tmp_path):
    truth = simulation.truth()
    np.savez(tmp_path / "rec_gt.npz", times_us=truth.times, gt=truth.images)
    from_file = cli("evaluate", recording, "--truth", tmp_path / "rec_gt.npz", "--methods", "hold").out
    own = cli("evaluate", with_truth, "--truth", "--methods", "hold").out
    assert from_file.splitlines()[1:] == own.splitlines()[1:]


def test_truth_beside_the_recording_is_found_and_told(cli, write_recording, simulation, tmp_path):
    truth = simulation.truth()
    path = write_recording(tmp_path / "pan.h5")
    np.savez(tmp_path / "pan_gt.npz", times_us=truth.times, gt=truth.images)
    found = cli("evaluate", path, "--methods", "hold").out
    assert f"ground truth of {tmp_path / 'pan_gt.npz'}: " in found
    assert cli("evaluate", path, "--truth", "--methods", "hold").out == found
    assert "held-out" in cli("evaluate", path, "--hold-out-frames", "3", "--methods", "hold").out


def test_a_mask_without_a_window_leaves_ssim_empty_and_says_so(cli, ran, recording, simulation, tmp_path):
    """In table and files, and in a benchmark."""
    truth = simulation.truth()
    mask = np.zeros(truth.images.shape[1:], bool)
    mask[:8, :8] = True
    np.savez(tmp_path / "t.npz", times_us=truth.times, gt=truth.images, mask=mask)
    told = f"SSIM without {len(truth.times)} images whose mask leaves no window of 11 x 11 pixels"
    for name in ("s.csv", "s.json"):
        found = cli(
            "evaluate", recording, "--truth", tmp_path / "t.npz", "--methods", "hold", "-o", tmp_path / name
        )
        assert f"all: {told}" in found.out, found.err
    assert next(csv.DictReader((tmp_path / "s.csv").open()))["ssim"] == ""
    assert json.loads((tmp_path / "s.json").read_text())["methods"][0]["ssim"] is None
    (tmp_path / "b.toml").write_text(f'[[sequence]]\npath = "{recording}"\ntruth = "t.npz"\n')
    done = cli("benchmark", tmp_path / "b.toml", "--methods", "hold,cf", "-o", tmp_path / "bench", "--quiet")
    assert done.code == 0, done.err
    assert told in (tmp_path / "bench" / "results.json").read_text()


@pytest.fixture
def ijrr_folder(tmp_path, simulation):
    """The recording as a folder of text and images, in which there is another folder, with its truth beside it."""
    folder, truth = tmp_path / "slider", simulation.truth()
    (folder / "images").mkdir(parents=True)
    events = (f"{e['t'] / 1e6:.6f} {e['x']} {e['y']} {int(e['p'])}\n" for e in simulation.events)
    (folder / "events.txt").write_text("".join(events))
    lines = []
    for i, shot in enumerate(simulation.frames):
        cv2.imwrite(str(folder / "images" / f"{i}.png"), shot.image)
        lines.append(f"{shot.exposure_start / 1e6:.6f} images/{i}.png\n")
    (folder / "images.txt").write_text("".join(lines))
    np.savez(tmp_path / "slider_gt.npz", times_us=truth.times, gt=truth.images)
    return folder


@pytest.mark.parametrize(("inside", "name"), [("", "."), ("images", "..")])
def test_truth_beside_a_folder_is_found_from_within_it(
    cli, ran, ijrr_folder, tmp_path, monkeypatch, inside, name
):
    """By the name of the folder, which . and .. do not tell; in a benchmark it is called by it, too."""
    monkeypatch.chdir(ijrr_folder / inside)
    arguments = ("--exposure", "10000", "--methods", "hold")
    found = cli("evaluate", name, *arguments)
    assert f"ground truth of {tmp_path / 'slider_gt.npz'}: " in found.out, found.err
    assert cli("benchmark", name, *arguments, "-o", tmp_path / "bench", "--quiet").code == 0
    (job,) = json.loads((tmp_path / "bench" / "results.json").read_text())["jobs"]
    assert (job["sequence"]["name"], job["sequence"]["held_out"]) == ("slider", False)
    named = cli("evaluate", name, *arguments, "--truth", tmp_path / "slider_gt.npz")
    assert named.out == found.out


def test_truth_beside_the_recording_comes_before_its_own(cli, ran, write_recording, simulation, tmp_path):
    """As in `kalux benchmark`, with the same numbers."""
    truth = simulation.truth()
    path = write_recording(tmp_path / "pan.h5", ground_truth=truth)
    own = cli("evaluate", path, "--methods", "hold").out
    np.savez(tmp_path / "pan_gt.npz", times_us=truth.times, gt=2 * truth.images)
    found = cli("evaluate", path, "--methods", "hold", "-o", tmp_path / "scores.csv").out
    assert "ground truth: " in own
    assert f"ground truth of {tmp_path / 'pan_gt.npz'}: " in found
    assert cli("benchmark", path, "--methods", "hold", "-o", tmp_path / "bench", "--quiet").code == 0
    (said,) = csv.DictReader((tmp_path / "scores.csv").open())
    (benched,) = (
        row["value"]
        for row in csv.DictReader((tmp_path / "bench" / "results.csv").open())
        if row["metric"] == "mse"
    )
    assert float(said["mse"]) == pytest.approx(float(benched), rel=1e-6)


def test_the_numbers_are_those_of_the_library_in_table_and_files(cli, recording, tmp_path):
    table, whole = tmp_path / "s.csv", tmp_path / "s.json"
    arguments = ("evaluate", recording, "--methods", "hold,cf", "--hdrvdp", "--blur-consistency", "--quiet")
    out = cli(*arguments, "-o", table).out
    assert cli(*arguments, "-o", whole).code == 0
    held = hold_out_frames(open_recording(recording))
    rows = list(csv.DictReader(table.open()))
    parsed = json.loads(whole.read_text())["methods"]
    for name, row, entry in zip(("hold", "cf"), rows, parsed, strict=True):
        scores = evaluate_held_out(held, methods()[name], hdr_vdp=True)
        assert {key: float(row[key]) if row[key] else None for key in scores.means()} == scores.means()
        assert {key: entry[key] for key in scores.means()} == scores.means()
        assert [image["mse"] for image in entry["per_image"]] == [image.mse for image in scores.images]
        assert float(row["blur_psnr"]) == entry["blur_psnr"] > 10
        assert (row["pixels"], row["clipped"]) == (str(scores.pixels), "False")
        assert f"{100 * scores.mse:.3f}" in out
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def test_whether_the_uncertainty_is_true_is_a_column(cli, recording, tmp_path):
    """Of methods that give one."""
    out = cli("evaluate", recording, "--methods", "hold,default", "-o", tmp_path / "s.csv").out
    hold, default = csv.DictReader((tmp_path / "s.csv").open())
    assert (hold["rms_z"], hold["median_z"], hold["one_sigma"]) == ("", "", "")
    assert 0.2 < float(default["rms_z"]) < 5
    assert 0 < float(default["one_sigma"]) < 1
    row = next(line for line in out.splitlines() if line.startswith("AKF default"))
    assert row.split()[-1] == f"{float(default['rms_z']):.2f}"


def test_equal_images_are_valid_json(cli, write_recording, simulation, tmp_path):
    """White, held: the PSNR is infinite, which JSON has not."""
    frames = [dataclasses.replace(f, image=np.full_like(f.image, 255)) for f in simulation.frames]
    path = write_recording(tmp_path / "still.h5", frames=frames)
    assert cli("evaluate", path, "--methods", "hold", "-o", tmp_path / "s.json").code == 0
    text = (tmp_path / "s.json").read_text()
    assert json.loads(text, parse_constant=pytest.fail)["methods"][0]["psnr"] is None


def test_clipping_is_asked_for_and_told(cli, recording):
    assert "clipped" not in cli("evaluate", recording, "--methods", "hold").out
    assert "all: the reconstruction clipped" in cli("evaluate", recording, "--methods", "hold", "--clip").out


def test_a_folder_of_images_is_compared_and_what_it_says_is_its_own(cli, with_truth, simulation, tmp_path):
    truth, lines = simulation.truth(), ["t_us,file"]
    for t, image in zip(truth.times.tolist(), truth.images, strict=True):
        np.save(tmp_path / f"{t}.npy", image)
        lines.append(f"{t},{t}.npy")
    (tmp_path / "timestamps.csv").write_text("\n".join(lines))
    found = cli("evaluate", with_truth, "--methods", f"theirs={tmp_path},hold")
    assert labels(found.out)[:2] == ["theirs", "hold the last frame"]
    assert found.out.splitlines()[2].split()[1:4] == ["0.000", "inf", "1.000"]
    assert f"\ntheirs: {len(truth.times)} images of " in found.out
    assert "all: " not in found.out


@pytest.mark.parametrize("place", ["timestamps.csv", "scores.csv"])
def test_nothing_in_a_folder_of_a_method_is_replaced(cli, recording, tmp_path, place):
    """Its list of images is a .csv, as the table is."""
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / place).write_text("t_us,file")
    methods = ("--methods", f"hold,mine={folder}?tolerance=5")
    found = cli("evaluate", recording, *methods, "-o", folder / place, "--overwrite")
    assert (found.code, f"lies in {folder}, an input" in found.error) == (2, True)
    assert (folder / place).read_text() == "t_us,file"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--methods", "e3vid"], "no method 'e3vid'"),
        (["--methods", "hold,e2vid"], "method 'e2vid' needs its weights: e2vid:FILE"),
        (["--methods", "mine=nowhere"], "not a folder of images"),
        (["--truth"], "has no ground truth; give --truth FILE.npz"),
        (["--truth", "missing.npz"], "missing.npz: cannot be read"),
        (["--truth", "x.npz", "--clip"], "--clip is for held-out frames"),
        (["--truth", "x.npz", "--hold-out-frames", "2"], "not allowed with"),
        (["--hold-out-frames", "0"], "at least 2"),
        (["--hold-out-frames", "11"], "too few"),
        (["--response", "log"], "unknown response"),
        (["-o", "scores.txt"], ".csv or .json"),
        (["-o", "no/such/scores.csv"], "no such folder"),
    ],
)
def test_errors_are_one_line(cli, recording, tmp_path, monkeypatch, arguments, told):
    monkeypatch.chdir(tmp_path)
    found = cli("evaluate", recording, *arguments)
    assert found.code == 2
    assert told in found.error


def test_a_reconstruction_is_planned_once_for_the_warning_and_all_that_go_by_it(cli, recording, monkeypatch):
    plans = []
    monkeypatch.setattr(baselines, "plan", lambda *a, **k: plans.append(k["settings"]) or plan(*a, **k))
    assert cli("evaluate", recording, "--methods", "edi,cf,default").code == 0
    assert len(plans) == len(set(plans)) == 2


def test_the_neighbours_are_no_baseline_where_they_are_not_held_out(cli, with_truth):
    assert "held out" in cli("evaluate", with_truth, "--methods", "mean").error


def test_the_neighbours_are_a_baseline_of_truth_between_frames(cli, recording, tmp_path):
    """Of artificial HDR with frames held out, those are the truth, and no method is given one of them."""
    out = tmp_path / "a.h5"
    for every, compared in ((None, False), (2, True)):
        held = () if every is None else ("--hold-out-frames", every)
        assert cli("ahdr", recording, "-o", out, "--cut", 30, "--overwrite", *held).code == 0
        found = cli("evaluate", out, "--methods", "hold,mean")
        assert found.code == (0 if compared else 2), found.err
        assert ("mean of the neighbours" in found.out) == compared


@pytest.mark.parametrize("damage", ["event outside the sensor", "no frames", "no exposure times", "NaN"])
def test_damage_is_found_before_the_table(cli, damaged, damage):
    found = cli("evaluate", damaged(damage))
    assert (found.code, found.out) == (2, "")
    assert found.error


def test_a_file_is_replaced_only_if_asked_for(cli, recording, tmp_path):
    out = tmp_path / "s.csv"
    out.write_text("mine")
    arguments = ("evaluate", recording, "--methods", "hold", "-o", out)
    assert "--overwrite" in cli(*arguments).error
    assert out.read_text() == "mine"
    assert cli(*arguments, "--overwrite").code == 0
    assert out.read_text().startswith("recording,")


def test_without_scikit_image_the_extra_is_named(cli, recording, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "skimage"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "skimage", None)
    found = cli("evaluate", recording)
    assert (found.code, found.out) == (2, "")
    assert "kalux[evaluation]" in found.error


def test_an_interrupt_leaves_no_file(cli, recording, tmp_path, monkeypatch):
    def interrupted(*unused, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("kalux.evaluation.held_out.evaluate_held_out", interrupted)
    found = cli("evaluate", recording, "-o", tmp_path / "s.csv")
    assert found.code == 130
    assert list(tmp_path.iterdir()) == []


def test_lpips_is_a_column(cli, tmp_path):
    pytest.importorskip("torch", reason="needs PyTorch; pip install -e '.[learned]' brings it")
    from random_networks import write_lpips

    simulation = moving_blocks(size=(64, 64))
    path = tmp_path / "large.h5"
    hdf5.write(
        path,
        sensor_size=(64, 64),
        events=[simulation.events],
        frames=simulation.frames,
        contrast_threshold=(0.2, 0.2),
    )
    files = ",".join(map(str, write_lpips(tmp_path)))
    out = tmp_path / "scores.csv"
    found = cli("evaluate", path, "--methods", "hold", "--lpips", files, "-o", out)
    assert found.code == 0, found.err
    assert found.out.splitlines()[1].split()[-1] == "LPIPS"
    (row,) = csv.DictReader(out.open())
    assert float(row["lpips"]) == pytest.approx(float(found.out.splitlines()[2].split()[-1]), abs=6e-4)


@pytest.mark.parametrize(
    ("given", "told"),
    [("none.pth", "none.pth: no such file"), ("a,b,c", "or two with a comma"), (",", "two")],
)
@pytest.mark.parametrize("command", ["evaluate", "benchmark"])
def test_weights_of_lpips_that_are_wrong_are_told_before_the_work(
    cli, recording, tmp_path, command, given, told
):
    pytest.importorskip("torch", reason="needs PyTorch; pip install -e '.[learned]' brings it")
    more = ("-o", tmp_path / "out") if command == "benchmark" else ()
    found = cli(command, recording, "--methods", "hold", "--lpips", given, *more)
    assert found.code == 2
    assert told in found.error
    assert "hold the last frame" not in found.out


def test_a_black_level_is_taken_off_and_told(cli, recording, tmp_path):
    """The one of a flag, else that of a calibration, else what events say."""
    said = cli("evaluate", recording, "--methods", "hold", "--black-level", 0.01)
    assert "; black level of 0.01 of white taken off all frames" in said.out.splitlines()[0]
    save_calibration(Calibration({"camera": {"black_level": 0.02}}), tmp_path / "dark.toml")
    flags = ("--methods", "hold", "--calibration", tmp_path / "dark.toml")
    assert "black level of 0.02" in cli("evaluate", recording, *flags).out
    assert "black level of 0.01" in cli("evaluate", recording, *flags, "--black-level", 0.01).out
    assert "black level" not in cli("evaluate", recording, "--methods", "hold").out
