"""The layout of asset files: what tensors members have, and since which version of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .model import BASE_CHANNELS, OPTIONAL_CHANNELS, SURFEL_CHANNELS

#: Newest version of the layout. A reader refuses higher ones, because it cannot know what they mean.
SCHEMA = 5
#: Conventions of all numbers in the file; a file that states others is refused.
CONVENTIONS = {
    "units": "metre",
    "up_axis": "+Z",
    "handedness": "right",
    "colour_space": "linear Rec.709",
    "quaternions": "wxyz",
}
TEXTURES = "textures.safetensors"
#: Its tensors of the optional channels' slots.
_SLOTS = {
    "optional_slots": "I32", "optional_factors": "F32", "optional_transforms": "F32", "optional_extensions": "I32",
}  # fmt: skip
#: member -> tensor -> dtype; names that end in "/" are families (extras of any name).
TENSORS: dict[str, dict[str, str]] = {
    "surfels.safetensors": {
        **dict.fromkeys(("centre", "scale", "rotation", "opacity", *BASE_CHANNELS, "sh", *SURFEL_CHANNELS), "F32"),
        "extras/": "F32",
    },
    "mesh.safetensors": {
        "vertices": "F32",
        "faces": "I32",
        **dict.fromkeys((*BASE_CHANNELS, *OPTIONAL_CHANNELS), "F32"),
        "groups/": "I32",
    },
    "binding.safetensors": {"face": "I32", **dict.fromkeys(("barycentric", "offset", "normal"), "F32")},
    "environment.safetensors": {"radiance": "F32"},
    "source.safetensors": {"index": "I32", "weights": "F32", "count": "I32", "transform": "F32"},
    TEXTURES: {
        "uvs": "F32", "material": "I32", "slots": "I32", "factors": "F32", "transforms": "F32", "extensions": "I32",
        "names": "U8", "normals": "F32", "images/": "U8", **_SLOTS,
    },
}  # fmt: skip
#: (member, tensor) -> the first schema that has it.
SINCE = {
    **{("surfels.safetensors", name): 3 for name in SURFEL_CHANNELS},
    **{("mesh.safetensors", name): 3 for name in OPTIONAL_CHANNELS},
    **{("source.safetensors", name): 2 for name in TENSORS["source.safetensors"]},
    **{(TEXTURES, name): 4 for name in TENSORS[TEXTURES]},
    **{(TEXTURES, name): 5 for name in _SLOTS},
}
OPTIONAL_TENSORS = {
    *[("surfels.safetensors", name) for name in ("sh", *SURFEL_CHANNELS)],
    *[("mesh.safetensors", name) for name in OPTIONAL_CHANNELS],
    ("source.safetensors", "transform"),
    (TEXTURES, "normals"),
    *[(TEXTURES, name) for name in _SLOTS],
}


def lowest_schema(members: Mapping[str, Any]) -> int:
    """The lowest schema that has these members and tensors, so that older versions read what they know."""
    used = [SINCE.get((member, name), 1) for member, entry in members.items() for name in entry["tensors"]]
    return max(used, default=1)
