"""What a device knows of a scene: copies of the arrays behind every address, and Warp's mesh of all faces."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...device.kernels import Launcher
from ...device.warp import warp
from ..lights.lamps import Lamps
from ..lights.light import EnvironmentLight, Sky
from ..memory import address
from ..trace.masks import DIFFUSE, GLOSSY, SHADOW, WITHOUT
from ..trace.scene import TraceScene
from .natives import MeshTracer

Array = np.ndarray

#: Kinds of rays that the integrator casts.
_LIGHT = DIFFUSE | GLOSSY | SHADOW


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
        self._kept: list[Any] = []
        self._sky: tuple[EnvironmentLight, Sky, list[Any]] | None = None
        self._tables: tuple[tuple[Any, ...], tuple[Any, Any, Any, Any]] | None = None
        self._mesh: tuple[tuple[object, int], Any] | None = None

    def tables(self, scene: TraceScene, light: EnvironmentLight, lamps: Lamps) -> tuple[Any, Any, Any, Any]:
        """(tracer, geometry, sky, lamps) with the device's addresses; until what they are of changes."""
        known = scene, scene.version, light, lamps
        if self._tables is not None and all(a is b for a, b in zip(self._tables[0], known)):
            return self._tables[1]
        self._tables, self._kept = None, []
        table, pick, _ = lamps.tables
        lights = table, pick, lamps.emitters.address_at(self._place)
        tables = self._tracer(scene), scene.geometry_at(self._place), self._light(light), lights
        self._tables = known, tables
        return tables

    def _place(self, array: Array) -> int:
        """Where the device finds a copy of an array."""
        if not self.copies:
            self._kept.append(array)
            return address(array)
        if not array.size:
            return 0
        copy = warp().array(array.reshape(-1).view(np.uint8), dtype=warp().uint8, device=self._device)
        self._kept.append(copy)
        return int(copy.ptr)

    def _light(self, light: EnvironmentLight) -> Sky:
        """The sky, copied once: pictures of the environment are large, and stay."""
        if self._sky is None or self._sky[0] is not light:
            kept, self._kept = self._kept, []
            sky = light.sky_at(self._place)
            self._sky = light, sky, self._kept
            self._kept = kept
        return self._sky[1]._replace(**{name: value for name, value in light.sky._asdict().items() if len(name) == 2})

    def _tracer(self, scene: TraceScene) -> MeshTracer:
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
        plain = bool(((masks & _LIGHT) == _LIGHT).all()) and not (masks >> WITHOUT).any()
        stands = (self._place(rows), self._place(corners)) if len(scene.places) else (0, 0)
        return MeshTracer(int(self._mesh[1].id), 0 if plain else self._place(masks), *stands)


def _placed(corners: Array, places: Array, rows: Array) -> Array:
    """(k, 3, 3) float32 corners of triangles where they stand."""
    out = corners[rows[:, 0]]
    moved = np.flatnonzero(rows[:, 1] >= 0)
    matrices = places[rows[moved, 1]].astype(np.float64)
    out[moved] = np.einsum("kij,kcj->kci", matrices[:, :, :3], out[moved]) + matrices[:, None, :, 3]
    return out
