"""Frames that Blender exported, made ready for light on surfaces rather than for a picture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.frame import Frame, split_rays

if TYPE_CHECKING:
    from ..engine.session import Session


def surface_frame(path: Path, rays: int, session: Session) -> Frame:
    """Frame whose surfaces get `rays` samples of light a point; `session` has its assets, for ``session.place``."""
    from ..ipc.frame_file import read_frame_file

    frame = read_frame_file(path)
    cosine, ggx, environment = split_rays(rays)
    settings = replace(frame.settings, cosine=cosine, ggx=ggx, environment=environment, split="auto", aa=1)
    settings = replace(settings, primary="surfels", denoise="none", noise_threshold=0.0)
    for state in frame.objects:
        state.asset = session.load_asset(state.asset)
    return replace(frame, settings=settings)
