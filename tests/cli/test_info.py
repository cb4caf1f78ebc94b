"""``kalux info``."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest

from kalux.writers import hdf5

from builders import passing_by, textured


def test_estimates_thresholds_that_the_recording_does_not_state(cli, write_recording, tmp_path):
    found = cli("info", write_recording(tmp_path / "rec.h5", contrast_threshold=None))
    assert (found.code, found.err) == (0, "")
    line = r"  thresholds +on (\S+), off (\S+) log intensity \(estimated from \S+ samples, residual \S+: \+- \d+ %\)"
    told = re.search(line, found.out)
    assert [float(value) for value in told.groups()] == pytest.approx([0.2, 0.2], rel=0.2)


def test_says_all_that_reconstruct_would_settle(cli, write_recording, tmp_path):
    """The same lines that it prints when it does."""
    path = write_recording(tmp_path / "rec.h5", contrast_threshold=None)
    said = cli("info", path).out.split("reconstruct would use, with the preset default\n")[1].splitlines()
    assert said.pop().split(maxsplit=1)[0] == "saturation"  # which takes another look at the frames
    assert [line.split("  ")[1].strip() for line in said] == [
        "thresholds",
        "agreement",
        "delay",
        "I_0",
        "step",
        "refractory",
        "spread",
        "background",
        "exposure",
        "noise",
        "pattern",
        "bright tail",
        "unshown",
        "response",
        "black",  # the blocks have nothing dark
        "motion",
    ]
    done = cli("reconstruct", path, "-o", tmp_path / "out", "--at", "frames").out
    assert [line.split() for line in said] == [
        line.split() for line in done.splitlines() if line.split()[0] in {row.split()[0] for row in said}
    ]


def test_a_preset_says_what_is_usual(cli, write_recording, simulation, tmp_path):
    path = write_recording(tmp_path / "rec.h5", contrast_threshold=None, events=[simulation.events[:50]])
    found = cli("info", path, "--preset", "davis346").out
    usual = "(usual of the preset, the recording does not tell)"
    assert f"on 0.310, off 0.370 log intensity {usual}" in found
    assert f"events 3.9 ms late {usual}" in found
    assert f"variance of one event 0.1 c^2, c its threshold {usual}" in found
    assert cli("info", path, "--preset", "best").code == 2


@pytest.mark.parametrize("flags", [(), ("--no-estimate",)])
def test_estimates_nothing_where_it_need_not(cli, recording, write_recording, tmp_path, flags):
    path = write_recording(tmp_path / "rec.h5", contrast_threshold=None) if flags else recording
    found = cli("info", path, *flags)
    assert found.code == 0
    assert "estimated from" not in found.out.partition("I_0")[0]
    assert ("ms late" in found.out) == (not flags)


def test_a_recording_without_exposures_is_described(cli, damaged):
    found = cli("info", damaged("no exposure times"))
    assert found.code == 0
    assert found.out.splitlines()[-1].endswith("a guess will do")


def test_exposures_that_are_replaced_are_told(cli, recording):
    found = cli("info", recording, "--no-estimate", "--exposure", 3000)
    assert (found.code, "--exposure 3000 replaces them" in found.err) == (0, True)


def test_exposures_of_no_frames_replace_nothing(cli, tmp_path):
    """A recording without frames has no exposures either."""
    (tmp_path / "events.txt").write_text("0.000001 3 4 1\n")
    found = cli("info", tmp_path, "--no-estimate", "--exposure", 3000)
    assert (found.code, found.err) == (0, "")


def test_exposures_can_be_given(cli, damaged):
    found = cli("info", damaged("no exposure times"), "--exposure", 8000, "--stamp", "middle")
    assert found.code == 0


@pytest.mark.parametrize("damage", ["event outside the sensor", "NaN", "frames of another size"])
def test_damage_is_one_line(cli, damaged, damage):
    found = cli("info", damaged(damage))
    assert found.code == 2
    assert found.error


@pytest.mark.parametrize("late", [0, 150_000])
@pytest.mark.parametrize("command", [["info"], ["evaluate", "--methods", "hold", "--hold-out-frames", 2]])
def test_events_that_contradict_the_frames_are_a_warning(cli, tmp_path, command, late):
    """Of frames with a clock of their own; as of reconstruct."""
    made = passing_by(textured(0.6))
    frames = [
        dataclasses.replace(f, exposure_start=f.exposure_start + late, exposure_end=f.exposure_end + late)
        for f in made.frames()
    ]
    hdf5.write(tmp_path / "rec.h5", sensor_size=made.sensor_size, events=made.events(), frames=frames)
    done = cli(command[0], tmp_path / "rec.h5", *command[1:])
    assert done.code == 0
    assert ("the events do not explain how the frames change" in done.err) == (late > 0)


def test_events_of_a_part_of_the_sensor_are_a_warning(cli, tmp_path):
    made = passing_by(textured(0.6))
    events = np.concatenate(list(made.events()))
    hdf5.write(
        tmp_path / "rec.h5",
        sensor_size=made.sensor_size,
        events=[events[events["y"] < 24]],
        frames=made.frames(),
    )
    done = cli("info", tmp_path / "rec.h5", "--no-estimate")
    assert "no event outside rows 0 to 23 and columns 0 to 63" in done.err


def test_a_still_scene_has_no_estimate(cli, write_recording, simulation, tmp_path):
    path = write_recording(tmp_path / "rec.h5", contrast_threshold=None, events=[simulation.events[:50]])
    found = cli("info", path).out
    assert "on 0.250, off 0.250 log intensity (usual of the preset, the recording does not tell)" in found
    assert "events 0 ms late (usual" in found
    assert "0.03 of white, events are steps of log(I + I_0) (usual" in found


def test_without_frames_nothing_is_estimated(cli, write_recording, tmp_path):
    assert cli("info", write_recording(tmp_path / "rec.h5", frames=[])).out.endswith(
        "--frames joins images or a video\n"
    )


def test_a_calibration_is_used(cli, write_recording, tmp_path):
    (tmp_path / "c.toml").write_text(
        "kalux_calibration = 1\n[settings.events]\nthreshold_on = 0.3\nthreshold_off = 0.28\ndelay = 500\n"
    )
    path = write_recording(tmp_path / "rec.h5", contrast_threshold=None)
    found = cli("info", path, "--calibration", tmp_path / "c.toml").out
    assert "on 0.300, off 0.280 log intensity (calibrated)" in found
    assert "events 0.5 ms late (given)" in found


class TestRealRecordings:
    @pytest.mark.parametrize("name", ["street_davis346.aedat4", "newton_davis346.aedat4"])
    def test_thresholds_are_plausible(self, cli, shared_data, name):
        found = cli("info", shared_data / name)
        on, off = re.search(r"thresholds +on (\S+), off (\S+) log", found.out).groups()
        assert 0.1 < float(on) < 0.5
        assert 0.1 < float(off) < 0.5

    def test_a_truncated_aedat4(self, cli, shared_data, tmp_path):
        whole = (shared_data / "street_davis346.aedat4").read_bytes()
        (tmp_path / "cut.aedat4").write_bytes(whole[: len(whole) // 2])
        for command in (("info",), ("reconstruct", "-o", tmp_path / "out")):
            found = cli(*command, tmp_path / "cut.aedat4")
            assert found.code == 2
            assert "cut short" in found.error
        assert [file.name for file in tmp_path.iterdir()] == ["cut.aedat4"]


def test_says_where_the_sensor_saturates(cli, shared_data):
    """slider_depth ends far below full scale, which nothing but events can tell from a white wall."""
    said = cli("info", shared_data / "slider_depth", "--exposure", 10_000).out.splitlines()[-1]
    assert re.search(
        r"saturation +from 0.98 of white \(the usual\); frames end at 0.4\d to 0.\d+, where events go on",
        said,
    )
    assert re.search(r"by \d\d %: if the camera saturates there, --camera.saturation 0.4\d ", said)


def test_a_reconstruction_warns_where_pixels_end_unevenly(cli, shared_data, tmp_path):
    """Unless it is told where they are clipped, or frames reach white."""
    slider = (shared_data / "slider_depth", "--exposure", 10_000, "--stamp", "start", "--end", 0.2)
    told = r"warning: frames end at 0.4\d to 0.4\d, where events go on by \d\d %: what they show there is taken for"
    output = ("--at", "frames", "--format", "npy")
    assert re.search(told, cli("reconstruct", *slider, "-o", tmp_path / "a", *output).err)
    known = cli("reconstruct", *slider, "-o", tmp_path / "b", *output, "--camera.saturation", 0.43)
    street = (shared_data / "street_davis346.aedat4", "--end", 0.2)
    for done in (known, cli("reconstruct", *street, "-o", tmp_path / "c", *output)):
        assert done.code == 0
        assert "frames end at" not in done.err
