"""How late events are: the shift of their clock at which they explain the frames best."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.exposures import Exposures
from kalux.calibration.intervals import APART_IN_TIME, Interval, intervals, spread
from kalux.calibration.regression import Fit, halves, two_stage
from kalux.event_slices import between, count_chunks
from kalux.events import EventArray
from kalux.recording import Recording
from kalux.settings import CameraSettings

Array = NDArray[np.float64]

STEP: Final = 1_000
"""Grid of delays that are tried, us; between its points a parabola decides."""

LARGEST: Final = 12_000
"""Largest delay that is tried, us: the photoreceptor's, in the dark, is some milliseconds (Lichtsteiner 2008)."""

FARTHEST: Final = 36_000
"""us: looked for only where no delay up to `LARGEST` is best. A sensor is never so late; clocks that started apart are,
and frames of long exposures whose length is not known."""

_FAR_STEP: Final = 3_000  # us: residuals have valleys 4 ms wide
_FAR_AROUND: Final = 4  # steps of the fine grid, to either side
_FAR_WALLS: Final = (0.93, 0.72)
"""Shares of the lower and of the higher wall of its valley that the residual of a far delay may have to be believed. Of
60 recordings whose events are 15 or 22 ms late, and 16 whose pixels lag by 5 to 75 ms, the more the darker they are, 69
have at most 0.83 and 0.64. Where events do not belong to the frames (of the wrong sign, from elsewhere, 300 ms off) and
fits succeed at all, one of them is more on 53 of 53: the lower one at least 0.95, or the higher one 0.78."""

_FITTED: Final = 0.5
"""Share of the delays tried that must have thresholds at all: fits fail where events do not belong to the frames, and
under single delays that are far from the right one."""

_COARSE: Final = (
    3  # points of the grid from one delay tried first to the next: valleys of the residuals are wider
)
_VALLEY: Final = 4_000  # us: their width

_AROUND: Final = (-3, 3)
"""Points of the grid around the delay found without motion within exposures, between which it is searched with such
motion: on 40 simulated scenes it is 0 to 1.8 ms earlier or up to 0.9 later."""

_RIVAL: Final = 1.05
"""Factor of the least residual up to which the minimum of another valley is a rival; of these, the one nearest to no
delay is taken. Under light that flickers, events a period earlier or later explain frames nearly as well: with a
simulated lamp of 100 Hz there are minima at -8.8 and 1.3 ms, which differ by 2 %."""

_WALL: Final = 1.05
"""Factor of the least residual at which the walls of its valley are taken."""

_MIN_SAMPLES: Final = 500
_MAX_SAMPLES: Final = 60_000
_MAX_FRAMES: Final = 60
SHARE: Final = 0.7
"""Share of the apparent delay that is corrected where the true one is not known."""


class DelayEstimate(NamedTuple):
    """A fitted delay.

    Attributes
    ----------
    apparent
        The delay at which the events explain the frames best, us.
    improvement
        Share of the residual at no delay that the apparent one removes, 0 to 1, of frames as they are.
    samples
        Pixels and frame intervals used.
    true
        The delay without the half threshold by which events trail the light, us; None where it is not known.
    """

    apparent: int
    improvement: float
    samples: int
    true: int | None = None

    @property
    def delay(self) -> int:
        """By how much to shift the events, us: by the true delay and half of the trailing (docs/equations.md, K8)."""
        return round(SHARE * self.apparent if self.true is None else (self.apparent + self.true) / 2)


