"""The material of DR-GS objects for Blender's own engines: a Principled BSDF fed by the material attributes."""

from __future__ import annotations

from collections.abc import Collection

import bpy

from ..drgs_blender.core.asset import BASE_CHANNELS, OPTIONAL_CHANNELS

NAME = "DR-GS"
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
    nodes, links = material.node_tree.nodes, material.node_tree.links
    surface = next(n for n in nodes if n.type == "BSDF_PRINCIPLED")
    surface.distribution = "GGX"
    surface.inputs["Emission Strength"].default_value = 1.0 if "emission" in more else 0.0
    for row, channel in enumerate([*BASE_CHANNELS, *more]):
        output, target = _INPUTS[channel]
        attribute = nodes.new("ShaderNodeAttribute")
        attribute.attribute_name = attribute.label = channel
        attribute.location = (surface.location.x - 300, surface.location.y - 180 * row)
        links.new(attribute.outputs[output], surface.inputs[target])
    return material


def update_viewport_material(mesh: bpy.types.Mesh) -> None:
    """Have the first slot of `mesh` show the channels that it has, if one of these materials is there."""
    material = mesh.materials[0] if mesh.materials else None
    if material is not None and material.name.split(" ")[0] == NAME and not material.library:
        mesh.materials[0] = viewport_material({name for name in OPTIONAL_CHANNELS if name in mesh.attributes})
