"""What light meets of thin objects: sheets of their surfels, in place of a mesh that makes tubes of leaves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..core.asset.model import Asset, PosedSurfels
from ..core.frame import Frame, Layer, MeshState, ObjectState
from ..core.materials import Material, Texture
from ..render.surfels.sheets import sheets

Array = np.ndarray

_COLOURS, _NUMBERS = "albedo", "roughness, metallic"


def meets_sheets(state: ObjectState, asset: Asset, frame: Frame) -> bool:
    """Whether light meets sheets of the object's surfels: it has no mesh, or was found to be thin when reconstructed.

    Not where the camera sees its mesh, and not where its materials are more than surfels have.
    """
    settings, known = frame.settings, asset.provenance.get("report")
    thin = not len(asset.mesh.faces) or (isinstance(known, Mapping) and known.get("thin") is True)
    plain = asset.mesh.textures is None and not state.visibility.shadow_catcher
    return (
        thin and plain and len(asset.surfels) > 0 and settings.rays_see == "mesh" and settings.camera_sees == "surfels"
    )


def sheet_mesh(state: ObjectState, posed: PosedSurfels) -> MeshState:
    """The sheets of the surfels that light meets, with their materials."""
    vertices, faces = sheets(posed.centre, posed.tangent_u, posed.tangent_v, posed.opacity)
    n = len(posed)
    ones = np.ones((n, 1), np.float32)
    colours = np.concatenate([posed.albedo, ones], 1)
    numbers = np.concatenate([posed.roughness[:, None], posed.metallic[:, None], ones, ones], 1)
    corners = np.repeat(np.arange(n), 2)  # of each surfel two faces
    layers = [
        Layer(name, np.repeat(values[corners, None].astype(np.float32), 3, axis=1))
        for name, values in ((_COLOURS, colours), (_NUMBERS, numbers))
    ]
    surface = Material(
        state.name, (1.0, 1.0, 1.0), 1.0, 1.0,
        base_colour_texture=Texture("", layer=_COLOURS),
        roughness_texture=Texture("", channel="r", layer=_NUMBERS),
        metallic_texture=Texture("", channel="g", layer=_NUMBERS),
        pass_index=state.material_pass_index,
    )  # fmt: skip
    return MeshState(
        name=state.name,
        vertices=vertices,
        faces=faces,
        matrices=np.eye(4)[None],
        pass_indices=np.array([state.pass_index], np.int32),
        layers=layers,
        materials=[surface],
        visibility=replace(state.visibility, camera=False, holdout=False),
    )
