"""What the compiled loops share: events as machine words, memory layout, and float32 elementary functions.

The functions here are for numba's loops. They are branchless, so that loops over pixels become vector code, and
they take and return float32: a literal number would turn float32 arithmetic into float64.
"""

from __future__ import annotations

import functools
import itertools
import math
from typing import Any, Final

import numba as nb
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.npydecl import parse_dtype, parse_shape
from numba.extending import intrinsic
from numba.np.arrayobj import _empty_nd_impl
from numpy.typing import NDArray

from kalux import memory
from kalux.events import EventArray
from kalux.formulas import LANES, Number, choose, formula
from kalux.kernel_cache import check_variables
from kalux.loop_files import kept
from kalux.memory import PAGE

check_variables()

MICROSECOND32: Final = np.float32(1e-6)
"""Seconds."""

ONE: Final = np.float32(1.0)
ZERO: Final = np.float32(0.0)

AHEAD: Final = 48
"""Events ahead whose pixels are prefetched: enough to cover the latency of memory, few enough to stay in the cache."""


FUSED: Final = {"contract"}
"""The only relaxation of arithmetic in loops (numba's ``fastmath``): a product and a sum may be fused into one
instruction, which rounds once instead of twice."""


_OPTIONS: Final = {"cache": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
"""numba's, of all loops, since it compiles its own helpers once for every set of options; without the wrapper for C
they compile a twentieth faster."""


def loop(function: Any = None, **options: Any) -> Any:
    """Decorates a loop. ``options`` are further ones of numba's."""
    if function is None:
        return functools.partial(loop, **options)
    return kept(nb.njit(**{**_OPTIONS, **options})(function))


inner: Any = functools.partial(loop, no_cpython_wrapper=True)
"""Decorates functions that only loops call: without the wrapper for Python they compile a tenth faster."""


WEIGHT_UNIT: Final = np.float32(1 / 4096)
"""Resolution of the weights that events carry (`event_weight`): sums of a few thousand are exact in float32."""


def event_words(events: EventArray) -> NDArray[np.int64]:
    """The same memory as (N, 2) int64: the time, and x, y and p in its lower 16, next 16 and next 8 bits."""
    return np.ascontiguousarray(events).view(np.int64).reshape(-1, 2)


@formula(types.uint64)
def event_column(word: Number) -> Number:
    """x of an event's second word; unsigned, as all indices, so that numba does not check for negative ones."""
    return word.to(types.uint64) & np.uint64(0xFFFF)


@formula(types.uint64)
def event_row(word: Number) -> Number:
    """y of an event's second word."""
    return (word.to(types.uint64) >> np.uint64(16)) & np.uint64(0xFFFF)


@formula(types.boolean)
def event_is_on(word: Number) -> Number:
    """p of an event's second word; the three bytes above it are padding and may hold anything."""
    return ((word.to(types.uint64) >> np.uint64(32)) & np.uint64(0xFF)) != np.uint64(0)


@nb.njit(cache=True, inline="always")
def flat(array):  # type: ignore[no-untyped-def]
    """A whole array as one row."""
    return array.reshape(array.size)


UNWEIGHED: Final = np.int64(0xFF_FFFF_FFFF)
"""The bits of an event's second word without its weight; by themselves they have the weight 1."""


@formula(types.int64)
def weighed(word: Number, extra: Number) -> Number:
    """An event's second word with a weight of 1 and ``extra`` units of `WEIGHT_UNIT`, 0 to 65535, in its padding."""
    return (word & UNWEIGHED) | (extra.to(types.int64) << np.int64(40))


@formula(types.float32)
def event_weight(word: Number, unit: Number) -> Number:
    """The weight of an event's second word: `WEIGHT_UNIT` where events carry one, 0, for 1, where they do not."""
    extra = (word.to(types.uint64) >> np.uint64(40)) & np.uint64(0xFFFF)
    return ONE + extra.to(types.int32).to(types.float32) * unit


def weight_unit(weighed: bool) -> np.float32:
    """The ``unit`` of `event_weight` for events that carry weights, or do not."""
    return WEIGHT_UNIT if weighed else np.float32(0.0)


_LINE: Final = 64
"""Bytes of a cache line."""

_APART: Final = 7 * _LINE
"""Bytes between planes, modulo a page: more than loops take of a plane at a time, 64 float32, and no two of nine planes
share cache lines' places."""

_begins: Final = itertools.count(0, 25)
"""Cache lines of a page at which successive calls of `apart` begin: far from each other. No result depends on it."""


def apart(count: int, shape: tuple[int, ...], dtype: Any = np.float32) -> NDArray[Any]:
    """``count`` uninitialised planes for loops over all of them at once, without cache conflicts: (count, *shape).

    Planes of many sensors are whole pages of memory, and addresses whole pages apart compete for the same few places of
    the first-level cache, as the same pixel of all planes would; stores would also wait for unrelated loads. A loop
    over twenty planes then takes 1.4 times as long. Here each plane begins `_APART` further on in a page, and those of
    another call elsewhere.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    step = size + (_APART - size) % PAGE
    piece = memory.empty((count * step + PAGE,), np.uint8)
    first = next(_begins) * _LINE % PAGE
    planes = piece[first : first + count * step].reshape(count, step)[:, :size]
    apart_: NDArray[Any] = planes.view(dtype).reshape(count, *shape)
    return apart_


def _new_array(*, zeros: bool) -> Any:
    def new_array(typing_context: Any, shape: Any, dtype: Any) -> Any:
        dimensions, element = parse_shape(shape), parse_dtype(dtype)  # type: ignore[no-untyped-call]
        kind = types.Array(element, dimensions, "C")

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            lengths = arguments[:1]
            if isinstance(shape, types.BaseTuple):
                lengths = cgutils.unpack_tuple(builder, arguments[0])  # type: ignore[no-untyped-call]
            array = _empty_nd_impl(context, builder, kind, lengths)  # type: ignore[no-untyped-call]
            if zeros:
                size = builder.mul(array.itemsize, array.nitems)
                cgutils.memset(builder, array.data, size, 0)  # type: ignore[no-untyped-call]
            return array._getvalue()

        return kind(shape, dtype), generate

    return intrinsic(new_array)


empty, zeros = _new_array(zeros=False), _new_array(zeros=True)
"""NumPy's, for loops, of a shape and a dtype. Compiled inline, where numba's own are two or three functions each."""


def _one_of_two(symbol: str) -> Any:
    def one_of_two(typing_context: Any, one: Any, other: Any) -> Any:
        kind = typing_context.unify_types(one, other)

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            first, second = (
                Number(builder, kind, context.cast(builder, value, given, kind))
                for value, given in zip(arguments, signature.args, strict=True)
            )
            return choose(second < first if symbol == "<" else second > first, second, first).value

        return kind(one, other), generate

    return intrinsic(one_of_two)


smaller, larger = _one_of_two("<"), _one_of_two(">")
"""`min` and `max` of two numbers, for loops. Compiled inline, where numba's own are functions."""


def _word_at(typing_context: Any, octets: Any, place: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        address = builder.gep(data, [arguments[1]])
        return builder.load(builder.bitcast(address, ir.IntType(64).as_pointer()), align=1)

    return types.uint64(octets, place), generate


word_at: Any = intrinsic(_word_at)
"""Eight bytes of an array, 1-D uint8, from an index on, as a uint64."""


def _prefetch(typing_context: Any, array: Any, index: Any) -> Any:
    signature = types.void(array, index)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        byte_pointer, i32 = ir.IntType(8).as_pointer(), ir.IntType(32)
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        address = builder.bitcast(builder.gep(data, [arguments[1]]), byte_pointer)
        function = cgutils.get_or_insert_function(  # type: ignore[no-untyped-call]
            builder.module,
            ir.FunctionType(ir.VoidType(), [byte_pointer, i32, i32, i32]),
            "llvm.prefetch.p0i8",
        )
        builder.call(function, [address, i32(1), i32(3), i32(1)])  # to write, into all caches, data
        return context.get_dummy_value()

    return signature, generate


prefetch: Any = intrinsic(_prefetch)
"""Prefetch ``array[index]``, 1-D, for writing."""


def _largest_around(typing_context: Any, plane: Any, at: Any, stride: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        i32, i64 = ir.IntType(32), ir.IntType(64)
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        at, stride = arguments[1:]

        def four(place: Any, offset: int) -> Any:
            start = builder.gep(data, [builder.add(place, i64(offset))])
            return builder.load(builder.bitcast(start, ir.VectorType(i32, 4).as_pointer()), align=4)

        def chosen(values: Any, lanes: list[int]) -> Any:
            return builder.shuffle_vector(values, values, ir.Constant(ir.VectorType(i32, 4), lanes))

        def larger(one: Any, other: Any) -> Any:
            return builder.select(builder.icmp_signed(">", one, other), one, other)

        # Four are loaded where three are meant: the fourth lies behind those of the upper row, before the others.
        lower = larger(four(at, -2), four(builder.add(at, stride), -2))
        largest = larger(chosen(lower, [1, 2, 3, 3]), four(builder.sub(at, stride), -1))
        largest = larger(larger(largest, chosen(largest, [1] * 4)), chosen(largest, [2] * 4))
        return builder.extract_element(largest, i32(0))

    return types.int32(plane, at, stride), generate


largest_around: Any = intrinsic(_largest_around)
"""The largest of nine numbers of a flat int32 plane, in rows of ``stride``: those around ``at`` and that there.

Both are uint64; all nine lie inside the plane. One by one they would be a fifth of the filter's instructions.
"""


class _Rows:
    """What `unpack` and `pack` share: the addresses of ``lanes`` float32 of records and of the rows of planes."""

    def __init__(self, context: Any, builder: Any, signature: Any, arguments: Any, lanes: int) -> None:
        self.builder, self.lanes = builder, lanes
        self.vector = ir.VectorType(ir.FloatType(), lanes)
        records, self._first, planes, self._column = (
            context.make_array(kind)(context, builder, argument)
            if isinstance(kind, types.Array)
            else argument
            for kind, argument in zip(signature.args, arguments, strict=True)
        )
        self._records, self._planes = records.data, planes.data
        self._width = cgutils.unpack_tuple(builder, planes.shape, 2)[1]  # type: ignore[no-untyped-call]

    def _at(self, data: Any, number: Any, offset: Any) -> Any:
        """Address of a vector, ``offset`` float32 behind an element of an array."""
        place = self.builder.bitcast(self.builder.gep(data, [number]), ir.FloatType().as_pointer())
        return self.builder.bitcast(self.builder.gep(place, [offset]), self.vector.as_pointer())

    def of_records(self, number: int) -> Any:
        return self._at(self._records, self._first, ir.IntType(64)(number * self.lanes))

    def of_plane(self, number: int) -> Any:
        builder, i64 = self.builder, ir.IntType(64)
        offset = builder.add(builder.mul(i64(number), self._width), self._column)
        return self._at(self._planes, i64(0), offset)

    def chosen(self, one: Any, other: Any, lanes: list[int]) -> Any:
        """A vector of some elements of two."""
        mask = ir.Constant(ir.VectorType(ir.IntType(32), self.lanes), lanes)
        return self.builder.shuffle_vector(one, other, mask)


def _unpack_of(lanes: int) -> Any:
    def unpack(typing_context: Any, records: Any, first: Any, planes: Any, column: Any) -> Any:
        fields = records.dtype.size // 4  # a power of two

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            rows = _Rows(context, builder, signature, arguments, lanes)

            def split(mixed: list[Any]) -> list[Any]:
                """One vector per field of vectors over which as many fields are spread in turns."""
                if len(mixed) == 1:
                    return mixed
                parts = []
                for odd in (0, 1):
                    pairs = zip(mixed[::2], mixed[1::2], strict=True)
                    parts.append(
                        split([rows.chosen(a, b, [2 * i + odd for i in range(lanes)]) for a, b in pairs])
                    )
                return [field for pair in zip(*parts, strict=True) for field in pair]

            for k, values in enumerate(
                split([builder.load(rows.of_records(k), align=4) for k in range(fields)])
            ):
                builder.store(values, rows.of_plane(k), align=4)
            return context.get_dummy_value()

        return types.void(records, first, planes, column), generate

    return intrinsic(unpack)


def _pack_of(lanes: int) -> Any:
    def pack(typing_context: Any, records: Any, first: Any, planes: Any, column: Any) -> Any:
        fields = records.dtype.size // 4  # a power of two

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            rows = _Rows(context, builder, signature, arguments, lanes)
            turns = [lane for i in range(lanes) for lane in (i, lanes + i)]

            def mix(parts: list[Any]) -> list[Any]:
                """Vectors over which the fields are spread in turns, of one vector per field."""
                if len(parts) == 1:
                    return parts
                pairs = zip(mix(parts[::2]), mix(parts[1::2]), strict=True)
                return [rows.chosen(a, b, half) for a, b in pairs for half in (turns[:lanes], turns[lanes:])]

            for k, values in enumerate(mix([builder.load(rows.of_plane(k), align=4) for k in range(fields)])):
                builder.store(values, rows.of_records(k), align=4)
            return context.get_dummy_value()

        return types.void(records, first, planes, column), generate

    return intrinsic(pack)


_unpack_many, _unpack_one = _unpack_of(LANES), _unpack_of(1)
_pack_many, _pack_one = _pack_of(LANES), _pack_of(1)


@nb.njit(cache=True, inline="always")
def unpack(records, first, count, planes):  # type: ignore[no-untyped-def]
    """Copy ``count`` records of float32 from ``first`` on, 1-D, into ``planes``, float32, a row for each field.

    The number of fields is a power of two. The compiler's own vector code would pick the fields one by one; here 16
    records are loaded as they lie and sorted within registers.
    """
    whole = count // LANES * LANES
    for column in range(0, whole, LANES):
        _unpack_many(records, first + column, planes, column)
    for column in range(whole, count):
        _unpack_one(records, first + column, planes, column)


@nb.njit(cache=True, inline="always")
def pack(planes, records, first, count):  # type: ignore[no-untyped-def]
    """The way back: fill ``count`` records from ``first`` on with the rows of ``planes``."""
    whole = count // LANES * LANES
    for column in range(0, whole, LANES):
        _pack_many(records, first + column, planes, column)
    for column in range(whole, count):
        _pack_one(records, first + column, planes, column)


_LOG2_E: Final = np.float32(1.4426950408889634)
_LN2_HIGH: Final = np.float32(0.693359375)  # few bits, so that its small multiples are exact
_LN2_LOW: Final = np.float32(-2.12194440e-4)
_ROUNDING: Final = np.float32(1.5 * 2**23)  # added and taken away again, it rounds to a whole number
_LEAST_EXPONENT, _LARGEST_EXPONENT = np.float32(-87.0), np.float32(88.0)
_HALF: Final = np.float32(0.5)
# Minimax polynomials of the Cephes library (S. Moshier, expf and logf).
_EXP: Final = tuple(
    np.float32(c)
    for c in (
        1.9875691500e-4,
        1.3981999507e-3,
        8.3334519073e-3,
        4.1665795894e-2,
        1.6666665459e-1,
        5.0000001201e-1,
    )
)
_LOG: Final = tuple(
    np.float32(c)
    for c in (
        7.0376836292e-2,
        -1.1514610310e-1,
        1.1676998740e-1,
        -1.2420140846e-1,
        1.4249322787e-1,
        -1.6668057665e-1,
        2.0000714765e-1,
        -2.4999993993e-1,
        3.3333331174e-1,
    )
)
_SQRT_HALF_BITS: Final = np.int32(0x3F3504F3)


@nb.njit(cache=True, inline="always")
def any_from(values, places, least):  # type: ignore[no-untyped-def]
    """Whether a value at one of the ``places`` is ``least`` or more; by counting, which is vector code."""
    count = np.int32(0)
    for i in places:
        count += np.int32(values[i] >= least)
    return count > 0


@formula(types.float32)
def exponential(x: Number) -> Number:
    """e^x in float32, to 2e-7 of itself; x is taken into [-87, 88]."""
    x = x.to(types.float32)
    x = choose(x < _LEAST_EXPONENT, x.like(_LEAST_EXPONENT), x)
    x = choose(x > _LARGEST_EXPONENT, x.like(_LARGEST_EXPONENT), x)
    shifted = x * _LOG2_E + _ROUNDING
    whole = shifted - _ROUNDING
    r = (x - whole * _LN2_HIGH) - whole * _LN2_LOW
    p = x.like(_EXP[0])
    for c in _EXP[1:]:
        p = p * r + c
    scale = ((whole.to(types.int32) + np.int32(127)) << np.int32(23)).bits_as(types.float32)
    return (p * r * r + r + ONE) * scale


@formula(types.float32)
def logarithm(x: Number) -> Number:
    """log(x) of a normal positive float32, to 2e-7 of itself or 1e-7, whichever is larger; finite whatever x is."""
    bits = x.to(types.float32).bits_as(types.int32) - _SQRT_HALF_BITS
    exponent = (bits >> np.int32(23)).to(types.float32)
    m = ((bits & np.int32(0x007FFFFF)) + _SQRT_HALF_BITS).bits_as(types.float32) - ONE
    p = m.like(_LOG[0])
    for c in _LOG[1:]:
        p = p * m + c
    square = m * m
    tail = exponent * _LN2_LOW + p * m * square
    return (tail - _HALF * square) + m + exponent * _LN2_HIGH


INFINITE_BITS: Final = 0x7F800000
"""Of an infinite float32 without its sign. Those of finite numbers are less, those of NaN more."""


def magnitude_bits(values: NDArray[np.float32]) -> int:
    """The largest bit pattern, without signs, of some float32, to find infinite ones and NaN in one pass; 0 of none."""
    if values.size and not any(values.strides):  # one number, repeated
        return int(values[(0,) * values.ndim].view(np.int32)) & 0x7FFFFFFF
    return int(_magnitude_bits(np.ascontiguousarray(values).view(np.int32).reshape(-1)))


@loop
def _magnitude_bits(bits):  # type: ignore[no-untyped-def]
    largest = np.int32(0)
    for i in range(len(bits)):
        magnitude = np.int32(bits[i] & np.int32(0x7FFFFFFF))
        largest = magnitude if magnitude > largest else largest
    return largest
