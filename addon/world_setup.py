"""The World of the scene: made of an HDR image, with a Mapping node to turn it."""

from __future__ import annotations

import os
from pathlib import Path

import bpy

from ..drgs_blender.core.errors import AssetError, UsageError
from ..drgs_blender.core.file_integrity import crashes_blender

#: Label of the nodes that are made here, by which they are found again.
LABEL = "DR-GS Light"


def choose_light(scene: bpy.types.Scene, path: Path, rotation: float = 0.0, strength: float = 1.0) -> bpy.types.World:
    """Make the image at `path` the scene's world; return it.

    Nodes of the world that this made before are used again, so that keyframes and drivers on them stay.

    Parameters
    ----------
    rotation : radians about Z; positive turns the light clockwise seen from above, as Blender's Mapping node does
    strength : factor on the radiance

    Raises
    ------
    AssetError
        The file is absent or no image.
    UsageError
        The scene comes from a library.
    """
    if not scene.is_editable:
        raise UsageError(f'Scene "{scene.name}"', "comes from a library and cannot be changed here", "Make it local")
    if not os.path.isfile(path):
        raise AssetError(str(path), "does not exist", "Choose another image")
    if crashes_blender(path):
        raise AssetError(str(path), "is cut off", "Copy it again, or choose another image")
    try:
        image = bpy.data.images.load(str(path), check_existing=True)
    except RuntimeError as error:
        raise AssetError(str(path), f"cannot be read ({str(error).strip()})", "Choose an EXR or HDR image") from error
    if not image.size[0]:
        if not image.users:
            bpy.data.images.remove(image)
        raise AssetError(str(path), "is no image that Blender can read", "Choose an EXR or HDR image")
    world = scene.world
    if world is None or not world.is_editable:
        world = scene.world = bpy.data.worlds.new(LABEL)
    if world.node_tree is None or (bpy.app.version < (5, 0, 0) and not world.use_nodes):
        world.use_nodes = True
    texture, mapping, background = nodes_of(world) or _new_nodes(world)
    texture.image = image
    mapping.inputs["Rotation"].default_value[2] = rotation
    background.inputs["Strength"].default_value = strength
    return world


def nodes_of(world: bpy.types.World | None) -> tuple[bpy.types.Node, bpy.types.Node, bpy.types.Node] | None:
    """The texture, mapping and background nodes that `choose_light` made in a world, None where it made none."""
    nodes = world.node_tree.nodes if world is not None and world.node_tree is not None else ()
    found = {n.type: n for n in nodes if n.label == LABEL}
    kinds = ("TEX_ENVIRONMENT", "MAPPING", "BACKGROUND")
    return tuple(found[k] for k in kinds) if all(k in found for k in kinds) else None


def shines(world: bpy.types.World | None) -> bool:
    """Whether an image or a sky lights a world, as far as the kinds of its nodes show."""
    nodes = world.node_tree.nodes if world is not None and world.node_tree is not None else ()
    return any(n.type in ("TEX_ENVIRONMENT", "TEX_SKY", "TEX_IMAGE") and not n.mute for n in nodes)


def _new_nodes(world: bpy.types.World) -> tuple[bpy.types.Node, bpy.types.Node, bpy.types.Node]:
    """Generated coordinates, mapping, image and background, as the light of the world."""
    nodes, links = world.node_tree.nodes, world.node_tree.links
    output = next((n for n in nodes if n.type == "OUTPUT_WORLD" and n.is_active_output), None)
    if output is None:
        output = nodes.new("ShaderNodeOutputWorld")
    x, y = output.location
    made = {}
    kinds = ("ShaderNodeTexCoord", "ShaderNodeMapping", "ShaderNodeTexEnvironment", "ShaderNodeBackground")
    for column, kind in enumerate(kinds):
        node = made[kind] = nodes.new(kind)
        node.location = (x - 300 * (len(kinds) - column), y + 350)
        node.label = LABEL
    coordinates, mapping, texture, background = made.values()
    links.new(coordinates.outputs["Generated"], mapping.inputs["Vector"])
    links.new(mapping.outputs["Vector"], texture.inputs["Vector"])
    links.new(texture.outputs["Color"], background.inputs["Color"])
    links.new(background.outputs["Background"], output.inputs["Surface"])
    return texture, mapping, background
