"""Frames against events, in space and in time: what changes between two frames is what the events between them say.

For every two successive frames, warped into the event camera's pixels, the change of the log intensity is modelled as

    log I_{k+1} - log I_k = s (c_on N_on - c_off N_off),    s = I / (I + I_0),

with N the number of events between tau_k + d and tau_{k+1} + d, d the offset of the frames' clock. Least squares, with
Huber's weights, over all pixels and intervals, in the thresholds, the offset d and, where it is free, the homography
between the cameras: Gauss and Newton's iteration, first blurred, then sharp.

An event comes when a whole threshold has gathered, so that counts trail the light by half a threshold: a delay that
depends on the speed, 1 to 7 ms. Here a step is spread over the time in which it gathered (`levels`), which takes the
trail away: the offset is that of the clocks, to the pixels' own latency. The mean delay with whole steps, as in
`kalux.calibration.delay`, is reported as well.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux import memory
from kalux.augmentation.trail import NO_EVENT
from kalux.calibration.registration import Registration
from kalux.calibration.regression import huber_weights, products
from kalux.compiled import (
    AHEAD,
    event_column,
    event_is_on,
    event_row,
    event_words,
    inner,
    loop,
    prefetch,
    smaller,
)
from kalux.errors import InputError
from kalux.event_slices import between
from kalux.events import NEVER, EventArray, check_events
from kalux.frames import Frame
from kalux.models.camera import Camera
from kalux.settings import CameraSettings
from kalux.wording import how_many

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

MOST_FRAMES: Final = 24
"""Frames that are looked at together; at 25 Hz that is 1 s."""

_BLURS: Final = (4.0, 2.0, 1.0, 1.0)
"""Sigmas, event camera's pixels, in the order they are used; each for a few steps."""

_STEPS: Final = 6
_CLOSE: Final = 0.01  # pixels, and ms: steps below it end a round
_MOST_SAMPLES: Final = 200_000  # neighbouring pixels, blurred, say the same
_HALF_STEP: Final = 1_000  # us, of the derivative by the offset
_EXPOSED: Final = (0.03, 0.95)
_SPREAD: Final = 200_000
"""us: a step is spread over no longer than this: what is older than that has mostly been still."""

_LEAST_EXPLAINED: Final = 0.1
"""Share of the changes' variance. At the right offset events explain 0.75 to 0.99 of it in ten simulated scenes, 0.41
to 0.88 in three recordings of DAVIS sensors. At offsets wrong by 0.1 to 0.7 s, fits of scenes that are shaken explain
at most 0.01, if they end at all, and move the homography by 4 pixels for it."""


class Shots(NamedTuple):
    """Frames to align: middles in their own clock (K,) us, and in their own pixels log(I + I_0), I / (I + I_0) and
    what is well exposed, (K, H', W') each."""

    middles: NDArray[np.int64]
    log: Floats
    share: Floats
    usable: NDArray[np.bool_]


class Alignment(NamedTuple):
    """What was found.

    Attributes
    ----------
    registration
        As given, or with a better homography.
    offset
        us, to be added to the frames' times.
    standard_error
        us, of the offset, by leaving out one interval at a time.
    thresholds
        (on, off), log intensity, as fitted.
    explained
        Share of the changes' variance (of their Huber-weighted squares) that the events explain, 0 to 1.
    intervals, samples
        How many were used.
    moved
        Mean distance, event camera's pixels, by which the homography was moved.
    """

    registration: Registration
    offset: float
    standard_error: float
    thresholds: tuple[float, float]
    explained: float
    intervals: int
    samples: int
    moved: float


def take_shots(frames: Iterable[Frame], camera: CameraSettings) -> Shots:
    """Logarithms of frames, from `intensities`."""
    middles, logs, shares, usable = [], [], [], []
    for frame, linear, good in intensities(frames, camera):
        middles.append(frame.middle)
        logs.append(np.log(linear + camera.offset).astype(np.float32))
        shares.append((linear / (linear + camera.offset)).astype(np.float32))
        usable.append(good)
    if len(middles) < 3:
        raise InputError(
            f"alignment: {how_many(len(middles), 'frame')}, too few; three at least, thirty are good"
        )
    return Shots(np.array(middles, np.int64), np.stack(logs), np.stack(shares), np.stack(usable))


