"""Jobs: the numbers of the library, keys that change when they must, errors as outcomes."""

from __future__ import annotations

import dataclasses
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

import kalux
from kalux.calibration.event_model import LOG_OFFSETS
from kalux.calibration.values import Calibration
from kalux.datasets.ahdr import ArtificialCamera, artificial_hdr
from kalux.errors import InputError
from kalux.evaluation.baselines import methods
from kalux.evaluation.benchmark import jobs
from kalux.evaluation.benchmark.jobs import (
    Failed,
    Finished,
    Pictures,
    make_job,
    moments,
    run_job,
    uses_held_out,
)
from kalux.evaluation.benchmark.sequences import ArtificialHdr, Options, Sequence
from kalux.evaluation.held_out import evaluate_held_out, hold_out_frames
from kalux.evaluation.lpips import load_lpips
from kalux.evaluation.pairs import Pair
from kalux.evaluation.truth import evaluate_truth, load_truth, prepare_reference
from kalux.writers import hdf5
from kalux.writers.calibration import save_calibration

from builders import moving_blocks


def test_the_numbers_are_those_of_the_library(small_set):
    recording = kalux.open(small_set.with_truth.path)
    reference = prepare_reference(recording, *load_truth(small_set.folder / "a_gt.npz"))
    for held_out in (False, True):
        done = run_job(small_set.job("default", held_out=held_out, hdr_vdp=True))
        expected = (
            evaluate_held_out(hold_out_frames(recording), methods()["default"], hdr_vdp=True)
            if held_out
            else evaluate_truth(recording, reference, methods()["default"], hdr_vdp=True)
        )
        scores = done.record["scores"]
        assert scores["means"] == expected.means()
        assert scores["per_image"] == [dataclasses.asdict(image) for image in expected.images]
        assert (scores["protocol"], scores["pixels"]) == (expected.protocol, expected.pixels)


def test_pictures_are_of_the_middles_of_three_parts(small_set):
    done = run_job(small_set.job("default", held_out=False))
    truth, _ = load_truth(small_set.folder / "a_gt.npz")
    times = done.pictures["times"]
    assert set(times) <= set(truth.times)
    shapes = {name: a.shape for name, a in done.pictures.items() if name != "times"}
    assert shapes == dict.fromkeys(("frame", "reference", "test", "variance"), (3, 32, 40))
    k = [int(np.flatnonzero(truth.times == t)[0]) for t in times]
    assert np.array_equal(done.pictures["reference"], truth.images[k])
    image, *_ = kalux.reconstruct(kalux.open(small_set.with_truth.path), times=times[:1])
    assert np.array_equal(done.pictures["test"][0], image.intensity)
    assert np.array_equal(done.pictures["variance"][0], image.variance)
    assert (moments(9), moments(1), moments(2)) == ([1, 4, 7], [0], [0, 1])


def test_pictures_are_kept_of_a_method_that_writes_all_images_into_one_array():
    """With their variance."""
    array, pictures = np.zeros((2, 3, 4), np.float32), Pictures([0, 2])
    for k in range(4):
        array[...] = k
        pictures.add(k, Pair(k, array[0], np.zeros((3, 4)), variance=array[1]))
    recording = moving_blocks(size=(12, 12)).recording()
    kept = pictures.arrays(recording, 1, "linear")
    assert kept["test"][:, 0, 0].tolist() == kept["variance"][:, 0, 0].tolist() == [0, 2]


def test_what_only_some_methods_have_is_none_for_others(small_set):
    hold, cf, paper, default = (
        run_job(small_set.job(n)).record for n in ("hold", "cf", "iccv2021", "default")
    )
    assert hold["calibration"] is cf["calibration"] is hold["camera"] is cf["camera"] is None
    assert LOG_OFFSETS[0] <= default["calibration"]["log_offset"] <= LOG_OFFSETS[-1]
    assert paper["calibration"]["log_offset"] == 1.0
    assert default["camera"]["covariance"][-1] is None
    assert paper["camera"]["covariance"][-1] == 1.0  # linear: f^w is 1 up to white


