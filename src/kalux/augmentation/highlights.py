"""Highlights that no frame has shown yet: clipped in every frame since the start (docs/equations.md, K15).

The frames and the events of such a pixel give a lower bound of its intensity. How far above the bound it is expected is
estimated twice. First from the pixels around it: intensities are continuous, so that where many pixels lie just below
white, few lie far above it. Then from pixels that were clipped, too, and have left saturation: when a frame measures
one for the first time, its distance from its bound is known. These distances are collected as the recording goes on,
for every part of the image, since a window is brighter than the floor that it lights. Events limit the first: where the
image moves and clipped pixels stay silent, the light hardly changes among them, and lies no farther above white than
their borders are steep.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.bridge import (
    MASKED,
    UNMEASURED,
    BridgedSegment,
    Latent,
    Revealed,
    Texture,
    UnshownMemory,
)
from kalux.augmentation.parts import (
    PART,
    interpolated,
    part_grid,
    part_sums,
    parts_of,
    weighted_area,
    weighted_sums,
)
from kalux.compiled import larger, loop, smaller

Floats = NDArray[np.floating[Any]]

_NEAR: Final = 0.2
"""Log intensity below white up to which a pixel counts as just below it: levels of 0.8 and more that are measured."""

_WHOLE: Final = 0.1
"""Share of a neighbourhood's pixels as which the whole image counts: it decides where nothing else is near."""

_LEAST: Final = 1e-4
"""Least share of a neighbourhood that counts as just below white, since it is divided by."""

_SOFT: Final = 0.05
"""Hardness of a border is 1/2 where its darkest pixel is this much darker than white, log intensity."""

_PRIOR_PIXELS: Final = 10.0
"""Pixels as which the prior counts: few beside the tens of pixels of a part that leave saturation."""

_PRIOR_EXCESS: Final = 5.0
"""Sum of their distances from their bounds, log intensity: 0.5 each, the mean of the clipped pixels of these scenes."""

_PRIOR_OF_ALL: Final = 100.0
"""Sum of expected distances, log intensity, at which the logarithm of the whole image's scale counts half. So large
because many of the pixels belong to one object: on 32 simulated scenes these sums are 100 to 1400."""

_UNKNOWN_SCALE: Final = 3.0
"""Standard deviation of the mean excess, in units of it, where no pixel has left saturation: by the errors of 32
simulated scenes, whose mean excess is half to ten times the expected one (docs/equations.md, K15)."""

_NOISE: Final = 3.0
"""Standard deviations of a frame's noise by which a pixel must lie below its bound to have left saturation."""

_RAISED: Final = np.float32(1e-4)
"""Log intensity by which a frame must raise a bound to count: less may be rounding."""

_RIM: Final = 2
"""Pixels from a clipped one up to which a measured one is at its rim: an edge that passes by moves both."""

_RIM_DARKEST: Final = 0.7
"""Log intensity below white down to which it is, half of white: what is darker may be something else that moves."""

_TEXTURE_WHOLE: Final = 0.3
"""Share of the whole image's events that counts around every part; 0.1 to 5 do alike (docs/equations.md, K15)."""

_UNSEEN_EVENTS: Final = 3.0
"""Events that count besides those that were seen: where none was, as many are expected at most, with a probability of
95 %."""

_SLOPE_REACH: Final = np.float32(10.0)
"""Pixels over which the light rises with the slope that events tell. 5 to 20 do alike."""

_STEP_REACH: Final = np.float32(2.0)
"""Excess beyond a border that is steep, in units of what it rises by up to white."""

_LEAST_EXCESS: Final = np.float32(1e-4)
"""Log intensity, since it is divided by."""

_LOWER_BOUNDS: Final = 8.0
"""How fast a direction of time counts less the lower its bounds are (docs/equations.md, K15): with 8 none counts whose
bounds lie an excess lower, and noise of bounds, which both have, changes little."""


