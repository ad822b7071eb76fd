"""Assets that a session has loaded, and what is made of each when an object first needs it."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..core.asset.model import Asset, Surfels
from ..core.errors import AssetError
from ..core.frame import ObjectState
from ..deform.mesh_driven import MeshDriven
from .asset_textures import TexturedAsset
from .captured_objects import Glow, glow_of


@dataclass(slots=True)
class LoadedAsset:
    """An asset and the state of the file it is mapped from.

    Attributes
    ----------
    driven : MeshDriven, optional
        Its deformation.
    glow : Glow, optional
        What it emits in captured colours.
    textured : TexturedAsset, optional
        Its textures.
    faults : list of str
        What of the file could not be used.
    """

    asset: Asset
    stamp: tuple[int, int, int]
    driven: MeshDriven | None = None
    glow: Glow | None = None
    textured: TexturedAsset | None = None
    faults: list[str] = field(default_factory=list)

    def surfels_of(self, state: ObjectState) -> MeshDriven | Surfels:
        """The deformation of the asset's surfels, made when an object first needs it; the surfels without a mesh."""
        if not len(self.asset.mesh.faces):
            return self.asset.surfels
        if self.driven is None:
            asset = self.asset
            if asset.binding is None:
                problem = f"the surfels of {state.asset} are not bound to its mesh"
                raise AssetError(f"object {state.name}", problem, "Bind them, or set Camera Sees to Mesh")
            self.driven = MeshDriven(asset.mesh, asset.surfels, asset.binding)
        return self.driven

    def glow_of(self, key: str) -> Glow:
        """What its faces emit in captured colours, made when an object first needs it."""
        if self.glow is None:
            self.glow = glow_of(self.asset, key)
        return self.glow

    def textured_of(self, key: str) -> TexturedAsset:
        """Its textures, decoded when an object first needs them."""
        if self.textured is None:
            self.textured = TexturedAsset(self.asset, key)
        return self.textured
