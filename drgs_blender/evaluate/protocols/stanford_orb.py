"""Stanford-ORB: relit pictures of other scenes, views left out, albedo, normals and depth, as `orb` measures them.

    SET/blender_HDR/CAPTURE/{transforms_train,transforms_test,transforms_novel}.json
    SET/blender_HDR/CAPTURE/{train,test}/0000.exr, {train,test}_mask/0000.png
    SET/ground_truth/CAPTURE/{env_map/0000.exr, surface_normal/0000.npy, z_depth/0000.npy, pseudo_gt_albedo/0000.png}

Source: `orb/utils/metrics.py`, `test.py`, `env_map.py` of the benchmark (Kuang et al. 2023). Novel pictures are those
of the same object in other scenes, whose cameras are given in the world of this capture; each has its own light, seen
from its camera: forward in the middle, its up on top.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import AssetError
from ...core.frame import Camera
from ...formats.exr import read_exr
from ...formats.images import load_image
from ...formats.latlong import bilinear, directions
from ...reconstruct.capture.capture import Capture
from ...reconstruct.readers import read_capture
from ...reconstruct.readers.layout import read_json, rigid
from ...reconstruct.readers.photograph_loading import shrink
from ..metrics import straight
from . import orb_metrics
from .bench import Array, Bench, existing, mean_of

logger = logging.getLogger(__name__)

OBJECTS = tuple(
    f"{name}_scene{scene:03d}"
    for name, scenes in {
        "baking": (1, 2, 3), "ball": (2, 3, 4), "blocks": (2, 5, 6), "cactus": (1, 5, 7), "car": (2, 4, 6),
        "chips": (2, 3, 4), "cup": (3, 6, 7), "curry": (1, 5, 7), "gnome": (3, 5, 7), "grogu": (1, 2, 3),
        "pepsi": (2, 3, 4), "pitcher": (1, 5, 7), "salt": (4, 5, 7), "teapot": (1, 2, 6),
    }.items()
    for scene in scenes
)  # fmt: skip
#: Pixels of a side at which the benchmark measures.
SIDE = 512
#: Each object is relit as in its two other scenes; how many views there are differs.
COUNTS = {"other scenes": 2}
_REMEDY = "Unpack blender_HDR and ground_truth of the set again"


@dataclass(frozen=True, slots=True)
class Frame:
    """A picture by which an asset is measured, not yet read.

    Attributes
    ----------
    name : str
    image, mask : Path
    matrix : (4, 4) array
        Camera to world, Blender's convention.
    angle : float
        Horizontal field of view, radians.
    truth : Path
        Folder of the capture that it is of, in ground_truth.
    """

    name: str
    image: Path
    mask: Path
    matrix: Array
    angle: float
    truth: Path

    def of(self, kind: str, end: str) -> Path:
        """The file of this picture in the folder `kind` of its truth."""
        return self.truth / kind / f"{self.image.stem}{end}"


def folder(root: Path, name: str) -> Path:
    """The photographs of a capture, in high dynamic range."""
    return root / "blender_HDR" / name


def read(root: Path, name: str, resolution: int | None) -> Capture:
    """The capture to learn from, at the benchmark's size."""
    return read_capture(folder(root, name), resolution or SIDE)


def check(root: Path, name: str, lights: Path | None) -> tuple[list[Frame], list[Frame]]:
    """The frames of other scenes, and those left out. Raises AssetError where a picture or a light is not there."""
    existing(folder(root, name), f"photographs of {name}")
    novel, testing = (frames(root, name, split) for split in ("novel", "test"))
    for frame in novel:
        if not (file := frame.of("env_map", ".exr")).is_file():
            raise AssetError(str(file), "is not there", _REMEDY)
    return novel, testing


