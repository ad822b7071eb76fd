"""Points that particles carry along, on a device: `deform.gmls` one point after the other.

The functions here are translated and never run as they stand.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...compute.warp.kernels import Launcher, WarpKernel
from ..gmls import Weights, blank, pack, settled

Array = np.ndarray


def _gradient(rows: Any, s: Any) -> Any:
    """That of a source, row by row."""
    return (
        rows[s, 0], rows[s, 4], rows[s, 8], rows[s, 1], rows[s, 5], rows[s, 9], rows[s, 2], rows[s, 6], rows[s, 10],
    )  # fmt: skip


def carry_points(thread, stride, scratch, source, weight, offset, reach, rows, centre, out):  # type: ignore[no-untyped-def]
    """`gmls._carry`; `source` and `weight` with the point as their last axis.

    Parameters
    ----------
    thread, stride, scratch : int64 or tuple
        See `compute.warp.kernels`.
    source : (k, n) int array
        Particles of each point.
    weight : (k, 4, n) float32 array
    offset : (n, 3) float32 array
    reach : (n,) float32 array
        As of `gmls.Weights`.
    rows, centre : array or tuple
        `gmls.pack` of the particles.
    out : tuple of array
        Points (n, 3), gradients (n, 3, 3) and whether each follows its first particle alone (n,); written.
    """
    points, gradients, turned = out
    zero = np.float32(0.0)
    for i in range(thread, len(reach), stride):
        first = source[0, i]
        ox, oy, oz = rows[first, 12], rows[first, 13], rows[first, 14]
        apart = zero
        p = zero, zero, zero
        f = zero, zero, zero, zero, zero, zero, zero, zero, zero
        for k in range(source.shape[0]):
            s = source[k, i]
            x, y, z, n = weight[k, 0, i], weight[k, 1, i], weight[k, 2, i], weight[k, 3, i]
            m = _gradient(rows, s)
            dx, dy, dz = rows[s, 12] - ox, rows[s, 13] - oy, rows[s, 14] - oz
            p = (
                p[0] + (m[0] * x + m[1] * y + m[2] * z + n * dx),
                p[1] + (m[3] * x + m[4] * y + m[5] * z + n * dy),
                p[2] + (m[6] * x + m[7] * y + m[8] * z + n * dz),
            )
            f = (
                f[0] + n * m[0], f[1] + n * m[1], f[2] + n * m[2], f[3] + n * m[3], f[4] + n * m[4], f[5] + n * m[5],
                f[6] + n * m[6], f[7] + n * m[7], f[8] + n * m[8],
            )  # fmt: skip
            apart = max(apart, dx * dx + dy * dy + dz * dz)
        q = offset[i, 0], offset[i, 1], offset[i, 2]
        own, at, alone = settled(f, p, _gradient(rows, first), q, apart, reach[i])
        turned[i] = alone
        gradients[i, 0, 0], gradients[i, 0, 1], gradients[i, 0, 2] = own[0], own[1], own[2]
        gradients[i, 1, 0], gradients[i, 1, 1], gradients[i, 1, 2] = own[3], own[4], own[5]
        gradients[i, 2, 0], gradients[i, 2, 1], gradients[i, 2, 2] = own[6], own[7], own[8]
        points[i, 0], points[i, 1] = centre[0] + (ox + at[0]), centre[1] + (oy + at[1])
        points[i, 2] = centre[2] + (oz + at[2])


CARRY = WarpKernel(carry_points, (), {})


class Carrier:
    """Carries points on a device, where their weights stay; of a frame only the sources go there.

    Parameters
    ----------
    weights : Weights
        Of `gmls.bind_points`.
    launcher : Launcher
        Of the device.

    Raises
    ------
    DeviceError
        The device fails, then or later.
    """

    def __init__(self, weights: Weights, launcher: Launcher) -> None:
        self._weights, self.launcher = weights, launcher
        with launcher.failures("copying weights"):  # neighbouring points next to each other, for cards
            turned = weights.source.T, weights.weight.transpose(1, 2, 0), weights.offset, weights.reach
            self._there = tuple(map(launcher.array, turned))

    def carry(self, x: Array, gradients: Array) -> tuple[Array, Array, int]:
        """`gmls.carry` of the weights."""
        x = np.ascontiguousarray(x)
        rows, centre = pack(x, gradients)
        points, out, turned = blank(self._weights, x.dtype)
        arguments = *self._there, rows, tuple(centre.tolist())
        self.launcher.launch(CARRY, len(points), arguments, (points, out, turned))
        return points, out, int(np.count_nonzero(turned))
