"""Learned normals in the shape: vertices that follow them, surfels that are shaded by them."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import plain_mesh, sphere_mesh

from drgs_blender.deform.attach import attach
from drgs_blender.deform.mesh_driven import MeshDriven
from drgs_blender.geometry.normals import VertexNormals, rotation_matrices, unit
from drgs_blender.reconstruct.meshing.normal_integration import blended, follow_normals, shaded_by, shaded_by_own


@pytest.fixture
def rough():
    """A sphere with waves on it, some ten edges long: the mesh, its true normals, its mean edge."""
    vertices, faces = sphere_mesh(5)
    true = unit(vertices.astype(np.float64))
    edge = np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1).mean()
    noise = 0.5 * edge * np.sin(15 * true).prod(axis=1, keepdims=True)
    return plain_mesh(true * (1 + noise), faces), true, edge


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((a * b).sum(-1), -1, 1)))


def smooth(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    return VertexNormals(faces, len(vertices))(vertices)


def test_vertices_follow_the_normals(rough):
    mesh, true, _ = rough
    moved = follow_normals(mesh, true.astype(np.float32))
    before, after = (angles(smooth(v, mesh.faces), true).mean() for v in (mesh.vertices, moved))
    assert before > 3 and after < 0.2 * before
    off_before, off_after = (np.abs(np.linalg.norm(v, axis=1) - 1).mean() for v in (mesh.vertices, moved))
    assert off_after < 0.2 * off_before  # the waves are gone, not the size


def test_the_position_holds_where_normals_say_nothing_new(rough):
    """Normals of a sphere of another size are the same: nothing may drift."""
    mesh, true, _ = rough
    big = plain_mesh(1.3 * true, mesh.faces)
    np.testing.assert_allclose(follow_normals(big, true.astype(np.float32)), big.vertices, atol=1e-3)


def test_normals_that_are_nonsense_turn_no_face(rough):
    mesh, true, edge = rough
    wild = unit(np.random.default_rng(1).normal(size=true.shape)).astype(np.float32)
    moved = follow_normals(mesh, wild)
    assert np.isfinite(moved).all() and np.linalg.norm(moved - mesh.vertices, axis=1).max() < 1.6 * edge

    def of_faces(v):
        corner = v[mesh.faces].astype(np.float64)
        return unit(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]))

    assert angles(of_faces(moved), of_faces(mesh.vertices)).max() < 61


def test_surfels_are_shaded_by_the_normals_in_every_pose(rough):
    mesh, true, _ = rough
    surfels, binding, _ = attach(mesh, None, density=20)
    shaded = shaded_by(binding, mesh, blended(binding, mesh, true))
    driven = MeshDriven(mesh, surfels, shaded)
    wanted = unit(np.einsum("nk,nkc->nc", binding.barycentric, true[mesh.faces[binding.face]]))
    assert angles(driven.pose(mesh.vertices).normal, wanted).max() < 0.1
    turn = np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]])
    posed = driven.pose((mesh.vertices @ turn.T).astype(np.float32))
    assert angles(posed.normal, wanted @ turn.T).max() < 0.1


def test_surfels_keep_their_own_normals_on_the_side_of_their_faces(rough):
    mesh, _, _ = rough
    surfels, binding, _ = attach(mesh, None, density=20)
    spun = np.random.default_rng(2).normal(size=surfels.rotation.shape)
    surfels.rotation = (spun / np.linalg.norm(spun, axis=1, keepdims=True)).astype(np.float32)
    own = rotation_matrices(surfels.rotation.astype(np.float64))[..., 2]
    outwards = np.einsum("nc,nc->n", own, unit(surfels.centre.astype(np.float64)))
    clear = np.abs(outwards) > 0.3  # the faces are a little rough
    wanted = own * np.sign(outwards)[:, None]
    for rotate in (np.eye(3), np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]])):
        driven = MeshDriven(mesh, surfels, shaded_by_own(binding, mesh, own))
        posed = driven.pose((mesh.vertices @ rotate.T).astype(np.float32))
        assert angles(posed.normal, wanted @ rotate.T)[clear].max() < 0.1
