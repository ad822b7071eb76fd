"""Splats to other formats and back: what is kept is kept to the stated precision, damage is named."""

from __future__ import annotations

import struct
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from splat_files import covariance, old_spz, random_splats, refusals

from drgs_blender.build.export import posed_surfels
from drgs_blender.build.importer import import_asset
from drgs_blender.cli.main import main
from drgs_blender.core.asset import Asset, Environment, Mesh, Surfels
from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.errors import AssetError
from drgs_blender.deform.binding import bind
from drgs_blender.formats.axes import UP_AXES, surfels_to_z_up, vectors_to_z_up
from drgs_blender.formats.gltf_splats import write_gltf_splats
from drgs_blender.formats.harmonics import basis, rotate_harmonics
from drgs_blender.formats.registry import find_format, read_environment, read_mesh, read_surfels
from drgs_blender.formats.sog_writer import write_sog
from drgs_blender.formats.splat_ply import write_splat_ply
from drgs_blender.formats.splats import Splats, splats_from_z_up, splats_of
from drgs_blender.formats.spz_writer import write_spz
from drgs_blender.geometry.normals import rotation_matrices

WRITERS = {".ply": write_splat_ply, ".spz": write_spz, ".glb": write_gltf_splats}


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_turned_harmonics_are_the_function_turned(degree: int) -> None:
    rng = np.random.default_rng(degree)
    sh = rng.normal(size=(20, (degree + 1) ** 2, 3)).astype(np.float32)
    turns = Rotation.random(20, random_state=2).as_matrix()
    directions = rng.normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before = np.einsum("nk,nkc->nc", basis(directions, degree), sh)
    moved = np.einsum("nij,nj->ni", turns, directions)
    after = np.einsum("nk,nkc->nc", basis(moved, degree), rotate_harmonics(sh, turns))
    np.testing.assert_allclose(after, before, atol=2e-5)


def test_the_basis_is_orthonormal_and_that_of_3dgs() -> None:
    z, weights = np.polynomial.legendre.leggauss(12)
    angle = np.arange(24) * (2 * np.pi / 24)
    ring = np.sqrt(1 - z * z)[:, None]
    grid = np.stack(np.broadcast_arrays(ring * np.cos(angle), ring * np.sin(angle), z[:, None]), axis=-1)
    values = basis(grid, 3)
    gram = np.einsum("ijk,ijl,i->kl", values, values, weights) * (2 * np.pi / 24)
    np.testing.assert_allclose(gram, np.eye(16), atol=1e-12)
    # The first band of 3DGS is (-y, z, -x): the signs decide what a viewer shows.
    np.testing.assert_allclose(basis(np.eye(3), 1)[:, 1:] / 0.4886025119029199, [[0, 0, -1], [-1, 0, 0], [0, 1, 0]])


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_ply_keeps_everything(tmp_path: Path, coefficients: int) -> None:
    splats = random_splats(coefficients=coefficients)
    write_splat_ply(tmp_path / "a.ply", splats)
    back = read_surfels(tmp_path / "a.ply").surfels
    np.testing.assert_array_equal(back.centre, splats.centre)
    np.testing.assert_array_equal(back.sh, splats.sh)
    np.testing.assert_allclose(back.scale, splats.scale[:, :2], rtol=2e-6)
    np.testing.assert_allclose(back.opacity, splats.opacity, atol=1e-6)
    np.testing.assert_allclose(np.abs((back.rotation * splats.rotation).sum(axis=1)), 1, atol=1e-6)


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_gltf_keeps_everything(tmp_path: Path, coefficients: int) -> None:
    splats = random_splats(coefficients=coefficients)
    write_gltf_splats(tmp_path / "a.glb", splats)
    file = read_surfels(tmp_path / "a.glb")
    assert file.up == "y"
    np.testing.assert_array_equal(file.surfels.centre, splats.centre)
    np.testing.assert_array_equal(file.surfels.sh, splats.sh)
    np.testing.assert_allclose(file.surfels.opacity, splats.opacity, atol=1e-6)
    np.testing.assert_allclose(file.surfels.scale, splats.scale[:, :2], rtol=2e-6)
    np.testing.assert_allclose(file.surfels.extras["thickness"], splats.scale[:, 2], rtol=2e-6)
    np.testing.assert_allclose(np.abs((file.surfels.rotation * splats.rotation).sum(axis=1)), 1, atol=1e-6)


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_spz_loses_what_the_documentation_says(tmp_path: Path, coefficients: int) -> None:
    splats = random_splats(coefficients=coefficients)
    write_spz(tmp_path / "a.spz", splats)
    assert find_format(tmp_path / "a.spz").name == "SPZ"
    file = read_surfels(tmp_path / "a.spz")
    back = file.surfels
    assert file.up == "y"
    assert np.abs(back.centre - splats.centre).max() <= 1 / 8192 * 1.001
    assert np.abs(np.log(back.scale) - np.log(splats.scale[:, :2])).max() <= 1 / 32 * 1.001
    assert np.abs(back.opacity - splats.opacity).max() <= 1 / 510 * 1.001
    assert np.abs(back.sh[:, 0] - splats.sh[:, 0]).max() <= 1 / (510 * 0.15) * 1.001
    assert np.abs(back.sh[:, 1:4] - splats.sh[:, 1:4]).max(initial=0) <= 0.5 / 16 + 0.5 / 128 + 1e-6
    assert np.abs(back.sh[:, 4:] - splats.sh[:, 4:]).max(initial=0) <= 0.5 / 8 + 0.5 / 128 + 1e-6
    turn = 2 * np.arccos(np.minimum(np.abs((back.rotation * splats.rotation).sum(axis=1)), 1))
    assert turn.max() < np.radians(0.4)


