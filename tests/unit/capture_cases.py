"""Photographs of known shapes, ray-traced exactly: what reconstructions are held against."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from drgs_blender.core.frame import Camera
from drgs_blender.reconstruct.capture.capture import Capture, View

#: Two balls that touch: centres and radii. Their crease is no silhouette from any side.
BALLS = ((np.array([-0.35, 0.0, 0.1]), 0.5), (np.array([0.4, 0.1, -0.05]), 0.4))


def camera(k: int, count: int, size: int, distance: float = 4.0) -> Camera:
    """Camera number k of `count` around the origin, on a Fibonacci sphere, that sees the balls whole."""
    z = 0.95 * (1 - 2 * (k + 0.5) / count)
    angle, ring = np.pi * (1 + 5**0.5) * k, np.sqrt(1 - z * z)
    back = np.array([ring * np.cos(angle), ring * np.sin(angle), z])
    right = np.cross([0.0, 0, 1], back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.stack([right, np.cross(back, right), back], -1), distance * back
    focal = 0.5 * size / 1.05 * distance
    return Camera(matrix, size, size, focal, focal, size / 2, size / 2)


def shade(which: int, normal: np.ndarray) -> np.ndarray:
    """sRGB (..., 3) of ball number `which` where it has a normal (..., 3): soft stripes, lit from above."""
    stripes = 0.5 + 0.3 * np.sin(9 * normal[..., 2 if which else 0])
    base = [stripes, np.full_like(stripes, 0.6), 1 - stripes] if which else [stripes, 1 - stripes, stripes]
    return np.stack(base, -1) * (0.6 + 0.4 * normal[..., 2:])


def rays_of(view: Camera, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions (h * samples, w * samples, 3) of a grid within each pixel, and their lengths at unit depth."""
    step = (np.arange(view.width * samples) + 0.5) / samples
    x, y = np.meshgrid((step - view.cx) / view.fx, -(step - view.cy) / view.fy)
    rays = np.stack([x, y, np.full_like(x, -1.0)], -1) @ view.matrix_world[:3, :3].T
    length = np.linalg.norm(rays, axis=-1)
    return rays / length[..., None], length


def trace(view: Camera, samples: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Colour over black and coverage of the balls, box-filtered."""
    rays, _ = rays_of(view, samples)
    eye = view.matrix_world[:3, 3]
    nearest, colour = np.full(rays.shape[:2], np.inf), np.zeros(rays.shape)
    for which, (middle, radius) in enumerate(BALLS):
        along = rays @ (middle - eye)
        inside = radius**2 - (np.sum((middle - eye) ** 2) - along**2)
        t = along - np.sqrt(np.maximum(inside, 0))
        hit = (inside > 0) & (t < nearest)
        normal = (eye + t[..., None] * rays - middle) / radius
        colour = np.where(hit[..., None], shade(which, normal), colour)
        nearest = np.where(hit, t, nearest)
    blocks = (view.height, samples, view.width, samples)
    alpha = np.isfinite(nearest).reshape(blocks).mean(axis=(1, 3))
    return colour.reshape(*blocks, 3).mean(axis=(1, 3)).astype(np.float32), alpha.astype(np.float32)


def balls(count: int = 24, size: int = 48, test_every: int = 8, masks: bool = True) -> Capture:
    """`count` photographs of the balls before black."""
    return photographed(trace, count, size, test_every, masks)


def photographed(
    shape: Callable[..., tuple[np.ndarray, ...]], count: int, size: int, test_every: int, masks: bool = True
) -> Capture:
    """`count` photographs before black of what `shape(camera)` says: colour, coverage, and what else it knows."""
    views = []
    for k in range(count):
        view = camera(k, count, size)
        colour, alpha, *_ = shape(view)
        views.append(View(f"{k:03d}", view, colour, alpha if masks else None, k % test_every == 0))
    return Capture(Path(shape.__name__), views, (0.0, 0.0, 0.0))


def write(capture: Capture, folder: Path) -> None:
    """Write a capture with masks as NeRF-synthetic files."""
    frames = []
    for view in capture.views:
        rgba = np.concatenate([view.colour / np.maximum(view.mask[..., None], 1e-6), view.mask[..., None]], -1)
        Image.fromarray((rgba.clip(0, 1) * 255).astype(np.uint8)).save(folder / f"{view.name}.png")
        frames.append({"file_path": view.name})
    write_cameras(capture, folder, frames)


def write_cameras(capture: Capture, folder: Path, about: list[dict[str, str]]) -> None:
    """Write `transforms.json`, with the files that it says of each view."""
    matrices = [view.camera.matrix_world.tolist() for view in capture.views]
    frames = [files | {"transform_matrix": matrix} for files, matrix in zip(about, matrices, strict=True)]
    camera = capture.views[0].camera
    angle = 2 * np.arctan(0.5 * camera.width / camera.fx)
    (folder / "transforms.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))


def colour_of_balls(points: np.ndarray) -> np.ndarray:
    """sRGB (n, 3) of the nearest points of the surface."""
    _, outward = distance_to_balls(points)
    apart = [np.linalg.norm(points - middle, axis=1) - radius for middle, radius in BALLS]
    return np.where((apart[1] < apart[0])[:, None], shade(1, outward), shade(0, outward))


def distance_to_balls(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signed distance (n,) of points to the surface, and its outward direction (n, 3)."""
    apart = np.stack([np.linalg.norm(points - middle, axis=1) - radius for middle, radius in BALLS])
    which = apart.argmin(axis=0)
    outward = points - np.stack([middle for middle, _ in BALLS])[which]
    return apart.min(axis=0), outward / np.linalg.norm(outward, axis=1, keepdims=True)
