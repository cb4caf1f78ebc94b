"""Scenes, and a camera with events and frames to look at them: recordings with ground truth."""

from __future__ import annotations

from kalux.datasets.colour import ColourScene, colour_photograph, simulate_colour
from kalux.datasets.scenes import (
    Motion,
    Pose,
    Scene,
    combine,
    demo_scene,
    dolly,
    handheld,
    linear_ramp,
    log_ramp,
    moving_edge,
    pan,
    photograph_scene,
    shake,
    spin,
    static,
    still,
)
from kalux.datasets.simulate import DEMO_SENSOR, Sampling, SensorSettings, Simulation, simulate

__all__ = [
    "DEMO_SENSOR",
    "ColourScene",
    "Motion",
    "Pose",
    "Sampling",
    "Scene",
    "SensorSettings",
    "Simulation",
    "colour_photograph",
    "combine",
    "demo_scene",
    "dolly",
    "handheld",
    "linear_ramp",
    "log_ramp",
    "moving_edge",
    "pan",
    "photograph_scene",
    "shake",
    "simulate",
    "simulate_colour",
    "spin",
    "static",
    "still",
]
