"""A plan as text: the settings that it filled in, with their units, and where they come from."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from kalux.calibration.clock_rate import ClockRate
from kalux.calibration.compression import Compression
from kalux.calibration.delay import SHARE
from kalux.calibration.event_layout import LayoutFit
from kalux.calibration.event_model import Agreement
from kalux.calibration.frame_faults import FrameFaults
from kalux.calibration.frame_times import FrameTimes
from kalux.calibration.levels import Ceiling, find_ceiling
from kalux.calibration.moving_noise import MovingNoise
from kalux.models.dark_levels import LIGHT_EDGES, dark_shares
from kalux.models.dark_steps import BRIGHT, dark_steps
from kalux.recording import Recording, less_black
from kalux.settings import AUTO, USUAL_PATTERN, EventSettings, Settings
from kalux.wording import how_many

if TYPE_CHECKING:
    from kalux.planning import Plan

ORIGINS: Final = {
    "settings": "given",
    "recording": "from the recording",
    "calibration": "calibrated",
    "estimate": "estimated",
    "assumed": "usual of the preset, the recording does not tell",
}
"""What to call where thresholds come from (`kalux.planning.event_steps.ThresholdOrigin`)."""

_NOTABLE_SHARE: Final = 0.05
_GIVEN: Final = "given"
_USUAL: Final = ORIGINS["assumed"]


def plan_report(recording: Recording, plan: Plan, asked: Settings) -> list[tuple[str, str]]:
    """What a plan found in the recording, line by line: name, and value with its unit and where that comes from.

    Parameters
    ----------
    recording, plan
        From `kalux.planning.plan`.
    asked
        The settings before the plan filled in what was missing; what they state is said to be given.
    """
    return [
        *_of_events(plan, asked),
        *_of_frames(recording, plan, asked),
        *_of_motion(recording, plan, asked),
    ]


def _of_events(plan: Plan, asked: Settings) -> Iterator[tuple[str, str]]:
    camera, events = plan.settings.camera, plan.settings.events
    yield (
        "thresholds",
        f"on {events.threshold_on:.3f}, off {events.threshold_off:.3f} log intensity ({_threshold_origin(plan)})",
    )
    if plan.steps.model is not None:
        yield "agreement", _agreement_text(plan.steps.model.agreement, plan.settings)
    yield "delay", f"events {events.lateness * 1e-3:g} ms late ({_delay_origin(plan, asked)})"
    yield (
        "I_0",
        f"{camera.offset:g} of white, events are steps of log(I + I_0) "
        f"({_model_origin(plan, asked.camera.log_offset)})",
    )
    if events.step_variance is not None:
        how = _step_origin(plan, asked.events.step_variance)
        yield "step", f"variance of one event {events.step_variance:g} c^2, c its threshold ({how})"
    more = dark_steps(events.dark_steps)
    if more is not None:
        how = "measured" if asked.events.dark_steps == AUTO else _GIVEN
        yield (
            "dark steps",
            f"variance of one event up to {max(more):g} c^2 more below {BRIGHT:g} of white ({how})",
        )
    if events.lag_variance:
        how = _estimated(asked.events.lag_variance, True)
        yield "lag", f"of slow pixels at a moment {events.lag_variance:g} c^2 at 0.02 of white ({how})"
    if events.refractory_period is not None:
        yield "refractory", f"{_refractory_text(events)} ({_refractory_origin(plan, asked)})"
    if events.threshold_spread is not None:
        how = _estimated(asked.events.threshold_spread, plan.mismatch is not None)
        yield "spread", f"{100 * events.threshold_spread:.1f} % between the pixels' thresholds ({how})"
    if events.noise_rate is not None:
        how = _estimated(asked.events.noise_rate, plan.background_rate == events.noise_rate)
        if plan.background_rate is not None and plan.background_rate < events.noise_rate:
            how = f"the least that is assumed; measured {plan.background_rate:.2g}"
        yield "background", f"{events.noise_rate:.2g} Hz per pixel of events without reason ({how})"
    if plan.mends.layout is not None and plan.mends.moves_events:
        yield "layout", f"{layout_text(plan.mends.layout)}: put right"
    if plan.mends.hot_pixels:
        yield "hot pixels", f"{how_many(plan.mends.hot_pixels, 'pixel')} whose events are left out (measured)"


def _of_frames(recording: Recording, plan: Plan, asked: Settings) -> Iterator[tuple[str, str]]:
    camera = plan.settings.camera
    how = "median of the frames" if asked.camera.reference_exposure is None else _GIVEN
    yield "exposure", f"{(camera.reference_exposure or 0) * 1e-3:g} ms makes a saturated pixel 1.0 ({how})"
    if camera.frame_noise is not None:
        read, shot = camera.noise
        how = _noise_origin(plan, asked)
        if plan.mends.compression is not None and asked.camera.frame_noise is None:
            how += ", and what their compression adds"
        half = np.sqrt(read**2 + shot / 2)
        yield "noise", f"of frames {read:.2g} of white in the dark, {half:.2g} at half of it ({how})"
    if camera.fixed_pattern is not None:
        how = _estimated(asked.camera.fixed_pattern, plan.fixed_pattern is not None)
        if how == _USUAL and 0 < camera.fixed_pattern < USUAL_PATTERN:
            how = "nothing moves that could tell it; no more is in smooth parts"
        if camera.fixed_pattern:
            yield "pattern", f"fixed, of frames {camera.fixed_pattern:.2g} of white ({how})"
        else:
            processed = "in colour, or not linear: processed"
            yield "pattern", f"none that is fixed ({processed if how == _USUAL else how})"
    shares = dark_shares(plan.settings.filter.dark_shares)
    if shares is not None:
        hidden = sum(shares[: LIGHT_EDGES.index(0.75)]) / sum(shares)
        how = "measured" if asked.filter.dark_shares == AUTO else _GIVEN
        yield (
            "dark",
            f"{100 * hidden:.0f} % of light up to 14 times the noise is less than three quarters of it ({how})",
        )
    if plan.settings.filter.bright_tail is not None and plan.settings.filter.highlight_scale > 0:
        how = "measured" if asked.filter.bright_tail is None else _GIVEN
        yield "bright tail", f"{plan.settings.filter.bright_tail:.2f} log intensity ({how})"
    yield from _unshown(asked, plan)
    stated = "usual, the recording does not state it" if recording.response is None else "as recorded"
    how = stated if asked.camera.response == AUTO else _GIVEN
    yield "response", f"{response_text(camera.response)} ({how})"
    if plan.mends.faults is not None and plan.mends.faults.steps:
        yield "gain", f"{gain_text(plan.mends.faults)}: evened out"
    if plan.mends.faults is not None and (plan.mends.faults.copies or plan.mends.faults.empty):
        yield "left out", left_out_text(plan.mends.faults)
    if plan.mends.faults is not None and plan.mends.faults.stuck is not None:
        yield "stuck", f"{stuck_text(plan.mends.faults.stuck)}: the median of their neighbours is taken"
    if plan.mends.compression is not None:
        yield "compression", f"{compression_text(plan.mends.compression)}: allowed for"
    moved = plan.mends.moved
    if moved.clock is not None:
        yield "clock", f"{clock_text(moved.clock)}: corrected"
    if moved.times is not None:
        yield "times", f"{times_text(moved.times)}: corrected"
    if recording.found_white is not None:
        yield "white", f"{recording.found_white}, where the 16-bit frames end"
    if plan.mends.black is not None or camera.black_level is not None:
        yield "black", _black_text(plan)
    elif (first := next(iter(recording.frames()))).black > 0:
        yield "black", f"{first.black / first.white_value:.3g} of white is taken off (as recorded)"
    if plan.mends.ceiling is not None:
        yield "saturation", f"from {camera.clipped_from:.2g} of white ({ceiling_text(plan.mends.ceiling)})"
    if camera.white_balance != asked.camera.white_balance:
        yield "white balance", f"{camera.white_balance} for red, green, blue (measured)"


def _unshown(asked: Settings, plan: Plan) -> Iterator[tuple[str, str]]:
    """How far pixels that no frame has measured lie beyond white, where that is told."""
    scale, found, how = plan.settings.filter.unshown_scale, plan.unshown_scale, _GIVEN
    if found is not None:
        how = f"told by pixels that leave saturation: {found.excess:.0f} for {found.expected:.0f} log intensity in all"
    elif asked.filter.unshown_scale is None:
        return
    yield "unshown", f"{scale:.2g} times as far beyond white as frames make expect ({how})"


def _of_motion(recording: Recording, plan: Plan, asked: Settings) -> Iterator[tuple[str, str]]:
    """Whether what moves is followed between frames (K16), where it could be."""
    filtered = plan.settings.filter
    if not (filtered.joins_frames and plan.lookahead) or next(iter(recording.frames())).mosaic is not None:
        return
    if filtered.motion == "on":
        by_size = asked.filter.follows_motion(recording.sensor_size)
        how = "usual of sensors of this size" if by_size else "as both ways in time always"
        what = f"followed between frames ({_GIVEN if asked.filter.motion == 'on' else how})"
    elif asked.filter.motion == "off":
        what = f"not followed between frames ({_GIVEN})"
    else:
        what = (
            "not followed between frames (the sensor has many pixels): --filter.motion on does, for less error "
            "there, and images take two to five times as long"
        )
    yield "motion", what


def saturation_text(recording: Recording, plan: Plan, asked: Settings) -> str:
    """From which level on pixels count as clipped, and where the recording shows that they are.

    For a plan without a ceiling, which `plan_report` tells. Parameters are those of `plan_report`; it looks at up to 80
    frames once more (`kalux.calibration.levels`).
    """
    used = plan.settings.camera.clipped_from
    how = "the usual" if plan.mends.compression is None else "the usual, less what their compression does"
    how = "all that is clipped is at the frames' last level" if plan.mends.is_clean_end else how
    how = how if asked.camera.saturation is None else _GIVEN
    text = f"from {used:.3g} of white ({how}); "
    source = less_black(recording, plan.settings.camera.black_level)
    ceiling = find_ceiling(source, plan.settings.camera, plan.settings.events)
    if ceiling is None:
        return text + "events do not go on where the frames end, or too few tell"
    text += ceiling_text(ceiling)
    if ceiling.level < used and not plan.mends.is_clean_end:
        text += f": {saturation_hint(ceiling)}"
    return text


def saturation_hint(ceiling: Ceiling) -> str:
    """What to do where frames end below what is taken for white."""
    return f"if the camera saturates there, --camera.saturation {ceiling.saturation:.2g} says so"


def _black_text(plan: Plan) -> str:
    """The black level that is taken off, or why none is though no pixel is dark."""
    level, found = plan.settings.camera.black_level or 0.0, plan.mends.black
    if found is None:
        return f"{level:.3g} of white is taken off ({_GIVEN})"
    begin = f"frames begin at {found.floor:.3g}"
    if found.level:
        why = f"it explains {100 * found.gain:.0f} % of what events and frames differ by"
        return f"{level:.3g} of white is taken off ({begin}; {why})"
    return (
        f"0; {begin}, which events do not show to be black: if the camera reads that in the dark, "
        f"--camera.black-level {found.floor:.2g}"
    )


def layout_text(fit: LayoutFit) -> str:
    """What of the events is the wrong way round."""
    layout = fit.found
    wrong = [
        text
        for is_so, text in (
            (layout.mirrored_x, "their x counts from the other side"),
            (layout.mirrored_y, "their y counts from the other side"),
            (layout.swapped, "their polarity 1 is darker"),
        )
        if is_so
    ]
    return f"events follow the frames if {' and '.join(wrong)} (correlation {fit.correlation:.2f})"


def gain_text(faults: FrameFaults) -> str:
    """By how much the frames' brightness steps, and where first; or by how much it goes up and down."""
    spans = float(faults.gains.max() / faults.gains.min())
    if faults.unsteady:
        moved = f"goes up and down by a factor of {spans:.2g}"
        return f"the brightness of the frames {moved}, and events show no such change"
    return (
        f"the brightness of the frames steps at {how_many(len(faults.steps), 'frame')}, first at frame "
        f"{faults.steps[0]}, by up to a factor of {spans:.2g} in all, and events show no such change"
    )


