"""What a node tree says, as plain data: for the name of a bake, and to give a copy of the tree the evaluated values.

Used by the extension and, as a plain module, by the scripts that run in the Blender that bakes: nothing of the package
is imported here.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import bpy
import numpy as np

#: Properties of every node that its output does not depend on.
_COMMON = {p.identifier for p in bpy.types.Node.bl_rna.properties} - {"mute"}
#: Properties of datablocks that are not read as parts of a node.
_SCALARS = {"BOOLEAN", "INT", "FLOAT", "STRING", "ENUM"}
#: Nested structures that are followed: a node's curves, their points.
_DEEPEST = 4
#: Numbers that Blender hands out of one image at most: it counts them in 32 bits.
MOST_NUMBERS = 2**31 - 1


Follow = Callable[[bpy.types.NodeSocket], bool]
#: Shader nodes, as of `leaf_of`.
Leaves = tuple[tuple[str, str], ...]


class Tree(NamedTuple):
    """A node tree and those of its nodes from which an output is reached, in the order of their names."""

    tree: bpy.types.NodeTree
    nodes: list[bpy.types.Node]


def trees(tree: bpy.types.NodeTree, start: bpy.types.Node, follow: Follow = lambda socket: True) -> list[Tree]:
    """The trees and nodes on which the node `start` depends: its own tree first, then groups as they are found.

    The order is the same for a copy of the trees.

    Parameters
    ----------
    follow : whether an input matters
    """
    found = [Tree(tree, _reachable([start], follow))]
    known = {tree.as_pointer()}
    for each in found:  # grows
        for node in each.nodes:
            group = getattr(node, "node_tree", None)
            if node.bl_idname == "ShaderNodeGroup" and group is not None and group.as_pointer() not in known:
                known.add(group.as_pointer())
                ends = [n for n in group.nodes if n.bl_idname == "NodeGroupOutput" and n.is_active_output]
                found.append(Tree(group, _reachable(ends, follow)))
    return found


def _reachable(ends: list[bpy.types.Node], follow: Follow) -> list[bpy.types.Node]:
    found = {node.name: node for node in ends}
    pending = list(ends)
    while pending:
        for socket in pending.pop().inputs:
            for link in socket.links if follow(socket) else ():
                node = link.from_node
                if node.name not in found:
                    found[node.name] = node
                    pending.append(node)
    return [found[name] for name in sorted(found)]


def describe(found: list[Tree], follow: Follow = lambda socket: True) -> list[dict[str, Any]]:
    """Everything the output of the trees depends on, JSON-able: a list of nodes by name for each tree."""
    return [{node.name: _node(node, follow) for node in tree.nodes} for tree in found]


def _node(node: bpy.types.Node, follow: Follow) -> dict[str, Any]:
    inputs = {}
    for socket in filter(follow, node.inputs):
        links = [[k.from_node.name, k.from_socket.identifier, k.is_muted, k.is_valid] for k in socket.links]
        inputs[socket.identifier] = {"value": _value(socket), "links": links, "enabled": socket.enabled}
    outputs = {socket.identifier: _value(socket) for socket in node.outputs if hasattr(socket, "default_value")}
    return {"type": node.bl_idname, "inputs": inputs, "outputs": outputs, "own": _struct(node, _COMMON, 0)}


def _value(socket: bpy.types.NodeSocket) -> Any:
    return _plain(getattr(socket, "default_value", None))


def _plain(value: Any) -> Any:
    """A property's value as JSON holds it."""
    if isinstance(value, (bool, int, float, str)) or value is None:
        return value
    if isinstance(value, bpy.types.ID):
        return value.name_full
    if isinstance(value, (set, frozenset)):
        return sorted(value)
    try:
        return [_plain(item) for item in value]
    except TypeError:
        return None


def _struct(struct: Any, without: set[str], depth: int) -> dict[str, Any]:
    """The properties of a structure, but for those in `without`; images, groups and objects by what they hold."""
    found: dict[str, Any] = {}
    for prop in struct.bl_rna.properties:
        name = prop.identifier
        if name in without or name == "rna_type":
            continue
        value = getattr(struct, name, None)
        if prop.type in _SCALARS:
            found[name] = _plain(value)
        elif value is None or depth >= _DEEPEST:
            continue
        elif prop.type == "COLLECTION":
            found[name] = [_struct(item, set(), depth + 1) for item in value if hasattr(item, "bl_rna")]
        elif isinstance(value, bpy.types.Image):
            found[name] = image_identity(value)
        elif isinstance(value, bpy.types.Object):
            found[name] = [list(row) for row in value.matrix_world]
        elif isinstance(value, bpy.types.Text):
            found[name] = value.as_string()
        elif not isinstance(value, bpy.types.ID):
            found[name] = _struct(value, set(), depth + 1)
    return found


