"""The rendering equation at pixels on a device, one lane a pixel: `inverse_rendering.estimator` with Warp's rays."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from ...compute.warp.kernels import Launcher, Work
from ...compute.warp.runtime import warp
from ...compute.warp.translate import Native
from ...core.asset.model import Mesh
from ...core.errors import DeviceError
from ...render.gpu.natives import NATIVES
from ...render.gpu.scene_mirror import Mirror
from ...render.lights.environment import EnvironmentLight
from ...render.scene.embree import trace
from ...render.scene.triangle_bvh import TriangleBVH
from ..inverse_rendering.estimator import Gatherer, gather_point

log = logging.getLogger(__name__)

Array = np.ndarray

_TRACE = """
@wp.func
def trace_mesh(
    unused: wp.int64, mesh: wp.int64, ox: wp.float32, oy: wp.float32, oz: wp.float32, dx: wp.float32, dy: wp.float32,
    dz: wp.float32, tnear: wp.float32, tfar: wp.float32, mask: wp.int32,
):
    group = wp.int32(-1)
    face = wp.int32(-1)
    t = wp.float32(tfar)
    u = wp.float32(0.0)
    v = wp.float32(0.0)
    normal = wp.vec3(0.0, 0.0, 0.0)
    if mesh != wp.int64(0):
        query = wp.mesh_query_ray(wp.uint64(mesh), wp.vec3(ox, oy, oz), wp.vec3(dx, dy, dz), tfar)
        if query.result:
            group = wp.int32(0)
            face = query.face
            t = query.t
            # Warp's coordinates belong to the first and the second corner, Embree's to the second and the third.
            u = query.v
            v = 1.0 - query.u - query.v
            normal = query.normal
    return t, group, face, wp.int32(-1), u, v, normal[0], normal[1], normal[2]
"""
_HIT = ("float32", "int32", "int32", "int32", "float32", "float32", "float32", "float32", "float32")


def gather_points(  # type: ignore[no-untyped-def]
    lane, lanes, room, points, normals, a2s, counts, sequence, scene, faces, cache, radiance, shape, envmap, seen, out
):
    """`inverse_rendering.estimator._gather`."""
    for i in range(lane, len(a2s), lanes):
        gather_point(i, points, normals, a2s, counts, sequence, scene, faces, cache, radiance, shape, envmap, seen, out)


GATHER = Work(gather_points, (), NATIVES | {trace: Native(_TRACE, "trace_mesh", _HIT)})


class DeviceGatherer(Gatherer):
    """A `Gatherer` whose directions are drawn and followed on a device; what that fails at is done here.

    Parameters
    ----------
    launcher : Launcher
        Of the device.
    mesh : Mesh
    tree : TriangleBVH
    cache : array or None
    counts : tuple of int
    normals : bool
    """

    def __init__(
        self, launcher: Launcher, mesh: Mesh, tree: TriangleBVH, cache: Array | None, counts: tuple[int, int, int],
        normals: bool = False,
    ) -> None:  # fmt: skip
        super().__init__(mesh, tree, cache, counts, normals)
        self._launcher, self._mirror, self._mesh = launcher, Mirror(launcher), None
        self._tables: tuple[Any, ...] = ()
        self.failed = ""

    def _gather(
        self, points: tuple[Array, ...], normal: Array, alpha2: Array, radiance: Array, shape: tuple[Any, ...],
        environment: EnvironmentLight, out: tuple[Array, ...],
    ) -> None:  # fmt: skip
        if not self.failed:
            try:
                with self._launcher.failures("copying the mesh"):
                    counts, sequence, faces, cache = self._kept()
                    scene, envmap = (
                        (0, 0 if self._mesh is None else int(self._mesh.id)),
                        self._mirror.envmap(environment),
                    )
                arguments = points, normal, alpha2, counts, sequence, scene, faces, cache, radiance, shape, envmap
                self._launcher.launch(GATHER, len(alpha2), (*arguments, self._seen), out)
                return
            except DeviceError as error:
                self.failed = str(error)
                log.warning("%s Materials are learned on the CPU from here on", self.failed)
        super()._gather(points, normal, alpha2, radiance, shape, environment, out)

    def _kept(self) -> tuple[Any, ...]:
        """What stays on the device: the mesh that rays meet, and tables."""
        if not self._tables:
            wp, device, tree = warp(), self._launcher.device, self._tree
            if len(tree.faces):
                vertices = wp.array(tree.vertices, dtype=wp.vec3, device=device)
                self._mesh = wp.Mesh(vertices, wp.array(tree.faces.ravel(), dtype=wp.int32, device=device))
            arrays = self._counts, self._sequence, self._faces, self._cache
            self._tables = tuple(map(self._launcher.array, arrays))
        return self._tables
