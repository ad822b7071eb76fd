"""``drgs relight`` on a small asset: what the options do, and every bad input."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from drgs_blender.cli.main import main
from drgs_blender.core.asset.container import read_asset, write_asset
from drgs_blender.core.asset.model import Asset, Environment, Mesh
from drgs_blender.core.particle_cache import Header, ParticleCache, ParticleFrame
from drgs_blender.core.passes import BY_NAME
from drgs_blender.deform.attach import attach
from drgs_blender.deform.bonds import Bonds
from drgs_blender.render.film.frame_files import read_frame

# Stands at -Y and looks along +Y; the picture's right is +X.
FRONT = {"matrix_world": [[1, 0, 0, 0], [0, 0, -1, -6], [0, 1, 0, 0], [0, 0, 0, 1]], "width": 40, "height": 30}


def octahedron(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit sphere from a subdivided octahedron."""
    vertices = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    faces = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4], [1, 0, 5], [2, 1, 5], [3, 2, 5], [0, 3, 5]])
    for _ in range(subdivisions):
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        corners = np.stack([a, a + b, a + c, a + b, b, b + c, a + c, b + c, c, a + b, b + c, a + c], axis=1)
        corners = corners.reshape(-1, 3) / np.linalg.norm(corners.reshape(-1, 3), axis=1, keepdims=True)
        vertices, index = np.unique(corners.round(9), axis=0, return_inverse=True)
        faces = index.reshape(-1, 3)
    return vertices, faces


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Assets with and without an environment that is bright towards +X, and a camera."""
    folder = tmp_path_factory.mktemp("relight")
    vertices, faces = octahedron(3)
    n = len(vertices)
    mesh = Mesh(vertices, faces, np.full((n, 3), 0.5), np.full(n, 0.8), np.zeros(n))
    surfels, binding, _ = attach(mesh, density=20)
    radiance = np.full((8, 16, 3), 0.05, np.float32)
    radiance[2:6, 6:10] = 4.0  # around +X, the centre of the picture
    write_asset(folder / "ball.drgs", Asset(surfels, mesh, binding))
    write_asset(folder / "lit.drgs", Asset(surfels, mesh, binding, Environment(radiance)))
    (folder / "front.json").write_text(json.dumps(FRONT | {"fov_x": 30}))
    return folder


@pytest.fixture
def relight(folder: Path, tmp_path: Path):
    """Function that relights and returns (passes, metadata)."""

    def relight(*options: str, asset: str = "lit.drgs") -> tuple[dict[str, np.ndarray], dict[str, str]]:
        out = tmp_path / "o.exr"
        arguments = ["relight", str(folder / asset), "--camera", str(folder / "front.json"), "--out", str(out)]
        assert main([*arguments, "--samples", "16", *options]) == 0
        return read_frame(out)

    return relight


def test_same_options_give_the_same_bits(relight):
    first, second = (relight("--seed", "5")[0]["Combined"] for _ in range(2))
    other = relight("--seed", "6")[0]["Combined"]
    assert np.array_equal(first, second)
    assert not np.array_equal(first, other)


def test_strength_is_a_factor(relight):
    once, twice = (relight("--env-strength", s)[0]["Combined"][..., :3] for s in ("1", "2"))
    np.testing.assert_allclose(twice, 2 * once, rtol=1e-5)


def test_surfels_follow_what_they_are_told_to(relight, folder, tmp_path, capsys):
    """Particles that move while the mesh stays take the surfels along only where they are asked to, or lead them."""
    mesh = read_asset(folder / "lit.drgs").mesh
    axis = np.linspace(-1.4, 1.4, 8)
    rest = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3).astype(np.float32)
    still = np.tile(np.eye(3, dtype=np.float16), (len(rest), 1, 1))

    def bake(name, model):
        cache = ParticleCache(tmp_path / name)
        frame = ParticleFrame(rest, still, mesh.vertices)
        settings = {"material": {"model": model}, "regions": []}
        cache.create(Header("digest", len(rest), len(mesh.vertices), 1, 24.0, settings), frame)
        cache.write(1, ParticleFrame(rest + np.float32([0.5, 0, 0]), still, mesh.vertices))
        return str(cache.folder)

    def column(*options):
        """Where in the picture the ball is."""
        alpha = relight("--transparent", "--frames", "1", *options)[0]["Combined"][..., 3]
        return (alpha.sum(axis=0) @ np.arange(40)) / alpha.sum()

    jelly, sand = bake("jelly", "elastic"), bake("sand", "sand")
    by_surface = column("--cache", jelly, "--driven-by", "surface")
    assert column("--cache", jelly, "--driven-by", "particles") > by_surface + 3
    assert column("--cache", jelly) == by_surface, "surfels that lie on the mesh follow it"
    assert column("--cache", sand) == by_surface
    out = ["relight", str(folder / "lit.drgs"), "--out", str(tmp_path / "x.exr"), "--driven-by", "particles"]
    for options, told in (((), "Give them with --cache"), (("--cache", sand), "its matter flows")):
        assert main([*out, *options]) == 64
        assert told in capsys.readouterr().err


def particles() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places of particles in a cube around the ball, gradients that deform nothing, and their lattice."""
    axis = np.linspace(-1.4, 1.4, 8)
    rest = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3).astype(np.float32)
    cells = np.eye(4) / 0.4
    cells[:3, 3], cells[3, 3] = 4.0, 1.0
    return rest, np.tile(np.eye(3, dtype=np.float16), (len(rest), 1, 1)), cells


