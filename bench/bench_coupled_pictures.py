"""Pictures of bodies that push each other: a capture of jelly that falls on sand, and two that fly into each other.

python bench/bench_coupled_pictures.py --assets out/bench/assets [--size 260]

Says how deep one is in the other at most, in cells of the grid, at every frame.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import igl
import numpy as np
import trimesh
from bench_thin import BOUNCES, STRENGTH, ground, save
from judge import environments, frame_camera
from ours import SESSION, pinhole
from report import OUT, add_publish, picture_path

from drgs_blender.core.asset import Asset, Mesh
from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.frame import Frame, ObjectState, RenderSettings, World
from drgs_blender.core.particle_cache import ParticleCache
from drgs_blender.deform.attach import attach
from drgs_blender.formats.registry import read_environment
from drgs_blender.simulation.coupled_bake import bake_coupled
from drgs_blender.simulation.coupled_job import CoupledJob, prepare_coupled
from drgs_blender.simulation.coupled_settings import parse_coupled

Array = np.ndarray

FIGURE = "coupled.png"
FOLDER = OUT / "coupled"
#: Frames that are shown of each.
FALLEN, FLOWN = (1, 4, 8, 30), (1, 8, 11, 15)


def mound(path: Path, across: float, height: float) -> Path:
    """An asset: a round heap of sand."""
    shape = trimesh.creation.icosphere(6, 1.0)
    flat = np.maximum(shape.vertices[:, 2], -0.02)
    shape.vertices = np.stack([*(0.5 * across * shape.vertices[:, :2].T), height * (flat + 0.02)], -1)
    n = len(shape.vertices)
    colour = np.tile(np.float32([0.62, 0.47, 0.28]), (n, 1))
    colour *= np.random.default_rng(0).uniform(0.85, 1.1, (n, 1)).astype(np.float32)
    mesh = Mesh(shape.vertices, np.asarray(shape.faces), colour, np.full(n, 0.9), np.zeros(n))
    surfels, binding, _ = attach(mesh)
    write_asset(path, Asset(surfels, mesh, binding))
    return path


def standing(mesh: Mesh, size: float, at: tuple[float, float, float], turn: float = 0.0) -> Array:
    """Matrix that makes a mesh so high and puts the middle of its foot there, turned about z by degrees."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    scale = size / float(high[2] - low[2])
    matrix = np.eye(4)
    matrix[:3, :3] = scale * trimesh.transformations.rotation_matrix(np.radians(turn), (0, 0, 1))[:3, :3]
    matrix[:3, 3] = at - matrix[:3, :3] @ [*(0.5 * (low + high)[:2]), low[2]]
    return matrix


def depth(job: CoupledJob, caches: list[ParticleCache], frame: int) -> float:
    """How deep the mesh of one body is in the other's at most, cells."""
    found = 0.0
    states = [cache.read(frame) for cache in caches]
    for i, j in ((0, 1), (1, 0)):
        back = np.linalg.inv(np.asarray(job.jobs[j].settings.matrix_world)) @ job.jobs[i].settings.matrix_world
        points = states[i].vertices.astype(np.float64) @ back[:3, :3].T + back[:3, 3]
        faces = SESSION.asset(SESSION.load_asset(job.bodies[j].asset)).mesh.faces.astype(np.int64)
        sign = igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
        inside = igl.signed_distance(points, states[j].vertices.astype(np.float64), faces, sign)[0].min()
        scale = abs(np.linalg.det(np.asarray(job.jobs[j].settings.matrix_world)[:3, :3])) ** (1 / 3)
        found = max(found, -float(inside) * scale / job.solver.domain.spacing)
    return found


def row(name: str, scene: dict[str, Any], frames: tuple[int, ...], camera: dict[str, Any], samples: int) -> list[Array]:
    """Bake bodies, and pictures of some frames."""
    parsed = parse_coupled({"last": max(frames), "floor": 0.0} | scene, name, out=FOLDER / name)
    keys = [SESSION.load_asset(body.asset) for body in parsed.bodies]
    job = prepare_coupled([SESSION.asset(key).mesh for key in keys], parsed)
    caches = [ParticleCache(body.out) for body in parsed.bodies]
    bake_coupled(job, caches, overwrite=True)
    depths = [depth(job, caches, frame) for frame in range(1, max(frames) + 1)]
    deepest = 1 + int(np.argmax(depths))
    print(f"{name}: surfaces at most {max(depths):.2f} cells inside of each other (frame {deepest})", flush=True)
    world = World(read_environment(environments() / "city.exr").radiance, strength=STRENGTH)
    how = RenderSettings(samples, bounces=BOUNCES, subpixel_samples=8, denoise="svgf")
    plane, pictures = ground(), []
    plane.vertices[:, 2] = 0.0
    for frame in frames:
        states = []
        for key, one, body, cache in zip(keys, job.jobs, job.bodies, caches, strict=True):
            particles, vertices = cache.driving(frame)
            given = {"vertices": np.ascontiguousarray(vertices, np.float32), "particles": particles}
            matrix = np.asarray(one.settings.matrix_world, np.float64)
            states.append(ObjectState(body.name, key, matrix_world=matrix, tear=one.tear, grain=one.grain, **given))
        made = SESSION.render(Frame(frame, pinhole(camera), states, world, how, ("Combined",), [plane]))
        pictures.append(made["Combined"])
    return pictures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--assets", type=Path, required=True, help="folder with cat.drgs and spot.drgs")
    parser.add_argument("--size", type=int, default=260)
    parser.add_argument("--samples", type=int, default=32)
    parser.add_argument("--resolution", type=int, default=48)
    add_publish(parser)
    options = parser.parse_args()
    FOLDER.mkdir(parents=True, exist_ok=True)
    cat, cow = (str((options.assets / f"{name}.drgs").resolve()) for name in ("cat", "spot"))
    heap = str(mound(FOLDER / "mound.drgs", 1.5, 0.4))
    meshes = {path: SESSION.asset(SESSION.load_asset(Path(path))).mesh for path in (cat, cow)}
    jelly = {"name": "jelly", "youngs_modulus": 1.5e5, "density": 700}

    def body(path: str, size: float, at: tuple[float, float, float], turn: float, **more: Any) -> dict[str, Any]:
        place = standing(meshes[path], size, at, turn).tolist()
        return {"asset": path, "material": jelly, "matrix_world": place} | more

    corners = np.array([[x, y, z] for x in (-0.75, 0.75) for y in (-0.5, 0.5) for z in (0, 1.1)], float)
    camera = frame_camera(corners, options.size, azimuth=-70, fill=0.8)
    stone = {"name": "jelly", "youngs_modulus": 6e5, "density": 2600}
    fall = [
        body(cat, 0.8, (0, 0, 0.45), 20) | {"material": stone} | {"velocity": [0, 0, -4.0]},
        {"asset": heap, "material": "sand"},
    ]
    fly = [
        body(cat, 0.9, (-0.62, 0, 0.02), 0, velocity=[2.5, 0, 1.2]),
        body(cow, 0.8, (0.62, 0, 0.02), 0, velocity=[-2.5, 0, 1.2]),
    ]
    rows = [
        row("sand", {"bodies": fall, "resolution": options.resolution}, FALLEN, camera, options.samples),
        row("impact", {"bodies": fly, "resolution": options.resolution}, FLOWN, camera, options.samples),
    ]
    save(picture_path(FIGURE, options), [np.concatenate([np.concatenate(pictures, axis=1) for pictures in rows])])


if __name__ == "__main__":
    main()
