"""Settings: frozen dataclasses with units and reasons, presets, TOML in and out."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal

from kalux.errors import InputError, KaluxError, SettingsError, did_you_mean

FilterName = Literal["akf", "cf"]
AugmentationName = Literal["bridge", "paper"]
AUTO: Final = "auto"
"""In files and flags, stands for None: estimated from the recording."""

EVEN: Final = "even"
"""Of `FilterSettings.dark_shares`: nothing is known of how often frames show which dark light."""

NO_DARK_STEPS: Final = "none"
"""Of `EventSettings.dark_steps`: events of dark pixels are as good as others."""

SolutionName = Literal["exact", "printed"]
MotionName = Literal["auto", "on", "off"]

UNKNOWN_LOG_OFFSET: Final = 0.03
"""I_0 where it is not known: what real recordings of DAVIS sensors agree with best (docs/tuning.md)."""

USUAL_PATTERN: Final = 0.005
"""Fixed pattern where nothing tells it: half a percent, as of DAVIS sensors (0.002 of slider_depth's, 0.008 of
newton's, 0.009 of street's)."""


def chosen_response(setting: str, stated: str | None) -> str:
    """The camera's response that a setting names, or, where that is ``"auto"``, the recording states."""
    return (stated or "linear") if setting == AUTO else setting


@dataclass(frozen=True, kw_only=True)
class CameraSettings:
    """The frame camera, equations (3)-(9).

    Attributes
    ----------
    response
        ``"linear"`` (raw sensor values: DAVIS, machine vision), ``"srgb"``, ``"bt709"`` (video), ``"gamma:EXPONENT"``,
        ``"s-curve:BLACK"``, or a measured ``"curve:0 0.0012 ... 1"``: the irradiance at equally spaced response levels
        (`kalux calibrate response`). Three with ";" between them are those of red, green and blue. ``"auto"``: what
        the recording states, else linear.
    log_offset
        I_0 of equation (8); white = 1. Events are steps of log I, so it must be small; below the dark current
        of the event pixels it only magnifies noise. None: an estimate from the recording
        (`kalux.calibration.event_model`), 0.03 where it cannot be told. The paper's code: 1.
    frame_noise
        sigma_im of equation (6) for one frame in the dark: standard deviation, white = 1. None: an estimate from the
        recording (`kalux.calibration.frame_noise`).
    shot_noise
        What sigma_im^2 grows by with the intensity: variance per intensity, white = 1. None: an estimate as of
        ``frame_noise``; 0 where that is given.
    usual_frame_noise
        The frame noise where the recording does not tell it, at half of white; all of it is read noise, unless dark
        pixels show less. 0.006 is what the paper's 7e5 1/s amounts to at 25 frames/s.
    fixed_pattern
        Standard deviation of the offsets that stored values of frames' pixels keep from frame to frame, white = 1: the
        images have them, too, and their variance counts them (docs/equations.md, K11). None: an estimate from the
        recording (`kalux.calibration.fixed_pattern`); `USUAL_PATTERN` where that cannot tell and smooth parts have no
        less, and in a live stream.
    confidence
        1 / sigma_im^2 of equation (6) as the paper uses it, a rate in 1/s: 7e5 (DAVIS), 7e7 (FLIR). For
        augmentation "paper" only.
    weight_floor
        Smallest f^w, which caps R_bar. 0.09 is the released code's; for augmentation "paper" only, since
        the other gives clipped pixels no weight at all.
    black_level
        What every pixel reads in the dark, on top of its light: a share of the white value, 0 to 0.5 (16 of 255 is
        0.063). It is taken off the frames before the response is inverted, so that 0 is black and 1 still white. None:
        what frames state; where they state nothing and begin above 0, what the recording's events say
        (`kalux.calibration.black_level`); else 0.
    saturation
        Response, 0 to 1, from which a pixel counts as clipped. None: just below the one level at which all clipped
        pixels are, if the recording's frames show it (below white, if events go on there, too), else the usual one
        (`kalux.calibration.levels`).
    usual_saturation
        The same where the recording does not tell it, and in a live stream; of frames that end lower, the share of
        their end. 0.98: a few levels below 255, for sensors with fixed pattern noise at the top.
    reference_exposure
        Exposure time, us, at which a saturated pixel has intensity 1; None: the recording's median.
    row_time
        Rolling shutter: how much later than the row above each row of a frame is exposed, us; negative from the lowest
        row up. A frame's exposure is that of its middle (docs/equations.md, K19). 0: all rows at once. For augmentation
        "bridge" only.
    even_gain
        Whether the brightness of frames is evened out where it steps though events say that the light does not
        (`kalux.calibration.frame_faults`): exposure or amplification that nobody states. Not in a live stream.
    leave_out_faulty
        Whether frames are left out that are copies of the one before though events say that something moved, or that
        are empty. Not in a live stream.
    mend_stuck
        Whether pixels of frames that always show the same, though their events and their neighbours say that their
        light changes, are taken for the median of these (`kalux.calibration.stuck_pixels`). Not in a live stream.
    mend_times
        Whether times of frames are corrected by what events tell, where they are off one by one
        (`kalux.calibration.frame_times`), or their clock is fast or slow (`kalux.calibration.clock_rate`). Not in a
        live stream.
    white_balance
        Of recordings in colour: ``"as-recorded"``, ``"grey-world"`` (gains that make the mean of well exposed pixels
        grey; one set for a recording), or gains of red, green and blue, ``"1.8;1;1.4"``. As recorded: what is grey is
        not in the recording, and RGB frames are balanced already.
    """

    response: str = AUTO
    log_offset: float | None = None
    frame_noise: float | None = None
    shot_noise: float | None = None
    usual_frame_noise: float = 0.006
    fixed_pattern: float | None = None
    confidence: float = 7e5
    weight_floor: float = 0.09
    black_level: float | None = None
    saturation: float | None = None
    usual_saturation: float = 0.98
    reference_exposure: int | None = None
    row_time: float = 0.0
    even_gain: bool = True
    leave_out_faulty: bool = True
    mend_stuck: bool = True
    mend_times: bool = True
    white_balance: str = "as-recorded"

    @property
    def offset(self) -> float:
        """I_0: ``log_offset``, or its usual value while that is None."""
        return UNKNOWN_LOG_OFFSET if self.log_offset is None else self.log_offset

    @property
    def is_linear(self) -> bool:
        """Whether values are proportional to the light."""
        return chosen_response(self.response, None) == "linear"

    @property
    def noise(self) -> tuple[float, float]:
        """(``frame_noise``, ``shot_noise``), or their usual values while they are None."""
        read = self.usual_frame_noise if self.frame_noise is None else self.frame_noise
        return read, self.shot_noise or 0.0

    @property
    def clipped_from(self) -> float:
        """``saturation``, or the usual one while that is None."""
        return self.usual_saturation if self.saturation is None else self.saturation


