"""Exposures from the edges on a trigger input."""

from __future__ import annotations

import numpy as np
import pytest

from kalux.calibration.triggers import exposures, match
from kalux.errors import ExposureError, InputError
from kalux.readers import aedat4
from kalux.readers.source import TRIGGER_DTYPE


def edges(*rows):
    """(t, rising) or (t, rising, id)."""
    return [np.array([(t, *rest, r) if rest else (t, 0, r) for t, r, *rest in rows], TRIGGER_DTYPE)]


def train(starts, length=5, input_id=0):
    return edges(*(row for s in starts for row in ((s, True, input_id), (s + length, False, input_id))))


def jittered(count, seed=0):
    return np.cumsum(np.random.default_rng(seed).integers(30_000, 36_000, count))


def test_an_exposure_is_from_rising_to_falling():
    starts, ends, notes = exposures(train([10, 30, 50]))
    assert (starts.tolist(), ends.tolist(), notes) == ([10, 30, 50], [15, 35, 55], ())


def test_chunks_may_cut_an_exposure():
    (whole,) = train([10, 30, 50])
    parts = [whole[:1], whole[1:1], whole[1:4], whole[4:]]
    assert exposures(parts)[1].tolist() == [15, 35, 55]


def test_a_cut_first_and_last_exposure_is_told():
    starts, ends, notes = exposures(
        edges((5, False), *((t, r) for t, r in ((10, True), (15, False))), (20, True))
    )
    assert (starts.tolist(), ends.tolist()) == ([10], [15])
    assert "began before" in notes[0]
    assert "ends after" in notes[1]


@pytest.mark.parametrize(("edge", "expected"), [("rising", [10, 30]), ("falling", [15, 35])])
def test_one_edge_and_an_exposure(edge, expected):
    starts, ends, _ = exposures(train([10, 30]), edge=edge, exposure=7)
    assert starts.tolist() == expected
    assert (ends - starts).tolist() == [7, 7]


@pytest.mark.parametrize(
    ("chunks", "options", "told"),
    [
        ([], {}, "no edges on its trigger inputs"),
        (train([10]), {"input_id": 3}, r"no edges on input 3 .*\[0\]"),
        ([*train([10]), *train([20], input_id=1)], {}, "inputs 0, 1 have edges; say which"),
        (edges((1, True), (2, True)), {}, "all 2 edges are rising; say so"),
        (edges((1, False), (2, False)), {"edge": "rising", "exposure": 4}, "no rising edges"),
        (train([10]), {"edge": "rising"}, "exposure time is needed"),
        (train([10]), {"exposure": 4}, "with one edge only"),
        (edges((1, True), (2, False), (3, True), (4, True), (5, False)), {}, "at 4 us two edges of one kind"),
    ],
)
def test_what_gives_no_exposures(chunks, options, told):
    with pytest.raises(ExposureError, match=told):
        exposures(chunks, **options)


def test_equal_numbers_belong_together():
    starts = jittered(5)
    found = match(starts, starts + 9, None, 5)
    assert (found.first_frame, found.notes) == (0, ())
    np.testing.assert_array_equal(found.starts, starts)


@pytest.mark.parametrize("at", ["beginning", "end"])
@pytest.mark.parametrize("many", ["triggers", "frames"])
def test_a_missing_one_is_found_by_the_intervals(at, many):
    """The frames' clock is another, and drifts by 50 ppm."""
    whole = jittered(30)
    kept = slice(1, None) if at == "beginning" else slice(None, -1)
    starts = whole if many == "triggers" else whole[kept]
    stamps = (whole[kept] if many == "triggers" else whole) * 1.00005 + 12_345
    found = match(starts, starts + 9, stamps.astype(np.int64), len(stamps))
    assert len(found.starts) == 29
    np.testing.assert_array_equal(found.starts, whole[kept])
    assert found.first_frame == (1 if many == "frames" and at == "beginning" else 0)
    assert "1" in found.notes[0]
    assert f"{30 if many == 'triggers' else 29} trigger exposures" in found.notes[0]


def drifting(times):
    """The same in another clock."""
    return (times * 1.00005 + 12_345).astype(np.int64)


