"""What a recording holds, in numbers and as text: the library side of ``kalux info``."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from kalux.events import EventArray
from kalux.frames import Frame, exposure_doubt
from kalux.plan_report import response_text
from kalux.recording import Recording
from kalux.white import WhiteCheck

_RATE_BIN: Final = 10_000  # us, over which the peak event rate is taken
_SATURATED: Final = 0.99  # of white: DAVIS frames clip a few values below it
_NEAR_BLACK: Final = 0.02  # of the way from black to white
_LARGE_GAP: Final = 1.5  # of the median frame interval


@dataclass(frozen=True)
class EventSummary:
    """Numbers about the events of a recording.

    Attributes
    ----------
    count
        Number of events.
    on_share
        Share of ON events, 0 to 1; None without events.
    first, last
        Times of the first and last event, us; None without events.
    mean_rate
        Events per second from the first to the last; None where these coincide.
    peak_rate
        Events per second in the busiest 10 ms; None without events.
    largest_gap
        Longest time without any event, us; None below two events.
    """

    count: int
    on_share: float | None = None
    first: int | None = None
    last: int | None = None
    mean_rate: float | None = None
    peak_rate: float | None = None
    largest_gap: int | None = None


@dataclass(frozen=True)
class FrameSummary:
    """Numbers about the frames of a recording.

    Attributes
    ----------
    count
        Number of frames.
    first, last
        Start of the first and end of the last exposure, us (stamps where exposures are unknown); None
        without frames.
    rate
        Frames per second, from the median interval; None below two frames.
    exposure_min, exposure_median, exposure_max
        Exposure times, us; None where unknown.
    saturated_share
        Share of pixels of at least 99 % of white, of RGB in any channel; None without frames.
    near_black_share
        Share of pixels of at most 2 % of the way from black to white, of RGB in all channels; None without frames.
    gap_count
        Intervals longer than 1.5 times the median: frames that were dropped, perhaps.
    largest_gap
        Longest interval between the starts of two frames, us; None below two frames.
    doubt
        What makes the end of the last exposure doubtful, if anything does.
    """

    count: int
    first: int | None = None
    last: int | None = None
    rate: float | None = None
    exposure_min: int | None = None
    exposure_median: float | None = None
    exposure_max: int | None = None
    saturated_share: float | None = None
    near_black_share: float | None = None
    gap_count: int = 0
    largest_gap: int | None = None
    doubt: str | None = None


@dataclass(frozen=True)
class Description:
    """What `describe` found in a recording.

    Attributes
    ----------
    path, format
        Of the file or folder.
    sensor_size
        (height, width), pixels.
    events, frames
        Numbers about each stream.
    overlap
        Time that both streams cover, us; None where one is empty.
    exposure_known
        Whether the frames have exposure times.
    contrast_threshold
        (on, off), log intensity, as the recording states it; None if it does not.
    has_ground_truth
        Whether reference images come with the recording.
    missing
        What the recording lacks, one sentence each.
    colours
        Of the frames: ``"grey"``, ``"RGB"``, or the pattern of a mosaic; None without frames.
    stored_in_rgb
        Whether a mosaic is stored as RGB that was made of it.
    response
        Of the frame camera, as in `kalux.settings.CameraSettings`; None if the recording does not state it.
    doubt
        What makes the frames' white value doubtful, if anything does.
    """

    path: str
    format: str
    sensor_size: tuple[int, int]
    events: EventSummary
    frames: FrameSummary
    overlap: int | None
    exposure_known: bool
    contrast_threshold: tuple[float, float] | None
    has_ground_truth: bool
    missing: tuple[str, ...]
    colours: str | None = None
    stored_in_rgb: bool = False
    response: str | None = None
    doubt: str | None = None


def describe(recording: Recording) -> Description:
    """Read through a recording and describe it, in bounded memory.

    Parameters
    ----------
    recording
        Any recording; events or frames may be absent, exposures unknown.

    Raises
    ------
    InputError
        If the recording is damaged or its contents are not usable, whatever `Recording` checks.
    """
    source = recording.source
    first = next(iter(recording.stamped_frames()), None)
    stored = next(iter(recording.stored_frames()), None)
    events = summarise_events(recording.events())
    white = WhiteCheck()
    frames = summarise_frames(
        white.watched(recording.stamped_frames()), exposure_known=recording.exposure_known
    )
    return Description(
        path=str(source.path),
        format=source.format,
        sensor_size=recording.sensor_size,
        events=events,
        frames=frames,
        overlap=_overlap(events, frames),
        exposure_known=recording.exposure_known,
        contrast_threshold=source.contrast_threshold,
        has_ground_truth=source.ground_truth is not None,
        missing=source.missing,
        colours=None if first is None else first.colours,
        stored_in_rgb=stored is not None and stored.image.ndim == 3 and recording.mosaic is not None,
        response=recording.response,
        doubt=white.doubt(),
    )


def summarise_events(chunks: Iterable[EventArray]) -> EventSummary:
    """Numbers about a stream of event chunks in time order."""
    count = on_count = peak = largest_gap = 0
    first = last = None
    open_bin, open_count = -1, 0  # the last bin of one chunk may go on in the next
    for chunk in chunks:
        t = chunk["t"]
        if not len(t):
            continue
        if first is None or last is None:
            first = last = int(t[0])
        largest_gap = max(largest_gap, int(t[0]) - last, int(np.diff(t).max(initial=0)))
        bins, counts = np.unique((t - first) // _RATE_BIN, return_counts=True)
        if bins[0] == open_bin:
            counts[0] += open_count
        peak = max(peak, int(counts.max()))
        open_bin, open_count = int(bins[-1]), int(counts[-1])
        count += len(t)
        on_count += int(np.count_nonzero(chunk["p"]))
        last = int(t[-1])
    if first is None or last is None:
        return EventSummary(0)
    return EventSummary(
        count=count,
        on_share=on_count / count,
        first=first,
        last=last,
        mean_rate=count * 1e6 / (last - first) if last > first else None,
        peak_rate=peak * 1e6 / _RATE_BIN,
        largest_gap=largest_gap if count > 1 else None,
    )


def summarise_frames(frames: Iterable[Frame], *, exposure_known: bool = True) -> FrameSummary:
    """Numbers about frames in time order, one in memory at a time."""
    spans: list[tuple[int, int]] = []
    pixels = saturated = near_black = 0
    for frame in frames:
        spans.append((frame.exposure_start, frame.exposure_end))
        image = frame.image if frame.valid is None else frame.image[frame.valid]
        image = image if frame.image.ndim == 2 else image.max(axis=-1)
        pixels += image.size
        saturated += int(np.count_nonzero(image >= _SATURATED * frame.white_value))
        near_black += int(np.count_nonzero(image <= frame.black + _NEAR_BLACK * frame.full_scale))
    if not spans:
        return FrameSummary(0)
    exposures = np.array(spans, np.int64)
    lengths = exposures[:, 1] - exposures[:, 0]
    intervals = np.diff(exposures[:, 0].astype(np.float64))
    median_interval = float(np.median(intervals)) if len(intervals) else None
    return FrameSummary(
        count=len(spans),
        first=int(exposures[0, 0]),
        last=int(exposures[-1, 1]),
        rate=1e6 / median_interval if median_interval else None,
        exposure_min=int(lengths.min()) if exposure_known else None,
        exposure_median=float(np.median(lengths)) if exposure_known else None,
        exposure_max=int(lengths.max()) if exposure_known else None,
        saturated_share=saturated / max(pixels, 1),
        near_black_share=near_black / max(pixels, 1),
        gap_count=int(np.count_nonzero(intervals > _LARGE_GAP * median_interval)) if median_interval else 0,
        largest_gap=int(intervals.max()) if len(intervals) else None,
        doubt=exposure_doubt(exposures) if exposure_known else None,
    )


def _overlap(events: EventSummary, frames: FrameSummary) -> int | None:
    if events.first is None or events.last is None or frames.first is None or frames.last is None:
        return None
    return max(min(events.last, frames.last) - max(events.first, frames.first), 0)


# Text


def format_description(description: Description) -> str:
    """A `Description` as lines of text, without a final newline."""
    height, width = description.sensor_size
    rows = [
        ("format", description.format),
        ("sensor", f"{width} x {height} pixels"),
        *_event_rows(description.events),
        *_frame_rows(description.frames, description.exposure_known),
        *_colour_rows(description),
    ]
    if description.overlap is not None:
        overlap = "none: events and frames do not overlap in time" if not description.overlap else None
        rows.append(("overlap", overlap or f"{_time(description.overlap)} covered by both events and frames"))
    threshold = description.contrast_threshold
    rows.append(
        (
            "threshold",
            "not recorded"
            if threshold is None
            else f"ON {threshold[0]:.3g}, OFF {threshold[1]:.3g} as recorded",
        )
    )
    if description.response is not None:
        rows.append(("response", f"{response_text(description.response)}, as recorded"))
    if description.has_ground_truth:
        rows.append(("reference", "ground truth images are included"))
    rows += [("note", sentence) for sentence in description.missing]
    rows += [("note", doubt) for doubt in (description.doubt, description.frames.doubt) if doubt is not None]
    label_width = max(len(label) for label, _ in rows)
    return "\n".join([description.path, *(f"  {label:<{label_width}}  {text}" for label, text in rows)])


def _event_rows(events: EventSummary) -> list[tuple[str, str]]:
    if events.first is None or events.last is None:
        return [("events", "none")]
    rows = [
        ("events", f"{events.count:,} ({_percent(events.on_share)} ON)"),
        ("", _span(events.first, events.last)),
    ]
    if events.mean_rate is not None:
        # The last 10 ms are not whole: a short recording, or an even one, may have less in any than on average.
        told = (events.peak_rate or 0.0) >= events.mean_rate
        busiest = f", {_rate(events.peak_rate)} in the busiest 10 ms" if told else ""
        rows.append(("", f"{_rate(events.mean_rate)} on average{busiest}"))
    if events.largest_gap is not None:
        rows.append(("", f"longest gap {_time(events.largest_gap)}"))
    return rows


def _frame_rows(frames: FrameSummary, exposure_known: bool) -> list[tuple[str, str]]:
    if frames.first is None or frames.last is None:
        return [("frames", "none")]
    rate = "" if frames.rate is None else f" at {frames.rate:.4g} Hz"
    rows = [("frames", f"{frames.count:,}{rate}"), ("", _span(frames.first, frames.last))]
    if frames.gap_count and frames.largest_gap is not None:
        gaps = "1 gap" if frames.gap_count == 1 else f"{frames.gap_count} gaps"
        rows.append(("", f"{gaps} of over 1.5 intervals, the longest {_time(frames.largest_gap)}"))
    rows.append(
        (
            "",
            f"{_percent(frames.saturated_share)} of pixels saturated, "
            f"{_percent(frames.near_black_share)} near black",
        )
    )
    rows.append(("exposure", _exposure_text(frames) if exposure_known else "unknown"))
    return rows


def _colour_rows(description: Description) -> list[tuple[str, str]]:
    if description.colours in (None, "grey"):
        return []
    if description.colours == "RGB":
        return [("colour", "RGB frames; events are taken as those of a sensor without colour filters")]
    stored = ", stored as RGB that was made of it" if description.stored_in_rgb else ""
    return [("colour", f"Bayer mosaic {description.colours}{stored}")]


def _exposure_text(frames: FrameSummary) -> str:
    if frames.exposure_min is None or frames.exposure_median is None or frames.exposure_max is None:
        return "unknown"
    if frames.exposure_min == frames.exposure_max:
        return _time(frames.exposure_min)
    return f"{_time(frames.exposure_min)} to {_time(frames.exposure_max)}, median {_time(frames.exposure_median)}"


def _span(first: int, last: int) -> str:
    return f"{_time(last - first)}, from {first / 1e6:.6f} s to {last / 1e6:.6f} s"


def _time(us: float) -> str:
    for limit, unit, factor in ((1e3, "us", 1.0), (1e6, "ms", 1e3)):
        if us < limit:
            return f"{us / factor:.4g} {unit}"
    return f"{us / 1e6:,.3f} s"


def _rate(per_second: float | None) -> str:
    if per_second is None:
        return "unknown"
    for limit, unit, factor in ((1e3, "events/s", 1.0), (1e6, "thousand events/s", 1e3)):
        if per_second < limit:
            return f"{per_second / factor:.3g} {unit}"
    return f"{per_second / 1e6:.3g} million events/s"


def _percent(share: float | None) -> str:
    if share is None:
        return "unknown"
    return f"{100 * share:.1f} %" if share == 0 or share >= 0.001 else f"{100 * share:.2g} %"
