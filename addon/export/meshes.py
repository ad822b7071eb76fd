"""Visible meshes that are no DR-GS objects -> frame.MeshState: one a shape, however often it stands in the scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import bpy
import numpy as np

from ...drgs_blender.frame import MeshState
from .. import mesh_arrays
from .instances import Visible
from .materials import DEFAULT, Look, Materials

Warn = Callable[[str], None]
Array = np.ndarray


@dataclass(slots=True)
class _Shape:
    """A shape and where it stands; no state where nothing of it is seen."""

    state: MeshState | None
    matrices: list[Array] = field(default_factory=list)
    pass_indices: list[int] = field(default_factory=list)


class Meshes:
    """Collects the meshes of one export. Those with the same data, materials and visibility are one shape."""

    def __init__(self, depsgraph: bpy.types.Depsgraph, materials: Materials, warn: Warn) -> None:
        self._depsgraph, self._materials, self._warn = depsgraph, materials, warn
        self._shapes: dict[tuple[object, ...], _Shape] = {}

    def add(self, item: Visible) -> None:
        """Take in a visible instance of a mesh."""
        obj, rays = item.object, item.visibility
        slots = [s.material for s in obj.material_slots]
        key = (
            obj.data.as_pointer(),
            *(m.as_pointer() if m else 0 for m in slots),
            *(getattr(rays, name) for name in rays.__slots__),
        )
        shape = self._shapes.get(key)
        if shape is None:
            shape = self._shapes[key] = _Shape(self._state(item, slots))
        shape.matrices.append(item.matrix_world)
        shape.pass_indices.append(obj.pass_index)

    def states(self) -> list[MeshState]:
        """One a shape."""
        found = []
        for shape in self._shapes.values():
            if shape.state is not None:
                shape.state.matrices = _frozen(np.array(shape.matrices, np.float64))
                shape.state.pass_indices = _frozen(np.array(shape.pass_indices, np.int32))
                found.append(shape.state)
        return found

    def _state(self, item: Visible, slots: list[bpy.types.Material | None]) -> MeshState | None:
        """What all instances share; None where the mesh has no faces that are seen."""
        obj = item.object
        # While a mesh is edited, its evaluated data is a wrapper without arrays; a converted copy has them.
        editing = obj.data.is_editmode
        mesh = obj.to_mesh(preserve_all_data_layers=True, depsgraph=self._depsgraph) if editing else obj.data
        try:
            return self._describe(item, mesh, slots)
        finally:
            if editing:
                obj.to_mesh_clear()

    def _describe(
        self, item: Visible, mesh: bpy.types.Mesh, slots: list[bpy.types.Material | None]
    ) -> MeshState | None:
        if len(mesh.polygons) == 0:
            return None
        looks = [self._materials.look(material, mesh) for material in slots or [None]]
        corners, polygons = mesh_arrays.read_loop_triangles(mesh)
        index = mesh_arrays.read_material_index(mesh)
        if index is not None:
            index = np.clip(index, 0, len(looks) - 1)[polygons]  # as Cycles reads what is out of range
        corners, index = _seen(corners, index, looks)
        if len(corners) == 0:
            return None
        normals = mesh_arrays.smooth_or_corner_normals(mesh)
        return MeshState(
            name=item.object.name,
            vertices=_frozen(mesh_arrays.read_vertices(mesh)),
            faces=_frozen(mesh_arrays.read_corner_vertices(mesh)[corners]),
            matrices=np.empty((0, 4, 4)),
            pass_indices=np.empty(0, np.int32),
            corner_normals=None if normals is None else _frozen(normals[corners]),
            uvs=self._uvs(item.object.name, mesh, corners, index, looks),
            material_index=None if index is None or not index.any() else _frozen(index.astype(np.int32)),
            materials=[look.material or DEFAULT.material for look in looks],
            visibility=item.visibility,
        )

    def _uvs(
        self, name: str, mesh: bpy.types.Mesh, corners: Array, index: Array | None, looks: list[Look]
    ) -> Array | None:
        """(m, 3, 2) float32 frozen: for every face the UV map that its material asks for; None where none does."""
        wanted = [look.uv_map for look in looks]
        if all(uv_map is None for uv_map in wanted):
            return None
        uvs = np.zeros((len(corners), 3, 2), np.float32)
        for uv_map in {u for u in wanted if u is not None}:
            values = mesh_arrays.read_uvs(mesh, uv_map)
            if values is None:
                which = f'the UV map "{uv_map}"' if uv_map else "a UV map"
                self._warn(f'"{name}": its textures need {which}, which it has not; they show a single texel')
                continue
            if index is None:
                faces = slice(None) if wanted[0] == uv_map else slice(0)
            else:
                faces = np.isin(index, [i for i, u in enumerate(wanted) if u == uv_map])
            uvs[faces] = values[corners[faces]]
        return _frozen(uvs)


def _seen(corners: Array, index: Array | None, looks: list[Look]) -> tuple[Array, Array | None]:
    """Only the faces whose material is seen."""
    unseen = [i for i, look in enumerate(looks) if look.material is None]
    if not unseen:
        return corners, index
    if index is None:
        return (corners[:0] if 0 in unseen else corners), None
    kept = ~np.isin(index, unseen)
    return corners[kept], index[kept]


def _frozen(array: Array) -> Array:
    """`array`, which nobody may write to any more, so that the engine's client need not copy it."""
    array.flags.writeable = False
    return array
