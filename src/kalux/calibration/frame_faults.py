"""Frames that are not what they say: copies, empty ones, and brightness that steps though the light does not.

Frame grabbers and video encoders repeat a frame where one is late, cameras begin with a black one, and change exposure
or amplification without a word. Events tell such frames from those of a scene that stands still, is dark, or is lit
anew: light that changes makes events. What a frame shows on top of what events explain is common to the whole image
only where it is the camera's.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.intervals import WELL_EXPOSED, Interval, intervals, spread
from kalux.calibration.neighbours import sum_of_neighbours
from kalux.calibration.regression import two_stage
from kalux.calibration.stuck_pixels import RangeWatch
from kalux.calibration.unsteady_gain import likely_log_gains
from kalux.frames import Frame, repeats
from kalux.models.camera import Camera
from kalux.recording import FrameCorrections, Recording, with_frames
from kalux.settings import CameraSettings

Array = NDArray[np.float64]

_SAMPLE: Final = 4096
"""Pixels of a frame, about, that tell whether it has to be looked at together with events."""

_SUSPECT: Final = 0.08
"""Median change of the log intensity from one frame to the next from which it is looked at."""

_LEAST_STEP: Final = 0.1
"""Least step of the log gain that is taken for one. On 65 recordings without any, what frames show beyond their events
is common to the image up to 0.075."""

_SAME: Final = 0.1
"""Difference of log gains that is within their errors: steps of a factor of 2 are found to 0.03 where a half of the
pixels have no events, to 0.1 where nearly all have."""

_ALIKE: Final = 0.5
"""Share of the step by which parts of the image may differ from it."""

_MOST_PARTS: Final = 0.8
"""Share of the parts that have to agree so far: they do in a step of the camera's; what motion, blur and lost events
leave unexplained differs from place to place."""

_LEAST_PARTS: Final = 6
_PARTS: Final = 6  # of the image along each side
_LEAST_IN_PART: Final = 20
_MOST_SAMPLES: Final = 20_000

_FLICKER: Final = 1.0
"""Where the light of the median pixel goes up and down again by more than this share of the step between two frames, a
step may be flicker that a frame catches at another moment than its events say."""

_SEEN: Final = 0.4
"""Where the median pixel, or the mean quiet one, has events for more than this share of the step, it is the light that
changes: so fast that most of it is lost in the pixels' refractory period, or by less than a threshold."""

_UNIFORM: Final = 0.15
"""Share of the pixels that brighten, less that of those that darken, from which the light of a part of the image
changes, if most parts (`_MOST_PARTS`) have as much. Motion has both signs, and noise has them at random."""

_LARGEST_THRESHOLD: Final = 0.5
"""Where the light changes, pixels have events alike, and no regression tells by how much each of them changes it: as
much as this, the largest threshold that is usual."""

_UNSEEN: Final = 1.5
"""Thresholds by which light that is seen to change may do so unseen: where it turns, no pixel has an event before it
has gone back by a whole one."""

_QUIET: Final = 1.0
"""Events of a pixel between two frames up to which it is quiet: it says by itself whether the light stayed."""

_LEAST_QUIET: Final = 0.1
"""Share of quiet pixels below which parts of the image have to agree twice as well. Where nearly all pixels have
events, many are lost: of 48 pans by 250 and 500 pixels a second, steps of 0.66 and 2.1 seemed certain in two."""

_MORE_FLICKER: Final = 3.0
"""The same where another step of the recording is certain: a camera that steps once may step again. Pans by 400 pixels
a second have 0.4 to 1.7 of steps of 0.4 to 0.7, a lamp of 100 Hz that flickers by 30 % some 20 of what it seems to
step. As larger steps are certain and smaller ones are not, gains that go up and down would drift without this."""

_UNEXPLAINED: Final = 0.02
"""Standard deviation of what frames show beyond their events where no gain steps, log intensity for every event of a
pixel. It is always of one sign, that of which more events are lost in the refractory period: -0.002 to -0.03 on four
scenes that pass by at 60 and 400 pixels a second."""

_TREND: Final = 1.5
"""Standard deviation of the log of the last gain over the first: exposures vary by a factor of 4."""

_ROUNDS: Final = 3
"""How often steps are told from what is none, each time without what the steps before leave unexplained."""

