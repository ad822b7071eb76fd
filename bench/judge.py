"""Ask Blender's Python (bpy) for Cycles pictures, and compare pictures."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from report import OUT, ROOT
from scipy.ndimage import binary_erosion

from drgs_blender.formats.colour import linear_to_srgb

Array = np.ndarray


def blender_python() -> Path:
    """Interpreter that has bpy: DRGS_BLENDER, else .venv-blender beside the checkout."""
    if override := os.environ.get("DRGS_BLENDER"):
        return Path(override)
    folder = ROOT / ".venv-blender"
    return folder / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")


def environments() -> Path:
    """Folder of the HDRIs that come with Blender."""
    found = sorted((ROOT / ".venv-blender").glob("lib/python*/site-packages/bpy/*/datafiles/studiolights/world"))
    found += sorted((ROOT / ".venv-blender").glob("Lib/site-packages/bpy/*/datafiles/studiolights/world"))
    if not found:
        raise SystemExit("no bpy in .venv-blender: run `make env` first")
    return found[0]


def run_cycles(jobs: list[dict[str, Any]], name: str, timeout: float = 3000) -> list[dict[str, Any]]:
    """Render `jobs` (see cycles_job.py) in one Blender process; returns their results."""
    OUT.mkdir(parents=True, exist_ok=True)
    path = OUT / f"{name}.json"
    path.write_text(json.dumps(jobs))
    program = Path(__file__).with_name("cycles_job.py")
    subprocess.run([str(blender_python()), "-P", str(program), str(path)], check=True, timeout=timeout)
    return json.loads(path.with_suffix(".result.json").read_text())


def to_srgb(linear: Array) -> Array:
    """Linear Rec.709 -> sRGB, clipped to [0, 1]."""
    return linear_to_srgb(np.clip(linear, 0, 1))


def psnr(a: Array, b: Array, mask: Array | None = None) -> float:
    """PSNR in dB of two linear pictures (h, w, >=3), in sRGB, over `mask`."""
    error = (to_srgb(a[..., :3]) - to_srgb(b[..., :3])) ** 2
    if mask is not None:
        error = error[mask]
    return float(-10 * np.log10(max(error.mean(), 1e-12)))


def foreground(alpha: Array, erode: int = 2) -> Array:
    """Mask of fully covered pixels, eroded."""
    covered = alpha > 0.999
    return binary_erosion(covered, iterations=erode) if erode else covered


def look_at(eye: Array, target: Array) -> Array:
    """Camera-to-world matrix (Blender's convention) at `eye` looking at `target`, Z up."""
    back = np.asarray(eye, float) - target
    back /= np.linalg.norm(back)
    right = np.cross((0, 0, 1), back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2], matrix[:3, 3] = right, np.cross(back, right), back, eye
    return matrix


def frame_camera(vertices: Array, size: int, azimuth: float, fov_x: float = 40.0, fill: float = 1.15) -> dict[str, Any]:
    """CAM.json of a camera that sees all `vertices` from `azimuth` degrees, a little from above."""
    low, high = vertices.min(0), vertices.max(0)
    centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    distance = fill * radius / np.sin(np.radians(fov_x) / 2)
    a, e = np.radians(azimuth), np.radians(15)
    eye = centre + distance * np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    return {"matrix_world": look_at(eye, centre).tolist(), "width": size, "height": size, "fov_x": fov_x}
