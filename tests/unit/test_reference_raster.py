"""The torch surfel raster: image integrals, order, invariances, the low-pass, gradients."""

from __future__ import annotations

import math

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from drgs_blender.core.frame import Camera  # noqa: E402
from drgs_blender.render.reference.brdf import normalise  # noqa: E402
from drgs_blender.render.reference.raster import (  # noqa: E402
    MIN_ALPHA,
    Splats,
    camera_rays,
    intersect,
    pixel_centres,
    project,
    rasterise,
)

torch.set_num_threads(1)
F64 = torch.float64


def look(width=48, height=40, focal=60.0, orthographic=False, turn=0.0, region=None) -> Camera:
    """A camera 5 m above the origin, looking down, turned about its axis; an off-centre, non-square pixel."""
    c, s = math.cos(turn), math.sin(turn)
    matrix = np.array([[c, -s, 0, 0.1], [s, c, 0, -0.2], [0, 0, 1, 5.0], [0, 0, 0, 1.0]])
    cx, cy = width / 2 + 1.3, height / 2 - 0.7
    return Camera(matrix, width, height, focal, 0.8 * focal, cx, cy, orthographic, region=region)


def splats(n: int = 1, seed: int = 0, size: float = 0.2, spread: float = 0.8) -> Splats:
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, dtype=F64, generator=generator)

    frame = torch.linalg.qr(torch.randn(n, 3, 3, dtype=F64, generator=generator))[0]
    return Splats(
        centre=(uniform(n, 3) - 0.5) * 2 * spread,
        tangent_u=frame[:, 0] * size * (0.5 + uniform(n, 1)),
        tangent_v=frame[:, 1] * size * (0.5 + uniform(n, 1)),
        normal=frame[:, 2],
        opacity=0.3 + 0.69 * uniform(n),
        albedo=uniform(n, 3),
        roughness=uniform(n),
        metallic=uniform(n),
    )


def facing(centre=(0.0, 0.0, 0.0), su=0.2, sv=0.3, opacity=0.5) -> Splats:
    """One surfel in the plane z = const, seen head-on by `look`."""

    def row(*values: float) -> torch.Tensor:
        return torch.tensor([values], dtype=F64)

    one = torch.tensor([0.5], dtype=F64)
    tangents = row(su, 0, 0), row(0, sv, 0)
    return Splats(row(*centre), *tangents, row(0, 0, 1), one * 2 * opacity, row(0.2, 0.4, 0.6), one, one)


def join(*parts: Splats) -> Splats:
    return Splats(*(torch.cat([getattr(p, name) for p in parts]) for name in Splats.__dataclass_fields__))


def assert_same(a, b, tolerance: float = 1e-9) -> None:
    for name in a.__dataclass_fields__:
        torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=0, atol=tolerance, msg=name)


@pytest.mark.parametrize("orthographic", [False, True])
def test_image_of_one_surfel_integrates_to_its_area(orthographic: bool):
    """The sum over pixels is 2 pi s_u s_v fx fy / z^2 opacity (1 - cut), the cut being MIN_ALPHA / opacity."""
    camera = look(96, 80, 12.0 if orthographic else 60.0, orthographic)
    one = facing(opacity=0.4)
    scale = 1.0 if orthographic else 25.0
    area = 2 * math.pi * 0.2 * 0.3 * camera.fx * camera.fy / scale
    coverage = rasterise(one, camera).coverage
    assert float(coverage.sum()) == pytest.approx(area * 0.4 * (1 - MIN_ALPHA / 0.4), rel=3e-3)
    assert float(coverage.max()) <= 0.4


def test_the_gaussian_is_exact_under_perspective():
    """At the pixel of the point centre + u tangent_u + v tangent_v the strength is exp(-(u^2 + v^2) / 2)."""
    one = splats(1, 3, 0.5)
    one.opacity[:] = 0.9
    camera = look(focal=400.0)
    uv = torch.tensor([[0.0, 0.0], [1.0, 0.0], [-0.5, 1.2], [1.3, -0.7]], dtype=F64)
    point = one.centre + uv[:, :1] * one.tangent_u + uv[:, 1:] * one.tangent_v
    pixel, depth = project(camera, point)
    result = rasterise(one, camera, pixel)
    torch.testing.assert_close(result.coverage, 0.9 * torch.exp(-0.5 * (uv**2).sum(1)))
    torch.testing.assert_close(result.depth, depth)
    torch.testing.assert_close(result.position, point)


