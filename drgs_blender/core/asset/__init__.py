"""The data of a DR-GS asset, and its container file."""

from .model import (
    BASE_CHANNELS,
    MATERIAL_CHANNELS,
    OPTIONAL_CHANNELS,
    Asset,
    Binding,
    Environment,
    Mesh,
    PosedSurfels,
    Surfels,
)

__all__ = [
    "BASE_CHANNELS",
    "MATERIAL_CHANNELS",
    "OPTIONAL_CHANNELS",
    "Asset",
    "Binding",
    "Environment",
    "Mesh",
    "PosedSurfels",
    "Surfels",
]
