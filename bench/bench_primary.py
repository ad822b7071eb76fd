"""Surfels against mesh as the primary surface, on assets made by `drgs make`.

python bench/bench_primary.py [--size 400]
"""

from __future__ import annotations

import argparse

import numpy as np
from judge import environments, foreground, frame_camera, psnr
from ours import relight
from report import OUT, table, write_section
from subjects import SOURCES, asset_path

from drgs_blender.core.asset.container import read_asset


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--size", type=int, default=400)
    parser.add_argument("--samples", type=int, default=512)
    options = parser.parse_args()
    rows = []
    for name in SOURCES:
        path = asset_path(name)
        asset = read_asset(path)
        camera = frame_camera(asset.mesh.vertices, options.size, azimuth=-60, fill=1.0)
        pictures = {
            camera_sees: relight(
                path,
                environments() / "city.exr",
                camera,
                samples=options.samples,
                camera_sees=camera_sees,
                subpixel_samples=16,
                bounces=1,
            )["Combined"]
            for camera_sees in ("mesh", "surfels")
        }
        for camera_sees, picture in pictures.items():
            np.save(OUT / f"primary-{name}-{camera_sees}.npy", picture)
        mesh, surfels = (pictures[p][..., 3] > 0.5 for p in ("mesh", "surfels"))
        iou = (mesh & surfels).sum() / (mesh | surfels).sum()
        mask = foreground(pictures["mesh"][..., 3], erode=0)
        rows.append(
            (name, len(asset.mesh.faces), len(asset.surfels), f"{iou:.4f}",
             f"{psnr(pictures['surfels'], pictures['mesh'], mask):.2f}",
             f"{psnr(pictures['surfels'], pictures['mesh'], mesh | surfels):.2f}")
        )  # fmt: skip
    body = (
        f"{options.size}x{options.size}, {options.samples} samples, 16 sub-pixel samples, city.exr; silhouettes at "
        f"alpha .5; "
        "PSNR in sRGB over pixels wholly inside the mesh, and over the union of both silhouettes.\n\n"
        + table(("Asset", "Triangles", "Surfels", "Silhouette IoU", "PSNR inside dB", "PSNR union dB"), rows)
    )
    write_section("camera_sees", "Surfels against mesh as primary surface", body)


if __name__ == "__main__":
    main()
