"""The data of a DR-GS asset, and its container file."""

from .model import MATERIAL_CHANNELS, Asset, Binding, Environment, Mesh, PosedSurfels, Surfels

__all__ = ["MATERIAL_CHANNELS", "Asset", "Binding", "Environment", "Mesh", "PosedSurfels", "Surfels"]
