"""File integrity: whether a picture was written to its end, without decoding it.

Where a disk is full, Blender leaves what fitted; and what reads pictures, shows what there is of them or crashes.
Layouts after the file format pages of OpenEXR, PNG (ISO 15948), JPEG (T.81) and WebP (RFC 9649).
"""

from __future__ import annotations

import os
import struct
from pathlib import Path

_EXR, _PNG, _JPEG, _RIFF = b"\x76\x2f\x31\x01", b"\x89PNG", b"\xff\xd8\xff", b"RIFF"
_PNG_END, _JPEG_END = b"IEND\xae\x42\x60\x82", b"\xff\xd9"
_TILED_OR_DEEP, _PARTS = 0x200 | 0x800, 0x1000
#: Scan lines of a chunk, by the number of the compression.
_LINES = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256)


def is_whole(path: str | os.PathLike[str]) -> bool:
    """Whether nothing is missing at the end of a file; of other formats than those above whether there is anything."""
    data = Path(path).read_bytes()
    if data[:4] == _EXR:
        try:
            return _is_whole_exr(data)
        except (struct.error, ValueError, IndexError, KeyError):
            return False
    if data[:4] == _PNG:
        return data.endswith(_PNG_END)
    if data[:3] == _JPEG:
        return data.endswith(_JPEG_END)
    if data[:4] == _RIFF:
        return len(data) >= 8 + int.from_bytes(data[4:8], "little")
    return len(data) > 0


def _is_whole_exr(data: bytes) -> bool:
    """Whether every chunk is where the tables in front of them say, and ends within the file."""
    (flags,) = struct.unpack_from("<I", data, 4)
    parts, position = [], 8
    while True:
        header, position = _header(data, position)
        if header or not flags & _PARTS:
            parts.append(header)
        if not header or not flags & _PARTS:
            break
    if flags & _TILED_OR_DEEP:
        return True  # Blender writes none
    front = 8 if flags & _PARTS else 4
    for header in parts:
        count = _chunks(header)
        offsets = struct.unpack_from(f"<{count}Q", data, position)
        position += 8 * count
        for offset in offsets:
            (size,) = struct.unpack_from("<I", data, offset + front)
            if offset == 0 or offset + front + 4 + size > len(data):
                return False
    return True


def _header(data: bytes, position: int) -> tuple[dict[bytes, bytes], int]:
    """Name -> value of the attributes at `position`, and where they end."""
    found = {}
    while data[position]:
        name, kind = data.index(b"\0", position), data.index(b"\0", data.index(b"\0", position) + 1)
        (size,) = struct.unpack_from("<I", data, kind + 1)
        found[data[position:name]] = data[kind + 5 : kind + 5 + size]
        position = kind + 5 + size
        if position >= len(data):
            raise ValueError("the header does not end")
    return found, position + 1


def _chunks(header: dict[bytes, bytes]) -> int:
    """How many chunks of scan lines a part has."""
    if b"chunkCount" in header:
        return int.from_bytes(header[b"chunkCount"], "little")
    _, low, _, high = struct.unpack("<4i", header[b"dataWindow"])
    lines = _LINES[header[b"compression"][0]]
    return (high - low) // lines + 1