def test_torn_and_flowing_matter_is_shown_as_it_is_asked_for(relight, folder, tmp_path, capsys):
    """The upper half is lifted off: closed in green or hollow; of water, boxes of particles instead of the mesh."""
    mesh = read_asset(folder / "lit.drgs").mesh
    rest, still, cells = particles()

    def bake(name, model, given):
        cache, settings = ParticleCache(tmp_path / name), {"material": {"model": model}, "regions": []}
        header = Header("digest", len(rest), len(mesh.vertices), 1, 24.0, settings, tear=0.8, cells=given)
        cache.create(header, ParticleFrame(rest, still, mesh.vertices))
        lifted = [x + np.where(x[:, 2:] > 0, np.float32([[0, 0, 1.6]]), 0) for x in (rest, mesh.vertices)]
        for frame in (1, 2):
            cache.write(frame, ParticleFrame(lifted[0], still, lifted[1]))
        return "--cache", str(cache.folder)

    def green(*options):
        colour = relight("--passes", "DiffCol", "--frames", "1", "--samples", "2", *options)[0]["DiffCol"]
        return int((colour[..., 1] > 2 * np.maximum(colour[..., 0], colour[..., 2]) + 0.1).sum())

    jelly, water = bake("jelly", "elastic", cells.tolist()), bake("water", "fluid", cells.tolist())
    assert green(*jelly, "--inside", "0,1,0,0.9") > 10
    assert green(*jelly, "--inside", "0,1,0", "--driven-by", "surface") > 10
    assert green(*jelly) == green(*jelly, "--inside", "open") == 0

    def rows(*options):
        alpha = relight("--transparent", "--frames", "1", "--samples", "2", *options)[0]["Combined"][..., 3]
        return np.count_nonzero(alpha > 0.5, axis=1)

    capsys.readouterr()
    flows = rows(*water)
    assert "surface of its particles" in capsys.readouterr().err
    halves = rows(*jelly)
    assert np.ptp(flows[flows > 0]) < np.ptp(halves[halves > 0]), "boxes are as wide everywhere"
    np.testing.assert_array_equal(rows(*jelly, "--surface", "particles"), flows)
    capsys.readouterr()
    relight("--frames", "1-2", "--samples", "1", *water, "--out", str(tmp_path / "##.exr"))
    assert capsys.readouterr().err.count("surface of its particles") == 1, "once of all frames"
    rows(*water, "--surface", "mesh")
    assert "surface of its particles" not in capsys.readouterr().err
    rows(*bake("old", "elastic", None))
    assert "Bake again" in capsys.readouterr().err
    for value in ("1,2,3", "red", "0.1,0.2"):
        assert main(["relight", str(folder / "lit.drgs"), "--out", "x.exr", *jelly, "--inside", value]) == 64


