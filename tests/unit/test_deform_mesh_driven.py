"""Surfels that follow a mesh: invariants of binding and posing."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from drgs_blender.core.asset.model import Binding, Mesh, Surfels
from drgs_blender.core.errors import AssetError
from drgs_blender.deform.attach import attach
from drgs_blender.deform.binding import bind
from drgs_blender.deform.mesh_driven import MeshDriven
from drgs_blender.geometry.normals import quaternions, rotation_matrices


def as_mesh(source: trimesh.Trimesh, seed: int = 0) -> Mesh:
    rng = np.random.default_rng(seed)
    n = len(source.vertices)
    return Mesh(source.vertices, source.faces, rng.random((n, 3)), rng.random(n), rng.random(n))


def blob() -> Mesh:
    source = trimesh.creation.icosphere(3)
    source.vertices *= [1.0, 0.7, 1.4]
    return as_mesh(source)


def shell_surfels(mesh: Mesh, n: int = 2000, off: float = 0.03, tilt: float = 0.1, seed: int = 0) -> Surfels:
    """Free surfels near `mesh`: scattered off the surface, tilted from its normals."""
    rng = np.random.default_rng(seed)
    source = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    point, face = trimesh.sample.sample_surface(source, n, seed=seed)
    normal = source.face_normals[face]
    tangent = np.cross(normal, rng.normal(size=(n, 3)))
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    frame = np.stack([tangent, np.cross(normal, tangent), normal], -1)
    frame = frame @ Rotation.from_rotvec(tilt * rng.normal(size=(n, 3))).as_matrix()
    return Surfels(
        point + normal * off * rng.normal(size=(n, 1)),
        rng.uniform(0.01, 0.05, (n, 2)),
        quaternions(frame),
        rng.random(n),
        rng.random((n, 3)),
        rng.random(n),
        rng.random(n),
    )


def rest_tangents(surfels: Surfels) -> np.ndarray:
    return rotation_matrices(surfels.rotation.astype(float))[..., :2] * surfels.scale[:, None, :]


def matrix(linear, translation=(0.0, 0.0, 0.0)) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = linear, translation
    return result


def posed_by(mesh, surfels, binding, world, **options):
    vertices = mesh.vertices @ world[:3, :3].T + world[:3, 3]
    return MeshDriven(mesh, surfels, binding).pose(vertices.astype(np.float32), **options)


def test_bound_surfels_stay_where_they_are_at_rest():
    mesh = blob()
    surfels = shell_surfels(mesh)
    binding, report = bind(mesh, surfels)
    posed = MeshDriven(mesh, surfels, binding).pose(mesh.vertices)
    assert report["snapped"] == 0
    np.testing.assert_allclose(posed.centre, surfels.centre, atol=1e-5)
    tangents = rest_tangents(surfels)
    np.testing.assert_allclose(posed.tangent_u, tangents[..., 0], atol=1e-6)
    np.testing.assert_allclose(posed.tangent_v, tangents[..., 1], atol=1e-6)
    normal = rotation_matrices(surfels.rotation.astype(float))[..., 2]
    np.testing.assert_allclose(posed.normal, normal, atol=1e-5)


def test_surfels_of_parts_that_the_mesh_lacks_stay_where_they_are():
    """Far beside the rim of a sheet of thin faces, up to thirty times their size: at rest, and as the sheet turns."""
    rng = np.random.default_rng(3)
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(0, 0.5, 11), np.linspace(0, 0.05, 11)))
    i = np.arange(100) + np.arange(100) // 10
    faces = np.concatenate([np.stack([i, i + 1, i + 12], 1), np.stack([i, i + 12, i + 11], 1)])
    mesh = Mesh(
        np.stack([x, y, 0.02 * rng.normal(size=len(x))], 1), faces, np.ones((121, 3)), np.ones(121), np.ones(121)
    )
    n = 200
    centre = rng.uniform((-1.5, -0.5, -0.3), (2.0, 0.6, 0.3), (n, 3))
    turns = rng.normal(size=(n, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    surfels = Surfels(centre, np.full((n, 2), 0.02), turns, np.ones(n), np.ones((n, 3)), np.ones(n), np.zeros(n))
    binding, report = bind(mesh, surfels)
    assert report["snapped"] == 0 and report["beside"] > n // 2
    posed = MeshDriven(mesh, surfels, binding).pose(mesh.vertices)
    np.testing.assert_allclose(posed.centre, surfels.centre, atol=2e-5)
    turn = Rotation.from_rotvec([0.3, -1.1, 2.0]).as_matrix()
    moved = posed_by(mesh, surfels, binding, matrix(turn, (3, -2, 5)))
    np.testing.assert_allclose(moved.centre, surfels.centre @ turn.T + [3, -2, 5], atol=1e-4)


def test_rigid_motion_is_rigid():
    mesh = blob()
    surfels = shell_surfels(mesh)
    binding, _ = bind(mesh, surfels)
    turn = Rotation.from_rotvec([0.3, -1.1, 2.0]).as_matrix()
    world = matrix(turn, (3, -2, 5))
    posed = posed_by(mesh, surfels, binding, world)
    tangents = turn @ rest_tangents(surfels)
    np.testing.assert_allclose(posed.centre, surfels.centre @ turn.T + [3, -2, 5], atol=1e-5)
    np.testing.assert_allclose(posed.tangent_u, tangents[..., 0], atol=1e-5)
    np.testing.assert_allclose(posed.tangent_v, tangents[..., 1], atol=1e-5)
    normal = rotation_matrices(surfels.rotation.astype(float))[..., 2]
    np.testing.assert_allclose(posed.normal, normal @ turn.T, atol=1e-5)


def test_normal_offset_turns_with_the_face():
    mesh = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], np.ones((3, 3)), np.ones(3), np.zeros(3))
    surfels = Surfels([[0.3, 0.3, 0.2]], [[0.1, 0.1]], [[1, 0, 0, 0]], [1], [[1, 1, 1]], [1], [0])
    binding, _ = bind(mesh, surfels)
    posed = posed_by(mesh, surfels, binding, matrix(Rotation.from_euler("x", 90, degrees=True).as_matrix()))
    np.testing.assert_allclose(posed.centre, [[0.3, -0.2, 0.3]], atol=1e-6)
    np.testing.assert_allclose(posed.normal, [[0, -1, 0]], atol=1e-6)


@pytest.mark.parametrize(
    "linear",
    [
        np.diag([2.0, 2, 2]),
        np.diag([0.3, 1.5, 2.0]),
        np.diag([-1.0, 1, 1]),
        [[1, 0.8, 0.1], [0, 0.7, -0.4], [0.2, 0, 1.3]],
        [[-1, 0.8, 0.1], [0, 0.7, -0.4], [0.2, 0, 1.3]],
    ],
    ids=["scale", "stretch", "mirror", "shear", "mirrored shear"],
)
def test_affine_matrix_world_is_exact_even_off_the_surface(linear):
    linear = np.asarray(linear, float)
    mesh = blob()
    surfels = shell_surfels(mesh)
    binding, _ = bind(mesh, surfels)
    world = matrix(linear, (1, 2, 3))
    posed = posed_by(mesh, surfels, binding, world, matrix_world=world)
    tangents = linear @ rest_tangents(surfels)
    np.testing.assert_allclose(posed.centre, surfels.centre @ linear.T + [1, 2, 3], atol=2e-5)
    np.testing.assert_allclose(posed.tangent_u, tangents[..., 0], atol=1e-5)
    np.testing.assert_allclose(posed.tangent_v, tangents[..., 1], atol=1e-5)


def test_mirror_keeps_normals_outwards():
    mesh = blob()
    surfels, binding, _ = attach(mesh, density=40)
    mirror = matrix(np.diag([-1.0, 1, 1]))
    rest = MeshDriven(mesh, surfels, binding).pose(mesh.vertices)
    posed = posed_by(mesh, surfels, binding, mirror, matrix_world=mirror)
    np.testing.assert_allclose(posed.normal, rest.normal * [-1, 1, 1], atol=1e-5)
    free = shell_surfels(mesh)
    free_binding, _ = bind(mesh, free)
    rest = MeshDriven(mesh, free, free_binding).pose(mesh.vertices)
    posed = posed_by(mesh, free, free_binding, mirror, matrix_world=mirror)
    np.testing.assert_allclose(posed.normal, rest.normal * [-1, 1, 1], atol=1e-5)


def test_flat_surfels_take_the_covariance_of_the_face_gradient():
    mesh = blob()
    surfels, binding, _ = attach(mesh, density=40)
    bend = mesh.vertices + 0.3 * np.sin(2 * mesh.vertices[:, [1, 2, 0]])
    posed = MeshDriven(mesh, surfels, binding).pose(bend.astype(np.float32))
    corners, bent = mesh.vertices[mesh.faces[binding.face]].astype(float), bend[mesh.faces[binding.face]]
    edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], -1)
    bent_edges = np.stack([bent[:, 1] - bent[:, 0], bent[:, 2] - bent[:, 0]], -1)
    expected = bent_edges @ np.linalg.pinv(edges) @ rest_tangents(surfels)
    actual = np.stack([posed.tangent_u, posed.tangent_v], -1)
    covariance, wanted = actual @ actual.swapaxes(1, 2), expected @ expected.swapaxes(1, 2)
    assert (np.abs(covariance - wanted).max((1, 2)) / np.abs(wanted).max((1, 2))).max() < 1e-4


def test_corner_normals_replace_smooth_ones():
    source = trimesh.creation.box()
    mesh = as_mesh(source)
    surfels, binding, _ = attach(mesh, density=10)
    flat = np.repeat(source.face_normals[:, None], 3, axis=1).astype(np.float32)
    posed = MeshDriven(mesh, surfels, binding).pose(mesh.vertices, flat)
    np.testing.assert_allclose(posed.normal, source.face_normals[binding.face], atol=1e-6)


def test_degenerate_rest_faces_and_collapsed_poses_stay_finite():
    vertices = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [5, 5, 5]])
    faces = [[0, 1, 2], [0, 1, 3], [4, 4, 4]]
    mesh = Mesh(vertices, faces, np.ones((5, 3)), np.ones(5), np.zeros(5))
    surfels = Surfels(np.zeros((3, 3)), np.ones((3, 2)), [[1, 0, 0, 0]] * 3, [1] * 3, np.ones((3, 3)), [1] * 3, [0] * 3)
    binding = Binding([0, 1, 2], np.full((3, 3), 1 / 3), np.full(3, 0.1), [[0, 0, 1]] * 3)
    driven = MeshDriven(mesh, surfels, binding)
    assert driven.degenerate_faces == 2
    for pose in (vertices, vertices * [1, 0, 1], vertices * 0):
        posed = driven.pose(pose.astype(np.float32))
        for name in ("centre", "tangent_u", "tangent_v", "normal"):
            assert np.isfinite(getattr(posed, name)).all(), name
        np.testing.assert_allclose(np.linalg.norm(posed.normal, axis=1), 1, atol=1e-6)
    grown = driven.pose(vertices * 3)
    np.testing.assert_allclose(np.linalg.norm(grown.tangent_u[:2], axis=1), 3, rtol=1e-5)


def test_vertices_that_are_not_finite_hide_their_surfels_only():
    mesh = blob()
    surfels, binding, _ = attach(mesh, density=40)
    vertices = mesh.vertices.copy()
    vertices[7] = np.nan
    driven = MeshDriven(mesh, surfels, binding)
    posed = driven.pose(vertices)
    touched = (mesh.faces[binding.face] == 7).any(axis=1)
    assert driven.hidden_count == touched.sum() > 0
    assert np.array_equal(posed.opacity == 0, touched)
    assert np.isfinite(posed.centre).all() and np.isfinite(posed.normal).all() and np.isfinite(posed.tangent_u).all()


def test_unchanged_materials_keep_the_detail_of_the_surfels_and_edits_replace_it():
    mesh = blob()
    surfels = shell_surfels(mesh)
    binding, _ = bind(mesh, surfels)
    driven = MeshDriven(mesh, surfels, binding)
    same = driven.pose(mesh.vertices, materials={"albedo": mesh.albedo.copy(), "roughness": None})
    assert np.array_equal(same.albedo, surfels.albedo)
    red = np.tile(np.float32([1, 0, 0]), (len(mesh.vertices), 1))
    painted = driven.pose(mesh.vertices, materials={"albedo": red})
    np.testing.assert_allclose(painted.albedo, np.tile([1, 0, 0], (len(surfels), 1)), atol=1e-6)
    assert np.array_equal(painted.roughness, surfels.roughness)
    one = mesh.roughness.copy()
    one[3] = 1 - one[3]
    partly = driven.pose(mesh.vertices, materials={"roughness": one})
    touched = (mesh.faces[binding.face] == 3).any(axis=1)
    assert np.array_equal(partly.roughness[~touched], surfels.roughness[~touched])
    assert not np.array_equal(partly.roughness[touched], surfels.roughness[touched])


def test_thin_wall_binds_each_side_to_its_own_face():
    wall = as_mesh(trimesh.creation.box((2, 2, 0.02)))
    rng = np.random.default_rng(0)
    n = 400
    side = np.where(np.arange(n) % 2, 1.0, -1.0)
    # Noise of the capture carries many centres past the middle of the wall.
    centre = np.c_[rng.uniform(-0.8, 0.8, (n, 2)), 0.01 * side + rng.normal(0, 0.01, n)]
    rotation = np.where(side[:, None] > 0, [[1, 0, 0, 0]], [[0, 1, 0, 0]])
    surfels = Surfels(centre, np.full((n, 2), 0.02), rotation, np.ones(n), np.ones((n, 3)), np.ones(n), np.zeros(n))
    binding, report = bind(wall, surfels)
    face_normal = trimesh.Trimesh(wall.vertices, wall.faces, process=False).face_normals[binding.face]
    assert (face_normal[:, 2] * side > 0.9).all()
    assert report["flipped"] == 0 and report["other_side"] > 20


def test_inward_captures_are_turned_outwards():
    mesh = blob()
    surfels = shell_surfels(mesh, tilt=0)
    turned = rotation_matrices(surfels.rotation.astype(float)) @ np.diag([1, -1, -1])
    surfels.rotation = quaternions(turned).astype(np.float32)
    binding, report = bind(mesh, surfels)
    assert report["flipped"] == len(surfels)
    posed = MeshDriven(mesh, surfels, binding).pose(mesh.vertices)
    outwards = np.einsum("nc,nc->n", posed.normal, posed.centre / np.float32([1, 0.49, 1.96]))
    assert (outwards > 0).all()


def test_wrong_input_is_told():
    mesh = blob()
    surfels, binding, _ = attach(mesh, density=40)
    with pytest.raises(AssetError, match=r"bound with"):
        MeshDriven(mesh, surfels, binding).pose(mesh.vertices[:-1])
    with pytest.raises(AssetError, match="Bind the surfels again"):
        MeshDriven(mesh, shell_surfels(mesh), binding)
    surfels = shell_surfels(mesh)
    surfels.centre[3] = np.nan
    with pytest.raises(AssetError, match="1 centres"):
        bind(mesh, surfels)


def test_normals_across_the_surface_are_not_believed():
    mesh = blob()
    surfels = shell_surfels(mesh, tilt=0)
    frames = rotation_matrices(surfels.rotation.astype(float))
    across = np.arange(len(surfels)) % 4 == 0
    # Cyclic order of the axes: the normal becomes a tangent.
    frames[across] = frames[across][..., [1, 2, 0]]
    surfels.rotation = quaternions(frames).astype(np.float32)
    binding, report = bind(mesh, surfels)
    assert report["unsure_normals"] == across.sum()
    assert (binding.normal[across] == [0, 0, 1]).all()
    posed = MeshDriven(mesh, surfels, binding).pose(mesh.vertices)
    outside = np.where(across[:, None], frames[..., 1], frames[..., 2])
    # The analytic normal of the ellipsoid; the mesh's own is as coarse as its triangles.
    agreement = np.einsum("nc,nc->n", posed.normal, outside)
    assert (agreement[~across] > 0.9999).all() and (agreement > 0.8).all() and agreement[across].mean() > 0.99
