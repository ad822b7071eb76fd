"""Cryptomatte: which objects and materials a pixel shows, and how much of each (Friedman and Jones 2015).

A pixel holds the numbers of the names (`core.cryptomatte`) and the coverages of what it shows, most first, two in every
RGBA pass.
"""

from __future__ import annotations

import numpy as np

from ...compute.jit import njit
from ...compute.threads import ROWS, over_range
from ...core.cryptomatte import DRGS_MATERIAL, KINDS, identities
from ...core.frame import Frame
from ...core.memory import filled_columns, sparse_zeros
from ..gbuffer.gbuffer import GBuffer
from ..scene.trace_scene import TraceScene
from ..shading_points import CATCHER

Array = np.ndarray

#: Passes of each kind.
PASSES_PER_KIND = 3
#: IDs kept per pixel before those of the least coverage are left out.
_SLOTS = 24


class CryptoFilm:
    """Identities and coverages of the camera's window, of one kind of thing."""

    def __init__(self, kind: str, scene: TraceScene, frame: Frame) -> None:
        x0, y0, x1, y1 = frame.camera.window
        self._kind, self._scene, self._origin, self._width = kind, scene, (x0, y0), frame.camera.width
        objects = [item.name for item in frame.objects] + [mesh.name for mesh in frame.meshes]
        self._identities = identities(objects if kind == "object" else [*scene.mesh_materials.names, DRGS_MATERIAL])
        self._passes = [sparse_zeros((y1 - y0, x1 - x0, 4)) for _ in range(PASSES_PER_KIND)]

    def add(self, buffer: GBuffer) -> None:
        """Take the samples of a strip."""
        y0, y1 = buffer.rows
        x0, top = self._origin
        scene = self._scene
        if self._kind == "object":
            owner = scene.source[buffer.object_index]
        else:
            owner = scene.mesh_materials.of(buffer.face - scene.vertex_faces)
        rows = buffer.point_rows(x0, self._width)
        out = np.zeros((y1 - y0, self._passes[0].shape[1], 2 * PASSES_PER_KIND, 2), np.float32)
        over_range(_rank, y1 - y0, rows, self._identities[owner], out, fewest=ROWS)
        for i, pixels in enumerate(self._passes):
            found = out[:, :, 2 * i : 2 * i + 2].reshape(y1 - y0, -1, 4)
            some = filled_columns(found)  # what is not written takes no memory
            pixels[y0 - top : y1 - top, some] = found[:, some]

    def passes(self) -> dict[str, Array]:
        """Name -> (h, w, 4) float32."""
        return {f"{KINDS[self._kind]}{i:02}": pixels for i, pixels in enumerate(self._passes)}


@njit
def _rank(y0, y1, points, identity, out):  # type: ignore[no-untyped-def]
    """Add up the weights of each identity in a pixel, and keep the largest."""
    start, pixel, weight, flags = points.start, points.pixel, points.weight, points.flags
    known, share = np.empty(_SLOTS, np.float32), np.empty(_SLOTS, np.float32)
    for y in range(y0, y1):
        first = start[y]
        while first < start[y + 1]:
            last, count = first, 0
            while last < start[y + 1] and pixel[last] == pixel[first]:
                if not flags[last] & CATCHER:
                    slot = 0
                    while slot < count and known[slot] != identity[last]:
                        slot += 1
                    if slot < _SLOTS:
                        if slot == count:
                            known[slot], share[slot] = identity[last], np.float32(0.0)
                            count += 1
                        share[slot] += weight[last]
                last += 1
            x = pixel[first] % points.width - points.x0
            for rank in range(min(count, out.shape[2])):
                best = rank
                for slot in range(rank + 1, count):
                    if share[slot] > share[best]:
                        best = slot
                known[rank], known[best] = known[best], known[rank]
                share[rank], share[best] = share[best], share[rank]
                out[y, x, rank, 0], out[y, x, rank, 1] = known[rank], share[rank]
            first = last
