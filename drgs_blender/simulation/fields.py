"""Force fields that push matter about: forces, winds, vortices and turbulence, as Blender's effectors do.

Formulas after Blender's effect.c (do_physical_effector, effector_falloff): the strength is an acceleration, m/s^2. The
pattern of turbulence is our own: gradient noise of two octaves (Perlin 1985), of the same size and strength.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..compute.jit import inlined, njit
from ..compute.threads import over_range
from .grid_blocks import Nodes

Array = np.ndarray

#: How compiled code numbers kinds, shapes, falloffs and the sides of a field that acts on one alone.
KINDS = {"force": 0, "wind": 1, "vortex": 2, "turbulence": 3}
SHAPES = {"point": 0, "plane": 1, "line": 2}
FALLOFFS = {"sphere": 0, "tube": 1, "cone": 2}
SIDES = {"both": 0, "above": 1, "below": 2}
#: Columns of `FieldRows.at`; what may change from frame to frame comes first.
_PLACE, _AXIS, _STRENGTH, _FLOW, MOVING = 0, 3, 6, 7, 8
_KIND, _SHAPE, _FALLOFF, _SIDE, _POWER, _NEAR, _FAR, _RADIAL, _INNER, _OUTER, _SIZE, COLUMNS = range(8, 20)
#: Fewest places for which another thread is worth while.
_PLACES = 512
#: Metres, beyond everything.
FAR = 1e9


@dataclass(frozen=True, slots=True)
class ForceField:
    """A field of force.

    Attributes
    ----------
    kind : str
        "force" (away from it, towards it if the strength is negative), "wind" (along its axis), "vortex" (around its
        axis) or "turbulence".
    frames : tuple of tuple of float
        Rows of eight: place (metres), axis (any length), strength (m/s^2) and flow (1/s), a frame each from the first
        one simulated on; the last one stays. Flow is how it slows what moves in it: wind blows at strength / flow.
    shape : str
        Origin of distances: "point", "plane" (across its axis) or "line" (along its axis).
    falloff : str
        Whether distance counts from all around, in a tube or in a cone along the axis.
    side : str
        Of the plane across the axis on which it acts.
    power : float
        Of the distance beyond `nearest` with which it falls.
    nearest, farthest : float
        Metres: full strength up to there, none beyond.
    radial, inner, outer : float
        The same across the tube (metres) or cone (degrees).
    size : float
        Of turbulence, metres.
    """

    kind: str
    frames: tuple[tuple[float, ...], ...]
    shape: str = "point"
    falloff: str = "sphere"
    side: str = "both"
    power: float = 0.0
    nearest: float = 0.0
    farthest: float = FAR
    radial: float = 0.0
    inner: float = 0.0
    outer: float = FAR
    size: float = 1.0

    def row(self) -> list[float]:
        """The columns that stay."""
        return [
            KINDS[self.kind], SHAPES[self.shape], FALLOFFS[self.falloff], SIDES[self.side], self.power, self.nearest,
            self.farthest, self.radial, self.inner, self.outer, max(self.size, 1e-6),
        ]  # fmt: skip


class FieldRows:
    """Fields as compiled code reads them, at any time."""

    def __init__(self, fields: Sequence[ForceField]) -> None:
        self._frames = [np.array(field.frames, np.float64).reshape(-1, MOVING) for field in fields]
        self._still = np.array([field.row() for field in fields], np.float64).reshape(len(fields), COLUMNS - MOVING)

    def push(self, frame: int) -> float:
        """Largest acceleration by the fields, but for vortices, from `frame` to the next, m/s^2."""
        return float(sum(max(abs(row[_STRENGTH]) for row in self._around(f, frame)) for f in self._frames))

    @staticmethod
    def _around(frames: Array, frame: int) -> list[Array]:
        """The rows of `frame` and of the next; the last one stays."""
        return [frames[min(f, len(frames) - 1)] for f in (frame, frame + 1)]

    def __len__(self) -> int:
        return len(self._frames)

    def at(self, frame: int, part: float) -> Array:
        """(k, columns) float64 at `part` (0 to 1) of the way from `frame`, counted from 0, to the next."""
        rows = np.empty((len(self), COLUMNS))
        rows[:, MOVING:] = self._still
        for row, frames in zip(rows, self._frames, strict=True):
            before, after = self._around(frames, frame)
            row[:MOVING] = (1 - part) * before + part * after
            row[_AXIS : _AXIS + 3] /= max(float(np.linalg.norm(row[_AXIS : _AXIS + 3])), 1e-12)
        return rows


@njit
def _slope(i, j, k, seed):  # type: ignore[no-untyped-def]
    """A direction for a corner of the lattice of noise."""
    h = (i * 73856093) ^ (j * 19349663) ^ (k * 83492791) ^ (seed * 2654435761)
    h = (h ^ (h >> 13)) * 1274126177 & 0x7FFFFFFF
    h = (h ^ (h >> 16)) * 668265263 & 0x7FFFFFFF
    z = ((h & 0x3FF) + 0.5) / 512.0 - 1.0
    angle = ((h >> 10) & 0x3FF) * (2.0 * np.pi / 1024.0)
    r = np.sqrt(1.0 - z * z)
    return r * np.cos(angle), r * np.sin(angle), z


@njit
def noise(x, y, z, seed):  # type: ignore[no-untyped-def]
    """Gradient noise (Perlin 1985), from about -1 to 1 and 0 on average, that varies over a distance of 1.

    Parameters
    ----------
    x, y, z : float64
        Position, in units of the noise's size.
    seed : int64

    Returns
    -------
    float64
    """
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    a, b, c = x - i, y - j, z - k
    u, v, w = a * a * a * (a * (a * 6 - 15) + 10), b * b * b * (b * (b * 6 - 15) + 10), c * c * c * (c * (c * 6 - 15) + 10)  # noqa: E501  # fmt: skip
    total = 0.0
    for corner in range(8):
        p, q, r = corner >> 2, corner >> 1 & 1, corner & 1
        gx, gy, gz = _slope(i + p, j + q, k + r, seed)
        weight = (u if p else 1 - u) * (v if q else 1 - v) * (w if r else 1 - w)
        total += weight * (gx * (a - p) + gy * (b - q) + gz * (c - r))
    return 1.6 * total


@inlined
def _fall(distance, power, nearest, farthest):  # type: ignore[no-untyped-def]
    if distance > farthest:
        return 0.0
    if distance < nearest:
        return 1.0
    return (1.0 + distance - nearest) ** -power


@njit
def push_of(f, x, y, z):  # type: ignore[no-untyped-def]
    """Force of a field at a position.

    Parameters
    ----------
    f : (k,) array
        A row of `FieldRows.at`.
    x, y, z : float
        Metres, world.

    Returns
    -------
    ax, ay, az : float
        m/s^2.
    flow : float
        1/s, by which it slows what moves there.
    """
    nx, ny, nz = f[_AXIS], f[_AXIS + 1], f[_AXIS + 2]
    rx, ry, rz = x - f[_PLACE], y - f[_PLACE + 1], z - f[_PLACE + 2]  # from its middle
    along = rx * nx + ry * ny + rz * nz
    kind, shape = f[_KIND], f[_SHAPE]
    dx, dy, dz = rx, ry, rz  # from the shape
    if shape == 2.0 or (shape == 1.0 and kind == 2.0):
        dx, dy, dz = rx - along * nx, ry - along * ny, rz - along * nz
    elif shape == 1.0:
        dx, dy, dz = along * nx, along * ny, along * nz
    distance = np.sqrt(dx * dx + dy * dy + dz * dz)
    if (f[_SIDE] == 1.0 and along < 0.0) or (f[_SIDE] == 2.0 and along > 0.0):
        return 0.0, 0.0, 0.0, 0.0
    if f[_FALLOFF] == 0.0:
        fall = _fall(distance, f[_POWER], f[_NEAR], f[_FAR])
    else:
        fall = _fall(abs(along), f[_POWER], f[_NEAR], f[_FAR])
        reach = np.sqrt(rx * rx + ry * ry + rz * rz)
        if f[_FALLOFF] == 1.0:
            across = np.sqrt(max(reach * reach - along * along, 0.0))
        else:
            across = np.degrees(np.arccos(min(max(along / max(reach, 1e-12), -1.0), 1.0)))
        fall *= _fall(across, f[_RADIAL], f[_INNER], f[_OUTER])
    s = f[_STRENGTH] * fall
    flow = f[_FLOW] * fall
    if kind == 0.0:
        s /= max(distance, 1e-12)
        return s * dx, s * dy, s * dz, flow
    if kind == 1.0:
        return s * nx, s * ny, s * nz, flow
    if kind == 2.0:
        cx, cy, cz = ny * rz - nz * ry, nz * rx - nx * rz, nx * ry - ny * rx
        if shape == 0.0:
            length = max(np.sqrt(cx * cx + cy * cy + cz * cz), 1e-12)
            s *= distance / length
            return s * cx, s * cy, s * cz, flow
        # Towards the speed of a turn about the axis, and what keeps matter on its circle.
        cx, cy, cz = s * cx, s * cy, s * cz
        return (
            cx + s * (ny * cz - nz * cy), cy + s * (nz * cx - nx * cz), cz + s * (nx * cy - ny * cx), flow + 1.0,
        )  # fmt: skip
    scale = 1.0 / f[_SIZE]
    rx, ry, rz = rx * scale, ry * scale, rz * scale
    ax = noise(rx, ry, rz, 1) + 0.5 * noise(2 * rx, 2 * ry, 2 * rz, 4)
    ay = noise(rx, ry, rz, 2) + 0.5 * noise(2 * rx, 2 * ry, 2 * rz, 5)
    az = noise(rx, ry, rz, 3) + 0.5 * noise(2 * rx, 2 * ry, 2 * rz, 6)
    return s * ax, s * ay, s * az, flow


def blow(x: Array, v: Array, still: Array, rows: Array, dt: float) -> None:
    """Change the velocities of matter by a time step of fields, in place.

    Parameters
    ----------
    x : (n, 3) float64 array
        Metres.
    v : (n, 3) float64 array
        m/s; changed.
    still : (n,) bool array
        Particles that are not pushed.
    rows : (k, columns) float64 array
        Of `FieldRows.at`.
    dt : float
        Seconds.
    """
    over_range(_blow, len(x), x, v, still, rows, dt, fewest=_PLACES)


@njit
def _blow(first, last, x, v, still, rows, dt):  # type: ignore[no-untyped-def]
    for i in range(first, last):
        if still[i]:
            continue
        for r in range(len(rows)):
            ax, ay, az, flow = push_of(rows[r], x[i, 0], x[i, 1], x[i, 2])
            damping_factor = 1.0 / (1.0 + dt * flow)
            v[i, 0] = (v[i, 0] + dt * ax) * damping_factor
            v[i, 1] = (v[i, 1] + dt * ay) * damping_factor
            v[i, 2] = (v[i, 2] + dt * az) * damping_factor


def blow_nodes(nodes: Nodes, rows: Array, dt: float) -> None:
    """`blow` for the nodes of the grid."""
    over_range(_blow_nodes, len(nodes.values), nodes, rows, dt, fewest=_PLACES // 64)


@njit
def _blow_nodes(first, last, nodes, rows, dt):  # type: ignore[no-untyped-def]
    values, active, origin, spacing = nodes
    for s in range(first, last):
        for n in range(64):
            if values[s, n, 3] <= np.float32(0.0):
                continue
            x = origin[0] + spacing * (4 * active[s, 0] + n // 16)
            y = origin[1] + spacing * (4 * active[s, 1] + n // 4 % 4)
            z = origin[2] + spacing * (4 * active[s, 2] + n % 4)
            for r in range(len(rows)):
                ax, ay, az, flow = push_of(rows[r], x, y, z)
                damping_factor = 1.0 / (1.0 + dt * flow)
                values[s, n, 0] = np.float32((values[s, n, 0] + dt * ax) * damping_factor)
                values[s, n, 1] = np.float32((values[s, n, 1] + dt * ay) * damping_factor)
                values[s, n, 2] = np.float32((values[s, n, 2] + dt * az) * damping_factor)
