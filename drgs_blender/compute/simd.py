"""SIMD: sixteen single-precision numbers at once, for loops that LLVM does not vectorise by itself.

``float32x16`` is a type of compiled code only: `load`, `repeat`, `quads` and `spread` make such values, arithmetic,
``math.sqrt`` and ``abs`` act on each of the sixteen, ``<`` and ``>`` compare them for `select` and `some`, and `store`,
`fold` and `lanes` end them. LLVM makes of it what the processor has (one
register of AVX-512, two of AVX, four of SSE or NEON) with the same results: nothing is reordered, no operations are
fused.
"""

from __future__ import annotations

import math
import operator
from typing import Any

import numpy as np
from llvmlite import ir

from .jit import overload  # first: it sets Numba up

from numba.core import cgutils, types  # isort: skip
from numba.extending import intrinsic, models, register_model  # isort: skip

LANES = 16
_VECTOR = ir.VectorType(ir.FloatType(), LANES)


def aligned(count: int, kind: type) -> np.ndarray:
    """1-D array of 4-byte items on a cache line's boundary, zeros, with room behind it for wide loads."""
    raw = np.zeros(count * 4 + 128, np.uint8)
    start = -raw.ctypes.data % 64
    return raw[start : start + count * 4 + 16].view(kind)[:count]


class Float32x16(types.Type):
    """The type, as Numba sees it."""

    def __init__(self) -> None:
        super().__init__(name="float32x16")


float32x16 = Float32x16()


@register_model(Float32x16)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, fe_type: Any) -> None:
        super().__init__(manager, fe_type, _VECTOR)


def _mask(lanes: list[int]) -> ir.Constant:
    return ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), lanes)


def _four(builder: Any, values: Any, lanes: list[int]) -> Any:
    """A vector whose lane i is value lanes[i] of four."""
    vector = ir.Constant(ir.VectorType(ir.FloatType(), 4), ir.Undefined)
    for i, value in enumerate(values):
        vector = builder.insert_element(vector, value, ir.Constant(ir.IntType(32), i))
    return builder.shuffle_vector(vector, ir.Constant(vector.type, ir.Undefined), _mask(lanes))


@intrinsic
def repeat(typingctx, a, b, c, d):  # type: ignore[no-untyped-def]
    """a, b, c, d four times over.

    Parameters
    ----------
    a, b, c, d : float32

    Returns
    -------
    Float32x16
        (a, b, c, d, a, b, ...).
    """
    single = types.float32
    return float32x16(single, single, single, single), lambda context, builder, signature, values: _four(
        builder, values, [i % 4 for i in range(LANES)]
    )


