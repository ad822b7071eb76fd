"""Meshes that fill the masks, and depth maps that become a mesh: against a ball, known exactly."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("skimage")

from capture_cases import balls, camera
from shapes import plain_mesh, sphere_mesh

from drgs_blender.core.errors import UsageError
from drgs_blender.core.frame import Camera
from drgs_blender.geometry.normals import VertexNormals
from drgs_blender.reconstruct.capture.training_views import pixel_rays
from drgs_blender.reconstruct.meshing import depth_fusion
from drgs_blender.reconstruct.meshing.silhouette_fit import FARTHEST, fill_silhouettes
from drgs_blender.reconstruct.meshing.tangential_relaxation import relaxed
from drgs_blender.reconstruct.meshing.visual_hull import Region, silhouettes

SIZE, RADIUS = 96, 0.7
PIXEL = 4.0 / camera(0, 1, SIZE).fx


@pytest.fixture(scope="module")
def cameras() -> list[Camera]:
    return [camera(k, 24, SIZE) for k in range(24)]


def hit(view: Camera, radius: float = RADIUS, middle: tuple[float, float, float] = (0, 0, 0)) -> tuple:
    """Depth (h, w) of a ball along rays of unit depth, inf beside it, and the cosine at which it is seen."""
    rays, eye = pixel_rays(view).numpy().astype(np.float64), view.matrix_world[:3, 3] - middle
    a, b = (rays * rays).sum(-1), rays @ eye
    root = b * b - a * (eye @ eye - radius**2)
    depth = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
    cosine = np.sqrt(np.maximum(root, 0) / a) / radius
    return depth.astype(np.float32), np.where(root > 0, cosine, 1).astype(np.float32)


def mask_of(view: Camera, **ball: object) -> np.ndarray:
    """(h, w) coverage by a ball."""
    k = 4
    fine = replace(
        view, width=k * view.width, height=k * view.height, fx=k * view.fx, fy=k * view.fy, cx=k * view.cx,
        cy=k * view.cy,
    )  # fmt: skip
    depth, _ = hit(fine, **ball)  # type: ignore[arg-type]
    return np.isfinite(depth).reshape(view.height, k, view.width, k).mean(axis=(1, 3)).astype(np.float32)


def off(vertices: np.ndarray) -> np.ndarray:
    """Distance from the ball's surface, pixels."""
    return (np.linalg.norm(vertices, axis=1) - RADIUS) / PIXEL


def test_exact_depth_maps_make_an_exact_mesh(cameras, monkeypatch):
    monkeypatch.setattr(depth_fusion, "surface_maps", lambda _, view: hit(view))
    low = np.full(3, -RADIUS)
    region = Region(np.zeros(3), 2 * RADIUS, low, -low, np.zeros((0, 3)), np.zeros((0, 3)), PIXEL)
    mesh, report = depth_fusion.fuse(None, cameras, region)  # type: ignore[arg-type]
    assert report["voxel"] == pytest.approx(PIXEL, rel=0.05)
    assert -0.3 < off(mesh.vertices).mean() < 0  # what the smoothing takes
    filled = off(fill_silhouettes(mesh, cameras, [mask_of(view) for view in cameras]))
    assert abs(filled.mean()) < 0.03 and np.abs(filled).max() < 0.2


def test_a_fused_mesh_keeps_its_normals_when_it_is_moved(cameras, monkeypatch):
    """Edges of a hundredth of a voxel, as marching cubes leaves them, turn over with the first move."""
    rng = np.random.default_rng(0)

    def noisy(_: object, view: Camera) -> tuple:
        depth, cosine = hit(view)
        return depth + (0.3 * PIXEL * rng.normal(size=depth.shape)).astype(np.float32), cosine

    monkeypatch.setattr(depth_fusion, "surface_maps", noisy)
    low = np.full(3, -RADIUS)
    region = Region(np.zeros(3), 2 * RADIUS, low, -low, np.zeros((0, 3)), np.zeros((0, 3)), PIXEL)
    mesh, report = depth_fusion.fuse(None, cameras, region)  # type: ignore[arg-type]
    edges = np.linalg.norm(mesh.vertices[mesh.faces] - mesh.vertices[np.roll(mesh.faces, 1, axis=1)], axis=-1)
    assert edges.min() > 0.1 * report["voxel"]
    filled = fill_silhouettes(mesh, cameras, [mask_of(view) for view in cameras])
    normals = VertexNormals(mesh.faces, len(filled))(filled)
    turned = (normals * filled).sum(1) / np.linalg.norm(filled, axis=1) < np.cos(np.radians(45))
    assert turned.mean() < 5e-4


def test_vertices_slide_along_the_surface_and_not_off_it():
    vertices, faces = sphere_mesh(4)
    rng = np.random.default_rng(0)
    edge = np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1).mean()
    uneven = vertices + rng.uniform(-0.3, 0.3, vertices.shape) * edge
    uneven /= np.linalg.norm(uneven, axis=1, keepdims=True)
    moved = relaxed(uneven, faces)
    length = lambda v: np.linalg.norm(v[faces] - v[np.roll(faces, 1, axis=1)], axis=-1)  # noqa: E731
    assert np.quantile(length(moved), 0.01) > 1.5 * np.quantile(length(uneven), 0.01)
    assert np.abs(np.linalg.norm(moved, axis=1) - 1).max() < 0.1 * edge


