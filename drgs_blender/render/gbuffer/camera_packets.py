"""Camera rays eight at a time: those of a pixel go much the same way, and Embree traces them together in less time.

A packet is eight positions of one pixel. Where surfaces coincide, which of them is met may depend on all rays of a
packet: so it has to be the same one in whatever tile, strip or part its pixel is.
"""

from __future__ import annotations

import numpy as np

from ...compute.jit import njit
from ..camera import CLIP_END, CLIP_START, WIDTH, sample_ray
from ..scene import embree as e
from ..scene.interaction import numbered
from ..scene.ray import Hit
from .mesh_hits import BLOCK, put_hit


@njit
def trace_packets(thread, stride, entry, tracer, view_of, mask, owners, out):  # type: ignore[no-untyped-def]
    """What `camera_hits.trace_samples` finds, to the bit but for which of several coinciding surfaces is met.

    Parameters
    ----------
    thread, stride : int64
    entry : int64
        `embree.packet_address`, not 0.
    tracer : Tracer
    view_of : tuple
    mask : int32
    owners, out : tuple
        As of `camera_hits.trace_samples`; pixels have a multiple of `embree.PACKET` samples.
    """
    p, x0, y0 = view_of
    owner = out[1]
    width = np.int64(p[WIDTH])
    rows, columns, subpixels = owner.shape
    near, far = np.float32(p[CLIP_START]), np.float32(p[CLIP_END])
    count = rows * columns * subpixels
    memory = np.zeros(e.PACKET_WORDS + 16, np.float32)
    begin = (-np.int64(memory.ctypes.data) // 4) % 16
    rays = memory[begin : begin + e.PACKET_WORDS]
    words = rays.view(np.int32)
    address = np.int64(rays.ctypes.data)
    for block in range(thread, (count + BLOCK - 1) // BLOCK, stride):
        for first in range(block * BLOCK, min((block + 1) * BLOCK, count), e.PACKET):
            pixel, k = first // subpixels, first % subpixels
            y, x = pixel // columns, pixel % columns
            for i in range(e.PACKET):
                ox, oy, oz, dx, dy, dz = sample_ray(p, (y0 + y) * width + x0 + x, k + i)
                # none beyond the picture of a fisheye lens
                words[e.PACKET_VALID + i] = -1 if dx * dx + dy * dy + dz * dz > 0.0 else 0
                at = e.ORIGIN + i
                rays[at], rays[at + e.PACKET], rays[at + 2 * e.PACKET] = ox, oy, oz
                at = e.DIRECTION + i
                rays[at], rays[at + e.PACKET], rays[at + 2 * e.PACKET] = dx, dy, dz
                rays[e.TNEAR + i], rays[e.TFAR + i] = near, far
                words[e.MASK + i] = mask
                words[e.PRIMITIVE + i] = words[e.GEOMETRY + i] = words[e.INSTANCE + i] = -1
            e.trace_packet(entry, tracer.scene, address)
            for i in range(e.PACKET):
                if words[e.PACKET_VALID + i] == 0:
                    owner[y, x, k + i] = -1
                    continue
                group, part = words[e.GEOMETRY + i], np.int32(-1)
                if words[e.INSTANCE + i] >= 0:  # Embree leaves the number of the part unwritten for hits without one
                    group, part = words[e.INSTANCE + i], words[e.INSTANCE_PRIMITIVE + i]
                face, instance = numbered(tracer, group, words[e.PRIMITIVE + i], part)
                normal = e.NORMAL + i
                gx, gy, gz = rays[normal], rays[normal + e.PACKET], rays[normal + 2 * e.PACKET]
                hit = Hit(rays[e.TFAR + i], face, instance, rays[e.U + i], rays[e.V + i], gx, gy, gz)
                put_hit((y, x, k + i), hit, owners, out)
