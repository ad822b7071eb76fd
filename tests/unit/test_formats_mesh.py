"""OBJ and glTF: geometry where Blender puts it, materials and texture coordinates as the formats define them."""

from __future__ import annotations

import base64
import json
import struct
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as Pillow
from scipy.spatial import cKDTree

from drgs_blender.core.color import srgb_to_linear
from drgs_blender.core.errors import AssetError
from drgs_blender.formats.axes import vectors_to_z_up
from drgs_blender.formats.files import MaterialFile
from drgs_blender.formats.gltf import read_gltf
from drgs_blender.formats.gltf_materials import uv_transform
from drgs_blender.formats.registry import read_mesh

ROOT = Path(__file__).resolve().parents[2]
BLENDER_PYTHON = ROOT / ".venv-blender" / "bin" / "python"

POSITIONS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.5]], np.float32)
INDICES = np.array([0, 1, 2, 2, 1, 3], np.uint16)


class Builder:
    """Assembles a small glTF file with embedded data."""

    def __init__(self) -> None:
        self.data = b""
        self.json: dict[str, Any] = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": []}

    def accessor(self, array: np.ndarray, kind: str, **more: Any) -> int:
        codes = {"f4": 5126, "u2": 5123, "u1": 5121, "u4": 5125, "i2": 5122, "i1": 5120}
        self.data += bytes(-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes}
        self.data += array.tobytes()
        self.json["bufferViews"].append(view)
        entry = {"bufferView": len(self.json["bufferViews"]) - 1, "count": len(array), "type": kind}
        self.json["accessors"].append(entry | {"componentType": codes[array.dtype.str[1:]]} | more)
        return len(self.json["accessors"]) - 1

    def write(self, path: Path, glb: bool = False) -> Path:
        if not glb:
            uri = "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
            self.json["buffers"] = [{"byteLength": len(self.data), "uri": uri}]
            path.write_text(json.dumps(self.json))
            return path
        self.json["buffers"] = [{"byteLength": len(self.data)}]
        text = json.dumps(self.json).encode()
        text += b" " * (-len(text) % 4)
        data = self.data + bytes(-len(self.data) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return path


def quad(node: dict[str, Any] | None = None, **primitive: Any) -> Builder:
    """Two triangles, in one node."""
    b = Builder()
    attributes = {"POSITION": b.accessor(POSITIONS, "VEC3")}
    indices = b.accessor(INDICES, "SCALAR")
    b.json |= {
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices, **primitive}]}],
        "nodes": [{"mesh": 0, "name": "quad", **(node or {})}],
        "scenes": [{"nodes": [0]}],
    }
    return b


@pytest.mark.parametrize("glb", [False, True])
def test_gltf_is_turned_to_z_up(tmp_path: Path, glb: bool) -> None:
    mesh = read_mesh(quad().write(tmp_path / "a.gltf", glb))
    np.testing.assert_array_equal(mesh.vertices, vectors_to_z_up(POSITIONS))
    np.testing.assert_array_equal(mesh.faces, INDICES.reshape(-1, 3))
    assert mesh.up_axis == "Z" and mesh.parts == [("quad", 0, 2)]
    assert mesh.materials[0].base_colour == (1, 1, 1) and mesh.materials[0].metallic == 1


