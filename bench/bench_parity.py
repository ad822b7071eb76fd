"""Engine against Cycles: the same mesh, vertex materials, HDRI and camera, both converged.

python bench/bench_parity.py [--size 256] [--seeds 4] [--spp 1024] [--samples 4096]

Every picture is rendered `seeds` times by either program with independent random numbers. Their means are compared as
they are, and what differs between the programs is separated from the noise of both, see `judge.systematic_error`: a sun
that a polished leg mirrors onto a matte one reaches one path in 10^5 or so, and ten pixels of such luck can decide the
dB of a whole picture.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import Any

import numpy as np
from judge import (
    cycles_pictures,
    decibels,
    environments,
    foreground,
    frame_camera,
    psnr,
    systematic_error,
    without_noise,
)
from ours import relight
from report import OUT, table, write_section
from subjects import spread_asset

MESHES = ("spot", "cat", "robot")
LIGHTS = ("city", "studio", "sunset")
BOUNCES = 3
#: Strength of the world: low enough that hardly a pixel is clipped, where any two renderers agree.
STRENGTH = 0.35


@dataclass
class Score:
    """How far the programs are apart in one pose; errors are mean squares in sRGB."""

    plain: float  # of the means over all seeds, dB
    error: float  # that is left without the noise of either program
    deviation: float  # standard error of `error`
    noise: float  # what the noise of both programs adds to the error of the means
    cycles: float  # PSNR between two single pictures of Cycles, dB
    clipped: float  # share of the pixels that are white in Cycles

    @property
    def bound(self) -> float:
        """Upper 95 % bound of `error`."""
        return max(self.error, 0.0) + 2 * self.deviation

    def __str__(self) -> str:
        """`error` in dB; where it cannot be distinguished from zero, what it is better than."""
        return without_noise(self.error, self.deviation)


def score(ours: np.ndarray, theirs: np.ndarray) -> Score:
    """Compare (k, h, w, 4) pictures of k seeds each."""
    mask = foreground(theirs[..., 3].min(0)) & foreground(ours[..., 3].min(0))
    error, deviation = systematic_error(ours, theirs, mask)
    plain = psnr(ours.mean(0), theirs.mean(0), mask)
    k = len(ours)
    between = [psnr(theirs[i], theirs[j], mask) for i in range(k) for j in range(i)]
    clipped = float((theirs.mean(0)[mask][:, :3] >= 1).all(axis=1).mean())
    noise = max(10 ** (-plain / 10) - error, 0.0)
    return Score(plain, error, deviation, noise, float(np.mean(between)), clipped)


def pictures(options: argparse.Namespace, mesh: str, light: str, bent: bool) -> tuple[Any, list[dict[str, Any]]]:
    """(our asset, jobs for Cycles, one a seed) of a case."""
    drgs, npz = spread_asset(mesh)
    with np.load(npz) as data:
        camera = frame_camera(data["vertices"], options.size, azimuth=-60, fill=1.0)
    stem = OUT / f"parity-{mesh}-{light}-{'bent' if bent else 'rest'}"
    jobs = [
        {
            "mesh": str(npz), "environment": str(environments() / f"{light}.exr"), "camera": camera,
            "samples": options.spp, "bounces": BOUNCES, "deform": bent, "strength": STRENGTH, "seed": seed,
            # Not physics: it lights what the mesh itself shadows, and both programs are to solve the same scene.
            "terminator_offset": 0.0,
            "out": f"{stem}-{seed}.npy", "vertices_out": f"{stem}-vertices.npy",
        }
        for seed in range(options.seeds)
    ]  # fmt: skip
    return drgs, jobs


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--seeds", type=int, default=4, help="independent pictures of either program, at least 2")
    parser.add_argument("--spp", type=int, default=1024, help="of Cycles, a pixel and picture")
    parser.add_argument("--samples", type=int, default=4096, help="of ours, a pixel and picture")
    parser.add_argument("--meshes", nargs="+", default=MESHES)
    parser.add_argument("--lights", nargs="+", default=LIGHTS)
    options = parser.parse_args()
    if options.seeds < 2:
        parser.error("--seeds: noise can be separated from the rest with two pictures or more")
    names = [(mesh, light, bent) for mesh in options.meshes for light in options.lights for bent in (False, True)]
    cases = {name: pictures(options, *name) for name in names}
    cycles_pictures([job for _, jobs in cases.values() for job in jobs], "parity")
    scores: dict[tuple[str, str], dict[bool, Score]] = {}
    for (mesh, light, bent), (drgs, jobs) in cases.items():
        theirs = np.stack([np.load(job["out"]) for job in jobs])
        vertices = np.load(jobs[0]["vertices_out"])
        ours = np.stack([
            relight(
                drgs, job["environment"], job["camera"], samples=options.samples, vertices=vertices,
                camera_sees="mesh", subpixel_samples=16,
                bounces=BOUNCES, strength=STRENGTH, seed=job["seed"],
            )["Combined"]
            for job in jobs
        ])  # fmt: skip
        np.save(jobs[0]["out"].replace("-0.npy", "-ours.npy"), ours)
        scores.setdefault((mesh, light), {})[bent] = score(ours, theirs)
    write_section("parity", "Parity with Cycles", report(options, scores))


def report(options: argparse.Namespace, scores: dict[tuple[str, str], dict[bool, Score]]) -> str:
    """The text of the section."""
    rows, changes = [], []
    for (mesh, light), pair in scores.items():
        rest, bent = pair[False], pair[True]
        # Rest and bent with the same noise: what the pose itself does to the figure.
        level = 10 ** (-rest.plain / 10)
        change = decibels(max(level + bent.error - rest.error, 1e-12)) - rest.plain
        changes.append(change)
        rows.append((
            mesh, light, f"{rest.plain:.2f}", f"{bent.plain:.2f}", f"{bent.plain - rest.plain:+.2f}", f"{change:+.2f}",
            str(rest), str(bent), f"{rest.cycles:.1f} / {bent.cycles:.1f}",
        ))  # fmt: skip
    rest, bent = ([pair[pose] for pair in scores.values()] for pose in (False, True))
    columns = (
        "Mesh", "HDRI", "Rest dB", "Bent dB", "Bent - rest", "at equal noise", "Rest, no noise", "Bent, no noise",
        "Cycles itself",
    )  # fmt: skip

    def summary(name: str, cases: list[Score]) -> str:
        plain = [s.plain for s in cases]
        return (
            f"{name}: mean {np.mean(plain):.2f} dB, lowest {min(plain):.2f} dB; without noise no case is below "
            f"{decibels(max(s.bound for s in cases)):.1f} dB (95 %)."
        )

    both = rest + bent
    share = np.mean([s.noise * 10 ** (s.plain / 10) for s in both])
    return (
        f"Foreground PSNR in sRGB (mask eroded by 2 px), {options.size}x{options.size}, Cycles of bpy 5.0.1 "
        f"(Principled, GGX) against `--camera-sees mesh --subpixel-samples 16`, {BOUNCES} bounces in both. Each "
        f"picture is the mean of "
        f"{options.seeds} with independent random numbers, of {options.spp} spp and {options.samples} samples; "
        f"{np.mean([s.clipped for s in both]):.1%} of the pixels are clipped to white. Bent: two-bone armature and a "
        "shape key, evaluated by Blender. Cycles' shadow terminator offset is off in both poses.\n\n"
        + table(columns, rows)
        + f"\n\n{summary('Rest', rest)} {summary('Bent', bent)}\n\n"
        f"- Noise of both programs makes {share:.0%} of the plain error, which is why it changes from pose to pose.\n"
        "- *No noise*: what is left when the differences of independent pairs of pictures are multiplied instead of "
        "squared; `>` where that cannot be distinguished from zero, and is better than the figure at 95 %.\n"
        "- *At equal noise*: what the pose itself changes, the bent pose's error without noise put on the noise of "
        f"the rest pose; worst {min(changes):+.2f} dB.\n"
        "- *Cycles itself*: two single pictures of Cycles with different seeds, rest / bent."
    )


if __name__ == "__main__":
    main()