_LEAST_UNSTEADY: Final = 0.03
"""Least step of a gain that is never steady, as of a camera whose automatic exposure follows the scene, which nobody
states. At least `_LEAST_OFTEN` are asked for, where more of the image is quiet than `_MUCH_QUIET`, and agrees twice as
well as for larger steps (`_QUIET_ALIKE`). Of 404 simulated recordings of steady gains one seems to have one such step;
of 28 whose gain goes up and down by 13 or 25 % eleven have two to 34."""

_LEAST_OFTEN: Final = 2
_MUCH_QUIET: Final = 0.3
_QUIET_ALIKE: Final = 0.25
_MOVING_ALIKE: Final = 0.5
"""Share of a step from which pixels with events may differ: half-way between what the gain does to them, all of the
step, and the light, nothing, since events have told it. Quiet ones do not tell: light that goes by d before pixels of
a threshold c makes events in d^2 / (2 c^2) of them."""

_SLIGHT: Final = 0.02
_MOST_SLIGHT: Final = 30
_EVERYWHERE: Final = 0.5
"""So many frames whose median log intensity changes by so much, and so does that of so many parts of the image, to a
factor of two, tell whether the gain is unsteady: the first ones. Of recordings of steady gains these are a quarter of
those whose median changes, of others three quarters."""

_PART_ERROR: Final = 0.4
"""Standard error of what frames show beyond their events, as a share of how far most parts of the image are from it
(`_Rest.apart`): it is 0.1 to 0.5 of it in those."""

_LEAST_ERROR: Final = 0.002  # log intensity

_SMALL_OFFSET: Final = 1e-3
"""I_0 for comparing frames: with a larger one, steps of dark pixels would come out too small."""

_CONTRAST: Final = 0.02
"""Of the response, between the darkest and the brightest hundredth of the pixels: with less, a frame is empty."""

_MOST_EMPTY: Final = 0.1
_MOST_COPIES: Final = 0.8
"""Shares of the frames above which they are what the recording is: a scene without contrast, or one that stands still.
Frames of 24 Hz in a video of 120 Hz are copies to 80 %."""

_LIT: Final = 2.0
"""Events of one sign in the median pixel from which the light itself went out, or came."""

_MOVED: Final = 0.01
"""Share of the pixels whose events agree with a neighbour's, above which something moved: background noise of 3 Hz at
24 frames/s has 0.004."""

_LEAST_USABLE: Final = 200  # pixels


class FrameFaults(NamedTuple):
    """What was found.

    Attributes
    ----------
    frames
        The number of all frames.
    copies, empty
        Indices of frames, in order.
    steps
        Indices of the frames from which on another gain holds, and
    gains
        (K,) the gain of every frame, 1 that of the median frame.
    unsteady
        Whether the gain is another in every frame, so that all of them are ``steps``.
    stuck
        (H, W) pixels that always show the same; None: none.
    """

    frames: int
    copies: tuple[int, ...] = ()
    empty: tuple[int, ...] = ()
    steps: tuple[int, ...] = ()
    gains: Array = np.ones(0)
    unsteady: bool = False
    stuck: NDArray[np.bool_] | None = None

    @property
    def first(self) -> int:
        """The first frame that is not empty."""
        return next(i for i, index in enumerate((*self.empty, -1)) if index != i)

    def corrections(self, *, with_first: bool) -> FrameCorrections:
        """What is to be done about it; whether empty frames at the beginning are needed."""
        kept = self.first if with_first else 0
        left_out = sorted({*self.copies, *self.empty[kept:]})
        return FrameCorrections(tuple(left_out), kept, self.gains if self.steps else None, self.stuck)

    def __bool__(self) -> bool:
        """Whether anything was."""
        return bool(self.copies or self.empty or self.steps or self.stuck is not None)


