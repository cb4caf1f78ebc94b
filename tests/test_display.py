"""Tone mapping: range, order, behaviour on normal and HDR scenes, smoothing over time."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from kalux.display import (
    CURVES,
    SAMPLES,
    Auto,
    Clahe,
    DisplaySettings,
    Drago,
    Linear,
    Percentile,
    Reinhard,
    _percentiles,
    _sampled,
    apply,
    curve_from_name,
    decode_srgb,
    encode_srgb,
    measure,
    settings_table,
    to_uint8,
    to_uint16,
    tone_map,
    tone_map_next,
)
from kalux.errors import InputError, SettingsError
from kalux.models.colour import luminance

GLOBAL = [Auto(), Linear(), Percentile(), Reinhard(), Drago()]
ALL = [*GLOBAL, Auto(lift=1), Reinhard(key=0.7, white=3), Drago(bias=0.7), Clahe(), Clahe(clip=20, tiles=3)]
INTENSITIES = hnp.arrays(
    np.float32,
    hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=24),
    elements=st.floats(0, float(np.float32(1e30)), width=32)
    | st.floats(0, 2, width=32)
    | st.sampled_from([0.0, 1.0, float(np.float32(3e38)), float(np.float32(1e-40))]),
)


@dataclass(frozen=True)
class Timed:
    t: int
    intensity: np.ndarray


def hdr_scene(scale: float = 1.0) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(0, 1, 64), np.linspace(0, 1, 48))
    lamp = 60 * np.exp(-((x - 0.7) ** 2 + (y - 0.3) ** 2) / 0.005)
    return (scale * (0.05 + 0.6 * x + lamp)).astype(np.float32)


@pytest.mark.parametrize("curve", ALL, ids=str)
@pytest.mark.parametrize("encoding", ["curve", "none", "srgb", "gamma"])
@settings(max_examples=15, deadline=None)
@given(intensity=INTENSITIES)
def test_mapped_values_are_finite_and_in_range(curve, encoding, intensity):
    mapped = tone_map(intensity, DisplaySettings(curve, encoding=encoding))
    assert mapped.dtype == np.float32
    assert mapped.shape == intensity.shape
    assert np.isfinite(mapped).all()
    assert mapped.min() >= 0
    assert mapped.max() <= 1


@pytest.mark.parametrize("curve", [c for c in ALL if not isinstance(c, Clahe)], ids=str)
@settings(max_examples=60, deadline=None)
@given(intensity=INTENSITIES)
def test_a_brighter_pixel_is_never_darker(curve, intensity):
    mapped = tone_map(intensity, DisplaySettings(curve)).ravel()
    order = np.argsort(intensity.ravel(), kind="stable")
    assert (np.diff(mapped[order]) >= -1e-6).all()


@pytest.mark.parametrize("curve", ALL, ids=str)
def test_a_black_image_is_shown(curve):
    assert np.isfinite(tone_map(np.zeros((5, 7), np.float32), DisplaySettings(curve))).all()


def test_clahe_orders_the_values_of_one_place():
    dark = np.full((32, 32), 0.1, np.float32)
    scene = np.random.default_rng(0).uniform(0, 1, (32, 32)).astype(np.float32)
    curve, statistics = DisplaySettings(Clahe()), measure(scene, Clahe())
    assert (apply(dark, curve, statistics) <= apply(2 * dark, curve, statistics)).all()


def test_clahe_of_a_clip_of_one_is_the_log():
    scene = hdr_scene()
    curve = DisplaySettings(Clahe(clip=1))
    mapped = tone_map(scene, curve)
    log = np.log(scene + 1e-3)
    limits = measure(scene, Clahe(clip=1))[:2]
    expected = np.clip((log - limits[0]) / (limits[1] - limits[0]), 0, 1)
    np.testing.assert_allclose(mapped, expected, atol=1e-5)


def test_auto_shows_a_well_exposed_scene_as_the_camera_does():
    frame = np.linspace(0, 1, 100, dtype=np.float32).reshape(10, 10)
    np.testing.assert_array_equal(tone_map(frame), frame)


def test_auto_keeps_normal_tones_and_rolls_off_highlights():
    scene = hdr_scene()
    mapped = tone_map(scene)
    normal = scene < 0.5
    np.testing.assert_allclose(mapped[normal], scene[normal], atol=1e-6)
    lamp = scene > 2
    assert np.unique(to_uint8(mapped[lamp])).size > 20
    assert np.unique(to_uint8(tone_map(scene, DisplaySettings(Linear()))[lamp])).size == 1


def test_the_shoulder_of_auto_has_no_kink():
    scene = hdr_scene()
    statistics = measure(scene, Auto())
    line = np.linspace(0.4, 0.6, 2001, dtype=np.float32)[None]
    slope = np.diff(apply(line, DisplaySettings(), statistics).astype(np.float64)[0]) / 1e-4
    assert slope[:900].mean() == pytest.approx(1, abs=1e-3)
    assert slope[1001:1011].mean() == pytest.approx(1, abs=0.01)
    assert (slope < 1.02).all()


def test_auto_lifts_a_dark_scene_but_not_further_than_allowed():
    scene = hdr_scene(0.02)
    assert np.median(tone_map(scene)) > 3 * np.median(scene)
    np.testing.assert_allclose(
        tone_map(scene, DisplaySettings(Auto(lift=1))), np.minimum(scene, 1), atol=0.35
    )
    assert np.median(tone_map(scene, DisplaySettings(Auto(lift=1)))) == pytest.approx(np.median(scene))


def test_linear_limits():
    mapped = tone_map(np.array([[0, 1, 2, 3, 9]], np.float32), DisplaySettings(Linear(black=1, white=3)))
    np.testing.assert_allclose(mapped, [[0, 0, 0.5, 1, 1]])


def test_reinhard_maps_as_equation_4():
    scene = hdr_scene()
    mapped = tone_map(scene, DisplaySettings(Reinhard(key=0.36, white=20), encoding="none"))
    average = np.exp(np.log(scene.astype(np.float64) + 1e-3).mean()) - 1e-3
    luminance, white = 0.36 * scene / average, 0.36 * 20 / average
    expected = np.clip(luminance * (1 + luminance / white**2) / (1 + luminance), 0, 1)
    np.testing.assert_allclose(mapped, expected, atol=1e-5)


def test_drago_maps_as_equation_4():
    scene = hdr_scene()
    mapped = tone_map(scene, DisplaySettings(Drago(bias=0.8, high=100), encoding="none"))
    relative = scene / (np.exp(np.log(scene.astype(np.float64) + 1e-3).mean()) - 1e-3)
    below = np.log(2 + 8 * (relative / relative.max()) ** (np.log(0.8) / np.log(0.5)))
    expected = np.log(relative + 1) / below / np.log10(relative.max() + 1)
    np.testing.assert_allclose(mapped, np.clip(expected, 0, 1), atol=1e-5)


def test_srgb_is_the_standard():
    values = np.array([0, 0.001, 0.0031308, 0.18, 0.5, 1], np.float32)
    np.testing.assert_allclose(encode_srgb(values), [0, 0.01292, 0.04045, 0.46135, 0.73536, 1], atol=1e-4)


def test_gamma_and_default_encodings():
    half = np.full((2, 2), 0.5, np.float32)
    linear = DisplaySettings(Linear(), encoding="gamma", gamma=2)
    np.testing.assert_allclose(tone_map(half, linear), np.sqrt(0.5), rtol=1e-6)
    bare = tone_map(half, DisplaySettings(Reinhard(), encoding="none"))
    np.testing.assert_allclose(tone_map(half, DisplaySettings(Reinhard())), encode_srgb(bare), rtol=1e-6)


@given(st.integers(0, 65535))
def test_integers_are_rounded_to_nearest(level):
    assert to_uint16(np.array([[level / 65535]]))[0, 0] == level
    assert to_uint8(np.array([[level / 65535]]))[0, 0] == round(level / 65535 * 255)


def test_integers_are_clipped():
    np.testing.assert_array_equal(to_uint8(np.array([[-1.0, 2.0]])), [[0, 255]])


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


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_not_finite_are_refused(bad):
    intensity = np.zeros((4, 5), np.float32)
    intensity[2, 3] = bad
    with pytest.raises(InputError, match="x=3, y=2"):
        tone_map(intensity)


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


@pytest.mark.parametrize("shape", [(3,), (2, 2, 4), (0, 4)])
def test_other_shapes_are_refused(shape):
    with pytest.raises(InputError, match="shape"):
        tone_map(np.zeros(shape, np.float32))


@pytest.mark.parametrize(
    "make",
    [
        lambda: Linear(black=1, white=1),
        lambda: Linear(white=float("nan")),
        lambda: Percentile(low=50, high=50),
        lambda: Percentile(low=-1),
        lambda: Reinhard(key=0),
        lambda: Reinhard(white=0),
        lambda: Drago(bias=0.5),
        lambda: Clahe(clip=0.5),
        lambda: Clahe(tiles=0),
        lambda: Auto(knee=1),
        lambda: Auto(lift=0.5),
        lambda: DisplaySettings(smoothing=-1),
        lambda: DisplaySettings(gamma=0),
        lambda: DisplaySettings(encoding="rec709"),
        lambda: DisplaySettings("auto"),
        lambda: curve_from_name("filmic"),
        lambda: curve_from_name("linear", knee=1),
    ],
)
def test_settings_out_of_range_are_refused(make):
    with pytest.raises(SettingsError):
        make()


@pytest.mark.parametrize("name", CURVES)
def test_settings_survive_a_table(name):
    table = settings_table(DisplaySettings(curve_from_name(name)))
    assert curve_from_name(table["curve"], **table[name]) == curve_from_name(name)


@given(
    st.sampled_from([(1, 1), (2, 3), (40, 50), (300, 400), (513, 600)]),
    st.sampled_from(["spread", "one value", "few values", "black"]),
    st.lists(st.floats(0.0, 100.0), min_size=1, max_size=3),
)
def test_percentiles_are_numpys(shape, kind, percents):
    """Of a sample of every other pixel where there are many; also where all numbers are alike."""
    rng = np.random.default_rng(0)
    image = {
        "spread": np.exp(rng.normal(0, 3, shape)),
        "one value": np.full(shape, 0.7),
        "few values": rng.integers(0, 3, shape) / 2,
        "black": np.zeros(shape),
    }[kind].astype(np.float32)
    step = 2 if image.size >= 4 * SAMPLES else 1
    expected = np.percentile(image[::step, ::step].astype(np.float64), percents)
    np.testing.assert_allclose(_percentiles(_sampled(image), percents), expected, rtol=1e-6)


@given(st.lists(st.floats(-1.0, 2.0, width=32), min_size=1, max_size=70))
def test_integers_are_rounded_to_the_nearest(values):
    for to_integer, top in ((to_uint8, 255), (to_uint16, 65535)):
        expected = np.rint(np.clip(np.float32(values), 0, 1) * np.float32(top))
        np.testing.assert_array_equal(to_integer(np.float32(values)), expected)
