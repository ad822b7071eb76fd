"""Moving objects as one USD stage, read by USD's own library."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from shapes import sphere_mesh
from splat_files import random_splats

pytest.importorskip("pxr", reason="usd-core is an optional package")
from pxr import Usd, UsdGeom, UsdShade, UsdValidation, UsdVol

from drgs_blender.cli.main import main
from drgs_blender.core.asset import Asset, Mesh, Surfels
from drgs_blender.core.asset.container import read_asset, write_asset
from drgs_blender.core.errors import AssetError, UsageError, WriteError
from drgs_blender.core.file_types import USD_SUFFIXES
from drgs_blender.core.frame import ObjectState
from drgs_blender.core.frame_sequences import frame_path
from drgs_blender.deform.binding import bind
from drgs_blender.formats.point_cache import write_point_cache
from drgs_blender.formats.usd_sequence import MovingObject, write_usd_sequence
from drgs_blender.ipc.frame_file import write_frame_file

from test_cli_convert_frame import frame_of, plate  # isort: skip
from test_mesh_textures import textured, uniform  # isort: skip

VERTICES, FACES = sphere_mesh(1)
#: Vertices of six frames: still, then moving, then still.
SHAPES = [VERTICES * np.float32(size) for size in (1, 1, 1, 2, 3, 3)]


def ball(vertices: np.ndarray) -> Mesh:
    share = np.linspace(0, 1, len(VERTICES), dtype=np.float32)
    albedo = np.stack([share, 1 - share, share**2], axis=1)
    return Mesh(vertices, FACES, albedo, share, 1 - share)


def moving(name: str = "Ball", **more: object) -> list[tuple[int, list[MovingObject]]]:
    """The frames 11 to 16."""
    return [(11 + i, [MovingObject(name, ball(v), np.eye(4), **more)]) for i, v in enumerate(SHAPES)]  # type: ignore[arg-type]


def checked(path: Path) -> Usd.Stage:
    """The stage, in which OpenUSD finds nothing wrong."""
    stage = Usd.Stage.Open(str(path))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    faults = UsdValidation.ValidationContext(validators).Validate(stage)
    assert len(validators) > 10 and not faults, [f.GetMessage() for f in faults]
    return stage


def points(stage: Usd.Stage, time: float, path: str = "/root/Ball/Ball") -> np.ndarray:
    return np.array(UsdGeom.PointBased(stage.GetPrimAtPath(path)).GetPointsAttr().Get(time))


@pytest.mark.parametrize("suffix", USD_SUFFIXES)
def test_the_mesh_moves_over_time(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"ball{suffix}"
    write_usd_sequence(path, moving(), 25.0)
    stage = checked(path)
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (11, 16)
    assert (stage.GetTimeCodesPerSecond(), stage.GetFramesPerSecond()) == (25, 25)
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/root/Ball/Ball"))
    np.testing.assert_array_equal(np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3), FACES)
    for i, vertices in enumerate(SHAPES):
        np.testing.assert_array_equal(points(stage, 11 + i), vertices)
        np.testing.assert_allclose(mesh.GetExtentAttr().Get(11 + i), [vertices.min(axis=0), vertices.max(axis=0)])
        normals = np.array(mesh.GetNormalsAttr().Get(11 + i))
        assert (normals * VERTICES).sum(axis=1).min() > 0.99
    # What stands still has one sample at either end of the pause, and is not a blend of what comes next.
    np.testing.assert_array_equal(points(stage, 12.5), SHAPES[0])
    assert mesh.GetPointsAttr().GetTimeSamples() == [11, 13, 14, 15]
    primvars = UsdGeom.PrimvarsAPI(mesh)
    for name in ("albedo", "roughness", "metallic"):
        primvar = primvars.GetPrimvar(name)
        assert primvar.GetInterpolation() == "vertex" and not primvar.GetAttr().GetTimeSamples()
        np.testing.assert_array_equal(np.array(primvar.Get()), getattr(ball(VERTICES), name))


@pytest.mark.parametrize("suffix", [".usdc", ".usdz"])
def test_images_are_found_from_the_stage(tmp_path: Path, suffix: str) -> None:
    """Two objects, whose images have the same names alone: each shows its own at its texture coordinates."""
    path = tmp_path / f"both{suffix}"
    red = replace(ball(VERTICES), albedo=ball(VERTICES).albedo * [1, 0, 0])
    write_usd_sequence(path, [(1, [MovingObject("A b", red, np.eye(4)), *moving()[0][1]])], 24.0)
    stage = checked(path)
    for name, mesh in (("A_b", red), ("Ball", ball(VERTICES))):
        shape = UsdGeom.Mesh(stage.GetPrimAtPath(f"/root/{name}/{name}"))
        material, _ = UsdShade.MaterialBindingAPI(shape).ComputeBoundMaterial()
        source, _, _ = material.ComputeSurfaceSource("")[0].GetInput("diffuseColor").GetConnectedSource()
        file = UsdShade.Shader(source).GetInput("file").Get().resolvedPath
        assert file, "the image is not found"
        if suffix == ".usdz":
            assert file.startswith(f"{path}[textures/{name}_")
            continue
        pixels = np.asarray(Image.open(file))[..., :3]
        assert (pixels[..., 1].max() > 200) == (mesh is not red)


def test_transforms_and_visibility_are_animated(tmp_path: Path) -> None:
    frames = moving()
    for number, (state,) in frames:
        state.mesh, state.matrix_world = ball(VERTICES), np.diag([1.0, -2, 1, 1])
        state.matrix_world[:3, 3] = number, 0, 1
    late = [(number, [*states, *([MovingObject("Late", ball(VERTICES), np.eye(4))] * (number in (13, 14)))])
            for number, states in frames]  # fmt: skip
    write_usd_sequence(tmp_path / "a.usda", late, 24.0)
    stage = checked(tmp_path / "a.usda")
    assert not UsdGeom.PointBased(stage.GetPrimAtPath("/root/Ball/Ball")).GetPointsAttr().GetTimeSamples()
    for number in range(11, 17):
        placed = UsdGeom.XformCache(number).GetLocalToWorldTransform(stage.GetPrimAtPath("/root/Ball/Ball"))
        assert tuple(placed.Transform((1.0, 1.0, 1.0))) == (number + 1, -2, 2)
        seen = UsdGeom.Imageable(stage.GetPrimAtPath("/root/Late")).ComputeVisibility(number)
        assert (seen == "inherited") == (number in (13, 14))


@pytest.mark.parametrize("kernel", ["ellipsoid", "surflet"])
def test_surfels_move_with_it_and_turn_the_shorter_way(tmp_path: Path, kernel: str) -> None:
    rest = random_splats(40, 4)
    frames = moving()
    for number, (state,) in frames:
        sign = np.float32(1 if number % 2 else -1)  # the same rotations
        state.splats = replace(rest, centre=rest.centre + np.float32(number), rotation=rest.rotation * sign)
    write_usd_sequence(tmp_path / "a.usdc", frames, 24.0, kernel=kernel)
    stage = checked(tmp_path / "a.usdc")
    prim = stage.GetPrimAtPath("/root/Ball_surfels")
    assert prim.GetTypeName() == ("ParticleField" if kernel == "surflet" else "ParticleField3DGaussianSplat")
    positions = UsdVol.ParticleFieldPositionAttributeAPI(prim).GetPositionsAttr()
    for number in range(11, 17):
        np.testing.assert_allclose(positions.Get(number), rest.centre + np.float32(number))
    assert not prim.GetAttribute("orientations").GetTimeSamples(), "they turned"
    assert not prim.GetAttribute("opacities").GetTimeSamples()


def test_what_one_file_cannot_hold_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "a.usdc"
    frames = moving()
    fewer = replace(ball(VERTICES), faces=FACES[1:])
    with pytest.raises(UsageError, match=r'a\.usdc.*"Ball" has other faces in frame 12.*####'):
        write_usd_sequence(path, [frames[0], (12, [MovingObject("Ball", fewer, np.eye(4))])], 24.0)
    broken = ball(np.where(np.arange(len(VERTICES))[:, None] == 3, np.nan, VERTICES))
    with pytest.raises(AssetError, match=r'"Ball": has 1 vertices that are NaN or infinite in frame 12'):
        write_usd_sequence(path, [frames[0], (12, [MovingObject("Ball", broken, np.eye(4))])], 24.0)
    some = [MovingObject("Ball", None, np.eye(4), splats=random_splats(k, 1)) for k in (9, 8)]
    with pytest.raises(UsageError, match="another number of surfels in frame 2"):
        write_usd_sequence(path, [(1, some[:1]), (2, some[1:])], 24.0)
    assert not list(tmp_path.iterdir())


def test_a_material_that_changes_is_told(tmp_path: Path) -> None:
    frames = moving()
    frames[3][1][0].mesh = replace(ball(VERTICES), roughness=np.zeros(len(VERTICES)))
    (note,) = write_usd_sequence(tmp_path / "a.usdc", frames, 24.0)
    assert "Ball" in note and "frame 14" in note and "images" in note


def test_a_channel_that_comes_later_is_neutral_before(tmp_path: Path) -> None:
    frames = moving()
    glow = np.full((len(VERTICES), 3), 2, np.float32)
    for number, (state,) in frames[2:4]:
        state.mesh = replace(ball(VERTICES), emission=glow * number)
    write_usd_sequence(tmp_path / "a.usdc", frames, 24.0)
    stage = checked(tmp_path / "a.usdc")
    primvar = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/root/Ball/Ball")).GetPrimvar("emission")
    for number, wanted in zip(range(11, 17), (0, 0, 13, 14, 0, 0), strict=True):
        np.testing.assert_array_equal(np.array(primvar.Get(number)), glow * wanted)


@pytest.mark.parametrize(
    ("name", "file"), [("Material", "a.usdc"), ("particles", "a@b.usda"), ("Würfel 日本", "é.usdz")]
)
def test_all_names_are_taken(tmp_path: Path, name: str, file: str) -> None:
    """An object may be called as what is below it, a file have what ends a path in USD's text."""
    write_usd_sequence(tmp_path / file, moving(name, points=VERTICES), 24.0)
    stage = checked(tmp_path / file)
    (mesh,) = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    assert UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()[0]
    assert len([prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Points)]) == 1
    texture = next(s for prim in stage.Traverse() if (s := UsdShade.Shader(prim)).GetInput("file"))
    assert texture.GetInput("file").Get().resolvedPath


