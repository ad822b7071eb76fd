"""Frames that Blender exported, written as splats, meshes and light."""

from __future__ import annotations

import hashlib
import json
import typing
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from splat_files import covariance, random_splats

from drgs_blender.cli.main import main
from drgs_blender.core.asset import Asset, Mesh, Surfels
from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.color import srgb_to_linear
from drgs_blender.core.errors import AssetError, VersionError
from drgs_blender.core.frame import Camera, Frame, Light, MeshState, ObjectState, RenderSettings, Visibility, World
from drgs_blender.deform.binding import bind
from drgs_blender.formats.harmonics import rotate_harmonics
from drgs_blender.formats.registry import read_environment, read_mesh, read_surfels
from drgs_blender.ipc import frame_file
from drgs_blender.ipc.codec import CodecError, completed, decode_frame, encode_frame
from drgs_blender.ipc.frame_file import read_frame_file, write_frame_file
from drgs_blender.ipc.protocol import PROTOCOL

SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def plate(path: Path, albedo: float = 0.5, meshless: bool = False) -> Path:
    """Rough surfels with captured colours on a square that faces +Z."""
    splats = random_splats(60, 9)
    n = len(splats)
    centre = splats.centre * [0.3, 0.3, 0]
    turn = np.random.default_rng(2).uniform(0, np.pi, n)
    rotation = np.stack([np.cos(turn / 2), 0 * turn, 0 * turn, np.sin(turn / 2)], axis=1)
    grey = np.full((n, 3), albedo)
    surfels = Surfels(centre, splats.scale[:, :2], rotation, np.full(n, 0.9), grey, np.ones(n), np.zeros(n), splats.sh)
    mesh = Mesh(SQUARE, FACES, np.full((4, 3), albedo), np.ones(4), np.zeros(4))
    asset = Asset(surfels, Mesh.empty()) if meshless else Asset(surfels, mesh, bind(mesh, surfels)[0])
    write_asset(path, asset)
    return path


def frame_of(objects: list[ObjectState], **more: object) -> Frame:
    camera = Camera(np.eye(4), 8, 8, 8.0, 8.0, 4.0, 4.0)
    settings = RenderSettings(bounces=0, shading_model="paper")
    return Frame(1, camera, objects, settings=more.pop("settings", settings), **more)  # type: ignore[arg-type]


@pytest.mark.parametrize("rays_see", ["mesh", "surfels"])
def test_what_has_no_mesh_shows_its_lit_side(tmp_path: Path, rays_see: str) -> None:
    """Whichever way its surfels face: below a lamp a plate shows what one with a mesh shows."""
    lamp = Light("sun", "sun", np.eye(4), power=1.0)
    shown = []
    for meshless in (False, True):
        turned = np.diag([1.0, -1, -1, 1]) if meshless else np.eye(4)
        file = plate(tmp_path / f"{meshless}.drgs", meshless=meshless)
        state = ObjectState("plate", str(file), matrix_world=turned)
        settings = RenderSettings(bounces=0, shading_model="paper", rays_see=rays_see)  # type: ignore[arg-type]
        write_frame_file(tmp_path / "a.drgsframe", frame_of([state], lights=[lamp], settings=settings))
        out = tmp_path / "relit.ply"
        assert main(["convert", str(tmp_path / "a.drgsframe"), str(out), "--as", "splats", "--colour", "relit"]) == 0
        shown.append(read_surfels(out).surfels.sh[:, 0] * 0.28209479 + 0.5)  # type: ignore[index]
    assert shown[0].min() > 0.1 and shown[0].max() < 0.9
    linear = [srgb_to_linear(values.astype(np.float64)).mean() for values in shown]
    assert linear[1] == pytest.approx(linear[0], rel=0.15)  # they overlap


def test_frame_files_keep_the_frame(tmp_path: Path) -> None:
    state = ObjectState("ball", "//ball.drgs", vertices=SQUARE, albedo=np.full((4, 3), 0.2, np.float32))
    frame = frame_of(
        [state], lights=[Light("sun", "sun", np.eye(4), power=3.0)], world=World(np.ones((2, 4, 3), np.float32))
    )
    write_frame_file(tmp_path / "a.drgsframe", frame)
    back = read_frame_file(tmp_path / "a.drgsframe")
    np.testing.assert_array_equal(back.objects[0].vertices, SQUARE)
    assert back.objects[0].asset == "//ball.drgs" and back.lights[0].power == 3 and back.settings == frame.settings
    np.testing.assert_array_equal(back.world.environment, frame.world.environment)


