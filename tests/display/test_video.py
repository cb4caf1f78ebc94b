"""Statistics over the images of a video."""

from __future__ import annotations

import numpy as np
import pytest

from curves import ALL, Timed, hdr_scene
from kalux.display import (
    Auto,
    Clahe,
    DisplaySettings,
    Linear,
    Percentile,
    apply,
    measure,
    tone_map,
    tone_map_next,
)
from kalux.errors import InputError


@pytest.mark.parametrize("curve", ALL, ids=str)
def test_the_first_image_and_no_smoothing_need_no_past(curve):
    first, second = Timed(0, hdr_scene()), Timed(10_000, hdr_scene(7))
    unsmoothed = DisplaySettings(curve, smoothing=0)
    mapped, state = tone_map_next(first, DisplaySettings(curve))
    np.testing.assert_array_equal(mapped, tone_map(first.intensity, unsmoothed))
    mapped, _ = tone_map_next(second, unsmoothed, state)
    np.testing.assert_array_equal(mapped, tone_map(second.intensity, unsmoothed))


@pytest.mark.parametrize("curve", [c for c in ALL if not isinstance(c, Linear)], ids=str)
def test_smoothing_follows_time_and_not_the_number_of_images(curve):
    display = DisplaySettings(curve, smoothing=0.5)
    bright = hdr_scene(5)
    _, start = tone_map_next(Timed(0, hdr_scene()), display)
    few, many = start, start
    for k in range(1, 6):
        _, few = tone_map_next(Timed(100_000 * k, bright), display, few)
    for k in range(1, 51):
        _, many = tone_map_next(Timed(10_000 * k, bright), display, many)
    np.testing.assert_allclose(few.statistics, many.statistics, rtol=1e-9, atol=1e-12)
    target = measure(bright, curve)
    expected = target + np.exp(-1) * (start.statistics - target)
    np.testing.assert_allclose(few.statistics, expected, rtol=1e-9, atol=1e-12)


def test_smoothing_holds_a_flicker_down():
    fresh, smooth, state = [], [], None
    for k in range(30):
        image = Timed(3333 * k, hdr_scene())
        image.intensity[0, 0:6] = 500 * (k % 2)
        fresh.append(tone_map(image.intensity, DisplaySettings(Percentile(0, 100)))[20, 40])
        mapped, state = tone_map_next(image, DisplaySettings(Percentile(0, 100)), state)
        smooth.append(mapped[20, 40])
    assert np.abs(np.diff(smooth[1:])).max() < 0.2 * np.abs(np.diff(fresh)).max()


def test_an_image_of_the_past_leaves_the_statistics():
    _, state = tone_map_next(Timed(1000, hdr_scene()))
    _, later = tone_map_next(Timed(500, hdr_scene(9)), None, state)
    np.testing.assert_array_equal(later.statistics, state.statistics)


def test_a_state_of_another_curve_is_refused():
    _, state = tone_map_next(Timed(0, hdr_scene()), DisplaySettings(Clahe()))
    with pytest.raises(InputError, match="another curve"):
        tone_map_next(Timed(1, hdr_scene()), DisplaySettings(Auto()), state)
    with pytest.raises(InputError, match="another curve"):
        apply(hdr_scene(), DisplaySettings(Auto()), state.statistics)
