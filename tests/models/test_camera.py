"""The frame camera, equations (3)-(9), against numbers worked by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux.errors import SettingsError
from kalux.frames import Frame
from kalux.models.camera import (
    BrightTail,
    Camera,
    Response,
    black_ceiling,
    clipping_level,
    common_rounding,
    count_bright,
    covariance,
    dark_scale,
    frame_log_covariance,
    inverse_response,
    log_bias,
    log_covariance,
    log_intensity,
    noise_variance,
    repeated_rounding,
    rounding_error,
)
from kalux.settings import CameraSettings

RESPONSES = {
    "linear": Response.linear(),
    "gamma": Response.gamma(2.2),
    "expanding gamma": Response.gamma(0.5),
    "srgb": Response.srgb(),
    "bt709": Response.bt709(),
    "tabulated": Response.tabulated([3.0, 4.0, 6.0, 10.0, 40.0]),
}
every_response = pytest.mark.parametrize("response", RESPONSES.values(), ids=RESPONSES.keys())
unit = st.floats(0.0, 1.0)


# --- (3) ------------------------------------------------------------------------------------------------


@every_response
@given(irradiance=unit)
def test_inverse_undoes_the_response(response, irradiance):
    value = np.array([irradiance])
    np.testing.assert_allclose(response.inverse(response(value)), value, rtol=1e-9, atol=1e-12)


@every_response
@given(level=unit)
def test_response_undoes_the_inverse(response, level):
    value = np.array([level])
    np.testing.assert_allclose(response(response.inverse(value)), value, rtol=1e-9, atol=1e-12)


@every_response
@given(a=st.floats(-0.5, 1.5), b=st.floats(-0.5, 1.5))
def test_inverse_never_falls(response, a, b):
    low, high = response.inverse(np.sort([a, b]))
    assert low <= high


@every_response
def test_curves_run_from_black_to_white(response):
    np.testing.assert_array_equal(response(np.array([0.0, 1.0, 1.7])), [0.0, 1.0, 1.0])
    np.testing.assert_array_equal(response.inverse(np.array([0.0, 1.0])), [0.0, 1.0])


@every_response
def test_inverse_does_not_clip_beyond_the_ends(response):
    """Float frames may exceed white, and noise may lie below black."""
    np.testing.assert_allclose(response.inverse(np.array([1.25, -0.01])), [1.25, -0.01])


def test_gamma_is_the_power_law():
    level = np.arange(256) / 255
    np.testing.assert_allclose(Response.gamma(2.2).inverse(level), level**2.2, rtol=1e-12)


def test_srgb_agrees_with_the_standard():
    """IEC 61966-2-1: the linear toe, the known middle grey, and white."""
    levels = np.array([0.0, 10 / 255, 188 / 255, 1.0])
    expected = [0.0, 10 / 255 / 12.92, 0.50289, 1.0]
    np.testing.assert_allclose(Response.srgb().inverse(levels), expected, rtol=1e-4)


def test_bt709_agrees_with_the_standard():
    """ITU-R BT.709-6, item 1.2: 4.5 L below 0.018, 1.099 L^0.45 - 0.099 from there."""
    irradiance = np.array([0.01, 0.018, 0.1, 0.5, 1.0])
    expected = [0.045, 0.0812, 0.2910, 0.7055, 1.0]
    np.testing.assert_allclose(Response.bt709()(irradiance), expected, atol=3e-4)


def test_a_table_is_shifted_and_scaled():
    response = Response.tabulated([3.0, 4.0, 6.0, 10.0, 40.0])
    np.testing.assert_allclose(
        response.inverse(np.linspace(0, 1, 5)), [0.0, 1 / 37, 3 / 37, 7 / 37, 1.0], rtol=1e-12
    )


@pytest.mark.parametrize(
    ("name", "same"),
    [
        ("linear", Response.linear()),
        ("srgb", Response.srgb()),
        ("bt709", Response.bt709()),
        ("gamma:2.2", Response.gamma(2.2)),
    ],
)
def test_named_responses(name, same):
    level = np.linspace(0, 1, 50)
    np.testing.assert_array_equal(Response.named(name).inverse(level), same.inverse(level))


@pytest.mark.parametrize("name", ["", "lin", "gamma", "gamma:", "gamma:two", "srgb:2", "LINEAR"])
def test_unknown_names_say_what_is_known(name):
    with pytest.raises(SettingsError, match="known are linear, srgb, bt709, gamma:EXPONENT"):
        Response.named(name)


@pytest.mark.parametrize("name", ["gamma:0", "gamma:-1", "gamma:inf", "gamma:nan"])
def test_a_bad_exponent_is_named_as_such(name):
    with pytest.raises(SettingsError, match="positive exponent"):
        Response.named(name)


@pytest.mark.parametrize(
    ("irradiance", "response", "message"),
    [
        ([0.0, 1.0], [0.0, 0.5, 1.0], "shapes"),
        ([0.0], [0.0], "shapes"),
        ([[0.0, 1.0]], [[0.0, 1.0]], "shapes"),
        ([0.0, np.nan, 1.0], [0.0, 0.5, 1.0], "not finite"),
        ([0.0, 0.5, 0.5, 1.0], [0.0, 0.2, 0.4, 1.0], "increase"),
        ([0.0, 0.2, 0.4, 1.0], [0.0, 0.5, 0.4, 1.0], "increase"),
        ([0.1, 1.0], [0.0, 1.0], "from 0 to 1"),
        ([0.0, 1.0], [0.0, 0.9], "from 0 to 1"),
    ],
)
def test_unusable_curves(irradiance, response, message):
    with pytest.raises(SettingsError, match=message):
        Response(np.array(irradiance), np.array(response))


@pytest.mark.parametrize("table", [[], [1.0], [1.0, 1.0], [2.0, 1.0], [0.0, np.nan], [0.0, 2.0, 1.0, 3.0]])
def test_unusable_tables(table):
    with pytest.raises(SettingsError, match="response"):
        Response.tabulated(table)


@given(level=unit, ratio=st.floats(0.01, 100.0))
def test_irradiance_is_scaled_to_the_reference_exposure(level, ratio):
    camera = Camera(RESPONSES["srgb"])
    value = np.array([level])
    expected = camera.response.inverse(value) * ratio
    np.testing.assert_allclose(inverse_response(camera, value, ratio), expected, rtol=1e-12)


# --- (4), (5) -------------------------------------------------------------------------------------------


@every_response
def test_certainty_is_the_slope_with_largest_value_one(response):
    """(4), against central differences of the response itself, away from black."""
    middle = np.linspace(0.25, 0.98, 60)
    assert response.certainty(np.linspace(0, 1, 5000)).max() == pytest.approx(1.0, abs=1e-9)
    assert (response.certainty(np.linspace(0, 1, 5000)) > 0).all()
    if response is not RESPONSES["tabulated"]:  # its slope has steps
        h = 0.01
        slope = (response(middle + h) - response(middle - h)) / (2 * h)
        ratio = response.certainty(middle) / slope
        np.testing.assert_allclose(ratio, np.median(ratio), rtol=0.08)


def test_certainty_of_a_table_is_its_slopes():
    """Four stretches of slopes 1/4 over 1/37, 2/37, 4/37 and 30/37."""
    response = RESPONSES["tabulated"]
    inside = np.array([0.5, 2.0, 5.0, 20.0]) / 37
    np.testing.assert_allclose(response.certainty(inside), [1.0, 1 / 2, 1 / 4, 1 / 30], rtol=1e-9)


@every_response
@given(level=unit)
def test_weight_is_certainty_after_inverse(response, level):
    """(5)."""
    value = np.array([level])
    np.testing.assert_array_equal(response.weight(value), response.certainty(response.inverse(value)))


def test_colours_may_have_a_response_each():
    camera = Camera.named("linear; gamma:2 ;srgb", 0.9)
    assert camera.saturation == 0.9
    level = np.array([0.25, 0.5])
    for channel, name in enumerate(("linear", "gamma:2", "srgb")):
        own = camera.of_channel(channel)
        assert own.colours is None
        np.testing.assert_array_equal(own.response.inverse(level), Response.named(name).inverse(level))
    assert Camera.named("srgb", 0.9).of_channel(2).colours is None


@pytest.mark.parametrize("text", ["linear;srgb", "linear;srgb;linear;srgb", ";;", "linear;srgb;no"])
def test_responses_per_colour_that_are_none(text):
    with pytest.raises(SettingsError, match="response"):
        Camera.named(text, 0.98)


def test_linear_camera_weighs_all_levels_alike():
    level = np.arange(256) / 255
    np.testing.assert_allclose(Camera(Response.linear()).weight(level), 1.0, rtol=1e-9)


def test_gamma_weighs_dark_more_than_bright():
    """The slope of I^(1/2.2) falls with I: at response v it is proportional to v^-1.2."""
    weight = Camera(Response.gamma(2.2)).weight(np.array([0.25, 0.5, 1.0]))
    np.testing.assert_allclose(weight[:-1] / weight[1:], 2**1.2, rtol=0.01)


def test_released_table_is_a_weight_with_largest_value_one():
    table = 7e5 * np.concatenate([np.linspace(0.1, 1.0, 128), np.linspace(1.0, 0.0, 128)])
    camera = Camera.from_inverse_covariance(table, Response.linear(), 0.9)
    level = np.arange(256) / 255
    np.testing.assert_allclose(camera.weight(level), table / 7e5, rtol=1e-12)
    assert camera.saturation == 0.9
    between = camera.weight(np.array([10.5 / 255]))
    np.testing.assert_allclose(between, (table[10] + table[11]) / 2 / 7e5, rtol=1e-12)


@pytest.mark.parametrize(
    "table", [[], [1.0], [0.0, 0.0], [1.0, -0.1], [1.0, np.nan], [1.0, np.inf], "x", [[1.0], [1.0, 2.0]]]
)
def test_unusable_released_tables(table):
    with pytest.raises(SettingsError, match="f_Q"):
        Camera.from_inverse_covariance(table, Response.linear(), 0.98)


# --- (6), (8), (9) --------------------------------------------------------------------------------------


def test_covariance_by_hand():
    """(6): sigma_im^2 / f^w, and the floor caps it."""
    weight = np.array([1.0, 0.5, 0.09, 0.01, 0.0])
    expected = np.array([1.0, 2.0, 1 / 0.09, 1 / 0.09, 1 / 0.09]) / 7e5
    np.testing.assert_allclose(covariance(weight, 1 / 7e5, 0.09), expected, rtol=1e-12)


def test_read_and_shot_noise_by_hand():
    """Half the exposure: the frame saw half of I, and is doubled, noise and all."""
    intensity = np.array([-0.1, 0.0, 0.5, 2.0])
    expected = 4 * (0.01**2 + 1e-4 * np.array([0.0, 0.0, 0.25, 1.0]))
    np.testing.assert_allclose(noise_variance(intensity, (0.01, 1e-4), 2.0), expected, rtol=1e-12)


def test_covariance_of_a_frame_by_hand():
    """(6) and (9); near black as at one and a half standard deviations of the noise."""
    intensity, weight = np.array([0.0, 0.01, 0.015, 0.5]), np.array([1.0, 1.0, 1.0, 0.5])
    expected = 1e-4 / np.array([0.045, 0.045, 0.045, 0.53]) ** 2 / weight
    found = frame_log_covariance(intensity, weight, (0.01, 0.0), 1.0, 0.03)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_noise_of_a_frame_is_no_less_than_the_rounding_of_its_levels():
    intensity, rounding = np.array([0.1, 0.5]), np.array([0.004, 0.02])
    found = frame_log_covariance(intensity, np.ones(2), (0.01, 0.0), 1.0, 0.03, rounding)
    np.testing.assert_allclose(found, [1e-4 / 0.13**2, 4e-4 / 0.53**2], rtol=1e-12)


def test_errors_of_a_response_are_as_much_light_as_its_inverse_is_steep():
    """Of v^2 the slope within v -+ e is 2 v; at black and white only the side that there is counts."""
    response, light = Response.gamma(2.0), np.array([0.01, 0.25, 0.81])
    np.testing.assert_allclose(response.irradiance_error(light, 0.005), 2 * np.sqrt(light) * 0.005, rtol=1e-3)
    np.testing.assert_allclose(response.slope(light, 0.005), 2 * np.sqrt(light), rtol=1e-3)
    assert 0 < response.irradiance_error(np.array([0.0]), 0.004)[0] < 3e-5
    assert response.irradiance_error(np.array([0.0]), 0.5 / 255)[0] > 0  # from half a level to a whole one
    crushed = Response.s_curve(0.2)
    assert crushed.irradiance_error(np.array([0.1]), 0.004)[0] < 0.03  # not what may be hidden, 0.2
    white, beyond = response.irradiance_error(np.array([1.0, 3.0]), 0.004)
    assert white == beyond == pytest.approx(2 * 0.998 * 0.004, rel=1e-3)
    np.testing.assert_allclose(Response.linear().irradiance_error(light, 0.005), 0.005)


def test_rounding_follows_the_slope_of_the_inverse_response():
    """Of gamma 2.2 half a level is 2.2 v^1.2 halves of a level at v: nearly nothing in the dark, double near white."""
    level, half = np.array([0.0, 0.1, 0.5, 0.9]), 0.5 / 255
    found = Response.gamma(2.2).rounding(level, half)
    np.testing.assert_allclose(found[1:], half * 2.2 * level[1:] ** 1.2, rtol=1e-2)
    assert 0 < found[0] < 1e-5
    np.testing.assert_array_equal(Response.linear().rounding(level, half), 0.0)
    np.testing.assert_array_equal(Response.gamma(2.2).rounding(level, 0.0), 0.0)


def test_rounding_that_all_levels_share():
    octets = Frame(np.zeros((1, 1), np.uint8), 0, 1)
    assert common_rounding(octets, Response.gamma(1.0)) == 0.5 / 255
    assert common_rounding(octets, Response.srgb()) == 0.0


def test_noise_of_a_measured_weight_only_is_divided_by_it():
    """The slope of a response says how exact a level is, but noise is that of the intensity."""
    level = np.linspace(0, 1, 5)
    np.testing.assert_array_equal(Camera(RESPONSES["srgb"]).measured_weight(level), 1.0)
    camera = Camera.from_inverse_covariance(np.linspace(1, 7e5, 256), Response.linear(), 0.98)
    np.testing.assert_array_equal(camera.measured_weight(level), camera.weight(level))


def test_rounding():
    assert rounding_error(Frame(np.zeros((1, 1), np.uint8), 0, 1)) == 0.5 / 255
    assert rounding_error(Frame(np.zeros((1, 1), np.uint16), 0, 1, 1023)) == 0.5 / 1023
    assert rounding_error(Frame(np.zeros((1, 1)), 0, 1)) == 0.0


def test_rounding_repeats_where_noise_is_less_than_half_a_level():
    """A standard deviation of a level over the root of 12; of no other response, of no floats, of no colours."""
    octets, half = Frame(np.zeros((2, 2), np.uint8), 0, 1), 0.5 / 255
    quiet = CameraSettings(frame_noise=half)
    assert repeated_rounding(octets, quiet) == pytest.approx(1 / 255 / 12**0.5)
    assert repeated_rounding(octets, CameraSettings(frame_noise=1.01 * half)) == 0
    assert repeated_rounding(octets, CameraSettings()) == 0
    assert repeated_rounding(octets, CameraSettings(frame_noise=half, response="srgb")) == 0
    assert repeated_rounding(Frame(np.zeros((2, 2)), 0, 1), quiet) == 0
    assert repeated_rounding(Frame(np.zeros((2, 2, 3), np.uint8), 0, 1), quiet) == 0


def test_dark_pixels_are_not_made_brighter_by_their_noise():
    """The mean of many frames by information: its error in log intensity, beside that of R at each value."""
    rng = np.random.default_rng(0)
    read, offset, truth = 0.005, 0.004, 0.002
    value = np.maximum(truth + read * rng.standard_normal(100_000), 0.0)
    error = log_intensity(value, offset) - np.log(truth + offset)

    def mean(covariances):
        return np.average(error, weights=1 / covariances)

    at_value = log_covariance(value, np.full(value.shape, read**2), offset)
    own = frame_log_covariance(value, np.ones(value.shape), (read, 0.0), 1.0, offset)
    assert mean(at_value) > 0.4
    assert abs(mean(own)) < 0.4 * mean(at_value)


@given(weight=unit, floor=st.floats(1e-6, 1.0))
def test_floor_caps_the_covariance(weight, floor):
    r_bar = covariance(np.array([weight]), 2.0, floor)[0]
    assert 2.0 <= r_bar <= 2.0 / floor * (1 + 1e-12)


def test_log_intensity_and_its_covariance_by_hand():
    """(8) and (9) at I = 0.2, I_0 = 0.05, R_bar = 0.01: (I + I_0)^2 = 1/16."""
    intensity, r_bar = np.array([0.2]), np.array([0.01])
    np.testing.assert_allclose(log_intensity(intensity, 0.05), -np.log(4), rtol=1e-12)
    np.testing.assert_allclose(log_bias(intensity, r_bar, 0.05), 0.08, rtol=1e-12)
    np.testing.assert_allclose(log_covariance(intensity, r_bar, 0.05), 0.16, rtol=1e-12)


def test_noise_below_black_counts_as_black():
    dark = np.array([-0.5, 0.0])
    np.testing.assert_array_equal(log_intensity(dark, 0.03), np.log([0.03, 0.03]))
    np.testing.assert_allclose(log_covariance(dark, np.ones(2), 0.5), [4.0, 4.0], rtol=1e-12)
    np.testing.assert_allclose(log_bias(dark, np.ones(2), 0.5), [2.0, 2.0], rtol=1e-12)


@given(st.floats(0.0, 5.0), st.floats(1e-3, 2.0))
def test_bias_and_covariance_are_those_of_a_noisy_logarithm(intensity, offset):
    """By Taylor's series the mean of log(x + noise) falls by half of its variance."""
    i, r = np.array([intensity]), np.array([1e-3])
    np.testing.assert_allclose(log_bias(i, r, offset), log_covariance(i, r, offset) / 2, rtol=1e-12)