@pytest.mark.parametrize("inside", ["0,1,0", "open"])
def test_what_has_broken_stays_so_in_every_frame_that_is_rendered_alone(folder, tmp_path, capsys, inside):
    """Torn and pushed together; a cache of before is told, and shows the last frame as if nothing had happened."""
    mesh = read_asset(folder / "lit.drgs").mesh
    rest, still, cells = particles()
    bonds = Bonds(rest, cells)

    def lifted(places, by):
        return places + np.where(places[:, 2:] > 0, np.float32([[0, 0, by]]), 0)

    torn = bonds.broken(bonds.placed(lifted(rest, 1.6)), 2.0)

    def bake(name, known):
        cache, settings = ParticleCache(tmp_path / name), {"material": {"model": "elastic"}, "regions": []}
        header = Header("digest", len(rest), len(mesh.vertices), 1, 24.0, settings, tear=0.8, cells=cells.tolist())
        for frame, by in enumerate((0.0, 0.0, 1.6, 0.1)):
            broken = bonds.packed(torn if frame > 1 else bonds.none()) if known else None
            now = ParticleFrame(lifted(rest, by), still, lifted(mesh.vertices, by), broken)
            cache.write(frame, now) if frame else cache.create(header, now)
        return str(cache.folder)

    def picture(name, cache, frames):
        common = ["--camera", str(folder / "front.json"), "--samples", "2", "--inside", inside, "--cache", cache]
        out = str(tmp_path / name)
        assert main(["relight", str(folder / "lit.drgs"), "--out", out, "--frames", frames, *common]) == 0
        return "cracks may close again. Bake again" in capsys.readouterr().err

    new, old = bake("new", True), bake("old", False)
    assert not picture("all/#.exr", new, "1-3") and not picture("alone.exr", new, "3")
    assert picture("old/#.exr", old, "2-3")
    whole, alone, before = (
        read_frame(tmp_path / path)[0]["Combined"] for path in ("all/3.exr", "alone.exr", "old/3.exr")
    )
    np.testing.assert_array_equal(whole, alone)
    assert np.abs(whole - before).max() > 0
    np.testing.assert_array_equal(*(read_frame(tmp_path / f"{of}/2.exr")[0]["Combined"] for of in ("all", "old")))


def test_rotation_is_that_of_a_mapping_node(relight):
    """Mapping turns the looked-up vector: with Rotation Z of 90 degrees, -Y looks up +X, where the light is."""
    front, back, right, left = (
        relight("--env-rotation", d)[0]["Combined"][10:20, 15:25, :3].mean() for d in ("90", "-90", "0", "180")
    )
    assert front > 4 * back
    assert back < min(left, right) < max(left, right) < front
    lit = relight()[0]["Combined"][..., :3].sum(axis=-1)
    assert lit[12:18, 25:28].mean() > 4 * lit[12:18, 12:15].mean()  # unrotated, the right side is lit


def test_all_passes_are_written_with_their_channels(relight):
    passes, _ = relight("--passes", "all")
    assert {name: p.shape for name, p in passes.items()} == {
        name: (30, 40, len(entry.channels)) for name, entry in BY_NAME.items()
    }
    assert np.isfinite(np.concatenate([p.ravel() for p in passes.values()])).all()
    # The nearest point of the unit sphere is 5 m before the camera.
    assert passes["Depth"].min() == pytest.approx(5, abs=0.05)


def test_transparent_film_has_the_silhouette_as_alpha(relight):
    alpha = relight("--transparent", "--camera-sees", "mesh")[0]["Combined"][..., 3]
    opaque = relight()[0]["Combined"][..., 3]
    assert (opaque == 1).all()
    assert alpha[0, 0] == 0 and alpha[15, 20] == pytest.approx(1, abs=1e-3)
    # Outline of a unit sphere at 6 m: the cone of half angle asin(1 / 6).
    radius = 20 / np.tan(np.radians(15)) * np.tan(np.arcsin(1 / 6))
    assert alpha.sum() == pytest.approx(np.pi * radius**2, rel=0.05)


def test_vertices_pose_the_asset(relight, folder, tmp_path):
    moved = read_asset(folder / "lit.drgs").mesh.vertices + np.float32([0.5, 0, 0])
    np.save(tmp_path / "moved.npy", moved)
    columns = np.arange(40) + 0.5
    centre = [
        (coverage := relight("--passes", "Coverage", *pose)[0]["Coverage"][..., 0]).sum(axis=0)
        @ columns
        / coverage.sum()
        for pose in ((), ("--vertices", str(tmp_path / "moved.npy")))
    ]
    # 0.5 m at 6 m distance, times fx pixels.
    assert centre[1] - centre[0] == pytest.approx(0.5 / 6 * 20 / np.tan(np.radians(15)), rel=0.05)


