"""The shortest time between events of a pixel, and the refractory periods that it allows."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kalux.calibration.refractory import (
    counted_period,
    dead_time,
    intervals,
    possible_periods,
    shortest_interval,
)
from kalux.datasets import SensorSettings, demo_scene, simulate
from kalux.events import make_events
from kalux.recording import Recording

from builders import dark_scene

SIZE = (5, 6)


def test_the_shortest_interval_is_not_that_of_noise():
    """Noise follows an event at any time; with a refractory period of 400 us others do not follow before."""
    sensor = SensorSettings(refractory=400.0, noise_rate=3.0)
    recording = simulate(demo_scene(sensor_size=(90, 120), duration=600_000), sensor).recording()
    assert 400 <= shortest_interval(recording) < 900
    assert shortest_interval(recording, most_events=20_000) >= 400


def trains(*, soonest, noise, seed=0, pixels=400, seconds=2.0):
    """Events of edges that follow one another ever sooner, from ``soonest`` us on, and ``noise`` at any time, Hz.

    One edge passes a pixel at a time: of two at once, events would follow sooner than those of either.
    """
    rng = np.random.default_rng(seed)
    events = []
    for pixel in range(pixels):
        gaps = soonest * (1 + 3 * np.sqrt(rng.random((20, 8))))
        begins = ((np.arange(20) + rng.uniform(0, 0.2, 20)) * 1e6 * seconds / 20)[:, None]
        t = (begins + np.cumsum(gaps, axis=1)).ravel()
        p = np.repeat(rng.random(20) < 0.5, 8)
        more = rng.uniform(0, 1e6 * seconds, rng.poisson(noise * seconds))
        t, p = np.append(t, more), np.append(p, rng.random(len(more)) < 0.5)
        events.append(np.stack([t, np.full(len(t), pixel), p]))
    t, pixel, p = np.concatenate(events, axis=1)
    order = np.argsort(t, kind="stable")
    x, y = (pixel[order] % 20).astype(int), (pixel[order] // 20).astype(int)
    made = make_events(t[order].astype(np.int64), x, y, p[order] > 0)
    return Recording.from_arrays(made, [], sensor_size=(20, pixels // 20))


@given(
    soonest=st.sampled_from([300, 1_000, 2_500]),
    noise=st.sampled_from([0.0, 1.0, 20.0]),
    seed=st.integers(0, 99),
)
@settings(max_examples=15, deadline=None)
def test_the_shortest_interval_of_light_is_told_from_noise(soonest, noise, seed):
    """Noise is as often of one polarity as of both, light of one."""
    found = intervals(trains(soonest=soonest, noise=noise, seed=seed))
    assert soonest <= found.of_light < 1.6 * soonest
    assert found.longest_period == int(0.93 * found.of_light)


@given(seed=st.integers(0, 999))
@settings(max_examples=10, deadline=None)
def test_noise_alone_has_no_shortest_interval_of_light(seed):
    rng = np.random.default_rng(seed)
    t = np.sort(rng.integers(0, 1_000_000, 60_000))
    x, y = rng.integers(0, 20, (2, len(t)))
    noise = make_events(t, x, y, rng.random(len(t)) < 0.5)
    assert intervals(Recording.from_arrays(noise, [], sensor_size=(20, 20))).of_light == 0


def test_times_may_be_negative():
    """Of a clock that is set to zero later, as that of the frames may be."""
    t, pixel = np.arange(0, 400_000, 500), np.arange(800) % 4
    made = [make_events(t - shift, pixel, pixel, pixel % 2 == 0) for shift in (0, 10**9)]
    found = [shortest_interval(Recording.from_arrays(events, [], sensor_size=SIZE)) for events in made]
    assert found[0] == found[1] > 0


def alternating(gaps):
    """Events of 100 pixels that follow one another after these times, us."""
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.permuted(np.tile(gaps, (100, 1)), axis=1), axis=1)
    pixel = np.broadcast_to(np.arange(100)[:, None], t.shape).ravel()
    order = np.argsort(t.ravel(), kind="stable")
    events = make_events(t.ravel()[order], pixel[order] % 10, pixel[order] // 10, np.ones(t.size, bool))
    return Recording.from_arrays(events, [], sensor_size=(10, 10))


SMOOTH = np.arange(500, 4_000, 7)


@pytest.mark.parametrize(
    ("gaps", "pile_up"),
    [
        (SMOOTH, False),
        (np.concatenate([SMOOTH, np.full(100, 503)]), True),
        (np.concatenate([SMOOTH, np.full(100, 900)]), False),
        (np.arange(1, 9).repeat(60) * 500, False),
    ],
    ids=["after a reset", "waiting", "flicker", "coarse times"],
)
def test_events_that_wait_pile_up_at_the_shortest_interval(gaps, pile_up):
    found = intervals(alternating(gaps))
    assert found.pile_up == pile_up
    assert 390 <= found.shortest <= 510


def test_events_that_nothing_follows_have_no_shortest_interval():
    lonely = make_events(np.arange(5), np.arange(5), np.zeros(5, int), np.ones(5, bool))
    assert shortest_interval(Recording.from_arrays(lonely, [], sensor_size=SIZE)) == 0


def test_no_period_is_longer_than_the_shortest_interval_may_be():
    """Which is the lower edge of a bin that ends a quarter higher."""
    assert possible_periods(1_000) == (0, 350, 600, 850, 1_100)
    assert possible_periods(1) == (0, 1)
    assert possible_periods(0) == (0,)


def simulated(**sensor):
    settings = SensorSettings(noise_rate=20.0, noise_resets=True, **sensor)
    return simulate(demo_scene(sensor_size=(60, 80), duration=600_000), settings).recording()


def random_intervals(draw):
    """Of 100 pixels 2000 intervals each, drawn by a function of a random generator and their number; noise."""
    rng = np.random.default_rng(1)
    t = np.cumsum(draw(rng, (100, 2_000)), axis=1).astype(np.int64)
    pixel = np.broadcast_to(np.arange(100)[:, None], t.shape).ravel()
    order = np.argsort(t.ravel(), kind="stable")
    events = make_events(t.ravel()[order], pixel[order] % 10, pixel[order] // 10, rng.random(t.size) < 0.5)
    return Recording.from_arrays(events, [], sensor_size=(10, 10))


@pytest.mark.parametrize("refractory", [250, 1_000])
def test_noise_shows_how_long_pixels_are_blind(refractory):
    assert dead_time(simulated(refractory=float(refractory))) == pytest.approx(refractory, rel=0.03)


@pytest.mark.parametrize("most_events", [50, 7_000])
def test_how_long_pixels_are_blind_does_not_depend_on_chunks(most_events):
    recording = random_intervals(lambda rng, shape: 700 + rng.exponential(20_000, shape))
    events = np.concatenate(list(recording.events()))
    parts = [events[i : i + most_events] for i in range(0, len(events), most_events)]
    cut = SimpleNamespace(sensor_size=recording.sensor_size, events=lambda: iter(parts))
    assert dead_time(cut) == dead_time(recording) == pytest.approx(700, rel=0.02)


@pytest.mark.parametrize(
    "draw",
    [
        lambda rng, shape: rng.exponential(5_000, shape),
        lambda rng, shape: 4_000 * rng.beta(8, 2, shape),
        lambda rng, shape: 500 * rng.integers(1, 40, shape),
        lambda rng, shape: np.maximum(500, rng.exponential(700, shape)),
    ],
    ids=["noise at any time", "the light's pace", "coarse times", "events that wait"],
)
def test_other_shortest_intervals_are_no_blindness(draw):
    assert dead_time(random_intervals(draw)) == 0


def test_edges_that_are_all_alike_are_no_noise():
    """Of one speed and contrast: their intervals are, too, and of one polarity."""
    recording = random_intervals(lambda rng, shape: 800 + rng.exponential(5_000, shape))
    events = np.concatenate(list(recording.events()))
    alike = events.copy()
    alike["p"] = True
    assert dead_time(recording) == pytest.approx(800, rel=0.02)
    assert dead_time(Recording.from_arrays(alike, [], sensor_size=(10, 10))) == 0


def test_a_dozen_intervals_of_noise_are_enough():
    """Of 800 us, with some fifteen intervals within a tenth behind it."""
    recording = random_intervals(lambda rng, shape: 800 + rng.exponential(60_000, shape))
    events = np.concatenate(list(recording.events()))
    few = Recording.from_arrays(events[: len(events) // 18], [], sensor_size=(10, 10))
    assert dead_time(few) == pytest.approx(800, rel=0.05)


def noise_beside_light(rng, noise, light, share):
    """Of 100 pixels 2000 intervals each: a ``share`` is of ``noise``, of either polarity, others of ``light``."""
    shape = 100, 2_000
    of_noise = rng.random(shape) < share
    gaps = np.where(of_noise, noise(shape), light(shape))
    on = np.cumsum(of_noise & (rng.random(shape) < 0.5), axis=1) % 2 == 0
    t = np.cumsum(gaps, axis=1).astype(np.int64).ravel()
    pixel, order = np.repeat(np.arange(100), 2_000), np.argsort(t, kind="stable")
    events = make_events(t[order], pixel[order] % 10, pixel[order] // 10, on.ravel()[order])
    return Recording.from_arrays(events, [], sensor_size=(10, 10))


def test_light_that_sets_in_soon_after_hides_no_noise():
    """Edges that are fast: of twenty intervals one is of noise, the others begin by degrees behind the same time."""
    rng = np.random.default_rng(2)
    recording = noise_beside_light(
        rng,
        lambda shape: 600 + rng.exponential(5_000, shape),
        lambda shape: 600 + 1_000 * rng.beta(3, 2, shape),
        share=0.05,
    )
    assert dead_time(recording) == pytest.approx(600, rel=0.03)


def test_light_that_turns_within_a_dead_time_hides_no_noise():
    """Texture that passes fast: from a quarter of the dead time behind it on, most that turns is the light's."""
    rng = np.random.default_rng(4)
    recording = noise_beside_light(
        rng,
        lambda shape: np.where(
            rng.random(shape) < 0.5, 600 + rng.exponential(20_000, shape), 760 + rng.gamma(4, 200, shape)
        ),
        lambda shape: 800 + 1_000 * rng.beta(3, 2, shape),
        share=0.5,
    )
    assert dead_time(recording) == pytest.approx(600, rel=0.03)


