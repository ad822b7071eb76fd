"""Hair: Curves objects, and the particle hair of others, as tubes; point clouds as spheres. `meshes` exports them all.

What is hair, how thick and of which material is as Cycles reads it (Blender's intern/cycles/blender/curves.cpp, and
pointcloud.cpp). A point is a strand of one point here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from mathutils.bvhtree import BVHTree

from ...drgs_blender.core.spheres import FINEST, sphere_faces, spheres
from ...drgs_blender.core.strands import MOST_TRIANGLES, SEGMENTS, SIDES, Tubes, triangle_count, tubes
from .. import mesh_arrays
from .layers import HAIR_INFO, LayerRef, attribute_values

Array = np.ndarray
Warn = Callable[[str], None]

#: Of hair curves without a radius, in object space.
_RADIUS = 0.005
#: Of points without one.
_POINT_RADIUS = 0.01
_POLY = 1
#: Modes in which the strands of an object are edited, and not rendered.
_EDITED = ("EDIT", "PARTICLE_EDIT")


@dataclass(frozen=True, slots=True)
class Strands:
    """The strands of an object, in its space.

    Attributes
    ----------
    points, radii : (n, 3), (n,) float32 array
    offsets : (k + 1,) int array
        First point of each strand, and `n`.
    slot : (k,) int32 array
        Material slot of each.
    linear : bool
        Straight between their points.
    are_points : bool
        Spheres.
    """

    points: Array
    radii: Array
    offsets: Array
    slot: Array
    linear: bool = False
    are_points: bool = False

    def tubes(self, name: str = "", warn: Warn = lambda text: None) -> Tubes:
        """As a mesh; coarser where it would be too large, with a warning that has the object's `name`."""
        if self.are_points:
            return self._spheres(name, warn)
        count, details = len(self.slot), [(1 if self.linear else SEGMENTS, SIDES), (1, SIDES), (1, 3)]
        wanted = [triangle_count(self.offsets, *detail) for detail in details]
        best = next((i for i, triangles in enumerate(wanted) if triangles <= MOST_TRIANGLES), len(details) - 1)
        segments, sides = details[best]
        made = tubes(self.points, self.offsets, self.radii, linear=self.linear, segments=segments, sides=sides)
        if wanted[0] > MOST_TRIANGLES:
            warn(
                f'"{name}": its {count:,} strands would be {wanted[0]:,} triangles; with {sides} sides and as many '
                f"pieces as they are given they are {len(made.faces):,}. Fewer strands, or fewer points on each (of "
                "particles: Render > Steps), take less memory and time"
            )
        seen = np.zeros(count, bool)
        seen[made.strand[made.ring]] = True
        bad = int(made.bad.sum())
        if bad:
            warn(f'"{name}": {bad:,} of its {count:,} strands have a number that is not finite; they are left out')
        if empty := count - int(seen.sum()) - bad:
            warn(f'"{name}": {empty:,} of its {count:,} strands have no length or no thickness; they are left out')
        return made

    def _spheres(self, name: str, warn: Warn) -> Tubes:
        """Of points, the finer the fewer they are."""
        count = len(self.points)
        level = next((k for k in range(FINEST, 0, -1) if count * sphere_faces(k) <= MOST_TRIANGLES), 0)
        made = spheres(self.points, self.radii, level)
        if count * sphere_faces(level) > MOST_TRIANGLES:
            warn(f'"{name}": its {count:,} points are {len(made.faces):,} triangles. Fewer take less memory and time')
        if bad := int(made.bad.sum()):
            warn(f'"{name}": {bad:,} of its {count:,} points have a number that is not finite; they are left out')
        if empty := int((self.radii <= 0).sum()):
            warn(f'"{name}": {empty:,} of its {count:,} points have no radius; they are left out')
        return made


def systems(obj: bpy.types.Object, mode: str) -> Iterator[Any]:
    """Modifiers of an evaluated object whose particles are hair, drawn as such by a depsgraph of that mode."""
    if obj.type != "MESH" or obj.mode in _EDITED:
        return
    for modifier in obj.modifiers:
        if modifier.type == "PARTICLE_SYSTEM":
            shown = modifier.show_render if mode == "RENDER" else modifier.show_viewport
            settings = modifier.particle_system.settings
            if shown and settings.type == "HAIR" and settings.render_type == "PATH":
                yield modifier


