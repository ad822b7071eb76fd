"""Surfels posed by their mesh on the processor, in blocks: the arithmetic of `pose`, on several surfels at a time.

What a block reads is gathered first, into rows of one number of each surfel. What follows is the same arithmetic on all
of them, without branches, which LLVM vectorises (SIMD). Surfels that take a branch of `pose.pose_surfel` that is rare
are found on the way and posed by it afterwards. Each operation is that of `pose`, in its order and precision, so the
results are the same bit for bit.
"""

from __future__ import annotations

import math

import numpy as np

from ..compute.jit import inlined, njit
from ..compute.threads import ELEMENTS, over_range
from .pose import Posed, PosedMesh, Rest, pose_surfel

Array = np.ndarray

#: Surfels of a block: what is gathered of them stays in the first level of cache.
_BLOCK = 128
# Rows of what is gathered: corners of the face, normals there, constants of the surfel; one that tells rare surfels.
_CORNER, _NORMAL, _WEIGHT, _OFFSET, _LOCAL, _OWN, _RARE = 0, 9, 18, 21, 22, 25, 31
_ROWS = 32
# Rows that `_frames` writes over them.
_CENTRE, _TANGENTS, _NEW_NORMAL = 0, 3, 9
# Rows of what is gathered of surfels with a span: its corners, tangents in its frame; one that tells if it is taken.
_IN_SPAN, _TAKEN, _SPAN_ROWS = 9, 15, 16


def pose(mesh: PosedMesh, by_corner: bool, linear: Array, sign: float, rest: Rest, out: Posed) -> None:
    """Pose all surfels; parameters as of `pose.pose_surfels`."""
    over_range(_pose, len(rest.face), mesh, by_corner, linear, sign, rest, out, fewest=ELEMENTS)


@njit
def _pose(first, last, mesh, by_corner, linear, sign, rest, out):  # type: ignore[no-untyped-def]
    s, w = np.empty((_ROWS, _BLOCK), np.float32), np.empty((_SPAN_ROWS, _BLOCK), np.float32)
    wide, squares = np.empty(_BLOCK, np.int64), np.empty((2, _BLOCK), np.float64)
    for begin in range(first, last, _BLOCK):
        count = min(_BLOCK, last - begin)
        _gather(s, begin, count, mesh, by_corner, rest)
        _frames(s, squares, count, linear, sign)
        spans = 0
        for j in range(count):
            if rest.span[begin + j, 0] >= 0:
                wide[spans] = j
                spans += 1
        if spans > 0:
            _gather_spans(w, squares, wide, begin, spans, mesh, rest)
            _span_tangents(w, squares, spans, linear, sign)
            for m in range(spans):
                if w[_TAKEN, m] != np.float32(0.0):
                    for k in range(6):
                        s[_TANGENTS + k, wide[m]] = w[k, m]
        for j in range(count):
            i = begin + j
            if s[_RARE, j] != np.float32(0.0):
                pose_surfel(i, mesh, by_corner, linear, sign, rest, out)
                continue
            for k in range(3):
                out.centre[i, k], out.normal[i, k] = s[_CENTRE + k, j], s[_NEW_NORMAL + k, j]
                out.tangent_u[i, k], out.tangent_v[i, k] = s[_TANGENTS + k, j], s[_TANGENTS + 3 + k, j]


@inlined
def _rows(linear):  # type: ignore[no-untyped-def]
    """The rows of a matrix in registers: within loops that write arrays they would be read again."""
    a = linear[0, 0], linear[0, 1], linear[0, 2]
    b = linear[1, 0], linear[1, 1], linear[1, 2]
    return a, b, (linear[2, 0], linear[2, 1], linear[2, 2])


@inlined
def _transformed_normal(rows, nx, ny, nz):  # type: ignore[no-untyped-def]
    """`pose._transformed_normal` with the rows of `linear`."""
    a, b, c = rows
    ox = a[0] * nx + b[0] * ny + c[0] * nz
    oy = a[1] * nx + b[1] * ny + c[1] * nz
    oz = a[2] * nx + b[2] * ny + c[2] * nz
    length = math.sqrt(ox * ox + oy * oy + oz * oz)
    length = 1.0 / length if length > 1e-300 else 0.0
    ox, oy, oz = ox * length, oy * length, oz * length
    return (
        a[0] * ox + a[1] * oy + a[2] * oz,
        b[0] * ox + b[1] * oy + b[2] * oz,
        c[0] * ox + c[1] * oy + c[2] * oz,
    )


