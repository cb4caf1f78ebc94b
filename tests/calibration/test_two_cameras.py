"""From two cameras' recordings to one, and its reconstruction against that of one shared sensor."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import kalux
from kalux import Recording
from kalux.calibration.registration import Registration
from kalux.calibration.rig import Lens
from kalux.calibration.two_cameras import events_size, open_frames, register, triggered
from kalux.datasets import Sampling
from kalux.datasets.exposure import frame_stream, plan_exposures
from kalux.errors import EventError, ExposureError, InputError
from kalux.readers.source import TRIGGER_DTYPE
from kalux.writers import hdf5
from rigs import DISTANCE, OFFSET, SENSOR, distant_recording, misplaced, small_rig

SIZES = {"events_size": (120, 160), "frames_size": (240, 320)}
TRUTH = Registration.of_rig(small_rig(), DISTANCE)


def found(**options):
    seen = distant_recording()
    return register(lambda: seen.frames, lambda: [seen.events], **SIZES, **options)


@pytest.fixture(scope="module")
def refined():
    return found(rig=small_rig(), reach=300_000)


def test_a_rig_is_refined_in_space_and_time(refined):
    """0.5 pixel and 0.5 ms are asked for."""
    assert misplaced(refined.registration, TRUTH).mean() < 0.1
    assert refined.offset == pytest.approx(OFFSET, abs=300)
    assert refined.matched is None
    assert refined.coarse.sure


def test_lenses_alone_are_enough():
    matched = found(rig=small_rig(), homography="auto", offset=OFFSET)
    assert misplaced(matched.registration, TRUTH).mean() < 0.1
    assert matched.matched.inliers > 100
    assert (matched.offset, matched.coarse) == (OFFSET, None)


def test_without_any_calibration_the_lenses_remain():
    """Barrel distortion of both lenses, which a homography cannot follow, is what is left."""
    matched = found(reach=300_000)
    off = misplaced(matched.registration, TRUTH)
    assert 0.05 < off.mean() < 0.6
    assert matched.offset == pytest.approx(OFFSET, abs=500)


def test_the_reconstruction_is_nearly_that_of_a_shared_sensor(refined):
    """Within 60 % of its MSE at this size; most of the difference is pixels at highlights, which are masked. A shared
    sensor's pixels are seen to be more alike (6 % instead of 8), and its steps to be more exact (K9)."""
    seen = distant_recording()
    pair = Recording.from_arrays(seen.events, refined.frames(seen.frames), sensor_size=(120, 160))
    shared_frames = list(
        frame_stream(seen.scene, SENSOR, plan_exposures(seen.scene, SENSOR), seed=0, sampling=Sampling())
    )
    shared = Recording.from_arrays(seen.events, shared_frames, sensor_size=(120, 160))
    times = [f.middle for f in shared_frames[2:-2:2]]
    mask = refined.registration.maps.inside
    errors = []
    for recording in (pair, shared):
        images = kalux.reconstruct(recording, times=times)
        errors.append(
            np.mean([((i.intensity - seen.scene.at(float(i.t))) ** 2)[mask].mean() for i in images])
        )
    assert errors[0] < 1.6 * errors[1]  # of larger images less: benchmarks/rig.py
    assert errors[0] < 0.0037
    assert errors[1] < 0.0026


def test_a_calibrated_rig_and_a_known_offset_need_no_fit():
    plain = found(rig=small_rig(), distance=DISTANCE, homography="rig", offset=OFFSET)
    assert misplaced(plain.registration, TRUTH).max() < 1e-6
    assert (plain.offset, plain.coarse, plain.alignment) == (OFFSET, None, None)
    seen = distant_recording()
    first = next(plain.frames(seen.frames))
    assert first.exposure_start == seen.frames[0].exposure_start + OFFSET
    assert first.image.shape == first.valid.shape == (120, 160)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"distance": 3.0}, "without a rig file"),
        ({"homography": "refine"}, "without a rig file"),
        ({"rig": small_rig(), "events_size": (60, 80)}, "the rig's event camera has 160x120"),
        ({"rig": small_rig(), "distance": -1.0}, "must be positive"),
    ],
)
def test_what_does_not_fit(options, told):
    seen = distant_recording()
    with pytest.raises(InputError, match=told):
        register(lambda: seen.frames, lambda: [seen.events], **(SIZES | options))


