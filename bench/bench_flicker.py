"""Does a sequence under a light that turns flicker? Noisy, denoised one by one, over time, and in a window; and Cycles.

python bench/bench_flicker.py [--frames 8] [--size 256] [--samples 32] [--reference 1024] [--steps 1 4]
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from flicker import flicker
from judge import environments, foreground, frame_camera, psnr, run_cycles
from ours import SESSION, pinhole
from report import OUT, table, write_section
from subjects import asset_path, save_mesh

from drgs_blender.cli import frame_store
from drgs_blender.cli.main import main as drgs
from drgs_blender.core.asset.container import read_asset
from drgs_blender.core.frame import Frame, MotionStep, ObjectState, RenderSettings, World
from drgs_blender.core.passes import TEMPORAL
from drgs_blender.formats.registry import read_environment
from drgs_blender.render.denoise.oidn import available
from drgs_blender.render.film.frame_files import read_frame

Array = np.ndarray

FOLDER = OUT / "flicker"
TRIANGLES = 82000


def frames(options: argparse.Namespace, step: float, environment: str) -> list[Frame]:
    """The sequence: the world turns about the vertical axis, all else stands still."""
    path = asset_path("cat", max_triangles=TRIANGLES)
    key = SESSION.load_asset(path)
    radiance = read_environment(environments() / f"{environment}.exr").radiance
    camera = pinhole(frame_camera(read_asset(path).mesh.vertices, options.size, azimuth=-60, fill=0.66))
    settings = RenderSettings(options.samples, film_transparent=True)
    out = []
    for number in range(options.frames):
        a = np.radians(step * number)
        turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        world = World(radiance, turn)
        out.append(
            Frame(number, camera, [ObjectState("cat", key)], world, settings, previous=MotionStep(camera, [None]))
        )
    return out


def rendered(sequence: list[Frame], history: str = "", **settings: object) -> list[Array]:
    """(h, w, 3) pictures of the sequence with some settings changed."""
    out = []
    for frame in sequence:
        changed = replace(frame, settings=replace(frame.settings, **settings), history=history)  # type: ignore[arg-type]
        out.append(SESSION.render(changed)["Combined"][..., :3])
    return out


def jobs_of(options: argparse.Namespace, step: float, environment: str) -> list[dict[str, Any]]:
    """The same sequence for Cycles, each frame with noise of its own."""
    mesh, npz = read_asset(asset_path("cat", max_triangles=TRIANGLES)).mesh, FOLDER / "cat.npz"
    FOLDER.mkdir(parents=True, exist_ok=True)
    save_mesh(npz, mesh)
    shared = {
        "mesh": str(npz), "environment": str(environments() / f"{environment}.exr"), "bounces": 1,
        "camera": frame_camera(mesh.vertices, options.size, azimuth=-60, fill=0.66),
    }  # fmt: skip
    return [
        shared | {"rotation_z": step * k, "seed": k, "out": str(FOLDER / f"{environment}-{step:g}-{k}.npy")}
        for k in range(options.frames)
    ]


def by_cycles(jobs: list[dict[str, Any]], samples: int, denoise: bool = False) -> Array:
    """(n, h, w, 4) pictures of `jobs_of` a sequence."""
    run_cycles([job | {"samples": samples, "denoise": denoise} for job in jobs], "flicker")
    return np.stack([np.load(job["out"]) for job in jobs])


def rows_of(ways: dict[str, Array], truth: Array, mask: Array) -> list[tuple[str, ...]]:
    """Cells of each way: flicker of its error and beyond the converged sequence's, PSNR from the third frame on."""
    rest, rows = flicker(truth, mask), []
    for name, shown in ways.items():
        later = [psnr(a, b, m) for a, b, m in zip(shown[2:], truth[2:], mask[2:])]
        error = flicker(shown, mask, converged=truth)
        beyond = flicker(shown, mask) - rest
        rows.append((name, f"{1e3 * error:.2f}", f"{1e3 * beyond:.2f}", f"{np.mean(later):.2f}"))
    return rows