def test_node_transforms_compose_and_mirrors_keep_the_outside(tmp_path: Path) -> None:
    b = quad({"scale": [-2, 1, 1]})
    normals = np.tile(np.array([0, 0, 1], np.float32), (4, 1))
    b.json["meshes"][0]["primitives"][0]["attributes"]["NORMAL"] = b.accessor(normals, "VEC3")
    b.json["nodes"].append({"children": [0], "translation": [0, 0, 5], "rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)]})
    b.json["scenes"] = [{"nodes": [1]}]
    mesh = read_mesh(b.write(tmp_path / "a.gltf"))
    scaled = POSITIONS * [-2, 1, 1]
    turned = np.stack([-scaled[:, 1], scaled[:, 0], scaled[:, 2] + 5], axis=1)
    np.testing.assert_allclose(mesh.vertices, vectors_to_z_up(turned), atol=1e-6)
    a, p, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    assert (np.einsum("ni,ni->n", np.cross(p - a, c - a), mesh.corner_normals[:, 0]) > 0).all()
    # the plane's normal is +Z of glTF: -Y of Blender, the same side after the mirror
    np.testing.assert_allclose(mesh.corner_normals[0, 0], [0, -1, 0], atol=1e-6)


def test_instances_are_what_nodes_in_their_places_are(tmp_path: Path) -> None:
    """EXT_mesh_gpu_instancing, with a mirrored instance, and one of other nodes with the same transforms."""
    rng = np.random.default_rng(4)
    turns = rng.normal(size=(3, 4))
    columns = {
        "translation": rng.normal(size=(3, 3)),
        "rotation": turns / np.linalg.norm(turns, axis=1, keepdims=True),
        "scale": rng.uniform(0.5, 2, (3, 3)) * [[1, 1, 1], [-1, 1, 1], [1, 1, 1]],
    }
    found = []
    for instanced in (True, False):
        b = quad({"translation": [1, 2, 3], "rotation": [0, 0.6, 0, 0.8], "scale": [1, 2, 3]})
        rows = np.random.default_rng(5).uniform(0.1, 1, (4, 3)).astype(np.float32)
        attributes = b.json["meshes"][0]["primitives"][0]["attributes"]
        attributes |= {"NORMAL": b.accessor(rows, "VEC3"), "COLOR_0": b.accessor(rows, "VEC3")}
        attributes["TEXCOORD_0"] = b.accessor(np.ascontiguousarray(rows[:, :2]), "VEC2")
        if instanced:
            places = {k.upper(): b.accessor(v.astype(np.float32), f"VEC{v.shape[1]}") for k, v in columns.items()}
            b.json["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": places}}
            b.json["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
        else:
            node = b.json["nodes"][0]
            node["children"] = [1, 2, 3]
            mesh = node.pop("mesh")
            b.json["nodes"] += [{"mesh": mesh, **{k: v[i].tolist() for k, v in columns.items()}} for i in range(3)]
        found.append(read_mesh(b.write(tmp_path / "a.gltf")))
    ours, wanted = found
    assert len(ours.faces) == 6 and not any("instancing" in note for note in ours.notes)
    np.testing.assert_array_equal(ours.faces, wanted.faces)
    for name in ("vertices", "corner_normals", "corner_uvs", "vertex_colours"):
        np.testing.assert_allclose(getattr(ours, name), getattr(wanted, name), atol=1e-5, err_msg=name)


def test_instances_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    b = quad()
    places = {"TRANSLATION": b.accessor(np.zeros((3, 3), np.float32), "VEC3")}
    places["SCALE"] = b.accessor(np.ones((2, 3), np.float32), "VEC3")
    b.json["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": places}}
    with pytest.raises(AssetError, match="2 and 3 places"):
        read_mesh(b.write(tmp_path / "a.gltf"))


def test_strips_and_fans_are_the_same_quad(tmp_path: Path) -> None:
    for mode, order in ((5, [0, 1, 2, 3]), (6, [0, 1, 3, 2])):
        b = quad(mode=mode)
        b.json["meshes"][0]["primitives"][0]["indices"] = b.accessor(np.array(order, np.uint8), "SCALAR")
        mesh = read_mesh(b.write(tmp_path / "a.gltf"))
        a, p, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
        normals = np.cross(p - a, c - a)
        assert len(mesh.faces) == 2 and (normals[:, 1] < 0).all()


def test_materials_textures_and_colours(tmp_path: Path) -> None:
    pixels = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    Pillow.fromarray(pixels).save(tmp_path / "t.png")
    b = quad(material=0)
    attributes = b.json["meshes"][0]["primitives"][0]["attributes"]
    uvs = np.array([[0, 0], [65535, 0], [0, 65535], [65535, 65535]], np.uint16)
    attributes["TEXCOORD_0"] = b.accessor(uvs, "VEC2", normalized=True)
    colours = np.array([[255, 0, 51, 255]] * 4, np.uint8)
    attributes["COLOR_0"] = b.accessor(colours, "VEC4", normalized=True)
    pbr = {
        "baseColorFactor": [0.5, 0.25, 1, 1],
        "roughnessFactor": 0.3,
        "baseColorTexture": {
            "index": 0,
            "extensions": {"KHR_texture_transform": {"offset": [0.5, 0], "scale": [2, 2]}},
        },
        "metallicRoughnessTexture": {"index": 0},
    }
    b.json |= {
        "materials": [{"name": "skin", "pbrMetallicRoughness": pbr, "emissiveFactor": [1, 0, 0], "alphaMode": "BLEND"}],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{"wrapS": 33071}],
        "images": [{"uri": "t.png"}],
    }
    mesh = read_mesh(b.write(tmp_path / "a.gltf"))
    material = mesh.materials[0]
    assert (material.name, material.base_colour, material.roughness) == ("skin", (0.5, 0.25, 1.0), 0.3)
    assert material.metallic == 1.0
    np.testing.assert_array_equal(material.base_colour_image.pixels, pixels)
    assert material.base_colour_image.srgb and not material.metallic_roughness_image.srgb
    assert material.base_colour_image.wrap == ("clamp", "repeat")
    np.testing.assert_allclose(mesh.corner_uvs[0], [[0, 1], [1, 1], [0, 0]])
    np.testing.assert_allclose(mesh.vertex_colours[0], [1, 0, 0.2], atol=1e-7)  # linear by definition
    assert material.emission == (1.0, 0.0, 0.0) and material.emission_image is None and not mesh.notes
    assert material.alpha == 1.0 and material.alpha_image is None


