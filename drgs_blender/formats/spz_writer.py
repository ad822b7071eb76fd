"""SPZ written, versions 2 to 4; see `spz` for the layout.

Version 4 is what the reference writes. Programs from before it read 2 and 3, which lie in one gzip stream; 2 has
coarser rotations (https://github.com/nianticlabs/spz, `packQuaternionFirstThree`).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ..core.asset.archive import replace_file
from ..core.errors import AssetError, UsageError
from ..core.file_types import SPZ_VERSIONS
from .axes import multiply_quaternions
from .quaternions import to_smallest_three
from .splats import Splats, writable
from .spz import COLOUR, HEADER, HEADER_4, MAGIC, TABLE, zstandard_library

Array = np.ndarray

#: Most fractional bits tried for positions; 24 bits hold the whole number.
_FRACTION = 12
#: Size below which all are the same, metres.
_SMALLEST = float(np.exp(-10))
#: Steps of the harmonics that are written: 5 bits for the first band, 4 for the others, as the reference does.
_STEPS = (8, 16)


def write_spz(path: Path, splats: Splats, spz_version: int = SPZ_VERSIONS[-1]) -> None:
    """Write an SPZ file. `splats` are Y up.

    Raises
    ------
    AssetError
        The splats are too far apart for 24 bits a coordinate, or too small; see also `splats.writable`.
    DeviceError
        The package zstandard is missing (version 4).
    UsageError
        There is no such version.
    WriteError
        The file cannot be written.
    """
    replace_file(path, spz_parts(splats, spz_version, str(path)))


@np.errstate(over="ignore")  # what is brighter than the format holds becomes the brightest that it does
def spz_parts(splats: Splats, version: int, subject: str) -> list[bytes]:
    """The bytes of an SPZ file, in pieces. Raises what `write_spz` does of the splats `subject`."""
    if version not in SPZ_VERSIONS:
        raise UsageError(subject, f"cannot be SPZ of version {version}", f"Choose one of {SPZ_VERSIONS}")
    splats = writable(splats, subject)
    if len(splats) and splats.scale.max() < _SMALLEST:
        problem = f"would hold splats of {splats.scale.max():.2g} m at most, all below the {_SMALLEST:.2g} m of SPZ"
        raise AssetError(subject, problem, "Choose another --scale or format")
    far = float(np.abs(splats.centre).max(initial=0.0))
    fraction = next((bits for bits in range(_FRACTION, -1, -1) if far * 2**bits < 2**23 - 1), None)
    if fraction is None:
        raise AssetError(subject, f"would hold a splat at {far:g} m, beyond the 8388 km of SPZ", "Remove far splats")
    degree = {1: 0, 4: 1, 9: 2, 16: 3}[splats.sh.shape[1]]
    rotation, scale = splats.rotation, splats.scale
    if version < 3:
        rotation, scale = _least_turned(rotation, scale)
    blocks = [
        np.rint(splats.centre * np.float32(2**fraction)).astype("<i4").view(np.uint8).reshape(-1, 4)[:, :3],
        _byte(splats.opacity * 255),
        _byte((splats.sh[:, 0] * COLOUR + 0.5) * 255),
        _byte((np.log(scale) + 10) * 16),
        _first_three(rotation) if version < 3 else _pack_rotations(rotation),
        *([_pack_harmonics(splats.sh[:, 1:])] if degree else []),
    ]
    if version < 4:
        header = HEADER.pack(MAGIC, version, len(splats), degree, fraction, 0, 0)
        return _gzip([header, *(np.ascontiguousarray(block).tobytes() for block in blocks)])
    packer = zstandard_library(subject).ZstdCompressor(level=6, threads=-1)
    frames = [packer.compress(np.ascontiguousarray(block)) for block in blocks]
    header = HEADER.pack(MAGIC, version, len(splats), degree, fraction, 0, len(blocks))
    table = [TABLE.pack(len(frame), block.nbytes) for frame, block in zip(frames, blocks, strict=True)]
    return [header, struct.pack("<I12x", HEADER_4), *table, *frames]


def _gzip(parts: Sequence[bytes]) -> list[bytes]:
    """One gzip stream, without a time: the same splats give the same bytes."""
    packer = zlib.compressobj(wbits=31)
    return [*(packer.compress(part) for part in parts), packer.flush()]


def _byte(values: Array) -> Array:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


@cache
def _orders() -> tuple[Array, Array]:
    """The turns of a cube that carry an axis onto +Z: quaternions wxyz (12, 4), and what axes become (12, 3)."""
    group = Rotation.create_group("O")
    turns = np.rint(group.as_matrix()).astype(np.int64)
    keep = (turns[:, 2] == 1).any(axis=1)
    order = np.abs(turns[keep]).argmax(axis=1)  # column i of a turn is plus or minus the axis order[i]
    return group.as_quat()[keep][:, [3, 0, 1, 2]].astype(np.float32), order


def _least_turned(rotation: Array, scale: Array) -> tuple[Array, Array]:
    """The same ellipsoids by other rotations of theirs: those with the largest real part, which is not stored.

    It follows from the others to a fraction of their steps that grows as it shrinks: near 0 it would be wrong by ten
    degrees. Axes keep their lengths, and the third one its sign: surfels keep their side.
    """
    turns, orders = _orders()
    # Real parts of rotation * turn.
    real = turns * np.array([1, -1, -1, -1], np.float32)
    best, largest = np.zeros(len(rotation), np.intp), np.full(len(rotation), -1, np.float32)
    for i, row in enumerate(real):
        size = np.abs(rotation @ row)
        better = size > largest + np.float32(1e-6)
        best[better], largest[better] = i, size[better]
    rotation = multiply_quaternions(rotation, turns[best]).astype(np.float32)
    return rotation, np.take_along_axis(scale, orders[best], axis=1)


def _first_three(rotation: Array) -> Array:
    """Version 2: x, y, z as bytes, of the quaternion whose w is positive."""
    signed = rotation[:, 1:] * np.where(rotation[:, :1] < 0, np.float32(-127.5), np.float32(127.5))
    return _byte(signed + np.float32(127.5))


def _pack_rotations(rotation: Array) -> Array:
    largest, others = to_smallest_three(rotation[:, [1, 2, 3, 0]])
    words = largest.astype(np.uint32)
    size = np.minimum(np.rint(np.abs(others) * np.float32(511 / np.sqrt(0.5))), 511).astype(np.uint32)
    size |= np.where(others < 0, np.uint32(512), np.uint32(0))
    for i in range(3):
        words = (words << np.uint32(10)) | size[:, i]
    return words.astype("<u4")


def _pack_harmonics(rest: Array) -> Array:
    """Bytes (n, k, 3) around 128, rounded to few steps, which compress well."""
    stored = np.empty(rest.shape, np.uint8)
    for k in range(rest.shape[1]):  # one at a time: bounds the memory
        step = np.float32(_STEPS[0] if k < 3 else _STEPS[1])
        whole = np.rint(rest[:, k] * np.float32(128)) + 128
        stored[:, k] = np.clip(np.floor((whole + step // 2) / step) * step, 0, 255)
    return stored
