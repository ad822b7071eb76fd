"""What limits the shape of stage (i): what fusion leaves of true depth maps, and what patches of photographs say of it.

python bench/bench_shape.py --capture scenes/spot [--size 128]
python bench/bench_shape.py --part chain --capture scenes/spot [--size 256]

The chain has the error of normals after each step from surfels to the mesh; it learns surfels once and keeps them.
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
from bench_reconstruct import against_truth, first_hits, trained
from report import OUT, store_row, table, write_section

from drgs_blender.core.asset.model import Mesh
from drgs_blender.core.frame import Camera
from drgs_blender.geometry.normals import unit
from drgs_blender.reconstruct.capture.capture import Capture
from drgs_blender.reconstruct.capture.neighbours import neighbours
from drgs_blender.reconstruct.capture.training_views import composed, pixel_rays
from drgs_blender.reconstruct.losses.patches import Pair, patch_loss
from drgs_blender.reconstruct.meshing import depth_fusion
from drgs_blender.reconstruct.meshing.silhouette_fit import fill_silhouettes
from drgs_blender.reconstruct.meshing.visual_hull import find_region, silhouettes
from drgs_blender.reconstruct.model.gaussians import Gaussians
from drgs_blender.reconstruct.model.thin_structures import normals_of
from drgs_blender.reconstruct.optim.learner import LUMA
from drgs_blender.reconstruct.optim.schedule import Schedule
from drgs_blender.reconstruct.readers import read_capture

FOLDER = OUT / "reconstruct"
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


def learned(capture: Capture, name: str) -> Gaussians:
    """The surfels of a capture after stage (i) as it is by default, kept from the first time on."""
    file = FOLDER / "surfels" / f"{name}.npz"
    if not file.exists():
        training, _ = trained(capture, Schedule(), None)
        surfels, light = training.gaussians.arrays(), training.gaussians.light
        assert light is not None
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savez(file, light=light.detach().numpy(), **surfels)  # type: ignore[arg-type]
    with np.load(file) as kept:
        tensors = {key: torch.from_numpy(kept[key]) for key in kept.files}
    light = tensors.pop("light")
    return Gaussians(tensors, light)


class Chain:
    """Errors of normals in the views left out, mean degrees of the pixels that both show."""

    def __init__(self, capture: Capture, truth: Truth) -> None:
        self._views, self._truth = capture.testing, truth
        self._maps = [truth.maps(view.camera) for view in self._views]

    def off(self, shown: list[tuple[np.ndarray, np.ndarray]]) -> float:
        """Of normals (h, w, 3) of each view, where its mask (h, w) says that there are any."""
        angles = []
        for (normal, seen), (depth, true) in zip(shown, self._maps, strict=True):
            both = seen & (depth > 0)
            angles.append(np.arccos((normal * true).sum(-1)[both].clip(-1, 1)))
        return float(np.degrees(np.concatenate(angles).mean()))

    def mesh(self, mesh: Mesh) -> float:
        """Of the smooth normals of a mesh."""
        return self._hits(mesh.vertices, mesh.faces)

    def facets(self) -> float:
        """Of the true mesh, faces flat: what no shape can show, as photographs show smooth normals of few faces."""
        corners = self._truth.vertices[self._truth.faces].reshape(-1, 3)
        return self._hits(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3))

    def surfels(self, gaussians: Gaussians) -> float:
        """Of the surfels' own normals."""
        shown = [unit(normals_of(gaussians)(view)) for view in self._views]
        return self.off([(normal, np.abs(normal).sum(-1) > 0) for normal in shown])

    def _hits(self, vertices: np.ndarray, faces: np.ndarray) -> float:
        shown = []
        for view in self._views:
            normal, hit, _ = first_hits(vertices, faces, view.camera)
            shape = view.camera.height, view.camera.width
            shown.append((normal.reshape(*shape, 3), hit.reshape(shape)))
        return self.off(shown)


def chain(capture: Capture, truth: Truth, name: str) -> dict[str, float]:
    """Degrees after each step from the surfels to the mesh of stage (i)."""
    judge, region, cameras = Chain(capture, truth), find_region(capture), [v.camera for v in capture.training]
    masks, gaussians = silhouettes(capture), learned(capture, name)
    assert masks is not None
    found = {"the true mesh, faces flat": judge.facets()}
    with true_depth(truth):
        for depth_fusion.PIXELS in VOXELS:
            mesh, _ = depth_fusion.fuse(None, cameras, region, 1024)  # type: ignore[arg-type]
            found[f"true depth, fused, voxels of {depth_fusion.PIXELS:g} pixels"] = judge.mesh(mesh)
    found["surfels' own normals"] = judge.surfels(gaussians)
    even = depth_fusion.relaxed
    for label, relax in (("triangles as marching cubes leaves them", lambda v, _: v), ("evened", even)):
        depth_fusion.relaxed = relax
        try:
            mesh, _ = depth_fusion.fuse(gaussians, cameras, region)
        finally:
            depth_fusion.relaxed = even
        found[f"learned depth, fused, {label}"] = judge.mesh(mesh)
        mesh.vertices = fill_silhouettes(mesh, cameras, masks)
        found[f"{label}, outlines filled"] = judge.mesh(mesh)
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
    parser.add_argument("--part", choices=("limits", "chain"), default="limits")
    parser.add_argument("--capture", type=Path, required=True)
    parser.add_argument("--size", type=int, help="default 128, of the chain 256")
    options = parser.parse_args()
    size = options.size or (128 if options.part == "limits" else 256)
    capture, truth = read_capture(options.capture, size, 8), Truth(options.capture)
    if options.part == "limits":
        row = fusion(capture, truth, options.capture) | patches(capture, truth)
        section, title = "reconstruct-shape", "What limits the shape of stage (i)"
        body = (
            "Normals, mean degrees in the views left out, of the mesh that is fused of *true* depth maps; then 1 - NCC "
            "of patches of neighbouring photographs (`losses/patches.py`), all of one weight, at the true shape and "
            "beside it.\n\n"
        )
    else:
        row = chain(capture, truth, f"{options.capture.name}-{size}")
        section, title = "reconstruct-chain", "Where stage (i) loses normals"
        body = (
            "Mean degrees in the views left out, before materials are learned. Photographs show smooth vertex normals "
            "of a mesh of few faces: what the true mesh is off with flat faces, no mesh fused of any depth can "
            "show.\n\n"
        )
    file = FOLDER / ("shape.json" if options.part == "limits" else "chain.json")
    rows = store_row(file, f"{options.capture.name}|{size}|{len(capture.training)}", row)
    head = ("Object", "Pixels", "Views", *row)
    digits = 3 if options.part == "limits" else 2
    cells = [(*key.split("|"), *(f"{value:.{digits}f}" for value in values.values())) for key, values in rows.items()]
    write_section(section, title, body + table(head, cells))


if __name__ == "__main__":
    main()
