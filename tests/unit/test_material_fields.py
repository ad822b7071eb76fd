"""Materials in frames: their lobes and textures arrive, and older frames have the defaults."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from drgs_blender.core.frame import Camera, Frame, MeshState
from drgs_blender.core.materials import TEXTURED, Image, Material, Part, Texture
from drgs_blender.ipc import frame_file
from drgs_blender.ipc.codec import completed, decode_frame, encode_frame
from drgs_blender.ipc.frame_file import read_frame_file, write_frame_file

#: Fields that came with the lobes.
LOBES = [field.name for field in fields(Material) if field.name in TEXTURED or field.name in (
    "tangent", "coat_details", "thin_walled", "kind", "multiscatter", "textures", "parts",
)]  # fmt: skip
GLASS = Material(
    "Glass", (0.9, 0.5, 0.2), ior=1.7, specular_level=0.3, specular_tint=(0.2, 0.4, 0.6), anisotropy=0.1,
    anisotropy_rotation=0.2, tangent="uv second", coat=0.3, coat_roughness=0.4, coat_ior=1.6, coat_tint=(0.5, 0.6, 0.7),
    coat_details=True, sheen=0.6, sheen_roughness=0.7, sheen_tint=(0.8, 0.9, 1.0), transmission=0.8, thin_walled=True,
    diffuse_roughness=0.9, kind="glass", multiscatter=True,
    parts=[Part(Material("First", coat=1.0), (0.1, 0.2, 0.3), Texture("picture"), True), Part(Material("Second"))],
    textures={name: Texture("picture", "r", np.eye(2, 3) * i) for i, name in enumerate(TEXTURED, 2)},
)  # fmt: skip


def frame_of(material: Material) -> Frame:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    mesh = MeshState(
        "glass", vertices, np.array([[0, 1, 2]], np.int32), np.eye(4)[None], np.zeros(1, np.int32), materials=[material]
    )
    image = Image("picture", np.zeros((1, 1, 4), np.uint8))
    return Frame(1, Camera(np.eye(4), 8, 8, 8.0, 8.0, 4.0, 4.0), [], meshes=[mesh], images=[image])


def test_the_example_differs_from_the_defaults_in_every_field() -> None:
    assert len(LOBES) == len(TEXTURED) + 7 and set(GLASS.textures) == set(TEXTURED)
    for name in LOBES:
        assert getattr(GLASS, name) != getattr(Material(""), name), name


@pytest.mark.parametrize("way", ["message", "file"])
def test_lobes_and_their_textures_arrive(tmp_path: Path, way: str) -> None:
    if way == "message":
        data, arrays = encode_frame(frame_of(GLASS))
        frame = decode_frame(json.loads(json.dumps(data)), arrays)
    else:
        write_frame_file(tmp_path / "a.drgsframe", frame_of(GLASS))
        frame = read_frame_file(tmp_path / "a.drgsframe")
    back = frame.meshes[0].materials[0]
    for name in set(LOBES) - {"textures", "parts"}:
        assert getattr(back, name) == getattr(GLASS, name), name
    assert back.textures.keys() == GLASS.textures.keys()
    for name, texture in GLASS.textures.items():
        assert_same_texture(back.textures[name], texture)
    first, second = back.parts
    assert (first.material, first.weight, first.inverted) == (GLASS.parts[0].material, (0.1, 0.2, 0.3), True)
    assert_same_texture(first.weight_texture, Texture("picture"))
    assert second == Part(Material("Second"))


def assert_same_texture(one: Texture | None, other: Texture) -> None:
    assert one is not None
    np.testing.assert_array_equal(one.transform, other.transform)
    assert replace(one, transform=other.transform) == other


def test_frame_files_from_before_the_lobes_have_the_defaults(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    encode = frame_file.encode_frame

    def before(frame: Frame) -> tuple[dict, dict]:
        data, arrays = encode(frame)
        for name in LOBES:
            del data["meshes"][0]["materials"][0][name]
        return data, arrays

    plain = Material("Plain", (0.1, 0.2, 0.3), 0.4)
    monkeypatch.setattr(frame_file, "encode_frame", before)
    monkeypatch.setattr(frame_file, "FORMAT", 3)
    write_frame_file(tmp_path / "a.drgsframe", frame_of(plain))
    monkeypatch.undo()
    assert read_frame_file(tmp_path / "a.drgsframe").meshes[0].materials == [plain]


def test_fields_that_textures_lack_have_their_defaults() -> None:
    data, _ = encode_frame(frame_of(GLASS))
    old = json.loads(json.dumps(data))
    for texture in old["meshes"][0]["materials"][0]["textures"].values():
        del texture["layer"]
    assert completed(Frame, old) == data


@pytest.mark.parametrize("name, value", [
    ("ior", 1.3), ("specular_level", 0.0), ("specular_tint", (1.0, 0.9, 1.0)), ("anisotropy", 0.2), ("coat", 0.1),
    ("sheen", 0.1), ("transmission", 0.1), ("diffuse_roughness", 0.1),
])  # fmt: skip
def test_what_needs_more_than_the_base_lobes(name: str, value: object) -> None:
    assert Material("", **{name: value}).has_more_lobes and Material("", textures={name: Texture("i")}).has_more_lobes
    of_metals = name in ("specular_tint", "anisotropy", "coat", "sheen")
    assert Material("", metallic=1.0, **{name: value}).has_more_lobes is of_metals
    assert Material("", metallic=1.0, metallic_texture=Texture("i"), **{name: value}).has_more_lobes


def test_what_the_base_lobes_are_enough_for() -> None:
    assert not Material("").has_more_lobes and Material("", kind="diffuse").has_more_lobes
    assert Material("", parts=[Part(Material(""))]).has_more_lobes
    idle = Material(
        "", (0.1, 0.2, 0.3), 0.2, 0.4, coat_roughness=0.5, coat_ior=2.0, coat_tint=(0.5, 0.5, 0.5), coat_details=True,
        sheen_roughness=0.2, sheen_tint=(0.0, 0.0, 0.0), anisotropy_rotation=0.3, tangent="uv", thin_walled=True,
        multiscatter=True,
    )  # fmt: skip
    assert not idle.has_more_lobes
