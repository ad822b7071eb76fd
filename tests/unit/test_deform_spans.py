"""Surfels larger than the face they hang on: what they follow, and what does not smear them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_deform_mesh_driven import matrix, posed_by

from drgs_blender.core.asset.model import Mesh, Surfels
from drgs_blender.deform.binding import bind
from drgs_blender.deform.mesh_driven import MeshDriven

CELL = 0.1
LARGE = 3 * CELL


def sheet(side: int = 21, low: tuple[float, float, float] = (-1.0, -1.0, 0.0)) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a square grid of cells of 0.1, facing up."""
    x, y = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    vertices = np.stack([x, y, 0 * x], -1).reshape(-1, 3) * CELL + low
    a = (x * side + y)[:-1, :-1].reshape(-1)
    quad = np.stack([a, a + side, a + side + 1, a + 1], -1)
    return vertices.astype(np.float32), np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]).astype(np.int32)


def joined(*parts: tuple[np.ndarray, np.ndarray]) -> Mesh:
    shift = np.cumsum([0] + [len(vertices) for vertices, _ in parts])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    faces = np.concatenate([faces + k for (_, faces), k in zip(parts, shift)])
    n = len(vertices)
    return Mesh(vertices, faces, np.ones((n, 3)), np.ones(n), np.zeros(n))


def flat(*centres: tuple[float, float, float], size: float = LARGE, turn: float = 0.4) -> Surfels:
    n = len(centres)
    x, y, z, w = Rotation.from_euler("z", turn).as_quat()
    rotation = np.tile([w, x, y, z], (n, 1))
    return Surfels(
        centres, np.full((n, 2), size), rotation, np.ones(n), np.full((n, 3), 0.5), np.full(n, 0.5), np.zeros(n)
    )


def driven(mesh: Mesh, surfels: Surfels) -> MeshDriven:
    return MeshDriven(mesh, surfels, bind(mesh, surfels)[0])


def extent(posed) -> np.ndarray:
    return np.linalg.svd(np.stack([posed.tangent_u, posed.tangent_v], -1).astype(float), compute_uv=False)[:, 0]


def test_only_surfels_larger_than_their_face_have_a_span():
    mesh = joined(sheet())
    surfels = flat((0.03, 0.01, 0), (0.53, 0.21, 0))
    surfels.scale[1] = 0.5 * CELL
    span = driven(mesh, surfels).rest[6]
    assert (span[1] == -1).all()
    away = np.linalg.norm(mesh.vertices[span[0]] - surfels.centre[0], axis=1)
    np.testing.assert_allclose(away, LARGE, atol=CELL)


def test_one_face_that_is_carried_badly_smears_no_large_surfel():
    mesh = joined(sheet())
    asset = driven(mesh, flat((0.03, 0.01, 0)))
    vertices = mesh.vertices.copy()
    vertices[mesh.faces[asset.binding.face[0], 0]] += (-0.5, 0.3, 0.2)
    np.testing.assert_allclose(extent(asset.pose(vertices)), LARGE, rtol=1e-4)
    small = driven(mesh, flat((0.03, 0.01, 0), size=0.5 * CELL))
    assert extent(small.pose(vertices))[0] > 1.5 * CELL


def test_a_gap_within_reach_smears_no_large_surfel():
    mesh = joined(sheet())
    asset = driven(mesh, flat((-0.12, 0.02, 0)))
    vertices = mesh.vertices + np.where(mesh.vertices[:, :1] > 0.05, (5.0, 0, 0), 0).astype(np.float32)
    assert (vertices[asset.rest[6]][0, :, 0] > 3).any(), "no gap within reach"
    np.testing.assert_allclose(extent(asset.pose(vertices)), LARGE, rtol=1e-4)