def test_far_splats_lose_precision_and_not_their_place(tmp_path: Path) -> None:
    splats = random_splats(50)
    splats.centre[0] = (50_000, -3, 2)
    write_spz(tmp_path / "a.spz", splats)
    back = read_surfels(tmp_path / "a.spz").surfels
    assert np.abs(back.centre - splats.centre).max() <= 0.5 / 128
    splats.centre[0] = 1e8
    with pytest.raises(AssetError, match="beyond"):
        write_spz(tmp_path / "b.spz", splats)


def extremes() -> Splats:
    """Opacities of 0 and 1, colours and harmonics out of every range, needles and walls."""
    splats = random_splats(64)
    splats.opacity[::2] = np.arange(32) % 2
    splats.sh[::3] *= 40
    splats.scale[::4] = (1e-9, 1e3, 1e-30)
    return splats


def test_what_spz_has_no_room_for_becomes_the_nearest_it_has(tmp_path: Path) -> None:
    splats = extremes()
    write_spz(tmp_path / "a.spz", splats)
    back = splats_of(read_surfels(tmp_path / "a.spz").surfels)
    assert len(back) == len(splats)
    np.testing.assert_allclose(back.opacity, splats.opacity, atol=1 / 500)
    size = np.sort(np.exp(np.log(splats.scale).clip(-10, 255 / 16 - 10)), axis=1)
    np.testing.assert_allclose(np.log(np.sort(back.scale, axis=1)), np.log(size), atol=0.04)
    wanted = splats.sh.copy()
    wanted[:, 0], wanted[:, 1:] = wanted[:, 0].clip(-0.5 / 0.15, 0.5 / 0.15), wanted[:, 1:].clip(-1, 127 / 128)
    assert np.abs(back.sh - wanted).max() < 0.08


