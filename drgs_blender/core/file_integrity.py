"""File integrity: whether a picture was written to its end, without decoding it.

Where a disk is full, Blender leaves what fitted; and what reads pictures, shows what there is of them or crashes.
Layouts after the file format pages of OpenEXR, PNG (ISO 15948), JPEG (T.81), WebP (RFC 9649) and TIFF 6.0. Of a file
only what says where the rest lies is read; of a JPEG, which does not say it, what comes before its end.
"""

from __future__ import annotations

import io
import os
import re
import struct
from typing import Any, BinaryIO

#: What an OpenEXR file begins with.
EXR = b"\x76\x2f\x31\x01"
_PNG, _JPEG, _RIFF = b"\x89PNG", b"\xff\xd8\xff", b"RIFF"
_TIFF = {b"II*\0": "<", b"MM\0*": ">"}
#: Tags of the places and sizes of a TIFF's strips, and of its tiles; how their numbers are stored, by type.
_TIFF_PIECES, _TIFF_NUMBERS = ((273, 279), (324, 325)), {3: "H", 4: "I"}
_TILED, _DEEP, _PARTS = 0x200, 0x800, 0x1000
#: A marker of a JPEG, but for those within a scan: escaped bytes, restarts and filling.
_JPEG_MARKER, _JPEG_END = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]"), 0xD9
#: Numbers before the size of a chunk: of scan lines their first, of a tile its place and level.
_PLACES = {b"scanlineimage": 1, b"tiledimage": 4}
#: Scan lines of a chunk by the number of the compression, from none to HTJ2K.
_LINES = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256, 256, 32)
#: Bytes of an EXR's names at most, with their zeros; bytes that are searched at once, at first and at most.
_NAMES, _FIRST_BLOCK, _LARGEST_BLOCK = 512, 1 << 12, 1 << 20


