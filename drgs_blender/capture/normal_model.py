"""Normals of photographs by a model that the user has: an ONNX file that gives the normals of one picture.

Models differ in their axes: the signs that agree best with the outlines of all views are taken, which know the object's
surface roughly.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image as Pillow

from ..core.arrays import Array
from ..core.errors import AssetError, Cancelled, UsageError
from ..geometry.normals import unit
from ..reconstruct.capture.capture import Capture, View
from ..reconstruct.meshing.crops import box_of
from ..reconstruct.meshing.visual_hull import Region, find_region, silhouettes, world_to_pixel
from .features import Tell
from .picture_model import IMAGENET, PictureModel, Preparation

logger = logging.getLogger(__name__)

#: Beginning of a file's name -> how pictures are prepared, of the model's own program.
KNOWN = {
    "omnidata": Preparation(384, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
    "": Preparation(512, *IMAGENET),
}
#: Margin of what a model is shown around the object, in parts of the object's longer side.
MARGIN = 0.1
#: How much nearer than normals that all face the viewer those of a model must be to the outlines' surface, in mean
#: cosine, to be believed.
AGREEMENT = 0.1


@functools.cache
def load_model(given: str) -> NormalModel:
    """`NormalModel`, read once in a process."""
    return NormalModel(given)


class NormalModel(PictureModel):
    """A model that gives the normals of a picture.

    Parameters
    ----------
    given : str
        Its file.

    Raises
    ------
    AssetError, DeviceError
        As of `PictureModel`.
    UsageError
        There is no such file.
    """

    def __init__(self, given: str) -> None:
        if not Path(given).is_file():
            raise UsageError("normals", f"is {given!r}: no such file", "Give a model of normals in ONNX format")
        super().__init__(Path(given), KNOWN, "normal")
        self._shown(self.run(np.full((8, 8, 3), 128, np.uint8), "a grey picture"))  # what gives no normals fails now

    def __call__(self, view: View, mask: Array) -> Array:
        """(h, w, 3) float32 unit normals of a view's pixels in the model's axes; 0 outside of the mask (h, w).

        Raises
        ------
        AssetError
            What the model gives are no normals.
        """
        height, width = view.colour.shape[:2]
        x0, y0, x1, y1 = _window(mask, width, height, self.size[0] / self.size[1])
        picture = np.empty((y1 - y0, x1 - x0, 3), np.float32)
        picture[:] = view.colour[0, 0]  # beside the photograph
        inner = slice(max(0, y0), min(height, y1)), slice(max(0, x0), min(width, x1))
        place = tuple(slice(part.start - low, part.stop - low) for part, low in zip(inner, (y0, x0), strict=True))
        picture[place] = view.colour[inner]
        found = self._shown(self.run((picture * 255 + 0.5).astype(np.uint8), view.name))
        if found.min() >= 0:  # as they are shown, 0 .. 1 or 0 .. 255
            found = found * (2 / (255 if found.max() > 2 else 1)) - 1
        layers = [
            Pillow.fromarray(np.ascontiguousarray(found[..., c])).resize((x1 - x0, y1 - y0), Pillow.Resampling.BILINEAR)
            for c in range(3)
        ]
        normals = np.zeros((height, width, 3), np.float32)
        normals[inner] = unit(np.stack([np.asarray(layer) for layer in layers], -1)[place], (0, 0, 0))
        normals[mask <= 0.5] = 0
        return normals

    def _shown(self, results: list[Array]) -> Array:
        """(h, w, 3) normals: the first of the model's results of three channels, or of four, the last a confidence."""
        for found in results:
            picture = found[0] if found.ndim == 4 and found.shape[0] == 1 else found
            if picture.ndim == 3 and picture.shape[0] in (3, 4):
                picture = picture.transpose(1, 2, 0)
            if picture.ndim == 3 and picture.shape[2] in (3, 4):
                return picture[..., :3]
        shapes = ", ".join(str(one.shape) for one in results)
        raise AssetError(str(self.path), f"gives values of the shape {shapes}",
                         "A normal model gives one picture: (1, 3, height, width)")  # fmt: skip


