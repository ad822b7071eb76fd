"""Splats for tests, and files of them damaged at random."""

from __future__ import annotations

import gzip
import struct
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from drgs_blender.core.errors import AssetError
from drgs_blender.formats.registry import read_surfels
from drgs_blender.formats.splats import Splats
from drgs_blender.geometry.normals import rotation_matrices


def random_splats(n: int = 300, coefficients: int = 16, seed: int = 1) -> Splats:
    """Flat splats, third axis shortest, harmonics within what every format holds."""
    rng = np.random.default_rng(seed)
    scale = np.exp(rng.uniform(-6, -1, (n, 3))).astype(np.float32)
    scale[:, 2] = 0.05 * scale[:, :2].min(axis=1)
    rotation = rng.normal(size=(n, 4))
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    return Splats(
        rng.uniform(-3, 3, (n, 3)).astype(np.float32),
        scale,
        rotation.astype(np.float32),
        rng.uniform(0.02, 0.98, n).astype(np.float32),
        rng.uniform(-0.9, 0.9, (n, coefficients, 3)).astype(np.float32),
    )


def covariance(rotation: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """(n, 3, 3) covariances of surfels (two scales) or splats (three)."""
    axes = rotation_matrices(rotation.astype(np.float64))[..., : scale.shape[1]] * scale[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def spz_blocks(data: bytes) -> list[bytes]:
    """The attributes of an SPZ file of version 4."""
    import zstandard

    start, blocks = struct.unpack_from("<I", data, 16)[0], []
    position = start + 16 * data[15]
    for i in range(data[15]):
        stored, _ = struct.unpack_from("<QQ", data, start + 16 * i)
        blocks.append(zstandard.decompress(data[position : position + stored]))
        position += stored
    return blocks


def build_spz(like: bytes, blocks: Sequence[bytes]) -> bytes:
    """An SPZ file of version 4 with the header of `like`, these attributes, and a table that fits them."""
    import zstandard

    frames = [zstandard.compress(block) for block in blocks]
    table = [struct.pack("<QQ", len(frame), len(block)) for frame, block in zip(frames, blocks)]
    return like[:16] + struct.pack("<I12x", 32) + b"".join([*table, *frames])


def old_spz(data: bytes, version: int) -> bytes:
    """An SPZ file of version 4 as one of version 2 or 3: one gzip stream; rotations of version 2 are other ones."""
    blocks = spz_blocks(data)
    if version == 2:
        blocks[4] = blocks[4][: 3 * (len(blocks[4]) // 4)]
    return gzip.compress(data[:4] + struct.pack("<I", version) + data[8:15] + b"\0" + b"".join(blocks), 1, mtime=0)


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """`data` cut off, or with a few other bytes, mostly near its start where headers are."""
    kind = rng.integers(3)
    if kind == 0:
        return data[: rng.integers(len(data))]
    changed = bytearray(data)
    for _ in range(rng.integers(1, 6)):
        changed[rng.integers(min(len(data), 200 if kind == 1 else len(data)))] = rng.integers(256)
    return bytes(changed)


def refusals(path: Path, data: bytes, rounds: int, damage: Callable[..., bytes] = damaged) -> int:
    """How many of `rounds` damaged copies are refused; the others must be read as finite numbers."""
    rng = np.random.default_rng(5)
    refused = 0
    for _ in range(rounds):
        path.write_bytes(damage(data, rng))
        try:
            surfels = read_surfels(path).surfels
        except AssetError as error:
            assert str(path) in str(error)
            refused += 1
        else:
            assert np.isfinite(surfels.centre).all() and np.isfinite(surfels.scale).all()
            assert len(surfels) <= 4 * len(data) + 65536
    return refused
