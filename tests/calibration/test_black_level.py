"""The black level of frames: cameras that read something in the dark, and scenes that merely have nothing dark."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import kalux
from kalux import Frame, Recording
from kalux.calibration.black_level import find_black_level, with_known_black
from kalux.calibration.delay import estimate_delay
from kalux.datasets import SensorSettings, simulate
from kalux.datasets.motion import pan
from kalux.datasets.scenes import photograph_scene
from kalux.planning import plan
from kalux.recording import less_black
from kalux.settings import PRESETS, altered

from builders import damaged, from_black, lifted, passing_by, textured

SETTINGS = PRESETS["default"]


@pytest.mark.parametrize("noise_rate", [0.0, 3.0])
@pytest.mark.parametrize("black", [8, 16, 32])
def test_a_black_level_is_found(black, noise_rate):
    found = find_black_level(lifted(from_black(noise_rate), black), SETTINGS.camera, SETTINGS.events)
    assert found is not None
    assert 255 * found.level == pytest.approx(black, abs=3)


@pytest.mark.parametrize("least", [0.05, 0.1, 0.3])
def test_a_scene_that_has_nothing_dark_has_no_black_level(least):
    """Its floor looks the same; its events do not."""
    source = passing_by(np.maximum(textured(1.3) - 0.25, 0) + least)
    found = find_black_level(source, SETTINGS.camera, SETTINGS.events)
    assert found is not None
    assert found.floor >= 0.9 * least
    assert found.level == 0


def of_v2e(picture):
    """The picture, recorded with the events of v2e's pixels: linear below 20 of 255, where the logarithm begins."""
    scene = photograph_scene(picture, pan(60.0), sensor_size=(48, 64), duration=500_000)

    def as_seen(t):
        level = 255 * scene.radiance(t)
        return np.where(level > 20, level, np.exp(level * np.log(20) / 20)) / 255

    sensor = SensorSettings(threshold_on=0.2, threshold_off=0.2, log_offset=1e-9, exposure=2_000)
    events = simulate(dataclasses.replace(scene, radiance=as_seen), sensor, seed=1).recording().events()
    return Recording.from_arrays(
        np.concatenate(list(events)), list(passing_by(picture).frames()), sensor_size=(48, 64), name="v2e"
    )


@pytest.mark.parametrize("least", [0.02, 0.03])
def test_pixels_that_are_linear_in_the_dark_have_no_black_level(least):
    """Their events are more in the dark than those of the logarithm, as if the frames were lifted."""
    found = find_black_level(of_v2e(least * 20 * textured(1.0)), SETTINGS.camera, SETTINGS.events)
    assert found is not None
    assert found.floor >= 0.8 * least
    assert (found.level, found.samples > 10_000) == (0.0, True)


def exposed(source, times):
    """The recording with frames that are exposed for ``times`` as long, one after the other, again and again."""
    frames = []
    for k, frame in enumerate(source.frames()):
        longer = times[k % len(times)]
        image = np.rint(np.minimum(frame.image * longer, 255)).astype(np.uint8)
        end = frame.exposure_start + round(longer * (frame.exposure_end - frame.exposure_start))
        frames.append(dataclasses.replace(frame, image=image, exposure_end=end))
    return Recording.from_arrays(
        np.concatenate(list(source.events())), frames, sensor_size=source.sensor_size, name="exposed"
    )


def test_changes_of_the_exposure_are_none_of_the_light():
    """Those of more than a tenth from frame to frame say nothing of black."""
    source = passing_by(np.maximum(textured(1.0) - 0.25, 0) / 2 + 0.05)
    found = find_black_level(exposed(source, [1.0, 0.7]), SETTINGS.camera, SETTINGS.events)
    assert found is not None
    assert (found.level, found.samples) == (0.0, 0)


def test_smaller_changes_of_the_exposure_are_taken_off():
    exposures = 1.05 ** -np.arange(40.0)
    found = find_black_level(lifted(exposed(from_black(), exposures), 16), SETTINGS.camera, SETTINGS.events)
    assert found is not None
    assert 255 * found.level == pytest.approx(16, abs=3)