def test_what_sog_has_no_room_for_becomes_the_nearest_it_has(tmp_path: Path) -> None:
    splats = extremes()
    splats.opacity[1::2] = (1.5, -0.5) * 16  # out of range, as rounding may leave it
    write_sog(tmp_path / "a.sog", splats)
    back = splats_of(read_surfels(tmp_path / "a.sog").surfels)
    order = np.abs(splats.centre[:, None] - back.centre[None]).max(axis=2).argmin(axis=1)
    assert len(np.unique(order)) == len(splats)
    np.testing.assert_allclose(back.opacity[order], splats.opacity.clip(0, 1), atol=1 / 500)


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_exact_formats_keep_extremes(tmp_path: Path, suffix: str) -> None:
    splats = extremes()
    splats.scale[::4] = (1e-9, 1e3, 1e-20)
    WRITERS[suffix](tmp_path / f"a{suffix}", splats)
    raw = (tmp_path / f"a{suffix}").read_bytes()
    back = splats_of(read_surfels(tmp_path / f"a{suffix}").surfels)
    assert len(back) == len(splats) and np.isfinite(np.frombuffer(raw[-4 * 62 * 8 :], "<f4")).all()
    np.testing.assert_allclose(back.opacity, splats.opacity, atol=2e-6)
    np.testing.assert_allclose(np.sort(back.scale, axis=1)[:, 1:], np.sort(splats.scale, axis=1)[:, 1:], rtol=1e-4)
    np.testing.assert_array_equal(back.sh, splats.sh)


@pytest.mark.parametrize("writer", WRITERS)
def test_splats_of_three_scales_stay_as_thick_as_they_were(tmp_path: Path, writer: str) -> None:
    splats = random_splats(100)
    splats.scale[:] = np.exp(np.random.default_rng(3).uniform(-4, -1, splats.scale.shape))
    path = tmp_path / f"a{writer}"
    write_splat_ply(tmp_path / "first.ply", splats)
    WRITERS[writer](path, splats_of(read_surfels(tmp_path / "first.ply").surfels))
    again = splats_of(read_surfels(path).surfels)
    wanted = covariance(splats.rotation, splats.scale)
    found = covariance(again.rotation, again.scale)
    tolerance = 0.1 if writer == ".spz" else 1e-5
    assert np.abs(found - wanted).max(axis=(1, 2)).max() <= tolerance * np.abs(wanted).max()


@pytest.mark.parametrize("up", ["y", "-y", "-z"])
def test_axes_there_and_back(up: str) -> None:
    splats = random_splats(80, 9)
    there = splats_from_z_up(splats, up)
    np.testing.assert_allclose(there.centre @ UP_AXES[up].T, splats.centre, atol=1e-6)
    n = len(splats)
    flat = Surfels(
        there.centre, there.scale[:, :2], there.rotation, there.opacity,
        np.zeros((n, 3)), np.zeros(n), np.zeros(n), there.sh,
    )  # fmt: skip
    back = surfels_to_z_up(flat, up)
    np.testing.assert_allclose(back.centre, splats.centre, atol=1e-6)
    np.testing.assert_allclose(np.abs((back.rotation * splats.rotation).sum(axis=1)), 1, atol=1e-6)
    np.testing.assert_allclose(back.sh, splats.sh, atol=1e-5)


def test_fixtures_of_the_reference_agree_over_versions(shared_data: Path) -> None:
    """Four splats in versions 3 and 4; four others in version 2, with and without its compression."""
    for names in (("v3", "v4"), ("v2", "raw")):
        first, second = (read_surfels(shared_data / f"splats/fixtures/minimal-{v}.spz").surfels for v in names)
        assert len(first) == 4
        np.testing.assert_allclose(first.opacity, 230 / 255, atol=1e-6)
        for name in ("centre", "scale", "opacity", "sh", "rotation"):
            np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_two_packings_of_one_capture_agree(shared_data: Path) -> None:
    """The same real capture as SPZ and as compressed PLY, each by its own program, in other orders and axes."""
    spz = surfels_to_z_up(read_surfels(shared_data / "splats/biker.spz").surfels, "y")
    ply = surfels_to_z_up(read_surfels(shared_data / "splats/biker.compressed.ply").surfels, "-y")
    assert len(spz) == len(ply)
    for name in ("centre", "opacity", "albedo"):
        a, b = (getattr(s, name).mean(axis=0) for s in (spz, ply))
        np.testing.assert_allclose(a, b, atol=0.01)
    distance, nearest = cKDTree(ply.centre).query(spz.centre[::10])
    assert np.quantile(distance, 0.99) < 5e-4
    first, second = covariance(spz.rotation, spz.scale)[::10], covariance(ply.rotation, ply.scale)[nearest]
    size = np.trace(second, axis1=1, axis2=2)
    assert np.quantile(np.abs(first - second).max(axis=(1, 2)) / size, 0.99) < 0.1


