"""What denoiser, MIS and tracing the mesh bring, over the number of samples. Part of bench_light.py; draws a figure."""

from __future__ import annotations

import argparse
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from judge import frame_camera, psnr
from light_cases import BOUNCES, Case, Reference
from report import OUT, ROOT, picture_path, table
from subjects import source_digest, spread_materials

from drgs_blender.build.make import make_asset
from drgs_blender.core.asset import Asset, Mesh
from drgs_blender.core.asset.container import read_asset, write_asset

FIGURE = "efficiency.png"
MESH = Path("data/meshes/odedstein/armadillo/armadillo.obj")
#: Rays of each picture that a reference is the mean of.
PART = 128
#: Sub-pixel positions of all pictures.
AA = 4
#: What a variant changes of the full method; "cosine" says that all samples are of the cosine.
VARIANTS: dict[str, dict[str, Any]] = {
    "full": {},
    "no denoiser": {"denoise": "none"},
    "no MIS (cosine samples alone)": {"cosine_only": True},
    "no mesh (light meets surfels)": {"rays_see": "surfels"},
}


@dataclass(frozen=True)
class Armadillo(Case):
    """The scan of the development data with spread materials."""

    @property
    def files(self) -> tuple[Path, Path]:  # type: ignore[override]
        path = OUT / source_digest() / "armadillo-spread.drgs"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            asset = make_asset(scan(), up="y")
            data = spread_materials(asset.mesh)
            colours = {k: data[k] for k in ("albedo", "roughness", "metallic")}
            surfels = replace(asset.surfels, **at_surfels(asset, colours))
            write_asset(path, Asset(surfels, Mesh(**data), asset.binding, None, {"source": "armadillo"}))
        return path, path

    def camera(self, size: int) -> dict[str, Any]:
        return frame_camera(read_asset(self.files[0]).mesh.vertices, size, azimuth=-90, fill=0.8)


def at_surfels(asset: Asset, materials: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Materials of the vertices interpolated at the surfels."""
    corners, weights = asset.mesh.faces[asset.binding.face], asset.binding.barycentric
    return {k: np.einsum("nk,nk...->n...", weights, v[corners]) for k, v in materials.items()}


def scan() -> Path:
    """The mesh in the development data, see tests/conftest.py."""
    return Path(os.environ.get("DRGS_SHARED", ROOT.parent / "shared")) / MESH


@dataclass
class Curve:
    """One line of the figure."""

    name: str
    samples: list[int]
    decibels: list[float]
    seconds: list[float]


def settings_of(change: dict[str, Any], samples: int) -> dict[str, Any]:
    """Fields of RenderSettings of a variant."""
    chosen = {"camera_sees": "surfels", "subpixel_samples": AA, "denoise": "svgf"} | change
    if chosen.pop("cosine_only", False):
        chosen |= {"strategy_samples": (samples, 0, 0)}
    return chosen


def converged(case: Case, size: int, samples: int, rays_see: str) -> Reference:
    """Mean of pictures with different seeds and the subpixels that is measured, of `rays` in all.

    One picture of more sub-pixel positions would be another picture: the low-pass of surfels follows their number.
    """
    count = max(1, samples // PART)
    pictures = [
        case.picture(
            size, samples // count, 1000 + seed, camera_sees="surfels", subpixel_samples=AA, rays_see=rays_see
        )[0]
        for seed in range(count)
    ]
    return Reference.of(np.mean(pictures, axis=0), alpha=0.99)


def measure(case: Case, options: argparse.Namespace) -> list[Curve]:
    curves = []
    references: dict[str, Reference] = {}
    for name, change in VARIANTS.items():
        rays_see = change.get("rays_see", "mesh")
        if rays_see not in references:
            references[rays_see] = converged(case, options.size, options.reference_rays, rays_see)
        reference = references[rays_see]
        curve = Curve(name, list(options.efficiency_rays), [], [])
        case.picture(options.size, 4, **settings_of(change, 4))  # kernels
        for samples in curve.samples:
            picture, seconds = case.picture(options.size, samples, **settings_of(change, samples))
            curve.decibels.append(psnr(picture, reference.picture, reference.mask))
            curve.seconds.append(seconds)
        curves.append(curve)
    return curves


def draw(curves: list[Curve], options: argparse.Namespace) -> None:
    """Quality and time over samples, side by side."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(1, 2, figsize=(9, 3.6), constrained_layout=True)
    for curve in curves:
        left.plot(curve.samples, curve.decibels, marker="o", markersize=3, label=curve.name)
        right.plot(curve.samples, curve.seconds, marker="o", markersize=3, label=curve.name)
    right.set_yscale("log")
    for axes, what in ((left, "PSNR, dB"), (right, "seconds a frame")):
        axes.set_xscale("log", base=2)
        axes.set_xlabel("samples a pixel")
        axes.set_ylabel(what)
        axes.grid(alpha=0.3)
        axes.xaxis.set_major_formatter("{x:.0f}")
    left.legend(fontsize="small")
    figure.savefig(picture_path(FIGURE, options), dpi=120)
    pyplot.close(figure)


def efficiency(options: argparse.Namespace) -> str:
    """The part's text; draws the figure."""
    if not scan().exists():
        return f"Not measured: {MESH.name} is not among the development data here (DRGS_SHARED)."
    case = Armadillo("armadillo", "armadillo", "city")
    curves = measure(case, options)
    draw(curves, options)
    mesh = read_asset(case.files[0]).mesh
    text = (
        f"Armadillo, {len(mesh.faces):,} triangles, spread materials, {case.light}.exr, {options.size}x{options.size}, "
        f"{BOUNCES} indirect bounce, surfels as primary surface, {AA} sub-pixel samples, SVGF unless said, one "
        f"picture a point; PSNR "
        f"over the subject against {options.reference_rays} rays (mean over seeds, same subpixels and tracer) without "
        "denoiser. Seconds: whole frame, everything rebuilt. Without MIS, all samples at the visible point are of "
        "the cosine; further hits are as always.\n\n"
        f"![PSNR and time over samples](images/{FIGURE})\n\n"
    )
    columns = ("Samples", *(f"{c.name}: dB / s" for c in curves))
    rows = [
        (
            samples,
            *(
                f"{c.decibels[c.samples.index(samples)]:.1f} / {c.seconds[c.samples.index(samples)]:.2f}"
                if samples in c.samples
                else "-"
                for c in curves
            ),
        )
        for samples in options.efficiency_rays
    ]
    text += table(columns, rows)
    return text
