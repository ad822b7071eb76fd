"""What a device knows of a scene: copies of the arrays behind every address, and Warp's mesh of all faces."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np

from ...device.kernels import Launcher
from ...device.warp import warp
from ..lights.lamps import Lamps
from ..lights.light import EnvironmentLight, Sky
from ..memory import Place, address
from ..trace.masks import DIFFUSE, GLOSSY, SHADOW, SURFELS, WITHOUT
from ..trace.scene import TraceScene
from .natives import MeshTracer

Array = np.ndarray

_KINDS = DIFFUSE | GLOSSY | SHADOW
#: Rays that are cast here.
_RAYS = _KINDS | _KINDS << WITHOUT | SURFELS


class Mirror:
    """Keeps what a device needs of the scene, the light and the lamps of one frame after another.

    Parameters
    ----------
    launcher : of the device
    """

    def __init__(self, launcher: Launcher) -> None:
        self._launcher, self._device = launcher, launcher.device
        #: Of every table: what it was made of, the table, and the arrays that it refers to.
        self._known: dict[str, tuple[tuple[Any, ...], Any, list[Any]]] = {}
        self._meshes: tuple[object, Array, list[Any]] | None = None

    def tables(self, scene: TraceScene, light: EnvironmentLight, lamps: Lamps) -> tuple[Any, Any, Any, Any]:
        """(tracer, geometry, sky, lamps) with the device's addresses; until what they are of changes."""
        state = scene, scene.version
        geometry = self._table("geometry", state, scene.geometry_at)
        lights = self._table(
            "lamps", (lamps, *state), lambda place: (*lamps.tables[:2], lamps.emitters.address_at(place))
        )
        # Pictures of the environment are large, and stay; only how they are turned may have changed.
        sky: Sky = self._table("sky", (light,), light.sky_at)
        turn = {name: value for name, value in light.sky._asdict().items() if len(name) == 2}
        return self.tracer(scene), geometry, sky._replace(**turn), lights

    def tracer(self, scene: TraceScene) -> MeshTracer:
        """How rays meet the scene; until its next update."""
        found: MeshTracer = self._table("tracer", (scene, scene.version), lambda place: self._tracer(scene, place))
        return found

    def _table(self, name: str, made_of: tuple[Any, ...], make: Callable[[Place], Any]) -> Any:
        """A table made anew where what it is made of is not the same as before."""
        known = self._known.pop(name, None)
        if known is None or any(a is not b for a, b in zip(known[0], made_of)):
            del known  # gives the memory back before more is taken
            kept: list[Any] = []
            known = made_of, make(lambda array: self._place(array, kept)), kept
        self._known[name] = known
        return known[1]

    def _place(self, array: Array, kept: list[Any]) -> int:
        """Where the device finds a copy of an array."""
        if not self._launcher.apart:
            kept.append(array)
            return address(array)
        if not array.size:
            return 0
        copy = self._launcher.array(array.reshape(-1))  # as its own elements: Warp counts up to 2^31
        kept.append(copy)
        return int(copy.ptr)

    def _tracer(self, scene: TraceScene, place: Place) -> MeshTracer:
        rows, masks = scene.standing()
        if not len(rows):
            self._meshes = None
            return MeshTracer(0, 0, 0, 0)
        # A mesh of Warp's for each kind of mask: its queries take none.
        kinds, which = np.unique(masks & _RAYS, return_inverse=True)
        order = np.argsort(which, kind="stable")
        starts = np.searchsorted(which[order], np.arange(len(kinds) + 1))
        corners = scene.vertices[scene.faces]
        triangles = corners if not len(scene.places) else _placed(corners, scene.places, rows)
        # What stands in places may have come or gone, and what sees it changed, without another layout.
        if self._meshes is None or self._meshes[0] is not scene.layout or not np.array_equal(self._meshes[1], masks):
            self._meshes = scene.layout, masks, [None] * len(kinds)
        meshes = self._meshes[2]
        for k, (first, last) in enumerate(pairwise(starts)):
            meshes[k] = self._built(meshes[k], triangles[order[first:last]])
        table = np.array([(mesh.id, *at) for mesh, *at in zip(meshes, kinds, starts)], np.int64)
        plain = len(kinds) == 1 and not len(scene.places)
        faces = 0 if plain else place(np.ascontiguousarray(rows[order]))
        return MeshTracer(place(table), len(table), faces, place(corners) if len(scene.places) else 0)

    def _built(self, mesh: Any, triangles: Array) -> Any:
        """Warp's mesh of (k, 3, 3) corners; one that had as many takes them on."""
        wp = warp()
        points = wp.array(triangles.reshape(-1, 3), dtype=wp.vec3, device=self._device)
        if mesh is not None:
            wp.copy(mesh.points, points)
            mesh.refit()
            return mesh
        indices = wp.array(np.arange(len(points), dtype=np.int32), dtype=wp.int32, device=self._device)
        return wp.Mesh(points, indices)


def _placed(corners: Array, places: Array, rows: Array) -> Array:
    """(k, 3, 3) float32 corners of triangles where they stand."""
    out = corners[rows[:, 0]]
    moved = np.flatnonzero(rows[:, 1] >= 0)
    matrices = places[rows[moved, 1]].astype(np.float64)
    out[moved] = np.einsum("kij,kcj->kci", matrices[:, :, :3], out[moved]) + matrices[:, None, :, 3]
    return out
