"""SOG, PlayCanvas's splats in pictures, versions 1 and 2: lossless WebP and a meta.json, zipped or side by side.

https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog/. One pixel a splat and picture. What the
pictures declare is checked against the count of splats, and the count against the bytes that are there, before
anything is unpacked.
"""

from __future__ import annotations

import json
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import AssetError
from .files import SurfelFile
from .gaussian_ply import sigmoid
from .gltf_document import is_name
from .images import decode_image
from .packed_splats import decode_arrays
from .quaternions import from_smallest_three
from .splats import Splats

Array = np.ndarray

_ZIP = b"PK\x03\x04"
#: Splats a byte of pictures can stand for, and pixels a splat: beyond that lies damage.
_PER_BYTE, _PER_SPLAT, _SPARE = 1000, 4, 1 << 16
#: Coefficients beyond the first of each degree, and entries of the palette in a row of its picture.
_COEFFICIENTS, _ROW = (0, 3, 8, 15), 64
_LARGEST_META = 1 << 24
_REMEDY = "Export it again, or restore it from a copy"


def sniff_sog(head: bytes, path: Path) -> bool:
    """Whether a file is a zip with such pictures, or a meta.json that names them."""
    if head.startswith(_ZIP):
        return b".webp" in head and (b"means" in head or b"meta.json" in head)
    return head.lstrip().startswith(b"{") and all(word in head for word in (b'"means"', b'"quats"', b'"sh0"'))


def read_sog(path: Path) -> SurfelFile:
    """Read a SOG file: the zip, or the meta.json beside its pictures.

    Raises
    ------
    AssetError
        Something in it is missing or damaged.
    """
    with _Files(path, str(path)) as files:
        return decode_arrays(*_Meta(files, str(path)).values(), path, "SOG")


def sog_splats(path: Path, subject: str) -> Splats:
    """The splats of a SOG file, which errors call `subject`. Raises what `read_sog` does."""
    with _Files(path, subject) as files:
        centre, scale, rotation, opacity, sh = _Meta(files, subject).values()
    with np.errstate(over="ignore"):  # what is not finite is dropped where splats are decoded
        return Splats(centre, np.exp(scale), rotation, opacity, sh)


class _Files:
    """The files of a SOG by name, from its zip or its folder."""

    def __init__(self, path: Path, subject: str) -> None:
        self.path, self.subject = path, subject
        self._zip: zipfile.ZipFile | None = None

    def __enter__(self) -> _Files:
        try:
            if self.path.exists() and not self.path.is_file():
                raise AssetError(self.subject, "is not a regular file", _REMEDY)
            with open(self.path, "rb") as file:
                zipped = file.read(4) == _ZIP
        except OSError as error:
            raise AssetError(self.subject, f"cannot be read ({error.strerror or error})", _REMEDY) from error
        if zipped:
            try:
                self._zip = zipfile.ZipFile(self.path)
            except (zipfile.BadZipFile, ValueError, OverflowError, NotImplementedError, OSError) as error:
                raise AssetError(self.subject, f"is a damaged zip ({error})", _REMEDY) from error
        return self

    def __exit__(self, *_: object) -> None:
        if self._zip is not None:
            self._zip.close()

    def meta(self) -> bytes:
        """The JSON."""
        return self.read("meta.json") if self._zip else self._read_file(self.path)

    def read(self, name: str) -> bytes:
        """A file of the zip, or one beside meta.json."""
        if Path(name).name != name or not is_name(name):
            raise AssetError(self.subject, f"refers to {name[:60]!r}, which is no file beside it", _REMEDY)
        if self._zip is None:
            return self._read_file(self.path.parent / name)
        found = [i for i in self._zip.infolist() if Path(i.filename).name == name]
        if not found:
            raise AssetError(self.subject, f"lacks {name}", _REMEDY)
        if found[0].compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise AssetError(self.subject, f"has a {name} packed in an unknown way", _REMEDY)
        if found[0].file_size > 4 * self.path.stat().st_size + _LARGEST_META:  # pictures are compressed already
            raise AssetError(self.subject, f"has a {name} of {found[0].file_size} bytes", _REMEDY)
        try:
            return self._zip.read(found[0])
        except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError, OSError) as error:
            raise AssetError(self.subject, f"has a damaged {name} ({error})", _REMEDY) from error

    def _read_file(self, path: Path) -> bytes:
        try:
            if path.exists() and not path.is_file():
                raise OSError("not a regular file")
            return path.read_bytes()
        except OSError as error:
            raise AssetError(self.subject, f"needs {path.name}, which cannot be read", "Put it beside") from error


