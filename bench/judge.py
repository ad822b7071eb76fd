"""Ask Blender's Python (bpy) for Cycles pictures, and compare pictures."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from report import OUT, ROOT
from scipy.ndimage import binary_erosion

from drgs_blender.core.color import linear_to_srgb

Array = np.ndarray

_PROGRAM = Path(__file__).with_name("cycles_job.py")


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
    subprocess.run([str(blender_python()), "-P", str(_PROGRAM), str(path)], check=True, timeout=timeout)
    return json.loads(path.with_suffix(".result.json").read_text())


def cycles_pictures(jobs: list[dict[str, Any]], name: str) -> None:
    """Render those `jobs` whose pictures do not lie there yet; a picture's job is kept beside it, to compare."""
    missing = []
    for job in jobs:
        note = Path(job["out"]).with_suffix(".job.json")
        mesh = hashlib.sha256(Path(job["mesh"]).read_bytes()).hexdigest()
        # What the mesh holds decides, not where it lies: the folder's name changes with every source of the engine.
        text = json.dumps([job | {"mesh": mesh}, hashlib.sha256(_PROGRAM.read_bytes()).hexdigest()])
        if not (Path(job["out"]).exists() and note.exists() and note.read_text() == text):
            note.unlink(missing_ok=True)
            missing.append((job, note, text))
    if missing:
        run_cycles([job for job, _, _ in missing], name, timeout=600.0 * len(missing))
    for _, note, text in missing:
        note.write_text(text)


def to_srgb(linear: Array) -> Array:
    """Linear Rec.709 -> sRGB, clipped to [0, 1]."""
    return linear_to_srgb(np.clip(linear, 0, 1))


def decibels(mse: float) -> float:
    """PSNR of a mean squared error of values in [0, 1]."""
    return float(-10 * np.log10(max(mse, 1e-12)))


def psnr(a: Array, b: Array, mask: Array | None = None) -> float:
    """PSNR in dB of two linear pictures (h, w, >=3), in sRGB, over `mask`."""
    error = (to_srgb(a[..., :3]) - to_srgb(b[..., :3])) ** 2
    if mask is not None:
        error = error[mask]
    return decibels(float(error.mean()))


def systematic_error(ours: Array, theirs: Array, mask: Array) -> tuple[float, float]:
    """Mean squared difference of two renderers without the noise of either, and its standard error, in sRGB.

    With k independent pictures of each, d_i = ours_i - theirs_i are independent with the same mean, the systematic
    difference; the mean of d_i d_j over all pairs i != j is an unbiased estimate of its square, because the noise of
    two pictures has nothing in common. It can come out negative where there is nothing to be found.

    Parameters
    ----------
    ours, theirs : (k, h, w, >=3) linear, k >= 2
    mask : (h, w) bool
    """
    d = np.stack([to_srgb(a[mask][:, :3]) - to_srgb(b[mask][:, :3]) for a, b in zip(ours, theirs, strict=True)])
    d = d.astype(np.float64)
    pairs = (d.sum(0) ** 2 - (d**2).sum(0)) / (len(d) * (len(d) - 1))
    pixels = pairs.mean(axis=1)
    return float(pixels.mean()), float(pixels.std() / np.sqrt(len(pixels)))


def without_noise(error: float, deviation: float) -> str:
    """What `systematic_error` found, in dB; where it cannot be told from zero, what it is better than at 95 %."""
    if error > 2 * deviation:
        return f"{decibels(error):.1f}"
    return f"> {decibels(max(error, 0) + 2 * deviation):.1f}"


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