def stuck_text(stuck: NDArray[np.bool_]) -> str:
    """How many pixels of frames are stuck."""
    return f"{how_many(int(np.count_nonzero(stuck)), 'pixel')} always the same though the light changes"


def compression_text(compression: Compression) -> str:
    """That frames were JPEG or a video, and what it did to them."""
    what = "are of a lossy video" if compression.of_video else "were stored as JPEG once"
    return (
        f"frames {what}, which leaves pixels off by up to some {100 * compression.error:.1f} % of white (standard "
        "deviation)"
    )


def clock_text(clock: ClockRate) -> str:
    """How fast or slow the clock of the frames is."""
    return (
        f"that of the frames is {'slow' if clock.rate > 0 else 'fast'} by {1e6 * abs(clock.rate):.0f} us in a second "
        f"(+- {1e6 * clock.standard_error:.0f}), {1e-3 * np.abs(clock.shifts).max():.0f} ms in all"
    )


def times_text(times: FrameTimes) -> str:
    """By how much the times of frames are off."""
    return (
        f"those of the frames are off one by one, by {times.spread / 1000:.1f} ms (standard deviation): events explain "
        f"{100 * (1 - times.left):.0f} % more of what frames show"
    )


def left_out_text(faults: FrameFaults) -> str:
    """Which frames are not used, and why."""
    parts = []
    if faults.copies:
        copies = how_many(len(faults.copies), "frame")
        parts.append(
            f"{copies}, first frame {faults.copies[0]}: the same as the one before, though events show motion"
        )
    if faults.empty:
        parts.append(f"{how_many(len(faults.empty), 'frame')}, first frame {faults.empty[0]}: empty")
    return "; ".join(parts)


