"""Small scenes for bench_materials.py: light linking, groups, passes, cameras, blur, painted channels, shading."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable

import bpy
import numpy as np
from bsdf_scenes import PASSED, balls, principled, stage, surface
from composed_job import add_light, ball, camera, cube, finish, floor, material, monkey, subject, world
from scene_nodes import look


def linked(*objects: bpy.types.Object, state: str = "INCLUDE") -> bpy.types.Collection:
    """A linking collection that includes or excludes objects."""
    made = bpy.data.collections.new("Linked")
    for obj in objects:
        made.objects.link(obj)
        made.collection_objects[-1].light_linking.link_state = state
    return made


def panel(at: tuple[float, float, float], strength: float) -> bpy.types.Object:
    """A square mesh that glows, towards the middle."""
    bpy.ops.mesh.primitive_plane_add(size=0.9, location=at, rotation=(0, 0.9 * np.sign(at[0]), 0))
    return finish("Panel", material("Panel", (0.1, 0.1, 0.1), emission=strength))


def three() -> tuple[bpy.types.Object, ...]:
    """Floor, Suzanne, a ball and a cube, before a faint sky; a camera."""
    ground = floor(material("Floor", (0.6, 0.6, 0.6), 0.7))
    material("Clay", (0.7, 0.6, 0.5), 0.4)
    head = monkey("Monkey", "Clay", (-0.75, 0, 0.5), 0.4)
    middle = ball(material("Ball", (0.6, 0.7, 0.5), 0.4), 0.35, (0.15, -0.3, 0.35))
    block = cube(material("Cube", (0.6, 0.5, 0.7), 0.4), 0.55, (0.85, 0.1, 0.28), 0.4)
    world((0.7, 0.85, 1.0), 0.05)
    camera((0.4, -4.2, 2.0), (0, 0, 0.4), lens=60)
    return ground, head, middle, block


def wall() -> None:
    """A wall behind, before which all edges are compared: those before an empty film are not."""
    bpy.ops.mesh.primitive_plane_add(size=12, location=(0, 2.2, 2), rotation=(math.pi / 2, 0, 0))
    finish("Wall", material("Wall", (0.35, 0.45, 0.55), 0.8))


def light_linking(job: dict) -> None:
    """A spot that lights floor and Suzanne, an area light that leaves out the floor, a panel for ball and cube."""
    ground, head, middle, block = three()
    spot = add_light("SPOT", 150, (-2, -2, 3), spot_size=math.radians(70), shadow_soft_size=0.1, color=(1, 0.7, 0.4))
    area = add_light("AREA", 60, (2, -2, 2.5), size=0.8, color=(0.4, 0.6, 1))
    glow = panel((-1.8, 0.2, 1.1), 10.0)
    spot.light_linking.receiver_collection = linked(ground, head)
    area.light_linking.receiver_collection = linked(ground, state="EXCLUDE")
    glow.light_linking.receiver_collection = linked(middle, block)


def shadow_linking(job: dict) -> None:
    """Shadow of the cube alone in a sun, of all but the ball in a lamp's light, of the ball in that of a panel."""
    _, _, middle, block = three()
    sun = add_light("SUN", 0.8, (2.5, -2, 3), angle=math.radians(4))
    lamp = add_light("POINT", 35, (-1.5, -2, 2.2), shadow_soft_size=0.1, color=(1, 0.7, 0.4))
    glow = panel((1.6, -0.6, 1.0), 5.0)
    sun.light_linking.blocker_collection = linked(block)
    lamp.light_linking.blocker_collection = linked(middle, state="EXCLUDE")
    glow.light_linking.blocker_collection = linked(middle)


def light_groups(job: dict) -> None:
    """A sun of no group; a lamp, the sky and a panel with one each."""
    three()
    scene = bpy.context.scene
    for name in ("lamps", "sky", "glow"):
        scene.view_layers[0].lightgroups.add(name=name)
    add_light("SUN", 1.0, (2.5, -2, 3), angle=math.radians(4))
    add_light("POINT", 60, (-1.5, -2, 2.2), shadow_soft_size=0.1, color=(1, 0.7, 0.4)).lightgroup = "lamps"
    panel((1.6, -0.6, 1.0), 8.0).lightgroup = "glow"
    scene.world.lightgroup = "sky"
    scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.4


