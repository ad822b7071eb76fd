"""Masks that may be wrong at their outlines: a band on either side of these teaches nothing."""

from __future__ import annotations

import json
from dataclasses import replace

import captures
import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("skimage")

from capture_cases import balls  # noqa: E402

from drgs_blender.reconstruct import checkpoint  # noqa: E402
from drgs_blender.reconstruct.backend import CPU  # noqa: E402
from drgs_blender.reconstruct.capture.training_views import GREY, Target, full_targets, half_target, near_outline  # noqa: E402
from drgs_blender.reconstruct.losses.photometric import Photograph  # noqa: E402
from drgs_blender.reconstruct.meshing.depth_fusion import fuse  # noqa: E402
from drgs_blender.reconstruct.meshing.visual_hull import find_region  # noqa: E402
from drgs_blender.reconstruct.model.initialisation import on_hull  # noqa: E402
from drgs_blender.reconstruct.optim.learner import Learner  # noqa: E402
from drgs_blender.reconstruct.optim.schedule import Schedule  # noqa: E402
from drgs_blender.reconstruct.pipeline import mesh_of  # noqa: E402
from drgs_blender.reconstruct.readers import read_capture  # noqa: E402

SIDE, BAND = 48, 2.0


def with_band(band: float, size: int = SIDE):
    capture = balls(size=size)
    return replace(capture, views=[replace(view, mask_band=band) for view in capture.views])


def gradients(target: Target, surfels, radius: float, beside: Target | None = None) -> dict[str, torch.Tensor]:
    """Of a step's parameters, and the error of the picture as "error"."""
    learner = Learner(surfels, Schedule(patches=0.0 if beside is None else 1.0), radius, torch.tensor(GREY), CPU)
    learner.optimiser.step = learner.light.step = lambda parameters, rates: None  # type: ignore[method-assign]
    learner.step(target, 0.5, beside)
    found = {name: value.grad for name, value in learner.gaussians.parameters.items() if value.grad is not None}
    return found | {"error": torch.tensor(learner.error)}


def other_photograph(target: Target, where: torch.Tensor) -> Target:
    """The target with another picture and the opposite mask at some pixels."""
    assert target.mask is not None
    noise = torch.rand(target.colour.shape, generator=torch.Generator().manual_seed(3))
    colour = torch.where(where[..., None], noise, target.colour)
    return replace(
        target, photograph=Photograph.of(colour.numpy()), mask=torch.where(where, 1 - target.mask, target.mask)
    )


def test_the_band_is_as_wide_as_said_on_either_side_of_the_outline():
    (target, *_), (exact, *_) = full_targets(with_band(BAND)), full_targets(with_band(0.0))
    assert exact.unknown is None and target.unknown is not None and target.mask is not None
    inside, unknown = target.mask.numpy() > 0.5, target.unknown.numpy()
    y, x = np.indices(inside.shape)
    for one, others in ((inside, ~inside), (~inside, inside)):
        apart = np.sqrt((y[one, None] - y[others]) ** 2 + (x[one, None] - x[others]) ** 2).min(axis=1)
        np.testing.assert_array_equal(unknown[one], apart <= BAND)
    half = half_target(target)
    assert half.unknown is not None
    h, w = half.unknown.shape
    fours = unknown[: 2 * h, : 2 * w].reshape(h, 2, w, 2).any(axis=(1, 3))
    np.testing.assert_array_equal(half.unknown.numpy(), fours)


def test_parts_that_are_no_wider_than_the_band_teach():
    """Else nothing would be known of them in any view."""
    mask = np.zeros((40, 60), np.float32)
    mask[5:25, 5:25] = 1  # a block with a bar, and a bar of its own
    mask[12:16, 25:50] = 1
    mask[30:34, 5:50] = 1
    unknown = near_outline(mask, BAND)
    assert not unknown[12:16, 30:50].any() and not unknown[30:34, 5:50].any()
    assert unknown[10:12, 30:50].all() and unknown[34:36, 5:50].all()
    assert unknown[5:7, 8:22].all() and not unknown[8:22, 8:22].any()


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_views_without_an_outline_have_no_band(value):
    capture = with_band(BAND)
    capture.training[0].mask = np.full_like(capture.training[0].mask, value)
    target = full_targets(capture)[0]
    assert target.unknown is not None and not target.unknown.any()


def test_what_photograph_and_mask_are_within_the_band_teaches_nothing():
    capture = with_band(BAND)
    region = find_region(capture)
    surfels = on_hull(capture, region, 3000, 2)
    target, near, *_ = full_targets(capture)
    assert target.unknown is not None
    for beside in (near, None):
        known = gradients(target, surfels, region.radius, beside)
        other = gradients(other_photograph(target, target.unknown), surfels, region.radius, beside)
        for name, value in known.items():
            np.testing.assert_array_equal(value, other[name], name)
    # beside the band they do, and without one everywhere
    for changed in (
        other_photograph(target, torch.roll(target.unknown, 9, 1) & ~target.unknown),
        other_photograph(replace(target, unknown=None), target.unknown),
    ):
        assert (gradients(changed, surfels, region.radius)["opacity"] - known["opacity"]).abs().max() > 0


def test_a_mesh_is_not_fitted_to_outlines_that_may_be_wrong():
    wide = with_band(BAND)
    for view in wide.views:  # the object would be larger by these
        view.mask = np.maximum.reduce([np.roll(view.mask, step, axis) for axis in (0, 1) for step in (-1, 0, 1)])
    region, cameras = find_region(wide), [view.camera for view in wide.training]
    surfels = on_hull(wide, region, 3000, 0)
    fused, _ = fuse(surfels, cameras, region, 48)
    np.testing.assert_array_equal(mesh_of(surfels, wide, region, 48)[0].vertices, fused.vertices)
    exact = replace(wide, views=[replace(view, mask_band=0.0) for view in wide.views])
    assert np.abs(mesh_of(surfels, exact, region, 48)[0].vertices - fused.vertices).max() > 0


def test_what_is_kept_of_a_run_belongs_to_its_band():
    assert len({checkpoint.fingerprint(with_band(band, 16)) for band in (0.0, 1.0, 2.0)}) == 3


def test_the_band_is_read_in_pixels_of_the_photographs_and_no_less_than_one_of_what_is_learned_from(tmp_path):
    file = captures.write_nerf(captures.make(tmp_path, 6))
    text = json.loads(file.read_text())
    said = (3.0, 0, None, -1.0, "wide", True)
    for frame, band in zip(text["frames"], said, strict=True):
        frame["mask_band"] = band
    file.write_text(json.dumps(text))
    width = read_capture(tmp_path).views[0].camera.width
    for resolution, found in ((None, 3.0), (width // 2, 1.5), (width // 6, 1.0)):
        bands = [view.mask_band for view in read_capture(tmp_path, resolution=resolution).views]
        assert bands[0] == pytest.approx(found, rel=0.03) and not any(bands[1:])