def test_gltf_has_emission_specular_and_coat(tmp_path) -> None:
    pixels = np.zeros((2, 2, 4), np.uint8)
    pixels[..., 0], pixels[..., 3] = 128, 64
    Pillow.fromarray(pixels).save(tmp_path / "t.png")
    b = quad(material=0)
    b.json["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = b.accessor(np.zeros((4, 2), np.float32), "VEC2")
    extensions = {
        "KHR_materials_emissive_strength": {"emissiveStrength": 8},
        "KHR_materials_specular": {"specularFactor": 0.5, "specularTexture": {"index": 0}},
        "KHR_materials_clearcoat": {"clearcoatFactor": 0.75, "clearcoatTexture": {"index": 0}},
        "KHR_materials_sheen": {},
    }
    entry = {
        "name": "lamp", "emissiveFactor": [1, 0.5, 0], "emissiveTexture": {"index": 0}, "extensions": extensions,
    }  # fmt: skip
    b.json |= {"materials": [entry], "textures": [{"source": 0}], "images": [{"uri": "t.png"}]}
    mesh = read_mesh(b.write(tmp_path / "a.gltf"))
    material = mesh.materials[0]
    assert (material.emission, material.specular, material.coat) == ((8.0, 4.0, 0.0), 0.25, 0.75)
    assert material.emission_image.srgb and not material.coat_image.srgb
    assert material.specular_image.pixels.max() == pytest.approx(64 / 255)
    assert mesh.notes == ["lamp: KHR_materials_sheen ignored"]
    entry["emissiveFactor"] = [-1, 0, 0]
    mesh = read_mesh(b.write(tmp_path / "b.gltf"))
    assert not any(mesh.materials[0].emission) and "emission ignored" in mesh.notes[0]


@pytest.mark.parametrize(("mode", "cut"), [("MASK", True), ("BLEND", False), ("OPAQUE", False)])
def test_alpha_and_normal_maps_of_gltf(tmp_path: Path, mode: str, cut: bool) -> None:
    """Alpha times its factor, cut where the material says so; a normal map on other coordinates is left out."""
    pixels = np.full((4, 4, 4), 200, np.uint8)
    pixels[..., 3] = np.linspace(0, 255, 16).reshape(4, 4)
    Pillow.fromarray(pixels).save(tmp_path / "t.png")
    b = quad(material=0)
    b.json["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = b.accessor(np.zeros((4, 2), np.float32), "VEC2")
    pbr = {"baseColorFactor": [1, 1, 1, 0.5], "baseColorTexture": {"index": 0}}
    bumps = {"index": 0, "scale": 0.7}
    b.json |= {
        "materials": [{"pbrMetallicRoughness": pbr, "alphaMode": mode, "alphaCutoff": 0.3, "normalTexture": bumps}],
        "textures": [{"source": 0}],
        "images": [{"uri": "t.png"}],
    }
    material = read_mesh(b.write(tmp_path / "a.gltf")).materials[0]
    assert material.cut_out is cut and (material.alpha_image is None) is (mode == "OPAQUE")
    if mode == "MASK":
        np.testing.assert_array_equal(material.alpha_image.pixels, pixels[..., 3] / 255 * 0.5 >= 0.3)
    elif mode == "BLEND":
        np.testing.assert_allclose(material.alpha * material.alpha_image.pixels, pixels[..., 3] / 255 * 0.5, atol=1e-6)
    assert material.normal_image is not None and not material.normal_image.srgb
    assert material.normal_strength == 0.7
    bumps["texCoord"] = 1
    other = read_mesh(b.write(tmp_path / "b.gltf"))
    assert other.materials[0].normal_image is None and "normal map ignored" in " ".join(other.notes)


def test_uv_transform_is_khr_texture_transform_with_v_up() -> None:
    """Against the extension's own formula (v down): translate, rotate, scale."""
    offset, angle, scale = np.array([0.2, -0.3]), 0.7, np.array([1.5, -2.0])
    uv = np.random.default_rng(0).random((20, 2))
    c, s = np.cos(angle), np.sin(angle)
    expected = (uv * scale) @ np.array([[c, s], [-s, c]]).T + offset
    up = np.concatenate([uv[:, :1], 1 - uv[:, 1:], np.ones((20, 1))], axis=1) @ uv_transform(offset, angle, scale).T
    np.testing.assert_allclose(np.stack([up[:, 0], 1 - up[:, 1]], axis=1), expected, atol=1e-12)


def test_missing_texture_is_a_note_not_a_failure(tmp_path: Path) -> None:
    b = quad(material=0)
    b.json |= {
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"uri": "gone.png"}],
    }
    mesh = read_mesh(b.write(tmp_path / "a.gltf"))
    assert len(mesh.faces) == 2 and any("gone.png" in note for note in mesh.notes)


