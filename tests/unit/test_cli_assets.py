"""``drgs make``, ``import``, ``inspect`` and ``doctor`` on files made here."""

from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from drgs_blender.cli import doctor, import_surfels
from drgs_blender.cli.find_blender import find_blender
from drgs_blender.cli.inspect_file import as_lines, short_lines
from drgs_blender.cli.main import main
from drgs_blender.compute.warp import runtime
from drgs_blender.core import errors
from drgs_blender.core.asset.container import read_asset
from drgs_blender.core.errors import DeviceError
from drgs_blender.formats.gltf import read_gltf
from drgs_blender.render.film.frame_files import write_frame

#: Unit cube, each face on the whole texture.
CUBE = """mtllib cube.mtl
v -1 -1 -1
v 1 -1 -1
v 1 1 -1
v -1 1 -1
v -1 -1 1
v 1 -1 1
v 1 1 1
v -1 1 1
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl paint
f 1/1 4/2 3/3 2/4
f 5/1 6/2 7/3 8/4
f 1/1 2/2 6/3 5/4
f 3/1 4/2 8/3 7/4
f 2/1 3/2 7/3 6/4
f 4/1 1/2 5/3 8/4
"""


@pytest.fixture
def cube(tmp_path: Path) -> Path:
    """A textured cube: the lower half of each face dark red, the upper half light blue."""
    pixels = np.zeros((8, 8, 3), np.uint8)
    pixels[4:], pixels[:4] = (188, 0, 0), (0, 0, 255)
    Image.fromarray(pixels).save(tmp_path / "paint.png")
    (tmp_path / "cube.mtl").write_text("newmtl paint\nKd 1 1 1\nmap_Kd paint.png\n")
    (tmp_path / "cube.obj").write_text(CUBE)
    return tmp_path / "cube.obj"


def splats(path: Path) -> Path:
    """A PLY in the layout of 2D Gaussian splatting: 400 discs on a unit sphere, in the colour of albedo 0.5."""
    turn = np.arange(400)
    z = 1 - (2 * turn + 1) / 400
    angle = turn * np.pi * (3 - np.sqrt(5))  # Fibonacci lattice: evenly spread
    ring = np.sqrt(1 - z**2)
    direction = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
    # Quaternion that turns +Z to the direction: half way between the two.
    rotation = np.stack([1 + direction[:, 2], -direction[:, 1], direction[:, 0], np.zeros(400)], axis=1)
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    columns = {name: direction[:, k] for k, name in enumerate("xyz")}
    columns |= {f"f_dc_{k}": np.zeros(400) for k in range(3)}
    columns |= {"opacity": np.full(400, 4.0)}
    columns |= {f"scale_{k}": np.full(400, np.log(0.08)) for k in range(2)}
    columns |= {f"rot_{k}": rotation[:, k] for k in range(4)}
    header = ["ply", "format binary_little_endian 1.0", "element vertex 400"]
    header += [f"property float {name}" for name in columns] + ["end_header", ""]
    path.write_bytes("\n".join(header).encode() + np.stack([*columns.values()], axis=1).astype("<f4").tobytes())
    return path


