"""Cameras that frame an asset, where none is given: from the front, or on a circle around it."""

from __future__ import annotations

import math

import numpy as np

from ..core.frame import Camera

#: Full field of view, degrees; elevation of the camera above the middle, degrees; room around the object.
FOV, ELEVATION, ROOM = 40.0, 15.0, 1.1
#: Pixels of a side.
SIZE = 800
#: Points, about, and degrees between places on the circle, by which the distance is found.
_POINTS, _STEP = 20_000, 30


def framing_camera(vertices: np.ndarray, turn: float = 0.0, size: int = SIZE) -> Camera:
    """A camera from which all of (n, 3) world `vertices` are in a square picture.

    Parameters
    ----------
    vertices : (n, 3) float array
        Metres, world, Z up; at least one.
    turn : float
        Degrees that the camera has gone around from the front (-Y), counter-clockwise seen from above.
    size : int
        Pixels of a side.
    """
    middle = (vertices.min(axis=0).astype(np.float64) + vertices.max(axis=0)) / 2
    around = vertices[:: max(1, len(vertices) // _POINTS)] - middle
    opening, distance = math.tan(math.radians(FOV) / 2), 1e-6
    for other in range(0, 360, _STEP):  # as far away on all of the circle
        local = around @ _axes(other)
        distance = max(distance, float((np.abs(local[:, :2]).max(axis=1) / opening + local[:, 2]).max()))
    matrix = np.eye(4)
    matrix[:3, :3] = _axes(turn)
    matrix[:3, 3] = middle + ROOM * distance * matrix[:3, 2]
    focal = 0.5 * size / opening
    return Camera(matrix, size, size, focal, focal, size / 2, size / 2)


def _axes(turn: float) -> np.ndarray:
    """(3, 3) float64: right, up and back of a camera that has gone around by `turn` degrees, as columns."""
    azimuth, height = math.radians(turn), math.radians(ELEVATION)
    flat = math.cos(height)
    back = np.array([math.sin(azimuth) * flat, -math.cos(azimuth) * flat, math.sin(height)])
    right = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    return np.stack([right, np.cross(back, right), back], axis=1)


def sees_any(camera: Camera, points: np.ndarray) -> bool:
    """Whether any of (n, 3) world points is in picture and clip range of a perspective or orthographic camera."""
    local = (points - camera.matrix_world[:3, 3]) @ camera.matrix_world[:3, :3]
    depth = np.ones(len(local)) if camera.orthographic else -local[:, 2]
    ahead = (-local[:, 2] > max(camera.clip_start, 0.0)) & (-local[:, 2] < camera.clip_end)
    safe = np.where(ahead, depth, 1.0)
    x, y = camera.cx + camera.fx * local[:, 0] / safe, camera.cy - camera.fy * local[:, 1] / safe
    return bool((ahead & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)).any())