def light_passes(job: dict) -> None:
    """Clay, a metal ball, a frosted pane before a lamp, a leaf that light shines through, a panel that glows."""
    three()
    look("Metal", Base_Color=(0.9, 0.7, 0.4, 1), Roughness=0.3, Metallic=0.8)
    bpy.data.objects["Ball"].data.materials[0] = bpy.data.materials["Metal"]
    bpy.ops.mesh.primitive_plane_add(size=0.6, location=(0.75, 0.8, 0.9), rotation=(1.5, 0, -0.1))
    finish("Pane", principled("Frosted", Base_Color=(0.6, 0.85, 0.7, 1), Roughness=0.3, Transmission_Weight=0.8))
    bpy.ops.mesh.primitive_plane_add(size=0.5, location=(0.05, 0.5, 0.95), rotation=(1.3, 0.2, 0.3))
    finish("Leaf", surface("Leaf", "BsdfTranslucent", Color=(0.4, 0.7, 0.2, 1)))
    bpy.ops.mesh.primitive_plane_add(size=0.4, location=(-0.3, 0.9, 1.1), rotation=(1.2, 0, 0))
    finish("Panel", material("Panel", (0.1, 0.1, 0.1), emission=1.0))
    add_light("AREA", 12, (1.2, 2.6, 0.9), (0.7, 0, 0.9), size=0.8)
    add_light("SUN", 0.8, (-1.5, -2, 3), angle=math.radians(6))
    # Cycles counts the bounces of each kind by itself, ours count together: with as many it is all the same.
    job["passed"], job["bounces"] = PASSED, 8
    layer = bpy.context.scene.view_layers[0]
    for lobe in ("diffuse", "glossy", "transmission"):
        for part in ("direct", "indirect", "color"):
            setattr(layer, f"use_pass_{lobe}_{part}", True)
    layer.use_pass_emit = True