def test_specular_glossiness_is_converted(tmp_path: Path) -> None:
    for specular, metallic in (([0.04] * 3, 0.0), ([0.9] * 3, 1.0)):
        b = quad(material=0)
        entry = {"diffuseFactor": [0.6 * (1 - metallic)] * 3 + [1], "specularFactor": specular, "glossinessFactor": 0.7}
        b.json["materials"] = [{"extensions": {"KHR_materials_pbrSpecularGlossiness": entry}}]
        material = read_mesh(b.write(tmp_path / "a.gltf")).materials[0]
        assert material.metallic == pytest.approx(metallic) and material.roughness == pytest.approx(0.3)
        assert material.base_colour[0] == pytest.approx(0.9 if metallic else 0.6)


def test_sparse_accessors_replace_values(tmp_path: Path) -> None:
    b = quad()
    b.accessor(np.array([1, 3], np.uint8), "SCALAR")
    b.accessor(np.array([[5, 5, 5], [6, 6, 6]], np.float32), "VEC3")
    views = len(b.json["bufferViews"])
    b.json["accessors"][0]["sparse"] = {
        "count": 2,
        "indices": {"bufferView": views - 2, "componentType": 5121},
        "values": {"bufferView": views - 1},
    }
    vertices = read_mesh(b.write(tmp_path / "a.gltf")).vertices
    np.testing.assert_array_equal(vertices[[1, 3]], vectors_to_z_up(np.array([[5, 5, 5], [6, 6, 6]])))
    np.testing.assert_array_equal(vertices[[0, 2]], vectors_to_z_up(POSITIONS[[0, 2]]))


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda j: j["nodes"].append({"children": [1]}) or j.update(scenes=[{"nodes": [1]}]), "two parents"),
        (lambda j: j.update(nodes=[{"children": [1], "mesh": 0}, {"children": [0]}]), "contain themselves"),
        (lambda j: j["accessors"][0].update(count=400), "leaves buffer view"),
        (lambda j: j["accessors"][0].update(count=10**15), "leaves buffer view"),
        (
            lambda j: j["accessors"][0].pop("bufferView") is None or j["accessors"][0].update(count=10**12),
            "without data",
        ),
        (lambda j: j["bufferViews"][0].update(byteLength=10**9), "beyond the end"),
        (lambda j: j["meshes"][0]["primitives"][0].update(indices=7), "number 7 of 2"),
        (lambda j: j["accessors"][0].update(type="VEC2"), "VEC3"),
        (lambda j: j["nodes"][0].update(scale=[1, "2", 3]), "wrong type"),
        (lambda j: j["nodes"][0].update(scale=[1, 10**400, 3]), "not finite"),
        (lambda j: j["nodes"][0].update(mesh=True), "wrong type"),
        (lambda j: j.update(buffers=[{"uri": "\ud800.bin"}]), "no file beside or below"),
        (lambda j: j["asset"].update(version="1.0"), "version"),
        (lambda j: j.update(extensionsRequired=["KHR_draco_mesh_compression"]), "compressed"),
        (lambda j: j["meshes"][0]["primitives"][0].update(extensions={"KHR_draco_mesh_compression": {}}), "Draco"),
    ],
)
def test_damaged_gltf_is_refused_with_the_reason(tmp_path: Path, change: Any, words: str) -> None:
    b = quad()
    path = b.write(tmp_path / "a.gltf")
    change(b.json)
    path.write_text(json.dumps(b.json))
    with pytest.raises(AssetError, match=words):
        read_mesh(path)


