"""The mesh of a signed distance field: of a ball, known exactly, and of parts that matter or do not."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from drgs_blender.core.errors import AssetError
from drgs_blender.geometry.tsdf import DepthMaps, SignedDistanceField, main_parts

VOXEL, SIDE = 0.05, 50
LOW = np.full(3, -0.5 * VOXEL * (SIDE - 1))
AWAY, SIZE, FOCAL = 4.0, 100, 160.0


def ball_seen(back: np.ndarray, perspective: bool, precision: type) -> DepthMaps:
    """A view of the unit ball from `back`, by pixels of about a voxel at the ball."""
    right = np.roll(back, 1)
    axes = np.stack([right, -np.cross(back, right), -back])
    x, y = (np.mgrid[:SIZE, :SIZE][::-1] + 0.5 - SIZE / 2) / FOCAL
    if perspective:  # rays (x, y, 1) from the eye
        a, b = x * x + y * y + 1, -AWAY
        root = b * b - a * (AWAY**2 - 1)
        depth = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
        cosine = np.sqrt(np.maximum(root, 0) / a)
        scale = FOCAL
    else:
        inside = 1 - (AWAY * x) ** 2 - (AWAY * y) ** 2
        cosine = np.sqrt(np.maximum(inside, 0))
        depth = np.where(inside > 0, AWAY - cosine, np.inf)
        scale = FOCAL / AWAY
    cosine = np.where(np.isfinite(depth), cosine, 1)
    if perspective:  # q of a view is its pixel times depth
        axes[:2] += SIZE / 2 / FOCAL * axes[2]
    offset = [0.0, 0.0, 0.0] if perspective else [SIZE / 2, SIZE / 2, 0.0]
    return DepthMaps(
        depth[None].astype(precision), cosine[None].astype(precision), AWAY * back[None], axes[None],
        np.array([[scale, scale, 1.0]]), np.array([offset]), perspective, bilinear=perspective,
    )  # fmt: skip


def fused(perspective: bool, precision: type, views: int) -> SignedDistanceField:
    """Of views spread evenly over a sphere."""
    field = SignedDistanceField(LOW, VOXEL, (SIDE, SIDE, SIDE))
    for k in range(views):
        z, angle = 1 - (2 * k + 1) / views, np.pi * (1 + 5**0.5) * k
        back = np.array([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z])
        frame = np.linalg.qr(np.column_stack([back, np.eye(3)[:, :2]]))[0]
        frame *= np.sign(frame[:, 0] @ back)
        field.add(_turned(ball_seen(np.array([1.0, 0, 0]), perspective, precision), frame))
    return field


def _turned(maps: DepthMaps, frame: np.ndarray) -> DepthMaps:
    """The same view of the ball, from another side."""
    return DepthMaps(
        maps.depth, maps.cosine, maps.origin @ frame.T, np.ascontiguousarray(maps.axes @ frame.T), maps.scale,
        maps.offset, maps.perspective, maps.bilinear,
    )  # fmt: skip


@pytest.mark.parametrize("precision", [np.float32, np.float64])
@pytest.mark.parametrize("perspective", [True, False])
def test_depth_maps_of_a_ball_make_a_closed_ball(perspective, precision):
    mesh, report = fused(perspective, precision, 40).mesh(1, 0.7, "")
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.is_watertight and solid.is_winding_consistent
    assert report["volume"] == pytest.approx(solid.volume)
    off = np.linalg.norm(mesh.vertices, axis=1) - 1
    assert abs(off.mean()) < 0.5 * VOXEL and np.abs(off).max() < VOXEL


def test_what_too_few_views_see_is_inside():
    """Of eight views, those that look along the surface or from behind do not count."""
    field = fused(False, np.float64, 8)
    alone, carved = field.mesh(1, 0.7, "")[1]["volume"], field.mesh(5, 0.7, "")[1]["volume"]
    assert carved > 1.1 * alone


def test_a_field_that_nothing_was_seen_of_encloses_all_and_free_space_nothing():
    field = SignedDistanceField(LOW, VOXEL, (SIDE, SIDE, SIDE))
    assert field.mesh(1, 0.7, "")[1]["volume"] == pytest.approx((VOXEL * SIDE) ** 3, rel=0.1)
    free = ball_seen(np.array([1.0, 0, 0]), False, np.float64)
    free.depth[:], free.cosine[:] = np.inf, 1
    field.add(free)
    with pytest.raises(AssetError, match=r"enclose no volume.*Try again"):
        field.mesh(1, 0.7, "Try again")


@pytest.mark.parametrize("flipped", [False, True])
def test_crumbs_and_cavities_are_dropped_and_faces_turned_outwards(flipped):
    body = trimesh.creation.icosphere(3)
    crumb = trimesh.creation.icosphere(1, radius=0.05).apply_translation((3, 0, 0))
    second = trimesh.creation.icosphere(2, radius=0.5).apply_translation((-3, 0, 0))
    cavity = trimesh.creation.icosphere(2, radius=0.5)
    cavity.invert()
    parts = [crumb, body, cavity, second]
    every = trimesh.util.concatenate(parts)
    faces = every.faces[:, ::-1] if flipped else every.faces
    vertices, kept, dropped, volume = main_parts(every.vertices, faces)
    solid = trimesh.Trimesh(vertices, kept, process=False)
    assert dropped == 2 and kept.dtype == np.int32 and len(vertices) == len(body.vertices) + len(second.vertices)
    assert volume == pytest.approx(body.volume + second.volume) == pytest.approx(solid.volume)
