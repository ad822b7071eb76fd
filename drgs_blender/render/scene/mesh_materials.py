"""Materials and texture coordinates of the meshes of a scene, face by face."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...core.arrays import Array
from ...core.asset.model import as_float
from ...core.errors import UsageError
from ...core.frame import MeshState
from ...core.materials import Image, Material
from ..memory import AddressOf, address
from .mesh_layers import MeshLayers, Placements, finite
from .object_mesh import ObjectMesh
from .textures import MaterialTable
from .trace_mesh import Part, TraceObject


@dataclass(slots=True)
class EmissiveMesh:
    """A mesh with materials that emit light.

    Attributes
    ----------
    mesh : MeshState
        As given.
    shape : slice
        All faces of the mesh, among the scene's.
    faces : (k,) int64 array
        Emissive faces.
    material : (k,) int32 array
        Of ``MeshMaterials.table``.
    uvs : (k, 3, 2) float32 array or None
        By the mesh's own UVs.
    instances : array, optional
        Rows of ``TraceScene.instances``, or None where the faces are in world space.
    """

    mesh: MeshState
    shape: slice
    faces: Array
    material: Array
    uvs: Array | None
    instances: range | None


class MeshMaterials:
    """Materials of the meshes of a `TraceScene`. Faces count from the first that is of a mesh.

    Attributes
    ----------
    table : MaterialTable
        All materials.
    layers : MeshLayers
        What textures and normal maps refer to.
    addresses : (12,) int64 array
        Of the arrays of `table`, then of the frames of `layers`.
    index : (k,) int32 array
        Material of each face, in `table`.
    uvs : (k, 3, 2) float32 array
        Texture coordinates of the corners; empty where no mesh has any.
    """

    def __init__(self) -> None:
        self.table = MaterialTable([], [])
        self.layers = MeshLayers()
        self._first_face = 0
        self._tables: tuple[Array, Array] = self.layers.tables(0)
        self.addresses: Array = self.addresses_at(address)
        self._given: list[Any] = []  # lists of materials, images
        self._ordinary = 0  # meshes; an `ObjectMesh` each of DR-GS objects follows
        self._first: list[int] = []  # of each mesh, in `table`
        self._names: list[Any] = []  # of the layers of each mesh
        self._shapes: list[tuple[slice, MeshState]] = []  # and the faces of each
        #: Texture coordinates by identity, and how many of their numbers are not finite.
        self._bad_uvs: dict[int, tuple[Array, int]] = {}
        self._uv_warnings: list[str] = []
        self.clear(0)

    def clear(self, count: int) -> None:
        """Forget the faces; there are `count` now, and each is to be set."""
        self.index: Array = np.zeros(count, np.int32)
        self.uvs: Array = np.empty((0, 3, 2), np.float32)

    @property
    def names(self) -> list[str]:
        """Names of all materials of ordinary meshes, in the order of `table`."""
        return [material.name for materials in self._given[: self._ordinary] for material in materials]

    @property
    def warnings(self) -> list[str]:
        """Problems of materials, images and layers, in words."""
        return self.table.warnings + self.layers.warnings + self._uv_warnings

    def addresses_at(self, address_of: AddressOf) -> Array:
        """`addresses` of arrays that lie elsewhere; who calls it keeps what it returns."""
        tables = self._tables if address_of is address else self.layers.tables(self._first_face, address_of)
        return np.array([*self.table.addresses_at(address_of, tables[0]), address_of(tables[1])], np.int64)

    @property
    def pass_indices(self) -> Array:
        """(k,) int32 pass index of each of `names`."""
        given = self._given[: self._ordinary]
        return np.array([material.pass_index for materials in given for material in materials], np.int32)

    def of(self, face: Array) -> Array:
        """(n,) int64 place in `names` of the materials of faces; one behind the last for those of DR-GS objects."""
        none = len(self.names)
        found = np.full(len(face), none, np.int64)
        meshes = face >= 0
        found[meshes] = np.minimum(self.index[face[meshes]], none)
        return found

    def update(
        self,
        parts: Sequence[Part],
        before: Sequence[TraceObject | MeshState | None],
        meshes: Sequence[MeshState],
        images: Sequence[Image],
        sources: tuple[int, int],
        placed: Placements,
    ) -> None:
        """Bring all up to date.

        Parameters
        ----------
        parts : sequence of Part
            Of the scene.
        before : sequence of (TraceObject or MeshState or None)
            State of each part at the last update.
        meshes : sequence of MeshState
            Of the frame.
        images : sequence of Image
            Images of their textures.
        sources : tuple of int
            First source that is a mesh, first face that is of one.
        placed : Placements

        Raises
        ------
        UsageError
            Where materials, or texture coordinates, do not fit a mesh.
        """
        first_source, first_face = sources
        given: list[Any] = [mesh.materials for mesh in meshes]
        self._ordinary = sum(not isinstance(mesh, ObjectMesh) for mesh in meshes)
        first = [int(n) for n in np.cumsum([0, *(len(own) for own in given)])]
        given += images
        # Which layers there are, not what is in them.
        names = [
            (mesh.uvs is None, *((layer.name, np.shape(layer.values)[-1:]) for layer in mesh.layers)) for mesh in meshes
        ]
        if first != self._first or names != self._names or [id(g) for g in given] != [id(g) for g in self._given]:
            self._make_table(meshes, images)
            self._given, self._names = given, names
        if any(mesh.uvs is not None for mesh in meshes) and not len(self.uvs):
            self.uvs = np.zeros((len(self.index), 3, 2), np.float32)
            before = [None] * len(before)
        known, self._bad_uvs, self._uv_warnings = self._bad_uvs, {}, []
        for part, old in zip(parts, before):
            mesh = part.item
            if not isinstance(mesh, MeshState):
                continue
            rows = slice(part.face.start - first_face, part.face.stop - first_face)
            if old is not mesh or first != self._first:
                self.index[rows] = first[part.source - first_source] + _material_index(mesh, len(part.faces))
            if mesh.uvs is None and len(self.uvs):
                self.uvs[rows] = 0.0
            elif mesh.uvs is not None and (not isinstance(old, MeshState) or old.uvs is not mesh.uvs):
                values = as_float(mesh.uvs, (len(part.faces), 3, 2), f"texture coordinates of {mesh.name}")
                self.uvs[rows], bad = finite(values)
                known[id(mesh.uvs)] = mesh.uvs, bad
            if mesh.uvs is not None and id(mesh.uvs) in known:
                self._bad_uvs[id(mesh.uvs)] = found = known[id(mesh.uvs)]
                if found[1]:
                    self._uv_warnings.append(f"{mesh.name}: {found[1]} texture coordinates are not finite; 0 is used")
        self._first = first
        of_mesh = {part.source - first_source: part for part in parts if isinstance(part.item, MeshState)}
        detailed = [any(_has_frame(material) for material in mesh.materials) for mesh in meshes]
        self.layers.update(of_mesh, meshes, detailed, placed)
        self._first_face, self._tables = first_face, self.layers.tables(first_face)
        self.table.take_layers(self._tables[0])
        self.addresses = self.addresses_at(address)
        self._shapes = [
            (slice(part.face.start - first_face, part.face.stop - first_face), part.item)
            for part in parts
            if isinstance(part.item, MeshState)
        ]

    def _make_table(self, meshes: Sequence[MeshState], images: Sequence[Image]) -> None:
        owner = [index for index, mesh in enumerate(meshes) for _ in mesh.materials]
        self.layers.begin()

        def layer_row(material: int, name: str, tangents: bool) -> int | None:
            mesh = owner[material]
            return self.layers.row(mesh, meshes[mesh], name, tangents)

        materials = [m for mesh in meshes for m in mesh.materials]
        self.table = MaterialTable(materials, list(images), self.table, layer_row, owner)

    def uv_maps(self) -> Array:
        """(k, 3, 3) float32: u, v and 1 at the corners of each face, for the pass UV; 0 of meshes without a UV map.

        Raises
        ------
        AssetError
            Where a map does not fit its mesh; names it.
        """
        found = np.zeros((len(self.index), 3, 3), np.float32)
        for rows, mesh in self._shapes:
            if mesh.uv_map is not None:
                found[rows, :, :2] = as_float(mesh.uv_map, (rows.stop - rows.start, 3, 2), f"UV map of {mesh.name}")
                found[rows, :, 2] = 1
        return found


def _has_frame(material: Material) -> bool:
    """Whether shading needs the frame of its mesh: for maps of normals, and for highlights that follow tangents."""
    anisotropic = material.anisotropy != 0.0 or any(part.material.anisotropy != 0.0 for part in material.parts)
    return bool(material.details) or anisotropic


def _material_index(mesh: MeshState, count: int) -> Array | int:
    """Material of each face, within the mesh's materials."""
    if not mesh.materials:
        raise UsageError(f"object {mesh.name}", "has no material", "Give it at least one")
    if mesh.material_index is None:
        return 0
    index = np.asarray(mesh.material_index)
    if index.shape != (count,):
        raise UsageError(
            f"object {mesh.name}", f"{len(index)} material indices for {count} faces", "Give one index per face"
        )
    return np.clip(index, 0, len(mesh.materials) - 1)
