"""Multi-view patch consistency, against plain tensor operations in double precision and on a textured plane."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from capture_cases import balls  # noqa: E402

from drgs_blender.core.frame import Camera  # noqa: E402
from drgs_blender.reconstruct.capture.capture import View  # noqa: E402
from drgs_blender.reconstruct.capture.neighbours import LEAST, MOST, NEIGHBOURS, neighbours  # noqa: E402
from drgs_blender.reconstruct.capture.training_views import pixel_rays  # noqa: E402
from drgs_blender.reconstruct.gpu.losses import patch_loss as reference  # noqa: E402
from drgs_blender.reconstruct.losses.patches import Pair, patch_loss  # noqa: E402
from drgs_blender.reconstruct.meshing.visual_hull import find_region  # noqa: E402
from drgs_blender.reconstruct.optim.schedule import Schedule  # noqa: E402
from drgs_blender.reconstruct.optim.train import Training  # noqa: E402

NORMAL = np.array([0.2, -0.9, 0.35]) / np.linalg.norm([0.2, -0.9, 0.35])


def camera(away: tuple[float, float, float], width: int = 40, height: int = 36) -> Camera:
    """Looks at the origin."""
    z = np.array(away) / np.linalg.norm(away)
    x = np.cross([0.0, 0, 1], z)
    x /= np.linalg.norm(x)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.stack([x, np.cross(z, x), z], -1), away
    return Camera(matrix, width, height, 60.0, 57.0, 0.53 * width, 0.48 * height)


HERE, BESIDE = camera((0.0, -4.0, 1.0)), camera((1.2, -3.9, 0.7), 44, 38)


def plane(view: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Depth of the plane through the origin, and grey of a smooth pattern on it, of each pixel."""
    rays, eye = pixel_rays(view).double().numpy(), view.matrix_world[:3, 3]
    depth = -(eye @ NORMAL) / (rays @ NORMAL)
    x, y, z = np.moveaxis(eye + depth[..., None] * rays, -1, 0)
    grey = 0.5 + 0.2 * np.sin(5 * x + 1) * np.cos(4 * z) + 0.2 * np.sin(3 * x - 6 * z + y)
    return depth.astype(np.float32), grey.astype(np.float32)


def given(seed: int = 0) -> dict:
    """All that the loss takes, with errors in depth and normals, holes and a place that the other view hides."""
    rng = np.random.default_rng(seed)
    (depth, grey), (behind, other) = plane(HERE), plane(BESIDE)
    depth = depth * (1 + 0.003 * rng.normal(size=depth.shape))
    depth[4:9, 20:26] = 0
    behind[20:26, 5:15] *= 0.8
    normal = NORMAL + 0.05 * rng.normal(size=(*depth.shape, 3))
    normal *= rng.uniform(0.4, 1, (*depth.shape, 1))
    counts = rng.uniform(0, 1, depth.shape)
    counts[12] = 0
    as_float = lambda a: torch.tensor(np.asarray(a), dtype=torch.float32)  # noqa: E731
    return {
        "depth": as_float(depth), "normal": as_float(normal), "counts": as_float(counts), "rays": pixel_rays(HERE),
        "greys": (as_float(grey), as_float(other)), "behind": as_float(behind), "pair": Pair.of(HERE, BESIDE),
        "spread": 0.1,
    }  # fmt: skip


def compiled(depth, normal, counts, rays, greys, behind, pair, spread):
    grey, other = (g.numpy() for g in greys)
    return patch_loss(depth, normal, counts.numpy(), rays.numpy(), (grey, other), behind.numpy(), pair, spread)


def test_value_and_gradients():
    values = given()
    doubled = {k: v.double() if isinstance(v, torch.Tensor) else v for k, v in values.items()}
    doubled["greys"] = tuple(g.double() for g in values["greys"])
    found = {}
    for name, work, inputs in (("mine", compiled, values), ("plain", reference, doubled)):
        depth, normal = (inputs[k].clone().requires_grad_() for k in ("depth", "normal"))
        loss = work(**inputs | {"depth": depth, "normal": normal})
        (3 * loss).backward()
        found[name] = float(loss.detach()), depth.grad, normal.grad
    assert found["mine"][0] == pytest.approx(found["plain"][0], rel=1e-4)
    assert found["mine"][0] > 0.001
    for mine, plain in zip(found["mine"][1:], found["plain"][1:], strict=True):
        assert float(plain.abs().max()) > 0
        torch.testing.assert_close(mine.double(), plain, rtol=1e-2, atol=1e-3 * float(plain.abs().max()))


