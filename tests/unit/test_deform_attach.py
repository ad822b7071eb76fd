"""Algorithm 1: surfels made from faces."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from drgs_blender.core.asset.model import Mesh, Surfels
from drgs_blender.core.frame import Camera, RenderSettings
from drgs_blender.deform.attach import UNSEEN, attach, sharp_edges
from drgs_blender.deform.face_frames import Faces
from drgs_blender.deform.mesh_driven import MeshDriven
from drgs_blender.geometry.normals import rotation_matrices
from drgs_blender.render.camera import camera_parameters
from drgs_blender.render.surfels.raster import rasterise
from drgs_blender.render.surfels.splats import prepare


def as_mesh(source: trimesh.Trimesh) -> Mesh:
    n = len(source.vertices)
    return Mesh(source.vertices, source.faces, np.full((n, 3), 0.5), np.full(n, 0.4), np.zeros(n))


def points(centre, opacity) -> Surfels:
    n = len(centre)
    return Surfels(
        centre, np.full((n, 2), 0.01), [[1, 0, 0, 0]] * n, opacity, np.full((n, 3), 0.5), np.ones(n), np.zeros(n)
    )


def coverage(mesh: Mesh, surfels, binding, size: int = 512) -> np.ndarray:
    """Coverage (size, size) seen orthographically along -X; the picture is 3 units wide."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]).T
    matrix[:3, 3] = (5, 0, 0)
    camera = Camera(matrix, size, size, size / 3, size / 3, size / 2, size / 2, orthographic=True)
    posed = MeshDriven(mesh, surfels, binding).pose(mesh.vertices)
    settings = RenderSettings(subpixel_samples=4)
    return rasterise(prepare(posed, camera, camera_parameters(camera, settings, 0)), 0, size).alpha.mean(axis=-1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "source",
    [trimesh.creation.icosphere(2), trimesh.creation.icosphere(4), trimesh.creation.cylinder(1.0, 2.0, sections=64)],
    ids=["coarse sphere", "fine sphere", "cylinder of slivers"],
)
def test_surfels_cover_the_mesh_and_little_else(source):
    mesh = as_mesh(source)
    surfels, binding, _ = attach(mesh)
    alpha = coverage(mesh, surfels, binding)
    size = len(alpha)
    y, z = ((np.arange(size) + 0.5) / size - 0.5) * 3, (0.5 - (np.arange(size) + 0.5) / size) * 3
    y, z = np.meshgrid(y, z)
    profile = np.abs(mesh.vertices[:, 1]).max(), np.abs(mesh.vertices[:, 2]).max()
    if len(source.faces) == 256:
        inside, core, halo = (
            (np.abs(y) < profile[0] + grow) & (np.abs(z) < profile[1] + grow) for grow in (0, -0.05, 0.05)
        )
    else:
        inside, core, halo = (np.hypot(y, z) < 1 + grow for grow in (0, -0.05, 0.05))
    assert alpha[core].mean() > 0.99 and alpha[core].min() > 0.9
    assert alpha[~halo].max() < 0.02
    assert (inside & (alpha > 0.5)).sum() / (inside | (alpha > 0.5)).sum() > 0.96


def test_fitted_surfels_are_flat_on_their_faces_and_scaled_to_them():
    mesh = as_mesh(trimesh.creation.icosphere(3))
    surfels, binding, report = attach(mesh, density=0.5)
    assert len(surfels) == len(mesh.faces) == report["surfels"] and report["cut_faces"] == 0
    frames = rotation_matrices(surfels.rotation.astype(float))
    normal = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).face_normals
    np.testing.assert_allclose(frames[..., 2], normal, atol=1e-5)
    np.testing.assert_allclose(binding.barycentric, 1 / 3, atol=1e-6)
    assert (binding.offset == 0).all() and (binding.normal == [0, 0, 1]).all()
    posed = MeshDriven(mesh, surfels, binding).pose(mesh.vertices)
    np.testing.assert_allclose(posed.centre, mesh.vertices[mesh.faces].mean(axis=1), atol=1e-6)
    # The product of the deviations is the area, up to the constant of a triangle's second moment.
    area = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).area_faces
    product = surfels.scale.prod(axis=1) / area
    np.testing.assert_allclose(product, product[0], rtol=1e-3)


