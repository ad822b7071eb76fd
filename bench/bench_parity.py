"""Engine against Cycles: the same mesh, vertex materials, HDRI and camera, both converged.

python bench/bench_parity.py [--size 256] [--samples 1024] [--rays 4096]
"""

from __future__ import annotations

import argparse

import numpy as np
from judge import environments, foreground, frame_camera, psnr, run_cycles
from ours import relight
from report import OUT, table, write_section
from subjects import spread_asset

MESHES = ("spot", "cat", "robot")
LIGHTS = ("city", "studio", "sunset")
BOUNCES = 3
#: Strength of the world: low enough that hardly a pixel is clipped, where any two renderers agree.
STRENGTH = 0.35


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--samples", type=int, default=1024)
    parser.add_argument("--rays", type=int, default=4096)
    parser.add_argument("--meshes", nargs="+", default=MESHES)
    parser.add_argument("--lights", nargs="+", default=LIGHTS)
    options = parser.parse_args()
    cases = []
    for mesh in options.meshes:
        drgs, npz = spread_asset(mesh)
        with np.load(npz) as data:
            camera = frame_camera(data["vertices"], options.size, azimuth=-60, fill=1.0)
        for light in options.lights:
            for deform in (False, True):
                stem = OUT / f"parity-{mesh}-{light}-{'bent' if deform else 'rest'}"
                job = {
                    "mesh": str(npz), "environment": str(environments() / f"{light}.exr"), "camera": camera,
                    "samples": options.samples, "bounces": BOUNCES, "deform": deform, "strength": STRENGTH,
                    "out": str(stem) + ".npy", "vertices_out": str(stem) + "-vertices.npy",
                }  # fmt: skip
                cases.append((mesh, light, deform, drgs, job))
    run_cycles([case[-1] for case in cases], "parity")
    scores: dict[tuple[str, str], dict[bool, float]] = {}
    clipped: list[float] = []
    for mesh, light, deform, drgs, job in cases:
        theirs = np.load(job["out"])
        ours = relight(
            drgs, job["environment"], job["camera"], rays=options.rays, vertices=np.load(job["vertices_out"]),
            primary="mesh", aa=16, bounces=BOUNCES, strength=STRENGTH,
        )["Combined"]  # fmt: skip
        np.save(job["out"].replace(".npy", "-ours.npy"), ours)
        mask = foreground(theirs[..., 3]) & foreground(ours[..., 3])
        clipped.append(float((theirs[mask][:, :3] >= 1).all(axis=1).mean()))
        scores.setdefault((mesh, light), {})[deform] = psnr(ours, theirs, mask)
    rows = [(m, l, f"{s[False]:.2f}", f"{s[True]:.2f}", f"{s[True] - s[False]:+.2f}") for (m, l), s in scores.items()]
    rest = [s[False] for s in scores.values()]
    bent = [s[True] for s in scores.values()]
    body = (
        f"Foreground PSNR in sRGB (mask eroded by 2 px), {options.size}x{options.size}, Cycles of bpy 5.0.1 at "
        f"{options.samples} spp (Principled, GGX), ours `--primary mesh --aa 16` at {options.rays} rays, "
        f"{BOUNCES} bounces in both; {np.mean(clipped):.1%} of the pixels are clipped to white.\n"
        "Bent: two-bone armature and a shape key, evaluated by Blender.\n\n"
        + table(("Mesh", "HDRI", "Rest dB", "Bent dB", "Difference dB"), rows)
        + f"\n\nRest: mean {np.mean(rest):.2f} dB, lowest {min(rest):.2f} dB. "
        f"Bent: mean {np.mean(bent):.2f} dB, lowest {min(bent):.2f} dB; "
        f"worst change {min(b - r for b, r in zip(bent, rest)):+.2f} dB."
    )
    write_section("parity", "Parity with Cycles", body)


if __name__ == "__main__":
    main()
