"""The shape of one of Blender's lights: from its panel to radiance as in Cycles, sampling, pdf and intersection.

A light is a row of a float32 table. What it sends towards a point is written per solid angle at that point, so a light
is a set of directions, a radiance for each, and a pdf with which `light_direction` draws them. The conversions were
measured in Cycles of Blender 5.0.1 (see docs/rendering.md).
"""

from __future__ import annotations

import math
from typing import get_args

import numpy as np

from ...compute.jit import njit
from ...core.color import LUMINANCE
from ...core.frame import Light, LightKind
from ..sampling import HALF, ONE, PI, TWO, ZERO, F, basis, sincos_turns, unit
from .environment import BRIGHTEST

Array = np.ndarray

#: Columns of the table. PLACE is the position, or of suns the direction towards them; AXIS is the direction in which
#: the light shines; U and V are an area's unit axes, of spots axes scaled so that their cone is round.
KIND, PLACE, RADIUS, RADIANCE, AXIS, U_AXIS, V_AXIS, HALF_U, HALF_V = 0, 1, 4, 5, 8, 11, 14, 17, 18
#: tan(spread / 2) and the factor that keeps the power, 0 without spread; cosine of a spot's cone and 1 / its soft part.
SPREAD_TAN, SPREAD_SCALE, CONE_COS, CONE_SCALE = 19, 20, 21, 22
#: Bits below; luminous intensity along the axis (of suns irradiance); radius around PLACE; cosine of the angle from
#: AXIS beyond which nothing is sent; luminous flux (of suns unused).
FLAGS, INTENSITY, BOUND, REACH_COS, FLUX = 23, 24, 25, 26, 27
WIDTH = 28

#: Kinds. A soft point is a disk that faces the shading point; rays do not hit the two without size.
BARE_POINT, BARE_SUN, SOFT_POINT, SPHERE, SUN, RECTANGLE, ELLIPSE = range(7)

#: Bits of FLAGS: rays that see the light, and whether things block it.
CAMERA, DIFFUSE, GLOSSY, SHADOW = 1, 2, 4, 8

#: Smaller radii (metres, radians) are points; Cycles' parallel area light (spread 0) gets this spread, in radians.
_LEAST_RADIUS, _LEAST_ANGLE, _LEAST_SPREAD = 1e-6, 1e-5, 1e-3
_FAR = F(np.inf)
_TINY = F(1e-30)
#: Windows whose diagonal is below a tenth of their distance are sampled by area.
_NEAR = F(100.0)


def light_row(light: Light) -> Array | str:
    """(WIDTH,) float32 row of a light, or in words why it gives no light."""
    matrix = np.asarray(light.matrix_world, np.float64).reshape(4, 4)
    colour = np.maximum(np.asarray(light.colour, np.float64), 0.0) * float(light.power)
    shape = (light.radius, light.angle, light.spot_size, light.spot_blend, light.size_x, light.size_y, light.spread)
    if not (np.isfinite(matrix).all() and np.isfinite(colour).all() and np.isfinite(shape).all()):
        return "a setting is not finite"
    if light.kind not in (kinds := get_args(LightKind)):
        return f"its kind {light.kind!r} is none of {', '.join(kinds)}"
    if light.power < 0:
        return "its power is negative"
    if not colour.max() > 0:
        return "its power or colour is zero"
    columns = matrix[:3, :3].T
    lengths = np.linalg.norm(columns, axis=1)
    row = np.zeros(WIDTH)
    row[PLACE : PLACE + 3] = matrix[:3, 3]
    row[CONE_COS], row[REACH_COS] = -2.0, -1.0
    row[FLAGS] = CAMERA * light.camera + DIFFUSE * light.diffuse + GLOSSY * light.glossy
    row[FLAGS] += SHADOW * light.cast_shadow
    if light.kind != "point":
        if not lengths[2] > 0:
            return "its scale is zero"
        row[AXIS : AXIS + 3] = -columns[2] / lengths[2]
    radiance: float | None
    if light.kind == "sun":
        radiance = _sun(row, light)
    elif light.kind == "area":
        radiance = _area(row, light, columns, lengths)
    else:
        radiance = _point(row, light)
        if light.kind == "spot":
            if not lengths.min() > 0:
                return "its scale is zero"
            if not light.spot_size > 0:
                return "its cone is closed"
            _cone(row, light, columns, lengths)
    if radiance is None:
        return "its size or scale is zero"
    row[RADIANCE : RADIANCE + 3] = radiance * colour
    row[INTENSITY] *= radiance * float(colour @ np.array(LUMINANCE))
    row[FLUX] *= radiance * float(colour @ np.array(LUMINANCE))
    with np.errstate(over="ignore"):
        row32 = row.astype(np.float32)
    usable = np.isfinite(row32).all() and (row32[RADIANCE : RADIANCE + 3] <= BRIGHTEST).all()
    return row32 if usable else "it is too bright or too far away"