KEPT = Path(__file__).parent / "kept"


def test_frame_files_of_format_1_open(tmp_path: Path) -> None:
    """Kept from before samples were one number and settings had the names of the panels."""
    frame = read_frame_file(KEPT / "frame-1.drgsframe")
    expected = RenderSettings(
        samples=40, subpixel_samples=4, camera_sees="mesh", rays_see="surfels", shading_model="paper", denoise="svgf",
        seed=3, noise_threshold=0.02,
    )  # fmt: skip
    assert frame.settings == expected and frame.noise_index == 7 and frame.history == "shot"
    assert (frame.objects[0].adjustment.hue, frame.lights[0].power, frame.images[0].encoding) == (0.1, 20.0, "srgb")
    strategies = read_frame_file(KEPT / "frame-1-strategies.drgsframe").settings
    assert (strategies.strategy_samples, strategies.sample_count) == ((16, 8, 4), 28)
    write_frame_file(tmp_path / "again.drgsframe", frame)
    assert read_frame_file(tmp_path / "again.drgsframe").settings == expected


def test_fields_that_came_after_format_2_have_their_defaults() -> None:
    light = Light("sun", "sun", np.eye(4))
    data, arrays = encode_frame(frame_of([ObjectState("ball", "b.drgs")], lights=[light]))
    old = json.loads(json.dumps(data))
    for name in ("panorama", "fov", "lens"):
        del old["camera"][name]
    del old["lights"][0]["normalize"], old["history"]
    assert completed(Frame, old) == data
    assert decode_frame(completed(Frame, old), arrays).camera.lens == (0.0, 1.0, 0.0, 0.0, 0.0)
    old["camera"]["colour"] = 3
    with pytest.raises(CodecError, match="camera"):
        decode_frame(completed(Frame, old), arrays)


def test_frame_files_of_the_format_before_lack_what_came_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Filter Glossy came with format 12."""
    encode = frame_file.encode_frame

    def before(frame: Frame) -> tuple[dict, dict]:
        data, arrays = encode(frame)
        del data["settings"]["filter_glossy"]
        return data, arrays

    monkeypatch.setattr(frame_file, "FORMAT", 11)
    monkeypatch.setattr(frame_file, "encode_frame", before)
    write_frame_file(tmp_path / "a.drgsframe", frame_of([], settings=RenderSettings(samples=7, filter_glossy=3.0)))
    monkeypatch.undo()
    settings = read_frame_file(tmp_path / "a.drgsframe").settings
    assert (settings.samples, settings.filter_glossy) == (7, 0.0)


def test_a_change_of_the_fields_of_frames_is_a_new_format() -> None:
    """Where this fails, raise both numbers: programs of either side of the change must not take each other's frames."""

    def fields_of(kind: Any, known: set[Any]) -> list[str]:
        found: list[str] = []
        for part in (kind, *typing.get_args(kind)):
            if is_dataclass(part) and part not in known:
                known.add(part)
                for name, hint in typing.get_type_hints(part).items():
                    found += [f"{part.__name__}.{name}", *fields_of(hint, known)]
            elif part is not kind:
                found += fields_of(part, known)
        return found

    names = fields_of(Frame, set())
    assert "RenderSettings.filter_glossy" in names and "MeshState.materials" in names
    digest = hashlib.sha256("\n".join(sorted(names)).encode()).hexdigest()[:12]
    assert (frame_file.FORMAT, PROTOCOL, digest) == (12, 18, "b2b6a75cfba6")


def test_frame_files_of_a_later_format_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frame_file, "FORMAT", later := frame_file.FORMAT + 1)
    write_frame_file(tmp_path / "a.drgsframe", frame_of([]))
    monkeypatch.undo()
    with pytest.raises(VersionError, match=rf"has format {later}.*Use a later DR-GS"):
        read_frame_file(tmp_path / "a.drgsframe")


