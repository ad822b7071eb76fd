"""Warp's trees of the triangles of a scene: they follow what moves, and are rebuilt where that has worn them out.

The function that places corners is translated and never runs as it stands.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from ...compute.warp.kernels import Launcher, WarpKernel
from ...compute.warp.runtime import warp
from ..scene.trace_scene import TraceScene
from ..scene.triangle_bvh import DEGRADED, looseness, neighbours

Array = np.ndarray


def place_corners(
    thread: Any, stride: Any, scratch: Any, vertices: Any, faces: Any, instances: Any, rows: Any, out: Any
) -> None:
    """Corners of triangles where they stand, three rows each."""
    (points,) = out
    for i in range(thread, len(rows), stride):
        face, instance = rows[i, 0], rows[i, 1]
        for c in range(3):
            v, row = faces[face, c], 3 * i + c
            x, y, z = np.float64(vertices[v, 0]), np.float64(vertices[v, 1]), np.float64(vertices[v, 2])
            if instance < 0:
                points[row, 0], points[row, 1], points[row, 2] = x, y, z
            else:
                for a in range(3):
                    turned = (
                        instances[instance, a, 0] * x + instances[instance, a, 1] * y + instances[instance, a, 2] * z
                    )
                    points[row, a] = turned + instances[instance, a, 3]


PLACE = WarpKernel(place_corners, (), {})


class Tree:
    """Warp's mesh of some triangles of a scene.

    Parameters
    ----------
    launcher : Launcher
    rows : (k, 2) int32 array
        The triangles: face, and instance or -1.

    Attributes
    ----------
    builds : int
        How often it was built.
    """

    def __init__(self, launcher: Launcher, rows: Array) -> None:
        self._launcher, self._rows = launcher, rows
        self._there = launcher.array(rows)
        self._corners = launcher.zeros((3 * len(rows), 3))
        self._mesh: Any = None
        self.builds = 0

    @property
    def id(self) -> int:
        """By which kernels know it."""
        return int(self._mesh.id)

    def follow(self, scene: TraceScene, arrays: tuple[Any, Any, Any]) -> None:
        """Go where the triangles are now; `arrays` are the scene's vertices, faces and instances, on the device."""
        self._launcher.launch(PLACE, len(self._rows), (*arrays, self._there), (self._corners,))
        if self._mesh is None or self._looseness(scene) > DEGRADED * self._fresh:
            self._build(scene)
        else:
            self._mesh.refit()

    def _build(self, scene: TraceScene) -> None:
        wp, corners = warp(), self._corners
        self._mesh = None  # gives the memory back before more is taken
        indices = wp.array(np.arange(len(corners), dtype=np.int32), dtype=wp.int32, device=corners.device)
        points = wp.array(ptr=corners.ptr, shape=len(corners), dtype=wp.vec3, device=corners.device)
        self._mesh, self.builds = wp.Mesh(points, indices), self.builds + 1
        self._runs = neighbours(*_separate(triangles(scene, self._rows)))
        self._fresh = self._looseness(scene)

    def _looseness(self, scene: TraceScene) -> float:
        """As `scene.triangle_bvh` measures it, 0 for a few triangles."""
        if not len(self._runs):
            return 0.0
        some = triangles(scene, self._rows[self._runs.ravel()])
        return float(looseness(*_separate(some), np.arange(len(some), dtype=np.int32).reshape(self._runs.shape)))


class Trees:
    """A tree for each kind of mask, since Warp's queries take none.

    Parameters
    ----------
    launcher : Launcher
    layout : object
        The scene's.
    rows, masks : (k, 2) int32 array
        Face and instance of all triangles, and what meets each.

    Attributes
    ----------
    rows : (k, 2) int32 array
        On the device, those of each tree together.
    table : (trees, 3) int64 array
        Now: each one's id, mask and first of its `rows`.
    moving : tuple
        The scene's vertices, faces and instances, on the device, now.
    trees : list
        One tree per kind.
    """

    def __init__(self, launcher: Launcher, layout: object, rows: Array, masks: Array) -> None:
        self._launcher, self._made_of = launcher, (layout, rows, masks)
        self._kinds, which = np.unique(masks, return_inverse=True)
        order = np.argsort(which, kind="stable")
        self._starts = np.searchsorted(which[order], np.arange(len(self._kinds) + 1))
        ordered = np.ascontiguousarray(rows[order])
        self.rows = launcher.array(ordered, copy=True)
        self.trees = [Tree(launcher, ordered[first:last]) for first, last in pairwise(self._starts)]
        self._faces: tuple[Array, Any] | None = None
        self._own: Any = None  # rows of all faces where they stand by themselves, once they are asked for

    def of(self, layout: object, rows: Array, masks: Array) -> bool:
        """Whether they are of these triangles."""
        known = self._made_of
        return known[0] is layout and np.array_equal(known[1], rows) and np.array_equal(known[2], masks)

    def follow(self, scene: TraceScene) -> Any:
        """Bring them up to date; (3 m, 3) float32 corners of the scene's faces, on the device.

        They stay there until the next time; None where no shape has instances.
        """
        launcher = self._launcher
        if self._faces is None or self._faces[0] is not scene.faces:
            self._faces, self._own = (scene.faces, launcher.array(scene.faces)), None
        given = self.moving = launcher.array(scene.vertices), self._faces[1], launcher.array(scene.instances)
        for tree in self.trees:
            tree.follow(scene, given)
        ids = np.array([tree.id for tree in self.trees], np.int64)
        self.table = np.stack([ids, self._kinds, self._starts[:-1]], axis=1)
        if not len(scene.instances):
            return None
        m = len(scene.faces)
        if self._own is None:
            own = np.stack([np.arange(m), np.full(m, -1)], axis=1).astype(np.int32)
            self._own = launcher.array(own, copy=True)
        self._corners = launcher.zeros((3 * m, 3))
        launcher.launch(PLACE, m, (*given, self._own), (self._corners,))
        return self._corners


def triangles(scene: TraceScene, rows: Array) -> Array:
    """(k, 3, 3) float32 corners of triangles where they stand."""
    out = scene.vertices[scene.faces[rows[:, 0]]]
    moved = np.flatnonzero(rows[:, 1] >= 0)
    matrices = scene.instances[rows[moved, 1]].astype(np.float64)
    out[moved] = np.einsum("kij,kcj->kci", matrices[:, :, :3], out[moved]) + matrices[:, None, :, 3]
    return out


def _separate(corners: Array) -> tuple[Array, Array]:
    """Vertices and faces of triangles that share no vertex."""
    return corners.reshape(-1, 3), np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
