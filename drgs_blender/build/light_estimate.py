"""An estimate of the light that surfels were captured in, for captures that come without their environment.

What a rough surface shows is its albedo times the light that arrives there, and that light is linear in the
environment: a sum of broad lobes, each with the shadows and reflections of the mesh. Two surfels of one paint then
differ by their light alone. Which pairs these are is not known: differences of all pairs are fitted robustly, close
ones (most paint has no edge between them) and far ones (paints come again), so that pairs of different paints count as
outliers.
After the intrinsic images of Bell, Bala and Snavely (2014) and the graduated non-convexity of Blake and Zisserman
(1987), with Geman and McClure's estimator.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from ..core.asset.model import Array, Asset, Environment, Mesh
from ..core.errors import AssetError
from ..core.frame import RenderSettings, World
from ..formats.latlong import directions
from ..render.lights.environment import EnvironmentLight
from ..render.scene.trace_scene import TraceObject, TraceScene
from ..render.shading_points import ShadingPoints
from .relit import Progress, captured_along, light_components, points_on_mesh, white_surfels

#: Surfels whose differences are fitted, close and far partners of each.
_SURFELS, _CLOSE, _FAR = 4096, 8, 8
#: Surfels without which nothing is estimated.
_FEWEST = 64
#: Lobes of the light, rows of its picture, and how narrow a lobe is: exp(sharpness (cos - 1)).
_LOBES, _ROWS, _SHARPNESS = 162, 32, 24.0
#: Albedo of the mesh while its own light is found.
_GREY = 0.4
#: Captured colours of which logarithms say something: neither black nor clipped.
_DARKEST, _CLIPPED = 0.001, 0.98
#: Of the light from everywhere, what reaches surfels inside of others.
_SHUT = 0.02
#: Differences (of logarithms) that still count: from the first round to the last.
_ROUNDS = np.geomspace(3.0, 0.12, 10)
#: How much lobes that differ in brightness, and in colour, count against differences that stay.
_EVEN, _NEUTRAL = 5e-5, 3e-3
_SETTINGS = RenderSettings(samples=192, subpixel_samples=1, bounces=1, shading_model="principled")


def subject_of(asset: Asset) -> str:
    """What messages about the removal of light begin with."""
    name = asset.provenance.get("surfels")
    return f"removing light of {name}" if name else "removing light"


def estimate_light(asset: Asset, progress: Progress | None = None, seed: int = 0) -> Environment:
    """The environment that explains the captured colours of an asset with the simplest paint.

    Neither its brightness nor its mean colour can be known: the light that arrives at the surfels is white in the mean,
    of radiance 1.

    Parameters
    ----------
    asset : Asset
        With a mesh and ``surfels.sh``.
    progress : callable, optional
        Called with the name of the phase and the part of it that is done.
    seed : int
        Of the choice of surfels and pairs.

    Raises
    ------
    AssetError
        Too few surfels show a colour.
    """
    rng = np.random.default_rng(seed)
    rows = _chosen(asset, rng)
    mesh, surfels = asset.mesh, asset.surfels
    assert asset.binding is not None
    points = points_on_mesh(white_surfels(surfels), mesh.vertices, mesh.faces, asset.binding)[rows]
    colour = captured_along(surfels, points.normal, rows)
    shown = np.flatnonzero((colour > _DARKEST).all(axis=1) & (colour < _CLIPPED).all(axis=1))
    _check_enough(asset, len(shown), "neither black nor clipped")
    transfer = _transfer(mesh, points[shown], progress)
    open_ = transfer.sum(axis=1) > _SHUT
    shown = shown[open_]
    _check_enough(asset, len(shown), "neither black nor clipped, and reached by light from outside")
    light = _fit(np.log(colour[shown]), transfer[open_], surfels.centre[rows[shown]].astype(np.float64), rng)
    radiance = np.einsum("hwk,ck->hwc", _lobes(directions(_ROWS)), light)
    return Environment(radiance.astype(np.float32))


def _check_enough(asset: Asset, count: int, what: str) -> None:
    if count < _FEWEST:
        problem = f"has {count} surfels that are {what}, too few to estimate the light of"
        raise AssetError(subject_of(asset), problem, "Give the environment of the capture with --env")


def _chosen(asset: Asset, rng: np.random.Generator) -> Array:
    """Rows of surfels, in proportion to the area that they cover."""
    surfels = asset.surfels
    weight = surfels.opacity.astype(np.float64) * surfels.scale.prod(axis=1)
    weight = np.minimum(weight, 20 * np.median(weight[weight > 0])) if (weight > 0).any() else np.ones(len(surfels))
    count = min(_SURFELS, int((weight > 0).sum()))
    return np.sort(rng.choice(len(surfels), count, replace=False, p=weight / weight.sum()))


def _lobes(look: Array) -> Array:
    """(..., k) values of all lobes in unit directions (..., 3); they add up to about 1 everywhere."""
    i = np.arange(_LOBES) + 0.5
    z, angle = 1 - 2 * i / _LOBES, np.pi * (1 + 5**0.5) * i
    axes = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)
    values = np.exp(_SHARPNESS * (look @ axes.T - 1))
    return values / values.sum(axis=-1, keepdims=True)


def _transfer(mesh: Mesh, points: ShadingPoints, progress: Progress | None) -> Array:
    """The diffuse light (n, k) that each lobe sends to white `points` on a mesh."""
    pictures = _lobes(directions(_ROWS)).astype(np.float32)
    grey = np.full_like(mesh.albedo, _GREY)
    scene = TraceScene()
    scene.update([TraceObject("asset", mesh.vertices, mesh.faces, grey, mesh.roughness, mesh.metallic)])
    found = np.empty((len(points), _LOBES))
    try:
        for first in range(0, _LOBES, 3):  # three lobes at a time, as red, green and blue
            if progress is not None:
                progress("Lobes of the light", first / _LOBES)
            light = EnvironmentLight(World(np.ascontiguousarray(pictures[..., first : first + 3])))
            found[:, first : first + 3] = light_components(scene, light, points, _SETTINGS)[:, :2].sum(axis=1)
    finally:
        scene.close()
    return found


def _pairs(place: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Rows (m,) of the two of each pair."""
    n = len(place)
    # Of the nearest 64 some: the very nearest have nearly the same light.
    near = cKDTree(place).query(place, min(65, n))[1][:, 1:]
    close = np.take_along_axis(near, rng.integers(0, near.shape[1], (n, _CLOSE)), axis=1)
    far = rng.integers(0, n, (n, _FAR))
    return np.repeat(np.arange(n), _CLOSE + _FAR), np.concatenate([close, far], axis=1).ravel()