def read_strands(obj: bpy.types.Object, mode: str) -> Strands:
    """Of an evaluated Curves or Point Cloud object, or of the particles on another, for a depsgraph of a mode."""
    if obj.type == "POINTCLOUD":
        return _of_points(obj.data)
    return _of_curves(obj.data) if obj.type == "CURVES" else _of_particles(obj, mode)


def _of_points(data: Any) -> Strands:
    count = len(data.points)
    points = np.zeros((count, 3), np.float32)
    if count:
        data.attributes["position"].data.foreach_get("vector", points.ravel())
    radii = np.full(count, _POINT_RADIUS, np.float32)
    attribute = data.attributes.get("radius")
    if attribute is not None and attribute.data_type == "FLOAT" and len(attribute.data) == count:
        attribute.data.foreach_get("value", radii)
    offsets = np.arange(count + 1, dtype=np.int32)
    return Strands(points, radii, offsets, np.zeros(count, np.int32), are_points=True)


def _of_curves(data: Any) -> Strands:
    offsets = np.zeros(len(data.curves) + 1, np.int32)
    if len(data.curves):
        data.curve_offset_data.foreach_get("value", offsets)
    points = np.zeros((len(data.points), 3), np.float32)
    if len(points):
        data.attributes["position"].data.foreach_get("vector", points.ravel())
    radii = np.full(len(points), _RADIUS, np.float32)
    attribute = data.attributes.get("radius")
    if attribute is not None and attribute.data_type == "FLOAT" and len(attribute.data):
        values = np.empty(len(attribute.data), np.float32)
        attribute.data.foreach_get("value", values)
        radii = values if attribute.domain == "POINT" else np.repeat(values, np.diff(offsets))
    kind = data.attributes.get("curve_type")
    linear = kind is not None and len(kind.data) > 0 and kind.data[0].value == _POLY
    return Strands(points, radii, offsets, np.zeros(len(data.curves), np.int32), linear)


def _numbers(system: Any, mode: str) -> range:
    """Numbers of the particles that are strands: children where there are some, else parents."""
    parents, children = len(system.particles), len(system.child_particles)
    if mode != "RENDER":
        children = int(children * system.settings.display_percentage / 100)
    first = parents if system.settings.child_type != "NONE" and children else 0
    return range(first, parents + children)


def _of_particles(obj: bpy.types.Object, mode: str) -> Strands:
    slots = max(len(obj.material_slots), 1)
    places, radii, counts, slot = [], [], [], []
    for modifier in systems(obj, mode):
        system, settings = modifier.particle_system, modifier.particle_system.settings
        steps = (1 << (settings.render_step if mode == "RENDER" else settings.display_step)) + 1
        if settings.kink == "SPIRAL":
            steps += settings.kink_extra_steps
        numbers, place = _numbers(system, mode), system.co_hair
        found = [place(object=obj, particle_no=i, step=step)[:] for i in numbers for step in range(steps)]
        points = np.array(found, np.float32).reshape(-1, steps, 3)
        for step in range(1, steps):  # past the end of a strand that is cut Blender says 0
            np.copyto(points[:, step], points[:, step - 1], where=~points[:, step].any(axis=1, keepdims=True))
        inverse = np.linalg.pinv(np.nan_to_num(np.array(obj.matrix_world, np.float64)))
        points = (points @ inverse[:3, :3].T + inverse[:3, 3]).astype(np.float32)
        places.append(points.reshape(-1, 3))
        radii.append(_profile(points, settings).reshape(-1))
        counts.append(np.full(len(points), steps))
        slot.append(np.full(len(points), min(max(settings.material - 1, 0), slots - 1), np.int32))
    offsets = np.concatenate(([0], np.cumsum(np.concatenate(counts)))).astype(np.int32)
    return Strands(np.concatenate(places), np.concatenate(radii), offsets, np.concatenate(slot))


