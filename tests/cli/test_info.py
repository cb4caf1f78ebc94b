"""``kalux info``."""

from __future__ import annotations

import re

import pytest


def test_estimates_thresholds_that_the_recording_does_not_state(cli, write_recording, tmp_path):
    found = cli("info", write_recording(tmp_path / "rec.h5", contrast_threshold=None))
    assert (found.code, found.err) == (0, "")
    last = found.out.splitlines()[-1]
    told = re.fullmatch(r"  estimate   threshold ON (\S+), OFF (\S+); residual \S+ of \S+ samples", last)
    assert [float(value) for value in told.groups()] == pytest.approx([0.2, 0.2], rel=0.2)


@pytest.mark.parametrize("flags", [(), ("--no-estimate",)])
def test_estimates_nothing_where_it_need_not(cli, recording, write_recording, tmp_path, flags):
    path = write_recording(tmp_path / "rec.h5", contrast_threshold=None) if flags else recording
    found = cli("info", path, *flags)
    assert found.code == 0
    assert "threshold ON" not in found.out
    assert ("events' delay" in found.out or "ms late" in found.out) == (not flags)


def test_a_recording_without_exposures_is_described(cli, damaged):
    found = cli("info", damaged("no exposure times"))
    assert found.code == 0
    assert found.out.splitlines()[-1].endswith("give --exposure")


def test_exposures_can_be_given(cli, damaged):
    found = cli("info", damaged("no exposure times"), "--exposure", 8000, "--stamp", "middle")
    assert found.code == 0


@pytest.mark.parametrize("damage", ["event outside the sensor", "NaN", "frames of another size"])
def test_damage_is_one_line(cli, damaged, damage):
    found = cli("info", damaged(damage))
    assert found.code == 2
    assert found.error


def test_a_still_scene_has_no_estimate(cli, write_recording, simulation, tmp_path):
    path = write_recording(tmp_path / "rec.h5", contrast_threshold=None, events=[simulation.events[:50]])
    assert "cannot be estimated, too little moves" in cli("info", path).out


class TestRealRecordings:
    @pytest.mark.parametrize("name", ["street_davis346.aedat4", "newton_davis346.aedat4"])
    def test_thresholds_are_plausible(self, cli, shared_data, name):
        found = cli("info", shared_data / name)
        on, off = re.search(r"estimate +threshold ON (\S+), OFF ([^\s;]+)", found.out).groups()
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
