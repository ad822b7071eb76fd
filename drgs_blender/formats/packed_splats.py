"""Small containers of 3D splats: ``.splat`` (32 bytes a splat) and PlayCanvas's compressed PLY.

Decoding yields the columns of a 3DGS file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import AssetError
from .files import SurfelFile
from .gaussian_ply import OWN_ALBEDO, OWN_NUMBERS, SH_C0, decode_splats
from .ply import Element, Header, Property, Rows, read_ply
from .quaternions import from_smallest_three

Array = np.ndarray

_SPLAT = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 4), ("rotation", "u1", 4)])
_CHUNK = 256
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def sniff_splat(head: bytes, path: Path) -> bool:
    """Whether the file can be .splat: the format has no signature, so whole records with sensible values must do."""
    records = head[: 64 * _SPLAT.itemsize]
    if path.suffix.lower() != ".splat" or not records or len(records) % _SPLAT.itemsize:
        return False
    table = np.frombuffer(records, _SPLAT)
    return bool(np.isfinite(table["position"]).all() and (table["scale"] >= 0).all())


def read_splat(path: Path) -> SurfelFile:
    """Read a .splat file: linear scales, colours and opacity as bytes, rotations as bytes around 128.

    Raises
    ------
    AssetError
        The file does not consist of whole records.
    """
    data = path.read_bytes()
    if len(data) % _SPLAT.itemsize:
        raise AssetError(str(path), f"is {len(data)} bytes long, no multiple of 32", "Export it again")
    table = np.frombuffer(data, _SPLAT)
    colour = table["colour"].astype(np.float32) / 255.0
    rotation = (table["rotation"].astype(np.float32) - 128.0) / 128.0
    return decode_arrays(
        table["position"], log_scale(table["scale"]), rotation, colour[:, 3], dc_of(colour), path, "splat"
    )


def is_compressed(header: Header) -> bool:
    """Whether a PLY header is that of a compressed splat file."""
    vertex = header.element("vertex")
    return header.element("chunk") is not None and vertex is not None and all(n in vertex for n in _PACKED)


def read_compressed_ply(path: Path) -> SurfelFile:
    """Read a compressed PLY: bit fields inside the bounds of each chunk of 256 splats.

    Raises
    ------
    AssetError
        The file is damaged or lacks bounds.
    """
    _, elements = read_ply(path)
    chunk, vertex = elements["chunk"].columns, elements["vertex"].columns
    count = len(vertex[_PACKED[0]])
    which = np.arange(count) // _CHUNK
    needed = [f"{end}_{name}" for end in ("min", "max") for name in ("x", "y", "z", "scale_x", "scale_y", "scale_z")]
    if any(n not in chunk for n in needed) or len(chunk["min_x"]) * _CHUNK < count:
        raise AssetError(str(path), "lacks the bounds of its chunks", "Export it again")
    if any(vertex[n].dtype.kind != "u" for n in _PACKED):
        raise AssetError(str(path), "has packed values that are not unsigned integers", "Export it again")

    def between(unit: Array, names: tuple[str, str, str]) -> Array:
        low, high = (np.stack([chunk[f"{e}_{n}"][which] for n in names], axis=1) for e in ("min", "max"))
        return low + unit * (high - low)

    position = between(_bits(vertex["packed_position"], (11, 10, 11)), ("x", "y", "z"))
    scale = between(_bits(vertex["packed_scale"], (11, 10, 11)), ("scale_x", "scale_y", "scale_z"))
    colour = _bits(vertex["packed_color"], (8, 8, 8, 8))
    if "min_r" in chunk and "max_b" in chunk:
        colour[:, :3] = between(colour[:, :3], ("r", "g", "b"))
    rotation = _smallest_three(vertex["packed_rotation"])
    sh = _harmonics(dc_of(colour), elements["sh"].columns if "sh" in elements else {}, str(path))
    return decode_arrays(position, scale, rotation, colour[:, 3], sh, path, "compressed PLY")


def _harmonics(dc: Array, columns: dict[str, Array], subject: str) -> Array:
    """`dc` (n, 1, 3) with the higher bands after it: bytes over -4 to 4, all of red, then green, then blue."""
    per_channel = len(columns) // 3
    if per_channel not in (3, 8, 15):
        return dc
    names = [f"f_rest_{i}" for i in range(3 * per_channel)]
    if any(n not in columns or columns[n].dtype != np.uint8 or len(columns[n]) != len(dc) for n in names):
        raise AssetError(subject, "has harmonics that do not fit its splats", "Export it again")
    sh = np.empty((len(dc), 1 + per_channel, 3), np.float32)
    sh[:, :1] = dc
    # The outermost bytes stand for the ends of the range, the others for the middles of equal steps.
    values = ((np.arange(256, dtype=np.float32) + 0.5) / 256 - 0.5) * 8
    values[0], values[255] = -4, 4
    for i, name in enumerate(names):
        sh[:, 1 + i % per_channel, i // per_channel] = values[columns[name]]
    return sh


def _bits(packed: Array, widths: tuple[int, ...]) -> Array:
    """(n, len(widths)) fractions in [0, 1] of bit fields, the highest first."""
    values = packed.astype(np.uint32)
    shift, columns = 32, []
    for width in widths:
        shift -= width
        columns.append(((values >> np.uint32(shift)) & np.uint32((1 << width) - 1)) / ((1 << width) - 1))
    return np.stack(columns, axis=1).astype(np.float32)


def _smallest_three(packed: Array) -> Array:
    """wxyz quaternions: two bits say which component is the largest, ten bits hold each of the others."""
    fields = _bits(packed, (2, 10, 10, 10))
    largest = np.rint(fields[:, 0] * 3).astype(np.int64)
    return from_smallest_three(largest, (fields[:, 1:] - 0.5) * np.sqrt(np.float32(2)))


def log_scale(scale: Array) -> Array:
    """Logarithm of linear scales; -inf and NaN are dealt with where splats are decoded."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log(scale)


