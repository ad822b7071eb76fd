"""Simulated and relit, against Cycles: captures that the particles of the true object carry, at rest and in motion.

python bench/bench_simulated_relit.py --scenes scenes [--objects cat helmet robot] [--frames 8 16]

The true mesh of each object is simulated as jelly that stands on a floor in a side wind; Cycles renders it as it then
is, under lights that were not photographed. Its particles carry the asset that bench_asset.py has learned from
photographs: the mesh by `gmls`, the surfels as each way has it. Beside them what other methods do, with the captured
colours that particles carry along: the same particles (as PhysGaussian), and those of a simulation by positions (XPBD,
as GSP). Scenes are those of `drgs evaluate --make-scenes scenes`.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from bench_asset import FOLDER, relit_truth
from bench_evaluate import mean, similarity
from other_methods import Baked
from report import OUT, ROOT, table, write_section

from drgs_blender.cli.evaluate import session_renderer
from drgs_blender.cli.find_blender import find_blender
from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.model import Mesh
from drgs_blender.core.frame import Camera, Particles, RenderSettings, World
from drgs_blender.core.particle_cache import ParticleCache
from drgs_blender.deform.fracture import torn_faces
from drgs_blender.deform.gmls import bind_points, carry
from drgs_blender.engine.session import Session
from drgs_blender.evaluate.compare import Posed, compare
from drgs_blender.evaluate.scenes import Plan, make_scenes
from drgs_blender.evaluate.truth import Truth, true_asset
from drgs_blender.geometry.occupancy import spacings, volume_of
from drgs_blender.reconstruct.readers import read_capture
from drgs_blender.simulation.bake import bake
from drgs_blender.simulation.job import prepare
from drgs_blender.simulation.settings import parse_settings

Array = np.ndarray

WAYS = ("surface", "automatic", "particles")
#: Views of each light that Cycles renders.
VIEWS = 4


def simulated(name: str, mesh: Mesh, last: int, solver: str = "mpm") -> ParticleCache:
    """The true object as jelly, in a cache of its own."""
    settings = {
        "material": {"name": "jelly", "youngs_modulus": 2e4, "density": 500.0},
        "floor": float(mesh.vertices[:, 2].min()), "wind": [6.0, 0.0, 0.0], "drag": 1.0, "resolution": 64, "last": last,
        "solver": solver,
    }  # fmt: skip
    cache = ParticleCache(OUT / "simulated" / (name if solver == "mpm" else f"{name}-{solver}"))
    bake(prepare(mesh, parse_settings(settings), name), cache, overwrite=True)
    return cache


def rendered(name: str, frame: int, mesh: Mesh, vertices: Array, scenes: Path, views: int = VIEWS) -> Truth:
    """Cycles' pictures of a frame, as sets of a truth."""
    plan = Plan(**json.loads((scenes / "plan.json").read_text()))
    plan = replace(plan, objects=(name,), train=2, test=views)
    out = OUT / "simulated" / (f"{name}-{frame}" if views == VIEWS else f"{name}-{frame}-{views}")
    (out / name).mkdir(parents=True, exist_ok=True)
    arrays = {channel: getattr(mesh, channel) for channel in ("faces", "albedo", "roughness", "metallic")}
    np.savez(out / name / "mesh.npz", vertices=vertices, **arrays)
    command = find_blender().command(ROOT / "drgs_blender" / "evaluate" / "scene_job.py")
    make_scenes(out, plan, command, ROOT / "examples")
    return relit_truth(out / name)


def scored(
    session: Session, key: str, truth: Truth, folder: Path, samples: int, pose: Posed | None, way: str = "surface",
    tear: float = 0.0,
) -> list[dict]:  # fmt: skip
    """Rows of the asset under the truth's lights, in a pose or at rest; faces that grew by `tear` are left out."""
    draw = session_renderer(session, key, RenderSettings(samples=samples, bounces=3), driven_by=way, tear=tear)
    capture = read_capture(folder)
    alone = replace(capture, views=capture.training)
    report = compare(session.asset(key), alone, truth, lambda camera, light, _: draw(camera, light, pose))
    rows: list[dict] = report["lights"]
    return rows


