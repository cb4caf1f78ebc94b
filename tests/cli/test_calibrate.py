"""``kalux calibrate`` and ``--calibration``."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from kalux import load_calibration
from kalux.datasets import SensorSettings, photograph_scene, simulate
from kalux.datasets.motion import pan
from kalux.models.camera import Response
from kalux.recording import EventLayout, with_event_layout
from kalux.settings import read_toml
from kalux.writers import hdf5
from recordings import SIZE, small_events

from builders import blocks, damaged, moving_blocks, passing_by, sky, textured


@pytest.fixture
def unlabelled_file(write_recording, tmp_path):
    """A recording that states no thresholds; those of the simulation are 0.2."""
    return write_recording(tmp_path / "rec.h5", contrast_threshold=None)


def test_contrast_is_measured_written_and_used(cli, unlabelled_file, tmp_path):
    out = tmp_path / "contrast.toml"
    done = cli("calibrate", "contrast", unlabelled_file, "-o", out, "--delay", 0)
    assert done.code == 0, done.err
    assert "threshold_on" in done.out
    assert "(log intensity)" in done.out
    found = load_calibration(out)
    assert found.settings["events"]["threshold_on"] == pytest.approx(0.2, rel=0.15)
    assert found.provenance["recording"] == str(unlabelled_file)

    info = cli("info", unlabelled_file, "--no-estimate", "--calibration", out)
    assert info.code == 0
    assert "map threshold_on" in info.out
    assert "made by" in info.out

    made = cli("reconstruct", unlabelled_file, "-o", tmp_path / "o", "--format", "npy", "--calibration", out)
    assert made.code == 0, made.err
    assert "(calibrated)" in made.out
    assert "warning" not in made.err  # the thresholds are measured
    flagged = cli(
        "reconstruct",
        unlabelled_file,
        *("-o", tmp_path / "p", "--format", "npy", "--calibration", out, "--events.threshold-on", 0.3),
    )
    assert "on 0.300" in flagged.out


@pytest.mark.parametrize(
    ("picture", "cut", "saturation"),
    [(sky(0.8), 255, None), (textured(2.4), 200, 0.999 * 200 / 255), (textured(2.4), 255, 0.999)],
)
def test_a_saturation_is_written_only_if_frames_are_clipped_there(cli, tmp_path, picture, cut, saturation):
    """Of a sky pixels pile up as of a sensor that clips."""
    made = passing_by(picture, cut)
    recording, out = tmp_path / "rec.h5", tmp_path / "noise.toml"
    hdf5.write(
        recording,
        sensor_size=made.sensor_size,
        events=made.events(),
        frames=made.frames(),
        contrast_threshold=0.2,
    )
    done = cli("calibrate", "noise", recording, "-o", out)
    assert done.code == 0, done.err
    found = load_calibration(out)
    assert found.settings.get("camera", {}).get("saturation") == (
        None if saturation is None else pytest.approx(saturation)
    )
    white = 0.8 if saturation is None else cut / 255
    assert found.measured["white_level"] == pytest.approx(white, abs=0.01)


def test_thresholds_need_frames(cli, tmp_path):
    path = tmp_path / "events.h5"
    hdf5.write(path, sensor_size=SIZE, events=[small_events()], frames=[])
    done = cli("calibrate", "contrast", path, "-o", tmp_path / "c.toml")
    assert done.code == 2
    assert "no frames" in done.error
    assert "--frames" in done.error


def moved(frames, by):
    """The frames of a clock that is ahead by ``by`` us."""
    return [
        dataclasses.replace(f, exposure_start=f.exposure_start + by, exposure_end=f.exposure_end + by)
        for f in frames
    ]


@pytest.mark.parametrize(
    ("events", "frames", "told"),
    [
        (lambda e: e[:0], lambda f: f, "there are no events to measure thresholds of"),
        (lambda e: e, lambda f: f[3:4], "there is one frame"),
        (lambda e: e, lambda f: moved(f, 10**12), "there is no event between the frames"),
        (lambda e: e[e["p"]], lambda f: f, "record both, ON and OFF"),
        (lambda e: e, lambda f: moved(f, 150_000), "kalux calibrate offset REC"),
        (lambda e: e, lambda f: [dataclasses.replace(g, image=g.image // 64) for g in f], "too little moves"),
    ],
    ids=["no events", "one frame", "another epoch", "ON only", "late frames", "dark"],
)
def test_why_thresholds_cannot_be_told_is_one_line(cli, tmp_path, events, frames, told):
    """Not always that too little moves."""
    made = passing_by(textured(0.6))
    path = tmp_path / "rec.h5"
    hdf5.write(
        path,
        sensor_size=made.sensor_size,
        events=[events(np.concatenate(list(made.events())))],
        frames=frames(list(made.frames())),
    )
    done = cli("calibrate", "contrast", path, "-o", tmp_path / "c.toml", "--quiet")
    assert done.code == 2
    (error,) = (line for line in done.err.splitlines() if "error" in line)
    assert told in error


def in_16_bits(path, made):
    """A recording of 12 bits, none of which clips, that does not state white."""
    frames = [dataclasses.replace(f, image=f.image.astype(np.uint16) * 8) for f in made.frames()]
    hdf5.write(path, sensor_size=made.sensor_size, events=made.events(), frames=frames)
    return path


@pytest.mark.parametrize("what", ["contrast", "noise", "offset"])
def test_white_that_is_doubtful_is_a_warning(cli, tmp_path, what):
    recording = in_16_bits(tmp_path / "rec.h5", passing_by(textured(0.9)))
    assert "give --white 4095" in cli("calibrate", what, recording).err
    assert "--white" not in cli("calibrate", what, recording, "--white", 2040).err


def test_levels_of_a_doubtful_white_are_not_taken_for_those_of_another(cli, tmp_path):
    """What a calibration states as shares of 65535 says nothing of a recording whose white is 4095."""
    recording, out = in_16_bits(tmp_path / "rec.h5", passing_by(textured(3), 200)), tmp_path / "noise.toml"
    assert cli("calibrate", "noise", recording, "-o", out).code == 0
    found = load_calibration(out)
    assert (found.provenance["white"], found.provenance["white_is_doubtful"]) == (65535, True)
    assert "saturation" in found.settings["camera"]
    used = ["--calibration", out, "--white", 2040]
    for command in (
        ["reconstruct", recording, "-o", tmp_path / "images"],
        ["calibrate", "noise", recording],
        ["convert", recording, tmp_path / "copy.h5", "--black-level", 0.1],
    ):
        done = cli(*command, *used)
        assert done.code == 2
        assert "its saturation is a share of 65535 as white" in done.err
        assert "calibrate again with --white 2040" in done.err
    again = cli("calibrate", "noise", recording, "-o", out, "--overwrite", "--white", 2040)
    assert again.code == 0, again.err
    assert load_calibration(out).provenance["white_is_doubtful"] is False
    assert cli("info", recording, *used).code == 0


def test_the_hint_of_a_written_calibration_can_be_pasted(cli, unlabelled_file, tmp_path):
    out = tmp_path / "my noise ö.toml"
    done = cli("calibrate", "noise", unlabelled_file, "-o", out)
    assert f"--calibration '{out}'" in done.out


def test_a_calibration_is_not_overwritten(cli, unlabelled_file, tmp_path):
    out = tmp_path / "noise.toml"
    assert cli("calibrate", "noise", unlabelled_file, "-o", out, "--quiet").code == 0
    again = cli("calibrate", "noise", unlabelled_file, "-o", out)
    assert again.code == 2
    assert "--overwrite" in again.error
    assert cli("calibrate", "noise", unlabelled_file, "-o", out, "--overwrite", "--quiet").code == 0


def test_fit_says_before_and_after(cli, unlabelled_file, tmp_path):
    out = tmp_path / "fit.toml"
    done = cli("calibrate", "noise", unlabelled_file, "--fit", "--evaluations", 3, "-o", out)
    assert done.code == 0, done.err
    assert "negative log likelihood per held-out pixel" in done.out
    measured = load_calibration(out).measured
    assert measured["nll_after"] <= measured["nll_before"]
    assert measured["held_out_mse_after"] <= measured["held_out_mse_before"]


@pytest.fixture(scope="module")
def sound_and_damaged(tmp_path_factory):
    """Two files of one scene: as it is, and mirrored, with polarities swapped, faulty frames and a stuck pixel."""
    sensor = SensorSettings(threshold_on=0.2, threshold_off=0.2, noise_rate=1.0, read_noise=0.004)
    sound = moving_blocks(0.02, 1.2, sensor=sensor, duration=1_000_000, size=(48, 64)).recording()
    wrong = damaged(with_event_layout(sound, EventLayout(mirrored_x=True, swapped=True)))
    folder, paths = tmp_path_factory.mktemp("mended"), []
    for name, source in (("sound.h5", sound), ("damaged.h5", wrong)):
        paths.append(folder / name)
        hdf5.write(paths[-1], sensor_size=source.sensor_size, events=source.events(), frames=source.frames())
    return paths


MENDED = (
    "the brightness of the frames steps at 1 frame",
    "left out: 1 frame",
    "their x counts from the other",
)


@pytest.mark.parametrize(
    ("what", "names"),
    [
        ("contrast", ["events.threshold_on", "events.threshold_off"]),
        ("noise", ["events.delay", "events.noise_rate"]),
    ],
)
def test_a_damaged_recording_is_mended_before_it_is_measured(cli, sound_and_damaged, tmp_path, what, names):
    found = []
    for path in sound_and_damaged:
        done = cli("calibrate", what, path, "-o", tmp_path / "o.toml", "--overwrite", "--quiet")
        assert done.code == 0, done.err
        settings = load_calibration(tmp_path / "o.toml").settings
        found.append([settings[group][name] for group, name in (name.split(".") for name in names)])
        assert all(text in done.err for text in MENDED) == (path == sound_and_damaged[1])
    assert "--camera" not in done.err  # there are no such flags here
    np.testing.assert_allclose(found[1], found[0], rtol=0.2)


def test_an_offset_is_that_of_the_mended_recording(cli, sound_and_damaged, tmp_path):
    offsets = []
    for path in sound_and_damaged:
        done = cli("calibrate", "offset", path, "-o", tmp_path / "o.toml", "--overwrite", "--range", 0.2)
        assert done.code == 0, done.err
        offsets.append(read_toml(tmp_path / "o.toml")["offset_us"])
    assert all(text in done.err for text in MENDED)
    assert "the offset may be another" not in done.err
    assert offsets[1] == pytest.approx(offsets[0], abs=200)


def test_response_from_images_with_given_times(cli, tmp_path):
    picture = cv2.GaussianBlur(blocks(0.5, 300.0, shape=(80, 96)), (0, 0), 1.0)
    curve, times, paths = Response.gamma(2.0), [0.001, 0.004, 0.016, 0.064], []
    for k, t in enumerate(times):
        paths.append(tmp_path / f"{k}.png")
        cv2.imwrite(str(paths[-1]), np.rint(255 * curve(np.minimum(picture * t, 1.0))).astype(np.uint8))
    out = tmp_path / "response.toml"
    done = cli("calibrate", "response", *paths, "--times", "0.001,1/250,0.016,0.064", "-o", out)
    assert done.code == 0, done.err
    found = Response.named(load_calibration(out).settings["camera"]["response"])
    assert float(found.inverse(np.array([0.5]))[0]) == pytest.approx(0.25, abs=0.03)
    swapped = cli(
        "calibrate", "response", *paths, "--times", "0.064,0.016,1/250,0.001", "-o", out, "--overwrite"
    )
    assert "no curve fits the images; do they show one still scene, with these times?" in swapped.error
    again = tmp_path / "again.toml"  # of the folder, in the order of the names' numbers
    assert cli("calibrate", "response", tmp_path, "--times", "0.001,1/250,0.016,0.064", "-o", again).code == 0
    assert load_calibration(again).settings == load_calibration(out).settings


def test_a_folder_of_photographs_without_times_asks_for_them(cli, tmp_path):
    """Not for a recording, though only one thing was given."""
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.full((8, 8), 50 * k, np.uint8))
    found = cli("calibrate", "response", tmp_path)
    assert (found.code, "0.png" in found.error, "--times" in found.error) == (2, True, True)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["calibrate"], "calibrate what?"),
        (["calibrate", "nonsense"], "nonsense"),
        (["calibrate", "contrast", "REC", "-o", "a.txt"], "ends in .toml"),
        (["calibrate", "contrast", "REC", "--refactory", "3"], "did you mean --refractory"),
        (["calibrate", "response", "REC"], "1 exposure time, three are needed"),
        (["calibrate", "response", "a.png", "b.png", "--times", "x,y"], "numbers with commas"),
        (["info", "REC", "--calibration", "nowhere.toml"], "cannot be read"),
    ],
)
def test_mistakes_are_one_line(cli, unlabelled_file, arguments, message):
    done = cli(*[unlabelled_file if word == "REC" else word for word in arguments])
    assert done.code == 2
    assert message in done.error


def test_a_rolling_shutter_is_measured_written_and_used(cli, tmp_path):
    sensor = SensorSettings(threshold_on=0.15, threshold_off=0.15, row_time=150.0, exposure=2_000)
    scene = photograph_scene(blocks(0.05, 0.6), pan(60.0, 25.0), sensor_size=(64, 48), duration=600_000)
    made = simulate(scene, sensor).recording()
    path, out = tmp_path / "rec.h5", tmp_path / "shutter.toml"
    hdf5.write(path, sensor_size=made.sensor_size, events=made.events(), frames=made.frames())
    done = cli("calibrate", "shutter", path, "-o", out)
    assert done.code == 0, done.err
    assert "us" in next(line for line in done.out.splitlines() if "row_time" in line)
    row_time = load_calibration(out).settings["camera"]["row_time"]
    assert row_time == pytest.approx(150, rel=0.1)
    used = cli("reconstruct", path, "-o", tmp_path / "images", "--calibration", out, "--at", "frames")
    assert used.code == 0, used.err
    assert read_toml(tmp_path / "images" / "kalux.toml")["settings"]["camera"]["row_time"] == row_time


def test_a_global_shutter_is_said_to_be_none_that_rolls(cli, unlabelled_file, tmp_path):
    done = cli("calibrate", "shutter", unlabelled_file, "-o", tmp_path / "shutter.toml")
    assert done.code == 2
    assert "no rolling shutter is seen" in done.err
    assert not (tmp_path / "shutter.toml").exists()


def test_without_frames_there_is_no_shutter(cli, tmp_path):
    hdf5.write(tmp_path / "events.h5", sensor_size=SIZE, events=[small_events()], frames=[])
    done = cli("calibrate", "shutter", tmp_path / "events.h5")
    assert done.code == 2
    assert "no frames; kalux needs frames as well as events" in done.err
