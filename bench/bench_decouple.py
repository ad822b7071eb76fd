"""Stage (ii): materials and light from photographs by Cycles and a mesh, and what each part of it is worth.

python bench/bench_decouple.py [--part NAME ...] [--scene FOLDER] [--iterations 1000]

Parts: `truth` (the photographs, if need be, and the ceiling), `long`, `estimator`, `light`, `materials`, `priors`,
`mesh` and `mitsuba`. Each runs on its own in a few minutes of two cores and adds its rows to those measured before.
"""

from __future__ import annotations

import argparse
import os
import subprocess
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from decouple_score import COLUMNS, Scene, score, with_materials_of
from report import OUT, ROOT, processor_seconds, store_row, table, write_section

from drgs_blender.core.asset import Mesh
from drgs_blender.core.color import srgb_to_linear
from drgs_blender.reconstruct.inverse_rendering.decoupled import Decoupled
from drgs_blender.reconstruct.inverse_rendering.run import decouple
from drgs_blender.reconstruct.inverse_rendering.settings import Settings

FOLDER = OUT / "decouple"
SIZE, TRAIN, TEST, SAMPLES = 128, 40, 8, 32

#: The paper's BRDF and losses: L1 of noisy estimates, white light, neither grids nor smoothness of materials.
PAPER: dict[str, Any] = {
    "shading_model": "paper", "unbiased": False, "grey_light_prior": 0.003, "coarse": 0, "smoothness": 0.0,
    "coarse_to_fine": False, "metal_albedo_prior": 0.0, "metal_smoothness": 0.0, "same_material": 0.0,
}  # fmt: skip

#: Part -> row -> what differs from the settings that the rows share.
VARIANTS: dict[str, dict[str, dict[str, Any]]] = {
    "estimator": {
        "as it is": {},
        "loss that noise pulls (log, L1)": {"unbiased": False},
        "weighed by the photographs": {"weight_by_prediction": False},
        "pixels beside clipped ones count whole": {"clipped_neighbour_weight": 1.0},
        "cosine samples alone (no MIS)": {"cosine": 32, "ggx": 0, "light": 0},
        "four times the rays on a quarter of the pixels": {"pixels": 512, "cosine": 64, "ggx": 32, "light": 32},
    },
    "light": {
        "without inter-reflection": {"indirect": False},
        "environment fine from the start": {"coarse_to_fine": False},
        "environment of 32 rows": {"environment": 32},
        "light learned a quarter as fast": {"light_rate": 0.1},
        "white-light weight .003": {"grey_light_prior": 0.003},
        "white-light weight 0": {"grey_light_prior": 0.0},
    },
    "materials": {
        "without nested grids": {"coarse": 0},
        "learned half as fast": {"rate": 0.02},
        "without smoothness": {"smoothness": 0.0},
        "specular-glossiness": {"parametrisation": "specular"},
        "the paper's BRDF": {"shading_model": "paper"},
    },
    "priors": {
        "metallic pulled to 0 or 1": {"binary_metallic_prior": 0.01},
        "metals of any brightness": {"metal_albedo_prior": 0.0},
        "metals smoothed like paint": {"metal_smoothness": 0.0},
        "learned exposure of each photograph": {"exposure": True},
        "learned normals": {"normals": True},
    },
}

#: What makes up for errors of the mesh: row -> what differs.
ON_OWN_MESH: dict[str, dict[str, Any]] = {
    "": {},
    ", weighed by the photographs": {"weight_by_prediction": False},
    ", pixels beside clipped ones count whole": {"clipped_neighbour_weight": 1.0},
    ", metals smoothed like paint": {"metal_smoothness": 0.0},
}


def scene_folder(given: Path | None) -> Path:
    """The scene, rendered by Cycles if need be (about three minutes)."""
    if given is not None:
        return given
    from drgs_blender.cli.find_blender import find_blender
    from drgs_blender.evaluate.scenes import Plan, make_scenes

    plan = Plan(("spot",), SIZE, TRAIN, TEST, SAMPLES)
    command = find_blender().command(ROOT / "drgs_blender" / "evaluate" / "scene_job.py")
    return make_scenes(FOLDER / f"scenes-{SIZE}", plan, command, ROOT / "examples")[0]