def test_bias_against_a_sampled_logarithm():
    noise = np.random.default_rng(0).normal(0.0, 0.02, 2_000_000)
    sampled = np.log(0.3 + noise + 0.1)
    bias = log_bias(np.array([0.3]), np.array([0.02**2]), 0.1)[0]
    variance = log_covariance(np.array([0.3]), np.array([0.02**2]), 0.1)[0]
    assert np.log(0.4) - sampled.mean() == pytest.approx(bias, rel=0.1)
    assert sampled.var() == pytest.approx(variance, rel=0.02)


# --- measured curves --------------------------------------------------------------------------------------


def test_a_curve_goes_through_its_knots_and_back():
    curve = Response.named("curve:0 0.02 0.1 0.3 1")
    level = np.linspace(0, 1, 5)
    np.testing.assert_allclose(curve.inverse(level), [0, 0.02, 0.1, 0.3, 1], atol=2e-3)
    fine = np.linspace(0, 1, 101)
    np.testing.assert_allclose(curve(curve.inverse(fine)), fine, atol=1e-9)
    assert (np.diff(curve.inverse(fine)) > 0).all()


def test_the_certainty_of_a_curve_is_its_slope():
    """Knots of a square root: f^c falls as 1 / sqrt(I), and f^w as 1 / response."""
    knots = " ".join(str(v) for v in np.linspace(0, 1, 33) ** 2)
    curve = Response.named(f"curve:{knots}")
    ratio = curve.weight(np.array([0.25])) / curve.weight(np.array([0.5]))
    assert ratio[0] == pytest.approx(2.0, rel=0.05)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("curve:", "at least two increasing"),
        ("curve:0", "at least two increasing"),
        ("curve:0 0.5 0.4 1", "at least two increasing"),
        ("curve:0 0.5 nan 1", "at least two increasing"),
        ("curve:0 0.5 2", "0 to 1 is needed"),
        ("curve:0.1 0.5 1", "0 to 1 is needed"),
        ("curve:0 half 1", "not a number"),
    ],
)
def test_curves_that_are_none(name, message):
    with pytest.raises(SettingsError, match=message):
        Response.named(name)