class _Reader:
    """A file by places, of which only what is asked for is read; ValueError where it ends before that."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.size = stream.seek(0, os.SEEK_END)

    def upto(self, position: int, count: int) -> bytes:
        """What there is of some bytes."""
        self._stream.seek(position)
        return self._stream.read(count)

    def bytes(self, position: int, count: int) -> bytes:
        if position + count > self.size:
            raise ValueError("the file ends before")
        return self.upto(position, count)

    def numbers(self, layout: str, position: int) -> tuple[Any, ...]:
        """As `struct.unpack` has them."""
        return struct.unpack(layout, self.bytes(position, struct.calcsize(layout)))


def is_whole(file: str | os.PathLike[str] | bytes) -> bool:
    """Whether nothing is missing at the end of a file; of other formats than those above whether there is anything.

    Parameters
    ----------
    file : str, path-like or bytes
        Its path, or its bytes.
    """
    with _opened(file) as stream:
        reader = _Reader(stream)
        start = reader.upto(0, 4)
        looks = _LOOKS.get(start, _is_whole_jpeg if start[:3] == _JPEG else None)
        try:
            return reader.size > 0 if looks is None else looks(reader)
        except (struct.error, ValueError, IndexError, KeyError):
            return False


def crashes_blender(file: str | os.PathLike[str] | bytes) -> bool:
    """Whether a file is an EXR that was cut off, at which Blender 5.0 crashes as soon as it is asked for the size.

    Parameters
    ----------
    file : str, path-like or bytes
        Its path, or its bytes.
    """
    return is_exr(file) and not is_whole(file)


def is_exr(file: str | os.PathLike[str] | bytes) -> bool:
    """Whether a file begins as an OpenEXR file does.

    Parameters
    ----------
    file : str, path-like or bytes
        Its path, or its bytes.
    """
    with _opened(file) as stream:
        return stream.read(len(EXR)) == EXR


def _opened(file: str | os.PathLike[str] | bytes) -> BinaryIO:
    return io.BytesIO(file) if isinstance(file, bytes) else open(file, "rb", buffering=0)


def _is_whole_exr(file: _Reader) -> bool:
    """Whether every chunk is where the tables in front of them say, and ends within the file."""
    (flags,) = file.numbers("<I", 4)
    if flags & _DEEP:
        return True
    parts: list[dict[bytes, bytes]] = []
    position = 8
    while True:
        header, position = _header(file, position)
        if header or not flags & _PARTS:
            parts.append(header)
        if not header or not flags & _PARTS:
            break
    for header in parts:
        places = _PLACES[header.get(b"type", b"tiledimage" if flags & _TILED else b"scanlineimage").rstrip(b"\0")]
        front = 4 * (places + bool(flags & _PARTS))
        count = int.from_bytes(header.get(b"chunkCount", b""), "little")
        # A lone part need not say how many chunks it has. The first of them follows the table.
        first = position + 8 * count if b"chunkCount" in header else file.size
        while position < first:
            (offset,) = file.numbers("<Q", position)
            if offset == 0 and not flags & (_PARTS | _TILED):
                return _has_all_lines(file, header, position)
            (size,) = file.numbers("<I", offset + front)
            if offset == 0 or offset + front + 4 + size > file.size:
                return False
            position += 8
            if b"chunkCount" not in header:
                first = min(first, offset)
    return True


def _has_all_lines(file: _Reader, header: dict[bytes, bytes], position: int) -> bool:
    """Whether all chunks of scan lines follow the table at `position`, which is empty; readers make up for that.

    Blender 5.2 leaves it so where it packs an image; in a file it is what is written last.
    """
    _, top, _, bottom = struct.unpack("<4i", header[b"dataWindow"])
    count = -(-(bottom - top + 1) // _LINES[header[b"compression"][0]])
    position += 8 * count
    for _ in range(count):
        (size,) = file.numbers("<I", position + 4)
        position += 8 + size
    return position <= file.size


def _header(file: _Reader, position: int) -> tuple[dict[bytes, bytes], int]:
    """Name -> value of the attributes at `position`, and where they end."""
    found = {}
    while (names := file.upto(position, _NAMES))[0]:
        name, kind, _ = names.split(b"\0", 2)
        position += len(name) + len(kind) + 2
        (size,) = file.numbers("<I", position)
        found[name] = file.bytes(position + 4, size)
        position += 4 + size
    return found, position + 1


def _is_whole_png(file: _Reader) -> bool:
    """Whether its chunks go on to the last."""
    position, kind = 8, b""
    while kind != b"IEND":
        size, kind = file.numbers(">I4s", position)
        position += 12 + size
    return position <= file.size


def _is_whole_jpeg(file: _Reader) -> bool:
    """Whether an end follows the segments of the first picture; thumbnails lie within segments, or behind it."""
    position, block = 2, _FIRST_BLOCK
    while position < file.size:
        data = file.upto(position, block)
        found = _JPEG_MARKER.search(data)
        if found is None:
            position += max(1, len(data) - 1)  # whose last byte may begin a marker
            block = min(2 * block, _LARGEST_BLOCK)
            continue
        if data[found.start() + 1] == _JPEG_END:
            return True
        (size,) = file.numbers(">H", position + found.end())
        position += found.end() + size
        block = _FIRST_BLOCK
    return False


def _is_whole_webp(file: _Reader) -> bool:
    """Whether there is as much as it says; other RIFF files say it, too."""
    (size,) = file.numbers("<I", 4)
    return file.size >= 8 + size


def _is_whole_tiff(file: _Reader) -> bool:
    """Whether the strips or tiles of the first picture end within the file."""
    order = _TIFF[file.bytes(0, 4)]
    (place,) = file.numbers(f"{order}I", 4)
    (count,) = file.numbers(f"{order}H", place)
    found: dict[int, tuple[int, ...]] = {}
    for entry in range(place + 2, place + 2 + 12 * count, 12):
        tag, kind, many = file.numbers(f"{order}HHI", entry)
        if any(tag in pieces for pieces in _TIFF_PIECES):
            numbers = f"{order}{many}{_TIFF_NUMBERS[kind]}"
            at = entry + 8
            if struct.calcsize(numbers) > 4:
                (at,) = file.numbers(f"{order}I", at)
            found[tag] = file.numbers(numbers, at)
    ends = [a + b for places, sizes in _TIFF_PIECES for a, b in zip(found.get(places, ()), found.get(sizes, ()))]
    return max(ends, default=0) <= file.size


#: By the first four bytes.
_LOOKS = {EXR: _is_whole_exr, _PNG: _is_whole_png, _RIFF: _is_whole_webp, **dict.fromkeys(_TIFF, _is_whole_tiff)}