@intrinsic
def quads(typingctx, a, b, c, d):  # type: ignore[no-untyped-def]
    """Four times a, four times b, four times c, four times d.

    Parameters
    ----------
    a, b, c, d : float32

    Returns
    -------
    Float32x16
        (a, a, a, a, b, b, ...).
    """
    single = types.float32
    return float32x16(single, single, single, single), lambda context, builder, signature, values: _four(
        builder, values, [i // 4 for i in range(LANES)]
    )


@intrinsic
def spread(typingctx, a):  # type: ignore[no-untyped-def]
    """Sixteen times a.

    Parameters
    ----------
    a : float32

    Returns
    -------
    Float32x16
    """
    return float32x16(types.float32), lambda context, builder, signature, values: _four(
        builder, [values[0]] * 4, [0] * LANES
    )


def _place(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    array = context.make_array(signature.args[0])(context, builder, values[0])
    return builder.bitcast(builder.gep(array.data, [values[1]]), _VECTOR.as_pointer())


def _check(array: Any) -> None:
    if not (isinstance(array, types.Array) and array.dtype == types.float32 and array.layout == "C"):
        raise TypeError("float32x16 is loaded from and stored to contiguous arrays of float32")


@intrinsic
def load(typingctx, array, at):  # type: ignore[no-untyped-def]
    """The sixteen elements from `at` on; nothing checks that the array has them.

    Parameters
    ----------
    array : float32 array
        Contiguous.
    at : int64
        Index in its memory.

    Returns
    -------
    Float32x16
    """
    _check(array)

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.load(_place(context, builder, signature, values), align=4)

    return float32x16(array, types.intp), code


@intrinsic
def spread_at(typingctx, array, at):  # type: ignore[no-untyped-def]
    """Sixteen times the element at `at`; nothing checks that the array has it.

    Parameters
    ----------
    array : float32 array
        Contiguous.
    at : int64
        Index in its memory.

    Returns
    -------
    Float32x16
    """
    _check(array)

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        one = builder.load(builder.bitcast(_place(context, builder, signature, values), ir.FloatType().as_pointer()))
        return _four(builder, [one] * 4, [0] * LANES)

    return float32x16(array, types.intp), code


@intrinsic
def store(typingctx, array, at, value):  # type: ignore[no-untyped-def]
    """Put sixteen elements at `at`; nothing checks that the array has them.

    Parameters
    ----------
    array : float32 array
        Contiguous.
    at : int64
        Index in its memory.
    value : Float32x16
    """
    _check(array)

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        builder.store(values[2], _place(context, builder, signature, values), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, float32x16), code


@intrinsic
def fold(typingctx, vector):  # type: ignore[no-untyped-def]
    """Sums of every fourth element, from the first, second, third and fourth on.

    Parameters
    ----------
    vector : Float32x16

    Returns
    -------
    a, b, c, d : float32
    """

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        total = values[0]
        for half in (8, 4):
            low = builder.shuffle_vector(total, total, _mask(list(range(half))))
            high = builder.shuffle_vector(total, total, _mask(list(range(half, 2 * half))))
            total = builder.fadd(low, high)
        parts = [builder.extract_element(total, ir.Constant(ir.IntType(32), i)) for i in range(4)]
        return cgutils.pack_array(builder, parts)

    return types.UniTuple(types.float32, 4)(float32x16), code


@intrinsic
def lanes(typingctx, vector):  # type: ignore[no-untyped-def]
    """The sixteen elements as a tuple.

    Parameters
    ----------
    vector : Float32x16

    Returns
    -------
    tuple of float32
    """

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        at = (ir.Constant(ir.IntType(32), i) for i in range(LANES))
        return cgutils.pack_array(builder, [builder.extract_element(values[0], i) for i in at])

    return types.UniTuple(types.float32, LANES)(float32x16), code


class Mask16(types.Type):
    """Sixteen answers, of a comparison."""

    def __init__(self) -> None:
        super().__init__(name="mask16")


mask16 = Mask16()
_ANSWERS = ir.VectorType(ir.IntType(1), LANES)


@register_model(Mask16)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, fe_type: Any) -> None:
        super().__init__(manager, fe_type, _ANSWERS)


def select(condition, a, b):  # type: ignore[no-untyped-def]
    """`a` where a condition holds, else `b`: of numbers, or lane by lane.

    Parameters
    ----------
    condition : bool or Mask16
    a, b : float or Float32x16

    Returns
    -------
    float or Float32x16
    """
    return a if condition else b


@intrinsic
def _chosen(typingctx, condition, a, b):  # type: ignore[no-untyped-def]
    return float32x16(mask16, float32x16, float32x16), lambda context, builder, signature, values: builder.select(
        *values
    )


@overload(select)
def _select(condition, a, b):  # type: ignore[no-untyped-def]
    if condition is not mask16:
        return select
    if a is float32x16:
        if b is float32x16:
            return lambda condition, a, b: _chosen(condition, a, b)
        return lambda condition, a, b: _chosen(condition, a, spread(b))
    if b is float32x16:
        return lambda condition, a, b: _chosen(condition, spread(a), b)
    return lambda condition, a, b: _chosen(condition, spread(a), spread(b))


@intrinsic
def some(typingctx, condition):  # type: ignore[no-untyped-def]
    """Whether a condition holds in any lane.

    Parameters
    ----------
    condition : Mask16

    Returns
    -------
    bool
    """

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        bits = builder.bitcast(values[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

    return types.boolean(mask16), code


@intrinsic
def fold_four(typingctx, a, b, c, d):  # type: ignore[no-untyped-def]
    """`fold` of four vectors, one after the other in one.

    Parameters
    ----------
    a, b, c, d : Float32x16

    Returns
    -------
    Float32x16
    """

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        low = [i for k in (0, LANES) for i in range(k, k + 8)]
        even = [i for k in (0, 8, LANES, LANES + 8) for i in range(k, k + 4)]

        def sums(one: Any, other: Any, lanes: list[int], step: int) -> Any:
            halves = (builder.shuffle_vector(one, other, _mask([i + k for i in lanes])) for k in (0, step))
            return builder.fadd(*halves)

        return sums(sums(values[0], values[1], low, 8), sums(values[2], values[3], low, 8), even, 4)

    return float32x16(float32x16, float32x16, float32x16, float32x16), code


def shuffled(*order: int) -> Any:
    """A function of compiled code that puts elements of a vector in another order, and 0 where that is -1."""

    @intrinsic
    def shuffle(typingctx, vector):  # type: ignore[no-untyped-def]
        def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            return builder.shuffle_vector(
                values[0], ir.Constant(_VECTOR, [0.0] * LANES), _mask([i % 32 for i in order])
            )

        return float32x16(float32x16), code

    return shuffle


@intrinsic
def keep_fourths(typingctx, vector, old):  # type: ignore[no-untyped-def]
    """A vector with every fourth element of another one.

    Parameters
    ----------
    vector, old : Float32x16

    Returns
    -------
    Float32x16
    """

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.shuffle_vector(*values, _mask([i + LANES * (i % 4 == 3) for i in range(LANES)]))

    return float32x16(float32x16, float32x16), code


@intrinsic
def transpose(typingctx, array, at, out, to):  # type: ignore[no-untyped-def]
    """Sixteen rows of sixteen elements from `at` on, turned into columns, at `to` of an array that may be the same.

    Parameters
    ----------
    array, out : float32 array
        Contiguous.
    at, to : int64
    """
    _check(array)
    _check(out)

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        def places(k: int) -> list[Any]:
            index = values[2 * k + 1]
            step = [builder.add(index, ir.Constant(index.type, LANES * i)) for i in range(LANES)]
            given = signature.args[2 * k], types.intp
            return [_place(context, builder, types.void(*given), (values[2 * k], i)) for i in step]

        rows = [builder.load(place, align=4) for place in places(0)]
        # Swap what is off the diagonal, of blocks of 8, 4, 2 and 1.
        for size in (8, 4, 2, 1):
            first = [i if not i & size else i + LANES - size for i in range(LANES)]
            second = [i + size if not i & size else i + LANES for i in range(LANES)]
            for i in range(LANES):
                if not i & size:
                    one, other = rows[i], rows[i + size]
                    rows[i] = builder.shuffle_vector(one, other, _mask(first))
                    rows[i + size] = builder.shuffle_vector(one, other, _mask(second))
        for row, place in zip(rows, places(1)):
            builder.store(row, place, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, out, types.intp), code


def _binary(symbol: Any, result: Any, emit: Any) -> None:
    """Let `symbol` act on two vectors, or on a number and a vector."""

    @intrinsic
    def act(typingctx, a, b):  # type: ignore[no-untyped-def]
        return result(float32x16, float32x16), lambda context, builder, signature, values: emit(builder, *values)

    @overload(symbol)
    def _on_vectors(a, b):  # type: ignore[no-untyped-def]
        if a is float32x16 and b is float32x16:
            return lambda a, b: act(a, b)
        if a is types.float32 and b is float32x16:
            return lambda a, b: act(spread(a), b)
        if a is float32x16 and b is types.float32:
            return lambda a, b: act(a, spread(b))
        return None


def _unary(symbol: Any, name: str) -> None:
    """Let `symbol` act on a vector as an intrinsic of LLVM does."""

    @intrinsic
    def act(typingctx, a):  # type: ignore[no-untyped-def]
        def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            kind = ir.FunctionType(_VECTOR, [_VECTOR])
            function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f32")
            return builder.call(function, values)

        return float32x16(float32x16), code

    @overload(symbol)
    def _on_vector(a):  # type: ignore[no-untyped-def]
        return (lambda a: act(a)) if a is float32x16 else None


for _symbol, _instruction in (
    (operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul"), (operator.truediv, "fdiv"),
):  # fmt: skip
    _binary(_symbol, float32x16, lambda builder, a, b, own=_instruction: getattr(builder, own)(a, b))
for _symbol, _sign in ((operator.lt, "<"), (operator.gt, ">")):
    _binary(_symbol, mask16, lambda builder, a, b, own=_sign: builder.fcmp_ordered(own, a, b))
_unary(math.sqrt, "sqrt")
_unary(abs, "fabs")
