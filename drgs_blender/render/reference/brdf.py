"""The two reflectance models, as torch functions of broadcastable tensors.

``paper``: Cook-Torrance with GGX, height-correlated Smith and Schlick's Fresnel of F0 = 0.04 (1 - m) + a m, plus
Lambert (1 - m) a / pi.

``principled``: Blender's Principled BSDF with the distribution GGX and no extra lobe: a metal (weight m) with
Schlick's Fresnel of F0 = a; a dielectric (weight 1 - m) with the exact Fresnel of IOR 1.5; below it a Lambert base
with the weight (1 - m) (1 - E), E the estimate Cycles makes of what the dielectric reflects.

All directions are unit vectors that point away from the surface; colours are linear Rec.709.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from torch import Tensor

SHADING_MODELS = ("principled", "paper")
MIN_GGX_ALPHA = 1e-3
IOR = 1.5
#: Reflectance of the dielectric at normal incidence.
F0 = ((IOR - 1) / (IOR + 1)) ** 2
_CELLS = 16


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Scalar product over the last axis."""
    return (a * b).sum(-1)


def normalise(a: Tensor) -> Tensor:
    """Unit vectors over the last axis."""
    return a / torch.linalg.vector_norm(a, dim=-1, keepdim=True)


def alpha_of(roughness: Tensor) -> Tensor:
    """GGX width of a perceptual roughness: its square, at least `MIN_GGX_ALPHA`."""
    return (roughness**2).clamp(min=MIN_GGX_ALPHA)


def ggx_distribution(normal: Tensor, half: Tensor, alpha: Tensor) -> Tensor:
    """GGX (Trowbridge-Reitz) density of microfacet normals at unit `half`, per steradian.

    The sine is taken from the cross product: 1 - cos^2 would cancel in float32 where the lobe is narrow.
    """
    normal, half = torch.broadcast_tensors(normal, half)
    sine2 = (torch.linalg.cross(normal, half) ** 2).sum(-1)
    width = alpha**2 * dot(normal, half) ** 2 + sine2
    return alpha**2 / (math.pi * width**2)


def smith_root(cosine: Tensor, alpha: Tensor) -> Tensor:
    """sqrt(alpha^2 + (1 - alpha^2) cos^2): (1 + 2 Lambda) cos of Smith's function for GGX."""
    return torch.sqrt(alpha**2 + (1 - alpha**2) * cosine**2)


def smith_visibility(cos_view: Tensor, cos_light: Tensor, alpha: Tensor) -> Tensor:
    """Height-correlated Smith G2 / (4 cos_view cos_light) (Heitz 2014, eq. 99)."""
    return 0.5 / (cos_light * smith_root(cos_view, alpha) + cos_view * smith_root(cos_light, alpha))


def fresnel_schlick(cosine: Tensor, f0: Tensor) -> Tensor:
    """Schlick's Fresnel; `cosine` (...), `f0` (..., c) -> (..., c)."""
    return f0 + (1 - f0) * ((1 - cosine) ** 5).unsqueeze(-1)


def fresnel_dielectric(cosine: Tensor, ior: float = IOR) -> Tensor:
    """Unpolarised reflectance of a smooth dielectric met from outside, `ior` > 1."""
    refracted = torch.sqrt(1 - (1 - cosine**2) / ior**2)
    across = (cosine - ior * refracted) / (cosine + ior * refracted)
    along = (ior * cosine - refracted) / (ior * cosine + refracted)
    return 0.5 * (across**2 + along**2)