def _profile(points: Array, settings: Any) -> Array:
    """(k, s) radii of strands of (k, s, 3) points: from root to tip by the settings' Strand Shape."""
    along = np.zeros(points.shape[:2])
    along[:, 1:] = np.cumsum(np.linalg.norm(np.diff(points, axis=1), axis=2), axis=1)
    whole = along[:, -1:]
    rest = np.clip(1 - np.divide(along, whole, out=np.zeros_like(along), where=whole > 0), 0, 1)
    shape = settings.shape
    rest = rest ** (1 + shape if shape < 0 else 1 / max(1 - shape, 1e-6))
    half = 0.5 * settings.radius_scale
    radii = half * (rest * (settings.root_radius - settings.tip_radius) + settings.tip_radius)
    if settings.use_close_tip:
        radii[:, -1] = 0
    return radii.astype(np.float32)


class Hair:
    """What stands for the mesh where the materials of strands are read; valid while the evaluated object is."""

    def __init__(self, obj: bpy.types.Object, strands: Strands, made: Tubes) -> None:
        self._data = obj.data
        self._places: tuple[tuple[Array, ...], Array] | None = None
        self.strands, self.tubes, self.name = strands, made, obj.data.name
        self.polygons = range(len(made.faces))
        self._has_values = obj.type != "MESH"  # else they are those of the emitter
        self.color_attributes: Any = () if self._has_values else self._data.color_attributes

    def as_pointer(self) -> int:
        """Unlike that of the mesh on which it grows."""
        return self._data.as_pointer() + (not self._has_values)

    @property
    def uv_layers(self) -> list[str]:
        """Names of its UV maps, those of the roots."""
        if self._has_values:
            return [a.name for a in self._data.attributes if a.data_type == "FLOAT2" and a.domain == "CURVE"]
        return [layer.name for layer in self._data.uv_layers]

    def corner_uvs(self, name: str) -> Array | None:
        """(3 m, 2) float32 UVs of the root at all corners of the faces; None where there is no such map.

        "" is the one that renders: of Curves the first.
        """
        if self._has_values:
            names = self.uv_layers
            roots = attribute_values(self._data, name or names[0]) if names and (not name or name in names) else None
        else:
            uvs = mesh_arrays.read_uvs(self._data, name)
            roots = None if uvs is None else self._at_roots(uvs, "CORNER")
        made = self.tubes
        return None if roots is None else np.repeat(roots[made.strand[made.ring], :2], 3, axis=0)

    def attribute_values(self, name: str) -> Array | None:
        """(n, 4) float32 values as of `layers.attribute_values`; of particles those of the emitter at the roots."""
        if name in HAIR_INFO:
            values = self._info(name)
            return np.column_stack((values, values, values, np.ones_like(values))).astype(np.float32)
        found = attribute_values(self._data, name)
        return found if found is None or self._has_values else self._at_roots(found, self._data.attributes[name].domain)

    def layer(self, ref: LayerRef) -> Array | None:
        """(m, 3, 2) or (m, 3, 4) float32 at the corners of the faces, as of `LayerRef.values`."""
        if ref.source == "uv":
            uvs = self.corner_uvs(ref.name)
            return None if uvs is None else uvs.reshape(-1, 3, 2)
        if ref.source == "tangent":
            return self._at_corners(self._directions(), "POINT")
        if ref.source == "attribute":
            values = self.attribute_values(ref.name)
            if values is None:
                return None
            values = values if ref.change is None else ref.change(values)
            return self._at_corners(np.asarray(values, np.float32), self._domain(ref.name))
        if ref.source == "vector":
            values = self.attribute_values(ref.name)
            if values is None:
                return None
            values, domain = values[:, :3], self._domain(ref.name)
        elif ref.source == "generated":
            values, domain = self._generated(), "CURVE"
        else:
            values, domain = self.strands.points, "POINT"
        matrix = np.array(ref.matrix)
        return self._at_corners((values @ matrix[:2, :3].T + matrix[:2, 3]).astype(np.float32), domain)

    def _domain(self, name: str) -> str:
        if name in HAIR_INFO:
            return HAIR_INFO[name]
        return str(self._data.attributes[name].domain) if self._has_values else "CURVE"

    def _info(self, name: str) -> Array:
        """What the node Hair Info says: (n,) the part of the way to the tip, or (k,) a random number."""
        points, offsets = self.strands.points.astype(np.float64), self.strands.offsets
        if HAIR_INFO[name] == "CURVE":
            return np.random.default_rng(0).random(len(offsets) - 1)
        first = np.repeat(offsets[:-1], np.diff(offsets))
        step = np.zeros(len(points))
        step[1:] = np.linalg.norm(np.diff(points, axis=0), axis=1)
        step[first] = 0
        along = np.cumsum(np.nan_to_num(step))
        along -= along[first]
        whole = along[np.repeat(offsets[1:] - 1, np.diff(offsets))]
        return along / np.maximum(whole, 1e-12)

    def _directions(self) -> Array:
        """(n, 4) float32: towards the tip at each point; the length says nothing."""
        points, offsets = np.nan_to_num(self.strands.points), self.strands.offsets
        first, last = (np.repeat(ends, np.diff(offsets)) for ends in (offsets[:-1], offsets[1:] - 1))
        number = np.arange(len(points))
        along = points[np.minimum(number + 1, last)] - points[np.maximum(number - 1, first)]
        return np.column_stack((along, np.zeros(len(points), np.float32)))

    def _generated(self) -> Array:
        """(k, 3): of particles the root in the mesh's texture space, of Curves the root."""
        roots = self._roots()
        if self._has_values:
            return roots
        size = np.array(self._data.texspace_size)
        size = np.divide(0.5, size, out=np.zeros(3), where=size != 0)
        return (roots - np.array(self._data.texspace_location)) * size + 0.5

    def _roots(self) -> Array:
        """(k, 3): the first point of each strand."""
        return self.strands.points[np.minimum(self.strands.offsets[:-1], max(len(self.strands.points) - 1, 0))]

    def _at_roots(self, values: Array, domain: str) -> Array:
        """(k, c) float32: values of the mesh on which the strands grow, where it is nearest to their roots."""
        mesh = self._data
        if self._places is None:
            corners, polygons = mesh_arrays.read_loop_triangles(mesh)
            vertices = np.nan_to_num(mesh_arrays.read_vertices(mesh)).astype(np.float64)
            faces = mesh_arrays.read_corner_vertices(mesh)[corners]
            tree = BVHTree.FromPolygons(vertices.tolist(), faces.tolist(), all_triangles=True)
            found = [tree.find_nearest(root)[2] for root in np.nan_to_num(self._roots()).tolist()]
            face = np.array([0 if number is None else number for number in found], np.int64)
            weights = _barycentric(self._roots().astype(np.float64), vertices[faces[face]])
            self._places = (corners[face], polygons[face], faces[face]), weights
        (corner, polygon, vertex), weights = self._places
        if domain == "FACE":
            return values[polygon]
        return np.einsum("kj,kjc->kc", weights, values[corner if domain == "CORNER" else vertex]).astype(np.float32)

    def _at_corners(self, values: Array, domain: str) -> Array:
        """(m, 3, c) values of strands or points at the corners of the faces."""
        made = self.tubes
        rings = values[made.strand] if domain == "CURVE" else made.blend(values).astype(np.float32)
        return rings[made.faces // (2 * made.sides)]


def _barycentric(points: Array, triangles: Array) -> Array:
    """(k, 3) weights, within [0, 1], of the corners of a triangle (k, 3, 3) each for points (k, 3) on it."""
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    p = points - triangles[:, 0]
    aa, ab, bb, pa, pb = ((x * y).sum(axis=1) for x, y in ((a, a), (a, b), (b, b), (p, a), (p, b)))
    area = np.maximum(aa * bb - ab * ab, 1e-30)
    weights = np.clip(np.stack((aa * 0, bb * pa - ab * pb, aa * pb - ab * pa), axis=1) / area[:, None], 0, 1)
    weights[:, 0] = np.clip(1 - weights[:, 1] - weights[:, 2], 0, 1)
    return np.nan_to_num(weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-9))
