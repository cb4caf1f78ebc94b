"""White balance from a recording."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import kalux
from kalux.calibration.white_balance import grey_world
from kalux.errors import FrameError
from kalux.frames import Frame
from kalux.models.colour import sample_mosaic, scaled_gains
from kalux.planning import plan
from kalux.recording import Recording
from kalux.settings import CameraSettings

from builders import colour_blocks

CAST = np.array([0.9, 0.6, 0.4])


def recording(mosaic=None, level=200.0, response=lambda value: value):
    """Grey patches under coloured light."""
    patches = np.random.default_rng(0).uniform(0.3, 1, (10, 12)).repeat(2, 0).repeat(2, 1)
    rgb = np.rint(level * response(patches[..., None] * CAST)).astype(np.uint8)
    image = rgb if mosaic is None else sample_mosaic(rgb, mosaic)
    frames = [Frame(image, 1000 * k, 1000 * k + 500, mosaic=mosaic) for k in range(3)]
    return Recording.from_arrays(np.empty(0, kalux.EVENT_DTYPE), frames, sensor_size=(20, 24))


@pytest.mark.parametrize("mosaic", [None, "RGGB", "GBRG"])
def test_grey_under_coloured_light_becomes_grey(mosaic):
    assert grey_world(recording(mosaic), CameraSettings()) == pytest.approx(scaled_gains(1 / CAST), rel=0.01)


@pytest.mark.parametrize("mosaic", [None, "RGGB"])
def test_pixels_that_are_not_valid_do_not_count(mosaic):
    made, valid = recording(mosaic), np.ones((20, 24), np.bool_)
    valid[:10] = False
    images = [np.where(valid[..., None] if mosaic is None else valid, f.image, 200) for f in made.frames()]
    frames = [
        dataclasses.replace(f, image=image, valid=valid)
        for f, image in zip(made.frames(), images, strict=True)
    ]
    masked = Recording.from_arrays(np.empty(0, kalux.EVENT_DTYPE), frames, sensor_size=(20, 24))
    assert grey_world(masked, CameraSettings()) == pytest.approx(scaled_gains(1 / CAST), rel=0.01)


def test_the_response_of_each_colour_is_undone():
    made = recording(level=255.0, response=lambda value: value ** np.array([1.0, 0.5, 1.0]))
    gains = grey_world(made, CameraSettings(response="linear;gamma:2;linear"))
    assert gains == pytest.approx(scaled_gains(1 / CAST), rel=0.02)


def test_nothing_well_exposed_is_said():
    with pytest.raises(FrameError, match="no pixel is well exposed in all colours; give white_balance"):
        grey_world(recording(level=5.0), CameraSettings())


def test_a_plan_has_the_gains_that_were_measured():
    _, made = colour_blocks("RGGB")
    wanted = dataclasses.replace(kalux.PRESETS["default"], camera=CameraSettings(white_balance="grey-world"))
    planned = plan(made.recording(), at="frames", settings=wanted)
    gains = [float(g) for g in planned.settings.camera.white_balance.split(";")]
    assert gains == pytest.approx(grey_world(made.recording(), CameraSettings()), abs=1e-4)
