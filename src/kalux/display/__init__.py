"""Tone mapping: from linear intensity or colour, far above 1 in highlights, to a picture in 0 to 1.

For looking only. Nothing here feeds a metric, a float output (EXR, npy) or the reconstruction.

A mapping is done in two steps. `measure` takes the statistics of one image that the curve needs (limits, the
log average, local histograms) as a small array of numbers; `apply` maps an image with given statistics.
`tone_map` does both for one image. For a video, where fresh statistics in every image would flicker,
`tone_map_next` carries them on in a `ToneState`, smoothed over time.

Of an image in colour the luminance is mapped, exactly as if it were a grey image; the picture has its chromaticity
on an sRGB display, and goes towards white where the display has no such colour as bright.
"""

from kalux.display.integers import fill, to_uint8, to_uint16
from kalux.display.intensities import Float32, Statistics
from kalux.display.mapping import apply, fill_levels, measure, quantised, tone_map
from kalux.display.percentiles import SAMPLES
from kalux.display.settings import (
    CURVES,
    Auto,
    Clahe,
    Curve,
    DisplaySettings,
    Drago,
    Encoding,
    Linear,
    Percentile,
    Reinhard,
    curve_from_name,
    settings_table,
)
from kalux.display.srgb import decode_srgb, encode_srgb
from kalux.display.video import TimedImage, ToneState, colour_of, next_state, shown_of, tone_map_next

__all__ = [
    "CURVES",
    "SAMPLES",
    "Auto",
    "Clahe",
    "Curve",
    "DisplaySettings",
    "Drago",
    "Encoding",
    "Float32",
    "Linear",
    "Percentile",
    "Reinhard",
    "Statistics",
    "TimedImage",
    "ToneState",
    "apply",
    "colour_of",
    "curve_from_name",
    "decode_srgb",
    "encode_srgb",
    "fill",
    "fill_levels",
    "measure",
    "next_state",
    "quantised",
    "settings_table",
    "shown_of",
    "to_uint8",
    "to_uint16",
    "tone_map",
    "tone_map_next",
]
