"""Passes of Blender's view layers: as those of Cycles, and what DR-GS does not make is told."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from scenes import part
from test_motion import layers_of
from test_panorama import room  # noqa: F401  a fixture

pytestmark = pytest.mark.blender_api

#: Passes of light, by the names of either Blender.
LIGHT = {
    "diffuse_direct": ("DiffDir", "Diffuse Direct"), "diffuse_indirect": ("DiffInd", "Diffuse Indirect"),
    "diffuse_color": ("DiffCol", "Diffuse Color"), "glossy_direct": ("GlossDir", "Glossy Direct"),
    "glossy_indirect": ("GlossInd", "Glossy Indirect"), "glossy_color": ("GlossCol", "Glossy Color"),
    "emit": ("Emit", "Emission"), "environment": ("Env", "Environment"),
}  # fmt: skip
THROUGH = {
    "transmission_direct": ("TransDir", "Transmission Direct"),
    "transmission_indirect": ("TransInd", "Transmission Indirect"),
    "transmission_color": ("TransCol", "Transmission Color"),
}  # fmt: skip
OTHERS = {"mist": ("Mist",), "uv": ("UV",), "material_index": ("IndexMA", "Material Index")}


def recombined(p: dict[str, np.ndarray]) -> np.ndarray:
    total = p["emit"] + p["environment"]
    for lobe in ("diffuse", "glossy", "transmission"):
        total = total + (p[f"{lobe}_direct"] + p[f"{lobe}_indirect"]) * p[f"{lobe}_color"]
    return total


@pytest.fixture
def passes(room, tmp_path):  # noqa: F811
    """Function that renders the room with an engine and returns its passes by the names of their switches."""
    layer = room.view_layers[0]
    for name in (*LIGHT, *THROUGH, *OTHERS):
        setattr(layer, f"use_pass_{name}", True)
    for index, material in enumerate(bpy.data.materials):
        material.pass_index = index + 1
    metal = bpy.data.materials["ball"].node_tree
    next(n for n in metal.nodes if n.type == "BSDF_PRINCIPLED").inputs["Metallic"].default_value = 0.4
    for name in ("floor", "left"):
        mesh = bpy.data.objects[name].data
        mesh.uv_layers.new(name="other")
        uvs = mesh.uv_layers.new(name="shown")
        uvs.active_render = True
        uvs.data.foreach_set("uv", np.float32([0, 0, 2, 0, 2, 1, 0, 1]))
    mist = room.world.mist_settings
    mist.start, mist.depth, mist.falloff = 1.0, 4.0, "QUADRATIC"
    lamp = bpy.data.objects["Lamp"]
    lamp.visible_camera = True
    lamp.location.z = 1.7
    room.camera.location, room.camera.rotation_euler = (-0.4, -2.6, 0.1), (1.5, 0.0, -0.1)
    room.camera.data.lens = 18

    def render(engine, bounces=1):
        cycles, settings = room.cycles, room.drgs
        cycles.device, cycles.samples, cycles.pixel_filter_type, cycles.filter_width = "CPU", 512, "BOX", 1.0
        cycles.use_adaptive_sampling = cycles.use_denoising = False
        cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = bounces
        cycles.max_bounces, cycles.transmission_bounces = bounces + 12 * (bounces > 1), 12
        cycles.sample_clamp_indirect = cycles.blur_glossy = 0.0
        settings.use_strategy_samples, settings.samples, settings.bounces = False, 512, bounces
        settings.subpixel_samples, settings.filter_width = 32, 0.0
        found = layers_of(room, engine, tmp_path)
        names = {**LIGHT, **THROUGH, **OTHERS, "combined": ("Combined",)}
        return {k: next(found[n] for n in choices if n in found) for k, choices in names.items()}

    return render


@pytest.mark.slow
def test_passes_are_those_of_cycles(passes):
    theirs, ours = passes("CYCLES"), passes("DRGS")
    for picture in (theirs, ours):
        error = np.abs(recombined(picture) - picture["combined"][..., :3])
        assert error.max() < 1e-3 and error.mean() < 1e-5
    found = {}
    for name in (*LIGHT, "mist", "uv", "combined"):
        a, b = (p[name][..., :3].astype(float) for p in (ours, theirs))
        peak = max(np.quantile(b, 0.99), 1.0)
        found[name] = -10 * np.log10(max(np.mean((np.minimum(a, peak) - np.minimum(b, peak)) ** 2) / peak**2, 1e-12))
        found[name + " mean"] = a.mean() / max(b.mean(), 1e-6)
    print({name: round(value, 3) for name, value in found.items()})
    same = ours["material_index"] == theirs["material_index"]
    assert same.mean() > 0.97  # where several materials share a pixel, Cycles shows one by chance
    for name in (*LIGHT, "mist", "uv", "combined"):
        assert found[name] > 35, (name, found[name])
        assert abs(found[name + " mean"] - 1) < 0.02, name


@pytest.mark.judged
@pytest.mark.slow
def test_passes_of_glass_are_those_of_cycles(passes):
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y = 64, 36  # means alone are compared
    bpy.ops.mesh.primitive_cube_add(size=0.5, location=(-0.6, -1.0, 0.0), rotation=(0.3, 0.2, 0.5))
    glass = bpy.data.materials.new("glass")
    glass.use_nodes = True
    inputs = next(n for n in glass.node_tree.nodes if n.type == "BSDF_PRINCIPLED").inputs
    inputs["Base Color"].default_value = (0.5, 0.8, 0.6, 1.0)
    inputs["Transmission Weight"].default_value, inputs["Roughness"].default_value = 0.8, 0.2
    bpy.context.object.data.materials.append(glass)
    theirs, ours = passes("CYCLES", 4), passes("DRGS", 4)
    for picture in (theirs, ours):
        assert np.abs(recombined(picture) - picture["combined"][..., :3]).max() < 1e-3
    found = {}
    for name in (*LIGHT, *THROUGH):
        a, b = (p[name][..., :3].astype(float) for p in (ours, theirs))
        found[name] = a.mean(), b.mean()
    print({name: tuple(round(float(x), 5) for x in pair) for name, pair in found.items()})
    for name, (a, b) in found.items():
        # Light of the lamp through rough glass is found by chance: over ten seeds it differs by 5 % in either program,
        # and is 6 % less here in the mean, as Cycles allows 4 bounces of each kind and this renderer 4 in all (with 16
        # bounces the means agree).
        assert abs(a - b) < (0.12 if name == "transmission_indirect" else 0.03) * b + 1e-4, name
    assert found["transmission_indirect"][0] > 0.01


@pytest.mark.judged
@pytest.mark.slow
def test_a_rough_pane_before_a_lamp_has_its_direct_light(passes, room):  # noqa: F811
    """Light of the lamp that one surface lets pass is direct.

    The lamp is straight behind it: far off the refracted directions Cycles evaluates microfacets that face away, too.
    """
    bpy.ops.mesh.primitive_plane_add(size=1.2, location=(-0.3, -1.2, 0.1), rotation=(1.4, 0.1, 0.2))
    glass = bpy.data.materials.new("glass")
    if glass.node_tree is None:
        glass.use_nodes = True
    inputs = next(n for n in glass.node_tree.nodes if n.type == "BSDF_PRINCIPLED").inputs
    inputs["Base Color"].default_value = (0.5, 0.8, 0.6, 1.0)
    inputs["Transmission Weight"].default_value, inputs["Roughness"].default_value = 0.8, 0.5
    bpy.context.object.data.materials.append(glass)
    lamp = bpy.data.objects["Lamp"]
    lamp.location, lamp.rotation_euler, lamp.data.energy = (-0.2, 1.0, 0.2), (-1.57, 0, 0), 20
    room.render.resolution_x, room.render.resolution_y = 48, 27
    theirs, ours = (p["transmission_direct"][..., :3].astype(float) for p in (passes("CYCLES"), passes("DRGS")))
    print(ours.mean(axis=(0, 1)), theirs.mean(axis=(0, 1)))
    np.testing.assert_allclose(ours.mean(axis=(0, 1)), theirs.mean(axis=(0, 1)), rtol=0.03)
    where = theirs.min(axis=2) > 0.05
    assert where.sum() > 50 and np.median(np.abs(ours / np.maximum(theirs, 1e-6) - 1)[where]) < 0.05


def test_passes_that_are_not_made_are_told(scene, ball, export):
    layer = scene.view_layers[0]
    layer.use_pass_shadow = layer.use_pass_ambient_occlusion = layer.use_pass_uv = True
    _, warnings = export()
    assert any("ViewLayer" in text and "Shadow, Ambient Occlusion" in text for text in warnings)
    assert any("UV" in text and "DR-GS objects" in text for text in warnings)
    layer.use_pass_shadow = layer.use_pass_ambient_occlusion = layer.use_pass_uv = False
    _, warnings = export()
    assert not any("no pass" in text or "UV" in text for text in warnings)
    layer.aovs.add().name = "wetness"
    layer.lightgroups.add(name="lamps")
    _, warnings = export()
    assert not any("no pass" in text for text in warnings)


def test_frame_has_mist_material_indices_and_the_map_that_renders(passes, room, ball, export):  # noqa: F811
    ball.material_slots[0].material.pass_index = 12
    frame, _ = export()
    assert (frame.mist.start, frame.mist.depth, frame.mist.falloff) == (1.0, 4.0, 2.0)
    assert frame.objects[0].material_pass_index == 12
    floor = next(mesh for mesh in frame.meshes if mesh.name == "floor")
    assert floor.uv_map.shape == (2, 3, 2) and floor.uv_map.max() == 2
    assert floor.materials[0].pass_index == bpy.data.materials["floor"].pass_index
    if hasattr(room.view_layers[0], "world_override"):
        other = room.view_layers[0].world_override = room.world.copy()
        other.mist_settings.start = 2.0
        assert export()[0].mist.start == 1.0, "as in Cycles, of the scene's world"
    room.view_layers[0].use_pass_uv = False
    frame, _ = export()
    assert all(mesh.uv_map is None for mesh in frame.meshes)


def test_names_are_blenders(scene):
    names = {p.name: part("addon.view_layer_passes").blender_name(p) for p in part("drgs_blender.core.passes").PASSES}
    later = bpy.app.version >= (5, 0, 0)
    assert names["DiffCol"] == ("Diffuse Color" if later else "DiffCol")
    assert names["IndexMA"] == ("Material Index" if later else "IndexMA")
