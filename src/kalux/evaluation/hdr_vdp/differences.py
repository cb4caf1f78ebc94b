"""Contrast masking, and the errors of the bands pooled to one number."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from kalux.compiled import loop
from kalux.evaluation.hdr_vdp import constants as c
from kalux.evaluation.hdr_vdp import pyramid
from kalux.evaluation.hdr_vdp.pathway import perceive
from kalux.evaluation.hdr_vdp.resampling import resize
from kalux.evaluation.hdr_vdp.sensitivity import (
    LOG_LUMINANCE,
    contrast_sensitivity,
    contrast_sensitivity_table,
)

Array = NDArray[np.float64]


def band_errors(test: Array, reference: Array, pixels_per_degree: float) -> Array:
    """What each band, from high to low frequency, adds to Q_err: its pooled error over the number of bands."""
    seen_test, seen_reference = (perceive(image, pixels_per_degree) for image in (test, reference))
    levels = pyramid.height(test.shape, pixels_per_degree)
    bands_test, bands_reference = (
        pyramid.decompose(seen.response, levels) for seen in (seen_test, seen_reference)
    )
    maskings = [mutual_masking(*pair) for pair in zip(bands_test, bands_reference, strict=True)]
    log_adaptation = np.clip(np.log10((seen_test.adaptation + seen_reference.adaptation) / 2), *LOG_LUMINANCE)
    counted = differing_pixels(test, reference).astype(np.float64)

    errors = []
    for band, frequency in enumerate(pyramid.frequencies(levels, pixels_per_degree)):
        of_test, of_reference = bands_test[band], bands_reference[band]
        log_luminance = np.clip(resize(log_adaptation, of_test.shape), *LOG_LUMINANCE)
        if band == levels + 1:
            noise = base_band_noise(of_test - of_reference, frequency, log_luminance)
        else:
            noise = band_noise(frequency, log_luminance)
        errors.append(
            _pooled_error(
                of_test,
                of_reference,
                maskings[band],
                neighbour_masking(maskings, band),
                noise,
                resize(counted, of_test.shape),
                *(c.MASK_P, c.MASK_Q, c.MASK_SELF, c.MASK_NEIGHBOURS, c.POOLING_EXPONENT),
            )
        )
    return np.array(errors) / len(errors)


def differing_pixels(test: Array, reference: Array) -> NDArray[np.bool_]:
    """Pixels that differ enough to count."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.abs(test - reference) / reference > c.VISIBLE_RATIO


def mutual_masking(test: Array, reference: Array) -> Array:
    """What test and reference have in common, averaged over 3 x 3 pixels (zero beyond the band)."""
    masking: Array = _mutual_masking(test, reference)
    return masking


@loop(error_model="python")
def _mutual_masking(test, reference):  # type: ignore[no-untyped-def]
    rows, columns = test.shape
    common = np.zeros((rows + 2, columns + 2))
    common[1:-1, 1:-1] = np.minimum(np.abs(test), np.abs(reference))
    out = np.empty((rows, columns))
    for i in range(rows):
        three = common[i] + common[i + 1] + common[i + 2]
        for j in range(columns):
            out[i, j] = (three[j] + three[j + 1] + three[j + 2]) / 9
    return out


def neighbour_masking(maskings: Sequence[Array], band: int) -> Array:
    """Masking by the bands next to a band, at its size; the base band masks none."""
    shape = maskings[band].shape
    masking = np.zeros(shape)
    for neighbour in (band - 1, band + 1):
        if 0 <= neighbour < len(maskings) - 1:
            masking += np.maximum(resize(maskings[neighbour], shape), 0)
    return masking


def band_noise(frequency: float, log_luminance: Array) -> Array:
    """N_CSF^(2p): the contrast that is just seen without masking."""
    noise: Array = _band_noise(
        contrast_sensitivity_table(frequency), log_luminance, *LOG_LUMINANCE, -2 * c.MASK_P
    )
    return noise


@loop(error_model="python")
def _band_noise(table, log_luminance, low, high, exponent):  # type: ignore[no-untyped-def]
    noise = np.empty_like(log_luminance)
    steps = (len(table) - 1) / (high - low)
    for i in range(noise.shape[0]):
        for j in range(noise.shape[1]):
            place = (log_luminance[i, j] - low) * steps
            index = min(int(place), len(table) - 2)
            sensitivity = table[index] + (table[index + 1] - table[index]) * (place - index)
            noise[i, j] = sensitivity**exponent
    return noise


def base_band_noise(difference: Array, frequency: float, log_luminance: Array) -> Array:
    """As `band_noise`, at the one frequency and luminance of the base band as a whole."""
    at = dominant_frequency(difference, 4 * frequency)
    sensitivity = contrast_sensitivity(at, np.mean(log_luminance, keepdims=True))
    with np.errstate(divide="ignore"):
        return np.broadcast_to(sensitivity ** (-2 * c.MASK_P), difference.shape).copy()


def dominant_frequency(image: Array, pixels_per_degree: float) -> float:
    """Frequency at which an image is strongest, its mean aside; 0 of a uniform one."""
    strength = np.abs(fft.rfft2(image))
    strength[0, 0] = 0
    row, column = np.unravel_index(np.argmax(strength), strength.shape)
    vertical = abs(fft.fftfreq(image.shape[0])[row])
    horizontal = column / image.shape[1]
    return float(np.hypot(vertical, horizontal) * pixels_per_degree)


@loop(error_model="python")
def _pooled_error(test, reference, masking, neighbours, noise, counted, p, q, own, other, pooling):  # type: ignore[no-untyped-def]
    """Minkowski mean of D = |B_T - B_R|^p / sqrt(N_CSF^(2p) + N_mask^2), each times the share of it that counts."""
    total = 0.0
    for i in range(test.shape[0]):
        row = 0.0
        for j in range(test.shape[1]):
            difference = abs(test[i, j] - reference[i, j])
            share = abs(counted[i, j])
            if difference > 0 and share > 0:
                mask = own * masking[i, j] ** q + other * neighbours[i, j] ** q
                seen = difference ** (p * pooling) * (noise[i, j] + mask**2) ** (-0.5 * pooling)
                row += seen if share == 1 else seen * share**pooling
        total += row
    return (total / test.size) ** (1 / pooling)