def intensities(
    frames: Iterable[Frame], camera: CameraSettings
) -> Iterator[tuple[Frame, Array, NDArray[np.bool_]]]:
    """Frames, their intensity (at the exposure of the first, where exposures are known), and what is well exposed."""
    green = Camera.named(camera.response, camera.clipped_from).of_channel(1)  # of colours that differ
    reference = 0
    for frame in frames:
        grey, good = _well_exposed(frame)
        linear = np.maximum(green.response.inverse(grey), 0.0)
        if frame.exposure > 0:
            reference = reference or frame.exposure
            linear = linear * (reference / frame.amplified_exposure)
        yield frame, linear, good


def _well_exposed(frame: Frame) -> tuple[Array, NDArray[np.bool_]]:
    """The response of a frame, of RGB the mean, and where it is measured and well exposed; (H', W')."""
    values = frame.normalised()
    grey = values if values.ndim == 2 else values.mean(axis=2)
    low, high = _EXPOSED
    good = (grey > low) & (grey < high)
    return grey, good if frame.valid is None else good & frame.valid


# --- events as levels --------------------------------------------------------------------------------------


def levels(
    events: EventArray, sensor_size: tuple[int, int], times: NDArray[np.int64], *, spread: bool = True
) -> tuple[Floats, Floats]:
    """Number of on and off events of each pixel before each of some times.

    Parameters
    ----------
    events
        Time-ordered, from before the first time on.
    times
        (Q,) us, ascending.
    spread
        Whether an event's step is spread evenly over the time before it: over the time since the pixel's event before
        or until the one after it, whichever is shorter, because the first event after a pause tells of a change that
        has just begun.

    Returns
    -------
    Two (Q, height, width) float32, from any common origin per pixel.

    Raises
    ------
    EventError
        If an event lies outside the sensor.
    """
    check_events(events, sensor_size)
    pixels = memory.empty((math.prod(sensor_size),), _TOLD_PIXEL)
    pixels[:] = (NO_EVENT, NEVER, 0, 0.0, 0.0)
    told = memory.empty((2, len(times), len(pixels)))
    longest = _SPREAD if spread else 0
    _levels(event_words(events), pixels, times, longest, np.uint64(sensor_size[1]), told)
    off, on = told.reshape(2, len(times), *sensor_size)
    return on, off


_TOLD_PIXEL: Final = np.dtype(
    [
        ("waiting", "i8"),  # code of the event that waits for the one after it, as of `Followed`
        ("before", "i8"),  # us, the event before that one
        ("upcoming", "i8"),  # the next time to be told
        ("on", "f4"),
        ("off", "f4"),
    ],
    align=True,
)
"""What `levels` counts of a pixel, in one line of memory that is used again: over planes of fresh memory it takes 1.5
to 3 times as long (sensors of 160x120 to 640x480)."""


@loop
def _levels(words, pixels, times, longest, width, told):  # type: ignore[no-untyped-def]
    last = len(words) - 1
    for i in range(len(words)):
        ahead = words[smaller(i + AHEAD, last), 1]
        prefetch(pixels, event_row(ahead) * width + event_column(ahead))
        now, word = words[i, 0], words[i, 1]
        at = event_row(word) * width + event_column(word)
        _tell(pixels, at, now, times, longest, told)
        pixels[at].waiting = 2 * now + np.int64(event_is_on(word))
    for at in range(np.uint64(len(pixels))):
        _tell(pixels, at, -NEVER, times, longest, told)  # the last events have none after them
        pixel = pixels[at]
        for k in range(pixel.upcoming, len(times)):
            told[0, k, at], told[1, k, at] = pixel.off, pixel.on


