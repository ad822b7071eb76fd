"""Objects of the last frame, with what was made of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..core.arrays import Array
from ..core.asset.model import PosedSurfels
from ..core.frame import MeshState, ObjectState, Pose
from ..core.level_of_detail import Detail
from ..core.materials import Image
from ..deform.closed_matter import ClosedMatter
from ..render.scene.ray_masks import CAMERA, group_mask
from ..render.scene.trace_scene import ObjectMesh, TraceObject
from ..render.surfels.captured import CapturedObject
from .broken_matter import crack_meshes
from .captured_objects import glowing_mesh
from .loaded_assets import LoadedAsset
from .object_meshes import channels_of, object_mesh, stub
from .optional_channels import optional_channels
from .particle_surfaces import Skin, skin_mesh
from .scene_objects import material_faults, moved_vertices, traced_object, world_vertices


@dataclass(slots=True)
class CachedObject:
    """An object as it was in the last frame, and what was made of it.

    One that is shown in captured colours is `captured` for the camera, and for rays `glowing`. One with materials of
    its own, or with `channels` that rays meet, has a `mesh` with `images` and the optional channels `shown`; `met` is
    what stands for the object in the scene. Of a thin one light meets `sheet`. Its surfels may have `emission` (n, 3).
    Of the surfels, `lost` are left out as the particles that carry them are not finite.
    Where its matter has broken, `cracks` are the faces made there, and `closed` says what else is different.
    Where its particles have a `skin`, that is its `mesh`.
    It has `levels` of fewer surfels by their number; of these each has the `detail` by which they grow.
    """

    state: ObjectState
    loaded: LoadedAsset
    traced: TraceObject
    met: TraceObject
    posed: PosedSurfels | None = None
    hidden_count: int = 0
    lost: int = 0
    faults: list[str] = field(default_factory=list)
    mode: tuple[bool, bool, bool, bool] = (False, False, False, False)
    captured: CapturedObject | None = None
    glowing: MeshState | None = None
    sheet: MeshState | None = None
    mesh: ObjectMesh | None = None
    images: list[Image] = field(default_factory=list)
    closed: ClosedMatter | None = None
    cracks: list[ObjectMesh] = field(default_factory=list)
    skin: Skin | None = None
    emission: Array | None = None
    channels: dict[str, Array] = field(default_factory=dict)
    shown: frozenset[str] = frozenset()
    levels: dict[int, CachedObject] = field(default_factory=dict)
    detail: Detail | None = None

    @property
    def meshes(self) -> tuple[MeshState | None, ...]:
        """What is laid out as a mesh of it."""
        return self.glowing, self.sheet, self.mesh, *self.cracks

    @property
    def sheeted(self) -> bool:
        """Whether light meets sheets of its surfels, which have no channels."""
        return self.mode[3] and not self.channels

    @property
    def seen_by_mesh(self) -> bool:
        """Whether the camera sees its mesh, not its surfels."""
        return self.mesh is not None and self.mesh.ordinary


def surfel_mask(item: CachedObject) -> int:
    """Which rays meet an object's surfels; where they meet a mesh of it, the camera's at most."""
    if item.glowing is not None or item.seen_by_mesh:
        return 0
    mask = group_mask(item.state.visibility, True)
    return mask if item.mesh is None or item.mesh.seen_only else mask & CAMERA


def emission_of(objects: Sequence[CachedObject]) -> Array | None:
    """(n, 3) float32 radiance of the surfels of `objects`; None where none emits."""
    if all(item.emission is None for item in objects):
        return None
    given = [item for item in objects if item.posed is not None]
    rows = [np.zeros((len(i.posed or ()), 3), np.float32) if i.emission is None else i.emission for i in given]
    return np.concatenate(rows)


def begun(
    state: ObjectState, loaded: LoadedAsset, mode: tuple[bool, bool, bool, bool], index: int,
    closed: ClosedMatter | None = None, skin: Skin | None = None,
) -> CachedObject:  # fmt: skip
    """An object that is new or has changed, without its surfels.

    Parameters
    ----------
    state : ObjectState
    loaded : LoadedAsset
    mode : tuple of bool
        Whether rays meet surfels, whether it is shown in captured colours, whether its textures are met, and whether
        light meets sheets.
    index : int
        Of the object in the frame.
    closed : ClosedMatter, optional
        Where its matter has broken.
    skin : Skin, optional
        The surface of its particles, which stands for it.
    """
    met, shown, textured, sheeted = mode
    asset = loaded.asset
    channels = {} if shown else optional_channels(state, asset)
    shape = state if closed is None else replace(state, vertices=closed.vertices)
    cut = None if closed is None else closed.cut
    traced = traced_object(shape, asset, met or shown, sheeted and not channels, cut)
    item = CachedObject(state, loaded, traced, traced, mode=mode, closed=closed)
    if closed is not None:
        item.cracks = crack_meshes(state, traced, closed, index)
    item.faults = [*(f"{state.name}: {fault}" for fault in loaded.faults), *material_faults(state)]
    if shown:
        if len(asset.mesh.faces):
            item.glowing = glowing_mesh(state, traced, loaded.glow_of(state.asset))
        return item
    if skin is not None:
        return _skinned(item, skin, index)
    item.channels = channels
    textures = asset.mesh.textures
    needed = textures is not None and bool(textured or item.channels or textures.optional)
    images = loaded.textured_of(state.asset) if needed else None
    item.mesh, item.images, faults = object_mesh(shape, traced, asset, index, item.channels, images)
    item.faults += faults
    item.shown = channels_of(item.mesh)
    if closed is not None and (images is not None or channels):
        item.faults.append(
            f"{state.name}: next to where it has broken, its albedo, roughness and metallic are those of vertices; "
            "images and other channels are not shown there"
        )
    if item.mesh is not None:
        item.met = stub(traced)
    return item


def _skinned(item: CachedObject, skin: Skin, index: int) -> CachedObject:
    """An object that is met by the surface of its particles."""
    name = item.state.name
    item.mesh, item.met, item.skin = skin_mesh(item.state, item.traced, skin, index), stub(item.traced), skin
    item.faults.append(
        f"{name}: shown by a surface of its particles, not by its surfels; Surface: Mesh (--surface mesh) shows these"
    )
    if item.loaded.asset.mesh.textures is not None:
        item.faults.append(f"{name}: the surface of its particles has the materials of vertices, not images")
    if skin.lost:
        item.faults.append(f"{name}: {skin.lost} particles are not finite, and not seen. Bake again")
    if skin.surface.far:
        item.faults.append(f"{name}: {skin.surface.far} particles are much farther off than the others, and not seen")
    if skin.surface.coarse:
        item.faults.append(
            f"{name}: its particles are spread so far that their surface is coarse; use a domain with walls"
        )
    return item


def same_matter(a: ObjectState, b: ObjectState) -> bool:
    """Whether two states of an object have broken alike, and have the same particles."""
    same = a.vertices is b.vertices and a.particles is b.particles
    return same and (a.tear, a.inside is None) == (b.tear, b.inside is None)


def vertices_at(item: CachedObject, pose: Pose) -> Array | None:
    """As `moved_vertices`; what is beside its place in the mesh, as matter at cracks is, stays as far from it."""
    then = moved_vertices(item.state, item.loaded.asset, pose)
    if then is None or item.closed is None:
        return then
    own = item.loaded.asset.mesh.vertices if item.state.vertices is None else item.state.vertices
    aside = (item.closed.vertices != own.astype(np.float32)).any(axis=1)
    now = world_vertices(own, np.asarray(item.state.matrix_world, np.float64))
    then[aside] += item.traced.vertices[aside] - now[aside]
    return then
