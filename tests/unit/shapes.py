"""A camera, a ball as mesh and as surfels: what several tests look at."""

from __future__ import annotations

import numpy as np

from drgs_blender.core.asset.model import Mesh, PosedSurfels
from drgs_blender.core.frame import Camera
from drgs_blender.render.scene.trace_scene import TraceObject, TraceScene


def look_along_y(size: int = 48, distance: float = 4.0, focal: float = 70.0, **more: object) -> Camera:
    matrix = np.eye(4)
    matrix[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    matrix[1, 3] = -distance
    return Camera(matrix, size, size, focal, focal, size / 2, size / 2, **more)  # type: ignore[arg-type]


def sphere_mesh(levels: int = 4) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    mesh = trimesh.creation.icosphere(levels)
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)


def plain_mesh(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """Grey, neither rough nor smooth, no metal."""
    n = len(vertices)
    return Mesh(vertices, faces, np.full((n, 3), 0.5), np.full(n, 0.5), np.zeros(n))


def scene_of(*meshes: tuple[np.ndarray, np.ndarray], albedo: float = 0.5) -> TraceScene:
    scene = TraceScene()
    scene.update(
        [
            TraceObject(f"mesh {i}", v, f, np.full((len(v), 3), albedo), np.full(len(v), 0.6), np.zeros(len(v)))
            for i, (v, f) in enumerate(meshes)
        ]
    )
    return scene


def sphere_surfels(radius: float, n: int = 6000, albedo: float = 0.5) -> PosedSurfels:
    i = np.arange(n) + 0.5
    z, turn = 1 - 2 * i / n, np.pi * (1 + 5**0.5) * i
    normal = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], -1)
    u = np.cross(normal, np.where(np.abs(z)[:, None] < 0.9, [[0, 0, 1.0]], [[1.0, 0, 0]]))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    sigma = 0.6 * np.sqrt(4 * np.pi / n)
    arrays = (
        radius * normal, sigma * u, sigma * np.cross(normal, u), normal, np.full(n, 0.9), np.full((n, 3), albedo),
        np.full(n, 0.6), np.zeros(n),
    )  # fmt: skip
    return PosedSurfels(*(np.ascontiguousarray(a, np.float32) for a in arrays), np.zeros(n, np.int32))
