"""The offset between clocks: over seconds, and to a fraction of a millisecond."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from kalux import Frame
from kalux.calibration.offset import busiest, correlate, estimate_offset, frame_changes
from kalux.calibration.registration import Registration
from kalux.calibration.rig import Lens
from kalux.errors import InputError
from kalux.models.camera import Response
from kalux.settings import CameraSettings
from rigs import DISTANCE, OFFSET, distant_recording, small_rig

from builders import frame, pixel_events, quick_frames

CAMERA = CameraSettings()
TRUTH = Registration.of_rig(small_rig(), DISTANCE)


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


def test_frames_every_two_milliseconds_have_one_peak():
    """Beyond one and a half of their intervals the correlation is nearly as high as at its peak: they are thinned."""
    seen = quick_frames()
    lens = Lens.pinhole(seen.scene.sensor_size)
    found = estimate_offset(
        lambda: seen.frames, lambda: [seen.events], Registration(lens, lens, np.eye(3)), reach=50_000
    )
    assert found.offset == pytest.approx(5_000, abs=1_000)
    assert found.coarse.sure
    assert found.coarse.ratio > 1.5


@pytest.mark.parametrize("registration", [None, TRUTH], ids=["activity", "pixels"])
def test_exposures_and_responses_change_nothing(registration):
    """Every other frame exposed a quarter as long, its values a quarter; and all coded in sRGB."""
    seen, srgb = distant_recording(), dataclasses.replace(CAMERA, response="srgb")
    # What is well exposed does not depend on the coding here.
    plain = [dataclasses.replace(f, valid=(f.image > 8) & (f.image < 240)) for f in seen.frames]
    coded = []
    for k, f in enumerate(plain):
        shorter = f.exposure * 3 // 8 if k % 2 else 0  # at either end, so that the middle stays
        light = f.normalised() * (1 - 2 * shorter / f.exposure)
        start, end = f.exposure_start + shorter, f.exposure_end - shorter
        coded.append(Frame(Response.srgb()(light), start, end, valid=f.valid))
    one, other = (
        correlate(frame_changes(frames, registration, camera), [seen.events], (120, 160), reach=100_000)
        for frames, camera in ((plain, CAMERA), (coded, srgb))
    )
    assert one.peak > 0.8
    assert other.peak == pytest.approx(one.peak, abs=0.01)
    assert other.offset == pytest.approx(one.offset, abs=500)


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
