"""Pictures of simulated captures: Young's modulus times four from one to the next, and a plant without a mesh in wind.

python bench/bench_matter_pictures.py --asset out/bench/assets/cat.drgs [--size 240]

The capture falls on a floor as jelly, each time four times as stiff, at the same moment. The plant of bench_thin.py is
surfels alone: the matter is what its proxy mesh encloses, pinned at the foot, and its particles carry the surfels.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from bench_thin import BOUNCES, STRENGTH, bent, ground, plant, save, surfels_of
from judge import environments, frame_camera
from ours import SESSION, pinhole
from report import OUT, add_publish, picture_path

from drgs_blender.core.asset import Asset, Mesh
from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.frame import Frame, ObjectState, RenderSettings, World
from drgs_blender.core.particle_cache import ParticleCache
from drgs_blender.formats.registry import read_environment
from drgs_blender.simulation.bake import bake
from drgs_blender.simulation.job import prepare
from drgs_blender.simulation.settings import parse_settings

Array = np.ndarray

FIGURE = "matter.png"
FOLDER = OUT / "matter"
#: Pascals; the frame that is shown of each.
MODULI, FALLEN = (2e4, 8e4, 3.2e5), 13
#: Frames of the plant in the wind.
BLOWN = (8, 16, 32)


def simulated(name: str, mesh: Mesh, settings: dict[str, Any], last: int) -> ParticleCache:
    """A bake of a mesh."""
    cache = ParticleCache(FOLDER / name)
    given = {"resolution": 48, "floor": float(mesh.vertices[:, 2].min()) - 0.4, "last": last} | settings
    bake(prepare(mesh, parse_settings(given), name), cache, overwrite=True)
    return cache


def picture(state: ObjectState, floor: float, camera: dict[str, Any], samples: int, **settings: Any) -> Array:
    """(h, w, 4) linear: an object over the ground."""
    plane = ground()
    plane.vertices[:, 2] = floor
    world = World(read_environment(environments() / "city.exr").radiance, strength=STRENGTH)
    how = RenderSettings(samples, bounces=BOUNCES, subpixel_samples=8, denoise="svgf", **settings)
    found: Array = SESSION.render(Frame(1, pinhole(camera), [state], world, how, ("Combined",), [plane]))["Combined"]
    return found


def fallen(path: Path, size: int, samples: int) -> list[Array]:
    """The capture at rest, and fallen, softer and stiffer."""
    key = SESSION.load_asset(path)
    mesh = SESSION.asset(key).mesh
    floor = float(mesh.vertices[:, 2].min()) - 0.4
    below = np.concatenate([mesh.vertices, mesh.vertices - [0, 0, 0.4]])
    camera = frame_camera(below, size, azimuth=-60, fill=1.2)
    state = ObjectState("capture", key)
    pictures = [picture(state, floor, camera, samples)]
    for modulus in MODULI:
        material = {"name": "jelly", "youngs_modulus": modulus, "density": 1000.0}
        cache = simulated(f"{path.stem}-{modulus:g}", mesh, {"material": material}, FALLEN)
        particles, vertices = cache.driving(FALLEN)
        moved = replace(state, vertices=np.ascontiguousarray(vertices, np.float32), particles=particles)
        pictures.append(picture(moved, floor, camera, samples))
    return pictures


def blown(size: int, samples: int) -> list[Array]:
    """The plant at rest and in the wind."""
    mesh, path = plant(), FOLDER / "plant.drgs"
    write_asset(path, Asset(surfels_of("plant", mesh), Mesh.empty()))
    proxy = bent(path, mesh)[1]
    count = len(proxy.rest)
    foot = np.flatnonzero(proxy.rest[:, 2] < proxy.rest[:, 2].min() + 0.15).astype(np.int32)
    plain = np.ones(count, np.float32)
    body = Mesh(proxy.rest, proxy.faces, np.ones((count, 3), np.float32), plain, 0 * plain, {"foot": foot})
    material = {"name": "jelly", "youngs_modulus": 6e4, "density": 200.0}
    settings = {"material": material, "pins": [{"group": "foot"}], "wind": [9.0, 0.0, 0.0], "drag": 1.5}
    cache = simulated("plant", body, settings, max(BLOWN))
    floor = float(mesh.vertices[:, 2].min())
    camera = frame_camera(mesh.vertices, size, azimuth=-60, fill=1.1)
    state, met = ObjectState("plant", SESSION.load_asset(path)), {"rays_see": "surfels"}
    pictures = [picture(state, floor, camera, samples, **met)]
    for frame in BLOWN:
        particles = replace(cache.driving(frame)[0], all=True)
        pictures.append(picture(replace(state, particles=particles), floor, camera, samples, **met))
    return pictures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--asset", type=Path, required=True)
    parser.add_argument("--size", type=int, default=240)
    parser.add_argument("--samples", type=int, default=32)
    add_publish(parser)
    options = parser.parse_args()
    FOLDER.mkdir(parents=True, exist_ok=True)
    rows = fallen(options.asset, options.size, options.samples), blown(options.size, options.samples)
    save(picture_path(FIGURE, options), [np.concatenate([np.concatenate(row, axis=1) for row in rows])])


if __name__ == "__main__":
    main()
