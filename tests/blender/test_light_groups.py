"""Light groups: one pass each, as those of Cycles."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from parity import psnr
from scenes import mesh_object
from test_light_links import add_lamp
from test_motion import layers_of
from test_panorama import _paint, room  # noqa: F401  a fixture

pytestmark = pytest.mark.blender_api
NAMES = ("lamps", "sky", "glow")


@pytest.fixture
def grouped(room):  # noqa: F811
    """The room with a second lamp and a glowing panel; a lamp, the world and the panel are in groups."""
    for name in NAMES:
        room.view_layers[0].lightgroups.add(name=name)
    add_lamp(room, "Fill", (1.5, -1.5, 1.0), energy=40.0, shadow_soft_size=0.2)
    bpy.data.objects["Lamp"].lightgroup, room.world.lightgroup = "lamps", "sky"
    z = 1.2
    glow = mesh_object("glow", [(-1.5, 1, z), (-0.9, 1, z), (-0.9, 1.6, z), (-1.5, 1.6, z)], [(0, 1, 2, 3)])
    _paint(glow, (0, 0, 0, 1), 1.0, 0.0)
    shader = next(n for n in glow.data.materials[0].node_tree.nodes if n.type == "BSDF_PRINCIPLED")
    shader.inputs["Emission Color"].default_value = (1, 0.7, 0.4, 1)
    shader.inputs["Emission Strength"].default_value = 12.0
    glow.lightgroup = "glow"
    room.camera.location, room.camera.rotation_euler = (-0.4, -2.6, 0.3), (1.45, 0.0, -0.15)
    room.camera.data.lens = 18
    cycles, settings = room.cycles, room.drgs
    cycles.device, cycles.samples, cycles.pixel_filter_type, cycles.filter_width = "CPU", 512, "BOX", 1.0
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = settings.bounces = 2
    cycles.sample_clamp_indirect = cycles.blur_glossy = cycles.light_sampling_threshold = 0.0
    settings.use_strategy_samples, settings.samples = False, 512
    settings.subpixel_samples, settings.filter_width, settings.denoise = 16, 0.0, "none"
    return room


def test_frame_has_the_groups_that_the_view_layer_names(grouped, export):
    frame, warnings = export()
    assert frame.passes[-3:] == tuple(f"Combined_{name}" for name in NAMES) and not warnings
    assert {light.name: light.light_group for light in frame.lights} == {"Lamp": "lamps", "Fill": ""}
    assert frame.world.light_group == "sky"
    assert {mesh.light_group for mesh in frame.meshes} == {"", "glow"}


@pytest.mark.slow
@pytest.mark.judged
def test_passes_are_those_of_cycles(grouped, tmp_path):
    grouped.cycles.samples = grouped.drgs.samples = 256
    found = {}
    for engine in ("CYCLES", "DRGS"):
        pairs = []
        for seed in (1, 2):
            grouped.cycles.seed = grouped.drgs.seed = seed
            pairs.append(layers_of(grouped, engine, tmp_path))
        found[engine] = {name: np.stack([pair[name] for pair in pairs]).astype(float) for name in pairs[0]}
    ours, theirs = found["DRGS"], found["CYCLES"]
    everywhere = np.ones(ours["Combined"].shape[1:3], bool)
    for name in (f"Combined_{name}" for name in NAMES):
        a, b = ours[name], theirs[name]
        print(f"{name}: {psnr(a, b, everywhere):.1f} dB, mean {a.mean() / b.mean():.4f}")
        assert psnr(a, b, everywhere) > 45 and abs(a.mean() / b.mean() - 1) < 0.01
    rest = ours["Combined"][..., :3] - sum(ours[f"Combined_{name}"] for name in NAMES)
    assert rest.min() > -1e-3 and rest.max() > 0.1  # that of the lamp in no group
