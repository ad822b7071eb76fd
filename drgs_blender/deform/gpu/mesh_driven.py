"""Surfels that follow their mesh on a device, where they stay: `deform.pose` from the same source.

The functions here are translated and never run as they stand.
"""

from __future__ import annotations

import weakref
from typing import Any, NamedTuple

import numpy as np

from ...compute.warp.kernels import Launcher, WarpKernel
from ...compute.warp.posed_surfels import DevicePosedSurfels
from ...compute.warp.runtime import warp
from ...compute.warp.translate import replacing
from ...core.asset.model import BASE_CHANNELS, PosedSurfels
from ...geometry.normals import face_normal, vertex_normal
from .. import pose
from ..mesh_driven import MeshDriven, Posing

Array = np.ndarray

#: Coordinates below this, metres, hide no surfel.
_USABLE = 1e28


def weigh_corners(thread, stride, scratch, vertices, faces, place, out):  # type: ignore[no-untyped-def]
    """`geometry._weigh`, one face after the other.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
        See `compute.warp.kernels`.
    vertices : (n, 3) float32 array
        Metres.
    faces : (m, 3) int32 array
    place : (3 m,) int array
        Row of each face corner in what is written.
    out : tuple of array
        Angle times unit normal of each corner, (3 m, 3) float32; written.
    """
    (weighted,) = out
    for f in range(thread, len(faces), stride):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        x, y, z = vertices[a, 0], vertices[a, 1], vertices[a, 2]
        nx, ny, nz, first, second, third = face_normal(
            vertices[b, 0] - x, vertices[b, 1] - y, vertices[b, 2] - z,
            vertices[c, 0] - x, vertices[c, 1] - y, vertices[c, 2] - z,
        )  # fmt: skip
        for k in range(3):
            p = place[3 * f + k]
            w = first if k == 0 else (second if k == 1 else third)
            weighted[p, 0], weighted[p, 1], weighted[p, 2] = w * nx, w * ny, w * nz


def sum_corners(thread, stride, scratch, weighted, start, sign, out):  # type: ignore[no-untyped-def]
    """Vertex normals, as `geometry._sum`.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
        See `compute.warp.kernels`.
    weighted : (3 m, 3) float32 array
        Of `weigh_corners`.
    start : (n + 1,) int array
        First row of each vertex.
    sign : float32
        1, or -1 to turn the normals round.
    out : tuple of array
        Unit normals, (n, 3) float32; written.
    """
    (normals,) = out
    for v in range(thread, len(normals), stride):
        x, y, z = vertex_normal(weighted, start[v], start[v + 1])
        normals[v, 0], normals[v, 1], normals[v, 2] = sign * x, sign * y, sign * z


# Exact: faces without area have to be found as the CPU finds them, or surfels near them turn elsewhere.
WEIGH = WarpKernel(weigh_corners, (), {}, exact=True)
SUM = WarpKernel(sum_corners, (), {}, exact=True)
# One surfel a block.
POSE = WarpKernel(pose.pose_surfels, (), {}, replacing(pose, "_BLOCK", 1), exact=True)


class _Tables(NamedTuple):
    """What of a mesh and its surfels is the same in every frame: `MeshDriven.rest`, `VertexNormals`, own channels."""

    rest: tuple[Any, ...]
    faces: Any
    start: Any
    place: Any
    channels: dict[str, Any]


class Deformer:
    """Poses surfels on a device, and keeps there what does not change from frame to frame.

    Parameters
    ----------
    launcher : Launcher
        Of the device.
    """

    def __init__(self, launcher: Launcher) -> None:
        self.launcher = launcher
        self._known: weakref.WeakKeyDictionary[MeshDriven, _Tables] = weakref.WeakKeyDictionary()

    def pose(
        self, driven: MeshDriven, vertices_world: Array, corner_normals_world: Array | None = None,
        materials: Any = None, *, matrix_world: Array | None = None, object_index: int = 0, torn: Array | None = None,
    ) -> PosedSurfels:  # fmt: skip
        """`MeshDriven.pose` on the device, but for meshes with vertices that are not finite: these hide surfels.

        Raises
        ------
        AssetError: as there.
        DeviceError: the device fails.
        """
        given = vertices_world, corner_normals_world, materials

        def here() -> PosedSurfels:
            return driven.pose(*given, matrix_world=matrix_world, object_index=object_index, torn=torn)

        posing = driven.posing(*given, matrix_world, torn)
        if not np.abs(posing.vertices).max(initial=0.0) < _USABLE:
            return here()
        driven.hidden_count = 0
        n, launcher, tables = len(driven.surfels), self.launcher, self._tables(driven)
        with launcher.failures("copying a mesh"):
            vertices = launcher.array(posing.vertices)
            opacity = self._own(tables, driven, "opacity", posing.opacity)
            opacity = opacity if posing.opacity is driven.surfels.opacity else launcher.array(opacity, copy=True)
            owner = warp().full(n, object_index, dtype=warp().int32, device=launcher.device)
            made = [launcher.zeros((n, 3)) for _ in range(4)]
        normals = self._smooth(tables, driven, posing, vertices) if posing.normals is None else posing.normals
        mesh = vertices, tables.faces, normals
        arguments = mesh, posing.normals is not None, posing.linear, posing.sign, tables.rest
        launcher.launch(POSE, n, arguments, (*made, opacity))
        names = "centre", "tangent_u", "tangent_v", "normal"
        channels = {name: self._own(tables, driven, name, posing.channels[name]) for name in BASE_CHANNELS}
        there = dict(zip(names, made)) | channels | {"opacity": opacity, "object_index": owner}
        return DevicePosedSurfels(there, here, posing.channels)

    def _smooth(self, tables: _Tables, driven: MeshDriven, posing: Posing, vertices: Any) -> Any:
        """(n, 3) normals of the vertices."""
        launcher = self.launcher
        with launcher.failures("copying a mesh"):
            own = posing.smooth_faces is driven.normals.faces
            faces = tables.faces if own else launcher.array(posing.smooth_faces)
            weighted, normals = launcher.zeros((3 * len(faces), 3)), launcher.zeros(vertices.shape)
        launcher.launch(WEIGH, len(faces), (vertices, faces, tables.place), (weighted,))
        launcher.launch(SUM, len(normals), (weighted, tables.start, np.float32(posing.sign)), (normals,))
        return normals

    def _tables(self, driven: MeshDriven) -> _Tables:
        known = self._known.get(driven)
        if known is None:
            copy, smoother = self.launcher.array, driven.normals
            with self.launcher.failures("copying a binding"):
                own = {name: copy(getattr(driven.surfels, name)) for name in ("opacity", *BASE_CHANNELS)}
                rest = tuple(map(copy, driven.rest))
                known = _Tables(rest, copy(driven.mesh.faces), copy(smoother.start), copy(smoother.place), own)
            self._known[driven] = known
        return known

    def _own(self, tables: _Tables, driven: MeshDriven, name: str, array: Array) -> Any:
        """The device's copy of an array of the surfels, or the array where it is another one."""
        return tables.channels[name] if array is getattr(driven.surfels, name) else array
