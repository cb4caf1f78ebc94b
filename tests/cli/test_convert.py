"""``kalux convert``: the copy holds what the recording holds, and is whole or not there."""

from __future__ import annotations

import dataclasses
import os
import signal
import time

import numpy as np
import pytest

import kalux
from kalux import readers
from kalux.calibration.values import Calibration
from kalux.frames import Frame, GroundTruth
from kalux.models.colour import sample_mosaic
from kalux.writers.calibration import save_calibration

CONTRAST = {"threshold_on": 0.31, "threshold_off": 0.42}


def same_frame(a, b):
    return (
        np.array_equal(a.image, b.image)
        and a.image.dtype == b.image.dtype
        and (a.exposure_start, a.exposure_end, a.white_value)
        == (b.exposure_start, b.exposure_end, b.white_value)
    )


def assert_same(left, right):
    """All that two recordings hold is equal."""
    assert left.sensor_size == right.sensor_size
    assert left.exposure_known == right.exposure_known
    assert left.contrast_threshold == right.contrast_threshold
    a, b = (np.concatenate(list(rec.events())) for rec in (left, right))
    assert a.dtype == b.dtype
    assert np.array_equal(a, b)
    for ours, theirs in zip(left.stamped_frames(), right.stamped_frames(), strict=True):
        assert same_frame(ours, theirs)
    first, second = left.ground_truth(), right.ground_truth()
    assert (first is None) == (second is None)
    if first is not None:
        assert np.array_equal(first.times, second.times)
        assert np.array_equal(first.images, second.images)
    covariances = left.source.inverse_covariance, right.source.inverse_covariance
    assert (covariances[0] is None) == (covariances[1] is None)
    if covariances[0] is not None:
        assert np.array_equal(*covariances)


def test_everything_is_copied(cli, write_recording, simulation, tmp_path):
    size = simulation.scene.sensor_size
    reference = GroundTruth(np.array([5, 2**40]), np.random.default_rng(0).random((2, *size), np.float32))
    frames = [
        Frame(f.image.astype(np.uint16), f.exposure_start, f.exposure_end, 300.0) for f in simulation.frames
    ]
    path = write_recording(
        tmp_path / "rec.h5",
        frames=frames,
        ground_truth=reference,
        inverse_covariance=np.linspace(1, 2, 256),
        contrast_threshold=(0.11, 0.23),
    )
    found = cli("convert", path, tmp_path / "copy.h5")
    assert (found.code, found.err) == (0, "")
    assert f"{len(simulation.events):,} events and {len(frames)} frames" in found.out
    copy = kalux.open(tmp_path / "copy.h5")
    assert_same(copy, kalux.open(path))
    assert next(iter(copy.frames())).white_value == 300


def test_rgb_that_was_made_of_a_mosaic_is_copied_as_it_is(cli, write_recording, simulation, tmp_path):
    """The pattern that is given goes into the copy, which then opens as a mosaic."""
    rng = np.random.default_rng(0)
    frames = [
        dataclasses.replace(f, image=rng.integers(0, 256, (*f.image.shape, 3), np.uint8))
        for f in simulation.frames
    ]
    path = write_recording(tmp_path / "rec.h5", frames=frames)
    assert cli("convert", path, tmp_path / "copy.h5", "--bayer", "gbrg").code == 0
    copy = kalux.open(tmp_path / "copy.h5")
    assert copy.mosaic == "GBRG"
    for stored, mosaic, frame in zip(copy.stored_frames(), copy.frames(), frames, strict=True):
        assert np.array_equal(stored.image, frame.image)
        assert np.array_equal(mosaic.image, sample_mosaic(frame.image, "GBRG"))


def test_exposures_that_are_given_are_put_in(cli, damaged, tmp_path):
    path = damaged("no exposure times")
    flags = ("--exposure", 3000, "--stamp", "end")
    assert cli("convert", path, tmp_path / "copy.h5", *flags).code == 0
    assert_same(kalux.open(tmp_path / "copy.h5"), kalux.open(path, exposure=3000, stamp="end"))


