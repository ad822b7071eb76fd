"""Vertex normals shared by deformation and rendering; arithmetic on many small rows."""

from __future__ import annotations

import tracemalloc

import numpy as np
import trimesh

from drgs_blender.deform.face_frames import product
from drgs_blender.geometry.distinct_rows import distinct_row_indices
from drgs_blender.geometry.normals import VertexNormals, corner_table, lengths, unit


def test_cube_corners_point_along_the_diagonal_however_it_is_triangulated():
    cube = trimesh.creation.box()
    normals = VertexNormals(cube.faces, 8)(cube.vertices)
    np.testing.assert_allclose(normals, np.sign(cube.vertices) / np.sqrt(3), atol=1e-6)


def test_angle_weights_match_trimesh_on_an_irregular_mesh():
    mesh = trimesh.creation.icosphere(3)
    mesh.vertices *= [1.0, 0.6, 1.7]
    mesh.vertices += np.random.default_rng(0).normal(0, 0.01, mesh.vertices.shape)
    expected = np.zeros_like(mesh.vertices)
    for k in range(3):
        np.add.at(expected, mesh.faces[:, k], mesh.face_normals * mesh.face_angles[:, k, None])
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(VertexNormals(mesh.faces, len(mesh.vertices))(mesh.vertices), expected, atol=2e-6)


def test_what_is_kept_of_a_mesh_is_its_faces_and_their_order_about_vertices():
    """What is computed on the way is more than that, and given back."""
    mesh = trimesh.creation.icosphere(5)
    VertexNormals(mesh.faces, len(mesh.vertices))(mesh.vertices)  # compiles
    tracemalloc.start()
    normals = VertexNormals(mesh.faces, len(mesh.vertices))
    found = normals(mesh.vertices)
    kept = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert kept < 1.1 * sum(array.nbytes for array in (normals.faces, normals.start, normals.place, found))


def test_degenerate_faces_weigh_nothing_and_lonely_vertices_stay_finite():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [9, 9, 9], [np.nan, 0, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 1, 3], [1, 1, 2], [2, 3, 5]])
    normals = VertexNormals(faces, len(vertices))(vertices)
    assert np.array_equal(normals, np.tile(np.float32([0, 0, 1]), (6, 1)))


def test_corner_table_lists_every_corner_once():
    faces = np.array([[0, 1, 2], [2, 1, 3]])
    start, corner = corner_table(faces, 5)
    assert [sorted(corner[start[v] : start[v + 1]]) for v in range(5)] == [[0], [1, 4], [2, 3], [5], []]


def test_fast_forms_have_the_bits_of_the_plain_ones():
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(9000, 3, 3))
    for dtype in (np.float32, np.float64):
        np.testing.assert_array_equal(lengths(vectors.astype(dtype)), np.linalg.norm(vectors.astype(dtype), axis=-1))
    np.testing.assert_array_equal(
        unit(np.array([[0.0, 0, 2], [0, 0, 0], [np.inf, 0, 0]]), (1, 0, 0))[1:], [[1, 0, 0]] * 2
    )
    flat = vectors[:, :, :2]
    np.testing.assert_array_equal(product(vectors, flat), np.einsum("nij,njk->nik", vectors, flat))
    assert product(vectors[:0], flat[:0]).shape == (0, 3, 2)
    for rows in (rng.integers(-3, 4, (5000, 3)), np.round(rng.normal(size=(5000, 3)), 1), np.zeros((0, 2), int)):
        np.testing.assert_array_equal(
            distinct_row_indices(*rows.T), np.unique(rows, axis=0, return_inverse=True)[1].reshape(-1)
        )