def test_held_out_calibration_leaves_clipped_frames_out(small_set, simulation):
    all_pixels = run_job(small_set.job("default")).record
    held = hold_out_frames(kalux.open(small_set.without.path))
    frames = list(simulation.frames)
    clipped = sum(int((frames[i].normalised() >= 0.98).sum()) for i in held.compared)
    assert clipped > 0
    assert all_pixels["calibration"]["all"]["pixels"] == all_pixels["scores"]["pixels"] - clipped


def test_the_key_is_of_all_that_scores_depend_on(small_set, monkeypatch):
    path = small_set.without.path
    first = small_set.job("hold").key
    assert small_set.job("hold").key == first
    others = {small_set.job("cf").key, small_set.job("hold", hdr_vdp=True).key}
    options = Options(hold_out_frames=3)
    other = dataclasses.replace(small_set.without, options=options)
    others.add(make_job(other, "hold", held_out=True, hdr_vdp=False).key)
    os.utime(path, ns=(1, 1))
    others.add(small_set.job("hold").key)
    monkeypatch.setattr(kalux, "__version__", "9.9")
    others.add(small_set.job("hold").key)
    monkeypatch.setattr(jobs, "code_digest", lambda: "other")
    others.add(small_set.job("hold").key)
    assert len(others - {first}) == 6