def measured(scene: Scene, mesh: Mesh, settings: Settings) -> list[float]:
    """One row: processor seconds and scores."""
    before = processor_seconds()
    found = decouple(scene.capture, mesh, settings)
    return [processor_seconds() - before, *score(scene, finished(mesh, found))]


def finished(mesh: Mesh, found: Decoupled) -> Mesh:
    """`mesh` with the materials that were found."""
    return Mesh(mesh.vertices, mesh.faces, found.albedo, found.roughness, found.metallic)


def warm(scene: Scene) -> None:
    """Compile before anything is timed."""
    decouple(scene.capture, scene.mesh, Settings(iterations=2, pixels=64, normals=True))


def variants(part: str, scene: Scene, iterations: int) -> dict[str, list[float]]:
    """Rows of `VARIANTS`."""
    base = Settings(iterations=iterations)
    return {name: measured(scene, scene.mesh, replace(base, **change)) for name, change in VARIANTS[part].items()}


def ceiling(scene: Scene) -> dict[str, list[float]]:
    """True materials, rendered by our own renderer."""
    return {"true materials and mesh (the ceiling)": [0.0, *score(scene, scene.mesh)]}


def long_run(scene: Scene, iterations: int) -> dict[str, list[float]]:
    """The settings as they are by default."""
    settings = Settings()
    return {f"default, {settings.iterations} steps": measured(scene, scene.mesh, settings)}


def own_meshes(scene: Scene) -> tuple[Mesh, Mesh]:
    """The mesh of stage (i) as it is fused, and with the outlines of the masks."""
    from drgs_blender.reconstruct.meshing.depth_fusion import fuse
    from drgs_blender.reconstruct.meshing.silhouette_fit import fill_silhouettes
    from drgs_blender.reconstruct.meshing.visual_hull import find_region, silhouettes
    from drgs_blender.reconstruct.optim.schedule import Schedule
    from drgs_blender.reconstruct.optim.train import Training

    path = FOLDER / "own-meshes.npz"
    if not path.exists():
        region, cameras = find_region(scene.capture), [view.camera for view in scene.capture.training]
        training = Training(scene.capture, region, Schedule(iterations=1500))
        while not training.finished:
            training.step()
        mesh, _ = fuse(training.gaussians, cameras, region)
        filled = fill_silhouettes(mesh, cameras, silhouettes(scene.capture) or [])
        np.savez(path, faces=mesh.faces, fused=mesh.vertices, filled=filled)
    with np.load(path) as arrays:
        vertices, f = (arrays["fused"], arrays["filled"]), arrays["faces"]
    fused, filled = (Mesh(v, f, np.zeros_like(v), np.zeros(len(v)), np.zeros(len(v))) for v in vertices)
    return fused, filled


def own_mesh(scene: Scene, iterations: int) -> dict[str, list[float]]:
    """On the mesh of stage (i): what its outlines and learned normals are worth, and the paper's way on it."""
    from drgs_blender.reconstruct.meshing.normal_integration import follow_normals

    fused, mesh = own_meshes(scene)
    base = Settings(iterations=iterations)
    rows = {}
    for name, one in {"mesh of stage (i) as fused": fused, "mesh of stage (i)": mesh}.items():
        rows[f"{name}, true materials"] = [0.0, *score(scene, with_materials_of(scene.mesh, one, one.vertices))]
        rows[name] = measured(scene, one, base)
    for name, change in ON_OWN_MESH.items():
        before = processor_seconds()
        found = decouple(scene.capture, mesh, replace(base, normals=True, **change))
        spent = processor_seconds() - before
        bent = replace(finished(mesh, found), vertices=follow_normals(mesh, found.normals))
        rows[f"mesh of stage (i), shaped by learned normals{name}"] = [spent, *score(scene, bent)]
    rows["mesh of stage (i) as fused, the paper's way"] = measured(scene, fused, replace(base, **PAPER))
    return rows