def _window(mask: Array, width: int, height: int, aspect: float) -> tuple[int, int, int, int]:
    """Pixels (x0, y0, x1, y1) around the object in the aspect, all where it is not to be seen; may reach beyond."""
    low, high = np.zeros(2), np.array([width, height], float)
    if (box := box_of(mask > 0.5)) is not None:
        low, high = np.array(box[:2], float), np.array(box[2:], float)
        margin = MARGIN * (high - low).max()
        low, high = low - margin, high + margin
    side = max((high - low)[1], (high - low)[0] / aspect)
    half = np.array([aspect * side, side]) / 2
    (x0, y0), (x1, y1) = np.floor((low + high) / 2 - half), np.ceil((low + high) / 2 + half)
    return int(x0), int(y0), int(x1), int(y1)


def give_normals(capture: Capture, given: str, tell: Tell, cancelled: Callable[[], bool]) -> None:
    """Give the training views the normals of a model, world space, in place; with a warning none where they are wrong.

    Parameters
    ----------
    capture : Capture
    given : str
        The model's file.
    tell, cancelled : callable

    Raises
    ------
    AssetError, DeviceError, UsageError
        As of `NormalModel`.
    Cancelled
        `cancelled` said so.
    """
    subject, model, views = str(capture.source), load_model(given), capture.training
    masks = silhouettes(capture)
    if masks is None:
        logger.warning("%s: has no masks, by which the axes of %s would be found: its normals are not used. Give "
                       "masks, or --masks auto", subject, model.path.name)  # fmt: skip
        return
    found = []
    for k, (view, mask) in enumerate(zip(views, masks, strict=True)):
        tell("normals", k / len(views))
        if cancelled():
            raise Cancelled
        found.append(model(view, mask))
    signs, cosine, facing = find_axes(views, found, find_region(capture))
    if cosine < facing + AGREEMENT:
        logger.warning(
            "%s: normals of %s agree with the surface that the outlines leave no better than normals that all face the "
            "viewer (mean cosine %.2f and %.2f), whatever their axes: they are not used. Check that it is a model of "
            "normals",
            subject, model.path.name, cosine, facing,
        )  # fmt: skip
        return
    for view in views:
        rotation = np.asarray(view.camera.matrix_world, np.float64)[:3, :3]
        view.normals = ((found.pop(0) * signs) @ rotation.T).astype(np.float32)


def find_axes(views: list[View], normals: list[Array], region: Region) -> tuple[Array, float, float]:
    """Signs of the axes of a model's normals against the camera's, right, up and back.

    Parameters
    ----------
    views : list of View
    normals : list of (h, w, 3) float32 arrays
    region : Region
        Its points on the surface that the outlines leave.

    Returns
    -------
    signs : (3,) float64 array
    cosine, facing : float
        Mean cosine between the surface's normals and these, and between it and normals that all face the viewer.
    """
    products, back, count = np.zeros(3), 0.0, 0
    for view, shown in zip(views, normals, strict=True):
        matrix = np.asarray(view.camera.matrix_world, np.float64)
        pixel = np.c_[region.points, np.ones(len(region.points))] @ world_to_pixel(view.camera).T
        before = (((matrix[:3, 3] - region.points) * region.normals).sum(1) > 0) & (pixel[:, 2] > 0)
        pixel, own = pixel[before], region.normals[before] @ matrix[:3, :3]
        column, row = (np.floor(pixel[:, k] / pixel[:, 2]).astype(int) for k in range(2))
        inside = (column >= 0) & (row >= 0) & (column < shown.shape[1]) & (row < shown.shape[0])
        there = shown[row[inside], column[inside]]
        known = (there != 0).any(axis=1)
        products += (there[known] * own[inside][known]).sum(axis=0)
        back += float(own[inside][known, 2].sum())
        count += int(known.sum())
    return np.where(products < 0, -1.0, 1.0), float(np.abs(products).sum()) / max(count, 1), back / max(count, 1)
