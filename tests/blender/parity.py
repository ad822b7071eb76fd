"""Pictures of one scene by Cycles and by DR-GS, and how far they are apart beyond their noise."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from scenes import new_world, read_exr

#: Before 5.0 Cycles turned steep normals of maps towards the viewer for diffuse light as well, up to a fifth brighter.
needs_current_normals = pytest.mark.skipif(
    bpy.app.version < (5, 0), reason="Cycles shades steep normals of maps otherwise before Blender 5.0"
)


def set_up(
    scene: bpy.types.Scene,
    size: int,
    samples: int = 256,
    bounces: int = 2,
    subpixels: int = 16,
    multiscatter: bool = False,
) -> None:
    """Both engines with the same bounces and pixel filter, nothing clamped or denoised."""
    for material in bpy.data.materials:
        for node in material.node_tree.nodes if material.node_tree else ():
            if not multiscatter and getattr(node, "distribution", "") == "MULTI_GGX":
                node.distribution = "GGX"
    for obj in bpy.data.objects:
        holder = obj if hasattr(obj, "shadow_terminator_geometry_offset") else obj.cycles  # the latter before 5.0
        holder.shadow_terminator_geometry_offset = 0.0
    render, cycles, settings = scene.render, scene.cycles, scene.drgs
    render.resolution_x = render.resolution_y = size
    render.film_transparent = True
    cycles.device, cycles.samples, cycles.use_adaptive_sampling, cycles.use_denoising = "CPU", samples, False, False
    cycles.pixel_filter_type, cycles.filter_width = "BOX", 1.0
    cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = settings.bounces = bounces
    cycles.transmission_bounces = bounces
    cycles.transparent_max_bounces = 64
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = cycles.blur_glossy = cycles.light_sampling_threshold = 0
    cycles.caustics_reflective = True
    settings.use_strategy_samples, settings.samples, settings.subpixel_samples = False, samples, subpixels
    settings.camera_sees, settings.filter_width = "mesh", 0


def light(scene: bpy.types.Scene, sky: float = 0.3) -> None:
    """A sun from the side, and an even sky."""
    _, background = new_world(scene)
    background.inputs["Color"].default_value, background.inputs["Strength"].default_value = (0.7, 0.85, 1, 1), sky
    data = bpy.data.lights.new("Sun", "SUN")
    data.energy, data.angle = 2.0, 0.3
    obj = bpy.data.objects.new("Sun", data)
    obj.rotation_euler = (0.9, 0.2, 0.6)
    scene.collection.objects.link(obj)


def pictures(scene: bpy.types.Scene, engine: str, seeds: tuple[int, ...] = (1, 2)) -> np.ndarray:
    """(seeds, h, w, 4) by an engine, linear, of different seeds."""
    found = []
    scene.render.engine = engine
    for seed in seeds:
        scene.cycles.seed = scene.drgs.seed = seed
        bpy.ops.render.render(write_still=True)
        found.append(read_exr(scene.render.filepath, scene.render.resolution_x, scene.render.resolution_y))
    return np.stack(found).astype(np.float64)


def encoded(colours: np.ndarray) -> np.ndarray:
    """Linear -> sRGB, within [0, 1]."""
    colours = np.clip(colours, 0, 1)
    return np.where(colours <= 0.0031308, colours * 12.92, 1.055 * colours ** (1 / 2.4) - 0.055)


def psnr(ours: np.ndarray, theirs: np.ndarray, where: np.ndarray | None = None) -> float:
    """PSNR in dB of two pairs of pictures, without their noise; of the pixels where theirs shows something.

    The product of the differences of independent pairs has the square of the systematic difference as its mean.
    """
    mask = (theirs[..., 3] > 0.999).all(axis=0) if where is None else where
    difference = (encoded(ours[..., :3]) - encoded(theirs[..., :3]))[:, mask]
    error = float((difference[0] * difference[1]).mean())
    return -10 * np.log10(max(error, 1e-7))
