"""``kalux register``, ``kalux calibrate rig`` and ``kalux calibrate offset``."""

from __future__ import annotations

import dataclasses
import tomllib

import cv2
import numpy as np
import pytest

import kalux
from kalux.calibration.registration import Registration
from kalux.calibration.rig import load_rig, rig_toml
from kalux.models.camera import Camera
from kalux.writers import hdf5
from rigs import DISTANCE, OFFSET, board_recording, distant_recording, misplaced, small_rig


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rig")
    for name, seen in (("scene", distant_recording()), ("board", board_recording())):
        hdf5.write(folder / f"{name}.h5", sensor_size=(120, 160), events=[seen.events], frames=[])
        hdf5.write(folder / f"{name}_frames.h5", sensor_size=(240, 320), events=[], frames=seen.frames)
    (folder / "true.toml").write_text(rig_toml(small_rig()))
    return folder


def test_from_the_board_to_the_reconstruction(cli, files, tmp_path):
    board = (files / "board.h5", files / "board_frames.h5", "--board", "6x5", "--square", "40")
    rig_file, sheet = tmp_path / "rig.toml", tmp_path / "sheet.png"
    done = cli("calibrate", "rig", *board, "-o", rig_file, "--window", 300, "--sheet", sheet)
    assert done.code == 0, done.err
    assert "used, 0 dropped" in done.out
    assert cv2.imread(str(sheet)).shape[2] == 3
    assert load_rig(rig_file).baseline == pytest.approx(0.04, abs=0.003)

    out, overlay, plot = tmp_path / "both.h5", tmp_path / "overlay.png", tmp_path / "offset.png"
    scene = (files / "scene.h5", "--frames", files / "scene_frames.h5", "--rig", rig_file, "--range", 0.3)
    done = cli("register", *scene, "-o", out, "--overlay", overlay, "--plot", plot)
    assert done.code == 0, done.err
    assert f"offset      {OFFSET / 1000:.1f}"[:14] in done.out
    assert cv2.imread(str(overlay)).shape == (240, 320, 3)
    assert cv2.imread(str(plot)) is not None
    recording = kalux.open(out)
    frames = list(recording.frames())
    assert len(frames) == len(distant_recording().frames)
    assert abs(frames[0].exposure_start - distant_recording().frames[0].exposure_start - OFFSET) < 300
    assert all(f.valid is not None and 0.8 < f.valid.mean() < 1 for f in frames)
    assert len(recording.events()) == len(distant_recording().events)

    done = cli("calibrate", "offset", out, "--range", "0.2", "-o", tmp_path / "offset.toml")
    assert done.code == 0, done.err
    assert (
        abs(tomllib.loads((tmp_path / "offset.toml").read_text())["offset_us"]) < 500
    )  # nothing is left of it
    silent = cli("calibrate", "offset", out, "--range", "0.2", "--quiet")
    assert (silent.code, silent.out, silent.err) == (0, "", "")


def test_an_offset_file_is_taken(cli, files, tmp_path):
    (tmp_path / "offset.toml").write_text(f"kalux_offset = 1\noffset_us = {OFFSET}\n")
    for offset in (tmp_path / "offset.toml", OFFSET):
        out = tmp_path / "both.h5"
        done = cli(
            "register", files / "scene.h5", "--frames", files / "scene_frames.h5", "--rig", files / "true.toml",
            "--homography", "rig", "--distance", DISTANCE, "--offset", offset, "--response", "srgb",
            "-o", out, "--overwrite", "--quiet",
        )  # fmt: skip
        assert (done.code, done.out) == (0, "")
        recording = kalux.open(out)
        assert recording.response == "srgb"
        frame = next(iter(recording.frames()))
        camera = Camera.named("srgb", 1.0)
        expected = Registration.of_rig(small_rig(), DISTANCE).frame(
            distant_recording().frames[0], camera=camera
        )
        np.testing.assert_array_equal(frame.image, expected.image)
        np.testing.assert_array_equal(frame.valid, expected.valid)
        assert frame.exposure_start == distant_recording().frames[0].exposure_start + OFFSET
    assert (
        misplaced(Registration.of_rig(small_rig()), Registration.of_rig(small_rig(), DISTANCE)).mean() > 0.2
    )


def test_a_black_level_that_is_told_is_taken_off(cli, files, tmp_path):
    """Left in, events seem to be steps of a third less, and the offset is several standard errors off."""
    raised = [
        dataclasses.replace(f, image=np.rint(16 + f.image * (239 / 255)).astype(np.uint8))
        for f in distant_recording().frames
    ]
    hdf5.write(tmp_path / "raised.h5", sensor_size=(240, 320), events=[], frames=raised)
    told = []
    for frames, black in ((files / "scene_frames.h5", None), (tmp_path / "raised.h5", 16 / 255)):
        out = tmp_path / "both.h5"
        flags = [] if black is None else ["--black-level", black]
        done = cli(
            "register", files / "scene.h5", "--frames", frames, "--rig", files / "true.toml", "--range", 0.3,
            "-o", out, "--overwrite", *flags,
        )  # fmt: skip
        assert done.code == 0, done.err
        text = done.out.split("thresholds ")[1].split(";")[0]
        told.append(([float(c) for c in text.split(" and ")], next(iter(kalux.open(out).frames()))))
    (thresholds, frame), (again, same) = told
    np.testing.assert_allclose(again, thresholds, atol=0.01)
    both = frame.valid & same.valid
    np.testing.assert_allclose(same.normalised()[both], frame.normalised()[both], atol=0.01)
    wrong = cli(
        "register", files / "scene.h5", "--frames", frames, "-o", out, "--black-level", 2, "--overwrite"
    )
    assert wrong.code == 2
    assert "black_level" in wrong.error