def described(path: Path, capsys: pytest.CaptureFixture) -> dict:
    """What ``drgs inspect --json`` says."""
    capsys.readouterr()
    assert main(["inspect", str(path), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_make_carries_the_texture_to_the_mesh(cube, tmp_path, capsys):
    out = tmp_path / "cube.drgs"
    assert main(["make", str(cube), "--up", "z", "--out", str(out)]) == 0
    asset = read_asset(out)
    said = capsys.readouterr().out
    assert f"{len(asset.surfels)} surfels on {len(asset.mesh.faces)} triangles" in said
    # sRGB 188 is 0.503 linear (IEC 61966-2-1).
    for part in (asset.mesh, asset.surfels):
        red, blue = part.albedo[:, 0], part.albedo[:, 2]
        assert red.max() == pytest.approx(0.503, abs=0.01) and blue.max() == pytest.approx(1, abs=0.01)
        assert part.albedo[:, 1].max() < 0.01
    np.testing.assert_allclose(np.abs(asset.mesh.vertices).max(axis=0), 1, atol=1e-6)
    report = described(out, capsys)
    assert (report["kind"], report["bound"], report["verified"]) == ("asset", True, True)
    assert report["counts"]["surfels"] == len(asset.surfels)


def test_up_axis_turns_the_object(cube, tmp_path):
    cube.write_text(CUBE.replace("v 1 1 1\n", "v 1 3 1\n"))
    tops = []
    for up in ("y", "z", "-y"):
        assert main(["make", str(cube), "--up", up, "--density", "20", "--out", str(tmp_path / "c.drgs")]) == 0
        vertices = read_asset(tmp_path / "c.drgs").mesh.vertices
        tops.append([vertices.min(axis=0), vertices.max(axis=0)])
    assert tops[0][1][2] == pytest.approx(3) and tops[1][1][1] == pytest.approx(3)
    assert tops[2][0][2] == pytest.approx(-3)


def test_import_builds_a_mesh_around_splats(tmp_path, capsys):
    out = tmp_path / "ball.drgs"
    assert main(["import", str(splats(tmp_path / "s.ply")), "--resolution", "24", "--out", str(out)]) == 0
    asset = read_asset(out)
    assert len(asset.surfels) == 400 and asset.binding is not None
    radius = np.linalg.norm(asset.mesh.vertices, axis=1)
    assert np.abs(radius - 1).max() < 0.15
    report = described(out, capsys)
    assert report["provenance"]["surfels"] == "s.ply" and report["counts"]["faces"] == len(asset.mesh.faces)


def test_import_without_a_mesh_and_a_picture_of_it(tmp_path, capsys):
    """Surfels alone: described, and rendered whatever light meets of them."""
    Image.fromarray(np.full((4, 8, 3), 255, np.uint8)).save(tmp_path / "white.png")
    out, png = tmp_path / "ball.drgs", tmp_path / "ball.png"
    source = ["import", str(splats(tmp_path / "s.ply")), "--no-mesh", "--env", str(tmp_path / "white.png")]
    assert main([*source, "--out", str(out)]) == 0
    report = described(out, capsys)
    assert report["counts"]["faces"] == 0 and report["counts"]["surfels"] == 400 and not report["bound"]
    camera = {"matrix_world": [[1, 0, 0, 0], [0, 0, -1, -4], [0, 1, 0, 0], [0, 0, 0, 1]], "fov_x": 40}
    (tmp_path / "c.json").write_text(json.dumps(camera | {"width": 16, "height": 16}))
    picture = ["relight", str(out), "--camera", str(tmp_path / "c.json"), "--samples", "16", "--out", str(png)]
    for rays_see in ("mesh", "surfels"):
        assert main([*picture, "--rays-see", rays_see, "--transparent"]) == 0
        pixels = np.asarray(Image.open(png))
        assert pixels[8, 8, 3] > 240 and 100 < pixels[8, 8, 0] < 255 and pixels[0, 0, 3] == 0


@pytest.mark.slow
def test_scale_is_of_all_lengths(cube, tmp_path):
    for command in (["make", str(cube)], ["import", str(splats(tmp_path / "s.ply")), "--mesh", str(cube)]):
        sizes = []
        for scale in ("1", "0.01"):
            assert main([*command, "--up", "z", "--scale", scale, "--out", str(tmp_path / "a.drgs")]) == 0
            asset = read_asset(tmp_path / "a.drgs")
            lengths = asset.mesh.vertices, asset.surfels.centre, asset.surfels.scale
            sizes.append([np.abs(values).max() for values in lengths] + [len(asset.surfels)])
        np.testing.assert_allclose(sizes[1], np.multiply(sizes[0], [0.01, 0.01, 0.01, 1]), rtol=1e-3)


def test_import_with_its_mesh_and_light(cube, tmp_path):
    Image.fromarray(np.full((4, 8, 3), 255, np.uint8)).save(tmp_path / "white.png")
    out = tmp_path / "a.drgs"
    arguments = ["import", str(splats(tmp_path / "s.ply")), "--mesh", str(cube), "--env", str(tmp_path / "white.png")]
    assert main([*arguments, "--out", str(out)]) == 0
    asset = read_asset(out)
    np.testing.assert_allclose(asset.environment.radiance, 1, atol=1e-6)
    np.testing.assert_allclose(np.abs(asset.mesh.vertices).max(axis=0), 1, atol=1e-6)


def test_inspect_knows_every_kind(cube, tmp_path, capsys):
    passes = {"Combined": np.ones((3, 5, 4), np.float32), "Depth": np.full((3, 5, 1), 7, np.float32)}
    write_frame(tmp_path / "f.exr", passes, {"settings": "abc"})
    frame = described(tmp_path / "f.exr", capsys)
    assert (frame["kind"], frame["width"], frame["height"]) == ("frame", 5, 3)
    assert frame["passes"]["Depth"]["range"] == [7, 7] and frame["metadata"]["settings"] == "abc"
    mesh = described(cube, capsys)
    assert mesh["kind"] == "mesh" and mesh["faces"]["shape"] == [12, 3]
    surfels = described(splats(tmp_path / "s.ply"), capsys)
    assert surfels["kind"] == "surfels" and surfels["surfels"]["centre"]["shape"] == [400, 3]
    assert described(tmp_path / "paint.png", capsys)["kind"] == "environment"
    assert main(["inspect", str(cube)]) == 0
    assert "faces: 12 x 3 int32" in capsys.readouterr().out


def test_a_rendered_frame_becomes_a_picture_to_look_at(tmp_path, capsys):
    """And is taken for a light only where one is written."""
    combined = np.zeros((4, 8, 4), np.float32)
    combined[:2] = (0.5, 0.25, 0, 0.5)  # premultiplied
    for number in (1, 2):
        write_frame(tmp_path / f"{number:04}.exr", {"Combined": combined * number}, {})
    pattern = ["convert", str(tmp_path / "####.exr")]
    assert main([*pattern, str(tmp_path / "look" / "####.png"), "--frames"]) == 0
    assert "0001.png: 8 x 4 picture, sRGB" in capsys.readouterr().out
    first, second = (np.asarray(Image.open(tmp_path / "look" / f"000{k}.png")) for k in (1, 2))
    assert first[0, 0].tolist() == [255, 188, 0, 128] and not first[2:].any() and second[0, 0, 3] == 255
    frame = str(tmp_path / "0001.exr")
    assert main(["convert", frame, str(tmp_path / "a.jpg")]) == errors.EXIT_USAGE
    assert "0001.exr: is a rendered frame, and cannot be written as .jpg. Name OUT .png" in capsys.readouterr().err
    assert main(["convert", frame, str(tmp_path / "a.png"), "--env", frame]) == errors.EXIT_USAGE
    assert "--env: does not go with a rendered frame" in capsys.readouterr().err
    assert main(["convert", frame, str(tmp_path / "light.exr")]) == 0
    assert "8 x 4 environment" in capsys.readouterr().out


def test_what_is_an_asset_already_is_said(tmp_path, capsys):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    asset = tmp_path / "a.drgs"
    assert main(["make", str(tmp_path / "a.obj"), "--out", str(asset), "--density", "4"]) == 0
    for command in ("make", "import"):
        assert main([command, str(asset), "--out", str(tmp_path / "b.drgs")]) == errors.EXIT_BAD_ASSET
        said = capsys.readouterr().err
        assert "a.drgs: is a DR-GS asset already. Render it by `drgs relight` or import it into Blender" in said


def test_what_is_no_surfels_is_refused_before_kernels_are_compiled(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(import_surfels, "prepare_engine", lambda *_: pytest.fail("compiles first"))
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    out = ["--out", str(tmp_path / "b.drgs")]
    assert main(["import", str(tmp_path / "a.obj"), *out]) == errors.EXIT_BAD_ASSET
    assert "is Wavefront OBJ, not surfels. `drgs make`, Make Asset in Blender, makes" in capsys.readouterr().err
    surfels = str(splats(tmp_path / "s.ply"))
    packed = str(tmp_path / "s.spz")
    assert main(["convert", surfels, packed]) == 0
    assert main(["import", surfels, "--mesh", packed, *out]) == errors.EXIT_BAD_ASSET
    assert main(["make", packed, *out]) == errors.EXIT_BAD_ASSET
    assert capsys.readouterr().err.count("s.spz: is SPZ, not mesh. `drgs import`, Import in Blender, makes") == 2


def test_inspect_names_the_passes_of_another_program(tmp_path, capsys):
    """Blender writes multi-layer files with a part for each pass, or one part for all."""
    planes = {
        f"ViewLayer.{name}": np.full((3, 5), k, np.float32) for k, name in enumerate(("Combined.R", "Combined.A"))
    }
    depth = {"ViewLayer.Depth.Z": np.full((3, 5), 7, np.float32)}
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    parts = [OpenEXR.Part(dict(header), dict(one), name) for name, one in (("Combined", planes), ("Depth", depth))]
    OpenEXR.File(parts).write(str(tmp_path / "parts.exr"))
    OpenEXR.File(dict(header), planes | depth).write(str(tmp_path / "one.exr"))
    OpenEXR.File(dict(header), {c: np.ones((2, 4), np.float32) for c in "RGB"}).write(str(tmp_path / "light.exr"))
    for name in ("parts.exr", "one.exr"):
        frame = described(tmp_path / name, capsys)
        assert (frame["kind"], frame["width"], frame["height"]) == ("frame", 5, 3)
        assert frame["passes"]["ViewLayer.Depth"] == {"shape": [3, 5, 1], "dtype": "float32", "range": [7, 7]}
        assert frame["passes"]["ViewLayer.Combined"]["shape"] == [3, 5, 2]
    assert described(tmp_path / "light.exr", capsys)["kind"] == "environment"


def test_inspect_shows_the_first_of_many_names_and_counts_them():
    names = [f"r_{k}" for k in range(100)]
    (line,) = as_lines({"learned_from": names})
    assert line == f"learned_from: {', '.join(names[:16])}, ... (100 in all)"


def test_inspect_counts_what_is_long_unless_all_is_asked_for():
    report = {
        "kind": "asset",
        "settings": {"a": {"b": 1, "c": 2, "d": {"e": 3}}, "f": [1, 2]},
        "views": [{"x": 1.5}] * 3,
    }
    short, whole = ("\n".join(as_lines(report, whole=whole)) for whole in (False, True))
    assert "a: 3 values, see --all" in short and "f: 1, 2" in short and "views: 3, see --all" in short
    assert "see --all" not in whole and "e: 3" in whole and whole.count("x: 1.5") == 3


@pytest.mark.parametrize("length", [3, 12, 40, 400])
def test_inspect_shows_a_person_thirty_lines_at_most(length: int) -> None:
    """Short descriptions as they are; of others what is in them, the longest parts in a line or two; --all has all."""
    numbers = {f"name {i}": [0.0, float(i)] for i in range(length)}
    report = {"kind": "asset", "counts": numbers, "bounds": {"mesh": [[0, 0, 0], [1, 2, 3]]}, "digest": "abc"}
    report |= {"ranges": dict(numbers), "notes": [f"a sentence that is long enough, number {i}" for i in range(length)]}
    lines, whole = short_lines(report), list(as_lines(report))
    assert len(lines) <= 30 and "digest: abc" in lines and "kind: asset" in lines
    assert all(len(line) < 140 for line in lines)
    if len(whole) <= 30:
        assert lines == whole
    else:
        assert any("see --all" in line for line in lines) or f"name {length - 1}: 0, {length - 1}" in " ".join(lines)
    many = {f"key {i}": i for i in range(length)}
    assert len(short_lines(many)) == min(length, 30)
    assert length <= 30 or short_lines(many)[-1] == f"... {length - 29} more lines, see --all"


def test_inspect_of_an_asset_is_short_and_json_is_whole(cube, tmp_path, capsys) -> None:
    out = tmp_path / "cube.drgs"
    assert main(["make", str(cube), "--out", str(out)]) == 0
    capsys.readouterr()
    assert main(["inspect", str(out)]) == 0
    short = capsys.readouterr().out.splitlines()
    assert len(short) <= 30 and any(line.startswith("counts: ") and "surfels: " in line for line in short)
    assert main(["inspect", str(out), "--all"]) == 0
    assert len(capsys.readouterr().out.splitlines()) > 60
    told = described(out, capsys)
    assert len(told["members"]["mesh.safetensors"]) > 2 and told["bounds"]["mesh"][1]


def test_inspect_counts_what_is_not_finite(tmp_path, capsys):
    picture = np.ones((2, 2, 4), np.float32)
    picture[0, 0] = np.nan
    write_frame(tmp_path / "f.exr", {"Combined": picture}, {})
    combined = described(tmp_path / "f.exr", capsys)["passes"]["Combined"]
    assert combined["not_finite"] == 4 and combined["range"] == [1, 1]


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["inspect", "absent.ply"], 65),
        (["inspect", "noise.bin"], 65),
        (["inspect", "torn.drgs"], 65),
        (["inspect", "."], 65),
        (["make", "absent.obj", "--out", "o.drgs"], 65),
        (["make", "noise.bin", "--out", "o.drgs"], 65),
        (["make", "cube.obj", "--out", "cube.obj/o.drgs"], 73),
        (["make", "cube.obj", "--out", "o.drgs", "--env", "noise.bin"], 65),
        (["import", "cube.obj", "--out", "o.drgs"], 65),
        (["import", "absent.ply", "--out", "o.drgs"], 65),
        (["import", "noise.bin", "--out", "o.drgs", "--resolution", "0"], 64),
    ],
)
def test_bad_files_are_named(cube, monkeypatch, capsys, arguments, code):
    monkeypatch.chdir(cube.parent)
    Path("noise.bin").write_bytes(np.random.default_rng(0).bytes(4096))
    Path("torn.drgs").write_bytes(b"PK\x03\x04 and no more")
    assert main(arguments) == code
    err = capsys.readouterr().err
    assert "Traceback" not in err and "internal" not in err
    assert not Path("o.drgs").exists()


