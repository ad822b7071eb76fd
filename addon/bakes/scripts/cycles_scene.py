"""Cycles in the Blender that bakes: datablocks as the extension wrote them, render settings, pictures as arrays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
import node_trees
import numpy as np
from mathutils import Matrix, Vector


def load(job: dict[str, Any], kind: str) -> bpy.types.ID:
    """The datablock of a job, as it was evaluated; `kind` is its collection in `bpy.data`."""
    source = job["source"]
    with bpy.data.libraries.load(source["path"], link=False) as (known, wanted):
        if source["name"] not in getattr(known, kind):
            raise LookupError(f"{source['path']} has no {source['name']}")
        setattr(wanted, kind, [source["name"]])
    (loaded,) = getattr(wanted, kind)
    return loaded


def evaluated(
    owner: bpy.types.ID, job: dict[str, Any], follow: node_trees.Follow = lambda socket: True
) -> list[node_trees.Tree]:
    """The trees behind an output of a datablock, that of the job or Cycles', with the values and loose images."""
    output = owner.node_tree.nodes[job["output"]] if "output" in job else output_of(owner)
    found = node_trees.trees(owner.node_tree, output, follow)
    owner.animation_data_clear()
    node_trees.apply(found, job["trees"])
    for place, (node, image) in enumerate(list(node_trees.images(found))):
        path = Path(job["folder"]) / f"image-{place}.npy"
        if path.exists():
            node.image = _filled(image, np.load(path))
    return found


def output_of(owner: bpy.types.ID) -> bpy.types.Node:
    """The output node that Cycles uses."""
    return owner.node_tree.get_output_node("CYCLES") or owner.node_tree.get_output_node("ALL")


def _filled(image: bpy.types.Image, pixels: np.ndarray) -> bpy.types.Image:
    """An image like `image` of these pixels, as Blender holds them."""
    width, height = image.size
    if width * height == 0 or len(pixels) % (width * height):
        return image
    made = bpy.data.images.new(image.name, width, height, alpha=True, float_buffer=image.is_float)
    made.colorspace_settings.name, made.alpha_mode = image.colorspace_settings.name, image.alpha_mode
    channels = len(pixels) // (width * height)
    whole = np.ones((width * height, 4), np.float32)
    whole[:, :channels] = pixels.reshape(-1, channels)
    if channels == 1:
        whole[:, 1:3] = whole[:, :1]
    made.pixels.foreach_set(whole.ravel())
    made.update()
    return made


def set_up(job: dict[str, Any], samples: int) -> bpy.types.Scene:
    """Cycles on the processor, every sample counted as it is."""
    scene = bpy.context.scene
    scene.frame_set(job["frame"])
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device, cycles.samples = "CPU", samples
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.pixel_filter_type, cycles.filter_width = "BOX", 1.0
    if job["threads"]:
        scene.render.threads_mode, scene.render.threads = "FIXED", job["threads"]
    scene.render.film_transparent = False
    scene.render.resolution_percentage = 100
    scene.render.use_compositing = scene.render.use_sequencer = False
    image = scene.render.image_settings
    image.file_format, image.color_mode, image.color_depth = "OPEN_EXR", "RGB", "32"
    image.exr_codec = "NONE"
    return scene


def camera(scene: bpy.types.Scene, **settings: Any) -> bpy.types.Object:
    """A new camera of the scene at the origin."""
    data = bpy.data.cameras.new("Camera")
    for name, value in settings.items():
        # Blender 5 took the settings of panoramas from Cycles.
        setattr(data if hasattr(data, name) else data.cycles, name, value)
    scene.camera = bpy.data.objects.new("Camera", data)
    scene.collection.objects.link(scene.camera)
    return scene.camera


def picture(scene: bpy.types.Scene, width: int, height: int, folder: str) -> np.ndarray:
    """(h, w, 3) float32 linear, row 0 at the top."""
    scene.render.resolution_x, scene.render.resolution_y = width, height
    path = Path(folder) / "picture.exr"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(str(path))
    pixels = np.empty((height, width, image.channels), np.float32)
    image.pixels.foreach_get(pixels.ravel())
    bpy.data.images.remove(image)
    path.unlink()
    return np.ascontiguousarray(pixels[::-1, :, :3])


def towards(direction: np.ndarray) -> Matrix:
    """Pose of a camera at the origin that looks along a unit vector."""
    return Vector(direction).to_track_quat("-Z", "Y").to_matrix().to_4x4()


def write(job: dict[str, Any], **arrays: np.ndarray) -> None:
    """Write the result of a job."""
    with open(Path(job["folder"]) / "result.npz", "wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
