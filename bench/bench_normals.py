"""Where normals are lost between surfels and mesh, and what that costs relit pictures.

python bench/bench_normals.py --part chain --capture scenes/cat [--size 256]
python bench/bench_normals.py --part creases --capture scenes/cat [--size 256]
python bench/bench_normals.py --part relit --capture scenes/cat [--steps 1000]
python bench/bench_normals.py --part prior --capture scenes/cat --size 128 [--steps 800]

Scenes are those of `drgs evaluate --make-scenes scenes`. Surfels are learned once and kept, and so are rows, so that
captures may be measured one by one.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from bench_evaluate import mean, score, similarity, under_other_lights
from bench_reconstruct import first_hits, trained
from bench_shape import VOXELS, Truth, true_depth
from report import OUT, processor_seconds, store_row, table, write_section
from scipy.ndimage import distance_transform_edt, gaussian_filter

from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.model import Mesh
from drgs_blender.core.frame import Camera
from drgs_blender.evaluate.truth import read_truth
from drgs_blender.geometry.normals import unit
from drgs_blender.reconstruct import pipeline
from drgs_blender.reconstruct.capture.capture import Capture
from drgs_blender.reconstruct.meshing import depth_fusion
from drgs_blender.reconstruct.meshing.silhouette_fit import fill_silhouettes
from drgs_blender.reconstruct.meshing.visual_hull import find_region, silhouettes
from drgs_blender.reconstruct.model.gaussians import Gaussians
from drgs_blender.reconstruct.model.thin_structures import normals_of
from drgs_blender.reconstruct.optim.schedule import Schedule
from drgs_blender.reconstruct.readers import read_capture
from drgs_blender.reconstruct.settings import Settings

FOLDER = OUT / "reconstruct"
#: The light of relit pictures.
LIGHT = "city"
#: Neighbouring pixels whose true normals are farther apart are on a crease or an outline, degrees.
CREASE = 20.0
#: Distances from creases between which pixels are counted together, pixels.
APART = (0.0, 1.0, 3.0, np.inf)
#: True normals are blurred by these standard deviations, pixels, sampled so finely.
BLURS, FINER = (0.5, 1.0, 2.0), 4
#: Name -> whether triangles are evened, and whether learning begins with the surfels' normals, too.
STEPS = {
    "triangles as marching cubes leaves them": (False, False),
    "evened": (True, False),
    "evened, and begun with the surfels' normals": (True, True),
}


def learned(capture: Capture, name: str) -> Gaussians:
    """The surfels of a capture after stage (i) as it is by default, kept from the first time on."""
    file = FOLDER / "surfels" / f"{name}.npz"
    if not file.exists():
        training, _ = trained(capture, Schedule(), None)
        surfels, light = training.gaussians.arrays(), training.gaussians.light
        assert light is not None
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savez(file, light=light.detach().numpy(), **surfels)  # type: ignore[arg-type]
    with np.load(file) as kept:
        tensors = {key: torch.from_numpy(kept[key]) for key in kept.files}
    light = tensors.pop("light")
    return Gaussians(tensors, light)


#: Name -> degrees that a model's normals are off, and the weight and part of the steps that they have.
PRIORS = {
    "without normals of a model": (0.0, 0.0, 0.0),
    "of a model 15 degrees off, as it is by default": (15.0, Schedule().normal_prior, Schedule().normal_prior_until),
    "of the same, until .4": (15.0, Schedule().normal_prior, 0.4),
    "true ones, weight 1, all the time": (0.0, 1.0, 1.0),
}
#: Deviations of what makes normals of a model of true ones: of the blur, and of the errors' width, pixels.
BLUR, WIDE = 1.5, 6.0


@contextmanager
def same_surfels(gaussians: Gaussians) -> Iterator[None]:
    """Let `pipeline.reconstruct` have these surfels in place of learning them."""
    names = "held_out_metrics", "Training"
    kept, learn = {name: getattr(pipeline, name) for name in names}, pipeline._Work.learn
    pipeline.held_out_metrics = lambda *_: {}
    pipeline.Training = lambda *_, **__: None  # type: ignore[assignment,misc]
    pipeline._Work.learn = lambda *_: gaussians  # type: ignore[method-assign]
    try:
        yield
    finally:
        pipeline._Work.learn = learn  # type: ignore[method-assign]
        for name, value in kept.items():
            setattr(pipeline, name, value)


#: Heads of `figures`.
FIGURES = (
    "Normals deg", "Relit scaled", "Relit: SSIM / FLIP", "Views left out", "Albedo scaled",
    "Roughness / metallic RMSE", "Processor s",
)  # fmt: skip


def figures(report: dict, spent: float) -> list[str]:
    """Cells of `FIGURES`: of a report, and processor seconds."""
    materials, lit = report["materials"], under_other_lights(report, False)
    return [
        f"{report['geometry']['normal_degrees']:.2f}",
        f"{mean(lit, 'scaled', 'foreground'):.2f}",
        similarity(lit),
        f"{report['novel']['psnr_foreground']:.2f}",
        f"{materials['albedo_psnr_scaled']:.2f}",
        f"{materials['roughness_rmse']:.3f} / {materials['metallic_rmse']:.3f}",
        f"{spent:.0f}",
    ]


class Chain:
    """Errors of normals in the views left out, mean degrees of the pixels that both show."""

    def __init__(self, capture: Capture, truth: Truth) -> None:
        self._views, self._truth = capture.testing, truth
        self._maps = [truth.maps(view.camera) for view in self._views]

    def off(self, shown: list[tuple[np.ndarray, np.ndarray]]) -> float:
        """Of normals (h, w, 3) of each view, where its mask (h, w) says that there are any."""
        angles = []
        for (normal, seen), (depth, true) in zip(shown, self._maps, strict=True):
            both = seen & (depth > 0)
            angles.append(np.arccos((normal * true).sum(-1)[both].clip(-1, 1)))
        return float(np.degrees(np.concatenate(angles).mean()))

    def mesh(self, mesh: Mesh) -> float:
        """Of the smooth normals of a mesh."""
        return self._hits(mesh.vertices, mesh.faces)

    def facets(self) -> float:
        """Of the true mesh, faces flat: what no shape can show, as photographs show smooth normals of few faces."""
        corners = self._truth.vertices[self._truth.faces].reshape(-1, 3)
        return self._hits(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3))

    def surfels(self, gaussians: Gaussians) -> float:
        """Of the surfels' own normals."""
        shown = [unit(normals_of(gaussians)(view)) for view in self._views]
        return self.off([(normal, np.abs(normal).sum(-1) > 0) for normal in shown])

    def _hits(self, vertices: np.ndarray, faces: np.ndarray) -> float:
        shown = []
        for view in self._views:
            normal, hit, _ = first_hits(vertices, faces, view.camera)
            shape = view.camera.height, view.camera.width
            shown.append((normal.reshape(*shape, 3), hit.reshape(shape)))
        return self.off(shown)