def images(found: list[Tree]) -> Iterator[tuple[bpy.types.Node, bpy.types.Image]]:
    """Nodes with images, and these, in an order that is the same for a copy of the trees."""
    for tree in found:
        for node in tree.nodes:
            image = getattr(node, "image", None)
            if isinstance(image, bpy.types.Image):
                yield node, image


def is_loose(image: bpy.types.Image) -> bool:
    """Whether an image's pixels are in this Blender alone: painted or generated."""
    return image.source == "GENERATED" or image.is_dirty


def image_identity(image: bpy.types.Image) -> dict[str, Any]:
    """What an image's pixels depend on."""
    settings = image.source, image.colorspace_settings.name, image.alpha_mode
    if is_loose(image):
        if _is_too_large(image):  # it is not baked, whatever it shows
            return {"pixels": image.name_full}
        return {"pixels": _digest(pixels_of(image).tobytes()), "settings": [*settings, *image.size]}
    # Not the size of others: to say it, Blender reads the file.
    if image.packed_file is not None:
        return {"pixels": _digest(image.packed_file.data), "settings": settings}
    path = bpy.path.abspath(image.filepath, library=image.library)
    try:
        facts = os.stat(path)
        stamp = [facts.st_mtime_ns, facts.st_size]
    except OSError:
        stamp = []
    tiles = [tile.number for tile in image.tiles] if image.source == "TILED" else []
    return {"path": path, "stamp": stamp, "settings": settings, "tiles": tiles}


def pixels_of(image: bpy.types.Image) -> np.ndarray:
    """(n,) float32, as Blender holds them; RuntimeError where it does not hand them out."""
    if _is_too_large(image):
        size = " x ".join(map(str, image.size))
        raise RuntimeError(
            f'image "{image.name}": its {size} pixels are more than Blender gives away. Use a smaller one'
        )
    pixels = np.empty(len(image.pixels), np.float32)
    if len(pixels):
        image.pixels.foreach_get(pixels)
    return pixels


def _is_too_large(image: bpy.types.Image) -> bool:
    return image.size[0] * image.size[1] * image.channels > MOST_NUMBERS


def _digest(data: bytes) -> str:
    return hashlib.blake2b(data, digest_size=16).hexdigest()


def moves(found: list[Tree]) -> bool:
    """Whether an image is another one in each frame."""
    return any(image.source in ("SEQUENCE", "MOVIE") for _, image in images(found))


#: Channels that are colours; others are numbers.
COLOURS = {"base_colour", "emission", "specular_tint", "coat_tint", "sheen_tint"}
_ANISOTROPIC: dict[str, tuple[str, ...] | float] = {"anisotropy": ("Anisotropy",), "anisotropy_rotation": ("Rotation",)}
#: Kind of a shader node -> channel -> its inputs: of a colour, or of a number; or a number. Others are as "".
SHADERS: dict[str, dict[str, tuple[str, ...] | float]] = {
    "BSDF_PRINCIPLED": {
        "base_colour": ("Base Color",),
        "roughness": ("Roughness",),
        "metallic": ("Metallic",),
        "emission": ("Emission Color", "Emission Strength"),
        "alpha": ("Alpha",),
        "ior": ("IOR",),
        "specular_level": ("Specular IOR Level",),
        "specular_tint": ("Specular Tint",),
        "anisotropy": ("Anisotropic",),
        "anisotropy_rotation": ("Anisotropic Rotation",),
        "coat": ("Coat Weight",),
        "coat_roughness": ("Coat Roughness",),
        "coat_ior": ("Coat IOR",),
        "coat_tint": ("Coat Tint",),
        "sheen": ("Sheen Weight",),
        "sheen_roughness": ("Sheen Roughness",),
        "sheen_tint": ("Sheen Tint",),
        "transmission": ("Transmission Weight",),
        "diffuse_roughness": ("Diffuse Roughness",),
    },
    "BSDF_DIFFUSE": {"base_colour": ("Color",), "roughness": 1.0, "diffuse_roughness": ("Roughness",)},
    "BSDF_GLOSSY": {"base_colour": ("Color",), "roughness": ("Roughness",), "metallic": 1.0, **_ANISOTROPIC},
    "BSDF_METALLIC": {
        "base_colour": ("Base Color",), "roughness": ("Roughness",), "metallic": 1.0, "specular_tint": ("Edge Tint",),
        **_ANISOTROPIC,
    },
    "BSDF_GLASS": {"base_colour": ("Color",), "roughness": ("Roughness",), "ior": ("IOR",)},
    "BSDF_REFRACTION": {"base_colour": ("Color",), "roughness": ("Roughness",), "ior": ("IOR",)},
    "BSDF_TRANSLUCENT": {"base_colour": ("Color",), "roughness": 1.0},
    "BSDF_SHEEN": {"base_colour": ("Color",), "roughness": 1.0, "sheen_roughness": ("Roughness",)},
    "SUBSURFACE_SCATTERING": {"base_colour": ("Color",), "roughness": 1.0},
    "EMISSION": {"emission": ("Color", "Strength")},
    "BACKGROUND": {"emission": ("Color", "Strength")},
    "BSDF_TRANSPARENT": {"alpha": 0.0},
    "": {"base_colour": ("Color",), "roughness": ("Roughness",)},
}  # fmt: skip
#: Channels of which a shader without such an input has one.
_WHOLE = ("alpha", "weight")
#: Those that scatter no light.
UNSCATTERED = ("EMISSION", "BACKGROUND", "BSDF_TRANSPARENT")
_JOINTS = ("MIX_SHADER", "ADD_SHADER", "GROUP", "REROUTE", "GROUP_INPUT")


