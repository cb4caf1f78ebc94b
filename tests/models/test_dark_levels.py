"""What dark levels are taken for (docs/equations.md, K3): means of noisy frames must be right."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux.errors import SettingsError
from kalux.models.camera import frame_log_covariance, log_intensity
from kalux.models.dark_levels import LIGHT_EDGES, dark_correction, dark_doubt, dark_shares

GAP = 1 / 255
LEVELS = np.arange(256) * GAP
OFFSET = 0.004


def error_of_mean(intensity: float, noise: float, added: np.ndarray) -> float:
    """Of log(I + I_0), as the mean of 100,000 frames of 8 bits in which each counts by its 1 / (R + 0.03) tells it."""
    rng = np.random.default_rng(5)
    read = np.rint(np.maximum(rng.normal(intensity, noise, 100_000), 0.0) / GAP).astype(int)
    told = log_intensity(LEVELS, OFFSET) + added
    counted = 1.0 / (0.03 + frame_log_covariance(LEVELS, np.ones(256), (noise, 0.0), 1.0, OFFSET))
    return float(np.average(told[read], weights=counted[read]) - np.log(intensity + OFFSET))


@pytest.mark.parametrize("noise", [0.004, 0.008, 0.015])
def test_the_mean_of_noisy_frames_is_right(noise):
    """From twice the noise on gone, of less light within a tenth; what is black stays too bright."""
    added = dark_correction(LEVELS, (float(np.hypot(noise, GAP / 12**0.5)), 0.0), 1.0, OFFSET, GAP)
    for share in (0.0, 0.25, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0):
        before, after = (error_of_mean(share * noise, noise, d) for d in (np.zeros(256), added))
        if share < 0.5:
            assert 0 < after < (0.95 if share else 0.98) * before
        else:
            assert abs(after) < (0.1 if share < 2 else 0.0125)
        if share not in (1.0, 5.0, 6.0):  # there the weights make up for the bend
            assert before > (0.045 if share in (2.0, 3.0) else 0.02)


def test_what_is_not_dark_stays():
    added = dark_correction(LEVELS, (0.008, 0.0), 1.0, OFFSET, GAP)
    assert (added[LEVELS >= 8 * 0.008] == 0).all()
    assert (added[(LEVELS > 0) & (LEVELS < 6 * 0.008)] < -0.008).all()
    assert (added[(LEVELS > 0) & (LEVELS < 5 * 0.008)] < -0.01).all()


@pytest.mark.parametrize("noise", [0.0, 0.2 * GAP, GAP / 12**0.5])
def test_frames_that_are_only_rounded_stay(noise):
    """They show the same level again and again: there is no mean to be put right."""
    assert not dark_correction(LEVELS, (noise, 0.0), 1.0, OFFSET, GAP).any()


def test_finer_levels_say_the_same():
    """Of 16 bits and of floating point: rounding to 8 bits changes little where noise is two of their levels."""
    coarse = dark_correction(LEVELS, (0.008, 0.001), 1.0, OFFSET, GAP)
    for gap in (1 / 65535, 0.0):
        np.testing.assert_allclose(
            dark_correction(LEVELS, (0.008, 0.001), 1.0, OFFSET, gap)[:20], coarse[:20], atol=0.06
        )


@given(
    st.floats(1e-4, 0.1),
    st.floats(0, 0.01),
    st.floats(1e-4, 0.2),
    st.sampled_from([0.0, 1 / 65535, 1 / 255]),
    st.floats(0.01, 100),
)
def test_brightness_has_no_unit(noise, shot, offset, gap, white):
    """An exposure half as long is the same frame, twice as bright."""
    intensity = np.linspace(-0.01, 1.0, 50)
    added = dark_correction(intensity, (noise, shot), 1.0, offset, gap)
    scaled = dark_correction(white * intensity, (noise, shot), white, white * offset, white * gap)
    assert np.isfinite(added).all()
    np.testing.assert_allclose(scaled, added, atol=1e-6)


@pytest.mark.parametrize("noise", [0.03, 0.06])
def test_what_is_hidden_below_black_is_doubted_by_as_much_as_means_are_wrong(noise):
    """By how much those of a hundred intensities are, all as likely in log(I + I_0), that show about the same."""
    both = (float(np.hypot(noise, GAP / 12**0.5)), 0.0)
    added = dark_correction(LEVELS, both, 1.0, OFFSET, GAP)
    light = np.geomspace(OFFSET, noise + OFFSET, 40) - OFFSET
    wrong = np.array([error_of_mean(i, noise, added) for i in light])
    shown = np.exp(wrong + np.log(light + OFFSET)) - OFFSET
    doubt = dark_doubt(both, OFFSET, GAP)
    told = np.interp(shown, np.arange(len(doubt.variances)) * doubt.spacing, doubt.variances)
    assert 0.8 < np.sqrt(np.mean(wrong**2) / np.mean(told)) < 1.25
    assert told[0] > 0.25


def test_nothing_is_doubted_that_noise_does_not_hide():
    assert dark_doubt((0.008, 0.0), OFFSET, GAP) is None
    assert dark_doubt((0.001, 0.0), 1e-5, GAP) is None  # frames are only rounded
    doubt = dark_doubt((0.03, 0.001), OFFSET, GAP)
    assert doubt.variances[-1] == 0
    assert doubt.spacing * (len(doubt.variances) - 1) == pytest.approx(4 * np.sqrt(0.03**2 - GAP**2 / 12))
    assert (doubt.variances[doubt.spacing * np.arange(len(doubt.variances)) > 0.06] < 1e-3).all()


def test_black_is_right_where_frames_show_black_and_other_light_where_they_show_that():
    """Which light noise hides below black no frame says: the light that is there counts."""
    noise = float(np.hypot(0.01, GAP / 12**0.5)), 0.0
    black, grey = (
        tuple(float(edge in shown) for edge in LIGHT_EDGES[:-1])
        for shown in ((0.0, 6.5), (0.375, 0.75, 1.25, 6.5))
    )
    of_black, of_grey = (dark_correction(LEVELS, noise, 1.0, OFFSET, GAP, one) for one in (black, grey))
    assert abs(error_of_mean(0.0, 0.01, of_black)) < 0.2 < 0.4 < error_of_mean(0.0, 0.01, of_grey)
    assert abs(error_of_mean(0.01, 0.01, of_grey)) < 0.05 < 0.3 < -error_of_mean(0.01, 0.01, of_black)


def test_dark_means_are_doubted_less_where_frames_show_nothing_darker():
    """Black is the doubt of a mean of the noise, and not where hardly anything is darker than that."""
    noise = 0.03, 0.0
    deep, shallow = (tuple(float(low <= edge < 2.0) for edge in LIGHT_EDGES[:-1]) for low in (0.0, 0.75))
    shown = slice(16, 24)  # from the noise to one and a half of it
    of_deep, of_shallow = (dark_doubt(noise, OFFSET, GAP, one).variances[shown] for one in (deep, shallow))
    assert (of_shallow < 0.6 * of_deep).all()


def test_shares_have_no_unit():
    noise, shares = (0.01, 0.0), (3.0, *np.arange(1.0, 10.0))
    thousandth = tuple(share / 1000 for share in shares)
    one, other = (dark_correction(LEVELS, noise, 1.0, OFFSET, GAP, given) for given in (shares, thousandth))
    np.testing.assert_allclose(one, other, atol=1e-12)


def test_shares_are_read_from_a_setting():
    assert dark_shares("auto") is dark_shares("even") is None
    assert dark_shares(" ".join(["0.5", *["0"] * 8, "1e-3"])) == (0.5, *[0.0] * 8, 0.001)


@pytest.mark.parametrize("text", ["", "black", "1 2 3", " ".join(["0"] * 10), " ".join(["1"] * 9 + ["-1"])])
def test_shares_that_are_none_are_an_error(text):
    with pytest.raises(SettingsError, match="10 numbers from 0"):
        dark_shares(text)
