"""Directions drawn by cosine, by GGX visible normals and their densities, per steradian.

Every sampler takes uniform numbers (..., 2) in [0, 1) and gives unit directions (..., 3) away from the surface.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .brdf import dot, ggx_distribution, normalise, smith_root


def basis(normal: Tensor) -> tuple[Tensor, Tensor]:
    """Two tangents that complete unit `normal` (..., 3) to a right-handed frame (Duff et al. 2017)."""
    x, y, z = normal.unbind(-1)
    sign = torch.where(z < 0, -torch.ones_like(z), torch.ones_like(z))
    a = -1 / (sign + z)
    b = x * y * a
    tangent = torch.stack([1 + sign * x * x * a, sign * b, -sign * x], -1)
    bitangent = torch.stack([b, sign + y * y * a, -y], -1)
    return tangent, bitangent


def to_world(local: Tensor, normal: Tensor) -> Tensor:
    """Vectors of the frame (tangent, bitangent, normal) in world axes."""
    tangent, bitangent = basis(normal)
    return local[..., 0:1] * tangent + local[..., 1:2] * bitangent + local[..., 2:3] * normal


def to_local(vector: Tensor, normal: Tensor) -> Tensor:
    """World vectors in the frame (tangent, bitangent, normal)."""
    tangent, bitangent = basis(normal)
    return torch.stack([dot(vector, tangent), dot(vector, bitangent), dot(vector, normal)], -1)


def sample_cosine(normal: Tensor, u: Tensor) -> Tensor:
    """Directions with the density cos / pi (the disk, lifted)."""
    radius, phi = torch.sqrt(u[..., 0]), 2 * math.pi * u[..., 1]
    local = torch.stack([radius * torch.cos(phi), radius * torch.sin(phi), torch.sqrt(1 - u[..., 0])], -1)
    return to_world(local, normal)


def pdf_cosine(normal: Tensor, light: Tensor) -> Tensor:
    """Density of `sample_cosine` at `light`."""
    return dot(normal, light).clamp(min=0) / math.pi


def _cap_bound(cos_view: Tensor, alpha: Tensor, bounded: bool) -> Tensor:
    """Part of the stretched view's height below which no cap normal reflects above the surface; 1 keeps them all."""
    if not bounded:
        return torch.ones_like(cos_view * alpha)
    s2 = (1 + torch.sqrt((1 - cos_view**2).clamp(min=0))) ** 2
    return (1 - alpha**2) * s2 / (s2 + alpha**2 * cos_view**2)


def sample_ggx(normal: Tensor, view: Tensor, alpha: Tensor, u: Tensor, bounded: bool = False) -> Tensor:
    """Reflections of `view` at visible GGX normals; some end below the surface.

    The visible normals are a spherical cap once the surface is stretched to a hemisphere (Heitz 2018, in the form of
    Dupuy and Benyoub 2023). `bounded` leaves out a part of the cap that only reflects below the surface (Eto and
    Tokuyoshi 2023).
    """
    local = to_local(view, normal)
    width = torch.stack(torch.broadcast_tensors(alpha, alpha, torch.ones_like(alpha)), -1)
    stretched = normalise(local * width)
    lowest = _cap_bound(local[..., 2], alpha, bounded) * stretched[..., 2]
    phi = 2 * math.pi * u[..., 0]
    z = (1 - u[..., 1]) * (1 + lowest) - lowest
    sine = torch.sqrt((1 - z * z).clamp(min=0))
    cap = torch.stack(torch.broadcast_tensors(sine * torch.cos(phi), sine * torch.sin(phi), z), -1)
    half = normalise((cap + stretched) * width)
    return to_world(2 * dot(local, half).unsqueeze(-1) * half - local, normal)


def pdf_ggx(normal: Tensor, view: Tensor, light: Tensor, alpha: Tensor, bounded: bool = False) -> Tensor:
    """Density of `sample_ggx` at `light`: G1(view) D(half) / (4 cos_view), or more where the cap is `bounded`.

    Without the bound it integrates to one over the **sphere**: what is reflected below the surface counts. With it,
    the density is exact for directions above the surface; below, where a part is left out, it is not meant.
    """
    cosine = dot(normal, view)
    half = normalise(view + light)
    kept = _cap_bound(cosine, alpha, bounded) * cosine + smith_root(cosine, alpha)
    density = 0.5 * ggx_distribution(normal, half, alpha) / kept
    return torch.where((cosine > 0) & (dot(normal, half) > 0), density, torch.zeros_like(density))


def balance(densities: Tensor, counts: Tensor) -> Tensor:
    """Denominator of the multi-sample balance heuristic (Veach 1997): sum of count times density over the last axis.

    A sample of any strategy contributes integrand / balance; the sum over all samples of all strategies estimates
    the integral.
    """
    return (densities * counts).sum(-1)
