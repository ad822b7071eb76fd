"""Directions and lat-long images in Blender's mapping, and cube maps resampled to them.

Z up; u = 0.5 - atan2(y, x) / 2 pi, v = acos(z) / pi from the top: +X in the middle, +Y at u = 0.25.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Array = np.ndarray


def directions(height: int) -> Array:
    """(height, 2 height, 3) float64 unit directions of the pixel centres of a lat-long image."""
    theta = np.pi * (np.arange(height) + 0.5) / height
    phi = 2.0 * np.pi * (0.5 - (np.arange(2 * height) + 0.5) / (2 * height))
    sine = np.sin(theta)[:, None]
    z = np.broadcast_to(np.cos(theta)[:, None], (height, 2 * height))
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), z], axis=-1)


def bilinear(image: Array, x: Array, y: Array) -> Array:
    """Values of `image` (h, w, c) at pixel positions whose centres are whole numbers; edges are extended."""
    height, width = image.shape[:2]
    x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
    x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    fx, fy = (x - x0)[..., None], (y - y0)[..., None]
    top = image[y0, x0] * (1 - fx) + image[y0, x1] * fx
    bottom = image[y1, x0] * (1 - fx) + image[y1, x1] * fx
    return top * (1 - fy) + bottom * fy


def sample_cube(faces: Array, direction: Array, position: Callable[[int, Array], tuple[Array, Array]]) -> Array:
    """Look a cube map up bilinearly.

    Parameters
    ----------
    faces : (6, n, n, c) array
        In the order +X -X +Y -Y +Z -Z.
    direction : (..., 3) array
    position : callable
        (face, directions divided by their largest component) -> (column, row) in pixels on that face.
    """
    largest = np.argmax(np.abs(direction), axis=-1)
    major = np.take_along_axis(direction, largest[..., None], axis=-1)[..., 0]
    number = 2 * largest + (major < 0)
    scaled = direction / np.abs(major)[..., None]
    result = np.empty((*direction.shape[:-1], faces.shape[-1]))
    for face in range(6):
        here = number == face
        column, row = position(face, scaled[here])
        result[here] = bilinear(faces[face], column, row)
    return result


def openexr_cube(size: int) -> Callable[[int, Array], tuple[Array, Array]]:
    """Positions on the faces of OpenEXR's cube maps (ImfEnvmap.h): the outer pixel centres lie on the edges."""

    def position(face: int, d: Array) -> tuple[Array, Array]:
        x, y, z = ((d[:, k] + 1.0) * 0.5 * (size - 1) for k in range(3))
        last = size - 1
        return (
            (z, last - y),
            (last - z, last - y),
            (x, last - z),
            (x, z),
            (last - x, last - y),
            (x, last - y),
        )[face]

    return position


def nvdiffrec_cube(size: int) -> Callable[[int, Array], tuple[Array, Array]]:
    """Positions on the faces of OpenGL-style cube maps, as nvdiffrec and its descendants use them."""

    def position(face: int, d: Array) -> tuple[Array, Array]:
        x, y, z = (d[:, k] for k in range(3))
        s, t = ((-z, -y), (z, -y), (x, z), (x, -z), (x, -y), (-x, -y))[face]
        return (s + 1.0) * 0.5 * size - 0.5, (t + 1.0) * 0.5 * size - 0.5

    return position