def measure(bench: Bench, root: Path, name: str, lights: Path | None) -> dict[str, Any]:
    """Figures of a capture."""
    novel, testing = check(root, name, lights)
    bench.warn_of_known([f"test/{frame.image.stem}" for frame in testing], name)
    rows = []
    for number, frame, true, mask in _pictures(bench, "relit", novel):
        radiance = camera_light(_exr(frame.of("env_map", ".exr")), frame.matrix)
        ours, _ = _linear(bench, frame, true.shape[0], radiance)
        rows.append(_scores(bench, "relit", number, ours, true, mask, scaled=True))
    report: dict[str, Any] = {"relit": mean_of(rows)}
    rows, shape, albedo = [], [], []
    depths: list[tuple[Array, Array, int]] = []
    for number, frame, true, mask in _pictures(bench, "views", testing):
        ours, passes = _linear(bench, frame, true.shape[0], bench.own_light())
        rows.append(_scores(bench, "views", number, ours, true, mask, scaled=False))
        inside = orb_metrics.eroded(mask)
        if (normals := _array(frame.of("surface_normal", ".npy"), true.shape[0], 3)) is not None:
            seen = np.nan_to_num(passes["Normal"]) @ frame.matrix[:3, :3]
            shape.append({"normal_distance": orb_metrics.normal_distance(seen, normals, inside)})
        if (depth := _array(frame.of("z_depth", ".npy"), true.shape[0], 1)) is not None:
            found = np.where(passes["Coverage"][..., 0] > 0, passes["Depth"][..., 0], 0)
            depths.append((found[inside], depth[..., 0][inside], inside.size))
        if (wanted := _albedo(frame.of("pseudo_gt_albedo", ".png"), true.shape[0])) is not None:
            albedo.append({"albedo_psnr": orb_metrics.albedo_psnr(np.nan_to_num(passes["Albedo"]), wanted, mask)})
    report |= {"views": mean_of(rows), "shape": mean_of(shape), "materials": mean_of(albedo)}
    report["shape"]["depth_mse"] = orb_metrics.depth_error(depths) if len(depths) == len(rows) else None
    for part, count in (("surface_normal", len(shape)), ("z_depth", len(depths)), ("pseudo_gt_albedo", len(albedo))):
        if count < len(rows):
            logger.warning("%s: ground_truth has %d of %d files %s", name, count, len(rows), part)
    return report


def counts(root: Path, name: str) -> dict[str, int]:
    """How many scenes there are of which there are novel pictures."""
    return {"other scenes": len({frame.truth for frame in frames(root, name, "novel")})}


def frames(root: Path, name: str, split: str) -> list[Frame]:
    """The pictures of transforms_SPLIT.json of a capture, in the order of the file.

    Raises
    ------
    AssetError
        The file or a picture that it names is not there, or the file describes no cameras.
    """
    file = folder(root, name) / f"transforms_{split}.json"
    data = read_json(file)
    found, missing = [], []
    try:
        for entry in data["frames"]:
            scene = str(entry.get("scene_name", name))
            image = folder(root, scene) / f"{entry['file_path']}.exr"
            mask = image.parent.with_name(f"{image.parent.name}_mask") / f"{image.stem}.png"
            missing += [str(path.relative_to(root)) for path in (image, mask) if not path.is_file()]
            matrix = rigid(entry["transform_matrix"], str(file))
            angle = float((entry if "camera_angle_x" in entry else data)["camera_angle_x"])
            if not 0 < angle < math.pi:
                raise ValueError(f"camera_angle_x {angle:g}")
            found.append(Frame(f"{scene}/{image.stem}", image, mask, matrix, angle, root / "ground_truth" / scene))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise AssetError(str(file), f"does not describe cameras ({error!r})", _REMEDY) from error
    if missing:
        raise AssetError(str(file), f"names {len(missing)} files that are not there, as {missing[0]}", _REMEDY)
    if not found:
        raise AssetError(str(file), "names no pictures", _REMEDY)
    return found


def camera_light(image: Array, matrix: Array) -> Array:
    """(h, 2 h, 3) float32 radiance in Blender's mapping of a light as a camera sees it.

    Parameters
    ----------
    image : (h, w, 3) array
        Lat-long about the camera: its forward direction in the middle, its right at three quarters, its up on top.
    matrix : (4, 4) array
        Camera to world.
    """
    height, width = image.shape[:2]
    x, y, z = np.moveaxis(directions(height) @ matrix[:3, :3], -1, 0)  # world to camera
    column = (np.arctan2(x, -z) / (2 * np.pi) + 0.5) * width - 0.5
    row = np.arccos(np.clip(y, -1, 1)) / np.pi * height - 0.5
    wrapped = np.concatenate([image[:, -1:], image, image[:, :1]], axis=1)
    return np.maximum(bilinear(wrapped, column + 1, row), 0).astype(np.float32)


