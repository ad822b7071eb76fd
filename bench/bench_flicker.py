"""Does a sequence flicker? Noisy, denoised frame by frame, over time, and in a window; and Cycles.

python bench/bench_flicker.py [--part turning bending] [--frames 8] [--size 256] [--samples 32] [--reference 1024]
    [--steps 1 4]

In one part the light turns, in the other the object bends. Each writes its own section.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from flicker import flicker, to_frame_before
from judge import environments, foreground, frame_camera, psnr, run_cycles
from ours import SESSION, pinhole
from report import OUT, table, write_section
from scipy.spatial.transform import Rotation
from subjects import asset_path, save_mesh

from drgs_blender.cli import frame_store
from drgs_blender.cli.main import main as drgs
from drgs_blender.core.asset.container import read_asset
from drgs_blender.core.frame import Frame, MotionStep, ObjectState, Pose, RenderSettings, World
from drgs_blender.core.passes import TEMPORAL
from drgs_blender.formats.registry import read_environment
from drgs_blender.render.denoise.oidn import available
from drgs_blender.render.film.frame_files import read_frame

Array = np.ndarray

FOLDER = OUT / "flicker"
TRIANGLES = 82000


@dataclass
class Sequence:
    """The same frames for both programs.

    Attributes
    ----------
    name : str
    frames : list of Frame
    jobs : list of dict
        For cycles_job.py, without samples; each frame has noise of its own.
    vectors : (n, h, w, 2) array, optional
        As `flicker` takes them; None where nothing moves.
    """

    name: str
    frames: list[Frame]
    jobs: list[dict[str, Any]]
    vectors: Array | None = None


def turning(options: argparse.Namespace, step: float, environment: str) -> Sequence:
    """The world turns about the vertical axis, all else stands still."""
    sequence = still(options, environment, f"turning-{step:g}")
    for k, frame in enumerate(sequence.frames):
        turn = Rotation.from_euler("z", step * k, degrees=True).as_matrix()
        frame.world = World(frame.world.environment, turn)
        sequence.jobs[k]["rotation_z"] = step * k
    return sequence


def bending(options: argparse.Namespace, step: float, environment: str) -> Sequence:
    """The cat bends to the side, from upright, the top of its head by `step` degrees each frame; all else stands."""
    sequence = still(options, environment, f"bending-{step:g}")
    mesh, vectors = read_asset(subject()).mesh, []
    for k, frame in enumerate(sequence.frames):
        before, now = (bent(mesh.vertices, step * n) for n in (k - 1, k))
        frame.objects[0].vertices = now
        frame.previous = MotionStep(frame.camera, [Pose("cat", np.eye(4)[None], before)])
        sequence.jobs[k]["mesh"] = str(FOLDER / f"{sequence.name}-{k}.npz")
        save_mesh(Path(sequence.jobs[k]["mesh"]), replace(mesh, vertices=now))
        moved = replace(frame, settings=replace(frame.settings, samples=1), passes=("Vector",))
        vectors.append(to_frame_before(SESSION.render(moved)))
    return replace(sequence, vectors=np.stack(vectors))


def still(options: argparse.Namespace, environment: str, name: str) -> Sequence:
    """Frames and jobs in which nothing moves yet."""
    path, world = subject(), environments() / f"{environment}.exr"
    FOLDER.mkdir(parents=True, exist_ok=True)
    mesh, key = read_asset(path).mesh, SESSION.load_asset(path)
    view = frame_camera(mesh.vertices, options.size, azimuth=-60, fill=0.66)
    camera, radiance = pinhole(view), read_environment(world).radiance
    settings = RenderSettings(options.samples, film_transparent=True, camera_sees="mesh")
    save_mesh(FOLDER / "cat.npz", mesh)
    shared = {"mesh": str(FOLDER / "cat.npz"), "environment": str(world), "bounces": 1, "camera": view}
    shared["terminator_offset"] = 0.0
    frames, jobs = [], []
    for k in range(options.frames):
        rest = MotionStep(camera, [None])
        frames.append(Frame(k, camera, [ObjectState("cat", key)], World(radiance), settings, previous=rest))
        jobs.append(shared | {"seed": k, "out": str(FOLDER / f"{name}-{environment}-{k}.npy")})
    return Sequence(f"{name}-{environment}", frames, jobs)


def subject() -> Path:
    return asset_path("cat", max_triangles=TRIANGLES)


def bent(vertices: Array, degrees: float) -> Array:
    """(n, 3) float32: each point turned about the X axis through the middle of the base, the higher the further."""
    low, high = vertices.min(0), vertices.max(0)
    base = [*((low + high)[:2] / 2), low[2]]
    angles = degrees * (vertices[:, 2] - low[2]) / (high - low)[2]
    turned = Rotation.from_euler("x", angles[:, None], degrees=True)
    return (turned.apply(vertices - base) + base).astype(np.float32)


def rendered(frames: list[Frame], history: str = "", **settings: object) -> list[Array]:
    """(h, w, 3) pictures of the frames with some settings changed."""
    out = []
    for frame in frames:
        changed = replace(frame, settings=replace(frame.settings, **settings), history=history)  # type: ignore[arg-type]
        out.append(SESSION.render(changed)["Combined"][..., :3])
    return out


def by_cycles(jobs: list[dict[str, Any]], samples: int, denoise: bool = False) -> Array:
    """(n, h, w, 4) pictures of the jobs of a sequence."""
    run_cycles([job | {"samples": samples, "denoise": denoise} for job in jobs], "flicker")
    return np.stack([np.load(job["out"]) for job in jobs])


def rows_of(ways: dict[str, Array], truth: Array, mask: Array, vectors: Array | None) -> list[tuple[str, ...]]:
    """Cells of each way: flicker of its error and of the picture, PSNR from the third frame on; first the truth's."""
    rows = [("converged", "-", f"{1e3 * flicker(truth, mask, vectors):.2f}", "-")]
    for name, shown in ways.items():
        later = [psnr(a, b, m) for a, b, m in zip(shown[2:], truth[2:], mask[2:])]
        error, own = flicker(shown, mask, vectors, converged=truth), flicker(shown, mask, vectors)
        rows.append((name, f"{1e3 * error:.2f}", f"{1e3 * own:.2f}", f"{np.mean(later):.2f}"))
    return rows


