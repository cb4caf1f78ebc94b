"""Images: the filter's estimate at one moment, and the image of linear intensities that is made of it.

`Estimate` is the filter's state, `Image` what users get. In between: the prior on highlights (K6, K15), averaging of
neighbours (K12), the variance that is given out (K11), and the colours of a Bayer sensor or of frames in RGB.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.along import Along, joined_along, log_taken, put, put_intensity, taken
from kalux.augmentation.bridge import RANDOM
from kalux.augmentation.highlights import Unshown
from kalux.augmentation.motion import Paths
from kalux.augmentation.subthreshold import UNKNOWN_CHANGE
from kalux.compiled import loop
from kalux.filters.highlights import calm_specks, given_spread, keep_white, lifted, read_unshown, tempered
from kalux.filters.readout import HighlightPrior, Subthreshold, read_out
from kalux.filters.surfaces import Unmeasured
from kalux.filters.uncertainty import (
    UNSHOWN_SHARE,
    Around,
    add_blurred,
    add_dark_doubt,
    add_lag,
    add_pattern,
    before_averaging,
    given_variance,
    keep_rounding,
    subthreshold_variance,
)
from kalux.frames import Mosaic
from kalux.models.camera import Response
from kalux.models.colour import Gains, calm_highlights, demosaic, luminance
from kalux.models.dark_levels import DarkDoubt

_INFINITE: Final = np.full(1, np.inf, np.float32)
"""The variance of all pixels where it is not wanted."""
_INFINITE.flags.writeable = False


@dataclass(frozen=True, eq=False)
class Image:
    """One reconstructed image.

    Attributes
    ----------
    t
        Its time, int us.
    intensity
        float32 (H, W), linear: 1.0 = a saturated frame pixel at the reference exposure; more in highlights.
    variance
        float32 (H, W): the variance of log(intensity + log_offset), from P (20); infinite for the complementary filter,
        which has none.
    log_offset
        I_0 of equation (8).
    final
        Whether it will not change with more data. With lookahead an image is final one frame later.
    colour
        float32 (H, W, 3), linear red, green, blue with the scale of ``intensity``, which of a Bayer sensor holds each
        pixel's own channel before white balance, and of frames in RGB the luminance. None: the frames are grey.
    fixed_pattern
        Standard deviation, in units of the intensity, of the offsets of the sensor's pixels that ``variance`` counts:
        a number, or (H, W) behind a response that bends.
    """

    t: int
    intensity: NDArray[np.float32]
    variance: NDArray[np.float32]
    log_offset: float
    final: bool
    colour: NDArray[np.float32] | None = None
    fixed_pattern: float | NDArray[np.float32] = 0.0

    def __repr__(self) -> str:
        height, width = self.intensity.shape
        least, most = (f"{limit(self.intensity):.4g}" for limit in (np.min, np.max))
        return (
            f"<kalux.Image at {self.t} us: {width} x {height} pixels, {'grey' if self.colour is None else 'colour'}, "
            f"intensity {least} to {most}, {'final' if self.final else 'not final'}>"
        )

    def grey(self) -> Image:
        """The same image without colours: its intensity is the luminance of ``colour``."""
        if self.colour is None:
            return self
        return dataclasses.replace(self, intensity=luminance(self.colour), colour=None)


@dataclass(frozen=True, eq=False)
class Estimate:
    """The filter's estimate at one moment, before the prior on highlights and averaging of neighbours.

    Attributes
    ----------
    t
        Its time, int us.
    log_intensity, variance
        (H, W): L = log(I + I_0), and P. float32; float64 with augmentation "paper".
    white
        log(I + I_0) of a saturated pixel in the frames around.
    final
        As of `Image`.
    moving
        (H, W) bool: pixels with an event in this frame interval (before or after ``t``) or the one before, and those
        that neither frame measures; None: not known.
    between
        0 at a frame, 1 half-way between two, and 1 where the next one is not known or not used.
    chroma
        Of frames in RGB: float32 (H, W, 3), the ratios of the channels to the luminance; else None.
    unshown
        Pixels that no frame has measured until then, of which L is a lower bound; None: there are none.
    silent_change
        (H, W): mean square change of the silent pixels (without events) around each, from one frame to the next; None:
        not known.
    around
        The variances and event counts between the two frames around (K11); None: not known, or there is only one frame.
    unmeasured
        Pixels that neither of the frames around measures, nor the only one known; None: not known.
    exposed
        Exposure over frame interval, where the next frame is known; more where the intensity reverses more often
        (`kalux.filters.uncertainty.changed_within`).
    since
        Where the next frame is not known or not used: time to the only frame, in frame intervals; else None.
    signalled_variance
        (H, W): variance of what frames and events have signalled, where that is not P; None: P. Both ways in time, P
        includes the errors that both directions share: subthreshold changes, which K11 adds itself.
    paths
        Of what moves between the frames around (K16); None: not looked for, or nothing moves.
    share
        Of the way from the frame before to the one after; 0 where that is not known or not used.
    texture
        (H, W) float32: variance by which neighbours one apart differ (K12); None: `View.neighbours` squared.
    """

    t: int
    log_intensity: NDArray[np.floating[Any]]
    variance: NDArray[np.floating[Any]]
    white: float
    final: bool
    moving: NDArray[np.bool_] | None = None
    between: float = 0.0
    chroma: NDArray[np.float32] | None = None
    unshown: Unshown | None = None
    silent_change: NDArray[np.floating[Any]] | None = None
    around: Around | None = None
    unmeasured: Unmeasured | None = None
    exposed: float = 0.0
    since: float | None = None
    signalled_variance: NDArray[np.floating[Any]] | None = None
    paths: Paths | None = None
    share: float = 0.0
    texture: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class View:
    """The settings and the camera's properties by which images are made of estimates.

    Attributes
    ----------
    log_offset
        I_0 of equation (8).
    threshold2
        c^2: the product of the thresholds on and off.
    neighbours
        `kalux.settings.FilterSettings.neighbours` (K12).
    highlight_scale, highlight_spread
        Of the prior on what lies beyond white (K6): its standard deviation in log intensity, 0 for none, and that of
        the log of the thresholds' error where no frame corrects it.
    highlight_gain, highlight_growth
        Share of what events say there that is believed, and how far highlights beyond that scale are (K6).
    unknown_variance
        P of a pixel that has not been measured.
    lag_variance
        Variance by which slow pixels are off the light at a moment, at 0.02 of white (K11); 0: none.
    fixed_pattern
        Standard deviation of the pixels' offsets in the frames (K11), of stored values, white = 1.
    response
        Of grey frames whose response bends; None: stored values are light.
    rounding
        Standard deviation of the rounding that all frames of a still pixel share (K11), white = 1; 0: none.
    dark
        What frames of the usual exposure may be wrong by in the dark (K11); None: hardly anything.
    mosaic, gains
        Pattern of a Bayer sensor, None of others, and its white balance.
    """

    log_offset: float
    threshold2: float
    neighbours: float
    highlight_scale: float
    highlight_spread: float
    highlight_gain: float
    highlight_growth: float
    unknown_variance: float
    lag_variance: float
    fixed_pattern: float
    response: Response | None
    rounding: float
    dark: DarkDoubt | None
    mosaic: Mosaic | None
    gains: Gains

    def prior(self, white: float) -> HighlightPrior:
        """The prior on highlights (K6) beyond ``white``, a log intensity."""
        return HighlightPrior(
            white=white,
            scale2=self.highlight_scale**2,
            unknown_scale=self.highlight_spread**2,
            gain=self.highlight_gain,
            growth=self.highlight_growth,
        )


def make_image(estimate: Estimate, view: View, *, with_variance: bool = True) -> Image:
    """The image of an estimate, with the prior on highlights (K6, K15) and averaging of neighbours (K12).

    Where the variance is not wanted it is infinite: computing it (K11) takes a seventh of the time.
    """
    prior = view.prior(estimate.white)
    log_intensity, variance, unshown = _above_bounds(estimate, prior)
    moving, change = estimate.moving, estimate.silent_change
    if change is None and moving is not None:  # K11 needs it only there
        change = np.full(log_intensity.shape, UNKNOWN_CHANGE * view.threshold2, np.float32)
    half_way = RANDOM if estimate.around is None else estimate.around.half_way
    subthreshold = subthreshold_variance(
        estimate.between, view.threshold2, estimate.exposed, estimate.since, half_way
    )
    # Colours of a mosaic's highlights depend on it, and how far the frames along the paths are believed.
    along = _along(estimate)
    with_variance |= view.mosaic is not None
    needs_variance = with_variance or along is not None
    # That after averaging counts only for pixels that neither frame measures (K11).
    needs_averaged = needs_variance and (moving is None or _misses_some(estimate))
    averaging = before_averaging(subthreshold)
    intensity, total, levels = read_out(
        log_intensity,
        _untied(variance, estimate.unmeasured, averaging),
        view.log_offset,
        prior,
        moving=moving,
        subthreshold=averaging,
        silent_change=change,
        difference=view.neighbours,
        pitch=1 if view.mosaic is None else 2,  # to neighbours of the same colour
        unshown=None if unshown is None else unshown.pixels,
        unmeasured=estimate.unmeasured,
        texture=estimate.texture,
        with_variance=needs_averaged,
    )
    if unshown is not None:
        read_unshown(intensity, levels, estimate.log_intensity, unshown, view.log_offset, prior)
    if estimate.unmeasured is not None:
        keep_white(intensity, estimate.log_intensity, estimate.unmeasured.pixels, view.log_offset, prior)
        if view.neighbours > 0 and view.mosaic is None:  # a mosaic's neighbours are of other colours
            calm_specks(intensity, variance, view.log_offset, estimate.unmeasured)
    white = float(np.exp(estimate.white) - view.log_offset)
    pattern = _pattern(intensity, view, white) if needs_variance else 0.0
    if not needs_variance:
        total = _infinite(intensity.shape)
    elif moving is not None and change is not None:
        signalled = estimate.variance if estimate.signalled_variance is None else estimate.signalled_variance
        given = signalled if unshown is None else given_spread(signalled, unshown)
        total = given_variance(
            given, moving, change, subthreshold, estimate.around, total if needs_averaged else None
        )
        if np.any(pattern):
            add_pattern(total, intensity, view.log_offset, pattern)
    if needs_variance and view.lag_variance > 0 and estimate.around is not None:
        add_lag(total, intensity, estimate.around, view.lag_variance)
    if needs_variance and unshown is not None:
        total.reshape(-1)[unshown.pixels] += np.float32(UNSHOWN_SHARE) * unshown.doubt
    if along is not None:
        _look_along(intensity, total, along, view.log_offset)
        if not with_variance:
            total = _infinite(intensity.shape)
    if with_variance and estimate.around is not None and change is not None:
        add_blurred(total, change, estimate.around, estimate.exposed, view.threshold2)
    if with_variance and moving is not None and view.rounding > 0:
        keep_rounding(total, intensity, moving, view.log_offset, view.rounding * white)
    if with_variance and moving is not None and view.dark is not None:
        add_dark_doubt(total, intensity, view.dark)
    image = Image(estimate.t, intensity, total, view.log_offset, estimate.final, fixed_pattern=pattern)
    colour = _coloured(image, estimate, view, white)
    return image if colour is None else dataclasses.replace(image, colour=colour)


def _untied(
    variance: NDArray[Any], unmeasured: Unmeasured | None, subthreshold: Subthreshold
) -> NDArray[Any]:
    """(H, W) P, and what pixels that neither frame around measures have above others, which a frame ties (K11)."""
    if unmeasured is None or len(unmeasured.pixels) == 0 or subthreshold.above_moving == 0:
        return variance
    untied = variance.copy()
    _add(np.float32(subthreshold.above_moving), unmeasured.pixels, untied.reshape(-1))
    return untied


@loop
def _add(more, pixels, plane):  # type: ignore[no-untyped-def]
    for i in range(len(pixels)):
        plane[np.uint64(pixels[i])] += more


def _pattern(intensity: NDArray[Any], view: View, white: float) -> float | NDArray[np.float32]:
    """Standard deviation of the pixels' offsets in units of I: one, or (H, W) behind a response that bends."""
    if view.response is None or view.fixed_pattern == 0:
        return view.fixed_pattern * white
    offsets = view.response.irradiance_error(intensity / white, view.fixed_pattern)
    return np.asarray(offsets * white, np.float32)


