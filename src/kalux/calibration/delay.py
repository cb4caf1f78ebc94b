"""How late events are: the shift of their clock at which they explain the frames best."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.deblur import between, count_chunks
from kalux.calibration.intervals import intervals, spread
from kalux.calibration.regression import two_stage
from kalux.events import EventArray
from kalux.recording import Recording
from kalux.settings import CameraSettings

Array = NDArray[np.float64]

STEP: Final = 1_000
"""Grid of delays that are tried, us; between its points a parabola decides."""

LARGEST: Final = 12_000
"""Largest delay that is tried, us: the photoreceptor's, in the dark, is some milliseconds (Lichtsteiner 2008)."""

_COARSE: Final = 3  # delays of the grid, of which one is tried first: residuals have valleys 4 ms wide
_VALLEY: Final = 4_000  # us

_RIVAL: Final = 1.05
"""Where light flickers, frames are explained nearly as well by events a period of it earlier or later: of valleys whose
least residual is no larger than so many times the least of all, the one nearest to no delay is taken. At a simulated
lamp of 100 Hz there are two, at -8.8 and 1.3 ms, whose residuals differ by 2 %."""

_MIN_SAMPLES: Final = 500
_MAX_SAMPLES: Final = 60_000
_MAX_FRAMES: Final = 60
_SHARE: Final = 0.7
"""Share of the apparent delay that is corrected. Events trail the light by half a threshold, which looks like delay
too: an ideal sensor shows 1 to 4 ms of it, real ones 2 to 7. On both 0.7 of it is best (docs/tuning.md)."""


class DelayEstimate(NamedTuple):
    """A fitted delay.

    Attributes
    ----------
    delay
        By how much to shift the events, us: the share that is corrected of the apparent delay.
    apparent
        The delay at which the events explain the frames best, us.
    improvement
        Share of the residual at no delay that the apparent one removes, 0 to 1.
    samples
        Pixels and frame intervals used.
    """

    delay: int
    apparent: int
    improvement: float
    samples: int


def estimate_delay(recording: Recording, camera: CameraSettings) -> DelayEstimate | None:
    """The delay of the events against the frames, by fitting log frame differences with event counts.

    For every delay of a grid the events between the middles of two exposures, shifted by it, are fitted to the
    change between the frames by robust least squares; the delay with the smallest residual wins. Latency of the
    event pixels (which grows in the dark), a wrong stamp or a guessed exposure time all look alike, and are all
    mended by it. Looks at the first 60 frames.

    Returns None where too few pixels change, or where no delay within 12 ms explains the frames best.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    difference, nets = _samples(recording, camera)
    if len(difference) < _MIN_SAMPLES:
        return None
    grid = delays()
    residuals = np.full(len(grid), np.inf)

    def try_between(first: int, last: int) -> None:
        for index in range(max(first, 0), min(last, len(grid) - 1) + 1):
            if np.isinf(residuals[index]):
                residuals[index] = _residual(difference, *nets[index])

    def least() -> int:
        return int(np.argmin(residuals))

    for index in range(0, len(grid), _COARSE):
        try_between(index, index)
    try_between(least() - _COARSE + 1, least() + _COARSE - 1)
    # So many steps from no delay lie rivals, and those beside them.
    nearer = (abs(int(grid[least()])) - _VALLEY) // STEP + 1
    middle = len(grid) // 2
    try_between(middle - nearer, middle + nearer)
    best = -1
    while best != least():  # what was tried for rivals may be less than all before
        best = least()
        try_between(best - 1, best + 1)
    return best_delay(grid, residuals, len(difference))


def delays() -> NDArray[np.int64]:
    """The grid of delays, us."""
    return np.arange(-LARGEST, LARGEST + 1, STEP, dtype=np.int64)


def best_delay(grid: NDArray[np.int64], residuals: Array, samples: int) -> DelayEstimate | None:
    """The minimum of the residuals over the grid, refined by a parabola through its neighbours.

    Of several that are about as deep (`_RIVAL`), the one nearest to no delay. Residuals are inf where nothing was
    tried. None where the minimum is at an end of the grid, or where a fit failed.
    """
    if np.isnan(residuals).any():
        return None
    least = int(np.argmin(residuals))
    lowest = (residuals[1:-1] <= residuals[:-2]) & (residuals[1:-1] <= residuals[2:])
    rivals = 1 + np.flatnonzero(lowest & (residuals[1:-1] <= _RIVAL * residuals[least]))
    rivals = rivals[np.abs(grid[rivals]) <= abs(int(grid[least])) - _VALLEY]
    best = int(rivals[np.argmin(np.abs(grid[rivals]))]) if len(rivals) else least
    if best in (0, len(grid) - 1):
        return None
    before, here, after = residuals[best - 1 : best + 2]
    curvature = before - 2 * here + after
    shift = 0.0 if curvature <= 0 else 0.5 * (before - after) / curvature
    improvement = 1.0 - here / residuals[int(np.flatnonzero(grid == 0)[0])]
    apparent = float(grid[best]) + shift * STEP
    return DelayEstimate(round(_SHARE * apparent), round(apparent), float(improvement), samples)


def _residual(difference: Array, on: Array, off: Array) -> float:
    """Robust standard deviation of what thresholds that fit best leave; nan if one is not determined."""
    counts = np.column_stack([on, -off])
    fit = two_stage(difference, counts, counts)
    return fit.residual if fit is not None and (fit.solution > 0).all() else float("nan")


def _samples(recording: Recording, camera: CameraSettings) -> tuple[Array, list[tuple[Array, Array]]]:
    """Log differences of usable pixels, and for every delay their on and off counts."""
    grid = delays().tolist()
    differences: list[Array] = []
    counts: list[list[tuple[Array, Array]]] = []
    total = 0
    for interval in intervals(recording, camera, margin=LARGEST, most_frames=_MAX_FRAMES):
        seen = sum(_counts(interval.events, recording.sensor_size))
        chosen = spread(interval.usable & (seen >= 2), _MAX_SAMPLES - total)
        differences.append(interval.change.ravel()[chosen])
        shifted = (between(interval.events, interval.start + d, interval.end + d) for d in grid)
        pairs = (_counts(events, recording.sensor_size) for events in shifted)
        counts.append([(_of(on, chosen), _of(off, chosen)) for on, off in pairs])
        total += len(chosen)
        if total >= _MAX_SAMPLES:
            break
    if not differences:
        return np.empty(0), []
    joined = [
        (np.concatenate([c[i][0] for c in counts]), np.concatenate([c[i][1] for c in counts]))
        for i in range(len(grid))
    ]
    return np.concatenate(differences), joined


def _counts(events: EventArray, shape: tuple[int, int]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Number of on and off events of every pixel, (H, W)."""
    return count_chunks([events], shape, weighed=False)


def _of(counts: NDArray[np.float32], chosen: NDArray[np.int64]) -> Array:
    return counts.ravel()[chosen].astype(np.float64)