@pytest.mark.parametrize("suffix", USD_SUFFIXES)
def test_frames_are_written_as_they_come(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str) -> None:
    """What is stopped leaves the file of before, and nothing else."""
    monkeypatch.setattr("drgs_blender.formats.usd_sequence._HELD", 0)
    path = tmp_path / f"a{suffix}"
    path.write_text("before")
    noise = np.random.default_rng(0)

    def frames(last: int) -> Iterator[tuple[int, list[MovingObject]]]:
        for number in range(8):
            written = sum(file.stat().st_size for file in tmp_path.glob(".*/*"))
            assert written >= number * VERTICES.nbytes
            if number == last:
                raise KeyboardInterrupt
            yield number, [MovingObject("A", ball(noise.random(VERTICES.shape).astype(np.float32)), np.eye(4))]

    with pytest.raises(KeyboardInterrupt):
        write_usd_sequence(path, frames(5), 24.0)
    assert [path] == list(tmp_path.iterdir()) and path.read_text() == "before"
    write_usd_sequence(path, frames(9), 24.0)
    stage = checked(path)
    assert len(UsdGeom.Mesh(stage.GetPrimAtPath("/root/A/A")).GetPointsAttr().GetTimeSamples()) == 8


def test_a_file_in_the_place_of_its_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "a_textures").write_text("mine")
    with pytest.raises(WriteError, match=r"a_textures.*folder of the images"):
        write_usd_sequence(tmp_path / "a.usdc", moving(), 24.0)
    assert [path.name for path in tmp_path.iterdir()] == ["a_textures"]