def around() -> bpy.types.Camera:
    """A ring of balls, cubes and monkeys around a panoramic camera; its data."""
    stage()
    looks = [material(f"Look {i}", c, 0.4) for i, c in enumerate(((0.8, 0.3, 0.2), (0.2, 0.6, 0.3), (0.3, 0.4, 0.8)))]
    for i in range(9):
        angle, distance = 2 * math.pi * i / 9, 1.5 + 0.3 * (i % 2)
        at = (distance * math.cos(angle), distance * math.sin(angle), 0.55)
        if i % 3 == 0:
            monkey(f"Monkey {i}", looks[i // 3].name, at, angle + math.pi / 2)
        elif i % 3 == 1:
            ball(looks[i // 3], 0.45, at)
        else:
            cube(looks[i // 3], 0.7, at, angle)
    view = bpy.context.scene.camera
    view.location, view.rotation_euler = (0, 0, 0.9), (1.0, 0.1, 0.4)
    view.data.type = "PANO"
    return view.data


def equirectangular(job: dict) -> None:
    """All around."""
    around().panorama_type = "EQUIRECTANGULAR"


def equidistant(job: dict) -> None:
    """A fisheye of 200 degrees."""
    lens = around()
    lens.panorama_type, lens.fisheye_fov = "FISHEYE_EQUIDISTANT", math.radians(200)


def equisolid(job: dict) -> None:
    """A fisheye lens of 10 mm, as is common."""
    lens = around()
    lens.panorama_type, lens.fisheye_lens, lens.fisheye_fov = "FISHEYE_EQUISOLID", 10.0, math.radians(180)


def straight(action: bpy.types.Action) -> None:
    """Let keyframes be joined by straight lines."""
    for curve in action.layers[0].strips[0].channelbags[0].fcurves:
        for key in curve.keyframe_points:
            key.interpolation = "LINEAR"


def blurred(steps: int) -> bpy.types.Scene:
    """The scene at frame 2, with the shutter open from a half frame before to a half after."""
    scene = bpy.context.scene
    scene.frame_set(2)
    scene.render.use_motion_blur, scene.render.motion_blur_shutter = True, 1.0
    scene.drgs.blur_steps = steps
    return scene


def motion_blur(job: dict) -> None:
    """A ball flies, Suzanne turns, a cube grows."""
    _, head, middle, block = three()
    wall()
    for frame, x, turn, scale in ((1, -0.2, 0.0, 0.8), (3, 0.5, 0.9, 1.2)):
        middle.location.x, head.rotation_euler.z, block.scale = x, turn, (scale,) * 3
        for obj, path in ((middle, "location"), (head, "rotation_euler"), (block, "scale")):
            obj.keyframe_insert(path, frame=frame)
    for obj in (head, middle, block):
        straight(obj.animation_data.action)
    add_light("SUN", 2.5, (2.5, -2, 3), angle=math.radians(8))
    blurred(64)


def deform_blur(job: dict) -> None:
    """Suzanne bends by a shape key."""
    _, head, _, _ = three()
    wall()
    head.shape_key_add(name="Basis")
    bent = head.shape_key_add(name="Bent")
    for point in bent.data:
        x, y, z = point.co
        point.co = (x + 0.8 * z, y, z * 1.4 + 0.5 * x * x)
    for frame, value in ((1, 0.0), (3, 1.0)):
        bent.value = value
        bent.keyframe_insert("value", frame=frame)
    straight(head.data.shape_keys.animation_data.action)
    add_light("SUN", 2.5, (2.5, -2, 3), angle=math.radians(8))
    blurred(64)


def depth_of_field(job: dict) -> None:
    """The ball in the middle is sharp, what is before and behind it is not; five blades."""
    _, head, middle, block = three()
    wall()
    head.location.y, block.location.y = 1.2, -1.4
    add_light("SUN", 2.5, (2.5, -2, 3), angle=math.radians(8))
    lens = bpy.context.scene.camera.data.dof
    lens.use_dof, lens.focus_object, lens.aperture_fstop = True, middle, 0.09
    lens.aperture_blades, lens.aperture_rotation = 5, 0.3
    bpy.context.scene.drgs.blur_steps = 128


def subsurface(job: dict) -> None:
    """Light that scatters below the surface, by Christensen-Burley, a millimetre at most: what is left is diffuse."""
    colours = (0.8, 0.5, 0.4, 1), (0.4, 0.6, 0.3, 1), (0.7, 0.7, 0.75, 1)
    skins = [principled(f"Skin {i}", Base_Color=c, Subsurface_Weight=1.0) for i, c in enumerate(colours)]
    for skin in skins:
        node = skin.node_tree.nodes["Principled BSDF"]
        node.subsurface_method, node.inputs["Subsurface Scale"].default_value = "BURLEY", 1e-3
    balls(*skins)


def painted(job: dict, **channels: Callable[[np.ndarray], np.ndarray]) -> bpy.types.Object:
    """The DR-GS object with attributes of its material channels, of its vertices' places from -1 to 1."""
    obj = subject(job["asset"], 0.6)
    places = np.array([v.co for v in obj.data.vertices], np.float32)
    places = 2 * (places - places.min(0)) / np.ptp(places, axis=0) - 1
    package = type(bpy.context.scene.drgs).__module__.removesuffix(".properties")
    for name, values in channels.items():
        bpy.ops.drgs.paint(channel=name)
        bpy.ops.object.mode_set(mode="OBJECT")
        importlib.import_module(f"{package}.mesh_arrays").write_channel(obj.data, name, values(places))
    importlib.import_module(f"{package}.viewport_material").update_viewport_material(obj.data)
    return obj


def painted_light(job: dict) -> None:
    """A DR-GS object that glows above and lets light pass on one side, before a cube."""
    painted(
        job,
        emission=lambda p: np.clip(p[:, 2:], 0, 1) * np.float32([0.8, 0.4, 0.15]),
        opacity=lambda p: np.clip(0.5 + 0.8 * p[:, 0], 0, 1),
    )
    cube(material("Cube", (0.2, 0.3, 0.7), 0.4), 0.7, (-0.3, 1.2, 0.35), 0.4)
    wall()
    stage()


def painted_lobes(job: dict) -> None:
    """A DR-GS object that is varnished on one side and reflects nothing below."""
    painted(job, coat=lambda p: np.clip(0.5 + 2 * p[:, 0], 0, 1), specular=lambda p: np.clip(0.5 + 1.5 * p[:, 2], 0, 1))
    stage()


def terminator(job: dict) -> None:
    """A coarse ball and an undivided Suzanne, smooth, with Blender's own offsets of the shadow terminator."""
    floor(material("Floor", (0.5, 0.5, 0.5), 0.7))
    bpy.ops.mesh.primitive_uv_sphere_add(segments=16, ring_count=10, radius=0.45, location=(-0.55, 0, 0.5))
    coarse = finish("Ball", material("Clay", (0.8, 0.7, 0.6), 0.4), smooth=True)
    bpy.ops.mesh.primitive_monkey_add(size=1.0, location=(0.5, 0, 0.5), rotation=(0, 0, 0.3))
    for obj in (coarse, finish("Monkey", bpy.data.materials["Clay"], smooth=True)):
        obj["own_terminator"] = True
    add_light("SUN", 2.5, (2.5, -0.4, 1.5), angle=math.radians(1))
    add_light("POINT", 40, (-1.5, -1.5, 1.6), shadow_soft_size=0.05)
    world((0.7, 0.85, 1.0), 0.05)
    camera((0.2, -3.6, 1.4), (0, 0, 0.5), lens=62)


def hair(job: dict) -> None:
    """The DR-GS object beside a head of brown particle hair, with children, and a tuft of fair hair curves."""
    subject(job["asset"], 0.5).location.x -= 0.55
    look("Brown", Base_Color=(0.2, 0.09, 0.035, 1), Roughness=0.4)
    look("Fair", Base_Color=(0.75, 0.6, 0.35, 1), Roughness=0.5)
    head = ball(bpy.data.materials["Brown"], 0.36, (0.62, -0.1, 0.75))
    group = head.vertex_groups.new(name="Scalp")
    group.add([v.index for v in head.data.vertices if v.co.z > 0.02 or v.co.y > 0.1], 1.0, "REPLACE")
    with bpy.context.temp_override(object=head, active_object=head):
        bpy.ops.object.particle_system_add()
    system = head.particle_systems[0]
    system.vertex_group_density = "Scalp"
    strands = system.settings
    strands.type, strands.count, strands.hair_length, strands.radius_scale = "HAIR", 250, 0.5, 0.006
    strands.use_advanced_hair, strands.normal_factor, strands.object_align_factor = True, 0.03, (0.0, 0.0, -0.025)
    strands.child_type, strands.rendered_child_count, strands.clump_factor = "INTERPOLATED", 20, 0.5
    strands.kink, strands.kink_amplitude, strands.tip_radius = "WAVE", 0.02, 0.3
    random, count, points = np.random.default_rng(0), 1500, 5
    roots = random.uniform(-0.25, 0.25, (count, 1, 3)) * (1, 1, 0)
    along = np.linspace(0, 1, points)[:, None]
    lean = random.normal(0, 0.08, (count, 1, 3)) + 0.8 * roots
    places = roots + along * (0, 0, 0.35) + along**2 * lean + (0.1, -0.9, 0)
    data = bpy.data.hair_curves.new("Tuft")
    data.add_curves([points] * count)
    data.attributes["position"].data.foreach_set("vector", places.astype(np.float32).ravel())
    radius = data.attributes.new("radius", "FLOAT", "POINT").data
    radius.foreach_set("value", np.tile(0.003 * (1 - 0.8 * along[:, 0]), count).astype(np.float32))
    data.materials.append(bpy.data.materials["Fair"])
    bpy.context.collection.objects.link(bpy.data.objects.new("Tuft", data))
    stage()


FEATURES: dict[str, Callable[[dict], None]] = {
    made.__name__: made
    for made in (
        light_linking, shadow_linking, light_groups, light_passes, equirectangular, equidistant, equisolid, motion_blur,
        deform_blur, depth_of_field, subsurface, painted_light, painted_lobes, terminator,
        hair,
    )
}  # fmt: skip
