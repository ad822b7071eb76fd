"""Shading points tied to the mesh on a device: `gbuffer.surfels` with Warp's rays, from the same source."""

from __future__ import annotations

from typing import Any

from ...compute.warp.kernels import Launcher, WarpKernel
from ...compute.warp.translate import replacing
from ..gbuffer import surfels
from ..scene.trace_scene import TraceScene
from .native_functions import NATIVES
from .scene_mirror import Mirror

#: One point a block.
ATTACH = WarpKernel(surfels.attach_points, (), NATIVES, replacing(surfels, "_BLOCK", 1))


def tie(launcher: Launcher, mirror: Mirror, scene: TraceScene, *arguments: Any) -> None:
    """`surfels.tie_to_mesh` on a device."""
    *inwards, frames, materials, seen = arguments
    with launcher.failures("copying the scene"):
        tracer = mirror.tracer(scene)
    groups = frames, materials, seen
    launcher.launch(ATTACH, len(frames[0]), (tracer, *inwards), groups)
