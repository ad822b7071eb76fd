"""What other methods leave out, and what it costs under other lights and in other poses.

python bench/bench_baselines.py --scenes scenes [--objects spot] [--steps 3000 1000] [--samples 128]

Scenes are those of `drgs evaluate --make-scenes scenes`. All rows of an object share its photographs, surfels and mesh;
what is left out, is left out of learning and of rendering. Rows are kept; a row takes about two minutes at 128 pixels.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from bench_evaluate import mean, similarity, under_other_lights
from other_methods import Baked, Prefiltered, split_sum
from report import OUT, store_row, table, write_section

from drgs_blender.cli.evaluate import session_renderer
from drgs_blender.core.asset import Environment
from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.frame import Camera, RenderSettings, Visibility, World
from drgs_blender.deform.mesh_driven import MeshDriven
from drgs_blender.engine.session import Session
from drgs_blender.evaluate.compare import Posed, Renderer, compare
from drgs_blender.evaluate.truth import read_truth
from drgs_blender.reconstruct.inverse_rendering.settings import Settings as Decoupling
from drgs_blender.reconstruct.optim.schedule import Schedule
from drgs_blender.reconstruct.pipeline import Settings, reconstruct
from drgs_blender.reconstruct.readers import read_capture

Array = np.ndarray

FOLDER = OUT / "baselines"
COLUMNS = (
    "Object", "Method", "Views left out", "The day's light, deformed", "Relit", "Relit and deformed",
    "Relit: SSIM / FLIP", "Relit and deformed: SSIM / FLIP",
)  # fmt: skip


@dataclass(frozen=True)
class Method:
    """What one leaves out.

    Attributes
    ----------
    learning : what of the decoupling differs; None: materials and light are not pulled apart
    rendering : what of the render settings differs
    visibility : which rays meet the object
    picture : "lit"; "albedo", what is learned as such; or one of `other_methods`: "baked", "split sum"
    """

    learning: dict[str, Any] | None = field(default_factory=dict)
    rendering: dict[str, Any] = field(default_factory=lambda: {"bounces": 3})
    visibility: Visibility = field(default_factory=Visibility)
    picture: str = "lit"


#: By no ray but the camera's.
UNSEEN = Visibility(diffuse=False, glossy=False, shadow=False)
METHODS = {
    "DR-GS": Method(),
    "no metallic, the paper's lobe (as IRGS)": Method(
        {"parametrisation": "dielectric", "shading_model": "paper"}, {"bounces": 3, "shading_model": "paper"}
    ),
    "no shadows, no inter-reflection (as split-sum shading: Ref-Gaussian)": Method(
        {"shadows": False, "indirect": False}, {"bounces": 0}, UNSEEN
    ),
    "split sum of each surfel, then blended (forward, as GS-ROR2)": Method(
        {"shadows": False, "indirect": False}, {"bounces": 0}, UNSEEN, "split sum"
    ),
    "colours of the day, carried along (as PhysGaussian, GaussianMesh, SuGaR, Mani-GS)": Method(None, picture="albedo"),
    "colours of the day with harmonics, carried by particles (as GSP, PhysGaussian)": Method(None, picture="baked"),
}


def renderer(session: Session, key: str, method: Method, samples: int) -> Renderer:
    """Renders as `method` does."""
    lit = session_renderer(session, key, RenderSettings(samples, **method.rendering), method.visibility)
    asset = session.asset(key)
    baked = Baked(asset) if method.picture == "baked" else None
    lights: dict[bytes, Prefiltered] = {}

    def draw(camera: Camera, light: World, pose: Posed | None) -> dict[str, Array]:
        radiance = np.asarray(light.environment)
        passes, vertices = lit(camera, light, pose), None if pose is None else pose.vertices
        if method.picture == "albedo":
            passes["Combined"] = np.concatenate([passes["Albedo"] * passes["Coverage"], passes["Coverage"]], axis=2)
        elif baked is not None:
            passes["Combined"] = baked(camera, vertices)
        elif method.picture == "split sum":
            if (key_of_light := radiance.tobytes()) not in lights:
                lights[key_of_light] = Prefiltered(radiance)
            assert asset.binding is not None
            rest = asset.mesh.vertices if vertices is None else vertices
            posed = MeshDriven(asset.mesh, asset.surfels, asset.binding).pose(rest)
            passes["Combined"] = split_sum(posed, lights[key_of_light], camera)
        return passes

    return draw


def row(folder: Path, name: str, options: argparse.Namespace) -> list[str]:
    """Cells of a method."""
    method = METHODS[name]
    learning, decoupling = options.steps
    settings = Settings(schedule=Schedule(iterations=learning), materials=method.learning is not None)
    changes = {"iterations": decoupling, **(method.learning or {})}
    settings = replace(settings, decoupling=Decoupling(normals=True, **changes))
    capture = read_capture(folder)
    asset = reconstruct(capture, settings, folder=FOLDER / folder.name)
    if asset.environment is None:
        asset.environment = Environment(np.ones((8, 16, 3), np.float32))
    path = FOLDER / f"{folder.name}.drgs"
    write_asset(path, asset)
    session = Session()
    draw = renderer(session, session.load_asset(path), method, options.samples)
    report = compare(asset, capture, read_truth(folder), draw)
    (day,) = (entry for entry in report["lights"] if entry["posed"] and entry["training_light"])
    lit = [under_other_lights(report, posed) for posed in (False, True)]
    relit = [mean(rows, "scaled", "foreground") for rows in lit]
    figures = (report["novel"]["psnr_foreground"], day["scaled"]["foreground"], *relit)
    return [*(f"{x:.2f}" for x in figures), *map(similarity, lit)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, required=True)
    parser.add_argument("--objects", nargs="+", default=["spot"])
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--steps", type=int, nargs=2, default=(3000, 1000), help="of surfels, of materials and light")
    parser.add_argument("--samples", type=int, default=128)
    options = parser.parse_args()
    for name in options.objects:
        for method in options.methods:
            found = row(options.scenes / name, method, options)
            rows = store_row(FOLDER / "rows.json", f"{name}|{method}", found)
            print(name, method, *found, flush=True)
    about = "{} and {} steps".format(*options.steps)
    body = (
        f"{about}; the same photographs by Cycles, surfels and mesh for every row. What is left out is left out "
        "of learning and of rendering; the integrals are ours, so the rows show what the idea costs and not what the "
        "original programs reach. PSNR of the foreground in dB; all but the views left out scaled by one factor a "
        "channel; SSIM and FLIP of scaled frames on white; relit: means over the lights that were not photographed. "
        "Colours of the day that are carried along are their mean over all views. GSP simulates by XPBD; here its "
        "particles follow the true motion, so that the row is about driving and light alone (`other_methods.py`).\n\n"
    )
    cells = [(*key.split("|"), *cells) for key, cells in rows.items()]
    write_section("baselines", "What other methods leave out", body + table(COLUMNS, cells))


if __name__ == "__main__":
    main()
