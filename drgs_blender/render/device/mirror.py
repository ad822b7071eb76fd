"""What a device knows of a scene: copies of the arrays behind every address, and Warp's mesh of all faces."""

from __future__ import annotations

from collections.abc import Callable
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

#: Kinds of rays that are cast here.
_RAYS = DIFFUSE | GLOSSY | SHADOW | SURFELS


class Mirror:
    """Keeps what a device needs of the scene, the light and the lamps of one frame after another.

    Parameters
    ----------
    launcher : of the device

    Attributes
    ----------
    copies : whether the device has memory of its own
    """

    def __init__(self, launcher: Launcher) -> None:
        self._device = launcher.device
        self.copies = bool(self._device.is_cuda)
        #: Of every table: what it was made of, the table, and the arrays that it refers to.
        self._known: dict[str, tuple[tuple[Any, ...], Any, list[Any]]] = {}
        self._mesh: tuple[tuple[object, int], Any] | None = None

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
        if not self.copies:
            kept.append(array)
            return address(array)
        if not array.size:
            return 0
        copy = warp().array(array.reshape(-1).view(np.uint8), dtype=warp().uint8, device=self._device)
        kept.append(copy)
        return int(copy.ptr)

    def _tracer(self, scene: TraceScene, place: Place) -> MeshTracer:
        wp = warp()
        rows, masks = scene.standing()
        if not len(rows):
            self._mesh = None
            return MeshTracer(0, 0, 0, 0)
        corners = scene.vertices[scene.faces]
        triangles = corners if not len(scene.places) else _placed(corners, scene.places, rows)
        points = wp.array(triangles.reshape(-1, 3), dtype=wp.vec3, device=self._device)
        # What stands in places may have come or gone without another layout.
        known = scene.layout, len(rows)
        if self._mesh is None or self._mesh[0] != known:
            indices = wp.array(np.arange(3 * len(rows), dtype=np.int32), dtype=wp.int32, device=self._device)
            self._mesh = known, wp.Mesh(points, indices)
        else:
            wp.copy(self._mesh[1].points, points)
            self._mesh[1].refit()
        # Where every ray meets every face, none looks at masks.
        plain = bool(((masks & _RAYS) == _RAYS).all()) and not (masks >> WITHOUT).any()
        stands = (place(rows), place(corners)) if len(scene.places) else (0, 0)
        return MeshTracer(int(self._mesh[1].id), 0 if plain else place(masks), *stands)


def _placed(corners: Array, places: Array, rows: Array) -> Array:
    """(k, 3, 3) float32 corners of triangles where they stand."""
    out = corners[rows[:, 0]]
    moved = np.flatnonzero(rows[:, 1] >= 0)
    matrices = places[rows[moved, 1]].astype(np.float64)
    out[moved] = np.einsum("kij,kcj->kci", matrices[:, :, :3], out[moved]) + matrices[:, None, :, 3]
    return out
