"""How much captures flicker while they are simulated, against Cycles, and what other methods do.

python bench/bench_simulated_flicker.py --scenes scenes [--objects cat robot] [--frames 8 13]

The simulations of bench_simulated_relit.py, frame after frame, under one light that was not photographed, in one view.
Points of the surface are followed by the motion of the true mesh, so that only what changes on them counts.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from bench_asset import FOLDER
from bench_simulated_relit import rendered, simulated
from flicker import flicker, to_frame_before
from judge import foreground
from other_methods import Baked
from report import OUT, table, write_section

from drgs_blender.cli.evaluate import session_renderer
from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.model import Mesh
from drgs_blender.core.color import srgb_to_linear
from drgs_blender.core.frame import Camera, Frame, MotionStep, ObjectState, Pose, RenderSettings, World
from drgs_blender.deform.gmls import bind_points, carry
from drgs_blender.engine.session import Session
from drgs_blender.evaluate.compare import Posed
from drgs_blender.evaluate.metrics import on_white, relight_scores, straight
from drgs_blender.evaluate.truth import true_asset
from drgs_blender.geometry.occupancy import spacings, volume_of

Array = np.ndarray


def motion(session: Session, key: str, camera: Camera, before: Array, now: Array) -> tuple[Array, Array]:
    """Where points of the true mesh were one frame earlier, in pixels, and what it covers."""
    state = ObjectState("truth", key, vertices=now)
    frame = Frame(
        1, camera, [state], settings=RenderSettings(1, camera_sees="mesh", film_transparent=True),
        passes=("Vector", "Coverage"), previous=MotionStep(camera, [Pose("truth", np.eye(4)[None], before)]),
    )  # fmt: skip
    pictures = session.render(frame)
    return to_frame_before(pictures), pictures["Coverage"][..., 0]


def measured(name: str, scenes: Path, first: int, last: int, samples: int) -> list[list[object]]:
    """Rows of an object."""
    true, session = true_asset(scenes / name), Session()
    key = session.load_asset(FOLDER / f"{name}.drgs")
    own: Mesh = session.asset(key).mesh
    path = OUT / "simulated" / f"{name}.drgs"
    write_asset(path, true)
    true_key = session.load_asset(path)
    caches = {"PhysGaussian": simulated(name, true.mesh, last), "GSP": simulated(name, true.mesh, last, "xpbd")}
    rest, tear = caches["PhysGaussian"].rest().points, getattr(caches["PhysGaussian"].header(), "tear", 0.0)
    weights = bind_points(own.vertices, rest, space=volume_of(rest, *spacings(rest)))
    baked = Baked(session.asset(key))
    looks = {
        "": RenderSettings(samples=samples, bounces=3),
        ", OIDN": RenderSettings(samples=samples, bounces=3, denoise="oidn"),
    }
    drawn: dict[str, list[dict[str, Array]]] = {}
    truths, vectors, covered = [], [], []
    before = caches["PhysGaussian"].driving(first - 1)[1]
    for number in range(first, last + 1):
        particles, vertices = caches["PhysGaussian"].driving(number)
        lit = rendered(name, number, true.mesh, vertices, scenes, views=2).sets[0]
        view, light = lit.views[0], World(lit.radiance)
        pose = Posed(carry(weights, particles.points, particles.gradients)[0].astype(np.float32), particles)
        for title, settings in looks.items():
            draw = session_renderer(session, key, settings, tear=tear)
            drawn.setdefault(f"relit{title}", []).append(draw(view.camera, light, pose))
        for title, cache in caches.items():
            given = cache.driving(number)[0]
            picture = {"Combined": baked(view.camera, None, given)}
            drawn.setdefault(f"colours of the day, by particles (as {title})", []).append(picture)
        vector, coverage = motion(session, true_key, view.camera, before, vertices)
        truths.append(view)
        vectors.append(vector)
        covered.append(coverage)
        before = vertices
    mask = np.stack([foreground(coverage, 1) for coverage in covered])
    white = np.stack([view.colour for view in truths])
    rows = [[name, "Cycles", f"{1e3 * flicker(srgb_to_linear(white), mask, np.stack(vectors)):.1f}", "-"]]
    for title, pictures in drawn.items():
        linear, alpha = (np.stack(parts) for parts in zip(*map(straight, pictures)))
        scores = relight_scores(linear, alpha, white, np.stack([view.mask for view in truths]))
        shown = srgb_to_linear(on_white(linear * np.array(scores["scale"]), alpha))
        figure = f"{1e3 * flicker(shown, mask, np.stack(vectors)):.1f}"
        rows.append([name, title, figure, f"{scores['scaled']['foreground']:.2f}"])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, required=True)
    parser.add_argument("--objects", nargs="+", default=["cat", "robot"])
    parser.add_argument("--frames", type=int, nargs=2, default=[8, 13], metavar=("FIRST", "LAST"))
    parser.add_argument("--samples", type=int, default=64)
    options = parser.parse_args()
    rows: list[list[object]] = []
    for name in options.objects:
        found = measured(name, options.scenes, *options.frames, options.samples)
        print(*found, sep="\n", flush=True)
        rows += found
    first, last = options.frames
    body = (
        f"Frames {first} to {last} of the jelly of *Simulated and relit*, one view under a light that was not "
        f"photographed, {options.samples} rays. Flicker: mean absolute second difference in time of sRGB luminance on "
        "points of the surface, followed by the true mesh's motion, in thousandths; light that glides over what bends "
        "has some in truth, too. PSNR of the foreground in dB, scaled by one factor a channel for all frames.\n\n"
    )
    columns = ("Object", "Pictures", "Flicker", "Relit, foreground")
    write_section("simulated-flicker", "Flicker of simulated captures", body + table(columns, rows))


if __name__ == "__main__":
    main()
