"""The BVH of all triangles, with refit: they move, in the world as they are or as instances."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...compute.jit import njit
from ...compute.simd import aligned
from ...compute.threads import ELEMENTS, over_range
from ...core.errors import DeviceError, UsageError
from . import embree
from .embree import blocked, trace
from .ray import Rays, ray_at

Array = np.ndarray

#: Neither vertices nor faces.
_NONE = np.empty((0, 3), np.int32)
#: A mask that every ray meets, and that meets every group.
ALL = -1

#: Rebuild when the boxes of neighbouring triangles have grown this much against the whole scene's box.
DEGRADED = 2.0
_RUN = 32  # neighbouring triangles in one box of that measure
_RUNS = 1024  # boxes looked at
#: Rays that one thread traces at least.
_RAYS = 512


@dataclass(slots=True)
class Group:
    """A run of faces that rays meet or pass together.

    Attributes
    ----------
    first, last : int
        The faces, half-open.
    mask : int
        int32 bits; a ray meets the group when it has one of them.
    instances : array, optional
        None when the vertices are in world space; else (k, 3, 4) float32 object-to-world matrices, invertible: the
        group's faces have k instances that share one tree.
    """

    first: int
    last: int
    mask: int = ALL
    instances: Array | None = None


@njit
def _intersect(first, last, tree, rays, t, face, instance, u, v):  # type: ignore[no-untyped-def]
    address, scene, first_face = tree
    for i in range(first, last):
        t[i], group, primitive, instance[i], u[i], v[i], _, _, _ = trace(address, scene, ray_at(rays, i))
        face[i] = first_face[group] + primitive if group >= 0 else np.int32(-1)


@njit
def _occluded(first, last, address, scene, rays, out):  # type: ignore[no-untyped-def]
    for i in range(first, last):
        out[i] = blocked(address, scene, ray_at(rays, i))


def looseness(vertices: Array, faces: Array, runs: Array) -> float:
    """Summed box surface of runs of once neighbouring triangles, relative to the box of them all.

    Parameters
    ----------
    vertices : (n, 3) float32 array
    faces : (m, 3) int32 array
    runs : (g, 32) int32 array
        See `neighbours`.
    """
    boxes = np.empty((len(runs), 6), np.float32)
    over_range(_boxes, len(runs), vertices, faces, runs, boxes, fewest=ELEMENTS // _RUN)
    return float(_relative_surface(boxes))


@njit
def _boxes(first, last, vertices, faces, runs, boxes):  # type: ignore[no-untyped-def]
    for g in range(first, last):
        x0 = y0 = z0 = np.float32(np.inf)
        x1 = y1 = z1 = np.float32(-np.inf)
        for k in range(runs.shape[1]):
            for c in range(3):
                v = faces[runs[g, k], c]
                x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2]
                x0, y0, z0 = min(x0, x), min(y0, y), min(z0, z)
                x1, y1, z1 = max(x1, x), max(y1, y), max(z1, z)
        boxes[g, 0], boxes[g, 1], boxes[g, 2], boxes[g, 3], boxes[g, 4], boxes[g, 5] = x0, y0, z0, x1, y1, z1


@njit
def _relative_surface(boxes):  # type: ignore[no-untyped-def]
    """Summed surface of some boxes, relative to that of the box around them."""
    total = 0.0
    lowest, highest = np.full(3, np.inf), np.full(3, -np.inf)
    for g in range(len(boxes)):
        x, y, z = boxes[g, 3] - boxes[g, 0], boxes[g, 4] - boxes[g, 1], boxes[g, 5] - boxes[g, 2]
        total += x * y + y * z + z * x
        for a in range(3):
            lowest[a], highest[a] = min(lowest[a], boxes[g, a]), max(highest[a], boxes[g, 3 + a])
    x, y, z = highest[0] - lowest[0], highest[1] - lowest[1], highest[2] - lowest[2]
    whole = x * y + y * z + z * x
    return total / whole if whole > 0.0 else 0.0


@njit
def _centres(first, last, vertices, faces, out):  # type: ignore[no-untyped-def]
    for i in range(first, last):
        a, b, c = faces[i, 0], faces[i, 1], faces[i, 2]
        for k in range(3):
            out[i, k] = (vertices[a, k] + vertices[b, k] + vertices[c, k]) * np.float32(1 / 3)


@njit
def _spread(x):  # type: ignore[no-untyped-def]
    """The lowest ten bits of a number with two free ones after each."""
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        x = (x | x << shift) & mask
    return x


@njit
def _keys(first, last, centre, low, scale, out):  # type: ignore[no-untyped-def]
    """Morton code of each centre and, below it, its index: no two are alike."""
    for i in range(first, last):
        x = _spread(np.int64((centre[i, 0] - low[0]) * scale[0]))
        y = _spread(np.int64((centre[i, 1] - low[1]) * scale[1]))
        z = _spread(np.int64((centre[i, 2] - low[2]) * scale[2]))
        out[i] = np.uint64((x | y << 1 | z << 2) << 32 | i)


def neighbours(vertices: Array, faces: Array) -> Array:
    """(g, 32) int32: runs of faces along a Morton curve through the centroids, evenly chosen."""
    m = len(faces)
    if m < 4 * _RUN:
        return np.empty((0, _RUN), np.int32)
    centre = np.empty((m, 3), np.float32)
    over_range(_centres, m, vertices, faces, centre, fewest=ELEMENTS)
    low, high = (np.array([f(x) for x in centre.T]) for f in (np.min, np.max))  # along an axis is 20 times slower
    key = np.empty(m, np.uint64)
    scale = np.float32(1023) / np.maximum(high - low, np.float32(1e-30))
    over_range(_keys, m, centre, low, scale, key, fewest=ELEMENTS)
    key.sort()
    order = key.astype(np.uint32).view(np.int32)
    runs = order[: m // _RUN * _RUN].reshape(-1, _RUN)
    return np.ascontiguousarray(runs[:: max(1, math.ceil(len(runs) / _RUNS))])


def corners(count: int, kind: type) -> Array:
    """(count, 3) zeros, with the room behind them that Embree reads."""
    return aligned(3 * count, kind).reshape(count, 3)


class _Part:
    """Embree geometry of one group: its triangles and instances."""

    def __init__(self, top: int, index: int, group: Group, vertices: Array, faces: Array) -> None:
        self._lib, self._device = embree.library(), embree.device()
        self._top, self._index, self._mask = top, index, group.mask & 0xFFFFFFFF
        self._vertices, self._faces, self._first = vertices, faces[group.first : group.last], group.first
        self._triangles: int | None = None
        self._instances: int | None = None
        self._shape: int | None = None
        if group.instances is not None:
            self._shape = new_scene()
        self.build()
        if group.instances is not None:
            self._instances = self._lib.rtcNewGeometry(self._device, embree.GEOMETRY_INSTANCE_ARRAY)
            self._lib.rtcSetGeometryInstancedScene(self._instances, self._shape)
            self._lib.rtcSetGeometryMask(self._instances, self._mask)
            self._lib.rtcAttachGeometryByID(top, self._instances, index)
            self.set_instances(group.instances)

    def build(self) -> None:
        """Build the triangles' own tree from scratch."""
        lib = self._lib
        scene, index = (self._top, self._index) if self._shape is None else (self._shape, 0)
        if self._triangles is not None:
            lib.rtcDetachGeometry(scene, index)
            lib.rtcReleaseGeometry(self._triangles)
        self._triangles = lib.rtcNewGeometry(self._device, embree.GEOMETRY_TRIANGLE)
        for kind, form, array in (
            (embree.BUFFER_VERTEX, embree.FORMAT_FLOAT3, self._vertices),
            (embree.BUFFER_INDEX, embree.FORMAT_UINT3, self._faces),
        ):
            lib.rtcSetSharedGeometryBuffer(self._triangles, kind, 0, form, array.ctypes.data, 0, 12, len(array))
        lib.rtcSetGeometryBuildQuality(self._triangles, embree.QUALITY_REFIT)
        lib.rtcSetGeometryMask(self._triangles, self._mask)
        lib.rtcAttachGeometryByID(scene, self._triangles, index)
        self._commit()
        self._runs = neighbours(self._vertices, self._faces)
        self._looseness = looseness(self._vertices, self._faces, self._runs)

    def refit(self) -> bool:
        """Follow moved vertices; True when the tree was worn out and rebuilt instead."""
        worn = len(self._runs) > 0 and (looseness(self._vertices, self._faces, self._runs) > DEGRADED * self._looseness)
        if worn:
            self.build()
        else:
            self._lib.rtcUpdateGeometryBuffer(self._triangles, embree.BUFFER_VERTEX, 0)
            self._commit()
        return worn

    def set_instances(self, instances: Array) -> None:
        """Let the group stand in (k, 3, 4) `instances`, copied."""
        self._matrices = aligned(12 * len(instances), np.float32).reshape(-1, 3, 4)
        self._matrices[:] = instances
        self._lib.rtcSetSharedGeometryBuffer(
            self._instances, embree.BUFFER_TRANSFORM, 0, embree.FORMAT_FLOAT3X4_ROW_MAJOR,
            self._matrices.ctypes.data, 0, 48, len(instances),
        )  # fmt: skip
        self._lib.rtcCommitGeometry(self._instances)

    def _commit(self) -> None:
        self._lib.rtcCommitGeometry(self._triangles)
        if self._shape is not None:
            self._lib.rtcCommitScene(self._shape)
        if self._instances is not None:
            self._lib.rtcCommitGeometry(self._instances)  # its boxes follow the shape's

    def release(self) -> None:
        """Give what Embree holds back; the top scene must have been released before."""
        for geometry in (self._instances, self._triangles):
            if geometry is not None:
                self._lib.rtcReleaseGeometry(geometry)
        if self._shape is not None:
            self._lib.rtcReleaseScene(self._shape)