def ceiling_text(ceiling: Ceiling) -> str:
    """Where frames end, as a share of white, and what events say there."""
    level = f"{ceiling.level:.2g}"
    if not ceiling.is_at(ceiling.level):
        level = f"{ceiling.least:.2g} to {2 * ceiling.level - ceiling.least:.2g}"
    return f"frames end at {level}, where events go on by {100 * np.expm1(ceiling.excess):.0f} %"


def _agreement_text(agreement: Agreement, settings: Settings) -> str:
    """How well events explain the frames, and how far they are believed where no frame checks them."""
    text = (
        f"events explain {100 * agreement.explained:.0f} % of how the frames change; where they say 1, frames "
        f"change by {agreement.slope:.2f}"
    )
    gain, trust = settings.events.believed_gain, settings.events.believed_trust
    doubts_far = trust < 1.0 and settings.filter.joins_frames
    if gain == 1.0 and not doubts_far:
        return text
    text = f"{text}: beyond white {100 * gain:.0f} % is believed"
    return f"{text}, and far beyond it {100 * trust:.0f} %" if doubts_far else text


def _threshold_origin(plan: Plan) -> str:
    found = plan.steps.thresholds
    if found is None or plan.threshold_origin not in ("estimate", "assumed"):
        return ORIGINS[plan.threshold_origin]
    if plan.threshold_origin == "assumed":
        return (
            f"{100 * found.usual_share:.0f} % usual of the preset, as the recording hardly tells: +- "
            f"{100 * found.spread:.0f} %"
        )
    text = f"{ORIGINS['estimate']} from {how_many(found.samples, 'sample')}, residual {found.residual:.2f}"
    if plan.steps.contradicted is not None:
        text = (
            f"{text}; the recording states {plan.steps.contradicted[0]:g} and {plan.steps.contradicted[1]:g}"
        )
    text += f": +- {100 * found.spread:.0f} %"
    if found.usual_share > _NOTABLE_SHARE:
        text += f"; {100 * found.usual_share:.0f} % is the usual of the preset, as frames show little change"
    return text


