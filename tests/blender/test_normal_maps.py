"""Normal and bump maps of ordinary meshes: what is exported, and that it is shaded as Cycles does."""

from __future__ import annotations

import math

import bpy
import numpy as np
import parity
import pytest
from scenes import mesh_object, sphere
from test_materials import add, material, picture, swatch

pytestmark = pytest.mark.blender_api


def unwrapped(obj: bpy.types.Object) -> bpy.types.Object:
    """A UV map around the object's Z axis, with a seam, twice around."""
    mesh = obj.data
    layer = mesh.uv_layers.new(name="Around")
    for polygon in mesh.polygons:
        angles = []
        for corner in polygon.loop_indices:
            x, y, z = mesh.vertices[mesh.loops[corner].vertex_index].co
            angles.append((math.atan2(y, x) / math.pi, math.acos(max(-1, min(1, z))) / math.pi))
        turn = [u + 2 if max(a[0] for a in angles) - u > 1 else u for u, _ in angles]
        for corner, u, (_, v) in zip(polygon.loop_indices, turn, angles):
            layer.uv[corner].vector = u, 1 - v
    return obj


def waves(name: str, normals: bool, size: int = 64) -> bpy.types.Image:
    """Bumps in a square, as their normals (tangent space) or their heights; as a file's pixels are, not as colours."""
    y, x = (np.mgrid[0:size, 0:size] + 0.5) / size * 2 * np.pi * 2
    height = 0.25 * np.sin(x) * np.sin(y)
    pixels = np.ones((size, size, 4), np.float32)
    if normals:
        n = np.stack((-0.6 * np.cos(x) * np.sin(y), -0.6 * np.sin(x) * np.cos(y), np.ones_like(x)), -1)
        pixels[..., :3] = n / np.linalg.norm(n, axis=-1, keepdims=True) / 2 + 0.5
    else:
        pixels[..., :3] = (height + 0.5)[..., None]
    image = bpy.data.images.new(name, size, size, alpha=True)
    image.colorspace_settings.name = "Non-Color"
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    return image


def ball(name: str, at: tuple[float, float, float], build) -> bpy.types.Object:
    """A smooth ball whose normal `build` makes of a tree."""
    tree, principled = material(name)
    principled.inputs["Base Color"].default_value = (0.7, 0.5, 0.35, 1)
    principled.inputs["Roughness"].default_value = 0.45
    tree.links.new(build(tree), principled.inputs["Normal"])
    obj = unwrapped(mesh_object(name, *sphere(24, 32)))
    obj.data.shade_smooth()
    obj.data.materials.append(bpy.data.materials[name])
    obj.location = at
    return obj


def tangent(tree, strength=1.0):
    image = bpy.data.images.get("Normals") or waves("Normals", True)
    return add(tree, "NormalMap", strength, add(tree, "TexImage", image=image), uv_map="Around")


def in_space(space):
    def build(tree):
        node = tangent(tree, 0.6).node
        node.space = space
        return node.outputs[0]

    return build


def bump(tree, before=None, invert=False):
    image = bpy.data.images.get("Heights") or waves("Heights", False)
    node = add(tree, "Bump", invert=invert).node
    node.inputs["Strength"].default_value, node.inputs["Distance"].default_value = 0.8, 0.3
    tree.links.new(add(tree, "TexImage", image=image), node.inputs["Height"])
    if before is not None:
        tree.links.new(before, node.inputs["Normal"])
    return node.outputs[0]


BALLS = {
    "tangent": tangent,
    "weak": lambda t: tangent(t, 0.4),
    "strong": lambda t: tangent(t, 1.8),
    "object": in_space("OBJECT"),
    "world": in_space("BLENDER_WORLD"),
    "bump": bump,
    "inverted": lambda t: bump(t, invert=True),
    "chained": lambda t: bump(t, tangent(t)),
    "mirrored": tangent,
}


