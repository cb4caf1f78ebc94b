"""Scenes in colour and the cameras that see them."""

from __future__ import annotations

import numpy as np
import pytest

from kalux.datasets import SensorSettings, colour_photograph, simulate, simulate_colour, still
from kalux.errors import InputError
from kalux.models.colour import channels, luminance


def flicker(size=(6, 8)):
    """Red, green and blue lamps of which only red changes."""
    from kalux.datasets import ColourScene

    def radiance(t):
        out = np.full((*size, 3), 0.3)
        out[..., 0] = 0.1 * np.exp(t * 2e-6)
        return out

    return ColourScene(radiance, size, 0, 500_000)


def test_pixels_of_a_mosaic_see_their_own_colour():
    made = simulate_colour(flicker(), SensorSettings(log_offset=1e-9, threshold_on=0.19), mosaic="GBRG")
    red = channels("GBRG", (6, 8)) == 0
    counts = np.zeros((6, 8), int)
    np.add.at(counts, (made.events["y"], made.events["x"]), 1)
    assert (counts[red] == 5).all()  # log intensity rises by 1, in steps of 0.19
    assert counts[~red].sum() == 0
    assert {frame.mosaic for frame in made.frames} == {"GBRG"}
    first, last = made.frames[0].image.astype(int), made.frames[-1].image.astype(int)
    assert (last[red] > first[red] + 20).all()
    assert (last[~red] == first[~red]).all()


def test_frames_in_rgb_have_events_of_the_luminance():
    made = simulate_colour(flicker(), SensorSettings(read_noise=0.01))
    grey = simulate(flicker().seen(luminance), SensorSettings(read_noise=0.01))
    assert np.array_equal(made.events, grey.events)
    first, last = made.frames[0].image.astype(int), made.frames[-1].image.astype(int)
    assert first.shape == (6, 8, 3)
    assert (last[..., 0] > first[..., 0] + 20).all()
    assert np.abs(last[..., 1:] - first[..., 1:]).max() < 30
    noise = first - first.mean(axis=(0, 1))
    assert abs(np.corrcoef(noise[..., 0].ravel(), noise[..., 1].ravel())[0, 1]) < 0.6


def test_a_photograph_is_seen_in_its_colours():
    picture = np.random.default_rng(0).uniform(0, 1, (20, 24, 3)).astype(np.float32)
    scene = colour_photograph(picture, still(), sensor_size=(20, 24), duration=1000, blur=0)
    np.testing.assert_allclose(scene.radiance(0.0), picture, atol=1e-6)
    with pytest.raises(InputError, match="height, width, 3"):
        colour_photograph(picture[..., 0], still(), sensor_size=(4, 4), duration=1000)