def test_light_without_noise_is_none():
    """Its intervals set in by degrees, and those few that turn may do so at once, later than any refractory period."""
    sensor = SensorSettings(exposure=2_000, log_offset=0.004, refractory=2_000.0, noise_rate=0.0)
    assert dead_time(simulate(dark_scene(), sensor, seed=1).recording()) == 0


def test_little_noise_is_looked_at_farther_behind():
    """Some fifteen intervals that turn up to twice the dead time, and as many up to three times."""
    recording = random_intervals(lambda rng, shape: 500 + rng.exponential(40_000, shape))
    events = np.concatenate(list(recording.events()))
    few = Recording.from_arrays(events[: len(events) // 90], [], sensor_size=(10, 10))
    assert dead_time(few) == pytest.approx(500, rel=0.1)


def test_the_first_intervals_of_noise_may_happen_not_to_turn():
    recording = random_intervals(lambda rng, shape: 500 + rng.exponential(20_000, shape))
    events = np.concatenate(list(recording.events()))
    pixel = events["y"].astype(np.int64) * 10 + events["x"]
    for one in range(100):
        own = np.flatnonzero(pixel == one)
        for before, after in itertools.pairwise(own):
            if events["t"][after] - events["t"][before] < 516:
                events["p"][after] = events["p"][before]
    assert dead_time(Recording.from_arrays(events, [], sensor_size=(10, 10))) == pytest.approx(500, rel=0.02)


def test_lamps_are_no_noise():
    """Of 100 Hz and of little depth: pixels turn 3.2 to 6.8 ms after an event, of which the shortest set in at once."""

    def draw(rng, shape):
        to_off = rng.uniform(3_200, 6_800, (shape[0], 1))
        return np.where(np.arange(shape[1]) % 2, to_off, 10_000 - to_off) + rng.normal(0, 50, shape)

    assert dead_time(random_intervals(draw)) == 0


def test_what_is_hidden_is_counted_by_a_little_more_than_the_dead_time():
    assert (counted_period(0), counted_period(500)) == (0, 510)
