"""File types: extensions of the files that are read and written, and of camera files; `formats` knows content."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Kind = Literal["surfels", "mesh", "environment", "materials"]
Held = Literal["splats", "mesh", "environment", "sequence"]


@dataclass(frozen=True, slots=True)
class ReadType:
    """Files that can be read.

    Attributes
    ----------
    extensions : tuple of str
        Usual endings; they never decide alone.
    kind : {"surfels", "mesh", "environment", "materials"}
        Kind of the data that is read.
    """

    extensions: tuple[str, ...]
    kind: Kind


@dataclass(frozen=True, slots=True)
class WriteType:
    """Files that can be written.

    Attributes
    ----------
    extensions : tuple of str
        Endings that choose it.
    kind : {"splats", "mesh", "environment", "sequence"}
        Kind of the data that is written; a sequence has the meshes, and perhaps the surfels, of all frames.
    up : {"z", "y"}
        The up axis that the format prescribes, or that is written unless asked otherwise.
    fixed : bool
        No other up axis can be asked for.
    options : tuple of str
        Options of `drgs convert` that it takes, as keywords of its writer.
    """

    extensions: tuple[str, ...]
    kind: Held
    up: Literal["z", "y"]
    fixed: bool
    options: tuple[str, ...] = ()


READ: dict[str, ReadType] = {
    "Gaussian PLY": ReadType((".ply",), "surfels"),
    "compressed PLY": ReadType((".ply",), "surfels"),
    "SPZ": ReadType((".spz",), "surfels"),
    "SOG": ReadType((".sog", ".json"), "surfels"),
    "streamed SOG": ReadType((".json",), "surfels"),
    "glTF splats": ReadType((".glb", ".gltf"), "surfels"),
    "USD": ReadType((".usd", ".usda", ".usdc", ".usdz"), "surfels"),
    "splat": ReadType((".splat",), "surfels"),
    "ksplat": ReadType((".ksplat",), "surfels"),
    "PLY mesh": ReadType((".ply",), "mesh"),
    "glTF 2.0": ReadType((".glb", ".gltf"), "mesh"),
    "Wavefront OBJ": ReadType((".obj",), "mesh"),
    "3MF": ReadType((".3mf",), "mesh"),
    "COLLADA": ReadType((".dae",), "mesh"),
    "OFF": ReadType((".off",), "mesh"),
    "STL": ReadType((".stl",), "mesh"),
    "Radiance HDR": ReadType((".hdr",), "environment"),
    "OpenEXR": ReadType((".exr",), "environment"),
    "picture": ReadType((".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff"), "environment"),
    "learned light": ReadType((".map", ".pth"), "environment"),
    "NeRO materials": ReadType((".npy",), "materials"),
}

#: Versions of SPZ that are read and written; the last one is written unless asked otherwise.
SPZ_VERSIONS = (2, 3, 4)

#: Kernels of splats in USD; the first one is written unless asked otherwise.
USD_KERNELS = ("ellipsoid", "surflet")
#: Names of stages.
USD_SUFFIXES = (".usdc", ".usda", ".usd", ".usdz")

WRITTEN: dict[str, WriteType] = {
    "3DGS PLY": WriteType((".ply",), "splats", "z", False, ("materials",)),
    "SPZ": WriteType((".spz",), "splats", "y", True, ("spz_version",)),
    "SOG": WriteType((".sog",), "splats", "z", False),
    "glTF splats": WriteType((".glb",), "splats", "y", True, ("materials", "compress", "spz_version")),
    "USD splats": WriteType((".usd", ".usda", ".usdc"), "splats", "z", True, ("materials", "kernel")),
    "glTF mesh": WriteType((".glb",), "mesh", "y", True),
    "USD mesh": WriteType((".usdz",), "mesh", "z", True),
    "USD sequence": WriteType(USD_SUFFIXES, "sequence", "z", True, ("surfels", "materials", "kernel")),
    "Alembic sequence": WriteType((".abc",), "sequence", "y", True),
    "OpenEXR": WriteType((".exr",), "environment", "z", True),
}

#: What Alembic lacks, in a sentence for the user.
LOST_IN_ALEMBIC = "surfels, materials, attributes and instances are left out: Alembic has shape, motion and UV maps"

#: Videos of which `drgs capture` takes frames.
VIDEOS = frozenset((".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm", ".mts"))

#: What the matrices in files of cameras may be, and their axes; `reconstruct.readers` turns them.
CAMERAS: dict[str, str] = {
    "opengl": "camera to world, y up, z backward",
    "opencv": "camera to world, y down, z forward",
    "opengl-inverse": "world to camera, y up, z backward",
    "opencv-inverse": "world to camera, y down, z forward",
}
#: Whether photographs show an object that was turned while camera and light stood still.
TURNTABLE = ("auto", "yes", "no")


def extensions(*kinds: Kind) -> tuple[str, ...]:
    """Usual endings of what is read, each once."""
    return tuple(dict.fromkeys(e for t in READ.values() if t.kind in kinds for e in t.extensions))
