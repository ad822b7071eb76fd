"""Warm-up: a few steps on a tiny scene, so that JIT compilation does not count against the time budget."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core.asset.model import Mesh
from ..core.errors import Cancelled
from ..core.frame import Camera
from .backend import CPU, LearningBackend
from .capture.capture import Capture, View
from .inverse_rendering.run import decouple
from .meshing.visual_hull import find_region
from .model.attached import attach_learned
from .optim.train import Training

if TYPE_CHECKING:
    from .pipeline import Settings

#: Pixels of a side, distance of the cameras from the object, steps of surfels (every part of their schedule has
#: some) and of materials.
_SIZE, _AWAY, _STEPS, _STEPS_OF_MATERIALS = 32, 4.0, 24, 4


def warm_up(settings: Settings, masked: bool, backend: LearningBackend, cancelled: Callable[[], bool]) -> None:
    """Take some steps of every phase that `settings` have.

    Parameters
    ----------
    settings : Settings
    masked : bool
        The photographs have masks, or a background that masks are made from.
    backend : LearningBackend
    cancelled : callable

    Raises
    ------
    Cancelled
    """
    # Neighbouring views only where they are compared.
    capture, mesh = _photographs((0.0, 0.3) if settings.schedule.patches else (0.0,)), _octahedron()
    region = find_region(capture)
    if not masked:
        for view in capture.views:
            view.mask = None
    schedule = replace(settings.schedule, iterations=_STEPS)
    training = Training(capture, region, schedule, backend=backend)
    _all_steps(training, cancelled)
    if settings.variant == "m":
        attached, _, _ = attach_learned(mesh, training.gaussians, settings.fixed)
        _all_steps(Training(capture, region, schedule.on_mesh(1.0), attached, backend=backend), cancelled)
    if settings.materials:
        quick = replace(settings.decoupling, iterations=_STEPS_OF_MATERIALS, seconds=0.0, pixels=64)
        for surfels in (None, training.gaussians.on(CPU)):  # as of thin things
            decouple(capture, mesh, quick, None, cancelled, backend=backend, surfels=surfels)


def _all_steps(training: Training, cancelled: Callable[[], bool]) -> None:
    while not training.finished:
        if cancelled():
            raise Cancelled
        training.step()


def _photographs(turns: tuple[float, ...]) -> Capture:
    """A ball of noise, seen from six sides, and from beside each, radians."""
    rng, views = np.random.default_rng(0), []
    y, x = np.mgrid[:_SIZE, :_SIZE] + 0.5 - _SIZE / 2
    mask = (np.hypot(x, y) < 0.4 * _SIZE).astype(np.float32)
    focal = 0.4 * _SIZE * _AWAY
    for k, (turn, axis) in enumerate(product(turns, np.concatenate([np.eye(3), -np.eye(3)]))):
        across = np.roll(axis, 1)
        back, side = np.cos(turn) * axis + np.sin(turn) * across, np.cos(turn) * across - np.sin(turn) * axis
        matrix = np.eye(4)
        matrix[:3] = np.column_stack([side, np.cross(back, side), back, _AWAY * back])
        camera = Camera(matrix, _SIZE, _SIZE, focal, focal, _SIZE / 2, _SIZE / 2)
        views.append(View(str(k), camera, rng.random((_SIZE, _SIZE, 3), np.float32), mask))
    return Capture(Path("warm-up"), views)


def _octahedron() -> Mesh:
    """Inscribed in the ball."""
    vertices = np.concatenate([np.eye(3), -np.eye(3)])
    faces = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]], np.int32)
    return Mesh(vertices.astype(np.float32), faces, np.full((6, 3), 0.5), np.full(6, 0.5), np.zeros(6))
