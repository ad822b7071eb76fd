"""The specular lobe as IRGS published it (Gu et al. 2025, after Relightable 3D Gaussians), for comparison alone."""

from __future__ import annotations

import numpy as np
import torch

from drgs_blender.render.reference.brdf import alpha_of, fresnel_schlick, ggx_distribution, smith_visibility

Array = np.ndarray

#: What cosines and the denominator are clamped to.
CLAMP = 1e-6


def specular(nl: Array, nv: Array, nh: Array, vh: Array, roughness: float, f0: float, clamp: float = CLAMP) -> Array:
    """BRDF value: GGX, Schlick's separable Smith with k = (alpha + 2 r + 1) / 8, Fresnel by powers of two.

    Its denominator is at least `clamp`; at the peak of a lobe it is 4 pi alpha^4, less than that below roughness 0.13.
    """
    alpha = roughness * roughness
    k = (alpha + 2 * roughness + 1) / 8
    nl, nv, nh, vh = (np.clip(cosine, CLAMP, 1) for cosine in (nl, nv, nh, vh))
    fresnel = f0 + (1 - f0) * 2.0 ** ((-5.55473 * vh - 6.98316) * vh)
    peak = nh * nh * (alpha * alpha - 1) + 1
    below = 4 * np.pi * peak * peak * (nv * (1 - k) + k) * (nl * (1 - k) + k)
    return fresnel * alpha * alpha / np.clip(below, clamp, 4 * np.pi)


def paper(nl: Array, nv: Array, nh: Array, vh: Array, roughness: float, f0: float) -> Array:
    """BRDF value of the look *paper*: GGX, height-correlated Smith, Schlick's Fresnel."""
    nl, nv, nh, vh, up, edge = (torch.as_tensor(a, dtype=torch.float64) for a in (nl, nv, nh, vh, [0, 0, 1], [f0]))
    alpha = alpha_of(torch.as_tensor(roughness, dtype=torch.float64))
    half = torch.stack([torch.sqrt((1 - nh) * (1 + nh)), torch.zeros_like(nh), nh], -1)
    lobe = ggx_distribution(up, half, alpha) * smith_visibility(nv, nl, alpha)
    return (lobe * fresnel_schlick(vh, edge)[..., 0]).numpy()


def albedo(lobe: object, mu: float, roughness: float, *more: float, steps: int = 3000, turns: int = 256) -> float:
    """Directional albedo of `lobe`, with Fresnel 1, at cosine `mu`; midpoint rule over half vectors."""
    alpha2 = max(roughness, 0.03) ** 4
    u, phi = (np.arange(steps) + 0.5) / steps, (np.arange(turns) + 0.5) / turns * 2 * np.pi
    tan2 = (alpha2 * u / (1 - u))[:, None]
    nh = 1 / np.sqrt(1 + tan2)
    solid = 0.5 * nh**3 * alpha2 / (1 - u[:, None]) ** 2 / steps * 2 * np.pi / turns
    vh = np.sqrt(1 - mu * mu) * np.sqrt(tan2) * nh * np.cos(phi) + mu * nh
    nl = 2 * vh * nh - mu
    good = (nl > 0) & (vh > 0)
    values = lobe(np.maximum(nl, 0), mu, nh, np.maximum(vh, 0), roughness, 1.0, *more)  # type: ignore[operator]
    return float(np.where(good, values * nl * 4 * vh * solid, 0).sum())
