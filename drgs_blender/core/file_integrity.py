"""File integrity: whether a picture was written to its end, without decoding it.

Where a disk is full, Blender leaves what fitted; and what reads pictures, shows what there is of them or crashes.
Layouts after the file format pages of OpenEXR, PNG (ISO 15948), JPEG (T.81), WebP (RFC 9649) and TIFF 6.0.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path

_EXR, _PNG, _JPEG, _RIFF = b"\x76\x2f\x31\x01", b"\x89PNG", b"\xff\xd8\xff", b"RIFF"
_TIFF = {b"II*\0": "<", b"MM\0*": ">"}
#: Tags of the places and sizes of a TIFF's strips, and of its tiles; how their numbers are stored, by type.
_TIFF_PIECES, _TIFF_NUMBERS = ((273, 279), (324, 325)), {3: "H", 4: "I"}
_PNG_END, _JPEG_END = b"IEND\xae\x42\x60\x82", b"\xff\xd9"
_TILED, _DEEP, _PARTS = 0x200, 0x800, 0x1000
_JPEG_SCAN = b"\xff\xda"
#: Numbers before the size of a chunk: of scan lines their first, of a tile its place and level.
_PLACES = {b"scanlineimage": 1, b"tiledimage": 4}


def is_whole(path: str | os.PathLike[str]) -> bool:
    """Whether nothing is missing at the end of a file; of other formats than those above whether there is anything."""
    return is_whole_data(Path(path).read_bytes())


def crashes_blender(data: bytes) -> bool:
    """Whether a file is an EXR that was cut off, at which Blender 5.0 crashes as soon as it is asked for the size."""
    return data[:4] == _EXR and not is_whole_data(data)


def is_whole_data(data: bytes) -> bool:
    """`is_whole` of the bytes of a file."""
    looks = _is_whole_exr if data[:4] == _EXR else _is_whole_tiff if data[:4] in _TIFF else None
    if looks is not None:
        try:
            return looks(data)
        except (struct.error, ValueError, IndexError, KeyError):
            return False
    if data[:4] == _PNG:
        return data.endswith(_PNG_END)
    if data[:3] == _JPEG:
        return data.rfind(_JPEG_END) > data.rfind(_JPEG_SCAN)  # some programs write more behind the end
    if data[:4] == _RIFF:
        return len(data) >= 8 + int.from_bytes(data[4:8], "little")
    return len(data) > 0


def _is_whole_exr(data: bytes) -> bool:
    """Whether every chunk is where the tables in front of them say, and ends within the file."""
    (flags,) = struct.unpack_from("<I", data, 4)
    if flags & _DEEP:
        return True
    parts, position = [], 8
    while True:
        header, position = _header(data, position)
        if header or not flags & _PARTS:
            parts.append(header)
        if not header or not flags & _PARTS:
            break
    for header in parts:
        places = _PLACES[header.get(b"type", b"tiledimage" if flags & _TILED else b"scanlineimage").rstrip(b"\0")]
        front = 4 * (places + bool(flags & _PARTS))
        count = int.from_bytes(header.get(b"chunkCount", b""), "little")
        # A lone part need not say how many chunks it has. The first of them follows the table.
        first = position + 8 * count if b"chunkCount" in header else len(data)
        while position < first:
            (offset,) = struct.unpack_from("<Q", data, position)
            (size,) = struct.unpack_from("<I", data, offset + front)
            if offset == 0 or offset + front + 4 + size > len(data):
                return False
            position += 8
            if b"chunkCount" not in header:
                first = min(first, offset)
    return True


def _is_whole_tiff(data: bytes) -> bool:
    """Whether the strips or tiles of the first picture end within the file."""
    order = _TIFF[data[:4]]
    (place,) = struct.unpack_from(f"{order}I", data, 4)
    (count,) = struct.unpack_from(f"{order}H", data, place)
    found: dict[int, tuple[int, ...]] = {}
    for entry in range(place + 2, place + 2 + 12 * count, 12):
        tag, kind, many = struct.unpack_from(f"{order}HHI", data, entry)
        if any(tag in pieces for pieces in _TIFF_PIECES):
            numbers = f"{order}{many}{_TIFF_NUMBERS[kind]}"
            at = entry + 8
            if struct.calcsize(numbers) > 4:
                (at,) = struct.unpack_from(f"{order}I", data, at)
            found[tag] = struct.unpack_from(numbers, data, at)
    ends = [a + b for places, sizes in _TIFF_PIECES for a, b in zip(found.get(places, ()), found.get(sizes, ()))]
    return max(ends, default=0) <= len(data)


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