@inner
def _tell(pixels, at, now, times, longest, told):  # type: ignore[no-untyped-def]
    """Count the event of a pixel that waits, if one does, since the next one has come ``now``."""
    pixel = pixels[at]
    if pixel.waiting == NO_EVENT:
        return
    here, is_on = pixel.waiting >> 1, pixel.waiting & 1
    length = smaller(smaller(here - pixel.before, now - here), longest)
    k = pixel.upcoming
    while k < len(times) and times[k] <= here:
        part = np.float32(0.0)
        if times[k] > here - length:
            part = np.float32(1.0 - (here - times[k]) / length)
        told[0, k, at], told[1, k, at] = pixel.off, pixel.on
        told[is_on, k, at] += part
        k += 1
    pixel.upcoming = k
    if is_on:
        pixel.on += np.float32(1.0)
    else:
        pixel.off += np.float32(1.0)
    pixel.before = here


# --- the fit ----------------------------------------------------------------------------------------------


class _Parameters(NamedTuple):
    on: float
    off: float
    offset: float
    homography: Array


class _Normal(NamedTuple):
    """Normal equations of each interval: (K-1, n, n), (K-1, n); squares before and after, weighted; samples."""

    matrices: Array
    vectors: Array
    before: float
    after: float
    samples: int


def align(
    shots: Shots,
    events: EventArray,
    registration: Registration,
    *,
    offset: float,
    free_homography: bool,
    free_offset: bool = True,
    spread: bool = True,
) -> Alignment:
    """Fit thresholds, the offset and the homography, from a first guess of both.

    Parameters
    ----------
    shots
        From `take_shots`.
    events
        All of the time of the frames, and a margin of 50 ms at least before and after.
    registration
        First guess. Right to some pixels, or exact where the homography is not free.
    offset
        First guess, us; right to half a frame interval.
    free_homography, free_offset
        What is fitted besides the thresholds. Where the cameras move evenly in one direction, an offset cannot be told
        from a shift: shake them.
    spread
        See `levels`.

    Raises
    ------
    InputError
        If too little changes, the fit does not end near its beginning, or it explains hardly anything.
    """
    begin = registration
    parameters = _Parameters(0.2, 0.2, offset, registration.homography)
    blurs = _BLURS if free_homography else _BLURS[1:]
    shots = shots._replace(
        log=np.stack([begin.filtered(image) for image in shots.log]),
        share=np.stack([begin.filtered(image) for image in shots.share]),
        usable=np.stack([begin.filtered(image) for image in shots.usable]) > 0.98,
    )
    normal: _Normal | None = None
    for blur in blurs:
        for _ in range(_STEPS):
            normal = _normal_equations(shots, events, _with(begin, parameters), parameters, blur, spread)
            step = _solve(
                normal.matrices.sum(axis=0), normal.vectors.sum(axis=0), free_homography, free_offset
            )
            last, parameters = parameters, _stepped(parameters, step, begin.events.sensor_size)
            moved = _distance(_with(begin, last), _with(begin, parameters)) if free_homography else 0.0
            if moved < _CLOSE and abs(parameters.offset - last.offset) < _CLOSE * 1_000:
                break
    assert normal is not None
    found = _with(begin, parameters)
    explained = 1.0 - normal.after / max(normal.before, 1e-30)
    least = np.ptp(shots.middles) / (len(shots.middles) - 1)
    ended = abs(parameters.offset - offset) <= least and min(parameters.on, parameters.off) > 0
    if not (ended and explained >= _LEAST_EXPLAINED):
        raise InputError(
            "alignment: the events do not explain how the frames change near the offset and the registration that it "
            f"began with ({offset * 1e-3:.1f} ms; now at {parameters.offset * 1e-3:.1f} ms, thresholds "
            f"{parameters.on:.2f} and {parameters.off:.2f}, {100 * explained:.0f} % explained); do both see the same "
            "moving scene, and is an offset that was given theirs?"
        )
    return Alignment(
        registration=found,
        offset=parameters.offset,
        standard_error=_jackknife(normal, free_homography) if free_offset else 0.0,
        thresholds=(parameters.on, parameters.off),
        explained=explained,
        intervals=len(normal.matrices),
        samples=normal.samples,
        moved=_distance(begin, found),
    )


