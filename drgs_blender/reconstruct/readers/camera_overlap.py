"""Overlap of cameras: whether they look at one thing, for captures whose silhouettes show nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage

from ...core.errors import AssetError
from ...core.frame import Camera
from ..capture.capture import View

Array = np.ndarray

#: Fewest views of a group; fewer that stand apart may be slips of the calibration.
_FEWEST = 3
#: Views of a group that are looked at, at most.
_VIEWS = 32


def check_overlap(views: Sequence[View], subject: str) -> None:
    """Raise AssetError where cameras stand in two groups that look at nothing in common.

    Groups are farther from each other than either is wide: two objects, or two calibrations in one file. Close-ups and
    pictures from afar are such groups too, but what the ones look at the others see.
    """
    if len(views) < 2 * _FEWEST:
        return
    tree = linkage(np.stack([_position(view) for view in views]), "single")
    label = fcluster(tree, 2, "maxclust")
    groups = [[view for view, k in zip(views, label) if k == group] for group in (1, 2)]
    if min(map(len, groups)) < _FEWEST or (gap := tree[-1, 2]) <= max(map(_width, groups)):
        return
    first, second = ([view.camera for view in group[:: len(group) // _VIEWS + 1]] for group in groups)
    if _share_view(first, second) or _share_view(second, first):
        return
    raise AssetError(
        subject,
        f"has two groups of cameras, {len(groups[0])} with {groups[0][0].name} and {len(groups[1])} with "
        f"{groups[1][0].name}, {gap:.3g} from each other, that look at nothing in common",
        "Give each its own capture, or calibrate all photographs together",
    )


def _position(view: View) -> Array:
    return view.camera.matrix_world[:3, 3]


def _width(views: list[View]) -> float:
    """Diagonal of the box of the cameras' places."""
    return float(np.linalg.norm(np.ptp([_position(view) for view in views], axis=0)))


def _share_view(viewers: list[Camera], targets: list[Camera]) -> bool:
    """Whether half of the viewers have on their axis what half of the others have in their picture."""
    eye, axis = (np.stack([camera.matrix_world[:3, k] for camera in targets]) for k in (3, 2))
    looking = 0
    for viewer in viewers:
        start, forward = viewer.matrix_world[:3, 3], -viewer.matrix_world[:3, 2]
        # Where the viewer's axis comes closest to those of the others.
        across, offset = axis @ forward, start - eye
        away = (across * (offset * axis).sum(axis=1) - offset @ forward) / np.maximum(1 - across**2, 1e-9)
        points = start + away[away > 0, None] * forward
        seen = np.sum([_in_picture(points, camera) for camera in targets], axis=0)
        looking += bool((2 * seen >= len(targets)).any())
    return 2 * looking >= len(viewers)


def _in_picture(points: Array, camera: Camera) -> Array:
    """(n,) bool: which of the points (n, 3) lie before the camera and within its picture."""
    x, y, back = ((points - camera.matrix_world[:3, 3]) @ camera.matrix_world[:3, :3]).T
    depth = np.maximum(-back, 1e-9)
    column, row = camera.fx * x / depth + camera.cx, camera.cy - camera.fy * y / depth
    return (back < 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