@dataclasses.dataclass(frozen=True)
class FrameHighlights:
    """What a frame shows of highlights.

    Attributes
    ----------
    clipped
        (H, W) bool.
    darker
        (H, W) float32: how far below what is clipped a pixel is, log intensity; 0 where it is clipped, or masked.
    measured
        (H, W) bool: neither clipped nor masked.
    pitch
        Distance of pixels of one colour: 2 in a Bayer mosaic.
    """

    clipped: NDArray[np.bool_]
    darker: NDArray[np.float32]
    measured: NDArray[np.bool_]
    pitch: int = 1

    @functools.cached_property
    def just_below(self) -> NDArray[np.bool_]:
        """(H, W) pixels just below white."""
        return self.measured & (self.darker < _NEAR)

    @functools.cached_property
    def hardness(self) -> Floats:
        """`border_hardness`, which K7 and K15 ask for."""
        return border_hardness(self)


class Tail(NamedTuple):
    """How far highlights go beyond white (K15): ``share`` of the scale of pixels just below it, at most ``most``.

    ``times`` as far, where the recording has been looked at before.
    """

    share: float
    most: float
    times: float = 1.0


class Unshown(NamedTuple):
    """Pixels that no frame has measured yet.

    Attributes
    ----------
    pixels
        (N,) their places in the flattened image, ascending.
    excess
        (N,) float32: how far above their bounds they are expected, log intensity; the mean, and the standard deviation
        too, of an exponential distribution.
    noise
        (N,) float32: variance of the bounds, that of the events.
    doubt
        (N,) float32: variance of that mean, which is an expectation itself.
    memory
        What both are expected by.
    """

    pixels: NDArray[np.int64]
    excess: NDArray[np.float32]
    noise: NDArray[np.float32]
    doubt: NDArray[np.float32]
    memory: UnshownMemory


def begin_unshown(first: Latent, highlights: FrameHighlights, tail: Tail) -> UnshownMemory:
    """The pixels that the first frame clips, and what it makes expect of them."""
    pixels = np.flatnonzero((first.variance >= UNMEASURED) & (first.variance < MASKED))
    bound = first.value.reshape(-1)[pixels].astype(np.float32)
    parts = part_grid(first.value.shape)
    revealed = Revealed(np.zeros(parts), np.zeros(parts), np.zeros(parts), 0.0, 0.0)
    near, clipped = _counts(highlights)
    hardness = highlights.hardness
    excess = excess_from_surroundings(highlights, hardness, pixels, near / max(clipped, 1), tail)
    expected = np.float32(tail.times) * excess
    doubt = (np.float32(_UNKNOWN_SCALE) * expected) ** 2
    texture = Texture(*(np.zeros(parts) for _ in Texture._fields))
    return UnshownMemory(
        pixels=pixels,
        bound=bound,
        shape=first.value.shape,
        excess=excess,
        limited=excess,
        expected=expected,
        doubt=doubt,
        revealed=revealed,
        texture=texture,
        hardness=hardness,
        near=near,
        clipped=clipped,
        times=tail.times,
    )


def follow_unshown(
    memory: UnshownMemory,
    following: Latent,
    highlights: FrameHighlights,
    noise: Floats,
    net: Floats,
    events: tuple[Floats, Floats],
    moved: float,
    tail: Tail,
) -> UnshownMemory:
    """The pixels that are still not measured after the next frame.

    A pixel that is measured below its bound counts as having been at it, since events are not exact.

    Parameters
    ----------
    following, highlights
        The next frame.
    noise
        (N,) variance of these pixels in it, by the noise of the frame alone: that is what takes still pixels out of
        saturation. Deblurring adds variance to moving pixels only.
    net
        (H, W) what events add to L between the two frames.
    events
        (H, W) each: on and off events between them, as far as they are signal.
    moved
        Log intensity by which events must take a pixel down for it to have moved: more than one wrong event.
    """
    pixels = memory.pixels
    predicted = memory.bound + net.reshape(-1)[pixels].astype(np.float32)
    value, variance = following.value.reshape(-1)[pixels], following.variance.reshape(-1)[pixels]
    measured = variance < UNMEASURED
    bounded = np.where(variance < MASKED, np.maximum(predicted, value), predicted)
    left = measured & (value < memory.bound - _NOISE * np.sqrt(noise))
    moved_out = measured & (predicted < memory.bound - moved)
    distance = np.maximum(value - predicted, np.float32(0.0))
    revealed = _with_revealed(memory, left, moved_out, distance)
    near, clipped = (
        old + new for old, new in zip((memory.near, memory.clipped), _counts(highlights), strict=True)
    )
    unknown, excess = pixels[~measured], memory.excess[~measured]
    raised = (bounded > predicted + _RAISED)[~measured]
    hardness = highlights.hardness
    if raised.any():
        around = excess_from_surroundings(highlights, hardness, unknown[raised], near / max(clipped, 1), tail)
        excess[raised] = np.minimum(excess[raised], around)
    return _with_expectation(
        memory._replace(
            pixels=unknown,
            bound=bounded[~measured],
            excess=excess,
            revealed=revealed,
            texture=_with_texture(memory.texture, unknown, highlights, events),
            hardness=hardness,
            near=near,
            clipped=clipped,
        )
    )


