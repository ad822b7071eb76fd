"""Cameras in transforms*.json: NeRF-synthetic, Instant-NGP, nerfstudio, and what follows them.

Matrices are camera-to-world with OpenGL axes, which are Blender's. NeRF-synthetic knows one horizontal field of view
and a Z-up world; the others give focal lengths, per file or per frame, and any world.
"""

from __future__ import annotations

import logging
import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import AssetError
from ...formats.ply import read_ply
from .layout import (
    PICTURES,
    Layout,
    Photograph,
    complain_of_missing,
    find_mask,
    find_picture,
    picture_size,
    read_json,
    rigid,
)
from .lens import Lens, lens_of

logger = logging.getLogger(__name__)

#: Sparse points that are kept at most.
MOST_POINTS = 1_000_000
#: nerfstudio's names of models -> (model, keys of its coefficients)
_MODELS = {
    "SIMPLE_PINHOLE": ("PINHOLE", ()),
    "PINHOLE": ("PINHOLE", ()),
    "PERSPECTIVE": ("OPENCV", ("k1", "k2", "p1", "p2")),
    "SIMPLE_RADIAL": ("OPENCV", ("k1", "k2", "p1", "p2")),
    "RADIAL": ("OPENCV", ("k1", "k2", "p1", "p2")),
    "OPENCV": ("OPENCV", ("k1", "k2", "p1", "p2")),
    "FULL_OPENCV": ("FULL_OPENCV", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "OPENCV_FISHEYE": ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
    "FISHEYE": ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
}
#: What a frame says that has a camera of its own.
_OWN = {"camera_angle_x", "fl_x", "w", "h"}
#: Files of a folder, in the order in which they are taken; those of one row belong together: (file, left out).
_FILES = (
    (("transforms_train.json", False), ("transforms_test.json", True)),
    (("transforms.json", False),),
)


def sniff(path: Path) -> bool:
    """Whether `path` is such a file, or a folder with one."""
    if path.is_file():
        return path.suffix.lower() == ".json"
    return any((path / name).is_file() for row in _FILES for name, _ in row)


def read(path: Path) -> Layout:
    """Read a folder, or one file. Raises AssetError."""
    if path.is_file():
        photographs, synthetic = _read_file(path, False, prefix=False)
        return Layout(photographs, synthetic, _points(path), guessed=_guessed(path))
    row = next(row for row in _FILES if any((path / name).is_file() for name, _ in row))
    photographs, synthetic = [], True
    present = [(path / name, test) for name, test in row if (path / name).is_file()]
    for file, test in present:
        found, of_blender = _read_file(file, test, prefix=len(present) > 1)
        photographs += found
        synthetic = synthetic and of_blender
    return Layout(photographs, synthetic, _points(present[0][0]), guessed=_guessed(present[0][0]))


def _guessed(path: Path) -> dict[str, str]:
    """What `drgs capture` assumed of the world of the file `path`."""
    found = read_json(path).get("guessed")
    return {str(name): str(why) for name, why in found.items()} if isinstance(found, dict) else {}


def _points(path: Path) -> np.ndarray | None:
    """(n, 3) float64 sparse points of the file that `path` names as nerfstudio does, None where it names none."""
    name = read_json(path).get("ply_file_path")
    if name is None:
        return None
    try:
        columns = read_ply(path.parent / str(name))[1]["vertex"].columns
        points = np.stack([np.asarray(columns[axis], np.float64) for axis in "xyz"], axis=1)
    except (AssetError, OSError, KeyError) as error:  # they only start a reconstruction
        logger.warning("%s: names sparse points, %s, that cannot be read and are not used (%s)", path, name, error)
        return None
    points = points[np.isfinite(points).all(axis=1)]
    return points[:: len(points) // MOST_POINTS + 1] if len(points) else None


def _read_file(path: Path, test: bool, prefix: bool) -> tuple[list[Photograph], bool]:
    """(photographs, whether the world is Z up: NeRF-synthetic's, or nerfstudio's that is to stay as it is)."""
    data = read_json(path)
    frames = data.get("frames")
    if isinstance(frames, dict):
        frames = list(frames.values())
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise AssetError(str(path), "has no list of frames", "Choose a transforms.json of NeRF or nerfstudio")
    left_out = data.get("test_filenames", [])
    if not isinstance(left_out, list):
        raise AssetError(str(path), "has test_filenames that are no list of names", "Export the capture again")
    photographs: list[Photograph] = []
    missing, alike = [], []
    for index, frame in enumerate(frames):
        subject = f"{path}, frame {index}"
        name = frame.get("file_path")
        if not isinstance(name, str):
            raise AssetError(subject, "has no file_path", "Export the capture again")
        image = find_picture(path.parent / name)
        if image is None:
            missing.append(name)
            continue
        lens = _lens(data | frame, image, subject)
        mask = _mask(path, frame, image, name)
        matrix = rigid(frame.get("transform_matrix"), subject)
        tidy = Path(name).with_suffix("") if Path(name).suffix in PICTURES else Path(name)
        label = tidy.as_posix().removeprefix("./") if prefix else tidy.name
        photographs.append(
            Photograph(label, image, matrix, lens, mask, test or name in left_out, _number(frame, "exposure_value"),
                       max(_number(frame, "mask_band") or 0.0, 0.0))
        )  # fmt: skip
        if not _OWN & frame.keys():
            alike.append(photographs[-1])
    complain_of_missing(str(path), missing, len(frames))
    _check_shapes(alike, path)
    if len({photograph.name for photograph in photographs}) < len(photographs):
        for index, photograph in enumerate(photographs):
            photograph.name = f"{index:04d}-{photograph.name}"
    synthetic = "camera_angle_x" in data and "fl_x" not in data and "fl_x" not in frames[0]
    return photographs, synthetic or data.get("orientation_override") == "none"


def _check_shapes(photographs: list[Photograph], path: Path) -> None:
    """Raise AssetError where a picture has another shape than most of those that one camera of the file took."""
    sizes = Counter((p.lens.width, p.lens.height) for p in photographs)
    if not sizes:
        return
    (width, height), _ = sizes.most_common(1)[0]
    for photograph in photographs:
        w, h = photograph.lens.width, photograph.lens.height
        if abs(w / width - h / height) * max(width, height) > 2:
            problem = (
                f"is {w} x {h} pixels, most pictures of {path.name}, which has one camera for all, {width} x {height}"
            )
            remedy = "Restore it, take its frame out of the file, or give each frame a camera (fl_x, w, h)"
            raise AssetError(str(photograph.image), problem, remedy)


def _mask(path: Path, frame: dict[str, Any], image: Path, name: str) -> Path | None:
    if "mask_path" not in frame:
        # Stanford-ORB has those of train/0000.exr in train_mask.
        own = image.parent.with_name(f"{image.parent.name}_mask")
        return find_mask(path.parent / "masks", image) or find_mask(own, image)
    mask = find_picture(path.parent / str(frame["mask_path"]))
    if mask is None:
        problem = f"names the mask {frame['mask_path']} for {name}, which is not there"
        raise AssetError(str(path), problem, "Put it back, or take mask_path out")
    return mask


def _number(frame: dict[str, Any], key: str) -> float | None:
    """A number that `drgs capture` has written: "exposure_value" from EXIF, or "mask_band"."""
    value = frame.get(key)
    known = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if known else None  # type: ignore[arg-type]


def _lens(values: dict[str, Any], image: Path, subject: str) -> Lens:
    """The lens of a frame, from the file's own values and the frame's, which win."""

    def number(key: str, default: float | None = None) -> float:
        value = values.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise AssetError(subject, f"has no number {key}" if value is None else f"has {key} = {value!r}")
        return float(value)

    width, height = picture_size(image)
    if "fl_x" not in values:
        if "camera_angle_x" not in values:
            raise AssetError(subject, "has neither camera_angle_x nor fl_x", "Export the capture with its cameras")
        angle = number("camera_angle_x")
        if not 0 < angle < math.pi:
            raise AssetError(subject, f"has camera_angle_x = {angle:g}", "It is in radians, between 0 and pi")
        focal = 0.5 * width / math.tan(angle / 2)
        return Lens(width, height, focal, focal, width / 2, height / 2)
    width, height = int(number("w", width)), int(number("h", height))
    fx = number("fl_x")
    name = str(values.get("camera_model", "OPENCV"))
    if name not in _MODELS:
        raise AssetError(subject, f"has the camera model {name}", f"Known are {', '.join(_MODELS)}")
    model, keys = _MODELS[name]
    centre = number("cx", width / 2), number("cy", height / 2)
    coefficients = [number(key, 0.0) for key in keys]
    return lens_of(model, width, height, np.array([fx, number("fl_y", fx), *centre, *coefficients]), subject)
