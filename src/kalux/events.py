"""The event array: one documented dtype, coercion from the layouts in use, and checks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from kalux.errors import EventError, InputError

EVENT_DTYPE: Final = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "?")], align=True)
"""Dtype of an event: ``t`` int64 microseconds, ``x`` column and ``y`` row (uint16, 0-based), ``p`` bool,
True where the pixel became brighter. 16 bytes, aligned."""

EventArray = NDArray[np.void]
"""A 1-D array of `EVENT_DTYPE`, sorted by ``t``."""

LATEST: Final = 10**18
"""us, 32 000 years: latest possible time, so that sums of times fit into an int64."""

NEVER: Final = -(1 << 60)
"""us: stands for the time of an event that has not happened. Times of recordings are never that early."""

LARGEST_SIDE: Final = 1 << 16
"""Most pixels of a sensor in either direction: coordinates have 16 bits."""

FIELD_NAMES: Final = {
    "t": ("t", "ts", "timestamp", "timestamps", "time", "times"),
    "x": ("x", "xs"),
    "y": ("y", "ys"),
    "p": ("p", "ps", "pol", "polarity", "polarities", "on"),
}
"""The names under which peers store each field, in small letters: tonic and Prophesee (t, x, y, p), dv-processing
(timestamp, x, y, polarity), Metavision CSV, event_stream, DSEC and IJRR tables."""

_LEAST_THRESHOLD: Final = 1e-12
_LARGEST_THRESHOLD: Final = 100.0

_TIME_UNITS: Final = {"us": 1.0, "s": 1e6, "ms": 1e3, "ns": 1e-3}
_UINT16_MAX: Final = np.iinfo(np.uint16).max

_COARSEST: Final = 1000.0
"""us: floating-point times that cannot tell less from each other are refused, such as seconds since 1970 in single
precision, which are 128 s apart. Frames are some 10 ms apart."""


def make_events(t: Any, x: Any, y: Any, p: Any) -> EventArray:
    """Join four columns into an event array.

    Parameters are 1-D and of equal length: ``t`` in microseconds (integer), ``x`` and ``y`` 0-based pixel
    coordinates, ``p`` polarity as bool, {0, 1} or {-1, +1}.

    Raises
    ------
    EventError
        If lengths differ, a coordinate is no whole number from 0 to 65535, times are not integers or beyond 10^18, or
        polarity has other values.
    """
    t, x, y, p = (np.asarray(column) for column in (t, x, y, p))
    _check_shapes(t, x, y, p)
    if t.dtype.kind not in "iu":
        raise EventError(
            f"events: times are {t.dtype}, not integer microseconds; convert them or name time_unit='s'"
        )
    _check_times(t)
    events = np.empty(t.shape, EVENT_DTYPE)
    events["t"] = t
    events["x"] = _coordinate("x", x)
    events["y"] = _coordinate("y", y)
    events["p"] = _polarity(p)
    return events


def as_events(data: Any, *, columns: str | None = None, time_unit: str | None = None) -> EventArray:
    """Accept any common event container and return it as an `EVENT_DTYPE` array.

    Parameters
    ----------
    data
        A structured array (tonic, Metavision, dv-processing), a dv-processing ``EventStore``, a pandas
        ``DataFrame``, a mapping of columns, or an (N, 4) array. Not copied when already 1-D and of `EVENT_DTYPE`.
        Coordinates and polarities may be floats that are whole numbers.
    columns
        For an (N, 4) array: the order of its columns, a permutation of ``"txyp"``.
    time_unit
        ``"s"``, ``"ms"``, ``"us"`` or ``"ns"``. Integer times are microseconds unless said otherwise; for
        floating-point times it must be given. ``timedelta64`` and ``datetime64`` have their own.

    Raises
    ------
    EventError
        If the layout is not recognised or a column has unusable values, such as times in single precision that are
        too large for it.
    """
    if isinstance(data, np.ndarray) and data.dtype == EVENT_DTYPE and time_unit in (None, "us"):
        return data if data.ndim == 1 else data.ravel()
    found = _columns(data, columns)
    _check_shapes(*(found[name] for name in ("t", "x", "y", "p")))
    t = found["t"]
    if time_unit is not None and time_unit not in _TIME_UNITS:
        raise EventError(f"events: unknown time_unit {time_unit!r}; known are {', '.join(_TIME_UNITS)}")
    if t.dtype.kind in "mM":
        t = t.astype(f"{t.dtype.kind}8[us]").astype(np.int64)
    elif t.dtype.kind == "f":
        if time_unit is None and len(t):
            raise EventError(
                "events: times are floating point, so their unit cannot be known; "
                "give time_unit='s' (or 'ms', 'us', 'ns')"
            )
        if not np.isfinite(t).all():
            index = int(np.flatnonzero(~np.isfinite(t))[0])
            raise EventError(f"events: time of event {index} is not finite")
        scale = _TIME_UNITS[time_unit or "us"]
        microseconds = np.rint(t.astype(np.float64) * scale)
        _check_times(microseconds)
        check_precision(t, scale)
        t = microseconds.astype(np.int64)
    elif t.dtype.kind in "iu" and time_unit not in (None, "us"):
        scale = _TIME_UNITS[time_unit]
        _check_times(t * scale)
        t = t.astype(np.int64) * int(scale) if scale >= 1 else t.astype(np.int64) // round(1 / scale)
    return make_events(t, found["x"], found["y"], found["p"])


def checked_size(sensor_size: tuple[int, int]) -> tuple[int, int]:
    """(height, width) as whole, positive numbers.

    Raises
    ------
    InputError
        If it is anything else.
    """
    try:
        height, width = sensor_size
        whole = (int(height), int(width))
        fine = whole == (height, width) and min(whole) > 0
    except (TypeError, ValueError):
        fine = False
    if not fine:
        raise InputError(f"sensor_size is {sensor_size}; (height, width) in pixels is needed")
    return whole


def checked_thresholds(threshold: Any) -> tuple[float, float] | None:
    """Contrast thresholds (on, off) of a number, or of two; None of None.

    Raises
    ------
    InputError
        If they are anything else, or not positive (1e-12 to 100, as in settings).
    """
    if threshold is None:
        return None
    try:
        on, off = (float(value) for value in np.broadcast_to(np.asarray(threshold, np.float64), 2))
        fine = all(_LEAST_THRESHOLD <= value <= _LARGEST_THRESHOLD for value in (on, off))
    except (TypeError, ValueError):
        fine = False
    if not fine:
        raise InputError(
            f"contrast threshold is {threshold!r}; it must be positive (log intensity, e.g. 0.2), or (on, off)"
        )
    return on, off


def check_events(
    events: EventArray,
    sensor_size: tuple[int, int],
    *,
    where: str = "events",
    first_index: int = 0,
    previous_t: int | None = None,
) -> None:
    """Check one chunk of a stream: sorted in time, at times that are possible, and inside the sensor.

    Parameters
    ----------
    events
        A chunk of `EVENT_DTYPE`.
    sensor_size
        (height, width) in pixels.
    where
        Named in the message, e.g. the file.
    first_index
        Index of the chunk's first event in the stream, for the message.
    previous_t
        Time of the event before the chunk, us.

    Raises
    ------
    EventError
        With the index of the first offending event.
    """
    if len(events) == 0:
        return
    t = events["t"]
    if previous_t is not None and t[0] < previous_t:
        raise EventError(
            f"{where}: event {first_index} at {t[0]} us comes after one at {previous_t} us; "
            "sort the events by time"
        )
    _check_times(t, where, first_index)
    backwards = t[1:] < t[:-1]
    if backwards.any():
        i = int(np.argmax(backwards)) + 1
        raise EventError(
            f"{where}: event {first_index + i} at {t[i]} us comes after one at {t[i - 1]} us; "
            "sort the events by time"
        )
    height, width = sensor_size
    if int(events["x"].max()) >= width or int(events["y"].max()) >= height:
        i = int(np.argmax((events["x"] >= width) | (events["y"] >= height)))
        raise EventError(
            f"{where}: event {first_index + i} at x={events['x'][i]}, y={events['y'][i]} is outside the sensor "
            f"of {width}x{height} pixels (x and y are 0-based)"
        )


def _columns(data: Any, order: str | None) -> dict[str, NDArray[Any]]:
    """Find the four columns of any supported container."""
    if hasattr(data, "numpy") and not isinstance(data, np.ndarray):
        data = data.numpy()  # dv-processing EventStore
    if isinstance(data, np.ndarray):
        if data.dtype.names is not None:
            return _named(data.ravel(), list(data.dtype.names))
        if data.ndim == 2 and data.shape[1] == 4:
            if order is None or sorted(order) != sorted("txyp"):
                raise EventError(
                    "events: an (N, 4) array needs the order of its columns, e.g. columns='txyp' or 'xytp'; "
                    f"got {order!r}"
                )
            return {name: data[:, order.index(name)] for name in "txyp"}
        raise EventError(
            f"events: cannot read an array of shape {data.shape} and dtype {data.dtype}; "
            "expected a structured array with t, x, y, p or an (N, 4) array"
        )
    if isinstance(data, Mapping):
        return _named(data, list(data))
    if hasattr(data, "columns"):  # a pandas DataFrame
        return _named(data, [str(name) for name in data.columns])
    raise EventError(
        f"events: cannot read a {type(data).__name__}; expected an array, a mapping or a table with t, x, y, p"
    )


def _named(data: Any, names: list[str]) -> dict[str, NDArray[Any]]:
    lower = {name.lower(): name for name in names}
    found = {}
    for field, aliases in FIELD_NAMES.items():
        match = next((lower[alias] for alias in aliases if alias in lower), None)
        if match is None:
            raise EventError(
                f"events: no column for {field!r} among {', '.join(names) or 'no columns'}; "
                f"one of {', '.join(aliases)} is needed"
            )
        found[field] = np.asarray(data[match])
    return found


def _check_shapes(t: NDArray[Any], x: NDArray[Any], y: NDArray[Any], p: NDArray[Any]) -> None:
    if t.ndim != 1 or not t.shape == x.shape == y.shape == p.shape:
        raise EventError(
            f"events: columns t, x, y, p have shapes {t.shape}, {x.shape}, {y.shape}, {p.shape}; "
            "they must be 1-D and equally long"
        )


def _check_times(t: NDArray[Any], where: str = "events", first_index: int = 0) -> None:
    """Refuse times, us, beyond 10^18, to which nothing can be added in an int64."""
    if len(t) and (t.min() < -LATEST or t.max() > LATEST):
        i = int(np.flatnonzero((t < -LATEST) | (t > LATEST))[0])
        raise EventError(
            f"{where}: event {first_index + i} is at {t[i]} us; at most 10^18 us is possible; if these are ns, say so: "
            "in arrays time_unit='ns', in files by a column t_ns"
        )


def check_precision(t: NDArray[np.floating[Any]], scale: float) -> None:
    """Refuse floating-point times, in units of ``scale`` us, that are too large for what their dtype can tell apart.

    Raises
    ------
    EventError
        If the largest one and the next that there is are more than 1 ms apart.
    """
    latest = np.abs(t).max(initial=0.0)
    apart = float(np.spacing(latest)) * scale
    if apart > _COARSEST:
        raise EventError(
            f"events: times are {t.dtype}, of which two that differ are {apart / 1e6:.3g} s apart at {latest:.10g}; "
            "store them as float64 or as integer microseconds"
        )


def _require_whole(name: str, values: NDArray[Any]) -> None:
    """Refuse floats that are no whole numbers."""
    whole = np.isfinite(values) & (np.rint(values) == values)
    if not whole.all():
        index = int(np.flatnonzero(~whole)[0])
        raise EventError(f"events: {name} of event {index} is {values[index]}, not a whole number")


def _coordinate(name: str, values: NDArray[Any]) -> NDArray[Any]:
    if values.dtype.kind not in "iuf":
        raise EventError(f"events: {name} is {values.dtype}, not an integer pixel coordinate")
    if values.dtype.kind == "f":
        _require_whole(name, values)
    if values.dtype != np.uint16 and len(values) and (values.min() < 0 or values.max() > _UINT16_MAX):
        index = int(np.flatnonzero((values < 0) | (values > _UINT16_MAX))[0])
        raise EventError(
            f"events: {name} of event {index} is {values[index]}; 0 to {_UINT16_MAX} is possible"
        )
    return values


def _polarity(values: NDArray[Any]) -> NDArray[np.bool_]:
    if values.dtype == np.bool_:
        return values
    if values.dtype.kind not in "iuf":
        raise EventError(f"events: polarity is {values.dtype}; bool, 0/1 or -1/+1 is needed")
    if values.dtype.kind == "f":
        _require_whole("polarity", values)
    if len(values) and (values.min() < -1 or values.max() > 1):
        index = int(np.flatnonzero((values < -1) | (values > 1))[0])
        raise EventError(
            f"events: polarity of event {index} is {values[index]}; bool, 0/1 or -1/+1 is needed"
        )
    return values > 0