def _sun(row: Array, light: Light) -> float:
    """Power is irradiance on a surface that faces the sun; not normalised, it is the sun's radiance."""
    half = min(0.5 * abs(light.angle), 0.5 * math.pi)
    row[PLACE : PLACE + 3] = -row[AXIS : AXIS + 3]
    row[INTENSITY] = 1.0
    if half < _LEAST_ANGLE:
        row[KIND] = BARE_SUN
        return 1.0
    projected = math.pi * math.sin(half) ** 2
    row[KIND], row[RADIUS], row[INTENSITY] = SUN, 2.0 * math.sin(0.5 * half) ** 2, projected
    return 1.0 / projected if light.normalize else 1.0


def _point(row: Array, light: Light) -> float:
    """Intensity is power / 4 pi, spread over the disk of the radius. The object's scale does not count."""
    radius = abs(light.radius)
    row[INTENSITY], row[FLUX] = 1.0, 4.0 * math.pi
    if radius < _LEAST_RADIUS:
        row[KIND] = BARE_POINT
        return 1.0 / (4.0 * math.pi) if light.normalize else 1.0 / math.pi
    disk = math.pi * radius**2
    row[KIND], row[RADIUS] = SOFT_POINT if light.soft_falloff else SPHERE, radius
    row[BOUND], row[INTENSITY], row[FLUX] = radius, disk, 4.0 * math.pi * disk
    return 1.0 / (4.0 * math.pi * disk) if light.normalize else 1.0 / math.pi


def _cone(row: Array, light: Light, columns: Array, lengths: Array) -> None:
    """A smooth step in the cosine, from the cone's edge inwards; the object's scale stretches the cone."""
    half = min(max(0.5 * light.spot_size, 0.0), 0.5 * math.pi)
    row[CONE_COS] = math.cos(half)
    row[CONE_SCALE] = 1.0 / max((1.0 - math.cos(half)) * light.spot_blend, 1e-8)
    stretch = lengths[:2] / lengths[2]
    for column, axis, factor in zip((U_AXIS, V_AXIS), columns[:2] / lengths[:2, None], stretch, strict=True):
        row[column : column + 3] = axis / factor
    row[FLUX] *= 0.5 * (1.0 - math.cos(half)) * float(stretch.prod())
    row[REACH_COS] = math.cos(math.atan2(math.sin(half) * stretch.max(), math.cos(half)))


