"""Simulated frames in OpenUSD: the moving mesh and its particles, written with usd-core."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from ..core.asset.archive import replace_by
from ..core.errors import DeviceError, WriteError
from ..core.particle_cache import ParticleFrame

Array = np.ndarray

SUFFIXES = (".usd", ".usda", ".usdc")


def check_usd(path: Path) -> None:
    """Raise DeviceError where usd-core is not installed: before frames are computed for `path`."""
    try:
        import pxr  # noqa: F401
    except ImportError as error:
        raise DeviceError(str(path), "needs the package usd-core", "Install it: pip install usd-core") from error


def write_usd_points(
    path: Path,
    frames: Iterable[ParticleFrame],
    faces: Array,
    first: int,
    fps: float,
    matrix_world: Sequence[Sequence[float]],
) -> None:
    """Write a stage, Z up, in metres: ``/Matter/Mesh`` and ``/Matter/Points`` with a time sample a frame.

    Parameters
    ----------
    path : Path
    frames : iterable of ParticleFrame
        In their order, object space.
    faces : (m, 3) int array
        Triangles of the mesh.
    first : int
        Number of the first frame.
    fps : float
        Frames per second.
    matrix_world : sequence of sequence of float
        (4, 4) object to world: the transform of ``/Matter``.

    Raises
    ------
    DeviceError
        usd-core is not installed.
    WriteError
        Naming the file and the system's reason.
    """
    check_usd(path)
    from pxr import Gf, Usd, UsdGeom, Vt

    def vectors(values: Array) -> Vt.Vec3fArray:
        return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, np.float32))

    def extent(values: Array) -> Vt.Vec3fArray:
        return vectors(np.stack([values.min(axis=0), values.max(axis=0)]))

    try:
        stage = Usd.Stage.CreateInMemory()
        UsdGeom.SetStageUpAxis(stage, "Z")
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        root = UsdGeom.Xform.Define(stage, "/Matter")
        # USD's matrices take rows for vectors.
        root.AddTransformOp().Set(Gf.Matrix4d(np.asarray(matrix_world, np.float64).T.tolist()))
        mesh, points = UsdGeom.Mesh.Define(stage, "/Matter/Mesh"), UsdGeom.Points.Define(stage, "/Matter/Points")
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray([3] * len(faces)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces, np.int32).reshape(-1)))
        mesh.CreateSubdivisionSchemeAttr("none")
        last = first
        for last, frame in enumerate(frames, first):
            for prim, values in ((mesh, frame.vertices), (points, frame.points)):
                prim.GetPointsAttr().Set(vectors(values), last)
                prim.GetExtentAttr().Set(extent(values), last)
        stage.SetDefaultPrim(root.GetPrim())
        stage.SetStartTimeCode(first)
        stage.SetEndTimeCode(last)
        stage.SetTimeCodesPerSecond(fps)
        stage.SetFramesPerSecond(fps)
    except RuntimeError as error:  # what errors of USD derive from
        raise WriteError(str(path), f"cannot be written ({error})", "Report it") from error
    replace_by(path, lambda temporary: stage.GetRootLayer().Export(str(temporary)))
