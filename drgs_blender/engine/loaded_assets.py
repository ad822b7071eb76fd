"""Assets that a session has loaded, and what is made of each when an object first needs it."""

from __future__ import annotations

from dataclasses import dataclass, field

from ..compute.threads import checkpoint
from ..core.asset.model import Asset, Surfels
from ..core.asset.part import with_surfels
from ..core.errors import AssetError
from ..core.frame import ObjectState
from ..core.level_of_detail import Detail
from ..deform.mesh_driven import MeshDriven
from .asset_textures import PixelsOf, TexturedAsset
from .captured_objects import Glow, glow_of

#: Surfels of the first level of detail that is made of an asset; others are its beginnings.
_AT_FIRST = 1 << 17


@dataclass(slots=True, weakref_slot=True)
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
    painting : int
        Number of the images painted over its own, unlike those of other objects of the file; 0: none are.
    pixels_of : callable, optional
        Gives the pixels of image files that need not be decoded, as `TexturedAsset.pixels_of`.
    levels : dict of int to LoadedAsset
        Its most needed surfels by their number, see `first`.
    larger : LoadedAsset, optional
        The level whose first surfels these are.
    """

    asset: Asset
    stamp: tuple[int, int, int]
    driven: MeshDriven | None = None
    glow: Glow | None = None
    textured: TexturedAsset | None = None
    faults: list[str] = field(default_factory=list)
    painting: int = 0
    pixels_of: PixelsOf | None = None
    levels: dict[int, LoadedAsset] = field(default_factory=dict)
    larger: LoadedAsset | None = None
    _detail: Detail | None = None

    def forget(self) -> None:
        """Give back what was made of the asset, which no object of the frame has."""
        self.driven = self.glow = self.textured = None
        self.levels.clear()

    @property
    def detail(self) -> Detail:
        """The order in which its surfels are needed, found once."""
        if self._detail is None:
            self._detail = Detail.of(self.asset.surfels, checkpoint)
        return self._detail

    def first(self, count: int) -> LoadedAsset:
        """The asset of its `count` most needed surfels, in that order and of their own size."""
        if count not in self.levels:
            largest = max(self.levels, default=0)
            if count > largest:
                self.levels.clear()
                largest = min(max(count, _AT_FIRST), len(self.asset.surfels))
                order = self.detail.order[:largest]
                self.levels[largest] = LoadedAsset(with_surfels(self.asset, order), self.stamp, painting=self.painting)
            if count < largest:
                whole = self.levels[largest]
                if whole.driven is None and whole.asset.binding is not None and len(whole.asset.mesh.faces):
                    whole.driven = MeshDriven(whole.asset.mesh, whole.asset.surfels, whole.asset.binding)
                some = slice(count)
                few = LoadedAsset(with_surfels(whole.asset, some), self.stamp, painting=self.painting, larger=whole)
                few.driven = None if whole.driven is None else whole.driven.first(count)
                self.levels[count] = few
        return self.levels[count]

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
            name = f"{key} (painting {self.painting})" if self.painting else key
            self.textured = TexturedAsset(self.asset, name, self.pixels_of)
        return self.textured
