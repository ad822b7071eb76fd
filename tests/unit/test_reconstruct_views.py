"""Training views cropped to the object: they teach what whole pictures teach."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("skimage")

from capture_cases import balls  # noqa: E402

from drgs_blender.reconstruct.backend import CPU  # noqa: E402
from drgs_blender.reconstruct.capture import training_views  # noqa: E402
from drgs_blender.reconstruct.capture.capture import Capture, View  # noqa: E402
from drgs_blender.reconstruct.capture.training_views import composed, half_size, pixel_rays, targets  # noqa: E402
from drgs_blender.reconstruct.meshing import depth_fusion  # noqa: E402
from drgs_blender.reconstruct.meshing.crops import cropped, cropped_views  # noqa: E402
from drgs_blender.reconstruct.meshing.visual_hull import find_region, world_to_pixel  # noqa: E402
from drgs_blender.reconstruct.model.initialisation import FEWEST, MOST, PER_PIXEL, on_hull, surfel_limit  # noqa: E402
from drgs_blender.reconstruct.optim.learner import Learner  # noqa: E402
from drgs_blender.reconstruct.optim.schedule import Schedule  # noqa: E402

SIDE, AROUND = 64, (70, 33)


def on_a_larger_film(view: View) -> View:
    """The photograph with a black border, wider to the left and above."""
    (x, y), camera = AROUND, view.camera
    wider = replace(
        camera, width=camera.width + 2 * x - 3, height=camera.height + 2 * y - 4, cx=camera.cx + x, cy=camera.cy + y
    )
    border = ((y, y - 4), (x, x - 3))
    return replace(view, camera=wider, colour=np.pad(view.colour, (*border, (0, 0))), mask=np.pad(view.mask, border))


@pytest.fixture(scope="module")
def capture() -> Capture:
    small = balls(size=SIDE)
    return replace(small, views=[on_a_larger_film(view) for view in small.views])


def test_crops_hold_the_object_and_its_rays(capture):
    for view, full, half in zip(capture.training, *targets(capture), strict=True):
        camera, colour, rays = view.camera, composed(view, capture), pixel_rays(view.camera).numpy()
        x, y = round(camera.cx - full.camera.cx), round(camera.cy - full.camera.cy)
        there = np.s_[y : y + full.camera.height, x : x + full.camera.width]
        assert full.share == full.camera.width * full.camera.height / (camera.width * camera.height) < 0.6
        outside = np.ones(colour.shape[:2], bool)
        outside[there] = False
        assert not colour[outside].any() and not view.mask[outside].any()
        np.testing.assert_array_equal(full.colour.numpy(), colour[there])
        np.testing.assert_array_equal(full.mask.numpy(), view.mask[there])
        np.testing.assert_array_equal(pixel_rays(full.camera).numpy(), rays[there])
        # half of the crop is the crop of the half
        halves, (h, w) = half_size(colour), half.colour.shape[:2]
        np.testing.assert_array_equal(half.colour.numpy(), halves[y // 2 : y // 2 + h, x // 2 : x // 2 + w])
        assert (half.camera.cx, half.camera.width, half.share) == (full.camera.cx / 2, w, full.share)


def test_views_without_masks_or_without_the_object_are_left_whole(capture):
    first, *others = capture.training
    empty = replace(first, mask=np.zeros_like(first.mask), colour=np.zeros_like(first.colour))
    full, _ = targets(replace(capture, views=[empty, *others]))
    assert full[0].camera == first.camera and full[0].share == 1
    white = replace(capture, background=None, views=[replace(view, mask=None) for view in capture.views])
    assert all(target.camera == view.camera for target, view in zip(targets(white)[0], white.training, strict=True))


def test_a_crop_teaches_what_the_whole_picture_teaches(capture, monkeypatch):
    """Gradients of all losses, and the error that is shown."""
    cropped = targets(capture)[0][0]
    monkeypatch.setattr(training_views, "LEAST_MARGIN", 1000)
    whole = targets(capture)[0][0]
    assert whole.share == 1 and whole.camera.width > 1.5 * cropped.camera.width
    region = find_region(capture)
    surfels = on_hull(capture, region, 4000, 2)
    behind = torch.zeros(3)
    found = []
    for target in (whole, cropped):
        learner = Learner(surfels, Schedule(), region.radius, behind, CPU)
        learner.optimiser.step = learner.light.step = lambda parameters, rates: None
        learner.step(target, 0.5)
        found.append((learner.gaussians.parameters, learner.statistics, learner.error))
    (wide, counted, error), (narrow, also_counted, also_error) = found
    assert also_error == pytest.approx(error, rel=1e-5)
    np.testing.assert_array_equal(counted.views, also_counted.views)
    pairs = {name: (value.grad, narrow[name].grad) for name, value in wide.items() if name != "blur"}  # light is grey
    for name, (one, other) in (pairs | {"pull": (counted.gradient, also_counted.gradient)}).items():
        # the consistency of normals is a mean without the outermost pixels: 1.7 % of its own
        assert (one - other).norm() < 0.02 * one.norm(), name


def test_larger_pictures_get_more_surfels_and_short_runs_fewer(capture):
    full, half = targets(capture)
    shown = np.mean([target.mask.sum() for target in full])
    assert surfel_limit(full) == int(PER_PIXEL * shown) == pytest.approx(4 * surfel_limit(half), rel=0.02)
    assert surfel_limit(full, 100) == 100
    large = [replace(target, mask=torch.ones(1000, 1000)) for target in full]
    assert surfel_limit(large) == MOST and surfel_limit(large, 100_000) == 100_000
    few, some, many = (surfel_limit(large, seconds=seconds) for seconds in (1.0, 300.0, 1e5))
    assert FEWEST == few < some < many == MOST


def test_fusion_draws_what_pictures_show_of_the_region_and_finds_the_same_mesh(capture: Capture, monkeypatch) -> None:
    region, cameras = find_region(capture), [view.camera for view in capture.training]
    surfels = on_hull(capture, region, 3000, 0)
    drawn = cropped(cameras, region.low, region.high)
    (size,) = {(camera.width, camera.height) for camera in drawn}
    assert size[0] * size[1] < 0.5 * cameras[0].width * cameras[0].height
    corner = np.array([*itertools.product(*zip(region.low, region.high, strict=True))])
    for whole, cut in zip(cameras, drawn, strict=True):
        seen = np.c_[corner, np.ones(8)] @ world_to_pixel(cut).T
        assert (seen[:, :2] / seen[:, 2:] >= 0).all() and (seen[:, :2] / seen[:, 2:] <= size).all()
        assert (whole.cx - cut.cx) % 1 == 0 and whole.fx == cut.fx
    with_crops, _ = depth_fusion.fuse(surfels, cameras, region, 64)
    monkeypatch.setattr(depth_fusion, "cropped", lambda whole, *_: whole)
    without, _ = depth_fusion.fuse(surfels, cameras, region, 64)
    assert np.array_equal(with_crops.faces, without.faces)
    np.testing.assert_allclose(with_crops.vertices, without.vertices, atol=1e-4)


def test_a_camera_inside_the_region_draws_all_that_it_sees(capture: Capture) -> None:
    outside = capture.training[0].camera
    inside = replace(outside, matrix_world=np.eye(4))
    found = cropped([inside, outside], np.full(3, -1.0), np.full(3, 1.0))
    assert (found[0].width, found[0].height) == (found[1].width, found[1].height) == (outside.width, outside.height)


def test_cropped_views_show_the_same_pixels(capture: Capture) -> None:
    points = np.array([[-0.9, -0.5, -0.5], [0.9, 0.6, 0.7]])
    for whole, cut in zip(capture.views, cropped_views(capture.views, points), strict=True):
        assert cut.colour.size < whole.colour.size and cut.colour.shape[:2] == cut.mask.shape
        near = pixel_rays(cut.camera)[5, 7], cut.colour[5, 7], cut.mask[5, 7]
        y, x = 5 + round(whole.camera.cy - cut.camera.cy), 7 + round(whole.camera.cx - cut.camera.cx)
        torch.testing.assert_close(near[0], pixel_rays(whole.camera)[y, x])
        assert np.array_equal(near[1], whole.colour[y, x]) and near[2] == whole.mask[y, x]