@pytest.mark.parametrize(
    ("code", "axes", "up"),
    [(4, "RUB", "y"), (7, "LUF", "y"), (6, "RDF", "-y"), (1, "LDB", "-y"), (12, "RFU", "z"), (15, "LBU", "z"),
     (14, "RBD", "-z"), (0, "", "y"), (99, "", "y"), (3, "LUB", ""), (11, "LFU", ""), (8, "RUF", "")],
)  # fmt: skip
def test_spz_says_which_axis_is_up(tmp_path: Path, code: int, axes: str, up: str) -> None:
    """The extension SPZ_ADOBE_coordinate_system, behind one that nobody knows; by where X, Y and Z point."""
    splats = random_splats(20, 4)
    write_spz(tmp_path / "a.spz", splats)
    data = bytearray((tmp_path / "a.spz").read_bytes())
    records = struct.pack("<IIH", 0x12340001, 2, 7) + struct.pack("<III", 0xADBE0001, 4, code)
    data[14] |= 2
    struct.pack_into("<I", data, 16, 32 + len(records))
    data[32:32] = records
    (tmp_path / "a.spz").write_bytes(data)
    if axes and not up:
        with pytest.raises(AssetError, match=f"left-handed axes {axes}"):
            read_surfels(tmp_path / "a.spz")
        return
    file = read_surfels(tmp_path / "a.spz")
    assert file.up == up and np.abs(file.surfels.centre - splats.centre).max() < 2e-4
    if axes:  # where that axis points after the turn that the importer makes of it
        points = {"U": 1, "D": -1}
        away = np.array([points.get(letter, 0) for letter in axes], np.float32)
        np.testing.assert_array_equal(vectors_to_z_up(away, up), [0, 0, 1])


@pytest.mark.parametrize("version", [2, 3, 4])
def test_damaged_spz_is_refused_or_read_sensibly(tmp_path: Path, version: int) -> None:
    splats, path = random_splats(200), tmp_path / "a.spz"
    write_spz(path, splats)
    data = path.read_bytes() if version == 4 else old_spz(path.read_bytes(), version)
    path.write_bytes(data)
    assert len(read_surfels(path).surfels) == 200
    assert refusals(path, data, 300) > 100


@pytest.mark.parametrize("version", [2, 3, 4])
def test_a_header_that_promises_too_much_costs_no_memory(tmp_path: Path, version: int) -> None:
    header = struct.pack("<4sIIBBBB", b"NGSP", version, 4_000_000_000, 3, 12, 0, 6)
    data = (
        header + struct.pack("<I", 32) + bytes(400) if version == 4 else zlib.compress(header + bytes(4000), wbits=31)
    )
    path = tmp_path / "a.spz"
    path.write_bytes(data)
    tracemalloc.start()
    with pytest.raises(AssetError, match="more than its"):
        read_surfels(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 << 20


def asset_on_a_square(n: int = 200) -> Asset:
    """Surfels with captured colours on a square of two triangles."""
    vertices = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    grey = np.full(4, 0.5, np.float32)
    mesh = Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]), np.full((4, 3), 0.5), grey, grey * 0)
    splats = random_splats(n, 9)
    splats.centre[:, 2] = 0
    splats.centre[:, :2] /= 4
    turn = np.random.default_rng(2).uniform(0, np.pi, n)
    rotation = np.stack([np.cos(turn / 2), 0 * turn, 0 * turn, np.sin(turn / 2)], axis=1)
    surfels = Surfels(
        splats.centre, splats.scale[:, :2], rotation, splats.opacity,
        np.full((n, 3), 0.25), np.full(n, 0.5), np.zeros(n), splats.sh,
    )  # fmt: skip
    return Asset(surfels, mesh, bind(mesh, surfels)[0])


