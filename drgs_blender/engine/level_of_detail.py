"""How many surfels of each object a moving picture shows: as many as its pixels can, where they are seen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..compute.warp.posed_surfels import with_fields
from ..core.asset.model import Asset, PosedSurfels
from ..core.errors import UsageError
from ..core.frame import Camera, Frame, ObjectState
from ..core.level_of_detail import Detail, enlarged
from .cached_objects import CachedObject
from .captured_objects import shows_captured
from .surfel_sheets import meets_sheets

Array = np.ndarray

#: Surfels a vertex up to which a mesh is taken for as detailed as a coarse picture.
_SURFELS_A_VERTEX = 16
#: Surfels for each pixel that objects cover, before rounding to a power of two, and least of an object.
_SURFELS_A_PIXEL, _LEAST = 3, 4096
#: Surfels by which it is seen what of an object is in the picture, and of these in each cell that it is divided into.
_PROBES, _A_CELL = 2048, 4
#: Part of the picture around it that counts as seen, and least part of an object that is taken to be.
_MARGIN, _SMALLEST = 1 / 16, 1 / 256


@dataclass(frozen=True, slots=True)
class Budget:
    """What a picture can show.

    Attributes
    ----------
    camera : Camera
        Of the whole picture.
    pixel : int
        Side of its pixels, in those of the camera.
    most : int
        Surfels of all objects together, at most.
    """

    camera: Camera
    pixel: int
    most: int


def check_most(most: int) -> None:
    """Refuse a limit that is none; 0 is no limit."""
    if isinstance(most, bool) or not isinstance(most, int) or most < 0:
        raise UsageError("viewport surfels", f"are {most!r}", "Give a number, or 0 for all")


def too_many(frame: Frame, given: Sequence[tuple[ObjectState, Asset]], most: int) -> bool:
    """Whether a picture of all surfels is worth one of all pixels, but fewer surfels, before it."""
    x0, y0, x1, y1 = frame.camera.window
    surfels = sum(len(asset.surfels) for state, asset in given if state.visibility.camera)
    few = min(most, _SURFELS_A_PIXEL * (x1 - x0) * (y1 - y0))
    return frame.settings.camera_sees == "surfels" and surfels > 2 * few


def is_detailed(frame: Frame, given: Sequence[tuple[ObjectState, Asset]]) -> bool:
    """Whether the meshes of all objects are detailed enough to stand for their surfels in coarse pictures."""
    if frame.settings.rays_see != "mesh":
        return False
    if any(shows_captured(*of, frame) or meets_sheets(*of, frame) for of in given):
        return False  # points on a mesh would lie among sheets, in their shade
    return all(len(asset.surfels) <= _SURFELS_A_VERTEX * len(asset.mesh.vertices) for _, asset in given)


def counts(objects: Sequence[CachedObject], budget: Budget) -> list[int]:
    """How many surfels of each object a picture shows: all of them, or a power of two, which lasts while it moves."""
    wanted = [_wanted(item, budget) for item in objects]
    whole = [len(item.loaded.asset.surfels) for item in objects]
    powers = [1 << round(math.log2(number)) for number in wanted]
    found = [number if 4 * number <= 5 * power else power for number, power in zip(whole, powers, strict=True)]
    if sum(found) <= budget.most:
        return found
    scale = budget.most / max(sum(wanted), budget.most)
    fewer = [max(int(number * scale), 1) for number in wanted]
    powers = [1 << number.bit_length() - 1 for number in fewer]
    return [min(number, power) for number, power in zip(whole, powers, strict=True)]


def _wanted(item: CachedObject, budget: Budget) -> int:
    """Surfels of an object that a picture can show, whatever there are."""
    whole = len(item.loaded.asset.surfels)
    if whole <= _LEAST or item.seen_by_mesh or not item.state.visibility.camera:
        return max(min(whole, _LEAST), 1)
    covered, seen = _covered(budget.camera, _probes(item))
    number = _SURFELS_A_PIXEL * covered / budget.pixel**2 / max(seen, _SMALLEST)
    return int(min(max(number, _LEAST), whole))


def _probes(item: CachedObject) -> Array:
    """(k, 3) places in the world near surfels that lie evenly over the object."""
    asset = item.loaded.asset
    rows = item.loaded.detail.order[:_PROBES]
    if asset.binding is not None and len(asset.mesh.faces):
        corners = item.traced.vertices[asset.mesh.faces[asset.binding.face[rows]]]
        places: Array = np.einsum("nk,nkc->nc", asset.binding.barycentric[rows], corners)
        return places
    matrix = np.asarray(item.state.matrix_world, np.float64)
    moved: Array = asset.surfels.centre[rows] @ matrix[:3, :3].T + matrix[:3, 3]
    return moved


def _covered(camera: Camera, places: Array) -> tuple[float, float]:
    """Pixels that (k, 3) places cover, and the part of them that is in the picture."""
    x0, y0, x1, y1 = camera.window
    whole = float((x1 - x0) * (y1 - y0))
    if camera.panorama:
        return whole, 1.0
    matrix = np.asarray(camera.matrix_world, np.float64)
    with np.errstate(all="ignore"):
        own = (places - matrix[:3, 3]) @ np.linalg.inv(matrix[:3, :3]).T
        depth = 1.0 if camera.orthographic else -own[:, 2]
        x = (camera.cx + camera.fx * own[:, 0] / depth - x0) / (x1 - x0)
        y = (camera.cy - camera.fy * own[:, 1] / depth - y0) / (y1 - y0)
        low, high = -_MARGIN, 1 + _MARGIN
        seen = (-own[:, 2] > camera.clip_start) & (x > low) & (x < high) & (y > low) & (y < high)
    if not seen.any():
        return 0.0, 0.0
    side = max(1, round(math.sqrt(np.count_nonzero(seen) / _A_CELL)))
    column, row = ((place[seen].clip(0, 0.999) * side).astype(int) for place in (x, y))
    return whole * len(np.unique(row * side + column)) / side**2, float(seen.mean())


def reduced(item: CachedObject, count: int) -> CachedObject:
    """An object as one of its `count` most needed surfels, which are posed when it is first asked for; itself for all.

    For rays that meet meshes it is the same.
    """
    if count >= len(item.loaded.asset.surfels):
        return item
    if count not in item.levels:
        few = replace(item, loaded=item.loaded.first(count), levels={}, detail=item.loaded.detail)
        few.posed = few.captured = few.emission = None
        item.levels[count] = few
    return item.levels[count]


def grown(posed: PosedSurfels, detail: Detail) -> PosedSurfels:
    """The first surfels of an object, as large as it takes to cover what all do."""
    u, v = enlarged(posed.tangent_u, posed.tangent_v, detail.growth(len(posed)))
    return with_fields(posed, {"tangent_u": u, "tangent_v": v})
