"""Frames that are copies, empty, or of another gain than they say; and scenes that merely look like it."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from kalux import Recording
from kalux.calibration.frame_faults import FrameFaults, FrameWatch, find_frame_faults
from kalux.datasets import SensorSettings, simulate
from kalux.datasets.motion import pan, still
from kalux.datasets.scenes import Scene, photograph_scene
from kalux.models.camera import Camera
from kalux.pipeline import reconstruct
from kalux.planning import plan
from kalux.settings import PRESETS, altered

from builders import blocks

SIZE = (48, 64)
SETTINGS = PRESETS["default"]


def filmed(motion=None, light=lambda t: 1.0, exposures=None, image=None, **sensor):
    """Events, and frames at 24 Hz, of a camera that pans over rectangles in a light that may change."""
    image = blocks() if image is None else image
    seen = photograph_scene(image, motion or pan(60.0), sensor_size=SIZE, duration=500_000)
    lit = Scene(lambda t: seen.at(t) * light(t), SIZE, seen.start, seen.end)
    made = simulate(
        lit,
        SensorSettings(**{"threshold_on": 0.2, "threshold_off": 0.2, **sensor}),
        seed=1,
        exposures=exposures,
    )
    return made.events, made.frames


def recorded(events, frames):
    return Recording.from_arrays(events, frames, sensor_size=SIZE)


def faults(events, frames) -> FrameFaults:
    source, watch = recorded(events, frames), FrameWatch(Camera.named("linear", 0.98))
    for frame in source.frames():
        watch.see(frame)
    return find_frame_faults(source, SETTINGS.camera, watch)


def with_image(frame, value):
    return dataclasses.replace(frame, image=np.full_like(frame.image, value))


def repeated(frames, *indices):
    """The frames, some of which are those before them once more."""
    made = list(frames)
    for index in indices:
        made[index] = dataclasses.replace(made[index], image=made[index - 1].image.copy())
    return made


def emptied(frames):
    """The frames, all of which show nothing."""
    return [with_image(frame, 10) for frame in frames]


def stated(frame, exposure):
    """The frame, which says that it was exposed for so long, us."""
    start = frame.middle - exposure // 2
    return dataclasses.replace(frame, exposure_start=start, exposure_end=start + exposure)


def test_nothing_is_wrong_with_good_frames():
    found = faults(*filmed(noise_rate=3.0, threshold_mismatch=0.05, read_noise=0.005))
    assert not found
    assert not found.corrections(with_first=True)


def test_copies_are_left_out_where_something_moved():
    events, frames = filmed(noise_rate=1.0)
    found = faults(events, repeated(frames, 4, 9))
    assert found.copies == (4, 9)
    assert found.corrections(with_first=False).left_out == (4, 9)


def test_frames_of_a_still_scene_are_no_copies():
    """A simulated camera without noise shows the same twice; noise of the events does not make that wrong."""
    events, frames = filmed(motion=still(), noise_rate=3.0)
    assert np.array_equal(frames[0].image, frames[1].image)
    assert not faults(events, frames)


@pytest.mark.parametrize("value", [0, 255])
def test_an_empty_frame_is_left_out(value):
    events, frames = filmed()
    found = faults(events, [*frames[:6], with_image(frames[6], value), *frames[7:]])
    assert found.empty == (6,)
    assert found.corrections(with_first=True).left_out == (6,)


def test_an_empty_first_frame_is_left_out_unless_it_is_needed():
    events, frames = filmed()
    found = faults(events, [with_image(frames[0], 0), *frames[1:]])
    assert found.empty == (0,)
    assert found.corrections(with_first=False).left_out == (0,)
    needed = found.corrections(with_first=True)
    assert (needed.left_out, needed.empty) == ((), 1)


def test_many_empty_frames_are_what_the_recording_is():
    events, frames = filmed()
    assert not faults(events, [with_image(frame, 0) for frame in frames[:3]] + frames[3:])


def test_a_light_that_goes_out_leaves_frames_that_are_not_empty_but_dark():
    events, frames = filmed(light=lambda t: 1e-3 if 205_000 < t < 295_000 else 1.0, log_offset=1e-3)
    assert frames[6].image.max() <= 1
    assert faults(events, frames).empty == ()


@pytest.mark.parametrize("factor", [2.0, 0.5, 1.25])
def test_a_step_of_the_exposure_that_nobody_states_is_found(factor):
    exposures = [6_000] * 5 + [round(6_000 * factor)] * 7
    events, frames = filmed(exposures=exposures, noise_rate=1.0)
    found = faults(events, [stated(frame, 6_000) for frame in frames])
    assert found.steps == (5,)
    assert found.gains[-1] / found.gains[0] == pytest.approx(factor, rel=0.05)
    assert 1.0 in found.gains


def test_stated_exposures_are_believed():
    events, frames = filmed(exposures=[6_000] * 5 + [12_000] * 7)
    assert not faults(events, frames)


def test_a_gain_that_comes_back_is_the_one_that_it_was():
    events, frames = filmed(exposures=[6_000] * 3 + [12_000] * 3 + [6_000] * 3 + [12_000] * 3)
    found = faults(events, [stated(frame, 6_000) for frame in frames])
    assert found.steps == (3, 6, 9)
    assert len({*found.gains.tolist()}) == 2


def unstated(exposures, **how):
    """Events, and frames at 48 Hz of which each says that it was exposed for 6 ms."""
    events, frames = filmed(exposures=exposures, frame_rate=48.0, **how)
    return events, [stated(frame, 6_000) for frame in frames]


def spread_of(gains, exposures):
    """Largest log gain less smallest, where exposures are made up for."""
    return np.ptp(np.log(gains / np.array(exposures)))


def test_gains_that_go_up_and_down_do_not_drift():
    """Though fast light makes some of the steps less certain than others, which once were left out."""
    exposures = [6_000, 4_000] * 12
    slow = {"refractory": 1_000, "cutoff": 1_500.0, "threshold_on": 0.3, "threshold_off": 0.35}
    found = faults(*unstated(exposures, motion=pan(300.0), **slow))
    assert found.steps == tuple(range(1, 24))
    assert spread_of(found.gains, exposures) < 0.05


def test_a_gain_that_is_never_steady_is_evened_out():
    """As automatic exposure has it that follows the scene, by less than what is taken for a step."""
    exposures = np.round(6_000 * np.exp(0.12 * np.sin(0.5 * np.arange(24)))).astype(int).tolist()
    events, frames = filmed(exposures=exposures, frame_rate=48.0)
    assert np.abs(np.diff(np.log(exposures))).max() < 0.1
    found = faults(events, [stated(frame, 6_000) for frame in frames])
    assert found.unsteady
    left = np.log(found.gains / np.array(exposures))
    assert np.std(left) < 0.25 * np.std(np.log(exposures))
    assert not faults(events, frames).unsteady


@pytest.mark.parametrize(
    "hide", [lambda frames: repeated(frames, 5, 6), lambda f: [*f[:5], *emptied(f[5:7]), *f[7:]]]
)
def test_steps_across_frames_that_are_left_out_are_found(hide):
    """Of a gain that goes up and down, with an odd number of steps hidden: else those after it are half or twice."""
    exposures = np.array([6_000, 3_000] * 12)
    events, frames = unstated(exposures.tolist())
    found = faults(events, hide(frames))
    shown = [index for index in range(24) if index not in (5, 6)]
    assert {*found.copies, *found.empty} == {5, 6}
    assert spread_of(found.gains[shown], exposures[shown]) < 0.05


def test_light_that_came_while_a_frame_was_repeated_and_goes_after_it_is_no_gain():
    """The frame after the copy is as bright as it, though events since say that it should be darker."""
    exposures = [6_000] * 4 + [3_000] * 16 + [6_000] * 4
    frame = 1e6 / 48.0  # us

    def light(t):
        return 1.0 + 0.6 * np.clip(min(t / frame - 13.3, 15.0 - t / frame) / 0.6, 0.0, 1.0)

    events, frames = unstated(exposures, light=light)
    found = faults(events, repeated(frames, 14))
    assert (found.copies, found.steps) == ((14,), (4, 20))


def test_events_that_are_lost_of_one_sign_alone_make_gains_hardly_drift():
    """Frames are then always darker than events say, which adds up to 2.3 in these 24 if it is taken for the gain's."""
    leaves = np.random.default_rng(0).normal(size=(120, 400))
    leaves = cv2.GaussianBlur(leaves, (0, 0), 1.0)
    exposures = [6_000, 3_000] * 12
    lossy = {"refractory": 1_500, "cutoff": 1_000.0, "threshold_on": 0.2, "threshold_off": 0.35}
    image = np.exp(0.75 * leaves / leaves.std() - 1.6)
    found = faults(*unstated(exposures, motion=pan(400.0), image=image, **lossy))
    assert found.steps == tuple(range(1, 24))
    assert spread_of(found.gains, exposures) < 0.5


