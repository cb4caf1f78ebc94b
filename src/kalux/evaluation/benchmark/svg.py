"""Line charts as inline SVG: drawn with classes that the page colours, told apart by dashes and markers as well."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape
from itertools import groupby
from typing import Final, NamedTuple

WIDTH: Final = 440
HEIGHT: Final = 260
_LEFT, _RIGHT, _TOP, _BOTTOM = 58, 12, 10, 40
_MARKERS: Final = 6  # along a line

STYLES: Final = 8
"""How many lines can be told apart; more begin again."""

_DASHES: Final = ("", "7 3", "2 3", "9 3 2 3", "5 2", "", "", "12 3")


class Axis(NamedTuple):
    """An axis of a chart.

    Attributes
    ----------
    label
        With the unit.
    log
        Whether it is logarithmic; what is not positive is then left out.
    limits
        Default: those of the data.
    """

    label: str
    log: bool = False
    limits: tuple[float, float] | None = None


class Series(NamedTuple):
    """A line.

    Attributes
    ----------
    label
        Its name.
    style
        Its number in the legend.
    points
        (x, y); where y is None the line is broken.
    """

    label: str
    style: int
    points: Sequence[tuple[float, float | None]]


def chart(title: str, x: Axis, y: Axis, series: Sequence[Series], *, diagonal: bool = False) -> str:
    """A line chart; ``diagonal`` adds the line y = x. Empty if there is nothing to draw."""
    drawn = [s._replace(points=[(a, _usable(a, b, x, y)) for a, b in s.points]) for s in series]
    known = [(a, b) for s in drawn for a, b in s.points if b is not None]
    if not known:
        return ""
    across = _Scale(x, [a for a, _ in known], _LEFT, WIDTH - _RIGHT)
    up = _Scale(y, [b for _, b in known], HEIGHT - _BOTTOM, _TOP)
    parts = [
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}">',
        f"<title>{escape(title)}</title>",
        *_grid(across, up),
    ]
    if diagonal:
        low = max(across.low, up.low)
        high = min(across.high, up.high)
        parts.append(
            f'<line class="diagonal" x1="{across(low):.1f}" y1="{up(low):.1f}" '
            f'x2="{across(high):.1f}" y2="{up(high):.1f}"/>'
        )
    for line in drawn:
        parts += _line(line, across, up)
    middle = (_LEFT + WIDTH - _RIGHT) / 2
    parts.append(f'<text class="name" x="{middle:.0f}" y="{HEIGHT - 6}">{escape(x.label)}</text>')
    centre = (_TOP + HEIGHT - _BOTTOM) / 2
    parts.append(
        f'<text class="name" transform="translate(13 {centre:.0f}) rotate(-90)">{escape(y.label)}</text></svg>'
    )
    return "".join(parts)


def sample(style: int) -> str:
    """The line and marker of a style, for a legend."""
    return (
        f'<svg class="sample" viewBox="0 0 34 12" aria-hidden="true">{_path("M1 6H33", style)}'
        f"{_marker(style, 17, 6)}</svg>"
    )


def _usable(a: float, b: float | None, x: Axis, y: Axis) -> float | None:
    if b is None or not math.isfinite(b) or (y.log and b <= 0) or (x.log and a <= 0):
        return None
    return b


class _Scale:
    """From values to positions."""

    def __init__(self, axis: Axis, values: Sequence[float], start: float, end: float) -> None:
        self.log = axis.log
        self.low, self.high = axis.limits or _padded(min(values), max(values), axis.log)
        self._start, self._end = start, end

    def __call__(self, value: float) -> float:
        low, high, v = self.low, self.high, min(max(value, self.low), self.high)
        if self.log:
            low, high, v = math.log(low), math.log(high), math.log(v)
        return self._start + (self._end - self._start) * (v - low) / (high - low)

    def ticks(self) -> list[float]:
        return _log_ticks(self.low, self.high) if self.log else _linear_ticks(self.low, self.high)


def _padded(low: float, high: float, log: bool) -> tuple[float, float]:
    if log:
        ratio = max(high / low, 1.5)
        return low / ratio**0.05, low * ratio**1.05
    width = (high - low) or abs(high) or 1.0
    return low - 0.04 * width, low + 1.04 * width


def _linear_ticks(low: float, high: float) -> list[float]:
    rough = (high - low) / 5
    power: float = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= rough * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [i * step for i in range(first, math.floor(high / step + 1e-9) + 1)]


def _log_ticks(low: float, high: float) -> list[float]:
    decades = math.log10(high / low)
    steps = (1, 2, 5) if decades < 2 else (1, 3) if decades < 3 else (1,)
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ticks = [m * 10.0**p for p in powers for m in steps]
    return [tick for tick in ticks if low <= tick <= high]


def _grid(across: _Scale, up: _Scale) -> Iterable[str]:
    bottom, right = HEIGHT - _BOTTOM, WIDTH - _RIGHT
    for tick in across.ticks():
        x = across(tick)
        yield f'<path class="grid" d="M{x:.1f} {_TOP}V{bottom}"/>'
        yield f'<text class="tick" x="{x:.1f}" y="{bottom + 14}">{_number(tick)}</text>'
    for tick in up.ticks():
        y = up(tick)
        yield f'<path class="grid" d="M{_LEFT} {y:.1f}H{right}"/>'
        yield f'<text class="tick left" x="{_LEFT - 5}" y="{y + 3.5:.1f}">{_number(tick)}</text>'
    yield f'<path class="frame" d="M{_LEFT} {_TOP}V{bottom}H{right}"/>'


def _number(value: float) -> str:
    return f"{value:.10g}" if value == 0 or 1e-4 <= abs(value) < 1e5 else f"{value:.0e}"


def _line(series: Series, across: _Scale, up: _Scale) -> Iterable[str]:
    for known, group in groupby(series.points, key=lambda point: point[1] is not None):
        if not known:
            continue
        places = [(across(a), up(b)) for a, b in group if b is not None]
        shape = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in places)
        yield _path(shape, series.style, series.label)
        step = max(1, round(len(places) / _MARKERS))
        # Each style begins elsewhere, so that markers of lines that coincide stand side by side.
        first = (series.style * step // 4) % step if len(places) > step else 0
        yield from (_marker(series.style, x, y) for x, y in places[first::step])


def _path(shape: str, style: int, label: str = "") -> str:
    dashes = _DASHES[style % STYLES]
    dashed = f' stroke-dasharray="{dashes}"' if dashes else ""
    title = f"<title>{escape(label)}</title>" if label else ""
    return f'<path class="line s{style % STYLES}" d="{shape}"{dashed}>{title}</path>'


def _marker(style: int, x: float, y: float) -> str:
    shape = (
        "M-3 0A3 3 0 1 0 3 0A3 3 0 1 0 -3 0Z",  # a disc
        "M-2.8 -2.8H2.8V2.8H-2.8Z",  # a square
        "M0 -3.5L3.4 2.6H-3.4Z",  # a triangle
        "M0 -4L3.4 0L0 4L-3.4 0Z",  # a diamond
        "M-3 -3L3 3M3 -3L-3 3",  # a cross
        "M0 -4.4L1.2 -1.4L4.2 -1.4L1.8 0.6L2.7 3.6L0 1.8L-2.7 3.6L-1.8 0.6L-4.2 -1.4L-1.2 -1.4Z",  # a star
        "M0 3.5L3.4 -2.6H-3.4Z",  # a triangle that stands on its tip
        "M-3.6 0H3.6M0 -3.6V3.6",  # a plus
    )[style % STYLES]
    return f'<path class="marker s{style % STYLES}" transform="translate({x:.1f} {y:.1f})" d="{shape}"/>'