def test_doctor_finds_this_environment_healthy(capsys):
    """What it renders with, and what it builds meshes with."""
    assert main(["doctor", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    states = {check["name"]: check["state"] for check in report["checks"]}
    assert report["healthy"]
    assert {states[name] for name in ("Python", "Numba", "Embree", "OpenEXR", "engine", "scikit-image")} == {"ok"}


def test_doctor_names_what_is_missing_and_the_remedy(monkeypatch, capsys, tmp_path):
    monkeypatch.setenv("DRGS_ENGINE", str(tmp_path / "gone"))
    monkeypatch.setattr(doctor.importlib.metadata, "version", lambda name: "3.3.0")
    assert main(["doctor", "--json"]) == 69
    checks = {check["name"]: check for check in json.loads(capsys.readouterr().out)["checks"]}
    assert checks["engine"]["state"] == "missing" and "DRGS_ENGINE" in checks["engine"]["detail"]
    assert checks["OpenEXR"]["state"] == "missing" and "pip install" in checks["OpenEXR"]["remedy"]


def test_doctor_only_notes_the_absence_of_what_is_optional(monkeypatch, capsys, tmp_path):
    monkeypatch.setenv("DRGS_BLENDER", str(tmp_path / "gone"))
    monkeypatch.setattr(doctor, "CHECKS", [c for c in doctor.CHECKS if c[0] in ("Python", "Blender")])
    assert main(["doctor"]) == 0
    text = capsys.readouterr().out
    assert "absent   Blender" in text and "DRGS_BLENDER" in text


def test_a_node_needs_blender_and_its_extension(monkeypatch, capsys, tmp_path):
    """What `drgs render` would start is started: without it a node is no node."""
    checks = [c for c in doctor.NODE_CHECKS if c[0] in ("Blender", "extension")]
    assert len(checks) == 2 and all(essential for _, essential, _ in checks)
    monkeypatch.setattr(doctor, "NODE_CHECKS", checks)
    empty = tmp_path / "python"
    empty.write_text("#!/bin/sh\nexit 3\n")
    empty.chmod(0o755)
    assert main(["doctor", "--node", "--json", "--blender", str(empty)]) == 69
    found = json.loads(capsys.readouterr().out)["checks"]
    assert [check["state"] for check in found] == ["missing", "missing"]
    assert "exit code 3" in found[1]["detail"]
    try:
        find_blender()
    except DeviceError as error:
        pytest.skip(str(error))
    assert main(["doctor", "--node"]) == 0
    assert "answers" in capsys.readouterr().out


def test_doctor_says_a_name_once(monkeypatch, capsys):
    def absent(name):
        raise doctor.importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(doctor.importlib.metadata, "version", absent)
    monkeypatch.setattr(doctor, "CHECKS", [c for c in doctor.CHECKS if c[0] == "torch"])
    assert main(["doctor"]) == 0
    assert "absent   torch        is not installed\n" in capsys.readouterr().out


def test_doctor_does_without_a_graphics_card(monkeypatch, capfd):
    monkeypatch.setattr(doctor, "CHECKS", [c for c in doctor.CHECKS if c[0] == "GPU"])
    warns = lambda: os.write(2, b"Warp CUDA warning\n")  # noqa: E731
    monkeypatch.setattr(runtime, "warp", warns)
    monkeypatch.setattr(runtime, "cuda_devices", list)
    assert main(["doctor"]) == 0
    found = capfd.readouterr()
    assert found.out.startswith("none     GPU          no NVIDIA GPU found; the CPU renders\n") and not found.err

    def absent():
        raise DeviceError("device cuda", "the package warp-lang cannot be imported", "Install it")

    monkeypatch.setattr(runtime, "warp", absent)
    assert main(["doctor"]) == 0
    assert "warp-lang cannot be imported; the CPU renders\n" in capfd.readouterr().out


@pytest.mark.parametrize("rig", ["RobotExpressive.glb"])
def test_pose_of_a_rig(shared_data, tmp_path, rig):
    path = next(shared_data.rglob(rig))
    extents = []
    for pose in ("rest", "default"):
        out = tmp_path / f"{pose}.drgs"
        assert main(["make", str(path), "--pose", pose, "--density", "20", "--out", str(out)]) == 0
        mesh = read_asset(out).mesh
        expected = read_gltf(path, pose=pose).vertices
        extents.append(np.stack([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)]))
        np.testing.assert_allclose(extents[-1], [expected.min(axis=0), expected.max(axis=0)], atol=1e-4)
    assert np.abs(extents[0] - extents[1]).max() > 0.01


def test_inspect_tells_a_sog_folder_from_a_capture(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Both may be a JSON file beside pictures."""
    packed = tmp_path / "ball.sog"
    assert main(["convert", str(splats(tmp_path / "ball.ply")), str(packed)]) == 0
    with zipfile.ZipFile(packed) as archive:
        archive.extractall(tmp_path / "ball")
    found = described(tmp_path / "ball" / "meta.json", capsys)
    assert found["kind"] == "surfels" and found["surfels"]["centre"]["shape"] == [400, 3]