def _blend_by_visible_normals(roughness: float, mu: float, ior: float, samples: int = 192) -> float:
    """Mean over the visible normals of (F - F0) / (1 - F0), where the reflected ray leaves the surface; else zero."""
    alpha = roughness**2
    u2 = (np.arange(samples) + 0.5) / samples
    u1 = u2[: samples // 2, None]  # half a turn: the plane of view and normal mirrors the rest
    view = np.array([math.sqrt(1 - mu * mu), 0.0, mu])
    stretched = view * (alpha, alpha, 1)
    stretched /= np.linalg.norm(stretched)
    # Visible normals are a spherical cap seen through the stretch (Dupuy and Benyoub 2023).
    z = (1 - u2) * (1 + stretched[2]) - stretched[2]
    sine = np.sqrt(np.clip(1 - z * z, 0, None))
    half = np.stack(np.broadcast_arrays(sine * np.cos(2 * math.pi * u1), sine * np.sin(2 * math.pi * u1), z), -1)
    half = (half + stretched) * (alpha, alpha, 1)
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    cosine = half @ view
    leaves = 2 * cosine * half[..., 2] - mu > 0
    f0 = ((ior - 1) / (ior + 1)) ** 2
    reflected = fresnel_dielectric(torch.from_numpy(cosine), ior).numpy()
    return float(np.mean(np.clip((reflected - f0) / (1 - f0), 0, 1) * leaves))


@functools.cache
def layer_table() -> np.ndarray:
    """Cycles' table of the blend between F0 and 1 that a rough dielectric of IOR 1.5 reflects.

    Returns (16, 16) float64, [cosine of the view, roughness], both from 0 to 1.

    Cycles keeps 16 x 16 x 16 values and interpolates linearly, in the third axis over z = F0^(1/4); the two layers
    around IOR 1.5 are computed and blended here as it does (Blender 5.0, intern/cycles/app/cycles_precompute.cpp and
    bsdf_microfacet_estimate_albedo in kernel/closure/bsdf_microfacet.h).
    """
    grid = np.clip(np.arange(_CELLS) / (_CELLS - 1), 1e-4, 1)
    z = F0**0.25 * (_CELLS - 1)
    layer = int(z)
    table = np.zeros((_CELLS, _CELLS))
    for index, weight in ((layer, layer + 1 - z), (layer + 1, z - layer)):
        root = (index / (_CELLS - 1)) ** 2
        ior = (1 + root) / (1 - root)
        table += weight * np.array([[_blend_by_visible_normals(r, mu, ior) for r in grid] for mu in grid])
    return table


def layer_albedo(cosine: Tensor, roughness: Tensor) -> Tensor:
    """Albedo of the dielectric layer in Cycles, for a view at `cosine`."""
    table = torch.as_tensor(layer_table(), dtype=cosine.dtype, device=cosine.device)
    y, x = torch.broadcast_tensors(cosine.clamp(0, 1) * (_CELLS - 1), roughness.clamp(0, 1) * (_CELLS - 1))
    j, i = y.detach().long().clamp(max=_CELLS - 2), x.detach().long().clamp(max=_CELLS - 2)
    t, s = y - j, x - i
    low = (1 - s) * table[j, i] + s * table[j, i + 1]
    high = (1 - s) * table[j + 1, i] + s * table[j + 1, i + 1]
    return F0 + (1 - F0) * ((1 - t) * low + t * high)


def evaluate(
    normal: Tensor,
    view: Tensor,
    light: Tensor,
    albedo: Tensor,
    roughness: Tensor,
    metallic: Tensor,
    shading_model: str = "principled",
) -> tuple[Tensor, Tensor]:
    """BRDF times the cosine of the light, diffuse and glossy part.

    Parameters
    ----------
    normal, view, light : (..., 3) tensor
        Unit vectors, broadcastable.
    albedo : (..., 3) tensor
    roughness, metallic : tensor
    shading_model : {"principled", "paper"}

    Returns
    -------
    diffuse, glossy : (..., 3) tensor
        Zero where the light is below the surface, glossy also where the view is (an interpolated normal may turn away
        from the viewer at a silhouette; diffuse light does not ask for the view).
    """
    if shading_model not in SHADING_MODELS:
        raise ValueError(f"shading model {shading_model!r} is not one of {SHADING_MODELS}")
    normal, view, light = torch.broadcast_tensors(normal, view, light)
    lit = (dot(normal, light) > 0).unsqueeze(-1)
    seen = lit & (dot(normal, view) > 0).unsqueeze(-1)
    # Directions below the surface are replaced by the normal, so that neither value nor gradient is ever NaN.
    cos_light = dot(normal, torch.where(lit, light, normal))
    base = ((1 - metallic) / math.pi * cos_light).unsqueeze(-1) * albedo
    if shading_model == "principled":
        base = base * (1 - layer_albedo(dot(normal, view), roughness)).unsqueeze(-1)

    view, light = torch.where(seen, view, normal), torch.where(seen, light, normal)
    cos_view, cos_light = dot(normal, view), dot(normal, light)
    half = normalise(view + light)
    cos_half = dot(view, half).clamp(0, 1)
    alpha = alpha_of(roughness)
    facets = ggx_distribution(normal, half, alpha) * smith_visibility(cos_view, cos_light, alpha) * cos_light
    metal = metallic.unsqueeze(-1)
    if shading_model == "paper":
        fresnel = fresnel_schlick(cos_half, 0.04 * (1 - metal) + albedo * metal)
    else:
        dielectric = fresnel_dielectric(cos_half).unsqueeze(-1)
        fresnel = metal * fresnel_schlick(cos_half, albedo) + (1 - metal) * dielectric
    zero = torch.zeros((), dtype=normal.dtype, device=normal.device)
    return torch.where(lit, base, zero), torch.where(seen, facets.unsqueeze(-1) * fresnel, zero)
