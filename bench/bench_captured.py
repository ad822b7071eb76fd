"""Splats shown as captured against gsplat's reference renderers of 3DGS and 2DGS, on the same files.

pip install gsplat                     # its torch code runs on the CPU, nothing is compiled
python bench/bench_captured.py [FILE.ply ...] [--size 200] [--places 4] [--views 3]

Files are those of 3DGS (three scales) or 2DGS (two); without any, examples/playbot/playbot.ply, which is of 2DGS.

Projection, spherical harmonics and the opacity at each pixel are gsplat's; the order, the limits of opacity and the
blending, which gsplat leaves to CUDA and to another package, are those of the published renderers, in `render_weight`.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import types
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from bench_composed import show
from judge import decibels
from report import OUT, ROOT, table, write_section

from drgs_blender.core.color import linear_to_srgb, srgb_to_linear
from drgs_blender.formats.exr import read_exr

Array = np.ndarray

PLAYBOT = ROOT / "examples" / "playbot" / "playbot.ply"
#: Sides of the squares in pixels, and splats, that are blended at once.
TILE, CHUNK = 8, 128
#: Of the published renderers: opacity below which a splat is skipped, the most that counts, what ends a ray (here all
#: rays of a square, a difference of that much).
LEAST, MOST, STOP = 1 / 255, 0.99, 1e-4


@dataclass(frozen=True, slots=True)
class Cloud:
    """A file of splats as gsplat takes it: float32 tensors."""

    means: torch.Tensor
    quats: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    harmonics: torch.Tensor
    is_2dgs: bool


def read(path: Path) -> Cloud:
    """A PLY file of 3DGS or 2DGS, read without our own reader."""
    data = path.read_bytes()
    head, _, body = data.partition(b"end_header\n")
    words = [line.split() for line in head.decode("ascii").splitlines()]
    count = next(int(w[2]) for w in words if w[:2] == ["element", "vertex"])
    properties = [w[1:] for w in words if w[0] == "property"]
    names = [name for _, name in properties]
    if ["format", "binary_little_endian", "1.0"] not in words or {kind for kind, _ in properties} != {"float"}:
        raise SystemExit(f"{path}: not a binary PLY file of floats; `drgs convert` writes one")
    values = np.frombuffer(body, "<f4", count * len(names)).reshape(count, len(names))
    column = dict(zip(names, values.T, strict=True))

    def columns(prefix: str) -> Array:
        found = sorted((name for name in names if name.startswith(prefix)), key=lambda n: int(n[len(prefix) :]))
        return np.stack([column[name] for name in found], -1) if found else np.zeros((count, 0), np.float32)

    scales = np.exp(columns("scale_"))
    is_2dgs = scales.shape[1] == 2
    rest = columns("f_rest_").reshape(count, 3, -1).transpose(0, 2, 1)
    arrays = (
        np.stack([column[name] for name in "xyz"], -1),
        columns("rot_"),
        np.column_stack([scales, np.ones(count)]) if is_2dgs else scales,
        1 / (1 + np.exp(-column["opacity"])),
        np.concatenate([columns("f_dc_")[:, None], rest], axis=1),
    )
    return Cloud(*(torch.from_numpy(np.array(a, np.float32)) for a in arrays), is_2dgs)


def render_weight(alphas: torch.Tensor, ray_indices: torch.Tensor, n_rays: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Weights of all splats of the same number of rays, front to back, and transmittances; in place of nerfacc's."""
    rays = 1 + int((ray_indices[1:] != ray_indices[:-1]).sum())
    alphas = alphas.reshape(rays, -1).clamp_max(MOST)
    alphas = torch.where(alphas < LEAST, torch.zeros_like(alphas), alphas)
    after = torch.cumprod(1 - alphas, dim=1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=1)
    return (before * alphas).reshape(-1), before.reshape(-1)


def accumulate_rays(
    weights: torch.Tensor, values: torch.Tensor | None, ray_indices: torch.Tensor, n_rays: int
) -> torch.Tensor:
    """Sums of weighted values (of the weights without any) of each ray; in place of nerfacc's."""
    given = weights[:, None] if values is None else weights[:, None] * values
    return torch.zeros((n_rays, given.shape[1])).index_add_(0, ray_indices, given)


