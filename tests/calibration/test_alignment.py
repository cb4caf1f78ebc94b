"""Frames against events: levels by hand, and the fit of offset and homography on a simulated rig."""

from __future__ import annotations

import numpy as np
import pytest

from kalux import Frame
from kalux.calibration.alignment import align, levels, take_shots
from kalux.calibration.registration import Registration
from kalux.calibration.rig import rig_toml
from kalux.errors import InputError
from kalux.settings import CameraSettings
from rigs import DISTANCE, OFFSET, distant_recording, misplaced, small_rig

from builders import events, frame, pixel_events, printed_on_threads

CAMERA = CameraSettings()


def at(array, times, spread=True):
    on, off = levels(array, (1, 1), np.array(times), spread=spread)
    return on[:, 0, 0].tolist(), off[:, 0, 0].tolist()


def test_whole_steps_are_counts():
    array = pixel_events([1000, 2000, 5000], [1, 1, 0])
    on, off = at(array, [0, 1000, 1001, 2001, 5000, 9000], spread=False)
    assert on == [0, 0, 1, 2, 2, 2]
    assert off == [0, 0, 0, 0, 0, 1]


def test_a_step_is_spread_over_the_shorter_of_the_times_around_it():
    """Events at 1, 2 and 5 ms: the second gathered for 1 ms, since the first, the third for 3 ms."""
    array = pixel_events([1000, 2000, 5000], [1, 1, 0])
    on, off = at(array, [0, 500, 1000, 1500, 2000, 3500, 5000])
    # Nothing comes before the first event: it gathered as long as the second.
    assert on == pytest.approx([0, 0.5, 1, 1.5, 2, 2, 2])
    assert off == pytest.approx([0, 0, 0, 0, 0, 0.5, 1])


def test_the_first_event_after_a_pause_is_not_spread_over_the_pause():
    array = pixel_events([1000, 100_000, 101_000, 102_000], [1, 1, 1, 1])
    on, _ = at(array, [50_000, 99_000, 99_500, 100_000])
    assert on == pytest.approx([1, 1, 1.5, 2])


def test_pixels_are_apart():
    array = events((1000, 1, 0, 1), (2000, 0, 1, 0))
    on, off = levels(array, (2, 2), np.array([3000]))
    assert on[0].tolist() == [[0, 1], [0, 0]]
    assert off[0].tolist() == [[0, 0], [1, 0]]


@pytest.fixture(scope="module")
def shots():
    return take_shots(distant_recording().frames, CAMERA)


def test_offset_and_homography_are_found_together(shots):
    """From a rig at infinity (half a pixel off) and clocks 7.3 ms apart, to 0.1 pixel and 0.3 ms."""
    seen, truth = distant_recording(), Registration.of_rig(small_rig(), DISTANCE)
    begin = Registration.of_rig(small_rig())
    assert misplaced(begin, truth).mean() > 0.2
    found = align(shots, seen.events, begin, offset=0.0, free_homography=True)
    assert found.offset == pytest.approx(OFFSET, abs=300)
    assert found.standard_error < 300
    assert misplaced(found.registration, truth).mean() < 0.1
    assert found.explained > 0.9
    assert found.thresholds == pytest.approx((0.2, 0.2), rel=0.2)
    assert found.moved == pytest.approx(misplaced(begin, found.registration).mean(), rel=0.05)


_ALIGNED = """
import sys
import numpy as np
from kalux.calibration.alignment import Shots, align
from kalux.calibration.registration import Registration
from kalux.calibration.rig import load_rig
from pathlib import Path
saved = np.load(sys.argv[1])
shots, begin = Shots(*(saved[name] for name in Shots._fields)), Registration.of_rig(load_rig(Path(sys.argv[2])))
print(align(shots, saved["events"], begin, offset=0.0, free_homography=False).offset.hex())
"""


def test_the_last_bits_do_not_depend_on_the_number_of_threads(shots, tmp_path):
    """Those of OpenBLAS's sums do."""
    np.savez(tmp_path / "seen.npz", events=distant_recording().events, **shots._asdict())
    (tmp_path / "rig.toml").write_text(rig_toml(small_rig()))
    assert len(printed_on_threads(_ALIGNED, tmp_path / "seen.npz", tmp_path / "rig.toml")) == 1


def test_whole_steps_are_late(shots):
    """Half a threshold: what the spread takes away."""
    seen, truth = distant_recording(), Registration.of_rig(small_rig(), DISTANCE)
    spread, whole = (
        align(shots, seen.events, truth, offset=5_000.0, free_homography=False, spread=s)
        for s in (True, False)
    )
    assert spread.offset == pytest.approx(OFFSET, abs=300)
    assert whole.offset > spread.offset + 500
    assert spread.explained > whole.explained
    assert spread.moved == 0


def test_a_known_offset_stays(shots):
    seen, truth = distant_recording(), Registration.of_rig(small_rig(), DISTANCE)
    found = align(shots, seen.events, truth, offset=float(OFFSET), free_homography=False, free_offset=False)
    assert (found.offset, found.standard_error) == (OFFSET, 0.0)


def test_events_of_another_scene_are_refused(shots):
    seen, truth = distant_recording(), Registration.of_rig(small_rig(), DISTANCE)
    other = seen.events.copy()
    other["p"] = np.random.default_rng(0).random(len(other)) < 0.5
    other["x"] = np.random.default_rng(1).permutation(other["x"])
    with pytest.raises(InputError, match="do not explain"):
        align(shots, other, truth, offset=float(OFFSET), free_homography=False)


@pytest.mark.parametrize("free_homography", [True, False])
def test_what_explains_nothing_moves_nothing(shots, free_homography):
    """An offset that is said to be known, and is wrong by 0.4 s: the homography would be moved by 5 pixels."""
    begin = Registration.of_rig(small_rig())
    with pytest.raises(InputError, match=r"do not explain .* [01] % explained"):
        align(
            shots,
            distant_recording().events,
            begin,
            offset=OFFSET - 400_000.0,
            free_homography=free_homography,
            free_offset=False,
        )


def test_what_is_too_little():
    with pytest.raises(InputError, match="2 frames, too few"):
        take_shots([frame(5, 0, 1), frame(5, 2, 3)], CAMERA)
    dark = [Frame(np.zeros((240, 320), np.uint8), t, t + 1) for t in (0, 10, 20)]
    begin = Registration.of_rig(small_rig())
    with pytest.raises(InputError, match="fewer than 500 pixels are well exposed"):
        align(take_shots(dark, CAMERA), pixel_events([5], [1]), begin, offset=0.0, free_homography=False)