def _area(row: Array, light: Light, columns: Array, lengths: Array) -> float | None:
    """A Lambertian emitter of the given power, on one side; not normalised, it is one of 1 square metre."""
    extent_u = light.size_x
    extent_v = light.size_y if light.shape in ("rectangle", "ellipse") else light.size_x
    normal = np.cross(columns[0], columns[1])
    sides = float(np.linalg.norm(normal))
    if not sides * abs(extent_u * extent_v) > 1e-18:
        return None
    u, normal = columns[0] / lengths[0], normal / sides * (-1.0 if normal @ columns[2] > 0 else 1.0)
    half_u, half_v = 0.5 * abs(extent_u) * lengths[0], 0.5 * abs(extent_v) * sides / lengths[0]
    row[AXIS : AXIS + 3], row[U_AXIS : U_AXIS + 3], row[V_AXIS : V_AXIS + 3] = normal, u, np.cross(normal, u)
    row[HALF_U], row[HALF_V] = half_u, half_v
    round_ = light.shape in ("disk", "ellipse")
    row[KIND], row[BOUND] = (ELLIPSE, max(half_u, half_v)) if round_ else (RECTANGLE, math.hypot(half_u, half_v))
    area = (math.pi if round_ else 4.0) * half_u * half_v
    row[INTENSITY], row[FLUX], row[REACH_COS] = area, math.pi * area, 0.0
    if light.spread < math.pi - 1e-6:
        half = 0.5 * max(light.spread, _LEAST_SPREAD)
        row[SPREAD_TAN], row[REACH_COS] = math.tan(half), math.cos(half)
        row[SPREAD_SCALE] = 3.0 / half**3 if half < 0.05 else 1.0 / (math.tan(half) - half)
        row[INTENSITY] *= row[SPREAD_TAN] * row[SPREAD_SCALE]
    return 1.0 / (math.pi * area) if light.normalize else 1.0 / math.pi


@njit
def light_emission(i, lx, ly, lz, table):  # type: ignore[no-untyped-def]
    """Share of its radiance that a light sends along a direction: a spot's cone, an area light's spread; else 1.

    Parameters
    ----------
    i : int64
        Row of the table.
    lx, ly, lz : float32
        Direction towards the light, unit, world.
    table : (k, WIDTH) float32 array
        `Lights.table`.

    Returns
    -------
    float32
        In [0, 1], with spread also above, as the power stays.
    """
    if table[i, CONE_COS] > -ONE:
        w = -(lx * table[i, AXIS] + ly * table[i, AXIS + 1] + lz * table[i, AXIS + 2])
        u = lx * table[i, U_AXIS] + ly * table[i, U_AXIS + 1] + lz * table[i, U_AXIS + 2]
        v = lx * table[i, V_AXIS] + ly * table[i, V_AXIS + 1] + lz * table[i, V_AXIS + 2]
        x = (w / math.sqrt(max(u * u + v * v + w * w, _TINY)) - table[i, CONE_COS]) * table[i, CONE_SCALE]
        x = min(max(x, ZERO), ONE)
        return x * x * (F(3.0) - TWO * x)
    if table[i, SPREAD_TAN] > ZERO:
        w = -(lx * table[i, AXIS] + ly * table[i, AXIS + 1] + lz * table[i, AXIS + 2])
        u = lx * table[i, U_AXIS] + ly * table[i, U_AXIS + 1] + lz * table[i, U_AXIS + 2]
        v = lx * table[i, V_AXIS] + ly * table[i, V_AXIS + 1] + lz * table[i, V_AXIS + 2]
        if not w > ZERO:
            return ZERO
        return max(ZERO, table[i, SPREAD_TAN] - math.sqrt(u * u + v * v) / w) * table[i, SPREAD_SCALE]
    return ONE


