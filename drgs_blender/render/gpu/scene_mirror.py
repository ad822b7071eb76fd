"""The copy of a scene on a device: the arrays behind every address, and Warp's BVHs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ...compute.warp.kernels import Launcher
from ..lights.environment import ROTATION, EnvironmentLight, EnvMap
from ..lights.light_sampler import Lights
from ..memory import AddressOf, address
from ..scene.interaction import Geometry
from ..scene.ray_masks import CAMERA, CLEAR, DIFFUSE, GLOSSY, ORDINARY, SHADOW, SURFELS, WITHOUT
from ..scene.trace_scene import TraceScene
from .bvhs import Trees
from .native_functions import MeshTracer

Array = np.ndarray

_KINDS = DIFFUSE | GLOSSY | SHADOW
#: Rays that are cast here.
_RAYS = CAMERA | ORDINARY | _KINDS | _KINDS << WITHOUT | SURFELS
_RAYS |= (_RAYS & ~SURFELS) << CLEAR


class Mirror:
    """Keeps what a device needs of the scene, the environment and the lights of one frame after another.

    Parameters
    ----------
    launcher : Launcher
        Of the device.
    """

    def __init__(self, launcher: Launcher) -> None:
        self._launcher = launcher
        #: Of every table: what it was made of, the table, and the arrays that it refers to.
        self._known: dict[str, tuple[tuple[Any, ...], Any, list[Any]]] = {}
        self._trees: Trees | None = None

    def tables(self, scene: TraceScene, environment: EnvironmentLight, lights: Lights) -> tuple[Any, Any, Any, Any]:
        """(tracer, geometry, environment, lights) with the device's addresses; until what they are of changes."""
        state = scene, scene.version
        of_lights = self._table(
            "lights",
            (lights, *state),
            lambda address_of: lights.tables._replace(emitters=lights.emitters.address_at(address_of)),
        )
        return self.tracer(scene), self.geometry(scene), self.envmap(environment), of_lights

    def envmap(self, environment: EnvironmentLight) -> EnvMap:
        """The environment; until it is another one."""
        # Its pictures are large, and stay; only how they are turned may have changed.
        envmap: EnvMap = self._table("environment", (environment,), environment.envmap_at)
        return envmap._replace(**{name: getattr(environment.envmap, name) for name in ROTATION})

    def geometry(self, scene: TraceScene) -> Geometry:
        """Records of the faces (`Geometry`); until the scene's next update."""
        found: Geometry = self._table("geometry", (scene, scene.version), scene.geometry_at)
        return found

    def owners(self, scene: TraceScene) -> tuple[Any, Any]:
        """Objects of the scene's faces and instances, as arrays; until its next update."""
        copy = self._launcher.array
        found: tuple[Any, Any] = self._table(
            "owners", (scene, scene.version), lambda address_of: (copy(scene.face_object), copy(scene.instance_object))
        )
        return found

    def moving(self, scene: TraceScene) -> tuple[Any, Any, Any]:
        """The scene's vertices, faces and instances; until its next update."""
        self.tracer(scene)
        assert self._trees is not None
        return self._trees.moving

    def tracer(self, scene: TraceScene) -> MeshTracer:
        """The tracer of rays into the scene; until its next update."""
        found: MeshTracer = self._table(
            "tracer", (scene, scene.version), lambda address_of: self._tracer(scene, address_of)
        )
        return found

    def _table(self, name: str, made_of: tuple[Any, ...], make: Callable[[AddressOf], Any]) -> Any:
        """A table made again where what it is made of is not the same as before."""
        known = self._known.pop(name, None)
        if known is None or any(a is not b for a, b in zip(known[0], made_of)):
            del known  # gives the memory back before more is taken
            kept: list[Any] = []
            known = made_of, make(lambda array: self._address_on_device(array, kept)), kept
        self._known[name] = known
        return known[1]

    def _address_on_device(self, array: Array, kept: list[Any]) -> int:
        """Where the device finds a copy of an array."""
        if not self._launcher.apart:
            kept.append(array)
            return address(array)
        if not array.size:
            return 0
        copy = self._launcher.array(array.reshape(-1))  # as its own elements: Warp counts up to 2^31
        kept.append(copy)
        return int(copy.ptr)

    def _tracer(self, scene: TraceScene, address_of: AddressOf) -> MeshTracer:
        rows, masks = scene.world_triangles()
        if not len(rows):
            self._trees = None
            return MeshTracer(0, 0, 0, 0)
        # Instances may have come or gone, and what sees them changed, without another layout.
        rays = masks & _RAYS
        if self._trees is None or not self._trees.of(scene.layout, rows, rays):
            self._trees = None  # gives the memory back before more is taken
            self._trees = Trees(self._launcher, scene.layout, rows, rays)
        trees, instanced = self._trees, len(scene.instances) > 0
        corners = trees.follow(scene)
        plain = len(trees.trees) == 1 and not instanced
        faces = 0 if plain else int(trees.rows.ptr)
        return MeshTracer(address_of(trees.table), len(trees.trees), faces, int(corners.ptr) if instanced else 0)
