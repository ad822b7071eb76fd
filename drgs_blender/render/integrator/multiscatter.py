"""Multiscatter GGX: what light that meets a second microfacet adds to lobes of GGX, and the tables that say how much.

GGX loses that light, the more the rougher the surface. As Cycles' ``microfacet_ggx_preserve_energy`` does, a lobe keeps
its shape and its pdf, and its value is scaled by 1 + F' E' / (1 - F' (1 - E')) (1 - E) / E (Kulla and Conty 2017;
Turquin 2019), with E the directional albedo of GGX that reflects all light, E' the mean of E over cosine-weighted
directions and F' that of the Fresnel reflectance. A diffuse lobe below gets what the layer leaves, which Cycles reckons
without dividing by E.
"""

from __future__ import annotations

import functools

import numpy as np

from ...compute.jit import inlined, njit
from ...core.arrays import Array
from ..memory import load_int32, load_int64
from ..sampling import ONE, ZERO, F
from ..scene.detailed_normal import MULTISCATTER_TABLE
from . import brdf

_NODES = 32
#: Mean of the Fresnel reflectance of IOR 1.5 (fit of Kulla and Conty 2017), and of Schlick's term.
_DIELECTRIC, _SCHLICK = F((1.5 - 1.0) / (4.08567 + 1.00071 * 1.5)), F(1.0 / 21.0)
_TINY = F(1e-6)


@functools.cache
def energy_tables() -> tuple[Array, Array]:
    """E, (32, 32) float32 over cosine to the viewer and roughness, and its mean E', (32,) float32 over roughness."""
    rows = []
    for cosine in range(_NODES):  # one by one: together their samples take more memory than many a scene
        _, normals, alpha = sampled(_NODES, 1024, slice(cosine, cosine + 1))
        _, above, o = reflected(*normals)
        rows.append(np.where(above, shadowed(normals[0], o, alpha), 0).mean(-1))
    energy, mu = np.concatenate(rows), grid_of(_NODES)
    weighted = 2 * mu[:, None] * energy
    mean = (np.diff(mu)[:, None] * (weighted[1:] + weighted[:-1]) / 2.0).sum(axis=0)  # NumPy 1 has no trapezoid
    return np.clip(energy, 0, 1).astype(np.float32), np.clip(mean, 0, 1).astype(np.float32)


def grid_of(nodes: int) -> Array:
    return np.clip(np.arange(nodes) / (nodes - 1), 1e-4, 1 - 1e-4)


def sampled(nodes: int, count: int, cosines: slice = slice(None)) -> tuple[Array, tuple[Array, Array], Array]:
    """Grid; directions to the viewer and visible normals of each of its cosines and roughnesses; and alpha."""
    index = np.arange(count)
    u, turn = (index + 0.5) / count, 2 * np.pi * ((index * 0.6180339887498949) % 1.0)
    mu, rough = np.meshgrid(grid_of(nodes)[cosines], np.clip(np.arange(nodes) / (nodes - 1), 1e-2, 1), indexing="ij")
    alpha, zero = (rough**2)[..., None], np.zeros((*mu.shape, 1))
    i = np.stack([np.sqrt(1 - mu**2)[..., None], zero, mu[..., None]])
    stretched = i * np.stack([alpha, alpha, zero + 1])
    stretched /= np.sqrt((stretched**2).sum(0))
    z = (1 - u) * (1 + stretched[2]) - stretched[2]
    ring = np.sqrt(np.maximum(0, 1 - z * z))
    h = np.stack([alpha * (ring * np.cos(turn) + stretched[0]), alpha * ring * np.sin(turn), z + stretched[2]])
    return mu, (i, h / np.sqrt((h**2).sum(0))), alpha


def reflected(i: Array, h: Array) -> tuple[Array, Array, Array]:
    """Cosine of direction and normal, whether the mirrored direction is above the surface, and that direction."""
    vh = (i * h).sum(0)
    o = 2 * vh * h - i
    return vh, o[2] > 0, o


def shadowed(i: Array, o: Array, alpha: Array) -> Array:
    """G2 / G1."""

    def smith(w: Array) -> Array:
        return (np.sqrt(1 + alpha**2 * (1 - w[2] ** 2) / np.maximum(w[2] ** 2, 1e-12)) - 1) / 2

    return (1 + smith(i)) / (1 + smith(i) + smith(o))