def chain(capture: Capture, truth: Truth, name: str) -> dict[str, float]:
    """Degrees after each step from the surfels to the mesh of stage (i)."""
    judge, region, cameras = Chain(capture, truth), find_region(capture), [v.camera for v in capture.training]
    masks, gaussians = silhouettes(capture), learned(capture, name)
    assert masks is not None
    found = {"the true mesh, faces flat": judge.facets()}
    with true_depth(truth):
        for depth_fusion.PIXELS in VOXELS:
            mesh, _ = depth_fusion.fuse(None, cameras, region, 1024)  # type: ignore[arg-type]
            found[f"true depth, fused, voxels of {depth_fusion.PIXELS:g} pixels"] = judge.mesh(mesh)
    found["surfels' own normals"] = judge.surfels(gaussians)
    even = depth_fusion.relaxed
    for label, relax in (("triangles as marching cubes leaves them", lambda v, _: v), ("evened", even)):
        depth_fusion.relaxed = relax
        try:
            mesh, _ = depth_fusion.fuse(gaussians, cameras, region)
        finally:
            depth_fusion.relaxed = even
        found[f"learned depth, fused, {label}"] = judge.mesh(mesh)
        mesh.vertices = fill_silhouettes(mesh, cameras, masks)
        found[f"{label}, outlines filled"] = judge.mesh(mesh)
    return found


def crease_distance(true: np.ndarray) -> np.ndarray:
    """(h, w) pixels to the nearest one on a crease or an outline of normals (h, w, 3)."""
    cosine, crease = np.cos(np.radians(CREASE)), np.zeros(true.shape[:2], bool)
    for axis in (0, 1):
        crease |= (true * np.roll(true, 1, axis)).sum(-1) < cosine
    return np.asarray(distance_transform_edt(~crease))


