"""DR-GS objects of an evaluated scene -> frame.ObjectState, one for each visible instance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np

from ...drgs_blender.asset import MATERIAL_CHANNELS, Asset
from ...drgs_blender.frame import ObjectState
from .. import assets, mesh_arrays
from .fit import check_fit, check_modifiers
from .instances import Visible

Warn = Callable[[str], None]
#: Gives the engine's key of the asset at a path.
KeyOf = Callable[[Path], str]


class DrgsObjects:
    """Collects the DR-GS objects of one export."""

    def __init__(self, depsgraph: bpy.types.Depsgraph, key_of: KeyOf, warn: Warn) -> None:
        self._depsgraph, self._key_of, self._warn = depsgraph, key_of, warn
        self._shapes: dict[tuple[int, int], ObjectState] = {}
        self.states: list[ObjectState] = []

    def add(self, item: Visible) -> None:
        """Take in a visible instance.

        Raises
        ------
        AssetError
            Its asset is missing, or the evaluated mesh is not the asset's, moved; names object and modifiers.
        """
        obj = item.object
        check_modifiers(obj, self._depsgraph)
        shape_of = (obj.original.as_pointer(), obj.data.as_pointer())
        if shape_of not in self._shapes:
            self._shapes[shape_of] = _shape(obj, self._depsgraph, self._key_of, self._warn)
        shape = self._shapes[shape_of]
        self.states.append(
            replace(shape, matrix_world=item.matrix_world, pass_index=obj.pass_index, visibility=item.visibility)
        )


def _shape(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph, key_of: KeyOf, warn: Warn) -> ObjectState:
    """What all instances of an object share."""
    path = assets.file_of(obj)
    asset = assets.load(path)
    # While a mesh is edited, its evaluated data is a wrapper without arrays; a converted copy has them.
    editing = obj.mode == "EDIT"
    mesh = obj.to_mesh(preserve_all_data_layers=True, depsgraph=depsgraph) if editing else obj.data
    try:
        same_faces = check_fit(obj, mesh, asset.mesh, warn)
        vertices = mesh_arrays.read_vertices(mesh)
        vertices.flags.writeable = False  # so that the engine's client need not copy it
        return ObjectState(
            name=obj.name,
            asset=key_of(path),
            vertices=vertices,
            corner_normals=_corner_normals(obj, mesh, same_faces, warn),
            **{channel: _edited(obj, mesh, asset, channel, warn) for channel in MATERIAL_CHANNELS},
        )
    finally:
        if editing:
            obj.to_mesh_clear()


def _corner_normals(obj: bpy.types.Object, mesh: bpy.types.Mesh, same_faces: bool, warn: Warn) -> np.ndarray | None:
    """Normals per corner where the mesh has flat, sharp or custom ones; smooth ones the engine makes itself."""
    if mesh.normals_domain == "POINT":
        return None
    if not same_faces:
        warn(f'"{obj.name}": its faces are not those of the asset, so it is shaded smooth')
        return None
    return mesh_arrays.read_corner_normals(mesh)


def _edited(obj: bpy.types.Object, mesh: bpy.types.Mesh, asset: Asset, channel: str, warn: Warn) -> np.ndarray | None:
    """A material channel where it differs from the asset's, else None."""
    try:
        values = mesh_arrays.read_channel(mesh, channel)
    except TypeError as error:
        warn(f'"{obj.name}": attribute {channel} is {error}; the asset\'s values are used')
        return None
    if values is None or np.array_equal(values, getattr(asset.mesh, channel)):
        return None
    return values
