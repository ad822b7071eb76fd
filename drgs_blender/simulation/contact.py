"""Contact of matter with obstacles, in compiled code: meshes with a field of distances, and planes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from ..compute.jit import inlined, njit
from ..compute.threads import ELEMENTS, over_range
from ..core.errors import UsageError
from .grid_blocks import SLOTS, Nodes

Array = np.ndarray

Contact = Literal["separate", "slip", "sticky"]
#: How compiled code numbers what happens at contact.
CONTACTS: dict[str, int] = {"separate": 0, "slip": 1, "sticky": 2}


class Field(NamedTuple):
    """Signed distance on a grid, negative inside.

    Attributes
    ----------
    origin : (3,) float64 array
        Metres, in the space of the field.
    spacing : float
        Metres.
    distance : (nx, ny, nz) float32 array
        Metres.
    velocity : (nx, ny, nz, 3) float32 array
        m/s, or with nx = 0 where the surface does not deform.
    """

    origin: Array
    spacing: float
    distance: Array
    velocity: Array


class Motion(NamedTuple):
    """Rigid motion of a field: at ``linear + spin x (x - shift)``.

    Attributes
    ----------
    rotation : (3, 3) float64 array
        From the space of the field to the world, as `shift`.
    shift : (3,) float64 array
        Metres.
    linear : (3,) float64 array
        m/s.
    spin : (3,) float64 array
        rad/s.
    """

    rotation: Array
    shift: Array
    linear: Array
    spin: Array


class Surface(NamedTuple):
    """What a surface does to matter that touches it.

    Attributes
    ----------
    thickness : float
        Metres by which it is moved outwards.
    contact : int
        One of `CONTACTS`.
    friction : float
        Coulomb's coefficient, of "separate".
    """

    thickness: float
    contact: int
    friction: float


@inlined
def respond(v, u, n, contact, friction):  # type: ignore[no-untyped-def]
    """Contact: velocity of matter after it has touched a surface, with Coulomb's friction.

    Parameters
    ----------
    v, u, n : tuple of float
        (x, y, z), world: velocity of the matter and of the surface, m/s; unit normal of the surface, outwards.
    contact : int64
        Index in `CONTACTS`.
    friction : float
        Coulomb's coefficient, of "separate".

    Returns
    -------
    x, y, z : float
        Velocity, m/s, world.
    """
    vx, vy, vz = v
    ux, uy, uz = u
    nx, ny, nz = n
    if contact == 2:
        return ux, uy, uz
    rx, ry, rz = vx - ux, vy - uy, vz - uz
    along = rx * nx + ry * ny + rz * nz
    if contact == 0 and along >= 0.0:
        return vx, vy, vz
    rx, ry, rz = rx - along * nx, ry - along * ny, rz - along * nz
    if contact == 0 and friction > 0.0:
        speed = np.sqrt(rx * rx + ry * ry + rz * rz)
        keep = max(0.0, 1.0 + friction * along / speed) if speed > 1e-30 else 0.0
        rx, ry, rz = keep * rx, keep * ry, keep * rz
    return ux + rx, uy + ry, uz + rz


@inlined
def surface_near(place, field, motion):  # type: ignore[no-untyped-def]
    """The surface of a collider as seen from a point.

    Parameters
    ----------
    place : tuple of float
        From the collider's ``shift``, in world axes.
    field : Field
        Or a tuple in its order, as devices have it; so `motion`.
    motion : Motion

    Returns
    -------
    tuple of float
        Signed distance (infinite outside of the field), unit normal and velocity of the surface.
    """
    wx, wy, wz = place
    field_origin, field_spacing, distance, velocity = field
    rotation, _, linear, spin = motion
    nx, ny, nz = distance.shape
    none = (np.inf, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    px = (rotation[0, 0] * wx + rotation[1, 0] * wy + rotation[2, 0] * wz - field_origin[0]) / field_spacing
    py = (rotation[0, 1] * wx + rotation[1, 1] * wy + rotation[2, 1] * wz - field_origin[1]) / field_spacing
    pz = (rotation[0, 2] * wx + rotation[1, 2] * wy + rotation[2, 2] * wz - field_origin[2]) / field_spacing
    if not (0.0 <= px <= nx - 1 and 0.0 <= py <= ny - 1 and 0.0 <= pz <= nz - 1):
        return none
    # On the last node itself counts as in the last cell.
    i, j, k = min(int(px), nx - 2), min(int(py), ny - 2), min(int(pz), nz - 2)
    a, b, c = px - i, py - j, pz - k
    d000, d001 = distance[i, j, k], distance[i, j, k + 1]
    d010, d011 = distance[i, j + 1, k], distance[i, j + 1, k + 1]
    d100, d101 = distance[i + 1, j, k], distance[i + 1, j, k + 1]
    d110, d111 = distance[i + 1, j + 1, k], distance[i + 1, j + 1, k + 1]
    e00, e01, e10, e11 = d000 + c * (d001 - d000), d010 + c * (d011 - d010), d100 + c * (d101 - d100), d110 + c * (d111 - d110)  # noqa: E501  # fmt: skip
    low, high = e00 + b * (e01 - e00), e10 + b * (e11 - e10)
    gx = high - low
    gy = (1 - a) * (e01 - e00) + a * (e11 - e10)
    gz = (1 - a) * ((1 - b) * (d001 - d000) + b * (d011 - d010)) + a * ((1 - b) * (d101 - d100) + b * (d111 - d110))
    length = np.sqrt(gx * gx + gy * gy + gz * gz)
    if length < 1e-12:
        return none
    gx, gy, gz = gx / length, gy / length, gz / length
    ux = linear[0] + spin[1] * wz - spin[2] * wy
    uy = linear[1] + spin[2] * wx - spin[0] * wz
    uz = linear[2] + spin[0] * wy - spin[1] * wx
    if len(velocity) > 0:
        at = velocity[i + int(a + 0.5), j + int(b + 0.5), k + int(c + 0.5)]
        ux, uy, uz = ux + at[0], uy + at[1], uz + at[2]
    return (
        low + a * (high - low),
        rotation[0, 0] * gx + rotation[0, 1] * gy + rotation[0, 2] * gz,
        rotation[1, 0] * gx + rotation[1, 1] * gy + rotation[1, 2] * gz,
        rotation[2, 0] * gx + rotation[2, 1] * gy + rotation[2, 2] * gz,
        ux,
        uy,
        uz,
    )


def collide(nodes: Nodes, field: Field, motion: Motion, surface: Surface) -> None:
    """Change the velocities of nodes inside a collider, in place."""
    over_range(_collide, len(nodes.values), nodes, field, motion, surface, fewest=SLOTS // 4)


@njit
def _collide(first, last, nodes, field, motion, surface):  # type: ignore[no-untyped-def]
    values, active, origin, spacing = nodes
    shift = motion.shift
    for s in range(first, last):
        for n in range(64):
            if values[s, n, 3] <= np.float32(0.0):
                continue
            x = origin[0] + spacing * (4 * active[s, 0] + n // 16)
            y = origin[1] + spacing * (4 * active[s, 1] + n // 4 % 4)
            z = origin[2] + spacing * (4 * active[s, 2] + n % 4)
            d, mx, my, mz, ux, uy, uz = surface_near((x - shift[0], y - shift[1], z - shift[2]), field, motion)
            if d < surface.thickness:
                v = values[s, n, 0], values[s, n, 1], values[s, n, 2]
                values[s, n, 0], values[s, n, 1], values[s, n, 2] = respond(
                    v, (ux, uy, uz), (mx, my, mz), surface.contact, surface.friction
                )


@dataclass(frozen=True, slots=True)
class Plane:
    """Half a space that matter cannot enter: behind the point, against the normal.

    Attributes
    ----------
    point : tuple of float
        Metres, world.
    normal : tuple of float
        Unit vector, world.
    contact : {"separate", "slip", "sticky"}
        As those of `Collider`.
    friction : float
        As those of `Collider`.
    """

    point: tuple[float, float, float]
    normal: tuple[float, float, float]
    contact: Contact = "separate"
    friction: float = 0.5


def plane_rows(planes: Sequence[Plane]) -> Array:
    """(k, 6) float64 for `bound`: normal, offset, contact, friction."""
    rows = np.zeros((len(planes), 6))
    for row, plane in zip(rows, planes, strict=True):
        normal = np.asarray(plane.normal, np.float64)
        length = np.linalg.norm(normal)
        if not (np.isfinite(length) and length > 0):
            raise UsageError("a plane", f"has the normal {plane.normal}", "Give it a direction")
        row[:3] = normal / length
        row[3] = row[:3] @ np.asarray(plane.point, np.float64)
        row[4], row[5] = CONTACTS[plane.contact], plane.friction
    return rows


def bound(nodes: Nodes, planes: Array) -> None:
    """Change the velocities of nodes behind planes, rows of `plane_rows`, in place."""
    over_range(_bound, len(nodes.values), nodes, planes, fewest=SLOTS)


@njit
def _bound(first, last, nodes, planes):  # type: ignore[no-untyped-def]
    values, active, origin, spacing = nodes
    for s in range(first, last):
        for q in range(len(planes)):
            ax, ay, az = planes[q, 0], planes[q, 1], planes[q, 2]
            base = (
                ax * (origin[0] + spacing * 4 * active[s, 0]) + ay * (origin[1] + spacing * 4 * active[s, 1])
                + az * (origin[2] + spacing * 4 * active[s, 2]) - planes[q, 3]
            )  # fmt: skip
            if base + 3 * spacing * (min(ax, 0.0) + min(ay, 0.0) + min(az, 0.0)) > 0.0:
                continue
            for n in range(64):
                depth = base + spacing * (ax * (n // 16) + ay * (n // 4 % 4) + az * (n % 4))
                if depth <= 1e-9 * spacing and values[s, n, 3] > np.float32(0.0):
                    v = values[s, n, 0], values[s, n, 1], values[s, n, 2]
                    values[s, n, 0], values[s, n, 1], values[s, n, 2] = respond(
                        v, (0.0, 0.0, 0.0), (ax, ay, az), int(planes[q, 4]), planes[q, 5]
                    )


def look(points: Array, field: Field, motion: Motion) -> Array:
    """(n, 7) what `surface_near` says of each world point."""
    out = np.empty((len(points), 7))
    over_range(_look, len(points), points, field, motion, out, fewest=ELEMENTS)
    return out


@njit
def _look(first, last, points, field, motion, out):  # type: ignore[no-untyped-def]
    shift = motion.shift
    for p in range(first, last):
        place = points[p, 0] - shift[0], points[p, 1] - shift[1], points[p, 2] - shift[2]
        out[p, 0], out[p, 1], out[p, 2], out[p, 3], out[p, 4], out[p, 5], out[p, 6] = surface_near(place, field, motion)
