"""A processor that is a device of Warp: what the renderer hands it, and when it does the work."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from ...device.kernels import Launcher
from ..camera import AA
from ..lights.lamps import Lamps
from ..lights.light import EnvironmentLight
from ..shade.integrate import Processor
from ..surfels.raster import SurfelSamples
from ..surfels.splats import TILE, Splats
from ..surfels.surfel_bvh import SurfelBVH
from ..trace.scene import TraceScene
from .denoise import smooth
from .integrate import SHADE
from .mirror import Mirror
from .raster import BLEND


class OnDevice(Processor):
    """Shades points, blends surfels and filters light on a device of Warp.

    Parameters
    ----------
    device : Warp's name of it: "cuda:0", "cpu"
    """

    def __init__(self, device: str) -> None:
        self.launcher = Launcher(device)
        self.mirror = Mirror(self.launcher)
        self.smooth = partial(smooth, self.launcher)

    def takes(self, surfels: SurfelBVH | None) -> bool:
        return surfels is None

    def tables(self, scene: TraceScene, light: EnvironmentLight, lamps: Lamps) -> tuple[Any, Any, Any, Any]:
        with self.launcher.failures("copying the scene"):
            return self.mirror.tables(scene, light, lamps)

    def kernel(self, *arguments: Any) -> None:
        *inwards, out = arguments
        self.launcher.launch(SHADE, len(out[0]), inwards, out)

    def rasterise(self, splats: Splats, y0: int, y1: int) -> SurfelSamples:
        if not len(splats):
            return super().rasterise(splats, y0, y1)
        x0, top, x1, _ = splats.window
        aa = int(splats.parameters[AA])
        shape = y1 - y0, x1 - x0, aa
        samples = SurfelSamples(
            np.empty(shape, np.float32),
            np.empty(shape, np.float32),
            np.empty((*shape, 9), np.float32),
            np.empty(shape, np.int32),
        )
        arrays = splats.screen, splats.surface, splats.box, splats.nearest, splats.object_index
        arguments = *arrays, splats.tile_start, splats.tile_list, splats.parameters, x0, x1, top // TILE, y0, y1, aa
        out = samples.alpha, samples.depth, samples.surface, samples.object_index
        self.launcher.launch(BLEND, samples.alpha.size, arguments, out)
        return samples
