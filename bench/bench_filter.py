"""Silhouettes and textures against Cycles with its own pixel filter, from surfels and from meshes.

python bench/bench_filter.py [--size 256] [--samples 1024]
"""

from __future__ import annotations

import argparse

import numpy as np
from judge import cycles_pictures, environments, frame_camera, psnr
from ours import relight
from report import OUT, table, write_section
from scipy.ndimage import binary_dilation
from subjects import spread_asset

from drgs_blender.core.asset import Asset, Mesh
from drgs_blender.core.asset.container import write_asset
from drgs_blender.deform.attach import attach

#: Cycles' default.
WIDTH = 1.5
CASES = (("spot", "city"), ("robot", "studio"))
#: Primary, width of our filter, sub-pixel positions.
ROWS = (
    ("mesh", 0.0, 4), ("mesh", WIDTH, 4), ("mesh", 0.0, 16), ("mesh", WIDTH, 16),
    ("surfels", 0.0, 4), ("surfels", WIDTH, 4), ("surfels", 0.0, 16), ("surfels", WIDTH, 16),
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--spp", type=int, default=1024, help="of Cycles")
    parser.add_argument("--samples", type=int, default=1024, help="of ours")
    options = parser.parse_args()
    jobs = {}
    for mesh, light in CASES:
        npz = spread_asset(mesh)[1]
        with np.load(npz) as data:
            shape = Mesh(**data)
        camera = frame_camera(shape.vertices, options.size, azimuth=-60, fill=0.9)
        drgs = OUT / f"filter-{mesh}.drgs"
        surfels, binding, _ = attach(shape)  # with the mesh's own materials
        write_asset(drgs, Asset(surfels, shape, binding, None, {"source": mesh}))
        jobs[mesh] = drgs, {
            "mesh": str(npz), "environment": str(environments() / f"{light}.exr"), "camera": camera, "strength": 0.35,
            "samples": options.spp, "bounces": 1, "terminator_offset": 0.0, "filter_width": WIDTH,
            "out": str(OUT / f"filter-{mesh}.npy"),
        }  # fmt: skip
    cycles_pictures([job for _, job in jobs.values()], "filter")
    rows = []
    for mesh, (drgs, job) in jobs.items():
        theirs = np.load(job["out"])
        cover = theirs[..., 3]
        edge, near = (cover > 0) & (cover < 1), binary_dilation(cover > 0)
        for camera_sees, width, subpixels in ROWS:
            found = relight(
                drgs, job["environment"], job["camera"], samples=options.samples, camera_sees=camera_sees,
                subpixel_samples=subpixels, bounces=1,
                strength=job["strength"], filter_width=width,
            )["Combined"]  # fmt: skip
            np.save(OUT / f"filter-{mesh}-{camera_sees}-{width}-{subpixels}.npy", found)
            off = float(np.sqrt(np.mean((found[..., 3] - cover)[edge] ** 2)))
            name = f"Blackman-Harris {width:g}" if width else "box 1"
            likeness = (f"{psnr(found, theirs, where):.2f}" for where in (near, edge))
            rows.append((mesh, camera_sees, name, subpixels, *likeness, f"{off:.4f}"))
    body = (
        f"{options.size}x{options.size}, {options.samples} samples, against Cycles with {options.spp} samples and its "
        f"default filter, Blackman-Harris {WIDTH:g}; the same mesh, materials, light, one bounce. PSNR in sRGB over "
        "all that is covered, edges included, and over the partly covered pixels alone; alpha: RMSE over the latter. "
        "Surfels stand a part of a pixel off the mesh.\n\n"
        + table(("Mesh", "Primary", "Our filter", "Positions", "Covered dB", "Edges dB", "Alpha"), rows)
    )
    write_section("filter", "Pixel filter against Cycles", body)


if __name__ == "__main__":
    main()
