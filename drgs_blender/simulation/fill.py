"""Interior particles of a mesh, also of one that is open, self-intersecting or inside out.

Rays along three axes count how often they enter and leave at every cell. Where they agree, that is the winding number;
where a hole makes them differ, the generalised one decides (Jacobson et al. 2013; fast form Barill et al. 2018). Where
that has no meaning, because faces are not oriented alike, the vote of the three rays' parities does.
"""

from __future__ import annotations

import importlib.util
import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage

from ..compute.jit import njit
from ..core.errors import AssetError, DeviceError, UsageError
from ..geometry.occupancy import Volume

Array = np.ndarray
log = logging.getLogger(__name__)

#: Most cells along the longest side, and in all.
MOST_ALONG, MOST_CELLS = 1024, 1 << 27
#: Connected parts smaller than this share of the largest one, or of fewer cells, are dropped as debris.
SMALLEST_SHARE, SMALLEST_CELLS = 1e-3, 8
#: Share of the interior in dispute between rays, other than by holes, beyond which their directions mean nothing.
UNDECIDED = 0.1


@dataclass(frozen=True, slots=True)
class Filling:
    """Particles inside a mesh.

    Attributes
    ----------
    points : (n, 3) float64 array
        Metres, in the frame of the mesh.
    volume : (n,) float32 array
        Cubic metres of space that each stands for.
    part : (n,) int32 array
        Number of the connected part.
    space : Volume
        The cells themselves.
    report : dict
        "particles", "parts", "dropped_parts", "dropped_cells", "method" ("winding number" or "ray parity"),
        "bare_vertices": vertices farther than two cells from any particle, whose surroundings are too thin to fill.
    """

    points: Array
    volume: Array
    part: Array
    space: Volume
    report: dict[str, Any]


def fill(
    vertices: Array,
    faces: Array,
    spacing: float,
    *,
    jitter: float = 0.0,
    seed: int = 0,
    method: str = "auto",
    name: str = "mesh",
) -> Filling:
    """Put one particle into every cell of side `spacing` whose centre is inside the mesh.

    Parameters
    ----------
    vertices : (n, 3) float array
        Metres.
    faces : (m, 3) int array
        Need not be closed, free of intersections, or oriented outwards.
    spacing : float
        Metres between particles.
    jitter : float
        Random displacement of particles, in cells, up to 1: sand and snow show no rows then.
    seed : int
        Of the jitter.
    method : str
        "winding", "parity" or "auto".
    name : str
        Of the mesh, in messages.

    Raises
    ------
    AssetError
        The mesh has no interior at this spacing.
    UsageError
        A spacing that is not positive or asks for more cells than there is memory for.
    """
    vertices = np.ascontiguousarray(vertices, np.float64)
    faces = np.ascontiguousarray(faces, np.int64)
    if not len(faces) or not np.isfinite(vertices[faces]).all():
        raise AssetError(name, "has no faces, or vertices that are not finite", "Clean the mesh up")
    if not (np.isfinite(spacing) and spacing > 0):
        raise UsageError("particle spacing", f"is {spacing}", "Give a positive number of metres")
    low, high = vertices[faces].min(axis=(0, 1)), vertices[faces].max(axis=(0, 1))
    size = np.ceil((high - low) / spacing).astype(np.int64) + 2
    if size.max() > MOST_ALONG or size.prod() > MOST_CELLS:
        raise UsageError(
            "particle spacing",
            f"of {spacing:g} m makes {size[0]} x {size[1]} x {size[2]} cells",
            f"Use a spacing of at least {(high - low).max() / 256:.3g} m",
        )
    # The mesh in the middle of its cells, so that a symmetric mesh is filled symmetrically.
    origin = 0.5 * (low + high) - 0.5 * size * spacing
    inside, used = _inside(vertices, faces, origin, spacing, size, method, name)
    part, report = _parts(inside)
    report["method"] = used
    if not report["parts"]:
        raise AssetError(
            name,
            f"has no interior at a particle spacing of {spacing:.3g} m",
            "Close its large holes, give it thickness (Solidify), or use a smaller spacing",
        )
    space = Volume(origin, float(spacing), part)
    points = space.centres()
    if jitter:
        points += (np.random.default_rng(seed).random(points.shape) - 0.5) * (min(jitter, 1.0) * spacing)
    report["particles"] = len(points)
    reach = ndimage.binary_dilation(part >= 0, np.ones((3, 3, 3)), iterations=2)
    cell = np.clip(((vertices - origin) / spacing).astype(np.int64), 0, size - 1)
    report["bare_vertices"] = int(np.count_nonzero(~reach[tuple(cell.T)]))
    return Filling(points, np.full(len(points), spacing**3, np.float32), part[part >= 0], space, report)