def new_scene() -> int:
    """An empty Embree scene whose geometries are refitted.

    Only a dynamic scene of low quality keeps one tree a geometry, and only such a tree is refitted; any other scene
    silently rebuilds at each commit. The geometry's own tree is of full quality either way.
    """
    lib = embree.library()
    scene = lib.rtcNewScene(embree.device())
    lib.rtcSetSceneFlags(scene, embree.SCENE_DYNAMIC)
    lib.rtcSetSceneBuildQuality(scene, embree.QUALITY_LOW)
    return int(scene)


def box_of(scene: int) -> tuple[Array, Array]:
    """Lowest and highest corner of the box around a committed scene, (3,) float32 each; zeros when it is empty."""
    box = np.zeros(8, np.float32)
    if scene:
        embree.library().rtcGetSceneBounds(scene, box.ctypes.data)
    low, high = box[:3].copy(), box[4:7].copy()
    return (low, high) if (low <= high).all() else (np.zeros(3, np.float32), np.zeros(3, np.float32))


class TriangleBVH:
    """Triangles ready for ray casting, whose vertices may move.

    Attributes
    ----------
    vertices : (n, 3) float32 array
        Metres, the coordinates Embree reads; write into them and call ``refit()``.
    faces : (m, 3) int32 array
    first_face : (groups,) int32 array
        The first face of each group, what turns a traced primitive into a face.
    intersect_address, occluded_address, scene : int
        Arguments of ``trace`` and ``blocked`` in compiled code.
    rebuilds : int
        How often a group's tree was built from scratch.
    """

    def __init__(self, vertices: Array = _NONE, faces: Array = _NONE) -> None:
        self._lib = embree.library()
        self.intersect_address = embree.address(self._lib.rtcIntersect1)
        self.occluded_address = embree.address(self._lib.rtcOccluded1)
        self.scene: int = 0
        self.first_face: Array = np.zeros(1, np.int32)
        self.rebuilds = 0
        self._parts: list[_Part] = []
        self.build(vertices, faces)

    def build(self, vertices: Array, faces: Array, groups: Sequence[Group] | None = None, take: bool = False) -> None:
        """Rebuild the trees from (n, 3) vertices and (m, 3) faces.

        Parameters
        ----------
        vertices, faces : array
        groups : sequence of Group, optional
            Runs of `faces`; by default one of them all, which every ray meets.
        take : bool
            Take arrays of `corners` as they are; others are copied.

        Raises
        ------
        UsageError
            When a face refers to a vertex that does not exist.
        DeviceError
            When Embree fails (out of memory).
        """
        n, m = len(vertices), len(faces)
        if m and (np.min(faces) < 0 or np.max(faces) >= n):
            raise UsageError("mesh", f"faces refer to vertices outside 0..{n - 1}", "Check the mesh's indices")
        self._release()
        if not take:
            given = vertices, faces
            vertices, faces = corners(n, np.float32), corners(m, np.int32)
            vertices[:], faces[:] = given
        self.vertices, self.faces = vertices, faces
        groups = [Group(0, m)] if groups is None else groups
        self.first_face = np.array([g.first for g in groups] or [0], np.int32)
        self.scene = new_scene()
        for index, group in enumerate(groups):
            self._parts.append(_Part(self.scene, index, group, self.vertices, self.faces))
        self._commit()
        self.rebuilds += len(groups)

    def refit(
        self,
        vertices: Array | None = None,
        moved: Collection[int] | None = None,
        instances: Mapping[int, Array] | None = None,
    ) -> None:
        """Follow moved vertices; rebuild the tree of a group that is worn out.

        Parameters
        ----------
        vertices : (n, 3) array, optional
            Or None: those already written into ``self.vertices``.
        moved : iterable of int, optional
            The groups whose vertices moved, or None: all.
        instances : mapping of int to array, optional
            group -> new (k, 3, 4) matrices, for groups that were built with instances.
        """
        if vertices is not None:
            self.vertices[:] = vertices
        for index in range(len(self._parts)) if moved is None else sorted(moved):
            self.rebuilds += self._parts[index].refit()
        for index, matrices in (instances or {}).items():
            self._parts[index].set_instances(matrices)
        self._commit()

    def _commit(self) -> None:
        self._lib.rtcCommitScene(self.scene)
        if error := self._lib.rtcGetDeviceError(embree.device()):
            raise DeviceError(
                "Embree", f"failed with error {error} on {len(self.faces)} triangles", "Use a smaller mesh"
            )

    def intersect(
        self, origins: Array, directions: Array, tnear: float = 0.0, tfar: float = math.inf, mask: int = ALL
    ) -> tuple[Array, Array, Array, Array]:
        """Closest hits of many rays: t (n,), face (n,) int32 or -1, u (n,), v (n,); t in units of the direction."""
        t, face, _, u, v = self.hits(origins, directions, tnear, tfar, mask)
        return t, face, u, v

    def hits(
        self, origins: Array, directions: Array, tnear: float = 0.0, tfar: float = math.inf, mask: int = ALL
    ) -> tuple[Array, Array, Array, Array, Array]:
        """As `intersect`, with the instance of the face's group between face and u: (n,) int32 or -1."""
        t, u, v = np.empty((3, len(origins)), np.float32)
        face, instance = np.empty((2, len(origins)), np.int32)
        rays = Rays.of(origins, directions, tnear, tfar, mask)
        tree = self.intersect_address, self.scene, self.first_face
        over_range(_intersect, len(t), tree, rays, t, face, instance, u, v, fewest=_RAYS)
        return t, face, instance, u, v

    def occluded_many(
        self, origins: Array, directions: Array, tnear: float = 0.0, tfar: float = math.inf, mask: int = ALL
    ) -> Array:
        """(n,) bool: whether anything lies on each ray."""
        out = np.empty(len(origins), np.bool_)
        rays = Rays.of(origins, directions, tnear, tfar, mask)
        over_range(_occluded, len(out), self.occluded_address, self.scene, rays, out, fewest=_RAYS)
        return out

    def _release(self) -> None:
        if self.scene:
            self._lib.rtcReleaseScene(self.scene)
            self.scene = 0
        for part in self._parts:
            part.release()
        self._parts = []

    def bounds(self) -> tuple[Array, Array]:
        """Lowest and highest corner of the box around everything, (3,) float32 each; zeros when there is nothing."""
        return box_of(self.scene)

    def close(self) -> None:
        """Give the trees' memory back; the object cannot be used afterwards."""
        self._release()

    def __del__(self) -> None:
        if getattr(self, "scene", 0):
            self.close()
