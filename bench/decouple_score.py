"""What materials and light are worth: against the known ones of a scene, and in pictures of it under other lights."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from scipy.spatial import cKDTree

from drgs_blender.core.asset import Mesh
from drgs_blender.core.asset.model import BASE_CHANNELS, PosedSurfels, Surfels
from drgs_blender.core.frame import Camera, Frame, ObjectState, RenderSettings, World
from drgs_blender.evaluate.metrics import material_scores, relight_scores
from drgs_blender.evaluate.truth import TruthSet, read_truth
from drgs_blender.reconstruct.capture.capture import Capture
from drgs_blender.reconstruct.readers import read_capture
from drgs_blender.render.lights.environment import EnvironmentLight
from drgs_blender.render.pipeline import render
from drgs_blender.render.prepared_scene import PreparedScene
from drgs_blender.render.scene.trace_scene import TraceObject, TraceScene

Array = np.ndarray
Part = TypeVar("Part", Mesh, Surfels)

COLUMNS = ("CPU-s", "Relit raw", "Relit scaled", "Albedo scaled", "Roughness RMSE", "Metallic RMSE")


@dataclass
class Scene:
    """A capture with its truth."""

    capture: Capture
    mesh: Mesh
    training: TruthSet
    relit: list[TruthSet]

    @classmethod
    def read(cls, folder: Path) -> Scene:
        """As evaluate.scenes writes it."""
        truth = read_truth(folder)
        if truth is None:
            raise SystemExit(f"{folder} has no truth.json")
        rest = [item for item in truth.sets if not item.posed]
        with np.load(folder / "mesh.npz") as arrays:
            mesh = Mesh(*(arrays[name] for name in ("vertices", "faces", "albedo", "roughness", "metallic")))
        training = next(item for item in rest if item.light == truth.training_light)
        return cls(read_capture(folder), mesh, training, [item for item in rest if item.light != truth.training_light])


def with_materials_of(true: Mesh, part: Part, points: Array) -> Part:
    """A mesh or surfels, at `points` (n, 3), with the materials of the nearest vertices of `true`."""
    nearest = cKDTree(true.vertices).query(points)[1]
    return replace(part, **{name: getattr(true, name)[nearest] for name in BASE_CHANNELS})


def passes_of(
    mesh: Mesh, cameras: list[Camera], radiance: Array, samples: int, passes: tuple[str, ...]
) -> list[dict[str, Array]]:
    """Passes of a mesh in a light, one dictionary a camera; one bounce."""
    scene, world = TraceScene(), World(environment=radiance)
    scene.update([TraceObject("subject", mesh.vertices, mesh.faces, mesh.albedo, mesh.roughness, mesh.metallic)])
    rows, column = np.empty((0, 3), np.float32), np.empty(0, np.float32)
    posed = PosedSurfels(rows, rows, rows, rows, column, rows, column, column, np.empty(0, np.int32))
    settings = RenderSettings(
        samples=max(4, samples),
        bounces=1,
        camera_sees="mesh",
        subpixel_samples=9,
        film_transparent=True,
    )
    light = EnvironmentLight(world)
    frames = [Frame(1, camera, [ObjectState("subject", "")], world, settings, passes) for camera in cameras]
    return [render(PreparedScene(scene, light, posed), frame) for frame in frames]


def score(scene: Scene, mesh: Mesh, samples: int = 64, step: int = 2) -> tuple[float, float, float, float, float]:
    """Relit raw and scaled (foreground, dB, means over the other lights), albedo scaled (dB), roughness, metallic.

    Parameters
    ----------
    step : take every n-th test view of each light
    """
    names = ("Albedo", "Roughness", "Metallic", "Coverage")
    white = np.ones((1, 1, 3), np.float32)
    maps = passes_of(mesh, [view.camera for view in scene.training.views], white, 4, names)

    def stack(source: list[dict[str, Array]]) -> dict[str, Array]:
        arrays = {name.lower(): np.stack([item[name] for item in source]) for name in names}
        return {name: a if name == "albedo" else a[..., 0] for name, a in arrays.items()}

    ours, true = stack(maps), stack(scene.training.maps)
    inside = (ours.pop("coverage") > 0.5) & (true.pop("coverage") > 0.99)
    materials = material_scores(ours, true, inside)
    raw, scaled = [], []
    for item in scene.relit:
        views = item.views[::step]
        pictures = passes_of(mesh, [view.camera for view in views], item.radiance, samples, ("Combined",))
        linear = np.stack([picture["Combined"] for picture in pictures])
        alpha = np.clip(linear[..., 3], 0, 1)
        straight = linear[..., :3] / np.maximum(alpha, 1e-6)[..., None] * (alpha > 0)[..., None]
        masks = np.stack([np.ones_like(alpha[0]) if view.mask is None else view.mask for view in views])
        found = relight_scores(straight, alpha, np.stack([view.colour for view in views]), masks)
        raw.append(found["raw"]["foreground"])  # type: ignore[index]
        scaled.append(found["scaled"]["foreground"])  # type: ignore[index]
    return (
        float(np.mean(raw)), float(np.mean(scaled)), float(materials["albedo_psnr_scaled"]),  # type: ignore[arg-type]
        float(materials["roughness_rmse"]), float(materials["metallic_rmse"]),  # type: ignore[arg-type]
    )  # fmt: skip
