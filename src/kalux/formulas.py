"""Formulas that loops use in many places, put there as machine code without numba's passes over each of their steps.

Of a function that numba puts in its place it copies every step and infers its types again wherever it is used, and a
logarithm has 87 steps. A `formula` is one step: a Python function, run on numbers that are still to come, of which each
operation writes down an instruction. It has no branches but `choose`, and the numbers of an operation are of one type.
So it is for one pixel of a loop: with rows for arguments it looks up and fills what it needs.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import from_dtype
from numba.core import types
from numba.extending import intrinsic


def _operation(of_floats: str, of_integers: str, *, swapped: bool = False) -> Callable[[Number, Any], Number]:
    def operate(self: Number, other: Any) -> Number:
        other = self.like(other)
        one, two = (other, self) if swapped else (self, other)
        name = of_floats if isinstance(self.kind, types.Float) else of_integers
        return Number(self.builder, self.kind, getattr(self.builder, name)(one.value, two.value))

    return operate


def _comparison(symbol: str) -> Callable[[Number, Any], Number]:
    def compare(self: Number, other: Any) -> Number:
        if isinstance(self.kind, types.Float):
            by = self.builder.fcmp_unordered if symbol == "!=" else self.builder.fcmp_ordered
        else:
            by = self.builder.icmp_signed if self.kind.signed else self.builder.icmp_unsigned
        return Number(self.builder, types.boolean, by(symbol, self.value, self.like(other).value))

    return compare


class Number:
    """A number of a loop: its type (numba's), and what holds it there.

    Raises
    ------
    TypeError
        The numbers of an operation are of different types.
    """

    __slots__ = ("builder", "kind", "value")
    __array_ufunc__ = None  # a NumPy number before the operator leaves it to this class

    def __init__(self, builder: Any, kind: Any, value: Any) -> None:
        self.builder, self.kind, self.value = builder, kind, value

    def like(self, other: Any) -> Number:
        """Another number of this type, which may be one of NumPy's."""
        if not isinstance(other, Number):
            kind = from_dtype(np.asarray(other).dtype)
            other = Number(self.builder, kind, ir.Constant(_machine_type(kind), np.asarray(other).item()))
        number: Number = other
        if number.kind != self.kind:
            raise TypeError(f"{self.kind} and {number.kind} in one operation of a formula")
        return number

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
        source, machine = self.kind, _machine_type(kind)
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
        return Number(self.builder, kind, self.builder.bitcast(self.value, _machine_type(kind)))


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


def choose(condition: Number, one: Number, other: Number) -> Number:
    """``one`` where the condition holds, else the ``other``."""
    value = condition.builder.select(condition.value, one.value, one.like(other).value)
    return Number(one.builder, one.kind, value)


def _machine_type(kind: Any) -> Any:
    if isinstance(kind, types.Float):
        return {32: ir.FloatType(), 64: ir.DoubleType()}[kind.bitwidth]
    return ir.IntType(1 if kind == types.boolean else kind.bitwidth)


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
