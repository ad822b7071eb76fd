"""Light groups, as Blender's: which group each lamp, each mesh that emits and the environment belong to.

Kernels have a version of their own for `GroupedTables`, which is made only for frames that ask for the light of groups;
directions and densities are those without groups. With other tables the functions here do nothing, and are gone from
the machine code.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ...compute.jit import overload
from ...core.frame import Light, MeshState, ObjectState
from ...core.passes import LIGHT_GROUP
from ..memory import load_int32
from .light_links import LinkedTables
from .light_sampler import Lights, LightTables
from .light_shapes import CAMERA, FLAGS
from .mesh_lights import emitter_source

Array = np.ndarray


class GroupedTables(NamedTuple):
    """`LightTables` or `LinkedTables` with the groups; the last group is that of all light that belongs to none.

    Attributes
    ----------
    tables : LightTables or LinkedTables
    lamps : (k,) int64 array
        Group of each row of the tables' `table`.
    emission : (sources,) int64 array
        Group of what each source emits.
    environment : int
        Group of the environment.
    number : int
        Of groups, the last one included.
    """

    tables: Any
    lamps: Array
    emission: Array
    environment: int
    number: int


def groups_of(passes: Sequence[str]) -> list[str]:
    """Names of the light groups whose light is among some passes."""
    return [name.removeprefix(LIGHT_GROUP) for name in passes if name.startswith(LIGHT_GROUP)]


def group(
    lights: Lights,
    given: Sequence[Light],
    shapes: Sequence[ObjectState | MeshState],
    environment: str,
    names: Sequence[str],
) -> None:
    """Give `lights` the groups of some names in ``grouped``; None where there are no names.

    Parameters
    ----------
    lights : Lights
        Of all; linked already.
    given : sequence of Light
        Blender's lights of the frame.
    shapes : sequence of (ObjectState or MeshState)
        In the order of the scene's sources.
    environment : str
        Group of the world.
    names : sequence of str
    """
    if not names:
        lights.grouped = None
        return
    number = {name: i for i, name in enumerate(names)}
    rest = len(names)
    of_lamp = np.array([number.get(light.light_group, rest) for light in given] or [rest], np.int64)
    rows = lights.linked_order if lights.linked is not None else lights.order
    tables = lights.linked or lights.tables
    lamps = np.full(len(tables.table), rest, np.int64)
    lamps[: len(rows)] = of_lamp[np.maximum(rows, 0)]
    emission = np.array([number.get(shape.light_group, rest) for shape in shapes] or [rest], np.int64)
    lights.grouped = GroupedTables(tables, lamps, emission, number.get(environment, rest), rest + 1)


def lamps_alone(lights: Lights, of_lamp: Sequence[str], name: str) -> LightTables:
    """`LightTables` of which the camera sees the lamps of one group alone; `of_lamp` has the group of each lamp."""
    table = lights.table.copy()
    for row, index in enumerate(lights.order):
        if of_lamp[int(index)] != name:
            table[row, FLAGS] = int(table[row, FLAGS]) & ~CAMERA
    return lights.tables._replace(table=table)


def is_grouped(lights: Any) -> bool:
    """Whether a Numba type is that of `GroupedTables`."""
    return getattr(lights, "instance_class", None) is GroupedTables


def _are_linked(lights: Any) -> bool:
    return lights.types[lights.fields.index("tables")].instance_class is LinkedTables


def group_of_sample(lights, receiver, index):  # type: ignore[no-untyped-def]
    """Group of a light that was sampled.

    Parameters
    ----------
    lights : LightTables, LinkedTables or GroupedTables
    receiver : float32
        Set of the surface, see `light_links`.
    index : int64
        As `sample_light` returns it.

    Returns
    -------
    int64
    """
    return np.int64(0)


@overload(group_of_sample)
def _group_of_sample(lights, receiver, index):  # type: ignore[no-untyped-def]
    if not is_grouped(lights):
        return lambda lights, receiver, index: np.int64(0)
    if _are_linked(lights):

        def found(lights, receiver, index):  # type: ignore[no-untyped-def]
            k, linked = np.int64(receiver), lights.tables
            first, past = linked.spans[k, 0], linked.spans[k, 1]
            if index < past - first:
                return lights.lamps[first + index]
            return lights.emission[emitter_source(index - (past - first), linked.emitters[k])]

        return found

    def plain(lights, receiver, index):  # type: ignore[no-untyped-def]
        count = len(lights.tables.table)
        if index < count:
            return lights.lamps[index]
        return lights.emission[emitter_source(index - count, lights.tables.emitters)]

    return plain


def first_lamp(lights, receiver):  # type: ignore[no-untyped-def]
    """Row of `GroupedTables.lamps` at which the lamps of a set begin.

    Parameters
    ----------
    lights : GroupedTables
    receiver : float32
        Set of the surface, see `light_links`.

    Returns
    -------
    int64
    """
    return np.int64(0)


@overload(first_lamp)
def _first_lamp(lights, receiver):  # type: ignore[no-untyped-def]
    if is_grouped(lights) and _are_linked(lights):
        return lambda lights, receiver: lights.tables.spans[np.int64(receiver), 0]
    return lambda lights, receiver: np.int64(0)


def group_of_hit(lights, hit, geometry):  # type: ignore[no-untyped-def]
    """Group of what the surface that a ray meets emits.

    Parameters
    ----------
    lights : LightTables, LinkedTables or GroupedTables
    hit : Hit
    geometry : Geometry
        The scene's.

    Returns
    -------
    int64
    """
    return np.int64(0)


@overload(group_of_hit)
def _group_of_hit(lights, hit, geometry):  # type: ignore[no-untyped-def]
    if not is_grouped(lights):
        return lambda lights, hit, geometry: np.int64(0)

    def found(lights, hit, geometry):  # type: ignore[no-untyped-def]
        if hit.face < 0:
            return np.int64(lights.number - 1)
        return lights.emission[load_int32(geometry.face_object, np.int64(hit.face))]

    return found


def group_of_environment(lights):  # type: ignore[no-untyped-def]
    """Group of the environment.

    Parameters
    ----------
    lights : LightTables, LinkedTables or GroupedTables

    Returns
    -------
    int64
    """
    return np.int64(0)


@overload(group_of_environment)
def _group_of_environment(lights):  # type: ignore[no-untyped-def]
    if not is_grouped(lights):
        return lambda lights: np.int64(0)
    return lambda lights: np.int64(lights.environment)