@pytest.mark.parametrize("offset", [(0.0, 0.0, -0.02), (2.02, 0.0, 0.0)], ids=["wall", "neighbour"])
def test_a_span_stays_on_its_sheet(offset):
    """The back of a wall, and a sheet that only comes near, move by themselves."""
    front, back = sheet(), sheet(low=tuple(np.add((-1.0, -1.0, 0.0), offset)))
    mesh = joined(front, (back[0], back[1][:, ::-1] if offset[2] else back[1]))
    surfels = flat(*np.random.default_rng(0).uniform((-0.95, -0.95, 0), (0.99, 0.95, 0), (200, 3)))
    asset = driven(mesh, surfels)
    span = asset.rest[6]
    assert (asset.binding.face < len(front[1])).all() and (span[:, 0] >= 0).mean() > 0.9
    assert (span < len(front[0])).all()


def test_a_span_does_not_go_round_a_rim():
    vertices, faces = sheet(side=41)
    back = vertices[:, 0] > 1.01
    vertices[back] = np.array([2, 0, -0.02]) + vertices[back] * [-1, 1, 1]
    asset = driven(joined((vertices, faces)), flat(*[(0.85, y, 0.0) for y in np.linspace(-0.5, 2.5, 100)]))
    span = asset.rest[6]
    assert (asset.mesh.vertices[asset.mesh.faces[asset.binding.face], 2] == 0).all() and (span[:, 0] >= 0).mean() > 0.5
    assert (asset.mesh.vertices[span[span[:, 0] >= 0], 2] == 0).all()


@pytest.mark.parametrize(
    "linear", [np.eye(3), np.diag([0.3, 1.5, 2.0]), [[-1, 0.8, 0.1], [0, 0.7, -0.4], [0.2, 0, 1.3]]]
)
def test_large_surfels_follow_affine_motion_exactly(linear):
    mesh = joined(sheet())
    mesh.vertices[:, 2] = 0.3 * np.sin(3 * mesh.vertices[:, 0]) * np.cos(2 * mesh.vertices[:, 1])
    rng = np.random.default_rng(2)
    surfels = flat(*rng.uniform((-0.9, -0.9, 0), (0.9, 0.9, 0), (300, 3)))
    turn = Rotation.from_rotvec([0.3, -1.1, 2.0]).as_matrix()
    linear = turn @ np.asarray(linear, float)
    world = matrix(linear, (1, 2, 3))
    asset = driven(mesh, surfels)
    assert (asset.rest[6][:, 0] >= 0).mean() > 0.9
    posed = posed_by(mesh, surfels, asset.binding, world, matrix_world=world)
    rest = asset.pose(mesh.vertices)
    np.testing.assert_allclose(posed.tangent_u, rest.tangent_u @ linear.T, atol=1e-5)
    np.testing.assert_allclose(posed.tangent_v, rest.tangent_v @ linear.T, atol=1e-5)


def test_a_large_surfel_takes_the_mean_of_what_it_covers():
    """On a sheet whose cells are stretched by 1 and 3 in turn a small one takes either; a large one about the mean."""
    mesh = joined(sheet())
    column = np.round((mesh.vertices[:, 0] + 1) / CELL).astype(int)
    place = np.concatenate([[0], np.cumsum(np.where(np.arange(20) % 2, 3, 1))]) * CELL
    vertices = mesh.vertices.copy()
    vertices[:, 0] = place[column]
    centres = [(x, 0.01, 0) for x in (0.07, 0.17)]  # in a cell stretched by 3, and in one by 1
    small, large = (
        extent(driven(mesh, flat(*centres, size=size, turn=0)).pose(vertices)) / size for size in (0.04, LARGE)
    )
    np.testing.assert_allclose(sorted(small), [1, 3], rtol=1e-4)
    assert large.max() < 2.5 and large.min() >= 1


def test_a_surfel_as_large_as_its_object_costs_no_walk_over_all_of_it():
    mesh = joined(sheet(side=101))
    asset = driven(mesh, flat((4.03, 4.01, 0), size=100.0))
    assert np.isfinite(extent(asset.pose(2 * mesh.vertices))).all()
    np.testing.assert_allclose(extent(asset.pose(2 * mesh.vertices)), 200, rtol=1e-4)
