"""The frame camera: response, certainty, weighting and covariance, equations (3)-(9)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.errors import SettingsError
from kalux.frames import Frame
from kalux.models import colour
from kalux.settings import CameraSettings

Array = NDArray[np.float64]

_LEVELS: Final = 256
"""Samples of a curve: the levels of an 8-bit camera, below which a slope cannot be told from quantisation."""

_BLACK: Final = 0.5 / 255
"""Response up to which an 8-bit camera stores black."""


@dataclass(frozen=True, eq=False)
class Response:
    """A camera response function CRF and its inverse, as a table.

    Attributes
    ----------
    irradiance, response
        Two increasing (n,) curves, both from 0 to 1 = a saturated pixel: response[i] = CRF(irradiance[i]).

    Raises
    ------
    SettingsError
        If the curves differ in length, are shorter than 2, are not finite, or do not increase from 0 to 1.
    """

    irradiance: Array
    response: Array

    def __post_init__(self) -> None:
        i, r = self.irradiance, self.response
        if i.ndim != 1 or i.shape != r.shape or len(i) < 2:
            raise SettingsError(
                f"response: curves of shapes {i.shape} and {r.shape}; two equal (n,) are needed"
            )
        if not (np.isfinite(i).all() and np.isfinite(r).all()):
            raise SettingsError("response: the curve is not finite")
        if (np.diff(i) <= 0).any() or (np.diff(r) <= 0).any():
            raise SettingsError("response: the curve must increase strictly with irradiance")
        if (i[0], r[0], i[-1], r[-1]) != (0.0, 0.0, 1.0, 1.0):
            raise SettingsError("response: the curve must run from 0 to 1 in both irradiance and response")

    @classmethod
    def linear(cls) -> Response:
        """I^F = I, as the raw values of DAVIS and machine vision cameras."""
        return cls(np.array([0.0, 1.0]), np.array([0.0, 1.0]))

    @classmethod
    def gamma(cls, exponent: float) -> Response:
        """I^F = I^(1/exponent), e.g. 2.2."""
        if not (np.isfinite(exponent) and exponent > 0):
            raise SettingsError(f"response: gamma is {exponent}; a positive exponent, e.g. 2.2, is needed")
        response = np.linspace(0.0, 1.0, _LEVELS)
        return cls(response**exponent, response)

    @classmethod
    def srgb(cls) -> Response:
        """The sRGB transfer function (IEC 61966-2-1)."""
        response = np.linspace(0.0, 1.0, _LEVELS)
        linear = np.where(response <= 0.04045, response / 12.92, ((response + 0.055) / 1.055) ** 2.4)
        return cls(linear, response)

    @classmethod
    def bt709(cls) -> Response:
        """The transfer function of video cameras (ITU-R BT.709-6, item 1.2; that of BT.601 and BT.2020, too).

        Both parts meet in value and slope with the numbers that BT.2020-2, table 4, rounds to 1.0993 and 0.0181.
        """
        alpha, beta = 1.09929682680944, 0.018053968510807
        response = np.linspace(0.0, 1.0, _LEVELS)
        curved = ((response + (alpha - 1.0)) / alpha) ** (1 / 0.45)
        linear = np.where(response < 4.5 * beta, response / 4.5, curved)
        return cls(linear, response)

    @classmethod
    def tabulated(cls, irradiance: Any) -> Response:
        """From the irradiance of equally spaced response levels, e.g. 256 values of a measured inverse CRF.

        The curve is shifted and scaled to run from 0 to 1.
        """
        table = np.asarray(irradiance, dtype=np.float64).ravel()
        if len(table) < 2 or not table[-1] > table[0]:
            raise SettingsError("response: a table of at least two increasing irradiances is needed")
        table = (table - table[0]) / (table[-1] - table[0])
        return cls(table, np.linspace(0.0, 1.0, len(table)))

    @classmethod
    def curve(cls, irradiance: Any) -> Response:
        """From the irradiance at equally spaced response levels, joined by a monotone cubic (PCHIP).

        Parameters
        ----------
        irradiance
            (n,) increasing from 0 to 1, e.g. 33 values of a measured inverse CRF.
        """
        from scipy.interpolate import PchipInterpolator  # slow to import, and rarely needed

        knots = np.asarray(irradiance, dtype=np.float64).ravel()
        if len(knots) < 2 or not np.isfinite(knots).all() or (np.diff(knots) <= 0).any():
            raise SettingsError("response: a curve needs at least two increasing numbers, e.g. curve:0 0.2 1")
        if (knots[0], knots[-1]) != (0.0, 1.0):
            raise SettingsError(
                f"response: the curve runs from {knots[0]:g} to {knots[-1]:g}; 0 to 1 is needed"
            )
        response = np.linspace(0.0, 1.0, _LEVELS)
        table = PchipInterpolator(np.linspace(0.0, 1.0, len(knots)), knots)(response)
        table[0], table[-1] = 0.0, 1.0
        return cls(table, response)

    @classmethod
    def s_curve(cls, black: float) -> Response:
        """A smooth S: black up to the irradiance ``black``, then 3 u^2 - 2 u^3 of u = 0 to 1, up to white.

        What is black rises by a quarter of an 8-bit level, since a response must increase.

        Parameters
        ----------
        black
            0 to less than 1.
        """
        if not (np.isfinite(black) and 0 <= black < 1):
            raise SettingsError(f"response: an s-curve is black up to {black}; 0 to less than 1 is needed")
        # Dense where the curve is flat, so that its inverse is as precise there as elsewhere.
        u = (1.0 - np.cos(np.linspace(0.0, np.pi, 16 * _LEVELS))) / 2.0
        toe = 0.25 / 255 if black > 0 else 0.0
        irradiance, response = black + (1.0 - black) * u, toe + (1.0 - toe) * u**2 * (3.0 - 2.0 * u)
        rising = np.concatenate([[True], np.diff(response) > 0])
        irradiance, response = irradiance[rising], response[rising]
        if black > 0:
            irradiance, response = np.append(0.0, irradiance), np.append(0.0, response)
        irradiance[-1] = response[-1] = 1.0
        return cls(irradiance, response)

    @classmethod
    def named(cls, name: str) -> Response:
        """A name of `kalux.settings.CameraSettings`, as ``"gamma:2.2"``; ``"auto"`` is linear.

        Raises
        ------
        SettingsError
            If there is none of that name, or its numbers do not make a response.
        """
        if name in ("linear", "auto"):
            return cls.linear()
        if name == "srgb":
            return cls.srgb()
        if name == "bt709":
            return cls.bt709()
        kind, _, exponent = name.partition(":")
        if kind == "curve":
            try:
                knots = [float(word) for word in exponent.split()]
            except ValueError:
                raise SettingsError(f"response: {name[:60]!r} holds something that is not a number") from None
            return cls.curve(knots)
        try:
            value = float(exponent)
        except ValueError:
            kind = ""
        if kind == "gamma":
            return cls.gamma(value)
        if kind == "s-curve":
            return cls.s_curve(value)
        raise SettingsError(
            f"response: unknown response {name!r}; known are linear, srgb, bt709, gamma:EXPONENT, s-curve:BLACK "
            "and curve:NUMBERS"
        )

    @property
    def is_linear(self) -> bool:
        """Whether the response is the irradiance itself."""
        return np.array_equal(self.irradiance, self.response)

    def __call__(self, irradiance: Array) -> Array:
        """CRF: response, 0 to 1, of an irradiance; clipped at 1."""
        return np.interp(irradiance, self.irradiance, self.response)

    def inverse(self, response: Array) -> Array:
        """CRF^-1 of equation (3), without its noise. Linear beyond the ends, so that nothing is clipped."""
        inside = np.interp(response, self.response, self.irradiance)
        return inside + np.maximum(response - 1.0, 0.0) + np.minimum(response, 0.0)

    @cached_property
    def _certainty(self) -> tuple[Array, Array]:
        response = np.linspace(0.0, 1.0, _LEVELS)
        irradiance = np.interp(response, self.response, self.irradiance)
        slope = np.diff(response) / np.diff(irradiance)
        return (irradiance[1:] + irradiance[:-1]) / 2.0, slope / slope.max()

    def certainty(self, irradiance: Array) -> Array:
        """f^c of equation (4): slope of the CRF over irradiance, its largest value scaled to 1."""
        return np.interp(irradiance, *self._certainty)

    def weight(self, response: Array) -> Array:
        """f^w of equation (5): the certainty as a function of the response."""
        return self.certainty(self.inverse(response))

    def irradiance_error(self, irradiance: NDArray[np.floating[Any]], error: float) -> Array:
        """What an error of the response is in irradiance: ``error`` times the mean slope of CRF^-1 within it.

        Beyond white it is that of white; what is stored as black is all alike, so that no slope there counts.
        """
        low = np.maximum(self.response - error, _BLACK)
        high = np.clip(self.response + error, 2.0 * _BLACK, 1.0)
        slope = (self.inverse(high) - self.inverse(low)) / (high - low)
        found: Array = np.interp(irradiance, self.irradiance, error * slope)
        return found

    def slope(self, irradiance: NDArray[np.floating[Any]], within: float) -> Array:
        """How much irradiance one of the response is: the mean slope of CRF^-1 ``within`` so much to either side.

        At black and beyond white as in `irradiance_error`.
        """
        return self.irradiance_error(irradiance, within) / within

    def rounding(self, response: Array, half_level: float) -> Array:
        """What ``half_level`` of the response is in irradiance there: half of what is rounded to this response.

        0 of a linear response, all of whose levels are alike, so that the frames' read noise can count it.
        """
        if self.is_linear:
            return np.zeros(np.shape(response))
        low, high = (np.clip(response + side, 0.0, 1.0) for side in (-half_level, half_level))
        return (self.inverse(high) - self.inverse(low)) / 2.0


def named_responses(text: str) -> tuple[Response, ...]:
    """The responses of a setting, each as in `Response.named`: one, or those of red, green and blue between ";".

    Raises
    ------
    SettingsError
        If one is unknown, or there are two or more than three.
    """
    names = [name.strip() for name in text.split(";")]
    if len(names) not in (1, 3):
        raise SettingsError(
            f"response: {text!r} has {len(names)} parts; one response, or three (red;green;blue), are needed"
        )
    return tuple(Response.named(name) for name in names)


@dataclass(frozen=True, eq=False)
class Camera:
    """Everything that is known of the frame camera.

    Attributes
    ----------
    response
        CRF of equation (3).
    weight_table
        (n,) f^w at n equally spaced response levels from 0 to 1, largest 1, where it was measured; None takes
        it from the response, equation (5).
    saturation
        Response, 0 to 1, from which a pixel counts as clipped.
    colours
        CRF of red, green and blue pixels, where they differ; ``response`` is then that of green.
    """

    response: Response
    weight_table: Array | None = None
    saturation: float = CameraSettings.usual_saturation
    colours: tuple[Response, ...] | None = None

    @classmethod
    def named(cls, response: str, saturation: float) -> Camera:
        """From settings; see `named_responses`."""
        found = named_responses(response)
        return cls(found[len(found) // 2], None, saturation, found if len(found) > 1 else None)

    def of_channel(self, channel: int) -> Camera:
        """The camera of the red (0), green (1) or blue (2) pixels."""
        if self.colours is None:
            return self
        return replace(self, response=self.colours[channel], colours=None)

    @classmethod
    def from_inverse_covariance(cls, f_Q: Any, response: Response, saturation: float) -> Camera:
        """From a released ``f_Q`` table: 1 / R_bar for every level, which is sigma_im^-2 f^w.

        Raises
        ------
        SettingsError
            If the table is not a finite, non-negative curve with a positive maximum.
        """
        try:
            table = np.asarray(f_Q, dtype=np.float64).ravel()
        except (TypeError, ValueError) as error:
            raise SettingsError(f"f_Q: a table of numbers is needed, not {f_Q!r:.40}") from error
        if len(table) < 2 or not np.isfinite(table).all() or table.min() < 0 or not table.max() > 0:
            raise SettingsError("f_Q: 1/R_bar must be a finite, non-negative table with a positive maximum")
        return cls(response, table / table.max(), saturation)

    def weight(self, response: Array) -> Array:
        """f^w of equation (5), measured or from the response, 0 to 1."""
        if self.weight_table is None:
            return self.response.weight(response)
        return np.interp(response, np.linspace(0.0, 1.0, len(self.weight_table)), self.weight_table)

    def measured_weight(self, response: Array) -> Array:
        """f^w where it was measured, else 1: noise that is known as that of I needs no slope of the response (K3)."""
        return np.ones(np.shape(response)) if self.weight_table is None else self.weight(response)


def inverse_response(camera: Camera, response: Array, exposure_ratio: float) -> Array:
    """Irradiance I of equation (3), scaled to the reference exposure (section 3.2.1).

    Parameters
    ----------
    response
        (H, W) I^F, 0 to 1.
    exposure_ratio
        Reference exposure time over this frame's: 1.0 in the result is a saturated pixel at the reference.
    """
    return camera.response.inverse(response) * exposure_ratio


class BrightTail(NamedTuple):
    """Numbers of pixels that are at least half as bright as white, and about white."""

    half: int = 0
    white: int = 0

    def joined(self, other: BrightTail) -> BrightTail:
        """The counts of two sets of frames together."""
        return BrightTail(self.half + other.half, self.white + other.white)

    @property
    def scale(self) -> float:
        """Scale of an exponential distribution of the log intensity that falls as much from half of white to white.

        Within 0.3, which is also taken where nothing is white, and 2: beyond these it rests on too few pixels.
        """
        if self.white == 0:
            return _TAIL_BOUNDS[0]
        fall = float(np.log(max(self.half, self.white) / self.white))
        low, high = _TAIL_BOUNDS
        return float(np.clip(np.log(2.0) / max(fall, 1e-3), low, high))


_TAIL_BOUNDS: Final = (0.3, 2.0)

_NO_TAIL: Final = 0.275
"""Scale of a tail that does not go on beyond white, just below the least measured one. That is 0.30 where the sun
glints on cars in a street, and no frame shows how bright that is; it is 0.34 on another recording, and 0.44 to 2 on
forty simulated scenes that go on beyond white, by 0.3 to 4.4 in log intensity."""

_MOST_BEYOND: Final = 0.5
"""Where much of a frame is white, its tail shows only that highlights go far beyond white; how far, pixels that leave
saturation show. On eleven simulated scenes bounds of 0.5, 0.8 and none are about equal (relative MSE 0.165, 0.163,
0.164); without one, scenes of which a large part is white but hardly more come out four times too bright."""


def beyond_white(scale: float) -> float:
    """How far a bright tail of this `BrightTail.scale` goes on beyond white, up to a factor: 0.025 to 0.5."""
    return min(max(scale, _TAIL_BOUNDS[0]) - _NO_TAIL, _MOST_BEYOND)


ABOUT_WHITE: Final = 0.95
"""Intensity, white = 1, that counts as white for `BrightTail`: below where sensors clip unevenly."""


def count_bright(
    camera: Camera,
    image: NDArray[Any],
    white: float = 1.0,
    black: float = 0.0,
    valid: NDArray[np.bool_] | None = None,
    gains: colour.Gains = (1.0, 1.0, 1.0),
) -> BrightTail:
    """`BrightTail` of one frame: (H, W), or (H, W, 3) of which `clipping_level` counts.

    Full scale is ``black`` to ``white``. Only pixels that are ``valid``, (H, W), count; None: all.
    Where pixels count as clipped from lower on than usual, that far below lies what counts as white.
    """
    grey = image if image.ndim == 2 else clipping_level(camera, image, white, black, gains)
    grey = grey if valid is None else grey[valid]
    ends = (camera.saturation, CameraSettings.usual_saturation)
    end, usual = (float(camera.response.inverse(np.array(value))) for value in ends)
    edges = camera.response(min(end / usual, 1.0) * np.array([ABOUT_WHITE / 2, ABOUT_WHITE]))
    edges = edges * (white - black) + black
    if grey.dtype.kind in "iu":
        if edges[1] > np.iinfo(grey.dtype).max:  # white that no pixel can have
            return BrightTail(int(np.count_nonzero(grey >= edges[0])), 0)
        edges = np.ceil(edges).astype(grey.dtype)  # compares as it is
    at_half, at_white = (int(np.count_nonzero(grey >= edge)) for edge in edges)
    return BrightTail(at_half, at_white)


def clipping_level(
    camera: Camera,
    image: NDArray[Any],
    white: float = 1.0,
    black: float = 0.0,
    gains: colour.Gains = (1.0, 1.0, 1.0),
) -> NDArray[Any]:
    """The value of the channel by which a pixel of an RGB frame, (H, W, 3), is clipped: (H, W).

    The largest for which channels that are as large carry more than `colour.CLIPPED_SHARE` of the luminance, which
    ``gains`` balance: in coloured light others stay below white. Full scale is ``black`` to ``white``.
    """
    values = np.moveaxis(image, -1, 0)
    weights = (weight * gain for weight, gain in zip(colour.LUMINANCE, gains, strict=True))
    shares = np.stack(
        [
            weight * _channel_intensity(camera.of_channel(channel), values[channel], white, black)
            for channel, weight in enumerate(weights)
        ]
    )
    least = colour.CLIPPED_SHARE * shares.sum(axis=0)
    level: NDArray[Any] = values.min(axis=0)
    for value in values:
        enough = (shares * (values >= value)).sum(axis=0) > least
        level = np.where(enough, np.maximum(level, value), level)
    return level


def _channel_intensity(camera: Camera, values: NDArray[Any], white: float, black: float) -> Array:
    """I of one channel, (H, W), 1 = white, 0 below black; of whole numbers taken once per level."""
    if values.dtype.kind == "f":
        return camera.response.inverse(np.maximum(values - black, 0.0) / (white - black))
    levels = np.arange(int(values.max(initial=0)) + 1)
    intensity: Array = camera.response.inverse(np.maximum(levels - black, 0.0) / (white - black))[values]
    return intensity


def dark_scale(intensity: Array, counts: NDArray[np.integer[Any]], ceiling: float, white: float) -> float:
    """Scale of an exponential distribution of the log intensity, falling from what black hides towards the dark.

    `BrightTail.scale` at the other end: of the pixels up to half as bright again as the brightest that is black, as
    many are black as such a distribution has. Bounded as there.

    Parameters
    ----------
    intensity, counts
        (N,) levels of I, and how many pixels have each.
    ceiling
        The most that I can be where it is black.
    white
        I of a saturated pixel.
    """
    near = max(min(1.5 * ceiling, ABOUT_WHITE * white), 1.1 * ceiling)
    black, dark = (int(counts[intensity <= most].sum()) for most in (ceiling, near))
    low, high = _TAIL_BOUNDS
    if black == 0:
        return low
    return float(np.clip(np.log(near / ceiling) / max(np.log(dark / black), 1e-3), low, high))


CRUSHED: Final = 1.5 / 255
"""Intensity, white = 1, that black must hide to be no measurement: three times what it hides of a linear response."""


def black_ceiling(camera: Camera, response: Array, exposure_ratio: float) -> Array:
    """What black hides: the most that I can be, (N,); inf where the response is not black.

    A response of less than half a level of 8 bits may be anything up to the irradiance of half a level.

    Parameters
    ----------
    response
        (N,) I^F, 0 to 1.
    exposure_ratio
        As in `inverse_response`.
    """
    half = 0.5 / (_LEVELS - 1)
    hidden = float(camera.response.inverse(np.array(half)))
    return np.where(response < half, hidden * exposure_ratio, np.inf)


def covariance(weight: Array, sigma_im2: float | Array, floor: float) -> Array:
    """R_bar of equation (6): sigma_im^2 / f^w, saturated by a floor of f^w.

    The paper's numbers, 7e5 and 7e7, are inverse variances (docs/equations.md): sigma_im2 = 1 / 7e5.
    """
    return sigma_im2 / np.maximum(weight, floor)


def noise_variance(intensity: Array, noise: tuple[float, float], white: float | Array) -> Array:
    """sigma_im^2 of equation (6) for one frame: that of its read and shot noise.

    Parameters
    ----------
    intensity
        I at the reference exposure; negative counts as 0.
    noise
        (read, shot): standard deviation in the dark, and variance per intensity, in units of a saturated pixel.
    white
        Intensity of a saturated pixel: reference exposure over the frame's own.
    """
    read, shot = noise
    return (read * white) ** 2 + shot * white * np.maximum(intensity, 0.0)


def rounding_error(frame: Frame) -> float:
    """Half a level, white = 1; 0 for images of floating point.

    The most that rounding can change, not its standard deviation, 1 / sqrt(12): where noise is less than a level it is
    the same error in every frame, which no mean takes away.
    """
    return 0.0 if frame.image.dtype.kind == "f" else 0.5 / frame.full_scale


def common_rounding(frame: Frame, response: Response) -> float:
    """The `rounding_error` of I where it is the same at all levels; 0 where each has its own (`Response.rounding`)."""
    return rounding_error(frame) if response.is_linear else 0.0


def repeated_rounding(frame: Frame, camera: CameraSettings) -> float:
    """Standard deviation, white = 1, of rounding that is the same in all frames of a still pixel (K11); 0: none is.

    Noise of more than half a level makes it another one in every frame. Levels of a response that is not linear have
    another width each, and colours have been demosaiced: nothing is said of them.
    """
    half_level = rounding_error(frame)
    repeats = camera.noise[0] <= half_level and camera.is_linear and frame.image.ndim == 2
    return half_level / 3**0.5 if repeats else 0.0


_DARK: Final = 1.5
"""Standard deviations of the noise from black: below, R is that there. Given a value from 0 to here, and that I is at
least 0, the variance of log(I + I_0) is the same within 20 % where the noise is I_0 or more, and 0.6 to 1 of this R."""


def frame_log_covariance(
    intensity: Array,
    weight: Array,
    noise: tuple[float, float],
    white: float,
    log_offset: float,
    rounding: float | Array = 0.0,
) -> Array:
    """R of one frame's pixels, equations (6) and (9) with its read and shot noise, no less than its rounding (K3).

    Taken at its own value as printed, R of a pixel near black depends on its noise, and a mean of many frames gives
    most weight to those in which the noise was bright: a dark pixel becomes too bright by as much as I_0.

    Parameters
    ----------
    intensity, noise, white
        As in `noise_variance`.
    weight
        f^w, as far as it was measured.
    log_offset
        I_0.
    rounding
        Half of what is rounded to the same level, in units of I; 0 where the read noise counts it.
    """
    r_bar = covariance(weight, np.maximum(noise_variance(intensity, noise, white), rounding**2), 1e-6)
    return log_covariance(np.maximum(intensity, _DARK * noise[0] * white), r_bar, log_offset)


def log_intensity(intensity: Array, log_offset: float) -> Array:
    """log(I + I_0), the state of the filter; negative intensities (noise below black) count as 0."""
    return np.log(np.maximum(intensity, 0.0) + log_offset)


def log_bias(intensity: Array, r_bar: Array, log_offset: float) -> Array:
    """The bias term of equation (8): R_bar / (2 (I + I_0)^2)."""
    return log_covariance(intensity, r_bar, log_offset) / 2.0


def log_covariance(intensity: Array, r_bar: Array, log_offset: float) -> Array:
    """R of equation (9): R_bar / (I + I_0)^2."""
    return r_bar / (np.maximum(intensity, 0.0) + log_offset) ** 2
