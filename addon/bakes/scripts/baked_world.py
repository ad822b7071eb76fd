"""A World as a lat-long map in Blender's mapping, without the discs of its suns, and these suns one by one."""

from __future__ import annotations

import math
from typing import Any

import bpy
import cycles_scene
import node_trees
import numpy as np

_SAMPLES = 4
#: Widths of the map in which a sun is looked for: by its diameter, between these. Side and samples of its picture.
_NARROWEST, _WIDEST = 512, 4096
_SIDE, _SUN_SAMPLES = 256, 16
#: Width of a sun's picture in its diameters.
_VIEW = 1.6
#: Part of what a sun adds to the map that has to be within its picture.
_WHOLE = 0.8


def bake(job: dict[str, Any]) -> None:
    """Write ``map`` (h, w, 3) float32 and ``suns`` (n, 7) float64: direction, irradiance, diameter in radians."""
    world = cycles_scene.load(job, "worlds")
    found = cycles_scene.evaluated(world, job)
    scene = cycles_scene.set_up(job, _SAMPLES)
    scene.world = world
    world.cycles.sampling_method = "NONE"  # nothing is lit here
    for name in ("camera", "diffuse", "glossy", "transmission", "scatter", "shadow"):
        setattr(world.cycles_visibility, name, True)
    output = cycles_scene.output_of(world)
    for link in list(output.inputs["Volume"].links):
        world.node_tree.links.remove(link)
    for tree in found:
        _fix_light_paths(tree, job["light_path"])
    sky_nodes = [] if job["camera"] else [n for t in found for n in t.nodes if n.bl_idname == "ShaderNodeTexSky"]
    discs = [node for node in sky_nodes if getattr(node, "sun_disc", False)]
    panorama = cycles_scene.camera(scene, type="PANO", panorama_type="EQUIRECTANGULAR")
    panorama.rotation_euler = (math.pi / 2, 0, -math.pi / 2)  # the middle of the map is +X
    for node in discs:
        node.sun_disc = False
    suns: list[tuple[bpy.types.Node, np.ndarray]] = []
    kept: list[tuple[bpy.types.Node, np.ndarray]] = []
    for node in discs:
        sun = _sun(scene, node, job["folder"])
        if sun is not None:
            (suns if len(sun) else kept).append((node, sun))
    for node, _ in kept:  # of no round shape: it stays in the map
        node.sun_disc = True
    scene.camera, scene.cycles.samples = panorama, _SAMPLES
    pixels = cycles_scene.picture(scene, job["size"], job["size"] // 2, job["folder"])
    lamps = np.array([sun for _, sun in suns], np.float64).reshape(-1, 7)
    cycles_scene.write(job, map=pixels, suns=lamps, kept=np.array(len(kept)))


def _fix_light_paths(tree: node_trees.Tree, values: dict[str, float]) -> None:
    """Let the Light Path nodes of a tree have these values, by the names of their outputs; 0 for others."""
    links = tree.tree.links
    for node in tree.nodes:
        if node.bl_idname != "ShaderNodeLightPath":
            continue
        for output in node.outputs:
            targets = [link.to_socket for link in output.links]
            value = tree.tree.nodes.new("ShaderNodeValue")
            value.outputs[0].default_value = values.get(output.name, 0.0)
            for target in targets:
                links.new(value.outputs[0], target)


def _sun(scene: bpy.types.Scene, node: bpy.types.Node, folder: str) -> np.ndarray | None:
    """(7,) of the sun that a Sky Texture shows; None without one, empty where it is not one round sun."""
    panorama, size = scene.camera, float(node.sun_size)
    height = int(np.clip(1.5 * np.pi / max(size, 1e-6), _NARROWEST / 2, _WIDEST / 2))
    width = 2 * height
    scene.cycles.samples = _SAMPLES
    added = _difference(scene, node, width, height, folder)
    polar = (np.arange(height) + 0.5) / height * np.pi
    solid = np.sin(polar)[:, None] * (np.pi / height) * (2 * np.pi / width)
    total = float((added * solid[..., None]).sum())
    if not total > 0:
        return None
    row, column = np.unravel_index(np.argmax(added.sum(axis=2)), added.shape[:2])
    azimuth = np.pi - (column + 0.5) / width * 2 * np.pi
    direction = np.array(
        (np.sin(polar[row]) * np.cos(azimuth), np.sin(polar[row]) * np.sin(azimuth), np.cos(polar[row]))
    )
    near = cycles_scene.camera(scene, type="PERSP")
    scene.cycles.samples = _SUN_SAMPLES
    irradiance = np.zeros(3)
    # The map says where it is to some texels: a wide view first.
    for angle in (_VIEW * size + 8 * np.pi / height, _VIEW * size):
        near.data.angle = angle
        near.matrix_world = cycles_scene.towards(direction)
        seen = _difference(scene, node, _SIDE, _SIDE, folder)
        edge = math.tan(angle / 2)
        x = ((np.arange(_SIDE) + 0.5) / _SIDE * 2 - 1) * edge
        rays = np.stack(np.broadcast_arrays(x[None, :], -x[:, None], -1.0), axis=-1)
        length = np.linalg.norm(rays, axis=-1, keepdims=True)
        weight = (2 * edge / _SIDE) ** 2 / length**3
        irradiance = (seen * weight).sum(axis=(0, 1), dtype=np.float64)
        if not irradiance.sum() > 0:
            break
        share = (seen * weight).sum(axis=2, keepdims=True)
        centre = (rays / length * share).sum(axis=(0, 1)) / share.sum()
        direction = np.array(near.matrix_world.to_3x3()) @ (centre / np.linalg.norm(centre))
    scene.camera = panorama
    bpy.data.objects.remove(near)
    if irradiance.sum() < _WHOLE * total:
        return np.empty(0)
    return np.array((*direction, *irradiance, size))


def _difference(scene: bpy.types.Scene, node: bpy.types.Node, width: int, height: int, folder: str) -> np.ndarray:
    """(h, w, 3): what the disc of a Sky Texture adds to a picture."""
    without = cycles_scene.picture(scene, width, height, folder)
    node.sun_disc = True
    with_sun = cycles_scene.picture(scene, width, height, folder)
    node.sun_disc = False
    return np.maximum(np.nan_to_num(with_sun - without), 0)
