"""An estimate of the albedo of captures that have no materials: their colour without the light they were taken in.

What leaves a rough, non-metallic surface is its albedo times the light that arrives, and a little gloss that does not
depend on it. Both follow from the environment and the mesh by the integrator; the captured colour gives the rest. It is
no inverse rendering: a colour that is not in the environment (another light, a wrong exposure, a mirror) stays. Where
the environment is not known, `light_estimate` finds one.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..core.asset.model import Array, Asset, Environment
from ..core.color import LUMINANCE
from ..core.errors import UsageError
from ..core.frame import RenderSettings, World
from ..formats.gaussian_ply import CAPTURED_ALBEDO
from ..render.lights.environment import EnvironmentLight
from ..render.scene.trace_scene import TraceObject, TraceScene
from .importer import CAPTURED
from .light_estimate import estimate_light, subject_of
from .relit import Progress, captured_along, light_components, points_on_mesh, white_surfels
from .transfer import surfels_to_vertices

#: What surfels without materials are taken for.
_ROUGHNESS, _METALLIC = 0.5, 0.0
#: Part of the median light below which a surfel says nothing: it takes the albedo of its neighbours on the mesh.
_DARK = 0.05
#: Without an exposure, the albedo (by luminance) that this part of the surfels stays below is this.
_BRIGHT, _BRIGHTEST = 0.9, 0.8
#: The same where the light is an estimate: objects are darker than white paint as a rule.
_USUAL = 0.5
#: Rounds: the light that other parts of the object reflect depends on their albedo.
_ROUNDS = 2
#: What an estimated light leaves open, for the user.
LIMITS = [
    "the light is estimated: its brightness is unknown (--exposure), its mean colour taken for white, so that light "
    "which is coloured as a whole stays in the albedo",
    "highlights, mirrors and metals stay in the albedo; light of near lamps is taken for that of an environment",
]
_SAMPLES = RenderSettings(samples=192, subpixel_samples=1, bounces=1, shading_model="principled")


def remove_light(
    asset: Asset, exposure: float | None = None, settings: RenderSettings = _SAMPLES, progress: Progress | None = None
) -> None:
    """Replace the albedo of an asset whose surfels have captured colours by an estimate; ``provenance`` says so.

    Parameters
    ----------
    asset : Asset
        With a mesh and ``surfels.sh``; changed in place, its mesh too. Without an environment it gets an estimate, as
        bright as gives the captured colours.
    exposure : float, optional
        Linear captured colour that radiance 1 gives, of an estimated light that of white paint in its mean; None
        chooses it so that the brightest tenth is not brighter than paint, or under an estimate usual things.
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
    if asset.binding is None or surfels.sh is None:
        lacking = "a mesh" if asset.binding is None else "captured colours"
        raise UsageError(subject_of(asset), f"needs {lacking}", "Import a capture of splats with their mesh")
    materials = asset.provenance.get("materials", CAPTURED)
    if not materials.startswith(CAPTURED):
        raise UsageError(subject_of(asset), f"is for captures without materials; these are {materials}", "Leave it out")
    surfels.roughness[:], surfels.metallic[:] = _ROUGHNESS, _METALLIC
    mesh.roughness[:], mesh.metallic[:] = _ROUGHNESS, _METALLIC
    estimated = asset.environment is None
    parts = _ROUNDS + estimated
    environment = asset.environment or estimate_light(asset, _part(progress, 0, parts))
    light = EnvironmentLight(World(environment.radiance))
    report: dict[str, Any] = {}
    for round_ in range(_ROUNDS):
        share = _part(progress, round_ + estimated, parts)
        diffuse, glossy, seen = _light(asset, light, settings, share)
        arriving = diffuse @ LUMINANCE
        known = arriving > _DARK * np.median(arriving)
        if not known.any() or not diffuse[known].any():
            raise UsageError(
                subject_of(asset), "the environment does not reach the surfels", "Choose that of the capture"
            )
        used = exposure or _exposure(seen, diffuse, glossy, known, _USUAL if estimated else _BRIGHTEST)
        albedo = np.clip((seen / used - glossy) / np.maximum(diffuse, 1e-6), 0.0, 1.0)
        surfels.albedo[:] = np.where(known[:, None], albedo, np.median(albedo[known], axis=0))
        report["vertices_without_surfels"] = surfels_to_vertices(mesh, surfels, asset.binding)
        surfels.albedo[~known] = _of_mesh(asset)[~known]
        report |= {"exposure": float(used), "too_dark": int((~known).sum())}
        report["clipped"] = int((known & (albedo >= 1).any(axis=1)).sum())
    whose = "an estimated environment" if estimated else "the environment"
    report["notes"] = [
        f"albedo estimated: captured colour over the light of {whose}, exposure {report['exposure']:.3g}; "
        f"{report['too_dark']} surfels too dark to estimate, {report['clipped']} as bright as white"
    ]
    if estimated:
        report["notes"] += LIMITS
        asset.environment = Environment(environment.radiance * np.float32(report["exposure"]))
    asset.provenance["materials"] = f"estimated from captured colours, by removing the light of {whose}"
    about = asset.provenance.setdefault("report", {})
    about["surfel_notes"] = [note for note in about.get("surfel_notes", []) if note != CAPTURED_ALBEDO]
    about["remove_light"] = report


def _light(
    asset: Asset, environment: EnvironmentLight, settings: RenderSettings, progress: Progress | None
) -> tuple[Array, Array, Array]:
    """Diffuse light of albedo 1, glossy light, and captured colour, (n, 3) each, of every surfel along its normal."""
    mesh, surfels = asset.mesh, asset.surfels
    assert asset.binding is not None
    points = points_on_mesh(white_surfels(surfels), mesh.vertices, mesh.faces, asset.binding)
    scene = TraceScene()
    scene.update([TraceObject("asset", mesh.vertices, mesh.faces, mesh.albedo, mesh.roughness, mesh.metallic)])
    try:
        components = light_components(scene, environment, points, settings, progress=progress).astype(np.float64)
    finally:
        scene.close()
    return components[:, :2].sum(axis=1), components[:, 2:].sum(axis=1), captured_along(surfels, points.normal)


def _exposure(seen: Array, diffuse: Array, glossy: Array, known: Array, brightest: float) -> float:
    """The exposure at which the brightest tenth has an albedo of `brightest`."""
    light = (brightest * diffuse[known] + glossy[known]) @ LUMINANCE
    return float(max(np.quantile(seen[known] @ LUMINANCE / np.maximum(light, 1e-9), _BRIGHT), 1e-6))


def _of_mesh(asset: Asset) -> Array:
    """The mesh's albedo at the surfels; those beside their faces take no more than what is there."""
    assert asset.binding is not None
    corners = asset.mesh.albedo[asset.mesh.faces[asset.binding.face]]
    return np.einsum("nk,nkc->nc", asset.binding.barycentric, corners).clip(0.0, 1.0)


def _part(progress: Progress | None, done: int, parts: int) -> Progress | None:
    """Progress of one of so many parts."""
    return None if progress is None else lambda phase, fraction: progress(phase, (done + fraction) / parts)
