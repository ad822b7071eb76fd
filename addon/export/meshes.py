"""Visible meshes that are no DR-GS objects -> frame.MeshState: one a shape, however often it stands in the scene."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import bpy
import numpy as np

from ...drgs_blender.core.arrays import shareable
from ...drgs_blender.core.frame import Layer, MeshState
from ...drgs_blender.core.materials import Image
from ...drgs_blender.core.strands import Tubes
from .. import mesh_arrays
from ..bakes.requests import Wanted
from .export_cache import ExportCache, uid
from .hair import Hair, Strands, read_strands
from .holdouts import Holdouts
from .instances import Key, Visible, terminator_offset
from .light_links import LightLinks
from .materials import DEFAULT_MATERIAL, ExportedMaterial, Materials
from .surface_bake import SurfaceBakes

Warn = Callable[[str], None]
Array = np.ndarray


@dataclass(slots=True)
class _Shape:
    """A shape and where it stands; no state where nothing of it is seen."""

    state: MeshState | None
    matrices: list[Array] = field(default_factory=list)
    pass_indices: list[int] = field(default_factory=list)
    keys: list[Key] = field(default_factory=list)
    is_placed: bool = False


@dataclass(frozen=True, slots=True)
class _Arrays:
    """What of a mesh does not depend on its materials; see `mesh_arrays`."""

    vertices: Array
    corners: Array
    polygons: Array
    corner_vertices: Array
    material_index: Array | None
    vertex_normals: Array | None
    corner_normals: Array | None

    @classmethod
    def read(cls, mesh: bpy.types.Mesh) -> _Arrays:
        """Read them, vertices and their normals frozen."""
        made = mesh_arrays.has_smooth_triangles(mesh)
        vertex_normals = None if made else mesh_arrays.read_vertex_normals(mesh)
        at_corners = not made and vertex_normals is None
        return cls(
            _frozen(mesh_arrays.read_vertices(mesh)),
            *mesh_arrays.read_loop_triangles(mesh),
            mesh_arrays.read_corner_vertices(mesh),
            mesh_arrays.read_material_index(mesh),
            None if vertex_normals is None else _frozen(vertex_normals),
            mesh_arrays.smooth_or_corner_normals(mesh) if at_corners else None,
        )

    @classmethod
    def of_hair(cls, hair: Hair) -> _Arrays:
        """Those of strands, whose tubes are theirs alone."""
        made = hair.tubes
        count = len(made.faces)
        index = hair.strands.slot[made.strand[made.ring]]
        return cls(
            made.vertices,
            np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
            np.arange(count, dtype=np.int32),
            made.faces.ravel(),
            index if index.any() else None,
            made.normals,
            None,
        )


#: What is exported as a mesh; hair answers for itself where Blender's meshes are read by `mesh_arrays`.
Surface: TypeAlias = bpy.types.Mesh | Hair
#: Reads them of an evaluated mesh or of hair, or knows them.
ReadArrays = Callable[[Surface], _Arrays]


class Meshes:
    """Collects the meshes of one export. Those with the same data, materials and visibility are one shape."""

    def __init__(
        self,
        depsgraph: bpy.types.Depsgraph,
        materials: Materials,
        warn: Warn,
        cache: ExportCache,
        links: LightLinks,
        wanted: Wanted | None = None,
        with_uv_map: bool = False,
    ) -> None:
        self._links, self._with_uv_map = links, with_uv_map
        self._depsgraph, self._materials, self._warn, self._cache = depsgraph, materials, warn, cache
        self._wanted, self._holdouts = wanted, Holdouts(warn)
        self._shapes: dict[tuple[object, ...], _Shape] = {}

    def add(self, item: Visible) -> None:
        """Take in a visible instance of a mesh, or of hair."""
        obj = item.object
        slots, sent = self._materials.slots(obj), self._links.numbers_of(item)
        owners = uid(obj.data), uid(obj)
        stands = (*owners, obj.data.as_pointer(), item.is_hair or obj.data.is_editmode, item.is_particle_hair)

        def read() -> AbstractContextManager[Surface]:
            if not item.is_hair:
                return _read(obj, self._depsgraph)
            strands, made = self._cache.get(("strands", *stands), owners, lambda: self._strands(obj))
            return contextlib.nullcontext(Hair(obj, strands, made))

        def arrays(mesh: Surface) -> _Arrays:
            make = _Arrays.of_hair if isinstance(mesh, Hair) else _Arrays.read
            return self._cache.get(("arrays", *stands), owners, lambda: make(mesh))

        def material_index() -> Array | None:
            with read() as mesh:
                return arrays(mesh).material_index

        item = self._holdouts.cut_out(item, slots, material_index)
        rays = item.visibility
        key = (
            obj.data.as_pointer(),
            item.is_particle_hair,
            *(m.as_pointer() if m else 0 for m in slots),
            *(getattr(rays, name) for name in rays.__slots__),
            self._with_uv_map,
            self._materials.aovs,
            obj.lightgroup,
            terminator_offset(obj),
            *sent.values(),
        )
        shape = self._shapes.get(key)
        if shape is None:
            state, pictures, bakes = self._cache.get(
                ("mesh", *stands, obj.name, *key), owners, lambda: self._state(item, slots, arrays, read)
            )
            self._materials.images |= pictures
            shape = self._shapes[key] = _Shape(state)
            if self._wanted is not None and bakes is not None:
                self._wanted.again(bakes.requests)
                shape.is_placed = bakes.is_placed
        shape.matrices.append(item.matrix_world)
        shape.pass_indices.append(obj.pass_index)
        shape.keys.append(item.key)

    def states(self) -> list[MeshState]:
        """One a shape."""
        found = []
        for shape in self._shapes.values():
            if shape.state is not None:
                matrices = _frozen(np.array(shape.matrices, np.float64))
                if shape.is_placed and len(matrices) > 1:
                    self._warn(
                        f'"{shape.state.name}": its baked materials depend on where it stands; all of its '
                        f"{len(matrices)} instances look as the first"
                    )
                indices = _frozen(np.array(shape.pass_indices, np.int32))
                found.append(replace(shape.state, matrices=matrices, pass_indices=indices))
        return found

    def keys(self) -> list[list[Key]]:
        """Instance keys of each of `states`, one per matrix."""
        return [shape.keys for shape in self._shapes.values() if shape.state is not None]

    def _strands(self, obj: bpy.types.Object) -> tuple[Strands, Tubes]:
        strands = read_strands(obj, self._depsgraph.mode)
        made = strands.tubes(obj.name, self._warn)
        vertices, normals = (_shared(values, np.float32) for values in (made.vertices, made.normals))
        return strands, replace(made, vertices=vertices, normals=normals)

    def _state(
        self,
        item: Visible,
        slots: list[bpy.types.Material | None],
        arrays: ReadArrays,
        read: Callable[[], AbstractContextManager[Surface]],
    ) -> tuple[MeshState | None, dict[str, Image], SurfaceBakes | None]:
        """What all instances share, the images on it and its bakes; None where the mesh has no faces that are seen."""
        with read() as mesh:
            wanted = None if item.is_hair else self._wanted  # hair has no texels
            bakes = None if wanted is None else SurfaceBakes(wanted, item.object, mesh, slots)
            state = self._describe(item, mesh, slots, arrays, bakes)
        if bakes is not None:
            bakes.end()
        return state, {name: self._materials.images[name] for name in _images_of(state)}, bakes

    def _describe(
        self,
        item: Visible,
        mesh: Surface,
        slots: list[bpy.types.Material | None],
        read: ReadArrays,
        bakes: SurfaceBakes | None,
    ) -> MeshState | None:
        if len(mesh.polygons) == 0:
            return None
        if isinstance(mesh, Hair):  # no warnings of materials that are not on it
            slots = [slot if number in mesh.strands.slot else None for number, slot in enumerate(slots)]
        known: dict[bpy.types.Material | None, ExportedMaterial] = {}
        for material in slots or [None]:
            if material not in known:
                known[material] = self._materials.export(material, mesh, bakes)
        exported = [known[material] for material in slots or [None]]
        arrays = read(mesh)  # after the images, which take much memory while Blender reads them
        corners, polygons, index = arrays.corners, arrays.polygons, arrays.material_index
        if index is not None:
            index = np.clip(index, 0, len(exported) - 1)[polygons]  # as Cycles reads what is out of range
        corners, polygons, index = _seen(corners, polygons, index, exported)
        if len(corners) == 0:
            return None
        normals = arrays.corner_normals
        if normals is not None:
            check_normals(item.object.name, mesh, normals, self._warn)
        return MeshState(
            name=item.object.name,
            vertices=arrays.vertices,
            faces=_taken(arrays.corner_vertices, corners),
            matrices=np.empty((0, 4, 4)),
            pass_indices=np.empty(0, np.int32),
            corner_normals=None if normals is None else _taken(normals, corners),
            uvs=self._uvs(item.object.name, mesh, corners, index, exported),
            uv_map=self._uv_map(mesh, corners),
            material_index=None if index is None or not index.any() else _shared(index, np.int32),
            materials=[material.material or DEFAULT_MATERIAL for material in exported],
            visibility=item.visibility,
            layers=self._layers(item.object.name, mesh, (corners, polygons, arrays.corner_vertices), exported),
            light_group=item.object.lightgroup,
            terminator_offset=terminator_offset(item.object, self._warn),
            vertex_normals=arrays.vertex_normals,
            **self._links.numbers_of(item),
        )

    def _layers(
        self, name: str, mesh: Surface, elements: tuple[Array, Array, Array], exported: list[ExportedMaterial]
    ) -> list[Layer]:
        """All that textures of its materials refer to besides the UV map that each asks for first."""
        found = []
        for ref in dict.fromkeys(layer for material in exported for layer in material.layers):
            values = ref.values(mesh, *elements)
            if values is None:
                self._lacks_uvs(name, ref.name)
                values = np.zeros((len(elements[0]), 3, 2), np.float32)
            found.append(Layer(ref.label, _shared(values, np.float32)))
        return found

    def _lacks_uvs(self, name: str, uv_map: str) -> None:
        which = f'the UV map "{uv_map}"' if uv_map else "a UV map"
        self._warn(
            f'"{name}": its textures need {which}, which it has not; they show a single texel. Unwrap it, or '
            "choose a map that it has"
        )

    def _uv_map(self, mesh: Surface, corners: Array) -> Array | None:
        """(m, 3, 2) float32 frozen: the UV map that renders, for the pass UV; None without one."""
        values = _uvs_of(mesh, "") if self._with_uv_map else None
        return None if values is None else _taken(values, corners)

    def _uvs(
        self, name: str, mesh: Surface, corners: Array, index: Array | None, exported: list[ExportedMaterial]
    ) -> Array | None:
        """(m, 3, 2) float32 frozen: for every face the UV map that its material asks for; None where none does."""
        requested = [material.uv_map for material in exported]
        if all(uv_map is None for uv_map in requested):
            return None
        uvs = shareable((len(corners), 3, 2), np.float32)
        for uv_map in {u for u in requested if u is not None}:
            values = _uvs_of(mesh, uv_map)
            if values is None:
                self._lacks_uvs(name, uv_map)
                continue
            if index is None:
                faces: slice | Array = slice(None) if requested[0] == uv_map else slice(0)
            else:
                faces = np.isin(index, [i for i, u in enumerate(requested) if u == uv_map])
            if isinstance(faces, slice):
                np.take(values, corners[faces], axis=0, out=uvs[faces], mode="clip")
            else:
                uvs[faces] = values[corners[faces]]
        return _frozen(uvs)


def _uvs_of(mesh: Surface, name: str) -> Array | None:
    """(l, 2) float32 of a UV map; "" is the one that renders."""
    return mesh.corner_uvs(name) if isinstance(mesh, Hair) else mesh_arrays.read_uvs(mesh, name)


@contextlib.contextmanager
def _read(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> Iterator[bpy.types.Mesh]:
    """The evaluated mesh of an object with all its arrays.

    While a mesh is edited, its evaluated data is a wrapper without arrays; a converted copy has them.
    """
    if not obj.data.is_editmode:
        yield obj.data
        return
    try:
        yield obj.to_mesh(preserve_all_data_layers=True, depsgraph=depsgraph)
    finally:
        obj.to_mesh_clear()


def check_normals(name: str, mesh: bpy.types.Mesh, normals: Array, warn: Warn) -> None:
    """Say how many custom normals the engine cannot use."""
    if mesh.has_custom_normals and (lost := int((~np.isfinite(normals)).any(axis=-1).sum())):
        warn(f'"{name}": {lost} of its custom normals are not finite; its faces\' own are used there. Clear them')


def _images_of(state: MeshState | None) -> set[str]:
    """Names of the images that its textures refer to."""
    if state is None:
        return set()
    textures = [texture for material in state.materials for texture in material.all_textures()]
    return {texture.image for texture in textures if texture.image}


def _seen(
    corners: Array, polygons: Array, index: Array | None, exported: list[ExportedMaterial]
) -> tuple[Array, Array, Array | None]:
    """Only the faces whose material is seen."""
    unseen = [i for i, material in enumerate(exported) if material.material is None]
    if not unseen:
        return corners, polygons, index
    if index is None:
        return (corners[:0], polygons[:0], None) if 0 in unseen else (corners, polygons, None)
    kept = ~np.isin(index, unseen)
    return corners[kept], polygons[kept], index[kept]


def _taken(values: Array, corners: Array) -> Array:
    """Frozen rows of `values` at corners, which the engine can map."""
    found = shareable((*corners.shape, *values.shape[1:]), values.dtype)
    np.take(values, corners, axis=0, out=found, mode="clip")  # others are buffered
    return _frozen(found)


def _shared(values: Array, dtype: type) -> Array:
    """A frozen copy, which the engine can map."""
    found = shareable(values.shape, dtype)
    found[:] = values
    return _frozen(found)


def _frozen(array: Array) -> Array:
    """`array`, which nobody may write to any more, so that the engine's client need not copy it."""
    array.flags.writeable = False
    return array
