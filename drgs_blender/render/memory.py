"""Reading arrays at their addresses, for compiled code.

Numba counts references to every array that is passed to a function which is not inlined, with atomic operations for
which threads wait. Lookups that are called a hundred million times a frame take addresses instead. Whoever makes an
address keeps the array alive and in place.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

Array = np.ndarray
#: Function of an array to the address at which compiled code reads it: `address`, or that of a copy on a device.
AddressOf = Callable[[Array], int]


def address(array: Array) -> int:
    """Address of the data of a C-contiguous array."""
    return int(array.__array_interface__["data"][0])


def _load(scalar: Any, kind: Any) -> Any:
    """Intrinsic ``load(address, index)``: element `index` of an array of `scalar`, wherever it is aligned."""

    @intrinsic
    def load(typing, address, index):  # type: ignore[no-untyped-def]
        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            start = builder.inttoptr(arguments[0], kind.as_pointer())
            value = builder.load(builder.gep(start, [arguments[1]]))
            value.align = 1
            return value

        return scalar(types.int64, types.int64), codegen

    return load


load_float = _load(types.float32, ir.FloatType())
load_double = _load(types.float64, ir.DoubleType())
load_uint8 = _load(types.uint8, ir.IntType(8))
load_int32 = _load(types.int32, ir.IntType(32))
load_uint32 = _load(types.uint32, ir.IntType(32))
load_int64 = _load(types.int64, ir.IntType(64))
