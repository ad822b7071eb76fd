"""Moving vertices as files that other programs play: PC2 and MDD, which Blender's Mesh Cache modifier plays.

Layouts after Autodesk's PointCache 2 and NewTek's MDD, as Blender's MOD_meshcache_pc2.c and _mdd.c read them.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.asset.archive import replace_file
from ..core.errors import AssetError, UsageError

Array = np.ndarray

#: Endings of both formats.
SUFFIXES = (".pc2", ".mdd")
_MAGIC = b"POINTCACHE2\0"
_PC2, _MDD = struct.Struct("<12s2i2fi"), struct.Struct(">2i")


@dataclass(frozen=True, slots=True)
class PointCache:
    """Moving vertices of a file.

    Attributes
    ----------
    frames : (k, n, 3) array
        Mapped; in the file's axes and unit, which it does not tell: as a rule object space, Z up, metres.
    first : int
        Number of the first frame, 1 where the file has times alone.
    fps : float
        Frames per second; 24 where the file has frames alone.
    """

    frames: Array
    first: int
    fps: float


def read_point_cache(path: Path) -> PointCache:
    """Read PC2 or MDD.

    Raises
    ------
    AssetError
        Names the file and what is wrong with it.
    """
    size = path.stat().st_size
    try:
        with open(path, "rb") as file:
            head = file.read(_PC2.size)
            if head.startswith(_MAGIC):
                if len(head) < _PC2.size:
                    raise AssetError(str(path), "is truncated in its header", "Export it again")
                _, _, points, start, rate, count = _PC2.unpack(head)
                if rate != 1:
                    raise AssetError(str(path), f"has a sample per {rate:g} frames", "Export it with one per frame")
                at, dtype, first, fps = _PC2.size, "<f4", round(start) if abs(start) < 1e6 else 1, 24.0
            elif len(head) >= _MDD.size and path.suffix.lower() == ".mdd":
                count, points = _MDD.unpack(head[: _MDD.size])
                at, dtype, first, fps = _MDD.size + 4 * max(count, 0), ">f4", 1, 24.0
                if count > 1 and at <= size:
                    file.seek(_MDD.size)
                    times = np.frombuffer(file.read(4 * count), ">f4").astype(np.float64)
                    step = float(np.median(np.diff(times)))
                    fps = 1 / step if 1e-4 < step < 1e4 else 24.0
            else:
                raise AssetError(str(path), "is neither PC2 nor MDD", "Export it in one of these formats")
    except OSError as error:
        raise AssetError(str(path), f"cannot be read ({error.strerror or error})", "Check the path") from error
    if count < 1 or points < 1:
        raise AssetError(str(path), f"says that it has {count} frames of {points} points", "Export it again")
    if at + 12 * count * points > size:
        whole = (size - at) // (12 * points)
        raise AssetError(
            str(path), f"is truncated: {count} frames are announced, {max(whole, 0)} are there", "Export it again"
        )
    return PointCache(np.memmap(path, dtype, "r", at, (count, points, 3)), first, fps)


def write_point_cache(path: Path, frames: Iterable[Array], count: int, points: int, first: int, fps: float) -> None:
    """Write vertices of consecutive frames, atomically.

    Parameters
    ----------
    path : Path
        Ends in .pc2 or .mdd, which decides the format.
    frames : iterable of (points, 3) array
        `count` arrays, metres, object space, Z up; in Mesh Cache leave the axes at Y forward, Z up.
    count : int
        Frames.
    points : int
        Of each frame.
    first : int
        Number of the first frame.
    fps : float
        Frames per second; times of an MDD are seconds from the first frame.

    Raises
    ------
    UsageError
        Another suffix, or a frame with another number of points.
    WriteError
        Naming the file and the system's reason.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise UsageError(str(path), f"does not end in {' or '.join(SUFFIXES)}", "Choose such a name")
    big = suffix == ".mdd"
    if big:
        head = _MDD.pack(count, points) + (np.arange(count) / fps).astype(">f4").tobytes()
    else:
        head = _PC2.pack(_MAGIC, 1, points, float(first), 1.0, count)

    def parts() -> Iterator[bytes | memoryview]:
        yield head
        for frame in frames:
            if frame.shape != (points, 3):
                raise UsageError(str(path), f"got a frame of shape {frame.shape}, expected ({points}, 3)", "Bake again")
            yield np.ascontiguousarray(frame, ">f4" if big else "<f4").tobytes()

    replace_file(path, parts())
