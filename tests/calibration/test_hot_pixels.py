"""Event pixels that fire alone, always, and with one sign."""

from __future__ import annotations

import numpy as np
import pytest

from kalux import EVENT_DTYPE, Recording
from kalux.calibration.hot_pixels import find_hot_pixels

SIZE = (12, 16)
SECOND = 1_000_000
ALL = 1 << 30


def fires(x, y, rate, p=True, until=SECOND):
    """Events of one pixel at a constant rate, Hz."""
    made = np.zeros(int(rate * until * 1e-6), EVENT_DTYPE)
    made["t"] = (np.arange(len(made)) * 1e6 / rate).astype(np.int64)
    made["x"], made["y"], made["p"] = x, y, p
    return made


def passing_edge(period=100_000):
    """An edge that sweeps over all pixels, one event each, again and again."""
    height, width = SIZE
    y, x = np.mgrid[:height, :width]
    sweeps = []
    for start in range(0, SECOND, period):
        made = np.zeros(height * width, EVENT_DTYPE)
        made["t"] = start + x.ravel() * 2_000 + y.ravel()
        made["x"], made["y"], made["p"] = x.ravel(), y.ravel(), start // period % 2
        sweeps.append(made)
    return np.concatenate(sweeps)


def found(*parts, most_events=ALL):
    events = np.concatenate([np.empty(0, EVENT_DTYPE), *parts])
    events = events[np.argsort(events["t"], kind="stable")]
    hot = find_hot_pixels(Recording.from_arrays(events, [], sensor_size=SIZE), most_events)
    assert hot.shape == SIZE
    return [(int(x), int(y)) for y, x in zip(*np.nonzero(hot), strict=True)]


@pytest.mark.parametrize("p", [True, False])
def test_a_pixel_that_leaks_is_found_though_the_scene_moves(p):
    assert found(passing_edge(), fires(5, 7, 100, p)) == [(5, 7)]


@pytest.mark.parametrize("p", [True, False])
def test_it_is_found_where_its_neighbours_are_never_silent(p):
    """Fine texture that moves: an event of either sign in every bin, everywhere."""
    busy = [passing_edge(40_000)]
    for shift in (10_000, 20_000, 30_000):
        busy.append(passing_edge(40_000))
        busy[-1]["t"] += shift
        busy[-1]["p"] = ~busy[-1]["p"] if shift == 20_000 else busy[-1]["p"]
    assert found(*busy) == []
    assert found(*busy, fires(5, 7, 200, p), fires(6, 7, 200, p)) == [(5, 7), (6, 7)]


def test_two_side_by_side_do_not_hide_one_another():
    assert found(passing_edge(), fires(5, 7, 100), fires(6, 7, 200)) == [(5, 7), (6, 7)]


def test_between_textures_short_bins_find_it():
    """Edges every 15 ms, so that there is no bin of 20 ms in which it is alone."""
    assert found(passing_edge(15_000), fires(5, 7, 500)) == [(5, 7)]


def test_at_the_border_of_the_sensor():
    assert found(fires(0, 0, 100), fires(15, 11, 100)) == [(0, 0), (15, 11)]


@pytest.mark.parametrize(
    "parts",
    [
        (),
        (passing_edge(),),
        (passing_edge(), fires(5, 7, 20)),  # too slow to matter
        (fires(5, 7, 200, until=SECOND // 2), fires(5, 7, 200, p=False)[100:]),  # up and down again
        (fires(5, 7, 100), fires(5, 7, 100, p=False)),  # a lamp that flickers
        (fires(5, 7, 100), fires(6, 7, 100), fires(6, 8, 100)),  # light that has an extent
        (passing_edge(), fires(5, 7, 100, until=SECOND // 3)),  # for a while only
    ],
    ids=["nothing", "an edge", "slow", "up and down", "both signs", "a patch", "for a while"],
)
def test_what_light_can_do_is_not_hot(parts):
    assert found(*parts) == []


def test_what_is_not_looked_at_or_too_short_tells_nothing():
    leaking = fires(5, 7, 100)
    assert found(leaking, most_events=15) == []  # 0.14 s, seven of the longest bins
    assert found(leaking[:15]) == []
    assert found(leaking[:17]) == found(leaking, most_events=17) == [(5, 7)]


def test_the_cut_into_chunks_changes_nothing(monkeypatch):
    whole = found(passing_edge(), fires(5, 7, 100))
    monkeypatch.setattr("kalux.recording.CHUNK_EVENTS", 17)
    assert found(passing_edge(), fires(5, 7, 100)) == whole == [(5, 7)]