def _fit(seen: Array, transfer: Array, place: Array, rng: np.random.Generator) -> Array:
    """Radiance (3, k) of the lobes, from logarithms of colours (n, 3)."""
    one, two = _pairs(place, rng)
    apart = seen[one] - seen[two]
    weight = np.ones(len(one))

    def cost(flat: Array) -> tuple[float, Array]:
        theta = flat.reshape(3, -1)
        lobes = np.exp(theta)
        light = np.maximum(transfer @ lobes.T, 1e-9)
        shading = np.log(light)
        left = apart - (shading[one] - shading[two])
        value = float((weight[:, None] * left**2).sum() / len(one))
        pull = -2 * weight[:, None] * left / len(one)
        at = np.stack([np.bincount(one, p, len(seen)) - np.bincount(two, p, len(seen)) for p in pull.T], axis=1)
        slope = (at / light).T @ transfer * lobes
        uneven = theta - theta.mean(axis=1, keepdims=True)
        tint = uneven - uneven.mean(axis=0)
        value += _EVEN * float((uneven**2).mean(axis=1).sum()) + _NEUTRAL * float((tint**2).mean(axis=1).sum())
        k = theta.shape[1]
        slope += 2 / k * (_EVEN * uneven + _NEUTRAL * (tint - tint.mean(axis=1, keepdims=True)))
        return value, slope.ravel()

    theta = np.zeros(3 * transfer.shape[1])
    for scale in _ROUNDS:
        shading = np.log(np.maximum(transfer @ np.exp(theta.reshape(3, -1)).T, 1e-9))
        left = ((apart - (shading[one] - shading[two])) ** 2).sum(axis=1)
        weight = (scale**2 / (scale**2 + left)) ** 2
        theta = minimize(cost, theta, jac=True, method="L-BFGS-B", options={"maxiter": 60}).x
    lobes = np.exp(theta.reshape(3, -1))
    return lobes / (transfer @ lobes.T).mean(axis=0)[:, None]
