"""Scenes, and a camera with events and frames to look at them: recordings with ground truth."""

from __future__ import annotations

from kalux.datasets.colour import ColourScene, colour_photograph, simulate_colour
from kalux.datasets.motion import Motion, Pose, combine, dolly, handheld, pan, shake, spin, still
from kalux.datasets.room import demo_scene
from kalux.datasets.scenes import Scene, linear_ramp, log_ramp, moving_edge, photograph_scene, static
from kalux.datasets.sensors import DEMO_SENSOR, PRESETS, Sampling, SensorPreset, SensorSettings, sensor_preset
from kalux.datasets.simulate import Simulation, simulate

__all__ = [
    "DEMO_SENSOR",
    "PRESETS",
    "ColourScene",
    "Motion",
    "Pose",
    "Sampling",
    "Scene",
    "SensorPreset",
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
    "sensor_preset",
    "shake",
    "simulate",
    "simulate_colour",
    "spin",
    "static",
    "still",
]
