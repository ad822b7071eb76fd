"""Radiance HDR pictures (RGBE), both run-length encodings (G. Ward, "Real Pixels", Graphics Gems II)."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ..compute.jit import njit
from ..core.errors import AssetError

Array = np.ndarray

PIXEL_LIMIT = 1 << 27
_DAMAGED = "Download or export the file again"


def read_hdr(path: Path) -> tuple[Array, dict[str, str]]:
    """((h, w, 3) float32 radiance, row 0 at the top; header variables).

    Raises
    ------
    AssetError
        The header is not understood or the data are truncated or damaged.
    """
    subject = str(path)
    data = path.read_bytes()
    match = re.search(rb"\n\r?\n([+-][XY]) (\d{1,12}) ([+-][XY]) (\d{1,12})\n", data[: 1 << 16].replace(b"\r\n", b"\n"))
    if not data.startswith((b"#?RADIANCE", b"#?RGBE", b"#?")) or match is None:
        raise AssetError(subject, "has no complete Radiance header", _DAMAGED)
    text = data[: match.start()].decode("latin-1")
    variables = dict(line.split("=", 1) for line in text.split("\n") if "=" in line)
    rows, height, columns, width = match[1].decode(), int(match[2]), match[3].decode(), int(match[4])
    if {rows[1], columns[1]} != {"X", "Y"} or not 0 < width * height <= PIXEL_LIMIT:
        raise AssetError(subject, f"has the size line {match[0].strip().decode()!r}, which is not possible", _DAMAGED)
    if "rle_rgbe" not in variables.get("FORMAT", "32-bit_rle_rgbe") and "xyze" not in variables["FORMAT"]:
        raise AssetError(subject, f"has the unknown format {variables['FORMAT']}", _DAMAGED)
    start = data.index(match[0].strip()) + len(match[0].strip()) + 1
    if height * width > 128 * (len(data) - start):  # a run stands for 127 values in 2 bytes; old runs for more, rarely
        raise AssetError(subject, "is truncated", _DAMAGED)
    rgbe = np.zeros((height, width, 4), np.uint8)
    if not _decode(np.frombuffer(data, np.uint8), start, rgbe):
        raise AssetError(subject, "is truncated or damaged", _DAMAGED)
    image = _to_float(rgbe)
    if rows[1] == "X":  # columns come first
        image = image.swapaxes(0, 1)
        rows, columns = columns, rows
    if rows[0] == "+":
        image = image[::-1]
    if columns[0] == "-":
        image = image[:, ::-1]
    return np.ascontiguousarray(image), variables


@njit
def _decode(data: Array, position: int, rgbe: Array) -> bool:
    """Fill `rgbe` from the bytes at `position`; False where they end too soon or make no sense."""
    height, width = rgbe.shape[:2]
    size = len(data)
    for y in range(height):
        if position + 4 > size:
            return False
        new = data[position] == 2 and data[position + 1] == 2 and data[position + 2] < 128 and 8 <= width < 32768
        if new:
            if data[position + 2] * 256 + data[position + 3] != width:
                return False
            position += 4
            for channel in range(4):
                x = 0
                while x < width:
                    if position + 2 > size:
                        return False
                    count = int(data[position])
                    if count > 128:
                        count -= 128
                        if x + count > width:
                            return False
                        for _ in range(count):
                            rgbe[y, x, channel] = data[position + 1]
                            x += 1
                        position += 2
                    else:
                        if count == 0 or x + count > width or position + 1 + count > size:
                            return False
                        for k in range(count):
                            rgbe[y, x, channel] = data[position + 1 + k]
                            x += 1
                        position += 1 + count
        else:
            x = 0
            shift = 0
            while x < width:
                if position + 4 > size:
                    return False
                if data[position] == 1 and data[position + 1] == 1 and data[position + 2] == 1:
                    if shift > 16 or x == 0:
                        return False
                    count = int(data[position + 3]) << shift
                    if x + count > width:
                        return False
                    for _ in range(count):
                        rgbe[y, x] = rgbe[y, x - 1]
                        x += 1
                    shift += 8
                else:
                    for channel in range(4):
                        rgbe[y, x, channel] = data[position + channel]
                    x += 1
                    shift = 0
                position += 4
    return True


def _to_float(rgbe: Array) -> Array:
    """RGBE to float32: mantissas are fractions of 256, the exponent has a bias of 128; exponent 0 is black."""
    exponent = rgbe[..., 3].astype(np.int32)
    scale = np.where(exponent > 0, np.ldexp(np.float32(1), exponent - 136), np.float32(0)).astype(np.float32)
    return rgbe[..., :3].astype(np.float32) * scale[..., None]
