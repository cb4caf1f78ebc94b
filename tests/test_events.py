"""Events from every layout in use, and the checks on them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kalux.errors import EventError
from kalux.events import EVENT_DTYPE, as_events, check_events, make_events

rows = st.lists(
    st.tuples(
        st.integers(0, 2**53), st.integers(0, 65535), st.integers(0, 65535), st.booleans()
    ),
    max_size=30,
)  # fmt: skip


def columns(values):
    arrays = zip(*values, strict=True) if values else ([], [], [], [])
    return [np.array(list(column), np.int64) for column in arrays]


def structured(t, x, y, p, names="txyp", dtypes=("i8", "u2", "u2", "?")):
    out = np.empty(len(t), list(zip(names, dtypes, strict=True)))
    for name, column in zip(names, (t, x, y, p), strict=True):
        out[name] = column
    return out


def test_the_dtype_is_documented():
    assert EVENT_DTYPE.itemsize == 16
    assert EVENT_DTYPE.names == ("t", "x", "y", "p")


@given(rows)
def test_every_layout_gives_the_same_events(values):
    t, x, y, p = columns(values)
    expected = make_events(t, x, y, p)
    assert expected.tolist() == [(a, b, c, d) for a, b, c, d in values]
    sign = 2 * p - 1
    dv_names = ("timestamp", "x", "y", "polarity")
    layouts = [
        structured(t, x, y, p, dtypes=("i8", "i2", "i2", "?")) if max([*x, *y, 0]) < 2**15 else expected,
        structured(t, x, y, p, dv_names),
        structured(x, y, p, t, ("x", "y", "p", "t"), ("u2", "u2", "i2", "i8")),  # Metavision
        {"ts": t, "x": x, "y": y, "pol": sign},
        {"T": t, "X": x, "Y": y, "On": p.astype(bool)},
        SimpleNamespace(numpy=lambda: structured(t, x, y, p, dv_names)),  # an EventStore
    ]
    for layout in layouts:
        assert np.array_equal(as_events(layout), expected)
    table = np.column_stack([x, y, t, sign])
    assert np.array_equal(as_events(table, columns="xytp"), expected)
    as_float = table.astype(np.float64)
    assert np.array_equal(as_events(as_float, columns="xytp", time_unit="us"), expected)


def test_a_data_frame():
    class DataFrame(dict):
        @property
        def columns(self):
            return list(self)

    expected = make_events(*columns([(1, 2, 3, True)]))
    assert np.array_equal(as_events(DataFrame(timestamp=[1], x=[2], y=[3], polarity=[1])), expected)
    floats = DataFrame(timestamp=[1e-6], x=[2.0], y=[3.0], polarity=[1.0])
    assert np.array_equal(as_events(floats, time_unit="s"), expected)


def test_events_of_the_dtype_are_not_copied():
    events = make_events(*columns([(1, 2, 3, True)]))
    assert as_events(events) is events


def test_arrays_of_other_shapes_and_orders_of_bytes():
    events = make_events(*columns([(10, 2, 3, True), (20, 4, 5, False), (30, 6, 7, True)]))
    assert np.array_equal(as_events(events.reshape(1, 3)), events)
    assert np.array_equal(
        as_events(structured(*columns(events.tolist()), dtypes=(">i8", ">u2", ">u2", "?"))), events
    )
    assert len(as_events({"t": [], "x": [], "y": [], "p": []})) == 0


@pytest.mark.parametrize("t", [np.array([1, 2], "m8[ms]"), np.array([1_000_000, 2_000_999], "M8[ns]")])
def test_times_that_have_a_unit_of_their_own(t):
    found = as_events({"t": t, "x": [0, 1], "y": [0, 1], "p": [0, 1]})
    assert found["t"].tolist() == [1000, 2000]


def test_seconds_in_single_precision_are_multiplied_in_double():
    t = np.array([1000.0001], np.float32)
    found = as_events({"t": t, "x": [0], "y": [0], "p": [0]}, time_unit="s")
    assert found["t"].tolist() == [round(float(t[0]) * 1e6)]


@pytest.mark.parametrize(
    ("t", "unit"),
    [
        (np.array([0, -(2**63)]), None),
        (np.array([0, 2**63 + 5], np.uint64), None),
        (np.array([0, 10**15]), "s"),
        (np.array([0, 1e300]), "s"),
        (np.array([0, "NaT"], "m8[us]"), None),
    ],
)
def test_times_that_nothing_could_be_added_to_are_refused(t, unit):
    with pytest.raises(
        EventError,
        match=r"events: event 1 is at .* us; at most 10\^18 us is possible; if these are ns, .*t_ns",
    ):
        as_events({"t": t, "x": [0, 1], "y": [0, 1], "p": [0, 1]}, time_unit=unit)


@pytest.mark.parametrize(
    ("t", "unit", "expected"),
    [
        ([0.5, 1.0000004], "s", [500_000, 1_000_000]),
        ([0.5, 1.25], "ms", [500, 1250]),
        ([1_500, 2_400], "ns", [1, 2]),
        ([1, 2], "s", [1_000_000, 2_000_000]),
        ([1, 2], None, [1, 2]),
    ],
)
def test_units_of_time(t, unit, expected):
    data = {"t": np.array(t), "x": [0, 1], "y": [0, 1], "p": [0, 1]}
    assert as_events(data, time_unit=unit)["t"].tolist() == expected


def test_floating_point_times_too_large_for_their_precision_are_refused():
    """Seconds since 1970 in single precision are 128 s apart: what order and distance events have is lost."""
    fields = {"x": [0], "y": [0], "p": [0]}
    with pytest.raises(EventError, match="float32, of which two that differ are 128 s apart"):
        as_events(fields | {"t": np.array([1.6e9], np.float32)}, time_unit="s")
    assert as_events(fields | {"t": np.array([1.6e9])}, time_unit="s")["t"] == 1_600_000_000_000_000
    assert as_events(fields | {"t": np.array([4000], np.float32)}, time_unit="s")["t"] == 4_000_000_000


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"t": [1]}, "equally long"),
        ({"t": [0.1, 0.2]}, "time_unit='s'"),
        ({"x": [-1, 0]}, "x of event 0 is -1"),
        ({"y": [0, 70_000]}, "y of event 1 is 70000"),
        ({"x": [0.5, 1.0]}, "x of event 0 is 0.5, not a whole number"),
        ({"x": [0.0, np.inf]}, "x of event 1 is inf, not a whole number"),
        ({"y": ["0", "1"]}, "not an integer"),
        ({"p": [0, 2]}, "polarity of event 1 is 2"),
        ({"p": [0.0, 0.5]}, "polarity of event 1 is 0.5, not a whole number"),
        ({"p": ["on", "off"]}, "polarity is <U3"),
    ],
)
def test_unusable_columns_are_refused(changes, message):
    data = {"t": [1, 2], "x": [0, 1], "y": [0, 1], "p": [0, 1]} | changes
    with pytest.raises(EventError, match=message):
        as_events({name: np.array(column) for name, column in data.items()})


@pytest.mark.parametrize(
    ("data", "options", "message"),
    [
        ({"t": [1], "x": [1], "y": [1]}, {}, "no column for 'p'"),
        ({"t": [1.0], "x": [1], "y": [1], "p": [1]}, {"time_unit": "min"}, "unknown time_unit"),
        ({"t": [np.inf], "x": [1], "y": [1], "p": [1]}, {"time_unit": "s"}, "time of event 0 is not finite"),
        ({"t": ["1"], "x": [1], "y": [1], "p": [1]}, {"time_unit": "ns"}, "times are <U1, not integer"),
        ({"t": [1j], "x": [1], "y": [1], "p": [1]}, {"time_unit": "ns"}, "times are complex128, not integer"),
        (np.zeros((3, 4), int), {}, "order of its columns"),
        (np.zeros((3, 5), int), {"columns": "txyp"}, "cannot read an array of shape"),
        (np.array([[1, 0.5, 1, 1]]), {"columns": "txyp", "time_unit": "us"}, "x of event 0 is 0.5"),
        ("events", {}, "cannot read a str"),
    ],
)
def test_unknown_layouts_are_refused(data, options, message):
    if isinstance(data, dict):
        data = {name: np.array(column) for name, column in data.items()}
    with pytest.raises(EventError, match=message):
        as_events(data, **options)


@pytest.mark.parametrize(
    ("values", "previous_t", "message"),
    [
        ([(5, 0, 0, True), (4, 0, 0, True)], None, r"event 11 at 4 us comes after one at 5 us"),
        ([(5, 0, 0, True)], 6, r"event 10 at 5 us comes after one at 6 us"),
        ([(2 * 10**18, 0, 0, True)], None, r"event 10 is at 2000000000000000000 us; at most 10\^18"),
        ([(5, 4, 0, True)], None, r"event 10 at x=4, y=0 is outside the sensor of 4x3"),
        ([(5, 0, 0, True), (5, 0, 3, True)], None, r"event 11 at x=0, y=3 is outside"),
    ],
)
def test_checks_name_the_event(values, previous_t, message):
    events = np.array(values, EVENT_DTYPE)
    with pytest.raises(EventError, match="here: " + message):
        check_events(events, (3, 4), where="here", first_index=10, previous_t=previous_t)


def test_good_events_pass():
    check_events(make_events(*columns([(5, 3, 2, True), (5, 0, 0, False)])), (3, 4), previous_t=5)
    check_events(make_events(*columns([])), (3, 4), previous_t=5)


@pytest.mark.parametrize("unit", ["s", "us", None])
def test_single_numbers_are_no_columns(unit):
    with pytest.raises(EventError, match="1-D"):
        as_events({"t": 5.0, "x": 1, "y": 1, "p": 1}, time_unit=unit)
