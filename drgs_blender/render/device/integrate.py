"""The integrator on a device: `shade.integrate` with Warp's rays, one thread a point, from the same source."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import numpy as np

from ...device.translate import Translation
from ...device.typed import Array as ArrayType
from ...device.typed import Type, flat, given, spelled
from ...device.warp import load_module, parts_of, type_for, warp
from ...errors import DeviceError
from ..lights.lamps import Lamps
from ..lights.light import EnvironmentLight
from ..shade import heads, integrate, paths, strategies, wave
from ..surfels.surfel_bvh import SurfelBVH
from ..trace.scene import TraceScene
from .mirror import Mirror
from .natives import NATIVES

Array = np.ndarray

#: Threads at most; each has its own scratch memory and takes every so-manyth point.
THREADS = 1 << 17
#: Scratch memory of a thread: as `integrate._lane` makes it for batches and blocks of one.
_ROOM: Type = (
    (ArrayType("float32"), ArrayType("uint32")),
    (ArrayType("float32"), ArrayType("uint32")),
    ArrayType("float32", 2),
    ArrayType("float32", 2),
    ArrayType("float32", 2),
    ArrayType("uint32"),
    ArrayType("int64"),
)


def _constants(module: ModuleType, name: str, value: Any) -> Any:
    """One ray a batch, one point a block, one lane a packet: a thread needs no more."""
    if name in ("BATCH", "_BLOCK") and module in (integrate, strategies):
        return 1
    if module is wave and type(value) is int and name.strip("_").isupper():
        return value // wave.LANES
    return value


def _shapes() -> list[tuple[int, ...]]:
    floats, ints = (n // wave.LANES for n in (wave._FLOATS, wave._INTS))
    blocks = (1, strategies.KINDS * strategies.KIND), (1, heads.HEAD)
    return [(floats,), (ints,), (floats,), (ints,), (1, paths.FOUND), *blocks, (1,), (1,)]


@functools.lru_cache(maxsize=8)
def kernel_for(types: tuple[Type, ...], fused: bool) -> Any:
    """The kernel that shades points for arguments of these types, see ``integrate.shade_points``."""
    translation = Translation(NATIVES, _constants, fused)
    made = translation.function(integrate.shade_points, ["int64", "int64", _ROOM, *types])
    rooms = [f"r{i}" for i in range(len(flat(_ROOM)))]
    names = [f"a{i}" for i in range(len(given(types)))]
    parameters = ["lanes: wp.int64"]
    parameters += [f"{n}: {ArrayType(k.element, k.axes + 1)}" for n, k in zip(rooms, flat(_ROOM))]
    parameters += [f"{n}: {spelled(k)}" for n, k in zip(names, given(types))]
    arguments = ["wp.int64(t)", "lanes", *(f"{n}[t]" for n in rooms), *names]
    translation.add(
        f"@wp.kernel\ndef shade({', '.join(parameters)}):\n    t = wp.tid()\n    {made.name}({', '.join(arguments)})"
    )
    return load_module(translation.source)


class OnDevice(integrate.Processor):
    """Shades points on a device of Warp.

    Parameters
    ----------
    device : Warp's name of it: "cuda:0", "cpu"
    """

    def __init__(self, device: str) -> None:
        self.device = warp().get_device(device)
        self._mirror = Mirror(self.device)
        self._rooms: list[Any] = []

    def takes(self, surfels: SurfelBVH | None) -> bool:
        return surfels is None

    def tables(self, scene: TraceScene, light: EnvironmentLight, lamps: Lamps) -> tuple[Any, Any, Any, Any]:
        with self._failures("copying the scene"):
            return self._mirror.tables(scene, light, lamps)

    def kernel(self, *arguments: Any) -> None:
        with self._failures("tracing"):
            self._launch(*arguments)

    def _launch(self, *arguments: Any) -> None:
        wp = warp()
        *inwards, out = arguments
        module = kernel_for(tuple(type_for(a) for a in arguments), self.device.is_cuda)
        points = len(out[0])
        threads = min(points, THREADS)
        found = [wp.zeros(array.shape, dtype=wp.float32, device=self.device) for array in out]
        inputs = [self._argument(module, part) for part in parts_of(tuple(inwards))]
        wp.launch(
            module.shade, dim=threads, inputs=[threads, *self._room(threads), *inputs, *found], device=self.device
        )
        for array, result in zip(out, found):
            array[...] = result.numpy()

    @contextlib.contextmanager
    def _failures(self, work: str) -> Iterator[None]:
        """Name what the device could not do; Warp raises RuntimeError for all of it, and for memory that is lacking."""
        try:
            yield
        except (RuntimeError, MemoryError) as error:
            problem = f"{self.device.name} failed at {work} ({str(error).strip().splitlines()[0]})"
            raise DeviceError("device cuda", problem, "Use fewer objects or the CPU") from error

    def _argument(self, module: ModuleType, value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return self._mirror.array(value)
        if isinstance(value, tuple):
            struct = getattr(module, type(value).__name__)()
            for name, part in zip(value._fields, value):  # type: ignore[attr-defined]
                setattr(struct, name, part)
            return struct
        return value.item() if isinstance(value, np.generic) else value

    def _room(self, threads: int) -> list[Any]:
        """Scratch memory; neighbouring threads find theirs next to each other on a card."""
        if not self._rooms or self._rooms[0].shape[0] < threads:
            wp = warp()
            self._rooms = []
            for kind, shape in zip(flat(_ROOM), _shapes()):
                dtype = getattr(wp, kind.element)
                if self.device.is_cuda:
                    turned = wp.zeros((*shape, threads), dtype=dtype, device=self.device)
                    axes = len(shape)
                    self._rooms.append(turned.transpose((axes, *range(axes))))
                else:
                    self._rooms.append(wp.zeros((threads, *shape), dtype=dtype, device=self.device))
        return self._rooms
