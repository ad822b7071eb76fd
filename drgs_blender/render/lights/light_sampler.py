"""All lights but the environment, Blender's and meshes': importance sampling of one, its pdf, lights that rays meet.

`light_tree` picks the light to sample from a point, `light_shapes` is one light, `mesh_lights` are emitting surfaces.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...compute.jit import njit, plain
from ...core.errors import first_of
from ...core.frame import Light
from ..sampling import ONE, ZERO, F, U
from ..scene.interaction import emitted
from .light_shapes import (
    BARE_SUN,
    BOUND,
    CAMERA,
    DIFFUSE,
    FLAGS,
    GLOSSY,
    INTENSITY,
    KIND,
    PLACE,
    RADIANCE,
    WIDTH,
    light_direction,
    light_emission,
    light_hit,
    light_pdf,
    light_row,
)
from .light_tree import (
    END,
    FIRST,
    PAST,
    SUNS,
    build,
    is_sun,
    leaf_along,
    lights_weight,
    pick_light,
    pick_probability,
)
from .mesh_lights import Emitters, emitter_bits, emitter_pdf, emitter_row, emitters_luminance, sample_emitter

Array = np.ndarray


class LightTables(NamedTuple):
    """All lights, for compiled code; valid until the next update of the emitters' scene.

    Attributes
    ----------
    table : (k, WIDTH) float32 array
        `Lights.table`.
    pick : (m, 16) float32 array
        `Lights.pick`.
    emitters : int
        Address of the tables of `mesh_lights.Emitters`; 0: there are none.
    """

    table: Array
    pick: Array
    emitters: int


class Lights:
    """Lights made ready for compiled code.

    Parameters
    ----------
    lights : list of Light
        Blender's lights of one frame.
    centre : array, optional
        Of a sphere around what they shine on, world space; only for `power`.
    radius : float
        Of that sphere.
    emitters : Emitters, optional
        Surfaces that emit light; those that are not among them are found by chance alone.

    Attributes
    ----------
    table : (k, WIDTH) float32 array
        One light a row, in the order of the tree, suns last; k >= 1 (a black one when there is none).
    pick : (m, 16) float32 array
        The tree, see the columns above.
    order : (count,) int array
        Which of `lights` each row is.
    count : int
        Lights that shine, and triangles.
    power : float
        Estimated luminance that arrives at the sphere from all directions together (cd / m^2 sr), as the integral
        of an environment over all directions is.
    rays_differ : bool
        Whether diffuse and glossy rays see different lights.
    seen : bool
        Whether the camera sees a light.
    warnings : list of str
        Lights that are left out, and why.
    linked : LinkedTables, optional
        What each set of objects gets, where lights are linked (`light_links`); then kernels take it for ``tables``.
    linked_order : (rows,) int array
        Which of `lights` each row of ``linked`` is; -1 for a black one.
    grouped : GroupedTables, optional
        With the groups, where a frame asks for the light of groups (`light_groups`); then kernels take it.
    parts : list of Lights
        Those of the sets, which keep its memory.
    """

    def __init__(
        self,
        lights: list[Light],
        centre: Array | None = None,
        radius: float = 1.0,
        emitters: Emitters | None = None,
    ) -> None:
        self.emitters = emitters or _NO_EMITTERS
        self.linked: Any = None
        self.linked_order: Array = np.empty(0, np.int64)
        self.grouped: Any = None
        self.parts: list[Lights] = []
        rows: list[Array] = []
        kept: list[int] = []
        left_out: dict[str, list[str]] = {}
        for i, light in enumerate(lights):
            row = light_row(light)
            if isinstance(row, str):
                left_out.setdefault(row, []).append(repr(light.name))
            else:
                rows.append(row)
                kept.append(i)
        self.warnings: list[str] = []
        for why, names in left_out.items():
            which = f"light {names[0]} is" if len(names) == 1 else f"{len(names)} lights ({first_of(names)}) are each"
            self.warnings.append(f"{which} left out: {why}")
        self.warnings += self.emitters.warnings
        self.count = len(rows) + self.emitters.count
        table = np.array(rows, np.float32).reshape(-1, WIDTH)
        order, self.pick = build(table)
        self.table = table[order] if rows else np.zeros((1, WIDTH), np.float32)
        self.order = np.array(kept, np.int64)[order]
        middle = np.zeros(3) if centre is None else np.asarray(centre, np.float64)
        self.power = self._power(middle, radius) + self.emitters.power(middle, radius)
        flags = self.table[:, FLAGS].astype(int)
        self.rays_differ = bool(((flags >> 1 ^ flags >> 2) & 1).any()) or self.emitters.rays_differ
        self.seen = bool((flags & CAMERA).any())

    @property
    def tables(self) -> LightTables:
        """Light tables for compiled code; until the next update of the emitters' scene."""
        return LightTables(self.table, self.pick, self.emitters.address)

    def sample(self, numbers: Array, points: Array) -> tuple[Array, Array, Array, Array, Array]:
        """``sample_light`` for (n, 3) uint32 and (n, 3) or (3,) points.

        Returns
        -------
        directions : (n, 3) array
        distances : (n,) array
        radiance : (n, 3) array
        densities : (n,) array
        rows : (n,) array
        """
        numbers = np.ascontiguousarray(numbers, np.uint32)
        out, rows = _sample_many(numbers, _rows(points, numbers), self.tables)
        return out[:, :3], out[:, 3], out[:, 4:7], out[:, 7], rows

    def pdf(self, rows: Array, points: Array, directions: Array) -> Array:
        """(n,) ``pdf_light`` of table rows (n,) for (n, 3) unit directions at (n, 3) or (3,) points."""
        directions = np.ascontiguousarray(directions, np.float32)
        rows = plain(np.broadcast_to(np.asarray(rows, np.int64), len(directions)))
        return _pdf_many(rows, _rows(points, directions), directions, self.tables)

    def along(
        self,
        origins: Array,
        directions: Array,
        others: Array | float = 1.0,
        share: float = 0.0,
        seen_by: int = DIFFUSE,
        tmax: float = np.inf,
    ) -> Array:
        """(n, 3) ``lights_along`` for (n, 3) unit directions from (n, 3) or (3,) origins."""
        directions = np.ascontiguousarray(directions, np.float32)
        others = plain(np.broadcast_to(np.asarray(others, np.float32), len(directions)))
        return _along_many(_rows(origins, directions), directions, F(tmax), others, F(share), seen_by, self.tables)

    def _power(self, centre: Array, radius: float) -> float:
        table = self.table.astype(np.float64)
        square = np.sum((table[:, PLACE : PLACE + 3] - centre) ** 2, axis=1)
        square = np.maximum(np.maximum(square, table[:, BOUND] ** 2), max(float(radius), 1e-9) ** 2)
        return float(np.sum(table[:, INTENSITY] / np.where(is_sun(table), 1.0, square)))