@njit
def light_hit(i, ox, oy, oz, dx, dy, dz, table):  # type: ignore[no-untyped-def]
    """Intersection of a ray with a light.

    Parameters
    ----------
    i : int64
        Row of the table.
    ox, oy, oz : float32
        Origin, world, m.
    dx, dy, dz : float32
        Direction, unit, world.
    table : (k, WIDTH) float32 array
        `Lights.table`.

    Returns
    -------
    float32
        Distance, m, infinite for suns; -1 when the ray does not meet the light.
    """
    kind = np.int32(table[i, KIND])
    if kind <= BARE_SUN:
        return -ONE
    if kind == SUN:
        x, y, z = dx - table[i, PLACE], dy - table[i, PLACE + 1], dz - table[i, PLACE + 2]
        return _FAR if x * x + y * y + z * z <= TWO * table[i, RADIUS] else -ONE
    x, y, z = table[i, PLACE] - ox, table[i, PLACE + 1] - oy, table[i, PLACE + 2] - oz
    if kind >= RECTANGLE:
        slope = dx * table[i, AXIS] + dy * table[i, AXIS + 1] + dz * table[i, AXIS + 2]
        height = x * table[i, AXIS] + y * table[i, AXIS + 1] + z * table[i, AXIS + 2]
        if not (slope < ZERO and height < ZERO):
            return -ONE
        t = height / slope
        x, y, z = t * dx - x, t * dy - y, t * dz - z
        u = (x * table[i, U_AXIS] + y * table[i, U_AXIS + 1] + z * table[i, U_AXIS + 2]) / table[i, HALF_U]
        v = (x * table[i, V_AXIS] + y * table[i, V_AXIS + 1] + z * table[i, V_AXIS + 2]) / table[i, HALF_V]
        inside = u * u + v * v <= ONE if kind == ELLIPSE else max(abs(u), abs(v)) <= ONE
        return t if inside else -ONE
    square = x * x + y * y + z * z
    along = x * dx + y * dy + z * dz
    r2 = table[i, RADIUS] * table[i, RADIUS]
    if kind == SOFT_POINT:
        if not along > ZERO:
            return -ONE
        t = square / along
        x, y, z = t * dx - x, t * dy - y, t * dz - z
        return t if x * x + y * y + z * z <= r2 else -ONE
    ax, ay, az = x - along * dx, y - along * dy, z - along * dz
    left = r2 - (ax * ax + ay * ay + az * az)
    if left < ZERO:
        return -ONE
    if square <= r2:
        return along + math.sqrt(left)
    return along - math.sqrt(left) if along > ZERO else -ONE


@njit
def _cone_width(square, r2):  # type: ignore[no-untyped-def]
    """1 - cos of the half angle under which a sphere is seen from outside, without cancellation."""
    sin2 = min(r2 / square, ONE)
    return sin2 / (ONE + math.sqrt(ONE - sin2))


@njit
def _window(i, px, py, pz, table):  # type: ignore[no-untyped-def]
    """Part of an area light's rectangle that is sampled from a point: (u0, u1, v0, v1, height, round, lit).

    Relative to the point's foot on the light's plane; with spread, no more than its cone can reach. When `round`, the
    whole ellipse is sampled instead.
    """
    x, y, z = px - table[i, PLACE], py - table[i, PLACE + 1], pz - table[i, PLACE + 2]
    u = x * table[i, U_AXIS] + y * table[i, U_AXIS + 1] + z * table[i, U_AXIS + 2]
    v = x * table[i, V_AXIS] + y * table[i, V_AXIS + 1] + z * table[i, V_AXIS + 2]
    height = x * table[i, AXIS] + y * table[i, AXIS + 1] + z * table[i, AXIS + 2]
    half_u, half_v = table[i, HALF_U], table[i, HALF_V]
    u0, u1, v0, v1 = -half_u - u, half_u - u, -half_v - v, half_v - v
    if table[i, SPREAD_TAN] > ZERO:
        reach = height * table[i, SPREAD_TAN]
        u0, u1, v0, v1 = max(u0, -reach), min(u1, reach), max(v0, -reach), min(v1, reach)
    whole = table[i, KIND] == F(ELLIPSE) and (u1 - u0) * (v1 - v0) > TWO * half_u * half_v
    return u0, u1, v0, v1, height, whole, height > ZERO and u1 > u0 and v1 > v0


@njit
def _is_near(u0, u1, v0, v1, height):  # type: ignore[no-untyped-def]
    """Whether a window is large enough, seen from the point, to be worth sampling by solid angle."""
    u, v = HALF * (u0 + u1), HALF * (v0 + v1)
    return _NEAR * ((u1 - u0) * (u1 - u0) + (v1 - v0) * (v1 - v0)) > u * u + v * v + height * height


@njit
def _solid_angle(u0, u1, v0, v1, height):  # type: ignore[no-untyped-def]
    """(solid angle, offset k, b0, b1) of a rectangle (Urena, Fajardo and King 2013); in double, as it cancels."""
    h2 = np.float64(height) * np.float64(height)
    b0 = -v0 / math.sqrt(h2 + np.float64(v0) * v0)
    n1 = u1 / math.sqrt(h2 + np.float64(u1) * u1)
    b1 = v1 / math.sqrt(h2 + np.float64(v1) * v1)
    n3 = -u0 / math.sqrt(h2 + np.float64(u0) * u0)
    k = 2.0 * math.pi - math.acos(-b1 * n3) - math.acos(-n3 * b0)
    return math.acos(-b0 * n1) + math.acos(-n1 * b1) - k, k, b0, b1