def _inside(
    vertices: Array, faces: Array, origin: Array, spacing: float, size: Array, method: str, name: str
) -> tuple[Array, str]:
    """Which cells are inside, (nx, ny, nz) bool, and the method that said so."""
    odd, deep = np.zeros(size, np.uint8), np.zeros(size, np.uint8)
    for axis in range(3):
        turn = np.roll(np.arange(3), -axis)  # the axis first
        corners = np.ascontiguousarray(((vertices - origin) / spacing)[:, turn][faces])
        entered = np.zeros(size[turn], np.int16)
        _enter(corners, entered)
        np.cumsum(entered, axis=0, out=entered)
        entered = entered.transpose(np.argsort(turn))
        odd += (entered & 1).astype(np.uint8)
        deep += entered != 0
    torn, disputed = ((votes == 1) | (votes == 2) for votes in (odd, deep))
    # Rays in all three directions count alike but for holes, unless faces point anywhere: then only parity does.
    mixed = np.count_nonzero(disputed) > 2 * np.count_nonzero(torn) + UNDECIDED * np.count_nonzero(deep >= 2)
    if method == "auto" and mixed:
        log.warning("%s: its faces are not oriented alike; its interior is found by ray parity", name)
    if method == "parity" or (method == "auto" and mixed):
        return odd >= 2, "ray parity"
    if importlib.util.find_spec("igl") is None:
        if method == "winding":
            raise DeviceError("libigl", "is not installed", "Install the engine's environment again")
        return deep >= 2, "ray parity"
    inside = deep >= 2
    cells = np.argwhere(ndimage.binary_dilation(disputed))
    if len(cells):
        import igl

        number = np.abs(igl.fast_winding_number(vertices, faces, origin + (cells + 0.5) * spacing))
        inside[tuple(cells.T)] = number >= 0.5
    return inside, "winding number"


@njit
def _enter(corners, entered):  # type: ignore[no-untyped-def]
    """Count, in each column along the first axis, at the first cell whose centre is beyond a face: 1 in, -1 out.

    Columns are moved by a small irrational part of a cell, so that none meets an edge of a mesh made on a grid.
    """
    nx, ny, nz = entered.shape
    sy, sz = 0.5 + 1.4142135e-5, 0.5 + 1.7320508e-5
    for f in range(len(corners)):
        ax, ay, az = corners[f, 0, 0], corners[f, 0, 1], corners[f, 0, 2]
        bx, by, bz = corners[f, 1, 0], corners[f, 1, 1], corners[f, 1, 2]
        cx, cy, cz = corners[f, 2, 0], corners[f, 2, 1], corners[f, 2, 2]
        area = (by - ay) * (cz - az) - (bz - az) * (cy - ay)
        if area == 0.0:
            continue
        way = -1 if area > 0.0 else 1
        for j in range(max(0, int(min(ay, by, cy) - sy)), min(ny, int(max(ay, by, cy) - sy) + 2)):
            for k in range(max(0, int(min(az, bz, cz) - sz)), min(nz, int(max(az, bz, cz) - sz) + 2)):
                y, z = j + sy, k + sz
                u = ((by - y) * (cz - z) - (bz - z) * (cy - y)) / area
                v = ((cy - y) * (az - z) - (cz - z) * (ay - y)) / area
                w = ((ay - y) * (bz - z) - (az - z) * (by - y)) / area
                if u < 0.0 or v < 0.0 or w < 0.0:
                    continue
                i = max(0, int(np.ceil(u * ax + v * bx + w * cx - 0.5)))
                if i < nx:
                    entered[i, j, k] += way


def _parts(inside: Array) -> tuple[Array, dict[str, Any]]:
    """Number connected cells (by faces) from the largest part on, and drop debris."""
    label, count = ndimage.label(inside)
    sizes = np.bincount(label.reshape(-1), minlength=count + 1)[1:]
    largest = sizes.max(initial=0)
    keep = sizes >= max(SMALLEST_SHARE * largest, min(SMALLEST_CELLS, largest)) if count else sizes > 0
    number = np.full(count + 1, -1, np.int32)
    rank = np.argsort(-sizes, kind="stable")
    rank = rank[keep[rank]]
    number[rank + 1] = np.arange(len(rank), dtype=np.int32)
    dropped = int(count - keep.sum())
    if dropped:
        log.info("%d small parts of %d cells in all were left out", dropped, sizes[~keep].sum())
    report = {"parts": int(keep.sum()), "dropped_parts": dropped, "dropped_cells": int(sizes[~keep].sum())}
    return np.ascontiguousarray(number[label]), report