def test_a_simulation_poses_the_asset_frame_by_frame(relight, folder, tmp_path, capsys):
    """Frame 2 of a cache is the picture of its vertices; without a range there is a file for every frame."""
    rest = read_asset(folder / "lit.drgs").mesh.vertices
    cache = ParticleCache(tmp_path / "cache")
    still = ParticleFrame(rest[:4], np.tile(np.eye(3), (4, 1, 1)), rest)
    cache.create(Header("digest", 4, len(rest), 1, 24.0), still)
    cache.write(1, still)
    moved = rest * np.float32(0.8) + np.float32([0.2, 0, 0.1])
    cache.write(2, ParticleFrame(still.points, still.gradients, moved))
    np.save(tmp_path / "v.npy", moved)
    expected, _ = relight("--vertices", str(tmp_path / "v.npy"), "--subpixel-samples", "1")
    one, _ = relight("--cache", str(cache.folder), "--frames", "2", "--subpixel-samples", "1")
    alpha = expected["Combined"][..., 3]
    assert np.abs(one["Combined"][..., 3] - alpha).max() < 0.3 and one["Combined"].shape == expected["Combined"].shape
    common = ["relight", str(folder / "lit.drgs"), "--camera", str(folder / "front.json"), "--samples", "4"]
    common += ["--cache", str(cache.folder)]
    assert main([*common, "--out", str(tmp_path / "all/##.exr")]) == 0
    sums = [read_frame(tmp_path / f"all/{k:02d}.exr")[0]["Combined"][..., :3].sum() for k in (1, 2)]
    assert sums[1] != sums[0]
    for more, said in ((["--frames", "1-3"], "frame 3: is not baked"), ([], "has no #"), (["--frames", "x"], "'x' is")):
        assert main([*common, *more, "--out", str(tmp_path / "o.exr")]) == 64
        assert said in capsys.readouterr().err
    assert main([*common[:-1], str(tmp_path), "--out", str(tmp_path / "o.exr")]) == 64
    assert "is not the cache of a simulation" in capsys.readouterr().err


def test_mesh_and_surfels_show_the_same_object(relight):
    surfels, mesh = (
        relight("--camera-sees", p, "--passes", "Depth")[0]["Depth"][12:18, 17:23] for p in ("surfels", "mesh")
    )
    np.testing.assert_allclose(surfels, mesh, atol=0.02)


def test_png_preview(folder, tmp_path, capsys):
    out = tmp_path / "o.png"
    arguments = ["relight", str(folder / "lit.drgs"), "--camera", str(folder / "front.json"), "--out", str(out)]
    assert main([*arguments, "--samples", "4", "--transparent", "--camera-sees", "mesh"]) == 0
    with Image.open(out) as picture:
        assert (picture.size, picture.mode) == ((40, 30), "RGBA")
        assert picture.getpixel((0, 0)) == (0, 0, 0, 0) and picture.getpixel((20, 15))[3] == 255
    assert capsys.readouterr() == (f"{out}: 40 x 30, 4 samples\n", "")


def test_without_a_camera_the_asset_is_framed(folder, tmp_path):
    """All of it is in the picture and fills much of it, also far from the origin and from all around."""
    out = tmp_path / "####.exr"
    given = ["relight", str(folder / "lit.drgs"), "--out", str(out), "--samples", "2", "--size", "32"]
    given += ["--transparent", "--camera-sees", "mesh"]
    assert main([*given, "--orbit", "4"]) == 0
    bright = []
    for number in range(1, 5):
        picture = read_frame(tmp_path / f"{number:04d}.exr")[0]["Combined"]
        alpha = picture[..., 3]
        assert picture.shape[:2] == (32, 32) and 0.2 < alpha.mean() < 0.8
        assert max(alpha[0].max(), alpha[-1].max(), alpha[:, 0].max(), alpha[:, -1].max()) == 0
        bright.append((picture[..., :3].sum(-1) * np.linspace(-1, 1, 32)).sum())
    # The light stands at +X: right of a camera in front, left of one behind, and before or behind the others.
    assert bright[0] > 5 * abs(bright[1]) and bright[2] < -5 * abs(bright[3])


