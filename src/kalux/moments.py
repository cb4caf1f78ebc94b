"""A moment between two frames: what images need of the frames besides the filter's estimate."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kalux.augmentation.bridge import bridge_variance
from kalux.filters.shots import Shot
from kalux.models.colour import joined_chromaticity


class Moment(NamedTuple):
    """A time, and the frames that are used for it.

    Attributes
    ----------
    t
        us.
    before
        The frame whose segment it lies in.
    after
        The next; None where it is not known or not used.
    share
        Of the segment that has passed: 0 to 1.
    """

    t: int
    before: Shot
    after: Shot | None
    share: float

    @property
    def between(self) -> float:
        """`bridge_variance` of the share; 1 where there is only one frame."""
        return 1.0 if self.after is None else bridge_variance(self.share)

    @property
    def exposed(self) -> float:
        """Exposure over frame interval; 0 where there is only one frame."""
        if self.after is None:
            return 0.0
        exposures = self.before.end - self.before.start + self.after.end - self.after.start
        return min(exposures / 2 / (self.after.middle - self.before.middle), 1.0)

    def since(self, interval: float) -> float | None:
        """Time to the only frame, in units of ``interval`` (us); None where there are two frames."""
        return None if self.after is not None else abs(self.t - self.before.middle) / interval

    def white(self, offset: float) -> float:
        """log(I + ``offset``) of a saturated pixel, interpolated between the frames."""
        white = float(np.log(self.before.white + offset))
        if self.after is None:
            return white
        return white + self.share * (float(np.log(self.after.white + offset)) - white)

    def chroma(self) -> NDArray[np.float32] | None:
        """Chromaticity of RGB frames, interpolated in time; None of others."""
        if self.before.chroma is None:
            return None
        fraction = 0.0
        shots = [self.before]
        if self.after is not None:
            shots.append(self.after)
            way = self.after.middle - self.before.middle
            fraction = min(max((self.t - self.before.middle) / way, 0.0), 1.0)
        parts = [
            (weight, shot.chroma, shot.chroma_weight)
            for weight, shot in zip((1.0 - fraction, fraction), shots, strict=False)
            if shot.chroma is not None and shot.chroma_weight is not None
        ]
        return joined_chromaticity(parts)
