"""Splats in OpenUSD: the schema ParticleField3DGaussianSplat of UsdVol, read and written with usd-core.

https://openusd.org/release/user_guides/schemas/usdVol/ParticleField3DGaussianSplat.html, or a ParticleField whose
kernel is the Gaussian surflet, a 2D Gaussian in the plane of its X and Y axes:
https://openusd.org/release/user_guides/schemas/usdVol/ParticleFieldKernelGaussianSurfletAPI.html
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..core.asset.archive import replace_by
from ..core.errors import DeviceError, WriteError
from ..core.file_types import USD_KERNELS
from ..core.own_python import install_remedy
from . import usd_stage
from .axes import UP_AXES
from .files import SurfelFile
from .splat_scene import Piece, join_pieces
from .splats import THICKNESS, SplatMaterials, Splats, writable
from .subprocess_reader import PATIENCE, SECONDS, read_in_subprocess
from .usd_crate import check_crate
from .usd_primvars import primvar_values
from .usd_stage import ATTRIBUTES, DEGREE, FIELD, HARMONICS, MATERIALS, NO_SPLATS, SCHEMA, SPACE, SURFLET, UP

Array = np.ndarray

#: What to do for what is not read.
MESHES = "For its meshes, import it in Blender and export glTF (.glb), which is read"
_NAMES = (b".usda", b".usdc", b".usd")


def sniff_usd(head: bytes, path: Path) -> bool:
    """Whether a file is USD: text, crate, or a zip that starts with one."""
    if head.startswith(b"PK\x03\x04"):
        return any(name in head[:512].lower() for name in _NAMES)
    return head.startswith((b"PXR-USDC", b"#usda "))


def read_usd_splats(path: Path) -> SurfelFile:
    """Read all splats of a USD stage at its earliest time, in metres; up as the stage says.

    Raises
    ------
    AssetError
        The file is damaged or has no splats.
    DeviceError
        usd-core is not installed.
    """
    check_crate(path)
    arrays = read_in_subprocess(
        path, usd_stage.__name__, "USD", _not_installed(), {NO_SPLATS: MESHES}, SECONDS, PATIENCE
    )
    up = arrays.pop(UP).tobytes().decode(errors="replace")
    pieces = []
    for i in range(sum(name.endswith("/matrix") for name in arrays)):
        of = {name: arrays[f"{i}/{name}"] for name in ("centre", "scale", "rotation", "opacity", "sh")}
        values = [arrays[f"{i}/{name}"] for name in MATERIALS if f"{i}/{name}" in arrays]
        materials = SplatMaterials(*values) if len(values) == len(MATERIALS) else None
        if f"{i}/flat" in arrays:
            of["scale"] = np.column_stack([of["scale"][:, :2], THICKNESS * of["scale"][:, :2].min(axis=1)])
        pieces.append(Piece(Splats(**of, materials=materials), arrays[f"{i}/matrix"], bool(arrays[f"{i}/linear"][0])))
    return join_pieces(pieces, path, "USD", up if up in UP_AXES else "y")


def write_usd_splats(path: Path, splats: Splats, materials: bool = False, kernel: str = USD_KERNELS[0]) -> None:
    """Write a stage with `splats`, which are Z up, in metres; with `materials`, see `usd_primvars`.

    The `kernel` is "ellipsoid" or "surflet": the latter has no extent along the third axis, as a surfel.

    Raises DeviceError (usd-core is not installed), AssetError (see `splats.writable`) or WriteError.
    """
    splats = writable(splats, str(path))
    check_usd(str(path))
    from pxr import Usd, UsdGeom

    try:
        stage = Usd.Stage.CreateInMemory()
        UsdGeom.SetStageUpAxis(stage, "Z")
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        prim = define_field(stage, "/Splats", kernel)
        stage.SetDefaultPrim(prim)
        for attribute, value in field_values(prim, splats, materials):
            attribute.Set(value)
    except RuntimeError as error:
        raise WriteError(str(path), f"cannot be written ({error})", "Report it") from error
    replace_by(path, lambda temporary: stage.GetRootLayer().Export(str(temporary)))


def define_field(stage: Any, path: str, kernel: str) -> Any:
    """A new prim at `path` for splats of a kernel, a name of `USD_KERNELS`."""
    from pxr import Sdf

    flat = kernel != USD_KERNELS[0]
    prim = stage.DefinePrim(path, FIELD if flat else SCHEMA)
    for name in (*ATTRIBUTES, SURFLET) if flat else ():
        prim.AddAppliedSchema(name)
    prim.AddAppliedSchema("ColorSpaceAPI")
    space = prim.CreateAttribute(SPACE, Sdf.ValueTypeNames.Token, custom=False, variability=Sdf.VariabilityUniform)
    space.Set("srgb_rec709_scene")  # of the names that USD knows; without one, colours are linear to it
    return prim


def field_values(prim: Any, splats: Splats, materials: bool) -> list[tuple[Any, Any]]:
    """Splats that are `writable` as attributes made on `prim`, which `define_field` made, with what to set them to."""
    from pxr import Gf, Sdf, Vt

    types = Sdf.ValueTypeNames
    reach = 3 * splats.scale.max(axis=1, keepdims=True)
    extent = np.zeros((2, 3))
    if len(splats):
        extent = np.stack([(splats.centre - reach).min(axis=0), (splats.centre + reach).max(axis=0)])
    quaternions = np.ascontiguousarray(splats.rotation[:, [1, 2, 3, 0]])
    values = [
        ("positions", types.Point3fArray, Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(splats.centre))),
        ("scales", types.Float3Array, Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(splats.scale))),
        ("orientations", types.QuatfArray, Vt.QuatfArray.FromNumpy(quaternions)),
        ("opacities", types.FloatArray, Vt.FloatArray.FromNumpy(np.ascontiguousarray(splats.opacity))),
        (HARMONICS, types.Float3Array, Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(splats.sh).reshape(-1, 3))),
        ("extent", types.Float3Array, Vt.Vec3fArray([Gf.Vec3f(*row.tolist()) for row in extent])),
    ]
    degree = prim.CreateAttribute(DEGREE, types.Int, custom=False, variability=Sdf.VariabilityUniform)
    found = [(degree, int(np.sqrt(splats.sh.shape[1])) - 1)]
    found += [(prim.CreateAttribute(name, kind, custom=False), value) for name, kind, value in values]
    return found + (primvar_values(prim, splats) if materials else [])


def check_usd(subject: str) -> None:
    """Raise DeviceError about `subject` where usd-core is not installed."""
    try:
        import pxr  # noqa: F401
    except ImportError as error:
        raise DeviceError(subject, *_not_installed()) from error


def _not_installed() -> tuple[str, str]:
    """What is missing, and what to do."""
    return "needs the package usd-core", f"Install it: {install_remedy('usd-core', 'USD, 3MF and COLLADA')}"
