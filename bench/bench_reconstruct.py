"""Photographs to surfels and mesh: time of the rasteriser, views left out, the mesh against the truth, ablations.

python bench/bench_reconstruct.py --part raster
python bench/bench_reconstruct.py --part surfels --capture scenes/spot [--time-budget 2] [--size 200]
python bench/bench_reconstruct.py --part photographs --capture lego_400 [--time-budget 2] [--size 256]
python bench/bench_reconstruct.py --part ablations --capture scenes/spot [--iterations 800] [--only NAME ...]
python bench/bench_reconstruct.py --part paces --capture scenes/spot [--iterations 800] [--only NAME ...]
python bench/bench_reconstruct.py --part variants --capture scenes/spot [--iterations 1500]

Scenes are those of `drgs evaluate --make-scenes scenes`. Rows are kept, so that captures may be measured one by one.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh
from report import OUT, processor_seconds, store_row, table, write_section

from drgs_blender.compute.threads import get_num_threads
from drgs_blender.core.frame import Camera
from drgs_blender.geometry.normals import VertexNormals
from drgs_blender.reconstruct.capture.capture import Capture
from drgs_blender.reconstruct.held_out import held_out_metrics
from drgs_blender.reconstruct.meshing.visual_hull import find_region
from drgs_blender.reconstruct.model.attached import attach_learned
from drgs_blender.reconstruct.model.gaussians import Gaussians
from drgs_blender.reconstruct.model.raster import rasterise
from drgs_blender.reconstruct.optim.schedule import RATES, Schedule
from drgs_blender.reconstruct.optim.train import Training
from drgs_blender.reconstruct.pipeline import ON_MESH, mesh_of
from drgs_blender.reconstruct.readers import read_capture

ROWS = OUT / "reconstruct"
#: Ablations of stage (i): name -> change of the schedule.
ABLATIONS: dict[str, dict[str, Any]] = {
    "as it is": {},
    "harmonics alone, nothing mirrored": {"reflections": 1.0},
    "without normal consistency": {"consistency": 0.0},
    "normal consistency with the median depth": {"median": 1.0},
    "consistency of patches of two views": {"patches": 1.0},
    "without distortion": {"distortion": 0.0},
    "without mask": {"mask": 0.0},
    "without harmonics beyond the mean": {"bands": 0},
    "without densification": {"rounds": 0},
}
#: Learning rates of places and of turns at the start, half of those of `schedule.RATES`.
SLOWLY = {name: (RATES[name][0] / 2, RATES[name][1]) for name in ("centre", "rotation")}
#: How fast stage (i) learns: name -> change of the schedule, and of "rates" those of learning.
PACES: dict[str, dict[str, Any]] = {
    "as it is": {},
    "mask a fifth as heavy (so also below)": {"mask": 0.1},
    "half size for three tenths of the steps": {"coarse": 0.3, "mask": 0.1},
    "places and turns learned half as fast": {"rates": SLOWLY, "mask": 0.1},
    "both of these": {"coarse": 0.3, "rates": SLOWLY, "mask": 0.1},
    "both of these, a fifth more steps": {"coarse": 0.3, "rates": SLOWLY, "iterations": 960, "mask": 0.1},
}


def timed(work: Callable[[], Any], times: int = 10) -> tuple[float, float]:
    """Median wall and processor milliseconds of `work`."""
    walls, processor = [], []
    for _ in range(times):
        begun, wall = processor_seconds(), time.perf_counter()
        work()
        walls.append(1e3 * (time.perf_counter() - wall))
        processor.append(1e3 * (processor_seconds() - begun))
    return float(np.median(walls)), float(np.median(processor))


def raster(options: argparse.Namespace) -> None:
    """20,000 surfels on a sphere that fills half of 200 x 200 pixels."""
    rng = np.random.default_rng(0)
    n, size = 20000, 200
    normal = rng.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    u = np.cross(normal, [0.3, 0.2, 1.0])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    scale = rng.uniform(0.006, 0.018, (n, 2, 1))
    values = (normal, u * scale[:, 0], np.cross(normal, u) * scale[:, 1], rng.uniform(0.3, 0.95, n))
    matrix = np.eye(4)
    matrix[2, 3] = 4.0
    camera = Camera(matrix, size, size, 330.0, 330.0, 100.0, 100.0)
    rows = []
    for channels in (6, 11):
        tensors = [torch.tensor(v, dtype=torch.float32, requires_grad=True) for v in values]
        features = torch.tensor(rng.uniform(size=(n, channels)), dtype=torch.float32, requires_grad=True)
        maps = rasterise(*tensors, features, camera)

        def loss(tensors: Any = tensors, features: Any = features) -> torch.Tensor:
            maps = rasterise(*tensors, features, camera)
            return maps.features.sum() + maps.depth.sum() + maps.distortion.sum() + maps.alpha.sum()

        loss().backward()
        forward = timed(lambda: rasterise(*tensors, features, camera))  # noqa: B023
        losses = [loss() for _ in range(10)]
        backward = timed(lambda: losses.pop().backward())  # noqa: B023
        rows.append((channels, *forward, *backward, float(maps.alpha.detach().mean())))
    head = ("Channels", "Forward ms", "processor ms", "Backward ms", "processor ms", "Covered")
    body = (
        f"20,000 surfels, 200x200 pixels, {get_num_threads()} threads; besides the channels depth, median, alpha and "
        "distortion. Gradients agree with a float64 brute force to 1e-4 (tests/unit/test_reconstruct_raster.py).\n\n"
    )
    write_section("reconstruct-raster", "Differentiable rasteriser", body + table(head, rows))


def first_hits(vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """At the pixels' centres: smooth unit normal (p, 3) towards the viewer, whether there is a hit (p,), depth (p,)."""
    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.int32))
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = -(np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    local = np.stack([*np.meshgrid(x, y), np.full((camera.height, camera.width), -1.0)], -1).reshape(-1, 3)
    rays = (local @ camera.matrix_world[:3, :3].T).astype(np.float32)
    found = scene.run(np.tile(camera.matrix_world[:3, 3].astype(np.float32), (len(rays), 1)), rays, output=1)
    corner = faces[np.maximum(found["primID"], 0)]
    smooth = VertexNormals(faces, len(vertices))(vertices)
    share = np.stack([1 - found["u"] - found["v"], found["u"], found["v"]], -1)
    normal = np.einsum("pk,pkc->pc", share, smooth[corner])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    normal[np.einsum("pc,pc->p", normal, rays) > 0] *= -1  # open surfaces are seen from both sides
    return normal, found["primID"] >= 0, found["tfar"]


def against_truth(gaussians: Gaussians, training: Training, capture: Capture, folder: Path) -> dict[str, Any]:
    """Our mesh and the true one in the test views: mean angle between normals, median depth error, overlap."""
    truth = np.load(folder / "mesh.npz")
    mesh, report = mesh_of(gaussians, capture, training.region)
    angles, depths, overlaps = [], [], []
    for view in capture.testing:
        normal, hit, depth = first_hits(mesh.vertices, mesh.faces, view.camera)
        true_normal, true_hit, true_depth = first_hits(truth["vertices"], truth["faces"], view.camera)
        both = hit & true_hit
        cosine = np.einsum("pc,pc->p", normal, true_normal)[both].clip(-1, 1)
        angles.append(np.degrees(np.arccos(cosine)))
        depths.append(np.abs(depth - true_depth)[both])
        overlaps.append(both.sum() / max((hit | true_hit).sum(), 1))
    return {
        "normal": float(np.concatenate(angles).mean()), "depth": float(np.median(np.concatenate(depths))),
        "overlap": float(np.mean(overlaps)), "faces": len(mesh.faces), "dropped": report["components_dropped"],
    }  # fmt: skip


def trained(capture: Capture, schedule: Schedule, seconds: float | None) -> tuple[Training, dict[str, Any]]:
    """A finished training, and what it cost and reached."""
    begun, wall = processor_seconds(), time.perf_counter()
    training = Training(capture, find_region(capture), schedule, seconds=seconds)
    while not training.finished:
        training.step()
    cost = {"cpu": processor_seconds() - begun, "wall": time.perf_counter() - wall, "steps": training.iteration}
    return training, cost | {"surfels": len(training.gaussians)} | held_out_metrics(training.gaussians, capture)


def warm(capture: Capture) -> None:
    """Compile every kernel, so that it is not measured."""
    training, _ = trained(capture, Schedule(iterations=12, surfels=500), None)
    mesh_of(training.gaussians, capture, training.region, 32)


def surfels(options: argparse.Namespace, part: str = "surfels") -> None:
    """Stage (i) within the minutes."""
    capture = read_capture(options.capture, options.size, 8)
    warm(capture)
    schedule = Schedule(iterations=options.iterations or 6000, surfels=options.surfels)
    training, row = trained(capture, schedule, 60 * options.time_budget if options.time_budget else None)
    if (options.capture / "mesh.npz").exists():
        row |= against_truth(training.gaussians, training, capture, options.capture)
    row |= {"views": len(capture.training), "size": capture.views[0].camera.width}
    row["limit"] = f"{options.time_budget:g} min" if options.time_budget else f"{schedule.iterations} steps"
    rows = store_row(ROWS / f"{part}.json", f"{options.capture.name}|{row['size']}|{row['limit']}", row)
    names = (
        "size", "views", "limit", "wall", "cpu", "steps", "surfels", "psnr", "psnr_pooled", "ssim", "normal", "depth",
        "overlap",
    )  # fmt: skip
    head = (
        "Capture", "Pixels", "Views", "Limit", "s", "processor s", "Steps", "Surfels", "PSNR dB", "pooled", "SSIM",
        "Normals deg", "Depth", "Silhouettes",
    )  # fmt: skip
    title = {"surfels": "Stage (i) on scenes with known truth", "photographs": "Stage (i) on published photographs"}[
        part
    ]
    body = (
        "PSNR over whole pictures of the views left out: the mean of the pictures', as published tables give it, and, "
        "pooled, of the mean squared error, which the worst views decide; normals (mean angle, degrees), depth "
        "(median, metres) and silhouettes (intersection over union) of the mesh against the true one.\n\n"
    )
    cells = [(key.split("|")[0], *(formatted(r.get(name, "-")) for name in names)) for key, r in rows.items()]
    write_section(f"reconstruct-{part}", title, body + table(head, cells))


def formatted(value: Any) -> Any:
    """Two decimals for decibels and degrees alike, four for small numbers."""
    return value if not isinstance(value, float) else f"{value:.4f}" if abs(value) < 1 else f"{value:.2f}"


@contextmanager
def learning_at(rates: dict[str, tuple[float, float]]) -> Iterator[None]:
    """Within it, surfels are learned at these rates in place of those of `schedule.RATES`."""
    kept = dict(RATES)
    RATES.update(rates)
    try:
        yield
    finally:
        RATES.update(kept)


def ablations(options: argparse.Namespace, part: str = "ablations") -> None:
    """What each part of stage (i) is worth, at equal steps, on the capture's object and on those measured before."""
    capture = read_capture(options.capture, options.size, 8)
    warm(capture)
    base = Schedule(iterations=options.iterations or 800, surfels=8000)
    pixels = capture.views[0].camera.width
    changes, title = {
        "ablations": (ABLATIONS, "Ablations of stage (i)"),
        "paces": (PACES, "How fast stage (i) learns"),
    }[part]
    file, rows = ROWS / f"{part}.json", {}
    for name, change in changes.items():
        if options.only and name not in options.only:
            continue
        fields = {key: value for key, value in change.items() if key != "rates"}
        with learning_at(change.get("rates", {})):
            training, row = trained(capture, replace(base, **fields), None)
        if (options.capture / "mesh.npz").exists():
            row |= against_truth(training.gaussians, training, capture, options.capture)
        row["run"] = f"{base.iterations} steps, {base.surfels} surfels, {pixels} pixels"
        rows = store_row(file, f"{name}|{options.capture.name}", row)
    order = {name: k for k, name in enumerate(changes)}
    named = sorted((key.split("|")[1], order[key.split("|")[0]], row) for key, row in rows.items())
    names = ("psnr", "ssim", "normal", "depth", "overlap", "cpu")
    cells = [(one, [*changes][k], *(formatted(row.get(name, "-")) for name in names)) for one, k, row in named]
    head = ("Object", "Stage (i)", "PSNR dB", "SSIM", "Normals deg", "Depth", "Silhouettes", "processor s")
    body = " / ".join(sorted({row["run"] for row in rows.values()})) + ".\n\n"
    write_section(f"reconstruct-{part}", title, body + table(head, cells))


def on_mesh(training: Training, capture: Capture, schedule: Schedule) -> Iterator[tuple[str, Gaussians, float]]:
    """Of each variant of surfels on the mesh of `training`: name, what it learned, processor seconds."""
    mesh, _ = mesh_of(training.gaussians, capture, training.region)
    light = training.gaussians.light
    for name, fixed in (
        ("M: on the mesh", ()), ("M without d", ("offset",)), ("M without alpha", ("opacity",)),
        ("M without both", ("offset", "opacity")),
    ):  # fmt: skip
        begun = processor_seconds()
        attached, _, _ = attach_learned(mesh, training.gaussians, fixed)
        attached.light = None if light is None else light.detach().clone().requires_grad_(True)
        again = Training(capture, training.region, schedule.on_mesh(ON_MESH), attached)
        while not again.finished:
            again.step()
        yield name, again.gaussians, processor_seconds() - begun


def variants(options: argparse.Namespace) -> None:
    """Free surfels against surfels on the mesh, with and without what the paper lets them learn."""
    capture = read_capture(options.capture, options.size, 8)
    warm(capture)
    schedule = Schedule(iterations=options.iterations or 1500, surfels=10000)
    training, row = trained(capture, schedule, None)
    rows = store_row(ROWS / "variants.json", "P: free surfels", row)
    for name, gaussians, seconds in on_mesh(training, capture, schedule):
        row = {"surfels": len(gaussians), "cpu": seconds} | held_out_metrics(gaussians, capture)
        rows = store_row(ROWS / "variants.json", name, row)
    cells = [(n, r["surfels"], *(formatted(r[k]) for k in ("psnr", "ssim", "cpu"))) for n, r in rows.items()]
    head = ("Variant", "Surfels", "PSNR dB", "SSIM", "processor s")
    body = f"{options.capture.name}, {schedule.iterations} steps, and {ON_MESH:g} of them again on the mesh.\n\n"
    write_section("reconstruct-variants", "Free surfels and surfels on the mesh", body + table(head, cells))


PARTS: dict[str, Callable[[argparse.Namespace], None]] = {
    "raster": raster,
    "surfels": surfels,
    "photographs": lambda options: surfels(options, "photographs"),
    "ablations": ablations,
    "paces": lambda options: ablations(options, "paces"),
    "variants": variants,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", choices=tuple(PARTS), default="raster")
    parser.add_argument("--capture", type=Path)
    parser.add_argument("--size", type=int, default=200)
    parser.add_argument("--time-budget", type=float, default=2.0, help="of stage (i); 0: the steps alone decide")
    parser.add_argument("--surfels", type=int, default=Schedule().surfels, help="at most")
    parser.add_argument("--iterations", type=int)
    parser.add_argument("--only", nargs="+", choices=tuple(ABLATIONS | PACES))
    options = parser.parse_args()
    if options.part != "raster" and options.capture is None:
        parser.error(f"--part {options.part} needs --capture")
    PARTS[options.part](options)


if __name__ == "__main__":
    main()
