"""`drgs import --remove-light`, with the light of the capture and without, on objects whose materials are known.

python bench/bench_delight.py [--objects spot cat robot] [--lights city sunset studio] [--under forest]

The engine lights the surfels of each object with its true materials (also gloss and metal) and an HDRI; what leaves
them along their normals is the captured colour. Lights are those of the development data (`DRGS_SHARED`, or ../shared).
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from report import ROOT, table, write_section
from subjects import SOURCES

from drgs_blender.build.delight import remove_light
from drgs_blender.build.make import make_asset, read_mesh_file
from drgs_blender.build.relit import relit_colours
from drgs_blender.build.transfer import surfels_to_vertices
from drgs_blender.cli.main import main as drgs
from drgs_blender.core.asset import Asset, Environment
from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.color import LUMINANCE, linear_to_srgb, srgb_to_linear
from drgs_blender.core.frame import RenderSettings, World
from drgs_blender.formats.exr import read_exr
from drgs_blender.formats.files import Image, MaterialFile
from drgs_blender.formats.gaussian_ply import METALLIC, ROUGHNESS, SH_C0
from drgs_blender.formats.images import load_image
from drgs_blender.formats.registry import read_environment

Array = np.ndarray
LIGHTS = Path(os.environ.get("DRGS_SHARED") or ROOT.parent / "shared") / "data" / "env"
TRUTH = RenderSettings(samples=512, subpixel_samples=1, bounces=2, shading_model="principled", seed=5)
SIZE = {"density": 40, "max_triangles": 15000, "max_surfels": 15000}
#: Part of the surfels that the exposure does not clip, and what it makes of the brightest of them.
UNCLIPPED, WHITE = 0.99, 0.9


def subject(name: str) -> Asset:
    """An example with its true materials."""
    file, options = SOURCES[name]
    source = read_mesh_file(ROOT / "examples" / file)
    if name == "spot":
        image = Image(load_image(ROOT / "examples" / "spot" / "spot_texture.png"), srgb=True)
        source.materials = [MaterialFile("Spot", (1.0, 1.0, 1.0), base_colour_image=image)]
        source.face_material = np.zeros(len(source.faces), np.int32)
    asset = make_asset(source, **options, **SIZE)
    return replace(asset, mesh=replace(asset.mesh, textures=None))


def photographed(truth: Asset, light: Environment) -> Asset:
    """The object as a capture without materials, exposed as a camera would."""
    assert truth.binding is not None
    world = World(light.radiance)
    seen = relit_colours(truth, truth.surfels, truth.mesh.vertices, world, TRUTH)
    shown = linear_to_srgb(np.clip(seen * WHITE / np.quantile(seen @ LUMINANCE, UNCLIPPED), 0, 1))
    n, k = len(truth.surfels), len(truth.mesh.vertices)
    surfels = replace(
        truth.surfels, albedo=srgb_to_linear(shown), roughness=np.full(n, ROUGHNESS), metallic=np.full(n, METALLIC),
        sh=((shown - 0.5) / SH_C0)[:, None],
    )  # fmt: skip
    mesh = replace(
        truth.mesh, albedo=np.full((k, 3), 0.4), roughness=np.full(k, ROUGHNESS), metallic=np.full(k, METALLIC)
    )
    surfels_to_vertices(mesh, surfels, truth.binding)
    return Asset(surfels, mesh, truth.binding)


def delit(capture: Asset, light: Environment | None) -> Asset:
    """A copy without its light."""
    s, m = capture.surfels, capture.mesh
    surfels = replace(s, albedo=s.albedo.copy(), roughness=s.roughness.copy(), metallic=s.metallic.copy())
    mesh = replace(m, albedo=m.albedo.copy(), roughness=m.roughness.copy(), metallic=m.metallic.copy())
    asset = Asset(surfels, mesh, capture.binding, light, {})
    remove_light(asset)
    return asset


def error(albedo: Array, truth: Array, weight: Array) -> tuple[float, float]:
    """Root mean square error of an albedo after the best factor, and as it is."""
    weight = weight[:, None]
    factor = (weight * albedo * truth).sum() / (weight * albedo**2).sum()
    both = [(weight * (k * albedo - truth) ** 2).sum() / (3 * weight.sum()) for k in (factor, 1.0)]
    return float(np.sqrt(both[0])), float(np.sqrt(both[1]))


def picture(asset: Asset, under: Path, folder: Path) -> Array:
    """A picture of it under another light."""
    write_asset(folder / "a.drgs", asset)
    size = ["--size", "192", "--samples", "48", "--seed", "1", "--transparent"]
    if drgs(["-q", "relight", str(folder / "a.drgs"), "--env", str(under), "--out", str(folder / "a.exr"), *size]):
        raise SystemExit("it could not be rendered")
    return read_exr(folder / "a.exr", alpha=True)[0]


def likeness(found: Array, true: Array) -> float:
    """PSNR of a picture on the object, encoded as sRGB, after the best factor."""
    inside = true[..., 3] > 0.5
    a, b = found[inside][:, :3], true[inside][:, :3]
    a = a * (a * b).sum() / (a * a).sum()
    apart = linear_to_srgb(np.clip(a, 0, 1)) - linear_to_srgb(np.clip(b, 0, 1))
    return float(-10 * np.log10(np.mean(apart**2)))


def main() -> None:
    """Measure and write the section."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--objects", nargs="+", default=["spot", "cat", "robot"])
    parser.add_argument("--lights", nargs="+", default=["city", "sunset", "studio"])
    parser.add_argument("--under", default="forest")
    args = parser.parse_args()
    under, rows, seconds = LIGHTS / f"{args.under}.hdr", [], []
    sums: dict[str, list[tuple[float, float, float]]] = {}
    for name in args.objects:
        truth = subject(name)
        weight = truth.surfels.opacity * truth.surfels.scale.prod(axis=1)
        with tempfile.TemporaryDirectory() as folder:
            true = picture(truth, under, Path(folder))
            for light in args.lights:
                environment = read_environment(LIGHTS / f"{light}.hdr")
                capture = photographed(truth, environment)
                begun = time.perf_counter()
                unknown = delit(capture, None)
                seconds.append(time.perf_counter() - begun)
                ways = {
                    "known environment": delit(capture, environment),
                    "estimated": unknown,
                    "colours as albedo": capture,
                }
                cells: list[object] = [name, light]
                for way, asset in ways.items():
                    found = (
                        *error(asset.surfels.albedo, truth.surfels.albedo, weight),
                        likeness(picture(asset, under, Path(folder)), true),
                    )
                    sums.setdefault(way, []).append(found)
                    cells += [f"{found[0]:.3f} ({found[1]:.3f})", f"{found[2]:.1f}"]
                rows.append(cells)
                print(*cells, flush=True)
    means = [np.mean(values, axis=0) for values in sums.values()]
    rows.append(["**mean**", "", *(c for m in means for c in (f"**{m[0]:.3f}** ({m[1]:.3f})", f"**{m[2]:.1f}**"))])
    body = (
        "Albedo: root mean square error after the one factor that fits best, since the brightness of the light is "
        "unknown (in brackets without it: the brightest tenth gets .8, under an estimated light .5). Relit: PSNR of "
        f"the object's picture under {args.under}, after the best factor. Captures are taken for rough (.5) and no "
        "metal. The cat is mostly metal: its relit pictures gain nothing, even where the light is known. Finding the "
        f"light and removing it took {np.median(seconds):.0f} s in the median, on a machine that did other work."
    )
    columns = ["object", "light", *(c for way in sums for c in (f"{way}: albedo", "relit"))]
    write_section("delight", "Albedo without the light of the capture", f"{body}\n\n{table(columns, rows)}")


if __name__ == "__main__":
    main()