def _rows(values: Array, like: Array) -> Array:
    """float32 rows, one broadcast to as many as `like` has."""
    values = np.asarray(values, np.float32)
    return plain(np.broadcast_to(values, (len(like), 3)))


_NO_EMITTERS = Emitters()


@njit
def _emitters_share(px, py, pz, lights):  # type: ignore[no-untyped-def]
    """How often surfaces are sampled from a point, rather than lights; float64."""
    table, pick, emitters = lights
    if emitters == 0:
        return 0.0
    if pick[0, END] == ZERO:
        return 1.0
    own = emitters_luminance(px, py, pz, emitters)
    both = own + np.float64(lights_weight(px, py, pz, table, pick))
    return own / both if both > 0.0 else 0.0


@njit
def sample_light(n0, n1, n2, px, py, pz, lights):  # type: ignore[no-untyped-def]
    """Light sampling: a direction from a point towards one of the lights or emitting triangles (PBRT 12.6).

    Parameters
    ----------
    n0, n1, n2 : uint32
        Random numbers: the pick, the place on the light.
    px, py, pz : float32
        Point, world, m.
    lights : LightTables

    Returns
    -------
    lx, ly, lz : float32
        Unit, world.
    distance : float32
        To the light, m; infinite for suns.
    r, g, b : float32
        Radiance, linear Rec.709; 0 when the light sends nothing here.
    pdf : float32
        Per solid angle times the probability of the pick, sr^-1; 0 when the light sends nothing here. Negative for a
        light that no other strategy finds, one without size: it adds f cos rgb / |pdf| without a MIS weight.
    index : int64
        Row of the table or, behind those, of the emitters; -1 for none.
    """
    table, pick, emitters = lights
    share = _emitters_share(px, py, pz, lights)
    if share > 0.0:
        rest = np.float64(n0) * (1.0 / 4294967296.0)
        if rest < share:
            lx, ly, lz, t, r, g, b, pdf, i = sample_emitter(rest / share, n1, n2, px, py, pz, emitters)
            return lx, ly, lz, t, r, g, b, pdf * F(share), i + len(table) if i >= 0 else i
        n0 = U(np.int64(min((rest - share) / (1.0 - share), 1.0) * 4294967295.0))
    i, probability = pick_light(n0, px, py, pz, table, pick)
    probability *= F(1.0 - share)
    if i < 0:
        return ZERO, ZERO, ONE, ZERO, ZERO, ZERO, ZERO, ZERO, np.int64(-1)
    lx, ly, lz, t = light_direction(i, n1, n2, px, py, pz, table)
    if not t >= ZERO:
        return ZERO, ZERO, ONE, ZERO, ZERO, ZERO, ZERO, ZERO, i
    bare = table[i, KIND] <= F(BARE_SUN)
    if bare:
        pdf = -probability
    else:
        pdf = probability * light_pdf(i, px, py, pz, lx, ly, lz, t, table)
    part = light_emission(i, lx, ly, lz, table)
    if bare and table[i, KIND] != F(BARE_SUN):
        part /= t * t
    r, g, b = part * table[i, RADIANCE], part * table[i, RADIANCE + 1], part * table[i, RADIANCE + 2]
    if not (r + g + b < F(np.inf) and abs(pdf) > ZERO and abs(pdf) < F(np.inf)):
        return lx, ly, lz, t, ZERO, ZERO, ZERO, ZERO, i
    return lx, ly, lz, t, r, g, b, pdf, i


