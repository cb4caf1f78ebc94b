"""The transfer function, and pictures in colour."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from kalux.display import (
    Auto,
    DisplaySettings,
    Drago,
    Linear,
    Reinhard,
    decode_srgb,
    encode_srgb,
    measure,
    tone_map,
    tone_map_next,
)
from kalux.models.colour import luminance


def test_srgb_is_the_standard():
    values = np.array([0, 0.001, 0.0031308, 0.18, 0.5, 1], np.float32)
    np.testing.assert_allclose(encode_srgb(values), [0, 0.01292, 0.04045, 0.46135, 0.73536, 1], atol=1e-4)


COLOURS = hnp.arrays(
    np.float32,
    (5, 6, 3),
    elements=st.floats(0, 100, width=32, allow_subnormal=False).map(lambda v: v if v > 1e-3 else 0),
)


class TestColour:
    @given(COLOURS, st.sampled_from([Auto(), Linear(), Reinhard(), Drago()]))
    def test_the_luminance_is_that_of_the_grey_picture(self, colour, curve):
        """What is seen on an sRGB display: the luminance of the light, not of the encoded values."""
        settings = DisplaySettings(curve)
        shown = tone_map(colour, settings)
        assert shown.shape == colour.shape
        assert shown.min() >= 0
        assert shown.max() <= 1
        light = luminance(decode_srgb(shown))
        np.testing.assert_allclose(light, decode_srgb(tone_map(luminance(colour), settings)), atol=2e-5)

    @given(COLOURS)
    def test_the_chromaticity_is_kept_or_drawn_towards_white(self, colour):
        """On the line from grey to the colour: hues keep their order of channels, and none is overshot."""
        shown = decode_srgb(tone_map(colour, DisplaySettings(Linear())))
        y, seen = luminance(colour)[..., None], luminance(shown)[..., None]
        wanted = (colour - y) / np.maximum(y, 1e-12) * seen
        share = np.sum((shown - seen) * wanted, axis=-1) / np.maximum(np.sum(wanted**2, axis=-1), 1e-12)
        assert share.min() > -1e-3
        assert share.max() < 1 + 1e-3
        np.testing.assert_allclose(shown - seen, share[..., None] * wanted, atol=1e-3)

    def test_grey_in_colour_is_the_grey_picture(self):
        grey = np.geomspace(1e-3, 50, 60, dtype=np.float32).reshape(6, 10)
        np.testing.assert_allclose(
            tone_map(np.stack([grey] * 3, axis=-1)), np.stack([tone_map(grey)] * 3, axis=-1), atol=1e-5
        )

    def test_a_saturated_colour_too_bright_for_the_display_goes_to_white(self):
        red = np.zeros((1, 4, 3), np.float32)
        red[0, :, 0] = [0.1, 2.0, 4.0, 50.0]
        shown = tone_map(red, DisplaySettings(Linear()))[0]
        assert shown[0, 0] > 0.05
        assert shown[0, 1:].max() < 0.01  # in gamut: pure red
        assert (np.diff(shown[:, 1]) >= 0).all()  # then paler and paler
        np.testing.assert_allclose(shown[3], 1, atol=1e-6)

    def test_srgb_and_back(self):
        values = np.linspace(0, 1, 100, dtype=np.float32)
        np.testing.assert_allclose(decode_srgb(encode_srgb(values)), values, atol=1e-6)

    def test_a_video_maps_the_colour_and_smooths_the_statistics_of_its_luminance(self):
        colour = np.random.default_rng(0).uniform(0, 5, (4, 5, 3)).astype(np.float32)
        image = SimpleNamespace(t=0, intensity=colour[..., 0], colour=colour)
        mapped, state = tone_map_next(image)
        np.testing.assert_array_equal(mapped, tone_map(colour))
        np.testing.assert_array_equal(state.statistics, measure(luminance(colour), Auto()))