# --- the bright tail ------------------------------------------------------------------------------------------


@given(st.floats(0.3, 2.0))
def test_the_scale_of_an_exponential_tail_is_found(scale):
    """Of log intensities that fall off exponentially from half of white on."""
    rng = np.random.default_rng(0)
    levels = 0.475 * np.exp(rng.exponential(scale, 200_000))
    found = count_bright(Camera.named("linear", 0.98), np.minimum(levels, 1.0).reshape(400, 500)).scale
    assert found == pytest.approx(scale, rel=0.03)


def test_only_valid_pixels_count_as_bright():
    image, valid = np.ones((4, 4)), np.zeros((4, 4), np.bool_)
    image[:2], valid[:2] = 0.6, True
    camera = Camera.named("linear", 0.98)
    assert count_bright(camera, image, valid=valid) == BrightTail(8, 0)
    assert count_bright(camera, np.repeat(image[..., None], 3, axis=-1), valid=valid) == BrightTail(8, 0)


def test_frames_without_white_and_frames_all_white_are_at_the_bounds():
    dark, white = np.full((4, 4), 0.6), np.ones((4, 4))
    camera = Camera.named("linear", 0.98)
    assert count_bright(camera, dark).scale == 0.3
    assert count_bright(camera, white).scale == 2.0
    both = count_bright(camera, dark).joined(count_bright(camera, white))
    assert both == BrightTail(32, 16)
    assert both.scale == pytest.approx(1.0)