def _with(registration: Registration, parameters: _Parameters) -> Registration:
    return Registration(registration.events, registration.frames, parameters.homography)


def _distance(one: Registration, other: Registration) -> float:
    """Mean distance between where both take the overlap's pixels, event camera's pixels."""
    a, b = one.maps, other.maps
    both = a.inside & b.inside
    if not both.any():
        return float("inf")
    return float(np.hypot(a.x - b.x, a.y - b.y)[both].mean() / other.scale)


class _Interval(NamedTuple):
    """Of the chosen pixels of a frame interval: what is left (N,), its derivatives (N, 11), and the change (N,)."""

    residual: Floats
    jacobian: Floats
    change: Floats


def _normal_equations(
    shots: Shots, events: EventArray, registration: Registration, now: _Parameters, blur: float, spread: bool
) -> _Normal:
    rows = [*_linearised(shots, events, registration, now, blur, spread)]
    if not rows or sum(len(row.residual) for row in rows) < 500:
        raise InputError(
            "alignment: fewer than 500 pixels are well exposed and seen by frames and events; are the frames dark or "
            "clipped, or is the registration wrong?"
        )
    everything = np.concatenate([row.residual for row in rows])
    weights, _ = huber_weights(everything)
    begin = 0
    matrices, vectors, before, after = [], [], 0.0, 0.0
    for residual, jacobian, change in rows:
        weight = weights[begin : begin + len(residual)]
        begin += len(residual)
        columns = np.ascontiguousarray(jacobian.T, np.float64)
        weighted = columns * weight
        matrices.append(products(weighted, columns))
        vectors.append(products(weighted, np.asarray(residual[None], np.float64))[:, 0])
        before += float((weight * change**2).sum())
        after += float((weight * residual**2).sum())
    return _Normal(np.array(matrices), np.array(vectors), before, after, len(everything))


