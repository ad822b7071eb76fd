"""An estimate of the albedo of captures that have no materials: their colour without the light they were taken in.

What leaves a rough, non-metallic surface is its albedo times the light that arrives, and a little gloss that does not
depend on it. Both follow from the environment and the mesh by the integrator; the captured colour gives the rest. It is
no inverse rendering: a colour that is not in the environment (another light, a wrong exposure, a mirror) stays.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..core.asset.model import Array, Asset, Surfels
from ..core.color import LUMINANCE, srgb_to_linear
from ..core.errors import UsageError
from ..core.frame import RenderSettings, World
from ..formats.gaussian_ply import CAPTURED_ALBEDO
from ..formats.harmonics import basis, whole_bands
from ..render.lights.environment import EnvironmentLight
from ..render.scene.trace_scene import TraceObject, TraceScene
from .importer import CAPTURED
from .relit import Progress, light_components, points_on_mesh
from .transfer import surfels_to_vertices

#: What surfels without materials are taken for.
_ROUGHNESS, _METALLIC = 0.5, 0.0
#: Part of the median light below which a surfel says nothing: it takes the albedo of its neighbours on the mesh.
_DARK = 0.05
#: Without an exposure, the albedo (by luminance) that this part of the surfels stays below is this.
_BRIGHT, _BRIGHTEST = 0.9, 0.8
#: Rounds: the light that other parts of the object reflect depends on their albedo.
_ROUNDS = 2
_SAMPLES = RenderSettings(samples=192, subpixel_samples=1, bounces=1, shading_model="principled")


def remove_light(
    asset: Asset, exposure: float | None = None, settings: RenderSettings = _SAMPLES, progress: Progress | None = None
) -> None:
    """Replace the albedo of an asset whose surfels have captured colours by an estimate; ``provenance`` says so.

    Parameters
    ----------
    asset : Asset
        With a mesh, an environment and ``surfels.sh``; changed in place, its mesh too.
    exposure : float, optional
        Linear captured colour that radiance 1 gives; None chooses it so that the brightest tenth is not brighter than
        paint.
    settings : RenderSettings
        Samples per surfel.
    progress : callable, optional
        Called with the name of the phase and the part of it that is done.

    Raises
    ------
    UsageError
        The asset lacks one of these, has materials already, or the environment gives no light.
    """
    surfels, mesh = asset.surfels, asset.mesh
    if asset.binding is None or asset.environment is None or surfels.sh is None:
        lacking = (
            "a mesh" if asset.binding is None else "an environment" if surfels.sh is not None else "captured colours"
        )
        raise UsageError("removing light", f"needs {lacking}", "Import the capture with its mesh and its light")
    materials = asset.provenance.get("materials", CAPTURED)
    if not materials.startswith(CAPTURED):
        raise UsageError("removing light", f"is for captures without materials; these are {materials}", "Leave it out")
    light = EnvironmentLight(World(asset.environment.radiance))
    surfels.roughness[:], surfels.metallic[:] = _ROUGHNESS, _METALLIC
    mesh.roughness[:], mesh.metallic[:] = _ROUGHNESS, _METALLIC
    report: dict[str, Any] = {}
    for round_ in range(_ROUNDS):
        share = None if progress is None else _part(progress, round_)
        diffuse, glossy, seen = _light(asset, light, settings, share)
        arriving = diffuse @ LUMINANCE
        known = arriving > _DARK * np.median(arriving)
        if not known.any() or not diffuse[known].any():
            raise UsageError(
                "removing light", "the environment does not reach the surfels", "Choose that of the capture"
            )
        used = exposure or _exposure(seen, diffuse, glossy, known)
        albedo = np.clip((seen / used - glossy) / np.maximum(diffuse, 1e-6), 0.0, 1.0)
        surfels.albedo[:] = np.where(known[:, None], albedo, np.median(albedo[known], axis=0))
        report["vertices_without_surfels"] = surfels_to_vertices(mesh, surfels, asset.binding)
        surfels.albedo[~known] = _of_mesh(asset)[~known]
        report |= {"exposure": float(used), "too_dark": int((~known).sum())}
        report["clipped"] = int((known & (albedo >= 1).any(axis=1)).sum())
    report["notes"] = [
        f"albedo estimated: captured colour over the light of the environment, exposure {report['exposure']:.3g}; "
        f"{report['too_dark']} surfels too dark to estimate, {report['clipped']} as bright as white"
    ]
    asset.provenance["materials"] = "estimated from captured colours, by removing the light of the environment"
    about = asset.provenance.setdefault("report", {})
    about["surfel_notes"] = [note for note in about.get("surfel_notes", []) if note != CAPTURED_ALBEDO]
    about["remove_light"] = report


def captured_along(surfels: Surfels, directions: Array) -> Array:
    """Linear captured colour (n, 3) that each surfel sends along a unit direction (n, 3).

    Harmonics are of the direction from the camera to the splat, which is the other way.
    """
    assert surfels.sh is not None
    sh = whole_bands(surfels.sh)
    weights = basis(-directions, {1: 0, 4: 1, 9: 2, 16: 3}[sh.shape[1]])
    return srgb_to_linear(np.clip(0.5 + np.einsum("nk,nkc->nc", weights, sh), 0.0, 1.0))


def _light(
    asset: Asset, environment: EnvironmentLight, settings: RenderSettings, progress: Progress | None
) -> tuple[Array, Array, Array]:
    """Diffuse light of albedo 1, glossy light, and captured colour, (n, 3) each, of every surfel along its normal."""
    mesh, surfels = asset.mesh, asset.surfels
    assert asset.binding is not None
    white = Surfels(
        surfels.centre, surfels.scale, surfels.rotation, surfels.opacity, np.ones_like(surfels.albedo),
        surfels.roughness, surfels.metallic,
    )  # fmt: skip
    points = points_on_mesh(white, mesh.vertices, mesh.faces, asset.binding)
    scene = TraceScene()
    scene.update([TraceObject("asset", mesh.vertices, mesh.faces, mesh.albedo, mesh.roughness, mesh.metallic)])
    try:
        components = light_components(scene, environment, points, settings, progress=progress).astype(np.float64)
    finally:
        scene.close()
    return components[:, :2].sum(axis=1), components[:, 2:].sum(axis=1), captured_along(surfels, points.normal)


def _exposure(seen: Array, diffuse: Array, glossy: Array, known: Array) -> float:
    """The exposure at which the albedo of the brightest tenth is that of bright paint."""
    light = (_BRIGHTEST * diffuse[known] + glossy[known]) @ LUMINANCE
    return float(max(np.quantile(seen[known] @ LUMINANCE / np.maximum(light, 1e-9), _BRIGHT), 1e-6))


def _of_mesh(asset: Asset) -> Array:
    """The mesh's albedo at the surfels."""
    assert asset.binding is not None
    corners = asset.mesh.albedo[asset.mesh.faces[asset.binding.face]]
    return np.einsum("nk,nkc->nc", asset.binding.barycentric, corners)


def _part(progress: Progress, round_: int) -> Progress:
    return lambda phase, fraction: progress(phase, (round_ + fraction) / _ROUNDS)
