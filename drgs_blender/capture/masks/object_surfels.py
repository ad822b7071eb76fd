"""The surfels of a learned scene that are the object's: above the ground, in the box, connected, and their foot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import binary_dilation, label
from scipy.spatial import cKDTree

from ...core.arrays import Array
from ...core.frame import Camera
from ...reconstruct.model.gaussians import Gaussians
from .object_box import ObjectBox

#: Surfels over which heights are averaged, with themselves.
_NEIGHBOURS = 6
#: Where the ground is fitted, in parts of the box's largest side: distance from the middle, height above the plane.
_AROUND, _THICK = 1.5, 0.08
#: Least height of the object in parts of the box's largest side, and in deviations of the ground.
_LEAST, _DEVIATIONS = 0.006, 3.0
#: What is lower is the object's foot where it is steep: largest part of its normal that is vertical, how far it lies
#: from the object's lowest part and how low it may be, and how high that part is, in parts of the least height.
_STEEP, _FOOT, _FOOT_BELOW = 0.5, 2.0, 2.0
#: The least height in parts of the box's largest side, at most, for that: rough ground has steep surfels of its own.
_MOST_FOOT = 0.02
#: Fainter surfels are nobody's; larger ones, in parts of the box's largest side, are what is behind.
_FAINT, _LARGEST = 0.1, 0.3
#: Cells along the box's largest side in which parts are connected; margin beyond the box, in parts of that side.
_CELLS, _BEYOND = 40, 0.1
#: Part of the main part's weight that another part of the object has at least.
_SMALL = 0.004
#: Margin of the box around the object, in parts of its largest side; part of its surfels left out on each side.
_MARGIN, _STRAYS = 0.12, 0.002


@dataclass(slots=True)
class Cut:
    """What of a learned scene is the object.

    Attributes
    ----------
    surfels : (n,) bool array
    noise : float
        Deviation of the ground's surfels from a plane, in parts of the box's largest side.
    """

    surfels: Array
    noise: float


def cut_object(scene: Gaussians, box: ObjectBox) -> Cut:
    """Find the object.

    Parameters
    ----------
    scene : Gaussians
        Z up, ground near 0.
    box : ObjectBox
        Where it is sought.
    """
    centre = scene.centres().detach().numpy().astype(np.float64)
    opacity = scene.opacities().detach().numpy()
    deviations = np.exp(scene.parameters["scale"].detach().numpy())
    size, middle = float((box.high - box.low).max()), (box.low + box.high) / 2
    flat = np.linalg.norm((centre - middle)[:, :2], axis=1)
    seen = (opacity > _FAINT) & (deviations.max(axis=1) < _LARGEST * size) & (flat < 2 * _AROUND * size)
    if not seen.any():
        return Cut(seen, 0.0)
    weight = opacity * deviations.prod(axis=1)
    height = np.full(len(centre), -np.inf)
    height[seen], noise = _heights(centre[seen], weight[seen], middle, size)
    least = max(_LEAST * size, _DEVIATIONS * noise)
    above = height > least
    low, high = box.low - _BEYOND * size, box.high + _BEYOND * size
    near = above & (centre >= [*low[:2], -np.inf]).all(axis=1) & (centre <= high).all(axis=1)
    kept = np.zeros(len(centre), bool)
    if near.any():
        away = flat[near] / (size / 2)
        kept[near] = _connected(centre[near], weight[near] * np.exp(-4 * away**2), size / _CELLS)
    kept |= _foot(centre[:, :2], scene.frames()[2], kept, seen, height, min(least, _MOST_FOOT * size))
    return Cut(kept, noise / size)


def _foot(places: Array, normals: Array, kept: Array, seen: Array, height: Array, least: float) -> Array:
    """(n,) bool: the surfels of walls, seen from above at `places` (n, 2), that go on below the least height.

    Ground is flat.
    """
    foot = np.zeros(len(kept), bool)
    lowest = kept & (height < _FOOT * least)
    steep = np.abs(normals[:, 2]) <= _STEEP
    asked = np.flatnonzero(seen & ~kept & steep & (height <= least) & (height > -_FOOT_BELOW * least))
    if lowest.any() and len(asked):
        away, _ = cKDTree(places[lowest]).query(places[asked])
        foot[asked[away < _FOOT * least]] = True
    return foot


def _heights(places: Array, weight: Array, middle: Array, size: float) -> tuple[Array, float]:
    """Mean heights above the ground of surfels and their neighbours, and the deviation of the ground from a plane.

    The plane is that of the surfels around, by least squares, reweighted.
    """
    nearest = cKDTree(places).query(places, k=min(_NEIGHBOURS, len(places)))[1].reshape(len(places), -1)
    share = weight[nearest] / np.maximum(weight[nearest].sum(axis=1, keepdims=True), 1e-30)
    smooth = np.einsum("nk,nkc->nc", share, places[nearest])
    local = np.column_stack([(smooth - middle)[:, :2], np.ones(len(smooth))])
    ground = (np.linalg.norm(local[:, :2], axis=1) < _AROUND * size) & (np.abs(smooth[:, 2]) < _THICK * size)
    if ground.sum() < 10:
        return smooth[:, 2], 0.0
    rows, heights = local[ground], smooth[ground, 2]
    factor = np.ones(len(rows))
    for _ in range(12):
        plane = np.linalg.lstsq(rows * factor[:, None], heights * factor, rcond=None)[0]
        off = heights - rows @ plane
        # what stands on the ground is above it: the deviation is that of what lies below
        below = off[off < 0]
        noise = 1.48 * float(np.median(-below)) + 1e-9 if len(below) else 1e-9
        factor = 1 / np.maximum(np.abs(off) / noise, 1)
        factor[off > 2 * noise] = 0
    return smooth[:, 2] - local @ plane, noise


def _connected(places: Array, weight: Array, cell: float) -> Array:
    """(n,) bool: the part with the largest weight, and others that are not small."""
    cells = np.floor((places - places.min(axis=0)) / cell).astype(int) + 1
    grid = np.zeros(cells.max(axis=0) + 2, bool)
    grid[tuple(cells.T)] = True
    parts, count = label(binary_dilation(grid, np.ones((3, 3, 3))))
    of = parts[tuple(cells.T)]
    total = np.bincount(of, weight, minlength=count + 1)
    return (total >= _SMALL * total.max())[of]


def box_around(scene: Gaussians, cut: Cut, points: Array) -> ObjectBox:
    """The box of the object's surfels with a margin, down to the ground at least.

    Parameters
    ----------
    scene : Gaussians
    cut : Cut
        With surfels.
    points : (n, 3) float64 array
        Points on the object.
    """
    places = scene.centres().detach().numpy()[cut.surfels].astype(np.float64)
    low, high = np.quantile(places, [_STRAYS, 1 - _STRAYS], axis=0)
    margin = _MARGIN * float((high - low).max())
    low[:2], high[:2] = low[:2] - margin, high[:2] + margin
    low[2], high[2] = min(0.0, low[2]), max(high[2], 0.0) + margin  # flat ones may lie below 0
    return ObjectBox(low, high, points)


def share_of_object(scene: Gaussians, cut: Cut, camera: Camera) -> Array:
    """(h, w) float32 in 0..1: the part of each pixel that surfels of the object cover, behind what stands before them.

    Parameters
    ----------
    scene : Gaussians
    cut : Cut
    camera : Camera
    """
    return _seen(scene, torch.from_numpy(cut.surfels.astype(np.float32))[:, None], camera)[..., 0].copy()


def height_of_object(scene: Gaussians, cut: Cut, camera: Camera) -> Array:
    """(h, w) float32: the mean height above z = 0 of what `share_of_object` counts; 0 where that is nothing.

    Parameters
    ----------
    scene : Gaussians
    cut : Cut
    camera : Camera
    """
    label_of = torch.from_numpy(cut.surfels.astype(np.float32))
    seen = _seen(scene, torch.stack([label_of, label_of * scene.centres().detach()[:, 2]], dim=1), camera)
    return seen[..., 1] / np.maximum(seen[..., 0], 1e-6)


def _seen(scene: Gaussians, features: torch.Tensor, camera: Camera) -> Array:
    """(h, w, k) float32: features (n, k) of surfels as a camera sees them."""
    eye = np.asarray(camera.matrix_world)[:3, 3]
    with torch.no_grad():
        u, v, opacity, _ = scene.backend.attributes(scene.parameters, scene.centres(), eye, 0, False)
        return np.asarray(scene.backend.rasterise(scene.centres(), u, v, opacity, features, camera).features.numpy())
