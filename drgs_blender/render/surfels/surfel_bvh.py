"""The BVH of surfels in Embree: a user geometry whose primitives are the surfels' discs; see `surfel_query`."""

from __future__ import annotations

import ctypes
import math

import numpy as np

from ...compute.jit import njit, plain
from ...core.asset.model import PosedSurfels
from ...core.errors import DeviceError, UsageError
from ..scene.embree import QUALITY_LOW, QUALITY_REFIT, SCENE_DYNAMIC, address, device, library
from ..scene.triangle_bvh import aligned, box_of, looseness, neighbours
from ..surfel_columns import ALBEDO, METALLIC, NORMAL, PLANE, ROUGHNESS, SIZE, SURFEL
from .splats import MIN_ALPHA, Posed
from .surfel_query import CUT, MASK, OBJECT, OPACITY, RECORD, TANGENT_U, TANGENT_V, WIDTH, callbacks

Array = np.ndarray

_GEOMETRY_USER = 120
_ROBUST = 4  # a scene's flag: no box is missed by rounding
_DEGRADED = 2.0  # as in tree.py: rebuild when the boxes of once neighbouring discs have grown this much
_FARTHEST = 1e15  # coordinates beyond are as unusable as NaN


@njit
def _record(posed, masks, words, boxes, surface):  # type: ignore[no-untyped-def]
    """Fill records, boxes of the discs and what hits look like; returns how many surfels are not finite.

    `posed` is a `Posed`.
    """
    centre, tangent_u, tangent_v, normal, opacity, albedo, roughness, metallic, objects = posed
    singles = words.view(np.float32)
    bad = 0
    for i in range(len(centre)):
        total = abs(opacity[i])
        uu = vv = 0.0
        for k in range(3):
            total += abs(centre[i, k]) + abs(tangent_u[i, k]) + abs(tangent_v[i, k])
            uu += np.float64(tangent_u[i, k]) ** 2
            vv += np.float64(tangent_v[i, k]) ** 2
        usable = total < _FARTHEST
        bad += not usable
        seen = usable and opacity[i] > MIN_ALPHA
        cut = 2.0 * math.log(opacity[i] / MIN_ALPHA) if seen else 0.0
        for k in range(3):
            c, a, b = centre[i, k], tangent_u[i, k], tangent_v[i, k]
            singles[i, k] = c if usable else 0.0
            singles[i, TANGENT_U + k], singles[i, TANGENT_V + k] = (a, b) if seen else (0.0, 0.0)
            reach = math.sqrt(cut * (a * a + b * b)) if seen else 0.0
            boxes[2 * i, k], boxes[2 * i + 1, k] = singles[i, k] - reach, singles[i, k] + reach
        singles[i, OPACITY], singles[i, CUT] = (opacity[i], cut) if seen else (0.0, 0.0)
        singles[i, WIDTH] = math.sqrt(max(uu, vv)) if seen else 0.0
        words[i, OBJECT], words[i, MASK] = objects[i], masks[objects[i]]
        for k in range(3):
            surface[i, NORMAL + k] = normal[i, k] if math.isfinite(normal[i, k]) else 0.0
            surface[i, ALBEDO + k] = _fraction(albedo[i, k])
        surface[i, ROUGHNESS], surface[i, METALLIC] = _fraction(roughness[i]), _fraction(metallic[i])
        surface[i, SIZE] = singles[i, WIDTH]
        ax, ay, az = (
            np.float64(singles[i, TANGENT_U]),
            np.float64(singles[i, TANGENT_U + 1]),
            np.float64(singles[i, TANGENT_U + 2]),
        )
        bx, by, bz = (
            np.float64(singles[i, TANGENT_V]),
            np.float64(singles[i, TANGENT_V + 1]),
            np.float64(singles[i, TANGENT_V + 2]),
        )
        x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        length = math.sqrt(x * x + y * y + z * z)
        scale = 1.0 / length if length > 0.0 else 0.0
        surface[i, PLANE], surface[i, PLANE + 1], surface[i, PLANE + 2] = x * scale, y * scale, z * scale
    return bad


@njit
def _fraction(x):  # type: ignore[no-untyped-def]
    """Clamp to [0, 1]; NaN becomes 0."""
    return min(max(x, np.float32(0.0)), np.float32(1.0)) if x > 0.0 else np.float32(0.0)


