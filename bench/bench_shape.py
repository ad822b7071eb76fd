"""What limits the shape of stage (i): what fusion leaves of true depth maps, and what patches of photographs say of it.

python bench/bench_shape.py --capture scenes/spot [--size 128]

Scenes are those of `drgs evaluate --make-scenes scenes`. Rows are kept, so that captures may be measured one by one.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from bench_reconstruct import against_truth, first_hits
from report import OUT, store_row, table, write_section

from drgs_blender.core.frame import Camera
from drgs_blender.reconstruct.capture.capture import Capture
from drgs_blender.reconstruct.capture.neighbours import neighbours
from drgs_blender.reconstruct.capture.training_views import composed, pixel_rays
from drgs_blender.reconstruct.losses.patches import Pair, patch_loss
from drgs_blender.reconstruct.meshing import depth_fusion
from drgs_blender.reconstruct.meshing.visual_hull import find_region
from drgs_blender.reconstruct.optim.learner import LUMA
from drgs_blender.reconstruct.readers import read_capture

FILE = OUT / "reconstruct" / "shape.json"
#: Voxels of the fusion, pixels.
VOXELS = (1.0, 0.5)
#: Name -> metres that the true surface is moved away from the viewer, and degrees that its normals are turned.
ERRORS = {"true shape": (0.0, 0), "1 cm nearer": (-0.01, 0), "1 cm farther": (0.01, 0), "turned by 15 deg": (0.0, 15)}
#: Every n-th view is compared, with so many neighbours.
EVERY, WITH = 3, 2


class Truth:
    """Maps of the true mesh."""

    def __init__(self, folder: Path) -> None:
        with np.load(folder / "mesh.npz") as file:
            self.vertices, self.faces = file["vertices"], file["faces"]

    def maps(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Depth (h, w), 0 where nothing is, and normal (h, w, 3)."""
        normal, hit, depth = first_hits(self.vertices, self.faces, camera)
        shape = camera.height, camera.width
        return np.where(hit, depth, 0).reshape(shape).astype(np.float32), normal.reshape(*shape, 3).astype(np.float32)


@contextmanager
def true_depth(truth: Truth) -> Iterator[None]:
    """Within it, fusion takes true depth maps in place of those of surfels."""

    def true_maps(_: Any, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        depth, normal = truth.maps(camera)
        rays = pixel_rays(camera).numpy()
        cosine = -(normal * rays).sum(-1) / np.linalg.norm(rays, axis=-1)
        seen = depth > 0
        return np.where(seen, depth, np.inf).astype(np.float32), np.where(seen, cosine.clip(0, 1), 1).astype(np.float32)

    kept = depth_fusion.surface_maps, depth_fusion.PIXELS
    try:
        depth_fusion.surface_maps = true_maps
        yield
    finally:
        depth_fusion.surface_maps, depth_fusion.PIXELS = kept


def fusion(capture: Capture, truth: Truth, folder: Path) -> dict[str, float]:
    """Degrees of normals of the mesh that is fused of true depth maps, by voxel."""
    found = {}
    training: Any = SimpleNamespace(region=find_region(capture))
    with true_depth(truth):
        for depth_fusion.PIXELS in VOXELS:
            figures = against_truth(None, training, capture, folder)  # type: ignore[arg-type]
            found[f"fused, voxels of {depth_fusion.PIXELS:g} pixels"] = figures["normal"]
    return found


def patches(capture: Capture, truth: Truth) -> dict[str, float]:
    """Mean 1 - NCC of patches of neighbouring views, at the true shape and beside it."""
    views = capture.training
    near, grey = (
        neighbours(views, find_region(capture).centre),
        [composed(v, capture) @ np.float32(LUMA) for v in views],
    )
    maps, rng = [truth.maps(view.camera) for view in views], np.random.default_rng(0)
    found = {}
    for name, (away, turn) in ERRORS.items():
        sums = np.zeros(2)
        for k in range(0, len(views), EVERY):
            depth, normal = maps[k]
            across = np.cross(normal, rng.normal(size=3))
            across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-6)
            turned = np.cos(np.radians(turn)) * normal + np.sin(np.radians(turn)) * across
            moved, ones = np.where(depth > 0, depth + away, 0), np.ones_like(depth)
            given = torch.from_numpy(moved.astype(np.float32)), torch.from_numpy(turned.astype(np.float32)), ones
            for j in near[k][:WITH]:
                behind = np.where(maps[j][0] > 0, maps[j][0] + away, 0).astype(np.float32)
                rest = behind, Pair.of(views[k].camera, views[j].camera), 0.0
                rays = pixel_rays(views[k].camera).numpy()
                # Of photographs without contrast it is the sum of the weights.
                for column, brightness in enumerate((1, 0)):
                    greys = np.float32(brightness) * grey[k], np.float32(brightness) * grey[j]
                    sums[column] += float(patch_loss(*given, rays, greys, *rest)) * depth.size
        found[name] = sums[0] / max(sums[1], 1e-9)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, required=True)
    parser.add_argument("--size", type=int, default=128)
    options = parser.parse_args()
    capture, truth = read_capture(options.capture, options.size, 8), Truth(options.capture)
    row = fusion(capture, truth, options.capture) | patches(capture, truth)
    rows = store_row(FILE, f"{options.capture.name}|{options.size}|{len(capture.training)}", row)
    head = ("Object", "Pixels", "Views", *row)
    cells = [(*key.split("|"), *(f"{value:.3f}" for value in values.values())) for key, values in rows.items()]
    body = (
        "Normals, mean degrees in the views left out, of the mesh that is fused of *true* depth maps; then 1 - NCC of "
        "patches of neighbouring photographs (`losses/patches.py`), all of one weight, at the true shape and beside "
        "it.\n\n"
    )
    write_section("reconstruct-shape", "What limits the shape of stage (i)", body + table(head, cells))


if __name__ == "__main__":
    main()
