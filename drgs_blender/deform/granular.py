"""Granular surfels: where a granular surface is stretched, its surfels shrink to grains instead of a stretched skin."""

from __future__ import annotations

import dataclasses

import numpy as np

from ..core.asset.model import PosedSurfels

Array = np.ndarray

#: Radius of a grain over that of a round disc of the stretched surfel's area: turned any way, they still cover it.
_WIDTH = 1.3
#: Stretch from which on there are grains: more than rounding.
_FROM = 1.01
#: Spread of a grain's brightness, over that of its normal.
_SHADE = 0.5


def grainy(posed: PosedSurfels, scale: Array, grain: float) -> PosedSurfels:
    """Surfels that have become grains as far as they are stretched, entirely from half their length on.

    A grain is round, faces and shines a little otherwise than its surface does, always in the same way.

    Parameters
    ----------
    posed : PosedSurfels
        Surfels of one object.
    scale : (n, 2) array
        Their scales where nothing is stretched, metres.
    grain : float
        Standard deviation of the normals' slopes.
    """
    u, v = posed.tangent_u.astype(np.float64), posed.tangent_v.astype(np.float64)
    uu, vv, uv = (np.einsum("nc,nc->n", a, b) for a, b in ((u, u), (v, v), (u, v)))
    area = np.sqrt(np.maximum(uu * vv - uv * uv, 0.0))
    longest = np.sqrt(0.5 * (uu + vv) + np.hypot(0.5 * (uu - vv), uv))
    amount = np.clip(2 * (longest / np.maximum(scale.max(axis=1), 1e-30) - _FROM), 0, 1)[:, None]
    amount[area < 1e-6 * longest**2] = 0.0  # a line is no grain
    own = np.random.default_rng(0).normal(size=(len(u), 4))

    slope = own[:, :3] - np.einsum("nc,nc->n", own[:, :3], posed.normal)[:, None] * posed.normal
    normal = posed.normal + grain * amount * slope
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    first = u / np.sqrt(np.maximum(uu, 1e-60))[:, None]
    across = v - np.einsum("nc,nc->n", v, first)[:, None] * first
    second = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
    radius = _WIDTH * np.sqrt(area)[:, None]
    shade = np.exp(_SHADE * grain * amount * own[:, 3:])
    return dataclasses.replace(
        posed,
        tangent_u=(u + amount * (radius * first - u)).astype(np.float32),
        tangent_v=(v + amount * (radius * second - v)).astype(np.float32),
        normal=normal.astype(np.float32),
        albedo=np.clip(posed.albedo * shade, 0, 1).astype(np.float32),
    )