class SurfelBVH:
    """The surfels of a frame, ready for ray casting; they may move from frame to frame.

    Attributes
    ----------
    intersect_address, occluded_address, scene : int
        Arguments of `trace_surfels` and `transmittance` in compiled code.
    surface : (n, SURFEL) float32 array
        Blended attributes of each surfel, see `columns`.
    objects : (n,) int32 array
        Index of each surfel's object.
    rebuilds : int
        How often the tree was built from scratch.
    bad : int
        How many surfels of the last update have a number that is not finite; they are never met.
    """

    def __init__(self) -> None:
        lib = self._lib = library()
        pointer, unsigned = ctypes.c_void_p, ctypes.c_uint
        for name, arguments in (
            ("rtcSetGeometryUserPrimitiveCount", [pointer, unsigned]),
            ("rtcSetGeometryUserData", [pointer, pointer]),
            ("rtcSetGeometryBoundsFunction", [pointer, pointer, pointer]),
            ("rtcSetGeometryIntersectFunction", [pointer, pointer]),
            ("rtcSetGeometryOccludedFunction", [pointer, pointer]),
        ):
            function = getattr(lib, name)
            function.restype, function.argtypes = None, arguments
        self.intersect_address = address(lib.rtcIntersect1)
        self.occluded_address = address(lib.rtcOccluded1)
        self._device = device()
        self._geometry: int | None = None
        self.scene: int = 0
        self.surface: Array = np.empty((0, SURFEL), np.float32)
        self.objects: Array = np.empty(0, np.int32)
        self.rebuilds = self.bad = 0
        self._words: Array = np.empty((0, RECORD), np.int32)
        self._runs: Array = np.empty((0, 0), np.int32)
        self._looseness = 0.0
        self._construct(np.empty((0, 3), np.float32))

    def __len__(self) -> int:
        return len(self._words)

    def update(self, posed: PosedSurfels, masks: Array | None = None) -> None:
        """Take the surfels of a new frame: refit when there are as many as before, rebuild otherwise.

        Parameters
        ----------
        posed : PosedSurfels
            Surfels in world space.
        masks : (objects,) int32 array, optional
            A ray meets the surfels of an object when the two masks share a bit; None: all do.

        Raises
        ------
        UsageError
            When a surfel's object has no mask.
        DeviceError
            When Embree fails (out of memory).
        """
        n = len(posed)
        highest = int(posed.object_index.max(initial=-1))
        if masks is None:
            masks = np.full(highest + 1, -1, np.int32)
        if highest >= len(masks) or posed.object_index.min(initial=0) < 0:
            raise UsageError("surfels", f"refer to object {highest} of {len(masks)}", "Give every object a mask")
        same = n == len(self._words)
        words = self._words if same else aligned(RECORD * n, np.int32).reshape(n, RECORD)
        boxes = np.empty((2 * n, 3), np.float32)
        self.surface = np.empty((n, SURFEL), np.float32)
        self.objects = np.ascontiguousarray(posed.object_index, np.int32)
        arrays = Posed.of(posed)._replace(object_index=plain(self.objects))
        self.bad = int(_record(arrays, plain(np.asarray(masks, np.int32)), words, boxes, self.surface))
        self._words = words
        fresh = not same
        if same and len(self._runs):
            fresh = looseness(boxes, _corners(n), self._runs) > _DEGRADED * self._looseness
        if fresh:
            self._construct(boxes)
        elif n:
            self._commit()

    def bounds(self) -> tuple[Array, Array]:
        """Lowest and highest corner of the box around all discs, (3,) float32 each; zeros when there are none."""
        return box_of(self.scene)

    @property
    def extent(self) -> float:
        """The largest absolute coordinate of the discs, metres."""
        return float(np.abs(self.bounds()).max())

    def sizes(self, count: int) -> Array:
        """(count,) float32 metres: mean larger standard deviation of each object's surfels, 0 without any."""
        if not len(self):
            return np.zeros(count, np.float32)
        number = np.bincount(self.objects, minlength=count)
        total = np.bincount(self.objects, self.surface[:, SIZE], minlength=count)
        return (total / np.maximum(number, 1)).astype(np.float32)

    def _construct(self, boxes: Array) -> None:
        self._release_scene()
        lib, n = self._lib, len(self._words)
        self.scene = lib.rtcNewScene(self._device)
        # As in tree.py: only this combination keeps a tree that can be refitted.
        lib.rtcSetSceneFlags(self.scene, SCENE_DYNAMIC | _ROBUST)
        lib.rtcSetSceneBuildQuality(self.scene, QUALITY_LOW)
        geometry = self._geometry = lib.rtcNewGeometry(self._device, _GEOMETRY_USER)
        bound, intersect, occluded = callbacks()
        lib.rtcSetGeometryUserPrimitiveCount(geometry, n)
        lib.rtcSetGeometryUserData(geometry, self._words.ctypes.data)
        lib.rtcSetGeometryBoundsFunction(geometry, bound.address, None)
        lib.rtcSetGeometryIntersectFunction(geometry, intersect.address)
        lib.rtcSetGeometryOccludedFunction(geometry, occluded.address)
        lib.rtcSetGeometryMask(geometry, 0xFFFFFFFF)  # masks are the surfels' own
        lib.rtcSetGeometryBuildQuality(geometry, QUALITY_REFIT)
        lib.rtcAttachGeometryByID(self.scene, geometry, 0)
        self._commit()
        self.rebuilds += 1
        self._runs = neighbours(boxes, _corners(n))
        self._looseness = looseness(boxes, _corners(n), self._runs)

    def _commit(self) -> None:
        self._lib.rtcCommitGeometry(self._geometry)
        self._lib.rtcCommitScene(self.scene)
        if error := self._lib.rtcGetDeviceError(self._device):
            raise DeviceError("Embree", f"failed with error {error} on {len(self)} surfels", "Use fewer surfels")

    def _release_scene(self) -> None:
        if self._geometry:
            self._lib.rtcReleaseGeometry(self._geometry)
        if self.scene:
            self._lib.rtcReleaseScene(self.scene)
        self._geometry, self.scene = None, 0

    def close(self) -> None:
        """Give the tree's memory back; the object cannot be used afterwards."""
        self._release_scene()

    def __del__(self) -> None:
        if getattr(self, "scene", 0):
            self._release_scene()


def _corners(n: int) -> Array:
    """(n, 3) int32 rows of `boxes`, as if each box were a triangle: what the measures of tree.py read."""
    first = 2 * np.arange(n, dtype=np.int32)
    return np.stack([first, first + 1, first], axis=1)
