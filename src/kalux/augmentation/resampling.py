"""Frames read between their pixels, for loops: cubic log intensity, and linear variance (docs/equations.md, K16)."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from kalux.augmentation.bridge import UNMEASURED, Latent

BORDER: Final = 3
"""Pixels of a `readable` frame around it: places up to two pixels outside are read as all others are."""

_SHARPNESS: Final = -0.75
"""a of Keys' cubic (IEEE Trans. ASSP 29, 1981): its slope at a distance of one pixel. As OpenCV has it; -1/2, the other
usual one, keeps less of the texture."""

_TAPS: Final = 4
"""Pixels of a row, and rows, that are read for one place: those at -1, 0, 1, 2 from the one before it."""


def readable(frame: Latent) -> NDArray[np.float32]:
    """A frame as `read_between` takes it: (H + 6, W + 6, 2) float32, log intensity and variance of every pixel.

    Outside a frame its outermost pixels go on, without being measured.
    """
    height, width = frame.value.shape
    made = np.empty((height + 2 * BORDER, width + 2 * BORDER, 2), np.float32)
    inside = made[BORDER:-BORDER, BORDER:-BORDER]
    made[..., 1] = UNMEASURED
    inside[..., 0], inside[..., 1] = frame.value, frame.variance
    levels = made[..., 0]
    levels[:BORDER], levels[-BORDER:] = levels[BORDER], levels[-BORDER - 1]
    levels[:, :BORDER], levels[:, -BORDER:] = levels[:, BORDER, None], levels[:, -BORDER - 1, None]
    return made


def _weights() -> list[list[float]]:
    """Of the third to no power of a fraction, for every tap: Keys' cubic for one quantity, linear for the other."""
    a = _SHARPNESS
    cubic = [[a, a + 2, -a - 2, -a], [-2 * a, -a - 3, 2 * a + 3, a], [a, 0.0, -a, 0.0], [0.0, 1.0, 0.0, 0.0]]
    linear = [[0.0] * _TAPS, [0.0] * _TAPS, [0.0, -1.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0]]
    return [np.stack(power, axis=1).reshape(-1).tolist() for power in zip(cubic, linear, strict=True)]


_WEIGHTS: Final = _weights()


def _read_row(
    typing_context: Any,
    count: Any,
    frame: Any,
    stride: Any,
    pixels: Any,
    fractions: Any,
    at: Any,
    apart: Any,
    out: Any,
) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        lanes, i32, i64 = 2 * _TAPS, ir.IntType(32), ir.IntType(64)
        vector = ir.VectorType(ir.FloatType(), lanes)
        count, frame, stride, pixels, fractions, at, apart, out = (
            context.make_array(kind)(context, builder, argument).data
            if isinstance(kind, types.Array)
            else argument
            for kind, argument in zip(signature.args, arguments, strict=True)
        )

        def chosen(values: Any, places: list[int]) -> Any:
            return builder.shuffle_vector(
                values, values, ir.Constant(ir.VectorType(i32, len(places)), places)
            )

        def weights(fraction: Any) -> Any:
            alone = builder.insert_element(ir.Constant(vector, ir.Undefined), fraction, i32(0))
            everywhere, weight = chosen(alone, [0] * lanes), ir.Constant(vector, _WEIGHTS[0])
            for factors in _WEIGHTS[1:]:
                weight = builder.fadd(builder.fmul(weight, everywhere), ir.Constant(vector, factors))
            return weight

        def first_tap(x: Any, y: Any) -> Any:
            corner = i64(BORDER - 1)
            column, row = (builder.add(builder.sext(pixel, i64), corner) for pixel in (x, y))
            return builder.add(builder.mul(row, stride), builder.mul(column, i64(2)))

        with cgutils.for_range(builder, count) as pixel:
            of_x = builder.add(at, pixel.index)
            of_y = builder.add(of_x, apart)
            place = first_tap(*(builder.load(builder.gep(pixels, [of])) for of in (of_x, of_y)))
            across, down = (weights(builder.load(builder.gep(fractions, [of]))) for of in (of_x, of_y))
            total = None
            for row in range(_TAPS):
                address = builder.bitcast(builder.gep(frame, [place]), vector.as_pointer())
                of_row = builder.fmul(
                    chosen(down, [2 * row, 2 * row + 1] * _TAPS), builder.load(address, align=4)
                )
                total = of_row if total is None else builder.fadd(total, of_row)
                place = builder.add(place, stride)
            found = builder.fmul(total, across)
            for half in (_TAPS, _TAPS // 2):
                found = builder.fadd(
                    *(chosen(found, list(range(start, start + half))) for start in (0, half))
                )
            for quantity, of in enumerate((of_x, of_y)):
                builder.store(builder.extract_element(found, i32(quantity)), builder.gep(out, [of]))
        return context.get_dummy_value()

    return types.void(count, frame, stride, pixels, fractions, at, apart, out), generate


read_row: Any = intrinsic(_read_row)
"""Read ``count`` places in a `readable` frame, flat and with rows of ``stride`` float32.

From ``at`` on, ``pixels`` holds the column of the last pixel left of each place, -2 to W, int32, and ``apart`` further
on the row of the last one above it, -2 to H; ``fractions`` how far the place is beyond that pixel, 0 to 1. At the same
two places ``out`` gets the log intensity and the variance. Other whole numbers are uint64, the rest float32.

Four pixels of a row, with both quantities, are one vector.
"""