@dataclass(frozen=True, kw_only=True)
class EventSettings:
    """Event noise, equations (1)-(2), and the calibration of the contrast threshold, (12).

    Attributes
    ----------
    threshold_on, threshold_off
        Contrast thresholds c, log intensity; None: what the recording states, else an estimate from it.
    delay
        How much later than the frames' clock events are stamped, us, e.g. by the latency of their pixels; None: an
        estimate from the recording (0 for a live stream).
    threshold_spread
        Relative standard deviation of the threshold between pixels, prior of its calibration. None: an estimate from
        the recording (`kalux.calibration.mismatch`).
    step_variance
        Variance of one event's step in units of c^2. None: an estimate from the recording
        (`kalux.calibration.mismatch`).
    dark_steps
        By how much more the steps of dark pixels vary, c^2, where these are slow (docs/equations.md, K20): 6 numbers
        with spaces between, for the octaves below 0.32 of white, the brightest first (`kalux.models.dark_steps`), or
        ``"none"``. ``"auto"``: an estimate from the recording (`kalux.calibration.dark_steps`); none in causal mode
        and in a live stream. For augmentation "bridge" and lookahead only.
    lag_variance
        Variance, c^2, by which pixels with events are off the light at a moment because they are slow, at 0.02 of
        white: more in the dark, less in the light (docs/equations.md, K11). It is in the variance of images between
        frames. None: an estimate from the recording (`kalux.calibration.lag`); 0 in a live stream. For augmentation
        "bridge" only.
    refractory_period
        Time after an event in which a pixel produces no other, us: the change meanwhile is added to its next event
        (docs/equations.md, K13). None: an estimate from the recording, 0 where its frames show that no change is lost
        and in a live stream. For augmentation "bridge" only.
    refractory_spread
        Relative standard deviation of ``refractory_period``: how wrong events that follow soon are, all alike, where no
        frame measures (docs/equations.md, K10). None: that of the estimate; 0 of a period that is given, or that noise
        shows, and in a live stream. For augmentation "bridge" only.
    quantisation_variance
        Variance, in c^2, of the changes below the threshold at both ends of a frame interval, which have produced no
        event yet: two uniform distributions one threshold wide, 2/12.
    deblur_variance
        Variance, in c^2, of the correction that a few events of an exposure make to the frame; it grows with their
        number (docs/equations.md, K3). 1/12: that of a uniform distribution one threshold wide.
    noise_rate
        Background noise, Hz per pixel, that makes isolated events doubtful. None: what is measured in the recording
        (`kalux.calibration.noise`), at least 0.5, in causal mode at least the usual; the usual in a live stream.
    leave_out_hot
        Whether pixels that leak all the time are looked for in the recording, and their events left out
        (`kalux.calibration.hot_pixels`). True: their highlights grow without bound (docs/calibration.md).
    mend_layout
        Whether events that are mirrored, or whose polarities are swapped, are put right where their counts follow the
        frames so, and not as they are (`kalux.calibration.event_layout`). Not in a live stream.
    extrapolation_spread
        Where thresholds are only estimates and threshold_spread is not known: standard deviation of the log of their
        common error beyond white, where no frame corrects it. 0.15: how well large changes between well exposed
        frames agree with estimated thresholds, on three real and eleven simulated recordings.
    extrapolation_gain
        Share of the changes by events that is believed beyond white, where no frame corrects them (docs/equations.md,
        K6), 0 to 1. None: as far as events explain how the frames change elsewhere
        (`kalux.calibration.event_model`); 1 in a live stream.
    extrapolation_trust
        How far highlights are believed to lie where they are, although they are much farther beyond white than
        ``highlight_scale`` expects (docs/equations.md, K6), 0 to 1. None: 1 where events explain 85 % of how the frames
        change elsewhere, 0 where 70 % or less (`kalux.calibration.event_model`); 0 in causal mode and in a live stream.
    trail
        By how much, in c, a pixel is on average beyond the level of its newest event, at most (docs/equations.md,
        K14): events trail the light. 0 turns it off. 0.4 (docs/tuning.md).
    usual_threshold_on, usual_threshold_off
        Where a recording (one frame, a live stream, or nothing that moves) does not tell the thresholds: what the
        sensor usually has. 0.25: in the middle of what DAVIS and Prophesee sensors are set to (0.1 to 0.4).
    usual_spread
        Relative standard deviation of the true threshold around the usual one; the prior of its calibration is then
        at least this wide. 0.5: in a live stream a third of the error of 0.1 where the true threshold is 0.15.
    usual_threshold_spread
        The spread between pixels where the recording does not tell it. 0.1: data sheets and the literature give 2 to
        10 % (Lichtsteiner 2008: 2.1 % of contrast at c = 0.2), real recordings more.
    usual_noise_rate
        The background noise where it is not measured, and the least of causal mode, which goes by the ages of events
        (K5): isolated events are doubtful for other reasons, too (leak of bright pixels, flicker). 3: typical of a
        DAVIS at its default biases in room light. slider_depth has 0.15 where nothing is seen; by their ages, at 0.5
        its artificial highlights drift to three times the error of 3 (docs/tuning.md).
    usual_delay
        The delay where the recording does not tell it, us. 0: as stamped.
    usual_step_variance
        The step's variance where the recording does not tell it, c^2. 0.2: between recordings of two sensors and
        larger than most, since too small a value believes events too much (docs/tuning.md).
    sigma_proc2, sigma_iso2, sigma_ref2, refractory_bound
        The paper's event noise: 0.0005 1/s, 0.03 1/s, 0.01, and 10 ms (released code), in s. For
        augmentation "paper" only.
    """

    threshold_on: float | None = None
    threshold_off: float | None = None
    delay: int | None = None
    threshold_spread: float | None = None
    step_variance: float | None = None
    dark_steps: str = AUTO
    lag_variance: float | None = None
    refractory_period: int | None = None
    refractory_spread: float | None = None
    quantisation_variance: float = 1 / 6
    deblur_variance: float = 1 / 12
    noise_rate: float | None = None
    leave_out_hot: bool = True
    mend_layout: bool = True
    extrapolation_spread: float = 0.15
    extrapolation_gain: float | None = None
    extrapolation_trust: float | None = None
    trail: float = 0.4
    usual_threshold_on: float = 0.25
    usual_threshold_off: float = 0.25
    usual_spread: float = 0.5
    usual_threshold_spread: float = 0.1
    usual_noise_rate: float = 3.0
    usual_delay: int = 0
    usual_step_variance: float = 0.2
    sigma_proc2: float = 0.0005
    sigma_iso2: float = 0.03
    sigma_ref2: float = 0.01
    refractory_bound: float = 0.01

    @property
    def step_noise(self) -> float:
        """``step_variance``, or the usual one while that is None."""
        return self.usual_step_variance if self.step_variance is None else self.step_variance

    @property
    def mismatch(self) -> float:
        """``threshold_spread``, or the usual one while that is None."""
        return self.usual_threshold_spread if self.threshold_spread is None else self.threshold_spread

    @property
    def believed_extrapolation(self) -> float:
        """The spread of the events' scale beyond white where thresholds are estimated, as used.

        A ``threshold_spread`` from a recording includes the uncertainty of its thresholds.
        """
        return self.extrapolation_spread if self.threshold_spread is None else self.believed_mismatch

    @property
    def believed_gain(self) -> float:
        """``extrapolation_gain``, or 1 while that is None."""
        return 1.0 if self.extrapolation_gain is None else self.extrapolation_gain

    @property
    def believed_trust(self) -> float:
        """``extrapolation_trust``, or 0 while that is None: nothing has shown that events belong to the frames."""
        return 0.0 if self.extrapolation_trust is None else self.extrapolation_trust

    @property
    def believed_mismatch(self) -> float:
        """The part of ``mismatch`` by which the scale of events beyond white is doubted (K6).

        No more than the usual one: pixels that differ by more tell so (K2), and P accounts for the rest (K10).
        """
        return min(self.mismatch, self.usual_threshold_spread)

    @property
    def background_rate(self) -> float:
        """``noise_rate``, or the usual one while that is None."""
        return self.usual_noise_rate if self.noise_rate is None else self.noise_rate

    @property
    def lateness(self) -> int:
        """``delay``, us, or the usual one while that is None."""
        return self.usual_delay if self.delay is None else self.delay

    @property
    def has_thresholds(self) -> bool:
        """Whether both thresholds are set."""
        return self.threshold_on is not None and self.threshold_off is not None

    @property
    def thresholds(self) -> tuple[float, float]:
        """(on, off); both must be set."""
        assert self.threshold_on is not None
        assert self.threshold_off is not None
        return self.threshold_on, self.threshold_off

    def with_thresholds(self, on: float | None, off: float | None) -> EventSettings:
        """With these thresholds in place of those that are None."""
        return replace(
            self,
            threshold_on=on if self.threshold_on is None else self.threshold_on,
            threshold_off=off if self.threshold_off is None else self.threshold_off,
        )

    def assuming(self) -> EventSettings:
        """With the usual thresholds in place of those that are None, and a prior as wide as these are uncertain."""
        if self.has_thresholds:
            return self
        assumed = self.with_thresholds(self.usual_threshold_on, self.usual_threshold_off)
        return replace(assumed, threshold_spread=max(self.mismatch, self.usual_spread))

    @property
    def refractory(self) -> int:
        """``refractory_period``, us, or 0 while that is None."""
        return 0 if self.refractory_period is None else self.refractory_period

    @property
    def refractory_doubt(self) -> float:
        """``refractory_spread``, or 0 while that is None."""
        return 0.0 if self.refractory_spread is None else self.refractory_spread


