"""Materials that show an asset's textures in Blender: Solid, Material Preview and Cycles."""

from __future__ import annotations

import hashlib

import bpy
import numpy as np

from ..addon.viewport_material import IMAGE, KEY, PICTURED, update_viewport_material
from ..drgs_blender.core.asset.textures import (
    ALBEDO,
    COAT,
    COLOURED,
    EMISSION,
    FACTORS,
    METALLIC,
    NORMAL,
    OPACITY,
    ROUGHNESS,
    SLOTS,
    SPECULAR,
    MeshTextures,
)

_EXTENSIONS = ("REPEAT", "EXTEND", "MIRROR")
_CHANNELS = {"r": "Red", "g": "Green", "b": "Blue"}
_INPUTS = {
    ALBEDO: "Base Color", ROUGHNESS: "Roughness", METALLIC: "Metallic", NORMAL: "Normal", OPACITY: "Alpha",
    EMISSION: "Emission Color", SPECULAR: "Specular IOR Level", COAT: "Coat Weight",
}  # fmt: skip


def show_textures(mesh: bpy.types.Mesh, textures: MeshTextures) -> None:
    """Give a mesh with the triangles of an asset its UV map, and its faces their materials, behind those it has."""
    coordinates = mesh.uv_layers.new(name="UVMap")
    if coordinates is None:  # as many as Blender allows
        return
    coordinates.uv.foreach_set("vector", textures.uvs.ravel())
    first = len(mesh.materials)
    for k in range(len(textures.names)):
        mesh.materials.append(_material(textures, k, coordinates.name))
    index = np.where(textures.material < 0, 0, first + textures.material).astype(np.int32)
    mesh.polygons.foreach_set("material_index", index)
    mesh.update()
    update_viewport_material(mesh)


def _material(textures: MeshTextures, k: int, uv_map: str) -> bpy.types.Material:
    """Material `k`, the one that is there or a new one."""
    slots = textures.slots[k]
    images = {slot: _image(textures, int(slots[slot]), _space(slot, slots)) for slot in _INPUTS if slots[slot] >= 0}
    numbers = b"".join(a[k].tobytes() for a in (textures.factors, textures.transforms, textures.extensions))
    names = "".join(f"{slot} {image[KEY]} " for slot, image in images.items())
    key = hashlib.sha256(numbers + f"{names}{uv_map} {textures.names[k]}".encode()).hexdigest()
    found = next((m for m in bpy.data.materials if m.get(KEY) == key and not m.library), None)
    if found is not None:
        return found
    material = bpy.data.materials.new(textures.names[k] or "Textures")
    material[KEY] = key
    if material.node_tree is None:  # before Blender 5.0
        material.use_nodes = True
    surface = next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED")
    surface.distribution = "GGX"
    for slot, image in images.items():
        _plug(material.node_tree, surface, textures, (k, slot), image, uv_map)
    material[PICTURED] = " ".join(SLOTS[slot] for slot in images if slot >= OPACITY)
    for slot, attribute, output in (
        (ALBEDO, "albedo", "Color"),
        (ROUGHNESS, "roughness", "Fac"),
        (METALLIC, "metallic", "Fac"),
    ):
        if slot not in images:
            node = _node(material.node_tree, "ShaderNodeAttribute", surface, -300, slot)
            node.attribute_name = attribute
            material.node_tree.links.new(node.outputs[output], surface.inputs[_INPUTS[slot]])
    return material