def test_an_object_outside_the_picture_is_told(folder, relight, tmp_path, capsys):
    away = np.array(FRONT["matrix_world"], float)
    away[0, 3] = 50.0
    (tmp_path / "away.json").write_text(json.dumps(FRONT | {"fov_x": 30, "matrix_world": away.tolist()}))
    relight("--camera", str(tmp_path / "away.json"))
    said = capsys.readouterr().err
    assert "lit is not in the picture: it lies between (-1, -1, -1) and (1, 1, 1) m" in said
    (tmp_path / "near.json").write_text(json.dumps(FRONT | {"fov_x": 30, "clip_start": 0.1, "clip_end": 0.2}))
    relight("--camera", str(tmp_path / "near.json"))
    assert "not in the picture" in capsys.readouterr().err
    relight()
    assert "not in the picture" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "message"),
    [(["--size", "64"], "--size"), (["--orbit", "4"], "--orbit")],
)
def test_what_frames_the_asset_excludes_a_camera(folder, tmp_path, capsys, more, message):
    given = [
        "relight",
        str(folder / "lit.drgs"),
        "--camera",
        str(folder / "front.json"),
        "--out",
        str(tmp_path / "o.exr"),
    ]
    assert main([*given, *more]) == 64
    assert f"{message}: is of pictures without --camera" in capsys.readouterr().err
    assert main([*given[:2], "--out", str(tmp_path / "o.exr"), "--orbit", "4"]) == 64
    assert "has no # for the frame's number" in capsys.readouterr().err


def test_a_camera_inside_the_object_is_said_once(folder, relight, tmp_path, capsys):
    matrix = [[1, 0, 0, 0], [0, 0, -1, -0.5], [0, 1, 0, 0], [0, 0, 0, 1]]
    (tmp_path / "inside.json").write_text(json.dumps(FRONT | {"fov_x": 30, "matrix_world": matrix}))
    relight("--camera", str(tmp_path / "inside.json"))
    assert capsys.readouterr().err.count("the camera is inside lit (a box of 2 x 2 x 2 m): move it back") == 1
    np.save(tmp_path / "far.npy", read_asset(folder / "lit.drgs").mesh.vertices + np.float32([0, 9, 0]))
    relight("--camera", str(tmp_path / "inside.json"), "--vertices", str(tmp_path / "far.npy"))
    assert "inside" not in capsys.readouterr().err.replace("inside.json", "")


def write_exr(path: Path, pixels: np.ndarray) -> None:
    """A picture with the channels R, G and B."""
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File(header, {"RGB": pixels}).write(str(path))


def damage_vertices(folder: Path) -> None:
    """Files that are no poses, each in its own way."""
    (folder / "empty.npy").write_bytes(b"")
    np.save(folder / "torn.npy", np.zeros((7, 3)))
    (folder / "torn.npy").write_bytes((folder / "torn.npy").read_bytes()[:60])
    with open(folder / "huge.npy", "wb") as file:
        header = {"descr": "<f4", "fortran_order": False, "shape": (10**12, 3)}
        np.lib.format.write_array_header_1_0(file, header)
        file.write(bytes(8))
    np.savez(folder / "zip.npz", vertices=np.zeros((7, 3)))
    (folder / "torn.npz").write_bytes(b"PK\x03\x04" + bytes(100))
    np.save(folder / "complex.npy", np.zeros((7, 3), complex))
    np.save(folder / "bool.npy", np.zeros((7, 3), bool))
    np.save(folder / "text.npy", np.full((7, 3), "a"))


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: np.zeros((4, 8, 3)), "completely black"),
        (lambda: np.ones((4, 4, 3)), "not 2:1"),
        (lambda: np.where(np.arange(96).reshape(4, 8, 3) < 1, np.nan, 1.0), "1 values that are NaN"),
    ],
)
def test_what_the_reader_of_the_light_noted_is_said(relight, tmp_path, capsys, make, said):
    write_exr(tmp_path / "e.exr", make().astype(np.float32))
    relight("--env", str(tmp_path / "e.exr"), "--camera-sees", "mesh")
    said_of_it = capsys.readouterr().err
    assert "e.exr" in said_of_it and said in said_of_it


