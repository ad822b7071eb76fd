"""Checks of a binary USD file before usd-core, which trusts every number in it, takes memory for it.

Layout of crate files after OpenUSD, pxr/usd/sdf/crateFile.h.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from ..core.errors import AssetError

_MAGIC = b"PXR-USDC"
_SHORTEST = 88
#: Sections that begin with the number of their entries. Those are compressed, but a scene has no more of them than this
#: for each of its bytes: vertices, splats and all else that is large are values, and not entries.
_COUNTED = (b"TOKENS", b"STRINGS", b"FIELDS", b"FIELDSETS", b"PATHS", b"SPECS")
_ENTRIES_A_BYTE, _ENTRIES = 1, 1024
#: Most that LZ4 gains.
_LZ4 = 255


def check_crate(path: Path) -> None:
    """Refuse a binary USD file, or a zip that begins with one, whose tables are larger than it can hold.

    Raises
    ------
    AssetError
    """
    if path.stat().st_size < _SHORTEST:
        return
    data = np.memmap(path, np.uint8, "r").data
    if data[:4] == b"PK\x03\x04":
        name, extra = struct.unpack_from("<2H", data, 26)
        data = data[30 + name + extra :]
    if len(data) < _SHORTEST or data[:8] != _MAGIC:
        return
    size = len(data)
    try:
        (toc,) = struct.unpack_from("<q", data, 16)
        (count,) = struct.unpack_from("<Q", data, toc)
        sections = [struct.unpack_from("<16sqq", data, toc + 8 + 32 * k) for k in range(min(count, 64))]
        for name, start, length in sections:
            name = name.rstrip(b"\0")
            if not 0 <= start <= start + length <= size:
                raise AssetError(str(path), f"has a section {name!r} that does not lie in it", "Export it again")
            if name in _COUNTED:
                (entries,) = struct.unpack_from("<Q", data, start)
                large = entries > _ENTRIES_A_BYTE * size + _ENTRIES
                if name == b"TOKENS":
                    large |= struct.unpack_from("<Q", data, start + 8)[0] > _LZ4 * length + _ENTRIES
                if large:
                    problem = f"declares {entries} entries of {name.decode()} in {size} bytes"
                    raise AssetError(str(path), problem, "Export it again")
    except struct.error as error:
        raise AssetError(str(path), "is cut short", "Export it again") from error