def in_windows(sequence: list[Frame]) -> tuple[list[Array], list[Array], list[Array]]:
    """Noisy pictures, those of ``drgs denoise`` on the files of these, and coverage."""
    with tempfile.TemporaryDirectory() as folder:
        noisy, clean = (str(Path(folder) / name / "####.exr") for name in ("noisy", "clean"))
        Path(noisy).parent.mkdir()
        pictures, coverage = [], []
        for frame in sequence:
            passes = SESSION.render(replace(frame, passes=TEMPORAL))
            path = Path(noisy.replace("####", f"{frame.noise_index:04d}"))
            frame_store.save(path, passes, frame, frame.noise_index, "")
            pictures.append(passes["Combined"][..., :3])
            coverage.append(passes["Coverage"][..., 0])
        numbers = f"0-{len(sequence) - 1}"
        code = drgs(["denoise", noisy, "--frames", numbers, "--out", clean, "--passes", "Combined"])
        if code:
            raise SystemExit(code)
        found = [read_frame(clean.replace("####", f"{f.noise_index:04d}"))[0]["Combined"][..., :3] for f in sequence]
    return pictures, found, coverage


def compared(options: argparse.Namespace, step: float, environment: str) -> list[tuple[str, ...]]:
    """Rows of one sequence, ours and those of Cycles."""
    sequence = frames(options, step, environment)
    noisy, windows, coverage = in_windows(sequence)
    # As many positions as there can be: those of few differ from frame to frame, which is flicker of ours.
    truth, again = (
        np.stack(rendered(sequence, samples=options.reference, subpixel_samples=64, seed=seed)) for seed in (1000, 2000)
    )
    mask = np.stack([foreground(c, 1) for c in coverage])
    ways: dict[str, list[Array]] = {
        "converged, another seed": list(again),
        "noisy": noisy,
        "SVGF, each frame alone": rendered(sequence, denoise="svgf"),
        "SVGF, over time": rendered(sequence, f"{environment} {step}", denoise="svgf"),
        "SVGF, window of 5": windows,
    }
    if available():
        ways["OIDN, each frame alone"] = rendered(sequence, denoise="oidn")
    rows = rows_of({name: np.stack(pictures) for name, pictures in ways.items()}, truth, mask)
    jobs = jobs_of(options, step, environment)
    theirs = by_cycles(jobs, options.reference)
    mask = np.stack([foreground(picture[..., 3], 1) for picture in theirs])
    cycles = {
        "Cycles: noisy": by_cycles(jobs, options.samples),
        "Cycles: OIDN, each frame alone": by_cycles(jobs, options.samples, denoise=True),
    }
    return [(f"{step:g}", environment, *row) for row in rows + rows_of(cycles, theirs, mask)]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--samples", type=int, default=32)
    parser.add_argument("--reference", type=int, default=1024)
    parser.add_argument("--steps", type=float, nargs="+", default=[1.0, 4.0], help="degrees a frame")
    options = parser.parse_args()
    rows: list[tuple[str, ...]] = []
    for step, environment in itertools.product(options.steps, ("city", "studio")):
        rows += compared(options, step, environment)
    columns = ("Degrees", "World", "Denoiser", "Flicker of the error", "beyond the converged", "PSNR, dB")
    body = (
        f"cat, {options.size}x{options.size}, {options.samples} samples, {options.frames} frames, the world turns "
        "by the degrees of the first column per frame. Flicker: mean absolute second difference in time of sRGB "
        f"luminance, in thousandths: of the error, which is the difference from {options.reference} rays at "
        f"64 places of a pixel, and of the picture, less that of the converged sequence, which blur lowers. PSNR: "
        f"against {options.reference} rays, "
        "foreground, sRGB, from the third frame on. Cycles: as many samples a pixel, against its own converged "
        "sequence.\n\n" + table(columns, rows)
    )
    write_section("flicker", "Flicker under a light that turns", body)


if __name__ == "__main__":
    main()
