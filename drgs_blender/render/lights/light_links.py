"""Light linking and shadow linking, as Blender's: which objects a light shines on, and which throw its shadow.

Objects that are lit by the same lights form a set. Each set has tables of its own lights alone (`light_sampler`), so
that nothing is drawn for lights that shine elsewhere; kernels choose them by the set of the surface at hand. Shadow
rays of lights with shadow linking have masks of their own (`scene.ray_masks`).

Kernels have a version of their own for `LinkedTables`. With `LightTables` the functions here do nothing, and are gone
from the machine code. Tables with groups (`light_groups`) hold either.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ...compute.jit import overload, plain
from ...core.frame import Light, MeshState, ObjectState
from ..memory import load_int32
from ..scene import ray_masks
from ..scene.trace_scene import TraceScene
from .light_sampler import Lights, LightTables
from .mesh_lights import Emitters, emitter_source

Array = np.ndarray

#: Sets of objects at most, as many as a shading point's flags can tell apart.
MOST_SETS = 31


class LinkedTables(NamedTuple):
    """`LightTables` of all sets, for compiled code; valid until the next update of the emitters' scene.

    Attributes
    ----------
    table, pick : array
        Those of the sets, one behind the other.
    spans : (sets, 4) int64 array
        First row and row behind the last of each set, in `table` and in `pick`.
    emitters : (sets,) int64 array
        As of `LightTables`.
    blockers : (k,) int32 array
        Mask of the shadow rays of each row of `table`; 0: those of other lights.
    receiver : (sources,) int64 array
        Set of each DR-GS object and mesh.
    emission : (sources,) int64 array
        Bit i: what the mesh emits shines on set i.
    emission_blockers : (sources,) int32 array
        As `blockers`, of what meshes emit.
    """

    table: Array
    pick: Array
    spans: Array
    emitters: Array
    blockers: Array
    receiver: Array
    emission: Array
    emission_blockers: Array


def link(
    lights: Lights,
    given: Sequence[Light],
    shapes: Sequence[ObjectState | MeshState],
    scene: TraceScene,
    sphere: tuple[Array, float],
) -> None:
    """Give `lights` the tables of each set in ``linked``, where a light or mesh has links; else None.

    Parameters
    ----------
    lights : Lights
        Of all.
    given : sequence of Light
        Blender's lights of the frame.
    shapes : sequence of (ObjectState or MeshState)
        Of the frame, in the order of the scene's sources.
    scene : TraceScene
    sphere : tuple
        Centre and radius of what they shine on.
    """
    sources: list[Light | MeshState] = [*given, *(shape for shape in shapes if isinstance(shape, MeshState))]
    if all(source.receivers < 0 and source.blockers < 0 for source in sources):
        return
    used = 0
    for source in sources:
        used |= 1 << source.receivers if source.receivers >= 0 else 0
    lit = [shape.visibility.lit_by & used for shape in shapes]
    values = sorted(set(lit))
    if len(values) > MOST_SETS:
        lights.warnings.append(f"light linking: {len(values)} objects are lit differently, {MOST_SETS} are possible")
        values = values[:MOST_SETS]
    receiver = [values.index(value) if value in values else 0 for value in lit]
    tables: list[Array] = []
    picks: list[Array] = []
    masks: list[Array] = []
    spans: list[list[int]] = []
    emitters: list[int] = []
    orders: list[Array] = []
    for value in values or [0]:
        which = [i for i, light in enumerate(given) if light.receivers < 0 or value >> light.receivers & 1]
        chosen = [given[i] for i in which]
        own = Lights(chosen, *sphere, Emitters(scene, receivers=value))
        lights.parts.append(own)
        spans.append([sum(len(t) for t in tables), 0, sum(len(p) for p in picks), 0])
        tables.append(own.table)
        picks.append(own.pick)
        masks.append(np.zeros(len(own.table), np.int32))
        orders.append(np.full(len(own.table), -1))
        orders[-1][: len(own.order)] = np.array(which, np.int64)[own.order]
        for row, index in enumerate(own.order):
            light = chosen[int(index)]
            masks[-1][row] = ray_masks.blocker_mask(light.blockers) if light.cast_shadow else 0
        spans[-1][1], spans[-1][3] = spans[-1][0] + len(own.table), spans[-1][2] + len(own.pick)
        emitters.append(own.emitters.address)
    emission, emission_blockers = np.zeros(len(shapes), np.int64), np.zeros(len(shapes), np.int32)
    for i, shape in enumerate(shapes):
        receivers, blockers = (shape.receivers, shape.blockers) if isinstance(shape, MeshState) else (-1, -1)
        emission_blockers[i] = ray_masks.blocker_mask(blockers)
        for k, value in enumerate(values):
            emission[i] |= int(receivers < 0 or value >> receivers & 1) << k
    lights.linked_order = np.concatenate(orders)
    lights.linked = LinkedTables(
        plain(np.concatenate(tables)), plain(np.concatenate(picks)), np.array(spans, np.int64),
        np.array(emitters, np.int64), np.concatenate(masks), np.array(receiver, np.int64), emission, emission_blockers,
    )  # fmt: skip


def _is_linked(lights: Any) -> bool:
    return getattr(lights, "instance_class", None) is LinkedTables


def _has_tables(lights: Any) -> bool:
    """Whether a Numba type is one that holds `LightTables` or `LinkedTables` as ``tables``, as those with groups do."""
    return "tables" in getattr(lights, "fields", ())


def lights_of(lights, receiver):  # type: ignore[no-untyped-def]
    """`LightTables` of the lights that shine on a set.

    Parameters
    ----------
    lights : LightTables or LinkedTables
    receiver : float32
        The set.

    Returns
    -------
    LightTables
    """
    return lights


@overload(lights_of)
def _lights_of(lights, receiver):  # type: ignore[no-untyped-def]
    if _has_tables(lights):
        return lambda lights, receiver: lights_of(lights.tables, receiver)
    if not _is_linked(lights):
        return lambda lights, receiver: lights

    def chosen(lights, receiver):  # type: ignore[no-untyped-def]
        k = np.int64(receiver)
        a, b, c, d = lights.spans[k, 0], lights.spans[k, 1], lights.spans[k, 2], lights.spans[k, 3]
        return LightTables(lights.table[a:b], lights.pick[c:d], lights.emitters[k])

    return chosen


def blockers_of(lights, receiver, index):  # type: ignore[no-untyped-def]
    """Mask of the shadow rays of a light that has its own; 0 for others.

    Parameters
    ----------
    lights : LightTables or LinkedTables
    receiver : float32
        The set.
    index : int64
        As `sample_light` returns it.

    Returns
    -------
    int32
    """
    return np.int32(0)


@overload(blockers_of)
def _blockers_of(lights, receiver, index):  # type: ignore[no-untyped-def]
    if _has_tables(lights):
        return lambda lights, receiver, index: blockers_of(lights.tables, receiver, index)
    if not _is_linked(lights):
        return lambda lights, receiver, index: np.int32(0)

    def found(lights, receiver, index):  # type: ignore[no-untyped-def]
        k = np.int64(receiver)
        first, past = lights.spans[k, 0], lights.spans[k, 1]
        if index < past - first:
            return lights.blockers[first + index]
        return lights.emission_blockers[emitter_source(index - (past - first), lights.emitters[k])]

    return found


def emits_to(lights, receiver, hit, geometry):  # type: ignore[no-untyped-def]
    """Whether a ray that meets a surface brings what it emits to a set.

    Parameters
    ----------
    lights : LightTables or LinkedTables
    receiver : float32
        The set.
    hit : Hit
        Of the ray.
    geometry : Geometry
        The scene's.

    Returns
    -------
    bool
    """
    return True


@overload(emits_to)
def _emits_to(lights, receiver, hit, geometry):  # type: ignore[no-untyped-def]
    if _has_tables(lights):
        return lambda lights, receiver, hit, geometry: emits_to(lights.tables, receiver, hit, geometry)
    if not _is_linked(lights):
        return lambda lights, receiver, hit, geometry: True

    def found(lights, receiver, hit, geometry):  # type: ignore[no-untyped-def]
        if hit.face < 0:
            return False
        source = load_int32(geometry.face_object, np.int64(hit.face))
        return lights.emission[source] >> np.int64(receiver) & 1 != 0

    return found


def set_of(lights, face, owner, geometry):  # type: ignore[no-untyped-def]
    """Set of a surface that a ray met.

    Parameters
    ----------
    lights : LightTables or LinkedTables
    face : int32
        Of the scene; negative: of surfels.
    owner : int32
        The object of the surfels.
    geometry : Geometry
        The scene's.

    Returns
    -------
    float32
    """
    return np.float32(0.0)


@overload(set_of)
def _set_of(lights, face, owner, geometry):  # type: ignore[no-untyped-def]
    if _has_tables(lights):
        return lambda lights, face, owner, geometry: set_of(lights.tables, face, owner, geometry)
    if not _is_linked(lights):
        return lambda lights, face, owner, geometry: np.float32(0.0)

    def found(lights, face, owner, geometry):  # type: ignore[no-untyped-def]
        source = owner if face < 0 else load_int32(geometry.face_object, np.int64(face))
        return np.float32(lights.receiver[source])

    return found
