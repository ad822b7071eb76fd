"""The compiled surfel raster against the torch reference, at the same sub-pixel positions."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from drgs_blender.core.asset.model import PosedSurfels  # noqa: E402
from drgs_blender.core.errors import UsageError  # noqa: E402
from drgs_blender.core.frame import Camera, RenderSettings  # noqa: E402
from drgs_blender.ipc.blur import camera_on_lens  # noqa: E402
from drgs_blender.render.camera import camera_parameters, camera_ray, check_camera, lattice, pixel_shift  # noqa: E402
from drgs_blender.render.reference import raster as reference  # noqa: E402
from drgs_blender.render.surfels import raster as kernel  # noqa: E402
from drgs_blender.render.surfels.splats import prepare, to_camera  # noqa: E402

torch.set_num_threads(1)
AA = 2


def camera(orthographic: bool, region: tuple[int, int, int, int] | None = None) -> Camera:
    """4 m from the origin, tilted and rolled, with pixels that are not square."""
    a, b = math.radians(25), math.radians(10)
    pitch = np.array([[1, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]])
    roll = np.array([[math.cos(b), -math.sin(b), 0], [math.sin(b), math.cos(b), 0], [0, 0, 1]])
    matrix = np.eye(4)
    matrix[:3, :3] = pitch @ roll
    matrix[:3, 3] = 4 * pitch[:, 2]
    focal = 13.0 if orthographic else 52.0
    return Camera(matrix, 56, 44, focal, 0.9 * focal, 27.0, 23.5, orthographic, 0.1, 100.0, region)


def cloud(count: int, seed: int, size: float, spread: float) -> PosedSurfels:
    """Random surfels, sheared tangents; shading normals lie within 40 degrees of +Z, some of them turned over."""
    rng = np.random.default_rng(seed)
    frame = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    u = frame[:, 0] * size * rng.uniform(0.3, 1.5, (count, 1))
    v = frame[:, 1] * size * rng.uniform(0.3, 1.5, (count, 1)) + 0.4 * u
    normal = np.array([0, 0, 1.0]) + 0.55 * rng.uniform(-1, 1, (count, 3)) * (1, 1, 0)
    normal *= rng.choice([-1, 1], (count, 1), p=[0.2, 0.8]) / np.linalg.norm(normal, axis=1, keepdims=True)
    arrays = (
        rng.uniform(-spread, spread, (count, 3)), u, v, normal, rng.uniform(0.05, 1.0, count),
        rng.random((count, 3)), rng.random(count), rng.random(count),
    )  # fmt: skip
    return PosedSurfels(*(np.ascontiguousarray(a, np.float32) for a in arrays), np.zeros(count, np.int32))


SCENES = {
    "large": lambda: cloud(150, 1, 0.25, 1.0),
    "small": lambda: cloud(800, 2, 0.02, 1.0),
    "dense": lambda: cloud(300, 3, 0.12, 0.7),
    "fog": lambda: cloud(1500, 6, 0.3, 1.0),
    "around the camera": lambda: cloud(200, 4, 0.3, 5.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("orthographic", [False, True], ids=["perspective", "orthographic"])
@pytest.mark.parametrize("scene", SCENES)
def test_g_buffer(scene: str, orthographic: bool):
    posed, view = SCENES[scene](), camera(orthographic)
    parameters = camera_parameters(view, RenderSettings(subpixel_samples=AA, seed=5), 7)
    found = kernel.rasterise(prepare(posed, view, parameters), 0, view.height)

    position = np.empty((view.height, view.width, AA, 2))
    for y, x in np.ndindex(view.height, view.width):
        shift = pixel_shift(parameters, y * view.width + x)
        for k in range(AA):
            position[y, x, k] = np.float32(np.add((x, y), lattice(*shift, k, parameters)))
    splats = reference.Splats.from_posed(posed)
    place = torch.from_numpy(position.reshape(-1, 2))
    with torch.no_grad():
        truth = reference.rasterise(splats, view, place, kernel.GAP, samples=AA)

    coverage, depth = found.alpha.reshape(-1), found.depth.reshape(-1)
    surface = found.surface.reshape(-1, 9)
    expected = truth.coverage.numpy()
    assert (expected > 0).mean() > 0.1
    # Rounding may take a contribution across its threshold (1/255), no more than one here and there.
    difference = np.abs(coverage - expected)
    assert difference.max() < 1.5 / 255
    assert (difference > 1e-4).mean() < 2e-3

    seen = (expected > 1e-2) & (coverage > 1e-2)
    # The kernel leaves the side of the normal to the stage that knows the mesh.
    rays = reference.camera_rays(view, place)[1].numpy()[seen]
    surface = surface[seen]
    away = (surface[:, 0:3] * rays).sum(1, keepdims=True) > 0
    values = {
        "depth": (depth[seen], truth.depth),
        "normal": (np.where(away, -surface[:, 0:3], surface[:, 0:3]), truth.normal),
        "albedo": (surface[:, 3:6], truth.albedo),
        "roughness": (surface[:, 6], truth.roughness),
        "metallic": (surface[:, 7], truth.metallic),
    }
    for name, (mine, other) in values.items():
        off = np.abs(mine - other.numpy()[seen]).reshape(seen.sum(), -1).max(1)
        # A jump of the depth close to the limit, or two equal depths, may be decided otherwise.
        assert (off > 1e-3).mean() < 5e-3, name
        assert np.median(off) < 2e-5, name


def test_points_are_where_the_rays_of_a_place_on_the_lens_meet_them():
    view = camera_on_lens(camera(True), (0.3, -0.2), 2.0)
    parameters, matrix = camera_parameters(view, RenderSettings(), 1), np.asarray(view.matrix_world)
    for direction in np.random.default_rng(5).normal(size=(20, 3)):
        right, down, forward = to_camera(parameters, *direction)
        assert matrix[:3, :3] @ (right, -down, -forward) == pytest.approx(direction, abs=1e-12)
    x, y = view.cx + 0.7 * view.fx, view.cy - 0.4 * view.fy
    ray = np.array(camera_ray(parameters, x, y)).reshape(2, 3)
    sharp = np.asarray(camera(True).matrix_world)
    assert ray[0] + 2.0 * ray[1] == pytest.approx((sharp @ (0.7, 0.4, -2.0, 1))[:3], abs=1e-12)
    with pytest.raises(UsageError, match="scales or shears"):
        check_camera(replace(view, orthographic=False))
