"""Colour, measured on an HDR photograph: how to demosaic, and images against the truth and the last frame.

    python benchmarks/colour.py Oxford_Church.hdr

docs/colour.md has the tables.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable
from unittest import mock

import cv2
import numpy as np

import kalux
import kalux.images
from kalux.datasets import SensorSettings, colour_photograph, combine, handheld, pan, simulate_colour
from kalux.models import colour
from kalux.models.colour import calm_highlights, channels, demosaic, luminance, sample_mosaic
from kalux.recording import Recording

OFFSET = 0.03
PLUS = np.array([[0, 0, -1, 0, 0], [0, 0, 2, 0, 0], [-1, 2, 4, 2, -1], [0, 0, 2, 0, 0], [0, 0, -1, 0, 0]]) / 8
ROW = (
    np.array([[0, 0, 0.5, 0, 0], [0, -1, 0, -1, 0], [-1, 4, 5, 4, -1], [0, -1, 0, -1, 0], [0, 0, 0.5, 0, 0]])
    / 8
)
CROSS = (
    np.array(
        [[0, 0, -1.5, 0, 0], [0, 2, 0, 2, 0], [-1.5, 0, 6, 0, -1.5], [0, 2, 0, 2, 0], [0, 0, -1.5, 0, 0]]
    )
    / 8
)


def bilinear(image, mosaic):
    """The mean of the nearest pixels of each colour."""
    kernel = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 4
    seen = channels(mosaic, image.shape)
    parts = []
    for c in range(3):
        there = (seen == c).astype(float)
        parts.append(filtered(image * there, kernel) / filtered(there, kernel))
    return np.stack(parts, axis=-1)


def malvar(image, mosaic):
    """Malvar, He, Cutler, "High-Quality Linear Interpolation for Demosaicing of Bayer-Patterned Color Images", 2004."""
    seen = channels(mosaic, image.shape)
    green, row, column, cross = (filtered(image, k) for k in (PLUS, ROW, ROW.T, CROSS))
    red_rows = np.broadcast_to((seen == 0).any(axis=1)[:, None], image.shape)
    out = np.empty((*image.shape, 3))
    out[..., 1] = np.where(seen == 1, image, green)
    out[..., 0] = np.where(seen == 0, image, np.where(seen == 2, cross, np.where(red_rows, row, column)))
    out[..., 2] = np.where(seen == 2, image, np.where(seen == 0, cross, np.where(red_rows, column, row)))
    return out


def filtered(image, kernel):
    """Correlation with a mirrored border."""
    return cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REFLECT_101)


def logarithmic(method: Callable) -> Callable:
    """The method on log(I + 0.03)."""
    return lambda image, mosaic: np.exp(method(np.log(image + OFFSET), mosaic)) - OFFSET


def errors(found, truth) -> str:
    """MSE, log-MSE, and the distance in r, g, b of well exposed pixels and of those beyond white."""
    found = np.maximum(found, 0)
    log_mse = np.mean((np.log(found + OFFSET) - np.log(truth + OFFSET)) ** 2)
    apart = [v / (v.sum(axis=-1, keepdims=True) + 1e-4) for v in (found, truth)]
    distance = 100 * np.linalg.norm(apart[0] - apart[1], axis=-1)
    brightest = truth.max(axis=-1)
    exposed, beyond = distance[(luminance(truth) > 0.05) & (brightest < 0.95)], distance[brightest > 1.2]
    worst = [np.percentile(part, 99) for part in (exposed, beyond)]
    return (
        f"MSE {np.mean((found - truth) ** 2):8.3f}  log-MSE x100 {100 * log_mse:7.2f}  chromaticity x100 "
        f"{exposed.mean():5.2f} (99 %: {worst[0]:5.2f}), beyond white {beyond.mean():5.2f} ({worst[1]:5.2f})"
    )


def compare_demosaicing(picture) -> None:
    """Mosaics of the photograph, with and without noise of the estimates."""
    print("demosaicing, noise of the log intensity 0 and 0.05")
    methods = {
        "bilinear": bilinear,
        "bilinear, log": logarithmic(bilinear),
        "Malvar": malvar,
        "Malvar, log": logarithmic(malvar),
        "kalux": lambda image, mosaic: demosaic(image.astype(np.float32), mosaic, OFFSET),
    }
    for noise in (0.0, 0.05):
        raw = sample_mosaic(picture, "RGGB").astype(float)
        raw = np.maximum(
            (raw + OFFSET) * np.exp(noise * np.random.default_rng(0).normal(size=raw.shape)) - OFFSET, 0
        )
        for name, method in methods.items():
            print(f"  {noise:4.2f} {name:15} {errors(method(raw, 'RGGB'), picture)}")


def compare_images(picture) -> None:
    """Simulated recordings with a mosaic, with RGB frames, and with RGB frames that were made of a mosaic."""
    scene = colour_photograph(
        picture, combine(pan(60, 25), handheld(1)), sensor_size=(120, 160), duration=700_000
    )
    sensor = SensorSettings(
        threshold_mismatch=0.05, noise_rate=0.5, exposure=8000, read_noise=0.005, refractory=100
    )
    for mosaic in ("RGGB", None):
        made = simulate_colour(scene, sensor, mosaic=mosaic)
        middles = np.array([frame.middle for frame in made.frames])
        times = np.sort(np.concatenate([middles[4:-3], (middles[4:-3] + middles[5:-2]) // 2]))
        truth = np.stack([scene.radiance(float(t)) for t in times])
        print(f"images, {'mosaic ' + mosaic if mosaic else 'RGB frames, events of the luminance'}")
        print(f"  {'last frame':22} {errors(held(made, times), truth)}")
        for name, smooth in (("default", False), ("both ways in time", True)):
            images = list(kalux.reconstruct(made.recording(), times=times, smooth=smooth))
            print(f"  {name:22} {errors(np.stack([image.colour for image in images]), truth)}")
            if mosaic is not None:
                compare_doubt(made.recording(), times, smooth, truth)
        if mosaic is not None:
            compare_rgb_of_a_mosaic(made, times, truth)


def compare_doubt(recording, times, smooth, truth) -> None:
    """Highlights with more and less of their colour than with `colour.DOUBT`, which the images before have."""
    for doubt in (0.0, 1.0, 10.0):
        scale = np.float32(doubt / colour.DOUBT)

        def calmed(picture, variance, *white, scale=scale):
            return calm_highlights(picture, scale * variance, *white)

        with mock.patch.object(kalux.images, "calm_highlights", calmed):
            images = list(kalux.reconstruct(recording, times=times, smooth=smooth))
        print(f"    {f'DOUBT {doubt:g}':20} {errors(np.stack([image.colour for image in images]), truth)}")


def compare_rgb_of_a_mosaic(made, times, truth) -> None:
    """Frames that OpenCV demosaiced: by their luminance, and with every pixel's own channel given back."""
    frames = [
        dataclasses.replace(f, image=cv2.cvtColor(f.image, cv2.COLOR_BayerBG2RGB), mosaic=None)
        for f in made.frames
    ]
    rgb = Recording.from_arrays(
        made.events, frames, sensor_size=made.scene.sensor_size, contrast_threshold=made.settings.threshold_on
    )
    for name, recording in (
        ("stored as RGB", rgb),
        ("same, --bayer RGGB", Recording(rgb.source, mosaic="RGGB")),
    ):
        images = kalux.reconstruct(recording, times=times)
        print(f"  {name:22} {errors(np.stack([image.colour for image in images]), truth)}")


def held(made, times):
    """The last frame that was finished at each time."""
    last = [[frame for frame in made.frames if frame.exposure_end <= t][-1] for t in times]
    values = [(frame.normalised().astype(np.float32), frame.mosaic) for frame in last]
    return np.stack([v if mosaic is None else demosaic(v, mosaic, OFFSET) for v, mosaic in values])


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description="Demosaicing, and images in colour, on an HDR photograph.")
    parser.add_argument("picture", help="in colour, of a kind that OpenCV reads: Radiance HDR")
    name = parser.parse_args().picture
    read = cv2.imread(name, cv2.IMREAD_UNCHANGED)
    if read is None or read.ndim != 3:
        parser.error(f"{name}: OpenCV reads no colours from it")
    picture = read[..., 2::-1]
    small = cv2.resize(picture, None, fx=0.34, fy=0.34, interpolation=cv2.INTER_AREA)
    compare_demosaicing(small / np.percentile(small, 80))
    half = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    compare_images(half / np.percentile(luminance(half), 85))


if __name__ == "__main__":
    main()