_FOLLOWED_PIXELS: Final = 120_000
"""Pixels of a sensor up to which motion is followed where nothing is said (docs/speed.md)."""


@dataclass(frozen=True, kw_only=True)
class FilterSettings:
    """The filter, equations (14)-(21).

    Attributes
    ----------
    kind
        ``"akf"``, the asynchronous Kalman filter, or ``"cf"``, the complementary filter.
    augmentation
        ``"bridge"``: frames joined by events weighted by their uncertainties; ``"paper"``: (10)-(13).
    solution
        Of (16) and (19): ``"exact"`` for a moving L^A and a varying R, or ``"printed"``, (17) and (20).
        Augmentation "bridge" is always exact.
    deblur
        Remove motion blur with the events of the exposure (EDI).
    initial_variance
        P at the start where the first frame is clipped, and everywhere with augmentation "paper" (0.09 in
        the released code). 1.0: a clipped pixel is white or up to a few times brighter.
    highlight_scale
        Standard deviation, in log intensity, of the prior on how far scenes go beyond white, which shrinks uncertain
        highlights towards white. 0 turns it off. 2 (docs/tuning.md).
    highlight_tail
        The same where thresholds are only an estimate, as a multiple of how far the frames' bright tail goes on
        (`kalux.models.camera.beyond_white`), but no more than highlight_scale: scenes of which little saturates do
        not go far beyond white. 6 (docs/tuning.md).
    unshown_tail
        How far pixels that every frame so far has clipped are expected to lie above their lower bounds, as a share of
        the scale of the pixels just below white around them (docs/equations.md, K15); likewise those that a frame has
        seen rise past white (K7). 0 leaves all at their bounds. 0.5 (docs/tuning.md).
    unshown_scale
        How many times as far above their lower bounds such pixels lie as frames make expect (R_0 of K15); None: as
        pixels that leave saturation in the first frames of a recording tell, 1 in a live stream.
    bright_tail
        Scale of the frames' bright tail; None: from the recording's frames, in a live stream from the first.
    dark_shares
        How often frames show light that their noise hides, by which dark means are put right (docs/equations.md, K3):
        10 numbers with spaces between, for the parts of `kalux.models.dark_levels.LIGHT_EDGES`, or ``"even"``.
        ``"auto"``: an estimate from the recording (`kalux.calibration.dark_shares`); even in a live stream.
    neighbours
        Standard deviation, in log intensity, by which neighbouring pixels of a surface differ: moving pixels become
        weighted means of themselves and their eight neighbours (docs/equations.md, K12). 0 turns it off. 0.2
        (docs/tuning.md).
    motion
        Whether the frames around an image are read along the paths of what moves between them (docs/equations.md, K16):
        ``"on"``, ``"off"``, or ``"auto"``, on for sensors of up to 120,000 pixels, of which two processor cores make
        300 images/s so, and wherever an image uses everything after it. With augmentation "bridge" and lookahead only;
        not of Bayer mosaics.
    cutoff
        Of the complementary filter, Hz. 1.0 (Scheerlinck 2018 uses 2 pi rad/s).
    """

    kind: FilterName = "akf"
    augmentation: AugmentationName = "bridge"
    solution: SolutionName = "exact"
    deblur: bool = True
    initial_variance: float = 1.0
    highlight_scale: float = 2.0
    highlight_tail: float = 6.0
    unshown_tail: float = 0.5
    unshown_scale: float | None = None
    bright_tail: float | None = None
    dark_shares: str = AUTO
    neighbours: float = 0.2
    motion: MotionName = "auto"
    cutoff: float = 1.0

    @property
    def joins_frames(self) -> bool:
        """Whether the filter follows frames that are joined by events (docs/equations.md, K1): the default's way."""
        return self.kind == "akf" and self.augmentation == "bridge"

    @property
    def believed_unshown_scale(self) -> float:
        """The scale of what is expected of pixels that no frame has measured; 1 where nothing is known."""
        return 1.0 if self.unshown_scale is None else self.unshown_scale

    def follows_motion(self, sensor_size: tuple[int, int]) -> bool:
        """Whether frames of a sensor are read along the paths of what moves."""
        height, width = sensor_size
        return self.motion == "on" or (self.motion == "auto" and height * width <= _FOLLOWED_PIXELS)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """All settings of a reconstruction. Start from `preset` and change with `dataclasses.replace`."""

    camera: CameraSettings = field(default_factory=CameraSettings)
    events: EventSettings = field(default_factory=EventSettings)
    filter: FilterSettings = field(default_factory=FilterSettings)

    def __post_init__(self) -> None:
        _check(self)


