"""Poses of the mesh that an asset was made from, in the order in which Blender imports it, against Cycles.

python bench/bench_poses.py [--size 192] [--seeds 3] [--spp 512] [--samples 1024]

Blender imports each file, bends the vertices and renders them with Cycles; the same array poses the asset that
`drgs make` makes of the file. Meshes that are not in examples/ are left out where the folder of shared data is absent.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from bench_parity import score
from judge import blender_python, environments, frame_camera
from ours import SESSION, relight
from report import OUT, ROOT, table, write_section
from scipy.spatial import cKDTree

from drgs_blender.build.make import make_asset, read_mesh_file
from drgs_blender.core.asset.container import read_asset, write_asset
from drgs_blender.formats.files import MaterialFile

Array = np.ndarray

SHARED = ROOT.parent / "shared" / "data" / "meshes"
FILES = [
    ROOT / "examples" / "spot" / "spot_triangulated.obj",
    ROOT / "examples" / "cat" / "egyptian_cat.glb",
    SHARED / "suzanne.obj",
    SHARED / "teapot.obj",
    SHARED / "odedstein" / "human" / "human_man.obj",
    SHARED / "odedstein" / "penguin" / "penguin.obj",
    SHARED / "odedstein" / "armadillo" / "armadillo.obj",
]
BOUNCES, STRENGTH = 2, 0.35
_PROGRAM = Path(__file__).with_name("poses_job.py")


def asset_of(path: Path) -> Path:
    """Asset of a file in one grey, smooth."""
    target = OUT / f"poses-{path.stem}.drgs"
    file = read_mesh_file(path)
    grey = [MaterialFile("grey", (0.6, 0.6, 0.6), 0.5)]
    file = replace(file, corner_normals=None, materials=grey, face_material=None, vertex_colours=None)
    write_asset(target, make_asset(file, up="y" if path.suffix == ".obj" else None))
    return target


def run_blender(jobs: list[dict[str, Any]]) -> None:
    """Do `poses_job`."""
    path = OUT / "poses.json"
    path.write_text(json.dumps(jobs))
    subprocess.run([str(blender_python()), str(_PROGRAM), str(path)], check=True, timeout=3000)


def by_place(rest: Array, vertices: Array) -> tuple[Array, float]:
    """The vertex of `rest` at the place of each of the asset, and the largest distance of these places."""
    distance, index = cKDTree(rest).query(vertices)
    return index, float(distance.max())


def main() -> None:
    """Measure and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=192)
    parser.add_argument("--seeds", type=int, default=3, help="independent pictures of either program, at least 2")
    parser.add_argument("--spp", type=int, default=512, help="of Cycles, per pixel and picture")
    parser.add_argument("--samples", type=int, default=1024, help="of ours, per pixel and picture")
    options = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    files = [path for path in FILES if path.exists()]
    light = str(environments() / "city.exr")
    jobs = []
    for path in files:
        rest, pose = (str(OUT / f"poses-{path.stem}-{name}.npy") for name in ("rest", "pose"))
        jobs.append({"file": str(path), "rest": rest, "pose": pose, "renders": []})
    run_blender(jobs)
    assets = [asset_of(path) for path in files]
    for path, job in zip(files, jobs):
        shape = np.load(job["pose"])
        shape = turned(shape) if path.suffix == ".obj" else shape  # Blender's importer turns the object
        outs = [str(OUT / f"poses-{path.stem}-{seed}.npy") for seed in range(options.seeds)]
        job |= {
            "environment": light, "strength": STRENGTH, "camera": frame_camera(shape, options.size, azimuth=-60),
            "samples": options.spp, "bounces": BOUNCES,
            "renders": [{"out": out, "seed": seed} for seed, out in enumerate(outs)],
        }  # fmt: skip
    run_blender(jobs)
    rows = [row(path, asset, job, options) for path, asset, job in zip(files, assets, jobs)]
    body = (
        f"`drgs make` of {len(files)} files in one grey, posed by the vertices of Blender's importer in its order; "
        f"{options.size} x {options.size}, HDRI, {BOUNCES} bounces, {options.seeds} seeds of {options.spp} and "
        f"{options.samples} samples. *By place*: the same pose with each vertex found by its place at rest, in the "
        "asset's own order. PSNR of the foreground in sRGB without the noise of either program; `>` where the "
        "difference cannot be told from zero.\n\n"
        + table(["mesh", "vertices of the file", "of the asset", "pictures by place", "against Cycles, dB"], rows)
    )
    write_section("poses", "Poses in the order of the source", body)


def turned(vertices: Array) -> Array:
    """Y up to Z up."""
    return vertices[:, (0, 2, 1)] * np.float32((1, -1, 1))


def row(path: Path, asset: Path, job: dict[str, Any], options: argparse.Namespace) -> list[object]:
    """A line of the table."""
    mesh = read_asset(asset).mesh
    rest, pose = np.load(job["rest"]), np.load(job["pose"])
    if path.suffix == ".obj":
        rest, pose = turned(rest), turned(pose)
    key = SESSION.load_asset(asset)
    index, apart = by_place(rest, SESSION.asset(key).mesh.vertices)
    size = float(np.ptp(rest, axis=0).max())
    if apart > 1e-6 * size:
        raise SystemExit(f"{path.name}: a vertex of the asset lies {apart:g} away from all of the file")
    given = {
        "source": mesh.source.to_asset(np.load(job["pose"])) if mesh.source is not None else pose,
        "place": pose[index],
    }
    pictures = {
        name: np.stack([
            relight(
                asset, job["environment"], job["camera"], samples=options.samples, vertices=vertices,
                camera_sees="mesh", subpixel_samples=16, bounces=BOUNCES, strength=STRENGTH, seed=seed,
            )["Combined"]
            for seed in range(options.seeds)
        ])
        for name, vertices in given.items()
    }  # fmt: skip
    same = np.array_equal(pictures["source"], pictures["place"])
    most = float(np.abs(pictures["source"] - pictures["place"]).max())
    theirs = np.stack([np.load(picture["out"]) for picture in job["renders"]])
    found = "the same bits" if same else f"{most:.1g} apart at most"
    print(path.name, found, score(pictures["source"], theirs), flush=True)
    return [path.name, len(rest), len(mesh.vertices), found, str(score(pictures["source"], theirs))]


if __name__ == "__main__":
    main()
