"""Small scenes for bench_materials.py, one per BSDF; see material_scenes.py."""

from __future__ import annotations

import math
from collections.abc import Callable

import bpy
import numpy as np
from composed_job import add_light, ball, camera, cube, finish, floor, material, world
from scene_nodes import look, node, painted_image

Tree = bpy.types.NodeTree

#: Surfaces that light passes, of a path: Blender's default, and what paths here allow.
PASSED = 12


def surface(name: str, kind: str, **values: object) -> bpy.types.Material:
    """A material of one shader node; `values` as of `scene_nodes.node`."""
    made = material(name)
    shader = node(made.node_tree, kind, **values)
    made.node_tree.links.new(shader.outputs[0], made.node_tree.nodes["Material Output"].inputs["Surface"])
    return made


def principled(name: str, **values: object) -> bpy.types.Material:
    look(name, **values)
    return bpy.data.materials[name]


def mixed(name: str, share: float | str, first: tuple, second: tuple) -> bpy.types.Material:
    """A mix, or with share "sum" the sum, of two shader nodes (kind, values)."""
    made = material(name)
    tree = made.node_tree
    joint = node(tree, "AddShader") if share == "sum" else node(tree, "MixShader", Fac=share)
    for (kind, values), socket in zip((first, second), joint.inputs[-2:], strict=True):
        tree.links.new(node(tree, kind, **values).outputs[0], socket)
    tree.links.new(joint.outputs[0], tree.nodes["Material Output"].inputs["Surface"])
    return made


def stage() -> None:
    """A checkered floor, a sun, an area light, an even sky, a camera."""
    tiles = np.kron((np.indices((16, 16)).sum(0) % 2)[..., None] * 0.5 + np.array((0.2, 0.25, 0.3)), np.ones((4, 4, 1)))
    tree, shader = look("Floor", Roughness=0.7)
    image = node(tree, "TexImage", image=painted_image("Tiles", tiles, True))
    tree.links.new(image.outputs["Color"], shader.inputs["Base Color"])
    floor(bpy.data.materials["Floor"])
    add_light("SUN", 1.5, (2.5, -2, 3), angle=math.radians(8))
    add_light("AREA", 60, (-2, -1.5, 2.5), size=1.5)
    world((0.7, 0.85, 1.0), 0.4)
    camera((0.4, -3.6, 1.6), (0, 0, 0.45), lens=60)


def balls(*materials: bpy.types.Material) -> None:
    """Balls in a row on the stage."""
    width = 0.95
    for i, made in enumerate(materials):
        ball(made, 0.42, (width * (i - (len(materials) - 1) / 2), 0, 0.45))
    stage()


def coat(job: dict) -> None:
    """Clear, rough and tinted coats over paint and metal."""
    red = {"Base_Color": (0.6, 0.08, 0.05, 1), "Roughness": 0.5}
    balls(
        principled("Clear", Coat_Weight=1.0, **red),
        principled("Rough", Coat_Weight=0.7, Coat_Roughness=0.3, Coat_IOR=1.8, **red),
        principled("Tinted", Metallic=1.0, Coat_Weight=1.0, Coat_Tint=(0.9, 0.6, 0.2, 1), Roughness=0.4),
    )


def sheen(job: dict) -> None:
    """Sheen over cloth, and the Sheen BSDF."""
    dark = {"Base_Color": (0.1, 0.05, 0.2, 1), "Roughness": 0.8}
    balls(
        principled("Soft", Sheen_Weight=1.0, Sheen_Roughness=0.5, **dark),
        principled("Tinted", Sheen_Weight=0.8, Sheen_Roughness=0.25, Sheen_Tint=(0.9, 0.6, 0.3, 1), **dark),
        surface("Node", "BsdfSheen", Color=(0.8, 0.7, 0.6, 1), Roughness=0.4),
    )


def glass(job: dict) -> None:
    """Smooth glass of several IOR and colours."""
    job["passed"] = PASSED
    clear = {"Transmission_Weight": 1.0, "Roughness": 0.0}
    balls(
        principled("Window", IOR=1.5, **clear, Base_Color=(1, 1, 1, 1)),
        principled("Diamond", IOR=2.4, **clear, Base_Color=(1, 1, 1, 1)),
        principled("Green", IOR=1.33, **clear, Base_Color=(0.4, 0.9, 0.5, 1)),
    )


def rough_glass(job: dict) -> None:
    """Frosted glass; half glass, half paint."""
    job["passed"] = PASSED
    balls(
        principled("Frosted", Transmission_Weight=1.0, Roughness=0.3, Base_Color=(1, 1, 1, 1)),
        principled("Milky", Transmission_Weight=1.0, Roughness=0.6, Base_Color=(0.9, 0.7, 0.5, 1)),
        principled("Half", Transmission_Weight=0.5, Roughness=0.2, Base_Color=(0.3, 0.5, 0.8, 1)),
    )