def blurred_normals(truth: Truth, camera: Camera, deviation: float) -> np.ndarray:
    """Unit normals (h, w, 3) of the true mesh, blurred by a Gaussian that many pixels wide."""
    size = {"width": camera.width * FINER, "height": camera.height * FINER}
    lens = {name: getattr(camera, name) * FINER for name in ("fx", "fy", "cx", "cy")}
    depth, normal = truth.maps(replace(camera, **size, **lens))
    shown = normal * (depth > 0)[..., None]
    blurred = [gaussian_filter(shown[..., c], deviation * FINER) for c in range(3)]
    return unit(np.stack(blurred, -1)[FINER // 2 :: FINER, FINER // 2 :: FINER])


def creases(capture: Capture, truth: Truth, name: str) -> dict[str, str]:
    """Errors of the surfels' normals by distance from creases, and of the true ones, blurred."""
    gaussians, views = learned(capture, name), capture.testing
    angles, distances = [], []
    blurs: dict[float, list[np.ndarray]] = {deviation: [] for deviation in BLURS}
    for view in views:
        depth, true = truth.maps(view.camera)
        shown = normals_of(gaussians)(view)
        seen = (depth > 0) & (np.abs(shown).sum(-1) > 0)
        angles.append(np.degrees(np.arccos((unit(shown) * true).sum(-1)[seen].clip(-1, 1))))
        distances.append(crease_distance(true)[seen])
        for deviation, found in blurs.items():
            blurred = blurred_normals(truth, view.camera, deviation)
            found.append(np.degrees(np.arccos((blurred * true).sum(-1)[seen].clip(-1, 1))))
    angle, distance = np.concatenate(angles), np.concatenate(distances)
    row = {"surfels' own normals": f"{angle.mean():.2f}", "median": f"{np.median(angle):.2f}"}
    for low, high in pairwise(APART):
        label = f"to {high:g} pixels from a crease" if np.isfinite(high) else "farther"
        there = (distance >= low if low == 0 else distance > low) & (distance <= high)
        row[label] = f"{angle[there].mean():.2f} ({100 * there.mean():.0f} %)"
    for deviation, found in blurs.items():
        row[f"true normals, blurred by {deviation:g} pixels"] = f"{np.concatenate(found).mean():.2f}"
    return row


def relit(capture: Capture, folder: Path, name: str, steps: int) -> dict[str, list[str]]:
    """Figures of the finished asset with and without the steps, from the same surfels."""
    gaussians, truth = learned(capture, name), read_truth(folder)
    assert truth is not None
    known = (LIGHT, truth.training_light)
    truth = replace(truth, sets=[item for item in truth.sets if not item.posed and item.light in known])
    settings = Settings()
    settings = replace(settings, decoupling=replace(settings.decoupling, iterations=steps))
    kept = depth_fusion.relaxed, pipeline.with_surfel_normals
    found = {}
    for label, (evened, shown) in STEPS.items():
        depth_fusion.relaxed = kept[0] if evened else lambda vertices, _: vertices
        pipeline.with_surfel_normals = kept[1] if shown else lambda *_: None
        begun = processor_seconds()
        try:
            with same_surfels(gaussians):
                asset = pipeline.reconstruct(capture, settings)
        finally:
            depth_fusion.relaxed, pipeline.with_surfel_normals = kept
        spent = processor_seconds() - begun
        path = FOLDER / f"{name}.drgs"
        write_asset(path, asset)
        found[label] = figures(score(path, folder, "surfels", 32, truth), spent)
        print(name, label, *found[label], flush=True)
    return found


def as_a_model_sees(normals: np.ndarray, degrees: float, random: np.random.Generator) -> np.ndarray:
    """Normals (h, w, 3), 0 where there are none, blurred, and turned anyhow by about as many degrees, alike nearby."""
    if not degrees:
        return normals
    noise = gaussian_filter(random.normal(size=normals.shape), (WIDE, WIDE, 0))
    noise *= np.tan(np.radians(degrees)) / np.sqrt((noise**2).sum(-1).mean())
    return unit(gaussian_filter(normals, (BLUR, BLUR, 0)) + noise, (0, 0, 0)).astype(np.float32)


def write_prior(capture: Capture, folder: Path, name: str, steps: int) -> None:
    """Measure and write what normals of a model bring stage (i)."""
    truth, rows = Truth(folder), {}
    judge, maps = Chain(capture, truth), [truth.maps(view.camera) for view in capture.training]
    for label, (degrees, weight, until) in PRIORS.items():
        random = np.random.default_rng(0)
        for view, (depth, normal) in zip(capture.training, maps, strict=True):
            shown = as_a_model_sees(np.where((depth > 0)[..., None], normal, 0), degrees, random)
            view.normals = np.where((depth > 0)[..., None], shown, 0).astype(np.float32)
        schedule = Schedule(iterations=steps, normal_prior=weight, normal_prior_until=until)
        training, figures = trained(capture, schedule, None)
        mesh, _ = pipeline.mesh_of(training.gaussians, capture, training.region)
        degrees_off = judge.surfels(training.gaussians), judge.mesh(mesh)
        cells = [*(f"{value:.2f}" for value in (*degrees_off, figures["psnr"]))]
        print(name, label, *cells, flush=True)
        rows = store_row(FOLDER / "prior.json", f"{name}|{label}", cells)
    body = (
        f"{steps} steps. Normals as a model would give them are true ones of the training views, blurred, with smooth "
        "errors. Normals in mean degrees and PSNR in dB in the views left out.\n\n"
    )
    head = ("Object-pixels", "Normals", "Surfels' own, deg", "Mesh, deg", "PSNR dB")
    cells = [(*key.split("|"), *values) for key, values in rows.items()]
    write_section("reconstruct-prior", "What normals of a model bring stage (i)", body + table(head, cells))


def write_chain(capture: Capture, folder: Path, name: str, _: int) -> None:
    """Measure and write the chain."""
    rows = store_row(FOLDER / "chain.json", name, chain(capture, Truth(folder), name))
    body = (
        "Mean degrees in the views left out, before materials are learned. Photographs show smooth vertex normals of a "
        "mesh of few faces: what the true mesh with flat faces is off is in no shape.\n\n"
    )
    head = ("Object-pixels", *next(iter(rows.values())))
    cells = [(key, *(f"{value:.2f}" for value in values.values())) for key, values in rows.items()]
    write_section("reconstruct-chain", "Where stage (i) loses normals", body + table(head, cells))


def write_creases(capture: Capture, folder: Path, name: str, _: int) -> None:
    """Measure and write the errors by distance from creases."""
    rows = store_row(FOLDER / "creases.json", name, creases(capture, Truth(folder), name))
    body = (
        f"Mean degrees in the views left out, and the share of the pixels; a crease is where true normals of "
        f"neighbouring pixels are over {CREASE:g} degrees apart, outlines included.\n\n"
    )
    head = ("Object-pixels", *next(iter(rows.values())))
    cells = [(key, *values.values()) for key, values in rows.items()]
    write_section("reconstruct-creases", "Normals of stage (i) on creases and off them", body + table(head, cells))


def write_relit(capture: Capture, folder: Path, name: str, steps: int) -> None:
    """Measure and write what the steps bring."""
    rows: dict[str, Any] = {}
    for label, cells in relit(capture, folder, name, steps).items():
        rows = store_row(FOLDER / "relit.json", f"{name}|{label}", cells)
    body = (
        f"The same surfels, {steps} steps of materials and light; camera sees surfels. Normals in mean degrees, PSNR "
        f"of the foreground in dB, relit under {LIGHT!r} scaled by one factor a channel. Of the fern learning has its "
        "surfels' normals alone, as it is thin.\n\n"
    )
    head = ("Object-pixels", "Mesh", *FIGURES)
    write_section(
        "reconstruct-normals",
        "What even triangles and normals of surfels bring",
        body + table(head, [(*key.split("|"), *cells) for key, cells in rows.items()]),
    )


PARTS: dict[str, Callable[[Capture, Path, str, int], None]] = {
    "chain": write_chain,
    "creases": write_creases,
    "relit": write_relit,
    "prior": write_prior,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", choices=tuple(PARTS), default="chain")
    parser.add_argument("--capture", type=Path, required=True)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--steps", type=int, default=1000, help="of materials and light")
    options = parser.parse_args()
    capture = read_capture(options.capture, options.size)
    PARTS[options.part](capture, options.capture, f"{options.capture.name}-{options.size}", options.steps)


if __name__ == "__main__":
    main()