def mitsuba(scene: Scene, iterations: int) -> dict[str, list[float]]:
    """Mitsuba's differentiable renderer on the same photographs and mesh, for as long as ours takes by default."""
    from light_renderers import mitsuba_python

    views = scene.capture.training
    source, out = FOLDER / "mitsuba-capture.npz", FOLDER / "mitsuba-found.npz"
    np.savez(
        source,
        vertices=scene.mesh.vertices,
        faces=scene.mesh.faces,
        matrices=np.stack([view.camera.matrix_world for view in views]),
        fov_x=[2 * np.degrees(np.arctan(view.camera.width / 2 / view.camera.fx)) for view in views],
        pictures=srgb_to_linear(np.stack([view.colour for view in views])),
        masks=np.stack([view.mask for view in views]),
    )
    before = processor_seconds()
    ours = decouple(scene.capture, scene.mesh, Settings(iterations=iterations))
    spent, seconds = processor_seconds() - before, float(ours.report["seconds"])
    rows = {f"ours, {iterations} steps": [spent, *score(scene, finished(scene.mesh, ours))]}
    program = Path(__file__).with_name("mitsuba_inverse.py")
    libraries = sorted((ROOT / "build" / "llvm").rglob("libLLVM.so*"))
    environment = ({"DRJIT_LIBLLVM_PATH": str(libraries[-1])} if libraries else {}) | os.environ
    command = [str(mitsuba_python()), str(program), str(source), str(out), str(seconds)]
    subprocess.run(command, check=True, timeout=seconds + 600, env=environment)
    with np.load(out) as file:
        found = {name: file[name] for name in file.files}
    mesh = Mesh(scene.mesh.vertices, scene.mesh.faces, found["albedo"], found["roughness"], found["metallic"])
    rows[f"Mitsuba 3, prb, {found['steps']} steps in the same time"] = [float(found["spent"]), *score(scene, mesh)]
    return rows


PARTS: dict[str, Callable[[Scene, int], dict[str, list[float]]]] = {
    "truth": lambda scene, iterations: ceiling(scene),
    "long": long_run,
    **{part: lambda scene, iterations, part=part: variants(part, scene, iterations) for part in VARIANTS},  # type: ignore[misc]
    "mesh": own_mesh,
    "mitsuba": mitsuba,
}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--part", nargs="+", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--scene", type=Path, help="a folder with truth.json; default: made by Cycles")
    parser.add_argument("--iterations", type=int, default=1000, help="of all rows but the long one")
    options = parser.parse_args()
    FOLDER.mkdir(parents=True, exist_ok=True)
    scene = Scene.read(scene_folder(options.scene))
    warm(scene)
    for part in options.part:
        kept = store_row(FOLDER / "rows.json", part, PARTS[part](scene, options.iterations))
        print(table(("", *COLUMNS), [(name, *row) for name, row in kept[part].items()]), flush=True)
    rows = [(name, *row) for part in PARTS for name, row in kept.get(part, {}).items()]
    write_section("decouple", "Materials and light from photographs", text(scene, rows, options.iterations))


def text(scene: Scene, rows: list[tuple[Any, ...]], iterations: int) -> str:
    """The section."""
    height, width = scene.capture.training[0].colour.shape[:2]
    settings = asdict(Settings())
    rays = settings["cosine"] + settings["ggx"] + settings["light"]
    return (
        f"Spot with materials from matte paint to polished gold, {len(scene.capture.training)} photographs of "
        f"{width} x {height} pixels by Cycles; {iterations} steps of {settings['pixels']} pixels and {rays} rays on "
        f"the true mesh unless said, each row one change. Relit: foreground PSNR in dB against Cycles under "
        f"{len(scene.relit)} other lights, raw and with one factor a channel. Albedo: dB of linear values, one factor "
        f"a channel. Processor seconds of two cores together.\n\n{table(('', *COLUMNS), rows)}"
    )


if __name__ == "__main__":
    main()
