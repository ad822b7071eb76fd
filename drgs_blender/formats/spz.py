"""SPZ, Niantic's compressed splats, versions 2 to 4: https://github.com/nianticlabs/spz (README, "File Format").

A header, then one block of bytes an attribute: all in one gzip stream (2 and 3), or each in a Zstandard frame (4).
The header is checked against the size of the file before anything is unpacked, so memory stays in proportion.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from types import ModuleType

import numpy as np

from ..core.errors import AssetError, DeviceError
from ..core.file_types import SPZ_VERSIONS
from .files import SurfelFile
from .packed_splats import decode_arrays
from .quaternions import from_smallest_three
from .splats import Splats

Array = np.ndarray

MAGIC = b"NGSP"
_GZIP = b"\x1f\x8b"
HEADER, TABLE = struct.Struct("<4sIIBBBB"), struct.Struct("<QQ")
HEADER_4 = 32
#: Attributes of a splat in file order: positions, opacities, colours, scales, rotations; then the harmonics.
_BYTES = (9, 1, 3, 3, 4)
_HARMONICS = (0, 9, 24, 45, 72)
#: Harmonics of the fixed part of the colour are stored as 0.5 + 0.15 dc, to hold a little more than [0, 1].
COLOUR = 0.15
#: No honest file is more compressed than this: numbers of captured splats look like noise. Deflate reaches 1032.
_RATIO = 128
_STEPS_OF_128 = (np.arange(256, dtype=np.float32) - 128) / 128
#: The axes that an extension can name, from code 1: where X, Y and Z point (left, right, down, up, back, front).
_AXES = (
    *("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF"),
    *("LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU"),
)
_AXES_RECORD = 0xADBE0001
_EXTENSIONS = 2
_REMEDY = "Export it again, or restore it from a copy"


def sniff_spz(head: bytes, path: Path) -> bool:
    """Whether a file starts as SPZ does; of gzip only the first bytes are unpacked."""
    if head.startswith(_GZIP):
        try:
            head = zlib.decompressobj(31).decompress(head[:4096], 4)
        except zlib.error:
            return False
    return head.startswith(MAGIC)


def read_spz(path: Path) -> SurfelFile:
    """Read an SPZ file. Axes as in the file: Y up unless an extension says otherwise.

    Raises
    ------
    AssetError
        The file is damaged, or of a version or in axes that are not understood.
    DeviceError
        Version 4 without the package zstandard.
    """
    packed = _unpack(path.read_bytes(), str(path))
    file = decode_arrays(*_values(packed), path, "SPZ")
    file.up = packed.up
    return file


def spz_splats(data: bytes, subject: str) -> tuple[Splats, str]:
    """The splats in the bytes of an SPZ file, in its axes, and its up axis. Raises what `read_spz` does."""
    packed = _unpack(data, subject)
    centre, scale, rotation, opacity, sh = _values(packed)
    return Splats(centre, np.exp(scale), rotation, opacity, sh), packed.up


class _Packed:
    """Attributes as they are stored, and what the header says of them."""

    def __init__(self, version: int, count: int, degree: int, fraction: int, up: str = "y") -> None:
        self.version, self.count, self.degree, self.fraction, self.up = version, count, degree, fraction, up
        self.sizes = [count * width for width in (*_BYTES[:4], 3 if version < 3 else 4, _HARMONICS[degree])]
        self.blocks: list[bytes | memoryview] = []


def _unpack(data: bytes, subject: str) -> _Packed:
    if data.startswith(_GZIP):
        return _unpack_gzip(data, subject)
    if len(data) >= 8 and struct.unpack_from("<I", data, 4)[0] >= 4:
        return _unpack_zstd(data, subject)
    return _split(data, _header(data, len(data) * _RATIO, subject), subject)


def _header(data: bytes, limit: int, subject: str) -> _Packed:
    """What the header says; `limit` is the most bytes the attributes can have."""
    if len(data) < HEADER.size:
        raise AssetError(subject, "is truncated within its header", _REMEDY)
    magic, version, count, degree, fraction, _, _ = HEADER.unpack_from(data)
    if magic != MAGIC:
        raise AssetError(subject, "is no SPZ file", _REMEDY)
    if version not in SPZ_VERSIONS:
        raise AssetError(subject, f"is of SPZ version {version}; 2, 3 and 4 are understood", _REMEDY)
    if degree >= len(_HARMONICS) or fraction > 30:
        raise AssetError(subject, f"has harmonics of degree {degree} and {fraction} fractional bits", _REMEDY)
    packed = _Packed(version, count, degree, fraction)
    if sum(packed.sizes) > limit:
        raise AssetError(subject, f"says it has {count} splats, more than its {len(data)} bytes can hold", _REMEDY)
    return packed


def _split(data: bytes, packed: _Packed, subject: str) -> _Packed:
    """Versions 2 and 3: the attributes lie one after the other behind the header."""
    if len(data) < HEADER.size + sum(packed.sizes):
        raise AssetError(subject, f"is truncated: {packed.count} splats need {sum(packed.sizes)} bytes", _REMEDY)
    position = HEADER.size
    view = memoryview(data)
    for size in packed.sizes:
        packed.blocks.append(view[position : position + size])
        position += size
    return packed


def _unpack_gzip(data: bytes, subject: str) -> _Packed:
    stream = zlib.decompressobj(31)
    try:
        start = stream.decompress(data, HEADER.size)
        packed = _header(start, len(data) * _RATIO, subject)
        wanted = sum(packed.sizes)
        rest = stream.decompress(stream.unconsumed_tail, wanted) if wanted else b""
    except zlib.error as error:
        raise AssetError(subject, f"is damaged ({error})", _REMEDY) from error
    return _split(start + rest, packed, subject)


def _unpack_zstd(data: bytes, subject: str) -> _Packed:
    zstandard = zstandard_library(subject)
    packed = _header(data, len(data) * _RATIO, subject)
    table = struct.unpack_from("<I", data, 16)[0] if len(data) >= HEADER_4 else 0
    wanted = packed.sizes if packed.degree else packed.sizes[:-1]
    position = table + len(wanted) * TABLE.size
    if data[15] != len(wanted) or table < HEADER_4 or position > len(data):
        raise AssetError(subject, "has a damaged table of contents", _REMEDY)
    if data[14] & _EXTENSIONS:
        packed.up = _up_axis(data[HEADER_4:table], subject)
    unpacker = zstandard.ZstdDecompressor(max_window_size=1 << 27)
    for i, size in enumerate(wanted):
        stored, length = TABLE.unpack_from(data, table + i * TABLE.size)
        frame = memoryview(data)[position : position + stored]
        if length != size or len(frame) != stored:
            raise AssetError(subject, "has a table of contents that does not fit its splats", _REMEDY)
        try:
            # The frame says its length too, and what it says is allocated.
            if size and zstandard.get_frame_parameters(frame).content_size not in (size, 2**64 - 1):
                raise AssetError(subject, "has an attribute of another length than it says", _REMEDY)
            block = unpacker.decompress(frame, max_output_size=size) if size else b""
        except zstandard.ZstdError as error:
            raise AssetError(subject, f"is damaged ({error})", _REMEDY) from error
        if len(block) != size:
            raise AssetError(subject, "has an attribute that is too short", _REMEDY)
        packed.blocks.append(block)
        position += stored
    packed.blocks += [b""] * (len(packed.sizes) - len(packed.blocks))
    return packed


def _up_axis(records: bytes, subject: str) -> str:
    """The up axis that the extension SPZ_ADOBE_coordinate_system names, else Y; other extensions say nothing of use."""
    position = 0
    while position + 8 <= len(records):
        kind, length = struct.unpack_from("<II", records, position)
        if kind == _AXES_RECORD and length >= 4 and position + 12 <= len(records):
            code = struct.unpack_from("<I", records, position + 8)[0]
            if not 1 <= code <= len(_AXES):
                break
            axes = _AXES[code - 1]
            reference = "RUB" if axes[1] in "UD" else "RFU"
            if sum(a != b for a, b in zip(axes, reference, strict=True)) % 2:
                raise AssetError(subject, f"is in the left-handed axes {axes}", "Export it in RUB, SPZ's own axes")
            return ("-" if "D" in axes else "") + ("y" if axes[1] in "UD" else "z")
        position += 8 + length
    return "y"


def _values(packed: _Packed) -> tuple[Array, Array, Array, Array, Array]:
    """Centres, logarithms of scales, rotations wxyz, opacities and harmonics (n, k, 3)."""
    n, (positions, opacities, colours, scales, rotations, harmonics) = packed.count, map(_array, packed.blocks)
    words = np.zeros((n * 3, 4), np.uint8)
    words[:, 1:] = positions.reshape(-1, 3)  # the sign is in the highest byte
    centre = ((words.view("<i4") >> 8).astype(np.float32) * np.float32(2.0**-packed.fraction)).reshape(n, 3)
    per_channel = _HARMONICS[packed.degree] // 3
    sh = np.empty((n, 1 + per_channel, 3), np.float32)
    sh[:, 0] = (colours.reshape(n, 3) / np.float32(255) - np.float32(0.5)) / np.float32(COLOUR)
    sh[:, 1:] = _STEPS_OF_128[harmonics.reshape(n, per_channel, 3)]
    rotation = _first_three(rotations) if packed.version < 3 else _smallest_three(rotations)
    scale = scales.reshape(n, 3) / np.float32(16) - np.float32(10)
    return centre, scale, rotation, opacities / np.float32(255), sh


def _array(block: bytes | memoryview) -> Array:
    return np.frombuffer(block, np.uint8)


def _first_three(stored: Array) -> Array:
    """Version 2: x, y, z as bytes, w is positive."""
    xyz = stored.reshape(-1, 3) / np.float32(127.5) - np.float32(1)
    w = np.sqrt(np.maximum(1 - np.square(xyz).sum(axis=1, keepdims=True), 0))
    return np.concatenate([w, xyz], axis=1)


def _smallest_three(stored: Array) -> Array:
    """Versions 3 and 4: two bits for the largest of x, y, z, w, then sign and nine bits of each of the others."""
    words = stored.view("<u4")
    others = np.empty((len(words), 3), np.float32)
    for i in range(3):
        field = words >> np.uint32(10 * (2 - i))
        others[:, i] = (field & np.uint32(511)) * np.float32(np.sqrt(0.5) / 511)
        others[:, i] *= np.where(field & np.uint32(512), np.float32(-1), np.float32(1))
    return from_smallest_three(words >> np.uint32(30), others)[:, [3, 0, 1, 2]]


def zstandard_library(subject: str) -> ModuleType:
    try:
        import zstandard
    except ImportError as error:
        raise DeviceError(subject, "needs the package zstandard", "Install it: pip install zstandard") from error
    return zstandard
