"""Motions of a camera: its pose as a function of time."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from kalux.errors import InputError


class Pose(NamedTuple):
    """Where the camera looks: ``x`` right and ``y`` down in sensor pixels, ``angle`` in radians clockwise,
    ``zoom`` as a factor (2 shows things twice as large)."""

    x: float = 0.0
    y: float = 0.0
    angle: float = 0.0
    zoom: float = 1.0


Motion = Callable[[float], Pose]
"""Pose of the camera at a time in us."""


def still() -> Motion:
    """A camera on a tripod."""
    return lambda t: Pose()


def pan(vx: float, vy: float = 0.0) -> Motion:
    """Constant velocity, sensor pixels per second."""
    return lambda t: Pose(vx * t * 1e-6, vy * t * 1e-6)


def spin(rate: float) -> Motion:
    """Constant rotation about the optical axis, radians per second."""
    return lambda t: Pose(angle=rate * t * 1e-6)


def dolly(rate: float) -> Motion:
    """Exponential zoom, ``exp(rate * t)``: natural logarithms per second, positive moves closer."""
    # exp(700) is the largest that double precision holds, and no camera zooms so far.
    return lambda t: Pose(zoom=float(np.exp(min(rate * t * 1e-6, 700.0))))


def shake(
    seed: int,
    *,
    amplitude: float = 1.0,
    roll: float = 0.0,
    band: tuple[float, float] = (4.0, 12.0),
) -> Motion:
    """Random vibration: a sum of sinusoids.

    Parameters
    ----------
    seed
        Chooses frequencies and phases.
    amplitude
        Root-mean-square displacement per axis, sensor pixels.
    roll
        Root-mean-square rotation, radians.
    band
        Lowest and highest frequency, Hz. The default is the band of physiological hand tremor.

    Raises
    ------
    InputError
        If a root mean square is negative.
    """
    if not (amplitude >= 0 and roll >= 0):
        raise InputError(f"shake: amplitude {amplitude} and roll {roll}; 0 or more are needed")
    rng = np.random.default_rng(seed)
    count = 5
    frequency = rng.uniform(*band, (3, count)) * 2e-6 * np.pi
    phase = rng.uniform(0, 2 * np.pi, (3, count))
    # A sinusoid of amplitude a has the mean square a^2 / 2.
    scale = np.array([amplitude, amplitude, roll]) * np.sqrt(2 / count)

    def pose(t: float) -> Pose:
        x, y, angle = scale * np.sin(frequency * t + phase).sum(axis=1)
        return Pose(float(x), float(y), float(angle))

    return pose


def handheld(seed: int, *, sway: float = 6.0, tremor: float = 0.4, roll: float = 0.01) -> Motion:
    """A camera in the hand: slow sway (0.3 to 2 Hz) with a little tremor (6 to 12 Hz).

    Parameters
    ----------
    seed
        Chooses frequencies and phases.
    sway, tremor
        Root-mean-square displacements per axis, sensor pixels.
    roll
        Root-mean-square rotation of the sway, radians.

    Raises
    ------
    InputError
        As of `shake`.
    """
    # Two streams of one seed, so that neither repeats the other's phases.
    slow, fast = (int(s) for s in np.random.default_rng(seed).integers(2**32, size=2))
    return combine(
        shake(slow, amplitude=sway, roll=roll, band=(0.3, 2.0)),
        shake(fast, amplitude=tremor, band=(6.0, 12.0)),
    )


def combine(*motions: Motion) -> Motion:
    """All motions at once: displacements and angles add, zooms multiply."""

    def pose(t: float) -> Pose:
        x, y, angle, zoom = 0.0, 0.0, 0.0, 1.0
        for motion in motions:
            part = motion(t)
            x, y, angle, zoom = x + part.x, y + part.y, angle + part.angle, zoom * part.zoom
        return Pose(x, y, angle, zoom)

    return pose