def estimate_delay(recording: Recording, camera: CameraSettings) -> DelayEstimate | None:
    """The delay of the events against the frames, by fitting log frame differences with event counts.

    For every delay of a grid the events between the middles of two exposures, shifted by it, are fitted to the
    change between the frames by robust least squares; the delay with the smallest residual wins. Around it, the
    thresholds found on the way tell what the light does within exposures, and delays are compared without that.
    Latency of the event pixels (which grows in the dark), a wrong stamp or a guessed exposure time all look alike,
    and are all mended by it. Looks at the first 60 frames, of those that
    follow soon at 60 that are 18 ms apart.

    Returns None where too few pixels change, or where no delay within 12 ms explains the frames best, nor one within
    36 ms far better than others before and after it.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    grid = delays()
    samples = _samples(recording, camera, grid, (0.0, 0.0))
    if len(samples[0].change) < _MIN_SAMPLES:
        return None
    residuals = np.full(len(grid), np.inf)

    def try_between(first: int, last: int) -> None:
        for index in range(max(first, 0), min(last, len(grid) - 1) + 1):
            if np.isinf(residuals[index]):
                residuals[index] = _residual(samples[index])

    def least() -> int:
        return int(np.argmin(_or_inf(residuals)))

    for index in range(0, len(grid), _COARSE):
        try_between(index, index)
    try_between(least() - _COARSE + 1, least() + _COARSE - 1)
    # Rivals that would be preferred lie so many steps from no delay.
    nearer = (abs(int(grid[least()])) - _VALLEY) // STEP + 1
    middle = len(grid) // 2
    try_between(middle - nearer, middle + nearer)
    best = -1
    while best != least():  # the new least may be among those tried for rivals
        best = least()
        try_between(best - 1, best + 1)
    rough = best_delay(grid, residuals, len(samples[0].change))
    if rough is None:
        grid, samples, rough = _far_delay(recording, camera)
    if rough is None:
        return None
    fit = _fit(samples[int(np.argmin(np.abs(grid - rough.apparent)))])
    return rough if fit is None else _with_moving_exposures(recording, camera, rough, fit)


def _far_delay(
    recording: Recording, camera: CameraSettings
) -> tuple[NDArray[np.int64], list[_Samples], DelayEstimate | None]:
    """A delay up to `FARTHEST`, where none up to `LARGEST` is best: on a coarse grid, then on a fine one.

    Where a fit fails, as thresholds come out negative, events do not belong to the frames: such a delay is not it.

    Returns
    -------
    The fine grid, the samples under each of its delays, and the estimate; None if none is far better than those before
    and after it.
    """
    coarse = np.arange(-FARTHEST, FARTHEST + 1, _FAR_STEP, dtype=np.int64)
    residuals = np.array([_residual(samples) for samples in _samples(recording, camera, coarse, (0.0, 0.0))])
    fitted = residuals[~np.isnan(residuals)]
    if len(fitted) < _FITTED * len(coarse) or not _is_valley(residuals):
        return coarse, [], None
    undelayed = float(residuals[len(coarse) // 2])
    near = int(coarse[int(np.nanargmin(residuals))])
    grid = near + STEP * np.arange(-_FAR_AROUND, _FAR_AROUND + 1, dtype=np.int64)
    samples = _samples(recording, camera, grid, (0.0, 0.0))
    around = np.array([_residual(s) for s in samples])
    undelayed = float(np.median(fitted)) if np.isnan(undelayed) else undelayed
    return grid, samples, best_delay(grid, around, len(samples[0].change), undelayed)


def _is_valley(residuals: Array) -> bool:
    """Whether the least of the residuals, some of which are nan, is far below the largest before and after it."""
    least = int(np.nanargmin(residuals))
    walls = sorted((np.nanmax(residuals[: least + 1]), np.nanmax(residuals[least:])))
    return bool(all(residuals[least] <= share * wall for share, wall in zip(_FAR_WALLS, walls, strict=True)))


def _with_moving_exposures(
    recording: Recording, camera: CameraSettings, rough: DelayEstimate, fit: Fit
) -> DelayEstimate:
    """The best delay if the light moves within exposures by the thresholds of a fit; the rough one if there is none."""
    on, off = fit.solution.tolist()
    grid = round(rough.apparent / STEP) * STEP + STEP * np.arange(*_AROUND)
    residuals = np.array([_residual(samples) for samples in _samples(recording, camera, grid, (on, off))])
    middle = _valley_middle(residuals)
    if middle is None:
        return rough
    apparent = float(grid[0]) + STEP * middle
    return rough._replace(apparent=round(apparent))


def _valley_middle(residuals: Array) -> float | None:
    """The middle of a valley, which may be flat at its bottom, in points of the grid; None where a wall is missing.

    Half-way between its walls, at 5 % above the least residual, or as high as the lower wall.
    """
    wall = min(_WALL * residuals.min(), residuals[0], residuals[-1])
    if not residuals.min() < wall < np.inf:
        return None
    depth = wall - residuals
    low = np.flatnonzero(depth > 0)
    first, last = int(low[0]), int(low[-1])
    left = first - depth[first] / (depth[first] - depth[first - 1])
    right = last + depth[last] / (depth[last] - depth[last + 1])
    return float(left + right) / 2


def delays() -> NDArray[np.int64]:
    """The grid of delays, us."""
    return np.arange(-LARGEST, LARGEST + 1, STEP, dtype=np.int64)


def best_delay(
    grid: NDArray[np.int64], residuals: Array, samples: int, undelayed: float | None = None
) -> DelayEstimate | None:
    """The minimum of the residuals over the grid, refined by a parabola through its neighbours.

    Of several that are about as deep (`_RIVAL`), the one nearest to no delay. Residuals are inf where nothing was
    tried, and nan where a fit failed; ``undelayed`` is that of no delay, if the grid has none. None where the minimum
    is at an end of the grid, or beside a fit that failed, or where most fits did.
    """
    fitted = residuals[np.isfinite(residuals)]
    if not len(fitted) or len(fitted) < _FITTED * np.count_nonzero(~np.isinf(residuals)):
        return None
    residuals = _or_inf(residuals)
    least = int(np.argmin(residuals))
    lowest = (residuals[1:-1] <= residuals[:-2]) & (residuals[1:-1] <= residuals[2:])
    rivals = 1 + np.flatnonzero(lowest & (residuals[1:-1] <= _RIVAL * residuals[least]))
    rivals = rivals[np.abs(grid[rivals]) <= abs(int(grid[least])) - _VALLEY]
    best = int(rivals[np.argmin(np.abs(grid[rivals]))]) if len(rivals) else least
    if best in (0, len(grid) - 1) or not np.isfinite(residuals[best - 1 : best + 2]).all():
        return None
    if undelayed is None:
        undelayed = float(residuals[int(np.flatnonzero(grid == 0)[0])])
        undelayed = undelayed if np.isfinite(undelayed) else float(np.median(fitted))
    improvement = 1.0 - residuals[best] / undelayed
    apparent = float(grid[best]) + STEP * (vertex(*residuals[best - 1 : best + 2]) or 0.0)
    return DelayEstimate(round(apparent), float(improvement), samples)


def _or_inf(residuals: Array) -> Array:
    """Residuals, inf where a fit failed."""
    return np.where(np.isnan(residuals), np.inf, residuals)


def vertex(before: float, here: float, after: float) -> float | None:
    """Where a parabola through three points one apart is least, from the one in the middle; None: nowhere."""
    curvature = before - 2 * here + after
    return 0.5 * (before - after) / curvature if curvature > 0 else None


class _Samples(NamedTuple):
    """Changes of pixels, log intensity, and their on and off events under one delay, (N,) each."""

    change: Array
    on: Array
    off: Array


def _fit(samples: _Samples) -> Fit | None:
    """Thresholds that fit best; None if one is not determined."""
    counts = np.column_stack([samples.on, -samples.off])
    fit = two_stage(samples.change, counts, halves(samples.change))
    return fit if fit is not None and (fit.solution > 0).all() else None


def _residual(samples: _Samples) -> float:
    """Robust standard deviation of the fit's residuals, in thresholds; nan if one of these is not determined."""
    fit = _fit(samples)
    return float("nan") if fit is None else in_thresholds(fit)


