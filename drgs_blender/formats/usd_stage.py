"""The splats of a USD stage as plain arrays in a file.

A program of its own, since USD's library may hang or crash on damaged files. `usd_splats` runs it with limits.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from ..core.errors import AssetError
from .subprocess_reader import limit, write_arrays

Array = np.ndarray

SCHEMA = "ParticleField3DGaussianSplat"
#: A field of particles of any kernel, the two kernels that are Gaussian, and the APIs of such a field's attributes.
FIELD = "ParticleField"
ELLIPSOID, SURFLET = "ParticleFieldKernelGaussianEllipsoidAPI", "ParticleFieldKernelGaussianSurfletAPI"
_KERNEL = "ParticleFieldKernel"
ATTRIBUTES = tuple(
    f"ParticleField{name}AttributeAPI" for name in ("Position", "Orientation", "Scale", "Opacity", "SphericalHarmonics")
)
DEGREE = "radiance:sphericalHarmonicsDegree"
HARMONICS = "radiance:sphericalHarmonicsCoefficients"
#: Attribute of UsdColorSpaceAPI, and how the names of linear light with our primaries start.
SPACE, LINEAR = "colorSpace:name", "lin_rec709"
#: Primvars of materials, with their widths, by the names that their arrays have.
MATERIALS = {"albedo": ("primvars:Cd", 3), "roughness": ("primvars:rough", 1), "metallic": ("primvars:metallic", 1)}
#: Limit of splats that references repeat: bytes, and bytes per byte of the files.
_SPLATS, _RATIO = 64 << 20, 32
#: Name of the text that says which axis is up.
UP = "up"
_ELSEWHERE = "which is not in this package"
NO_SPLATS = f"holds no splats ({SCHEMA}), and of USD nothing else is read"


def main(source: str, target: str, most_bytes: str, most_seconds: str) -> None:
    """Write the pieces of the stage `source` to `target`; exit with a code (see `subprocess_reader`)."""
    limit(int(most_bytes), int(most_seconds))

    def read(subject: str) -> dict[str, Array]:
        from pxr import Usd, UsdGeom

        return read_stage(subject, Usd, UsdGeom)

    write_arrays(source, target, "USD", read)


def read_stage(subject: str, usd: Any, geometry: Any) -> dict[str, Array]:
    """Arrays of each piece, "0/centre" and so on, at the earliest time, with its matrix to the stage in metres."""
    package = _check_package(subject)
    stage = usd.Stage.Open(subject)
    prims = [prim for prim in stage.Traverse() if prim.GetTypeName() in (SCHEMA, FIELD)]
    if not prims:
        raise AssetError(subject, NO_SPLATS)
    time = usd.TimeCode.EarliestTime()
    places = geometry.XformCache(time)
    metres = np.diag([*[geometry.GetStageMetersPerUnit(stage)] * 3, 1.0])
    arrays: dict[str, Array] = {UP: np.frombuffer(str(geometry.GetStageUpAxis(stage)).lower().encode(), np.uint8)}
    files = {_outer(layer.identifier) for layer in stage.GetUsedLayers(True) if not layer.anonymous}
    room = _SPLATS + _RATIO * sum(os.path.getsize(file) for file in files if os.path.isfile(file))
    for i, prim in enumerate(prims):
        # USD's matrices take rows for vectors.
        arrays[f"{i}/matrix"] = metres @ np.array(places.GetLocalToWorldTransform(prim), np.float64).T
        if _is_flat(prim, subject):
            arrays[f"{i}/flat"] = np.array([True])
        arrays[f"{i}/linear"] = np.array([_space(prim).startswith(LINEAR)])
        splats = _splats(prim, time, subject)
        room -= sum(array.nbytes for array in splats.values())
        if room < 0:
            raise AssetError(subject, "refers to its splats so often that they are more than such files can hold")
        arrays |= {f"{i}/{name}": array for name, array in splats.items()}
    if package:  # also against layers that only values name
        for layer in stage.GetUsedLayers(True):
            if not layer.anonymous and _outer(layer.identifier) != package:
                raise AssetError(subject, f"refers to {layer.identifier!r}, {_ELSEWHERE}")
    return arrays


def _check_package(subject: str) -> str:
    """The file of a package (.usdz), empty where `subject` is none.

    A package comes from elsewhere and is whole: it may not lead to other files of this machine, which USD would open.
    Stages of other kinds may: a studio's layers refer to each other across folders.
    """
    from pxr import Sdf

    root = Sdf.Layer.FindOrOpen(subject)
    if not root or not root.GetFileFormat().IsPackage():
        return ""
    package, waiting, seen = _outer(subject), [root], {root.identifier}
    while waiting:
        layer = waiting.pop()
        for name in layer.GetCompositionAssetDependencies():
            found = Sdf.ComputeAssetPathRelativeToLayer(layer, name) if name else ""
            if found and _outer(found) != package:
                raise AssetError(subject, f"refers to {name!r}, {_ELSEWHERE}")
            if found and found not in seen and (other := Sdf.Layer.FindOrOpen(found)):
                waiting.append(other)
            seen.add(found)
    return package


def _outer(identifier: str) -> str:
    """The file on the disk in which a layer lies."""
    from pxr import Ar

    return os.path.realpath(Ar.SplitPackageRelativePathOuter(identifier)[0])


def _is_flat(prim: Any, subject: str) -> bool:
    """Whether the kernel is a surflet: a Gaussian in the plane of X and Y, whatever the scale along Z."""
    kernels = [str(name) for name in prim.GetAppliedSchemas() if str(name).startswith(_KERNEL)]
    kernel = next((name for name in kernels if name != f"{_KERNEL}BaseAPI"), "none")  # the strongest comes first
    if kernel not in (ELLIPSOID, SURFLET):
        raise AssetError(subject, f"has {prim.GetPath()} with the kernel {kernel}; Gaussian ones are read")
    return kernel == SURFLET


def _space(prim: Any) -> str:
    """The colour space of a prim, which those below inherit; empty where none is given: the harmonics of captures."""
    while prim:
        attribute = prim.GetAttribute(SPACE)
        if attribute and (name := attribute.Get()):
            return str(name)
        prim = prim.GetParent()
    return ""


def _splats(prim: Any, time: Any, subject: str) -> dict[str, Array]:
    """The attributes of a prim; those that are absent or too short have the schema's defaults."""

    def values_of(name: str, width: int, each: int = 1) -> Array | None:
        for attribute in (prim.GetAttribute(name), prim.GetAttribute(name + "h")):  # float before half
            value = attribute.Get(time) if attribute and attribute.GetTypeName().isArray else None
            if value is not None and len(value):
                numbers = np.array(value, np.float32)
                if numbers.size != len(value) * width:  # a primvar of that name may be anything
                    return None
                table = numbers.reshape(len(value), width)
                return table if name == "positions" or len(table) >= n * each else None
        return None

    n = 0
    centre = values_of("positions", 3)
    if centre is None:
        raise AssetError(subject, f"has {prim.GetPath()} without positions")
    n = len(centre)
    degree = prim.GetAttribute(DEGREE).Get() if prim.GetAttribute(DEGREE) else 3
    count = (int(degree) + 1) ** 2 if isinstance(degree, int) and 0 <= degree <= 8 else 1
    harmonics = values_of(HARMONICS, 3, count)
    rotation, scale, opacity = values_of("orientations", 4), values_of("scales", 3), values_of("opacities", 1)
    sh = np.zeros((n, 1, 3), np.float32) if harmonics is None else harmonics[: n * count].reshape(n, count, 3)
    identity = np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1))
    given = {name: values_of(attribute, width) for name, (attribute, width) in MATERIALS.items()}
    materials = {
        name: array[:n].squeeze(1) if array.shape[1] == 1 else array[:n]
        for name, array in given.items()
        if array is not None
    }
    return materials | {
        "centre": centre,
        "scale": np.ones((n, 3), np.float32) if scale is None else scale[:n],
        # In memory the imaginary part of a quaternion comes first.
        "rotation": identity if rotation is None else rotation[:n, [3, 0, 1, 2]],
        "opacity": np.ones(n, np.float32) if opacity is None else opacity[:n, 0],
        "sh": sh[:, :16],
    }
