"""The material of DR-GS objects for Blender's own engines: a Principled BSDF fed by the material attributes."""

from __future__ import annotations

from collections.abc import Collection

import bpy

from ..drgs_blender.core.asset import BASE_CHANNELS, OPTIONAL_CHANNELS

NAME = "DR-GS"
#: Custom property of images and materials of textures: what they were made of, and the optional channels they show.
KEY = "drgs_textures"
#: Custom property of images: their name in the asset that they came from.
IMAGE = "drgs_image"
#: Custom property of materials of textures: optional channels of which they have images, which their attributes leave.
PICTURED = "drgs_pictured"
#: Material channel -> (output of its attribute, input of the Principled BSDF).
_INPUTS = {
    "albedo": ("Color", "Base Color"),
    "roughness": ("Fac", "Roughness"),
    "metallic": ("Fac", "Metallic"),
    "opacity": ("Fac", "Alpha"),
    "emission": ("Color", "Emission Color"),
    "specular": ("Fac", "Specular IOR Level"),
    "coat": ("Fac", "Coat Weight"),
}


def viewport_material(channels: Collection[str] = ()) -> bpy.types.Material:
    """What Solid, Material Preview and Cycles show; one for all objects that have the same optional `channels`."""
    more = [name for name in OPTIONAL_CHANNELS if name in channels]
    name = " ".join([NAME, *more])
    material = bpy.data.materials.get(name)
    if material is not None and not material.library:
        return material
    material = bpy.data.materials.new(name)
    if material.node_tree is None:  # before Blender 5.0
        material.use_nodes = True
    surface = next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED")
    surface.distribution = "GGX"
    _show(material, [*BASE_CHANNELS, *more])
    return material


def is_viewport_material(material: bpy.types.Material) -> bool:
    """Whether a material is one of these, with textures or without."""
    return KEY in material or material.name.split(" ")[0] == NAME


def textured_material(material: bpy.types.Material, channels: Collection[str]) -> bpy.types.Material:
    """`material`, which shows textures, or that with the same textures that shows these optional `channels`."""
    base, _, shown = material[KEY].partition(" ")
    pictured = str(material.get(PICTURED, "")).split()
    more = [name for name in OPTIONAL_CHANNELS if name in channels and name not in pictured]
    if shown.split() == more:
        return material
    key = " ".join([base, *more])
    found = next((m for m in bpy.data.materials if m.get(KEY) == key and not m.library), None)
    if found is not None:
        return found
    made = material.copy()
    made[KEY] = key
    for node in [n for n in made.node_tree.nodes if n.type == "ATTRIBUTE" and n.attribute_name in OPTIONAL_CHANNELS]:
        made.node_tree.nodes.remove(node)
    _show(made, more, "emission" in pictured)
    return made


def update_viewport_material(mesh: bpy.types.Mesh) -> None:
    """Have those of these materials that `mesh` has show the channels that it has."""
    channels = {name for name in OPTIONAL_CHANNELS if name in mesh.attributes}
    for slot, material in enumerate(mesh.materials):
        if material is None or material.library:
            continue
        if slot == 0 and KEY not in material and is_viewport_material(material):
            mesh.materials[0] = viewport_material(channels)
        elif KEY in material:
            mesh.materials[slot] = textured_material(material, channels)


def _show(material: bpy.types.Material, channels: Collection[str], glows: bool = False) -> None:
    """Feed the Principled BSDF of a material with the attributes of channels; `glows`: it has an image of emission."""
    nodes, links = material.node_tree.nodes, material.node_tree.links
    surface = next(n for n in nodes if n.type == "BSDF_PRINCIPLED")
    surface.inputs["Emission Strength"].default_value = 1.0 if glows or "emission" in channels else 0.0
    for row, channel in enumerate(channels):
        output, target = _INPUTS[channel]
        attribute = nodes.new("ShaderNodeAttribute")
        attribute.attribute_name = attribute.label = channel
        attribute.location = (surface.location.x - 300, surface.location.y - 180 * row)
        links.new(attribute.outputs[output], surface.inputs[target])