def test_exposures_that_are_unknown_stay_unknown(cli, damaged, tmp_path):
    path = damaged("no exposure times")
    found = cli("convert", path, tmp_path / "copy.h5", "--quiet")
    assert (found.code, found.out) == (0, "")
    assert found.err.startswith("kalux: warning: the recording has no exposure times")
    copy = kalux.open(tmp_path / "copy.h5")
    assert not copy.exposure_known
    assert_same(copy, kalux.open(path))


def test_a_sensor_size_that_is_a_guess_is_a_warning(cli, simulation, tmp_path):
    events = simulation.events
    np.savez(tmp_path / "rec.npz", t_us=events["t"], x=events["x"], y=events["y"], p=events["p"])
    found = cli("convert", tmp_path / "rec.npz", tmp_path / "copy.h5")
    assert found.code == 0
    assert "does not say how large the sensor is; the copy says 40x32" in found.err


def test_a_recording_without_frames(cli, damaged, tmp_path):
    path = damaged("no frames")
    assert cli("convert", path, tmp_path / "copy.h5").code == 0
    assert_same(kalux.open(tmp_path / "copy.h5"), kalux.open(path))


@pytest.mark.parametrize("damage", ["event outside the sensor", "events not sorted", "frames overlap", "NaN"])
def test_damage_is_one_line_and_nothing_is_written(cli, damaged, tmp_path, damage):
    path = damaged(damage)
    found = cli("convert", path, tmp_path / "copy.h5")
    assert found.code == 2
    assert str(path) in found.error
    assert [file.name for file in tmp_path.iterdir()] == ["damaged.h5"]


def test_a_former_copy_is_replaced_only_on_request(cli, recording, tmp_path):
    out = tmp_path / "copy.h5"
    out.write_text("mine")
    refused = cli("convert", recording, out)
    assert refused.code == 2
    assert "--overwrite" in refused.error
    assert out.read_text() == "mine"
    assert cli("convert", recording, out, "--overwrite").code == 0
    assert_same(kalux.open(out), kalux.open(recording))


def test_damage_leaves_the_former_copy(cli, damaged, tmp_path):
    out = tmp_path / "copy.h5"
    out.write_text("mine")
    assert cli("convert", damaged("NaN"), out, "--overwrite").code == 2
    assert out.read_text() == "mine"


def test_the_recording_itself_is_not_replaced(cli, recording):
    found = cli("convert", recording, recording, "--overwrite")
    assert found.code == 2
    assert "the recording itself" in found.error


@pytest.mark.parametrize(
    ("name", "told"),
    [("copy.mp4", "ends in .h5"), ("copy", "or in .aedat4"), ("none/copy.h5", "no such folder")],
)
def test_names_that_cannot_be_used(cli, recording, tmp_path, name, told):
    found = cli("convert", recording, tmp_path / name)
    assert found.code == 2
    assert told in found.error
    assert list(tmp_path.iterdir()) == []


def test_a_folder_of_that_name(cli, recording, tmp_path):
    (tmp_path / "copy.h5").mkdir()
    assert "a folder of this name" in cli("convert", recording, tmp_path / "copy.h5", "--overwrite").error


@pytest.mark.skipif(os.getuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission(cli, recording, tmp_path):
    (tmp_path / "closed").mkdir(mode=0o500)
    assert "no permission" in cli("convert", recording, tmp_path / "closed" / "copy.h5").error


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_leaves_nothing(start_cli, write_recording, simulation, tmp_path, number):
    path = tmp_path / "rec.h5"
    gap = simulation.frames[-1].exposure_end + 10_000
    many = [
        dataclasses.replace(
            f, exposure_start=f.exposure_start + i * gap, exposure_end=f.exposure_end + i * gap
        )
        for i in range(400)
        for f in simulation.frames
    ]
    write_recording(path, frames=many)
    process = start_cli("convert", path, tmp_path / "copy.h5")
    deadline = time.monotonic() + 60
    while not any(tmp_path.glob(".copy.h5.part")):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.005)
    process.send_signal(number)
    _, stderr = process.communicate(timeout=30)
    assert (process.returncode, stderr) == (130, "kalux: interrupted; nothing was written\n")
    assert list(tmp_path.iterdir()) == [path]


