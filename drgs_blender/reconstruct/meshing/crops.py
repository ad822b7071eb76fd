"""Cameras and views cropped to what they show of a box: the rest need not be drawn."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from ...core.arrays import Array
from ...core.frame import Camera
from ..capture.capture import View
from .visual_hull import world_to_pixel


def cropped(cameras: list[Camera], low: Array, high: Array) -> list[Camera]:
    """Cameras of what theirs show of a box: all of the pictures of one size are cropped to one smaller size.

    Parameters
    ----------
    cameras : list of Camera
    low, high : (3,) array
        Corners of the box, metres. A camera that has some of it beside or behind it keeps its picture.
    """
    corners = np.array([*itertools.product(*zip(low, high, strict=True))])
    windows = []
    for camera in cameras:
        size = np.array([camera.width, camera.height])
        seen = np.c_[corners, np.ones(8)] @ world_to_pixel(camera).T
        first, last = np.zeros(2, int), size
        if (seen[:, 2] > 0).all():
            place = seen[:, :2] / seen[:, 2:]
            first = np.clip(np.floor(place.min(axis=0)) - 1, 0, size - 1).astype(int)
            last = np.clip(np.ceil(place.max(axis=0)) + 1, first + 1, size).astype(int)
        windows.append((first, last))
    found = []
    for camera, (first, _) in zip(cameras, windows, strict=True):
        alike = [
            w for c, w in zip(cameras, windows, strict=True) if (c.width, c.height) == (camera.width, camera.height)
        ]
        width, height = (int(n) for n in np.max([last - first for first, last in alike], axis=0))
        x, y = (int(n) for n in np.minimum(first, [camera.width - width, camera.height - height]))
        found.append(replace(camera, width=width, height=height, cx=camera.cx - x, cy=camera.cy - y))
    return found


def cropped_views(views: list[View], points: Array) -> list[View]:
    """Views of what theirs show of the box around `points` (n, 3); their arrays are parts of the whole ones."""
    cameras = cropped([view.camera for view in views], points.min(axis=0), points.max(axis=0))
    found = []
    for view, camera in zip(views, cameras, strict=True):
        x, y = round(view.camera.cx - camera.cx), round(view.camera.cy - camera.cy)
        part = slice(y, y + camera.height), slice(x, x + camera.width)
        layers = {name: getattr(view, name) for name in ("colour", "mask", "normals")}
        cut = {name: layer[part] for name, layer in layers.items() if layer is not None}
        found.append(replace(view, camera=camera, **cut))
    return found