def _pictures(bench: Bench, part: str, found: list[Frame]) -> Iterator[tuple[int, Frame, Array, Array]]:
    """(number, frame, (n, n, 3) linear picture, (n, n) bool mask) of the frames that are rendered."""
    chosen = bench.chosen(found)
    for number, frame in enumerate(chosen):
        bench.progress(part, number, len(chosen))
        side = bench.resolution or SIDE
        picture = _shrunk(_exr(frame.image), side)
        if picture.shape[0] != picture.shape[1]:
            problem = f"is {picture.shape[1]} x {picture.shape[0]} pixels, not square"
            raise AssetError(str(frame.image), problem, _REMEDY)
        mask = _shrunk(_grey(load_image(frame.mask)), side)[..., 0]
        if mask.shape != picture.shape[:2]:
            problem = (
                f"is {mask.shape[1]} x {mask.shape[0]} pixels, its picture {picture.shape[1]} x {picture.shape[0]}"
            )
            raise AssetError(str(frame.mask), problem, _REMEDY)
        yield number, frame, picture, mask > 0.5
    bench.progress(part, len(chosen), len(chosen))


def _linear(bench: Bench, frame: Frame, side: int, radiance: Array) -> tuple[Array, dict[str, Array]]:
    """((n, n, 3) linear picture on black, all passes)."""
    focal = 0.5 * side / math.tan(0.5 * frame.angle)
    camera = Camera(frame.matrix, side, side, focal, focal, side / 2, side / 2)
    passes = bench.render(camera, radiance, (1.0, 1.0, 1.0))
    linear, alpha = straight(passes)
    return np.maximum(linear * alpha[..., None], 0), passes


def _scores(
    bench: Bench, part: str, number: int, ours: Array, true: Array, mask: Array, scaled: bool
) -> dict[str, float | None]:
    found = orb_metrics.picture_scores(ours, true, mask, scaled, bench.flip, bench.lpips)
    bench.show(part, number, found.ours, found.true)
    return found.figures


def _exr(path: Path) -> Array:
    return read_exr(path)[0]


def _grey(image: Array) -> Array:
    """(h, w, 1) float32 in 0..1 of an 8-bit mask."""
    return image[..., :1].astype(np.float32) / np.float32(np.iinfo(image.dtype).max)


def _shrunk(image: Array, side: int) -> Array:
    height, width = image.shape[:2]
    factor = min(1.0, side / max(height, width))
    return shrink(image.astype(np.float32), round(width * factor), round(height * factor)) if factor < 1 else image


def _array(path: Path, side: int, channels: int) -> Array | None:
    """(n, n, c) float32 of a file of numbers, None where there is none."""
    if not path.is_file():
        return None
    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)  # mapped, the file must be as long as it says
    except Exception as error:  # damaged files raise almost anything
        raise AssetError(str(path), f"holds no map ({error})", _REMEDY) from error
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiu":
        raise AssetError(str(path), "holds no map (no array of numbers)", _REMEDY)
    if values.ndim not in (2, 3) or not values.size or values[0, 0].size != channels:
        raise AssetError(str(path), f"holds no map (an array of shape {values.shape})", _REMEDY)
    return _fitting(np.array(values, np.float32).reshape(*values.shape[:2], channels), path, side)


def _albedo(path: Path, side: int) -> Array | None:
    """(n, n, 3) sRGB-encoded, None where there is none."""
    if not path.is_file():
        return None
    image = load_image(path)
    return _fitting(image[..., :3].astype(np.float32) / np.float32(np.iinfo(image.dtype).max), path, side)


def _fitting(image: Array, path: Path, side: int) -> Array:
    """The map in the size of its picture, (n, n, c). Raises AssetError where it is not of its shape, or smaller."""
    if (small := _shrunk(image, side)).shape[:2] != (side, side):
        problem = f"is {image.shape[1]} x {image.shape[0]} pixels, its picture {side} x {side}"
        raise AssetError(str(path), problem, _REMEDY)
    return small