def test_the_tail_is_one_of_light_not_of_response():
    levels = np.linspace(0, 1, 1000).reshape(20, 50)
    linear, gamma = Camera.named("linear", 0.98), Camera.named("gamma:2.2", 0.98)
    for white in (255, 200):  # as recorded, and normalised
        image = np.random.default_rng(1).integers(0, white + 1, (30, 40)).astype(np.uint8)
        assert count_bright(linear, image, white) == count_bright(linear, image / white)
    assert count_bright(gamma, levels ** (1 / 2.2)) == count_bright(linear, levels)


@pytest.mark.parametrize("light", [(1, 1, 1), (1, 1, 0.3), (0.3, 1, 1), (1, 0.7, 0.3), (0.7, 1, 0.4)])
@pytest.mark.parametrize("dtype", [np.uint8, np.float64])
def test_in_coloured_light_as_many_pixels_are_bright_as_in_white(light, dtype):
    """Channels that stay below white in clipped highlights say nothing of these; grey stored as RGB is grey."""
    camera = Camera.named("linear", 0.98)
    white = 255 if dtype == np.uint8 else 1
    radiance = np.random.default_rng(3).exponential(0.5, (60, 80))

    def seen(light):
        image = np.minimum(white * np.multiply.outer(radiance, light), white)
        return (np.rint(image) if white == 255 else image).astype(dtype)

    expected = count_bright(camera, seen(1.0), white)
    found = count_bright(camera, seen(light), white)
    assert found.half == pytest.approx(expected.half, rel=0.01)
    assert found.white == pytest.approx(expected.white, rel=0.01)
    assert found.scale > 0.4


