"""Objects of the last frame and their assets, with what was made of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ..core.arrays import Array
from ..core.asset.model import Asset, PosedSurfels, Surfels
from ..core.errors import AssetError
from ..core.frame import MeshState, ObjectState, RenderSettings
from ..deform.mesh_driven import MeshDriven
from ..render.scene.ray_masks import CAMERA, group_mask
from ..render.scene.trace_scene import TraceObject
from ..render.surfels.captured import CapturedObject
from .captured_objects import Glow, glow_of, glowing_mesh
from .scene_objects import material_faults, traced_object
from .stand_ins import optional_channels, stand_in, tie_only


@dataclass(slots=True)
class LoadedAsset:
    """An asset, the state of the file it is mapped from, and its deformation once it was needed."""

    asset: Asset
    stamp: tuple[int, int, int]
    driven: MeshDriven | None = None
    glow: Glow | None = None

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


@dataclass(slots=True)
class CachedObject:
    """An object as it was in the last frame, and what was made of it.

    One that is shown in captured colours is `captured` for the camera, and for rays `glowing`. One that emits light or
    lets it pass has a `stand_in`, and `emission` (n, 3) of its surfels.
    """

    state: ObjectState
    loaded: LoadedAsset
    traced: TraceObject
    posed: PosedSurfels | None = None
    hidden_count: int = 0
    faults: list[str] = field(default_factory=list)
    mode: tuple[bool, bool, bool] = (False, False, True)
    captured: CapturedObject | None = None
    glowing: MeshState | None = None
    stand_in: MeshState | None = None
    emission: Array | None = None
    channels: dict[str, Array] = field(default_factory=dict)

    @property
    def other_mesh(self) -> MeshState | None:
        """What rays meet instead of the object itself."""
        return self.glowing or self.stand_in

    @property
    def seen_by_mesh(self) -> bool:
        """Whether the camera sees the mesh that stands for it, not its surfels."""
        return self.stand_in is not None and self.stand_in.visibility.camera


def surfel_mask(item: CachedObject) -> int:
    """Which rays meet an object's surfels; where something else stands for it, the camera's at most."""
    mask = group_mask(item.state.visibility, True)
    if item.other_mesh is None:
        return mask
    return 0 if item.glowing is not None or item.seen_by_mesh else mask & CAMERA


def emission_of(objects: Sequence[CachedObject]) -> Array | None:
    """(n, 3) float32 radiance of the surfels of `objects`; None where none emits."""
    if all(item.emission is None for item in objects):
        return None
    given = [item for item in objects if item.posed is not None]
    rows = [np.zeros((len(i.posed or ()), 3), np.float32) if i.emission is None else i.emission for i in given]
    return np.concatenate(rows)


def begun(
    state: ObjectState, loaded: LoadedAsset, mode: tuple[bool, bool, bool], settings: RenderSettings
) -> CachedObject:
    """An object that is new or has changed, without its surfels."""
    met, shown, _ = mode
    item = CachedObject(state, loaded, traced_object(state, loaded.asset, met or shown), mode=mode)
    item.faults = material_faults(state)
    if shown and len(loaded.asset.mesh.faces):
        item.glowing = glowing_mesh(state, item.traced, loaded.glow_of(state.asset))
    if not shown:
        item.channels = optional_channels(state, loaded.asset)
        item.stand_in = stand_in(state, item.traced, item.channels, settings.camera_sees == "mesh")
        if item.stand_in is not None:
            item.traced = tie_only(item.traced)
    return item
