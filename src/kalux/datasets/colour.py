"""Scenes in colour, and cameras that see them: with a Bayer mosaic, or with RGB frames over events of all light."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kalux.datasets.exposure import frame_stream
from kalux.datasets.motion import Motion
from kalux.datasets.scenes import Scene, photograph_scene
from kalux.datasets.sensors import Sampling, SensorSettings
from kalux.datasets.simulate import Simulation, simulate
from kalux.errors import InputError
from kalux.frames import Frame, Mosaic
from kalux.models.colour import luminance, sample_mosaic


@dataclass(frozen=True, eq=False)
class ColourScene:
    """What a sensor looks at, in colour.

    Attributes
    ----------
    radiance
        Called with a time in us (float), returns (height, width, 3): red, green, blue, as `Scene.radiance` otherwise.
    sensor_size, start, end, name
        As of `Scene`.
    """

    radiance: Callable[[float], NDArray[Any]]
    sensor_size: tuple[int, int]
    start: int
    end: int
    name: str = "colour scene"

    def seen(self, by: Callable[[NDArray[Any]], NDArray[Any]]) -> Scene:
        """The scene as pixels see it that make one value of red, green and blue: (H, W, 3) to (H, W)."""
        return Scene(lambda t: by(self.radiance(t)), self.sensor_size, self.start, self.end, self.name)


def colour_photograph(
    image: NDArray[Any], motion: Motion, *, sensor_size: tuple[int, int], duration: int, **options: Any
) -> ColourScene:
    """A camera that moves over an HDR image in colour: as `photograph_scene`, of an image (H, W, 3).

    Raises
    ------
    InputError
        As of `photograph_scene`.
    """
    if image.ndim != 3 or image.shape[2] != 3:
        raise InputError(f"photograph: image has shape {image.shape}; (height, width, 3) is needed")
    parts = [
        photograph_scene(image[..., c], motion, sensor_size=sensor_size, duration=duration, **options)
        for c in range(3)
    ]
    return ColourScene(
        lambda t: np.stack([part.radiance(t) for part in parts], axis=-1),
        sensor_size,
        0,
        duration,
        parts[0].name,
    )


def simulate_colour(
    scene: ColourScene,
    settings: SensorSettings | None = None,
    *,
    mosaic: Mosaic | None = None,
    seed: int = 0,
    exposures: Sequence[int] | None = None,
    sampling: Sampling | None = None,
) -> Simulation:
    """Look at a scene in colour.

    Parameters
    ----------
    mosaic
        Every pixel of frames and events sees its own colour of this Bayer pattern. None: frames in RGB, events of the
        luminance.
    scene, settings, seed, exposures, sampling
        As of `simulate`.

    Returns
    -------
    Simulation
        Its scene, and so its truth, is what the event pixels see: the mosaic, or the luminance.
    """
    if mosaic is not None:
        pattern = mosaic
        made = simulate(
            scene.seen(lambda colour: sample_mosaic(colour, pattern)),
            settings,
            seed=seed,
            exposures=exposures,
            sampling=sampling,
        )
        frames = [dataclasses.replace(frame, mosaic=mosaic) for frame in made.frames]
        return dataclasses.replace(made, frames=frames)
    made = simulate(scene.seen(luminance), settings, seed=seed, exposures=exposures, sampling=sampling)
    return dataclasses.replace(made, frames=_rgb_frames(scene, made, sampling or Sampling()))


def _rgb_frames(scene: ColourScene, made: Simulation, sampling: Sampling) -> list[Frame]:
    # A seed each: channels have noise of their own.
    parts = [
        frame_stream(
            scene.seen(itemgetter((..., c))),
            made.settings,
            made.exposures,
            seed=3 * made.seed + c,
            sampling=sampling,
        )
        for c in range(3)
    ]
    return [
        dataclasses.replace(of_red, image=np.stack([frame.image for frame in (of_red, *others)], axis=-1))
        for of_red, *others in zip(*parts, strict=True)
    ]
