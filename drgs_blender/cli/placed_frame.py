"""Frames that Blender exported, made ready for light on surfaces rather than for a picture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.frame import Frame

if TYPE_CHECKING:
    from ..engine.session import Session


def surface_frame(path: Path, samples: int, session: Session) -> Frame:
    """Frame whose surfaces get `samples` samples of light per point; ``session.prepare`` finds its assets."""
    from ..ipc.frame_file import read_frame_file

    frame = read_frame_file(path)
    settings = replace(frame.settings, samples=samples, strategy_samples=None, subpixel_samples=1)
    settings = replace(settings, camera_sees="surfels", denoise="none", noise_threshold=0.0)
    for state in frame.objects:
        state.asset = session.load_asset(state.asset)
    return replace(frame, settings=settings)
