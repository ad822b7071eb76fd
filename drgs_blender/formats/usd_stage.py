"""The splats of a USD stage as plain arrays in a file: a program of its own, since USD's library may hang or crash on
damaged files. `usd_splats` runs it with limits.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from ..asset.tensors import encode
from ..errors import AssetError

Array = np.ndarray

SCHEMA = "ParticleField3DGaussianSplat"
DEGREE = "radiance:sphericalHarmonicsDegree"
HARMONICS = "radiance:sphericalHarmonicsCoefficients"
#: Attribute of UsdColorSpaceAPI, and how the names of linear light with our primaries start.
SPACE, LINEAR = "colorSpace:name", "lin_rec709"
#: Codes to leave with: the file is refused (the reason is the last line of stderr), USD is not installed.
REFUSED, LACKING = 65, 69
#: Name of the text that says which axis is up.
UP = "up"
REMEDY = "Export it again, or restore it from a copy"


def main(source: str, target: str, most_bytes: str) -> None:
    """Write the pieces of the stage `source` to `target` with at most so many bytes of memory; leave with a code."""
    if sys.platform.startswith("linux"):
        import resource

        now, most = resource.getrlimit(resource.RLIMIT_AS)
        wanted = [int(most_bytes), *(v for v in (now, most) if v != resource.RLIM_INFINITY)]
        resource.setrlimit(resource.RLIMIT_AS, (min(wanted), most))
    try:
        from pxr import Usd, UsdGeom
    except ImportError:
        sys.exit(LACKING)
    try:
        arrays = read_stage(source, Usd, UsdGeom)
        with open(target, "wb") as file:
            file.writelines(encode(arrays))
    except AssetError as error:
        sys.stderr.write(f"\n{error.problem}\n")
    except (RuntimeError, TypeError, ValueError, MemoryError, OverflowError) as error:  # what USD's library raises
        reason = str(error).strip().splitlines()[-1:] or ["no reason given"]
        sys.stderr.write(f"\ncannot be read as USD ({reason[0][:200]})\n")
    else:
        sys.exit(0)
    sys.exit(REFUSED)


def read_stage(subject: str, usd: Any, geometry: Any) -> dict[str, Array]:
    """Arrays of each piece, "0/centre" and so on, at the earliest time, with its matrix to the stage in metres."""
    stage = usd.Stage.Open(subject)
    prims = [prim for prim in stage.Traverse() if prim.GetTypeName() == SCHEMA]
    if not prims:
        raise AssetError(subject, f"has no {SCHEMA}, and of USD nothing else is read (meshes are, of glTF)")
    time = usd.TimeCode.EarliestTime()
    places = geometry.XformCache(time)
    metres = np.diag([*[geometry.GetStageMetersPerUnit(stage)] * 3, 1.0])
    arrays: dict[str, Array] = {UP: np.frombuffer(str(geometry.GetStageUpAxis(stage)).lower().encode(), np.uint8)}
    for i, prim in enumerate(prims):
        # USD's matrices take rows for vectors.
        arrays[f"{i}/matrix"] = metres @ np.array(places.GetLocalToWorldTransform(prim), np.float64).T
        arrays[f"{i}/linear"] = np.array([_space(prim).startswith(LINEAR)])
        arrays |= {f"{i}/{name}": array for name, array in _splats(prim, time, subject).items()}
    return arrays


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

    def take(name: str, width: int, each: int = 1) -> Array | None:
        for attribute in (prim.GetAttribute(name), prim.GetAttribute(name + "h")):  # float before half
            value = attribute.Get(time) if attribute else None
            if value is not None and len(value):
                table = np.array(value, np.float32).reshape(len(value), width)
                return table if name == "positions" or len(table) >= n * each else None
        return None

    n = 0
    centre = take("positions", 3)
    if centre is None:
        raise AssetError(subject, f"has {prim.GetPath()} without positions")
    n = len(centre)
    degree = prim.GetAttribute(DEGREE).Get() if prim.GetAttribute(DEGREE) else 3
    count = (int(degree) + 1) ** 2 if isinstance(degree, int) and 0 <= degree <= 8 else 1
    harmonics = take(HARMONICS, 3, count)
    rotation, scale, opacity = take("orientations", 4), take("scales", 3), take("opacities", 1)
    sh = np.zeros((n, 1, 3), np.float32) if harmonics is None else harmonics[: n * count].reshape(n, count, 3)
    identity = np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1))
    return {
        "centre": centre,
        "scale": np.ones((n, 3), np.float32) if scale is None else scale[:n],
        # In memory the imaginary part of a quaternion comes first.
        "rotation": identity if rotation is None else rotation[:n, [3, 0, 1, 2]],
        "opacity": np.ones(n, np.float32) if opacity is None else opacity[:n, 0],
        "sh": sh[:, :16],
    }
