"""The differentiable rasteriser against autograd of a float64 brute force, and against the renderer's raster."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from drgs_blender.compute.threads import get_num_threads, use_threads  # noqa: E402
from drgs_blender.core.asset.model import PosedSurfels  # noqa: E402
from drgs_blender.core.errors import UsageError  # noqa: E402
from drgs_blender.core.frame import Camera, RenderSettings  # noqa: E402
from drgs_blender.reconstruct.model.projection import LOW_PASS  # noqa: E402
from drgs_blender.reconstruct.model.raster import GradientStatistics, rasterise  # noqa: E402
from drgs_blender.render.camera import camera_parameters  # noqa: E402
from drgs_blender.render.reference import raster as reference  # noqa: E402
from drgs_blender.render.surfels import raster as renderer  # noqa: E402
from drgs_blender.render.surfels.splats import prepare  # noqa: E402


def camera(width: int = 37, height: int = 29, **changes: object) -> Camera:
    """Looks at the origin from (0, -4, 1), with pixels that are not square and a centre off the middle."""
    away = np.array([0.0, -4.0, 1.0])
    z = away / np.linalg.norm(away)
    x = np.cross([0.0, 0, 1], z)
    x /= np.linalg.norm(x)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.stack([x, np.cross(z, x), z], -1), away
    settings = {"fx": 40.0, "fy": 36.0, "cx": 0.53 * width, "cy": 0.48 * height, **changes}
    return Camera(matrix, width, height, **settings)  # type: ignore[arg-type]


def surfels(n: int, seed: int = 0, size: float = 0.25) -> dict[str, torch.Tensor]:
    """Random surfels around the origin, a few of them tiny: those the screen-space filter shows."""
    rng = np.random.default_rng(seed)
    scale = size * rng.uniform(0.3, 1.5, (n, 2, 1))
    scale[: n // 4] *= 0.05
    axes = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    tangents = scale * axes[:, :2]
    values = {
        "centre": rng.uniform(-0.8, 0.8, (n, 3)),
        "tangent_u": tangents[:, 0],
        "tangent_v": tangents[:, 1],
        "opacity": rng.uniform(0.05, 0.97, n),
        "features": rng.uniform(-1, 1, (n, 5)),
    }
    return {k: torch.tensor(v, dtype=torch.float32, requires_grad=True) for k, v in values.items()}


def brute_force(given: dict[str, torch.Tensor], view: Camera) -> tuple[torch.Tensor, ...]:
    """The maps in plain float64 torch: every surfel at every pixel, in the order of the centres."""
    n = len(given["opacity"])
    zero = torch.zeros(n, dtype=torch.float64)
    splats = reference.Splats(
        given["centre"], given["tangent_u"], given["tangent_v"], torch.zeros(n, 3), given["opacity"],
        torch.zeros(n, 3), zero, zero,
    )  # fmt: skip
    position = reference.pixel_centres(view)
    origin, direction = reference.camera_rays(view, position)
    radius2, t, valid = reference.intersect(splats, origin, direction)
    centre, centre_depth = reference.project(view, splats.centre)
    across = torch.linalg.cross(splats.tangent_u, splats.tangent_v)
    towards = splats.centre - origin[0]
    cosine = (across * towards).sum(-1) / (across.norm(dim=-1) * towards.norm(dim=-1))
    distance2 = LOW_PASS * ((position[:, None] - centre) ** 2).sum(-1) - 2 * cosine.detach().abs().log()
    exact = valid & (t > view.clip_start) & (radius2 <= distance2)
    q = torch.where(exact, radius2, distance2)
    z = torch.where(exact, t, centre_depth.expand_as(t))
    alpha = (given["opacity"] * torch.exp(-0.5 * q)).clamp(max=0.99)
    alpha = torch.where(alpha >= 1 / 255, alpha, torch.zeros_like(alpha))
    order = torch.argsort(centre_depth.detach(), stable=True)
    alpha, z, features = alpha[:, order], z[:, order], given["features"][order]
    left = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones_like(left[:, :1]), left[:, :-1]], 1)
    alpha = torch.where(before.detach() >= 1e-4, alpha, torch.zeros_like(alpha))
    weight = before * alpha
    middle = (before > 0.5) & (before * (1 - alpha) <= 0.5)
    mean = (weight * z).sum(1)
    distortion = weight.sum(1) * (weight * z**2).sum(1) - mean**2  # the sum over all pairs
    shape = (view.height, view.width)
    maps = (weight.sum(1), mean, (z * middle).sum(1), distortion)
    return (weight @ features).reshape(*shape, -1), *(m.reshape(shape) for m in maps)


def double(given: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {k: v.detach().double().requires_grad_() for k, v in given.items()}


@pytest.mark.parametrize(("n", "size"), [(1, 1.0), (60, 0.25), (400, 0.12)])
def test_maps_and_gradients_are_those_of_the_brute_force(n, size):
    assert_matches_brute_force(rasterise, n, size)


def assert_matches_brute_force(rasterise, n, size):
    view, given = camera(), surfels(n, seed=n, size=size)
    maps = rasterise(**given, camera=view)
    ours = (maps.features, maps.alpha, maps.depth, maps.median, maps.distortion)
    exact = double(given)
    truth = brute_force(exact, view)
    rng = np.random.default_rng(1)
    weights = [torch.tensor(rng.normal(size=m.shape)) for m in truth]
    for mine, his in zip(ours, truth, strict=True):
        assert torch.allclose(mine.double(), his, atol=2e-5), float((mine - his).abs().max())
    sum((m * w.float()).sum() for m, w in zip(ours, weights, strict=True)).backward()
    sum((m * w).sum() for m, w in zip(truth, weights, strict=True)).backward()
    for name, value in given.items():
        his = exact[name].grad
        assert his.abs().max() > 0
        error = (value.grad.double() - his).norm() / his.norm()
        assert error < 1e-4, f"{name}: {float(error)}"


def test_every_map_has_a_gradient_of_its_own():
    assert_each_map_matches_brute_force(rasterise)


def assert_each_map_matches_brute_force(rasterise):
    """Each map alone: an error in one must not hide behind the larger gradients of another."""
    view = camera(20, 16)
    for k in range(5):
        given = surfels(40, seed=3)
        exact = double(given)
        maps = rasterise(**given, camera=view)
        mine = (maps.features, maps.alpha, maps.depth, maps.median, maps.distortion)[k]
        his = brute_force(exact, view)[k]
        pull = torch.tensor(np.random.default_rng(k).normal(size=his.shape))
        (mine * pull.float()).sum().backward()
        (his * pull).sum().backward()
        for name in ("centre", "tangent_u", "tangent_v", "opacity", "features"):
            truth = exact[name].grad if exact[name].grad is not None else torch.zeros_like(exact[name])
            assert (given[name].grad.double() - truth).norm() <= 1e-4 * truth.norm() + 1e-9, (k, name)


@pytest.mark.alone
def test_same_bits_with_any_number_of_threads_and_again():
    view, results = camera(100, 70), []
    threads = get_num_threads()
    try:
        for count in (1, threads, threads):
            use_threads(count)
            given, statistics = surfels(2000, seed=5, size=0.08), GradientStatistics.of(2000)
            maps = rasterise(**given, camera=view, statistics=statistics)
            (maps.features.square().sum() + maps.depth.sum() + maps.distortion.sum()).backward()
            results.append(
                [maps.features.detach().numpy(), *(v.grad.numpy() for v in given.values()), statistics.gradient]
            )
    finally:
        use_threads(threads)
    for other in results[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_agrees_with_the_renderer_where_surfels_do_not_intersect():
    """One kernel: on surfels parallel to the picture plane both orders of blending are the same."""
    view, n = camera(48, 40), 200
    rng = np.random.default_rng(2)
    turn = view.matrix_world[:3, :3].astype(np.float32)
    centre = rng.uniform(-0.8, 0.8, (n, 3)).astype(np.float32)
    size = rng.uniform(0.02, 0.2, (n, 2, 1)).astype(np.float32)
    u, v = size[:, 0] * turn[:, 0], size[:, 1] * turn[:, 1]
    opacity = rng.uniform(0.1, 0.9, n).astype(np.float32)
    posed = PosedSurfels(
        centre, u, v, np.tile(turn[:, 2], (n, 1)), opacity, np.zeros((n, 3), np.float32), np.zeros(n, np.float32),
        np.zeros(n, np.float32), np.zeros(n, np.int32),
    )  # fmt: skip
    parameters = camera_parameters(view, RenderSettings(subpixel_samples=1), 0)
    splats = prepare(posed, view, parameters)
    # The renderer's samples are shifted inside their pixels; ours stand in the middle: compare the means over rows.
    theirs = renderer.rasterise(splats, 0, view.height).alpha[..., 0]
    tensors = [torch.from_numpy(np.ascontiguousarray(a)) for a in (centre, u, v, opacity, np.zeros((n, 1), np.float32))]
    ours = rasterise(*tensors, camera=view).alpha.numpy()
    assert abs(ours.mean() - theirs.mean()) < 0.01 * theirs.mean()


def test_nothing_to_see_gives_empty_maps_and_no_gradients():
    behind = surfels(5)
    with torch.no_grad():
        behind["centre"] += torch.tensor([0.0, -50.0, 0.0])
    maps = rasterise(**behind, camera=camera())
    assert float(maps.alpha.detach().abs().max()) == 0
    maps.features.sum().backward()
    assert all(float(v.grad.abs().max()) == 0 for v in behind.values())


def test_damaged_surfels_are_left_out():
    given = surfels(8)
    with torch.no_grad():
        given["centre"][0, 0] = float("nan")
        given["tangent_u"][1] = float("inf")
        given["tangent_u"][2] = 0
    maps = rasterise(**given, camera=camera())
    maps.features.sum().backward()
    assert torch.isfinite(maps.features).all()
    assert all(torch.isfinite(v.grad).all() for v in given.values())


def test_orthographic_cameras_are_refused():
    with pytest.raises(UsageError, match="orthographic"):
        rasterise(**surfels(2), camera=camera(orthographic=True))