def of_both(first: UnshownMemory, second: UnshownMemory) -> UnshownMemory:
    """What two directions of time know together, of pixels that neither has seen measured.

    Each has seen frames, events and revealed pixels of its own: sums add up, of revealed pixels as far as a direction's
    bounds are those of both. Of what frames show around the pixels the mean counts, of logarithms, since it is their
    scale that is not known.
    """
    of_first = np.isin(first.pixels, second.pixels, kind="table")
    of_second = np.isin(second.pixels, first.pixels, kind="table")
    bounds = first.bound[of_first], second.bound[of_second]
    excesses = first.excess[of_first], second.excess[of_second]
    first_counts, second_counts = weights_of_both(bounds, excesses)

    def weighed(one: Any, other: Any) -> Any:
        return first_counts * one + second_counts * other

    return _with_expectation(
        first._replace(
            pixels=first.pixels[of_first],
            bound=np.maximum(*bounds),
            excess=np.sqrt(np.multiply(*excesses)),
            revealed=Revealed(*map(weighed, first.revealed, second.revealed)),
            texture=Texture(*map(operator.add, first.texture, second.texture)),
            hardness=(first.hardness + second.hardness) / 2.0,
            near=first.near + second.near,
            clipped=first.clipped + second.clipped,
        )
    )


def weights_of_both(
    bounds: tuple[NDArray[np.float32], NDArray[np.float32]],
    excesses: tuple[NDArray[np.float32], NDArray[np.float32]],
) -> tuple[float, float]:
    """How much what has left saturation counts of either direction of time, by the ``bounds`` that it has, (N,) each.

    Where an exposure was longer, white was lower, and pixels have left saturation that lay above less: they tell too
    much of those above both bounds. The direction with the higher bounds counts 1.
    """
    if len(bounds[0]) == 0:
        return 1.0, 1.0

    higher = np.maximum(*bounds)

    def nearness(bound: NDArray[np.float32], excess: NDArray[np.float32]) -> float:
        scale = np.maximum(excess, _LEAST_EXCESS)
        return float((scale / (scale + higher - bound)).mean(dtype=np.float64))

    first, second = map(nearness, bounds, excesses)
    highest = max(first, second)
    return (first / highest) ** _LOWER_BOUNDS, (second / highest) ** _LOWER_BOUNDS


def _with_expectation(memory: UnshownMemory) -> UnshownMemory:
    """``memory`` with what is expected of its pixels by all else in it."""
    limited = _limited(memory)
    scale = np.float32(scale_of_all(memory.revealed, memory.times))
    expected, doubt = _corrected(scale, limited, memory.pixels, memory.shape[1], memory.revealed)
    return memory._replace(limited=limited, expected=expected, doubt=doubt)


