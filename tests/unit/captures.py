"""Small captures with known cameras, written in every layout: an ellipsoid of flat colours, seen from a ring."""

from __future__ import annotations

import json
import pickle
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

WIDTH, HEIGHT, FOCAL = 48, 40, 60.0
AXES = np.array([1.0, 0.6, 0.8])
OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def look_at(eye: np.ndarray, target: np.ndarray | None = None) -> np.ndarray:
    """Camera-to-world of Blender's convention, level, Z up."""
    back = eye - (np.zeros(3) if target is None else target)
    back = back / np.linalg.norm(back)
    right = np.cross([0, 0, 1.0], back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([right, np.cross(back, right), back, eye])
    return matrix


def ring(count: int) -> list[np.ndarray]:
    """Cameras around the origin at two heights."""
    angles = np.arange(count) * 2 * np.pi / count
    return [look_at(np.array([4 * np.cos(a), 4 * np.sin(a), 1.0 + (k % 2)])) for k, a in enumerate(angles)]


def picture(matrix: np.ndarray, width: int = WIDTH, height: int = HEIGHT, focal: float = FOCAL) -> np.ndarray:
    """(h, w, 4) uint8: colour by direction of the normal's parts, alpha 255 on the ellipsoid."""
    py, px = np.mgrid[:height, :width] + 0.5
    scale = focal * width / WIDTH
    local = np.stack([(px - width / 2) / scale, -(py - height / 2) / scale, -np.ones_like(px)], -1)
    direction = local @ matrix[:3, :3].T / AXES
    origin = matrix[:3, 3] / AXES
    a, b, c = (direction**2).sum(-1), direction @ origin, origin @ origin - 1
    disc = b * b - a * c
    t = (-b - np.sqrt(np.maximum(disc, 0))) / a
    point = origin + t[..., None] * direction
    colour = np.clip(0.5 + 0.4 * point, 0, 1)
    inside = disc > 0
    out = np.zeros((height, width, 4), np.uint8)
    out[inside, :3] = (colour[inside] * 255).round()
    out[inside, 3] = 255
    return out


@dataclass
class Scene:
    folder: Path
    cameras: list[np.ndarray]

    def pictures(self, folder: str, names: list[str], alpha: bool) -> None:
        (self.folder / folder).mkdir(parents=True, exist_ok=True)
        for name, matrix in zip(names, self.cameras):
            pixels = picture(matrix)
            Image.fromarray(pixels if alpha else pixels[..., :3]).save(self.folder / folder / name)

    def masks(self, names: list[str]) -> None:
        (self.folder / "masks").mkdir(exist_ok=True)
        for name, matrix in zip(names, self.cameras):
            Image.fromarray(picture(matrix)[..., 3]).save(self.folder / "masks" / name)


def make(folder: Path, count: int = 12) -> Scene:
    folder.mkdir(parents=True, exist_ok=True)
    return Scene(folder, ring(count))


def write_nerf(scene: Scene, split: str = "train", convert=lambda matrix: matrix) -> Path:
    names = [f"r_{k}" for k in range(len(scene.cameras))]
    scene.pictures(split, [f"{name}.png" for name in names], alpha=True)
    frames = [
        {"file_path": f"./{split}/{name}", "transform_matrix": convert(matrix).tolist()}
        for name, matrix in zip(names, scene.cameras)
    ]
    angle = 2 * np.arctan(0.5 * WIDTH / FOCAL)
    path = scene.folder / f"transforms_{split}.json"
    path.write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    return path


def write_nerfstudio(scene: Scene, **extra) -> Path:
    names = [f"frame_{k:05d}.png" for k in range(len(scene.cameras))]
    scene.pictures("images", names, alpha=False)
    scene.masks(names)
    frames = [
        {"file_path": f"images/{name}", "mask_path": f"masks/{name}", "transform_matrix": matrix.tolist()}
        for name, matrix in zip(names, scene.cameras)
    ]
    data = {"camera_model": "OPENCV", "fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    path = scene.folder / "transforms.json"
    path.write_text(json.dumps(data | {"w": WIDTH, "h": HEIGHT, "frames": frames} | extra))
    return path


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_quat()[[3, 0, 1, 2]]


def write_colmap(scene: Scene, binary: bool) -> Path:
    names = [f"{k:03d}.png" for k in range(len(scene.cameras))]
    scene.pictures("images", names, alpha=False)
    scene.masks(names)
    model = scene.folder / "sparse" / "0"
    model.mkdir(parents=True)
    points = np.array([[0.5, 0, 0], [0, 0.25, 0], [0, 0, 0.125]])
    images = []
    for name, matrix in zip(names, scene.cameras):
        to_camera = np.linalg.inv(matrix @ OPENCV)
        images.append((name, _quaternion(to_camera[:3, :3]), to_camera[:3, 3]))
    parameters = (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    if binary:
        cameras = struct.pack("<QiiQQ4d", 1, 7, 1, WIDTH, HEIGHT, *parameters)
        (model / "cameras.bin").write_bytes(cameras)
        parts = [struct.pack("<Q", len(images))]
        for k, (name, q, t) in enumerate(images):
            observed = k % 3  # tracks of other lengths must be skipped rightly
            parts.append(struct.pack("<i7di", k + 1, *q, *t, 7) + name.encode() + b"\0")
            parts.append(struct.pack("<Q", observed) + struct.pack("<ddq", 1.0, 2.0, -1) * observed)
        (model / "images.bin").write_bytes(b"".join(parts))
        parts = [struct.pack("<Q", len(points))]
        for k, p in enumerate(points):
            parts.append(struct.pack("<Q3d3BdQ", k, *p, 1, 2, 3, 0.5, k) + struct.pack("<ii", 1, 2) * k)
        (model / "points3D.bin").write_bytes(b"".join(parts))
    else:
        words = " ".join(map(str, parameters))
        (model / "cameras.txt").write_text(f"# comment\n7 PINHOLE {WIDTH} {HEIGHT} {words}\n")
        lines = ["# comment"]
        for k, (name, q, t) in enumerate(images):
            lines += [f"{k + 1} {' '.join(map(repr, [*q.tolist(), *t.tolist()]))} 7 {name}", "1.0 2.0 -1" * (k % 2)]
        (model / "images.txt").write_text("\n".join(lines) + "\n")
        lines = [f"{k} {' '.join(map(str, p))} 1 2 3 0.5 1 2" for k, p in enumerate(points)]
        (model / "points3D.txt").write_text("\n".join(lines) + "\n")
    return scene.folder


def write_llff(scene: Scene) -> Path:
    names = [f"{k:03d}.png" for k in range(len(scene.cameras))]
    scene.pictures("images", names, alpha=False)
    scene.masks(names)
    rows = []
    for matrix in scene.cameras:
        right, up, back, centre = matrix[:3].T
        pose = np.column_stack([-up, right, back, centre, [4 * HEIGHT, 4 * WIDTH, 4 * FOCAL]])
        rows.append([*pose.ravel(), 2.0, 6.0])
    np.save(scene.folder / "poses_bounds.npy", np.array(rows))
    return scene.folder


def write_nero(scene: Scene) -> Path:
    to_y_up = np.eye(4)
    to_y_up[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    for k, matrix in enumerate(scene.cameras):
        pixels = picture(matrix)
        Image.fromarray(pixels[..., :3]).save(scene.folder / f"{k}.png")
        depth = np.where(pixels[..., 3] > 0, 20000, 65535).astype(np.uint16)
        Image.fromarray(depth).save(scene.folder / f"{k}-depth.png")
        pose = np.linalg.inv(to_y_up @ matrix @ OPENCV)[:3].astype(np.float32)
        intrinsics = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], np.float32)
        (scene.folder / f"{k}-camera.pkl").write_bytes(pickle.dumps((pose, intrinsics)))
    return scene.folder


def write_tensoir(scene: Scene) -> Path:
    for k, matrix in enumerate(scene.cameras):
        folder = scene.folder / (f"train_{k:03d}" if k % 4 else f"test_{k // 4:03d}")
        folder.mkdir()
        for light in ("city", "sunset"):
            Image.fromarray(picture(matrix)).save(folder / f"rgba_{light}.png")
        angle = 2 * np.arctan(0.5 * WIDTH / FOCAL)
        data = {"cam_angle_x": angle, "imw": WIDTH, "imh": HEIGHT}
        data["cam_transform_mat"] = ",".join(map(str, matrix.ravel()))
        (folder / "metadata.json").write_text(json.dumps(data))
    return scene.folder