def test_rays_go_through_what_they_project_to():
    for camera in (look(turn=0.3), look(orthographic=True, turn=0.3)):
        origin, direction = camera_rays(camera, pixel_centres(camera))
        pixel, depth = project(camera, origin + 3.5 * direction)
        torch.testing.assert_close(pixel, pixel_centres(camera))
        torch.testing.assert_close(depth, torch.full_like(depth, 3.5))


def test_the_nearer_surfel_wins_whatever_the_order_of_storage():
    near, far = facing((0, 0, 1.0), opacity=0.9), facing((0, 0, -1.0), 1.0, 1.0, opacity=0.9)
    near.albedo = torch.tensor([[1.0, 0, 0]], dtype=F64)
    far.albedo = torch.tensor([[0, 1.0, 0]], dtype=F64)
    camera = look()
    centre = project(camera, near.centre)[0]
    strength_far = float(rasterise(far, camera, centre).coverage)
    ways = [rasterise(join(near, far), camera, centre), rasterise(join(far, near), camera, centre)]
    assert_same(*ways)
    w_near, w_far = 0.9, 0.1 * strength_far
    assert float(ways[0].coverage) == pytest.approx(w_near + w_far)
    expected = torch.tensor([[w_near, w_far, 0]], dtype=F64) / (w_near + w_far)
    torch.testing.assert_close(ways[0].albedo, expected)
    assert float(ways[0].depth) == pytest.approx((4 * w_near + 6 * w_far) / (w_near + w_far))


def test_interpenetrating_surfels_are_sorted_in_each_pixel():
    """Two crossed planes: the nearer is a different one left and right of the line they share."""
    tilt = torch.tensor([[1.0, 0, 1.0]], dtype=F64)
    rising = facing(opacity=0.99, sv=2.0)
    rising.tangent_u, rising.normal = tilt, normalise(torch.tensor([[-1.0, 0, 1]], dtype=F64))
    falling = facing(opacity=0.99, sv=2.0)
    falling.tangent_u, falling.normal = (
        tilt * torch.tensor([1.0, 1, -1]),
        normalise(torch.tensor([[1.0, 0, 1]], dtype=F64)),
    )
    rising.albedo, falling.albedo = torch.ones(1, 3, dtype=F64), torch.zeros(1, 3, dtype=F64)
    camera = look()
    pixel = project(camera, torch.tensor([[-0.3, 0, 0], [0.3, 0, 0]], dtype=F64))[0]
    red = rasterise(join(rising, falling), camera, pixel).albedo[:, 0]
    assert red[0] < 0.1 and red[1] > 0.9


def test_tangents_may_turn_and_shear_while_their_covariance_stays():
    cloud, camera = splats(12, 1), look()
    angle = torch.linspace(0, 3, 12, dtype=F64).unsqueeze(1)
    c, s = torch.cos(angle), torch.sin(angle)
    turned = Splats(**vars(cloud))
    # T R has T T^T: where |tangent_u| != |tangent_v| the turned tangents are no longer orthogonal.
    turned.tangent_u = c * cloud.tangent_u + s * cloud.tangent_v
    turned.tangent_v = c * cloud.tangent_v - s * cloud.tangent_u
    assert ((turned.tangent_u * turned.tangent_v).sum(1).abs() > 1e-4).any()
    assert_same(rasterise(cloud, camera), rasterise(turned, camera))


def test_the_picture_turns_with_the_camera():
    """Half a turn about the view axis mirrors both axes of the picture."""
    cloud = splats(10, 2)

    def camera(turn: float) -> Camera:
        base = look(40, 40, turn=turn)
        base.fy, base.cx, base.cy = base.fx, 20.0, 20.0
        return base

    upright, turned = rasterise(cloud, camera(0.0)), rasterise(cloud, camera(math.pi))
    torch.testing.assert_close(upright.coverage.reshape(40, 40).flip(0, 1), turned.coverage.reshape(40, 40))
    torch.testing.assert_close(upright.position.reshape(40, 40, 3).flip(0, 1), turned.position.reshape(40, 40, 3))


def test_a_region_is_a_cut_of_the_picture():
    cloud = splats(10, 4)
    whole = rasterise(cloud, look()).albedo.reshape(40, 48, 3)
    part = rasterise(cloud, look(region=(7, 5, 30, 21))).albedo.reshape(16, 23, 3)
    torch.testing.assert_close(part, whole[5:21, 7:30])


