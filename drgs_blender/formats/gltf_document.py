"""glTF 2.0 files as JSON plus arrays: GLB and .gltf, buffers, accessors, images; nothing in them is trusted.

Khronos, glTF 2.0 specification, sections 3.6 (binary data) and 4 (GLB).
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
import sys
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from ..core.errors import AssetError

Array = np.ndarray

_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {
    "SCALAR": (1, 1),
    "VEC2": (2, 1),
    "VEC3": (3, 1),
    "VEC4": (4, 1),
    "MAT2": (2, 2),
    "MAT3": (3, 3),
    "MAT4": (4, 4),
}
#: An accessor without data (all zeros) is not longer than this.
EMPTY_LIMIT = 10_000_000
#: Bytes of values that may be taken from a file: all of it some times over, and enough for honest copies. Nodes can
#: place a mesh, and meshes name an accessor, without end.
_TIMES, _COPIES = 4, 64 << 20
_DAMAGED = "Export the file again, or restore it from a copy"


class Document:
    """A glTF file.

    Parameters
    ----------
    path : Path
        .gltf or .glb; the content decides.

    Raises
    ------
    AssetError
        From here and from every method: something in the file is missing, damaged or of the wrong type.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.subject = path, str(path)
        data = path.read_bytes()
        text, self._binary = _split_glb(data, self.subject) if data[:4] == b"glTF" else (data, None)
        self.json = _parse(text, self.subject)
        self._items: dict[str, list[dict[str, Any]]] = {}
        version = self.get(self.get(self.json, "asset", dict, {}), "version", str, "")
        if not version.startswith("2."):
            raise AssetError(self.subject, f"is glTF of version {version or 'unknown'}; 2 is read", _DAMAGED)
        self._buffers: dict[int, Array] = {}
        self._room = _COPIES + _TIMES * len(data)

    def get(self, entry: dict[str, Any], key: str, kind: type | tuple[type, ...], default: Any = None) -> Any:
        """``entry[key]`` when it is there and of type `kind`; `default` when it is absent."""
        value = entry.get(key, default)
        if key in entry and (not isinstance(value, kind) or isinstance(value, bool)):
            raise AssetError(self.subject, f"has {key!r} of the wrong type ({str(value)[:40]})", _DAMAGED)
        return value

    def items(self, key: str) -> list[dict[str, Any]]:
        """The top-level list `key` (empty when absent), all of whose entries are objects."""
        if key not in self._items:
            entries = self.get(self.json, key, list, [])
            if not all(isinstance(e, dict) for e in entries):
                raise AssetError(self.subject, f"has an entry of {key!r} of the wrong type", _DAMAGED)
            self._items[key] = entries
        return self._items[key]

    def item(self, key: str, index: Any) -> dict[str, Any]:
        """Entry `index` of the top-level list `key`."""
        entries = self.items(key)
        if isinstance(index, float) and index.is_integer():  # some exporters write 1.0
            index = int(index)
        if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(entries):
            raise AssetError(self.subject, f"refers to number {index} of {len(entries)} {key}", _DAMAGED)
        return entries[index]

    def index(self, entry: dict[str, Any], key: str) -> int | None:
        """``entry[key]`` as an integer, or None when it is absent."""
        value = self.get(entry, key, (int, float))
        if value is None:
            return None
        if value != value or value in (float("inf"), float("-inf")) or int(value) != value or value < 0:
            raise AssetError(self.subject, f"has {key!r} of {value}, which is no index", _DAMAGED)
        return int(value)

    def numbers(self, entry: dict[str, Any], key: str, default: tuple[float, ...]) -> Array:
        """``entry[key]`` as float64 array of the length of `default`."""
        value = entry.get(key, list(default))
        if len(default) == 1 and not isinstance(value, list):
            value = [value]
        good = isinstance(value, list) and len(value) == len(default)
        if not good or not all(isinstance(v, int | float) and not isinstance(v, bool) for v in value):
            raise AssetError(self.subject, f"has {key!r} of the wrong type ({str(value)[:40]})", _DAMAGED)
        if not all(abs(v) <= sys.float_info.max for v in value):  # Python's integers have no end
            raise AssetError(self.subject, f"has {key!r} that is not finite", _DAMAGED)
        return np.array(value, np.float64)

    def accessor(self, index: Any, kinds: tuple[str, ...]) -> Array:
        """Values of an accessor as (count, width) array; integers that are normalised become float32 in [-1, 1].

        Parameters
        ----------
        kinds : tuple of str
            Permitted types ("SCALAR", "VEC3", ...).
        """
        entry = self.item("accessors", index)
        dtype, shape = self._type(entry, kinds)
        count = self.index(entry, "count") or 0
        view = self.index(entry, "bufferView")
        width = int(np.prod(shape))
        if view is not None:
            values = self._strided(view, self.index(entry, "byteOffset") or 0, count, dtype, shape)
        elif count > EMPTY_LIMIT:
            raise AssetError(self.subject, f"declares {count} values without data", _DAMAGED)
        else:
            self.reserve(count * width * dtype.itemsize)
            values = np.zeros((count, width), dtype)
        if sparse := self.get(entry, "sparse", dict):
            values = self._sparse(sparse, values, dtype, shape)
        if entry.get("normalized") is True and dtype.kind in "iu":
            return np.maximum(values.astype(np.float32) / np.float32(np.iinfo(dtype).max), -1.0)
        return values

    def view(self, index: Any) -> tuple[Array, tuple[int, int]]:
        """Bytes of a buffer view, uint8, and the place in which they start: (buffer, byte)."""
        start, stop, buffer, _ = self._view(index)
        return buffer[start:stop], (self.index(self.item("bufferViews", index), "buffer") or 0, start)

    def image(self, index: Any) -> tuple[bytes, str]:
        """(encoded bytes, name for messages) of an image."""
        entry = self.item("images", index)
        view = self.index(entry, "bufferView")
        if view is not None:
            start, stop, buffer, _ = self._view(view)
            return buffer[start:stop].tobytes(), f"{self.subject}, image {index}"
        uri = self.get(entry, "uri", str, "")
        return self._uri(uri).tobytes(), f"{self.subject}, image {uri[:60]}"

    def _type(self, entry: dict[str, Any], kinds: tuple[str, ...]) -> tuple[np.dtype[Any], tuple[int, int]]:
        kind, component = entry.get("type"), entry.get("componentType")
        if not isinstance(component, int | float) or component not in _COMPONENTS or kind not in kinds:
            raise AssetError(self.subject, f"has an accessor {kind} of {component} where {kinds} is needed", _DAMAGED)
        return np.dtype(_COMPONENTS[int(component)]), _WIDTHS[str(kind)]

    def _view(self, index: Any) -> tuple[int, int, Array, int]:
        """(start, stop, buffer, stride) of a buffer view."""
        entry = self.item("bufferViews", index)
        for name in ("EXT_meshopt_compression", "KHR_meshopt_compression"):
            if name in self.get(entry, "extensions", dict, {}):
                raise AssetError(self.subject, "is compressed with meshopt", "Export it without mesh compression")
        buffer = self._buffer(self.index(entry, "buffer"))
        start = self.index(entry, "byteOffset") or 0
        stop = start + (self.index(entry, "byteLength") or 0)
        if stop > len(buffer):
            raise AssetError(self.subject, f"has buffer view {index} beyond the end of its buffer", _DAMAGED)
        return start, stop, buffer, self.index(entry, "byteStride") or 0

    def _buffer(self, index: Any) -> Array:
        entry = self.item("buffers", index)
        if index not in self._buffers:
            if "uri" in entry:
                data = self._uri(self.get(entry, "uri", str))
                self._room += _TIMES * len(data)
            elif index == 0 and self._binary is not None:
                data = np.frombuffer(self._binary, np.uint8)
            else:
                raise AssetError(self.subject, f"has no data for buffer {index}", _DAMAGED)
            if len(data) < (self.index(entry, "byteLength") or 0):
                raise AssetError(self.subject, f"has a buffer {index} that is truncated", _DAMAGED)
            self._buffers[index] = data
        return self._buffers[index]

    def _uri(self, uri: str) -> Array:
        """The bytes behind a data: URI or a file beside this one."""
        if uri.startswith("data:"):
            head, _, body = uri.partition(",")
            try:
                data = base64.b64decode(body, validate=True) if head.endswith(";base64") else unquote(body).encode()
            except (binascii.Error, ValueError) as error:
                raise AssetError(self.subject, f"has damaged embedded data ({error})", _DAMAGED) from error
            return np.frombuffer(data, np.uint8)
        name = unquote(uri)
        if not is_name(name) or ":" in name or not below(name):
            raise AssetError(self.subject, f"refers to {uri[:60]!r}, which is no file beside or below it", _DAMAGED)
        try:
            if (self.path.parent / name).exists() and not (self.path.parent / name).is_file():
                raise OSError("not a regular file")
            return np.fromfile(self.path.parent / name, np.uint8)
        except OSError as error:
            raise AssetError(self.subject, f"needs the file {name!r}, which cannot be read", "Put it beside") from error

    def _strided(self, view: int, offset: int, count: int, dtype: np.dtype[Any], shape: tuple[int, int]) -> Array:
        start, stop, buffer, stride = self._view(view)
        rows, columns = shape
        column = rows * dtype.itemsize
        pitch = column if columns == 1 else -(-column // 4) * 4  # columns of matrices start at multiples of 4
        size = pitch * columns
        stride = stride or size
        first = start + offset
        if count and (stride < size or first + stride * (count - 1) + size > stop):
            raise AssetError(self.subject, f"has an accessor that leaves buffer view {view}", _DAMAGED)
        if not count:
            return np.zeros((0, rows * columns), dtype)
        self.reserve(count * size)
        block = np.lib.stride_tricks.as_strided(buffer[first:], (count, columns, column), (stride, pitch, 1))
        return np.ascontiguousarray(block).view(dtype).reshape(count, rows * columns)

    def reserve(self, size: int) -> None:
        """Note that `size` bytes of values are made of the file; refuse it where they become too many."""
        self._room -= size
        if self._room < 0:
            problem = "repeats its meshes until they are far more than is in it"
            raise AssetError(self.subject, problem, "Export the object once, without its copies")

    def _sparse(self, sparse: dict[str, Any], values: Array, dtype: np.dtype[Any], shape: tuple[int, int]) -> Array:
        count = self.index(sparse, "count") or 0
        where, what = self.get(sparse, "indices", dict, {}), self.get(sparse, "values", dict, {})
        code, _ = self._type({**where, "type": "SCALAR"}, ("SCALAR",))
        offsets = self.index(where, "byteOffset") or 0, self.index(what, "byteOffset") or 0
        indices = self._strided(self.index(where, "bufferView") or 0, offsets[0], count, code, (1, 1))[:, 0]
        if count and (code.kind == "f" or int(indices.max()) >= len(values) or int(indices.min()) < 0):
            raise AssetError(self.subject, "has a sparse accessor with an index out of range", _DAMAGED)
        values = values.copy()
        values[indices] = self._strided(self.index(what, "bufferView") or 0, offsets[1], count, dtype, shape)
        return values


def is_name(text: str) -> bool:
    """Whether a file can have the name: neither empty nor with characters that no system takes."""
    return bool(text) and "\0" not in text and not any("\ud800" <= c <= "\udfff" for c in text)


def below(name: str) -> bool:
    """Whether a relative name stays in its folder all the way, whichever system's separators it uses."""
    depth = 0
    for part in name.replace("\\", "/").split("/"):
        depth += {"": 0, ".": 0, "..": -1}.get(part, 1)
        if depth < 0:
            return False
    return not name.startswith(("/", "\\"))


def _split_glb(data: bytes, subject: str) -> tuple[bytes, bytes | None]:
    """(JSON chunk, binary chunk or None) of a GLB file."""
    if len(data) < 20:
        raise AssetError(subject, "is a truncated GLB", _DAMAGED)
    _, version, length = struct.unpack_from("<4sII", data)
    if version != 2:
        raise AssetError(subject, f"is GLB of version {version}; 2 is read", _DAMAGED)
    if length > len(data):
        raise AssetError(subject, f"is a truncated GLB: {len(data)} of {length} bytes are there", _DAMAGED)
    chunks: list[tuple[bytes, bytes]] = []
    position = 12
    while position + 8 <= length:
        size, kind = struct.unpack_from("<I4s", data, position)
        if position + 8 + size > length:
            raise AssetError(subject, "is a GLB with a truncated chunk", _DAMAGED)
        chunks.append((kind, data[position + 8 : position + 8 + size]))
        position += 8 + size
    if not chunks or chunks[0][0] != b"JSON":
        raise AssetError(subject, "is a GLB without JSON", _DAMAGED)
    binary = chunks[1][1] if len(chunks) > 1 and chunks[1][0] == b"BIN\0" else None
    return chunks[0][1], binary


def _parse(text: bytes, subject: str) -> dict[str, Any]:
    try:
        value = json.loads(text.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise AssetError(subject, f"is not valid JSON ({error})", _DAMAGED) from error
    if not isinstance(value, dict):
        raise AssetError(subject, "is not a glTF object", _DAMAGED)
    return value
