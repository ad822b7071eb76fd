"""Camera rays against meshes on a device: `gbuffer.camera_hits` with Warp's rays, from the same source."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...compute.warp.kernels import Launcher, WarpKernel
from ...compute.warp.translate import replacing
from ..gbuffer import camera_hits
from ..gbuffer.camera_hits import arrays_of
from ..gbuffer.gbuffer import GBuffer
from ..gbuffer.mesh_hits import MeshHits
from ..scene.trace_scene import TraceScene
from .native_functions import NATIVES
from .scene_mirror import Mirror

Array = np.ndarray


#: One sample or point a block.
_CONSTANTS = replacing(camera_hits, "BLOCK", 1)

TRACE = WarpKernel(camera_hits.trace_samples, (), NATIVES, _CONSTANTS)
TRACE_THROUGH = WarpKernel(camera_hits.trace_through_samples, (), NATIVES, _CONSTANTS)
SHADE = WarpKernel(camera_hits.shade_hits, (), NATIVES, _CONSTANTS)


@dataclass(slots=True)
class DeviceHits(MeshHits):
    """`MeshHits` of which depth and owner have come back from a device; the rest stays there.

    Attributes
    ----------
    on_device : tuple
        All arrays, on the device.
    again : callable
        Traces them on the CPU.
    """

    on_device: tuple[Any, ...]
    again: Callable[[], MeshHits]

    def to_cpu(self) -> MeshHits:
        """A copy in the CPU's memory; traced again where they are lost with the device."""
        try:
            return MeshHits(*(array.numpy() for array in self.on_device))
        except Exception:  # whatever Warp raises for a device that is no more
            return self.again()


def trace(
    launcher: Launcher, mirror: Mirror, on_cpu: Callable[[], MeshHits], scene: TraceScene, parameters: Array, x0: int,
    y0: int, shape: tuple[int, ...], mask: int,
) -> MeshHits:  # fmt: skip
    """`gbuffer.camera_hits.trace_camera` on a device; `on_cpu` does it on the CPU."""
    if not mask:
        return on_cpu()
    with launcher.failures("copying the scene"):
        tracer, owners, zeros = mirror.tracer(scene), mirror.owners(scene), launcher.zeros
        depth, where = zeros(shape), zeros((*shape, 5))
        owner, face, instance = (zeros(shape, "int32") for _ in range(3))
    on_device = depth, owner, face, instance, where
    view_of, count = (parameters, x0, y0), int(np.prod(shape))
    if scene.mesh_materials.table.clear:
        with launcher.failures("copying the scene"):
            seen, cut = (tracer, mirror.geometry(scene)), zeros((max(len(scene.pass_index), 1),), "int32")
        launcher.launch(TRACE_THROUGH, count, (seen, view_of, np.int32(mask), owners), (*on_device, cut))
        with launcher.failures("tracing the camera's rays"):
            scene.cut.update(np.flatnonzero(cut.numpy()).tolist())
    else:
        launcher.launch(TRACE, count, (tracer, view_of, np.int32(mask), owners), on_device)
    with launcher.failures("tracing the camera's rays"):
        return DeviceHits(depth.numpy(), owner.numpy(), face, instance, where, on_device, on_cpu)


def shade(
    launcher: Launcher, mirror: Mirror, scene: TraceScene, hits: DeviceHits, parameters: Array, x0: int,
    buffer: GBuffer, layer: int,
) -> None:  # fmt: skip
    """`gbuffer.camera_hits.shade_mesh` on a device."""
    keys, out = arrays_of(buffer)
    chosen = np.flatnonzero(keys[2] & layer == layer)
    if not len(chosen):
        return
    with launcher.failures("copying the scene"):
        geometry, moving = mirror.geometry(scene), mirror.moving(scene)
    # Those alone: what is written to comes back as a whole.
    found = tuple(
        tuple(np.zeros((min(len(chosen), len(array)), *array.shape[1:]), array.dtype) for array in group)
        for group in out
    )
    arguments = geometry, moving, (parameters, x0, buffer.rows[0]), layer, hits.on_device
    launcher.launch(SHADE, len(chosen), (*arguments, tuple(key[chosen] for key in keys)), found)
    for group, values in zip(out, found):
        for array, value in zip(group, values):
            if len(array):
                array[chosen] = value