@njit
def _spherical_rectangle(a, b, u0, u1, v0, v1, height):  # type: ignore[no-untyped-def]
    """Point of a window, uniform in solid angle, from two numbers in [0, 1) (Urena, Fajardo and King 2013)."""
    solid, k, b0, b1 = _solid_angle(u0, u1, v0, v1, height)
    angle = a * solid + k
    f = (math.cos(angle) * b0 - b1) / math.sin(angle)
    c = math.copysign(1.0, f) / math.sqrt(f * f + b0 * b0)
    c = min(max(c, -1.0), 1.0)
    u = min(max(c * height / math.sqrt(max(1.0 - c * c, 1e-30)), u0), u1)
    d2 = u * u + np.float64(height) * height
    h0, h1 = v0 / math.sqrt(d2 + np.float64(v0) * v0), v1 / math.sqrt(d2 + np.float64(v1) * v1)
    h = h0 + b * (h1 - h0)
    return F(u), F(min(max(h * math.sqrt(d2 / max(1.0 - h * h, 1e-30)), v0), v1))


@njit
def light_pdf(i, px, py, pz, lx, ly, lz, t, table):  # type: ignore[no-untyped-def]
    """The pdf, density per solid angle, with which `light_direction` draws a direction that meets the light.

    Parameters
    ----------
    i : int64
        Row of the table.
    px, py, pz : float32
        Point, world, m.
    lx, ly, lz : float32
        Direction from it, unit, world.
    t : float32
        Distance at which it meets the light, see `light_hit`, m.
    table : (k, WIDTH) float32 array
        `Lights.table`.

    Returns
    -------
    float32
        sr^-1; 0 of lights without size.
    """
    kind = np.int32(table[i, KIND])
    if kind <= BARE_SUN:
        return ZERO
    if kind == SUN:
        return ONE / (TWO * PI * table[i, RADIUS])
    if kind >= RECTANGLE:
        u0, u1, v0, v1, height, whole, lit = _window(i, px, py, pz, table)
        if not lit:
            return ZERO
        if whole:
            area = PI * table[i, HALF_U] * table[i, HALF_V]
        elif _is_near(u0, u1, v0, v1, height):
            solid, _, _, _ = _solid_angle(u0, u1, v0, v1, height)
            return F(1.0 / max(solid, 1e-30))
        else:
            area = (u1 - u0) * (v1 - v0)
        # The cosine at the light is height / t.
        return t * t * t / (height * area)
    x, y, z = table[i, PLACE] - px, table[i, PLACE + 1] - py, table[i, PLACE + 2] - pz
    square = x * x + y * y + z * z
    r2 = table[i, RADIUS] * table[i, RADIUS]
    if kind == SOFT_POINT:
        return t * t * t / max(PI * r2 * math.sqrt(square), _TINY)
    if square <= r2:
        return F(0.25) / PI
    return ONE / (TWO * PI * _cone_width(square, r2))


@njit
def _about(x, y, z, width, a, b):  # type: ignore[no-untyped-def]
    """Direction uniform in the cone about a unit direction; `width` is 1 - cos of its half angle."""
    ux, uy, uz, vx, vy, vz = basis(x, y, z)
    low = a * width
    s, c = sincos_turns(b)
    r = math.sqrt(max(ZERO, low * (TWO - low)))
    s, c, w = r * s, r * c, ONE - low
    return c * ux + s * vx + w * x, c * uy + s * vy + w * y, c * uz + s * vz + w * z