SETTINGS_NEEDED: Final = "a kalux.Settings is needed, from kalux.preset"

_GROUPS: Final = tuple(entry.name for entry in dataclasses.fields(Settings))


def preset(name: str) -> Settings:
    """The settings of a preset.

    Raises
    ------
    SettingsError
        If there is no such preset.
    """
    try:
        return PRESETS[name]
    except (KeyError, TypeError):
        raise SettingsError(
            f"preset: unknown preset {name!r}{did_you_mean(str(name), PRESETS)}; known are {', '.join(PRESETS)}"
        ) from None


def altered(settings: Settings, group: Literal["camera", "events", "filter"], **values: Any) -> Settings:
    """The settings with some values of one group changed.

    Raises
    ------
    SettingsError
        If a value is out of range.
    """
    changed: Any = {group: dataclasses.replace(getattr(settings, group), **values)}
    return dataclasses.replace(settings, **changed)


def completed(settings: Settings, group: Literal["camera", "events", "filter"], **found: Any) -> Settings:
    """The settings with what one group leaves open, None, as it was found; what it states stays.

    Raises
    ------
    SettingsError
        If a value is out of range.
    """
    stated = getattr(settings, group)
    return altered(settings, group, **{name: found[name] for name in found if getattr(stated, name) is None})


