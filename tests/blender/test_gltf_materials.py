"""Materials of glTF files that Blender's importer reads: every value of the extensions is in the frame."""

from __future__ import annotations

import base64
import json
import math
import struct
from pathlib import Path

import bpy
import numpy as np
import pytest

pytestmark = pytest.mark.blender_api
#: Materials by name: the extensions of each.
MATERIALS = {
    "glass": {"KHR_materials_transmission": {"transmissionFactor": 0.7}, "KHR_materials_ior": {"ior": 1.4}},
    "lacquer": {"KHR_materials_clearcoat": {"clearcoatFactor": 0.6, "clearcoatRoughnessFactor": 0.2}},
    "cloth": {"KHR_materials_sheen": {"sheenColorFactor": [0.2, 0.4, 0.6], "sheenRoughnessFactor": 0.3}},
    "shine": {"KHR_materials_specular": {"specularFactor": 0.8, "specularColorFactor": [0.9, 0.5, 0.3]}},
    "brushed": {"KHR_materials_anisotropy": {"anisotropyStrength": 0.5, "anisotropyRotation": 0.7}},
    "lamp": {"KHR_materials_emissive_strength": {"emissiveStrength": 4.0}},
}


def gltf_file(path: Path, textured: bool = False) -> Path:
    """A square for each material, with normals and texture coordinates; factors, or the same times an image."""
    corners = np.float32([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    normals = np.float32([[0, 0, 1]] * 4)
    data = corners.tobytes() + normals.tobytes() + corners[:, :2].tobytes() + struct.pack("<6H", 0, 1, 2, 0, 2, 3)
    views, offset = [], 0
    for length in (48, 48, 32, 12):
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": length})
        offset += length
    materials = []
    for name, extensions in MATERIALS.items():
        used = json.loads(json.dumps(extensions))
        if textured:
            for extension in used.values():
                for key in [key for key in extension if key.endswith("Factor")]:
                    extension[key.replace("Factor", "Texture")] = {"index": 0}
                if "anisotropyStrength" in extension:
                    extension["anisotropyTexture"] = {"index": 0}
        pbr = {"baseColorFactor": [0.5, 0.4, 0.3, 1.0], "metallicFactor": 0.1, "roughnessFactor": 0.35}
        made = {"name": name, "pbrMetallicRoughness": pbr, "extensions": used}
        if name == "lamp":
            made["emissiveFactor"] = [1.0, 0.5, 0.25]
        materials.append(made)
    attributes = {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2}
    document = {
        "asset": {"version": "2.0"},
        "extensionsUsed": sorted({key for extensions in MATERIALS.values() for key in extensions}),
        "buffers": [{
            "uri": "data:application/octet-stream;base64," + base64.b64encode(data).decode(), "byteLength": len(data),
        }],
        "bufferViews": views,
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0]},
            {"bufferView": 1, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 2, "componentType": 5126, "count": 4, "type": "VEC2"},
            {"bufferView": 3, "componentType": 5123, "count": 6, "type": "SCALAR"},
        ],
        "materials": materials,
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 3, "material": i}]}
                   for i in range(len(materials))],
        "nodes": [{"mesh": i, "translation": [2 * i, 0, 0]} for i in range(len(materials))],
        "scenes": [{"nodes": list(range(len(materials)))}],
        "scene": 0,
    }  # fmt: skip
    if textured:
        image = bpy.data.images.new("Picture", 4, 4)
        image.pixels.foreach_set(np.random.default_rng(1).uniform(0.3, 0.9, 64).astype(np.float32))
        image.filepath_raw, image.file_format = str(path.with_name("picture.png")), "PNG"
        image.save()
        bpy.data.images.remove(image)
        document |= {"images": [{"uri": "picture.png"}], "textures": [{"source": 0}]}
    path.write_text(json.dumps(document))
    return path


@pytest.fixture
def imported(scene, export, tmp_path):
    """Function that imports such a file; returns (materials, meshes by their material's name, warnings)."""

    def run(textured: bool = False):
        bpy.ops.import_scene.gltf(filepath=str(gltf_file(tmp_path / "things.gltf", textured)))
        frame, warnings = export()
        found = {mesh.materials[0].name: mesh.materials[0] for mesh in frame.meshes}
        return found, {mesh.materials[0].name: mesh for mesh in frame.meshes}, warnings

    return run


def test_factors_arrive(imported):
    found, _, warnings = imported()
    assert not warnings and found.keys() == MATERIALS.keys()
    for one in found.values():
        np.testing.assert_allclose(one.base_colour, (0.5, 0.4, 0.3), rtol=1e-5)
        np.testing.assert_allclose((one.roughness, one.metallic), (0.35, 0.1), rtol=1e-5)
    np.testing.assert_allclose((found["glass"].transmission, found["glass"].ior), (0.7, 1.4), rtol=1e-5)
    np.testing.assert_allclose((found["lacquer"].coat, found["lacquer"].coat_roughness), (0.6, 0.2), rtol=1e-5)
    cloth = found["cloth"]
    np.testing.assert_allclose(np.multiply(cloth.sheen_tint, cloth.sheen), (0.2, 0.4, 0.6), rtol=1e-5)
    np.testing.assert_allclose(cloth.sheen_roughness, 0.3, rtol=1e-5)
    np.testing.assert_allclose(2 * found["shine"].specular_level, 0.8, rtol=1e-5)
    np.testing.assert_allclose(found["shine"].specular_tint, (0.9, 0.5, 0.3), rtol=1e-5)
    np.testing.assert_allclose(found["brushed"].anisotropy, 0.5, rtol=1e-5)
    np.testing.assert_allclose(found["brushed"].anisotropy_rotation % 1, 0.7 / (2 * math.pi), rtol=1e-4)
    np.testing.assert_allclose(found["lamp"].emission, (4, 2, 1), rtol=1e-5)
    assert {name for name, one in found.items() if one.has_more_lobes} == MATERIALS.keys() - {"lamp"}


def test_textures_arrive(imported):
    found, meshes, warnings = imported(True)
    channels = {
        "glass": {"transmission": "r"},
        "lacquer": {"coat": "r", "coat_roughness": "g"},
        "cloth": {"sheen_tint": "rgb", "sheen_roughness": "a"},
        "shine": {"specular_level": "a", "specular_tint": "rgb"},
    }
    for name, expected in channels.items():
        assert {field: texture.channel for field, texture in found[name].textures.items()} == expected, name
    np.testing.assert_allclose((found["glass"].transmission, found["lacquer"].coat), (0.7, 0.6), rtol=1e-5)
    np.testing.assert_allclose(found["shine"].specular_tint, (0.9, 0.5, 0.3), rtol=1e-5)
    # The angle is that of the red and green of a pixel, which is left to a bake.
    brushed = found["brushed"]
    assert brushed.textures["anisotropy"].channel == "b" and brushed.anisotropy == pytest.approx(0.5)
    assert warnings and all('Material "brushed"' in text for text in warnings)
    layers = {layer.name: layer.values for layer in meshes["brushed"].layers}
    assert layers[brushed.tangent].shape == (2, 3, 2)
