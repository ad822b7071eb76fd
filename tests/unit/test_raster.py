"""The CPU raster against the torch oracle, analytic cases, and its promises (order, gaps, independence of strips)."""

from __future__ import annotations

import numpy as np
import pytest

from drgs_blender.asset.model import PosedSurfels
from drgs_blender.frame import Camera, RenderSettings
from drgs_blender.render import raster
from drgs_blender.render.camera import camera_parameters, sample_ray

FIELDS = ("centre", "tangent_u", "tangent_v", "normal", "opacity", "albedo", "roughness", "metallic", "object_index")


def look_along_y(width: int, height: int, distance: float = 4.0, focal: float | None = None, **more: object) -> Camera:
    """A camera on the negative Y axis that looks along +Y with +Z up."""
    matrix = np.eye(4)
    matrix[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    matrix[1, 3] = -distance
    focal = focal or float(width)
    return Camera(matrix, width, height, focal, focal, width / 2, height / 2, **more)  # type: ignore[arg-type]


def surfels(centre: object, u: object, v: object, **values: object) -> PosedSurfels:
    """Surfels with the given scaled tangents; the normal is that of the plane."""
    centre, u, v = (np.atleast_2d(np.asarray(a, np.float32)) for a in (centre, u, v))
    n = len(centre)
    u, v = np.broadcast_to(u, (n, 3)), np.broadcast_to(v, (n, 3))
    normal = np.cross(u, v)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    defaults = {"opacity": 0.9, "albedo": (0.5, 0.5, 0.5), "roughness": 0.5, "metallic": 0.0}
    data = {k: np.asarray(values.get(k, d), np.float32) for k, d in defaults.items()}
    shapes = {"opacity": (n,), "albedo": (n, 3), "roughness": (n,), "metallic": (n,)}
    data = {k: np.ascontiguousarray(np.broadcast_to(a, shapes[k])) for k, a in data.items()}
    index = np.ascontiguousarray(np.broadcast_to(np.asarray(values.get("object_index", 0), np.int32), (n,)))
    return PosedSurfels(
        np.ascontiguousarray(centre),
        np.ascontiguousarray(u),
        np.ascontiguousarray(v),
        normal.astype(np.float32),
        object_index=index,
        **data,
    )


def join(*parts: PosedSurfels) -> PosedSurfels:
    return PosedSurfels(*(np.concatenate([getattr(p, f) for p in parts]) for f in FIELDS))


def random_surfels(n: int, seed: int = 0, size: float = 0.05) -> PosedSurfels:
    """Skewed surfels of all orientations in a ball of radius one."""
    rng = np.random.default_rng(seed)
    centre = rng.normal(size=(n, 3))
    centre *= (rng.random((n, 1)) ** (1 / 3)) / np.linalg.norm(centre, axis=1, keepdims=True)
    u, v = rng.normal(size=(2, n, 3)) * size
    return surfels(
        centre,
        u,
        v,
        opacity=rng.uniform(0.02, 1.0, n),
        albedo=rng.random((n, 3)),
        roughness=rng.random(n),
        metallic=rng.random(n),
        object_index=rng.integers(0, 3, n),
    )


def render(posed: PosedSurfels, camera: Camera, aa: int = 1, seed: int = 3) -> raster.SurfelSamples:
    p = camera_parameters(camera, RenderSettings(aa=aa, seed=seed), 7)
    return raster.rasterise(raster.prepare(posed, camera, p), camera.window[1], camera.window[3])


def sample_positions(camera: Camera, aa: int, seed: int = 3) -> np.ndarray:
    """(h, w, aa, 2) pixel positions of all samples, from the rays the renderer shoots."""
    p = camera_parameters(camera, RenderSettings(aa=aa, seed=seed), 7)
    x0, y0, x1, y1 = camera.window
    matrix = np.asarray(camera.matrix_world)
    out = np.empty((y1 - y0, x1 - x0, aa, 2))
    for y in range(y0, y1):
        for x in range(x0, x1):
            for k in range(aa):
                ray = np.array(sample_ray(p, y * camera.width + x, k))
                local = matrix[:3, :3].T @ ray[3:]
                if camera.orthographic:
                    local = matrix[:3, :3].T @ (ray[:3] - matrix[:3, 3])
                out[y - y0, x - x0, k] = (
                    camera.cx + camera.fx * local[0],
                    camera.cy - camera.fy * local[1],
                )
    return out


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("size", [0.002, 0.05, 0.5])
def test_agrees_with_the_torch_oracle(monkeypatch: pytest.MonkeyPatch, orthographic: bool, size: float) -> None:
    reference = pytest.importorskip("drgs_blender.render.reference.raster")
    camera = look_along_y(40, 32, focal=12.0 if orthographic else 44.0, orthographic=orthographic, clip_start=0.1)
    # So few large ones that no contribution is more than a window out of order; see the test of the window itself.
    posed = random_surfels(400 if size < 0.1 else 50, size=size)
    posed.normal[:, 1] = -2.0  # shading normals that face the camera and agree with each other
    posed.normal /= np.linalg.norm(posed.normal, axis=1, keepdims=True)
    mine = render_without_gaps(posed, camera, aa=2)
    positions = sample_positions(camera, 2)
    import torch

    oracle = reference.rasterise(reference.Splats.from_posed(posed), camera, torch.as_tensor(positions.reshape(-1, 2)))
    coverage = oracle.coverage.numpy().reshape(mine.alpha.shape)
    # A contribution at exactly 1/255 may fall on either side of the threshold.
    assert np.abs(mine.alpha - coverage).max() < 1.2 / 255
    assert np.quantile(np.abs(mine.alpha - coverage), 0.99) < 1e-4
    seen = coverage > 0.1
    assert seen.mean() > 0.02
    for got, want in (
        (mine.depth, oracle.depth),
        (mine.surface[..., 3], oracle.albedo[:, 0]),
        (mine.surface[..., 6], oracle.roughness),
        (mine.surface[..., 7], oracle.metallic),
        (mine.surface[..., 0], oracle.normal[:, 0]),
    ):
        error = np.abs(got - want.numpy().reshape(got.shape))[seen]
        assert np.quantile(error, 0.98) < 2e-3, np.quantile(error, [0.5, 0.9, 0.98, 1.0])


def render_without_gaps(posed: PosedSurfels, camera: Camera, aa: int) -> raster.SurfelSamples:
    """Blend as the paper does, one mean over all contributions: sizes so large that no gap is one."""
    p = camera_parameters(camera, RenderSettings(aa=aa, seed=3), 7)
    splats = raster.prepare(posed, camera, p)
    splats.surface[:, 9] = 1e6
    return raster.rasterise(splats, camera.window[1], camera.window[3])
