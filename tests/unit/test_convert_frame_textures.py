"""Images of the objects in a frame that Blender exported, written with the mesh of all of them."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow
from splat_files import random_splats

from drgs_blender.cli.main import main
from drgs_blender.core.asset import Asset, Mesh, Surfels
from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.textures import MeshTextures
from drgs_blender.core.frame import Camera, Frame, ObjectState, RenderSettings
from drgs_blender.deform.binding import bind
from drgs_blender.formats.files import MeshFile
from drgs_blender.formats.registry import read_mesh
from drgs_blender.ipc.frame_file import write_frame_file

SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
UVS = ((SQUARE[:, :2] + 1) / 2)[FACES]


def textured(path: Path, value: int, normals: bool = False) -> None:
    """Write a square with an image of one grey, of a name that all such squares have."""
    data = io.BytesIO()
    Pillow.fromarray(np.full((4, 4, 3), value, np.uint8)).save(data, "PNG")
    leaning = np.tile(np.float32([0.6, 0, 0.8]), (2, 3, 1)) if normals else None
    slots = np.full((1, 4), -1)
    slots[0, 0] = 0
    textures = MeshTextures(
        UVS, np.zeros(2), slots, np.ones((1, 6)), np.tile(np.eye(2, 3), (1, 4, 1, 1)), np.zeros((1, 4)), ["paint"],
        {"picture": np.frombuffer(data.getvalue(), np.uint8)}, leaning,
    )  # fmt: skip
    _write(path, textures)


def _write(path: Path, textures: MeshTextures | None) -> None:
    mesh = Mesh(SQUARE, FACES, np.full((4, 3), 0.5), np.ones(4), np.zeros(4), textures=textures)
    splats = random_splats(20, 9)
    n = len(splats)
    up = np.tile([1.0, 0, 0, 0], (n, 1))
    surfels = Surfels(
        splats.centre * [0.3, 0.3, 0],
        splats.scale[:, :2],
        up,
        np.ones(n),
        np.full((n, 3), 0.5),
        np.ones(n),
        np.zeros(n),
    )
    write_asset(path, Asset(surfels, mesh, bind(mesh, surfels)[0]))


def converted(folder: Path, objects: list[ObjectState]) -> MeshFile:
    camera = Camera(np.eye(4), 8, 8, 8.0, 8.0, 4.0, 4.0)
    write_frame_file(folder / "f.drgsframe", Frame(1, camera, objects, settings=RenderSettings()))
    assert main(["convert", str(folder / "f.drgsframe"), str(folder / "f.glb"), "--as", "mesh"]) == 0
    return read_mesh(folder / "f.glb")


def test_images_of_all_objects_are_written_where_they_are(tmp_path: Path) -> None:
    """Posed, moved and mirrored ones, beside one that has none; images of one name stay two."""
    textured(tmp_path / "a.drgs", 40)
    textured(tmp_path / "b.drgs", 200, normals=True)
    _write(tmp_path / "plain.drgs", None)
    moved, mirrored = np.eye(4), np.diag([-2.0, 2, 2, 1])
    moved[:3, 3], mirrored[:3, 3] = (5, 0, 0), (-9, 0, 0)
    file = converted(
        tmp_path,
        [
            ObjectState("A", str(tmp_path / "a.drgs"), moved, vertices=SQUARE * np.float32([1, 1.5, 1])),
            ObjectState("plain", str(tmp_path / "plain.drgs")),
            ObjectState("B", str(tmp_path / "b.drgs"), mirrored),
        ],
    )
    assert len(file.faces) == 6 and file.face_material is not None and file.corner_uvs is not None
    found = {}
    for face, material, uvs in zip(file.faces, file.face_material, file.corner_uvs, strict=True):
        corners, image = file.vertices[face], file.materials[material].base_colour_image
        where = "A" if corners[:, 0].min() > 3 else "B" if corners[:, 0].max() < -3 else "plain"
        if where == "plain":
            continue
        found[where] = int(image.pixels.reshape(-1)[0])
        local = (corners - (5, 0, 0)) / (1, 1.5, 1) if where == "A" else (corners - (-9, 0, 0)) / (-2, 2, 2)
        np.testing.assert_allclose(uvs, (local[:, :2] + 1) / 2, atol=1e-5)
        assert np.cross(corners[1] - corners[0], corners[2] - corners[0])[2] > 0
    assert found == {"A": 40, "B": 200}
    assert file.corner_normals is not None
    middle = file.vertices[file.faces].mean(axis=1)[:, 0]
    np.testing.assert_allclose(file.corner_normals[middle < -3], np.broadcast_to([-0.6, 0, 0.8], (2, 3, 3)), atol=1e-3)
    np.testing.assert_allclose(file.corner_normals[middle > 3], np.broadcast_to([0, 0, 1], (2, 3, 3)), atol=1e-3)


def test_images_of_what_is_painted_are_left_out_and_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    textured(tmp_path / "a.drgs", 40)
    state = ObjectState("A", str(tmp_path / "a.drgs"))
    painted = replace(state, albedo=np.full((4, 3), 0.3, np.float32))
    with_image = converted(tmp_path, [state]).materials
    assert "images are left out" not in capsys.readouterr().out
    without = converted(tmp_path, [painted]).materials
    assert "A: is painted or adjusted, so its images are left out" in capsys.readouterr().out
    assert with_image != without
