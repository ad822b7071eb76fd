"""Render a picture with our engine, in process, through the same session the engine process uses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from drgs_blender.core.frame import Camera, Frame, ObjectState, RenderSettings, World
from drgs_blender.engine.session import Session
from drgs_blender.formats.registry import read_environment

#: One session for a whole program, so that kernels and assets are loaded once.
SESSION = Session()


def pinhole(camera: dict[str, Any]) -> Camera:
    """Camera of a CAM.json dictionary with `fov_x`."""
    width, height = camera["width"], camera["height"]
    f = width / 2 / np.tan(np.radians(camera["fov_x"]) / 2)
    return Camera(np.array(camera["matrix_world"], float), width, height, f, f, width / 2, height / 2)


def relight(asset: Path, environment: Path | np.ndarray, camera: dict[str, Any], **more: Any) -> dict[str, np.ndarray]:
    """Passes of one object under one HDRI; `more` as of `frame_of`."""
    return SESSION.render(frame_of(asset, environment, camera, **more))


def first_view(
    asset: Path, environment: Path | np.ndarray, camera: dict[str, Any], **more: Any
) -> dict[str, np.ndarray]:
    """Passes of one object under one HDRI, as in the first picture of a viewport."""
    return SESSION.view("bench", frame_of(asset, environment, camera, **more))


def frame_of(
    asset: Path,
    environment: Path | np.ndarray,
    camera: dict[str, Any],
    *,
    samples: int,
    strength: float = 1.0,
    vertices: np.ndarray | None = None,
    passes: tuple[str, ...] = ("Combined",),
    **settings: Any,
) -> Frame:
    """One object under one HDRI; `settings` are fields of RenderSettings."""
    given = isinstance(environment, np.ndarray)
    radiance = environment if given else read_environment(environment).radiance
    key = SESSION.load_asset(asset)
    return Frame(
        noise_index=1,
        camera=pinhole(camera),
        objects=[ObjectState("subject", key, vertices=vertices)],
        world=World(environment=radiance, strength=strength),
        settings=RenderSettings(samples=samples, film_transparent=True, **settings),
        passes=passes,
    )