@njit
def light_direction(i, n1, n2, px, py, pz, table):  # type: ignore[no-untyped-def]
    """Sample a direction towards a light.

    Parameters
    ----------
    i : int64
        Row of the table.
    n1, n2 : uint32
        Random numbers.
    px, py, pz : float32
        Point, world, m.
    table : (k, WIDTH) float32 array
        `Lights.table`.

    Returns
    -------
    lx, ly, lz : float32
        Unit, world.
    t : float32
        Distance, m, infinite for suns; -1 when the light sends nothing here.
    """
    kind = np.int32(table[i, KIND])
    a, b = unit(n1), unit(n2)
    x, y, z = table[i, PLACE], table[i, PLACE + 1], table[i, PLACE + 2]
    if kind == BARE_SUN:
        return x, y, z, _FAR
    if kind == SUN:
        x, y, z = _about(x, y, z, table[i, RADIUS], a, b)
        return x, y, z, _FAR
    x, y, z = x - px, y - py, z - pz
    if kind >= RECTANGLE:
        u0, u1, v0, v1, height, whole, lit = _window(i, px, py, pz, table)
        if not lit:
            return ZERO, ZERO, ONE, -ONE
        if whole:
            s, c = sincos_turns(b)
            r = math.sqrt(a)
            u = x * table[i, U_AXIS] + y * table[i, U_AXIS + 1] + z * table[i, U_AXIS + 2] + r * c * table[i, HALF_U]
            v = x * table[i, V_AXIS] + y * table[i, V_AXIS + 1] + z * table[i, V_AXIS + 2] + r * s * table[i, HALF_V]
        elif _is_near(u0, u1, v0, v1, height):
            u, v = _spherical_rectangle(a, b, u0, u1, v0, v1, height)
        else:
            u, v = u0 + a * (u1 - u0), v0 + b * (v1 - v0)
        if kind == ELLIPSE:
            # A window reaches beyond the ellipse.
            e = (u - (x * table[i, U_AXIS] + y * table[i, U_AXIS + 1] + z * table[i, U_AXIS + 2])) / table[i, HALF_U]
            f = (v - (x * table[i, V_AXIS] + y * table[i, V_AXIS + 1] + z * table[i, V_AXIS + 2])) / table[i, HALF_V]
            if e * e + f * f > F(1.00001):
                return ZERO, ZERO, ONE, -ONE
        x = u * table[i, U_AXIS] + v * table[i, V_AXIS] - height * table[i, AXIS]
        y = u * table[i, U_AXIS + 1] + v * table[i, V_AXIS + 1] - height * table[i, AXIS + 1]
        z = u * table[i, U_AXIS + 2] + v * table[i, V_AXIS + 2] - height * table[i, AXIS + 2]
        t = math.sqrt(x * x + y * y + z * z)
        return x / t, y / t, z / t, t
    square = x * x + y * y + z * z
    d = math.sqrt(square)
    r2 = table[i, RADIUS] * table[i, RADIUS]
    if kind == SPHERE and square <= r2:
        s, c = sincos_turns(b)
        w = ONE - TWO * a
        r = math.sqrt(max(ZERO, ONE - w * w))
        lx, ly, lz = r * c, r * s, w
        return lx, ly, lz, max(ZERO, light_hit(i, px, py, pz, lx, ly, lz, table))
    if not d > F(1e-15):
        return ZERO, ZERO, ONE, -ONE
    x, y, z = x / d, y / d, z / d
    if kind == BARE_POINT:
        return x, y, z, d
    if kind == SOFT_POINT:
        ux, uy, uz, vx, vy, vz = basis(x, y, z)
        s, c = sincos_turns(b)
        r = table[i, RADIUS] * math.sqrt(a)
        s, c = s * r, c * r
        x, y, z = d * x + c * ux + s * vx, d * y + c * uy + s * vy, d * z + c * uz + s * vz
        t = math.sqrt(x * x + y * y + z * z)
        return x / t, y / t, z / t, t
    lx, ly, lz = _about(x, y, z, _cone_width(square, r2), a, b)
    along = d * (x * lx + y * ly + z * lz)
    ax, ay, az = d * x - along * lx, d * y - along * ly, d * z - along * lz
    return lx, ly, lz, along - math.sqrt(max(ZERO, r2 - (ax * ax + ay * ay + az * az)))
