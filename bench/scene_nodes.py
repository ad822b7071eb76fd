"""Nodes, materials and images of scenes that are built inside Blender; see composed_job.py."""

from __future__ import annotations

import bpy
import numpy as np
from composed_job import material

Tree = bpy.types.NodeTree


def node(tree: Tree, kind: str, **values: object) -> bpy.types.Node:
    """A new node; `values` are its properties, or sockets by name where it has no such property."""
    made = tree.nodes.new(f"ShaderNode{kind}")
    for name, value in values.items():
        socket = None if hasattr(made, name) else made.inputs[name.replace("_", " ")]
        if socket is None:
            setattr(made, name, value)
        elif isinstance(value, bpy.types.NodeSocket):
            tree.links.new(value, socket)
        else:
            socket.default_value = value
    return made


def look(name: str, **values: object) -> tuple[Tree, bpy.types.Node]:
    """A material's tree and its Principled BSDF."""
    made = material(name)
    principled = made.node_tree.nodes["Principled BSDF"]
    for key, value in values.items():
        principled.inputs[key.replace("_", " ")].default_value = value
    return made.node_tree, principled


def painted_image(name: str, pixels: np.ndarray, colour: bool) -> bpy.types.Image:
    """An image of (h, w, 3 or 4) values in [0, 1], row 0 at the bottom."""
    height, width = pixels.shape[:2]
    made = bpy.data.images.new(name, width, height, alpha=True)
    made.colorspace_settings.name = "sRGB" if colour else "Non-Color"
    values = np.ones((height, width, 4), np.float32)
    values[..., : pixels.shape[2]] = pixels
    made.pixels.foreach_set(values.ravel())
    made.update()
    made.pack()
    return made