def test_a_posed_asset_by_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asset = plate(tmp_path / "plate.drgs")
    rest = read_asset(asset).mesh.vertices
    poses = [rest + np.float32([0, 0, k]) for k in range(4)]
    write_point_cache(tmp_path / "walk.pc2", poses, 4, len(rest), 5, 24.0)
    command = ["convert", str(asset), str(tmp_path / "walk.usdc"), "--vertices", str(tmp_path / "walk.pc2"), "--frames"]
    assert main([*command, "--surfels", "--scale", "2", "--fps", "30"]) == 0
    assert "frames 5 to 8, 30 per second" in capsys.readouterr().out
    stage = checked(tmp_path / "walk.usdc")
    field = UsdVol.ParticleFieldPositionAttributeAPI(stage.GetPrimAtPath("/root/plate_surfels")).GetPositionsAttr()
    for k, pose in enumerate(poses):
        np.testing.assert_array_equal(points(stage, 5 + k, "/root/plate/plate"), 2 * pose)
        np.testing.assert_allclose(np.array(field.Get(5 + k))[:, 2].mean(), 2 * k, atol=1e-5)
    command[2] = str(tmp_path / "splats.usdc")
    assert main([*command, "--as", "splats"]) == 0
    found = checked(tmp_path / "splats.usdc")
    assert found.GetPrimAtPath("/root/plate_surfels") and not found.GetPrimAtPath("/root/plate/plate")
    for more, words in (
        (["--kernel", "surflet"], "--surfels"),
        (["--up=-y"], "--up"),
        (["--compress"], "--compress"),
    ):
        capsys.readouterr()
        assert main([*command, *more]) == 64 and words in capsys.readouterr().err
    one = ["convert", str(asset), str(tmp_path / "one.spz"), "--surfels"]
    assert main(one) == 64 and "--surfels: is no option of SPZ" in capsys.readouterr().err


