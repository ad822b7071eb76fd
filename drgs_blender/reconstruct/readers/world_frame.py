"""The world of a capture: which way is up, and whether cameras and silhouettes belong together."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...core.errors import AssetError, first_of
from ...core.file_types import CAMERAS
from ..capture.capture import View
from .layout import OPENCV_TO_BLENDER, invert

Array = np.ndarray
logger = logging.getLogger(__name__)

#: Name, of `CAMERAS` -> what brings the matrices of a file to camera-to-world with Blender's axes.
AXES = {
    "opengl": lambda matrix: matrix,
    "opencv": lambda matrix: matrix @ OPENCV_TO_BLENDER,
    "opengl-inverse": invert,
    "opencv-inverse": lambda matrix: invert(matrix) @ OPENCV_TO_BLENDER,
}
#: Views, cells and pixels along a side of the test of silhouettes.
_VIEWS, _CELLS, _SIDE = 16, 36, 40
#: Part of all views that must see a cell, and part of those that must take it for the object.
_SEEN, _AGREE = 0.25, 0.9
#: Part of the silhouettes that is explained: below the first something is wrong, above the second it is right.
_WRONG, _RIGHT = 0.5, 0.8
_NOWHERE = 0.2
#: Part of one silhouette below which its camera is wrong, where those of the others are right.
_STRANGE = 0.05
#: Least spread of cameras in their distance from the origin: single precision leaves some thousand steps of it.
_DIGITS = 1e-4
#: Least and greatest spread of cameras, metres: a `Camera` shows nothing nearer or farther than its clip distances.
_SMALL, _LARGE = 2e-3, 5e5


def turn_upright(matrices: Array) -> Array:
    """(3, 3) rotation of the world after which the cameras (n, 4, 4) stand upright: Z is up.

    Where `direction_up` knows none, the world stays as it is.
    """
    z = direction_up(matrices)
    if z is None:
        return np.eye(3)
    if z[2] > 1e-6:  # turn no further than needed
        axis = np.cross(z, [0, 0, 1])
        skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        return np.eye(3) + skew + skew @ skew / (1 + z[2])
    x = np.eye(3)[np.argmin(np.abs(z))]
    x = x - z * (x @ z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def direction_up(matrices: Array) -> Array | None:
    """(3,) up as the cameras (n, 4, 4) were held; None where they leave it open, as when they were held in all ways.

    People hold cameras level: up is the direction to which the cameras' horizontal axes are most nearly orthogonal.
    Where these leave it open, as with few views, it is the mean of the cameras' own up axes.
    """
    across, up = matrices[:, :3, 0], matrices[:, :3, 1]
    values, vectors = np.linalg.eigh(across.T @ across / len(across))
    mean = up.mean(axis=0)
    direction = vectors[:, 0] if values[0] < 0.2 * values[1] else mean
    if np.linalg.norm(mean) < 0.1 or np.linalg.norm(direction) < 0.1:
        return None
    z = direction / np.linalg.norm(direction)
    return z if z @ mean > 0 else -z


def check_positions(matrices: Array, subject: str, axes: str) -> None:
    """Raise AssetError where cameras do not see an object from several sides, or too near or far to compute with."""
    if len(matrices) < 2:
        raise AssetError(subject, "has one camera", "Shape needs photographs from several sides: take 20 or more")
    centres = matrices[:, :3, 3]
    spread, away = _spread(matrices), float(np.abs(centres).max())
    if spread < 1e-6 * min(max(away, 1.0), 1e3):
        remedy = "Walk around the object; turning on the spot shows no shape"
        # World-to-camera matrices of cameras that look at the origin from one distance, as renderers place them.
        if not axes.endswith("inverse") and _spread(np.stack([invert(matrix) for matrix in matrices])) > 1e-3:
            remedy += ". If the matrices are world to camera, give --axes opengl-inverse or opencv-inverse"
        raise AssetError(subject, "has all its cameras in one place", remedy)
    if spread < _DIGITS * away:
        problem = (
            f"has its cameras {away:.3g} from the origin and within {spread:.3g} of each other: digits do not suffice"
        )
        raise AssetError(subject, problem, "Export the capture with the origin near the object")
    if not _SMALL <= spread <= _LARGE:
        problem = f"has its cameras within {spread:.3g} m of each other; {_SMALL:g} to {_LARGE:g} can be learned from"
        raise AssetError(subject, problem, "Export it in another unit, in which the object is about a metre large")


def _spread(matrices: Array) -> float:
    """How far cameras are from their mean place, at most."""
    centres = matrices[:, :3, 3]
    return float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())


def check_silhouettes(views: Sequence[View], subject: str, axes: str) -> None:
    """Raise AssetError where the masks of `views` have no common shape, or are inverted.

    The message names the convention in which they have one. The visual hull of an object covers its silhouettes when
    the cameras are right, and is empty when they are not.
    """
    masked = [view for view in views if view.mask is not None and view.mask.any() and not view.mask.all()]
    if len(masked) < 3:
        return
    chosen = [masked[i] for i in np.unique(np.linspace(0, len(masked) - 1, _VIEWS).round().astype(int))]
    shapes = [_Silhouette.of(view) for view in chosen]
    if any(shape is None for shape in shapes):
        return
    kept = [(view, shape) for view, shape in zip(chosen, shapes) if shape is not None and shape.inside.any()]
    if len(kept) < 3:
        return
    outlines = [shape for _, shape in kept]
    matrices = np.stack([view.camera.matrix_world for view, _ in kept])
    if _inside_out(matrices, outlines):
        problem = "has masks that are inverted: they fill the pictures' borders, and what they leave out is one shape"
        raise AssetError(subject, problem, "Invert the masks: white is the object, black its surroundings")
    hull = _hull(matrices, outlines)
    score = _covers(hull, matrices, outlines)
    logger.debug("%s: the visual hull explains %.2f of the silhouettes", subject, score)
    if score >= _WRONG:
        _warn_of_strangers(masked, *hull, subject)
        return
    # The matrices of the file, as every other convention would have them.
    raw = np.stack([_undo(axes, matrix) for matrix in matrices])
    scores = {
        name: _explained(np.stack([convert(matrix) for matrix in raw]), outlines)
        for name, convert in AXES.items()
        if name != axes
    }
    best = max(scores, key=scores.__getitem__)
    if scores[best] > _RIGHT:
        problem = (
            f"has cameras whose silhouettes do not meet ({score:.0%} explained; {scores[best]:.0%} if the matrices are "
            f"{CAMERAS[best]})"
        )
        raise AssetError(subject, problem, f"Give --axes {best}")
    if score < _NOWHERE and np.mean([shape.whole for shape in outlines]) > 0.5:
        problem = f"has silhouettes with no common shape ({score:.0%} explained): cameras and masks do not fit"
        raise AssetError(subject, problem, "Check that the masks show the object, and calibrate the cameras again")
    logger.warning("%s: cameras and masks fit badly (%.0f %% of the silhouettes explained)", subject, 100 * score)


def _inside_out(matrices: Array, outlines: list[_Silhouette]) -> bool:
    """Whether most masks fill the whole border of their pictures, and what they leave out has one common shape."""
    holes = [(m, _Silhouette(~shape.inside, shape.focal, shape.centre)) for m, shape in zip(matrices, outlines)]
    holes = [(matrix, hole) for matrix, hole in holes if hole.whole and hole.inside.any()]
    if 2 * len(holes) <= len(outlines) or len(holes) < 3:
        return False
    return _explained(np.stack([matrix for matrix, _ in holes]), [hole for _, hole in holes]) > _RIGHT


def _warn_of_strangers(views: Sequence[View], hull: Array, cell: float, subject: str) -> None:
    """Name the views that have an object whole in their picture, elsewhere than the `hull` of most others."""
    shapes = [(view, _Silhouette.of(view)) for view in views]
    strangers = [
        view.name
        for view, shape in shapes
        if shape is not None
        and shape.inside.any()
        and shape.whole
        and _covered(hull, cell, view.camera.matrix_world, shape) < _STRANGE
    ]
    if strangers:
        logger.warning(
            "%s: %d of %d photographs show the object where the others do not have it: %s. Check their cameras (their "
            "axes too), or take them out", subject, len(strangers), len(views), first_of(strangers),
        )  # fmt: skip


def _undo(axes: str, matrix: Array) -> Array:
    """The matrix that the convention `axes` turned into `matrix`."""
    if axes.startswith("opencv"):
        matrix = matrix @ OPENCV_TO_BLENDER
    return invert(matrix) if axes.endswith("inverse") else matrix


@dataclass(slots=True)
class _Silhouette:
    """A small mask with the pinhole that projects onto it."""

    inside: Array
    focal: tuple[float, float]
    centre: tuple[float, float]

    @property
    def whole(self) -> bool:
        """Whether the object does not reach out of the picture."""
        edges = self.inside[0], self.inside[-1], self.inside[:, 0], self.inside[:, -1]
        return not any(edge.any() for edge in edges)

    @classmethod
    def of(cls, view: View) -> _Silhouette | None:
        assert view.mask is not None
        camera = view.camera
        if camera.orthographic:
            return None
        step = max(1, min(camera.width, camera.height) // _SIDE)
        height, width = camera.height // step, camera.width // step
        small = view.mask[: height * step, : width * step].reshape(height, step, width, step).mean(axis=(1, 3))
        focal = camera.fx / step, camera.fy / step
        return cls(small > 0.5, focal, (camera.cx / step, camera.cy / step))


def _explained(matrices: Array, outlines: list[_Silhouette]) -> float:
    """Mean part of the silhouettes that their visual hull covers."""
    return _covers(_hull(matrices, outlines), matrices, outlines)


def _covers(hull: tuple[Array, float], matrices: Array, outlines: list[_Silhouette]) -> float:
    """Mean part of the silhouettes that a hull covers."""
    return float(np.mean([_covered(*hull, m, shape) for m, shape in zip(matrices, outlines)]))


def _hull(matrices: Array, outlines: list[_Silhouette]) -> tuple[Array, float]:
    """Centres (n, 3) of the cells of the visual hull, and their side; n may be 0."""
    centre = _meeting_point(matrices)
    distance = np.linalg.norm(matrices[:, :3, 3] - centre, axis=1)
    widest = max(max(shape.inside.shape) / min(shape.focal) for shape in outlines)
    extent = float(np.median(distance)) * min(widest / 2, 1.0)
    low, size = centre - extent, 2 * extent
    for _ in range(2):  # the second time only where the first found something
        axis = (np.arange(_CELLS) + 0.5) / _CELLS
        cells = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3) * size + low
        hull = cells[_agreed(cells, matrices, outlines)]
        if len(hull) == 0:
            return hull, 0.0
        cell = np.max(size) / _CELLS
        low, size = hull.min(axis=0) - cell, np.ptp(hull, axis=0) + 2 * cell
    return hull, float(cell)


def _meeting_point(matrices: Array) -> Array:
    """The point closest to all optical axes."""
    axis = matrices[:, :3, 2]
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    right = np.einsum("nij,nj->i", across, matrices[:, :3, 3])
    return np.linalg.lstsq(across.sum(axis=0) + 1e-9 * np.eye(3), right, rcond=None)[0]


def _project(points: Array, matrix: Array, shape: _Silhouette) -> tuple[Array, Array, Array]:
    """(column, row, depth) of points; columns and rows are pixels of the small mask, -1 outside."""
    local = (points - matrix[:3, 3]) @ matrix[:3, :3]
    depth = -local[:, 2]
    safe = np.maximum(depth, 1e-9)
    column = np.floor(local[:, 0] / safe * shape.focal[0] + shape.centre[0])
    row = np.floor(-local[:, 1] / safe * shape.focal[1] + shape.centre[1])
    height, width = shape.inside.shape
    seen = (depth > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return np.where(seen, column, -1).astype(int), np.where(seen, row, -1).astype(int), depth


def _agreed(cells: Array, matrices: Array, outlines: list[_Silhouette]) -> Array:
    """Which cells most of the views that see them, and these are not too few, take for the object."""
    inside, seen = np.zeros(len(cells)), np.zeros(len(cells))
    for matrix, shape in zip(matrices, outlines):
        column, row, _ = _project(cells, matrix, shape)
        visible = column >= 0
        seen += visible
        inside += visible & shape.inside[row, column]
    return (seen >= _SEEN * len(outlines)) & (inside >= _AGREE * seen)


def _covered(hull: Array, cell: float, matrix: Array, shape: _Silhouette) -> float:
    """Part of a silhouette onto which the hull falls."""
    from scipy.ndimage import maximum_filter

    column, row, depth = _project(hull, matrix, shape)
    visible = column >= 0
    if not visible.any():
        return 0.0
    drawn = np.zeros_like(shape.inside)
    drawn[row[visible], column[visible]] = True
    footprint = int(np.ceil(cell * shape.focal[0] / np.median(depth[visible]))) // 2
    drawn = maximum_filter(drawn, 2 * footprint + 3)
    return float((drawn & shape.inside).sum() / shape.inside.sum())
