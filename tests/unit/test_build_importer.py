"""Captures made into bound assets."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from splat_files import random_splats

from drgs_blender.build.importer import import_asset
from drgs_blender.build.proxy import mesh_from_surfels
from drgs_blender.build.transfer import surfels_to_vertices, vertices_to_surfels
from drgs_blender.core.asset.model import Mesh, Surfels
from drgs_blender.core.errors import AssetError
from drgs_blender.deform.attach import attach
from drgs_blender.deform.binding import bind
from drgs_blender.deform.mesh_driven import MeshDriven
from drgs_blender.formats.files import MaterialsFile, MeshFile, SurfelFile
from drgs_blender.geometry.normals import quaternions, rotation_matrices


def sphere_capture(n: int = 6000, seed: int = 0, keep=lambda p: np.ones(len(p), bool)) -> Surfels:
    """Surfels on a unit sphere whose normals point in or out at random; albedo follows the position."""
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal[keep(normal)]
    n = len(normal)
    side = np.cross(normal, rng.normal(size=(n, 3)))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    signed = normal * rng.choice([-1, 1], (n, 1))
    frame = np.stack([side, np.cross(signed, side), signed], -1)
    return Surfels(
        normal, np.full((n, 2), 0.04), quaternions(frame), np.full(n, 0.95), 0.5 + 0.4 * normal,
        0.5 + 0.4 * normal[:, 0], 0.5 + 0.4 * normal[:, 2],
    )  # fmt: skip


def sphere_mesh(subdivisions: int = 4) -> MeshFile:
    source = trimesh.creation.icosphere(subdivisions)
    return MeshFile(source.vertices, source.faces)


def test_capture_with_materials_gives_them_to_its_mesh():
    capture = SurfelFile(sphere_capture(), "IRGS")
    asset = import_asset(capture, sphere_mesh())
    np.testing.assert_allclose(asset.mesh.albedo, 0.5 + 0.4 * asset.mesh.vertices, atol=0.03)
    np.testing.assert_allclose(asset.mesh.roughness, 0.5 + 0.4 * asset.mesh.vertices[:, 0], atol=0.03)
    assert asset.provenance["materials"].startswith("of the surfels")
    posed = MeshDriven(asset.mesh, asset.surfels, asset.binding).pose(asset.mesh.vertices)
    assert (np.einsum("nc,nc->n", posed.normal, posed.centre) > 0.95).all()


def test_mesh_with_materials_gives_them_to_a_bare_capture():
    mesh = sphere_mesh()
    materials = MaterialsFile(
        0.5 + 0.4 * mesh.vertices, np.full(len(mesh.vertices), 0.2), np.ones(len(mesh.vertices)), "NeRO"
    )
    asset = import_asset(SurfelFile(sphere_capture(), "3DGS"), mesh, materials=materials)
    np.testing.assert_allclose(asset.surfels.albedo, 0.5 + 0.4 * asset.surfels.centre, atol=0.01)
    np.testing.assert_allclose(asset.surfels.roughness, 0.2, atol=1e-6)
    with pytest.raises(AssetError, match="its materials are of 5"):
        five = MaterialsFile(np.ones((5, 3)), np.ones(5), np.ones(5), "NeRO")
        import_asset(SurfelFile(sphere_capture(), "3DGS"), mesh, materials=five)


def test_materials_survive_the_way_to_surfels_and_back():
    source = trimesh.creation.icosphere(4)
    waves = 0.5 + 0.3 * np.sin(3 * source.vertices)
    mesh = Mesh(source.vertices, source.faces, waves, waves[:, 0], waves[:, 1])
    surfels, binding, _ = attach(mesh)
    surfels.albedo[:] = 0
    vertices_to_surfels(mesh, surfels, binding)
    back = Mesh(source.vertices, source.faces, np.zeros_like(waves), np.zeros(len(waves)), np.zeros(len(waves)))
    assert surfels_to_vertices(back, surfels, binding) == 0
    np.testing.assert_allclose(back.albedo, mesh.albedo, atol=0.02)
    np.testing.assert_allclose(back.metallic, mesh.metallic, atol=0.02)


def test_thin_wall_keeps_a_colour_on_each_side():
    source = trimesh.creation.box((2, 2, 0.01)).subdivide().subdivide().subdivide()
    n = len(source.vertices)
    mesh = Mesh(source.vertices, source.faces, np.full((n, 3), 0.5), np.full(n, 0.5), np.zeros(n))
    surfels, binding, _ = attach(mesh)
    above = rotation_matrices(surfels.rotation)[:, 2, 2] > 0.5
    surfels.albedo[:] = np.where(above[:, None], [1, 0, 0], [0, 0, 1])
    surfels_to_vertices(mesh, surfels, binding)
    middle = (np.abs(mesh.vertices[:, :2]) < 0.9).all(axis=1)
    top = mesh.vertices[:, 2] > 0
    assert (mesh.albedo[middle & top, 0] > 0.95).all() and (mesh.albedo[middle & ~top, 2] > 0.95).all()


def test_proxy_of_a_sphere_is_a_closed_sphere():
    mesh, report = mesh_from_surfels(sphere_capture(), resolution=64, views=48)
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.is_watertight and solid.is_winding_consistent
    assert solid.volume == pytest.approx(4 / 3 * np.pi, rel=0.03) == report["volume"]
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1).max() < 0.5 * report["voxel"]


def test_proxy_closes_an_open_capture_instead_of_carving_its_inside():
    bowl = sphere_capture(keep=lambda p: p[:, 2] > -0.5)
    mesh, _ = mesh_from_surfels(bowl, resolution=64, views=48)
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    cap = np.pi * 0.5**2 * (3 - 0.5) / 3  # what is missing below the opening
    assert solid.is_watertight
    assert solid.volume == pytest.approx(4 / 3 * np.pi - cap, rel=0.08)


def squares(low, high, fixed: int, at: float, facing: int, spacing: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) of a grid on a rectangle that is level along an axis, and their normals."""
    first, second = (np.arange(a + spacing / 2, b, spacing) for a, b in zip(low, high))
    points = np.stack(np.meshgrid(first, second), -1).reshape(-1, 2)
    return np.insert(points, fixed, at, axis=1), np.tile(facing * np.eye(3)[fixed], (len(points), 1))