def flat(shift: float, tilt: float) -> tuple[torch.Tensor, torch.Tensor, dict]:
    """The plane moved away by `shift` metres of depth and turned by `tilt` radians."""
    (depth, grey), (behind, other) = plane(HERE), plane(BESIDE)
    c, s = np.cos(tilt), np.sin(tilt)
    normal = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ NORMAL
    tensor = torch.from_numpy
    moved = tensor(depth + np.float32(shift)).requires_grad_()
    turned = torch.tensor(np.broadcast_to(normal, (*depth.shape, 3)), dtype=torch.float32).requires_grad_()
    rest = {
        "counts": torch.ones(depth.shape), "rays": pixel_rays(HERE), "greys": (tensor(grey), tensor(other)),
        "behind": tensor(behind + np.float32(shift)), "pair": Pair.of(HERE, BESIDE),
        "spread": 0.1,
    }  # fmt: skip
    return moved, turned, rest


def test_the_true_plane_costs_nothing_and_others_are_drawn_to_it():
    def loss(shift: float, tilt: float) -> tuple[float, float]:
        depth, normal, rest = flat(shift, tilt)
        value = compiled(depth, normal, **rest)
        value.backward()
        return float(value.detach()), float(depth.grad.sum())

    best, _ = loss(0, 0)
    for shift in (-0.1, 0.1):
        value, slope = loss(shift, 0)
        assert value > 2 * best
        assert slope * shift > 0
    assert min(loss(0, 0.3)[0], loss(0, -0.3)[0]) > 1.2 * best


def test_places_that_look_different_from_elsewhere_count_less():
    depth, normal, rest = flat(0.1, 0)
    same = float(compiled(depth, normal, **rest).detach())
    grey, other = rest["greys"]
    rest["greys"] = grey, other + 0.2
    # NCC does not see brightness: what is left is the weight.
    assert 0 < float(compiled(depth, normal, **rest).detach()) < 0.05 * same
    assert float(compiled(depth, normal, **rest | {"spread": 0.0}).detach()) == pytest.approx(same, rel=0.1)


def test_neighbours_have_parallax_and_views_without_are_named(caplog):
    angles = np.radians([0, 1, 10, 20, 30, 180])
    views = [View(f"view-{k}", camera((3 * np.sin(a), -3 * np.cos(a), 0.5)), None) for k, a in enumerate(angles)]
    near = neighbours(views, np.zeros(3))
    (said,) = caplog.messages
    assert "1 of 6 photographs (view-5)" in said and "Take them 2 to 45 degrees apart around the object" in said
    assert near[0] == [2, 3, 4]
    assert near[5] == []
    assert all(len(found) <= NEIGHBOURS for found in near)
    caplog.clear()
    neighbours(views[:5], np.zeros(3))
    assert not caplog.messages
    assert LEAST < MOST


def test_training_with_patches_goes_on_bit_for_bit(caplog):
    capture = balls(count=40, size=40)
    del capture.views[16:]  # from above, close to each other
    region = find_region(capture)
    schedule = Schedule(iterations=12, surfels=600, rounds=1, median=0.5, patches=0.5, patches_from=0.2)
    whole, plain = (Training(capture, region, s) for s in (schedule, replace(schedule, patches=0.0)))
    assert not caplog.messages  # all have neighbours
    for _ in range(8):
        whole.step(), plain.step()
    resumed = Training(capture, region, schedule)
    resumed.restore(whole.arrays())
    for _ in range(2):
        whole.step(), resumed.step(), plain.step()
    there, again = whole.arrays(), resumed.arrays()
    for name in there.keys() - {"numbers"}:  # the time spent
        np.testing.assert_array_equal(there[name], again[name], err_msg=name)
        assert np.isfinite(there[name]).all()
    assert not np.array_equal(there["value.centre"], plain.arrays()["value.centre"])