def gsplat() -> tuple[Any, Any]:
    """gsplat's torch modules of 3DGS and of 2DGS."""
    # Their blending imports a package that compiles CUDA; the two functions that it takes from there are above.
    stand_in = types.ModuleType("nerfacc")
    stand_in.render_weight_from_alpha, stand_in.accumulate_along_rays = render_weight, accumulate_rays  # type: ignore
    sys.modules["nerfacc"] = stand_in
    try:
        from gsplat.cuda import _torch_impl, _torch_impl_2dgs
    except ImportError as problem:
        raise SystemExit(f"gsplat cannot be imported ({problem}); run `pip install gsplat`") from problem
    return _torch_impl, _torch_impl_2dgs


def theirs(cloud: Cloud, camera: dict[str, Any], place: tuple[float, float]) -> Array:
    """(h, w, 4) over black: colours of the display, and opacity, at a place of each pixel, (0.5, 0.5) its centre."""
    of_3dgs, of_2dgs = gsplat()
    size = camera["width"]
    pose = torch.tensor(camera["matrix_world"], dtype=torch.float32)
    view = torch.linalg.inv(pose @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])))[None]
    middle = [size / 2 + 0.5 - p for p in place]
    lens = torch.tensor([[[camera["fx"], 0, middle[0]], [0, camera["fy"], middle[1]], [0, 0, 1]]])
    degree = int(np.sqrt(cloud.harmonics.shape[1])) - 1
    colours = of_3dgs._spherical_harmonics(degree, cloud.means - pose[:3, 3], cloud.harmonics)
    colours = (colours + 0.5).clamp_min(0)[None]
    if cloud.is_2dgs:
        given = cloud.means, cloud.quats, cloud.scales, view, lens, size, size
        radii, means, depths, shape, normals = of_2dgs._fully_fused_projection_2dgs(*given)
        accumulate = of_2dgs.accumulate_2dgs
    else:
        covariances, _ = of_3dgs._quat_scale_to_covar_preci(cloud.quats, cloud.scales, compute_preci=False)
        radii, means, depths, shape, _ = of_3dgs._fully_fused_projection(
            cloud.means, covariances, view, lens, size, size
        )
        normals, accumulate = None, of_3dgs.accumulate
    order = torch.argsort(depths[0], stable=True)
    order = order[(radii[0, order] > 0).all(-1)]
    low, high = (means[0] + sign * (radii[0] + 1) for sign in (-1, 1))
    opacities, picture = cloud.opacities[None], torch.zeros((size * size, 4))
    for y in range(0, size, TILE):
        for x in range(0, size, TILE):
            corner = torch.tensor([x, y])
            near = order[((high[order] > corner) & (low[order] < corner + TILE)).all(-1)]
            if not len(near):
                continue
            rows, cols = torch.arange(y, min(y + TILE, size)), torch.arange(x, min(x + TILE, size))
            pixels = (rows[:, None] * size + cols).reshape(-1)
            left = torch.ones(len(pixels), 1)
            for some in near.split(CHUNK):
                pairs = some.repeat(len(pixels)), pixels.repeat_interleave(len(some))
                images = torch.zeros_like(pairs[0])
                given = means, shape, opacities, colours, normals, *pairs, images, size, size
                shown = torch.cat(accumulate(*(a for a in given if a is not None))[:2], -1).reshape(-1, 4)[pixels]
                picture[pixels] += left * shown
                left = left * (1 - shown[:, 3:])
                if left.max() < STOP:
                    break
    return picture.reshape(size, size, 4).numpy()


def views(cloud: Cloud, size: int, count: int) -> list[dict[str, Any]]:
    """Cameras around the middle of a cloud, as CAM.json; captures mostly have Y down."""
    means = cloud.means.numpy().astype(np.float64)
    centre = np.median(means, axis=0)
    radius = np.quantile(np.linalg.norm(means - centre, axis=1), 0.95)
    up, cameras = np.array([0.0, -1.0, 0.0]), []
    for i in range(count):
        angle = 2 * np.pi * (i + 0.15) / count
        back = np.array([np.sin(angle), -0.35, np.cos(angle)])
        back /= np.linalg.norm(back)
        right = np.cross(up, back)
        right /= np.linalg.norm(right)
        matrix = np.eye(4)
        matrix[:3] = np.column_stack([right, np.cross(back, right), back, centre + 3.2 * radius * back])
        focal = 1.4 * size
        cameras.append({"matrix_world": matrix.tolist(), "width": size, "height": size, "fx": focal, "fy": focal})
    return cameras