class FrameWatch:
    """Sees all frames of a recording go by, and tells which ones are to be looked at together with events.

    Parameters
    ----------
    camera
        By which responses are compared.
    gain, faulty, stuck
        Whether to look for steps of the gain, for copies and empty frames, and for stuck pixels.
    """

    def __init__(self, camera: Camera, *, gain: bool = True, faulty: bool = True, stuck: bool = True) -> None:
        self._gain, self._faulty, self._stuck = gain, faulty, stuck
        self._response = camera.of_channel(1).response
        self._previous: tuple[Array, Array] | None = None
        self._last: Frame | None = None
        self.frames = 0
        self.copies: list[int] = []
        self.empty: list[int] = []
        self.suspects: list[int] = []
        self.slight: list[int] = []
        self.ranges = RangeWatch()

    def see(self, frame: Frame) -> None:
        """Look at the next frame."""
        index, self.frames = self.frames, self.frames + 1
        step = max(round((frame.image.shape[0] * frame.image.shape[1] / _SAMPLE) ** 0.5), 1)
        image = frame.image[::step, ::step]
        image = np.ascontiguousarray(image if image.ndim == 2 else image[..., 1])
        response = dataclasses.replace(frame, image=image, valid=None).normalised()
        low, high = np.quantile(response, (0.01, 0.99))
        is_copy = repeats(frame, self._last)
        self._last = frame
        if high - low < _CONTRAST:
            if self._faulty:
                self.empty.append(index)
            return
        if self._stuck:
            self.ranges.see(frame)
        if is_copy and self._faulty:
            self.copies.append(index)
        elif not is_copy and self._gain:
            self._compare(index, frame, response)

    def _compare(self, index: int, frame: Frame, response: Array) -> None:
        """Whether most of the image is brighter, or darker, than in the frame before, exposure times accounted for."""
        intensity = self._response.inverse(response) / frame.amplified_exposure
        if self._previous is not None:
            before, earlier = self._previous
            both = _inside(response) & _inside(before)
            if np.count_nonzero(both):
                changes = np.log(intensity[both] / earlier[both])
                change = float(np.median(changes))
                if abs(change) >= _SUSPECT:
                    self.suspects.append(index)
                if abs(change) >= _SLIGHT and len(self.slight) < _MOST_SLIGHT:
                    parts = _middles(changes, _part(np.flatnonzero(both), *both.shape))
                    if np.count_nonzero(np.abs(parts - change) < abs(change)) >= _EVERYWHERE * _PARTS**2:
                        self.slight.append(index)
        self._previous = response, intensity


def _inside(response: Array) -> NDArray[np.bool_]:
    low, high = WELL_EXPOSED
    return (response > low) & (response < high)


