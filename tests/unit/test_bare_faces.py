"""Faces that go with removed surfels: those that nothing else covers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from shapes import plain_mesh, sphere_mesh

from drgs_blender.core.asset.model import Asset, Binding, Mesh
from drgs_blender.core.asset.part import taken
from drgs_blender.core.bare_faces import REACH, bare_faces
from drgs_blender.core.floaters import median_size
from drgs_blender.deform.attach import attach
from drgs_blender.deform.binding import bind


def middles(mesh: Mesh) -> np.ndarray:
    return mesh.vertices[mesh.faces].mean(axis=1)


@pytest.fixture(scope="module")
def sparse() -> Asset:
    """A fine ball under few surfels, which are as large as many of its faces."""
    coarse = plain_mesh(*sphere_mesh(2))
    surfels, _, _ = attach(coarse, density=1)
    fine = plain_mesh(*sphere_mesh(5))
    return Asset(surfels, fine, bind(fine, surfels)[0])


def soup(mesh: Mesh) -> Mesh:
    """Every face with vertices of its own."""
    rows = mesh.faces.reshape(-1)
    return plain_mesh(mesh.vertices[rows], np.arange(len(rows), dtype=np.int32).reshape(-1, 3))


def test_with_a_surfel_in_the_middle_of_each_face_it_is_that_one() -> None:
    mesh = plain_mesh(*sphere_mesh(3))
    surfels, binding, _ = attach(mesh, density=1)
    assert len(surfels) == len(mesh.faces)
    removed = np.random.default_rng(0).random(len(surfels)) < 0.3
    bare = bare_faces(Asset(surfels, mesh, binding), np.flatnonzero(removed))
    np.testing.assert_array_equal(bare, removed[np.argsort(binding.face)])


def test_a_face_stays_as_long_as_one_of_its_surfels() -> None:
    """Else surfels that nobody deleted would go with it."""
    mesh = plain_mesh(*sphere_mesh(1))
    surfels, binding, _ = attach(mesh, density=8)
    removed = np.random.default_rng(1).random(len(surfels)) < 0.9
    assert len(surfels) >= 2 * len(mesh.faces)
    left = np.bincount(binding.face[~removed], minlength=len(mesh.faces))
    bare = bare_faces(Asset(surfels, mesh, binding), np.flatnonzero(removed))
    np.testing.assert_array_equal(bare, left == 0)
    assert 0 < bare.sum() < len(bare)


@pytest.mark.parametrize("split", [False, True])
def test_faces_without_surfels_go_with_those_around(sparse: Asset, split: bool) -> None:
    asset = replace(sparse, mesh=soup(sparse.mesh)) if split else sparse
    assert asset.binding is not None
    assert len(np.unique(asset.binding.face)) < len(asset.mesh.faces) / 4
    above = asset.surfels.centre[:, 2] > 0
    bare = bare_faces(asset, np.flatnonzero(above))
    height, reach = middles(asset.mesh)[:, 2], REACH * median_size(asset.surfels)
    sure = np.abs(height) > reach / 2
    assert 0 < sure.sum() < len(sure)
    np.testing.assert_array_equal(bare[sure], height[sure] > 0)


def test_what_no_surfel_covered_stays(sparse: Asset) -> None:
    """As the back of an object that no photograph shows; and what only a surfel in the air hangs on."""
    assert sparse.binding is not None
    front = np.flatnonzero(sparse.surfels.centre[:, 2] > 0.8)
    b = sparse.binding
    asset = Asset(
        taken(sparse.surfels, front),
        sparse.mesh,
        Binding(b.face[front], b.barycentric[front], b.offset[front], b.normal[front]),
    )
    bare = bare_faces(asset, np.arange(len(front)))
    height = middles(asset.mesh)[:, 2]
    assert bare[height > 0.9].all() and not bare[height < 0].any()
    lifted = taken(asset.surfels, np.arange(len(front)))
    lifted.centre = lifted.centre * 3
    assert not bare_faces(replace(asset, surfels=lifted), np.arange(len(front))).any()


def test_surfels_without_a_mesh_cover_no_face(sparse: Asset) -> None:
    assert not len(bare_faces(Asset(sparse.surfels, Mesh.empty(), None), np.arange(3)))