def test_the_code_is_all_but_what_shows_results(tmp_path, monkeypatch):
    """As scores do not depend on the command line and the report; line ends are the checkout's."""
    copy = tmp_path / "kalux"
    shutil.copytree(Path(kalux.__file__).parent, copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(kalux, "__file__", str(copy / "__init__.py"))
    whole = jobs.code_digest.__wrapped__
    assert whole() == jobs.code_digest()

    def after(name):
        (copy / name).write_bytes((copy / name).read_bytes() + b"# changed\n")
        return whole()

    assert after("cli/app.py") == after("evaluation/benchmark/report.py") == jobs.code_digest()
    (copy / "events.py").write_bytes((copy / "events.py").read_bytes().replace(b"\n", b"\r\n"))
    assert whole() == jobs.code_digest()
    assert len({jobs.code_digest(), after("filters/akf.py"), after("evaluation/benchmark/jobs.py")}) == 3


def test_a_title_is_not_part_of_the_key(small_set):
    renamed = dataclasses.replace(small_set.without, title="other", group="other")
    assert make_job(renamed, "hold", held_out=True, hdr_vdp=False).key == small_set.job("hold").key


def test_zero_is_no_number_of_frames_to_hold_out(small_set):
    """It is neither every second nor none."""
    with pytest.raises(InputError, match="every is 0; at least 2 is needed"):
        dataclasses.replace(small_set.with_truth, options=Options(hold_out_frames=0))


def test_held_out_frames_are_used_where_there_is_no_truth(small_set):
    assert uses_held_out(small_set.without)
    assert not uses_held_out(small_set.with_truth)
    options = Options(hold_out_frames=2)
    assert uses_held_out(dataclasses.replace(small_set.with_truth, options=options))


def test_whatever_goes_wrong_is_an_outcome_of_one_line(small_set, monkeypatch):
    job = small_set.job("hold")
    assert run_job(dataclasses.replace(job, version="0.0")) == Failed(
        f"the job is for kalux 0.0, this is {kalux.__version__}; install the same", is_bug=False
    )
    assert "the job is for other code of kalux" in run_job(dataclasses.replace(job, code="other")).message
    few = dataclasses.replace(small_set.without, options=Options(hold_out_frames=99))
    assert "too few" in run_job(make_job(few, "hold", held_out=True, hdr_vdp=False)).message
    small_set.without.path.write_bytes(b"x")
    assert not run_job(job).is_bug

    def broken(*unused, **options):
        raise ZeroDivisionError("one\ntwo")

    monkeypatch.setattr(jobs, "_run", broken)
    assert run_job(job) == Failed("ZeroDivisionError inside kalux: one two", is_bug=True)


def test_a_missing_recording_is_named(small_set):
    missing = dataclasses.replace(small_set.without, path=small_set.folder / "none.h5")
    with pytest.raises(InputError, match=r"none\.h5"):
        make_job(missing, "hold", held_out=True, hdr_vdp=False)


def test_artificial_hdr_is_what_the_library_makes_of_it(small_set):
    """With all frames, and with frames held out, when the neighbours are a fair comparison, too."""
    recording = kalux.open(small_set.without.path)
    for every in (None, 2):
        options = Options(ahdr=ArtificialHdr(low=10, high=90), hold_out_frames=every)
        sequence = dataclasses.replace(small_set.without, options=options)
        assert uses_held_out(sequence) == (every is not None)
        made = artificial_hdr(recording, ArtificialCamera(10 / 255, 90 / 255), every=every)
        truth = prepare_reference(made, made.ground_truth())
        for name in ("default", "mean") if every else ("default",):
            done = run_job(make_job(sequence, name, held_out=every is not None, hdr_vdp=False))
            assert isinstance(done, Finished), done
            expected = evaluate_truth(made, truth, methods()[name])
            assert done.record["scores"]["means"] == expected.means()
        assert "of artificial HDR, black up to 10 and white from 90" in done.record["scores"]["protocol"]


def test_a_calibration_changes_filters_and_the_key(small_set):
    save_calibration(Calibration({"events": {"threshold_on": 0.35}}), small_set.folder / "cal.toml")
    options = Options(calibration=(small_set.folder / "cal.toml",))
    sequence = dataclasses.replace(small_set.without, options=options)
    jobs_made = [make_job(sequence, "default", held_out=True, hdr_vdp=False)]
    assert run_job(jobs_made[0]).record["method"]["settings"]["events"]["threshold_on"] == 0.35
    os.utime(small_set.folder / "cal.toml", ns=(3, 3))
    jobs_made += [make_job(sequence, "default", held_out=True, hdr_vdp=False), small_set.job("default")]
    assert len({job.key for job in jobs_made}) == 3


def test_a_folder_of_images_takes_part_wherever_the_job_runs(small_set, tmp_path, monkeypatch):
    """Relative to the folder that is given, with the sequence's name in it; its notes reach the scores."""
    held = hold_out_frames(kalux.open(small_set.without.path))
    folder = tmp_path / "results" / "b"
    folder.mkdir(parents=True)
    lines = ["t_us,file"]
    for i, t in enumerate(held.times.ravel()):
        np.save(folder / f"{i}.npy", np.zeros((32, 40), np.float32))
        lines.append(f"{t},{i}.npy")
    (folder / "timestamps.csv").write_text("\n".join(lines) + "\n")

    def job():
        return make_job(
            small_set.without, "theirs=results/{sequence}", held_out=True, hdr_vdp=False, folder=tmp_path
        )

    made = job()
    monkeypatch.chdir("/")
    done = run_job(made).record
    assert (done["method"]["name"], done["method"]["label"]) == ("theirs=results/{sequence}", "theirs")
    assert f"{held.times.size} images of {folder}" in done["scores"]["adjustments"][-1]
    np.save(folder / "0.npy", np.zeros((32, 40), np.float64))
    assert job().key != made.key


def test_lpips_is_computed_where_it_is_asked_for(tmp_path):
    pytest.importorskip("torch", reason="needs PyTorch; pip install -e '.[learned]' brings it")
    from random_networks import write_lpips

    files = write_lpips(tmp_path)
    simulation = moving_blocks(size=(64, 64))
    path = tmp_path / "large.h5"
    hdf5.write(
        path,
        sensor_size=(64, 64),
        events=[simulation.events],
        frames=simulation.frames,
        contrast_threshold=(0.2, 0.2),
    )
    sequence = Sequence(name="large", path=path, options=Options(), title="Large")
    with_it, without = (
        make_job(sequence, "hold", held_out=True, hdr_vdp=False, lpips=weights) for weights in (files, ())
    )
    assert with_it.key != without.key
    assert run_job(without).record["scores"]["means"]["lpips"] is None
    held = hold_out_frames(kalux.open(path))
    expected = evaluate_held_out(held, methods()["hold"], lpips=load_lpips(*files)).lpips
    assert expected > 0
    assert run_job(with_it).record["scores"]["means"]["lpips"] == expected