@pytest.mark.parametrize(
    ("seed", "sigma", "ramp"), [(0, 1.0, 0.0), (0, 1.0, 3.0), (1, 1.0, 3.0), (1, 2.0, 0.0)]
)
def test_fast_light_most_of_whose_events_are_lost_is_no_gain(seed, sigma, ramp):
    """Long exposures of what passes in a third of a second: frames show in all parts what events do not say."""
    leaves = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(120, 700)), (0, 0), sigma)
    image = np.exp(1.5 * leaves / leaves.std() - 2.5 + ramp * np.linspace(-0.5, 0.5, 700))
    lossy = {"refractory": 1_500, "cutoff": 1_000.0, "threshold_on": 0.15, "threshold_off": 0.15}
    found = faults(*filmed(motion=pan(500.0), image=image, frame_rate=20.0, exposure=40_000, **lossy))
    assert found.steps == ()


@pytest.mark.parametrize("refractory", [0, 2_000])
def test_light_that_is_switched_on_is_no_gain(refractory):
    """Though pixels lose most of so fast a change in their refractory period."""
    found = faults(*filmed(light=lambda t: 0.5 if t < 260_000 else 1.0, refractory=refractory))
    assert found.steps == ()


BETWEEN = 1e6 / 48.0  # us from one of the frames below to the next


