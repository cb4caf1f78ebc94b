"""Formulas that loops use in many places, put there as machine code without numba's passes over each of their steps.

Of a function that numba puts in its place it copies every step and infers its types again wherever it is used, and a
logarithm has 87 steps. A `formula` is one step: a Python function, run on numbers that are still to come, of which each
operation writes down an instruction. It has no branches but `choose`, and the numbers of an operation are of one type.
So it is for one pixel of a loop: with rows for arguments it looks up and fills what it needs.

A `row_formula` is for a whole row, and one step as well: 16 pixels at a time are written down as vectors, and those
that are left one by one. Of plain loops the compiler makes the same, but it takes ten times as long to see that it may.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from llvmlite import ir
from numba import from_dtype
from numba.core import types
from numba.extending import intrinsic

LANES: Final = 16
"""Pixels that a `row_formula` takes at a time: what the widest vector instructions hold of float32."""


def _operation(of_floats: str, of_integers: str, *, swapped: bool = False) -> Callable[[Number, Any], Number]:
    def operate(self: Number, other: Any) -> Number:
        if isinstance(other, Number):
            self = self.spread(other.lanes)
        other = self.like(other)
        one, two = (other, self) if swapped else (self, other)
        name = of_floats if isinstance(self.kind, types.Float) else of_integers
        return Number(self.builder, self.kind, getattr(self.builder, name)(one.value, two.value))

    return operate


def _comparison(symbol: str) -> Callable[[Number, Any], Number]:
    def compare(self: Number, other: Any) -> Number:
        if isinstance(other, Number):
            self = self.spread(other.lanes)
        if isinstance(self.kind, types.Float):
            by = self.builder.fcmp_unordered if symbol == "!=" else self.builder.fcmp_ordered
        else:
            by = self.builder.icmp_signed if self.kind.signed else self.builder.icmp_unsigned
        return Number(self.builder, types.boolean, by(symbol, self.value, self.like(other).value))

    return compare


class Number:
    """A number of a loop, or one for each of some pixels: its type (numba's), and what holds it there.

    Raises
    ------
    TypeError
        The numbers of an operation are of different types.
    """

    __slots__ = ("builder", "kind", "value")
    __array_ufunc__ = None  # a NumPy number before the operator leaves it to this class

    def __init__(self, builder: Any, kind: Any, value: Any) -> None:
        self.builder, self.kind, self.value = builder, kind, value

    @property
    def lanes(self) -> int:
        """Of how many pixels."""
        return self.value.type.count if isinstance(self.value.type, ir.VectorType) else 1

    def spread(self, lanes: int) -> Number:
        """The same number for each of as many pixels, where it is not yet."""
        if self.lanes == lanes or lanes == 1:
            return self
        vector = _machine_type(self.kind, lanes)
        first = self.builder.insert_element(ir.Constant(vector, ir.Undefined), self.value, ir.IntType(32)(0))
        everywhere = ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes)
        return Number(self.builder, self.kind, self.builder.shuffle_vector(first, first, everywhere))

    def like(self, other: Any) -> Number:
        """Another number of this type, which may be one of NumPy's, for as many pixels."""
        if not isinstance(other, Number):
            kind = from_dtype(np.asarray(other).dtype)
            other = Number(self.builder, kind, ir.Constant(_machine_type(kind), np.asarray(other).item()))
        number: Number = other
        if number.kind != self.kind:
            raise TypeError(f"{self.kind} and {number.kind} in one operation of a formula")
        return number.spread(self.lanes)

    __add__, __radd__ = _operation("fadd", "add"), _operation("fadd", "add", swapped=True)
    __sub__, __rsub__ = _operation("fsub", "sub"), _operation("fsub", "sub", swapped=True)
    __mul__, __rmul__ = _operation("fmul", "mul"), _operation("fmul", "mul", swapped=True)
    __truediv__, __rtruediv__ = _operation("fdiv", "sdiv"), _operation("fdiv", "sdiv", swapped=True)
    __and__, __or__, __lshift__ = _operation("", "and_"), _operation("", "or_"), _operation("", "shl")
    __lt__, __gt__ = _comparison("<"), _comparison(">")
    __ge__, __ne__ = _comparison(">="), _comparison("!=")  # type: ignore[assignment]

    def __rshift__(self, other: Any) -> Number:
        shift = self.builder.ashr if self.kind.signed else self.builder.lshr
        return Number(self.builder, self.kind, shift(self.value, self.like(other).value))

    def to(self, kind: Any) -> Number:
        """Converted as numba does."""
        source, machine = self.kind, _machine_type(kind, self.lanes)
        if source == kind:
            return self
        if isinstance(kind, types.Float):
            convert = self.builder.sitofp if source.signed else self.builder.uitofp
        elif isinstance(source, types.Float):
            convert = self.builder.fptosi
        elif source.bitwidth >= kind.bitwidth:
            convert = self.builder.trunc if source.bitwidth > kind.bitwidth else self.builder.bitcast
        else:
            convert = self.builder.sext if source.signed else self.builder.zext
        return Number(self.builder, kind, convert(self.value, machine))

    def bits_as(self, kind: Any) -> Number:
        """The number of another type that has the same bits."""
        return Number(self.builder, kind, self.builder.bitcast(self.value, _machine_type(kind, self.lanes)))


class Row:
    """A flat array of a loop, without gaps, of numbers; places in it are uint64."""

    __slots__ = ("_builder", "_data", "_kind")

    def __init__(self, builder: Any, kind: Any, data: Any) -> None:
        self._builder, self._kind, self._data = builder, kind, data

    def __getitem__(self, place: Number) -> Number:
        return Number(self._builder, self._kind, self._builder.load(self._at(place)))

    def __setitem__(self, place: Number, number: Number) -> None:
        self._builder.store(number.to(self._kind).value, self._at(place))

    def _at(self, place: Number) -> Any:
        return self._builder.gep(self._data, [place.to(types.uint64).value])


class Pixels:
    """A row of a `row_formula`: the numbers of some pixels beside each other, ``[0]``, or of those ``n`` further on."""

    __slots__ = ("_builder", "_first", "_kind", "_lanes")

    def __init__(self, builder: Any, kind: Any, first: Any, lanes: int) -> None:
        self._builder, self._kind, self._first, self._lanes = builder, kind, first, lanes

    def __getitem__(self, further: int) -> Number:
        value = self._builder.load(self._at(further), align=self._kind.bitwidth // 8)
        return Number(self._builder, self._kind, value)

    def __setitem__(self, further: int, number: Number) -> None:
        value = number.to(self._kind).spread(self._lanes).value
        self._builder.store(value, self._at(further), align=self._kind.bitwidth // 8)

    def _at(self, further: int) -> Any:
        address = self._builder.gep(self._first, [ir.IntType(64)(further)])
        return self._builder.bitcast(address, _machine_type(self._kind, self._lanes).as_pointer())


def choose(condition: Number, one: Number, other: Number) -> Number:
    """``one`` where the condition holds, else the ``other``."""
    one = one.spread(condition.lanes)
    value = condition.builder.select(condition.value, one.value, one.like(other).value)
    return Number(one.builder, one.kind, value)


def smaller_of(one: Number, other: Number | np.float32) -> Number:
    """The smaller of two, in a formula; the ``other`` may be a constant."""
    return choose(one < other, one, one.like(other))


def larger_of(one: Number, other: Number | np.float32) -> Number:
    """The larger of two, likewise."""
    return choose(one > other, one, one.like(other))


def squared(value: Number) -> Number:
    """The value times itself, computed once where it is an expression."""
    return value * value


def _machine_type(kind: Any, lanes: int = 1) -> Any:
    if isinstance(kind, types.Float):
        machine: Any = {32: ir.FloatType(), 64: ir.DoubleType()}[kind.bitwidth]
    else:
        machine = ir.IntType(1 if kind == types.boolean else kind.bitwidth)
    return machine if lanes == 1 else ir.VectorType(machine, lanes)


def formula(result: Any = None) -> Callable[[Callable[..., Any]], Any]:
    """Decorates a formula for use in loops; ``of`` is the formula itself, for use in others.

    Parameters
    ----------
    result
        numba's type of what the formula returns; None: nothing, it fills rows.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        def define(typing_context: Any, *kinds: Any) -> Any:
            def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
                def given(kind: Any, argument: Any) -> Number | Row:
                    if isinstance(kind, types.Array):
                        if (kind.ndim, kind.layout) != (1, "C"):
                            raise TypeError(f"{kind} in a formula, where rows are flat and without gaps")
                        data = context.make_array(kind)(context, builder, argument).data
                        return Row(builder, kind.dtype, data)
                    return Number(builder, kind, argument)

                returned = function(*map(given, signature.args, arguments))
                return context.get_dummy_value() if result is None else returned.to(result).value

            return (types.void if result is None else result)(*kinds), generate

        # numba would take what has no names for a tuple.
        parameters = inspect.signature(function).parameters.values()
        first = inspect.Parameter("typing_context", inspect.Parameter.POSITIONAL_OR_KEYWORD)
        define.__signature__ = inspect.Signature([first, *parameters])  # type: ignore[attr-defined]
        define.__name__, define.__doc__ = function.__name__, function.__doc__
        made: Any = intrinsic(define)
        made.of = function
        return made

    return decorate


def row_formula(function: Callable[..., None]) -> Any:
    """Decorates a formula that fills rows of pixels, for use in loops.

    The formula takes `Pixels` for rows, which must be annotated as that, and numbers for what is the same all along.
    A loop calls it with the number of pixels before all else, and for every row with a flat array without gaps and the
    place of the row in it, both whole numbers as uint64. A row that is filled lies apart from those that are looked up,
    or is itself looked up only at the pixels that are filled.
    """
    parameters = list(inspect.signature(function).parameters.values())
    rows = [parameter.annotation in (Pixels, "Pixels") for parameter in parameters]

    def define(typing_context: Any, *kinds: Any) -> Any:
        given = iter(kinds[1:])
        for is_row in rows:
            kind = next(given)
            if is_row and ((kind.ndim, kind.layout) != (1, "C") or next(given) != types.uint64):
                raise TypeError(
                    f"{kind} in a formula, where rows are flat and without gaps, and places uint64"
                )

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            count, i64 = arguments[0], ir.IntType(64)
            whole = builder.and_(count, i64(-LANES))

            def write(place: Any, lanes: int) -> None:
                given = zip(signature.args[1:], arguments[1:], strict=True)

                def taken(is_row: bool) -> Number | Pixels:
                    kind, argument = next(given)
                    if not is_row:
                        return Number(builder, kind, argument)
                    data = context.make_array(kind)(context, builder, argument).data
                    first = builder.gep(data, [builder.add(next(given)[1], place)])
                    return Pixels(builder, kind.dtype, first, lanes)

                function(*map(taken, rows))

            _repeat(builder, i64(0), whole, LANES, lambda place: write(place, LANES))
            # By a number that cannot be large: the compiler would make vectors of these, too.
            left = builder.and_(count, i64(LANES - 1))
            _repeat(builder, i64(0), left, 1, lambda place: write(builder.add(whole, place), 1))
            return context.get_dummy_value()

        return types.void(*kinds), generate

    names = ["typing_context", "count"]
    for parameter, is_row in zip(parameters, rows, strict=True):
        names += [parameter.name, f"{parameter.name}_at"] if is_row else [parameter.name]
    kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
    define.__signature__ = inspect.Signature([inspect.Parameter(name, kind) for name in names])  # type: ignore[attr-defined]
    define.__name__, define.__doc__ = function.__name__, function.__doc__
    return intrinsic(define)


def _repeat(builder: Any, start: Any, stop: Any, step: int, write: Callable[[Any], None]) -> None:
    """A loop that the compiler leaves as it is: to see how it may be unrolled takes it as long as all else."""
    i64, before = ir.IntType(64), builder.block
    body, after = (builder.append_basic_block(name) for name in ("pixels", "beyond"))
    builder.cbranch(builder.icmp_unsigned("<", start, stop), body, after)
    builder.position_at_end(body)
    place = builder.phi(i64)
    place.add_incoming(start, before)
    write(place)
    following = builder.add(place, i64(step))
    place.add_incoming(following, builder.block)
    again = builder.cbranch(builder.icmp_unsigned("<", following, stop), body, after)
    module = builder.module
    option = module.add_metadata(["llvm.loop.unroll.disable"])
    known = module.add_metadata([str(len(module.metadata)), option])
    known.operands = (known, option)  # a loop is known by itself
    again.set_metadata("llvm.loop", known)
    builder.position_at_end(after)