def _refractory_text(events: EventSettings) -> str:
    if events.refractory == 0:
        return "nothing is lost in it"
    doubt = f" +- {100 * events.refractory_doubt:.0f} %" if events.refractory_doubt else ""
    return f"{events.refractory * 1e-3:g} ms{doubt}"


def _refractory_origin(plan: Plan, asked: Settings) -> str:
    if asked.events.refractory_period is not None:
        return _GIVEN
    if plan.dead_time:
        return "measured: noise follows other events no sooner"
    if plan.steps.thresholds is None:
        return _USUAL
    return f"estimated from {how_many(plan.steps.thresholds.samples, 'sample')}"


def _noise_origin(plan: Plan, asked: Settings) -> str:
    if asked.camera.frame_noise is not None:
        return _GIVEN
    if isinstance(plan.frame_noise, MovingNoise):
        return "estimated, of what moves"
    if plan.frame_noise is not None:
        return "estimated"
    by_events = plan.steps.model is not None and plan.steps.model.frame_noise is not None
    if by_events:
        return "in the dark as much as events do not explain, at half of white twice that"
    return "the usual, or what parts allow that are dark, or change smoothly"


def _delay_origin(plan: Plan, asked: Settings) -> str:
    found = plan.steps.delay
    if found is None:
        return _USUAL if asked.events.delay is None else _GIVEN
    seem = (
        f"the {found.apparent * 1e-3:.1f} ms that explain the frames {100 * found.improvement:.0f} % better"
    )
    if found.true is None:
        return f"estimated: {SHARE:g} of {seem}, as events trail the light, too"
    trailing = (found.apparent - found.true) * 1e-3
    return f"estimated: {seem}, less half of the {trailing:.1f} ms by which events trail the light"


def _model_origin(plan: Plan, asked: float | None) -> str:
    if asked is not None:
        return _GIVEN
    return (
        _USUAL
        if plan.steps.model is None
        else f"estimated from {how_many(plan.steps.model.samples, 'sample')}"
    )


def _step_origin(plan: Plan, asked: float | None) -> str:
    if plan.mismatch is None or plan.mismatch.per_event is None:
        return _model_origin(plan, asked)
    return _estimated(asked, True)


def _estimated(asked: float | None, found: bool) -> str:
    if asked is not None:
        return _GIVEN
    return "measured" if found else _USUAL


def response_text(response: str) -> str:
    """A response's name, without all values of a measured curve."""
    return "; ".join(
        f"curve of {len(part.split())} knots" if part.startswith("curve:") else part
        for part in response.split(";")
    )
