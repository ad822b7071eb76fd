"""Tabulated albedos of GGX lobes, by which Cycles layers lobes and makes up for light between microfacets.

Computed here, by visible normals, on Cycles' grids. What Multiscatter GGX does with them is in `multiscatter`.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from ....compute.jit import njit
from ..multiscatter import energy_tables, grid_of, linear, read_2d, reflected, sampled, shadowed

Array = np.ndarray

_NODES = 16


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
    real = np.zeros((_NODES,) * 3)
    grid, normals, ggx = sampled(_NODES, 512)
    vh, above, _ = reflected(*normals)
    for node, z in enumerate(grid_of(_NODES)):
        eta = _eta(z)
        f0 = ((eta - 1) / (eta + 1)) ** 2
        real[node] = np.where(above, (_fresnel(vh, eta)[0] - f0) / max(1 - f0, 1e-9), 0).mean(-1)
    schlick = np.where(above, np.maximum(0, 1 - vh) ** 5, 0).mean(-1)
    found = _glass(grid, normals, ggx) if glass else np.ones((2, 1, 1, 1))
    kept = [np.clip(t, 0, 1).astype(np.float32) for t in (real, schlick, found)]
    return AlbedoTables(kept[0], kept[1], *energy_tables(), kept[2])


def _eta(z: float) -> float:
    return (1 + z * z) / (1 - z * z)


def _fresnel(c: Array, eta: float) -> tuple[Array, Array]:
    """Reflectance and the cosine of the refracted direction."""
    t2 = 1 - (1 - c * c) / eta**2
    t = np.sqrt(np.maximum(t2, 0))
    across, along = (c - eta * t) / (c + eta * t), (eta * c - t) / (eta * c + t)
    return np.where(t2 > 0, (across**2 + along**2) / 2, 1.0), t


def _glass(grid: Array, normals: tuple[Array, Array], alpha: Array) -> Array:
    i, h = normals
    vh, above, mirrored = reflected(i, h)
    kept = np.where(above, shadowed(i, mirrored, alpha), 0)
    found = np.zeros((2, _NODES, *grid.shape))
    for inside in (0, 1):
        for node, z in enumerate(grid_of(_NODES)):
            eta = 1 / _eta(z) if inside else _eta(z)
            f, t = _fresnel(vh, eta)
            o = (vh / eta - t) * h - i / eta
            passed = np.where(o[2] < 0, shadowed(i, o, alpha), 0)
            found[inside, node] = (f * kept + (1 - f) * passed).mean(-1)
    return found


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
    k, c = linear(z, table.shape[0])
    low, high = read_2d(table[k], cosine, roughness), read_2d(table[k + 1], cosine, roughness)
    return low + c * (high - low)
