"""GLB files put together: arrays become accessors, pictures buffer views (Khronos, glTF 2.0, sections 3.6 and 4)."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from ..core.asset.archive import replace_file
from ..core.errors import UsageError
from ..core.version import __version__

Array = np.ndarray

_COMPONENTS = {"f4": 5126, "u4": 5125, "u2": 5123, "u1": 5121}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_VERTICES, _INDICES = 34962, 34963
_LARGEST = (1 << 32) - 1


class Glb:
    """A glTF document in the making, with one buffer.

    Attributes
    ----------
    json : dict
        The document; everything but buffers, views and accessors is the caller's.
    """

    def __init__(self) -> None:
        self.json: dict[str, Any] = {"asset": {"version": "2.0", "generator": f"DR-GS {__version__}"}}
        self._views: list[dict[str, int]] = []
        self._accessors: list[dict[str, Any]] = []
        self._parts: list[bytes] = []
        self._size = 0

    def view(self, data: bytes, target: int = 0) -> int:
        """Index of a new buffer view; `target` says what of a mesh it holds."""
        self._views.append({"buffer": 0, "byteOffset": self._size, "byteLength": len(data)})
        if target:
            self._views[-1]["target"] = target
        padded = data + bytes(-len(data) % 4)
        self._parts.append(padded)
        self._size += len(padded)
        return len(self._views) - 1

    def accessor(self, values: Array, *, normalized: bool = False, bounds: bool = False) -> int:
        """Index of a new accessor of `values` (n,) or (n, width): float32, or unsigned integers; uint32 are indices.

        `bounds` adds the least and greatest values, which positions must have.
        """
        table = np.ascontiguousarray(values.reshape(len(values), -1))
        code = table.dtype.str[1:]
        entry: dict[str, Any] = {
            "bufferView": self.view(
                table.astype(f"<{code}", copy=False).tobytes(), _INDICES if code == "u4" else _VERTICES
            ),
            "componentType": _COMPONENTS[code],
            "count": len(table),
            "type": _TYPES[table.shape[1]],
        }
        if normalized:
            entry["normalized"] = True
        if bounds:
            entry |= {"min": table.min(axis=0).tolist(), "max": table.max(axis=0).tolist()}
        self._accessors.append(entry)
        return len(self._accessors) - 1

    def placeholder(self, count: int, width: int, bounds: tuple[Array, Array] | None = None) -> int:
        """Index of a new accessor of `count` float32 rows without data: an extension provides it.

        `bounds` are the least and greatest values (width,), which positions must have.
        """
        entry: dict[str, Any] = {"componentType": _COMPONENTS["f4"], "count": count, "type": _TYPES[width]}
        if bounds is not None:
            entry |= {"min": bounds[0].tolist(), "max": bounds[1].tolist()}
        self._accessors.append(entry)
        return len(self._accessors) - 1

    def write(self, path: Path) -> None:
        """Write the file.

        Raises
        ------
        UsageError
            It would be larger than a GLB can be.
        WriteError
            It cannot be written.
        """
        document = self.json | {
            "bufferViews": self._views,
            "accessors": self._accessors,
            "buffers": [{"byteLength": self._size}],
        }
        text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        length = 12 + 8 + len(text) + 8 + self._size
        if length > _LARGEST:
            raise UsageError(str(path), f"would be {length} bytes, more than the 4 GiB of GLB", "Choose another format")
        header = struct.pack("<4sII", b"glTF", 2, length) + struct.pack("<I4s", len(text), b"JSON")
        replace_file(path, [header, text, struct.pack("<I4s", self._size, b"BIN\0"), *self._parts])