def test_frames_per_second_are_those_of_the_cache(tmp_path: Path) -> None:
    asset = plate(tmp_path / "plate.drgs")
    rest = read_asset(asset).mesh.vertices
    write_point_cache(tmp_path / "walk.mdd", [rest, rest + 1], 2, len(rest), 1, 48.0)
    given = ["--vertices", str(tmp_path / "walk.mdd"), "--frames"]
    assert main(["convert", str(asset), str(tmp_path / "walk.usdc"), *given]) == 0
    assert checked(tmp_path / "walk.usdc").GetTimeCodesPerSecond() == pytest.approx(48)


@pytest.mark.parametrize(("pattern", "name"), [("walk_####", "walk"), ("####", "asset")])
def test_assets_of_frames_are_one_object(tmp_path: Path, pattern: str, name: str) -> None:
    asset = read_asset(plate(tmp_path / "plate.drgs"))
    for number in (1, 2):
        shape = replace(asset.mesh, vertices=asset.mesh.vertices * np.float32(number))
        write_asset(Path(frame_path(str(tmp_path / f"{pattern}.drgs"), number)), replace(asset, mesh=shape))
    assert main(["convert", str(tmp_path / f"{pattern}.drgs"), str(tmp_path / "a.usdc"), "--frames"]) == 0
    stage = checked(tmp_path / "a.usdc")
    assert [prim.GetName() for prim in stage.GetPrimAtPath("/root").GetChildren()] == [name]
    np.testing.assert_allclose(points(stage, 2, f"/root/{name}/{name}"), 2 * asset.mesh.vertices)


def frames_of(tmp_path: Path, frames: list[list[ObjectState]]) -> list[str]:
    """The beginning of a command that converts frames as Blender describes them."""
    for number, states in enumerate(frames, 1):
        write_frame_file(tmp_path / f"{number:04d}.drgsframe", frame_of(states))
    return ["convert", str(tmp_path / "####.drgsframe"), str(tmp_path / "a.usdc"), "--as", "sequence"]


def test_instances_have_names_that_no_other_object_has(tmp_path: Path) -> None:
    """The copy that Blender calls A.001 stands after the instances of A."""
    file = str(plate(tmp_path / "plate.drgs"))
    states = [ObjectState(name, file, matrix_world=np.eye(4)) for name in ("A", "A", "A.001", "A")]
    for k, state in enumerate(states):
        state.matrix_world[0, 3] = 3 * k
    assert main([*frames_of(tmp_path, [states]), "--scale", "2"]) == 0
    stage = checked(tmp_path / "a.usdc")
    cache = UsdGeom.XformCache(1)
    found = {p.GetName(): cache.GetLocalToWorldTransform(p)[3][0] for p in stage.GetPrimAtPath("/root").GetChildren()}
    assert found == {"A": 0, "A_002": 6, "A_001": 12, "A_003": 18}


def test_normals_of_textures_stay_where_they_give_way_to_paint(tmp_path: Path) -> None:
    asset = textured(uniform((200, 100, 50)))
    textures = asset.mesh.textures
    assert textures is not None
    bent = np.tile(np.float32([0.6, -0.8, 0]), (len(asset.mesh.faces), 3, 1))
    surfels = Surfels([[0, 0, 0]], [[0.1, 0.1]], [[1, 0, 0, 0]], [1], [[0.5] * 3], [0.5], [0])
    mesh = replace(asset.mesh, textures=replace(textures, normals=bent))
    write_asset(tmp_path / "t.drgs", Asset(surfels, mesh, bind(mesh, surfels)[0]))
    painted = np.full((len(mesh.vertices), 3), 0.1, np.float32)
    states = [ObjectState("A", str(tmp_path / "t.drgs"), albedo=albedo) for albedo in (None, painted)]
    assert main(frames_of(tmp_path, [[state] for state in states])) == 0
    stage = checked(tmp_path / "a.usdc")
    shape = UsdGeom.Mesh(stage.GetPrimAtPath("/root/A/A"))
    for number in (1, 2):
        np.testing.assert_allclose(np.array(shape.GetNormalsAttr().Get(number)), bent.reshape(-1, 3), atol=1e-6)