def thin_glass(job: dict) -> None:
    """A pane before a ball and a cube."""
    job["passed"] = PASSED
    pane = cube(principled("Pane", Transmission_Weight=1.0, Roughness=0.0, Base_Color=(1, 1, 1, 1)), 1, (0, -0.6, 0.6))
    pane.scale = (1.6, 0.04, 1.1)
    ball(material("Ball", (0.7, 0.3, 0.2)), 0.35, (-0.4, 0.3, 0.35))
    cube(material("Cube", (0.2, 0.4, 0.7)), 0.5, (0.5, 0.3, 0.25), 0.4)
    stage()


def anisotropy(job: dict) -> None:
    """Brushed metals: the Principled BSDF with its own tangents and turned, the Glossy BSDF."""
    metal = {"Metallic": 1.0, "Roughness": 0.35, "Base_Color": (0.9, 0.8, 0.7, 1)}
    balls(
        principled("Brushed", Anisotropic=0.8, **metal),
        principled("Turned", Anisotropic=0.8, Anisotropic_Rotation=0.25, **metal),
        surface("Node", "BsdfAnisotropic", Color=(0.7, 0.75, 0.8, 1), Roughness=0.4, Anisotropy=0.6),
    )


def metals(job: dict) -> None:
    """Rough metals with Blender's default distribution, Multiscatter GGX, one of them half a dielectric."""
    gold, red = (0.9, 0.65, 0.3, 1), (0.8, 0.15, 0.1, 1)
    made = [
        principled("Worn", Metallic=1.0, Roughness=0.5, Base_Color=gold),
        principled("Cast", Metallic=1.0, Roughness=0.9, Base_Color=gold),
        principled("Half", Metallic=0.5, Roughness=0.7, Base_Color=red),
    ]
    for one in made:
        one["multiscatter"] = True
    balls(*made)


def specular(job: dict) -> None:
    """IOR, specular level and tint of the glossy lobe, and rough diffuse light."""
    paint = {"Base_Color": (0.1, 0.2, 0.4, 1), "Roughness": 0.25}
    balls(
        principled("High", IOR=2.2, **paint),
        principled("Tinted", Specular_IOR_Level=1.0, Specular_Tint=(1.0, 0.5, 0.2, 1), **paint),
        principled("Dull", Specular_IOR_Level=0.0, **paint),
        surface("Clay", "BsdfDiffuse", Color=(0.7, 0.5, 0.4, 1), Roughness=1.0),
    )


def glass_nodes(job: dict) -> None:
    """The Glass, Refraction and Glossy BSDF."""
    job["passed"] = PASSED
    balls(
        surface("Glass", "BsdfGlass", distribution="GGX", Color=(0.7, 0.9, 0.8, 1), Roughness=0.1, IOR=1.45),
        surface("Refraction", "BsdfRefraction", distribution="GGX", Color=(0.9, 0.8, 0.7, 1), Roughness=0.15, IOR=1.3),
        surface("Glossy", "BsdfAnisotropic", distribution="GGX", Color=(0.4, 0.5, 0.6, 1), Roughness=0.3),
    )


def translucent(job: dict) -> None:
    """Light through a leaf: the Translucent BSDF alone, and mixed with diffuse light."""
    leaves = (
        surface("Lamp shade", "BsdfTranslucent", Color=(0.8, 0.6, 0.4, 1)),
        mixed("Leaf", 0.4, ("BsdfDiffuse", {"Color": (0.2, 0.5, 0.1, 1)}),
              ("BsdfTranslucent", {"Color": (0.5, 0.8, 0.2, 1)})),
    )  # fmt: skip
    for i, made in enumerate(leaves):
        at = (1.1 * i - 0.55, 0, 0.6)
        bpy.ops.mesh.primitive_plane_add(size=0.9, location=at, rotation=(1.2, 0, 0.5 - i))
        finish(made.name, made)
    stage()


def mixes(job: dict) -> None:
    """Mixed and added BSDFs: paint with a gloss, gloss added, glass and light."""
    red, white = {"Color": (0.6, 0.1, 0.05, 1)}, {"Color": (0.9, 0.9, 0.9, 1), "Roughness": 0.15}
    balls(
        mixed("Plastic", 0.2, ("BsdfDiffuse", red), ("BsdfAnisotropic", white)),
        mixed("Sum", "sum", ("BsdfDiffuse", red), ("BsdfSheen", {"Color": (0.5, 0.5, 0.9, 1), "Roughness": 0.4})),
        mixed("Glow", 0.7, ("Emission", {"Color": (1, 0.6, 0.2, 1), "Strength": 0.5}), ("BsdfGlass", white)),
    )


BSDFS: dict[str, Callable[[dict], None]] = {
    made.__name__: made
    for made in (
        coat, sheen, glass, rough_glass, thin_glass, anisotropy, metals, specular, glass_nodes, translucent, mixes,
    )
}  # fmt: skip