_USED_BY: Final[Mapping[str, tuple[str, ...]]] = {
    **dict.fromkeys(
        (
            "filter.highlight_tail",
            "filter.unshown_tail",
            "filter.unshown_scale",
            "filter.bright_tail",
            "filter.dark_shares",
            "filter.neighbours",
            "filter.motion",
            "camera.fixed_pattern",
            "camera.row_time",
            "events.step_variance",
            "events.dark_steps",
            "events.lag_variance",
            "events.refractory_period",
            "events.refractory_spread",
            "events.deblur_variance",
            "events.noise_rate",
            "events.extrapolation_spread",
            "events.extrapolation_gain",
            "events.extrapolation_trust",
            "events.trail",
        ),
        ("default",),
    ),
    **dict.fromkeys(
        (
            "filter.solution",
            "camera.confidence",
            "camera.weight_floor",
            "events.sigma_proc2",
            "events.sigma_iso2",
            "events.sigma_ref2",
            "events.refractory_bound",
        ),
        ("iccv2021",),
    ),
    **dict.fromkeys(
        ("filter.deblur", "filter.initial_variance", "filter.highlight_scale"), ("default", "iccv2021")
    ),
    "filter.cutoff": ("cf",),
}
"""Settings that not every filter has, and presets of the filters that do."""


