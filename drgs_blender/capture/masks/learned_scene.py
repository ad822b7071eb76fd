"""Object and ground around it learned as surfels from photographs without masks.

Stage (i) of `reconstruct` learns the object together with the ground on which it stands. The ground begins where it is
known to be; the space in which the object is sought begins full of faint surfels, of which those stay that several
views agree on. What is behind both is not learned: it is what the photographs show there, or would show without the
object, so that nothing is gained by surfels that stand before it. Where the object was turned before a still camera,
that is what stood still (`still_background`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...core.arrays import Array
from ...core.errors import Cancelled
from ...reconstruct.capture.capture import Capture, View
from ...reconstruct.meshing.visual_hull import Region, colours_of
from ...reconstruct.model.gaussians import Gaussians
from ...reconstruct.optim.schedule import Schedule
from ...reconstruct.optim.train import Training
from ..features import Tell
from .ground_picture import GroundPicture
from .mask_view import MaskView
from .object_box import ObjectBox

#: Margin of the ground around the box, in parts of the box's largest side; pixels between surfels on it.
_GROUND, _PIXELS = 0.15, 2.0
#: Surfels on the ground at most.
_PAVED = 20000
#: Surfels strewn in the box, also sparse points at most, and how opaque they begin; opacity of the others.
_STREWN, _FAINT, _OPAQUE = 3000, 0.1, 0.7
#: Deviation of surfels in parts of their distance.
_WIDE = 0.5
#: Bands of the colour's harmonics.
_BANDS = 1


@dataclass(frozen=True, slots=True)
class Effort:
    """How thoroughly a scene is learned.

    Attributes
    ----------
    size : int
        Pixels of a window's longer side.
    steps : int
    surfels : int
        At most, after those that learning begins with.
    finest : int
        As `size`, of photographs that show as much.
    """

    size: int
    steps: int
    surfels: int
    finest: int = 0

    def fitting(self, shown: float) -> Effort:
        """The same for windows of so many pixels as photographed."""
        return replace(self, size=max(self.size, round(min(shown, self.finest))))


def learn_scene(cv2: Any, views: Sequence[MaskView], box: ObjectBox, effort: Effort,
                earlier: Gaussians | None, tell: Tell, cancelled: Callable[[], bool]) -> Gaussians:  # fmt: skip
    """Surfels of the object and the ground around it.

    Parameters
    ----------
    cv2 : module
        OpenCV.
    views : sequence of MaskView
        The parts of the photographs around the box.
    box : ObjectBox
    effort : Effort
    earlier : Gaussians, optional
        Those of the object as far as they are known.
    tell, cancelled : callable

    Raises
    ------
    Cancelled
        `cancelled` said so.
    """
    straight = [view.straightened(cv2, effort.size) for view in views]
    shown = [View(v.name, v.pinhole(effort.size), v.pixels.astype(np.float32) / 255) for v in straight]
    size = float((box.high - box.low).max())
    none = np.zeros((0, 3), np.float32)
    region = Region((box.low + box.high) / 2, size, box.low, box.high, none, none, size)
    schedule = Schedule(effort.steps, effort.surfels, coarse=0.4, rounds=8, reflections=1.0, bands=_BANDS)
    # by steps alone: the time they take would make masks differ from run to run
    training = Training(Capture(Path("photographs"), shown), region, schedule, first_surfels(shown, box, earlier))
    ground = None
    for view, target in zip(straight, training.targets, strict=True):
        if view.behind is not None:
            behind = view.behind.astype(np.float32) / 255
        else:
            ground = ground or GroundPicture(cv2, straight, box)
            behind = ground.without_object(view, box.outline(cv2, view), near_ground(box))
        target.background = torch.from_numpy(behind)
    while not training.finished:
        if cancelled():
            raise Cancelled
        training.step()
        tell("masks: learning the scene", training.part)
    return training.gaussians


def near_ground(box: ObjectBox) -> tuple[Array, Array]:
    """Corners (2,) of the ground that is learned."""
    margin = _GROUND * float((box.high - box.low).max())
    return box.low[:2] - margin, box.high[:2] + margin


def first_surfels(views: list[View], box: ObjectBox, earlier: Gaussians | None = None) -> Gaussians:
    """The surfels that learning begins with.

    Parameters
    ----------
    views : list of View
    box : ObjectBox
    earlier : Gaussians, optional
        Those of the object as far as they are known, instead of sparse points.
    """
    size, middle = float((box.high - box.low).max()), (box.low + box.high) / 2
    parts = [] if earlier is None else [earlier]
    away = [np.linalg.norm(np.asarray(view.camera.matrix_world)[:3, 3] - middle) / view.camera.fx for view in views]
    paved = float(np.prod(np.subtract(*near_ground(box)[::-1])))
    step = max(_PIXELS * float(np.median(away)), (paved / _PAVED) ** 0.5)
    axes = [np.arange(a, b, step) for a, b in zip(*near_ground(box), strict=True)]
    flat = np.stack([*np.meshgrid(*axes), np.zeros((len(axes[1]), len(axes[0])))], axis=-1).reshape(-1, 3)
    parts.append(_surfels(flat, np.tile([0.0, 0.0, 1.0], (len(flat), 1)), views, _WIDE * step, _OPAQUE))
    random = np.random.default_rng(0)
    strewn = random.uniform(box.low, box.high, (_STREWN, 3))
    normals = random.normal(size=strewn.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    step = float(np.prod(box.high - box.low) / _STREWN) ** (1 / 3)
    parts.append(_surfels(strewn, normals, views, _WIDE * step, _FAINT))
    if len(box.points) and earlier is None:
        kept = np.sort(random.permutation(len(box.points))[:_STREWN])
        facing = box.points[kept] - middle * [1.0, 1.0, 0.0]
        facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-12)
        parts.append(_surfels(box.points[kept], facing, views, 0.01 * size, _OPAQUE))
    names = parts[0].parameters
    return Gaussians({name: torch.cat([part.parameters[name].detach() for part in parts]) for name in names})


def _surfels(places: Array, normals: Array, views: list[View], deviation: float, opacity: float) -> Gaussians:
    made = Gaussians.on_surface(places, normals, colours_of(places, normals, views), deviation, _BANDS)
    with torch.no_grad():
        made.parameters["opacity"].fill_(math.log(opacity / (1 - opacity)))
    return made
