"""Moving vertices as files that other programs play: PC2 and MDD, which Blender's Mesh Cache modifier reads.

Layouts after Autodesk's PointCache 2 and NewTek's MDD, as Blender's MOD_meshcache_pc2.c and _mdd.c read them.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from ..core.asset.archive import replace_file
from ..core.errors import UsageError

Array = np.ndarray

#: Endings of what can be written.
SUFFIXES = (".pc2", ".mdd")


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
        head = struct.pack(">2i", count, points) + (np.arange(count) / fps).astype(">f4").tobytes()
    else:
        head = struct.pack("<12s2i2fi", b"POINTCACHE2\0", 1, points, float(first), 1.0, count)

    def parts() -> Iterator[bytes | memoryview]:
        yield head
        for frame in frames:
            if frame.shape != (points, 3):
                raise UsageError(str(path), f"got a frame of shape {frame.shape}, expected ({points}, 3)", "Bake again")
            yield np.ascontiguousarray(frame, ">f4" if big else "<f4").tobytes()

    replace_file(path, parts())