@inlined
def _gather(s, begin, count, mesh, by_corner, rest):  # type: ignore[no-untyped-def]
    """Write what surfels from `begin` on read into rows of `s`."""
    for j in range(count):
        i = begin + j
        f = rest.face[i]
        a, b, c = mesh.faces[f, 0], mesh.faces[f, 1], mesh.faces[f, 2]
        for k in range(3):
            s[_CORNER + k, j], s[_CORNER + 3 + k, j], s[_CORNER + 6 + k, j] = (
                mesh.vertices[a, k], mesh.vertices[b, k], mesh.vertices[c, k]
            )  # fmt: skip
        if by_corner:
            a, b, c = 3 * f, 3 * f + 1, 3 * f + 2
        for k in range(3):
            s[_NORMAL + k, j], s[_NORMAL + 3 + k, j], s[_NORMAL + 6 + k, j] = (
                mesh.normals[a, k], mesh.normals[b, k], mesh.normals[c, k]
            )  # fmt: skip
            s[_WEIGHT + k, j], s[_LOCAL + k, j] = rest.weights[i, k], rest.normal[i, k]
            s[_OWN + k, j], s[_OWN + 3 + k, j] = rest.coordinates[i, k, 0], rest.coordinates[i, k, 1]
        s[_OFFSET, j] = rest.offset[i]
        s[_RARE, j] = rest.rest_edge[f]  # more than 0: the face had no area at rest


@inlined
def _frames(s, squares, count, linear, sign):  # type: ignore[no-untyped-def]
    """Write centres, tangents and normals over what was gathered in `s`, and which surfels are rare.

    The row 0 of `squares` becomes the squared length of both tangents.
    """
    rows = _rows(linear)
    for j in range(count):
        ax, ay, az = np.float64(s[0, j]), np.float64(s[1, j]), np.float64(s[2, j])
        ux, uy, uz = s[3, j] - ax, s[4, j] - ay, s[5, j] - az
        vx, vy, vz = s[6, j] - ax, s[7, j] - ay, s[8, j] - az
        size = abs(ax) + abs(ay) + abs(az) + abs(ux) + abs(uy) + abs(uz) + abs(vx) + abs(vy) + abs(vz)
        wa, wb, wc = np.float64(s[_WEIGHT, j]), np.float64(s[_WEIGHT + 1, j]), np.float64(s[_WEIGHT + 2, j])
        pa, pb, pc = max(wa, 0.0), max(wb, 0.0), max(wc, 0.0)
        sx = pa * s[_NORMAL, j] + pb * s[_NORMAL + 3, j] + pc * s[_NORMAL + 6, j]
        sy = pa * s[_NORMAL + 1, j] + pb * s[_NORMAL + 4, j] + pc * s[_NORMAL + 7, j]
        sz = pa * s[_NORMAL + 2, j] + pb * s[_NORMAL + 5, j] + pc * s[_NORMAL + 8, j]

        nx, ny, nz = sign * (uy * vz - uz * vy), sign * (uz * vx - ux * vz), sign * (ux * vy - uy * vx)
        length = math.sqrt(nx * nx + ny * ny + nz * nz)
        uu, vv = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz
        usual = (size < 1e30) & (length > 1e-10 * (uu + vv)) & (sx * sx + sy * sy + sz * sz > 1e-12)
        nx, ny, nz = nx / length, ny / length, nz / length

        # `tangent_frame` of the first edge
        length = math.sqrt(sx * sx + sy * sy + sz * sz)
        sx, sy, sz = sx / length, sy / length, sz / length
        d = ux * sx + uy * sy + uz * sz
        tx, ty, tz = ux - d * sx, uy - d * sy, uz - d * sz
        length = math.sqrt(tx * tx + ty * ty + tz * tz)
        usual = usual & (length > 1e-6 * math.sqrt(ux * ux + uy * uy + uz * uz))
        tx, ty, tz = tx / length, ty / length, tz / length
        bx, by, bz = sy * tz - sz * ty, sz * tx - sx * tz, sx * ty - sy * tx

        hx, hy, hz = _transformed_normal(rows, nx, ny, nz)

        d = np.float64(s[_OFFSET, j])
        p, q, r = s[_OWN, j], s[_OWN + 1, j], s[_OWN + 2, j]
        a, b, c = s[_OWN + 3, j], s[_OWN + 4, j], s[_OWN + 5, j]
        lx, ly, lz = np.float64(s[_LOCAL, j]), sign * s[_LOCAL + 1, j], np.float64(s[_LOCAL + 2, j])
        mx, my, mz = tx * lx + bx * ly + sx * lz, ty * lx + by * ly + sy * lz, tz * lx + bz * ly + sz * lz
        length = math.sqrt(mx * mx + my * my + mz * mz)
        usual = usual & (length > 1e-12) & (s[_RARE, j] <= np.float32(0.0))
        s[0, j], s[1, j], s[2, j] = (
            ax + wb * ux + wc * vx + d * hx, ay + wb * uy + wc * vy + d * hy, az + wb * uz + wc * vz + d * hz
        )  # fmt: skip
        fx, fy, fz = ux * p + vx * q + hx * r, uy * p + vy * q + hy * r, uz * p + vz * q + hz * r
        gx, gy, gz = ux * a + vx * b + hx * c, uy * a + vy * b + hy * c, uz * a + vz * b + hz * c
        squares[0, j] = fx * fx + fy * fy + fz * fz + gx * gx + gy * gy + gz * gz
        s[3, j], s[4, j], s[5, j], s[6, j], s[7, j], s[8, j] = fx, fy, fz, gx, gy, gz
        s[9, j], s[10, j], s[11, j] = mx / length, my / length, mz / length
        s[_RARE, j] = np.float32(0.0) if usual else np.float32(1.0)