@pytest.mark.parametrize("many", [1, 2])
def test_equal_numbers_are_shifted_where_the_intervals_say_so(many):
    """Missing: triggers at the beginning and frames at the end, or the other way round."""
    whole = jittered(40)
    found = match(whole[many:], whole[many:] + 9, drifting(whole[:-many]), 40 - many)
    np.testing.assert_array_equal(found.starts, whole[many:-many])
    assert (found.first_frame, len(found.notes)) == (many, 1)
    found = match(whole[:-many], whole[:-many] + 9, drifting(whole[many:]), 40 - many)
    np.testing.assert_array_equal(found.starts, whole[many:-many])
    np.testing.assert_array_equal(found.ends, whole[many:-many] + 9)
    assert found.first_frame == 0
    assert f"the first {many} exposure" in found.notes[0]
    found = match(whole[:-many], whole[:-many] + 9, drifting(whole[many:]), 40 - many, skip_frames=0)
    assert (found.first_frame, len(found.starts), found.notes) == (0, 40 - many, ())


def test_frames_lost_within_are_told():
    """The first trigger and the twentieth frame are missing: each frame before has the exposure of the next."""
    whole = jittered(40)
    with pytest.raises(ExposureError, match=r"39 trigger.* before frame \d+ .* lost within the recording"):
        match(whole[1:], whole[1:] + 9, drifting(np.delete(whole, 20)), 39)


def test_intervals_that_agree_nowhere_are_told():
    found = match(jittered(40), jittered(40) + 9, jittered(40, seed=1), 40)
    assert (found.first_frame, len(found.starts)) == (0, 40)
    assert "are not those of the triggers" in found.notes[0]


@pytest.mark.parametrize("jitter", [0, 1, 500])
@pytest.mark.parametrize("count", [12, 40, 300])
def test_stamps_that_jitter_by_themselves_shift_nothing(count, jitter):
    """Nor do odd ones: a first frame that is late, and a clock that is set."""
    starts = np.arange(count) * 33_333
    for seed in range(20):
        stamps = starts + np.random.default_rng(seed).integers(-jitter, jitter + 1, count)
        stamps[0] -= 20_000
        stamps[count // 2 :] += 1_000_000 * (seed % 2)
        found = match(starts, starts + 9, stamps, count)
        assert (found.first_frame, len(found.starts), found.notes) == (0, count, ())


def test_even_intervals_do_not_tell():
    starts = np.arange(10) * 33_333
    for stamps in (None, np.arange(9) * 33_333):
        with pytest.raises(ExposureError, match=r"10 trigger exposures and 9 frames.*--skip-triggers"):
            match(starts, starts + 9, stamps, 9)
    found = match(starts, starts + 9, None, 9, skip_triggers=1)
    np.testing.assert_array_equal(found.starts, starts[1:])
    found = match(starts, starts + 9, None, 12, skip_frames=1)
    assert (found.first_frame, len(found.starts)) == (1, 10)


def test_more_than_two_missing_is_an_error():
    starts = jittered(10)
    with pytest.raises(ExposureError, match="10 trigger exposures and 7 frames"):
        match(starts, starts + 9, starts[:7], 7)
    with pytest.raises(InputError, match="negative"):
        match(starts, starts + 9, None, 10, skip_frames=-1)


@pytest.mark.parametrize("name", ["street", "newton", "bench"])
def test_a_davis_marks_its_own_exposures_as_triggers(shared_data, name):
    """Types 8 and 9 of a real DAVIS346's trigger stream, taken as edges of an input: the exposures of its frames."""
    path = shared_data / f"{name}_davis346.aedat4"
    with path.open("rb") as file:
        container = aedat4._open(path, file)
    (stream,) = (s for s in container.streams if s.kind == "TRIG")
    rows = [
        row for packet in container.read(stream, lambda t: list(aedat4.trigger_types(t))) for row in packet
    ]
    rows = sorted((t, kind) for t, kind in rows if kind in (8, 9))
    starts, ends, _ = exposures(edges(*((t, kind == 8) for t, kind in rows)))
    source = aedat4.read(path)
    frames = list(source.frames())
    known = {(f.exposure_start, f.exposure_end) for f in frames}
    shared = [pair in known for pair in zip(starts.tolist(), ends.tolist(), strict=True)]
    assert sum(shared) >= len(frames) - 1
    assert [edge for chunk in source.triggers() for edge in chunk] == []  # nothing was wired to it