def dc_of(colour: Array) -> Array:
    """(n, 1, 3) harmonics of colours (n, 3 or more) in [0, 1] as 3DGS shows them."""
    return ((colour[:, None, :3] - 0.5) / SH_C0).astype(np.float32)


def decode_arrays(
    position: Array,
    scale: Array,
    rotation: Array,
    opacity: Array,
    sh: Array,
    path: Path,
    layout: str,
    materials: tuple[Array, Array, Array] | None = None,
) -> SurfelFile:
    """Give the values the names of a 3DGS file and decode that.

    `scale` is logarithmic, `opacity` in [0, 1], `rotation` wxyz, `sh` (n, k, 3) float32, `materials` albedo (n, 3),
    roughness and metallic in [0, 1].
    """
    clipped = np.clip(opacity.astype(np.float64), 1e-6, 1 - 1e-6)
    columns: dict[str, Array] = {"opacity": np.log(clipped / (1 - clipped)).astype(np.float32)}
    groups: list[tuple[tuple[str, ...], Any]] = [
        (("x", "y", "z"), position),
        (("scale_0", "scale_1", "scale_2"), scale),
        (("rot_0", "rot_1", "rot_2", "rot_3"), rotation),
    ]
    if materials is not None:
        groups += [(OWN_ALBEDO, materials[0]), (OWN_NUMBERS, np.stack(materials[1:], axis=1))]
    for names, values in groups:
        table = np.ascontiguousarray(values, np.float32)
        columns |= {name: table[:, i] for i, name in enumerate(names)}
    element = Element("vertex", len(position), tuple(Property(name, "f4") for name in columns))
    file = decode_splats(Header((element,), "<", 0), Rows(element, columns), str(path), sh)
    if materials is None:  # else the layout is that of splats with materials
        file.layout = layout
    return file