@njit
def light_flags(index, lights):  # type: ignore[no-untyped-def]
    """Bits CAMERA, DIFFUSE, GLOSSY (rays that see it), SHADOW (things block it) and ABSENT of what was sampled.

    Parameters
    ----------
    index : int64
        As `sample_light` returns it.
    lights : LightTables

    Returns
    -------
    int64
    """
    table, _, emitters = lights
    if index >= len(table):
        return emitter_bits(index - len(table), emitters)
    return np.int64(table[index, FLAGS])


@njit
def pdf_light(index, px, py, pz, lx, ly, lz, lights):  # type: ignore[no-untyped-def]
    """Density per solid angle, pick included, with which ``sample_light`` draws this unit direction by this light.

    0 where the light sends nothing from there: the density of samples whose radiance is not 0. 0 for lights without
    size.

    Parameters
    ----------
    index : int64
        Row of the table.
    px, py, pz : float32
        Point, world, m.
    lx, ly, lz : float32
        Direction from it, unit, world.
    lights : LightTables

    Returns
    -------
    float32
        sr^-1.
    """
    table = lights.table
    t = light_hit(index, px, py, pz, lx, ly, lz, table)
    if not (t >= ZERO and light_emission(index, lx, ly, lz, table) > ZERO):
        return ZERO
    density = light_pdf(index, px, py, pz, lx, ly, lz, t, table)
    if not density > ZERO:
        return ZERO
    return density * _probability(index, px, py, pz, lights)


@njit
def _probability(index, px, py, pz, lights):  # type: ignore[no-untyped-def]
    """With which a light is picked."""
    share = F(1.0 - _emitters_share(px, py, pz, lights))
    return share * pick_probability(index, px, py, pz, lights.table, lights.pick)


@njit
def emission_along(origin, direction, hit, geometry, lights):  # type: ignore[no-untyped-def]
    """Emission of the surface that a ray meets, and its pdf by ``sample_light``.

    Parameters
    ----------
    origin, direction : tuple of float
        World, m; the direction is of unit length.
    hit : Hit
        Result of ``scene.interaction.nearest``.
    geometry : Geometry
        The scene's.
    lights : LightTables

    Returns
    -------
    r, g, b : float32
        Radiance, linear Rec.709; 0 without a hit.
    diffuse, glossy : float32
        Pdf per solid angle, pick included, sr^-1, with which ``sample_light`` draws this direction by this surface, for
        either lobe.
    """
    if hit.face < 0:
        return ZERO, ZERO, ZERO, ZERO, ZERO
    r, g, b = emitted(hit.face, hit.u, hit.v, geometry)
    if not r + g + b > ZERO:
        return ZERO, ZERO, ZERO, ZERO, ZERO
    i = emitter_row(hit.face, hit.instance, lights.emitters)
    if i < 0:
        return r, g, b, ZERO, ZERO
    ox, oy, oz = origin
    dx, dy, dz = direction
    pdf = emitter_pdf(i, ox, oy, oz, dx, dy, dz, hit.t, lights.emitters)
    pdf *= F(_emitters_share(ox, oy, oz, lights))
    flags = light_flags(len(lights.table) + i, lights)
    return r, g, b, pdf if flags & DIFFUSE else ZERO, pdf if flags & GLOSSY else ZERO


