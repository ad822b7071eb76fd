"""``.ksplat``, the splats of the web viewer GaussianSplats3D: sections of splats, exact or in buckets of 16 bits.

https://github.com/mkkellogg/GaussianSplats3D (SplatBuffer). Two headers of fixed size, then per section the sizes of
its last buckets, the centres of all buckets, and a record a splat.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from ..core.errors import AssetError
from .files import SurfelFile
from .packed_splats import dc_of, decode_arrays, log_scale

Array = np.ndarray

_HEADER, _SECTION = 4096, 1024
_HARMONICS = (0, 9, 24, 45)
_REMEDY = "Export it again, or restore it from a copy"


def sniff_ksplat(head: bytes, path: Path) -> bool:
    """Whether a file can be .ksplat: it has no signature, so its name and its version must do."""
    if path.suffix.lower() != ".ksplat" or len(head) < _HEADER:
        return False
    return head[0] == 0 and head[1] >= 1 and struct.unpack_from("<H", head, 20)[0] <= 2


def read_ksplat(path: Path) -> SurfelFile:
    """Read a .ksplat file of any compression level.

    Raises
    ------
    AssetError
        The file is truncated or its headers contradict each other.
    """
    data, subject = path.read_bytes(), str(path)
    sections, total, level = struct.unpack_from("<I8xIH", data, 4)
    low, high = struct.unpack_from("<2f", data, 36)
    position = _HEADER + sections * _SECTION
    if position > len(data):
        raise AssetError(subject, f"says it has {sections} sections, more than it can hold", _REMEDY)
    pieces = []
    for index in range(sections):
        section = _Section(data, _HEADER + index * _SECTION, position, level, subject)
        if section.count:
            pieces.append((section.centres(), section.table))
        position = section.end
    if sum(len(table) for _, table in pieces) != total or not pieces:
        raise AssetError(subject, f"says it has {total} splats, but its sections have another number", _REMEDY)
    per_channel = max(table["sh"].shape[1] for _, table in pieces) // 3
    sh = np.zeros((total, 1 + per_channel, 3), np.float32)
    first = 0
    for _, table in pieces:
        rows = slice(first, first + len(table))
        sh[rows, :1] = dc_of(table["colour"] / np.float32(255))
        _put_harmonics(sh[rows], table["sh"], (low or -1.5, high or 1.5))
        first = rows.stop

    def joined(name: str) -> Array:
        return np.concatenate([table[name].astype(np.float32) for _, table in pieces])

    return decode_arrays(
        np.concatenate([centre for centre, _ in pieces]),
        log_scale(joined("scale")),
        joined("rotation"),
        joined("colour")[:, 3] / np.float32(255),
        sh,
        path,
        "ksplat",
    )


class _Section:
    """One section: where its parts lie, and its records."""

    def __init__(self, data: bytes, header: int, start: int, level: int, subject: str) -> None:
        self.count, room, self.capacity, self.buckets = struct.unpack_from("<4I", data, header)
        self.block, storage, self.range = struct.unpack_from("<fH2xI", data, header + 16)
        self.full, partial, degree = struct.unpack_from("<2IH", data, header + 32)
        if degree >= len(_HARMONICS):
            raise AssetError(subject, f"has harmonics of degree {degree}", _REMEDY)
        self.level, self.subject = level, subject
        record = _record(level, _HARMONICS[degree])
        centres = start + 4 * partial
        first = centres + storage * self.buckets
        self.end = first + record.itemsize * room
        last = first + record.itemsize * self.count
        if self.count > room or last > len(data) or (self.buckets and level and storage < 12):
            raise AssetError(subject, f"is truncated: a section of {self.count} splats does not fit", _REMEDY)
        self.table = np.frombuffer(data, record, self.count, first) if self.count else np.zeros(0, record)
        self._partial = np.frombuffer(data, "<u4", partial, start)
        self._centres = np.zeros((0, 3), np.float32)
        if level and self.buckets:
            rows = np.frombuffer(data, np.uint8, storage * self.buckets, centres).reshape(-1, storage)
            self._centres = np.ascontiguousarray(rows[:, :12]).view("<f4")

    def centres(self) -> Array:
        """(count, 3) centres: as stored, or steps within the cube of each bucket."""
        if not self.level:
            return self.table["position"].astype(np.float32)
        inside = min(self.full * self.capacity, self.count)
        sizes = self._partial.astype(np.int64)
        if self.full * self.capacity > self.count or sizes.sum() != self.count - inside:
            raise AssetError(self.subject, "has buckets that do not add up to its splats", _REMEDY)
        bucket = np.empty(self.count, np.int64)
        bucket[:inside] = np.arange(inside) // max(self.capacity, 1)
        bucket[inside:] = np.repeat(self.full + np.arange(len(sizes)), sizes)
        if self.count and bucket.max() >= len(self._centres):
            raise AssetError(self.subject, "refers to a bucket that is not there", _REMEDY)
        steps = self.range or 32767
        offset = (self.table["position"].astype(np.float32) - steps) * np.float32(self.block / 2 / steps)
        return offset + self._centres[bucket]


def _record(level: int, harmonics: int) -> np.dtype[np.void]:
    """A splat in a section: 32-bit numbers, 16-bit, or 16-bit with harmonics as bytes."""
    number, position = ("<f4", "<f4") if level == 0 else ("<f2", "<u2")
    return np.dtype(
        [
            ("position", position, 3),
            ("scale", number, 3),
            ("rotation", number, 4),
            ("colour", "u1", 4),
            ("sh", "u1" if level == 2 else number, (harmonics,)),
        ]
    )


def _put_harmonics(sh: Array, stored: Array, ends: tuple[float, float]) -> None:
    """Band after band, and in each all of red, then green, then blue; bytes lie between `ends`."""
    values = stored.astype(np.float32)
    if stored.dtype == np.uint8:
        values = ends[0] + values * np.float32((ends[1] - ends[0]) / 255)
    first = 0
    for band, width in ((1, 3), (4, 5), (9, 7)):
        if first + 3 * width > values.shape[1]:
            break
        part = values[:, first : first + 3 * width].reshape(-1, 3, width)
        sh[:, band : band + width] = part.transpose(0, 2, 1)
        first += 3 * width