def test_frames_that_show_black_or_state_it_are_not_looked_at():
    assert find_black_level(from_black(), SETTINGS.camera, SETTINGS.events) is None
    assert find_black_level(lifted(from_black(), 16, stated=True), SETTINGS.camera, SETTINGS.events) is None


def test_what_does_not_move_tells_nothing():
    frames = [Frame(np.full((8, 8), 40, np.uint8), 1000 * i, 1000 * i + 500) for i in range(4)]
    events = np.empty(0, kalux.EVENT_DTYPE)
    source = Recording.from_arrays(events, frames, sensor_size=(8, 8))
    found = find_black_level(source, SETTINGS.camera, SETTINGS.events)
    assert found is not None
    assert (found.level, found.samples) == (0, 0)


def test_a_plan_takes_it_off_unless_it_is_given():
    source = lifted(from_black(), 16)
    made = plan(source, at="frames")
    assert made.settings.camera.black_level == pytest.approx(16 / 255, abs=3 / 255)
    given = plan(source, at="frames", settings=altered(SETTINGS, "camera", black_level=0.0))
    assert (given.settings.camera.black_level, given.mends.black) == (0, None)
    paper = plan(source, at="frames", preset="iccv2021")
    assert (paper.settings.camera.black_level, paper.mends.black) == (None, None)


def test_frames_less_black_are_those_of_a_camera_without():
    plain = next(iter(from_black().frames())).normalised()
    less = next(iter(less_black(lifted(from_black(), 51), 0.2).frames()))
    np.testing.assert_allclose(less.normalised(), plain, atol=1 / 204)
    assert less.full_scale == 204


def test_images_are_those_of_a_camera_without():
    """Both ways in time, too: a black level that is given, that frames state, and none."""
    settings = altered(SETTINGS, "events", threshold_on=0.2, threshold_off=0.2)
    black = altered(settings, "camera", black_level=51 / 255)

    def last(source, chosen):
        *_, image = kalux.reconstruct(source, at="frames", settings=chosen, smooth=True)
        return image.intensity

    expected = last(from_black(), settings)
    given = last(lifted(from_black(), 51), black)
    assert np.median(np.abs(given - expected)) < 0.02
    np.testing.assert_array_equal(last(lifted(from_black(), 51, stated=True), settings), given)


def test_what_is_known_of_black_is_asked_for_once():
    """Settings go before what is known already, that before what events say; frames that state it are left alone."""
    source = lifted(from_black(), 16)
    found, looked = with_known_black(source, SETTINGS.camera, SETTINGS.events)
    assert found.black_level == looked.level == pytest.approx(16 / 255, abs=3 / 255)
    assert with_known_black(found, SETTINGS.camera, SETTINGS.events) == (found, None)
    given = altered(SETTINGS, "camera", black_level=0.1).camera
    assert with_known_black(found, given, SETTINGS.events)[0].black_level == 0.1
    stated, looked = with_known_black(lifted(from_black(), 16, stated=True), SETTINGS.camera, SETTINGS.events)
    assert (stated.black_level, looked) == (None, None)
    assert next(iter(stated.frames())).black == 16
    assert with_known_black(from_black(), SETTINGS.camera, SETTINGS.events)[0].black_level == 0


def test_the_delay_is_estimated_once_where_there_is_no_black_level(monkeypatch):
    """The search for black needs it, too; of frames less a black level it is another one."""
    source, asked = passing_by(np.maximum(textured(1.3) - 0.25, 0) + 0.1), []
    expected = plan(source, at="frames")

    def counted(*arguments):
        asked.append(estimate_delay(*arguments))
        return asked[-1]

    for module in ("planning.event_steps", "calibration.black_level"):
        monkeypatch.setattr(f"kalux.{module}.estimate_delay", counted)
    again = plan(source, at="frames")
    assert expected.steps.delay is not None
    assert len(asked) == 1
    assert again.settings == expected.settings
    alone = estimate_delay(source, SETTINGS.camera)
    assert alone.apparent == expected.steps.delay.apparent
    asked.clear()
    plan(lifted(from_black(), 16), at="frames")
    assert len(asked) == 2
    asked.clear()
    plan(damaged(source), at="frames")  # that of copies of frames, and of gains that step, is another one
    assert len(asked) == 2