def excess_from_surroundings(
    highlights: FrameHighlights, hardness: Floats, pixels: NDArray[np.int64], near: float, tail: Tail
) -> NDArray[np.float32]:
    """How far above white clipped pixels are expected, from the pixels around them.

    If the density of log intensities continues beyond white and falls off exponentially, its scale is `_NEAR` times the
    number of clipped pixels over that of pixels just below white. Both are counted around every part of the image. The
    result is less where borders of the clipped areas are soft, and within a pixel of them: where a frame approaches
    white slowly, the scene goes on slowly.

    Parameters
    ----------
    hardness
        `border_hardness`.
    pixels
        (N,) which pixels, in the flattened image, ascending.
    near
        Number of pixels just below white over that of clipped ones, of all frames until now.
    """
    level = _excess_around(highlights, hardness, near, tail)
    inside = -np.expm1(-_distance(highlights).reshape(-1)[pixels])
    excess: NDArray[np.float32] = (
        interpolated(level.astype(np.float32), pixels, highlights.darker.shape[1]) * inside
    )
    return excess


def expected_of_shown(
    memory: UnshownMemory, highlights: FrameHighlights, pixels: NDArray[np.int64], tail: Tail
) -> NDArray[np.float32]:
    """(N,) how far above white ``pixels`` are expected that a frame clips and an earlier one has measured (K7).

    As far as those that none has measured (``memory``, before that frame), but for being beside a border, since it is
    known from where they have come.
    """
    hardness = highlights.hardness
    below, clipped = _counts(highlights)
    level = _excess_around(highlights, hardness, below / max(clipped, 1), tail)
    excess = interpolated(level.astype(np.float32), pixels, memory.shape[1])
    return _with_expectation(memory._replace(pixels=pixels, excess=excess, hardness=hardness)).expected


def _excess_around(highlights: FrameHighlights, hardness: Floats, near: float, tail: Tail) -> Floats:
    """Of every part: `excess_from_surroundings` inside the clipped areas."""
    clipped, below = (
        weighted_sums(part_sums(plane)) for plane in (highlights.clipped, highlights.just_below)
    )
    area = weighted_area(highlights.darker.shape)
    scale = _NEAR * (clipped + _WHOLE * area) / (below + (_WHOLE * near + _LEAST) * area)
    level: Floats = tail.most * -np.expm1(-tail.share * scale / tail.most) * hardness
    return level


def _counts(highlights: FrameHighlights) -> tuple[int, int]:
    """Pixels just below white, and clipped ones."""
    return int(np.count_nonzero(highlights.just_below)), int(np.count_nonzero(highlights.clipped))


def _distance(highlights: FrameHighlights) -> NDArray[np.float32]:
    """(H, W) distance to the nearest pixel of the same colour that is not clipped, pixels, right to 2 %."""
    distance = np.empty(highlights.clipped.shape, np.float32)
    for of_colour in _colours(highlights):
        clipped = np.ascontiguousarray(highlights.clipped[of_colour], np.uint8)
        steps = cv2.distanceTransform(clipped, cv2.DIST_L2, cv2.DIST_MASK_5)
        # Where all pixels are clipped, OpenCV's distances have no meaning.
        distance[of_colour] = highlights.pitch * np.minimum(steps, np.float32(sum(distance.shape)))
    return distance


def border_hardness(highlights: FrameHighlights) -> Floats:
    """Mean hardness, 0 to 1, of the borders of clipped pixels around every part; 1 where there are none."""
    pitch = highlights.pitch
    of_colour = np.zeros((2 * pitch + 1, 2 * pitch + 1), np.uint8)
    of_colour[::pitch, ::pitch] = 1
    beside = (
        cv2.dilate(np.ascontiguousarray(highlights.clipped, np.uint8), of_colour).view(np.bool_)
        & highlights.measured
    )
    sums = np.zeros((2, *part_grid(beside.shape)))
    _sum_borders(beside, np.ascontiguousarray(highlights.darker), pitch, sums)
    rims, hard = map(weighted_sums, sums)
    return np.where(rims > 0.0, hard / np.maximum(rims, 1e-300), 1.0)


