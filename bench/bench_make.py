"""Assets of textured files against the files themselves in Cycles: what `drgs make` keeps of textures and normal maps.

python bench/bench_make.py [--size 384] [--seeds 2] [--spp 512] [--samples 512]
"""

from __future__ import annotations

import argparse
import json
import subprocess
from pathlib import Path

import numpy as np
from judge import blender_python, decibels, environments, foreground, frame_camera, systematic_error
from lantern import write_lantern
from ours import relight
from report import OUT, ROOT, table, write_section
from subjects import SOURCES, asset_path

from drgs_blender.core.asset.container import read_asset

FILES = {
    "cat": "cat/egyptian_cat.glb",
    "helmet": "helmet/FlightHelmet.gltf",
    "lantern": str(OUT / "lantern.glb"),
}
BOUNCES, STRENGTH = 2, 0.35
#: Budgets of surfels: none beyond those that density asks for, and the default.
BUDGETS = {"of the mesh's vertices' detail": {"max_surfels": 1}, "default": {}}
_PROGRAM = Path(__file__).with_name("make_job.py")


def main() -> None:
    """Measure and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=384)
    parser.add_argument("--seeds", type=int, default=2, help="independent pictures of either program, at least 2")
    parser.add_argument("--spp", type=int, default=512, help="of Cycles, per pixel and picture")
    parser.add_argument("--samples", type=int, default=512, help="of ours, per pixel and picture")
    options = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    SOURCES["lantern"] = str(write_lantern(OUT / "lantern.glb")), {}
    light = str(environments() / "city.exr")
    jobs, cameras = [], {}
    for name, file in FILES.items():
        cameras[name] = frame_camera(
            read_asset(asset_path(name, textures=True)).mesh.vertices, options.size, azimuth=-60
        )
        jobs += [
            {
                "file": str(ROOT / "examples" / file), "environment": light, "strength": STRENGTH,
                "camera": cameras[name], "samples": options.spp, "bounces": BOUNCES, "seed": seed,
                "out": str(OUT / f"make-{name}-{seed}.npy"),
            }
            for seed in range(options.seeds)
        ]  # fmt: skip
    path = OUT / "make.json"
    path.write_text(json.dumps(jobs))
    subprocess.run([str(blender_python()), str(_PROGRAM), str(path)], check=True, timeout=3000)
    rows = []
    for name in FILES:
        theirs = np.stack([np.load(job["out"]) for job in jobs if f"make-{name}-" in job["out"]])
        for text, more in BUDGETS.items():
            asset, found = asset_path(name, textures=True, **more), []
            for sees in ("surfels", "mesh"):
                ours = np.stack([
                    relight(
                        asset, light, cameras[name], samples=options.samples, subpixel_samples=16, bounces=BOUNCES,
                        strength=STRENGTH, seed=seed, camera_sees=sees,
                    )["Combined"]
                    for seed in range(options.seeds)
                ])  # fmt: skip
                error, _ = systematic_error(ours, theirs, foreground(theirs[..., 3].min(0)))
                found.append(f"{decibels(error):.1f}")
            rows.append([name, text, len(read_asset(asset).surfels), *found])
            print(*rows[-1], flush=True)
    body = (
        "glTF files of examples/ as Blender imports them, in Cycles, against the surfels of `drgs make`, and its mesh: "
        f"{options.size} x {options.size}, HDRI, {BOUNCES} bounces, {options.seeds} seeds of {options.spp} "
        f"and {options.samples} samples. PSNR of the file's foreground in sRGB without the noise of either program.\n\n"
        + table(["file", "surfels", "number", "dB", "dB, Camera Sees: Mesh"], rows)
    )
    write_section("make", "Assets of textured files", body)


if __name__ == "__main__":
    main()
