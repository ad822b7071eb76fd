"""The integrator on a device: `integrator.integrate` with Warp's rays, one thread per point, from the same source."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np

from ...compute.warp.kernels import Launcher, ScratchArray, WarpKernel
from ..integrator import direct, group_sums, integrate, sample_allocation, wavefront
from ..integrator.records import Sampler, Scene, Settings
from ..lights.environment import EnvironmentLight
from ..lights.light_sampler import Lights
from ..scene.trace_scene import TraceScene
from ..shading_points import PointArrays
from .native_functions import NATIVES
from .scene_mirror import Mirror

Array = np.ndarray


def _constants(module: ModuleType, name: str, value: Any) -> Any:
    """One ray per batch, one point per block, one lane per packet: a thread needs no more."""
    if name in ("BATCH", "_BLOCK") and module in (integrate, direct):
        return 1
    if module is wavefront and name in wavefront.IN_LANES:
        return value // wavefront.LANES
    return value


_BATCH = wavefront.Batch._make([
    ScratchArray("float32", (wavefront.PACKET_FLOATS // wavefront.LANES,)),
    ScratchArray("uint32", (wavefront.PACKET_INTS // wavefront.LANES,)),
])  # fmt: skip
#: As `integrate._scratch` makes it, for batches and blocks of one.
_SCRATCH = integrate.Scratch._make([
    _BATCH,
    _BATCH,
    ScratchArray("float32", (1, group_sums.FOUND)),
    ScratchArray("float32", (1, direct.KINDS * direct.KIND)),
    ScratchArray("float32", (1, sample_allocation.POINT_STATE)),
    ScratchArray("uint32", (1,)),
    ScratchArray("int64", (1,)),
])  # fmt: skip
#: The compiler's level 2 takes a third of the time of level 3, and what it makes is no slower.
SHADE = WarpKernel(integrate.shade_points, _SCRATCH, NATIVES, _constants, level=2)


class DeviceShadingKernel(integrate.ShadingKernel):
    """`integrator.integrate.ShadingKernel` on a device."""

    def __init__(self, launcher: Launcher, mirror: Mirror) -> None:
        self._launcher, self._mirror = launcher, mirror

    def tables(self, scene: TraceScene, environment: EnvironmentLight, lights: Lights) -> tuple[Any, Any, Any, Any]:
        with self._launcher.failures("copying the scene"):
            return self._mirror.tables(scene, environment, lights)

    def shade(
        self, points: PointArrays, scene: Scene, settings: Settings, sampler: Sampler, out: tuple[Array, Array]
    ) -> None:
        self._launcher.launch(SHADE, len(out[0]), (points, scene, settings, sampler), out)
