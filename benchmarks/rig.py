"""A simulated two-camera rig, from the blinking board to the reconstruction, against one shared sensor.

    python benchmarks/rig.py [--views 24] [--out FOLDER]

An event camera of 320x240 and a frame camera of 640x480 pixels, both with barrel distortion, 3 degrees and 40 mm apart,
clocks 7.3 ms apart, before a scene in 20 m. Prints the errors of the calibration and of the registration against
the truth, in pixels of the event camera and ms, and the MSE of the reconstruction from both cameras over that of
the reconstruction from one sensor that sees the event camera's image. With --out, the recordings (as kalux HDF5) and
pictures to look at.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

import cv2
import numpy as np

import kalux
from kalux.calibration.boards import Board, calibrate_rig, contact_sheet, event_images, find_views
from kalux.calibration.offset import some_events
from kalux.calibration.pictures import correlation_plot, overlay
from kalux.calibration.registration import Registration
from kalux.calibration.rig import rig_toml
from kalux.calibration.two_cameras import register
from kalux.datasets import Sampling, SensorSettings, combine, shake
from kalux.datasets.exposure import frame_stream, plan_exposures
from kalux.writers import hdf5
from rig_scene import (
    BlinkingBoard,
    board_poses,
    board_scenes,
    checkerboard_picture,
    distant_scenes,
    example_rig,
    patchwork,
    record,
)

OFFSET = 7_300
DISTANCE = 20.0
SENSOR = SensorSettings(
    threshold_on=0.2,
    threshold_off=0.2,
    threshold_mismatch=0.05,
    refractory=200,
    noise_rate=1.0,
    frame_rate=30,
    exposure=5_000,
    read_noise=0.005,
)
BOARD = SensorSettings(
    threshold_on=0.25,
    threshold_off=0.25,
    threshold_mismatch=0.1,
    refractory=30,
    noise_rate=1.0,
    frame_rate=20,
    exposure=10_000,
    read_noise=0.005,
)


def error(found: Registration, truth: Registration) -> str:
    a, b = found.maps, truth.maps
    both = a.inside & b.inside
    off = np.hypot(a.x - b.x, a.y - b.y)[both] / truth.scale
    return f"mean {off.mean():.3f}, 95 % below {np.percentile(off, 95):.3f}, largest {off.max():.3f} pixels"


def mse(recording: kalux.Recording, scene, mask: np.ndarray, times: list[int]) -> float:
    images = list(kalux.reconstruct(recording, times=times))
    return float(
        np.mean([np.mean((i.intensity.astype(float) - scene.at(float(i.t)))[mask] ** 2) for i in images])
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--duration", type=int, default=1_200_000, help="us")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    rig = example_rig()
    sizes = {"events_size": rig.events.sensor_size, "frames_size": rig.frames.sensor_size}
    truth = Registration.of_rig(rig, DISTANCE)

    started = time.perf_counter()
    board = BlinkingBoard(checkerboard_picture(8, 6), 0.03 / 24)
    seen = record(
        board_scenes(rig, board, board_poses(arguments.views, distance=0.55)),
        BOARD,
        clock_offset=OFFSET,
        sampling=Sampling(max_step=20_000, min_step=250),
    )
    print(
        f"board: {len(seen.events):,} events, {len(seen.frames)} frames ({time.perf_counter() - started:.0f} s)"
    )
    started = time.perf_counter()
    square = Board(8, 6, 0.03)
    images = event_images([seen.events], rig.events.sensor_size, 400_000)
    calibrated = calibrate_rig(square, find_views(square, images, seen.frames), **sizes)
    print(f"calibrated in {time.perf_counter() - started:.0f} s: {calibrated.rig.about}")
    print(
        f"  {calibrated.rig.angle:.2f} degrees (true {rig.angle:.2f}), {1e3 * calibrated.rig.baseline:.1f} mm "
        f"(true {1e3 * rig.baseline:.1f})"
    )
    print(f"  mapped at {DISTANCE:g} m: {error(Registration.of_rig(calibrated.rig, DISTANCE), truth)}")

    started = time.perf_counter()
    motion = combine(shake(1, amplitude=6, roll=0.01, band=(0.7, 3)))
    scenes = distant_scenes(
        rig, patchwork((800, 1100)), motion, distance=DISTANCE, duration=arguments.duration
    )
    both = record(scenes, SENSOR, clock_offset=OFFSET, sampling=Sampling(min_step=250))
    shared_frames = list(
        frame_stream(scenes[0], SENSOR, plan_exposures(scenes[0], SENSOR), seed=0, sampling=Sampling())
    )
    print(
        f"scene: {len(both.events):,} events, {len(both.frames)} frames ({time.perf_counter() - started:.0f} s)"
    )

    def frames():
        return both.frames

    def events():
        return [both.events]

    size = rig.events.sensor_size
    shared = kalux.Recording.from_arrays(both.events, shared_frames, sensor_size=size)
    middles = [frame.middle for frame in shared_frames[2:-2]]
    found = {}
    for name, options in {
        "rig as calibrated, 20 m": {"rig": calibrated.rig, "distance": DISTANCE, "homography": "rig"},
        "rig at infinity, refined": {"rig": calibrated.rig},
        "rig's lenses, features": {"rig": calibrated.rig, "homography": "auto"},
        "no calibration, features": {},
    }.items():
        started = time.perf_counter()
        one = found[name] = register(frames, events, **sizes, **options)
        seconds = time.perf_counter() - started
        print(f"{name}: {error(one.registration, truth)}")
        print(
            f"  offset {one.offset * 1e-3:.2f} +- {one.standard_error * 1e-3:.2f} ms (true {OFFSET * 1e-3:.2f}); "
            f"overlap {100 * one.registration.overlap:.1f} %; {seconds:.0f} s"
        )
        pair = kalux.Recording.from_arrays(both.events, one.frames(both.frames), sensor_size=size)
        mask = one.registration.maps.inside
        ours, theirs = (mse(recording, scenes[0], mask, middles) for recording in (pair, shared))
        print(f"  MSE x 100: {100 * ours:.4f}, shared sensor {100 * theirs:.4f}: ratio {ours / theirs:.3f}")
    if arguments.out is None:
        return
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "rig.toml").write_text(rig_toml(calibrated.rig))
    cv2.imwrite(str(arguments.out / "sheet.png"), contact_sheet(calibrated.views))
    one = found["rig at infinity, refined"]
    pair = list(one.frames(both.frames))
    frame = pair[len(pair) // 2]
    near = some_events([both.events], frame.middle - 5_000, frame.middle + 5_000)
    cv2.imwrite(str(arguments.out / "overlay.png"), overlay(frame, near))
    assert one.coarse is not None
    plot = correlation_plot(one.coarse, offset=one.offset, standard_error=one.standard_error)
    cv2.imwrite(str(arguments.out / "offset.png"), plot)
    for name, recorded, sensor_size, events_of, frames_of in (
        ("board_events", seen, size, [seen.events], []),
        ("board_frames", seen, rig.frames.sensor_size, [], seen.frames),
        ("scene_events", both, size, [both.events], []),
        ("scene_frames", both, rig.frames.sensor_size, [], both.frames),
    ):
        del recorded
        hdf5.write(arguments.out / f"{name}.h5", sensor_size=sensor_size, events=events_of, frames=frames_of)


if __name__ == "__main__":
    main()
