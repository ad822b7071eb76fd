"""Sheets: a flat quadrilateral for each surfel, as what rays meet where no good mesh can be fused.

Blending surfels along rays, `surfel_tracer`, takes several times as long; a sheet is opaque and two triangles.
"""

from __future__ import annotations

import numpy as np

from ...core.arrays import Array

#: How far a sheet may lie off its surfel's plane, in parts of its sides: of two in one plane, either would be met.
OFF = 1e-3
_GOLDEN = 0.6180339887498949


def sheets(centre: Array, tangent_u: Array, tangent_v: Array, opacity: Array) -> tuple[Array, Array]:
    """Vertices (4 n, 3) float32 and faces (2 n, 3) int32 of the sheets of n surfels, as of `PosedSurfels`.

    The sides are along the tangents. Their area is the kernel's, 2 pi opacity |u| |v|.
    Each is moved along its normal, by up to `OFF` as its number says, so that no two of one face are in one plane.
    """
    half = np.sqrt(0.5 * np.pi * opacity.astype(np.float64))[:, None]
    u, v = half * tangent_u, half * tangent_v
    normal = np.cross(u, v)
    quarter = np.sqrt(np.maximum((normal * normal).sum(axis=1, keepdims=True), 1e-60))  # of its area
    move = 2.0 * np.mod(_GOLDEN * np.arange(len(centre)), 1.0)[:, None] - 1.0  # far apart for numbers that are near
    centre = centre + 2.0 * OFF * move * normal / np.sqrt(quarter)
    corners = np.stack([centre - u - v, centre + u - v, centre + u + v, centre - u + v], axis=1)
    first = 4 * np.arange(len(centre), dtype=np.int32)[:, None, None]
    faces = first + np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return corners.reshape(-1, 3).astype(np.float32), faces.reshape(-1, 3)
