"""Rendering equation at pixels on a device, one thread per pixel: `inverse_rendering.estimator` with Warp's rays."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from ...compute.warp.kernels import Launcher, WarpKernel
from ...compute.warp.runtime import warp
from ...compute.warp.translate import Native
from ...core.asset.model import Mesh
from ...core.errors import DeviceError
from ...render.gpu.native_functions import NATIVES
from ...render.gpu.scene_mirror import Mirror
from ...render.lights.environment import EnvironmentLight
from ...render.scene.embree import trace
from ...render.scene.triangle_bvh import TriangleBVH
from ..inverse_rendering.estimator import Lobes, Plan, Points, Samples, Sky, Sums, gather_point
from ..inverse_rendering.gatherer import Gatherer

log = logging.getLogger(__name__)

Array = np.ndarray

#: The parameters are those of `embree.trace`, which kernels call: Warp takes its place by name and position.
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


def gather_points(thread, stride, scratch, points, lobes, plan, occluder, sky, envmap, out):  # type: ignore[no-untyped-def]
    """`inverse_rendering.estimator.gather`.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
        See `compute.warp.kernels`.
    points, lobes, plan, occluder, sky, envmap : Points, Lobes, Plan, Occluder, Sky or EnvMap
        As of `gather_point`.
    out : tuple
        `Sums` and `Samples`; written.
    """
    sums, samples = out
    for i in range(thread, len(lobes.alpha2), stride):
        gather_point(i, points, lobes, plan, occluder, sky, envmap, sums, samples)


GATHER = WarpKernel(gather_points, (), NATIVES | {trace: Native(_TRACE, "trace_mesh", _HIT)})


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
        self, points: Points, lobes: Lobes, sky: Sky, light: EnvironmentLight, sums: Sums, samples: Samples
    ) -> None:
        if not self.failed:
            try:
                with self._launcher.failures("copying the mesh"):
                    plan, occluder = self._kept()
                    envmap = self._mirror.envmap(light)
                arguments = points, lobes, plan, occluder, sky, envmap
                self._launcher.launch(GATHER, len(lobes.alpha2), arguments, (sums, samples))
                return
            except DeviceError as error:
                self.failed = str(error)
                log.warning("%s Materials are learned on the CPU from here on", self.failed)
        super()._gather(points, lobes, sky, light, sums, samples)

    def _kept(self) -> tuple[Any, ...]:
        """What stays on the device: the mesh that rays meet, and tables."""
        if not self._tables:
            wp, device, tree = warp(), self._launcher.device, self._tree
            if len(tree.faces):
                vertices = wp.array(tree.vertices, dtype=wp.vec3, device=device)
                self._mesh = wp.Mesh(vertices, wp.array(tree.faces.ravel(), dtype=wp.int32, device=device))
            copy, own = self._launcher.array, self._occluder
            scene = 0 if self._mesh is None else int(self._mesh.id)
            mesh = own._replace(intersect=0, scene=scene, faces=copy(own.faces), cache=copy(own.cache))
            self._tables = Plan(*map(copy, self._plan)), mesh
        return self._tables
