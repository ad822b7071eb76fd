"""A glTF file for `bench_make.py` of what examples/ lack: a lamp with a texture of radiance, and a veil."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as Pillow

from drgs_blender.formats.glb import Glb

#: Radiance of the brightest texel.
STRENGTH = 6.0


def write_lantern(path: Path) -> Path:
    """Write the file; Y up."""
    glb = Glb()
    y, x = np.mgrid[0:128, 0:256] / np.array([128, 256]).reshape(2, 1, 1)
    glow = (0.5 + 0.5 * np.cos(6 * np.pi * x)) * np.sin(np.pi * y) ** 2
    radiance = np.stack([glow, 0.6 * glow**1.5, 0.2 * glow**2], axis=-1)
    v, u = np.mgrid[0:128, 0:128] / 127
    veil = np.dstack([np.broadcast_to([0.1, 0.3, 0.7], (128, 128, 3)), 0.15 + 0.7 * v * (0.6 + 0.4 * np.sin(9 * u))])
    pictures = [_png(radiance), _png(veil)]
    views = [glb.view(picture) for picture in pictures]
    rough = {"metallicFactor": 0.0, "roughnessFactor": 0.7}
    strength = {"KHR_materials_emissive_strength": {"emissiveStrength": STRENGTH}}
    glb.json |= {
        "extensionsUsed": list(strength),
        "images": [{"bufferView": view, "mimeType": "image/png"} for view in views],
        "samplers": [{"magFilter": 9729, "minFilter": 9729, "wrapS": 10497, "wrapT": 33071}],
        "textures": [{"sampler": 0, "source": i} for i in range(2)],
        "materials": [
            {
                "name": "lamp", "pbrMetallicRoughness": {"baseColorFactor": [0.5, 0.5, 0.5, 1.0], **rough},
                "emissiveFactor": [1.0, 1.0, 1.0], "emissiveTexture": {"index": 0}, "extensions": strength,
            },
            {
                "name": "veil", "pbrMetallicRoughness": {"baseColorTexture": {"index": 1}, **rough},
                "alphaMode": "BLEND", "doubleSided": True,
            },
            {"name": "floor", "pbrMetallicRoughness": {"baseColorFactor": [0.6, 0.6, 0.6, 1.0], **rough}},
        ],
        "scene": 0,
        "scenes": [{"nodes": [0, 1, 2]}],
    }  # fmt: skip
    grid = [
        _sphere(0.5),
        _grid([-0.9, 0.0, 0.7], [1.2, 0, 0], [0, 1.2, 0]),
        _grid([-2, -0.5, 2], [4, 0, 0], [0, 0, -4]),
    ]
    glb.json["meshes"] = [_mesh(glb, *part, material) for material, part in enumerate(grid)]
    glb.json["nodes"] = [{"mesh": i, "name": name} for i, name in enumerate(("lamp", "veil", "floor"))]
    glb.write(path)
    return path


def _mesh(glb: Glb, vertices: np.ndarray, normals: np.ndarray, uvs: np.ndarray, faces: np.ndarray, material: int) -> (
    dict[str, Any]
):  # fmt: skip
    attributes = {
        "POSITION": glb.accessor(vertices.astype(np.float32), bounds=True),
        "NORMAL": glb.accessor(normals.astype(np.float32)),
        "TEXCOORD_0": glb.accessor(uvs.astype(np.float32)),
    }
    indices = glb.accessor(faces.astype(np.uint32).ravel())
    return {"primitives": [{"attributes": attributes, "indices": indices, "material": material}]}


def _faces(rows: int, columns: int) -> np.ndarray:
    """Triangles of a grid of (rows + 1) x (columns + 1) vertices."""
    r, c = (a.ravel() for a in np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"))
    a = r * (columns + 1) + c
    b, d, e = a + columns + 1, a + columns + 2, a + 1
    return np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, e], 1)])


def _sphere(radius: float, rows: int = 48, columns: int = 96) -> tuple[np.ndarray, ...]:
    v, u = (a.ravel() for a in np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij"))
    theta, phi = np.pi * v, 2 * np.pi * u
    normals = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), -np.sin(theta) * np.sin(phi)], 1)
    return radius * normals, normals, np.stack([u, v], 1), _faces(rows, columns)


def _grid(corner: list[float], along: list[float], up: list[float], count: int = 24) -> tuple[np.ndarray, ...]:
    t, s = (a.ravel() for a in np.meshgrid(*[np.linspace(0, 1, count + 1)] * 2, indexing="ij"))
    vertices = np.array(corner) + s[:, None] * along + t[:, None] * up
    normal = np.cross(along, up) / np.linalg.norm(np.cross(along, up))
    return vertices, np.tile(normal, (len(s), 1)), np.stack([s, 1 - t], 1), _faces(count, count)[:, [0, 2, 1]]


def _png(colours: np.ndarray) -> bytes:
    """PNG of linear colours as sRGB, alpha as it is."""
    pixels = np.clip(colours, 0, 1)
    linear = pixels[..., :3]
    pixels[..., :3] = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    data = io.BytesIO()
    Pillow.fromarray(np.rint(pixels * 255).astype(np.uint8)).save(data, "PNG")
    return data.getvalue()
