"""Stand-ins: ordinary meshes in place of DR-GS objects whose surface emits light or lets light pass.

Whatever the renderer does with ordinary meshes it then does with these objects: they are sampled as mesh lights, and
rays stop at them by chance. Values of the vertices become layers of the mesh. An object that light passes is also seen
by its mesh: surfels overlap, so that a share of each is no share of the surface.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..core.asset.model import MATERIAL_CHANNELS, OPTIONAL_CHANNELS, Asset
from ..core.cryptomatte import DRGS_MATERIAL
from ..core.frame import Frame, Layer, Material, MeshState, ObjectState, Pose, RenderSettings, Texture
from ..core.material_adjustments import scaled
from ..deform.mesh_driven import MeshDriven
from ..render.scene.trace_scene import TraceObject
from .scene_objects import material, moved_vertices

Array = np.ndarray

#: Channels that are kept in assets, painted and saved, and have no effect on the picture yet.
NOT_RENDERED = ("specular", "coat")
#: Layers of a stand-in: albedo and roughness, emission and metallic, opacity.
_SURFACE, _LIGHT, _COVER = "surface", "light", "cover"


def has_channels(state: ObjectState, asset: Asset) -> bool:
    """Whether an object or its asset has optional channels at all."""
    fades = state.adjustment is not None and state.adjustment.opacity != 1
    return fades or any(getattr(part, name) is not None for part in (state, asset.mesh) for name in OPTIONAL_CHANNELS)


def optional_channels(state: ObjectState, asset: Asset) -> dict[str, Array]:
    """Optional channels of the object's vertices in this frame, those that are not neutral everywhere.

    Raises
    ------
    AssetError
        An array that does not fit the asset; names the object.
    """
    found = {}
    for name in OPTIONAL_CHANNELS:
        factor = getattr(state.adjustment, name, 1.0)
        if getattr(state, name) is None and getattr(asset.mesh, name) is None and factor == 1:
            continue
        values = material(state, name, asset.mesh.channel(name), f"{len(asset.mesh.vertices)} vertices")
        if state.adjustment is not None:
            values = scaled(name, values, factor, state.adjustment.mask)
        if (values != MATERIAL_CHANNELS[name].neutral).any():
            found[name] = values
    return found


def surfel_emission(state: ObjectState, asset: Asset, driven: MeshDriven | None) -> Array | None:
    """(n, 3) float32 radiance of the object's surfels in this frame; None where none emits."""
    own = asset.surfels.emission
    if driven is not None and state.emission is not None:
        painted = material(state, "emission", asset.mesh.channel("emission"), "a mesh")
        own = driven.channel("emission", painted)
    if own is not None and state.adjustment is not None and state.adjustment.emission != 1:
        mask = state.adjustment.mask
        if mask is not None and driven is not None:
            mask = np.einsum("nk,nk->n", driven.binding.barycentric, mask[driven.mesh.faces[driven.binding.face]])
        own = scaled("emission", own, state.adjustment.emission, mask)
    return own if own is not None and own.any() else None


def stand_in(state: ObjectState, traced: TraceObject, channels: dict[str, Array], by_mesh: bool) -> MeshState | None:
    """The mesh that stands for an object; None where it neither emits nor lets light pass.

    Parameters
    ----------
    state : ObjectState
    traced : TraceObject
        The object as it would be traced otherwise.
    channels : dict of str to array
        `optional_channels`.
    by_mesh : bool
        Whether the camera sees meshes.
    """
    emission, opacity = channels.get("emission"), channels.get("opacity")
    if not len(traced.faces) or (emission is None and opacity is None):
        return None
    faces, normals = traced.faces, traced.corner_normals
    if traced.torn is not None:
        faces, normals = faces[~traced.torn], None if normals is None else normals[~traced.torn]
        if not len(faces):
            return None
    layers = [Layer(_SURFACE, _corners(faces, traced.albedo, traced.roughness))]
    light = np.zeros((len(traced.vertices), 3), np.float32) if emission is None else emission
    layers.append(Layer(_LIGHT, _corners(faces, light, traced.metallic)))
    plain = Material(
        DRGS_MATERIAL,
        (1.0, 1.0, 1.0),
        1.0,
        1.0,
        base_colour_texture=Texture("", layer=_SURFACE),
        roughness_texture=Texture("", "a", layer=_SURFACE),
        metallic_texture=Texture("", "a", layer=_LIGHT),
        pass_index=state.material_pass_index,
    )
    if opacity is not None:
        layers.append(Layer(_COVER, np.repeat(opacity[faces][..., None], 4, axis=2).astype(np.float32)))
        plain = replace(plain, alpha_texture=Texture("", "r", layer=_COVER))
    glowing = replace(plain, emission=(1.0, 1.0, 1.0), emission_texture=Texture("", layer=_LIGHT))
    index = None
    if emission is not None:
        shines = (emission[faces] > 0).any(axis=(1, 2))
        if opacity is not None:
            shines &= opacity[faces].any(axis=1)  # what is not there need not be sampled
        index = shines.astype(np.int32)
    seen = state.visibility
    return MeshState(
        name=state.name,
        vertices=traced.vertices,
        faces=faces,
        matrices=np.eye(4)[None],
        pass_indices=np.array([state.pass_index], np.int32),
        corner_normals=normals,
        material_index=index,
        materials=[plain, glowing] if emission is not None else [plain],
        visibility=replace(seen, camera=seen.camera and (by_mesh or opacity is not None)),
        layers=layers,
    )


def tie_only(traced: TraceObject) -> TraceObject:
    """An object that a mesh stands for: what its surfels are tied to, and nothing else."""
    return replace(traced, seen_only=True, visibility=replace(traced.visibility, camera=False))


def stand_in_pose(state: ObjectState, asset: Asset, pose: Pose | None) -> Pose | None:
    """The pose of the mesh that stands for an object which has `pose`."""
    if pose is None:
        return None
    return Pose(state.name, np.eye(4)[None], moved_vertices(state, asset, pose))


def stand_in_faults(
    state: ObjectState, asset: Asset, channels: dict[str, Array], settings: RenderSettings
) -> list[str]:
    """What of the object's optional channels is not shown, or otherwise than its surfels, in words for the user."""
    name, found = state.name, []
    kept = [channel for channel in NOT_RENDERED if channel in channels]
    if kept:
        found.append(f"{name}: its {' and '.join(kept)} are kept in the asset, but not rendered")
    passes, emits = "opacity" in channels, "emission" in channels
    if passes and settings.camera_sees == "surfels":
        found.append(f"{name}: light passes it, so the camera sees its mesh, not its surfels")
    if (passes or emits) and settings.rays_see == "surfels":
        found.append(f"{name}: it emits light or lets light pass, so rays meet its mesh, not its surfels")
    if not len(asset.mesh.faces) and asset.surfels.emission is not None:
        found.append(f"{name}: has no mesh, so what it emits is seen by the camera alone")
    return found


def may_need(frame: Frame, assets: list[Asset]) -> bool:
    """Whether a frame with these assets of its objects may have stand-ins, whose kernels are others."""
    return any(has_channels(state, asset) for state, asset in zip(frame.objects, assets))


def _corners(faces: Array, colours: Array, numbers: Array) -> Array:
    """(m, 3, 4) float32 values at the corners of faces, from (n, 3) and (n,) ones of the vertices."""
    return np.concatenate([colours, numbers[:, None]], axis=1).astype(np.float32)[faces]