def test_what_jpeg_leaves_clipped_pixels_at_is_white(cli, files, tmp_path):
    """Where frames are clipped in the camera they are in the recording, though their JPEG says less there."""
    whole, jpeg = [], []
    for frame in distant_recording().frames:
        image = np.minimum(frame.image.astype(np.uint16) * 2, 255).astype(np.uint8)
        coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 60])[1]
        whole.append(dataclasses.replace(frame, image=image))
        jpeg.append(dataclasses.replace(frame, image=cv2.imdecode(coded, cv2.IMREAD_UNCHANGED)))
    shares = []
    for name, frames in (("whole", whole), ("jpeg", jpeg)):
        hdf5.write(tmp_path / f"{name}.h5", sensor_size=(240, 320), events=[], frames=frames)
        out = tmp_path / f"both_{name}.h5"
        done = cli(
            "register", files / "scene.h5", "--frames", tmp_path / f"{name}.h5", "--rig", files / "true.toml",
            "--homography", "rig", "--distance", DISTANCE, "--offset", OFFSET, "-o", out,
        )  # fmt: skip
        assert done.code == 0, done.err
        assert ("stored as JPEG once" in done.err) == (name == "jpeg")
        shares.append([f.normalised() >= 0.98 for f in kalux.open(out).frames()])
    clipped, found = (np.array(each) for each in shares)
    assert clipped.mean() > 0.02
    assert found[clipped].mean() > 0.9


def test_the_response_that_the_frames_state_is_kept(cli, files, tmp_path):
    source = kalux.open(files / "scene_frames.h5")
    stated = tmp_path / "stated.h5"
    hdf5.write(
        stated, sensor_size=source.sensor_size, events=[], frames=source.frames(), response="gamma:2.2"
    )
    out = tmp_path / "both.h5"
    done = cli(
        "register", files / "scene.h5", "--frames", stated, "--rig", files / "true.toml", "--homography", "rig",
        "--distance", DISTANCE, "--offset", OFFSET, "-o", out, "--quiet",
    )  # fmt: skip
    assert (done.code, kalux.open(out).response) == (0, "gamma:2.2")


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--stamp", "start"], "give --exposure, too"),
        (["--trigger-edge", "rising"], "--trigger-edge is for --timing triggers"),
        (["--timing", "triggers"], "has no trigger events"),
        (["--timing", "triggers", "--stamp", "end"], "--stamp is for frames with times of their own"),
        (["--timing", "same", "--offset", "5"], "leave --timing out"),
        (["--offset", "later"], "neither a number of us nor a file"),
        (["--offset", "nan"], "--offset nan: nan us; at most 1e18"),
        (["--offset=-1e300"], "-1e+300 us; at most 1e18"),
        (["--around", "nan"], "--around is nan ms; at most 1e15"),
        (["--around", "1e16"], "--around is 1e+16 ms"),
        (["--range", "0"], "--range is 0 s"),
        (["--distance", "20"], "without a rig file"),
        (["--rig", "none.toml"], "none.toml: cannot be read"),
    ],
)
def test_usage(cli, files, tmp_path, arguments, told):
    out = tmp_path / "both.h5"
    done = cli("register", files / "scene.h5", "--frames", files / "scene_frames.h5", "-o", out, *arguments)
    assert done.code == 2
    assert told in done.error
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--board", "nine"], "COLUMNSxROWS"),
        (["--board", "6x5", "--window", "0"], "--window is 0 ms"),
        (["--board", "9x8"], "in 0 places only"),
    ],
)
def test_usage_of_calibrate_rig(cli, files, tmp_path, arguments, told):
    out = tmp_path / "rig.toml"
    done = cli(
        "calibrate",
        "rig",
        files / "scene.h5",
        files / "scene_frames.h5",
        "--square",
        "40",
        "-o",
        out,
        *arguments,
    )
    assert done.code == 2
    assert told in done.error
    assert not out.exists()


def test_an_offset_needs_frames(cli, files):
    done = cli("calibrate", "offset", files / "scene.h5")
    assert done.code == 2
    assert "scene.h5: no frames; kalux needs frames as well as events" in done.error


def test_calibrate_needs_to_know_what(cli):
    done = cli("calibrate")
    assert done.code == 2
    assert "calibrate what?" in done.error


@pytest.mark.parametrize("flags", [[], ["--homography", "rig", "--offset", "0"]])
def test_events_outside_the_rigs_camera_are_refused(cli, files, tmp_path, flags):
    """Of a recording that does not state its size."""
    events, out = tmp_path / "events.npz", tmp_path / "both.h5"
    array = distant_recording().events.copy()
    array["x"][-1] = 300
    np.savez(events, **{name: array[name] for name in "txyp"})
    done = cli(
        "register",
        events,
        "--frames",
        files / "scene_frames.h5",
        "--rig",
        files / "true.toml",
        "-o",
        out,
        *flags,
    )
    assert done.code == 2
    assert "of a sensor of 301x120 pixels at least, the rig's event camera has 160x120" in done.error
    assert not out.exists()


def test_nothing_is_overwritten(cli, files, tmp_path):
    out = tmp_path / "both.h5"
    out.write_text("mine")
    done = cli("register", files / "scene.h5", "--frames", files / "scene_frames.h5", "-o", out)
    assert done.code == 2
    assert out.read_text() == "mine"
