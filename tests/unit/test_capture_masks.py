"""Masks of photographs with cameras: a ball on a patterned plane, ray-traced, whose masks are known."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from PIL import Image

from drgs_blender.capture.masks import settling, stage
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
    pytest.importorskip("torch")
    from drgs_blender.capture.masks import making
    from drgs_blender.capture.masks.learned_scene import Effort

    # small, for speed
    monkeypatch.setattr(making, "EFFORTS", (Effort(64, 150, 5000), Effort(96, 400, 6000)))
    monkeypatch.setattr(making, "PART", 150)
    monkeypatch.setattr(settling, "_WHOLE", 160)
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


def test_masks_are_learned_as_finely_as_photographs_show_the_object_within_bounds():
    pytest.importorskip("torch")
    from drgs_blender.capture.masks.learned_scene import Effort

    fine = Effort(64, 150, 5000, 96)
    assert [fine.fitting(shown).size for shown in (10, 64, 80.4, 96, 4000)] == [64, 64, 80, 96, 96]
    assert Effort(64, 150, 5000).fitting(4000) == Effort(64, 150, 5000)


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
@pytest.mark.parametrize("points", [True, False])
def test_masks_of_a_ball_on_a_pattern(cv2, tmp_path, points):
    views, true = scene()
    found, pictures = written(tmp_path, views, ball_points() if points else np.zeros((0, 3)))
    masked = run(tmp_path, "auto", found, pictures)
    assert not any(fit.doubtful for fit in masked.fits) and (tmp_path / "sheet.png").is_file()
    scores = [iou(np.asarray(Image.open(pictures[v.name].mask)) > 127, mask) for v, mask in zip(views, true)]
    assert np.mean(scores) > 0.92 and min(scores) > 0.85
    bands = [picture.mask_band for picture in pictures.values()]
    assert 1 <= min(bands) <= max(bands) < 1.5, "learned almost as finely as photographed"
    first = {name: picture.mask.read_bytes() for name, picture in pictures.items()}
    run(tmp_path, "auto", found, pictures)
    assert first == {name: picture.mask.read_bytes() for name, picture in pictures.items()}


def test_straightening_and_distorting_are_inverse():
    cv2 = pytest.importorskip("cv2")
    view, mask = photograph(3, 12)
    view.pixels[:] = np.where(mask[..., None], 255, 0)
    straight = view.straightened(cv2, 160)
    back = view.distorted(cv2, view.pinhole(160), straight.pixels[..., 0].astype(np.float32)) > 127
    assert iou(back, mask) > 0.985
    at, _ = view.project(view.centre + 0.7 * straight.rays()[30:33, 20:23].reshape(-1, 3))
    assert np.abs(at - np.stack(np.mgrid[30:33, 20:23][::-1], -1).reshape(-1, 2) - 0.5).max() > 0.2  # distortion


def test_behind_the_object_is_the_ground():
    cv2 = pytest.importorskip("cv2")
    from drgs_blender.capture.masks.ground_picture import GroundPicture

    views, masks = scene(16)
    box = ObjectBox(MIDDLE - np.array([0.2, 0.2, RADIUS]), MIDDLE + 0.2, np.zeros((0, 3)))
    ground = GroundPicture(cv2, views, box)
    view, mask = views[3], masks[3]
    nothing = np.zeros(2), np.zeros(2)
    behind = ground.without_object(view, box.outline(cv2, view), nothing)
    assert np.array_equal(behind[~box.outline(cv2, view)], view.pixels[~box.outline(cv2, view)] / np.float32(255))
    # the upper half of the ball, which hides ground that other views see
    upper = mask & (np.arange(120)[:, None] < np.nonzero(mask)[0].mean())
    assert view.pixels[upper].max() < 80 and np.median(behind[upper]) > 0.4
    learned = ground.without_object(view, box.outline(cv2, view), (box.low[:2], box.high[:2]))
    foot = view.project(np.array([[0.1, -0.15, 0.0]]))[0][0].astype(int)
    assert len(np.unique(learned[foot[1] - 2 : foot[1] + 3, foot[0] - 2 : foot[0] + 3].reshape(-1, 3), axis=0)) == 1


def strewn(low: list[float], high: list[float], count: int) -> np.ndarray:
    return np.random.default_rng(7).uniform(low, high, (count, 3))


def test_the_object_is_what_stands_on_the_ground_and_is_connected():
    pytest.importorskip("torch")
    from drgs_blender.capture.masks.object_surfels import box_around, cut_object
    from drgs_blender.reconstruct.model.gaussians import Gaussians

    tilted = strewn([-0.6, -0.6, 0], [0.6, 0.6, 0], 4000)
    tilted[:, 2] = 0.02 * tilted[:, 0] + np.random.default_rng(8).normal(scale=4e-4, size=len(tilted))
    body = strewn([-0.1, -0.1, 0.01], [0.1, 0.1, 0.4], 1500)
    tail = strewn([0.1, -0.02, 0.012], [0.2, 0.02, 0.02], 300)  # it lies on the ground
    stray = strewn([0.25, 0.25, 0.3], [0.26, 0.26, 0.31], 3)
    places = np.concatenate([tilted, body, tail, stray])
    scene = Gaussians.on_surface(places, np.tile([0.0, 0, 1], (len(places), 1)), np.full_like(places, 0.5), 0.006, 0)
    box = ObjectBox(np.array([-0.25, -0.25, 0]), np.array([0.25, 0.25, 0.5]), np.zeros((0, 3)))
    cut = cut_object(scene, box)
    ground, rest = cut.surfels[:4000], cut.surfels[4000:]
    beside = (tilted[:, 0] < -0.12) | (tilted[:, 0] > 0.22) | (np.abs(tilted[:, 1]) > 0.12)
    assert not ground[beside].any() and rest[:1800].mean() > 0.98 and not rest[1800:].any() and 0 < cut.noise < 2e-3
    found = box_around(scene, cut, box.points)
    assert (
        -0.01 < found.low[2] <= 0 and (found.high >= [0.2, 0.1, 0.4]).all() and (found.high < [0.26, 0.16, 0.47]).all()
    )


def test_walls_go_on_to_the_ground_and_the_ground_beside_them_is_none_of_the_object():
    pytest.importorskip("torch")
    from drgs_blender.capture.masks.object_surfels import cut_object
    from drgs_blender.reconstruct.model.gaussians import Gaussians

    ground = strewn([-0.6, -0.6, 0], [0.6, 0.6, 0], 6000)
    ground[:, 2] += np.random.default_rng(8).normal(scale=2e-3, size=len(ground))
    wall = strewn([0.1, -0.1, 0], [0.1, 0.1, 0.4], 8000)
    post = strewn([0.4, 0.4, 0], [0.4, 0.42, 0.005], 50)  # as low as the ground is uneven, and apart
    deep = strewn([0.1, -0.1, -0.1], [0.1, 0.1, -0.05], 50)
    flat_beside = strewn([0.101, -0.1, 0], [0.104, 0.1, 0], 200)
    parts = (ground, wall, post, deep, flat_beside)
    places = np.concatenate(parts)
    facing = [[0.0, 0, 1], [1, 0, 0.1], [1, 0, 0], [1, 0, 0], [0, 0, 1]]
    normals = np.repeat(facing, [len(part) for part in parts], axis=0)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    scene = Gaussians.on_surface(places, normals, np.full_like(places, 0.5), 0.006, 0)
    box = ObjectBox(np.array([-0.25, -0.25, 0]), np.array([0.25, 0.25, 0.5]), np.zeros((0, 3)))
    cut = cut_object(scene, box)
    flat, upright, apart, below, near = np.split(cut.surfels, np.cumsum([len(part) for part in parts])[:-1])
    low = wall[:, 2] < 3 * cut.noise * 0.5
    assert low.sum() > 30 and upright[low].mean() > 0.95 and upright[~low].mean() > 0.98
    beside = (np.abs(ground[:, 0] - 0.1) > 0.03) | (np.abs(ground[:, 1]) > 0.12)  # heights are means of neighbours
    assert not flat[beside].any() and not apart.any() and not below.any() and near.mean() < 0.2


def test_a_scene_without_surfels_of_its_own_has_no_object_and_a_flat_object_has_a_box():
    pytest.importorskip("torch")
    from drgs_blender.capture.masks.object_surfels import Cut, box_around, cut_object
    from drgs_blender.reconstruct.model.gaussians import Gaussians

    places = strewn([-0.1, -0.1, -0.05], [0.1, 0.1, -0.049], 50)
    scene = Gaussians.on_surface(places, np.tile([0.0, 0, 1], (50, 1)), np.full_like(places, 0.5), 0.006, 0)
    found = box_around(scene, Cut(np.ones(50, bool), 0.0), places)
    assert -0.051 < found.low[2] < -0.049 and found.high[2] > 0
    scene.parameters["opacity"].data.fill_(-10.0)
    assert not cut_object(scene, found).surfels.any()


def test_learning_begins_with_a_limited_number_of_surfels():
    pytest.importorskip("torch")
    from drgs_blender.capture.masks.learned_scene import first_surfels
    from drgs_blender.reconstruct.capture.capture import View

    views = [View(view.name, view.pinhole(160), view.pixels / np.float32(255)) for view in scene(5)[0]]
    many = strewn([-0.1, -0.1, 0], [0.1, 0.1, 0.2], 50000)
    small = ObjectBox(MIDDLE - 0.16, MIDDLE + 0.16, many)
    begun = first_surfels(views, small)
    without = first_surfels(views, ObjectBox(small.low, small.high, np.zeros((0, 3))))
    assert len(without) + 3000 == len(begun)
    again = first_surfels(views, small)
    np.testing.assert_array_equal(begun.centres().detach().numpy(), again.centres().detach().numpy())
    # those that are known of the object take the place of sparse points
    assert len(first_surfels(views, small, begun)) == len(without) + len(begun)
    assert len(first_surfels(views, ObjectBox(small.low - 3, small.high + 3, np.zeros((0, 3))))) < 24000


def test_what_is_behind_a_view_counts_in_its_error_and_moves_with_it():
    torch = pytest.importorskip("torch")
    pytest.importorskip("warp")
    from drgs_blender.reconstruct.backend import CPU
    from drgs_blender.reconstruct.capture.training_views import Target
    from drgs_blender.reconstruct.gpu.warp_backend import WarpLearningBackend
    from drgs_blender.reconstruct.model.gaussians import Gaussians
    from drgs_blender.reconstruct.optim.learner import Learner
    from drgs_blender.reconstruct.optim.schedule import Schedule

    view = photograph(0, 4)[0]
    shown = torch.from_numpy(view.pixels / np.float32(255))
    target = Target(view.pinhole(160), shown, None, shown)
    backend = WarpLearningBackend.__new__(WarpLearningBackend)
    backend.device = torch.device("meta")
    assert backend.bring(target).background.device.type == "meta"
    out_of_sight = Gaussians.on_surface(np.array([[0, 0, 9.0]]), np.eye(3)[2:], np.ones((1, 3)), 0.01, 0)
    learner = Learner(out_of_sight, Schedule(reflections=1.0), 1.0, torch.zeros(3), CPU)
    assert learner.error_of([target]) == 0


def test_thin_parts_of_pictures_are_no_windows():
    view, _ = photograph(0, 4)
    view.lens = Lens(1600, 1200, 1900.0, 1900.0, 800.0, 600.0)
    view.pixels = np.zeros((1200, 1600, 3), np.uint8)
    box = ObjectBox(MIDDLE - 0.16, MIDDLE + 0.16, np.zeros((0, 3)))
    left, top, right, _ = box.window(view)
    view.pixels = view.pixels[: top + 12]  # the picture ends within the box
    assert right - left > 500 and box.window(view) is None
    view.pixels = np.zeros((top + 100, 1600, 3), np.uint8)
    part = view.cropped(box.window(view), 64)
    assert min(part.shape) >= 4


@pytest.mark.parametrize(
    ("views", "surfels", "said"),
    [(3, 400, "3 photographs show the object, masks need 4"), (5, 3, "no object is found on the ground"),
     (5, 400, "covers half of no pixel")],
)  # fmt: skip
def test_it_is_said_why_no_masks_are_made(cv2, tmp_path, monkeypatch, caplog, views, surfels, said):
    from drgs_blender.capture.masks import making
    from drgs_blender.reconstruct.model.gaussians import Gaussians

    places = ball_points()[:surfels]
    faint = Gaussians.on_surface(places, np.tile([0.0, 0, 1], (len(places), 1)), np.ones_like(places), 0.01, 0)
    monkeypatch.setattr(making, "prepare_kernels", lambda *_: None)
    monkeypatch.setattr(making, "learn_scene", lambda *_: faint)
    monkeypatch.setattr(making, "share_of_object", lambda *_: np.zeros((113, 150), np.float32))
    found, pictures = written(tmp_path, scene(views)[0], ball_points())
    masked = run(tmp_path, "auto", found, pictures)
    assert masked.lines == ["masks: none could be made"] and said in caplog.text and len(caplog.messages) == 1


def test_replaced_masks_are_drawn_as_they_are_used(cv2, tmp_path, monkeypatch):
    from drgs_blender.capture.masks import making

    views, true = scene()
    masks = [half(mask) if k == 4 else mask for k, mask in enumerate(true)]
    box = ObjectBox(MIDDLE - 0.16, MIDDLE + 0.16, np.zeros((0, 3)))
    windows = {k: (0, 0, *view.shape[::-1]) for k, view in enumerate(views)}
    found = making.Found(windows, views, masks, Hull(cv2, views, masks, box, 48), None, None, box)
    monkeypatch.setattr(making, "find_masks", lambda *_: found)
    drawn = []
    monkeypatch.setattr(settling, "draw_contact_sheet", lambda path, views, masks, fits: drawn.append(list(masks)))
    made, fits = making.make_masks(cv2, views, np.zeros((0, 3)), tmp_path, "set", lambda *_: None, lambda: False)
    assert made is found and fits[4].wrong and iou(made.masks[4], true[4]) > 0.75
    assert len(drawn) == 1 and np.array_equal(drawn[0][4], made.masks[4])


def test_masks_of_the_surroundings_are_not_used(cv2, tmp_path, monkeypatch, caplog):
    """As where the cameras went round a quarter of the object alone: behind it a room is as good an object."""
    from drgs_blender.capture.masks import making

    views, true = scene()
    for masks in ([~mask for mask in true], true):
        windows = {k: (0, 0, *view.shape[::-1]) for k, view in enumerate(views)}
        found = making.Found(windows, views, masks, None, None, None, None)
        monkeypatch.setattr(making, "find_masks", lambda *_, found=found: found)
        monkeypatch.setattr(making, "settle", lambda *_: (True, []))
        made, _ = making.make_masks(cv2, views, np.zeros((0, 3)), tmp_path, "set", lambda *_: None, lambda: False)
        assert made is (found if masks is true else None)
    (said,) = caplog.messages
    assert "set: what would be the object is at 100% of the pictures' edges" in said and "no masks are made" in said


def test_a_view_that_was_not_learned_from_sees_the_object(cv2):
    from drgs_blender.capture.masks.making import Found
    from drgs_blender.capture.masks.object_surfels import Cut
    from drgs_blender.reconstruct.model.gaussians import Gaussians

    normals = ball_points(2000)[:2000] - MIDDLE
    normals /= RADIUS
    ball = Gaussians.on_surface(MIDDLE + RADIUS * normals, normals, np.ones_like(normals), 0.006, 0)
    ball.parameters["opacity"].data.fill_(4.0)
    box = ObjectBox(MIDDLE - 0.16, MIDDLE + 0.16, np.zeros((0, 3)))
    found = Found({}, [], [], None, ball, Cut(np.ones(len(normals), bool), 0.0), box)
    view, true = photograph(3, 12)
    seen = found.seen_by(cv2, view)
    assert seen.dtype == np.uint8 and iou(seen > 127, true) > 0.9
    view.matrix[:3, :3] = view.matrix[:3, :3] @ np.diag([-1.0, 1, -1])  # it looks away
    assert not found.seen_by(cv2, view).any()


def test_specks_and_pinholes_are_no_part_of_a_mask():
    pytest.importorskip("torch")
    from drgs_blender.capture.masks.making import without_specks

    _, mask = photograph(2, 12)
    rows, columns = np.nonzero(mask)
    torn = mask.copy()
    torn[2:4, 2:4] = True
    torn[int(rows.mean()), int(columns.mean())] = False
    assert np.array_equal(without_specks(torn), mask) and not without_specks(mask & False).any()


class Captures:
    """Captures of the ball in a world whose Z is not up, and stand-ins of what makes their masks."""

    turned = np.array([[0, 0, 1.0, 0], [1, 0, 0, 0], [0, 1, 0, 3], [0, 0, 0, 1]])

    def __init__(self, folder, monkeypatch):
        pytest.importorskip("cv2")
        pytest.importorskip("torch")
        from drgs_blender.capture.masks import of_capture

        self.folder, self.sheet, self.of_capture = folder, folder / "sheet.png", of_capture
        self.views, self.masks = scene(6)
        self.asked: list[list[MaskView]] = []
        monkeypatch.setattr(of_capture, "make_masks", self._make)

    def _make(self, cv2, views, *_):
        self.asked.append(views)
        return self, []

    @staticmethod
    def whole(view, shape, size):
        return np.full(shape, 51 * (view % 2), np.uint8)

    @staticmethod
    def band(view):
        return 1.5 + view

    @staticmethod
    def seen_by(cv2, view):
        return np.full(view.shape, 204, np.uint8)

    def make(self, points=None, turned=turned):
        from drgs_blender.core.frame import Camera
        from drgs_blender.reconstruct.capture.capture import Capture, View

        shown = []
        for view in self.views:
            camera = Camera(turned @ view.matrix, 160, 120, 190.0, 190.0, 80.0, 60.0)
            shown.append(View(view.name, camera, view.pixels / np.float32(255)))
        points = (ball_points() if points is None else points) @ turned[:3, :3].T + turned[:3, 3]
        return Capture(self.folder, shown, None, points.astype(np.float32))

    def mask(self, capture, mode):
        """Masks of the views of a capture afterwards."""
        self.of_capture.mask_capture(capture, mode, self.sheet, lambda *_: None, lambda: False)
        return [view.mask for view in capture.views]


@pytest.fixture
def captures(tmp_path, monkeypatch):
    return Captures(tmp_path, monkeypatch)


def test_masks_of_a_capture_are_made_only_where_it_has_none(captures, caplog):
    assert captures.mask(captures.make(), "given") == [None] * 6 and not captures.asked
    given = captures.make()
    for view, true in zip(given.views, captures.masks, strict=True):
        view.mask = true.astype(np.float32)
    assert captures.mask(given, "auto")[0] is given.views[0].mask and not captures.asked and not caplog.messages
    for view in given.views[2:]:
        view.mask = None
    assert captures.mask(given, "auto")[2:] == [None] * 4 and not captures.asked
    assert "2 of 6 pictures have masks: no others are made" in caplog.text
    captures.sheet.touch()
    made = captures.mask(captures.make(), "auto")
    assert np.allclose(made[1], 0.2) and not made[0].any() and len(captures.asked) == 1
    assert not captures.sheet.exists()  # of another run
    assert all(view.mask_band == 0 for view in given.views)
    whole = captures.make()
    captures.mask(whole, "auto")
    assert [view.mask_band for view in whole.views] == [1.5, 2.5, 3.5, 4.5, 5.5, 6.5]
    captures.mask(whole, "none")
    assert not any(view.mask_band for view in whole.views)
    # upright, on the ground
    level = np.stack([view.matrix for view in captures.asked[0]])
    np.testing.assert_allclose(level[:, 2, 2], [view.matrix[2, 2] for view in captures.views], atol=1e-2)
    assert (level[:, 2, 3] > 0.2).all()


def test_given_masks_that_cut_the_object_are_named_and_drawn(captures, caplog):
    given = captures.make()
    for view, true in zip(given.views, captures.masks, strict=True):
        view.mask = true.astype(np.float32)
    captures.mask(given, "given")
    assert not caplog.messages and not captures.sheet.exists()
    rows = np.flatnonzero(given.views[2].mask.any(axis=1))
    given.views[2].mask[: rows.mean().astype(int)] = 0
    captures.mask(given, "given")
    (told,) = caplog.messages
    assert f"1 of 6 masks do not fit the others, or their cameras do not: {given.views[2].name} (" in told
    assert captures.sheet.exists()


def test_masks_and_a_background_of_one_colour_are_left_out_when_asked(captures):
    from drgs_blender.reconstruct.meshing.visual_hull import have_silhouettes

    given = captures.make()
    given.background = (1.0, 1.0, 1.0)
    for view, true in zip(given.views, captures.masks, strict=True):
        view.mask = true.astype(np.float32)
    assert have_silhouettes(given)
    assert captures.mask(given, "none") == [None] * 6 and not captures.asked and not have_silhouettes(given)


def test_masks_need_to_know_the_ground(captures, caplog):
    nothing, ground = np.zeros((0, 3)), {"ground": "marker sheet (A4)"}
    report = captures.folder / "capture.json"
    assert captures.mask(captures.make(nothing), "auto") == [None] * 6 and not captures.asked
    assert "plane on which the object stands is not known" in caplog.text and "--masks none" in caplog.text
    caplog.clear()
    # a marker sheet gives it, unless the world has been turned since
    report.write_text(json.dumps(ground))
    on_its_side = captures.turned.copy()
    on_its_side[:3, 3] = 0
    captures.mask(captures.make(nothing, on_its_side), "auto")
    assert not captures.asked and caplog.messages
    caplog.clear()
    captures.mask(captures.make(nothing, np.eye(4)), "auto")
    assert not caplog.messages
    np.testing.assert_array_equal(captures.asked[0][3].matrix, captures.views[3].matrix)
    # a ground that is only the lowest points will do, but it is said; what only the cameras guess will not
    report.write_text(json.dumps({"ground": "lowest points"}))
    captures.mask(captures.make(nothing, np.eye(4)), "auto")
    assert len(captures.asked) == 2 and "above the lowest points" in caplog.text
    report.write_text(json.dumps({"ground": "what the cameras look at"}))
    assert captures.mask(captures.make(nothing, np.eye(4)), "auto") == [None] * 6 and len(captures.asked) == 2


def test_masks_are_not_learned_from_views_left_out(captures):
    capture = captures.make()
    capture.views[1].test = capture.views[4].test = True
    made = captures.mask(capture, "auto")
    assert [view.name for view in captures.asked[0]] == [f"photo_{k}.png" for k in (0, 2, 3, 5)]
    assert [round(float(mask.max()), 2) for mask in made] == [0, 0.8, 0.2, 0, 0.8, 0.2]


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


def test_a_camera_that_looks_away_sees_nothing_of_the_hull():
    cv2 = pytest.importorskip("cv2")
    views, masks = scene()
    views[3].matrix = views[3].matrix @ np.diag([-1.0, 1, -1, 1])
    hull = Hull(cv2, views, masks, ObjectBox(MIDDLE - 0.2, MIDDLE + 0.2, np.zeros((0, 3))))
    found = check_masks(cv2, views, masks, hull)
    assert found[3].outside == 1.0 and found[3].wrong


def beside(view: MaskView, true: np.ndarray) -> np.ndarray:
    """The ground around the foot of the ball, as far as it is seen."""
    away = np.linalg.norm(np.nan_to_num(view.on_ground(), nan=9.0) - MIDDLE[:2], axis=-1)
    return (away < 1.2 * RADIUS) & ~true


@pytest.mark.parametrize("plain", [False, True])
def test_ground_that_a_mask_took_for_the_foot_of_the_object_is_told_by_neighbouring_photographs(cv2, plain):
    """Of a plain ground nothing tells it, and the mask stays."""
    from drgs_blender.capture.masks.ground_contact import shows_ground

    views, true = scene(16)
    noise = np.random.default_rng(0)
    for view in views:
        pixels = np.where(plain, 150, view.pixels) + noise.normal(0, 3, view.pixels.shape)
        view.pixels[:] = np.clip(pixels, 0, 255)
    box = ObjectBox(MIDDLE - 1.3 * RADIUS, MIDDLE + 1.3 * RADIUS, np.zeros((0, 3)))
    told, taken, wrong, kept = 0, 0, 0, 0
    for k, (view, mask) in enumerate(zip(views, true, strict=True)):
        extra = beside(view, mask)
        low = np.full(view.shape, 0.01, np.float32)  # all of it may be ground, the ball too
        found = shows_ground(cv2, views, k, mask | extra, low, box) > 0.5
        assert not found[~(mask | extra)].any()
        told, taken = told + (found & extra).sum(), taken + extra.sum()
        wrong, kept = wrong + (found & mask).sum(), kept + mask.sum()
        assert not shows_ground(cv2, [view], 0, mask | extra, low, box).any()
        high = shows_ground(cv2, views, k, mask | extra, 10 * low, box)
        assert not high.any()  # what is learned high above it is no ground
    assert taken > 500 and wrong < 0.03 * kept
    assert told < 0.03 * taken if plain else told > 0.5 * taken


def rolled(view: MaskView, quarters: int) -> MaskView:
    """The same photograph by a camera that is held turned by quarters of a turn."""
    matrix, lens = view.matrix.copy(), view.lens
    for _ in range(quarters):
        right, up = matrix[:3, 0].copy(), matrix[:3, 1].copy()
        matrix[:3, 0], matrix[:3, 1] = -up, right
        lens = Lens(lens.height, lens.width, lens.fy, lens.fx, lens.cy, lens.cx, lens.model, lens.coefficients)
    return MaskView(view.name, np.ascontiguousarray(np.rot90(view.pixels, quarters)), matrix, lens)


@pytest.mark.parametrize("quarters", [0, 1, 2])
def test_the_lower_edge_of_a_mask_stays_as_no_plane_lies_between_it_and_the_ground(cv2, quarters):
    from drgs_blender.capture.masks.ground_contact import _ABOVE, shows_ground

    upright, true = scene(16)
    views = [rolled(view, quarters) for view in upright]
    box = ObjectBox(MIDDLE - 1.3 * RADIUS, MIDDLE + 1.3 * RADIUS, np.zeros((0, 3)))
    size = float((box.high - box.low).max())
    low, high = MIDDLE * [1, 1, 0], MIDDLE * [1, 1, 0] + [0, 0, _ABOVE[0] * size]
    for k, (view, mask) in enumerate(zip(upright, true, strict=True)):
        ground = beside(view, mask)
        given = np.ascontiguousarray(np.rot90(ground, quarters))
        found = shows_ground(cv2, views, k, given, np.full(given.shape, 0.01, np.float32), box) > 0.5
        (_, bottom), (_, top) = view.project(np.stack([low, high]))[0]
        rows = max(math.ceil(bottom - top - 0.5), 1)
        edge = ground & ~np.vstack([ground[rows:], np.zeros((rows, ground.shape[1]), bool)])
        assert found.any() and found[np.rot90(edge, quarters)].mean() < 0.3  # as a mean over 3 x 3 pixels


def test_the_band_of_a_mask_is_in_pixels_of_the_photograph(cv2, monkeypatch):
    from drgs_blender.capture.masks import making

    views, _ = scene(5)
    found = making.Found({0: (0, 0, 80, 60), 1: (0, 0, 10, 10)}, [], [], None, None, None, None, [], 40)
    assert [found.band(k) for k in range(3)] == [2.0, 1.0, 1.0]
    monkeypatch.setattr(making, "make_masks", lambda *_: (found, []))
    pictures = [Picture(None, view.name, size=(size, 90)) for view, size in zip(views, (160, 640, 80, 320, 160))]
    known = Registration({}, {}, {}, {}, np.zeros((0, 3)), np.zeros((0, 3)), "", [])
    stage._learned(cv2, views, pictures, None, known, "set", lambda *_: None, lambda: False)
    assert [picture.mask_band for picture in pictures] == [2.0, 4.0, 1.0, 2.0, 1.0]
