"""Everything rays can meet in one frame: DR-GS objects and ordinary meshes, with one BVH.

DR-GS objects and meshes of one instance are triangles in world space; a mesh of several keeps its vertices in
object space and a tree of its own, and stands in the scene as instances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from ...core.frame import MeshState, Pose
from ...core.materials import Image
from ..memory import AddressOf, address
from ..sampling import F
from ..surfel_columns import VERTEX
from .instances import Instances, normal_matrices, other_matrices, usable_instances
from .interaction import Geometry, Tracer
from .mesh_layers import Placements
from .mesh_materials import EmissiveMesh, MeshMaterials
from .object_mesh import ObjectMesh
from .ray_masks import object_flags
from .terminator import TerminatorOffsets
from .trace_mesh import Part, TraceObject, mask_of, own_faces, place_vertices, take_mesh, take_object
from .triangle_bvh import Group, TriangleBVH, corners

Array = np.ndarray

__all__ = ["ObjectFaults", "ObjectMesh", "TraceObject", "TraceScene"]


@dataclass(slots=True)
class ObjectFaults:
    """Problems of one object in the last update; such faces and instances are invisible to rays."""

    name: str
    bad_vertices: int  # NaN, infinite or absurdly far
    bad_faces: int  # touch a bad vertex
    empty_faces: int  # have no area
    bad_instances: int = 0  # matrices that are not finite, or flatten one of several


class TraceScene:
    """All objects and meshes of a frame.

    Objects are numbered: DR-GS objects as given, then meshes as given, then the instances of meshes that have
    several, in the order of the meshes. A `ObjectMesh` is one of the meshes, yet its faces are of its owner.

    Attributes
    ----------
    bvh : TriangleBVH
        TriangleBVH over everything.
    layout : object
        Another object whenever vertices and faces are numbered again.
    version : object
        Another object after every update.
    vertices : (n, 3) float32 array
        As traced (``bvh``'s own), world space save for meshes of several instances.
    faces : (m, 3) int32 array
        As traced; a face with a bad vertex is collapsed to one point.
    face_object : (m,) int32 array
        Object of each face (of a mesh of several instances: the mesh).
    shading_faces : (m, 3) int32 array
        Rows of ``shading`` (DR-GS objects) or of ``normals`` at the corners of each face.
    shading : (k, 8) float32 array
        Unit shading normal (3), albedo (3), roughness, metallic.
    normals : (r, 3) float32 array
        Of meshes; object space where these have several instances.
    vertex_faces : int
        How many faces are of DR-GS objects without an `ObjectMesh`; those come first.
    any_drgs, any_ordinary : bool
        Whether any faces are of DR-GS objects, and whether the camera may see an ordinary mesh.
    instances : (p, 3, 4) float32 array
        Object-to-world matrices of meshes of several instances.
    instance_object : (p,) int32 array
        Object of each instance.
    rays_differ : bool
        Whether there is an object that diffuse rays meet and glossy ones do not, or the other way.
    pass_index, object_flags : (objects,) int32 array
        Blender's object index pass; bits HOLDOUT and CATCHER.
    sheeted : (n,) bool array
        Of the frame's objects, as of `TraceObject`.
    source : (objects,) int64 array
        Which of the frame's objects, or behind them which of its meshes, each is.
    mesh_materials : MeshMaterials
        Materials and texture coordinates of the meshes, whose faces begin at `vertex_faces`.
    extent : float
        Metres: the largest absolute coordinate, the scale of rounding errors.
    cut : set of int
        Objects at which rays of the camera ended for having passed too many surfaces.
    faults : list of ObjectFaults
        Problems, one entry per object, then one per mesh.
    """

    def __init__(self) -> None:
        self.bvh = TriangleBVH()
        self.layout = self.version = object()
        self.shading_faces: Array = np.empty((0, 3), np.int32)
        self.shading: Array = np.empty((0, VERTEX), np.float32)
        self.normals: Array = np.empty((0, 3), np.float32)
        self.face_object: Array = np.empty(0, np.int32)
        self.vertex_faces = 0
        self.any_drgs = self.any_ordinary = False
        self.instances: Array = np.empty((0, 3, 4), np.float32)
        self.pass_index: Array = np.empty(0, np.int32)
        self.source: Array = np.empty(0, np.int64)
        self.object_flags: Array = np.empty(0, np.int32)
        self.sheeted: Array = np.empty(0, bool)
        self.rays_differ = False
        self.mesh_materials = MeshMaterials()
        self.extent = 0.0
        self.cut: set[int] = set()
        self.faults: list[ObjectFaults] = []
        self._parts: list[Part] = []
        self._known: list[tuple[MeshState, Instances]] = []
        self._groups: list[list[int]] = []  # parts of each group
        self._vertex_count = 0
        self._instance_normal: Array = np.empty((0, 3, 3), np.float32)
        self.instance_object: Array = np.empty(0, np.int32)
        self._first_instance: Array = np.zeros(1, np.int32)
        self._offsets = TerminatorOffsets()

    @property
    def vertices(self) -> Array:
        """(n, 3) float32 vertices, metres."""
        return self.bvh.vertices

    @property
    def faces(self) -> Array:
        """(m, 3) int32 faces of everything, as traced."""
        return self.bvh.faces

    @property
    def tracer(self) -> Tracer:
        """Ray tracer for compiled code; until the next update."""
        bvh = self.bvh
        tables = address(bvh.first_face), address(self._first_instance)
        return Tracer(bvh.intersect_address, bvh.occluded_address, bvh.scene, *tables)

    @property
    def geometry(self) -> Geometry:
        """Geometry and materials of hits, for compiled code; until the next update."""
        return self.geometry_at(address)

    def geometry_at(self, address_of: AddressOf) -> Geometry:
        """`geometry` of arrays that lie elsewhere."""
        meshes = self.mesh_materials
        tables = meshes.addresses if address_of is address else meshes.addresses_at(address_of)
        return Geometry(
            address_of(self.shading_faces),
            address_of(self.shading),
            address_of(self.normals),
            address_of(self.face_object),
            self.vertex_faces,
            address_of(meshes.index),
            address_of(meshes.uvs) if len(meshes.uvs) else 0,
            address_of(self._instance_normal),
            address_of(self.instance_object),
            address_of(tables),
            self._offsets.at(address_of, self.vertices, self.faces, self.instances),
        )

    def world_triangles(self) -> tuple[Array, Array]:
        """All triangles of the scene in world space: (k, 2) int32 faces and instances (or -1), and (k,) int32 masks."""
        rows, masks = [np.empty((0, 2), np.int32)], [np.empty(0, np.int32)]
        for group, members in enumerate(self._groups):
            for part in (self._parts[i] for i in members):
                faces = np.arange(part.face.start, part.face.stop, dtype=np.int32)
                where = self._instances_of(group, part)
                instances = np.array([-1] if where is None else where, np.int32)
                rows.append(np.stack([np.tile(faces, len(instances)), np.repeat(instances, len(faces))], axis=1))
                masks.append(np.full(len(rows[-1]), part.mask, np.int32))
        return np.concatenate(rows), np.concatenate(masks)

    @property
    def emissive_meshes(self) -> list[EmissiveMesh]:
        """Emissive surfaces, in the order of the scene's faces."""
        found, materials = list[EmissiveMesh](), self.mesh_materials
        if not materials.table.emissive:
            return found
        emissive = np.any(materials.table.arrays[0][:, 5:] > 0.0, axis=1)
        for group, members in enumerate(self._groups):
            for part in (self._parts[i] for i in members):
                if not isinstance(part.item, MeshState):
                    continue
                rows = slice(part.face.start - self.vertex_faces, part.face.stop - self.vertex_faces)
                own = np.flatnonzero(emissive[materials.index[rows]]) + rows.start
                if not len(own):
                    continue
                where = self._instances_of(group, part)
                uvs = materials.uvs[own] if len(materials.uvs) else None
                found.append(
                    EmissiveMesh(part.item, part.face, own + self.vertex_faces, materials.index[own], uvs, where)
                )
        return found

    def _instances_of(self, group: int, part: Part) -> range | None:
        """Rows of `instances` in which a part of a group stands; None where it is in world space."""
        if not part.instanced:
            return None
        first, objects = int(self._first_instance[group]), len(self.faults) - len(self._known)
        return range(first, first + len(self._known[part.source - objects][1].matrices))

    def update(
        self, objects: Sequence[TraceObject], meshes: Sequence[MeshState] = (), images: Sequence[Image] = ()
    ) -> None:
        """Take the objects of a new frame: refit what moved, rebuild when faces or visibility changed.

        An object that is the same (``is``) as in the last update is unchanged; so is an array of one that is not.

        Raises
        ------
        UsageError, AssetError
            When an object's arrays do not fit together; names the object.
        """
        items: list[TraceObject | MeshState] = [*objects, *meshes]
        # An update that fails half way leaves nothing to be taken for current.
        (parts, self._parts), (known, self._known) = (self._parts, []), (self._known, [])
        kept = [k[1] if k[0] is mesh else None for k, mesh in zip(known, meshes)]
        kept += [None] * (len(meshes) - len(kept))
        stands = [old or usable_instances(mesh) for old, mesh in zip(kept, meshes)]
        instances: list[Instances | None] = [*([None] * len(objects)), *stands]
        order = _order(items, instances)
        same = [p.source for p in parts] == order and all(p.fits(items[p.source], instances[p.source]) for p in parts)
        if not same:
            parts = self._lay_out(items, instances, order)
        before = [part.item for part in parts]
        vertices = self.bvh.vertices if same else corners(self._vertex_count, np.float32)
        moved, elsewhere, died = set(), set(), not same
        for index, part in enumerate(parts):
            item, where = items[part.source], instances[part.source]
            if part.item is item:
                continue
            if isinstance(item, TraceObject):
                change = take_object(part, item, vertices, self.shading)
            else:
                assert where is not None
                change = take_mesh(part, item, where, vertices, self.normals)
                elsewhere |= {index} if where.instanced else set()
            moved |= {index} if change[0] else set()
            died |= change[1]
        if not same or elsewhere or len(known) != len(meshes):
            self._list_instances(stands, len(items))
        self._number(objects, meshes, stands)
        placed = Placements(stands, self.instances, self._instance_normal, len(objects))
        self.mesh_materials.update(parts, before, meshes, images, (len(objects), self.vertex_faces), placed)
        self._commit(parts, vertices, instances, moved, elsewhere, died)
        self.version = object()
        self.cut = set()
        self.faults = [ObjectFaults(item.name, 0, 0, 0, p.bad if p else 0) for item, p in zip(items, instances)]
        for part in parts:
            fault, bad, empty = self.faults[part.owner], part.bad_vertices, max(part.empty_faces, part.flat_faces)
            fault.bad_vertices, fault.empty_faces = fault.bad_vertices + bad, fault.empty_faces + empty
            fault.bad_faces += part.bad_faces
        self._parts, self._known = parts, list(zip(meshes, stands))

    def at(self, objects: Sequence[Array | None], meshes: Sequence[Pose | None]) -> tuple[Array, Array]:
        """`vertices` and `instances` as they would be with everything at another time, for motion.

        Parameters
        ----------
        objects : sequence of (array or None)
            (n, 3) world-space vertices of every DR-GS object of the last update, or None: as now.
        meshes : sequence of (Pose or None)
            Of every mesh, or None; vertices or matrices of another number than now are ignored, unusable ones too.
        """
        vertices, instances = self.vertices.copy(), self.instances.copy()
        first = np.cumsum([0, *(len(p.matrices) if p.instanced else 0 for _, p in self._known)])
        for part in self._parts:
            own = vertices[part.vertex]
            if isinstance(part.item, TraceObject | ObjectMesh):
                place_vertices(objects[part.owner], None, own)
                continue
            index = part.source - len(objects)
            pose, (mesh, now) = meshes[index], self._known[index]
            if pose is None:
                continue
            given = mesh.vertices if pose.vertices is None else pose.vertices
            moved = other_matrices(pose.matrices, now)
            if now.instanced:
                instances[first[index] : first[index + 1]] = moved
            place_vertices(given, None if now.instanced else moved[0], own)
        return vertices, instances

    def close(self) -> None:
        """Give the tree's memory back."""
        self.bvh.close()

    def _lay_out(
        self, items: Sequence[TraceObject | MeshState], instances: Sequence[Instances | None], order: list[int]
    ) -> list[Part]:
        """Lay out the scene's arrays: all that depends on topology alone."""
        parts, rows = list[Part](), {True: 0, False: 0}
        vertex = face = self.vertex_faces = 0
        for source in order:
            item, where = items[source], instances[source]
            own, n = own_faces(item), len(item.vertices)
            m, smooth, surfels = len(own), item.corner_normals is None, isinstance(item, TraceObject)
            row = rows[surfels]
            # Corners with normals of their own get a row each.
            rows[surfels] += n if smooth else 3 * m
            spans = slice(vertex, vertex + n), slice(face, face + m), slice(row, rows[surfels])
            instanced = where is not None and where.instanced
            parts.append(Part(source, item.name, own, *spans, mask_of(item), smooth, instanced))
            vertex, face = vertex + n, face + m
            self.vertex_faces += m if surfels else 0
        self._vertex_count, self.layout = vertex, object()
        self.any_drgs = any(isinstance(items[source], TraceObject | ObjectMesh) for source in order)
        self.shading_faces, self.face_object = np.empty((face, 3), np.int32), np.empty(face, np.int32)
        for part in parts:
            np.add(part.corner_rows, np.int32(part.row.start), out=self.shading_faces[part.face])
            item = items[part.source]
            self.face_object[part.face] = item.owner if isinstance(item, ObjectMesh) else part.source
        self.shading = np.zeros((rows[True], VERTEX), np.float32)
        self.normals = np.zeros((rows[False], 3), np.float32)
        self.mesh_materials.clear(face - self.vertex_faces)
        # A part with instances is a group of its own; others of one mask share one.
        alike = groupby(range(len(parts)), lambda i: (parts[i].mask, i if parts[i].instanced else -1))
        self._groups = [list(members) for _, members in alike]
        return parts

    def _list_instances(self, where: Sequence[Instances], first: int) -> None:
        """List the instances of meshes that have several; their objects are numbered from `first`."""
        matrices = np.concatenate([np.empty((0, 3, 4)), *(p.matrices for p in where if p.instanced)])
        self.instances = np.ascontiguousarray(matrices, np.float32)
        self._instance_normal = normal_matrices(matrices)
        self.instance_object = np.arange(first, first + len(matrices), dtype=np.int32)

    def _number(self, objects: Sequence[TraceObject], meshes: Sequence[MeshState], where: Sequence[Instances]) -> None:
        """Pass index and flags of all objects and instances; see the class."""
        first = [o.pass_index for o in objects] + [p.pass_index[0] if len(p.pass_index) else 0 for p in where]
        more = [p.pass_index for p in where if p.instanced]
        self.pass_index = np.concatenate([np.array(first, np.int32), *more])
        seen = [o.visibility for o in objects] + [mesh.visibility for mesh in meshes]
        self.rays_differ = any(v.diffuse != v.glossy for v in seen)
        flags = np.array([object_flags(visibility) for visibility in seen], np.int32)
        counts = [0] * len(objects) + [len(p.matrices) if p.instanced else 0 for p in where]
        self.source = np.concatenate([np.arange(len(seen)), np.repeat(np.arange(len(seen)), counts)])
        self.object_flags = flags[self.source]
        self.sheeted = np.array([o.sheeted for o in objects], bool)
        self._offsets.take(objects, meshes, self.source)
        visible = [len(p.matrices) > 0 and m.visibility.camera for m, p in zip(meshes, where)]
        self.any_ordinary = any(v and (not isinstance(m, ObjectMesh) or m.ordinary) for v, m in zip(visible, meshes))

    def _commit(
        self,
        parts: Sequence[Part],
        vertices: Array,
        instances: Sequence[Instances | None],
        moved: set[int],
        elsewhere: set[int],
        other_faces: bool,
    ) -> None:
        """Bring the tree up to date: parts whose vertices `moved`, shapes that stand `elsewhere`."""
        first_instance, count = [], 0
        matrices: dict[int, Array] = {}
        for index, members in enumerate(self._groups):
            where = instances[parts[members[0]].source]
            first_instance.append(count)
            if parts[members[0]].instanced and where is not None:
                matrices[index] = self.instances[count : count + len(where.matrices)]
                count += len(where.matrices)
        self._first_instance = np.array(first_instance or [0], np.int32)
        if other_faces:
            faces = corners(len(self.face_object), np.int32)
            for part in parts:
                np.add(part.traced_faces, np.int32(part.vertex.start), out=faces[part.face])
            groups = [
                Group(parts[m[0]].face.start, parts[m[-1]].face.stop, parts[m[0]].mask, matrices.get(i))
                for i, m in enumerate(self._groups)
            ]
            self.bvh.build(vertices, faces, groups, take=True)
        else:
            changed = [i for i, members in enumerate(self._groups) if moved.intersection(members)]
            placed = {i: m for i, m in matrices.items() if elsewhere.intersection(self._groups[i])}
            self.bvh.refit(None, changed, placed)
        reach = [part.reach for part in parts if not part.instanced]
        for index, m in matrices.items():
            part = parts[self._groups[index][0]]
            reach.append(float((np.abs(m[:, :, :3]).sum(axis=2) * part.reach + np.abs(m[:, :, 3])).max(initial=0.0)))
        self.extent = float(F(max(reach, default=0.0)))


def _order(items: Sequence[TraceObject | MeshState], instances: Sequence[Instances | None]) -> list[int]:
    """Indices of what is traced, in the order of the scene's arrays: objects, meshes of one instance, of several.

    Neighbours of one mask share a group, so each kind is sorted by mask; meshes stay in order of instances.
    """

    def kind(source: int) -> tuple[int, int]:
        where = instances[source]
        if where is None:
            return 0, mask_of(items[source])
        return (2, 0) if where.instanced else (1, mask_of(items[source]))

    here = [i for i, where in enumerate(instances) if (len(items[i].faces) if where is None else len(where.matrices))]
    return sorted(here, key=kind)