def test_a_turned_pose_turns_surfels_and_their_captured_colours() -> None:
    asset = asset_on_a_square()
    turn = Rotation.from_euler("xyz", [30, 50, -70], degrees=True).as_matrix()
    posed = posed_surfels(asset, (asset.mesh.vertices @ turn.T).astype(np.float32))
    rest = asset.surfels
    np.testing.assert_allclose(posed.centre, rest.centre @ turn.T, atol=1e-5)
    wanted = turn @ covariance(rest.rotation, rest.scale) @ turn.T
    np.testing.assert_allclose(covariance(posed.rotation, posed.scale), wanted, atol=1e-6)
    normal = rotation_matrices(posed.rotation.astype(np.float64))[..., 2]
    np.testing.assert_allclose(normal, np.broadcast_to(turn[:, 2], normal.shape), atol=1e-4)
    np.testing.assert_allclose(posed.sh, rotate_harmonics(rest.sh, turn), atol=1e-3)


def test_splats_that_grow_grow_in_all_directions(tmp_path: Path) -> None:
    asset = asset_on_a_square()
    asset.surfels.extras["thickness"] = np.linspace(0.01, 0.02, len(asset.surfels)).astype(np.float32)
    posed = posed_surfels(asset, asset.mesh.vertices * np.float32(3))
    np.testing.assert_allclose(posed.extras["thickness"], 3 * asset.surfels.extras["thickness"], rtol=1e-4)
    splats = random_splats(30)
    write_splat_ply(tmp_path / "a.ply", splats)
    larger = import_asset(tmp_path / "a.ply", meshless=True, scale=3.0).surfels
    np.testing.assert_allclose(splats_of(larger).scale, 3 * splats.scale, rtol=1e-5)


def test_a_sheared_pose_keeps_the_ellipse() -> None:
    asset = asset_on_a_square()
    shear = np.array([[1, 0.8, 0], [0, 1.5, 0], [0, 0, 1.0]])
    posed = posed_surfels(asset, (asset.mesh.vertices @ shear.T).astype(np.float32))
    wanted = shear @ covariance(asset.surfels.rotation, asset.surfels.scale) @ shear.T
    np.testing.assert_allclose(covariance(posed.rotation, posed.scale), wanted, atol=1e-5)


@pytest.mark.parametrize("suffix", WRITERS)
def test_convert_writes_a_posed_asset(tmp_path: Path, suffix: str, capsys: pytest.CaptureFixture[str]) -> None:
    asset = asset_on_a_square()
    write_asset(tmp_path / "a.drgs", asset)
    lifted = asset.mesh.vertices + np.float32([0, 0, 2])
    np.save(tmp_path / "v.npy", lifted)
    out = tmp_path / f"b{suffix}"
    posed = ["--as", "splats", "--vertices", str(tmp_path / "v.npy")]
    assert main(["convert", str(tmp_path / "a.drgs"), str(out), *posed]) == 0
    assert "200 splats" in capsys.readouterr().out
    file = read_surfels(out)
    back = surfels_to_z_up(file.surfels, file.up or "z")
    np.testing.assert_allclose(back.centre, asset.surfels.centre + np.float32([0, 0, 2]), atol=2e-4)
    assert main(["convert", str(out), str(tmp_path / "c.ply"), "--scale", "2", "--colour", "albedo"]) == 0
    again = read_surfels(tmp_path / "c.ply").surfels
    np.testing.assert_allclose(again.centre, 2 * back.centre, atol=1e-5)
    assert again.sh.shape[1] == 1
    np.testing.assert_allclose(again.albedo, back.albedo, atol=1e-5)