def test_paper_rule_aligns_with_the_first_edge_and_takes_the_nearest_centre():
    vertices = [[0, 0, 0], [2, 0, 0], [0, 2, 0], [2, 2, 0]]
    mesh = Mesh(vertices, [[0, 1, 2], [1, 3, 2]], np.ones((4, 3)), np.ones(4), np.zeros(4))
    surfels, _, _ = attach(mesh, scale="paper")
    np.testing.assert_allclose(surfels.scale, np.sqrt(8) / 3, rtol=1e-6)
    np.testing.assert_allclose(rotation_matrices(surfels.rotation)[0], np.eye(3), atol=1e-6)
    np.testing.assert_allclose(rotation_matrices(surfels.rotation)[1, :, 0], [0, 1, 0], atol=1e-6)


def test_pretrained_surfels_give_their_mean_place_and_opacity():
    mesh = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], np.ones((3, 3)), np.ones(3), np.zeros(3))
    pretrained = points([[0.2, 0.2, 0.3], [0.4, 0.2, -0.1], [0.5, 0.005, 0]], [0.2, 0.6, 1.0])
    surfels, binding, report = attach(mesh, pretrained, density=0.5)
    np.testing.assert_allclose(binding.barycentric, [[0.5, 0.3, 0.2]], atol=1e-6)
    np.testing.assert_allclose(surfels.opacity, [0.4], atol=1e-6)  # the third lies within tau of an edge
    assert report["interior"] == 2 and report["on_edges"] == 1 and report["pretrained"] == 3


def test_faces_without_pretrained_take_neighbours_else_the_default():
    sphere = trimesh.creation.icosphere(1)
    far = sphere.copy()
    far.apply_translation([9, 0, 0])
    mesh = as_mesh(trimesh.util.concatenate([sphere, far]))
    first = mesh.vertices[mesh.faces[0]].mean(axis=0)
    surfels, binding, report = attach(mesh, points([first], [0.7]), density=0.5)
    touching = np.isin(mesh.faces, mesh.faces[0]).any(axis=1)[binding.face]
    np.testing.assert_allclose(surfels.opacity, np.where(touching, 0.7, UNSEEN), atol=1e-6)
    assert report["faces_from_neighbours"] == touching.sum() - 1
    assert report["faces_unseen"] == (~touching).sum()


def test_convex_ridges_are_counted():
    mesh = as_mesh(trimesh.creation.box())
    _, _, report = attach(mesh, points([[0.7, 0.7, 0], [0.8, 0.9, 0.7], [0.7, 0.1, 0.2]], [1, 1, 1]), density=0.5)
    assert report["on_edges"] == 2 and report["interior"] == 1


def test_degenerate_faces_get_no_surfel():
    mesh = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]], [[0, 1, 2], [0, 1, 3]], np.ones((4, 3)), [1] * 4, [0] * 4)
    surfels, binding, report = attach(mesh, density=0.5)
    assert len(surfels) == 1 and report["degenerate_faces"] == 1 and binding.face[0] == 0


def test_sharp_edges_are_folds_and_rims_even_where_vertices_are_split():
    box = trimesh.creation.box((1, 1, 1)).subdivide()
    soup = box.vertices[box.faces].reshape(-1, 3)
    for vertices, indices in ((box.vertices, box.faces), (soup, np.arange(len(soup)).reshape(-1, 3))):
        n = len(vertices)
        mesh = Mesh(vertices, indices, np.ones((n, 3)), np.ones(n), np.zeros(n))
        sharp = sharp_edges(mesh, Faces.of(mesh.vertices, mesh.faces))
        a, b = (vertices[np.roll(indices, -k, axis=1)] for k in (1, 2))
        folded = ((np.abs(a) == 0.5) & (a == b)).sum(axis=2) == 2  # both ends on the same two sides of the box
        assert np.array_equal(sharp, folded)


def test_surfels_stay_inside_folds():
    box = trimesh.creation.box((1, 1, 1)).subdivide().subdivide()
    n = len(box.vertices)
    mesh = Mesh(box.vertices, box.faces, np.ones((n, 3)), np.ones(n), np.zeros(n))
    surfels, binding, _ = attach(mesh)
    normal = box.face_normals[binding.face]
    frame = rotation_matrices(surfels.rotation.astype(float))
    # Where the kernel is one half: sqrt(2 ln 2) deviations from the centre, in any direction of the plane.
    reach = np.sqrt(2 * np.log(2) * ((frame[:, :, :2] * surfels.scale[:, None]) ** 2).sum(axis=2))
    beyond = np.where(np.abs(normal) > 0.5, 0, np.abs(surfels.centre) + reach - 0.5)
    size = 1 / 4 * 2**0.5
    assert beyond.max() < 0.03 * size