def in_colours_of_the_day(
    session: Session, key: str, truth: Truth, folder: Path, particles: Particles, baked: Baked
) -> list[dict]:
    """Rows of the captured colours, carried by particles, under the truth's lights."""
    draw = session_renderer(session, key, RenderSettings(samples=1, bounces=0), driven_by="particles")
    capture, asset = read_capture(folder), session.asset(key)
    pose = Posed(asset.mesh.vertices, particles)

    def picture(camera: Camera, light: World, _: Posed | None) -> dict[str, Array]:
        return draw(camera, light, pose) | {"Combined": baked(camera, None, particles)}

    rows: list[dict] = compare(asset, replace(capture, views=capture.training), truth, picture)["lights"]
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, required=True)
    parser.add_argument("--objects", nargs="+", default=["cat", "helmet", "robot"])
    parser.add_argument("--frames", type=int, nargs="+", default=[8, 16])
    parser.add_argument("--samples", type=int, default=64)
    options = parser.parse_args()
    rows: list[list[object]] = []
    for name in options.objects:
        folder = options.scenes / name
        true, session = true_asset(folder), Session()
        key = session.load_asset(FOLDER / f"{name}.drgs")
        own = session.asset(key).mesh
        cache = simulated(name, true.mesh, max(options.frames))
        quick, baked = simulated(name, true.mesh, max(options.frames), "xpbd"), Baked(session.asset(key))
        rest, tear = cache.rest().points, getattr(cache.header(), "tear", 0.0)
        weights = bind_points(own.vertices, rest, space=volume_of(rest, *spacings(rest)))
        found = scored(session, key, relit_truth(folder, views=VIEWS), folder, options.samples, None)
        rows.append([name, "at rest", "-", f"{mean(found, 'scaled', 'foreground'):.2f}", similarity(found)])
        print(*rows[-1], flush=True)
        path = OUT / "simulated" / f"{name}.drgs"
        write_asset(path, true)
        true_key = session.load_asset(path)
        for frame in options.frames:
            particles, vertices = cache.driving(frame)
            truth = rendered(name, frame, true.mesh, vertices, options.scenes)
            pose = Posed(carry(weights, particles.points, particles.gradients)[0].astype(np.float32), particles)
            moved = 100 * float(np.linalg.norm(vertices - true.mesh.vertices, axis=1).mean())
            torn = 100 * float(torn_faces(true.mesh.vertices, vertices, true.mesh.faces, tear).mean())
            label = f"frame {frame}, moved by {moved:.0f} cm in the mean, {torn:.1f} % of the true faces torn"
            for way in WAYS:
                found = scored(session, key, truth, folder, options.samples, pose, way, tear)
                figures = f"{mean(found, 'scaled', 'foreground'):.2f}", similarity(found)
                rows.append([name, label, way, *figures])
                print(*rows[-1], flush=True)
            given = Posed(vertices, particles)
            found = scored(session, true_key, truth, folder, options.samples, given, "automatic", tear)
            figures = f"{mean(found, 'scaled', 'foreground'):.2f}", similarity(found)
            rows.append([name, f"frame {frame}", "the true object, as ours: what could be reached", *figures])
            print(*rows[-1], flush=True)
            for title, carriers in (("PhysGaussian", particles), ("GSP", quick.driving(frame)[0])):
                found = in_colours_of_the_day(session, key, truth, folder, carriers, baked)
                figures = f"{mean(found, 'scaled', 'foreground'):.2f}", similarity(found)
                rows.append([name, f"frame {frame}", f"colours of the day, by particles (as {title})", *figures])
                print(*rows[-1], flush=True)
    body = (
        "Jelly (E = 2e4 Pa) on a floor in a side wind, the true object's particles carrying what was learned from "
        f"photographs; {VIEWS} views under each of the lights that were not photographed, PSNR of the foreground in "
        "dB, scaled by one factor a channel; SSIM and FLIP of the scaled frames on white. Objects are some "
        "1.6 m large. Streaks beside the object count in SSIM and FLIP alone. Colours of the day: those that the "
        "surfels were captured in, with harmonics, in no new light; by the same particles, or by those of the solver "
        "by positions (`other_methods.py`). Faces that the matter has torn are left out of ours, where Cycles renders "
        "them stretched across the gap: where more than a few are, the pictures show two things.\n\n"
    )
    columns = ("Object", "Pose", "Surfels carried by", "Relit, foreground", "SSIM / FLIP")
    write_section("simulated-relit", "Simulated and relit", body + table(columns, rows))


if __name__ == "__main__":
    main()