def in_windows(frames: list[Frame]) -> tuple[list[Array], list[Array], list[Array]]:
    """Noisy pictures, those of ``drgs denoise`` on the files of these, and coverage."""
    with tempfile.TemporaryDirectory() as folder:
        noisy, clean = (str(Path(folder) / name / "####.exr") for name in ("noisy", "clean"))
        Path(noisy).parent.mkdir()
        pictures, coverage = [], []
        for frame in frames:
            passes = SESSION.render(replace(frame, passes=TEMPORAL))
            path = Path(noisy.replace("####", f"{frame.noise_index:04d}"))
            frame_store.save(path, passes, frame, frame.noise_index, "")
            pictures.append(passes["Combined"][..., :3])
            coverage.append(passes["Coverage"][..., 0])
        numbers = f"0-{len(frames) - 1}"
        code = drgs(["denoise", noisy, "--frames", numbers, "--out", clean, "--passes", "Combined"])
        if code:
            raise SystemExit(code)
        found = [read_frame(clean.replace("####", f"{f.noise_index:04d}"))[0]["Combined"][..., :3] for f in frames]
    return pictures, found, coverage


def compared(options: argparse.Namespace, sequence: Sequence) -> list[tuple[str, ...]]:
    """Rows of one sequence, ours and those of Cycles."""
    frames, vectors = sequence.frames, sequence.vectors
    noisy, windows, coverage = in_windows(frames)
    _, doubled, _ = in_windows([replace(f, settings=replace(f.settings, samples=2 * options.samples)) for f in frames])
    # As many positions as there can be: those of few differ from frame to frame, which is flicker of ours.
    truth, again = (
        np.stack(rendered(frames, samples=options.reference, subpixel_samples=64, seed=seed)) for seed in (1000, 2000)
    )
    mask = np.stack([foreground(c, 1) for c in coverage])
    ways: dict[str, list[Array]] = {
        "converged, another seed": list(again),
        "noisy": noisy,
        "SVGF, each frame alone": rendered(frames, denoise="svgf"),
        "SVGF, over time": rendered(frames, sequence.name, denoise="svgf"),
        "SVGF, window of 5": windows,
        f"SVGF, window of 5, {2 * options.samples} samples": doubled,
    }
    if available():
        ways["OIDN, each frame alone"] = rendered(frames, denoise="oidn")
    rows = rows_of({name: np.stack(pictures) for name, pictures in ways.items()}, truth, mask, vectors)
    theirs = by_cycles(sequence.jobs, options.reference)
    mask = np.stack([foreground(picture[..., 3], 1) for picture in theirs])
    cycles = {
        "noisy": by_cycles(sequence.jobs, options.samples),
        "OIDN, each frame alone": by_cycles(sequence.jobs, options.samples, denoise=True),
    }
    return rows + [(f"Cycles: {name}", *cells) for name, *cells in rows_of(cycles, theirs, mask, vectors)]


#: Name of a part -> section, its title, what moves, and its sequences.
PARTS: dict[str, tuple[str, str, str, Callable[[argparse.Namespace, float, str], Sequence]]] = {
    "turning": ("flicker", "Flicker under a light that turns", "the world turns", turning),
    "bending": (
        "flicker-bending",
        "Flicker of an object that bends",
        "the object bends from upright, its top",
        bending,
    ),
}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--part", nargs="+", choices=PARTS, default=list(PARTS), metavar="PART")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--samples", type=int, default=32)
    parser.add_argument("--reference", type=int, default=1024)
    parser.add_argument("--steps", type=float, nargs="+", default=[1.0, 4.0], help="degrees a frame")
    options = parser.parse_args()
    columns = ("Degrees", "World", "Denoiser", "Flicker of the error", "of the picture", "PSNR, dB")
    for section, title, motion, sequence in (PARTS[part] for part in options.part):
        rows: list[tuple[str, ...]] = []
        for step, environment in itertools.product(options.steps, ("city", "studio")):
            rows += [(f"{step:g}", environment, *r) for r in compared(options, sequence(options, step, environment))]
        body = (
            f"cat, the mesh seen by both programs, {options.size}x{options.size}, {options.samples} samples, "
            f"{options.frames} frames, {motion} by the degrees of the first column per frame. Flicker: mean absolute "
            "second difference in time of sRGB luminance on points of the surface, in thousandths: of the error, which "
            f"is the difference from {options.reference} rays at 64 places of a pixel, and of the picture itself, "
            "which in a converged sequence is what moves, and blur lowers. Points that moved lie between pixels, whose "
            "mean they get: noise of single pixels flickers less by that, what is denoised hardly. PSNR: against "
            f"{options.reference} rays, foreground, sRGB, from the third frame on. Cycles: {options.samples} samples, "
            f"each two rays at a surface, as many as {2 * options.samples} samples of ours, against its own converged "
            "sequence.\n\n" + table(columns, rows)
        )
        write_section(section, title, body)


if __name__ == "__main__":
    main()
