"""COLMAP's sparse models, text or binary: cameras, images, points3D (formats of its documentation)."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from ...core.errors import AssetError
from .layout import OPENCV_TO_BLENDER, Layout, Photograph, complain_of_missing, find_mask, invert, rigid
from .lens import MODELS, Lens, lens_of

Array = np.ndarray

#: COLMAP's numbers of the models in binary files.
_NUMBERS = dict(
    enumerate(
        (
            *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV"),
            *("FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"),
        )
    )
)
_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "distorted/sparse/0", ".")
_IMAGES = ("images", "images_2", "images_4", "images_8", "input", ".")
#: Points that are kept at most: they only start a reconstruction.
MOST_POINTS = 1_000_000
_DAMAGED = "Export the model again from COLMAP"


def model_folder(path: Path) -> Path | None:
    """The folder of the sparse model at or below `path`."""
    if not path.is_dir():
        return None
    for folder in (path / name for name in _FOLDERS):
        for end in (".bin", ".txt"):
            if (folder / f"cameras{end}").is_file() and (folder / f"images{end}").is_file():
                return folder
    return None


def sniff(path: Path) -> bool:
    """Whether there is a sparse model at `path`."""
    return model_folder(path) is not None


def read(path: Path) -> Layout:
    """Read a sparse model and find its photographs. Raises AssetError."""
    model = model_folder(path)
    assert model is not None
    binary = (model / "cameras.bin").is_file() and (model / "images.bin").is_file()
    try:
        lenses = _cameras_binary(model / "cameras.bin") if binary else _cameras_text(model / "cameras.txt")
        poses = _images_binary(model / "images.bin") if binary else _images_text(model / "images.txt")
        points = _points(model)
    except (struct.error, ValueError, IndexError, UnicodeDecodeError) as error:
        raise AssetError(str(model), f"is damaged ({error})", _DAMAGED) from error
    except OSError as error:
        raise AssetError(str(model), f"cannot be read ({error.strerror or error})", "Check the path") from error
    if not poses:
        raise AssetError(str(model), "has no registered image", "Let COLMAP register the photographs first")
    root = _root(path, model)
    folder = _image_folder(root, [name for name, _, _ in poses])
    photographs, missing = [], []
    for name, camera, matrix in sorted(poses, key=lambda pose: pose[0]):
        image = folder / name
        if camera not in lenses:
            raise AssetError(str(model), f"has no camera {camera}, which {name} was taken with", _DAMAGED)
        if not image.is_file():
            missing.append(name)
            continue
        mask = find_mask(root / "masks", image, name)
        photographs.append(Photograph(name, image, matrix, lenses[camera], mask))
    complain_of_missing(f"{model} (images looked for in {folder})", missing, len(poses))
    return Layout(photographs, upright=False, points=points)


def _root(path: Path, model: Path) -> Path:
    """The folder that holds images and masks: that of the capture, also when the model's own folder was given."""
    for folder in (path, *model.parents[:3]):
        if any((folder / name).is_dir() for name in _IMAGES[:-1]):
            return folder
    return path


def _image_folder(root: Path, names: list[str]) -> Path:
    """Where most of the images are."""
    folders = [root / name for name in _IMAGES if (root / name).is_dir()]
    return max(folders, key=lambda folder: sum((folder / name).is_file() for name in names))


def _pose(quaternion: Array, translation: Array, name: str) -> Array:
    """Camera-to-world of COLMAP's world-to-camera quaternion wxyz and translation."""
    length = np.linalg.norm(quaternion)
    if not 1e-6 < length < 1e6:
        raise AssetError(name, "has an impossible rotation", _DAMAGED)
    w, x, y, z = quaternion / length
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    to_camera = rigid(np.column_stack([rotation, translation]), name)
    return invert(to_camera) @ OPENCV_TO_BLENDER


def _lines(path: Path) -> list[str]:
    text = path.read_text(encoding="utf-8")
    return [line.strip() for line in text.splitlines() if not line.lstrip().startswith("#")]


def _cameras_text(path: Path) -> dict[int, Lens]:
    lenses = {}
    for line in filter(None, _lines(path)):
        number, model, width, height, *parameters = line.split()
        values = np.array(parameters, np.float64)
        lenses[int(number)] = lens_of(model, int(width), int(height), values, f"{path}, camera {number}")
    return lenses


def _images_text(path: Path) -> list[tuple[str, int, Array]]:
    """(name, camera, camera-to-world); every second line lists points and may be empty."""
    poses = []
    lines = _lines(path)
    while lines and not lines[0]:
        lines.pop(0)
    for line in lines[::2]:
        if not line:
            continue
        words = line.split(maxsplit=9)
        values = np.array(words[1:8], np.float64)
        poses.append((words[9], int(words[8]), _pose(values[:4], values[4:], f"{path}, {words[9]}")))
    return poses


def _cameras_binary(path: Path) -> dict[int, Lens]:
    data = path.read_bytes()
    (count,) = struct.unpack_from("<Q", data)
    at, lenses = 8, {}
    for _ in range(count):
        number, model, width, height = struct.unpack_from("<iiQQ", data, at)
        name = _NUMBERS.get(model, f"number {model}")
        subject = f"{path}, camera {number}"
        parameters = sum(MODELS[name][:2]) + 2 if name in MODELS else 0
        values = np.frombuffer(data, "<f8", parameters, at + 24)
        lenses[number] = lens_of(name, width, height, values, subject)
        at += 24 + 8 * parameters
    return lenses


def _images_binary(path: Path) -> list[tuple[str, int, Array]]:
    data = path.read_bytes()
    (count,) = struct.unpack_from("<Q", data)
    at, poses = 8, []
    for _ in range(count):
        values = np.array(struct.unpack_from("<7d", data, at + 4))
        (camera,) = struct.unpack_from("<i", data, at + 60)
        end = data.index(b"\0", at + 64)
        name = data[at + 64 : end].decode("utf-8")
        (points,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + 24 * points
        poses.append((name, camera, _pose(values[:4], values[4:], f"{path}, {name}")))
    _check_end(at, data)
    return poses


def _check_end(at: int, data: bytes) -> None:
    """Raise ValueError where the last record of a file goes on beyond its end."""
    if at > len(data):
        raise ValueError(f"it ends after {len(data)} of at least {at} bytes")


def _points(model: Path) -> Array | None:
    """(n, 3) float64 sparse points, at most `MOST_POINTS`; None where there are none."""
    if (model / "points3D.bin").is_file():
        data = (model / "points3D.bin").read_bytes()
        (count,) = struct.unpack_from("<Q", data)
        points, at = [], 8
        for _ in range(count):
            points.append(struct.unpack_from("<3d", data, at + 8))
            (track,) = struct.unpack_from("<Q", data, at + 43)
            at += 51 + 8 * track
        _check_end(at, data)
    elif (model / "points3D.txt").is_file():
        points = [
            (float(x), float(y), float(z))
            for _, x, y, z, *_ in (line.split(maxsplit=4) for line in _lines(model / "points3D.txt") if line)
        ]
    else:
        return None
    array = np.array(points, np.float64).reshape(-1, 3)
    array = array[np.isfinite(array).all(axis=1)]
    return array[:: len(array) // MOST_POINTS + 1] if len(array) else None