def _linearised(
    shots: Shots, events: EventArray, registration: Registration, now: _Parameters, blur: float, spread: bool
) -> Iterator[_Interval]:
    """What the events leave unexplained in every frame interval, and how it depends on the parameters."""
    size = registration.events.sensor_size
    count = len(shots.middles)
    times = np.rint(shots.middles[:, None] + now.offset + np.array([-1, 0, 1]) * _HALF_STEP).astype(np.int64)
    inside = between(events, int(times[0, 0]) - _SPREAD, int(times[-1, -1]) + _SPREAD)
    # Frames closer than the half steps would put the times out of order.
    order = np.argsort(times.ravel(), kind="stable")
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    on, off = levels(inside, size, times.ravel()[order], spread=spread)
    places = place.reshape(count, 3)
    coordinates = _coordinates(registration)
    margin = int(np.ceil(2 * blur)) * 2 + 1
    kernel = np.ones((margin, margin), np.uint8)
    warped = _warp(shots, registration, 0)
    stride = max(int(np.sqrt(size[0] * size[1] * (count - 1) / _MOST_SAMPLES)), 1)
    lattice = np.zeros(size, bool)
    lattice[stride // 2 :: stride, stride // 2 :: stride] = True
    for k in range(count - 1):
        following = _warp(shots, registration, k + 1)
        good = (warped[2] & following[2]).astype(np.uint8)
        good[0], good[-1], good[:, 0], good[:, -1] = 0, 0, 0, 0
        good = cv2.erode(good, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0).astype(bool)
        change = _blurred((following[0] - warped[0]) * (warped[2] & following[2]), blur)
        share = (following[1] + warped[1]) / 2
        first, last = places[k], places[k + 1]
        counts = [_blurred((level[last[1]] - level[first[1]]) * share, blur) for level in (on, off)]
        slopes = [
            _blurred(((level[last[2]] - level[first[2]]) - (level[last[0]] - level[first[0]])) * share, blur)
            / (2 * _HALF_STEP)
            for level in (on, off)
        ]
        warped = following
        good &= lattice
        if not good.any():
            continue
        gy, gx = (np.asarray(g, np.float32) for g in np.gradient(change))
        residual = (change - now.on * counts[0] + now.off * counts[1])[good]
        by_offset = np.asarray(now.on * slopes[0] - now.off * slopes[1], np.float32)
        jacobian: Floats = np.column_stack(
            [
                -counts[0][good],
                counts[1][good],
                -by_offset[good],
                _homography_columns(gx[good], gy[good], coordinates[good]),
            ]
        )
        yield _Interval(residual, jacobian, change[good])


def _warp(shots: Shots, registration: Registration, k: int) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    usable = registration.sampled(shots.usable[k].astype(np.float32)) > 0.98
    return (
        registration.sampled(shots.log[k]),
        registration.sampled(shots.share[k]),
        usable & registration.maps.inside,
    )


def _blurred(image: NDArray[Any], sigma: float) -> Floats:
    return np.asarray(cv2.GaussianBlur(np.asarray(image, np.float32), (0, 0), sigma), np.float32)


def _scaling(size: tuple[int, int]) -> Array:
    """(3, 3), from pixels to coordinates of about -1 to 1."""
    height, width = size
    return np.array([[2 / width, 0, -1], [0, 2 / width, -height / width], [0, 0, 1]])


def _coordinates(registration: Registration) -> Floats:
    """(H, W, 2): the undistorted pixels of the event camera, scaled."""
    height, width = registration.events.sensor_size
    points = np.column_stack([registration.undistorted, np.ones(height * width)])
    scaled = points @ _scaling((height, width)).T
    return np.nan_to_num(scaled[:, :2]).reshape(height, width, 2).astype(np.float32)


def _homography_columns(gx: Floats, gy: Floats, at: Floats) -> Floats:
    """Derivatives of a warped image by the eight parameters of a small homography applied before it, (N, 8)."""
    x, y = at.T
    along = gx * x + gy * y
    return np.column_stack([gx * x, gx * y, gx, gy * x, gy * y, gy, -along * x, -along * y])


def _solve(matrix: Array, vector: Array, free_homography: bool, free_offset: bool) -> Array:
    """The step of all parameters, (11,); 0 for those that are not free."""
    free = np.array([True, True, free_offset] + [free_homography] * 8)
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    scaled = (matrix / scale / scale[:, None])[np.ix_(free, free)] + 1e-6 * np.eye(int(free.sum()))
    step = np.zeros(len(vector))
    step[free] = -np.linalg.solve(scaled, (vector / scale)[free])
    out: Array = step / scale
    return out


def _stepped(now: _Parameters, step: Array, size: tuple[int, int]) -> _Parameters:
    # The derivative by a small homography is by scaled coordinates; the image's gradient is by pixels.
    small = np.eye(3)
    small.ravel()[:8] += step[3:] * 2 / size[1]
    scaling = _scaling(size)
    homography = now.homography @ np.linalg.inv(scaling) @ small @ scaling
    return _Parameters(
        now.on + float(step[0]),
        now.off + float(step[1]),
        now.offset + float(np.clip(step[2], -10_000, 10_000)),
        homography / homography[2, 2],
    )


def _jackknife(normal: _Normal, free_homography: bool) -> float:
    """Standard error of the offset, us: the spread of what is found without one interval at a time."""
    matrix, vector = normal.matrices.sum(axis=0), normal.vectors.sum(axis=0)
    count = len(normal.matrices)
    if count < 3:
        return float("inf")
    found = [
        _solve(matrix - m, vector - v, free_homography, True)[2]
        for m, v in zip(normal.matrices, normal.vectors, strict=True)
    ]
    return float(np.sqrt((count - 1) / count * np.sum((found - np.mean(found)) ** 2)))