def test_a_colour_is_clipped_by_the_channel_that_takes_a_fifth_of_its_luminance_along():
    """Blue alone, 7 % of white's luminance, does not clip it, except where hardly anything else is; gains count."""
    camera = Camera.named("linear", 0.98)
    image = np.array([[[200, 200, 255], [255, 200, 60], [0, 20, 255], [7, 7, 7]]], np.uint8)
    assert clipping_level(camera, image, 255).tolist() == [[200, 255, 255, 7]]
    assert clipping_level(camera, image, 255, gains=(1.0, 1.0, 4.0)).tolist() == [[255, 255, 255, 7]]
    assert clipping_level(camera, image, 255, 6).tolist() == [[200, 255, 255, 7]]


def test_what_counts_as_white_lies_below_where_pixels_clip():
    """The same light, of a camera that clips at half of full scale; one that clips from 1 on is not brighter."""
    levels = np.minimum(np.random.default_rng(2).exponential(0.4, (30, 40)), 1.0)
    for response in ("linear", "gamma:2.2"):
        whole = Camera.named(response, 0.98)
        half = Camera.named(response, float(whole.response(0.5 * whole.response.inverse(np.array(0.98)))))
        assert count_bright(half, whole.response(0.5 * levels)) == count_bright(whole, whole.response(levels))
    assert count_bright(Camera.named("linear", 1.0), levels) == count_bright(
        Camera.named("linear", 0.98), levels
    )