def without_effect(settings: Settings, keys: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """Of settings, as ``group.name``, those that the chosen filter has no use for, and the presets whose filters do."""
    chosen = settings.filter
    own = "default" if chosen.joins_frames else "cf" if chosen.kind == "cf" else "iccv2021"
    users = {key: _USED_BY.get(key, (own,)) for key in keys}
    return {key: presets for key, presets in users.items() if own not in presets}


def to_dict(settings: Settings) -> dict[str, dict[str, Any]]:
    """As nested plain values, for TOML; None, which TOML has not, is ``"auto"``."""
    return {
        group: {name: AUTO if value is None else value for name, value in values.items()}
        for group, values in dataclasses.asdict(settings).items()
    }


def from_dict(values: Mapping[str, Any], base: Settings) -> Settings:
    """Change ``base`` by nested plain values.

    Raises
    ------
    SettingsError
        If a group or a setting is unknown, or a value has the wrong type or range.
    """
    groups = {}
    for group, entries in values.items():
        if group not in _GROUPS:
            raise SettingsError(f"settings: {_unknown_group(group, base)}; known are {', '.join(_GROUPS)}")
        current = getattr(base, group)
        known = {entry.name for entry in dataclasses.fields(current)}
        if not isinstance(entries, Mapping):
            raise SettingsError(f"settings: {group} is not a table of settings")
        for name in entries:
            if name not in known:
                raise SettingsError(
                    f"settings: unknown setting {group}.{name}{did_you_mean(name.replace('-', '_'), known)}; known are "
                    f"{', '.join(sorted(known))}"
                )
        optional = {entry.name for entry in dataclasses.fields(current) if entry.default is None}
        chosen = {
            name: None if name in optional and value == AUTO else value for name, value in entries.items()
        }
        groups[group] = dataclasses.replace(current, **chosen)
    return dataclasses.replace(base, **groups)


def _unknown_group(name: str, base: Settings) -> str:
    """What is wrong with a table of this name, which may be a setting or a table without its group."""
    for group in _GROUPS:
        if name in {entry.name for entry in dataclasses.fields(getattr(base, group))}:
            return f"{name} is a setting of [{group}] and has to follow that line"
    if name == "preset":
        return "a preset is given by --preset (preset=), not in the file"
    return f"unknown group [{name}]{did_you_mean(name, _GROUPS)}"


def read_toml(
    path: Path, *, unreadable: type[KaluxError] = InputError, damaged: type[KaluxError] = InputError
) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises
    ------
    KaluxError
        ``unreadable`` if the file cannot be read, ``damaged`` if it is not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise unreadable(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise damaged(f"{path}: not a TOML file: byte {error.start} is not UTF-8 text") from error
    except tomllib.TOMLDecodeError as error:
        raise damaged(f"{path}: not valid TOML: {error}") from error


def load(path: str | Path, base: Settings) -> Settings:
    """Change ``base`` by a TOML file: tables ``[camera]``, ``[events]``, ``[filter]``, as in ``kalux.toml``.

    An output's ``kalux.toml`` can be given as it is: its ``[settings.*]`` tables are used.

    Raises
    ------
    SettingsError
        If the file cannot be read, is not TOML, or holds an unknown setting.
    """
    values = read_toml(Path(path), unreadable=SettingsError, damaged=SettingsError)
    chosen = values.get("settings", values)
    if not isinstance(chosen, Mapping):
        raise SettingsError(f"{path}: settings is not a table of settings")
    try:
        return from_dict(chosen, base)
    except SettingsError as error:
        raise SettingsError(f"{path}: {error}") from None


_POSITIVE: Final = {
    "log_offset",
    "frame_noise",
    "usual_frame_noise",
    "confidence",
    "weight_floor",
    "saturation",
    "usual_saturation",
    "reference_exposure",
    "threshold_on",
    "threshold_off",
    "usual_threshold_on",
    "usual_threshold_off",
    "bright_tail",
    "unshown_scale",
    "initial_variance",
    "cutoff",
}
_WHOLE: Final = {"delay", "usual_delay", "reference_exposure", "refractory_period"}
_LARGEST_WHOLE: Final = 10**18  # fits int64
_LARGEST: Final = 1e10  # more than any value can mean, and its square is a number in single precision
_LEAST: Final = 1e-12  # but 0: less than any value can mean, and so is its square
_LARGEST_OF: Final[Mapping[str, float]] = {
    **dict.fromkeys(
        ("saturation", "usual_saturation", "weight_floor", "extrapolation_gain", "extrapolation_trust"), 1.0
    ),
    "black_level": 0.5,  # of white: no camera gives half of its range away
    "log_offset": 1e3,  # of white: its logarithm is then the same as its radiance
    **dict.fromkeys(
        ("frame_noise", "usual_frame_noise", "shot_noise", "fixed_pattern"), 10.0
    ),  # of white: nothing is left of a frame
    # Log intensity: exp(100) is more than single precision holds.
    **dict.fromkeys(("threshold_on", "threshold_off", "usual_threshold_on", "usual_threshold_off"), 100.0),
    **dict.fromkeys(("highlight_scale", "bright_tail", "neighbours"), 100.0),
    "initial_variance": 1e4,  # the square of that
    # Shares: at ten times a value nothing is known of it.
    **dict.fromkeys(
        (
            "threshold_spread",
            "usual_spread",
            "usual_threshold_spread",
            "extrapolation_spread",
            "refractory_spread",
        ),
        10.0,
    ),
    "trail": 10.0,  # c: a pixel one threshold beyond its newest event has another
    **dict.fromkeys(
        ("step_variance", "usual_step_variance", "lag_variance", "quantisation_variance", "deblur_variance"),
        100.0,
    ),  # c^2
    **dict.fromkeys(
        ("highlight_tail", "unshown_tail", "unshown_scale"), 100.0
    ),  # multiples of a log intensity
    # us: pixels in the dark are late by tens of milliseconds, guessed stamps by an exposure, at most seconds.
    **dict.fromkeys(("delay", "usual_delay", "refractory_period"), 10_000_000),
    "row_time": 1e6,  # us, as in simulations
}
_LEAST_OF: Final[Mapping[str, float]] = {
    # The square of a frame's weight, 1 / noise^2, is still a number in single precision.
    **dict.fromkeys(("frame_noise", "usual_frame_noise"), 1e-9),
}
_SIGNED: Final = {"delay", "usual_delay", "row_time"}
_CHOICES: Final = {
    "kind": ("akf", "cf"),
    "augmentation": ("bridge", "paper"),
    "solution": ("exact", "printed"),
    "motion": ("auto", "on", "off"),
}


def _check(settings: Settings) -> None:
    for group in _GROUPS:
        values = getattr(settings, group)
        for entry in dataclasses.fields(values):
            _check_value(f"{group}.{entry.name}", entry.name, getattr(values, entry.name), entry.default)


def _check_value(label: str, name: str, value: Any, default: Any) -> None:
    most = _LARGEST_OF.get(name, _LARGEST_WHOLE if name in _WHOLE else _LARGEST)
    least = _LEAST_OF.get(name, _LEAST)
    if name in _CHOICES:
        if value not in _CHOICES[name]:
            raise SettingsError(
                f"settings: {label} is {value!r}; it must be one of {', '.join(_CHOICES[name])}"
            )
    elif isinstance(default, (bool, str)):
        if not isinstance(value, type(default)):
            raise SettingsError(f"settings: {label} is {value!r}; {type(default).__name__} is needed")
    elif value is None:
        if default is not None:
            raise SettingsError(f"settings: {label} needs a number")
    elif name in _WHOLE and not (isinstance(value, int) and not isinstance(value, bool)):
        raise SettingsError(f"settings: {label} is {value!r}; whole microseconds are needed")
    elif isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= most:
        hint = " us; kalux register brings clocks together that differ by more" if "delay" in name else ""
        raise SettingsError(
            f"settings: {label} is {value!r}; a finite number is needed, at most {most:g}{hint}"
        )
    elif 0 < abs(value) < least:
        raise SettingsError(
            f"settings: {label} is {value!r}; {least:g} is the least above 0 that is possible"
        )
    elif (value < 0 and name not in _SIGNED) or (name in _POSITIVE and value == 0):
        raise SettingsError(
            f"settings: {label} is {value}; it must be {'positive' if name in _POSITIVE else '0 or more'}"
        )


_PAPER: Final = Settings(
    camera=CameraSettings(log_offset=1.0),
    # 0.1 is the released code's threshold where the recording has none.
    events=EventSettings(delay=0, usual_threshold_on=0.1, usual_threshold_off=0.1),
    filter=FilterSettings(
        augmentation="paper",
        solution="printed",
        initial_variance=0.09,
        highlight_scale=0.0,
        neighbours=0.0,
    ),
)

# Sensors. Thresholds, delay and step variance depend on bias currents, light and motion, and a few frames tell them
# better than the sensor's name does: they stay automatic. Presets say what is usual where nothing can be told (one
# frame, little motion, a live stream), and what no estimate looks for. Measured by kalux: docs/tuning.md, Sensors.

_DAVIS240C: Final = EventSettings(
    # slider_depth, whole and in parts of 3 and 5 frames: 0.62 to 0.78 and 0.43 to 0.54. With one frame and in a live
    # stream a tenth less or more of either is no better. One recording only, of the IJRR data set. The sensor can be
    # set down to 11 % of contrast (Gallego 2022, Table 1).
    usual_threshold_on=0.66,
    usual_threshold_off=0.46,
    # More than the 7 % between parts of a recording: others may have other bias currents. Of 0.1 to 0.5, 0.1 and 0.2
    # are the best for live streams of these recordings.
    usual_spread=0.2,
    # The same recording: 1.0 to 1.8 ms. Its exposures (10 ms, from the stamp on) are a guess, which is part of this.
    usual_delay=1500,
    # Parts of it have 0.1 to 0.2, but with nothing else to correct events it pays to believe them less: of 0.15, 0.4
    # and 0.8 the best in a live stream, and with one frame 12 % better than 0.15.
    usual_step_variance=0.4,
    # 0.09 between pixels is measured, but a pixel's steps also differ with contrast and light; v2e has 0.03 of 0.2.
    # Held-out frames of all three recordings of DAVIS sensors prefer it to 0.1.
    usual_threshold_spread=0.15,
)

_DAVIS346: Final = EventSettings(
    # Two recordings, one dim and one in the sun: 0.33 and 0.31 on, 0.36 and 0.37 off; parts of 5 frames 0.29 to 0.38
    # and 0.34 to 0.41.
    # The sensor can be set down to 14.3 and 22.5 % of contrast (the same table).
    usual_threshold_on=0.31,
    usual_threshold_off=0.37,
    usual_spread=0.2,  # as of the DAVIS240C
    # 3.0 ms (exposures of 20 ms, dim) and 4.7 ms (0.5 ms, sun): latency, and that events trail the light.
    usual_delay=3900,
    # 0.05 and 0.1: the larger, since too small a value believes events too much.
    usual_step_variance=0.1,
    usual_threshold_spread=0.15,  # as of the DAVIS240C
)

_PROPHESEE_FLIR: Final = Settings(
    camera=CameraSettings(
        # 2.3 electrons of read noise and 10,400 at white (IMX265, EMVA 1288) are 0.0069 at half of white, mostly photon
        # noise; `kalux register` averages about ten of its 2048 x 1536 pixels to one of 640 x 480.
        usual_frame_noise=0.0022,
    ),
    events=EventSettings(
        # 25 % of contrast, 0.22, is nominal for Prophesee's sensors; events lost in the refractory period make steps
        # look larger, 0.27 on a simulated rig of 0.22.
        usual_threshold_on=0.25,
        usual_threshold_off=0.25,
        # Background noise is 0.1 Hz per pixel at 25 C in the light (Gallego 2022, Table 1). Events are doubtful for
        # other reasons, too: the default is far above what DAVIS sensors have. A third of it gains 2 % on the rig.
        usual_noise_rate=1.0,
    ),
)

PRESETS: Final[Mapping[str, Settings]] = {
    "default": Settings(),
    "davis240c": Settings(events=_DAVIS240C),
    "davis346": Settings(events=_DAVIS346),
    "prophesee-flir": _PROPHESEE_FLIR,
    "iccv2021": _PAPER,
    "iccv2021-flir": altered(_PAPER, "camera", confidence=7e7),
    "cf": Settings(filter=FilterSettings(kind="cf", deblur=False, highlight_scale=0.0, neighbours=0.0)),
}
"""``default``: best on ground truth; what is not known is estimated from the recording. ``davis240c``, ``davis346``,
``prophesee-flir`` (the paper's two cameras side by side): the same, with what a recording of that sensor often cannot
tell. ``iccv2021``: the paper to the letter with the confidence of its DAVIS, ``iccv2021-flir`` of its FLIR. ``cf``: the
complementary filter."""
