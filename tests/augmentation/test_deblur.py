"""The event double integral: exact cases, its defining property, and real gain on a blurred picture."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux.augmentation.deblur import (
    EXPOSED,
    expose,
    integrate_exposure,
    latent_end,
    latent_middle,
    latent_peak,
    latent_start,
    still_exposure,
)
from kalux.augmentation.refractory import EventClock
from kalux.datasets import SensorSettings, pan, photograph_scene, simulate
from kalux.events import make_events
from kalux.filters.bridged_frames import latent_frame
from kalux.models.camera import log_intensity

from builders import blocks, events, pixel_events

ON, OFF = 0.3, 0.2


def steps(shape=(1, 1), on=ON, off=OFF):
    return np.full(shape, on), np.full(shape, off)


def integrate(array, start=1000, end=2000, shape=(1, 1), on=ON, off=OFF):
    return integrate_exposure(array, start, end, *steps(shape, on, off))


# --- exact cases ----------------------------------------------------------------------------------------


def test_no_events_leave_the_frame_as_it_is():
    integrals = integrate(events(), shape=(2, 3))
    for values in integrals:
        np.testing.assert_array_equal(values, np.zeros((2, 3)))
    frame = np.log(np.arange(1.0, 7.0)).reshape(2, 3)
    for latent in (latent_start, latent_middle, latent_end, latent_peak):
        np.testing.assert_array_equal(latent(frame, integrals), frame)


def test_one_event_a_quarter_into_the_exposure():
    """Before it the level is 0 for 250 us, after it c for 750 us."""
    integrals = integrate(pixel_events([1250], [1]))
    np.testing.assert_allclose(integrals.log_mean, np.log(0.25 + 0.75 * np.exp(ON)), rtol=1e-6)
    assert integrals.to_middle == pytest.approx(ON, rel=1e-6)
    assert integrals.to_end == pytest.approx(ON, rel=1e-6)
    assert integrals.peak == pytest.approx(ON, rel=1e-6)
    assert integrals.events == 1
    frame = np.zeros((1, 1))
    np.testing.assert_allclose(latent_start(frame, integrals), -integrals.log_mean, rtol=1e-6)
    np.testing.assert_allclose(latent_end(frame, integrals), ON - integrals.log_mean, rtol=1e-6)


def test_one_event_after_the_middle():
    integrals = integrate(pixel_events([1750], [0]))
    np.testing.assert_allclose(integrals.log_mean, np.log(0.75 + 0.25 * np.exp(-OFF)), rtol=1e-6)
    assert integrals.to_middle == 0.0
    assert integrals.to_end == pytest.approx(-OFF, rel=1e-6)
    assert integrals.peak == 0.0


def test_two_events_up_and_down():
    integrals = integrate(pixel_events([1100, 1600], [1, 0]))
    expected = np.log(0.1 + 0.5 * np.exp(ON) + 0.4 * np.exp(ON - OFF))
    np.testing.assert_allclose(integrals.log_mean, expected, rtol=1e-6)
    np.testing.assert_allclose(integrals.to_middle, ON, rtol=1e-6)
    np.testing.assert_allclose(integrals.to_end, ON - OFF, rtol=1e-6)
    np.testing.assert_allclose(integrals.peak, ON, rtol=1e-6)
    assert integrals.events == 2


def test_a_broken_pixel_stays_finite():
    """A thousand steps of 0.3 within an exposure, up or down."""
    for polarity in (1, 0):
        integrals = integrate(pixel_events(range(1001, 2001), [polarity] * 1000))
        for values in integrals:
            assert np.isfinite(values).all()


def test_events_at_the_same_time_count_one_after_another():
    both = integrate(pixel_events([1500, 1500], [1, 1]))
    np.testing.assert_allclose(both.log_mean, np.log(0.5 + 0.5 * np.exp(2 * ON)), rtol=1e-6)


def test_exposures_are_open_at_the_start_and_closed_at_the_end():
    """An event at the start belongs before the exposure; one at its end is in it, with no time left to count."""
    at_start = integrate(pixel_events([1000], [1]))
    assert (at_start.events, at_start.to_end, at_start.log_mean) == (0, 0.0, 0.0)
    at_end = integrate(pixel_events([2000], [1]))
    assert (at_end.events, at_end.log_mean) == (1, 0.0)
    assert at_end.to_end == pytest.approx(ON, rel=1e-6)
    at_middle = integrate(pixel_events([1500], [1]))
    assert at_middle.to_middle == pytest.approx(ON, rel=1e-6)
    assert integrate(pixel_events([1501], [1])).to_middle == 0.0


def test_every_pixel_has_its_own_events_and_steps():
    on = np.array([[0.1, 0.2, 0.3]])
    integrals = integrate_exposure(events((1500, 2, 0, 1), (1500, 0, 0, 0)), 1000, 2000, on, 2 * on)
    np.testing.assert_allclose(integrals.to_end, [[-0.2, 0.0, 0.3]], rtol=1e-6)
    np.testing.assert_array_equal(integrals.events, [[1, 0, 1]])


def test_switched_off():
    for values in still_exposure((2, 3)):
        np.testing.assert_array_equal(values, np.zeros((2, 3)))


# --- properties -----------------------------------------------------------------------------------------

moments = st.lists(st.tuples(st.integers(900, 2100), st.booleans()), max_size=12).map(sorted)


def latent_at(t, start_value, inside):
    return start_value + sum(ON if p else -OFF for time, p in inside if time <= t)


@given(moments, st.floats(-4.0, 1.0))
def test_the_mean_of_the_latent_image_is_the_frame(rows, log_frame):
    """B + I_0 = 1/T int exp L^D dt, integrated over the stretches between events, whatever lies outside."""
    integrals = integrate(pixel_events([t for t, _ in rows], [p for _, p in rows]))
    start = latent_start(np.full((1, 1), log_frame), integrals)[0, 0]
    inside = [(t, p) for t, p in rows if 1000 < t <= 2000]
    edges = sorted({1000, 2000, *(t for t, _ in inside)})
    mean = sum(np.exp(latent_at(a, start, inside)) * (b - a) for a, b in pairwise(edges))
    np.testing.assert_allclose(mean / 1000, np.exp(log_frame), rtol=5e-6)
    assert integrals.events == len(inside)


@given(moments)
def test_middle_end_and_peak_follow_from_the_start(rows):
    integrals = integrate(pixel_events([t for t, _ in rows], [p for _, p in rows]))
    inside = [(t, p) for t, p in rows if 1000 < t <= 2000]
    frame = np.zeros((1, 1))
    start = latent_start(frame, integrals)[0, 0]
    levels = [start, *(start + np.cumsum([ON if p else -OFF for _, p in inside]))]
    np.testing.assert_allclose(latent_middle(frame, integrals), latent_at(1500, start, inside), atol=2e-6)
    np.testing.assert_allclose(latent_end(frame, integrals), latent_at(2000, start, inside), atol=2e-6)
    np.testing.assert_allclose(latent_peak(frame, integrals), max(levels), atol=2e-6)


@given(moments)
def test_events_outside_the_exposure_change_nothing(rows):
    everything = pixel_events([t for t, _ in rows], [p for _, p in rows])
    inside = [(t, p) for t, p in rows if 1000 < t <= 2000]
    only = pixel_events([t for t, _ in inside], [p for _, p in inside])
    for a, b in zip(integrate(everything), integrate(only), strict=True):
        np.testing.assert_array_equal(a, b)


@given(moments, st.integers(-(10**9), 4 * 10**15))
def test_the_origin_of_time_does_not_matter(rows, shift):
    array = pixel_events([t for t, _ in rows], [p for _, p in rows])
    moved = array.copy()
    moved["t"] += 2 * (shift // 2)
    for a, b in zip(
        integrate(array),
        integrate(moved, 1000 + 2 * (shift // 2), 2000 + 2 * (shift // 2)),
        strict=True,
    ):
        np.testing.assert_array_equal(a, b)


# --- a blurred picture ----------------------------------------------------------------------------------


def gain_over_blur(picture, speed, center=None, size=(60, 80)):
    """PSNR (dB) of the blurred frame, and of the deblurred one, against the sharp truth at mid-exposure.

    Exposure 30 ms, threshold 0.15, over four frames, pixels that are unclipped in both.
    """
    scene = photograph_scene(picture, pan(speed), sensor_size=size, duration=170_000, center=center)
    sensor = SensorSettings(threshold_on=0.15, threshold_off=0.15, exposure=30_000)
    simulation = simulate(scene, sensor)
    blurred, sharp = [], []
    for frame in simulation.frames:
        truth, seen = scene.at(frame.middle), frame.normalised()
        integrals = integrate_exposure(
            simulation.events, frame.exposure_start, frame.exposure_end, *steps(size, 0.15, 0.15)
        )
        latent = np.exp(latent_middle(log_intensity(seen, 0.03), integrals)) - 0.03
        unclipped = (seen < 0.98) & (truth < 0.98)
        for image, out in ((seen, blurred), (latent, sharp)):
            out.append((image - truth)[unclipped] ** 2)
    return tuple(-10 * np.log10(np.concatenate(squares).mean()) for squares in (blurred, sharp))


def test_deblurring_gains_8_db_on_strong_blur():
    """Five pixels of motion within the exposure."""
    blurred, sharp = gain_over_blur(blocks(), 160.0)
    assert 30 < blurred < 35
    assert sharp - blurred >= 8


def test_deblurring_gains_8_db_on_a_photograph(shared_data):
    cv2 = pytest.importorskip("cv2")
    path = shared_data / "hdr" / "Oxford_Church.hdr"
    if not path.exists():
        pytest.skip("the photograph is not here")
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).mean(axis=2).astype(np.float64)
    blurred, sharp = gain_over_blur(2 * picture, 80.0, center=(350.0, 700.0))
    assert 30 < blurred < 35
    assert sharp - blurred >= 8


def test_only_blocks_with_an_event_are_looked_at():
    """What memory held before (`kalux.memory`) does not show, nor does where an event falls."""
    rng = np.random.default_rng(3)
    shape = (9, 50)  # blocks go on over the ends of rows
    thresholds = tuple(rng.uniform(0.5, 2.0, shape).astype(np.float32) for _ in range(2))
    for places in ([], [0], [63, 64, 449], rng.integers(0, 450, 200)):
        t = np.sort(rng.integers(1001, 2000, len(places)))
        row, column = np.divmod(np.asarray(places, np.int64), shape[1])
        array = make_events(t, column, row, rng.integers(0, 2, len(places)))
        array = EventClock(shape, 0).weighed(array)
        exposure = expose([array], 1000, 2000, thresholds, (ON, OFF), weighed=True)
        np.testing.assert_array_equal(
            np.flatnonzero(exposure.touched), np.unique(np.asarray(places, int) // EXPOSED)
        )
        level, variance = latent_frame(
            np.zeros(shape, np.uint8),
            np.array([-1.0]),
            np.array([0.01]),
            exposure,
            duration=1000,
            deblur_variance=0.1,
            threshold2=0.04,
        )[:2]
        steps = (ON * thresholds[0], OFF * thresholds[1])
        whole = integrate_exposure(array, 1000, 2000, *steps)
        np.testing.assert_allclose(level, -1.0 - whole.log_mean + whole.to_middle, atol=1e-6)
        error = 0.1 * 0.04 * (1 + whole.events / 12 + whole.events**2 / 20)
        wrong = error / (error + 0.01 * 0.04 * whole.events**2)
        moved = whole.to_middle - whole.log_mean
        np.testing.assert_allclose(variance, 0.01 + (wrong * moved) ** 2 + (1 - wrong) * error, rtol=2e-5)