@pytest.mark.parametrize(
    ("motion", "threshold", "light"),
    [
        (still(), 0.15, lambda k: np.exp(-0.4 * (k > 10.3))),
        (still(), 0.3, lambda k: np.exp(-0.1 * k)),
        (still(), 0.15, lambda k: np.exp(0.6 * np.sin(k / 2))),
        (still(), 0.3, lambda k: np.exp(0.2 * np.sin(k / 6))),
        (pan(60.0), 0.3, lambda k: np.exp(-0.06 * k)),
        (pan(60.0), 0.15, lambda k: np.exp(0.6 * np.sin(k / 2))),
    ],
    ids=["down at once", "down slowly", "up and down", "up and down slowly", "pan, down", "pan, up and down"],
)
def test_a_lamp_that_is_turned_down_or_up_is_no_gain(motion, threshold, light):
    """All pixels have the same events then, which no regression tells from a change that none of them explains; where
    the light turns, none has any. (k counts frames.)"""
    events, frames = filmed(
        motion,
        light=lambda t: float(light(t / BETWEEN)),
        exposures=[6_000] * 24,
        frame_rate=48.0,
        threshold_on=threshold,
        threshold_off=threshold,
        settled=True,
    )
    assert faults(events, frames).steps == ()


def test_a_lamp_that_flickers_is_no_gain():
    found = faults(*filmed(light=lambda t: 1 + 0.3 * np.sin(2 * np.pi * 100e-6 * t), exposure=3_000))
    assert found.steps == ()


def test_images_are_as_if_nothing_had_happened():
    events, frames = filmed(read_noise=0.003)
    good = recorded(events, frames)
    wrong = [with_image(frames[0], 0), *repeated(frames, 5)[1:]]
    made = plan(recorded(events, wrong), at="frames")
    assert made.mends.faults is not None
    assert (made.mends.faults.empty, made.mends.faults.copies) == ((0,), (5,))
    times = made.times
    assert len(times) == len(frames) - 1

    def images(source, settings=None):
        return np.stack([image.intensity for image in reconstruct(source, times=times, settings=settings)])

    truth = images(good)
    kept = altered(SETTINGS, "camera", leave_out_faulty=False)
    errors = [np.abs(images(recorded(events, wrong), s) - truth).mean() for s in (None, kept)]
    assert errors[0] < 0.5 * errors[1]


def test_images_are_made_in_an_empty_frame_if_they_are_asked_for():
    events, frames = filmed()
    wrong = recorded(events, [with_image(frames[0], 0), *frames[1:]])
    (image,) = reconstruct(wrong, times=[frames[0].middle])
    assert np.isfinite(image.intensity).all()
    assert np.median(image.intensity) == pytest.approx(np.median(frames[0].image) / 255, rel=0.3)


def test_a_plan_evens_out_gains_unless_told_not_to():
    exposures = [6_000] * 6 + [12_000] * 6
    events, frames = filmed(exposures=exposures)
    source = recorded(events, [stated(frame, 6_000) for frame in frames])
    made = plan(source, at="frames")
    assert made.mends.corrections.gains is not None
    right = recorded(events, frames)
    evened, true = (
        np.array([np.median(image.intensity) for image in reconstruct(each, at="frames")])
        for each in (source, right)
    )
    assert np.ptp(np.log(evened / true)) < 0.1
    kept = plan(source, at="frames", settings=altered(SETTINGS, "camera", even_gain=False))
    assert (kept.mends.faults, bool(kept.mends.corrections)) == (None, False)
    assert plan(source, at="frames", preset="iccv2021").mends.faults is None
