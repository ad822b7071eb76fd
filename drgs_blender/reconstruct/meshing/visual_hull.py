"""The visual hull of the masks as the first surface, and the region of the object from the cameras.

A point belongs to the visual hull when no view that has it in its picture shows background there (Laurentini 1994).
Surfels that start on it need not be found by gradients.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion, gaussian_filter, label, maximum_filter, uniform_filter

from ...compute.jit import njit
from ...compute.threads import over_range
from ...core.arrays import Array
from ...core.errors import AssetError, first_of
from ...core.frame import Camera
from ..capture.capture import Capture, View

log = logging.getLogger(__name__)

#: Distance of colours from the background beyond which pixels show the object, in captures without masks.
DISTINCT = 0.03
#: Part of the views of a point of the hull that may call it background: masks are not perfect.
DISSENT = 0.03
#: Part of the views that must have a point of the hull in their picture.
WITNESSES = 0.2
#: Cells along the longest side of the hull's box.
CELLS = 96
#: Part of a mask that small parts of the object must have for themselves to be missed where they are left out.
SHOWN = 0.01
#: Distance in cells at which parts thinner than a cell begin, from the thicker parts.
AWAY = 2


@dataclass(slots=True)
class Region:
    """The region of the object, in which surfels may be.

    Attributes
    ----------
    centre : (3,) float64 array
        Metres.
    radius : float
        Of a sphere around the object, metres.
    low, high : (3,) float64 array
        Corners of the object's box.
    points, normals : (n, 3) float32 array
        On the first surface, unit normals outwards.
    spacing : float
        Distance between those points, metres.
    solid : (m, 3) float32 array
        Centres of the cells of side `spacing` that are inside; none where there are no masks.
    """

    centre: Array
    radius: float
    low: Array
    high: Array
    points: Array
    normals: Array
    spacing: float
    solid: Array = field(default_factory=lambda: np.zeros((0, 3), np.float32))


def have_silhouettes(capture: Capture) -> bool:
    """Whether there are `silhouettes`."""
    return capture.background is not None or all(view.mask is not None for view in capture.training)


def silhouettes(capture: Capture) -> list[Array] | None:
    """Masks of the training views, (h, w) float32 each: drawn, or made from a background of one colour; or None.

    Raises
    ------
    AssetError: a mask of another size than its picture.
    """
    views = capture.training
    for view in views:
        if view.mask is not None and view.mask.shape != view.colour.shape[:2]:
            raise AssetError(
                view.name,
                f"has a mask of {view.mask.shape[1]} x {view.mask.shape[0]} pixels for a picture of "
                f"{view.colour.shape[1]} x {view.colour.shape[0]}",
                "Give a mask of the picture's size",
            )
    if not have_silhouettes(capture):
        return None
    if all(view.mask is not None for view in views):
        return [np.ascontiguousarray(view.mask, np.float32) for view in views]
    return [_told_from(np.asarray(capture.background, np.float32), view.colour) for view in views]


def _told_from(background: Array, colour: Array) -> Array:
    """(h, w) float32 coverage by what is not of the `background` colour.

    A pixel on the outline is so much of the object as its colour is of that of its neighbours inside: to count it whole
    would widen the object by almost half a pixel.
    """
    apart = colour - background
    distinct = np.abs(apart).max(axis=-1) > DISTINCT
    inside = binary_erosion(distinct, np.ones((3, 3)), border_value=1)
    near = uniform_filter(inside.astype(np.float32), 3)
    known = distinct & ~inside & (near > 1e-3)
    whole = uniform_filter(apart * inside[..., None], (3, 3, 0))[known] / near[known, None]
    coverage = distinct.astype(np.float32)
    share = (apart[known] * whole).sum(axis=-1) / np.maximum((whole * whole).sum(axis=-1), 1e-9)
    coverage[known] = np.clip(share, 0, 1)
    return coverage


def aim(cameras: list[Camera]) -> tuple[Array, float]:
    """Point nearest to all optical axes, and the radius of the sphere there that the median camera sees whole."""
    matrices = np.stack([np.asarray(c.matrix_world, np.float64) for c in cameras])
    eye, axis = matrices[:, :3, 3], -matrices[:, :3, 2]
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    if np.linalg.cond(across.sum(0)) > 1e6:
        raise AssetError(
            "cameras", "all look in one direction: depth cannot be measured", "Photograph the object from around it"
        )
    middle = np.linalg.solve(across.sum(0), (across @ eye[:, :, None]).sum(0))[:, 0]
    half = [min(c.width / c.fx, c.height / c.fy) / 2 for c in cameras]
    distance = np.linalg.norm(eye - middle, axis=1)
    return middle, float(np.median(distance * np.asarray(half)))


def find_region(capture: Capture) -> Region:
    """The visual hull where there are silhouettes; else the sparse points, or a sphere that the cameras look at.

    Raises
    ------
    AssetError: fewer than three views, cameras that all look the same way, or masks that have no point in common:
        cameras and pictures do not belong together; a mask of another size than its picture.
    """
    views = capture.training
    if len(views) < 3:
        raise AssetError(
            str(capture.source),
            f"has {len(views)} views to learn from",
            "A surface needs three or more, from all around",
        )
    masks = silhouettes(capture)
    if masks is None:
        return _without_masks(capture, views)
    if not any(mask.max() > 0.5 for mask in masks):
        raise AssetError(str(capture.source), "shows no object in any mask", "Check masks and background")
    centre, radius = aim([view.camera for view in views])
    low, high = centre - 1.5 * radius, centre + 1.5 * radius
    missed: set[str] = set()
    # Coarse first, to find the box; cells of the second time are as fine as the object allows.
    for cells in (64, CELLS):
        origin, spacing = low, float((high - low).max()) / cells
        shape = np.ceil((high - low) / spacing).astype(int) + 1
        inside, seen = _carve(origin, spacing, shape, views, masks)
        near, _ = _carve(origin, spacing, shape, views, _widened(masks, views, centre, spacing))
        apart = near & ~binary_dilation(inside, iterations=AWAY)
        parts, sizes = _main_parts(inside | near)
        if cells == CELLS:
            sizes[_phantoms(parts, sizes, seen, origin, spacing, views)] = 0
        whole = inside | apart
        inside = (sizes > 0)[parts] & whole
        if not inside.any():
            raise AssetError(
                str(capture.source),
                "has masks that no common point projects into: cameras and pictures do not agree",
                "Check the convention of the cameras' axes and their order",
            )
        missed |= _missed(whole & ~inside, inside, origin, spacing, views, masks)
        corners = np.argwhere(inside)
        low, high = origin + (corners.min(0) - 1.5) * spacing, origin + (corners.max(0) + 1.5) * spacing
    if len(missed) >= 3:
        log.warning(
            "%s: a small part apart from the rest is left out, which %d photographs show (%s): photograph it alone, or "
            "leave it out of the masks", capture.source, len(missed), first_of(sorted(missed)),
        )  # fmt: skip
    points, normals = _surface(inside, origin, spacing)
    middle = 0.5 * (low + high)
    solid = (np.argwhere(inside) * spacing + origin).astype(np.float32)
    log.info("visual hull: %d cells, %d surface points, box %s", int(inside.sum()), len(points), high - low)
    return Region(middle, 0.5 * float(np.linalg.norm(high - low)), low, high, points, normals, spacing, solid)


def _widened(masks: list[Array], views: list[View], centre: Array, spacing: float) -> list[Array]:
    """Masks grown by half a cell: with them no cell is carved that something thinner passes through."""
    grown = []
    for mask, view in zip(masks, views, strict=True):
        camera = view.camera
        away = max(float(np.linalg.norm(np.asarray(camera.matrix_world)[:3, 3] - centre)), 1e-9)
        pixels = 0.5 * spacing * max(camera.fx, camera.fy) / away
        # No more than the picture has: a camera may stand in the middle.
        grown.append(maximum_filter(mask, 2 * min(round(pixels), max(mask.shape)) + 1))
    return grown


def _main_parts(inside: Array) -> tuple[Array, Array]:
    """Number of the part that each cell of the solid is of, 0 outside; cells of each, 0 of those under a hundredth."""
    parts, count = label(inside)
    sizes = np.bincount(parts.reshape(-1), minlength=count + 1)
    sizes[0] = 0
    return parts, np.where(sizes >= 0.01 * sizes.max(), sizes, 0)


def _phantoms(parts: Array, sizes: Array, seen: Array, origin: Array, spacing: float, views: list[View]) -> list[int]:
    """Numbers of small parts at the edge of the pictures, where few of them can show background.

    Those are smaller than a tenth of the largest, fewer than half as many views have them, and nothing that these show
    is missing without them.
    """
    witnesses = np.bincount(parts.reshape(-1), seen.reshape(-1), len(sizes)) / np.maximum(sizes, 1)
    doubtful = (sizes > 0) & (sizes < 0.1 * sizes.max()) & (witnesses < 0.5 * witnesses[sizes.argmax()])
    places = lambda which: np.argwhere(which) * spacing + origin  # noqa: E731
    left = {int(part): places(parts == part) for part in np.flatnonzero(doubtful)}
    rest = places(((sizes > 0) & ~doubtful)[parts])
    for view in views if left else ():
        covered = _drawn(rest, spacing, view.camera)
        for part, points in list(left.items()):
            x, y, has, _ = _pixels(points, view.camera)
            if has.any() and covered[y[has], x[has]].mean() < 0.5:
                del left[part]  # most of it is where nothing else is
    if left:
        log.info("left out %d parts of the hull that few views have in their picture", len(left))
    return list(left)


def _missed(
    dropped: Array, kept: Array, origin: Array, spacing: float, views: list[View], masks: list[Array]
) -> set[str]:
    """Names of the views with more than `SHOWN` of their mask where the `dropped` cells are, and none `kept`."""
    if not dropped.any():
        return set()
    names = set()
    lost, rest = (np.argwhere(cells) * spacing + origin for cells in (dropped, kept))
    for view, mask in zip(views, masks, strict=True):
        object_ = mask > 0.5
        alone = object_ & _drawn(lost, spacing, view.camera) & ~_drawn(rest, spacing, view.camera)
        if alone.sum() > SHOWN * max(object_.sum(), 1):
            names.add(view.name)
    return names


def _drawn(points: Array, spacing: float, camera: Camera) -> Array:
    """(h, w) bool: where cells of side `spacing` are in the picture, generously."""
    x, y, shown, depth = _pixels(points, camera)
    covered = np.zeros((camera.height, camera.width), bool)
    covered[y[shown], x[shown]] = True
    middle = float(np.median(depth[shown])) if shown.any() else np.inf
    cell = math.ceil(spacing * max(camera.fx, camera.fy) / middle)
    return maximum_filter(covered, 2 * min(cell, max(covered.shape)) + 1)


def _pixels(points: Array, camera: Camera) -> tuple[Array, Array, Array, Array]:
    """Columns and rows of points (n, 3) in the picture, 0 of those outside; which are inside; their depth."""
    matrix = world_to_pixel(camera)
    position = points @ matrix[:, :3].T + matrix[:, 3]
    x, y = (np.floor(position[:, k] / np.maximum(position[:, 2], 1e-9)) for k in (0, 1))
    inside = (position[:, 2] > 0) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    return np.where(inside, x, 0).astype(int), np.where(inside, y, 0).astype(int), inside, position[:, 2]


def _surface(inside: Array, origin: Array, spacing: float) -> tuple[Array, Array]:
    """Cells at the border of the solid, moved onto the smoothed surface, and normals (n, 3) from the smoothed solid."""
    padded = np.pad(inside, 3)
    smooth = gaussian_filter(padded.astype(np.float32), 1.5)
    slope = np.stack(np.gradient(smooth), -1)
    beside = np.stack([[np.roll(padded, step, axis) for step in (1, -1)] for axis in range(3)])
    border = padded & ~beside.all(axis=(0, 1))
    steep = slope[border]
    length = np.linalg.norm(steep, axis=1)[:, None]
    # Wires and leaves as thin as a cell are alike on both sides: across them, where they are.
    thin = length <= 1e-3
    lone = np.logical_or(beside[:, 0], beside[:, 1])[:, border].argmin(axis=0)  # an axis along which nothing is beside
    across = np.eye(3, dtype=np.float32)[lone]
    length = np.maximum(length, 1e-3)
    normals = np.where(thin, across, -steep / length)
    offset = np.where(thin, 0, np.clip((smooth[border][:, None] - 0.5) / length, -1, 1))
    points = (np.argwhere(border) - 3 + offset * normals) * spacing + origin
    return points.astype(np.float32), normals.astype(np.float32)


def _without_masks(capture: Capture, views: list[View]) -> Region:
    """Sparse points where there are enough, else points in the sphere that the cameras look at."""
    log.warning(
        "%s: neither masks nor a background of one colour: the surroundings are learned with the object, which takes "
        "longer and gives a worse shape; masks separate them",
        capture.source,
    )
    centre, radius = aim([view.camera for view in views])
    rng = np.random.default_rng(0)
    points = None if capture.points is None else capture.points[np.isfinite(capture.points).all(axis=1)]
    if points is not None and len(points) >= 100:
        low, high = np.quantile(points, 0.02, axis=0), np.quantile(points, 0.98, axis=0)
        centre, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    else:
        directions = rng.normal(size=(8000, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        points = centre + radius * rng.uniform(size=(len(directions), 1)) ** (1 / 3) * directions
        low, high = centre - radius, centre + radius
    normals = points - centre
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    spacing = radius * (4.2 / len(points)) ** (1 / 3)
    return Region(
        centre.astype(np.float64), radius, low.astype(np.float64), high.astype(np.float64),
        points.astype(np.float32), normals.astype(np.float32), spacing,
    )  # fmt: skip


def _carve(low: Array, spacing: float, shape: Array, views: list[View], masks: list[Array]) -> tuple[Array, Array]:
    """Points of a grid that enough views see, no more than `DISSENT` of which call them background; how many see each.

    Returns
    -------
    kept : bool array
        Of the grid's shape.
    seen : int32 array
        Of the grid's shape: how many views see each point.
    """
    seen, background = np.zeros(tuple(shape), np.int32), np.zeros(tuple(shape), np.int32)
    for view, mask in zip(views, masks, strict=True):
        over_range(_count, len(seen), low, spacing, world_to_pixel(view.camera), mask, seen, background)
    return (seen >= max(3, int(WITNESSES * len(views)))) & (background <= DISSENT * seen), seen


def world_to_pixel(camera: Camera) -> Array:
    """(3, 4) float64: rows give x z, y z and z of a world point, (x, y) its pixel position, z its depth."""
    matrix = np.linalg.inv(np.asarray(camera.matrix_world, np.float64))
    right, up, back = matrix[0], matrix[1], matrix[2]
    return np.stack([camera.fx * right - camera.cx * back, -camera.fy * up - camera.cy * back, -back])


def colours_of(points: Array, normals: Array, views: list[View]) -> Array:
    """Mean colour (n, 3) of the views that see points (n, 3) from the front, sRGB; grey where none does."""
    total, weight = np.zeros((len(points), 3)), np.zeros(len(points))
    for view in views:
        eye = np.asarray(view.camera.matrix_world)[:3, 3]
        towards = eye - points
        facing = np.einsum("nc,nc->n", towards, normals) / np.maximum(np.linalg.norm(towards, axis=1), 1e-9)
        x, y, inside, _ = _pixels(points, view.camera)
        w = np.where(inside, np.maximum(facing, 0) ** 2, 0)
        total += w[:, None] * view.colour[y, x]
        weight += w
    return np.where(weight[:, None] > 1e-3, total / np.maximum(weight, 1e-3)[:, None], 0.5).astype(np.float32)


@njit
def _count(first, last, low, spacing, p, mask, seen, background):  # type: ignore[no-untyped-def]
    """Count views that have grid points in their picture, and those that show background there."""
    height, width = mask.shape
    for i in range(first, last):
        for j in range(seen.shape[1]):
            for k in range(seen.shape[2]):
                x, y, z = low[0] + i * spacing, low[1] + j * spacing, low[2] + k * spacing
                depth = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
                if depth <= 0.0:
                    continue
                px = (p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) / depth
                py = (p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) / depth
                if px < 0.0 or py < 0.0 or px >= width or py >= height:
                    continue
                seen[i, j, k] += 1
                if mask[int(py), int(px)] < 0.5:
                    background[i, j, k] += 1
