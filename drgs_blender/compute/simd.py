"""SIMD: sixteen single-precision numbers at once, for loops that LLVM does not vectorise by itself.

``float32x16`` is a type of compiled code only: `load`, `repeat`, `quads` and `spread` make such values, ``+``, ``-``
and ``*`` act on each of the sixteen, `store`, `fold` and `lanes` end them. LLVM makes of it what the processor has (one
register of AVX-512, two of AVX, four of SSE or NEON) with the same results: nothing is reordered, no operations are
fused.
"""

from __future__ import annotations

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


def _arithmetic(symbol: Any, instruction: str) -> None:
    """Let `symbol` act on two vectors, or on a number and a vector."""

    @intrinsic
    def act(typingctx, a, b):  # type: ignore[no-untyped-def]
        return float32x16(float32x16, float32x16), lambda context, builder, signature, values: getattr(
            builder, instruction
        )(*values)

    @overload(symbol)
    def _on_vectors(a, b):  # type: ignore[no-untyped-def]
        if a is float32x16 and b is float32x16:
            return lambda a, b: act(a, b)
        if a is types.float32 and b is float32x16:
            return lambda a, b: act(spread(a), b)
        return None


for _symbol, _instruction in ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul")):
    _arithmetic(_symbol, _instruction)