@pytest.mark.parametrize("options", [{}, {"offset": OFFSET}])
def test_events_outside_the_event_camera_are_refused(options):
    """Loops that are compiled would write them anywhere."""
    seen = distant_recording()
    events = seen.events.copy()
    events["x"][len(events) // 2] = 160
    with pytest.raises(EventError, match=r"at x=160, .* outside the sensor of 160x120"):
        register(lambda: seen.frames, lambda: [events], rig=small_rig(), reach=50_000, **SIZES, **options)


def test_a_size_that_is_not_stated_is_that_of_the_rig():
    """Unless events lie outside it; what a reader assumed may be larger than they need."""
    events = Recording.from_arrays(distant_recording().events, [], sensor_size=(200, 200))
    assert events_size(events, small_rig()) == (200, 200)
    unknown = Recording(dataclasses.replace(events.source, sensor_size_known=False))
    assert events_size(unknown, None) == (200, 200)
    assert events_size(unknown, small_rig()) == (120, 160)
    smaller = dataclasses.replace(small_rig(), events=Lens.pinhole((119, 160)))
    with pytest.raises(InputError, match=r"a sensor of 160x120 pixels at least, the rig's .* 160x119; is"):
        events_size(unknown, smaller)


@pytest.mark.parametrize("homography", ["refine", "auto"])
def test_frames_without_events_around_them_are_refused(homography):
    with pytest.raises(InputError, match=r"no events from 60\.\d+ to 60\.\d+ s, .*\(with 60000\.0 ms added"):
        found(rig=small_rig(), homography=homography, offset=60e6)


def test_a_still_scene_tells_no_offset():
    seen = distant_recording()
    still = [dataclasses.replace(f, image=seen.frames[0].image) for f in seen.frames]
    with pytest.raises(InputError, match=r"offset|cannot be told"):
        register(lambda: still, lambda: [seen.events], rig=small_rig(), reach=200_000, **SIZES)


@pytest.fixture
def files(tmp_path):
    seen = distant_recording()
    hdf5.write(tmp_path / "events.h5", sensor_size=(120, 160), events=[seen.events], frames=[])
    hdf5.write(tmp_path / "frames.h5", sensor_size=(240, 320), events=[], frames=seen.frames)
    return tmp_path


def with_triggers(recording, frames, *, drop_first=0):
    """The recording, wired to the camera: an edge at the start and the end of every exposure, in the events' clock."""
    rows = [(f.exposure_start + OFFSET, 0, True) for f in frames] + [
        (f.exposure_end + OFFSET, 0, False) for f in frames
    ]
    edges = np.array(sorted(rows)[drop_first:], TRIGGER_DTYPE)
    return Recording(dataclasses.replace(recording.source, triggers=lambda: iter([edges])))


def test_triggers_give_the_exposures(files):
    seen = distant_recording()
    events = with_triggers(kalux.open(files / "events.h5"), seen.frames)
    frames, notes = triggered(events, open_frames(files / "frames.h5"))
    assert notes == ()
    for got, given in zip(frames(), seen.frames, strict=True):
        assert (got.exposure_start, got.exposure_end) == (
            given.exposure_start + OFFSET,
            given.exposure_end + OFFSET,
        )
        np.testing.assert_array_equal(got.image, given.image)


def test_a_lost_first_edge_costs_a_frame(files):
    """The camera's own times are even, so that it has to be said."""
    seen = distant_recording()
    events = with_triggers(kalux.open(files / "events.h5"), seen.frames, drop_first=1)
    with pytest.raises(
        ExposureError, match=f"{len(seen.frames) - 1} trigger exposures and {len(seen.frames)} frames"
    ):
        triggered(events, open_frames(files / "frames.h5"))
    frames, notes = triggered(events, open_frames(files / "frames.h5"), skip_frames=1)
    assert [f.exposure_start for f in frames()] == [f.exposure_start + OFFSET for f in seen.frames[1:]]
    assert len(notes) == 1


def test_a_format_without_triggers(files):
    with pytest.raises(InputError, match="has no trigger events"):
        triggered(kalux.open(files / "events.h5"), open_frames(files / "frames.h5"))


def test_what_are_no_frames(files):
    with pytest.raises(InputError, match="has no frames"):
        open_frames(files / "events.h5")
    with pytest.raises(InputError, match="has its own times"):
        open_frames(files / "frames.h5", start=0, rate_hz=30)
    with pytest.raises(InputError, match="no such file"):
        open_frames(files / "none")
