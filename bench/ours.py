"""Render a picture with our engine, in process, through the same session the engine process uses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from drgs_blender.engine.session import Session
from drgs_blender.formats.registry import read_environment
from drgs_blender.frame import Camera, Frame, ObjectState, RenderSettings, World, split_rays

#: One session for a whole program, so that kernels and assets are loaded once.
SESSION = Session()


def pinhole(camera: dict[str, Any]) -> Camera:
    """Camera of a CAM.json dictionary with `fov_x`."""
    width, height = camera["width"], camera["height"]
    f = width / 2 / np.tan(np.radians(camera["fov_x"]) / 2)
    return Camera(np.array(camera["matrix_world"], float), width, height, f, f, width / 2, height / 2)


def relight(
    asset: Path,
    environment: Path,
    camera: dict[str, Any],
    *,
    rays: int,
    strength: float = 1.0,
    vertices: np.ndarray | None = None,
    passes: tuple[str, ...] = ("Combined",),
    **settings: Any,
) -> dict[str, np.ndarray]:
    """Passes of one object under one HDRI; `settings` are fields of RenderSettings."""
    cosine, ggx, light = split_rays(rays)
    key = SESSION.load_asset(asset)
    frame = Frame(
        number=1,
        camera=pinhole(camera),
        objects=[ObjectState("subject", key, vertices=vertices)],
        world=World(environment=read_environment(environment).radiance, strength=strength),
        settings=RenderSettings(cosine=cosine, ggx=ggx, environment=light, film_transparent=True, **settings),
        passes=passes,
    )
    return SESSION.render(frame)
