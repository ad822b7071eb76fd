"""The safetensors format in numpy: named arrays, no code, no copies.

A file is an 8-byte little-endian length, that many bytes of JSON (name -> dtype, shape, data_offsets) and the raw
little-endian arrays one after the other (https://github.com/huggingface/safetensors). The JSON is padded with spaces
so that the arrays start at a multiple of 64 bytes.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..errors import AssetError

Array = np.ndarray

#: Bytes to which the first array is aligned.
ALIGNMENT = 64
#: A header larger than this is damage or an attack, not an asset.
HEADER_LIMIT = 16 << 20

#: safetensors' name of a type -> numpy's.
DTYPES: dict[str, np.dtype[Any]] = {
    "F64": np.dtype("<f8"),
    "F32": np.dtype("<f4"),
    "F16": np.dtype("<f2"),
    "I64": np.dtype("<i8"),
    "I32": np.dtype("<i4"),
    "I16": np.dtype("<i2"),
    "I8": np.dtype("i1"),
    "U64": np.dtype("<u8"),
    "U32": np.dtype("<u4"),
    "U16": np.dtype("<u2"),
    "U8": np.dtype("u1"),
    "BOOL": np.dtype("?"),
}
_NAMES = {dtype: name for name, dtype in DTYPES.items()}


def dtype_name(array: Array) -> str:
    """safetensors' name of the type of `array`; AssetError where it has none."""
    try:
        return _NAMES[array.dtype.newbyteorder("<")]
    except KeyError:
        raise AssetError("tensor", f"has type {array.dtype}, which safetensors cannot hold") from None


def encode(tensors: Mapping[str, Array]) -> list[memoryview]:
    """Return the bytes of a safetensors file as buffers to write one after the other; arrays are not copied.

    Parameters
    ----------
    tensors : mapping of str to array
        Written in this order, little-endian and C-contiguous.
    """
    header: dict[str, Any] = {}
    buffers: list[memoryview] = []
    position = 0
    for name, array in tensors.items():
        dtype = dtype_name(array)
        data = np.ascontiguousarray(array, dtype=DTYPES[dtype])
        header[name] = {
            "dtype": dtype,
            "shape": list(array.shape),
            "data_offsets": [position, position + data.nbytes],
        }
        buffers.append(data.reshape(-1).view(np.uint8).data)
        position += data.nbytes
    text = json.dumps(header, ensure_ascii=False, separators=(",", ":")).encode()
    text += b" " * (-(8 + len(text)) % ALIGNMENT)
    return [memoryview(struct.pack("<Q", len(text)) + text), *buffers]


def decode(buffer: Array, subject: str = "tensors") -> dict[str, Array]:
    """Return the arrays of a safetensors file as views of `buffer`.

    Parameters
    ----------
    buffer : (n,) uint8 array
        The whole file; the arrays are as writable as it is.
    subject : str
        Name in errors.

    Raises
    ------
    AssetError
        The header is not what the format allows, or the arrays do not fill the file exactly.
    """
    start, header = _header(buffer, subject)
    tensors: dict[str, Array] = {}
    end = 0
    for name, entry in sorted(header.items(), key=lambda item: _offsets(item[1], item[0], subject)):
        begin, stop = _offsets(entry, name, subject)
        dtype, shape = DTYPES.get(str(entry.get("dtype"))), entry.get("shape")
        if dtype is None:
            raise AssetError(subject, f"tensor {name!r} has the type {entry.get('dtype')!r}, which is not supported")
        if not isinstance(shape, list) or len(shape) > 8 or not all(_is_count(width) for width in shape):
            raise AssetError(subject, f"tensor {name!r} has the shape {shape!r}, which is not a list of sizes")
        if begin != end or stop - begin != math.prod(shape) * dtype.itemsize or start + stop > len(buffer):
            raise AssetError(subject, f"tensor {name!r} does not lie where its shape and its neighbours say")
        end = stop
        tensors[name] = _view(buffer[start + begin : start + stop], dtype, shape)
    if start + end != len(buffer):
        raise AssetError(subject, f"has {len(buffer) - start - end} bytes that belong to no tensor")
    return {name: tensors[name] for name in header}


def parse_json(text: bytes, subject: str) -> dict[str, Any]:
    """Parse a JSON object strictly: UTF-8, no repeated name, no NaN or infinity, bounded depth; AssetError else."""

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        result = dict(pairs)
        if len(result) != len(pairs):
            raise ValueError("a name is repeated")
        return result

    def constant(name: str) -> None:
        raise ValueError(f"{name} is not a number of JSON")

    try:
        value = json.loads(text.decode(), object_pairs_hook=unique, parse_constant=constant)
    except (ValueError, RecursionError) as error:
        raise AssetError(subject, f"is not valid JSON ({error})") from error
    if not isinstance(value, dict):
        raise AssetError(subject, "is not a JSON object")
    return value


def _header(buffer: Array, subject: str) -> tuple[int, dict[str, Any]]:
    """(offset of the arrays, name -> entry) of a safetensors file."""
    if len(buffer) < 8:
        raise AssetError(subject, f"is {len(buffer)} bytes long, too short for safetensors")
    (length,) = struct.unpack("<Q", buffer[:8].tobytes())
    if length > min(HEADER_LIMIT, len(buffer) - 8):
        raise AssetError(subject, f"declares a header of {length} bytes in a file of {len(buffer)}")
    header = parse_json(buffer[8 : 8 + length].tobytes(), f"{subject}, header")
    header.pop("__metadata__", None)
    return 8 + length, header


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 48


def _offsets(entry: Any, name: str, subject: str) -> tuple[int, int]:
    """(begin, end) of an entry, checked."""
    offsets = entry.get("data_offsets") if isinstance(entry, dict) else None
    if isinstance(offsets, list) and len(offsets) == 2 and all(_is_count(o) for o in offsets):
        begin, end = offsets
        if begin <= end:
            return begin, end
    raise AssetError(subject, f"tensor {name!r} has no valid data_offsets")


def _view(data: Array, dtype: np.dtype[Any], shape: list[int]) -> Array:
    """`data` seen as an array; copied only where a foreign file did not align it."""
    if data.ctypes.data % dtype.itemsize:
        data = data.copy()
    return data.view(dtype).reshape(shape)