def furnish(scene) -> None:
    for i, (name, build) in enumerate(BALLS.items()):
        obj = ball(name, (2.2 * (i % 3 - 1), 0, 2.2 * (i // 3 - 1)), build)
        obj.rotation_euler = (0.3, 0.2, 0.5 * i)
        if name == "mirrored":
            obj.scale = (-0.9, 0.8, 1)
            copy = obj.copy()  # several in one place each
            copy.location.x += 50
            scene.collection.objects.link(copy)
    camera = scene.camera
    camera.location, camera.data.type, camera.data.ortho_scale = (0, -9, 0), "ORTHO", 7
    parity.light(scene)


def details_of(frame) -> list:
    return frame.meshes[0].materials[0].details


def test_nodes_before_the_normal_are_exported_in_their_order(scene, export):
    ball("Ball", (0, 0, 0), lambda t: bump(t, tangent(t, 0.7), invert=True))
    frame, warnings = export()
    first, second = details_of(frame)
    assert not warnings and {i.name for i in frame.images} == {"Normals", "Heights"}
    assert (first.kind, first.texture.image, first.strength) == ("tangent", "Normals", pytest.approx(0.7))
    assert (second.kind, second.texture.channel) == ("bump", "luminance")
    assert (second.strength, second.distance) == (pytest.approx(0.8), pytest.approx(-0.3))
    # The named map is another layer than the active one, even where both are the same.
    (layer,) = frame.meshes[0].layers
    assert frame.meshes[0].uvs is not None and layer.name == first.tangents
    np.testing.assert_array_equal(layer.values, frame.meshes[0].uvs)


def test_what_is_no_map_is_named(scene, export):
    """Other nodes, Closest heights and missing images; plain heights are no bumps and say nothing."""
    for name, build in {
        "curves": lambda t: add(t, "Normal", label="The Odd One"),
        "closest": lambda t: add(t, "Bump", label="The Odd One"),
        "plain": lambda t: add(t, "Bump"),
        "gone": lambda t: add(t, "NormalMap", 1.0, add(t, "TexImage", label="The Odd One")),
    }.items():
        obj = ball(name, (0, 0, 0), build)
        if name == "closest":
            tree = obj.active_material.node_tree
            height = add(tree, "TexImage", image=picture(), interpolation="Closest")
            tree.links.new(height, next(n for n in tree.nodes if n.type == "BUMP").inputs["Height"])
        frame, warnings = export()
        assert len(warnings) == (name != "plain")
        assert all(f'Material "{name}", node "The Odd One"' in w for w in warnings)
        kinds = {"closest": ["bump"], "gone": ["tangent"]}.get(name, [])
        assert [d.kind for d in details_of(frame)] == kinds
        bpy.data.objects.remove(obj)


def test_loops_and_long_rows_of_bumps_end(scene, export):
    tree, principled = material("Loop")
    bumps = [add(tree, "Bump").node for _ in range(150)]
    heights = add(tree, "TexImage", image=picture())
    for before, after in zip(bumps, [*bumps[1:], bumps[0]]):
        tree.links.new(heights, before.inputs["Height"])
        tree.links.new(before.outputs[0], after.inputs["Normal"])
    tree.links.new(bumps[-1].outputs[0], principled.inputs["Normal"])
    swatch(bpy.data.materials["Loop"])
    frame, warnings = export()
    assert 0 < len(details_of(frame)) <= 100 and any("left out" in w for w in warnings)


def test_shaders_with_other_normals_are_named(scene, export):
    tree, principled = material("Two")
    tree.links.new(tangent(tree), principled.inputs["Normal"])
    diffuse = add(tree, "BsdfDiffuse").node
    mixed = add(tree, "MixShader", 0.3, principled.outputs[0], diffuse.outputs[0])
    tree.links.new(mixed, next(n for n in tree.nodes if n.type == "OUTPUT_MATERIAL").inputs["Surface"])
    unwrapped(swatch(bpy.data.materials["Two"]))
    frame, warnings = export()
    assert len(warnings) == 1 and "normal" in warnings[0] and [d.kind for d in details_of(frame)] == ["tangent"]
    mixed.node.inputs[0].default_value = 0.7
    frame, warnings = export()
    assert len(warnings) == 1 and not details_of(frame)
    tree.links.new(principled.inputs["Normal"].links[0].from_socket, diffuse.inputs["Normal"])
    frame, warnings = export()
    assert not warnings and [d.kind for d in details_of(frame)] == ["tangent"]


def test_curves_of_normal_maps_keep_their_bytes(scene, export):
    """A map with its green turned round, as nodes do it for those of DirectX: no byte is lost to an encoding."""
    image = waves("Normals", True)

    def flipped(tree):
        split = add(tree, "SeparateColor", add(tree, "TexImage", image=image)).node
        down = add(tree, "Invert", 1.0, split.inputs[0].links[0].from_socket)
        return add(tree, "NormalMap", 1.0, down)

    ball("Ball", (0, 0, 0), flipped)
    frame, warnings = export()
    (sent,), (detail,) = frame.images, details_of(frame)
    assert not warnings and detail.texture.image == sent.name and sent.encoding == "linear"
    plain = np.array(image.pixels[:]).reshape(64, 64, 4)[::-1]
    np.testing.assert_array_equal(sent.pixels[..., :3], 255 - np.rint(255 * plain[..., :3]).astype(int))


@pytest.mark.slow
@parity.needs_current_normals
def test_normal_and_bump_maps_look_as_in_cycles(scene, export):
    furnish(scene)
    parity.set_up(scene, 96)
    _, warnings = export()
    assert not warnings
    ours, theirs = parity.pictures(scene, "DRGS"), parity.pictures(scene, "CYCLES")
    assert parity.psnr(ours, theirs) > 40
    for i, name in enumerate(BALLS):
        row, column = 32 * (2 - i // 3), 32 * (i % 3)
        where = np.zeros((96, 96), bool)
        where[row : row + 32, column : column + 32] = True
        where &= (theirs[..., 3] > 0.999).all(axis=0)
        found = parity.psnr(ours, theirs, where)
        print(name, found)
        assert found > 38, name