def test_convert_writes_the_mesh_and_the_light_of_an_asset(tmp_path: Path) -> None:
    asset = asset_on_a_square()
    asset.environment = Environment(np.random.default_rng(4).uniform(0, 50, (8, 16, 3)))
    write_asset(tmp_path / "a.drgs", asset)
    assert main(["convert", str(tmp_path / "a.drgs"), str(tmp_path / "a.glb"), "--scale", "3"]) == 0
    mesh = read_mesh(tmp_path / "a.glb")
    np.testing.assert_allclose(mesh.vertices, 3 * asset.mesh.vertices, atol=1e-5)
    assert main(["convert", str(tmp_path / "a.drgs"), str(tmp_path / "a.exr")]) == 0
    light = read_environment(tmp_path / "a.exr").radiance
    np.testing.assert_array_equal(light, asset.environment.radiance)
    assert main(["convert", str(tmp_path / "a.exr"), str(tmp_path / "b.exr")]) == 0
    np.testing.assert_array_equal(read_environment(tmp_path / "b.exr").radiance, light)


def test_convert_bakes_the_light_of_an_environment(tmp_path: Path) -> None:
    """A white, rough square under white light is white but for the light that GGX's single bounce loses, some 3 %."""
    asset = asset_on_a_square(40)
    asset.surfels.albedo[:] = 1
    asset.surfels.roughness[:] = 1
    asset.environment = Environment(np.full((8, 16, 3), 0.5))
    write_asset(tmp_path / "a.drgs", asset)
    options = ["--colour", "relit", "--samples", "64"]
    assert main(["convert", str(tmp_path / "a.drgs"), str(tmp_path / "b.ply"), *options]) == 0
    seen = read_surfels(tmp_path / "b.ply").surfels
    assert seen.sh is not None and seen.sh.shape[1] == 1
    assert 0.96 * 0.5 < seen.albedo.mean() < 0.505
    assert main(["convert", str(tmp_path / "a.drgs"), str(tmp_path / "c.ply"), *options, "--env-strength", "0.5"]) == 0
    half = read_surfels(tmp_path / "c.ply").surfels
    np.testing.assert_allclose(half.albedo, seen.albedo / 2, rtol=1e-3)


def test_convert_writes_a_file_a_frame(tmp_path: Path) -> None:
    asset = asset_on_a_square()
    write_asset(tmp_path / "a.drgs", asset)
    for frame in (1, 2):
        np.save(tmp_path / f"v{frame:02d}.npy", asset.mesh.vertices + np.float32([0, 0, frame]))
    pattern = ["--vertices", str(tmp_path / "v##.npy"), "--frames", "1-2"]
    assert main(["convert", str(tmp_path / "a.drgs"), str(tmp_path / "f##.ply"), *pattern]) == 0
    for frame in (1, 2):
        back = read_surfels(tmp_path / f"f{frame:02d}.ply").surfels
        np.testing.assert_allclose(back.centre[:, 2], frame, atol=1e-5)
    assert main(["convert", str(tmp_path / "a.drgs"), str(tmp_path / "f.ply"), *pattern]) == 64


def test_splats_that_are_y_up_stand_upright_in_an_asset(tmp_path: Path) -> None:
    splats = random_splats(30)
    write_spz(tmp_path / "a.spz", splats_from_z_up(splats, "y"))
    for up in (None, "y"):
        asset = import_asset(tmp_path / "a.spz", up=up, meshless=True)
        np.testing.assert_allclose(asset.surfels.centre, splats.centre, atol=2e-4)
    lying = import_asset(tmp_path / "a.spz", up="z", meshless=True)
    assert np.abs(lying.surfels.centre - splats.centre).max() > 1


def test_convert_names_what_it_cannot_write(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_splat_ply(tmp_path / "a.ply", random_splats(5))
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "a.xyz")]) == 64
    assert "a.xyz: splats cannot be written as .xyz. Use .ply, .spz, .sog, .glb," in capsys.readouterr().err
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "a.spz"), "--up", "z"]) == 64
    assert "SPZ is y up" in capsys.readouterr().err
    assert not (tmp_path / "a.spz").exists()


