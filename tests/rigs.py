"""A small simulated rig, made once for all tests that need it."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from kalux.calibration.registration import Registration
from kalux.calibration.rig import Rig
from kalux.datasets import Sampling, SensorSettings, combine, shake
from rig_scene import (
    BlinkingBoard,
    RigRecording,
    board_poses,
    board_scenes,
    checkerboard_picture,
    distant_scenes,
    example_rig,
    patchwork,
    record,
)

OFFSET, DISTANCE, SQUARE = 7_300, 20.0, 0.04
SENSOR = SensorSettings(frame_rate=40, exposure=4_000, read_noise=0.005, threshold_mismatch=0.05)


@lru_cache(maxsize=1)
def small_rig() -> Rig:
    """160 x 120 events, 320 x 240 frames, 3 degrees and 40 mm apart."""
    return example_rig((120, 160), (240, 320))


@lru_cache(maxsize=1)
def distant_recording() -> RigRecording:
    """Half a second of a rig that is shaken before a picture 20 m away."""
    motion = combine(shake(3, amplitude=4, roll=0.01, band=(1, 4)))
    scenes = distant_scenes(
        small_rig(), patchwork((480, 640), 2), motion, distance=DISTANCE, duration=500_000
    )
    return record(scenes, SENSOR, clock_offset=OFFSET, sampling=Sampling(min_step=500))


@lru_cache(maxsize=1)
def board_recording(poses: int = 10) -> RigRecording:
    """A blinking board of 6 x 5 corners in ten poses."""
    board = BlinkingBoard(checkerboard_picture(6, 5), SQUARE / 24)
    scenes = board_scenes(small_rig(), board, board_poses(poses, distance=0.5, seed=1), pose_time=300_000)
    sensor = SensorSettings(
        threshold_on=0.3,
        threshold_off=0.3,
        threshold_mismatch=0.1,
        refractory=30,
        frame_rate=30,
        noise_rate=1.0,
    )
    return record(scenes, sensor, clock_offset=OFFSET, sampling=Sampling(max_step=10_000, min_step=1_000))


def misplaced(found: Registration, truth: Registration) -> np.ndarray:
    """Distances between where both take the pixels that they share, event camera's pixels."""
    a, b = found.maps, truth.maps
    return np.hypot(a.x - b.x, a.y - b.y)[a.inside & b.inside] / truth.scale