class TestAedat4:
    """What the other format holds is the same; what it cannot hold is said in one line."""

    def test_of_a_real_recording_all_is_kept(self, cli, shared_data, tmp_path):
        path = shared_data / "newton_davis346.aedat4"
        found = cli("convert", path, tmp_path / "copy.aedat4")
        assert (found.code, found.err) == (0, "")
        copy = kalux.open(tmp_path / "copy.aedat4")
        assert copy.source.format == "aedat4"
        assert_same(copy, kalux.open(path))

    def test_what_has_no_place_is_named(self, cli, write_recording, simulation, tmp_path):
        frames = [
            dataclasses.replace(f, image=f.image.astype(np.uint16), white=300.0) for f in simulation.frames
        ]
        reference = GroundTruth(np.array([5]), np.zeros((1, *simulation.scene.sensor_size), np.float32))
        path = write_recording(
            tmp_path / "rec.h5",
            frames=frames,
            mosaic="GBRG",
            response="gamma:2.2",
            ground_truth=reference,
            inverse_covariance=np.ones(256),
        )
        found = cli("convert", path, tmp_path / "copy.aedat4", "--quiet")
        assert found.code == 0
        assert found.out == ""
        assert found.err == (
            "kalux: warning: AEDAT 4 has no place for contrast thresholds, image noise, reference images, the response "
            "gamma:2.2, the white value 300, the Bayer pattern (--bayer GBRG opens the copy with it): not in the copy, "
            "kalux HDF5 (.h5) would keep all\n"
        )
        copy = kalux.open(tmp_path / "copy.aedat4", mosaic="GBRG")
        assert np.array_equal(np.concatenate(list(copy.events())), simulation.events)
        for ours, theirs in zip(copy.frames(), frames, strict=True):
            assert np.array_equal(ours.image, theirs.image)
            assert (ours.exposure_start, ours.exposure_end) == (theirs.exposure_start, theirs.exposure_end)

    def test_frames_of_floats_are_refused(self, cli, write_recording, simulation, tmp_path):
        frames = [dataclasses.replace(f, image=f.image.astype(np.float32)) for f in simulation.frames]
        path = write_recording(tmp_path / "rec.h5", frames=frames, contrast_threshold=None)
        found = cli("convert", path, tmp_path / "copy.aedat4")
        assert found.code == 2
        assert "frame 0 has pixels of float32" in found.error
        assert [file.name for file in tmp_path.iterdir()] == ["rec.h5"]

    def test_a_calibration_is_refused(self, cli, recording, tmp_path):
        save_calibration(Calibration({"events": CONTRAST}), tmp_path / "c.toml")
        found = cli("convert", recording, tmp_path / "copy.aedat4", "--calibration", tmp_path / "c.toml")
        assert found.code == 2
        assert "AEDAT 4 has no place" in found.error


