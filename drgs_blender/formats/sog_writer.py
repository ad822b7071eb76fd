"""SOG, version 2, written: a zip of lossless WebP pictures and meta.json; see `sog` for the layout."""

from __future__ import annotations

import io
import json
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as Pillow

from ..core.asset.archive import replace_file
from ..core.errors import UsageError
from ..core.version import __version__
from .palette import codebook, palette
from .quaternions import to_smallest_three
from .splats import Splats, writable

Array = np.ndarray

#: Entries of the palette of harmonics, and how many stand in a row of its picture.
_PALETTE, _ROW = 1 << 16, 64
#: Largest harmonic: one brighter splat would take the code words that all others need.
_BRIGHTEST = np.float32(100)
#: Largest side of a WebP picture.
_LARGEST = 16383
#: Bits a coordinate of the order in which splats are written: neighbours in space are neighbours in the pictures.
_BITS = 10


def write_sog(path: Path, splats: Splats) -> None:
    """Write `splats`, in the axes they have, sorted by place so that the pictures pack well.

    Raises
    ------
    UsageError
        There are none, or more than a picture has room for.
    AssetError
        See `splats.writable`.
    WriteError
        The file cannot be written.
    """
    n = len(splats)
    if not 0 < n <= _LARGEST * _LARGEST:
        raise UsageError(str(path), f"cannot hold {n} splats", "Choose another format")
    splats = writable(splats, str(path))
    harmonics = splats.sh.clip(-_BRIGHTEST, _BRIGHTEST)
    level, low, high = _means(splats.centre)
    order = _neighbours(level)

    def rows(values: Array, last: Array | int = 255) -> Array:
        """(n, 4) bytes in the order of the file."""
        pixels = np.zeros((n, 4), np.uint8)
        pixels[:, : values.shape[1]] = values[order]
        pixels[:, 3] = last if isinstance(last, int) else last[order]
        return pixels

    with ThreadPoolExecutor(2) as threads:
        jobs = {}

        def picture(name: str, pixels: Array) -> str:
            jobs[f"{name}.webp"] = threads.submit(_webp, pixels)
            return f"{name}.webp"

        means = [picture("means_l", rows(level & 255)), picture("means_u", rows(level >> 8))]
        largest, others = to_smallest_three(splats.rotation)
        quats = picture("quats", rows(_byte(others * np.sqrt(0.5) + 0.5), (252 + largest).astype(np.uint8)))
        sizes, scale = codebook(np.log(splats.scale))
        colours, dc = codebook(harmonics[:, 0])
        meta: dict[str, Any] = {
            "version": 2,
            "asset": {"generator": f"DR-GS {__version__}"},
            "count": n,
            "antialias": False,
            "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": means},
            "scales": {"codebook": sizes.tolist(), "files": [picture("scales", rows(scale))]},
            "quats": {"files": [quats]},
            "sh0": {"codebook": colours.tolist(), "files": [picture("sh0", rows(dc, _byte(splats.opacity)))]},
        }
        if splats.sh.shape[1] > 1:
            entries, index = palette(harmonics.reshape(n, -1)[:, 3:], _PALETTE)
            steps, stored = codebook(entries)
            label = np.stack([index & 255, index >> 8], axis=1)
            meta["shN"] = {
                "count": len(entries),
                "bands": {4: 1, 9: 2, 16: 3}[splats.sh.shape[1]],
                "codebook": steps.tolist(),
                "files": [
                    picture("shN_centroids", _table(stored.reshape(len(entries), -1, 3))),
                    picture("shN_labels", rows(label)),
                ],
            }
        files = {name: job.result() for name, job in jobs.items()}
    files["meta.json"] = json.dumps(meta, separators=(",", ":"), allow_nan=False).encode()
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name), content)  # of 1980: the same splats give the same bytes
    replace_file(path, [data.getbuffer()])


def _means(centre: Array) -> tuple[Array, Array, Array]:
    """Positions as (n, 3) uint16 between the ends (3,) and (3,) of sign(x) log(1 + |x|)."""
    logs = np.copysign(np.log1p(np.abs(centre)), centre)
    low, high = logs.min(axis=0), logs.max(axis=0)
    span = np.where(high > low, high - low, 1)
    return np.rint((logs - low) * (np.float32(65535) / span)).astype(np.uint16), low, high


def _neighbours(level: Array) -> Array:
    """The order of splats along a curve through space (Morton, 1966), from (n, 3) uint16."""
    code = np.zeros(len(level), np.uint32)
    for axis in range(3):
        part = (level[:, axis] >> (16 - _BITS)).astype(np.uint32)
        for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
            part = (part | (part << np.uint32(shift))) & np.uint32(mask)
        code |= part << np.uint32(axis)
    return np.argsort(code, kind="stable")


def _byte(values: Array) -> Array:
    return np.clip(np.rint(values * np.float32(255)), 0, 255).astype(np.uint8)


def _table(entries: Array) -> Array:
    """The picture of a palette (k, c, 3): `_ROW` entries a row, c pixels each."""
    k, width = entries.shape[:2]
    pixels = np.zeros((-(-k // _ROW) * _ROW, width, 4), np.uint8)
    pixels[:k, :, :3], pixels[..., 3] = entries, 255
    return pixels.reshape(-1, _ROW * width, 4)


def _webp(pixels: Array) -> bytes:
    """A lossless picture of (h, w, 4) bytes, or of (n, 4) in the squarest rectangle that holds them."""
    if pixels.ndim == 2:
        width = int(np.ceil(np.sqrt(len(pixels))))
        height = -(-len(pixels) // width)
        pixels = np.pad(pixels, ((0, width * height - len(pixels)), (0, 0))).reshape(height, width, 4)
    data = io.BytesIO()
    Pillow.fromarray(pixels).save(data, "WEBP", lossless=True, exact=True, method=0, quality=50)
    return data.getvalue()
