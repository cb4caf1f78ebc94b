"""From luminance to the response of the eye: optics, adaptation, photoreceptors."""

from __future__ import annotations

from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from kalux.compiled import loop
from kalux.evaluation.hdr_vdp import constants as c
from kalux.evaluation.hdr_vdp.sensitivity import LOG_LUMINANCE, modulation_transfer, response_tables

Array = NDArray[np.float64]

_SPATIAL_BELOW: Final = 4.3
"""Pixels. The original blurs in space, replicating the border, below this size, and by a periodic transform of an
image extended at one end from it on; borders differ, so both are followed."""


class Percept(NamedTuple):
    """What one image does to the eye; both (H, W).

    Attributes
    ----------
    response
        Of cones and rods together, in just noticeable differences.
    adaptation
        Adapting luminance, cd/m2.
    """

    response: Array
    adaptation: Array


def perceive(luminance: Array, pixels_per_degree: float) -> Percept:
    """Response and adaptation to an image in cd/m2."""
    log_retinal = np.log(scatter(luminance, pixels_per_degree))
    adaptation = np.exp(gaussian(log_retinal, 10**c.LOG_ADAPTATION_SIZE * pixels_per_degree))
    geometric_mean = float(np.exp(np.mean(np.log(adaptation))))
    gain = pupil_gain(geometric_mean, luminance.size / pixels_per_degree**2)
    return Percept(photoreceptors(log_retinal, gain), adaptation)


def scatter(luminance: Array, pixels_per_degree: float) -> Array:
    """Glare: the image on the retina, of a scene that continues mirrored beyond the image.

    A symmetric filter of a mirrored image is a product in the discrete cosine transform.
    """
    transfer = _scatter_filter(luminance.shape, pixels_per_degree)
    spread = fft.idctn(fft.dctn(luminance) * transfer, overwrite_x=True)
    return np.asarray(np.clip(spread, *c.RETINAL_LUMINANCE))


@lru_cache(maxsize=4)
def _scatter_filter(shape: tuple[int, ...], pixels_per_degree: float) -> Array:
    vertical, horizontal = (np.arange(size) / (2 * size) * pixels_per_degree for size in shape)
    transfer = modulation_transfer(np.hypot(vertical[:, None], horizontal))
    transfer.setflags(write=False)
    return transfer


def gaussian(image: Array, sigma: float) -> Array:
    """Blur by a Gaussian of ``sigma`` pixels, with the original's borders."""
    return _gaussian_in_space(image, sigma) if sigma < _SPATIAL_BELOW else _gaussian_periodic(image, sigma)


def _gaussian_in_space(image: Array, sigma: float) -> Array:
    radius = int(np.floor(6 * sigma + 0.5)) // 2
    kernel = np.exp(-(np.arange(-radius, radius + 1) ** 2) / (2 * sigma**2))
    kernel /= kernel.sum()
    for axis in (0, 1):
        image = ndimage.correlate1d(image, kernel, axis, mode="nearest")
    return image


def _gaussian_periodic(image: Array, sigma: float) -> Array:
    """The image, extended to twice its size by its last row and column, repeats without end."""
    for axis in (0, 1):
        size = image.shape[axis]
        extended = np.concatenate([image, np.repeat(image.take([-1], axis), size, axis)], axis)
        transfer = np.exp(-0.5 * (2 * np.pi * fft.rfftfreq(2 * size) * sigma) ** 2)
        product = fft.rfft(extended, axis=axis) * np.expand_dims(transfer, 1 - axis)
        image = fft.irfft(product, 2 * size, axis, overwrite_x=True).take(range(size), axis)
    return image


def pupil_gain(luminance: float, area: float) -> float:
    """Light that the observer's pupil lets in, relative to that of the standard age.

    Parameters
    ----------
    luminance
        Geometric mean of the adapting luminance, cd/m2.
    area
        Of the image, square degrees.
    """
    flux = (luminance * area / 846) ** 0.41
    diameter = 7.75 - 5.75 * flux / (flux + 2)  # Stanley and Davies 1995, mm
    change = 0.02132 - 0.009562 * diameter  # per year of age
    observer, standard = (
        diameter + (age - c.PUPIL_REFERENCE_AGE) * change for age in (c.OBSERVER_AGE, c.STANDARD_AGE)
    )
    return float((observer / standard) ** 2)


def photoreceptors(log_retinal: Array, pupil: float) -> Array:
    """Sum of the responses of L and M cones and of rods to the (natural) log of retinal luminance."""
    shifts = np.log10([c.L_CONES * pupil, c.M_CONES * pupil, c.RODS * pupil])
    tables = response_tables()
    response: Array = _sum_responses(log_retinal, shifts, tables.cones, tables.rods, *LOG_LUMINANCE)
    return response


@loop(error_model="python")
def _sum_responses(log_retinal, shifts, cones, rods, low, high):  # type: ignore[no-untyped-def]
    response = np.empty_like(log_retinal)
    for i in range(log_retinal.shape[0]):
        for j in range(log_retinal.shape[1]):
            level = log_retinal[i, j] / np.log(10.0)
            response[i, j] = (
                _look_up(cones, level + shifts[0], low, high)
                + _look_up(cones, level + shifts[1], low, high)
                + _look_up(rods, level + shifts[2], low, high)
            )
    return response


@loop(error_model="python")
def _look_up(table, level, low, high):  # type: ignore[no-untyped-def]
    """Linear in a table of equal steps from low to high; levels beyond are taken to its ends."""
    place = (min(max(level, low), high) - low) * ((len(table) - 1) / (high - low))
    index = min(int(place), len(table) - 2)
    return table[index] + (table[index + 1] - table[index]) * (place - index)
