"""Warnings of what a plan mended, of what it could not find out, and of what in a recording contradicts itself."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

import numpy as np

from kalux.calibration.levels import find_ceiling
from kalux.plan_report import (
    ceiling_text,
    clock_text,
    compression_text,
    gain_text,
    layout_text,
    left_out_text,
    saturation_hint,
    times_text,
)
from kalux.planning import ESTIMATED_ORIGINS, Plan
from kalux.planning.mending import Mends
from kalux.recording import Recording, less_black
from kalux.settings import Settings
from kalux.wording import how_many

if TYPE_CHECKING:
    from kalux.calibration.global_thresholds import ThresholdEstimate
    from kalux.cli.checking import Contents

_MANY_SAMPLES: Final = 1000
_NEARLY_ALL: Final = 0.95
"""Of many samples, whose thresholds are nearly all the usual ones: the events contradict the frames, or are noise."""

_LITTLE_EXPLAINED: Final = 0.5
"""Of how the frames change, by events: 0.89 and more on 35 simulated scenes and recordings, less than 0.4 with frames
that are 3 pixels aside, or ON events alone."""

_LOOKED_AT: Final = 20
"""Frames that tell where pixels end: 80 of a sensor of 640x480 with 15 million events/s would take 3 s."""

_EXACT: Final = 0.1
"""Standard deviation of estimated thresholds, relative, up to which there is nothing to warn of."""

_ENCODED: Final = (0.38, 0.6)
"""Times the true thresholds are what frames tell that are encoded for a display: by an exponent of 1 / 2.2, or less in
the dark."""

_GIVEN_ORIGINS: Final = ("settings", "calibration")
"""Of thresholds that are used though frames may contradict them."""


_UNRELATED: Final = (
    "the events do not explain how the frames change; if much moves, do both see the same pixels (kalux register), do "
    "both have the same clock (kalux calibrate offset REC finds out), and is polarity 1 brighter?"
)


def plan_warnings(planned: Plan, contents: Contents, preset_name: str) -> Iterator[str]:
    """Warnings of images in gaps between frames, of unknown thresholds, and of events that contradict the frames."""
    gap = gap_warning(planned, contents)
    if gap is not None:
        yield gap
    yield from mend_warnings(planned.mends)
    if planned.threshold_origin in ESTIMATED_ORIGINS and not is_well_known(planned):
        yield threshold_warning(planned, preset_name)
    yield from agreement_warnings(planned)


def saturation_warning(recording: Recording, planned: Plan, asked: Settings) -> str | None:
    """That pixels seem to end at different levels below white, where they are taken for measured; None if not.

    Of a recording whose frames reach white that is told by a look at some of them; else events are asked once more.
    """
    camera, events = planned.settings.camera, planned.settings.events
    known = asked.camera.saturation is not None or planned.mends.ceiling is not None
    if known or not planned.settings.filter.joins_frames:
        return None
    source = less_black(recording, camera.black_level)
    found = find_ceiling(source, camera, events, below=camera.clipped_from, most_frames=_LOOKED_AT)
    if found is None or found.level >= camera.clipped_from:
        return None
    return (
        f"{ceiling_text(found)}: what they show there is taken for measured, and its uncertainty comes out too small; "
        f"{saturation_hint(found)}"
    )


def agreement_warnings(planned: Plan) -> Iterator[str]:
    """That events and frames, or the thresholds and both, contradict each other, and what to do."""
    agreement = None if planned.steps.model is None else planned.steps.model.agreement
    unrelated = unrelated_warning(planned)
    if planned.steps.contradicted is not None:
        assert agreement is not None
        on, off = planned.steps.contradicted
        hint = _encoding_hint(planned.settings, planned.steps.contradicted)
        yield (
            f"the contrast thresholds that the recording states, {on:g} on and {off:g} off, contradict its frames and "
            f"are not used{hint}; to insist, give --events.threshold-on {on:g} "
            f"--events.threshold-off {off:g}"
        )
    if unrelated is not None:
        yield unrelated
    elif (
        planned.threshold_origin in _GIVEN_ORIGINS
        and agreement is not None
        and agreement.contradicts_thresholds
    ):
        yield (
            f"the given contrast thresholds contradict the frames, which change by {agreement.slope:.2f} where "
            "events say 1; without them they are estimated"
        )


def unrelated_warning(planned: Plan) -> str | None:
    """That events do not explain the frames, and what may be wrong; None where they do, or nothing tells."""
    model, layout = planned.steps.model, planned.mends.layout
    unexplained = model is not None and model.agreement.explained < _LITTLE_EXPLAINED
    unrelated = layout is not None and layout.contradicts
    untold = planned.threshold_origin == "assumed" and contradicts(planned.steps.thresholds)
    return _UNRELATED if unexplained or unrelated or untold else None


def _encoding_hint(settings: Settings, stated: tuple[float, float]) -> str:
    """What else may be wrong where both thresholds come out at about half of the ``stated`` ones."""
    if settings.camera.response != "linear":
        return ""
    shares = [found / said for found, said in zip(settings.events.thresholds, stated, strict=True)]
    low, high = _ENCODED
    if not (low < min(shares) and max(shares) < high):
        return ""
    return (
        f" ({shares[0]:.2f} and {shares[1]:.2f} times these fit, as where frames are encoded for a display: if they "
        "are, give --camera.response srgb, or bt709 of videos)"
    )


def threshold_warning(planned: Plan, preset_name: str) -> str:
    """That thresholds are not known, what follows, and how to state them."""
    how = "estimated from the recording" if planned.threshold_origin == "estimate" else "unknown and assumed"
    sensor = (
        ", or the sensor's --preset"
        if planned.threshold_origin == "assumed" and preset_name == "default"
        else ""
    )
    if planned.steps.thresholds is not None:
        how += f" (+- {100 * planned.steps.thresholds.spread:.0f} %)"
    return (
        f"the contrast thresholds are {how}, so brightness above white is uncertain; "
        f"if you know them, give --events.threshold-on and --events.threshold-off{sensor}"
    )


def mend_warnings(mends: Mends, *, with_flags: bool = True) -> Iterator[str]:
    """What of a recording is not used as it is; ``with_flags`` of `kalux reconstruct` that would use it."""
    faults, layout = mends.faults, mends.layout
    if faults is not None and faults.steps:
        flag = " (--camera.even-gain false does not)" if with_flags else ""
        yield f"{gain_text(faults)}: taken for the camera's exposure or gain, and evened out{flag}"
    if faults is not None and (faults.copies or faults.empty):
        flag = " (--camera.leave-out-faulty false keeps them)" if with_flags else ""
        yield f"left out: {left_out_text(faults)}{flag}"
    if mends.compression is not None:
        yield f"compression: {compression_text(mends.compression)}: allowed for; raw frames would be better"
    flag = " (--camera.mend-times false does not)" if with_flags else ""
    if mends.moved.clock is not None:
        yield f"clock: {clock_text(mends.moved.clock)}: corrected{flag}"
    if mends.moved.times is not None:
        yield f"times: {times_text(mends.moved.times)}: corrected{flag}"
    if layout is not None and mends.moves_events:
        flag = " (--events.mend-layout false leaves them as they are)" if with_flags else ""
        yield f"{layout_text(layout)}: put right{flag}"


def calibration_warnings(mends: Mends) -> Iterator[str]:
    """What of a recording is not measured as it is, by commands without settings, and that it contradicts itself."""
    yield from mend_warnings(mends, with_flags=False)
    if mends.layout is not None and mends.layout.contradicts:
        yield _UNRELATED


def gap_warning(planned: Plan, contents: Contents) -> str | None:
    """How many images lie where there is no frame for long; None where there is no such time, or no image in it."""
    if contents.gap is None:
        return None
    begin, end = contents.gap
    images = int(np.count_nonzero((planned.times > begin) & (planned.times < end)))
    if not images:
        return None
    first, last = ((t - contents.start) * 1e-6 for t in contents.gap)
    return (
        f"there is no frame for {(end - begin) * 1e-6:,.0f} s, from {first:.3f} to {last:.3f} s: {images:,} of "
        f"{how_many(len(planned.times), 'image')} lie there; are the times right? --start and --end choose a part"
    )


def is_well_known(planned: Plan) -> bool:
    """Whether estimated thresholds are as exact as stated ones mostly are."""
    return planned.steps.thresholds is not None and planned.steps.thresholds.spread <= _EXACT


def contradicts(estimate: ThresholdEstimate | None) -> bool:
    """Whether many samples have next to no information of the thresholds."""
    return estimate is not None and estimate.samples >= _MANY_SAMPLES and estimate.usual_share > _NEARLY_ALL
