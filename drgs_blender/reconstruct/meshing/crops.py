"""Cameras and views cropped to what they show of a box: the rest need not be drawn."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from ...core.arrays import Array
from ...core.frame import Camera
from ..capture.capture import View
from .visual_hull import world_to_pixel


def box_of(shown: Array) -> tuple[int, int, int, int] | None:
    """Columns and rows (x0, y0, x1, y1), half-open, of what is true in (h, w); None where nothing is."""
    rows, columns = np.flatnonzero(shown.any(axis=1)), np.flatnonzero(shown.any(axis=0))
    return (int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1) if len(rows) else None


def cut(camera: Camera, x: int, y: int, width: int, height: int) -> Camera:
    """The camera of a part of its picture, whose first pixel is the one at (x, y)."""
    return replace(camera, width=width, height=height, cx=camera.cx - x, cy=camera.cy - y)


def corner_of(part: Camera, whole: Camera) -> tuple[int, int]:
    """The x and y with which `cut` has made `part` of `whole`."""
    return round(whole.cx - part.cx), round(whole.cy - part.cy)


def cropped(cameras: list[Camera], low: Array, high: Array) -> list[Camera]:
    """Cameras of what theirs show of a box: all of the pictures of one size are cropped to one smaller size.

    Parameters
    ----------
    cameras : list of Camera
    low, high : (3,) array
        Corners of the box, metres. A camera that has some of it beside or behind it keeps its picture.
    """
    corners = np.array([*itertools.product(*zip(low, high, strict=True))])
    windows: list[Array] = []
    largest: dict[tuple[int, int], Array] = {}
    for camera in cameras:
        size = camera.width, camera.height
        seen = np.c_[corners, np.ones(8)] @ world_to_pixel(camera).T
        first, last = np.zeros(2, int), np.array(size)
        if (seen[:, 2] > 0).all():
            place = seen[:, :2] / seen[:, 2:]
            first = np.clip(np.floor(place.min(axis=0)) - 1, 0, last - 1).astype(int)
            last = np.clip(np.ceil(place.max(axis=0)) + 1, first + 1, size).astype(int)
        windows.append(first)
        largest[size] = np.maximum(largest.get(size, 0), last - first)
    found = []
    for camera, first in zip(cameras, windows, strict=True):
        side = largest[camera.width, camera.height]
        x, y = np.minimum(first, [camera.width, camera.height] - side)
        found.append(cut(camera, int(x), int(y), *map(int, side)))
    return found


def cropped_views(views: list[View], points: Array) -> list[View]:
    """Views of what theirs show of the box around `points` (n, 3); their arrays are parts of the whole ones."""
    cameras = cropped([view.camera for view in views], points.min(axis=0), points.max(axis=0))
    found = []
    for view, camera in zip(views, cameras, strict=True):
        x, y = corner_of(camera, view.camera)
        part = slice(y, y + camera.height), slice(x, x + camera.width)
        layers = {name: getattr(view, name) for name in ("colour", "mask", "normals", "above_white")}
        parts = {name: layer[part] for name, layer in layers.items() if layer is not None}
        found.append(replace(view, camera=camera, **parts))
    return found
