"""Optional material channels of objects in a frame: emission, opacity and others that assets need not have.

Where its surface emits light or lets it pass, rays meet an object by its `object_meshes.object_mesh`. Where light
passes, the camera does, too: surfels overlap, so that a share of each is no share of the surface. Specular level and
coat of surfels that the camera sees are those of the mesh where they are tied to it.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from ..core.asset.model import MATERIAL_CHANNELS, OPTIONAL_CHANNELS, Asset
from ..core.frame import Frame, ObjectState, RenderSettings
from ..core.material_adjustments import scaled
from ..deform.mesh_driven import MeshDriven
from .scene_objects import material
from .surfel_sheets import meets_sheets

Array = np.ndarray

#: Channels of lobes that the mesh has, surfels on their own have not.
LOBES = ("specular", "coat")
_BE = ("", "is", "are")


def has_channels(state: ObjectState, asset: Asset) -> bool:
    """Whether an object or its asset has optional channels at all."""
    fades = state.adjustment is not None and state.adjustment.opacity != 1
    pictured = asset.mesh.textures is not None and bool(asset.mesh.textures.optional)
    return (
        fades
        or pictured
        or any(getattr(part, name) is not None for part in (state, asset.mesh) for name in OPTIONAL_CHANNELS)
    )


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


def channel_faults(state: ObjectState, asset: Asset, shown: Collection[str], settings: RenderSettings) -> list[str]:
    """What of the object's optional channels is not shown, or otherwise than its surfels, in words for the user.

    Parameters
    ----------
    state : ObjectState
    asset : Asset
    shown : set of str
        Optional channels that its mesh has, see `object_meshes.channels_of`.
    settings : RenderSettings
    """
    name, found = state.name, []
    bare = not len(asset.mesh.faces)
    passes, emits = "opacity" in shown, "emission" in shown
    lobes = [c for c in LOBES if c in shown or (bare and getattr(asset.surfels, c) is not None)]
    own = f"its {' and '.join(lobes)}"
    if lobes and bare:
        found.append(f"{name}: has no mesh, so {own} {_BE[len(lobes)]} not shown")
    elif lobes and settings.shading_model == "paper":
        found.append(f"{name}: the shading model Cook-Torrance leaves out {own}. Choose Principled")
    elif lobes:
        if settings.camera_sees == "surfels" and not passes:
            found.append(f"{name}: {own} on surfels {_BE[len(lobes)]} taken from the mesh next to them")
        if settings.rays_see == "surfels" and not (passes or emits):
            found.append(f"{name}: {own} {_BE[len(lobes)]} shown to the camera alone; other rays meet surfels without")
    if passes and settings.camera_sees == "surfels":
        found.append(
            f"{name}: part of it is transparent (such as glass), so the camera sees its mesh instead of its surfels"
        )
    if (passes or emits) and settings.rays_see == "surfels":
        found.append(f"{name}: part of it emits light or is transparent, so rays meet its mesh instead of its surfels")
    if bare and state.visibility.shadow_catcher and settings.rays_see == "mesh":
        found.append(f"{name}: has no mesh, so as a shadow catcher it is in no reflection. Set Rays See to Surfels")
    if bare and asset.surfels.emission is not None:
        found.append(f"{name}: has no mesh, so what it emits is seen by the camera alone")
    return found


def may_need(frame: Frame, assets: list[Asset]) -> bool:
    """Whether a frame with these assets of its objects may have meshes that emit, sheets or skins: these need more."""
    if any(state.particles is not None and state.particles.skin for state in frame.objects):
        return True
    both = zip(frame.objects, assets)
    return any(has_channels(state, asset) or meets_sheets(state, asset, frame) for state, asset in both)
