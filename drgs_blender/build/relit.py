"""The light of an environment on an asset's surfels, one colour each: what splats without materials can show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from ..core.asset.model import Asset, Binding, Surfels
from ..core.color import srgb_to_linear
from ..core.frame import RenderSettings, World
from ..deform.rigid import pose_by_matrix
from ..formats.harmonics import basis, whole_bands
from ..geometry.normals import rotation_matrices
from ..render.integrator.integrate import integrate
from ..render.lights.environment import EnvironmentLight
from ..render.lights.light_sampler import Lights
from ..render.scene.trace_scene import TraceObject, TraceScene
from ..render.shading_points import ShadingPoints
from ..render.surfels.surfel_bvh import SurfelBVH

Array = np.ndarray
Progress = Callable[[str, float], None]

#: Samples by which it is found how open a side of a surfel is.
_OPEN_SAMPLES = 32
#: Surfels lit at once: bounds memory and the time until a cancel is seen.
_BLOCK = 1 << 15


def relit_colours(
    asset: Asset,
    surfels: Surfels,
    vertices: Array,
    world: World,
    settings: RenderSettings,
    progress: Progress | None = None,
) -> Array:
    """Light that leaves each surfel along its normal, with shadows and indirect light of the asset's mesh.

    Without a mesh light meets the surfels themselves; see `both_sides`.

    Parameters
    ----------
    asset : Asset
        Its mesh, or its surfels, are what light meets; object space is the world.
    surfels : Surfels
        The asset's surfels, posed as `vertices` are.
    vertices : (n, 3) float32 array
        The mesh's vertices.
    world : World
        The light.
    settings : RenderSettings
        Samples per surfel, bounces, look, seed.
    progress : callable, optional
        Called with the name of the phase and the part of it that is done, in [0, 1].

    Returns
    -------
    (n, 3) float32 array
        Linear Rec.709, scene-referred.

    Raises
    ------
    UsageError
        The settings are out of range.

    Examples
    --------
    A wall of albedo 0.5 reflects half of the light that comes from everywhere:

    >>> from drgs_blender.core.asset.model import Mesh
    >>> from drgs_blender.deform.attach import attach
    >>> corners = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    >>> mesh = Mesh(corners, [[0, 1, 2], [0, 2, 3]], albedo=[[0.5] * 3] * 4, roughness=[1] * 4, metallic=[0] * 4)
    >>> surfels, binding, report = attach(mesh, density=1)
    >>> asset = Asset(surfels, mesh, binding)
    >>> world = World(colour=(1.0, 0.4, 0.2))
    >>> relit_colours(asset, surfels, mesh.vertices, world, RenderSettings(samples=1024)).round(1)
    array([[0.5, 0.2, 0.1],
           [0.5, 0.2, 0.1],
           [0.5, 0.2, 0.1],
           [0.5, 0.2, 0.1]], dtype=float32)
    """
    mesh = asset.mesh
    scene = TraceScene()
    if asset.binding is None:
        tree = SurfelBVH()
        tree.update(pose_by_matrix(surfels, np.eye(4)))
        scene.update([])
        size = float(tree.sizes(1)[0])
        try:
            return both_sides(scene, EnvironmentLight(world), surfels, 0, size, settings, None, tree, progress)
        finally:
            scene.close()
    scene.update([TraceObject("asset", vertices, mesh.faces, mesh.albedo, mesh.roughness, mesh.metallic)])
    points = points_on_mesh(surfels, vertices, mesh.faces, asset.binding)
    try:
        return lit_colours(scene, EnvironmentLight(world), points, settings, progress=progress)
    finally:
        scene.close()


def lit_colours(
    scene: TraceScene,
    environment: EnvironmentLight,
    points: ShadingPoints,
    settings: RenderSettings,
    lights: Lights | None = None,
    tree: SurfelBVH | None = None,
    progress: Progress | None = None,
) -> Array:
    """Light that leaves `points`, (n, 3) float32 linear Rec.709; what is given is as for `integrate`."""
    return light_components(scene, environment, points, settings, lights, tree, progress).sum(axis=1)


def light_components(
    scene: TraceScene,
    environment: EnvironmentLight,
    points: ShadingPoints,
    settings: RenderSettings,
    lights: Lights | None = None,
    tree: SurfelBVH | None = None,
    progress: Progress | None = None,
) -> Array:
    """As `lit_colours`, (n, 4, 3): diffuse direct and indirect, glossy direct and indirect light."""
    n = len(points)
    components = np.empty((n, 4, 3), np.float32)
    for start in range(0, n, _BLOCK):
        if progress is not None:
            progress("Lighting", start / n)
        rows = slice(start, start + _BLOCK)
        components[rows] = integrate(scene, environment, points[rows], settings, 0, lights, surfels=tree).components
    if progress is not None:
        progress("Done", 1.0)
    return components


def points_on_mesh(
    surfels: Surfels, vertices: Array, faces: Array, binding: Binding, *, mirrored: bool = False
) -> ShadingPoints:
    """The places on a mesh, (n, 3) `vertices` and (m, 3) `faces`, where its `surfels` hang, seen along their normals.

    `mirrored`: the faces are clockwise seen from outside.
    """
    corners = vertices[faces[binding.face]].astype(np.float64)
    normal = rotation_matrices(surfels.rotation.astype(np.float64))[..., 2]
    geometric = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    geometric *= -1.0 if mirrored else 1.0
    length = np.linalg.norm(geometric, axis=1, keepdims=True)
    geometric = np.where(length > 1e-30, geometric / np.maximum(length, 1e-30), normal)
    # Surfels of captures face either way; what is seen of them is the outside of the mesh.
    normal *= np.where(np.sum(normal * geometric, axis=1, keepdims=True) < 0, -1.0, 1.0)
    return _points(surfels, np.einsum("nk,nkj->nj", binding.barycentric, corners), normal, geometric)


def both_sides(
    scene: TraceScene,
    environment: EnvironmentLight,
    surfels: Surfels,
    owner: int,
    size: float,
    settings: RenderSettings,
    lights: Lights | None,
    tree: SurfelBVH,
    progress: Progress | None = None,
) -> Array:
    """Light that leaves `surfels` without a mesh, (n, 3) float32 linear Rec.709.

    Their normals face either way, and one of the sides may lie in the dark inside of a body, but splats have one colour
    for both. Sides count by the square of the share of directions from which they are seen, and by their light: what is
    inside shows its outside, a leaf its lit side.

    Parameters
    ----------
    scene : TraceScene
    environment : EnvironmentLight
    lights : Lights, optional
    settings : RenderSettings
    tree : SurfelBVH
        These as for `integrate`.
    surfels : Surfels
        World space.
    owner : int
        The object, by its number in the tree of surfels, that does not shade itself nearby.
    size : float
        Mean larger standard deviation of its surfels, metres.
    progress : callable, optional
        See `relit_colours`.
    """
    normal = rotation_matrices(surfels.rotation.astype(np.float64))[..., 2]
    white = EnvironmentLight(World(colour=(1.0, 1.0, 1.0)))
    few = replace(settings, samples=_OPEN_SAMPLES, strategy_samples=None, bounces=0)
    n = len(surfels)
    white_rough = {"albedo": np.ones((n, 3), np.float32), "roughness": np.ones(n, np.float32)}
    total, weights = np.zeros((n, 3)), np.zeros((n, 1))
    for part, side in enumerate((normal, -normal)):
        points = own_surfels(_points(surfels, surfels.centre, side, side), owner, size)
        bare = replace(points, metallic=np.zeros(n, np.float32), **white_rough)
        share = light_components(scene, white, bare, few, None, tree)[:, 0].mean(axis=1, keepdims=True)
        told = None if progress is None else partial(_half, progress, part)
        colour = lit_colours(scene, environment, points, settings, lights, tree, told)
        weight = np.maximum(share, 1e-3) ** 2 * np.maximum(colour.mean(axis=1, keepdims=True), 1e-9)
        total += weight * colour
        weights += weight
    return (total / weights).astype(np.float32)


def _half(progress: Progress, part: int, phase: str, done: float) -> None:
    progress(phase, (part + done) / 2)


def own_surfels(points: ShadingPoints, owner: int, size: float) -> ShadingPoints:
    """The `points` with the numbers of their own surfels, see `both_sides`."""
    n = len(points)
    return replace(points, own=np.full(n, owner, np.int32), size=np.full(n, size, np.float32))


def _points(surfels: Surfels, origin: Array, normal: Array, geometric: Array) -> ShadingPoints:
    return points_along(origin, normal, geometric, surfels.albedo, surfels.roughness, surfels.metallic)


def points_along(
    origin: Array, normal: Array, geometric: Array, albedo: Array, roughness: Array, metallic: Array
) -> ShadingPoints:
    """Points seen along their `normal`, a pixel each; arrays as in `ShadingPoints`."""
    n = len(origin)
    return ShadingPoints(
        pixel=np.arange(n),
        sample=np.zeros(n),
        weight=np.ones(n),
        origin=origin,
        normal=normal,
        geometric_normal=geometric,
        view=normal,
        albedo=albedo,
        roughness=roughness,
        metallic=metallic,
    )


def white_surfels(surfels: Surfels) -> Surfels:
    """The surfels with an albedo of 1."""
    return replace(surfels, albedo=np.ones_like(surfels.albedo))


def captured_along(surfels: Surfels, directions: Array, rows: Array | slice = slice(None)) -> Array:
    """Linear captured colour (n, 3) that each surfel, or those of `rows`, sends along a unit direction (n, 3).

    Harmonics are of the direction from the camera to the splat, which is the other way.
    """
    assert surfels.sh is not None
    sh = whole_bands(surfels.sh[rows])
    weights = basis(-directions, {1: 0, 4: 1, 9: 2, 16: 3}[sh.shape[1]])
    return srgb_to_linear(np.clip(0.5 + np.einsum("nk,nkc->nc", weights, sh), 0.0, 1.0))