def test_large_surfels_whose_centre_no_view_sees_count_from_both_sides():
    """A block with a well. Four large surfels inside it make the floor of the well, and face down by mistake."""
    side, well, top, floor = 1.4, 0.4, 1.0, 0.5
    parts = [squares((-side, -side), (side, side), 2, z, facing) for z, facing in ((0, -1), (top, 1))]
    for axis in (0, 1):
        for sign in (-1, 1):
            parts.append(squares((-side, 0), (side, top), axis, sign * side, sign))
            parts.append(squares((-well, floor), (well, top), axis, sign * well, -sign))
    centre, normal = (np.concatenate(arrays) for arrays in zip(*parts))
    opening = (np.abs(centre[:, :2]) < well).all(axis=1) & (centre[:, 2] == top)
    large = np.array([[0.65, 0, floor], [-0.65, 0, floor], [0, 0.65, floor], [0, -0.65, floor]])
    centre = np.concatenate([centre[~opening], large])
    normal = np.concatenate([normal[~opening], np.tile([0.0, 0, -1], (4, 1))])
    n = len(centre)
    along = np.roll(normal, 1, axis=1)
    frame = np.stack([along, np.cross(normal, along), normal], -1)
    scale = np.full((n, 2), 0.04)
    scale[-4:] = 0.4
    capture = Surfels(centre, scale, quaternions(frame), np.full(n, 0.99), np.ones((n, 3)), np.ones(n), np.zeros(n))
    mesh, report = mesh_from_surfels(capture, resolution=64, views=96)
    inside = (np.abs(mesh.vertices[:, :2]) < 0.5 * well).all(axis=1) & (mesh.vertices[:, 2] > 0.25)
    assert inside.any() and mesh.vertices[inside, 2].max() < floor + report["voxel"], "the well is open to its floor"


@pytest.mark.slow
def test_import_without_a_mesh_builds_and_binds_one(shared_data):
    asset = import_asset(shared_data / "splats/playbot_lod3_2scale_sh2.ply", resolution=64)
    solid = trimesh.Trimesh(asset.mesh.vertices, asset.mesh.faces, process=False)
    assert solid.is_watertight and solid.volume > 0
    report = asset.provenance["report"]
    assert len(asset.surfels) == 31_000 and report["binding"]["far"] < 1500
    posed = MeshDriven(asset.mesh, asset.surfels, asset.binding).pose(asset.mesh.vertices)
    moved = np.linalg.norm(posed.centre - asset.surfels.centre, axis=1)
    assert np.quantile(moved, 0.995) < 1e-5
    assert asset.mesh.albedo.std() > 0.05