def test_more_voxels_than_memory_are_refused_with_how_many_fit(cameras, monkeypatch, caplog):
    def begun(*_):
        raise LookupError

    monkeypatch.setattr("drgs_blender.reconstruct.memory_budget.total_memory", lambda: 2.0**25)
    monkeypatch.setattr(depth_fusion, "surface_maps", begun)
    sharp = [replace(view, fx=9 * view.fx) for view in cameras]
    low = np.full(3, -RADIUS)
    region = Region(np.zeros(3), 2 * RADIUS, low, -low, np.zeros((0, 3)), np.zeros((0, 3)), PIXEL)
    with pytest.raises(UsageError, match=r"GiB of voxels.*--voxels") as refused:
        depth_fusion.fuse(None, sharp, region, 1024)  # type: ignore[arg-type]
    fitting = int(re.search(r"--voxels (\d+) or less", str(refused.value))[1])  # type: ignore[index]
    with pytest.raises(LookupError):
        depth_fusion.fuse(None, sharp, region, fitting)  # type: ignore[arg-type]
    with pytest.raises(UsageError):
        depth_fusion.fuse(None, sharp, region, fitting + 2)  # type: ignore[arg-type]
    # where none are asked for, as many as fit are taken, and told
    assert depth_fusion.voxels_that_fit(sharp, region, 1024) == fitting
    assert f"gets {fitting} voxels" in caplog.text
    assert depth_fusion.voxels_that_fit(sharp, region, 20) == 20


@pytest.mark.parametrize("pixels", [-1.2, 0.8])
def test_outlines_become_those_of_the_masks(cameras, pixels):
    vertices, faces = sphere_mesh(5)
    mesh = plain_mesh((RADIUS + pixels * PIXEL) * vertices, faces)
    moved = off(fill_silhouettes(mesh, cameras, [mask_of(view) for view in cameras]))
    assert abs(moved.mean()) < 0.03 and np.abs(moved).max() < 0.06


def test_a_dent_that_outlines_show_is_filled_where_it_is(cameras):
    vertices, faces = sphere_mesh(5)
    deep = np.exp(-8 * ((vertices - (1, 0, 0)) ** 2).sum(1))  # towards +X, about half a radius wide
    mesh = plain_mesh((RADIUS - PIXEL * deep[:, None]) * vertices, faces)
    moved = off(fill_silhouettes(mesh, cameras, [mask_of(view) for view in cameras]))
    assert np.abs(moved[deep > 0.5]).mean() < 0.35 * deep[deep > 0.5].mean()
    assert np.abs(moved[deep < 0.01]).mean() < 0.03


def test_parts_that_the_mesh_lacks_do_not_inflate_the_rest(cameras):
    vertices, faces = sphere_mesh(5)
    beside = {"radius": 0.12, "middle": (0.0, 0.0, 0.88)}
    masks = [np.maximum(mask_of(view), mask_of(view, **beside)) for view in cameras]
    moved = off(fill_silhouettes(plain_mesh(RADIUS * vertices, faces), cameras, masks))
    far = vertices[:, 2] < 0.3
    assert np.abs(moved[far]).max() < 0.06 and moved.max() <= FARTHEST + 0.01


def test_what_is_around_the_object_in_the_picture_changes_nothing(cameras):
    """Pictures of which the object fills a part, and wider ones."""
    vertices, faces = sphere_mesh(4)
    mesh, add = plain_mesh((RADIUS - 0.8 * PIXEL) * vertices, faces), np.array((31, 17))
    wide = [
        replace(v, width=v.width + 2 * add[0], height=v.height + 2 * add[1], cx=v.cx + add[0], cy=v.cy + add[1])
        for v in cameras
    ]
    masks = [mask_of(view) for view in cameras]
    padded = [np.pad(mask, ((add[1], add[1]), (add[0], add[0]))) for mask in masks]
    one, other = fill_silhouettes(mesh, cameras, masks), fill_silhouettes(mesh, wide, padded)
    np.testing.assert_allclose(one, other, atol=1e-3 * PIXEL)
    assert np.abs(one - mesh.vertices).max() > 0.5 * PIXEL


def test_a_mesh_that_no_camera_sees_stays(cameras):
    vertices, faces = sphere_mesh(2)
    mesh = plain_mesh(0.1 * vertices + (0, 0, 50), faces)
    empty = [np.zeros((SIZE, SIZE), np.float32)] * len(cameras)
    assert np.array_equal(fill_silhouettes(mesh, cameras, empty), mesh.vertices)


def test_outlines_before_a_backdrop_are_as_exact_as_masks():
    """Pixels that the object covers in part count in part."""
    known, told = (silhouettes(balls(8, 128, masks=masks)) for masks in (True, False))
    assert known is not None and told is not None
    for mask, found in zip(known, told, strict=True):
        border = np.count_nonzero((mask > 0) & (mask < 1))
        assert abs(float(found.sum() - mask.sum())) < 0.1 * border