def ours(path: Path, camera: dict[str, Any], samples: int, folder: Path) -> Array:
    """(h, w, 4) linear, premultiplied: what `drgs relight --captured` shows of the file."""
    drgs, asset = [sys.executable, "-m", "drgs_blender.cli.main"], folder / f"{path.stem}.drgs"
    if not asset.exists():
        command = [*drgs, "import", str(path), "--no-mesh", "--up", "z", "--out", str(asset)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    (folder / "camera.json").write_text(json.dumps(camera | {"clip_start": 0.01}))
    out = folder / "picture.exr"
    words = ["--samples", str(samples), "--subpixel-samples", str(samples), "--filter-width", "0", "--transparent"]
    command = [*drgs, "relight", str(asset), "--captured", "--camera", str(folder / "camera.json"), *words]
    subprocess.run([*command, "--out", str(out)], check=True, stdout=subprocess.DEVNULL)
    return read_exr(out, alpha=True)[0]


def to_light(shown: Array) -> Array:
    """Linear premultiplied light of premultiplied colours of the display."""
    alpha = shown[..., 3:]
    return np.concatenate([srgb_to_linear(shown[..., :3] / np.maximum(alpha, 1e-9)) * alpha, alpha], -1)


def to_display(light: Array) -> Array:
    """The reverse of `to_light`."""
    alpha = light[..., 3:]
    return np.concatenate([linear_to_srgb(light[..., :3] / np.maximum(alpha, 1e-9)) * alpha, alpha], -1)


def difference(a: Array, b: Array, where: Array) -> float:
    """PSNR in dB of colours of the display."""
    return decibels(float(((a - b)[where][:, :3] ** 2).mean()))


def measure(path: Path, options: argparse.Namespace, folder: Path) -> tuple[Any, ...]:
    """A file's line of the table."""
    cloud = read(path)
    found = []
    n = options.places
    for index, camera in enumerate(views(cloud, options.size, options.views)):
        picture = to_display(ours(path, camera, 4 * n * n, folder))
        centres = theirs(cloud, camera, (0.5, 0.5))
        places = [((i + 0.5) / n, (k + 0.5) / n) for i in range(n) for k in range(n)]
        mean = to_display(np.mean([to_light(theirs(cloud, camera, place)) for place in places], axis=0))
        where = mean[..., 3] > LEAST
        found.append((difference(picture, mean, where), difference(picture, centres, where)))
        print(path.name, index, *found[-1], flush=True)
        show(to_light(picture), to_light(mean), OUT / f"captured-{path.stem}-{index}.png")
    worst = np.min(found, axis=0)
    kind = "2DGS" if cloud.is_2dgs else "3DGS"
    degree = int(np.sqrt(cloud.harmonics.shape[1])) - 1
    return path.name, kind, f"{len(cloud.means):,}", degree, *(f"{decibel:.1f}" for decibel in worst)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=Path, nargs="*", default=[PLAYBOT], metavar="FILE.ply")
    parser.add_argument("--size", type=int, default=200)
    parser.add_argument("--places", type=int, default=4, help="of a pixel, along each side")
    parser.add_argument("--views", type=int, default=3)
    options = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)  # of the small squares: more only wait for each other
    with tempfile.TemporaryDirectory() as folder:
        rows = [measure(path, options, Path(folder)) for path in options.files]
    columns = ("File", "Renderer", "Splats", "SH degree", "Mean over pixels, dB", "Centres of pixels, dB")
    write_section(
        "captured",
        "Splats as captured against gsplat",
        f"`drgs relight --captured`, {4 * options.places**2} sub-pixel samples and a box filter, against gsplat's "
        f"torch reference of 3DGS and 2DGS on the same file, not in its antialiased mode. It differs from the "
        f"published renderers in opacities up to 0.999 (here at most {MOST}, as there), in splats that reach 3.33 "
        f"standard deviations (there 3, rounded up to tiles) and in its near plane. {options.size} x {options.size} "
        f"pixels, the worst of {options.views} views; PSNR of the display's colours over black where splats are. "
        f"*Mean over pixels*: gsplat's pictures of {options.places} x {options.places} places in each pixel, decoded "
        "and averaged as ours are. *Centres of pixels*: its own one picture, which is not anti-aliased."
        "\n\n" + table(columns, rows),
    )


if __name__ == "__main__":
    main()