def find_frame_faults(recording: Recording, camera: CameraSettings, watch: FrameWatch) -> FrameFaults:
    """Judge the frames that a watch has noticed by their events.

    Parameters
    ----------
    recording
        With frames and exposures. Its events are read up to the last of those frames.
    camera
        Response, saturation and black level.
    watch
        Which has seen all frames of the recording.

    Raises
    ------
    ExposureError
        If the frames' exposures are not known.
    """
    empty = watch.empty if len(watch.empty) <= _MOST_EMPTY * watch.frames else []
    copies = watch.copies if len(watch.copies) <= _MOST_COPIES * watch.frames else []
    found = FrameFaults(watch.frames, stuck=watch.ranges.stuck(recording))
    if not (empty or copies or watch.suspects or watch.slight):
        return found
    compared = dataclasses.replace(camera, log_offset=_SMALL_OFFSET)
    certain_copies, certain_empty = list[int](), list[int]()
    for index, interval in _intervals(recording, compared, {*empty}, {*empty, *copies}):
        on, off = interval.counts(recording.sensor_size)
        if index in copies:
            if _shows_motion(on, off, interval.usable):
                certain_copies.append(index)
        elif abs(float(np.median(on - off))) < _LIT:
            certain_empty.append(index)
    logs = np.zeros(watch.frames)
    rests = _rests(recording, compared, watch, {*watch.suspects, *watch.slight})
    unseen = _unseen(rests.values())
    unsteady = unseen < _LEAST_STEP and sum(rest.is_unsteady for rest in rests.values()) >= _LEAST_OFTEN
    suspects = {i: rests[i] for i in watch.suspects if i in rests and abs(rests[i].step) > unseen}
    if unsteady:
        others = set(range(1, watch.frames)) - {*rests}
        logs = _unsteady_log_gains(watch.frames, rests | _rests(recording, compared, watch, others))
    elif any(rest.is_certain(rest.step) for rest in suspects.values()):
        others = set(range(1, max(suspects))) - {*suspects}
        logs = _log_gains(watch.frames, _steps(suspects | _rests(recording, compared, watch, others)))
    return found._replace(
        copies=tuple(certain_copies),
        empty=tuple(certain_empty),
        steps=tuple((1 + np.flatnonzero(np.diff(logs))).tolist()),
        gains=np.asarray(np.exp(logs - np.sort(logs)[watch.frames // 2]), np.float64),
        unsteady=unsteady,
    )


def _unseen(rests: Iterable[_Rest]) -> float:
    """Log intensity by which the light may change unseen; 0 where it is not seen to change between any two frames."""
    thresholds = [abs(rest.lit.changed / rest.lit.net) for rest in rests if rest.lit.is_seen]
    return _UNSEEN * float(np.median(thresholds)) if thresholds else 0.0


def _intervals(
    recording: Recording, camera: CameraSettings, empty: set[int], asked: set[int]
) -> Iterator[tuple[int, Interval]]:
    """Frames that are asked for, with the interval that ends there; where the first are empty, that which begins there.

    What is beside an empty frame cannot be compared with it.
    """
    if not asked:
        return
    most = max(asked) + 2
    for before, interval in enumerate(intervals(recording, camera, margin=0, most_frames=most, apart=0)):
        if before in empty and all(i in empty for i in range(before)):
            yield before, interval
        elif before + 1 in asked and not (before in empty and before + 1 not in empty):
            yield before + 1, interval


def _shows_motion(on: NDArray[Any], off: NDArray[Any], usable: NDArray[np.bool_]) -> bool:
    """Whether neighbouring pixels had events of one sign, in places that frames show well: noise has them alone."""
    net = on - off
    rising, falling = net > 0, net < 0
    moved = (rising & (sum_of_neighbours(rising.view(np.uint8)) > 0)) | (
        falling & (sum_of_neighbours(falling.view(np.uint8)) > 0)
    )
    count = np.count_nonzero(usable)
    return bool(count >= _LEAST_USABLE and np.count_nonzero(moved & usable) >= _MOVED * count)


class _Quiet(NamedTuple):
    """Pixels that say by themselves whether the light stayed (`_QUIET`).

    Attributes
    ----------
    share
        Of all pixels.
    light
        By how much the light of their mean changes by its events, log intensity, and
    beyond
        what the median one shows beyond that.
    """

    share: float = 0.0
    light: float = 0.0
    beyond: float = 0.0


class _Lit(NamedTuple):
    """Whether the light of the whole image changes.

    Attributes
    ----------
    changed
        Median change of the log intensity, by the frames.
    net
        ON less OFF events of a pixel, mean.
    alike
        Share of the pixels with more ON than OFF events, less that of the others: most parts of the image have as much
        or more of it, with this sign. 0 where they differ in the sign.
    """

    changed: float
    net: float
    alike: float

    @property
    def is_seen(self) -> bool:
        """Whether events show it to change, as frames do."""
        return abs(self.alike) >= _UNIFORM and self.changed * self.alike > 0 and self.net * self.alike > 0


class _Rest(NamedTuple):
    """What the second of two frames shows beyond what its events explain.

    Attributes
    ----------
    step
        Of the log intensity of the whole image.
    events
        Mean number of a pixel's events.
    apart
        How far parts of the image are from that: most of them (`_MOST_PARTS`) less than this.
    light, back_and_forth
        Log intensity by which the light of the median pixel changes, and goes up and down again, by its events.
    quiet
        What quiet pixels show; all 0 where there are hardly any.
    moving
        What the median of the others shows beyond its events; 0 where there are hardly any.
    lit
        What events say of the light of the whole image.
    """

    step: float
    events: float
    apart: float
    light: float
    back_and_forth: float
    quiet: _Quiet
    moving: float
    lit: _Lit

    def is_gain(self, step: float, flicker: float, at_least: float = _LEAST_STEP) -> bool:
        """Whether a step is the gain's and not the light's, which flickers by less than a share of the step."""
        lit = max(light * np.sign(step) for light in (self.light, self.quiet.light)) >= _SEEN * abs(step)
        return bool(abs(step) >= at_least and not lit and self.back_and_forth < flicker * abs(step))

    @property
    def is_unsteady(self) -> bool:
        """Whether this is a small step that can only be the gain's (`_LEAST_UNSTEADY`)."""
        step, quiet = self.step, self.quiet
        if abs(step) >= _LEAST_STEP:
            return False
        alike = self.apart < _ALIKE * abs(step) and abs(quiet.beyond - step) < _QUIET_ALIKE * abs(step)
        moving = abs(self.moving - step) < _MOVING_ALIKE * abs(step)
        many = quiet.share >= _MUCH_QUIET
        return alike and moving and many and self.is_gain(step, _FLICKER, _LEAST_UNSTEADY)

    def is_certain(self, step: float) -> bool:
        """Whether a step is the gain's whatever other frames show: most of the image, and quiet pixels, have it."""
        alike = _ALIKE if self.quiet.share >= _LEAST_QUIET else _ALIKE / 2
        agreed = self.apart < alike * abs(step) and abs(self.quiet.beyond - step) < _ALIKE * abs(step)
        return agreed and self.is_gain(step, _FLICKER)


def _rest(interval: Interval, on: NDArray[Any], off: NDArray[Any]) -> _Rest | None:
    """What frames show beyond their events; None where too few pixels tell, or events do not explain the frames."""
    if np.count_nonzero(interval.usable) < _LEAST_USABLE:
        return None
    chosen = spread(interval.usable, _MOST_SAMPLES)
    ups, downs = (counts.ravel()[chosen].astype(np.float64) for counts in (on, off))
    change = interval.change.ravel()[chosen]
    columns = [column for column in (ups, -downs) if np.count_nonzero(column) > len(column) // 100]
    explained = np.column_stack([*columns, np.ones(len(change))])
    fit = two_stage(change, explained, explained)
    if fit is None or (fit.solution[:-1] < 0).any():
        return None
    thresholds = fit.solution[:-1].tolist()
    rest = change - sum(c * column for c, column in zip(thresholds, columns, strict=True))
    part = _part(chosen, *interval.change.shape)
    middles = _middles(rest, part)
    if len(middles) < _LEAST_PARTS:
        return None
    step = float(np.median(middles))
    largest = max(thresholds, default=0.0)
    net = ups - downs
    lit = _Lit(float(np.median(change)), float(np.mean(net)), _most(_means(np.sign(net), part)))
    if lit.is_seen:
        largest = max(largest, _LARGEST_THRESHOLD)
    is_quiet = ups + downs <= _QUIET
    quiet, moving = _Quiet(), 0.0
    if np.count_nonzero(is_quiet) >= _LEAST_IN_PART:
        light = float(np.mean(net[is_quiet])) * largest
        quiet = _Quiet(float(np.mean(is_quiet)), light, float(np.median(rest[is_quiet])))
    if np.count_nonzero(~is_quiet) >= _LEAST_IN_PART:
        moving = float(np.median(rest[~is_quiet]))
    return _Rest(
        step=step,
        events=float(np.mean(ups + downs)),
        apart=float(np.sort(np.abs(middles - step))[math.ceil(_MOST_PARTS * len(middles)) - 1]),
        light=float(np.median(net)) * largest,
        back_and_forth=float(np.median(np.minimum(ups, downs))) * largest,
        quiet=quiet,
        moving=moving,
        lit=lit,
    )


def _part(pixels: NDArray[np.int64], height: int, width: int) -> NDArray[np.int64]:
    """(N,) in which of the parts of an image each of its pixels lies, by their indices."""
    rows, across = np.divmod(pixels, width)
    return np.asarray((rows * _PARTS // height) * _PARTS + across * _PARTS // width, np.int64)


def _means(values: Array, part: NDArray[np.int64]) -> Array:
    """The mean of the values in each part that has enough of them."""
    count = np.bincount(part, minlength=_PARTS**2)
    many = count >= _LEAST_IN_PART
    return np.asarray(np.bincount(part, values, _PARTS**2)[many] / count[many], np.float64)


def _most(values: Array) -> float:
    """What most of the values (`_MOST_PARTS`) are at least, away from 0; 0 where most have no one sign."""
    low, high = np.quantile(values, (1 - _MOST_PARTS, _MOST_PARTS))
    return float(max(low, 0.0) + min(high, 0.0))


def _middles(values: Array, part: NDArray[np.int64]) -> Array:
    """The median of the values in each part that has enough of them."""
    many = np.flatnonzero(np.bincount(part, minlength=_PARTS**2) >= _LEAST_IN_PART)
    return np.array([np.median(values[part == i]) for i in many])


def _rests(
    recording: Recording, camera: CameraSettings, watch: FrameWatch, asked: set[int]
) -> dict[int, _Rest]:
    """What frames that are asked for show beyond the events since those before them that are no copies, nor empty.

    Events since a copy do not tell what changed since the frame that it repeats, and an empty frame shows no step. Over
    so long a time less is known of light that comes and goes: there only what is certain counts. A step of the gain
    against a change of the scene may leave a frame as bright as the one before.
    """
    found: dict[int, _Rest] = {}
    if not asked:
        return found
    left_out = {*watch.copies, *watch.empty}
    kept = [index for index in range(max(asked) + 1) if index not in left_out]
    shown = with_frames(
        recording, lambda: (f for index, f in enumerate(recording.frames()) if index not in left_out)
    )
    each = intervals(shown, camera, margin=0, most_frames=len(kept), apart=0)
    for index, interval in zip(kept[1:], each, strict=True):
        rest = _rest(interval, *interval.counts(recording.sensor_size)) if index in asked else None
        if rest is not None and (rest.is_certain(rest.step) or index - 1 not in left_out):
            found[index] = rest
    return found


def _steps(rests: dict[int, _Rest]) -> dict[int, float]:
    """Steps of the log gain, without what events always leave unexplained: that would add up from step to step.

    To begin with, all that frames show is a step. Where none is certain without what is unexplained then, there are
    none: events that are lost in all of the image look like steps, too.
    """
    beyond = _beyond(rests, rests)
    if not any(rests[index].is_certain(step) for index, step in beyond.items()):
        return {}
    steps = _gains(rests, beyond)
    for _ in range(_ROUNDS - 1):
        steps = _gains(rests, _beyond(rests, steps))
    return steps


def _beyond(rests: dict[int, _Rest], steps: Iterable[int]) -> dict[int, float]:
    """What frames show beyond their events, in order, without what these leave unexplained of frames that step."""
    unexplained = _unexplained([rests[index] for index in sorted(steps)])
    return {index: rests[index].step - unexplained * rests[index].events for index in sorted(rests)}


def _gains(rests: dict[int, _Rest], beyond: dict[int, float]) -> dict[int, float]:
    """Those that are steps of the gain, given that one is."""
    return {index: step for index, step in beyond.items() if rests[index].is_gain(step, _MORE_FLICKER)}


def _unexplained(rests: list[_Rest]) -> float:
    """Of what frames that step show beyond their events, the part that is no step: log intensity for every event.

    By Bayes' rule, from how much that is (`_UNEXPLAINED`) and how little of a trend gains of cameras have (`_TREND`).
    """
    events = np.cumsum([0.0, *(rest.events for rest in rests)])
    logs = np.cumsum([0.0, *(rest.step for rest in rests)])
    away = events - events.mean()
    if events[-1] == 0:
        return 0.0
    of_trend = float(events[-1]) ** 2 / _TREND**2
    return of_trend * float(away @ logs / (away @ away)) / (of_trend + 1 / _UNEXPLAINED**2)


def _log_gains(frames: int, steps: dict[int, float]) -> Array:
    """(K,) log gains, that of the first frame 0.

    One that is as good as one before is that one: cameras go back to where they were, and errors of steps do not
    add up.
    """
    logs, known = np.zeros(frames), [0.0]
    for index, step in sorted(steps.items()):
        reached = float(logs[index - 1]) + step
        nearest = min(known, key=lambda level: abs(level - reached))
        if abs(nearest - reached) > _SAME:
            known.append(reached)
            nearest = reached
        logs[index:] = nearest
    return logs


def _unsteady_log_gains(frames: int, rests: dict[int, _Rest]) -> Array:
    """(K,) log gains where every frame has its own. Quiet pixels tell most where there are many."""
    steps, errors = np.zeros(frames - 1), np.full(frames - 1, np.inf)
    for index, rest in rests.items():
        steps[index - 1] = rest.quiet.beyond if rest.quiet.share >= _MUCH_QUIET else rest.step
        errors[index - 1] = max(_PART_ERROR * rest.apart, _LEAST_ERROR)
    return likely_log_gains(steps, errors)