def test_y_up_turns_surfels_and_mesh_together():
    capture = sphere_capture()
    asset = import_asset(SurfelFile(capture, "IRGS"), sphere_mesh(3), up="y")
    np.testing.assert_allclose(asset.surfels.centre, capture.centre[:, [0, 2, 1]] * [1, -1, 1], atol=1e-6)
    vertices = asset.mesh.vertices[:, [0, 2, 1]] * [1, 1, -1]
    np.testing.assert_allclose(asset.mesh.albedo, 0.5 + 0.4 * vertices, atol=0.05)


def test_foreign_mesh_is_refused_with_both_sizes():
    mesh = sphere_mesh(2)
    mesh.vertices = mesh.vertices * 100 + 500
    with pytest.raises(AssetError, match=r"surfels and mesh: do not overlap: 0 %.*1\.9\d.*200 x"):
        import_asset(SurfelFile(sphere_capture(500), "3DGS"), mesh)


@pytest.mark.parametrize("factor", [0.001, 0.01, 0.4, 2.5, 100, 1000])
def test_other_units_are_refused_whichever_is_larger(factor):
    """Both around the origin: a mesh in millimetres encloses all surfels of its capture in metres."""
    mesh = sphere_mesh(3)
    mesh.vertices = mesh.vertices * np.float32(factor)
    with pytest.raises(AssetError, match=rf"surfels and mesh: do not .*1\.9\d.*the mesh {2 * factor:.4g} x"):
        import_asset(SurfelFile(sphere_capture(500), "3DGS"), mesh)


def test_other_units_of_what_is_flat_are_refused():
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32) * 100
    capture = sphere_capture(500)
    capture.centre[:, 2] = 0
    with pytest.raises(AssetError, match="do not fit"):
        import_asset(SurfelFile(capture, "3DGS"), MeshFile(square, [[0, 1, 2], [0, 2, 3]]))


def test_surfels_that_are_not_finite_are_dropped_and_counted():
    capture = sphere_capture(500)
    capture.centre[3] = np.nan
    capture.scale[7, 1] = np.inf
    asset = import_asset(SurfelFile(capture, "IRGS"), sphere_mesh(3))
    assert len(asset.surfels) == 498 and asset.provenance["report"]["not_finite"] == 2
    capture.centre[:] = np.nan
    with pytest.raises(AssetError, match="none with finite values"):
        import_asset(SurfelFile(capture, "IRGS"), sphere_mesh(3))
    with pytest.raises(AssetError, match="has no surfels"):
        import_asset(SurfelFile(sphere_capture(10, keep=lambda p: p[:, 0] > 9), "IRGS"), sphere_mesh(3))


def test_a_file_of_which_no_mesh_can_be_made_is_named(tmp_path):
    """Too few splats enclose nothing; of faint ones there is no outline; of splats that are all NaN none is left."""
    from drgs_blender.formats.writers import WRITERS

    (writer,) = (w for w in WRITERS if w.kind == "splats" and ".ply" in w.extensions)
    for count, opacity, problem in ((3, 0.9, "enclose no volume"), (9, 0.001, "only transparent")):
        file = tmp_path / f"of {count}.ply"
        splats = random_splats(count, 9)
        splats.opacity[:] = opacity
        writer.write(file, splats)
        with pytest.raises(AssetError, match=rf"of {count}\.ply.*{problem}.*Give the mesh"):
            import_asset(file)
    data = bytearray(file.read_bytes())
    start = data.index(b"end_header") + 11
    data[start:] = np.full((len(data) - start) // 4, np.nan, np.float32).tobytes()
    file.write_bytes(data)
    with pytest.raises(AssetError, match="has no surfels: 9 of 9 splats dropped: NaN"):
        import_asset(file)


def test_bind_reports_what_it_did():
    source = trimesh.creation.icosphere(3)
    n = len(source.vertices)
    mesh = Mesh(source.vertices, source.faces, np.ones((n, 3)), np.ones(n), np.zeros(n))
    capture = sphere_capture(1000)
    binding, report = bind(mesh, capture)
    assert report["surfels"] == 1000 and 0.4 < report["normals_agree"] < 0.6
    assert report["flipped"] == pytest.approx(1000 * (1 - report["normals_agree"]), abs=0.5)
    assert np.abs(binding.barycentric.sum(axis=1) - 1).max() < 1e-5 and (binding.normal[:, 2] > 0.9).all()