def test_small_surfels_are_kept_by_the_low_pass():
    """A tiny surfel spreads to 2 pi sigma^2 = pi pixels, at the depth of its centre; less by the cosine of its tilt."""
    camera = look()
    tiny = facing((0.013, 0.021, 0.5), 1e-5, 1e-5, 0.9)
    result = rasterise(tiny, camera)
    assert float(result.coverage.sum()) == pytest.approx(math.pi * 0.9, rel=0.02)
    assert torch.allclose(result.depth[result.coverage > 0], torch.tensor(4.5, dtype=F64))
    tilted = facing((0.1, -0.2, 0.5), 1e-5, 1e-5, 0.9)
    tilted.tangent_v = 1e-5 * torch.tensor([[0.0, 0.6, 0.8]], dtype=F64)
    whole = rasterise(facing((0.1, -0.2, 0.5), 1e-5, 1e-5, 0.9), camera).coverage.max()
    assert float(rasterise(tilted, camera).coverage.max() / whole) == pytest.approx(0.6)
    edge = facing((0.1, -0.2, 0.5), 0.3, 0.3, 0.9)
    edge.tangent_v = torch.tensor([[0.0, 0, 0.3]], dtype=F64)
    edge.normal = torch.tensor([[0.0, 1, 0]], dtype=F64)
    result = rasterise(edge, camera)
    assert float(result.coverage.sum()) == 0
    assert all(torch.isfinite(v).all() for v in vars(result).values())


def test_what_is_behind_the_camera_is_not_seen():
    behind = facing((0.1, -0.2, 6.0), opacity=0.9)
    assert (rasterise(behind, look()).coverage == 0).all()


def test_normals_face_the_viewer_and_have_length_one():
    cloud = splats(20, 6)
    flipped = Splats(**vars(cloud))
    flipped.normal = -cloud.normal
    camera = look()
    a, b = rasterise(cloud, camera), rasterise(flipped, camera)
    assert_same(a, b)
    seen = a.coverage > 0
    torch.testing.assert_close(torch.linalg.vector_norm(a.normal[seen], dim=1), torch.ones(int(seen.sum()), dtype=F64))
    assert ((a.normal * camera_rays(camera, pixel_centres(camera))[1]).sum(1)[seen] < 0).all()


def test_a_jump_of_the_depth_separates_surfaces():
    """Two layers, 2 m apart: without a gap their mean lies in the empty space between, with it on the heavier."""
    near, behind = facing((0, 0, 1.0), opacity=0.3), facing((0, 0, -1.0), 1.0, 1.0, opacity=0.9)
    close = facing((0, 0, -1.2), 1.0, 1.0, opacity=0.5)
    camera = look()
    centre = project(camera, near.centre)[0]
    mixed, split = (rasterise(join(near, behind, close), camera, centre, gap) for gap in (None, 3.0))
    assert 4.5 < float(mixed.depth) < 5.9
    assert 6.0 < float(split.depth) < 6.2
    torch.testing.assert_close(mixed.coverage, split.coverage)
    only = rasterise(join(behind, close), camera, centre)
    torch.testing.assert_close(split.depth, only.depth)
    near.opacity[:] = 0.8
    assert float(rasterise(join(near, behind, close), camera, centre, 3.0).depth) == pytest.approx(4.0)


def test_batches_do_not_change_the_picture():
    cloud = splats(15, 7)
    assert_same(rasterise(cloud, look()), rasterise(cloud, look(), batch_size=100), 1e-12)


def test_a_scene_of_no_surfels_is_empty():
    assert (rasterise(splats(0), look()).coverage == 0).all()


def test_gradients():
    cloud, camera = splats(4, 8, 0.5, 0.4), look(12, 10, 14.0)
    pixel = pixel_centres(camera)[::7]
    names = list(Splats.__dataclass_fields__)

    def picture(*tensors: torch.Tensor) -> torch.Tensor:
        result = rasterise(Splats(**dict(zip(names, tensors, strict=True))), camera, pixel)
        return torch.cat([v.reshape(len(pixel), -1) for v in vars(result).values()], 1)

    inputs = tuple(getattr(cloud, name).clone().requires_grad_() for name in names)
    # The picture jumps where a contribution reaches the cut; no pixel here is within the step of differences of it.
    assert torch.autograd.gradcheck(picture, inputs, eps=1e-7, atol=1e-5)


def test_intersection_is_on_the_plane():
    cloud = splats(30, 9)
    origin, direction = camera_rays(look(), pixel_centres(look())[::50])
    _, t, valid = intersect(cloud, origin, direction)
    point = origin[:, None] + t.unsqueeze(-1) * direction[:, None]
    across = torch.linalg.cross(cloud.tangent_u, cloud.tangent_v)
    distance = ((point - cloud.centre) * normalise(across)).sum(-1)
    assert distance[valid].abs().max() < 1e-9