@njit
def linear(x, nodes):  # type: ignore[no-untyped-def]
    """Node of a table below x in [0, 1], and the part of the way to the next.

    Parameters
    ----------
    x : float32
        Clamped to [0, 1].
    nodes : int64

    Returns
    -------
    i : int64
    part : float32
    """
    x = min(max(x, ZERO), ONE) * F(nodes - 1)
    i = min(int(x), nodes - 2)
    return i, x - F(i)


@njit
def read_2d(table, cosine, roughness):  # type: ignore[no-untyped-def]
    """A table over cosine and roughness, bilinear.

    Parameters
    ----------
    table : (n, n) float32 array
    cosine, roughness : float32
        Clamped to [0, 1].

    Returns
    -------
    float32
    """
    i, a = linear(roughness, table.shape[1])
    j, b = linear(cosine, table.shape[0])
    low = table[j, i] + a * (table[j, i + 1] - table[j, i])
    high = table[j + 1, i] + a * (table[j + 1, i + 1] - table[j + 1, i])
    return low + b * (high - low)


@njit
def read_1d(table, roughness):  # type: ignore[no-untyped-def]
    """A table over roughness, linear.

    Parameters
    ----------
    table : (n,) float32 array
    roughness : float32
        Clamped to [0, 1].

    Returns
    -------
    float32
    """
    i, a = linear(roughness, table.shape[0])
    return table[i] + a * (table[i + 1] - table[i])


@njit
def lobe_albedo(nv, roughness, tables):  # type: ignore[no-untyped-def]
    """E: directional albedo of a lobe of GGX that reflects all light.

    Parameters
    ----------
    nv : float32
        Cosine between viewer and normal.
    roughness : float32
        In [0, 1].
    tables : Settings or AlbedoTables

    Returns
    -------
    float32
        In (0, 1].
    """
    return max(read_2d(tables.energy, nv, roughness), F(1e-3))


@inlined
def added_light(missing, fresnel, mean):  # type: ignore[no-untyped-def]
    """Light of further microfacets over that of the first.

    Parameters
    ----------
    missing : float32
        (1 - E) / E.
    fresnel : float32
        Mean Fresnel reflectance F'.
    mean : float32
        E'.

    Returns
    -------
    float32
    """
    return missing * fresnel * mean / max(ONE - fresnel * (ONE - mean), _TINY)


@njit
def lobe_weights(nv, roughness, metallic, albedo, is_multiscatter, settings):  # type: ignore[no-untyped-def]
    """Weights of a surface's lobes, as `brdf.evaluate` takes them.

    Parameters
    ----------
    nv : float32
        Cosine between viewer and normal of the specular lobe.
    roughness, metallic : float32
        In [0, 1].
    albedo : tuple of float32
        Linear Rec.709.
    is_multiscatter : bool
        Whether the material has Multiscatter GGX; the shading model `paper` has none.
    settings : Settings

    Returns
    -------
    kd : float32
        Of the diffuse lobe, see `brdf.diffuse_weight`.
    metal : tuple of float32
        Of the specular lobe's metal, by channel.
    dielectric : float32
        Of the specular lobe's dielectric layer.
    """
    kd = brdf.diffuse_weight(roughness, metallic, nv, settings.shading_model, settings.layers)
    rest = ONE - metallic
    if not is_multiscatter or settings.shading_model == brdf.PAPER:
        return kd, (metallic, metallic, metallic), rest
    e, mean = lobe_albedo(nv, roughness, settings), read_1d(settings.mean_energy, roughness)
    missing = (ONE - e) / e
    added = added_light(missing, _DIELECTRIC, mean)
    if kd > ZERO:
        kd = rest - (rest - kd) * (ONE + added) / (ONE + missing)
    r, g, b = min(albedo[0], ONE), min(albedo[1], ONE), min(albedo[2], ONE)
    return (
        kd,
        (
            metallic * (ONE + added_light(missing, r + (ONE - r) * _SCHLICK, mean)),
            metallic * (ONE + added_light(missing, g + (ONE - g) * _SCHLICK, mean)),
            metallic * (ONE + added_light(missing, b + (ONE - b) * _SCHLICK, mean)),
        ),
        rest * (ONE + added),
    )


@njit
def has_multiscatter(face, geometry):  # type: ignore[no-untyped-def]
    """Whether the material of a face has Multiscatter GGX.

    Parameters
    ----------
    face : int32
        Of the scene; -1 of surfels.
    geometry : Geometry

    Returns
    -------
    bool
    """
    own = np.int64(face) - geometry.vertex_faces
    if face < 0 or own < 0:
        return False
    material = np.int64(load_int32(geometry.material, own))
    return load_int32(load_int64(geometry.materials, MULTISCATTER_TABLE), material) != 0