def test_damaged_frame_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.drgsframe"
    write_frame_file(path, frame_of([ObjectState("ball", "b.drgs", vertices=SQUARE)]))
    data = path.read_bytes()
    rng = np.random.default_rng(1)
    refused = 0
    for _ in range(200):
        changed = bytearray(data[: rng.integers(len(data))] if rng.random() < 0.3 else data)
        if changed:
            changed[rng.integers(len(changed))] = rng.integers(256)
        path.write_bytes(bytes(changed))
        try:
            read_frame_file(path)
        except AssetError as error:
            refused += 1
            assert str(path) in str(error)
        except VersionError:  # a digit of the version was hit
            refused += 1
    assert refused > 100
    assert main(["convert", str(tmp_path / "none.drgsframe"), str(tmp_path / "a.ply")]) == 65


def test_objects_stand_where_their_matrices_put_them(tmp_path: Path) -> None:
    """Two instances of an asset, one of them mirrored and larger; a third that the camera does not see is left out."""
    asset = str(plate(tmp_path / "plate.drgs"))
    matrix = np.array([[0, -2, 0, 5], [-2, 0, 0, 1], [0, 0, 2, -3], [0, 0, 0, 1.0]])
    states = [
        ObjectState("a", asset),
        ObjectState("b", asset, matrix_world=matrix),
        ObjectState("c", asset, matrix_world=5 * matrix, visibility=Visibility(camera=False)),
    ]
    write_frame_file(tmp_path / "f.drgsframe", frame_of(states))
    assert main(["convert", str(tmp_path / "f.drgsframe"), str(tmp_path / "f.ply"), "--as", "splats"]) == 0
    found = read_surfels(tmp_path / "f.ply").surfels
    assert len(found) == 120
    np.testing.assert_allclose(found.centre[60:], found.centre[:60] @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-5)
    first = covariance(found.rotation[:60], found.scale[:60])
    wanted = matrix[:3, :3] @ first @ matrix[:3, :3].T
    np.testing.assert_allclose(covariance(found.rotation[60:], found.scale[60:]), wanted, atol=1e-5)
    np.testing.assert_allclose(found.sh[60:], rotate_harmonics(found.sh[:60], matrix[:3, :3] / 2), atol=1e-4)
    assert main(["convert", str(tmp_path / "f.drgsframe"), str(tmp_path / "f.glb"), "--scale", "2"]) == 0
    mesh = read_mesh(tmp_path / "f.glb")
    assert len(mesh.faces) == 4
    np.testing.assert_allclose(mesh.vertices.min(axis=0), [-2, -2, -6], atol=1e-5)


def test_an_object_may_be_hidden_in_some_frames_of_a_sequence_but_not_in_all(tmp_path, capsys) -> None:
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    asset = str(plate(tmp_path / "plate.drgs"))
    for number in (1, 2):
        states = [ObjectState("a", asset), ObjectState("b", asset, visibility=Visibility(camera=number == 2))]
        write_frame_file(tmp_path / f"{number}.drgsframe", frame_of(states))
    given = ["convert", str(tmp_path / "#.drgsframe"), str(tmp_path / "f.usdc"), "--frames", "1-2", "--object"]
    assert main([*given, "b"]) == 0
    stage = Usd.Stage.Open(str(tmp_path / "f.usdc"))
    (prim,) = stage.GetDefaultPrim().GetChildren()
    seen = [UsdGeom.Imageable(prim).ComputeVisibility(number) for number in (1, 2)]
    assert prim.GetName() == "b" and seen == ["invisible", "inherited"]
    (tmp_path / "f.usdc").unlink()
    assert main([*given, "c"]) == 64
    assert "--object c" in (told := capsys.readouterr().err) and "#.drgsframe, which has a, b" in told
    given[4] = "1"
    assert main([*given, "b", "--as", "sequence"]) == 64
    assert not (tmp_path / "f.usdc").exists()