@inlined
def _gather_spans(w, squares, wide, begin, spans, mesh, rest):  # type: ignore[no-untyped-def]
    """Write what surfels `wide` of a block read of their spans into rows of `w`, their squares into row 1."""
    for m in range(spans):
        i = begin + wide[m]
        a, b, c = rest.span[i, 0], rest.span[i, 1], rest.span[i, 2]
        for k in range(3):
            w[k, m], w[3 + k, m], w[6 + k, m] = mesh.vertices[a, k], mesh.vertices[b, k], mesh.vertices[c, k]
            w[_IN_SPAN + k, m], w[_IN_SPAN + 3 + k, m] = rest.in_span[i, k, 0], rest.in_span[i, k, 1]
        squares[1, m] = squares[0, wide[m]]


@inlined
def _span_tangents(w, squares, spans, linear, sign):  # type: ignore[no-untyped-def]
    """Write the tangents by spans into the first six rows of `w`, and whether they stretch the surfels less."""
    rows = _rows(linear)
    for m in range(spans):
        ax, ay, az = np.float64(w[0, m]), np.float64(w[1, m]), np.float64(w[2, m])
        ux, uy, uz = w[3, m] - ax, w[4, m] - ay, w[5, m] - az
        vx, vy, vz = w[6, m] - ax, w[7, m] - ay, w[8, m] - az
        nx, ny, nz = sign * (uy * vz - uz * vy), sign * (uz * vx - ux * vz), sign * (ux * vy - uy * vx)
        length = math.sqrt(nx * nx + ny * ny + nz * nz)
        proper = length > 1e-10 * (ux * ux + uy * uy + uz * uz + vx * vx + vy * vy + vz * vz)
        nx, ny, nz = nx / length, ny / length, nz / length
        hx, hy, hz = _transformed_normal(rows, nx, ny, nz)
        p, q, r = w[_IN_SPAN, m], w[_IN_SPAN + 1, m], w[_IN_SPAN + 2, m]
        a, b, c = w[_IN_SPAN + 3, m], w[_IN_SPAN + 4, m], w[_IN_SPAN + 5, m]
        fx, fy, fz = ux * p + vx * q + hx * r, uy * p + vy * q + hy * r, uz * p + vz * q + hz * r
        gx, gy, gz = ux * a + vx * b + hx * c, uy * a + vy * b + hy * c, uz * a + vz * b + hz * c
        less = fx * fx + fy * fy + fz * fz + gx * gx + gy * gy + gz * gz < squares[1, m]
        w[0, m], w[1, m], w[2, m], w[3, m], w[4, m], w[5, m] = fx, fy, fz, gx, gy, gz
        w[_TAKEN, m] = np.float32(1.0) if proper & less else np.float32(0.0)