def _plug(
    tree: bpy.types.NodeTree,
    surface: bpy.types.Node,
    textures: MeshTextures,
    place: tuple[int, int],
    image: bpy.types.Image,
    uv_map: str,
) -> None:
    """Nodes of one slot of a material: the image where it lies, times its factor."""
    k, slot = place
    links = tree.links
    texture = _node(tree, "ShaderNodeTexImage", surface, -900, slot)
    texture.image, texture.extension = image, _EXTENSIONS[textures.extensions[k, slot]]
    coordinates = _node(tree, "ShaderNodeUVMap", surface, -1500, slot)
    coordinates.uv_map = uv_map
    placed = coordinates.outputs["UV"]
    transform = textures.transforms[k, slot].astype(float)
    if not np.array_equal(transform, np.eye(2, 3)):
        placed = _moved(tree, surface, slot, placed, transform)
    links.new(placed, texture.inputs["Vector"])
    factors, value = textures.factors[k, FACTORS[slot]].tolist(), texture.outputs["Color"]
    channel = textures.channel(slot, int(textures.slots[k, slot]))
    if slot == NORMAL:
        bumps = _node(tree, "ShaderNodeNormalMap", surface, -300, slot)
        bumps.uv_map, bumps.inputs["Strength"].default_value = uv_map, factors[0]
        links.new(value, bumps.inputs["Color"])
        value = bumps.outputs["Normal"]
    elif channel == "rgb":
        if factors != [1.0, 1.0, 1.0]:
            tinted = _node(tree, "ShaderNodeVectorMath", surface, -300, slot)
            tinted.operation, tinted.inputs[1].default_value = "MULTIPLY", factors
            links.new(value, tinted.inputs[0])
            value = tinted.outputs["Vector"]
    else:
        value = texture.outputs["Alpha"]
        if channel != "a":
            parts = _node(tree, "ShaderNodeSeparateColor", surface, -550, slot)
            links.new(texture.outputs["Color"], parts.inputs["Color"])
            value = parts.outputs[_CHANNELS[channel]]
        if factors != [1.0]:
            scaled = _node(tree, "ShaderNodeMath", surface, -300, slot)
            scaled.operation, scaled.inputs[1].default_value = "MULTIPLY", factors[0]
            links.new(value, scaled.inputs[0])
            value = scaled.outputs["Value"]
    links.new(value, surface.inputs[_INPUTS[slot]])
    if slot == EMISSION:
        surface.inputs["Emission Strength"].default_value = 1.0


def _moved(
    tree: bpy.types.NodeTree,
    surface: bpy.types.Node,
    slot: int,
    coordinates: bpy.types.NodeSocket,
    transform: np.ndarray,
) -> bpy.types.NodeSocket:
    """Coordinates through a (2, 3) matrix: a dot product for each of u and v."""
    joined = _node(tree, "ShaderNodeCombineXYZ", surface, -1100, slot)
    for row in range(2):
        product = _node(tree, "ShaderNodeVectorMath", surface, -1300, slot + 0.4 * row)
        product.operation, product.inputs[1].default_value = "DOT_PRODUCT", (*transform[row, :2], 0.0)
        tree.links.new(coordinates, product.inputs[0])
        summed = _node(tree, "ShaderNodeMath", surface, -1200, slot + 0.4 * row)
        summed.operation, summed.inputs[1].default_value = "ADD", transform[row, 2]
        tree.links.new(product.outputs["Value"], summed.inputs[0])
        tree.links.new(summed.outputs["Value"], joined.inputs[row])
    return joined.outputs["Vector"]


def _node(tree: bpy.types.NodeTree, kind: str, surface: bpy.types.Node, x: float, row: float) -> bpy.types.Node:
    node = tree.nodes.new(kind)
    node.location = surface.location.x + x, surface.location.y - 320 * row
    return node


def _space(slot: int, slots: np.ndarray) -> str:
    """Colour space of an image in a slot; the alpha of an image of colours is the same in either."""
    return "sRGB" if slot in COLOURED or (slot == OPACITY and slots[slot] == slots[ALBEDO]) else "Non-Color"


def _image(textures: MeshTextures, number: int, space: str) -> bpy.types.Image:
    """An image with its file packed, the one that is there or a new one."""
    name, data = textures.files[number]
    key = f"{hashlib.sha256(data.tobytes()).hexdigest()} {space}"
    found = next((i for i in bpy.data.images if i.get(KEY) == key and not i.library), None)
    if found is not None:
        return found
    image = bpy.data.images.new(name, 1, 1)
    image.pack(data=data.tobytes(), data_len=len(data))
    image.source = "FILE"
    image.colorspace_settings.name = space
    image.alpha_mode = "CHANNEL_PACKED"
    image[KEY], image[IMAGE] = key, list(textures.images)[number]
    return image
