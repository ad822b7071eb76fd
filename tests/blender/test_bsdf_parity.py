"""All BSDFs as Cycles shows them, and the nodes that mix them."""

from __future__ import annotations

import math
from pathlib import Path

import bpy
import numpy as np
import parity
import pytest
from scenes import mesh_object, sphere
from test_materials import add, material, shaded

ROOT = Path(__file__).resolve().parents[2]
pytestmark = [
    pytest.mark.blender_api,
    pytest.mark.slow,
    pytest.mark.skipif(
        not (ROOT / "drgs_blender/render/scene/material_rows.py").exists(), reason="the engine has no such lobes"
    ),
]
RED, GREEN, BLUE = (0.6, 0.1, 0.05), (0.3, 0.7, 0.3), (0.15, 0.25, 0.6)


def principled(**values):
    def build(tree):
        node = next(n for n in tree.nodes if n.type == "BSDF_PRINCIPLED")
        for key, value in values.items():
            if (name := key.replace("_", " ")) in node.inputs:  # 4.2 has no Diffuse Roughness
                node.inputs[name].default_value = (*value, 1) if isinstance(value, tuple) else value
        return node.outputs[0]

    return build


def single(kind: str, *values, **settings):
    return lambda tree: add(tree, kind, *values, **settings)


def mixed(joint: str, share, first, second):
    def build(tree):
        shaders = first(tree), second(tree)
        return add(tree, joint, *(() if share is None else (share,)), *shaders)

    return build


DIFFUSE, METAL = single("BsdfDiffuse", RED), {"Metallic": 1.0, "Base_Color": (0.9, 0.8, 0.7)}
#: Picture -> balls from left to right, nine at most.
SHELVES = {
    "layers": {
        "coat": principled(Base_Color=RED, Coat_Weight=1.0),
        "rough coat": principled(Base_Color=BLUE, Coat_Weight=0.7, Coat_Roughness=0.4, Coat_IOR=1.8),
        "tinted coat": principled(**METAL, Roughness=0.4, Coat_Weight=1.0, Coat_Tint=(0.9, 0.6, 0.2)),
        "sheen": principled(Base_Color=(0.1, 0.05, 0.2), Roughness=0.8, Sheen_Weight=1.0),
        "tinted sheen": principled(Base_Color=BLUE, Sheen_Weight=0.8, Sheen_Roughness=0.3, Sheen_Tint=(0.9, 0.6, 0.3)),
        "ior": principled(Base_Color=BLUE, Roughness=0.3, IOR=2.2),
        "tint": principled(Base_Color=BLUE, Roughness=0.3, Specular_IOR_Level=1.0, Specular_Tint=(1.0, 0.5, 0.2)),
        "dull": principled(Base_Color=GREEN, Specular_IOR_Level=0.0),
        "all": principled(
            Base_Color=GREEN, Metallic=0.3, Roughness=0.3, Coat_Weight=0.5, Sheen_Weight=0.5, Anisotropic=0.5, IOR=1.7
        ),
    },
    "glass": {
        "glass": principled(Transmission_Weight=1.0, Roughness=0.2, Base_Color=(1.0, 1.0, 1.0)),
        "frosted": principled(Transmission_Weight=1.0, Roughness=0.5, Base_Color=(0.5, 0.8, 0.6)),
        "half": principled(Transmission_Weight=0.5, Roughness=0.3, Base_Color=BLUE),
        "glass node": single("BsdfGlass", (0.7, 0.9, 0.8), 0.3, 1.45, distribution="GGX"),
        "diamond node": single("BsdfGlass", (1.0, 1.0, 1.0), 0.15, 2.4, distribution="GGX"),
        "refraction": single("BsdfRefraction", (0.9, 0.8, 0.7), 0.3, 1.3, distribution="GGX"),
        "translucent": single("BsdfTranslucent", (0.8, 0.6, 0.4)),
        "leaf": mixed("MixShader", 0.4, single("BsdfDiffuse", GREEN), single("BsdfTranslucent", (0.5, 0.8, 0.2))),
        "glow": mixed("MixShader", 0.6, single("Emission", RED, 0.5), single("BsdfGlass", GREEN, 0.3)),
    },
    "nodes": {
        "diffuse": DIFFUSE,
        "clay": single("BsdfDiffuse", GREEN, 1.0),
        "glossy": single("BsdfAnisotropic", (0.4, 0.5, 0.6), 0.3),
        "brushed": principled(**METAL, Roughness=0.35, Anisotropic=0.8),
        "turned": principled(**METAL, Roughness=0.35, Anisotropic=0.8, Anisotropic_Rotation=0.125),
        "brushed node": single("BsdfAnisotropic", (0.7, 0.75, 0.8), 0.4, 0.6),
        "sheen": single("BsdfSheen", (0.8, 0.7, 0.6), 0.4),
        "plastic": mixed("MixShader", 0.2, DIFFUSE, single("BsdfAnisotropic", (0.9, 0.9, 0.9), 0.2)),
        "sum": mixed("AddShader", None, DIFFUSE, single("BsdfSheen", BLUE, 0.4)),
    },
}


def furnish(scene, shelf: str) -> None:
    """The balls in three rows, before a wall of squares."""
    for i, (name, build) in enumerate(SHELVES[shelf].items()):
        tree, _ = material(name)
        shaded(tree, build(tree))
        obj = mesh_object(name, *sphere(24, 32))
        obj.data.shade_smooth()
        obj.data.materials.append(bpy.data.materials[name])
        obj.location, obj.scale = (2.2 * (i % 3 - 1), 0, 2.2 * (i // 3 - 1)), (0.95, 0.95, 0.95)
    for shade in (0.25, 0.7):
        _, node = material(f"Wall {shade}")
        node.inputs["Base Color"].default_value = (shade, shade, 0.9 * shade, 1)
    for i in range(64):
        x, z = 1.1 * (i % 8 - 4), 1.1 * (i // 8 - 4)
        corners = [(x, 2, z), (x + 1.1, 2, z), (x + 1.1, 2, z + 1.1), (x, 2, z + 1.1)]
        tile = mesh_object(f"Tile {i}", corners, [(0, 1, 2, 3)])
        tile.data.materials.append(bpy.data.materials[f"Wall {(0.25, 0.7)[(i + i // 8) % 2]}"])
    parity.light(scene, 0.5)
    camera = scene.camera
    camera.data.type, camera.data.ortho_scale = "ORTHO", 6.6
    camera.location, camera.rotation_euler = (0, -8, 0), (math.pi / 2, 0, 0)


@pytest.mark.judged
@pytest.mark.parametrize("shelf", SHELVES)
def test_bsdfs_look_as_in_cycles(scene, export, shelf):
    furnish(scene, shelf)
    parity.set_up(scene, 96, bounces=4)
    assert not export()[1]
    ours, theirs = parity.pictures(scene, "DRGS"), parity.pictures(scene, "CYCLES")
    found = {}
    for i, name in enumerate(SHELVES[shelf]):
        row, column = 32 * (2 - i // 3), 32 * (i % 3)
        where = np.zeros((96, 96), bool)
        where[row : row + 32, column : column + 32] = True
        found[name] = round(float(parity.psnr(ours, theirs, where)), 1)
    print(found)
    assert parity.psnr(ours, theirs) > 38, found
    assert min(found.values()) > 34, found
