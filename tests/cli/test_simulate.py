"""``kalux simulate``: a recording that the other commands take, the same each time, and errors in one line."""

from __future__ import annotations

import dataclasses
import itertools
import json
import signal
import time
import tomllib

import cv2
import numpy as np
import pytest

import kalux
from kalux.cli.simulated_sensors import sensor_fields
from kalux.datasets import SensorSettings, sensor_preset


@pytest.fixture(scope="module")
def photograph(tmp_path_factory):
    """A small HDR photograph: blocks, and a sun."""
    rng = np.random.default_rng(0)
    picture = np.full((90, 120), 0.1, np.float32)
    for _ in range(120):
        y, x = rng.integers(0, 90, 2)
        height, width = rng.integers(4, 30, 2)
        picture[y : y + height, x : x + width] = np.exp(rng.uniform(np.log(0.02), np.log(3.0)))
    picture[20:40, 30:50] = 20.0
    path = tmp_path_factory.mktemp("photograph") / "room.hdr"
    cv2.imwrite(str(path), np.repeat(picture[..., None], 3, axis=2))
    return path


SHORT = ("--size", "40x32", "--duration", "0.4")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Thirty ordinary images of a bar that moves."""
    path = tmp_path_factory.mktemp("folder")
    for i in range(30):
        picture = np.full((40, 60, 3), 60, np.uint8)
        picture[:, 10 + i : 20 + i] = 220
        cv2.imwrite(str(path / f"{i}.png"), picture)
    return path


def recording(path):
    found = kalux.open(path)
    return found, np.concatenate(list(found.events())), list(found.frames())


def test_a_photograph_becomes_a_recording_with_truth(cli, photograph, tmp_path):
    out = tmp_path / "a.h5"
    told = cli("simulate", photograph, "-o", out, *SHORT)
    assert (told.code, told.err) == (0, "")
    found, events, frames = recording(out)
    assert found.sensor_size == (32, 40)
    assert f"{len(events):,} events, {len(frames)} frames" in told.out
    assert len(frames) == 10
    assert len(events) > 2000
    truth = found.ground_truth()
    middles = [frame.middle for frame in frames]
    assert truth.times.tolist() == sorted(
        [*middles[1:-1], *((a + b) // 2 for a, b in itertools.pairwise(middles[1:-1]))]
    )
    # 0.12 of the pixels are beyond white, and the frames clip them.
    assert (truth.images > 1).mean() == pytest.approx(0.12, abs=0.03)
    assert np.mean([(frame.image == 255).mean() for frame in frames]) == pytest.approx(0.12, abs=0.04)
    assert truth.images.max() > 2
    inside = truth.images[2] < 0.9
    assert np.abs(frames[2].normalised() - truth.images[2])[inside].mean() < 0.05


def test_info_and_evaluate_take_it(cli, photograph, tmp_path):
    pytest.importorskip("skimage")
    out = tmp_path / "a.h5"
    assert cli("simulate", photograph, "-o", out, *SHORT, "--preset", "ideal").code == 0
    info = cli("info", out)
    assert info.code == 0
    assert "ground truth images are included" in info.out
    scores = cli("evaluate", out, "--methods", "hold,default", "--quiet", "-o", tmp_path / "scores.json")
    assert scores.code == 0
    hold, default = json.loads((tmp_path / "scores.json").read_text())["methods"]
    assert default["mse"] < 0.5 * hold["mse"]


def test_the_same_flags_give_the_same_file(cli, photograph, tmp_path):
    flags = (*SHORT, "--seed", "3", "--motion", "handheld", "--quiet")
    for name in ("a.h5", "b.h5"):
        found = cli("simulate", photograph, "-o", tmp_path / name, *flags)
        assert (found.code, found.out, found.err) == (0, "", "")
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()
    assert (
        cli(
            "simulate", photograph, "-o", tmp_path / "c.h5", *SHORT, "--seed", "4", "--motion", "handheld"
        ).code
        == 0
    )
    assert (tmp_path / "c.h5").read_bytes() != (tmp_path / "a.h5").read_bytes()


def test_the_settings_are_beside_the_recording(cli, photograph, tmp_path):
    flags = ("--seed", "5", "--sensor.latency", "7", "--white", "2")
    assert cli("simulate", photograph, "-o", tmp_path / "a.h5", *SHORT, *flags).code == 0
    settings = tomllib.loads((tmp_path / "a.h5.kalux.toml").read_text())
    expected = dataclasses.replace(sensor_preset("davis346").settings, latency=7.0)
    assert SensorSettings(**settings["sensor"]) == expected
    assert settings["simulation"]["white_radiance"] == 2
    assert settings["command"].startswith("kalux simulate ")
    (tmp_path / "a.h5.kalux.toml").write_text("mine")
    refused = cli("simulate", photograph, "-o", tmp_path / "a.h5", *SHORT, "--overwrite")
    assert "not an output of kalux" in refused.error


def test_negative_pixels_are_told_once(cli, tmp_path):
    """Of a photograph, of a folder and of what crosses before it."""
    rng = np.random.default_rng(0)
    (tmp_path / "frames").mkdir()
    for i in range(3):
        picture = rng.uniform(0.1, 9, (40, 50)).astype(np.float32)
        picture[:2, :3] = -0.25
        cv2.imwrite(str(tmp_path / "frames" / f"{i}.tif"), picture)
    one = tmp_path / "frames" / "0.tif"
    line = f"kalux: warning: {one}: 6 of 2,000 pixels (0.3 %) are negative, down to -0.25, and taken as black"
    for source, flags in ((one, ["--foreground", one]), (tmp_path / "frames", ["--source-rate", "10"])):
        told = cli("simulate", source, "-o", tmp_path / f"{source.stem}.h5", *flags, "--size", "20x16")
        assert told.code == 0
        lines = told.err.splitlines()
        assert [text.split(";")[0] for text in lines if "negative" in text] == [line] * (1 + (source == one))


def test_a_folder_needs_its_rate(cli, folder, tmp_path):
    out = tmp_path / "a.h5"
    refused = cli("simulate", folder, "-o", out)
    assert refused.code == 2
    assert "give --source-rate HZ" in refused.error
    told = cli("simulate", folder, "-o", out, "--source-rate", "100", "--size", "60x40", "--preset", "ideal")
    assert told.code == 0
    assert told.err.count("warning") == 1
    assert "no HDR source: it is decoded as sRGB" in told.err
    found, events, frames = recording(out)
    assert len(frames) == 6
    # Events where the bar's edges pass, and nowhere else.
    assert set(events["x"].tolist()) == set(range(10, 49))
    assert found.ground_truth().images.max() == pytest.approx(((220 / 255 + 0.055) / 1.055) ** 2.4, rel=0.01)


def test_a_still_camera_sees_nothing_but_noise(cli, photograph, tmp_path):
    out = tmp_path / "a.h5"
    told = cli("simulate", photograph, "-o", out, *SHORT, "--preset", "ideal", "--motion", "still")
    assert told.code == 0
    assert kalux.open(out).source.count_events() == 0
    flags = ("--sensor.noise-rate", "50", "--sensor.noise_resets", "true", "--overwrite")
    assert (
        cli("simulate", photograph, "-o", out, *SHORT, "--preset", "ideal", "--motion", "still", *flags).code
        == 0
    )
    expected = 50 * 0.4 * 32 * 40
    assert abs(kalux.open(out).source.count_events() - expected) < 4 * np.sqrt(expected)


@pytest.mark.parametrize("motion", ["pan", "rotate", "dolly", "shake", "handheld", "pan+shake"])
def test_motions_make_events(cli, photograph, tmp_path, motion):
    flags = ("--size", "40x32", "--duration", "0.1", "--preset", "ideal", "--motion", motion)
    assert cli("simulate", photograph, "-o", tmp_path / "a.h5", *flags).code == 0
    assert kalux.open(tmp_path / "a.h5").source.count_events() > 100


def test_a_foreground_crosses(cli, photograph, tmp_path):
    base = (*SHORT, "--preset", "ideal", "--motion", "still", "--white", "1")
    ball = (
        "--foreground",
        "ball",
        "--foreground-speed",
        "160",
        "--foreground-size",
        "12",
        "--foreground-level",
        "5",
    )
    assert cli("simulate", photograph, "-o", tmp_path / "a.h5", *base, *ball).code == 0
    _, events, _ = recording(tmp_path / "a.h5")
    assert set(events["y"].tolist()) <= set(range(8, 24))
    assert len(set(events["x"].tolist())) == 40
    sprite = np.zeros((20, 10, 4), np.uint8)
    sprite[..., 3] = 255
    cv2.imwrite(str(tmp_path / "s.png"), sprite)
    told = cli("simulate", photograph, "-o", tmp_path / "b.h5", *base, "--foreground", tmp_path / "s.png")
    assert told.code == 0
    truth = kalux.open(tmp_path / "b.h5").ground_truth().images
    assert truth.min() < 0.01


def test_frame_flags(cli, photograph, tmp_path):
    flags = ("--frame-rate", "50", "--exposure", "2000", "--sensor.bits", "10", "--truth-rate", "200")
    assert cli("simulate", photograph, "-o", tmp_path / "a.h5", *SHORT, *flags).code == 0
    found, _, frames = recording(tmp_path / "a.h5")
    assert (len(frames), frames[0].exposure, frames[0].white_value) == (20, 2000, 1023)
    assert np.diff(found.ground_truth().times).tolist() == [5000] * (len(found.ground_truth().times) - 1)
    assert cli("simulate", photograph, "-o", tmp_path / "b.h5", *SHORT, "--auto-exposure", "0.2").code == 0
    exposures = {frame.exposure for frame in recording(tmp_path / "b.h5")[2]}
    assert len(exposures) > 3


def test_every_setting_of_the_sensor_is_a_flag(cli):
    fields = {field.name: field for field in dataclasses.fields(SensorSettings)}
    flags = sensor_fields()
    assert flags.keys() == fields.keys()
    names = {
        "float": "a number",
        "float | None": "a number",
        "int": "a whole number",
        "int | None": "a whole number",
    }
    names |= {"bool": "true or false", "CameraResponse": "str"}
    for name, kind in flags.items():
        assert kind.__name__ == names[str(fields[name].type)], name
    told = cli("simulate", "--help-sensor")
    assert told.code == 0
    for name in fields:
        assert f"--sensor.{name.replace('_', '-')} " in told.out
    assert "davis346" in told.out
    assert "Lichtsteiner" in told.out
    assert "]_" not in told.out


@pytest.mark.parametrize(
    ("flags", "told"),
    [
        (("--preset", "dvs"), "no preset 'dvs'"),
        (("--motion", "fly"), "no 'fly'; known are still, pan"),
        (("--motion", "pan", "--turn", "5"), "--turn is for the motion rotate"),
        (("--size", "40"), "as 346x260"),
        (("--duration", "0"), "must be positive"),
        (("--duration", "0.001"), "too short for one frame"),
        (("--saturate", "0.1", "--white", "2"), "give one of them"),
        (("--saturate", "2"), "between 0 and 1"),
        (("--white", "-1"), "must be positive"),
        (("--exposure", "100000"), "do not fit"),
        (("--exposure", "1000", "--sensor.exposure", "2000"), "give one of them"),
        (("--sensor.cutoff", "-1"), "cutoff is -1"),
        (("--sensor.response", "log"), "unknown response 'log'"),
        (("--sensor.bits", "x"), "'x' is not a whole number"),
        (("--source-rate", "10"), "the source is one image"),
        (("--foreground-size", "5"), "give --foreground ball"),
        (("--foreground", "none.png"), "none.png"),
        (("--seed", "-1"), "must not be negative"),
        (("--truth-rate", "0"), "truth per second"),
        (("--scale", "0"), "must be positive"),
        (("--scale", "nan"), "must be positive"),
        (("--scale", "1e300"), "must be positive"),
        (("--duration", "1e-300"), "must be positive"),
        (("--frame-rate", "1e300"), "frame_rate is 1e+300"),
        (("--motion", "rotate", "--turn", "nan"), "--turn nan: a finite number is needed"),
        (("--motion", "shake", "--amplitude", "-1"), "--amplitude -1: 0 or more is needed"),
        (("--direction", "inf"), "--direction inf: a finite number is needed"),
        (("--motion", "dolly", "--closer", "1e300"), "its motion leads to"),
        (("--foreground", "ball", "--foreground-speed", "inf"), "--foreground-speed inf: a finite"),
        (("--truth-rate", "1e-310"), "truth per second"),
        (("--sensor.nose", "1"), "unknown flag --sensor.nose, did you mean"),
    ],
)
def test_what_cannot_be_done_is_one_line(cli, photograph, tmp_path, flags, told):
    found = cli("simulate", photograph, "-o", tmp_path / "a.h5", "--size", "40x32", *flags)
    assert found.code == 2
    assert told in found.error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["none.hdr", "none"])
def test_a_source_that_is_not_there(cli, tmp_path, name):
    found = cli("simulate", tmp_path / name, "-o", tmp_path / "a.h5")
    assert found.code == 2
    assert name in found.error
    assert "no such file" in found.error.lower()


def test_an_output_that_is_there_stays(cli, photograph, tmp_path):
    out = tmp_path / "a.h5"
    out.write_text("mine")
    assert "--overwrite" in cli("simulate", photograph, "-o", out, *SHORT).error
    assert out.read_text() == "mine"
    assert "ends in .h5" in cli("simulate", photograph, "-o", tmp_path / "a.mp4", *SHORT).error


def test_an_interrupt_leaves_nothing(start_cli, photograph, tmp_path):
    process = start_cli(
        "simulate", photograph, "-o", tmp_path / "a.h5", "--size", "160x120", "--duration", "60"
    )
    deadline = time.monotonic() + 60
    while not any(tmp_path.glob(".a.h5.part")):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 130
    assert stderr.splitlines()[-1] == "kalux: interrupted; nothing was written"
    assert list(tmp_path.iterdir()) == []