class TestCalibration:
    """Thresholds and the response go into the copy; what a copy cannot state is said."""

    def test_thresholds_and_response_replace_what_the_recording_states(self, cli, recording, tmp_path):
        save_calibration(Calibration({"events": {**CONTRAST, "delay": 500}}), tmp_path / "contrast.toml")
        save_calibration(Calibration({"camera": {"response": "gamma:2.2"}}), tmp_path / "response.toml")
        flags = [v for name in ("contrast", "response") for v in ("--calibration", tmp_path / f"{name}.toml")]
        found = cli("convert", recording, tmp_path / "copy.h5", *flags)
        assert found.code == 0
        assert found.err.count("\n") == 1
        assert "the copy cannot state events.delay" in found.err
        copy = kalux.open(tmp_path / "copy.h5")
        assert copy.contrast_threshold == (0.31, 0.42)
        assert copy.response == "gamma:2.2"

    def test_what_it_does_not_know_stays_as_it_was(self, cli, recording, tmp_path):
        save_calibration(Calibration({"camera": {"response": "srgb"}}), tmp_path / "response.toml")
        found = cli("convert", recording, tmp_path / "copy.h5", "--calibration", tmp_path / "response.toml")
        assert (found.code, found.err) == (0, "")
        copy = kalux.open(tmp_path / "copy.h5")
        assert copy.contrast_threshold == kalux.open(recording).contrast_threshold
        assert copy.response == "srgb"

    @pytest.mark.parametrize(
        "settings",
        [{"camera": {"frame_noise": 0.01}}, {"events": {"threshold_on": "auto", "threshold_off": 0.2}}],
    )
    def test_one_that_says_neither_is_refused(self, cli, recording, tmp_path, settings):
        save_calibration(Calibration(settings), tmp_path / "noise.toml")
        found = cli("convert", recording, tmp_path / "copy.h5", "--calibration", tmp_path / "noise.toml")
        assert found.code == 2
        assert "neither contrast thresholds nor a response" in found.error
        assert not (tmp_path / "copy.h5").exists()


@pytest.mark.parametrize("suffix", [".h5", ".aedat4"])
@pytest.mark.parametrize("length", [250, 300])
def test_a_name_that_is_too_long_is_one_line(cli, recording, tmp_path, suffix, length):
    """250 letters are allowed, but not for the temporary file beside."""
    found = cli("convert", recording, tmp_path / ("a" * (length - len(suffix)) + suffix))
    assert found.code == 2
    assert found.err.endswith("File name too long\n")
    assert "Traceback" not in found.err
    assert not any(tmp_path.iterdir())


def test_the_white_value_goes_into_the_copy(cli, write_recording, simulation, tmp_path):
    deep = [dataclasses.replace(f, image=f.image.astype(np.uint16) << 4) for f in simulation.frames]
    source = write_recording(tmp_path / "deep.h5", frames=deep)
    assert "--white 4095" in cli("info", source, "--no-estimate").out
    assert "give --white 4095" in cli("convert", source, tmp_path / "other.h5").err
    done = cli("convert", source, tmp_path / "copy.h5", "--white", 4095)
    assert (done.code, "--white" in done.err) == (0, False)
    assert {frame.white_value for frame in kalux.open(tmp_path / "copy.h5").frames()} == {4095}
    assert "--white" not in cli("info", tmp_path / "copy.h5", "--no-estimate").out


def test_the_black_level_goes_into_the_copy(cli, recording, tmp_path):
    copy, again = tmp_path / "copy.h5", tmp_path / "again.h5"
    assert cli("convert", recording, copy, "--black-level", 0.05).code == 0
    assert {frame.black for frame in kalux.open(copy).frames()} == {0.05 * 255}
    assert "0.05 of white is taken off (as recorded)" in cli("info", copy).out
    save_calibration(Calibration({"camera": {"black_level": 0.1}}), tmp_path / "dark.toml")
    assert cli("convert", copy, again, "--calibration", tmp_path / "dark.toml").code == 0
    assert {frame.black for frame in kalux.open(again).frames()} == {0.1 * 255}
    lost = cli("convert", again, tmp_path / "copy.aedat4")
    assert lost.code == 0
    assert "no place for contrast thresholds, the black value 25.5:" in lost.err
    assert "at most 0.5" in cli("convert", recording, copy, "--black-level", 0.7, "--overwrite").error


@pytest.mark.parametrize(
    "name", ["newton_davis346.aedat4", "slider_depth", "hdr_pan/Oxford_Church_noisy.mat"]
)
def test_real_recordings_are_copied(cli, shared_data, tmp_path, name):
    assert cli("convert", shared_data / name, tmp_path / "copy.h5").code == 0
    copy = kalux.open(tmp_path / "copy.h5")
    assert copy.source.format == "kalux"
    assert_same(copy, kalux.open(shared_data / name))
    assert (readers.read(tmp_path / "copy.h5").count_events()) > 300_000