def test_a_white_value_beyond_the_type_is_one_that_no_pixel_has():
    image = np.arange(256, dtype=np.uint8).reshape(16, 16)
    linear = Camera.named("linear", 0.98)
    for white in (300.0, 512.0, 1e12):
        assert count_bright(linear, image, white) == count_bright(linear, image / white)


def test_black_hides_the_irradiance_of_half_a_level():
    """Of a linear response half a level; of an s-curve its toe; nothing of what is not black; by the exposure."""
    response = np.array([0.0, 0.4 / 255, 1 / 255, 1.0])
    linear = black_ceiling(Camera.named("linear", 0.98), response, 2.0)
    np.testing.assert_allclose(linear, [1 / 255, 1 / 255, np.inf, np.inf])
    crushed = black_ceiling(Camera.named("s-curve:0.3", 0.98), response, 1.0)
    assert 0.3 < crushed[0] < 0.33
    assert np.isinf(crushed[2:]).all()


@pytest.mark.parametrize("scale", [0.4, 1.0, 1.8])
def test_the_scale_of_what_is_black_is_found_from_what_is_hardly_more(scale):
    intensity = np.linspace(0.0, 1.0, 2001)
    counts = np.diff(1e6 * intensity ** (1 / scale), prepend=0.0).astype(np.int64)
    assert dark_scale(intensity, counts, 0.2, 1.0) == pytest.approx(scale, rel=0.03)


def test_the_scale_of_what_is_black_has_bounds():
    """Where nothing is black, and where nothing else is."""
    intensity = np.array([0.0, 0.3, 0.5])
    assert dark_scale(intensity, np.array([0, 9, 9]), 0.25, 1.0) == 0.3
    assert dark_scale(intensity, np.array([9, 0, 0]), 0.25, 1.0) == 2.0
