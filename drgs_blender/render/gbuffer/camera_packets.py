"""Camera rays eight at a time: neighbours go much the same way, and Embree traces them together in half of the time."""

from __future__ import annotations

import numpy as np

from ...compute.jit import njit
from ..camera import CLIP_END, CLIP_START, WIDTH, sample_ray
from ..scene import embree as e
from ..scene.interaction import numbered
from ..scene.ray import Hit

#: Samples or points of a block: whole packets.
BLOCK = 256


@njit
def put_hit(at, hit, owners, out):  # type: ignore[no-untyped-def]
    """Write what a sample's ray meets.

    Parameters
    ----------
    at : tuple of int64
        Row, column and number of the sample.
    hit : Hit
    owners, out : tuple
        As of `camera_hits.trace_samples`.

    Returns
    -------
    int32
        The object, or -1.
    """
    y, x, k = at
    face_object, instance_object = owners
    depth, owner, face, instance, where = out
    depth[y, x, k], face[y, x, k], instance[y, x, k] = hit.t, hit.face, hit.instance
    where[y, x, k, 0], where[y, x, k, 1] = hit.u, hit.v
    where[y, x, k, 2], where[y, x, k, 3], where[y, x, k, 4] = hit.gx, hit.gy, hit.gz
    who = np.int32(-1)
    if hit.face >= 0 and hit.instance >= 0:
        who = instance_object[hit.instance]
    elif hit.face >= 0:
        who = face_object[hit.face]
    owner[y, x, k] = who
    return who


@njit
def trace_packets(thread, stride, packets, tracer, view_of, mask, owners, out):  # type: ignore[no-untyped-def]
    """What `camera_hits.trace_samples` finds, to the bit.

    Parameters
    ----------
    thread, stride : int64
    packets : int64
        `embree.packet_address`, not 0.
    tracer, view_of, mask, owners, out : Tracer, tuple or int32
        As of `camera_hits.trace_samples`.
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
            for i in range(e.PACKET):
                n = first + i
                words[e.PACKET_VALID + i] = 0
                if n >= count:
                    continue
                x, y, k = n // subpixels % columns, n // (subpixels * columns), n % subpixels
                owner[y, x, k] = -1
                ox, oy, oz, dx, dy, dz = sample_ray(p, (y0 + y) * width + x0 + x, k)
                if dx * dx + dy * dy + dz * dz == 0.0:  # beyond the picture of a fisheye lens
                    continue
                words[e.PACKET_VALID + i] = -1
                at = e.ORIGIN + i
                rays[at], rays[at + e.PACKET], rays[at + 2 * e.PACKET] = ox, oy, oz
                at = e.DIRECTION + i
                rays[at], rays[at + e.PACKET], rays[at + 2 * e.PACKET] = dx, dy, dz
                rays[e.TNEAR + i], rays[e.TFAR + i] = near, far
                words[e.MASK + i] = mask
                words[e.PRIMITIVE + i] = words[e.GEOMETRY + i] = words[e.INSTANCE + i] = -1
            e.trace_packet(packets, tracer.scene, address)
            for i in range(e.PACKET):
                if words[e.PACKET_VALID + i] == 0:
                    continue
                n = first + i
                x, y, k = n // subpixels % columns, n // (subpixels * columns), n % subpixels
                place, group = words[e.INSTANCE + i], words[e.GEOMETRY + i]
                # Embree leaves the number of the instance unwritten for hits without one.
                its = np.int32(-1)
                if place >= 0:
                    group, its = place, words[e.INSTANCE_PRIMITIVE + i]
                f, its = numbered(tracer, group, words[e.PRIMITIVE + i], its)
                normal = e.NORMAL + i
                gx, gy, gz = rays[normal], rays[normal + e.PACKET], rays[normal + 2 * e.PACKET]
                hit = Hit(rays[e.TFAR + i], f, its, rays[e.U + i], rays[e.V + i], gx, gy, gz)
                put_hit((y, x, k), hit, owners, out)