def _misses_some(estimate: Estimate) -> bool:
    """Whether there are pixels that neither frame around is known to measure."""
    around, unmeasured = estimate.around, estimate.unmeasured
    return around is not None and unmeasured is not None and around.misses_some(unmeasured.pixels)


def _infinite(shape: tuple[int, ...]) -> NDArray[np.float32]:
    """The variance of an image that is not wanted, in no memory."""
    return np.ndarray(shape, np.float32, _INFINITE, strides=(0, 0))


def _along(estimate: Estimate) -> Along | None:
    """What the frames around an image show along the paths of what moves; None: nothing that is not known."""
    motion = None if estimate.paths is None else estimate.paths.motion
    return None if motion is None else Along(motion, estimate.share)


def _look_along(
    intensity: NDArray[np.float32], variance: NDArray[np.float32], along: Along, log_offset: float
) -> None:
    """Join an image with what the frames around show along the paths of what moves (K16). In place."""
    level, doubt = joined_along(along, log_taken(along, intensity, log_offset), taken(along, variance))
    put_intensity(along, intensity, level, log_offset)
    put(along, variance, doubt)


def _above_bounds(
    estimate: Estimate, prior: HighlightPrior
) -> tuple[NDArray[Any], NDArray[Any], Unshown | None]:
    """L, P, and the unshown pixels, raised from bounds to where they are expected (K15)."""
    if estimate.unshown is None:
        return estimate.log_intensity, estimate.variance, None
    unshown = tempered(estimate.unshown, estimate.log_intensity, prior)
    level, variance = lifted(estimate.log_intensity, estimate.variance, unshown)
    return level, variance, unshown


def _coloured(image: Image, estimate: Estimate, view: View, white: float) -> NDArray[np.float32] | None:
    """The image's colours: demosaiced, or the luminance with the frames' chromaticity; None where frames are grey."""
    if estimate.chroma is not None:
        return estimate.chroma * image.intensity[..., None]
    if view.mosaic is None:
        return None
    colour = demosaic(image.intensity, view.mosaic, view.log_offset, view.gains)
    # The complementary filter has no variance: its highlights are treated as never measured.
    # An expected excess above a bound (K15) says nothing about the colour: there, P counts.
    known = np.maximum(image.variance, estimate.variance)
    return calm_highlights(colour, np.minimum(known, np.float32(view.unknown_variance)), view.gains, white)
