"""Cryptomatte: the hash of names to IDs, and the manifest by which readers of a file find the names again.

A name is a number, the MurmurHash3 of its UTF-8 text read as float32 (Friedman and Jones 2015).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable

import numpy as np

from .frame import Frame

Array = np.ndarray

#: Kind of ID -> prefix of its passes.
KINDS = {"object": "CryptoObject", "material": "CryptoMaterial"}
#: The material of DR-GS objects, as Blender's add-on names it.
DRGS_MATERIAL = "DR-GS"
#: How the names of a file's metadata begin that every reader of Cryptomatte knows.
METADATA = "cryptomatte/"
_MASK = 0xFFFFFFFF


def name_hash(name: str) -> int:
    """MurmurHash3_x86_32 of a name, seed 0, with an exponent that no special float32 has."""
    data = name.encode(errors="surrogateescape")
    value, whole = 0, len(data) // 4 * 4
    for (k,) in struct.iter_unpack("<I", data[:whole]):
        value ^= _scrambled(k)
        value = ((value << 13 | value >> 19) * 5 + 0xE6546B64) & _MASK
    value ^= _scrambled(int.from_bytes(data[whole:], "little")) ^ len(data)
    value = ((value ^ value >> 16) * 0x85EBCA6B) & _MASK
    value = ((value ^ value >> 13) * 0xC2B2AE35) & _MASK
    value ^= value >> 16
    return value ^ (1 << 23) if (value >> 23 & 0xFF) in (0, 0xFF) else value


def _scrambled(k: int) -> int:
    k = k * 0xCC9E2D51 & _MASK
    return (k << 15 | k >> 17) * 0x1B873593 & _MASK


def identities(names: list[str]) -> Array:
    """(n,) float32 number of each name."""
    return np.array([name_hash(name) for name in names], np.uint32).view(np.float32)


def metadata(frame: Frame, layer: str = "") -> dict[str, str]:
    """Metadata of a file with the Cryptomatte passes of `frame`.

    Parameters
    ----------
    frame : Frame
    layer : str
        Prefix of the pass names in the file, with its dot.
    """
    names: dict[str, Iterable[str]] = {
        "object": [*(item.name for item in frame.objects), *(mesh.name for mesh in frame.meshes)],
        "material": [*(m.name for mesh in frame.meshes for m in mesh.materials), DRGS_MATERIAL],
    }
    said = {}
    for kind, name in KINDS.items():
        if f"{name}00" in frame.passes:
            prefix = f"{METADATA}{f'{name_hash(layer + name):08x}'[:7]}/"
            numbers = {known: f"{name_hash(known):08x}" for known in names[kind]}
            said[f"{prefix}name"] = layer + name
            said[f"{prefix}hash"] = "MurmurHash3_32"
            said[f"{prefix}conversion"] = "uint32_to_float32"
            said[f"{prefix}manifest"] = json.dumps(numbers, separators=(",", ":"))
    return said
