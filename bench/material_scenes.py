"""Small scenes for bench_materials.py, one per feature, and two of many; built inside Blender, see composed_job.py."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
from bsdf_scenes import BSDFS
from composed_job import add_light, ball, camera, cube, finish, floor, material, monkey, subject, world
from feature_scenes import FEATURES
from image_scenes import IMAGES
from scene_nodes import look, node, painted_image

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


def stage() -> None:
    """Grey floor, a sun, an even sky, a camera."""
    floor(material("Floor", (0.5, 0.5, 0.5), 0.7))
    add_light("SUN", 2.5, (2.5, -2, 3), angle=math.radians(8))
    world((0.7, 0.85, 1.0), 0.3)
    camera((0.5, -3.6, 1.6), lens=72)


def waves(normals: bool, size: int = 256) -> bpy.types.Image:
    y, x = (np.mgrid[0:size, 0:size] + 0.5) / size * 2 * np.pi * 12
    if not normals:
        return painted_image("Heights", (0.5 + 0.25 * np.sin(x) * np.sin(y))[..., None].repeat(3, 2), False)
    n = np.stack((-0.5 * np.cos(x) * np.sin(y), -0.5 * np.sin(x) * np.cos(y), np.ones_like(x)), -1)
    return painted_image("Normals", n / np.linalg.norm(n, axis=-1, keepdims=True) / 2 + 0.5, False)


def gltf(path: Path, height: float) -> None:
    """The parts of a file, as Blender imports them, on the ground."""
    before = set(bpy.data.objects)
    bpy.ops.import_scene.gltf(filepath=str(path))
    made = [obj for obj in bpy.data.objects if obj not in before]
    corners = np.array([obj.matrix_world @ __import__("mathutils").Vector(c) for obj in made for c in obj.bound_box])
    scale = height / np.ptp(corners[:, 2])
    for obj in made:
        if obj.parent is None:
            obj.scale = [scale * s for s in obj.scale]
            obj.location = scale * (np.array(obj.location) - (*corners.mean(0)[:2], corners[:, 2].min()))


def helmet(job: dict) -> None:
    """A file with normal maps, metallic and roughness maps, five materials."""
    gltf(EXAMPLES / "helmet" / "FlightHelmet.gltf", 1.4)
    stage()


def statue(job: dict) -> None:
    """A gilded statue with a normal map."""
    gltf(EXAMPLES / "cat" / "egyptian_cat.glb", 1.4)
    stage()
    # Its bumps are much smaller than a pixel and polished: 16 places leave noise that no number of samples takes out.
    job["subpixels"] = 128


def normal_map(job: dict) -> None:
    """A normal map on Suzanne."""
    tree, principled = look("Bumpy", Base_Color=(0.7, 0.5, 0.35, 1), Roughness=0.4)
    image = node(tree, "TexImage", image=waves(True))
    mapped = node(tree, "NormalMap", Strength=0.8, Color=image.outputs["Color"])
    tree.links.new(mapped.outputs[0], principled.inputs["Normal"])
    monkey("Monkey", "Bumpy")
    stage()


def bump(job: dict) -> None:
    """Heights on Suzanne."""
    tree, principled = look("Bumpy", Base_Color=(0.35, 0.5, 0.7, 1), Roughness=0.4)
    image = node(tree, "TexImage", image=waves(False))
    bumped = node(tree, "Bump", Strength=0.6, Distance=0.05, Height=image.outputs["Color"])
    tree.links.new(bumped.outputs[0], principled.inputs["Normal"])
    monkey("Monkey", "Bumpy")
    stage()


def colours(job: dict) -> None:
    """A colour attribute of the corners, a float attribute of the points as roughness."""
    tree, principled = look("Painted")
    colour = node(tree, "VertexColor", layer_name="Paint")
    tree.links.new(colour.outputs["Color"], principled.inputs["Base Color"])
    rough = node(tree, "Attribute", attribute_name="Rough")
    tree.links.new(rough.outputs[2], principled.inputs["Roughness"])
    mesh = monkey("Monkey", "Painted").data
    rng = np.random.default_rng(4)
    faces = rng.uniform(0.1, 0.9, (len(mesh.polygons), 3))
    count = np.array([len(p.vertices) for p in mesh.polygons])
    values = np.ones((len(mesh.loops), 4), np.float32)
    values[:, :3] = np.repeat(faces, count, axis=0)
    mesh.attributes.new("Paint", "FLOAT_COLOR", "CORNER").data.foreach_set("color", values.ravel())
    height = np.array([v.co.z for v in mesh.vertices], np.float32)
    mesh.attributes.new("Rough", "FLOAT", "POINT").data.foreach_set("value", 0.15 + 0.7 * (height > 0))
    stage()


def coordinates(job: dict) -> None:
    """An image by object coordinates, another by generated ones, a third by a second UV map."""
    tree, principled = look("Placed", Roughness=0.5)
    rng = np.random.default_rng(6)
    tiles = painted_image("Tiles", np.kron(rng.uniform(0.2, 0.9, (8, 8, 3)), np.ones((8, 8, 1))), True)
    places = node(tree, "TexCoord")
    moved = node(tree, "Mapping", Vector=places.outputs["Object"], Rotation=(0.3, 0.2, 0.5), Scale=(1.5, 1.2, 1))
    image = node(tree, "TexImage", image=tiles, Vector=moved.outputs[0])
    tree.links.new(image.outputs["Color"], principled.inputs["Base Color"])
    rough = node(tree, "TexImage", image=tiles, Vector=places.outputs["Generated"])
    tree.links.new(rough.outputs["Color"], principled.inputs["Roughness"])
    monkey("Monkey", "Placed")
    stage()


def leaves(job: dict) -> None:
    """Cards with cut-out leaves, one in front of the other, and their shadows."""
    tree, principled = look("Leaf", Roughness=0.6)
    y, x = (np.mgrid[0:128, 0:128] + 0.5) / 128 - 0.5
    inside = (np.abs(x) < 0.42 * np.sqrt(np.clip(0.25 - y * y, 0, None)) * 2 * (1 + 0.2 * np.cos(40 * y))).astype(float)
    green = np.stack([0.2 + 0.3 * (y + 0.5), 0.5 + 0.2 * x, 0.15 + 0 * x, inside], -1)
    image = node(tree, "TexImage", image=painted_image("Leaf", green, True))
    tree.links.new(image.outputs["Color"], principled.inputs["Base Color"])
    tree.links.new(image.outputs["Alpha"], principled.inputs["Alpha"])
    rng = np.random.default_rng(1)
    for i in range(24):
        place = (*rng.uniform(-0.9, 0.9, 2), rng.uniform(0.3, 1.4))
        bpy.ops.mesh.primitive_plane_add(size=0.6, location=place, rotation=rng.uniform(-1.2, 1.2, 3))
        finish(f"Leaf {i}", bpy.data.materials["Leaf"])
    stage()


def veil(job: dict) -> None:
    """Half transparent balls before a cube, by a number and by Mix Shader."""
    look("Veil", Base_Color=(0.8, 0.3, 0.2, 1), Alpha=0.4)
    ball(bpy.data.materials["Veil"], 0.45, (-0.5, -0.4, 0.5))
    tree, principled = look("Mixed", Base_Color=(0.2, 0.4, 0.8, 1), Roughness=0.2)
    clear = node(tree, "BsdfTransparent", Color=(1, 1, 1, 1))
    mixed = node(tree, "MixShader", Fac=0.35)
    tree.links.new(clear.outputs[0], mixed.inputs[1])
    tree.links.new(principled.outputs[0], mixed.inputs[2])
    tree.links.new(mixed.outputs[0], tree.nodes["Material Output"].inputs["Surface"])
    ball(bpy.data.materials["Mixed"], 0.45, (0.5, -0.4, 0.5))
    cube(material("Cube", (0.6, 0.6, 0.2)), 0.8, (0, 0.7, 0.4), 0.4)
    stage()


def sky(job: dict) -> None:
    """A Sky Texture with its sun."""
    floor(material("Floor", (0.5, 0.5, 0.5), 0.7))
    monkey("Monkey", material("Clay", (0.7, 0.6, 0.5), 0.3).name)
    world()
    tree = bpy.context.scene.world.node_tree
    texture = node(tree, "TexSky")
    kinds = [item.identifier for item in texture.bl_rna.properties["sky_type"].enum_items]
    texture.sky_type = next(kind for kind in ("MULTIPLE_SCATTERING", "NISHITA") if kind in kinds)
    texture.sun_elevation, texture.sun_rotation = math.radians(35), math.radians(130)
    tree.links.new(texture.outputs[0], tree.nodes["Background"].inputs["Color"])
    tree.nodes["Background"].inputs["Strength"].default_value = 0.025
    camera((0.5, -3.6, 1.6), lens=72)


def procedural_world(job: dict) -> None:
    """Noise and a gradient around a clay monkey and a metal ball."""
    floor(material("Floor", (0.5, 0.5, 0.5), 0.7))
    monkey("Monkey", material("Clay", (0.7, 0.6, 0.5), 0.5).name, (-0.4, 0, 0.6))
    ball(material("Metal", (0.9, 0.8, 0.6), 0.25, 1.0), 0.4, (0.75, -0.2, 0.4))
    world()
    tree = bpy.context.scene.world.node_tree
    places = node(tree, "TexCoord")
    noise = node(tree, "TexNoise", Scale=3.0, Vector=places.outputs["Generated"])
    ramp = node(tree, "ValToRGB", Fac=noise.outputs[0])
    ramp.color_ramp.elements[0].color, ramp.color_ramp.elements[1].color = (0.02, 0.05, 0.2, 1), (2.0, 1.4, 0.8, 1)
    tree.links.new(ramp.outputs[0], tree.nodes["Background"].inputs["Color"])
    tree.nodes["Background"].inputs["Strength"].default_value = 0.7
    camera((0.5, -3.6, 1.6), lens=72)


def procedural(job: dict) -> None:
    """Voronoi cells by UV as colour, noise as roughness."""
    tree, principled = look("Cells")
    places = node(tree, "TexCoord")
    cells = node(tree, "TexVoronoi", Scale=14.0, Vector=places.outputs["UV"])
    noise = node(tree, "TexNoise", Scale=9.0, Vector=places.outputs["UV"])
    tree.links.new(cells.outputs["Color"], principled.inputs["Base Color"])
    tree.links.new(noise.outputs[0], principled.inputs["Roughness"])
    monkey("Monkey", "Cells")
    stage()


def procedural_bump(job: dict) -> None:
    """Noise and Voronoi cells as heights, one Bump node after the other, by UV and by Generated coordinates."""
    tree, principled = look("Rough", Base_Color=(0.5, 0.42, 0.35, 1), Roughness=0.35)
    cells = node(tree, "TexVoronoi", Scale=9.0, Vector=node(tree, "TexCoord").outputs["UV"])
    noise = node(tree, "TexNoise", Scale=7.0, Detail=1.0)
    first = node(tree, "Bump", Strength=0.9, Distance=0.15, Height=cells.outputs["Distance"])
    second = node(tree, "Bump", Strength=0.8, Distance=0.3, Height=noise.outputs[0], Normal=first.outputs[0])
    tree.links.new(second.outputs[0], principled.inputs["Normal"])
    monkey("Monkey", "Rough")
    stage()


def forest(job: dict) -> None:
    """Leaves over a statue with a normal map and a captured object, in a sky."""
    leaves(job)
    bpy.data.objects.remove(bpy.data.objects["Floor"])
    gltf(EXAMPLES / "cat" / "egyptian_cat.glb", 1.1)
    captured = subject(job["asset"], 0.6)
    captured.location.x, captured.location.y = 1.1, 0.3
    bpy.data.objects.remove(bpy.data.objects["Camera"])
    bpy.data.objects.remove(bpy.data.objects["Sun"])
    sky(job)
    bpy.data.objects.remove(bpy.data.objects["Monkey"])


def workshop(job: dict) -> None:
    """A helmet, painted, bumpy and procedural monkeys, a captured object; four lamps and a world of noise."""
    procedural(job)
    for name in ("Floor", "Sun", "Camera", "Monkey"):
        bpy.data.objects.remove(bpy.data.objects[name])
    procedural_world(job)
    for name in ("Camera", "Monkey", "Ball"):
        bpy.data.objects.remove(bpy.data.objects[name])
    gltf(EXAMPLES / "helmet" / "FlightHelmet.gltf", 1.2)
    captured = subject(job["asset"], 0.6)
    captured.location.x = -1.2
    tree, principled = look("Bumpy", Base_Color=(0.35, 0.5, 0.7, 1), Roughness=0.4)
    bumped = node(
        tree, "Bump", Strength=0.6, Distance=0.05, Height=node(tree, "TexImage", image=waves(False)).outputs[0]
    )
    tree.links.new(bumped.outputs[0], principled.inputs["Normal"])
    monkey("Bumpy", "Bumpy", (1.1, 0.5, 0.6), 0.4)
    monkey("Cells", "Cells", (-0.4, 1.2, 0.6), -0.3)
    add_light("AREA", 60, (2, -2, 3), size=1.0)
    add_light("POINT", 30, (-2, -1, 2), shadow_soft_size=0.2)
    add_light("SPOT", 90, (0, -3, 3), spot_size=math.radians(60), shadow_soft_size=0.15)
    add_light("SUN", 0.6, (3, 2, 4), angle=math.radians(5))
    camera((0.3, -4.6, 1.9))


SCENES: dict[str, Callable[[dict], None]] = {
    made.__name__: made
    for made in (
        helmet, statue, normal_map, bump, colours, coordinates, leaves, veil, sky, procedural_world, procedural,
        procedural_bump, forest,
        workshop,
    )
} | BSDFS | IMAGES | FEATURES  # fmt: skip