class _Meta:
    """The JSON, checked entry by entry, and the pictures it names."""

    def __init__(self, files: _Files, subject: str) -> None:
        self.subject, self._files = subject, files
        text = files.meta()
        try:
            content = json.loads(text.decode("utf-8-sig")) if len(text) <= _LARGEST_META else None
        except (ValueError, RecursionError) as error:
            raise AssetError(subject, f"has a damaged meta.json ({error})", _REMEDY) from error
        if not isinstance(content, dict):
            raise AssetError(subject, "has a meta.json that is no object", _REMEDY)
        self.json: dict[str, Any] = content
        self.version = self.json.get("version", 1)
        if self.version not in (1, 2):
            raise AssetError(subject, f"is SOG of version {self.version}; 1 and 2 are read", _REMEDY)
        shape = self.entry("means").get("shape")
        count = self.json.get("count") if self.version == 2 else shape[0] if isinstance(shape, list) and shape else None
        if not isinstance(count, int) or isinstance(count, bool) or count < 0:
            raise AssetError(subject, f"has {count!r} for its number of splats", _REMEDY)
        self.count = count
        self._means = [files.read(name) for name in self._names("means", 2)]
        if count > _PER_BYTE * sum(map(len, self._means)) + _SPARE:
            raise AssetError(subject, f"says it has {count} splats, more than its pictures can hold", _REMEDY)

    def entry(self, name: str) -> dict[str, Any]:
        """A top-level object."""
        value = self.json.get(name)
        if not isinstance(value, dict):
            raise AssetError(self.subject, f"has a meta.json without {name}", _REMEDY)
        return value

    def numbers(self, entry: str, key: str, length: int) -> Array:
        """(length,) float32 of a list, or of one number repeated."""
        value = self.entry(entry).get(key)
        values: list[Any] = value if isinstance(value, list) else [value] * length
        good = len(values) == length and all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
        # Compared before they are converted: Python's integers have no end.
        if not good or not all(abs(v) < 1e30 for v in values):
            raise AssetError(self.subject, f"has {entry}.{key} that are not {length} numbers", _REMEDY)
        return np.array(values, np.float64).astype(np.float32)

    def _names(self, entry: str, count: int) -> list[str]:
        names = self.entry(entry).get("files")
        if not isinstance(names, list) or len(names) != count or not all(isinstance(n, str) for n in names):
            raise AssetError(self.subject, f"does not name the {count} pictures of {entry}", _REMEDY)
        return names

    def _picture(self, data: bytes, what: str) -> Array:
        """(h, w, 4) uint8."""
        pixels = decode_image(data, f"{self.subject}, {what}", limit=_PER_SPLAT * self.count + _SPARE)
        if pixels.dtype != np.uint8:
            raise AssetError(self.subject, f"has a picture of {what} that is not of bytes", _REMEDY)
        if pixels.shape[2] == 3:
            pixels = np.concatenate([pixels, np.full((*pixels.shape[:2], 1), 255, np.uint8)], axis=2)
        return pixels

    def _rows(self, data: bytes, what: str) -> Array:
        """(count, 4) uint8: a pixel a splat."""
        pixels = self._picture(data, what).reshape(-1, 4)
        if len(pixels) < self.count:
            raise AssetError(self.subject, f"has {len(pixels)} {what} for {self.count} splats", _REMEDY)
        return pixels[: self.count]

    def _bytes(self, entry: str) -> Array:
        return self._rows(self._files.read(self._names(entry, 1)[0]), entry)

    def _values(self, entry: str, stored: Array) -> Array:
        """Bytes (count, channels) looked up in the codebook (version 2), or between two ends (version 1)."""
        channels = stored.shape[1]
        if self.version == 2:
            return self.numbers(entry, "codebook", 256)[stored]
        low, high = (self.numbers(entry, key, channels) for key in ("mins", "maxs"))
        return low + (high - low) * (stored / np.float32(255))

    def values(self) -> tuple[Array, Array, Array, Array, Array]:
        """Centres, logarithms of scales, rotations wxyz, opacities and harmonics (n, k, 3) of all splats."""
        low, high = (self._rows(data, "means") for data in self._means)
        start, stop = (self.numbers("means", key, 3) for key in ("mins", "maxs"))
        level = (low[:, :3] + high[:, :3].astype(np.uint16) * 256) / np.float32(65535)
        centre = start + (stop - start) * level
        centre = np.sign(centre) * np.expm1(np.abs(centre))
        colour = self._bytes("sh0")
        if self.version == 2:
            dc, opacity = self._values("sh0", colour[:, :3]), colour[:, 3] / np.float32(255)
        else:
            values = self._values("sh0", colour)
            dc, opacity = values[:, :3], sigmoid(values[:, 3])
        rest = self._rest()
        sh = np.empty((self.count, 1 + rest.shape[1], 3), np.float32)
        sh[:, 0], sh[:, 1:] = dc, rest
        scale = self._values("scales", self._bytes("scales")[:, :3])
        return centre, scale, self._rotations(), opacity, sh

    def _rotations(self) -> Array:
        """Smallest three of w, x, y, z; the fourth byte is 252 + the largest, anything else no rotation."""
        stored = self._bytes("quats")
        others = (stored[:, :3] * np.float32(2 / 255) - 1) * np.float32(np.sqrt(0.5))
        known = stored[:, 3] >= 252
        others[~known] = 0
        return from_smallest_three(np.where(known, stored[:, 3], 252) - 252, others)

    def _rest(self) -> Array:
        """(count, k, 3) harmonics beyond the first: rows of a palette."""
        none = np.zeros((self.count, 0, 3), np.float32)
        if self.json.get("shN") is None:
            return none
        centroids, labels = (self._files.read(name) for name in self._names("shN", 2))
        palette = decode_image(centroids, f"{self.subject}, shN", limit=1 << 21)[..., :3]
        k = palette.shape[1] // _ROW
        if k not in _COEFFICIENTS[1:] or palette.shape[1] % _ROW or palette.dtype != np.uint8:
            raise AssetError(self.subject, f"has a palette of harmonics {palette.shape[1]} pixels wide", _REMEDY)
        stored = palette.reshape(-1, k, 3)
        if self.version == 2:
            values = self.numbers("shN", "codebook", 256)[stored]
        else:
            low, high = (self.numbers("shN", key, 1)[0] for key in ("mins", "maxs"))
            values = low + (high - low) * (stored / np.float32(255))
        label = self._rows(labels, "labels")
        index = label[:, 0] + label[:, 1].astype(np.int32) * 256
        known = index < len(values)
        rest = values[np.where(known, index, 0)]
        rest[~known] = 0
        return rest
