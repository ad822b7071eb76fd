"""The surfel raster: closed forms, order, depth gaps, clipping, independence of strips. Oracle: test_parity_raster."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drgs_blender.core.asset.model import PosedSurfels
from drgs_blender.core.errors import UsageError
from drgs_blender.core.frame import Camera, RenderSettings
from drgs_blender.render.camera import camera_parameters, lattice, pixel_shift
from drgs_blender.render.surfels import raster
from drgs_blender.render.surfels import splats as screen

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
    data = {k: np.array(np.broadcast_to(a, shapes[k])) for k, a in data.items()}
    index = np.ascontiguousarray(np.broadcast_to(np.asarray(values.get("object_index", 0), np.int32), (n,)))
    return PosedSurfels(
        np.ascontiguousarray(centre),
        np.array(u),
        np.array(v),
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


def render(
    posed: PosedSurfels, camera: Camera, subpixels: int = 1, seed: int = 3, **more: float
) -> raster.SurfelSamples:
    p = camera_parameters(camera, RenderSettings(subpixel_samples=subpixels, seed=seed, **more), 7)
    return raster.rasterise(screen.prepare(posed, camera, p), camera.window[1], camera.window[3])


def sample_positions(camera: Camera, subpixels: int, seed: int = 3, **more: float) -> np.ndarray:
    """(h, w, subpixels, 2) pixel positions of the samples of `render`."""
    p = camera_parameters(camera, RenderSettings(subpixel_samples=subpixels, seed=seed, **more), 7)
    x0, y0, x1, y1 = camera.window
    out = np.empty((y1 - y0, x1 - x0, subpixels, 2))
    for y, x, k in np.ndindex(*out.shape[:3]):
        shift = pixel_shift(p, (y0 + y) * camera.width + x0 + x)
        out[y, x, k] = np.add((x0 + x, y0 + y), lattice(*shift, k, p))
    return out


@pytest.mark.parametrize("width", [0.0, 1.5, 4.0])
@pytest.mark.parametrize("orthographic", [False, True])
def test_one_surfel_is_the_gaussian_it_should_be(orthographic: bool, width: float) -> None:
    camera = look_along_y(60, 50, distance=4, focal=20.0 if orthographic else 80.0, orthographic=orthographic)
    # Sheared tangents in the plane y = 0, depth 4; 1 m is 20 pixels there.
    u, v = np.array([0.3, 0, 0.1]), np.array([0.1, 0, 0.4])
    got = render(surfels([[0.1, 0, -0.2]], u, v, opacity=0.8), camera, subpixels=2, filter_width=width)
    at = sample_positions(camera, 2, filter_width=width)
    offset = np.stack([(at[..., 0] - 30) / 20 - 0.1, -(at[..., 1] - 25) / 20 + 0.2], -1)
    uv = offset @ np.linalg.inv(np.array([u[[0, 2]], v[[0, 2]]]))
    expected = 0.8 * np.exp(-0.5 * (uv**2).sum(-1))
    inside = expected >= 1 / 255
    assert np.allclose(got.alpha[inside], expected[inside], atol=2e-5)
    assert (got.alpha[expected < 0.999 / 255] == 0).all()
    assert np.allclose(got.depth[got.alpha > 0], 4, atol=1e-5)
    assert np.allclose(got.surface[got.alpha > 0][:, 8], np.hypot(0.1, 0.4), atol=1e-6)


@pytest.mark.parametrize("subpixels", [1, 4, 16])
def test_the_low_pass_follows_the_sampling_rate(subpixels: int) -> None:
    camera = look_along_y(31, 31)
    dot = surfels([[0, 0, 0]], [1e-5, 0, 0], [0, 0, 1e-5], opacity=1.0)
    got = render(dot, camera, subpixels)
    distance2 = ((sample_positions(camera, subpixels) - 15.5) ** 2).sum(-1)
    expected = np.minimum(np.exp(-subpixels * distance2), 0.99)
    expected[np.exp(-subpixels * distance2) < 1 / 255] = 0
    assert np.allclose(got.alpha, expected, atol=2e-5)
    if subpixels == 16:  # its image has the integral of the filter, pi / subpixels square pixels
        assert abs(got.alpha.mean(-1).sum() - np.pi / subpixels) < 0.3 * np.pi / subpixels


@pytest.mark.parametrize("subpixels", [4, 16])
def test_a_ball_is_as_large_as_it_is(subpixels: int) -> None:
    """The many surfels edge-on along its outline do not widen it."""
    camera = look_along_y(40, 40, focal=15.0, orthographic=True)
    k = np.arange(6000) + 0.5
    z, turn = 1 - k / 3000, k * np.pi * (3 - 5**0.5)
    normal = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], 1)
    u = np.cross(normal, np.where(np.abs(z[:, None]) < 0.9, [[0.0, 0, 1]], [[1.0, 0, 0]]))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    ball = surfels(normal, 0.03 * u, 0.03 * np.cross(normal, u), opacity=0.95)
    radius = np.sqrt(render(ball, camera, subpixels).alpha.mean(-1).sum() / np.pi)
    # The filter blurs the edge by 0.7 / sqrt(subpixels) pixels, and where surfels overlap more than half of that is
    # opaque.
    assert abs(radius - 15) < 0.6 / np.sqrt(subpixels)


@pytest.mark.parametrize("tilt", [0.0, 1e-3, 0.05])
def test_a_surfel_fades_as_it_turns_edge_on(tilt: float) -> None:
    """Narrower than the filter, it shows the filter, weakened by the cosine."""
    got = render(
        surfels([[0, 0, 0]], [0.02 * tilt, 0.02, 0], [0, 0, 1e-4], opacity=0.9),
        look_along_y(41, 41),
        subpixels=16,
    )
    peak = 0.9 * tilt / np.hypot(tilt, 1)
    assert (got.alpha == 0).all() if peak < 1 / 255 else 0.3 * peak < got.alpha.max() <= 1.01 * peak


def plane_of_surfels(y: float, half: float, spacing: float, sigma: float, **values: object) -> PosedSurfels:
    """A grid of surfels that faces the camera of `look_along_y`, covering |x|, |z| <= half."""
    line = np.arange(-half, half + 1e-9, spacing)
    x, z = (a.ravel() for a in np.meshgrid(line, line))
    return surfels(np.stack([x, np.full_like(x, y), z], -1), [sigma, 0, 0], [0, 0, sigma], **values)


@pytest.mark.parametrize("subpixels", [1, 4, 16])
def test_small_surfels_count_by_their_area(subpixels: int) -> None:
    """Stripes of coarse black and of fine white surfels, all smaller than the filter, are grey and opaque."""
    stripes = []
    for k in range(-20, 20):
        spacing, white = (0.02, 1.0) if k % 2 else (0.06, 0.0)
        across = 0.06 * k + np.arange(0, 0.06 - 1e-9, spacing) + spacing / 2
        x, z = (a.ravel() for a in np.meshgrid(across, np.arange(-1.2, 1.2, spacing) + spacing / 2))
        sigma = 0.8 * spacing
        stripes.append(
            surfels(np.stack([x, 0 * x, z], -1), [sigma, 0, 0], [0, 0, sigma], opacity=0.99, albedo=(white,) * 3)
        )
    camera = look_along_y(24, 24, focal=8 / subpixels**0.5, orthographic=True)
    got = render(join(*stripes), camera, subpixels)
    half = int(4 / subpixels**0.5)
    inside = slice(12 - half, 12 + half)
    assert got.alpha[inside, inside].min() > 0.99
    assert abs(got.surface[inside, inside, :, 3].mean() - 0.5) < 0.04


@pytest.mark.slow
def test_a_front_edge_does_not_bleed_into_the_back_surface() -> None:
    camera = look_along_y(64, 64, distance=4)
    front = plane_of_surfels(-1.0, 0.5, 0.05, 0.04, albedo=(1, 0, 0), roughness=0.1, object_index=1)
    back = plane_of_surfels(1.0, 3.0, 0.08, 0.06, albedo=(0, 0, 1), roughness=0.9, object_index=2)
    both = join(front, back)
    got = render(both, camera, subpixels=4)
    depth, owner = got.depth, got.object_index
    assert (got.alpha > 0.95).all()
    # Every sample lies on one of the surfaces, none between, and everything about it is of that surface.
    assert (np.minimum(np.abs(depth - 3), np.abs(depth - 5)) < 1e-3).all()
    assert np.array_equal(owner == 1, depth < 4)
    assert np.allclose(got.surface[..., 3], owner == 1, atol=1e-5)
    assert np.allclose(got.surface[..., 6], np.where(owner == 1, 0.1, 0.9), atol=1e-4)
    # The blend without clusters has what the clusters prevent.
    blended = render_without_gaps(both, camera, subpixels=4)
    assert ((blended.depth > 3.2) & (blended.depth < 4.8)).sum() > 100
    assert np.array_equal(blended.alpha, got.alpha)
    # The heavier surface wins: the edge lies where the front surface covers half.
    alone = render(front, camera, subpixels=4).alpha
    assert np.array_equal((owner == 1)[np.abs(alone - 0.5) > 0.01], (alone > 0.5)[np.abs(alone - 0.5) > 0.01])


def render_without_gaps(posed: PosedSurfels, camera: Camera, subpixels: int) -> raster.SurfelSamples:
    """Blend as the paper does, one mean over all contributions: sizes so large that no gap is one."""
    p = camera_parameters(camera, RenderSettings(subpixel_samples=subpixels, seed=3), 7)
    splats = screen.prepare(posed, camera, p)
    splats.surface[:, screen.SIZE] = 1e6
    return raster.rasterise(splats, camera.window[1], camera.window[3])


def test_intersecting_surfels_are_ordered_where_the_ray_meets_them() -> None:
    """Two planes cross like an X; sorted by centre alone one would lie before the other everywhere."""
    camera = look_along_y(40, 40, distance=4, orthographic=True, focal=20)
    rising = surfels([[0, 0.01, 0]], [0.7, 0.7, 0], [0, 0, 1], albedo=(1, 0, 0), opacity=0.99)
    falling = surfels([[0, -0.01, 0]], [0.7, -0.7, 0], [0, 0, 1], albedo=(0, 1, 0), opacity=0.99)
    red = render_without_gaps(join(rising, falling), camera, subpixels=1).surface[20, :, 0, 3]
    assert red[12:18].min() > 0.5 > red[22:28].max()


@pytest.mark.slow
def test_fog_of_any_depth_is_blended_in_exact_order() -> None:
    """A thousand faint tilted sheets on every ray, listed by centre in an order that differs on both sides of it."""
    rng = np.random.default_rng(9)
    n, opacity = 1000, 0.012
    camera = look_along_y(8, 8, distance=4, orthographic=True, focal=4)
    tilt, middle, red = rng.uniform(-0.6, 0.6, n), rng.uniform(-1, 1, n), rng.random(n)
    u = np.stack([np.full(n, 1e4), 1e4 * tilt, np.zeros(n)], -1)
    centre = np.stack([np.zeros(n), middle, np.zeros(n)], -1)
    albedo = np.stack([red, red, red], -1)
    sheets = surfels(centre, u, [0, 0, 1e4], opacity=opacity, albedo=albedo)
    got = render_without_gaps(sheets, camera, subpixels=2)
    at = sample_positions(camera, 2)
    x = (at[..., 0] - 4) / 4
    depth = 4 + middle + tilt * x[..., None]
    order = np.argsort(depth, axis=-1, kind="stable")
    left = (1 - opacity) ** np.arange(n + 1)
    counted = left[:-1] >= 1e-4
    weight = np.where(counted, opacity * left[:-1], 0.0)
    assert 700 < counted.sum() < n  # more than a list has room for at first, and some behind opacity
    assert np.allclose(got.alpha, weight.sum(), atol=1e-5)
    assert np.allclose(got.surface[..., 3], (weight * red[order]).sum(-1) / weight.sum(), atol=1e-4)
    sorted_depth = np.take_along_axis(depth, order, -1)
    assert np.allclose(got.depth, (weight * sorted_depth).sum(-1) / weight.sum(), atol=1e-4)


def test_what_full_lists_drop_is_hidden() -> None:
    """Hundreds of strong sheets, of which a ray may meet the last one first: full lists are cut only behind opacity."""
    n = 400
    camera = look_along_y(8, 8, distance=4, orthographic=True, focal=4)
    k = np.arange(n)
    # Centres far to the left, ever deeper; on the right of the picture the sheets lie in reverse order.
    tilt = -0.0028 * k
    centre = np.stack([np.full(n, -4.0), -2 + 0.01 * k, np.zeros(n)], -1)
    u = np.stack([np.full(n, 1e4), 1e4 * tilt, np.zeros(n)], -1)
    red = k / n
    sheets = surfels(centre, u, [0, 0, 1e4], opacity=0.1, albedo=np.stack([red, red, red], -1))
    got = render_without_gaps(sheets, camera, subpixels=1)
    x = (sample_positions(camera, 1)[..., 0] - 4) / 4
    depth = 2 + 0.01 * k + tilt * (x[..., None] + 4)
    order = np.argsort(depth, axis=-1, kind="stable")
    left = 0.9 ** np.arange(n)
    weight = np.where(left >= 1e-4, 0.1 * left, 0.0)
    expected = (weight * red[order]).sum(-1) / weight.sum()
    assert 60 < (weight > 0).sum() < 120
    clipped = (depth <= camera.clip_start).any(-1)
    assert not clipped.any()
    assert np.allclose(got.surface[..., 3], expected, atol=1e-3)
    assert np.allclose(got.alpha, weight.sum(), atol=1e-5)


def test_the_order_of_the_input_does_not_matter() -> None:
    posed = random_surfels(300, seed=5)
    turned = PosedSurfels(*(np.ascontiguousarray(getattr(posed, f)[::-1]) for f in FIELDS))
    camera = look_along_y(48, 40)
    a, b = render(posed, camera, subpixels=2), render(turned, camera, subpixels=2)
    assert np.array_equal(a.alpha, b.alpha)
    seen = a.alpha > 0
    assert np.array_equal(a.surface[seen], b.surface[seen])


@pytest.mark.parametrize("width", [0.0, 3.0])
def test_rows_and_regions_are_crops_of_the_picture(width: float) -> None:
    posed = random_surfels(500, seed=6)
    camera = look_along_y(70, 61)
    whole = render(posed, camera, subpixels=3, filter_width=width)
    p = camera_parameters(camera, RenderSettings(subpixel_samples=3, seed=3, filter_width=width), 7)
    splats = screen.prepare(posed, camera, p)
    for y0, y1 in ((0, 1), (5, 38), (31, 61), (60, 61)):
        part = raster.rasterise(splats, y0, y1)
        assert np.array_equal(part.alpha, whole.alpha[y0:y1])
        seen = part.alpha > 0
        assert np.array_equal(part.surface[seen], whole.surface[y0:y1][seen])
    camera.region = (13, 7, 50, 41)
    part = render(posed, camera, subpixels=3, filter_width=width)
    assert np.array_equal(part.alpha, whole.alpha[7:41, 13:50])
    seen = part.alpha > 0
    assert np.array_equal(part.depth[seen], whole.depth[7:41, 13:50][seen])


def test_unusable_surfels_are_left_out() -> None:
    good = random_surfels(50, seed=7)
    bad = random_surfels(50, seed=8)
    for i, field in enumerate(("centre", "tangent_u", "tangent_v")):
        getattr(bad, field)[i * 10 : i * 10 + 10, i] = (np.nan, np.inf, -np.inf, np.nan, np.inf) * 2
    bad.opacity[30:40] = np.nan
    bad.opacity[40:45] = 0.0
    bad.centre[45:50, 1] = -40.0  # behind the camera
    camera = look_along_y(40, 40)
    with_bad, alone = render(join(good, bad), camera), render(good, camera)
    assert np.array_equal(with_bad.alpha, alone.alpha)
    assert np.isfinite(with_bad.surface[with_bad.alpha > 0]).all()


def test_no_surfels() -> None:
    nothing = surfels(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3)))
    assert (render(nothing, look_along_y(9, 7)).alpha == 0).all()


def test_clipping() -> None:
    near, far = plane_of_surfels(-2.0, 1, 0.1, 0.08), plane_of_surfels(1.0, 2, 0.1, 0.08)
    camera = look_along_y(32, 32, distance=4, clip_start=3.0, clip_end=100.0)
    got = render(join(near, far), camera)
    assert np.allclose(got.depth[got.alpha > 0], 5, atol=1e-3)
    camera.clip_start, camera.clip_end = 0.1, 4.5
    got = render(join(near, far), camera)
    assert np.allclose(got.depth[got.alpha > 0], 2, atol=1e-3)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"fx": 0.0}, "focal lengths"),
        ({"fy": float("nan")}, "focal lengths"),
        ({"cx": float("nan")}, "principal point"),
        ({"cy": float("inf")}, "principal point"),
        ({"width": 0}, "pixels"),
        ({"width": 10**6}, "pixels"),
        ({"clip_start": 0.0}, "clip start"),
        ({"clip_end": 1e-4}, "clips from"),
        ({"region": (5, 5, 5, 9)}, "region"),
        ({"region": (0, 0, 33, 8)}, "region"),
        ({"matrix_world": np.diag([2.0, 1, 1, 1])}, "scales or shears"),
        ({"matrix_world": np.full((4, 4), np.nan)}, "matrix is not"),
    ],
)
def test_cameras_that_cannot_see_are_refused(change: dict[str, object], named: str) -> None:
    camera = replace(look_along_y(32, 32), **change)
    with pytest.raises(UsageError, match=f"camera: .*{named}"):
        camera_parameters(camera, RenderSettings(), 1)


@pytest.mark.parametrize("subpixels", [1, 2, 3, 4, 7, 16])
def test_sub_pixel_positions_are_stratified_and_uniform(subpixels: int) -> None:
    camera = look_along_y(48, 48)
    at = sample_positions(camera, subpixels) % 1.0
    assert (at >= 0).all() and (at < 1).all()
    assert np.abs(at.mean(axis=(0, 1)) - 0.5).max() < 0.05  # each sample number alone is uniform
    assert np.abs(np.sort(at.reshape(-1, 2), axis=0).mean(0) - 0.5).max() < 0.02
    gaps = np.diff(np.sort(at[..., 0], axis=2), axis=2)
    if subpixels > 1:  # evenly spaced along x
        assert np.abs(gaps - 1 / subpixels).max() < 0.01
    other = sample_positions(camera, subpixels, seed=4) % 1.0
    assert np.abs(other - at).mean() > 0.1


@pytest.mark.parametrize("width", [0.5, 1.5, 4.0])
def test_the_pixel_filter_is_the_window_of_blackman_and_harris(width: float) -> None:
    camera = look_along_y(64, 64)
    centre = np.stack(np.meshgrid(np.arange(64), np.arange(64)), -1)[:, :, None] + 0.5
    off = (sample_positions(camera, 16, filter_width=width) - centre) / (2 * width)
    assert np.abs(off).max() <= 0.5
    a = np.array([0.35875, 0.48829, 0.14128, 0.01168])
    x = np.linspace(-0.45, 0.45, 19)
    k = 2 * np.pi * np.arange(1, 4)
    below = 0.5 + x + (a[1:] / k * np.sin(np.outer(x, k))).sum(1) / a[0]
    for axis in range(2):
        found = (off[..., axis].reshape(-1, 1) < x).mean(0)
        assert np.abs(found - below).max() < 2e-3
    gaps = np.diff(np.sort(off[..., 0], axis=2), axis=2)
    assert gaps.min() > 0.01  # still stratified


@pytest.mark.parametrize("width", [-1.0, 11.0, float("nan")])
def test_pixel_filters_that_do_not_exist_are_refused(width: float) -> None:
    with pytest.raises(UsageError, match="pixel filter"):
        camera_parameters(look_along_y(32, 32), RenderSettings(filter_width=width), 1)