@loop
def _sum_borders(beside, darker, pitch, sums):  # type: ignore[no-untyped-def]
    """Of every part: the pixels ``beside`` clipped ones, and the sum of how hard the border is at each."""
    (height, width), part = darker.shape, np.int64(PART)
    for row in range(height):
        for column in range(width):
            if not beside[row, column]:
                continue
            darkest, top, left = np.float32(0.0), row - pitch, column - pitch
            for y in range(top if top >= 0 else row, smaller(row + pitch + 1, height), pitch):
                for x in range(left if left >= 0 else column, smaller(column + pitch + 1, width), pitch):
                    darkest = larger(darkest, darker[y, x])
            sums[0, row // part, column // part] += 1.0
            sums[1, row // part, column // part] += darkest / (darkest + np.float32(_SOFT))


def _colours(highlights: FrameHighlights) -> list[tuple[slice, slice]]:
    """The pixels of each colour."""
    pitch = highlights.pitch
    return [np.s_[row::pitch, column::pitch] for row, column in np.ndindex(pitch, pitch)]


def _with_texture(
    before: Texture, unknown: NDArray[np.int64], highlights: FrameHighlights, events: tuple[Floats, Floats]
) -> Texture:
    """The sums with those of an interval, after which ``unknown`` pixels are not measured and others are as given."""
    reach = 2 * _RIM * highlights.pitch + 1
    near_clipped = cv2.dilate(highlights.clipped.view(np.uint8), np.ones((reach, reach), np.uint8))
    rim = np.flatnonzero(
        near_clipped.view(np.bool_) & highlights.measured & (highlights.darker < _RIM_DARKEST)
    )
    on, off = (np.ascontiguousarray(plane, np.float32).reshape(-1) for plane in events)
    sums = np.zeros((4, *before.pixels.shape))
    seen = highlights.clipped | highlights.measured
    _sum_texture(unknown, rim, on, off, np.ascontiguousarray(highlights.darker), seen, highlights.pitch, sums)
    return Texture(*(old + new for old, new in zip(before, sums, strict=True)))


@loop
def _sum_texture(unknown, rim, on, off, darker, seen, pitch, sums):  # type: ignore[no-untyped-def]
    """The four sums of `Texture`, of one interval, are added to ``sums``.

    The slope is that of the log intensity, at most white; across what is masked, and the border of the image, it counts
    as 0.
    """
    (height, width), part = darker.shape, np.int64(PART)
    for pixel in unknown:
        row, column = pixel // width // part, pixel % width // part
        sums[0, row, column] += on[pixel] + off[pixel]
        sums[1, row, column] += 1.0
    for pixel in rim:
        y, x = pixel // width, pixel % width
        down, right = np.float32(0.0), np.float32(0.0)
        if pitch <= y < height - pitch and seen[y - pitch, x] and seen[y + pitch, x]:
            down = darker[y + pitch, x] - darker[y - pitch, x]
        if pitch <= x < width - pitch and seen[y, x - pitch] and seen[y, x + pitch]:
            right = darker[y, x + pitch] - darker[y, x - pitch]
        row, column = y // part, x // part
        sums[2, row, column] += on[pixel] + off[pixel]
        sums[3, row, column] += np.sqrt(down * down + right * right) / np.float32(2 * pitch)


def _limited(memory: UnshownMemory) -> NDArray[np.float32]:
    """(N,) the expected excess, limited by the slope that events tell and by how steep the borders are.

    As many events come per slope at the rim as beyond white, where they tell it alone. Where nothing moves, or there is
    no rim, nothing is limited.
    """
    height, width = memory.shape
    whole = _TEXTURE_WHOLE * weighted_area((height, width)) / (height * width)
    events, count, rim_events, rim_slope = (
        weighted_sums(part) + whole * part.sum() for part in memory.texture
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = (events + _UNSEEN_EVENTS) / count * (rim_slope / rim_events)
        step = _SOFT * memory.hardness / (1.0 - memory.hardness)
        # Inverse, so that what is not limited is finite.
        inverse = 1.0 / (_SLOPE_REACH * slope + _STEP_REACH * step)
    known = np.where(rim_slope > 0.0, inverse, 0.0).astype(np.float32)
    relative = memory.excess * interpolated(known, memory.pixels, width)
    return np.asarray(memory.excess / np.sqrt(np.float32(1.0) + np.square(relative)), np.float32)


def _with_revealed(
    memory: UnshownMemory, left: NDArray[np.bool_], moved_out: NDArray[np.bool_], distance: Floats
) -> Revealed:
    """The statistics with the pixels that have now ``left`` saturation, or that events have ``moved_out`` of it.

    ``distance`` is how far above its bound each pixel was, (N,) as the masks.
    """
    known, shape = memory.revealed, memory.revealed.excess.shape
    part = parts_of(memory.pixels[left], memory.shape)

    def more(weights: Floats | None) -> Floats:
        sums: Floats = np.bincount(part, weights, known.excess.size).reshape(shape).astype(np.float64)
        return sums

    return Revealed(
        known.excess + more(distance[left]),
        known.expected + more(memory.limited[left]),
        known.pixels + more(None),
        known.moved_excess + float(distance[moved_out].sum(dtype=np.float64)),
        known.moved_expected + float(memory.limited[moved_out].sum(dtype=np.float64)),
    )


def scale_of_all(revealed: Revealed, known: float = 1.0) -> float:
    """R of docs/equations.md: by what the whole image has revealed, and what was ``known`` before."""
    certainty = revealed.moved_expected / (revealed.moved_expected + _PRIOR_OF_ALL)
    told = (revealed.moved_excess + _PRIOR_EXCESS) / (revealed.moved_expected + _PRIOR_EXCESS)
    return float(told**certainty * known ** (1.0 - certainty))


def _corrected(
    scale: np.float32,
    excess: NDArray[np.float32],
    pixels: NDArray[np.int64],
    width: int,
    revealed: Revealed,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The expected ``excess``, (N,), corrected by the pixels that have left saturation, and the variance of its mean.

    It is scaled by what the whole image has revealed, ``scale``, and then by what the pixels around have, in comparison
    with what is expected of them after the first step.
    """
    found, expected, count = (weighted_sums(values) for values in revealed[:3])
    expected *= scale
    factor = (found + _PRIOR_EXCESS) / (expected + _PRIOR_EXCESS)
    surplus = np.maximum(found - expected, 0.0) / (count + _PRIOR_PIXELS)
    unknown = _UNKNOWN_SCALE**2 * _PRIOR_EXCESS / (expected + _PRIOR_EXCESS)
    times, plus, left = (
        interpolated(values.astype(np.float32), pixels, width) for values in (factor, surplus, unknown)
    )
    scaled = scale * excess
    return np.minimum(times * scaled, scaled + plus), left * scaled**2


def expected_excess(memory: UnshownMemory, variance: Floats, initial_variance: float) -> Unshown | None:
    """How far the pixels are expected above their bounds; None if there are no such pixels.

    Parameters
    ----------
    variance, initial_variance
        (H, W) P, and its value at the start: the difference is the noise of the events.
    """
    if len(memory.pixels) == 0:
        return None
    noise = np.empty(len(memory.pixels), np.float32)
    _bound_noise(memory.pixels, variance.reshape(-1), np.float32(initial_variance), noise)
    return Unshown(memory.pixels, memory.expected, noise, memory.doubt, memory)


@loop
def _bound_noise(pixels, variance, initial_variance, noise):  # type: ignore[no-untyped-def]
    """By how much P has grown."""
    for i in range(len(pixels)):
        noise[i] = larger(np.float32(variance[pixels[i]]) - initial_variance, np.float32(0.0))


def above_frames(segment: BridgedSegment, level: Floats, pixels: NDArray[np.int64], bound: Floats) -> Floats:
    """(N,) by how much the ``bound`` of ``pixels`` at the segment's start exceeds the bounds by the frames around.

    The bound is too high by that at most. The frame at the start, of log intensity ``level`` (H, W), bounds the pixel
    without events, the one at the end (`BridgedSegment.floor`) without those from before the segment. Infinite where
    one of them is masked.
    """
    variances = segment.forward_variance, segment.backward_variance
    seen = np.maximum(*(plane.reshape(-1)[pixels] for plane in variances)) < MASKED
    least = np.where(seen, level.reshape(-1)[pixels], -np.inf)
    if segment.floor is not None:
        least = np.maximum(least, segment.floor.reshape(-1)[pixels])
    return np.maximum(bound - least, 0.0)