@njit
def light_along(i, origin, direction, tmax, others, share, seen_by, lights):  # type: ignore[no-untyped-def]
    """`lights_along` of the light in one row of the table.

    Parameters
    ----------
    i : int64
    origin, direction, tmax, others, share, seen_by, lights : tuple, float32, int64 or LightTables
        As of `lights_along`.

    Returns
    -------
    r, g, b : float32
    """
    table = lights.table
    flags = np.int64(table[i, FLAGS])
    if not flags & seen_by:
        return ZERO, ZERO, ZERO
    ox, oy, oz = origin
    dx, dy, dz = direction
    t = light_hit(i, ox, oy, oz, dx, dy, dz, table)
    if not (t >= ZERO and (t < tmax or t == tmax == F(np.inf))):
        return ZERO, ZERO, ZERO
    weight = light_emission(i, dx, dy, dz, table)
    if not weight > ZERO:
        return ZERO, ZERO, ZERO
    if share > ZERO:
        density = light_pdf(i, ox, oy, oz, dx, dy, dz, t, table)
        weight /= others + share * density * _probability(i, ox, oy, oz, lights)
    else:
        weight /= others
    return weight * table[i, RADIANCE], weight * table[i, RADIANCE + 1], weight * table[i, RADIANCE + 2]


@njit
def lights_along(origin, direction, tmax, others, share, seen_by, lights):  # type: ignore[no-untyped-def]
    """Lights with size that a ray meets, with MIS weight over pdf: the sum of L / (others + share * pick * density).

    Parameters
    ----------
    origin, direction : tuple of float
        World, m; the direction is of unit length.
    tmax : float32
        Distance of the surface behind, m; infinite when none.
    others : float32
        Sum over all other strategies of count times pdf in this direction, sr^-1; must be positive.
    share : float32
        Number of light samples that the balance heuristic reckons with; 0 leaves them out.
    seen_by : int64
        CAMERA, DIFFUSE or GLOSSY: lights that such rays do not see are left out.
    lights : LightTables

    Returns
    -------
    r, g, b : float32
        Linear Rec.709, not shadowed.
    """
    pick = lights.pick
    red, green, blue = ZERO, ZERO, ZERO
    node = np.int64(0)
    while node >= 0:
        node = leaf_along(node + 1, origin, direction, tmax, pick)
        if node > 0:
            for i in range(np.int64(pick[node, FIRST]), np.int64(pick[node, PAST])):
                r, g, b = light_along(i, origin, direction, tmax, others, share, seen_by, lights)
                red, green, blue = red + r, green + g, blue + b
    r, g, b = suns_along(origin, direction, tmax, others, share, seen_by, lights)
    return red + r, green + g, blue + b


@njit
def suns_along(origin, direction, tmax, others, share, seen_by, lights):  # type: ignore[no-untyped-def]
    """`lights_along` of suns alone.

    Parameters
    ----------
    origin, direction, tmax, others, share, seen_by, lights : tuple, float32, int64 or LightTables
        As of `lights_along`.

    Returns
    -------
    r, g, b : float32
    """
    pick = lights.pick
    red, green, blue = ZERO, ZERO, ZERO
    for i in range(np.int64(pick[0, SUNS]), np.int64(pick[0, END])):
        r, g, b = light_along(i, origin, direction, tmax, others, share, seen_by, lights)
        red, green, blue = red + r, green + g, blue + b
    return red, green, blue


@njit
def _sample_many(numbers, points, lights):  # type: ignore[no-untyped-def]
    out, rows = np.empty((len(numbers), 8), np.float32), np.empty(len(numbers), np.int64)
    for j in range(len(numbers)):
        lx, ly, lz, t, r, g, b, pdf, i = sample_light(
            numbers[j, 0], numbers[j, 1], numbers[j, 2], points[j, 0], points[j, 1], points[j, 2], lights
        )
        out[j, 0], out[j, 1], out[j, 2], out[j, 3] = lx, ly, lz, t
        out[j, 4], out[j, 5], out[j, 6], out[j, 7] = r, g, b, pdf
        rows[j] = i
    return out, rows


@njit
def _pdf_many(rows, points, directions, lights):  # type: ignore[no-untyped-def]
    out = np.empty(len(points), np.float32)
    for j in range(len(points)):
        out[j] = pdf_light(
            rows[j], points[j, 0], points[j, 1], points[j, 2], directions[j, 0], directions[j, 1], directions[j, 2],
            lights,
        )  # fmt: skip
    return out


@njit
def _along_many(origins, directions, tmax, others, share, seen_by, lights):  # type: ignore[no-untyped-def]
    out = np.empty((len(origins), 3), np.float32)
    for j in range(len(origins)):
        origin = origins[j, 0], origins[j, 1], origins[j, 2]
        direction = directions[j, 0], directions[j, 1], directions[j, 2]
        out[j, 0], out[j, 1], out[j, 2] = lights_along(origin, direction, tmax, others[j], share, seen_by, lights)
    return out
