"""Does a sequence under a light that turns flicker? Noisy, denoised one by one, over time, and in a window.

python bench/bench_flicker.py [--frames 8] [--size 256] [--rays 32] [--reference 1024] [--step 1]
"""

from __future__ import annotations

import argparse

import numpy as np
from flicker import flicker
from judge import environments, foreground, frame_camera, psnr
from ours import SESSION, pinhole
from report import table, write_section
from subjects import asset_path

from drgs_blender.asset.container import read_asset
from drgs_blender.formats.registry import read_environment
from drgs_blender.frame import Frame, ObjectState, RenderSettings, World, split_rays
from drgs_blender.render import pipeline
from drgs_blender.render.picture.denoise import denoise
from drgs_blender.render.picture.film import Film
from drgs_blender.render.picture.motion import Motion
from drgs_blender.render.picture.oidn import available, denoise_oidn
from drgs_blender.render.picture.temporal import REACH, Shot, denoise_next, window

Array = np.ndarray


class KeptFilm(Film):
    """A film that can be found again after the picture was made."""

    last: Film

    def __init__(self, *arguments: object) -> None:
        super().__init__(*arguments)  # type: ignore[arg-type]
        KeptFilm.last = self


def shots(options: argparse.Namespace, environment: str, rays: int) -> list[Shot]:
    """The sequence: the world turns about the vertical axis, all else stands still."""
    path = asset_path("cat", max_triangles=82000)
    key = SESSION.load_asset(path)
    radiance = read_environment(environments() / f"{environment}.exr").radiance
    camera = pinhole(frame_camera(read_asset(path).mesh.vertices, options.size, azimuth=-60, fill=0.66))
    out = []
    for number in range(options.frames):
        a = np.radians(options.step * number)
        turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        settings = RenderSettings(*split_rays(rays), film_transparent=True, aa=4)
        SESSION.render(Frame(number, camera, [ObjectState("cat", key)], World(radiance, turn), settings))
        film = KeptFilm.last
        still = Motion(np.zeros((*film.coverage.shape, 2), np.float32), film.position.copy())
        out.append(Shot(film.components, film.variance, film.guides(), still))
    return out


def one_by_one(noisy: list[Shot]) -> list[Array]:
    return [denoise(s.components, s.variance, s.guides, split=False) for s in noisy]


def over_time(noisy: list[Shot]) -> list[Array]:
    out, history = [], None
    for s in noisy:
        picture, history = denoise_next(s, history, split=False)
        out.append(picture)
    return out


def in_windows(noisy: list[Shot]) -> list[Array]:
    padded = [None] * REACH + noisy + [None] * REACH
    return [window(padded[k : k + 2 * REACH + 1], split=False) for k in range(len(noisy))]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--rays", type=int, default=32)
    parser.add_argument("--reference", type=int, default=1024)
    parser.add_argument("--step", type=float, default=1.0, help="degrees a frame")
    options = parser.parse_args()
    pipeline.Film = KeptFilm  # type: ignore[misc]
    rows = []
    for environment in ("city", "studio"):
        noisy = shots(options, environment, options.rays)
        truth = np.stack([s.components.sum(2) for s in shots(options, environment, options.reference)])
        mask = np.stack([foreground(s.guides.coverage, 1) for s in noisy])
        rest = flicker(truth, mask)
        ways: dict[str, list[Array]] = {
            "noisy": [s.components for s in noisy],
            "SVGF, each frame alone": one_by_one(noisy),
            "SVGF, over time": over_time(noisy),
            "SVGF, window of 5": in_windows(noisy),
        }
        if available():
            ways["OIDN, each frame alone"] = [denoise_oidn(s.components, s.guides, split=False) for s in noisy]
        for name, pictures in ways.items():
            shown = np.stack([p.sum(2) for p in pictures])
            later = [psnr(a, b, m) for a, b, m in zip(shown[2:], truth[2:], mask[2:])]
            rows.append((environment, name, f"{1e3 * (flicker(shown, mask) - rest):.2f}", f"{np.mean(later):.2f}"))
    body = (
        f"cat, {options.size}x{options.size}, {options.rays} rays, {options.frames} frames, the world turns "
        f"{options.step:g} degree(s) a frame. Flicker: mean absolute second difference in time of sRGB luminance, less "
        f"that of {options.reference} rays, in thousandths. PSNR: against {options.reference} rays, foreground, sRGB, "
        "from the third frame on.\n\n" + table(("World", "Denoiser", "Flicker", "PSNR, dB"), rows)
    )
    write_section("flicker", "Flicker under a light that turns", body)


if __name__ == "__main__":
    main()