def test_convert_names_what_a_file_does_not_hold(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_asset(tmp_path / "a.drgs", asset_on_a_square())
    assert main(["convert", str(tmp_path / "a.drgs"), str(tmp_path / "a.exr")]) == 64
    said = capsys.readouterr().err
    assert "a.drgs: has no captured light, only a mesh and splats, and cannot be written as .exr. Name OUT .glb" in said
    assert "`drgs import ... --env`" in said
    assert main(["convert", str(tmp_path / "a.drgs"), str(tmp_path / "a.xyz")]) == 64
    said = capsys.readouterr().err
    assert "meshes or splats cannot be written as .xyz. Use .glb or .usdz for meshes, .ply, .spz, .sog" in said
    assert main(["convert", str(tmp_path / "a.drgs"), str(tmp_path / "a.glb")]) == 0
    capsys.readouterr()
    assert main(["convert", str(tmp_path / "a.glb"), str(tmp_path / "a.obj")]) == 64
    assert "a.obj: meshes cannot be written as .obj. Use .glb or .usdz." in capsys.readouterr().err
    assert main(["convert", str(tmp_path / "a.glb"), str(tmp_path / "b.ply")]) == 64
    assert "a.glb: has no splats, only a mesh, and cannot be written as .ply." in capsys.readouterr().err


def test_splats_are_as_translucent_as_the_mesh_and_emission_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asset = asset_on_a_square()
    n, k = len(asset.mesh.vertices), len(asset.surfels)
    asset.mesh.opacity, asset.mesh.specular = np.full(n, 0.5, np.float32), np.full(n, 0.9, np.float32)
    asset.mesh.emission = np.full((n, 3), 2, np.float32)
    asset.surfels.emission = np.full((k, 3), 2, np.float32)
    write_asset(tmp_path / "a.drgs", asset)
    assert main(["convert", str(tmp_path / "a.drgs"), str(tmp_path / "a.ply"), "--as", "splats"]) == 0
    assert "what the surfels emit is left out" in capsys.readouterr().out
    found = read_surfels(tmp_path / "a.ply").surfels.opacity
    np.testing.assert_allclose(found, 0.5 * asset.surfels.opacity, atol=1e-5)
    assert main(["convert", str(tmp_path / "a.drgs"), str(tmp_path / "a.usdz")]) == 0
    assert "specular is lost" in capsys.readouterr().out
    assert main(["convert", str(tmp_path / "a.drgs"), str(tmp_path / "a.glb")]) == 0
    assert "specular" not in capsys.readouterr().out


def test_convert_says_what_becomes_of_materials(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asset = asset_on_a_square()
    asset.mesh.albedo[:], asset.mesh.roughness[:], asset.mesh.metallic[:] = 0.5, 0.5, 0.0
    write_asset(tmp_path / "a.drgs", asset)
    assert main(["convert", str(tmp_path / "a.drgs"), str(tmp_path / "a.glb")]) == 0
    assert "one material of one colour, without UV map" in capsys.readouterr().out
    asset.mesh.albedo[0] = 0.1
    write_asset(tmp_path / "a.drgs", asset)
    assert main(["convert", str(tmp_path / "a.drgs"), str(tmp_path / "a.usdz")]) == 0
    said = capsys.readouterr().out
    assert "all materials joined into one, with a new UV map and textures of" in said
    with zipfile.ZipFile(tmp_path / "a.usdz") as archive, archive.open("textures/color.png") as file:
        width, height = Image.open(file).size
    assert f"textures of {width} x {height}:" in said


@pytest.mark.parametrize("suffix", ["ply", "spz", "sog", "glb"])
@pytest.mark.parametrize(
    ("scale", "said"),
    [("1e39", "1e39 is not a finite number"), ("3e38", "3e+38: makes lengths"), ("1e-50", "1e-50: makes lengths")],
)
def test_convert_refuses_scales_that_numbers_do_not_hold(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], suffix: str, scale: str, said: str
) -> None:
    write_splat_ply(tmp_path / "a.ply", random_splats(5))
    out = tmp_path / f"b.{suffix}"
    assert main(["convert", str(tmp_path / "a.ply"), str(out), "--scale", scale]) == 64
    shown = capsys.readouterr().err
    assert "--scale" in shown and said in shown
    assert not out.exists()