def test_display_referred_light_is_said(relight, tmp_path, capsys):
    Image.new("RGB", (8, 4), "white").save(tmp_path / "e.png")
    relight("--env", str(tmp_path / "e.png"), "--camera-sees", "mesh")
    assert "display-referred" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "code", "named"),
    [
        ({"asset": "no.drgs"}, 65, "no.drgs"),
        ({"asset": "torn.drgs"}, 65, "torn.drgs"),
        ({"asset": "ball.drgs"}, 64, "--env"),
        ({"--env": "no.exr"}, 65, "no.exr"),
        ({"--env": "front.json"}, 65, "front.json"),
        ({"--camera": "no.json"}, 64, "no.json"),
        ({"--camera": "flat.json"}, 64, "width is 0"),
        ({"--vertices": "short.npy"}, 65, "7"),
        ({"--vertices": "flat.npy"}, 64, "(9,)"),
        ({"--vertices": "pickle.npy"}, 64, "pickle.npy"),
        ({"--vertices": "no.npy"}, 64, "no.npy"),
        ({"--vertices": "empty.npy"}, 64, "(n, 3) array"),
        ({"--vertices": "torn.npy"}, 64, "(n, 3) array"),
        ({"--vertices": "huge.npy"}, 64, "12000000000000 bytes, 8 are there"),
        ({"--vertices": "zip.npz"}, 64, "(n, 3) array"),
        ({"--vertices": "torn.npz"}, 64, "(n, 3) array"),
        ({"--vertices": "complex.npy"}, 64, "type complex128"),
        ({"--vertices": "bool.npy"}, 64, "type bool"),
        ({"--vertices": "text.npy"}, 64, "type str"),
        ({"--vertices": "pickle.npy"}, 64, "type object"),
        ({"--vertices": "."}, 64, "not a regular file"),
        ({"--camera": "wide.json"}, 64, "65536 x 65536 pixels"),
        ({"--env": "nan.exr"}, 65, "nan.exr"),
        ({"--out": "front.json/o.exr"}, 73, "o.exr"),
        ({"--out": "o.tif"}, 64, "o.tif"),
    ],
)
def test_bad_input_ends_with_its_code_and_name(folder, capsys, changes, code, named):
    (folder / "torn.drgs").write_bytes((folder / "ball.drgs").read_bytes()[:5000])
    (folder / "flat.json").write_text(json.dumps(FRONT | {"fov_x": 30, "width": 0}))
    np.save(folder / "short.npy", np.zeros((7, 3), np.float32))
    np.save(folder / "flat.npy", np.zeros(9, np.float32))
    (folder / "wide.json").write_text(json.dumps(FRONT | {"fov_x": 30, "width": 65536, "height": 65536}))
    np.save(folder / "pickle.npy", np.array([print], dtype=object), allow_pickle=True)
    damage_vertices(folder)
    write_exr(folder / "nan.exr", np.full((4, 8, 3), np.nan, np.float32))
    options = {"asset": "lit.drgs", "--camera": "front.json", "--out": "o.exr"} | changes
    arguments = ["relight", str(folder / options.pop("asset"))]
    for name, value in options.items():
        arguments += [name, str(folder / value)]
    assert main(arguments) == code
    said = capsys.readouterr().err
    assert named in said and "allow_pickle" not in said
    assert not (folder / "o.exr").exists()


def test_relights_with_torch_blocked(folder, tmp_path):
    program = (
        "import sys; sys.modules['torch'] = None; sys.modules['bpy'] = None\n"
        "from drgs_blender.cli.main import main; sys.exit(main(sys.argv[1:]))"
    )
    out = tmp_path / "o.exr"
    arguments = ["relight", str(folder / "lit.drgs"), "--camera", str(folder / "front.json"), "--out", str(out)]
    command = [sys.executable, "-c", program, *arguments, "--samples", "4", "--denoise", "svgf"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    assert np.isfinite(read_frame(out)[0]["Combined"]).all()


def test_captured_colours_need_no_light(relight, folder: Path, capsys: pytest.CaptureFixture) -> None:
    """The picture is the colour of the file, and PNG files show its own numbers; what has none says so."""
    asset = read_asset(folder / "ball.drgs")
    sh = np.zeros((len(asset.surfels), 1, 3), np.float32)
    sh[:, 0] = (np.array([0.6, 0.3, 0.8]) - 0.5) / 0.28209479177387814
    surfels = replace(asset.surfels, sh=sh, opacity=np.ones_like(asset.surfels.opacity))
    write_asset(folder / "captured.drgs", Asset(surfels, asset.mesh, asset.binding))
    passes, _ = relight("--captured", asset="captured.drgs")
    assert np.allclose(passes["Combined"][15, 20, :3], [0.3185, 0.0732, 0.6038], atol=2e-3)
    given = "relight", folder / "captured.drgs", "--camera", folder / "front.json", "--out", folder / "o.png"
    assert main([*map(str, given), "--captured"]) == 0
    assert np.abs(np.asarray(Image.open(folder / "o.png"))[15, 20, :3] - np.array([153, 76.5, 204])).max() <= 1
    relight("--captured", asset="ball.drgs")
    assert "no captured colours" in capsys.readouterr().err
