"""Surfels carried by particles, by the faces of their mesh, or each by what suits it: against exact motion, and Cycles.

python bench/bench_particle_driven.py --scenes scenes [--objects cat helmet robot spot fern]

Scenes are those of `drgs evaluate --make-scenes scenes`, assets those that bench_asset.py has learned from them.

Exact: the object is bent by a right angle and twisted, by a formula that is known everywhere; particles and vertices
follow it exactly, and where surfels then are says how well they were carried. Pictures: the pose of the scenes, in
which points of the true surface carry mesh and surfels, under lights that were not photographed, against Cycles.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from bench_asset import FOLDER, relit_truth
from bench_evaluate import mean, of_truth, similarity
from decouple_score import with_materials_of
from report import add_publish, picture_path, table, write_section

from drgs_blender.build.proxy import mesh_from_surfels
from drgs_blender.cli.evaluate import session_renderer
from drgs_blender.core.asset.container import read_asset, write_asset
from drgs_blender.core.asset.model import Asset
from drgs_blender.core.frame import RenderSettings
from drgs_blender.deform.binding import bind
from drgs_blender.deform.mesh_driven import MeshDriven
from drgs_blender.deform.particle_driven import Frames, ParticleDriven, on_the_mesh
from drgs_blender.engine.session import Session
from drgs_blender.evaluate.compare import compare
from drgs_blender.formats.images import write_png
from drgs_blender.reconstruct.readers import read_capture
from drgs_blender.simulation.fill import fill

Array = np.ndarray
Motion = Callable[[Array], Array]

LEARNED = "from photographs"
WAYS = ("surface", "automatic", "particles")
#: Voxels along the longest side of the meshes that are made of surfels: as an import makes them, and coarse ones.
FINE, COARSE = 192, 32
#: Particles along the longest side; views under each light.
ALONG, VIEWS = 192, 4
#: What the figure shows of what was learned from photographs.
LIGHT, VIEW = "city", 1
FIGURE = "driven-by.png"


def bend(vertices: Array) -> tuple[Motion, Motion]:
    """A right angle along x with a twist of 1.2 rad, and its gradient by differences."""
    low, high = vertices.min(axis=0).astype(np.float64), vertices.max(axis=0).astype(np.float64)
    middle, size = 0.5 * (low + high), float((high - low).max())
    curvature, twist, step = np.pi / 2 / size, 1.2 / size, 1e-5 * size

    def motion(points: Array) -> Array:
        x, y, z = (np.asarray(points, np.float64) - middle).T
        cos, sin = np.cos(twist * x), np.sin(twist * x)
        y, z = cos * y - sin * z, sin * y + cos * z
        radius, angle = 1 / curvature - z, curvature * x
        return np.stack([np.sin(angle) * radius, y, 1 / curvature - np.cos(angle) * radius], -1) + middle

    def gradient(points: Array) -> Array:
        steps = step * np.eye(3)
        return np.stack([(motion(points + d) - motion(points - d)) / (2 * step) for d in steps], -1)

    return motion, gradient


def on_own_mesh(asset: Asset, voxels: int) -> Asset:
    """The same surfels on a mesh that is made of them, as where a capture has none."""
    mesh, _ = mesh_from_surfels(asset.surfels, resolution=voxels)
    binding, _ = bind(mesh, asset.surfels)
    return Asset(asset.surfels, with_materials_of(asset.mesh, mesh, mesh.vertices), binding)


def errors(asset: Asset) -> list[list[object]]:
    """Of each way: how far surfels are from where exact motion takes them, and how wrong their tangents are."""
    mesh, (motion, gradient) = asset.mesh, bend(asset.mesh.vertices)
    assert asset.binding is not None
    driven = MeshDriven(mesh, asset.surfels, asset.binding)
    rest = Frames.of(driven.pose(mesh.vertices))
    size = float(np.ptp(mesh.vertices, axis=0).max())
    particles = fill(mesh.vertices, mesh.faces, size / ALONG).points.astype(np.float32)
    points, gradients = motion(particles).astype(np.float32), gradient(particles).astype(np.float16).astype(np.float32)
    tangents = np.stack([rest.tangent_u, rest.tangent_v], -1).astype(np.float64)
    where, image = motion(rest.centre), gradient(rest.centre.astype(np.float64)) @ tangents
    carrier = ParticleDriven(rest, particles)
    on_mesh = on_the_mesh(mesh, asset.binding, rest.centre, carrier.spacing)
    rows = []
    for way in WAYS:
        posed = driven.pose(motion(mesh.vertices).astype(np.float32))
        if way != "surface":
            carrier.on_mesh = on_mesh if way == "automatic" else None
            carrier.pose(posed, points, gradients)
        off = 100 * np.linalg.norm(posed.centre - where, axis=1) / size
        found = np.stack([posed.tangent_u, posed.tangent_v], -1)
        wrong = 100 * np.linalg.norm(found - image, axis=(1, 2)) / np.linalg.norm(image, axis=(1, 2)).clip(1e-12)
        share = {"surface": 0.0, "automatic": 1 - on_mesh.mean(), "particles": 1.0}[way]
        figures = (off.mean(), np.quantile(off, 0.99), wrong.mean(), np.quantile(wrong, 0.99))
        rows.append([way, f"{share:.0%}", *(f"{figure:.2g}" for figure in figures)])
    return rows


def pictures(asset: Asset, folder: Path, samples: int) -> tuple[list[list[object]], Array]:
    """Of each way PSNR of the foreground, SSIM and FLIP of the posed asset under other lights; and a view of each.

    The views stand side by side, behind the one by Cycles: (h, w, 3), encoded.
    """
    session, rows, views = Session(), [], []
    path = FOLDER / "particle-driven.drgs"
    write_asset(path, asset)
    key = session.load_asset(path)
    truth, capture = relit_truth(folder, posed=True, views=VIEWS), read_capture(folder)
    alone = replace(capture, views=capture.training)

    def show(name: str, number: int, ours: Array, truth: Array) -> None:
        if name == f"posed-{LIGHT}" and number == VIEW:
            views.extend([ours] if views else [truth, ours])

    for way in WAYS:
        draw = session_renderer(session, key, RenderSettings(samples=samples, bounces=3), driven_by=way)
        found = compare(asset, alone, truth, draw, show=show)["lights"]
        rows.append([f"{mean(found, 'scaled', 'foreground'):.2f}", similarity(found)])
    return rows, np.concatenate(views, axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, required=True)
    parser.add_argument("--objects", nargs="+", default=["cat", "helmet", "robot", "spot", "fern"])
    parser.add_argument("--samples", type=int, default=64)
    add_publish(parser)
    options = parser.parse_args()
    rows: list[list[object]] = []
    strips: list[Array] = []
    for name in options.objects:
        folder = options.scenes / name
        true = read_asset(of_truth(folder))
        cases = {"true, on the true mesh": true}
        cases |= {f"true, on a mesh of {n} voxels": on_own_mesh(true, n) for n in (FINE, COARSE)}
        if (learned := FOLDER / f"{name}.drgs").exists():
            cases[LEARNED] = read_asset(learned)
        for case, asset in cases.items():
            figures, strip = pictures(asset, folder, options.samples)
            strips += [strip] if case == LEARNED else []
            for exact, drawn in zip(errors(asset), figures):
                rows.append([name, case, *exact, *drawn])
                print(*rows[-1], flush=True)
    body = (
        "Bent by a right angle and twisted by 1.2 rad, exactly: distance of surfels from where they belong, in percent "
        "of the object's size, and error of their scaled tangents in percent, mean and 99th percentile. Posed as in "
        "the scenes: PSNR of the foreground, scaled by one factor a channel, under lights that were not photographed, "
        "against Cycles; SSIM and FLIP of the scaled frames on white. *Automatic*: particles carry the share of the "
        "surfels that does not lie on the mesh, or whose faces are coarse. Meshes of voxels are made of the surfels: "
        f"an import of surfels alone has {FINE} along the longest side. {VIEWS} views under each light.\n\n"
    )
    if strips:
        write_png(picture_path(FIGURE, options), (np.clip(np.concatenate(strips), 0, 1) * 255 + 0.5).astype(np.uint8))
        body += (
            "![Posed and relit: Cycles, then carried by surface, automatically, by particles](images/driven-by.png)\n\n"
        )
    columns = (
        "Object", "Surfels", "Carried by", "Share by particles", "Off, mean", "Off, 99 %", "Tangents, mean",
        "Tangents, 99 %", "Posed and relit, dB", "SSIM / FLIP",
    )  # fmt: skip
    write_section("particle-driven", "Surfels by particles", body + table(columns, rows))


if __name__ == "__main__":
    main()
