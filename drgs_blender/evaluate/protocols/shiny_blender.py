"""Ref-NeRF's Shiny Blender: views left out and normals.

    SET/OBJECT/{transforms_train.json, transforms_test.json}, and beside each picture NAME.png NAME_normal.png

Source: `Blender` of `datasets.py` and `compute_weighted_mae` of multinerf (Verbin et al. 2022). The set has no pictures
under other lights.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...core.color import to_unit
from ...core.errors import AssetError
from ...formats.images import load_image
from ...reconstruct.capture.capture import Capture, View
from ...reconstruct.readers import read_capture, transforms
from ...reconstruct.readers.layout import Layout, complain_of_missing
from ...reconstruct.readers.photograph_loading import shrink
from .bench import Array, Bench, existing, mean_of, shown_on_white, split_counts

OBJECTS = ("ball", "car", "coffee", "helmet", "teapot", "toaster")
#: Views of the published set.
COUNTS = {"training views": 100, "views left out": 200}


def folder(root: Path, name: str) -> Path:
    """The photographs of an object."""
    return root / name


def read(root: Path, name: str, resolution: int | None) -> Capture:
    """The capture to learn from."""
    return read_capture(folder(root, name), resolution)


def check(root: Path, name: str, lights: Path | None) -> Layout:
    """The views. Raises AssetError where one, or its normals, are not there."""
    source = existing(folder(root, name), f"photographs of {name}")
    if not (source / "transforms_test.json").is_file():
        raise AssetError(str(source / "transforms_test.json"), "is not there", "Unpack the set again")
    layout = transforms.read(source)
    testing = [photograph for photograph in layout.photographs if photograph.test]
    missing = [file.name for photograph in testing if not (file := _normals(photograph.image)).is_file()]
    complain_of_missing(str(source), missing, len(testing))
    return layout


def counts(root: Path, name: str) -> dict[str, int]:
    """How many views there are."""
    return split_counts(transforms.read(folder(root, name)))


def _normals(image: Path) -> Path:
    return image.with_name(f"{image.stem}_normal.png")


def measure(bench: Bench, root: Path, name: str, lights: Path | None) -> dict[str, Any]:
    """Figures of an object."""
    layout = check(root, name, lights)
    testing = [photograph for photograph in layout.photographs if photograph.test]
    bench.warn_of_known([photograph.name for photograph in testing], name)
    images = {photograph.name: photograph.image for photograph in testing}
    rows, angles = [], []
    for number, view in bench.views("views", layout, testing):
        passes = bench.render(view.camera, bench.own_light(), (1.0, 1.0, 1.0))
        ours = shown_on_white(passes)
        bench.show("views", number, ours, view.colour)
        rows.append(bench.scores(ours, view.colour))
        angles.append({"normal_degrees": _normal_error(passes, images[view.name], view)})
    return {"views": mean_of(rows), "shape": mean_of(angles)}


def _normal_error(passes: dict[str, Array], image: Path, view: View) -> float:
    """Mean angle in degrees, weighted by the coverage of ours times the true alpha; NaN where all of that is zero."""
    true = 2 * shrink(to_unit(load_image(_normals(image)))[..., :3], view.camera.width, view.camera.height) - 1
    if view.mask is None:
        raise AssetError(str(image), "has no alpha", "Use the set's own files")
    ours = np.nan_to_num(passes["Normal"])
    lengths = np.linalg.norm(ours, axis=-1) * np.linalg.norm(true, axis=-1)
    cosine = (ours * true).sum(axis=-1) / np.maximum(lengths, 1e-8)
    angles = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    weights = np.clip(passes["Coverage"][..., 0], 0, 1) * view.mask
    total = float(weights.sum(dtype=np.float64))
    return float((angles * weights).sum(dtype=np.float64) / total) if total > 0 else float("nan")
