"""Tabulated albedos of GGX lobes, by which Cycles layers lobes and makes up for light between microfacets.

Computed here, by visible normals, on Cycles' grids. Light that meets a second microfacet is lost, the more the rougher
the surface. Multiscatter GGX divides a lobe by what is left of it, E, and colours what it adds by Fresnel (Kulla and
Conty 2017; Turquin 2019), as Cycles' ``microfacet_ggx_preserve_energy`` does.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from ....compute.jit import njit
from ...sampling import ONE, ZERO, F

Array = np.ndarray

_NODES, _FINE = 16, 32


class AlbedoTables(NamedTuple):
    """Tables over roughness (last axis) and cosine to the viewer (second to last).

    Attributes
    ----------
    real : (16, 16, 16) float32 array
        By z = sqrt|(eta - 1) / (eta + 1)| first: mean of (Fresnel - F0) / (1 - F0).
    schlick : (16, 16) float32 array
        Mean of Schlick's (1 - cosine)^5.
    energy : (32, 32) float32 array
        E: albedo of GGX that reflects all light.
    mean_energy : (32,) float32 array
        Mean of E over the cosines, by roughness.
    glass : (2, 16, 16, 16) float32 array
        Of glass, reflected and refracted, as a path enters (0) and leaves (1), by z; empty where nothing needs it.
    """

    real: Array
    schlick: Array
    energy: Array
    mean_energy: Array
    glass: Array


@functools.cache
def albedo_tables(glass: bool) -> AlbedoTables:
    """The tables, that of glass only where asked for: it takes a second."""
    real, schlick = np.zeros((_NODES,) * 3), None
    grid, normals, ggx = _sampled(_NODES, 512)
    vh, above, _ = _reflected(*normals)
    for node, z in enumerate(_grid(_NODES)):
        eta = _eta(z)
        f0 = ((eta - 1) / (eta + 1)) ** 2
        real[node] = np.where(above, (_fresnel(vh, eta)[0] - f0) / max(1 - f0, 1e-9), 0).mean(-1)
    schlick = np.where(above, np.maximum(0, 1 - vh) ** 5, 0).mean(-1)
    found = _glass(grid, normals, ggx) if glass else np.ones((2, 1, 1, 1))
    _, fine, ggx = _sampled(_FINE, 1024)
    _, above, o = _reflected(*fine)
    energy = np.where(above, _shadowed(fine[0], o, ggx), 0).mean(-1)
    mu = _grid(_FINE)
    mean = np.trapezoid(2 * mu[:, None] * energy, mu, axis=0)
    return AlbedoTables(*(np.clip(t, 0, 1).astype(np.float32) for t in (real, schlick, energy, mean, found)))


def _grid(nodes: int) -> Array:
    return np.clip(np.arange(nodes) / (nodes - 1), 1e-4, 1 - 1e-4)


def _eta(z: float) -> float:
    return (1 + z * z) / (1 - z * z)


def _sampled(nodes: int, count: int) -> tuple[Array, tuple[Array, Array], Array]:
    """Grid; directions to the viewer and visible normals of each of its cosines and roughnesses; and alpha."""
    index = np.arange(count)
    u, turn = (index + 0.5) / count, 2 * np.pi * ((index * 0.6180339887498949) % 1.0)
    mu, rough = np.meshgrid(_grid(nodes), np.clip(np.arange(nodes) / (nodes - 1), 1e-2, 1), indexing="ij")
    alpha, zero = (rough**2)[..., None], np.zeros((nodes, nodes, 1))
    i = np.stack([np.sqrt(1 - mu**2)[..., None], zero, mu[..., None]])
    stretched = i * np.stack([alpha, alpha, zero + 1])
    stretched /= np.sqrt((stretched**2).sum(0))
    z = (1 - u) * (1 + stretched[2]) - stretched[2]
    ring = np.sqrt(np.maximum(0, 1 - z * z))
    h = np.stack([alpha * (ring * np.cos(turn) + stretched[0]), alpha * ring * np.sin(turn), z + stretched[2]])
    return mu, (i, h / np.sqrt((h**2).sum(0))), alpha


def _reflected(i: Array, h: Array) -> tuple[Array, Array, Array]:
    """Cosine of direction and normal, whether the mirrored direction is above the surface, and that direction."""
    vh = (i * h).sum(0)
    o = 2 * vh * h - i
    return vh, o[2] > 0, o


def _shadowed(i: Array, o: Array, alpha: Array) -> Array:
    """G2 / G1."""

    def smith(w: Array) -> Array:
        return (np.sqrt(1 + alpha**2 * (1 - w[2] ** 2) / np.maximum(w[2] ** 2, 1e-12)) - 1) / 2

    return (1 + smith(i)) / (1 + smith(i) + smith(o))


def _fresnel(c: Array, eta: float) -> tuple[Array, Array]:
    """Reflectance and the cosine of the refracted direction."""
    t2 = 1 - (1 - c * c) / eta**2
    t = np.sqrt(np.maximum(t2, 0))
    across, along = (c - eta * t) / (c + eta * t), (eta * c - t) / (eta * c + t)
    return np.where(t2 > 0, (across**2 + along**2) / 2, 1.0), t


def _glass(grid: Array, normals: tuple[Array, Array], alpha: Array) -> Array:
    i, h = normals
    vh, above, mirrored = _reflected(i, h)
    kept = np.where(above, _shadowed(i, mirrored, alpha), 0)
    found = np.zeros((2, _NODES, *grid.shape))
    for inside in (0, 1):
        for node, z in enumerate(_grid(_NODES)):
            eta = 1 / _eta(z) if inside else _eta(z)
            f, t = _fresnel(vh, eta)
            o = (vh / eta - t) * h - i / eta
            passed = np.where(o[2] < 0, _shadowed(i, o, alpha), 0)
            found[inside, node] = (f * kept + (1 - f) * passed).mean(-1)
    return found


@njit
def _linear(x, nodes):  # type: ignore[no-untyped-def]
    """Node below x in [0, 1], and the part of the way to the next."""
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
    i, a = _linear(roughness, table.shape[1])
    j, b = _linear(cosine, table.shape[0])
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
    i, a = _linear(roughness, table.shape[0])
    return table[i] + a * (table[i + 1] - table[i])


@njit
def read_3d(table, z, cosine, roughness):  # type: ignore[no-untyped-def]
    """A table over z, cosine and roughness, trilinear.

    Parameters
    ----------
    table : (n, n, n) float32 array
    z, cosine, roughness : float32
        Clamped to [0, 1].

    Returns
    -------
    float32
    """
    k, c = _linear(z, table.shape[0])
    low, high = read_2d(table[k], cosine, roughness), read_2d(table[k + 1], cosine, roughness)
    return low + c * (high - low)
