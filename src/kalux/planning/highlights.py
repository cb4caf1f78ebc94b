"""How far a scene goes beyond white: pixels that leave saturation tell, in a first look at its beginning."""

from __future__ import annotations

import itertools
import math
from typing import Final, NamedTuple

from kalux.augmentation.bridge import Revealed
from kalux.augmentation.highlights import scale_of_all
from kalux.driver import EventFeed, engine_of
from kalux.models.pixels import PixelCalibration
from kalux.reconstructor import Reconstructor
from kalux.recording import Recording
from kalux.settings import Settings, altered

_MOST_FRAMES: Final = 30
_MOST_EVENTS: Final = 4_000_000
"""What the filter looks at ends with the first frame by which there are so many: later ones tell as they come."""


class UnshownScale(NamedTuple):
    """What the beginning of a recording tells of pixels that every frame had clipped before (docs/equations.md, K15).

    Attributes
    ----------
    scale
        How many times as far above their bounds they are taken to lie as frames and events make expect, R_0.
    excess, expected
        Sums of their distances from their bounds, log intensity, found and expected.
    """

    scale: float
    excess: float
    expected: float


def with_unshown_scale(
    recording: Recording,
    settings: Settings,
    pixels: PixelCalibration | None,
    *,
    threshold_is_estimate: bool,
    lookahead: bool,
) -> tuple[Settings, UnshownScale | None]:
    """Fill in ``filter.unshown_scale`` by the first frames of a recording, and their events.

    Parameters
    ----------
    recording
        Mended.
    settings
        With all else filled in.
    pixels, threshold_is_estimate, lookahead
        As of the `Reconstructor` that is to make the images. Without lookahead nothing is known of what comes.

    Returns
    -------
    The settings, and what was found; None where it was not looked for, or nothing could tell.
    """
    filtered = settings.filter
    uses_it = filtered.joins_frames and filtered.highlight_scale > 0 and filtered.unshown_tail > 0
    if not (uses_it and lookahead) or filtered.unshown_scale is not None:
        return settings, None
    # Paths are followed in images alone, and take longer than all else.
    without_paths = altered(settings, "filter", motion="off")
    engine = engine_of(recording, without_paths, pixels, threshold_is_estimate=threshold_is_estimate)
    revealed = _revealed(recording, engine)
    if revealed is None or revealed.moved_expected == 0:
        return altered(settings, "filter", unshown_scale=1.0), None
    told = scale_of_all(revealed)
    # Too bright costs more than too dark, and those that leave later are not always like the first (docs/equations.md).
    scale = min(told, math.sqrt(told))
    found = UnshownScale(scale, revealed.moved_excess, revealed.moved_expected)
    return altered(settings, "filter", unshown_scale=scale), found


def _revealed(recording: Recording, engine: Reconstructor) -> Revealed | None:
    """What the first frames reveal; None where the first one clips nothing, or there is one alone."""
    feed, revealed = EventFeed(engine, iter(recording.events())), None
    for frame in itertools.islice(recording.frames(), _MOST_FRAMES):
        engine.push_frame(frame)
        feed.cover(frame.exposure_end)
        until = engine.final_until
        if until is None:
            continue
        unshown = engine.estimate(until).unshown
        if unshown is None:
            break
        revealed = unshown.memory.revealed
        if feed.count(frame.exposure_end) >= _MOST_EVENTS:
            break
    return revealed