def in_thresholds(fit: Fit) -> float:
    """The residual of a fit in units of its thresholds, both positive: how far counts are from what frames say."""
    return fit.residual / float(np.sqrt(fit.solution.prod()))


def _samples(
    recording: Recording, camera: CameraSettings, grid: NDArray[np.int64], thresholds: tuple[float, float]
) -> list[_Samples]:
    """Changes and events of usable pixels under every delay of the grid.

    By the ``thresholds``, log intensity, the light moves within exposures; 0: it stands still.
    """
    parts: list[list[_Samples]] = []
    total = 0
    margin = max(LARGEST, int(np.abs(grid).max())) + (recording.longest_exposure if any(thresholds) else 0)
    exposures = [(d, Exposures(recording.sensor_size, d, thresholds)) for d in grid.tolist()]
    found = intervals(recording, camera, margin=margin, most_frames=_MAX_FRAMES, apart=APART_IN_TIME)
    for interval in found:
        events = sum(_counts(interval.events, recording.sensor_size))
        chosen = spread(interval.usable & (events >= 2), _MAX_SAMPLES - total)
        parts.append(
            [_samples_under(interval, d, within, recording.sensor_size, chosen) for d, within in exposures]
        )
        total += len(chosen)
        if total >= _MAX_SAMPLES:
            break
    if not parts:
        return [_Samples(*np.empty((3, 0))) for _ in grid]
    return [
        _Samples(*(np.concatenate(values) for values in zip(*of_delay, strict=True)))
        for of_delay in zip(*parts, strict=True)
    ]


def _samples_under(
    interval: Interval,
    delay: int,
    exposures: Exposures,
    sensor_size: tuple[int, int],
    chosen: NDArray[np.int64],
) -> _Samples:
    """The ``chosen`` pixels of an interval under one delay, us."""
    before, after = exposures.of(interval.first, interval.second, interval.events)
    counts = _counts(between(interval.events, interval.start + delay, interval.end + delay), sensor_size)
    planes = (interval.change, before.over_middle, after.over_middle, *counts)
    change, first, second, on, off = (plane.ravel()[chosen].astype(np.float64) for plane in planes)
    return _Samples(change - (second - first), on, off)


def _counts(events: EventArray, shape: tuple[int, int]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Number of on and off events of every pixel, (H, W)."""
    return count_chunks([events], shape, weighed=False)
