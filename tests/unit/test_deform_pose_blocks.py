"""Surfels posed in blocks: what `pose.pose_surfels` makes of one surfel after the other, bit for bit."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from test_deform_mesh_driven import as_mesh, shell_surfels

from drgs_blender.compute.threads import get_num_threads, use_threads
from drgs_blender.core.asset.model import Mesh
from drgs_blender.deform.binding import bind
from drgs_blender.deform.mesh_driven import MeshDriven
from drgs_blender.deform.pose import Posed, PosedMesh, Rest, pose_surfels
from drgs_blender.deform.pose_blocks import pose

MIRRORED = np.array([[-1.2, 0.1, 0.0], [0.2, 0.8, 0.1], [0.0, 0.3, 1.1]])


@pytest.fixture(scope="module")
def driven() -> MeshDriven:
    """Surfels smaller and larger than their faces, on a mesh of which some faces have no area at rest."""
    ball = trimesh.creation.icosphere(4)
    faces = np.concatenate([ball.faces, ball.faces[:40, [0, 0, 1]]])
    n = len(ball.vertices)
    mesh = Mesh(ball.vertices * [1.0, 0.7, 1.4], faces, np.ones((n, 3)), np.ones(n), np.zeros(n))
    surfels = shell_surfels(as_mesh(trimesh.Trimesh(mesh.vertices, ball.faces, process=False)), 12_000)
    surfels.scale[::3] *= 5
    binding, _ = bind(mesh, surfels)
    binding.face[7::50] = np.arange(len(ball.faces), len(faces))[np.arange(len(binding.face[7::50])) % 40]
    made = MeshDriven(mesh, surfels, binding)
    assert made.degenerate_faces == 40
    return made


def bent(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertices with waves, a collapsed cap and some that are not finite; normals of which a few vanish."""
    vertices = (mesh.vertices + 0.2 * np.sin(9 * mesh.vertices[:, [2, 0, 1]])).astype(np.float32)
    vertices[mesh.vertices[:, 2] > 1.3] = (0.1, 0.2, 1.4)
    vertices[5], vertices[77, 1], vertices[300, 2] = np.nan, np.inf, 1e31
    normals = np.random.default_rng(0).normal(size=(len(vertices), 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[40:60] = 0
    return vertices, normals


def empty(count: int) -> Posed:
    return Posed(*(np.full((count, 3), 7, np.float32) for _ in range(4)), np.full(count, 0.5, np.float32))


def first(rest: Rest, count: int) -> Rest:
    return Rest(*(part if name == "rest_edge" else part[:count] for name, part in zip(Rest._fields, rest)))


@pytest.mark.parametrize("count", [1, 127, 129, 12_000])
@pytest.mark.parametrize("by_corner", [False, True], ids=["vertex normals", "corner normals"])
@pytest.mark.parametrize("linear", [np.eye(3), MIRRORED], ids=["rigid", "mirrored"])
def test_blocks_give_the_bits_of_single_surfels(driven, linear, by_corner, count):
    vertices, normals = bent(driven.mesh)
    if by_corner:
        normals = normals[driven.mesh.faces].reshape(-1, 3)
    mesh = PosedMesh(vertices, driven.mesh.faces, normals)
    rest, sign = first(driven.rest, count), float(np.sign(np.linalg.det(linear)))
    expected = empty(count)
    pose_surfels(0, 1, 0, mesh, by_corner, linear, sign, rest, expected)
    before = get_num_threads()
    try:
        for threads in (1, 2):
            use_threads(threads)
            found = empty(count)
            pose(mesh, by_corner, linear, sign, rest, found)
            for name, one, other in zip(Posed._fields, found, expected):
                assert one.tobytes() == other.tobytes(), name
    finally:
        use_threads(before)


def test_the_case_has_surfels_of_every_kind(driven):
    """Hidden ones, such on faces without area, collapsed in the pose, with a span that is taken and one that is not."""
    vertices, normals = bent(driven.mesh)
    mesh, rest, count = PosedMesh(vertices, driven.mesh.faces, normals), driven.rest, len(driven.surfels)
    posed, without = empty(count), empty(count)
    pose(mesh, False, np.eye(3), 1.0, rest, posed)
    pose(mesh, False, np.eye(3), 1.0, rest._replace(span=np.full_like(rest.span, -1)), without)
    with_span = (rest.span[:, 0] >= 0) & (posed.opacity > 0)
    taken = (posed.tangent_u != without.tangent_u).any(axis=1)
    corners = vertices[driven.mesh.faces[rest.face]]
    collapsed = (corners == corners[:, :1]).all(axis=(1, 2)) & (rest.rest_edge[rest.face] == 0)
    for kind in (posed.opacity == 0, rest.rest_edge[rest.face] > 0, collapsed, taken & with_span, with_span & ~taken):
        assert 20 < kind.sum() < count
    assert not taken[~with_span].any()
