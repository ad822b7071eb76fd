"""Assets made of glTF files with lenses, cut-outs, lamps and varnish, as Cycles shows Blender's import of the file."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path

import bpy
import numpy as np
import parity
import pytest
from scenes import mesh_object
from test_asset_textures import png
from test_materials import material

SIZE = 64
#: Material -> where its square stands, in glTF's axes: to the right, up, towards the viewer.
PLACES = {"lens": (-1.1, 0.6, 0.8), "leaf": (1.1, 0.6, 0.5), "lamp": (-1.1, -1.0, 0.3), "lacquer": (1.1, -1.0, 0.6)}


def rgba(colour: np.ndarray, alpha: np.ndarray) -> bytes:
    """A PNG file with alpha; by Blender, which stores it straight."""
    image = bpy.data.images.new("Picture", SIZE, SIZE, alpha=True)
    pixels = np.dstack([np.broadcast_to(colour, (SIZE, SIZE, 3)), np.broadcast_to(alpha, (SIZE, SIZE))])
    image.alpha_mode = "CHANNEL_PACKED"
    image.pixels.foreach_set(pixels.astype(np.float32).ravel())
    path = Path(bpy.app.tempdir) / "picture.png"
    image.filepath_raw, image.file_format = str(path), "PNG"
    image.save()
    bpy.data.images.remove(image)
    return path.read_bytes()


def gltf_file(path: Path) -> Path:
    """Four squares, each of a material with images."""
    u, v = np.meshgrid(np.linspace(0, 1, SIZE), np.linspace(0, 1, SIZE))
    disc = np.hypot(u - 0.5, v - 0.5)
    spots = (np.sin(9 * u) * np.sin(7 * v) > 0).astype(float)
    tint = np.dstack([0.2 + 0.6 * u, 0.5 + 0 * u, 0.9 - 0.6 * v])
    flat = lambda *colour: (np.float32(colour) * np.ones((SIZE, SIZE, 3)) * 255).astype(np.uint8)  # noqa: E731
    glow = (np.dstack([u, 0.3 + 0.5 * v, 1 - u]) * 255 * (disc < 0.4)[..., None]).astype(np.uint8)
    images = [
        rgba(tint, np.clip(1.4 - 3 * disc, 0.1, 1)), rgba(tint, (disc < 0.42).astype(float)), png(glow).tobytes(),
        png(flat(1, 0, 0) * spots[..., None].astype(np.uint8)).tobytes(), rgba(np.ones(3), 0.1 + 0.9 * (1 - spots)),
        png((tint * 255).astype(np.uint8)).tobytes(),
    ]  # fmt: skip
    matte = {"metallicFactor": 0.0, "roughnessFactor": 0.6}
    layers = {
        "KHR_materials_clearcoat": {
            "clearcoatFactor": 0.9, "clearcoatTexture": {"index": 3}, "clearcoatRoughnessFactor": 0.03,
        },
        "KHR_materials_specular": {"specularFactor": 0.9, "specularTexture": {"index": 4}},
    }  # fmt: skip
    entries = {
        "lens": {"pbrMetallicRoughness": matte | {"baseColorTexture": {"index": 0}}, "alphaMode": "BLEND"},
        "leaf": {"pbrMetallicRoughness": matte | {"baseColorTexture": {"index": 1}}, "alphaMode": "MASK"},
        "lamp": {
            "pbrMetallicRoughness": matte | {"baseColorFactor": [0.2, 0.2, 0.2, 1]}, "emissiveTexture": {"index": 2},
            "emissiveFactor": [1.0, 0.9, 0.8],
            "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 3.0}},
        },
        "lacquer": {
            "pbrMetallicRoughness": matte | {"baseColorTexture": {"index": 5}}, "extensions": layers,
        },
    }  # fmt: skip
    corners = np.float32([[-1, -0.75, 0], [1, -0.75, 0], [1, 0.75, 0], [-1, 0.75, 0]])
    uvs, normals = np.float32([[0, 1], [1, 1], [1, 0], [0, 0]]), np.float32([[0, 0, 1]] * 4)
    chunks = [corners.tobytes(), normals.tobytes(), uvs.tobytes(), struct.pack("<6H", 0, 1, 2, 0, 2, 3), *images]
    views, data = [], b""
    for chunk in chunks:
        data += bytes(-len(data) % 4)
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(chunk)})
        data += chunk
    document = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_materials_emissive_strength", *layers],
        "buffers": [{"uri": "data:application/octet-stream;base64," + base64.b64encode(data).decode(),
                     "byteLength": len(data)}],
        "bufferViews": views,
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3", "min": [-1, -0.75, 0],
             "max": [1, 0.75, 0]},
            {"bufferView": 1, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 2, "componentType": 5126, "count": 4, "type": "VEC2"},
            {"bufferView": 3, "componentType": 5123, "count": 6, "type": "SCALAR"},
        ],
        "images": [{"bufferView": 4 + i, "mimeType": "image/png"} for i in range(len(images))],
        "textures": [{"source": i} for i in range(len(images))],
        "materials": [{"name": name, "doubleSided": True, **entry} for name, entry in entries.items()],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2}, "indices": 3,
                                    "material": i}]} for i in range(len(entries))],
        "nodes": [{"mesh": i, "translation": PLACES[name]} for i, name in enumerate(entries)],
        "scenes": [{"nodes": list(range(len(entries)))}],
        "scene": 0,
    }  # fmt: skip
    path.write_text(json.dumps(document))
    return path


@pytest.mark.slow
def test_a_gltf_file_looks_as_its_import_in_cycles(scene, tmp_path):
    path = gltf_file(tmp_path / "things.gltf")
    wall = mesh_object("Wall", [(-4, 1, -3), (4, 1, -3), (4, 1, 3), (-4, 1, 3)], [(0, 1, 2, 3)])
    _, principled = material(wall.name)
    principled.inputs["Base Color"].default_value = (0.7, 0.6, 0.3, 1)
    wall.data.materials.append(bpy.data.materials[wall.name])
    scene.camera.location, scene.camera.data.angle = (0.3, -7, 0.2), 0.75
    parity.light(scene)
    bpy.ops.import_scene.gltf(filepath=str(path))
    theirs_objects = [obj for obj in scene.objects if obj.type == "MESH" and obj is not wall]
    parity.set_up(scene, 96, samples=256, bounces=2, subpixels=64)
    theirs = parity.pictures(scene, "CYCLES")
    for obj in theirs_objects:
        bpy.data.objects.remove(obj)
    assert bpy.ops.drgs.import_parts(mesh=str(path), out=str(tmp_path / "things.drgs")) == {"FINISHED"}
    parity.set_up(scene, 96, samples=256, bounces=2, subpixels=64)
    ours, imported = parity.pictures(scene, "DRGS"), parity.pictures(scene, "CYCLES")
    np.savez(tmp_path / "pictures.npz", ours=ours, theirs=theirs, imported=imported)
    found = {"asset": parity.psnr(ours, theirs), "import": parity.psnr(imported, theirs)}
    print("PSNR", found, tmp_path)
    assert min(found.values()) > 40
