"""The integrator on a device: `shade.integrate` with Warp's rays, one lane a point, from the same source."""

from __future__ import annotations

from types import ModuleType
from typing import Any

from ...device.kernels import Launcher, Room, Work
from ..lights.lamps import Lamps
from ..lights.light import EnvironmentLight
from ..shade import heads, integrate, paths, strategies, wave
from ..trace.scene import TraceScene
from .mirror import Mirror
from .natives import NATIVES


def _constants(module: ModuleType, name: str, value: Any) -> Any:
    """One ray a batch, one point a block, one lane a packet: a thread needs no more."""
    if name in ("BATCH", "_BLOCK") and module in (integrate, strategies):
        return 1
    if module is wave and type(value) is int and name.strip("_").isupper():
        return value // wave.LANES
    return value


_BATCH = (Room("float32", (wave._FLOATS // wave.LANES,)), Room("uint32", (wave._INTS // wave.LANES,)))
#: As `integrate._room` makes it, for batches and blocks of one.
_ROOMS = (
    _BATCH,
    _BATCH,
    Room("float32", (1, paths.FOUND)),
    Room("float32", (1, strategies.KINDS * strategies.KIND)),
    Room("float32", (1, heads.HEAD)),
    Room("uint32", (1,)),
    Room("int64", (1,)),
)
SHADE = Work(integrate.shade_points, _ROOMS, NATIVES, _constants)


class DeviceKernel(integrate.Kernel):
    """`shade.integrate.Kernel` on a device."""

    def __init__(self, launcher: Launcher, mirror: Mirror) -> None:
        self._launcher, self._mirror = launcher, mirror

    def tables(self, scene: TraceScene, light: EnvironmentLight, lamps: Lamps) -> tuple[Any, Any, Any, Any]:
        with self._launcher.failures("copying the scene"):
            return self._mirror.tables(scene, light, lamps)

    def shade(self, *arguments: Any) -> None:
        *inwards, out = arguments
        self._launcher.launch(SHADE, len(out[0]), inwards, out)
