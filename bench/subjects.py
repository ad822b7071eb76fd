"""The objects the benchmarks look at: real meshes of examples/, with materials from matte to polished."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from report import OUT, ROOT

from drgs_blender.build import make
from drgs_blender.build.make import make_asset, read_mesh_file
from drgs_blender.compute.closure import digest
from drgs_blender.core.asset import Asset, Mesh
from drgs_blender.core.asset.container import read_asset, write_asset
from drgs_blender.formats.files import Image, MaterialFile
from drgs_blender.formats.images import load_image

SOURCES = {
    "spot": ("spot/spot_triangulated.obj", {"up": "y"}),
    "cat": ("cat/egyptian_cat.glb", {}),
    "robot": ("robot/RobotExpressive.glb", {}),
    "helmet": ("helmet/FlightHelmet.gltf", {}),
}


def source_digest() -> str:
    """Digest of the sources that make assets: assets of older sources are made again."""
    return digest(Path(make.__file__))


def asset_path(name: str, textures: bool = False, **options: Any) -> Path:
    """`.drgs` of an example as `drgs make` builds it with `options`, made once for these sources.

    Without `textures` its materials are those of its vertices alone, which Cycles is given as well, and it has no more
    surfels than these need.
    """
    kind = ["textures" if textures else "plain"]
    path = OUT / source_digest() / ("-".join([name, *map(str, options.values()), *kind]) + ".drgs")
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        file, defaults = SOURCES[name]
        options |= {} if textures else {"max_texture": 0, "max_surfels": 1}
        write_asset(path, make_asset(ROOT / "examples" / file, **defaults, **options))
    return path


def textured_spot() -> Path:
    """`.drgs` of spot with its spots: the file of the example names no texture."""
    path = OUT / source_digest() / "spot-textured.drgs"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        file, options = SOURCES["spot"]
        source = read_mesh_file(ROOT / "examples" / file)
        image = Image(load_image(ROOT / "examples" / "spot" / "spot_texture.png"), srgb=True)
        source.materials = [MaterialFile("Spot", (1.0, 1.0, 1.0), base_colour_image=image)]
        source.face_material = np.zeros(len(source.faces), np.int32)
        write_asset(path, make_asset(source, **options))
    return path


def spread_materials(mesh: Mesh) -> dict[str, np.ndarray]:
    """Arrays of `mesh` with roughness .1 to .9 from bottom to top and metallic 0 to 1 around the vertical axis."""
    v = mesh.vertices
    low, high = v.min(0), v.max(0)
    height = (v[:, 2] - low[2]) / max(float(high[2] - low[2]), 1e-6)
    angle = np.arctan2(v[:, 1] - (low[1] + high[1]) / 2, v[:, 0] - (low[0] + high[0]) / 2)
    return {
        "vertices": v,
        "faces": mesh.faces,
        "albedo": np.clip(mesh.albedo, 0.05, 0.95),
        "roughness": (0.1 + 0.8 * height).astype(np.float32),
        "metallic": (0.5 + 0.5 * np.sin(3 * angle)).astype(np.float32),
    }


def save_mesh(path: Path, mesh: Mesh) -> None:
    """Write what Cycles' jobs take of a mesh as .npz."""
    np.savez(path, **{name: getattr(mesh, name) for name in ("vertices", "faces", "albedo", "roughness", "metallic")})


def spread_asset(name: str) -> tuple[Path, Path]:
    """(.drgs, .npz) of an example with spread materials, for our engine and for Cycles."""
    folder = asset_path(name).parent
    drgs, npz = folder / f"{name}-spread.drgs", folder / f"{name}-spread.npz"
    if not (drgs.exists() and npz.exists()):
        asset = read_asset(asset_path(name))
        data = spread_materials(asset.mesh)
        mesh = Mesh(**data)
        write_asset(drgs, Asset(asset.surfels, mesh, asset.binding, None, {"source": name}))
        np.savez(npz, **data)
    return drgs, npz
