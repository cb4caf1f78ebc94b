# Constants of HDR-VDP 3.0.6: Copyright (c) 2010-2020, Rafal Mantiuk; Copyright (c) 2020 Displays and Graphics Ltd.
# BSD licence, in LICENSES/hdrvdp.txt.

"""The constants of HDR-VDP 3.0.6 for task "side-by-side" and an observer of 24 years, its defaults.

Sizes of the visual field are in degrees, frequencies in cycles per degree, luminance in cd/m2. The headings are the
stages of the paper (Mantiuk et al. 2011); the values are those of version 3.0.6.
"""

from __future__ import annotations

from typing import Final

# Intra-ocular light scatter: MTF(f) = sum of a exp(-b f).
_NARROW: Final = 0.99727370023777070
_WIDE: Final = 0.061466549455263
MTF_AMPLITUDE: Final = (
    _NARROW * 0.426,
    _NARROW * 0.574,
    (1 - _NARROW) * _WIDE,
    (1 - _NARROW) * (1 - _WIDE),
)
MTF_DECAY: Final = (0.028, 0.37, 37.0, 360.0)
RETINAL_LUMINANCE: Final = (1e-5, 1e10)
"""Luminance on the retina is kept within these, cd/m2."""

# Photoreceptor spectral sensitivity: what 1 cd/m2 of D65 does to each class. Integrals over wavelength of the
# spectrum, the lens at 24 years (Pokorny 1987, relative to the standard lens), and the sensitivity of the cones of
# Smith and Pokorny (1975) and of the rods of the CIE (1951), scaled so that L + M = 1. S cones do not add to luminance.
L_CONES: Final = 0.65293140835027819
M_CONES: Final = 0.34706859164972181
RODS: Final = 1.0171300679539299

# Luminance masking: sensitivity of cones and rods together, and of rods alone, to luminance.
JOINT_SENSITIVITY: Final = (315.98, 6.7977, 1.6008, 0.25534)
ROD_PEAK: Final = 1.1732
ROD_BELOW: Final = (1.32, 1.095)
ROD_ABOVE: Final = (0.5547, 2.9899)
ROD_LOG_GAIN: Final = 1.8
SENSITIVITY_CORRECTION: Final = 0.203943775672
"""Log10 of the gain fitted for the task."""

# Pupil, for a field and an age (Watson and Yellott 2012).
OBSERVER_AGE: Final = 24.0
STANDARD_AGE: Final = 28.0
"""Age to which the light through the pupil is related."""
PUPIL_REFERENCE_AGE: Final = 28.58

LOG_ADAPTATION_SIZE: Final = -0.781367
"""Log10 of the standard deviation, degrees, of the Gaussian over which the eye adapts."""

# Neural noise: parameters of the contrast sensitivity function at a few luminances.
CSF_LUMINANCE: Final = (0.0002, 0.002, 0.02, 0.2, 2.0, 20.0, 150.0)
CSF_PARAMETERS: Final = (
    (1.26181, 4.27832, 0.361902, 3.11914),
    (0.893585, 4.27832, 0.361902, 2.18938),
    (0.84864, 3.57253, 0.530355, 3.12486),
    (0.699243, 3.94545, 0.68608, 4.41846),
    (0.530826, 4.25337, 0.866916, 4.65117),
    (0.459297, 3.78765, 0.981028, 4.33546),
    (0.312626, 4.15264, 0.952367, 3.22389),
)

# Contrast masking: exponents of excitation and inhibition, weights of masking by the band itself and its neighbours.
MASK_P: Final = 10**0.3424
MASK_Q: Final = 10**0.108934275615
MASK_SELF: Final = 10**1.41846291721
MASK_NEIGHBOURS: Final = 10**0.136877512403

# Quality, refitted in version 3 to the UPIQ data set.
VISIBLE_RATIO: Final = 0.001
"""Pixels that differ by no more than this, relative to the reference, are not counted."""
POOLING_EXPONENT: Final = 0.8
QUALITY_BEST: Final = 10.0
QUALITY_FLOOR: Final = -4.0
JOD_SLOPE: Final = 0.52
JOD_EXPONENT: Final = 1.2812

# Multi-scale decomposition: steerable pyramid with one orientation (Karasaridis and Simoncelli 1996). Each filter
# from its centre down and right; the rest is its mirror image.
HIGH_RESIDUAL: Final = (
    (0.8554893, -0.09623594, -0.02420138, -0.00037321, -0.00024066),
    (-0.09623594, -0.06300923, -0.01437358, 0.00014597, -0.00033256),
    (-0.02420138, -0.01437358, -0.00161665, 0.00049271, -0.00033249),
    (-0.00037321, 0.00014597, 0.00049271, 0.00012631, -6.068e-5),
    (-0.00024066, -0.00033256, -0.00033249, -6.068e-5, 0.00059972),
)
LOW_RESIDUAL: Final = (
    (0.3153017, 0.1524935, -0.0075632, -0.00374386),
    (0.1524935, 0.06441488, -0.0134416, -0.00037258),
    (-0.0075632, -0.0134416, -0.00611952, -0.00011371),
    (-0.00374386, -0.00037258, -0.00011371, -0.0004514),
)
BAND: Final = (
    (0.9464195, -0.03158605, -0.03487008, -0.00909195, -0.01009473),
    (-0.03158605, -0.01730466, -0.02435662, -0.00762341, -0.00788939),
    (-0.03487008, -0.02435662, -0.0212954, -0.00727254, -0.0049425),
    (-0.00909195, -0.00762341, -0.00727254, -0.00462515, -0.00173864),
    (-0.01009473, -0.00788939, -0.0049425, -0.00173864, -9.066e-5),
)
LOW_PASS: Final = (
    (0.1576508, 0.1348999, 0.07624674, 0.024496, -0.0037816, -0.0069489, -0.00187192),
    (0.1348999, 0.1116388, 0.06306262, 0.01722078, -0.00523618, -0.00700674, -0.00103164),
    (0.07624674, 0.06306262, 0.03220744, 0.00393862, -0.0067208, -0.00459642, -0.00018628),
    (0.024496, 0.01722078, 0.00393862, -0.00526002, -0.006401, -0.00244906, 0.00087414),
    (-0.0037816, -0.00523618, -0.0067208, -0.006401, -0.00305976, -0.00019038, -5.686e-5),
    (-0.0069489, -0.00700674, -0.00459642, -0.00244906, -0.00019038, 0.00141762, -0.00080644),
    (-0.00187192, -0.00103164, -0.00018628, 0.00087414, -5.686e-5, -0.00080644, -0.0002257),
)
