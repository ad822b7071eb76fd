"""Masks of photographs with cameras: a ball on a patterned plane, ray-traced, whose masks are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from PIL import Image

from drgs_blender.capture.masks import stage
from drgs_blender.capture.masks.hull import Hull
from drgs_blender.capture.masks.hull_check import check_masks
from drgs_blender.capture.masks.mask_view import MaskView
from drgs_blender.capture.masks.object_box import ObjectBox, find_box
from drgs_blender.capture.pictures import Picture
from drgs_blender.capture.registration import Registration
from drgs_blender.core.errors import AssetError, Cancelled
from drgs_blender.reconstruct.readers.lens import Lens

RADIUS = 0.12
MIDDLE = np.array([0.02, -0.01, RADIUS])
LENS = Lens(160, 120, 190.0, 190.0, 80.0, 60.0, "RADIAL", (-0.03, 0.01))


@pytest.fixture
def cv2(monkeypatch):
    module = pytest.importorskip("cv2")
    monkeypatch.setattr(stage, "_PART", 150)  # small, for speed
    monkeypatch.setattr(stage, "_WHOLE", 160)
    return module


def photograph(k: int, count: int) -> tuple[MaskView, np.ndarray]:
    """View k of `count` around the ball, and its true mask."""
    angle, height = 2 * math.pi * k / count, (0.45, 0.9)[k % 2]
    back = np.array([math.cos(angle) * math.cos(height), math.sin(angle) * math.cos(height), math.sin(height)])
    right = np.cross([0, 0, 1.0], back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.stack([right, np.cross(back, right), back], 1), back + np.array([0, 0, RADIUS])
    view = MaskView(f"photo_{k}.png", np.zeros((120, 160, 3), np.uint8), matrix, LENS)
    rays = view.rays()
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    eye = view.centre - MIDDLE
    along = -rays @ eye
    inside = RADIUS**2 - (eye @ eye - along**2)
    mask = inside > 0
    ground = view.on_ground()
    cells = np.nan_to_num(np.floor(ground / 0.04)).astype(int)
    pattern = np.random.default_rng(1).integers(60, 255, (64, 64, 3))
    view.pixels[:] = np.where(np.isfinite(ground[..., :1]), pattern[cells[..., 0] % 64, cells[..., 1] % 64], 200)
    normal = (view.centre + (along - np.sqrt(np.maximum(inside, 0)))[..., None] * rays - MIDDLE) / RADIUS
    view.pixels[mask] = (np.array([45, 30, 25]) * (1 + 0.4 * normal[..., 2:]))[mask]
    return view, mask


def scene(count: int = 10) -> tuple[list[MaskView], list[np.ndarray]]:
    views, masks = zip(*(photograph(k, count) for k in range(count)), strict=True)
    return list(views), list(masks)


def ball_points(count: int = 400) -> np.ndarray:
    random = np.random.default_rng(3)
    on_ball = random.normal(size=(count, 3))
    on_ball = MIDDLE + RADIUS * on_ball / np.linalg.norm(on_ball, axis=1, keepdims=True)
    ground = np.column_stack([random.uniform(-1, 1, (count, 2)), random.normal(scale=1e-3, size=count)])
    return np.vstack([on_ball, ground, [[0.3, 0.3, 0.6]]])


def half(mask: np.ndarray) -> np.ndarray:
    """The mask without more than its left half."""
    return mask & (np.arange(mask.shape[1]) >= np.nonzero(mask)[1].mean() + 8)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def written(tmp_path, views: list[MaskView], points: np.ndarray) -> tuple[Registration, dict[str, Picture]]:
    found = Registration({}, {}, {}, {}, points, np.zeros((len(points), 3), np.uint8), "", [])
    pictures = {}
    for view in views:
        Image.fromarray(view.pixels).save(tmp_path / view.name)
        found.matrices[view.name], found.lenses[view.name] = view.matrix, view.lens
        pictures[view.name] = Picture(tmp_path / view.name, view.name[:-4], size=view.shape[::-1])
    return found, pictures


def run(tmp_path, mode, found, pictures, given=None, cancelled=lambda: False):
    return stage.make_or_check(
        mode, found, pictures, tmp_path, tmp_path / "made", tmp_path / "sheet.png", given, "set", lambda *_: None,
        cancelled,
    )  # fmt: skip


def test_rays_and_projection_are_inverse():
    view, _ = photograph(3, 12)
    places = view.centre + 0.8 * view.rays().reshape(-1, 3)
    at, depth = view.project(places)
    rows, columns = np.mgrid[:120, :160] + 0.5
    np.testing.assert_allclose(at, np.stack([columns, rows], -1).reshape(-1, 2), atol=1e-6)
    assert (depth > 0).all()
    part = view.cropped((40, 20, 120, 100), 160)
    np.testing.assert_allclose(part.project(places)[0], 2 * (at - [40, 20]), atol=1e-6)


def test_the_box_holds_the_ball_without_ground_and_strays():
    views, _ = scene()
    box = find_box(ball_points(), np.stack([view.matrix for view in views]))
    assert (box.low <= MIDDLE - RADIUS).all() and (box.high >= MIDDLE + np.array([1, 1, 0.9]) * RADIUS).all()
    assert (box.high - box.low).max() < 3.2 * RADIUS and box.points[:, 2].max() < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("points", [True])
def test_masks_of_a_ball_on_a_pattern(cv2, tmp_path, points):
    views, true = scene()
    found, pictures = written(tmp_path, views, ball_points() if points else np.zeros((0, 3)))
    masked = run(tmp_path, "auto", found, pictures)
    assert not any(fit.doubtful for fit in masked.fits) and (tmp_path / "sheet.png").is_file()
    scores = [iou(np.asarray(Image.open(pictures[v.name].mask)) > 127, mask) for v, mask in zip(views, true)]
    assert np.mean(scores) > 0.92 and min(scores) > 0.85
    first = {name: picture.mask.read_bytes() for name, picture in pictures.items()}
    run(tmp_path, "auto", found, pictures)
    assert first == {name: picture.mask.read_bytes() for name, picture in pictures.items()}


def test_a_wrong_mask_is_found_among_right_ones(cv2):
    views, true = scene()
    masks = [half(mask) if k == 4 else mask for k, mask in enumerate(true)]
    box = ObjectBox(MIDDLE - 0.16, MIDDLE + 0.16, np.zeros((0, 3)))
    fits = check_masks(cv2, views, masks, Hull(cv2, views, masks, box, 48))
    assert [fit.name for fit in fits if fit.doubtful] == ["photo_4.png"] and fits[4].missing > 0.4


@pytest.mark.slow
def test_a_given_mask_that_cuts_the_object_is_refused(cv2, tmp_path):
    views, true = scene()
    masks = [half(mask) if k == 4 else mask for k, mask in enumerate(true)]
    found, pictures = written(tmp_path, views, ball_points())
    given = tmp_path / "given"
    given.mkdir()
    for view, mask in zip(views, masks, strict=True):
        Image.fromarray(mask.astype(np.uint8) * 255).save(given / f"{view.name}.png")
    with pytest.raises(AssetError, match=r"photo_4\.png .*hull missing"):
        run(tmp_path, "given", found, pictures, given)
    Image.fromarray(true[4].astype(np.uint8) * 255).save(given / "photo_4.png.png")
    masked = run(tmp_path, "given", found, pictures, given)
    assert len(masked.fits) == 10 and not any(fit.doubtful for fit in masked.fits)


def test_no_masks_are_made_unless_asked(tmp_path):
    views, _ = scene(5)
    found, pictures = written(tmp_path, views, ball_points())
    for mode in ("given", "none"):
        assert not run(tmp_path, mode, found, pictures).lines
    assert all(picture.mask is None for picture in pictures.values())


@pytest.mark.slow
def test_making_masks_can_be_cancelled(cv2, tmp_path):
    views, _ = scene()
    found, pictures = written(tmp_path, views, ball_points())
    with pytest.raises(Cancelled):
        run(tmp_path, "auto", found, pictures, cancelled=lambda: True)