@pytest.mark.parametrize("rays_see", ["mesh", "surfels"])
def test_the_light_of_the_scene_is_baked_with_its_lights_and_shadows(tmp_path: Path, rays_see: str) -> None:
    """A sun from above of 1 W/m2 on a plate of albedo a leaves a / pi; half of it lies in the shadow of a mesh."""
    asset = str(plate(tmp_path / "plate.drgs", 0.8, meshless=rays_see == "surfels"))
    settings = RenderSettings(bounces=0, shading_model="paper", rays_see=rays_see)  # type: ignore[arg-type]
    sun = Light("sun", "sun", np.eye(4), power=np.pi * 0.5)
    lid = MeshState("lid", SQUARE * [1, 2, 1] + np.float32([1, 0, 0.5]), FACES, np.eye(4)[None], np.zeros(1, np.int32))
    black = World(None, colour=(0.0, 0.0, 0.0))
    for name, meshes in (("open", []), ("half", [lid])):
        frame = frame_of([ObjectState("a", asset)], world=black, lights=[sun], meshes=meshes, settings=settings)
        write_frame_file(tmp_path / f"{name}.drgsframe", frame)
        options = ["--as", "splats", "--colour", "relit", "--samples", "64"]
        assert main(["convert", str(tmp_path / f"{name}.drgsframe"), str(tmp_path / f"{name}.ply"), *options]) == 0
    surfels = [read_surfels(tmp_path / f"{name}.ply").surfels for name in ("open", "half")]
    lit = surfels[0].albedo.mean()
    assert 0.4 < lit < 0.44  # 0.8 / 2 of diffuse light, and a little that is glossy
    under = surfels[1].centre[:, 0] > 0.05
    assert surfels[1].albedo[under].max() < 0.02
    np.testing.assert_allclose(surfels[1].albedo[surfels[1].centre[:, 0] < -0.05].mean(), lit, rtol=0.05)


def test_painted_materials_are_what_is_written(tmp_path: Path) -> None:
    asset = str(plate(tmp_path / "plate.drgs"))
    state = ObjectState("a", asset, albedo=np.tile(np.float32([0.9, 0.1, 0.2]), (4, 1)))
    write_frame_file(tmp_path / "f.drgsframe", frame_of([state]))
    assert (
        main(
            ["convert", str(tmp_path / "f.drgsframe"), str(tmp_path / "f.ply"), "--as", "splats", "--colour", "albedo"]
        )
        == 0
    )
    np.testing.assert_allclose(read_surfels(tmp_path / "f.ply").surfels.albedo.mean(axis=0), [0.9, 0.1, 0.2], atol=1e-3)


def test_the_world_is_written_as_it_is_turned(tmp_path: Path) -> None:
    """A quarter turn about Z moves the columns of the picture by a quarter of its width."""
    picture = np.random.default_rng(4).uniform(0, 9, (8, 16, 3)).astype(np.float32)
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    write_frame_file(tmp_path / "f.drgsframe", frame_of([], world=World(picture, quarter, (1.0, 0.5, 2.0), 3.0)))
    assert main(["convert", str(tmp_path / "f.drgsframe"), str(tmp_path / "f.exr")]) == 0
    found = read_environment(tmp_path / "f.exr").radiance
    np.testing.assert_allclose(found, np.roll(picture, 4, axis=1) * np.float32([3, 1.5, 6]), rtol=1e-3)
    assert main(["convert", str(tmp_path / "f.drgsframe"), str(tmp_path / "f.ply")]) == 64


def test_a_file_a_frame(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asset = str(plate(tmp_path / "plate.drgs"))
    for number in (1, 2, 3):
        moved = SQUARE + np.float32([0, 0, number])
        write_frame_file(tmp_path / f"f{number:04d}.drgsframe", frame_of([ObjectState("a", asset, vertices=moved)]))
    arguments = [str(tmp_path / "f####.drgsframe"), str(tmp_path / "o##.spz"), "--frames", "1-3", "--as", "splats"]
    assert main(["convert", *arguments]) == 0
    for number in (1, 2, 3):
        np.testing.assert_allclose(
            read_surfels(tmp_path / f"o{number:02d}.spz").surfels.centre[:, 1], number, atol=2e-4
        )


def test_inspect_describes_an_exported_frame(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", str(KEPT / "frame-1.drgsframe"), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    frame = read_frame_file(KEPT / "frame-1.drgsframe")
    assert (report["kind"], report["width"]) == ("exported frame", frame.camera.width)
    assert report["version"] and list(report["objects"]) == [state.name for state in frame.objects]