def is_shader(node: bpy.types.Node) -> bool:
    """Whether a node is a shader itself, and joins no others."""
    return node.type not in _JOINTS and any(socket.type == "SHADER" for socket in node.outputs)


def leaf_of(node: bpy.types.Node) -> tuple[str, str]:
    """A shader node by name: of its node group, "" in the material itself, and its own."""
    tree = node.id_data
    return "" if tree.is_embedded_data else tree.name, node.name


def shader_inputs(node: bpy.types.Node, channel: str, leaves: Leaves | None = None) -> tuple[str, ...] | float:
    """Inputs of a shader node that make a channel of its surface, or the number that it is.

    Parameters
    ----------
    leaves : the only shaders that count; None: all do
    """
    if leaves is not None and leaf_of(node) not in leaves:
        return 0.0
    return SHADERS.get(node.type, SHADERS[""]).get(channel, float(channel in _WHOLE))


def follow_channel(channel: str, leaves: Leaves | None = None) -> Follow:
    """For `trees`: only what a channel of a material's surface depends on; `leaves` are as of `shader_inputs`."""

    def follow(socket: bpy.types.NodeSocket) -> bool:
        node = socket.node
        if node.type == "OUTPUT_MATERIAL":
            return socket.name == "Surface"
        if node.type == "OUTPUT_AOV":
            return channel == f"aov {socket.name}"
        if node.type == "BUMP" and channel == "height":
            return socket.name == "Height"
        if not is_shader(node):
            return True
        names = shader_inputs(node, channel, leaves)
        return isinstance(names, tuple) and socket.name in names

    return follow


def apply(found: list[Tree], description: list[dict[str, Any]]) -> None:
    """Give a copy of the trees the values of `description`: those that animation, drivers and scripts had set."""
    for tree, described in zip(found, description, strict=True):
        tree.tree.animation_data_clear()
        for node in tree.nodes:
            known = described[node.name]
            for socket in node.inputs:
                _set(socket, "default_value", known["inputs"].get(socket.identifier, {}).get("value"))
            for socket in node.outputs:
                _set(socket, "default_value", known["outputs"].get(socket.identifier))
            _set_struct(node, known["own"], 0)


def _set_struct(struct: Any, known: dict[str, Any], depth: int) -> None:
    for name, value in known.items():
        prop = struct.bl_rna.properties.get(name)
        if prop is None:
            continue
        if prop.type in _SCALARS:
            if not prop.is_readonly:
                _set(struct, name, value)
        elif prop.type == "COLLECTION" and depth < _DEEPEST:
            items = list(getattr(struct, name))
            for item, part in zip(items, value):
                _set_struct(item, part, depth + 1)
        elif prop.type == "POINTER" and isinstance(value, dict) and depth < _DEEPEST:
            own = getattr(struct, name)
            if own is not None and not isinstance(own, bpy.types.ID):
                _set_struct(own, value, depth + 1)


def _set(owner: Any, name: str, value: Any) -> None:
    """Set a property where it differs; what Blender refuses is as in the file."""
    if value is None or not hasattr(owner, name) or isinstance(getattr(owner, name), bpy.types.ID):
        return
    if _plain(getattr(owner, name)) != value:
        with contextlib.suppress(TypeError, ValueError, AttributeError):
            setattr(owner, name, value)