@pytest.mark.slow
@pytest.mark.parametrize("deep", [False, True])
def test_many_nodes_and_joints_are_read_in_time(tmp_path: Path, deep: bool) -> None:
    """In proportion to their number: 10 000 are a file of some 100 kB."""
    b, count = quad({"skin": 0}), 10_000
    joints = list(range(1, count + 1))
    b.json["nodes"] += [{"children": [joint + 1]} if deep and joint < count else {} for joint in joints]
    b.json |= {"skins": [{"joints": joints}], "scenes": [{"nodes": [0, 1] if deep else [0, *joints]}]}
    path = b.write(tmp_path / "a.gltf")
    start = time.process_time()
    assert len(read_mesh(path).faces) == 2
    assert time.process_time() - start < 5


@pytest.mark.parametrize(
    "uri", ["../out.bin", "a/../../out.bin", "%2e%2e/out.bin", "..\\out.bin", "/etc/passwd", "file:///etc/passwd"]
)
def test_data_outside_the_folder_are_never_opened(tmp_path: Path, uri: str) -> None:
    b = quad()
    (tmp_path / "inside" / "a").mkdir(parents=True)
    path = b.write(tmp_path / "inside" / "a.gltf")
    (tmp_path / "out.bin").write_bytes(b.data)
    b.json["buffers"] = [{"byteLength": len(b.data), "uri": uri}]
    path.write_text(json.dumps(b.json))
    with pytest.raises(AssetError, match="no file beside or below"):
        read_mesh(path)
    (tmp_path / "inside" / "in.bin").write_bytes(b.data)
    path.write_text(json.dumps(b.json | {"buffers": [{"byteLength": len(b.data), "uri": "a/../in.bin"}]}))
    assert len(read_mesh(path).faces) == 2


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [np.nan, np.inf, 3e38])
def test_values_that_overflow_are_no_warnings_of_numpy(tmp_path: Path, value: float) -> None:
    b = quad({"scale": [1e10, 1e10, 1e10], "rotation": [0.5, 0.5, 0.5, 0.5]})
    vertices = POSITIONS.copy()
    vertices[3] = value
    b.json["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = b.accessor(vertices, "VEC3")
    mesh = read_mesh(b.write(tmp_path / "a.gltf"))
    assert np.isfinite(mesh.vertices).all() and len(mesh.faces) == 1


def test_faces_beyond_the_vertices_are_refused(tmp_path: Path) -> None:
    b = quad()
    b.json["meshes"][0]["primitives"][0]["indices"] = b.accessor(np.array([0, 1, 9], np.uint32), "SCALAR")
    with pytest.raises(AssetError, match="vertex 9 of 4"):
        read_mesh(b.write(tmp_path / "a.gltf"))


def test_truncated_glb_says_how_much_of_it_is_there(tmp_path: Path) -> None:
    path = quad().write(tmp_path / "a.glb", True)
    data = path.read_bytes()
    path.write_bytes(data[:100])
    with pytest.raises(AssetError, match=f"truncated GLB: 100 of {len(data)} bytes"):
        read_mesh(path)
    path.write_bytes(data[:4] + struct.pack("<I", 1) + data[8:])
    with pytest.raises(AssetError, match="version 1; 2 is read"):
        read_mesh(path)


@pytest.mark.parametrize("glb", [False, True])
def test_gltf_mutants_never_crash(tmp_path: Path, glb: bool) -> None:
    data = quad({"rotation": [0, 0, 0, 1]}).write(tmp_path / "a.gltf", glb).read_bytes()
    rng = np.random.default_rng(9)
    for _ in range(250):
        mutant = bytearray(data)
        mutant[rng.integers(len(data))] = rng.integers(32, 127)
        (tmp_path / "a.gltf").write_bytes(mutant)
        try:
            mesh = read_mesh(tmp_path / "a.gltf")
        except AssetError:
            continue
        assert np.isfinite(mesh.vertices).all()


DUMP = """
import sys, bpy, numpy as np
for source, target in zip(sys.argv[1::2], sys.argv[2::2]):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=source)
    for o in bpy.data.objects:
        if o.type == "ARMATURE":
            o.data.pose_position = "REST"
    bpy.context.view_layer.update()
    points = []
    for o in bpy.context.scene.objects:
        if o.type == "MESH" and "glTF_not_exported" not in {c.name for c in o.users_collection}:
            v = np.empty(3 * len(o.data.vertices), "f4")
            o.data.vertices.foreach_get("co", v)
            m = np.array(o.matrix_world)
            points.append(v.reshape(-1, 3) @ m[:3, :3].T + m[:3, 3])
    np.save(target, np.concatenate(points))
"""
RIGS = (
    "RobotExpressive.glb",
    "CesiumMan.glb",
    "Fox.glb",
    "RiggedSimple.glb",
    "SimpleSkin.gltf",
    "MorphStressTest.gltf",
)


@pytest.fixture(scope="module")
def blender_rest(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the rest positions that Blender's own importer gives, one .npy a rig."""
    if not BLENDER_PYTHON.exists():
        pytest.skip("Blender's Python is not installed in .venv-blender")
    folder = tmp_path_factory.mktemp("rest")
    pairs = [str(x) for rig in RIGS for x in (shared_data / "rigs" / rig, folder / f"{rig}.npy")]
    subprocess.run([BLENDER_PYTHON, "-c", DUMP, *pairs], check=True, timeout=180, capture_output=True)
    return folder


@pytest.mark.parametrize("rig", RIGS)
def test_skinned_meshes_rest_where_blender_rests_them(blender_rest: Path, shared_data: Path, rig: str) -> None:
    """Rest pose, not frame 0: with an animation the two differ, and weights belong to the rest pose."""
    theirs = np.load(blender_rest / f"{rig}.npy")
    ours = read_mesh(shared_data / "rigs" / rig).vertices
    size = np.ptp(theirs, axis=0).max()
    assert len(ours) == len(theirs)
    assert cKDTree(theirs).query(ours)[0].max() < 1e-4 * size
    assert cKDTree(ours).query(theirs)[0].max() < 1e-4 * size


def test_the_default_pose_is_what_viewers_show(shared_data: Path) -> None:
    """RobotExpressive stands on the ground in its default pose; its rest pose in Blender is taken apart."""
    robot = read_gltf(shared_data / "rigs" / "RobotExpressive.glb", pose="default")
    assert abs(robot.vertices[:, 2].min()) < 0.05 and 4 < robot.vertices[:, 2].max() < 5
    assert "skinned: the mesh is in its default pose" in robot.notes


def test_real_gltf_files(shared_data: Path) -> None:
    helmet = read_mesh(shared_data / "meshes/pbr/FlightHelmet/FlightHelmet.gltf")
    assert len(helmet.faces) == 94722 and len(helmet.materials) == 6 and len(helmet.parts) == 6
    assert all(m.base_colour_image and m.metallic_roughness_image for m in helmet.materials)
    np.testing.assert_allclose(np.linalg.norm(helmet.corner_normals, axis=2), 1, atol=1e-5)
    cat = read_mesh(shared_data / "meshes/pbr/egyptian_cat.glb")
    assert len(cat.faces) == 4622 and cat.materials[0].base_colour_image.pixels.shape == (1024, 1024, 3)


OBJ = """mtllib a.mtl
o body
v 0 0 0 1 0 0
v 1 0 0 1 0 0
v 1 1 0 1 0 0
v 0 1 0 0.5 0.5 0.5
vt 0 0
vt 1 0
vt 1 1
vt 0 1
vn 0 0 2
usemtl red paint
f 1/1/1 2/2/1 3/3/1 4/4/1
o lid
usemtl glass
f -4//1 -3//1 \\
 -2//1
"""


def test_obj_with_materials(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(OBJ)
    (tmp_path / "a.mtl").write_text("newmtl red paint\nKd .5 .25 .125\nPr .4\nPm 1\nmap_Kd -s 1 1 1 t 1.png\n")
    Pillow.fromarray(np.full((2, 2, 3), 7, np.uint8)).save(tmp_path / "1.png")
    mesh = read_mesh(tmp_path / "a.obj")
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2]]
    assert mesh.face_material.tolist() == [0, 0, 1] and mesh.parts == [("body", 0, 2), ("lid", 2, 3)]
    paint = mesh.materials[0]
    assert (paint.name, paint.roughness, paint.metallic) == ("red paint", 0.4, 1.0)
    assert paint.base_colour == (1, 1, 1) and paint.base_colour_image.pixels[0, 0].tolist() == [7, 7, 7]
    assert "material glass is not described" in mesh.notes
    np.testing.assert_array_equal(mesh.corner_uvs[1], [[0, 0], [1, 1], [0, 1]])
    np.testing.assert_array_equal(mesh.corner_normals, np.broadcast_to([0, 0, 1], (3, 3, 3)))
    np.testing.assert_allclose(mesh.vertex_colours[3], srgb_to_linear(np.full(3, 0.5)), atol=1e-7)
    assert mesh.up_axis == "unknown"


def test_options_of_mtl_maps_move_textures_or_are_named(tmp_path: Path) -> None:
    """Names may hold spaces; numbers that are left out change nothing."""
    (tmp_path / "a.obj").write_text(OBJ)
    (tmp_path / "a.mtl").write_text(
        "newmtl red paint\nmap_Kd -clamp on -o .25 -.5 -s 2 3 1 -mm 0 1 -blendu on my wood.png\n"
        "map_Ke -s 2 -mm .1 2 -imfchan l my wood.png\nmap_d -boost 1 -s x my wood.png\nnorm -bm .5 -o 0 1 n.png\n"
    )
    Pillow.fromarray(np.full((2, 2, 3), 7, np.uint8)).save(tmp_path / "my wood.png")
    Pillow.fromarray(np.uint8([[[127, 127, 255]]])).save(tmp_path / "n.png")
    mesh = read_mesh(tmp_path / "a.obj")
    paint = mesh.materials[0]
    np.testing.assert_array_equal(paint.base_colour_image.uv_transform, [[2, 0, 0.25], [0, 3, -0.5]])
    np.testing.assert_array_equal(paint.emission_image.uv_transform, [[2, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(paint.normal_image.uv_transform, [[1, 0, 0], [0, 1, 1]])
    assert paint.normal_strength == 0.5 and paint.alpha_image is None and not paint.normal_image.srgb
    assert [note for note in mesh.notes if "glass" not in note and "colours" not in note] == [
        "red paint: -clamp of map_Kd ignored", "red paint: -mm, -imfchan of map_Ke ignored",
        "a.mtl: line 'map_d -boost 1 -s x my wood.png' not understood",
    ]  # fmt: skip


@pytest.mark.parametrize(
    "line", ["f 1 2 9", "f 1 2 -9", "f 0 1 2", "v 1 2", "v a b c", "f 1//7 2 3", "f /1 /2 /3", "vt"]
)
def test_bad_obj_lines_are_named(tmp_path: Path, line: str) -> None:
    (tmp_path / "a.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\n{line}\n")
    with pytest.raises(AssetError, match="line 5"):
        read_mesh(tmp_path / "a.obj")


@pytest.mark.parametrize(
    "line", ["Kd nan 0 0", "Kd 1e39 0 0", "Ns", "Ns 1e400", "Pr", "Pr nan", "Pm inf", "Pc", "d nan"]
)
def test_bad_lines_of_obj_materials_are_named_and_left_out(tmp_path: Path, line: str) -> None:
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nusemtl red\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (tmp_path / "a.mtl").write_text(f"newmtl red\n{line}\nKe 1 2 3\n")
    mesh = read_mesh(tmp_path / "a.obj")
    assert mesh.notes == [f"a.mtl: line {line!r} not understood"]
    assert mesh.materials[0].emission == (1, 2, 3) and mesh.materials[0].base_colour == MaterialFile("").base_colour


def test_a_real_obj_with_texture(shared_data: Path) -> None:
    spot = read_mesh(shared_data / "meshes/spot_textured/spot_triangulated.obj")
    assert spot.faces.shape == (5856, 3) and spot.vertices.shape == (2930, 3)
    assert spot.corner_uvs.shape == (5856, 3, 2) and len(np.unique(spot.corner_uvs.reshape(-1, 2), axis=0)) > 2930


@pytest.mark.parametrize(("scale", "broken"), [(40.0, True), (1.5, False), (1.0, False)])
def test_a_rest_pose_of_another_size_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture, scale, broken) -> None:
    """A joint that is scaled, and a bind matrix that takes it back: bones have no scale in Blender's rest pose."""
    arrays = [
        np.float32([(0, 0, 0), (1, 0, 0), (0, 1, 0)]), np.zeros((3, 4), np.uint8),
        np.tile(np.float32((1, 0, 0, 0)), (3, 1)),
        np.uint16([0, 1, 2, 0]), np.diag([1 / scale] * 3 + [1]).astype(np.float32),
    ]  # fmt: skip
    views, data = [], b""
    for array in arrays:
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes})
        data += array.tobytes()
    kinds = [(5126, "VEC3", 3), (5121, "VEC4", 3), (5126, "VEC4", 3), (5123, "SCALAR", 3), (5126, "MAT4", 1)]
    accessors = [
        {"bufferView": k, "componentType": component, "type": kind, "count": count}
        for k, (component, kind, count) in enumerate(kinds)
    ]
    text = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0, 1]}],
        "nodes": [{"mesh": 0, "skin": 0}, {"scale": [scale] * 3}],
        "skins": [{"joints": [1], "inverseBindMatrices": 4}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "JOINTS_0": 1, "WEIGHTS_0": 2}, "indices": 3}]}],
        "buffers": [{"byteLength": len(data), "uri": "data:;base64," + base64.b64encode(data).decode()}],
        "bufferViews": views, "accessors": accessors,
    }  # fmt: skip
    path = tmp_path / "arm.gltf"
    path.write_text(json.dumps(text))
    sizes = [np.ptp(read_mesh(path, pose).vertices, axis=0).max() for pose in ("rest", "default")]
    assert sizes == pytest.approx([1 / scale, 1])
    assert ("its rest pose is 0.025 x" in caplog.text and "--pose default" in caplog.text) == broken
