"""The offset between clocks: over seconds, and to a fraction of a millisecond."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import kalux
from kalux.calibration.offset import busiest, correlate, estimate_offset, frame_changes, offset_of_recording
from kalux.calibration.registration import Registration
from kalux.calibration.rig import Lens
from kalux.datasets import SensorSettings, pan, photograph_scene, simulate
from kalux.errors import InputError
from kalux.settings import CameraSettings
from rigs import DISTANCE, OFFSET, distant_recording, small_rig

from builders import blocks, frame, lifted, pixel_events

CAMERA = CameraSettings()
TRUTH = Registration.of_rig(small_rig(), DISTANCE)


@pytest.mark.parametrize(
    ("name", "options", "expected"),
    [
        # ../shared/data/README.md: the events agree best with 8 ms added to slider_depth's stamps,
        ("slider_depth", {"exposure": 10_000, "stamp": "middle"}, 8_000),
        # and with newton 6 ms after the middle of the exposure.
        ("newton_davis346.aedat4", {}, 6_000),
    ],
)
def test_the_measured_offsets_of_real_recordings(shared_data, name, options, expected):
    """Within 2 ms, with whole event steps, as they were measured; without the half threshold it is less."""
    found, _ = offset_of_recording(kalux.open(shared_data / name, **options), reach=500_000)
    assert found.apparent == pytest.approx(expected, abs=2_000)
    assert found.offset < found.apparent - 1_000
    assert found.standard_error < 500
    assert found.coarse.sure


@pytest.mark.parametrize("shift", [0, 400_000, -1_300_000])
def test_clocks_seconds_apart(shift):
    """By activity of the whole image, frames not registered: to a quarter of a frame interval."""
    seen = distant_recording()
    frames = [
        dataclasses.replace(f, exposure_start=f.exposure_start - shift, exposure_end=f.exposure_end - shift)
        for f in seen.frames
    ]
    found = correlate(frame_changes(frames, None, CAMERA), [seen.events], (120, 160))
    assert found.offset == pytest.approx(OFFSET + shift, abs=6_000)
    assert found.peak > 0.8
    assert not found.per_pixel


def test_registered_frames_give_it_finely():
    seen = distant_recording()
    found = estimate_offset(lambda: seen.frames, lambda: [seen.events], TRUTH, reach=200_000)
    assert found.offset == pytest.approx(OFFSET, abs=300)
    assert found.coarse.offset == pytest.approx(OFFSET, abs=5_000)
    assert found.coarse.per_pixel
    assert found.apparent > found.offset


def test_chunks_change_nothing():
    seen = distant_recording()
    changes = frame_changes(seen.frames, TRUTH, CAMERA)
    parts = np.array_split(seen.events, 7)
    one, other = (correlate(changes, chunks, (120, 160), reach=50_000) for chunks in ([seen.events], parts))
    np.testing.assert_allclose(one.curve, other.curve, rtol=1e-12)


def test_a_periodic_scene_is_not_sure():
    """Light that flickers at 10 Hz: an offset of 0.1 s more is as good."""
    times = np.arange(0, 2_000_000, 1_000)
    phase = (times % 100_000) / 100_000
    array = pixel_events(times.tolist(), (phase < 0.5).tolist())
    levels = [40 + 80 * abs((t % 100_000) / 50_000 - 1) for t in range(500_000, 1_500_000, 20_000)]
    frames = [
        frame(np.full((2, 2), level), 500_000 + 20_000 * k, 500_001 + 20_000 * k)
        for k, level in enumerate(levels)
    ]
    lens = Lens.pinhole((2, 2))
    changes = frame_changes(frames, Registration(lens, lens, np.eye(3)), CAMERA)
    found = correlate(changes, [array], (2, 2), reach=300_000)
    assert found.ratio < 1.02
    assert not found.sure


def test_the_busiest_stretch():
    changes = frame_changes(distant_recording().frames, None, CAMERA)
    quiet = changes._replace(changes=np.where(np.arange(len(changes.changes))[:, None] < 10, 1e-6, 1.0))
    assert busiest(quiet, 5).start == 10
    assert busiest(quiet, 1000) == slice(0, len(changes.middles))


def test_what_cannot_be_told():
    seen = distant_recording()
    with pytest.raises(InputError, match="frames, too few"):
        frame_changes(seen.frames[:4], None, CAMERA)
    changes = frame_changes(seen.frames, None, CAMERA)
    with pytest.raises(InputError, match="no events from"):
        correlate(changes, [seen.events], (120, 160), centre=9e7)


def test_a_black_level_is_taken_off():
    """Though events say where it is only in the clock of the frames. Left in, it moves the offset by 350 us."""
    picture = np.maximum(blocks(0.03, 1.0, shape=(170, 220)) - 0.05, 0)
    scene = photograph_scene(picture, pan(60.0), sensor_size=(120, 160), duration=500_000)
    made = simulate(scene, SensorSettings())
    expected, none = offset_of_recording(made.recording(), reach=200_000)
    frames = [
        dataclasses.replace(f, exposure_start=f.exposure_start - 70_000, exposure_end=f.exposure_end - 70_000)
        for f in lifted(made.recording(), 16).frames()
    ]
    raised = kalux.Recording.from_arrays(made.events, frames, sensor_size=(120, 160))
    found, level = offset_of_recording(raised, reach=200_000)
    assert none is None
    assert level == pytest.approx(16 / 255, abs=1 / 255)
    assert found.offset == pytest.approx(expected.offset + 70_000, abs=50)
    left, none = offset_of_recording(raised, camera=CameraSettings(black_level=0.0), reach=200_000)
    assert none == 0
    assert abs(left.offset - found.offset) > 200
