"""Particles as the processor steps them: what is known of each in three rows of sixteen numbers, a cache line each."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..compute.jit import njit
from ..compute.simd import load, store
from ..compute.threads import ELEMENTS, over_range
from ..core.sim_materials import COLUMNS
from .particles import Particles, Properties

Array = np.ndarray

#: Columns of `Packed.motion` after the velocity: mass, volume at rest; those of the velocity gradient are at 4, 8, 12.
MASS, VOLUME = 3, 7
#: First columns of `Packed.strain`: F - 1 of what is elastic, Kirchhoff stress, memory.
ELASTIC, TAU, MEMORY = 0, 9, 15
#: After the parameters in `Packed.matter`: F - 1 of all since the start.
TOTAL = 5
WIDTH = 16


class Packed(NamedTuple):
    """`Particles` and `Properties`.

    Attributes
    ----------
    x : (n, 3) float64 array
    motion, strain, matter : (n, WIDTH) float32 array
    model : (n,) uint8 array
    solid : (n,) bool array
        Whose `total` is kept.
    """

    x: Array
    motion: Array
    strain: Array
    matter: Array
    model: Array
    solid: Array


def room_for(n: int) -> Packed:
    """Rows of `n` particles, to be written."""
    motion, strain, matter = (np.zeros((n, WIDTH), np.float32) for _ in range(3))
    return Packed(np.empty((n, 3)), motion, strain, matter, np.empty(n, np.uint8), np.empty(n, np.bool_))


def pack(state: Particles, properties: Properties, order: Array, rows: Packed) -> None:
    """Write particles, in an order, to rows."""
    over_range(_pack, len(order), order, state, properties, len(state.total) > 0, rows, fewest=ELEMENTS)


@njit
def _pack(first, last, order, state, properties, kept, rows):  # type: ignore[no-untyped-def]
    x, motion, strain, matter, model, solid = rows
    for p in range(first, last):
        q = order[p]
        model[p], solid[p] = properties.model[q], kept and properties.solid[q]
        motion[p, MASS], motion[p, VOLUME] = properties.mass[q], properties.volume[q]
        strain[p, MEMORY] = state.memory[q]
        for c in range(3):
            x[p, c], motion[p, c] = state.x[q, c], state.v[q, c]
        for c in range(COLUMNS):
            matter[p, c] = properties.parameters[q, c]
        for c in range(6):
            strain[p, TAU + c] = state.tau[q, c]
        for c in range(9):
            motion[p, 4 + 4 * (c % 3) + c // 3] = state.affine[q, c]
            strain[p, c] = state.elastic[q, c]
            if kept:
                matter[p, TOTAL + c] = state.total[q, c]


def move(rows: Packed, order: Array, to: Packed) -> None:
    """Write rows, in an order, to others."""
    over_range(_move, len(order), order, rows, to, fewest=ELEMENTS)


@njit
def _move(first, last, order, rows, to):  # type: ignore[no-untyped-def]
    for p in range(first, last):
        q = order[p]
        to.model[p], to.solid[p] = rows.model[q], rows.solid[q]
        for c in range(3):
            to.x[p, c] = rows.x[q, c]
        store(to.motion, WIDTH * p, load(rows.motion, WIDTH * q))
        store(to.strain, WIDTH * p, load(rows.strain, WIDTH * q))
        store(to.matter, WIDTH * p, load(rows.matter, WIDTH * q))


def unpacked(rows: Packed, order: Array, kept: bool) -> Particles:
    """The state in arrays of its own; row `p` is of particle ``order[p]``, and `kept` says whether `total` is."""
    n = len(order)
    shapes = ((n, 3), (n, 9), (n, 9), (n if kept else 0, 9), (n, 6), (n,))
    state = Particles(np.empty((n, 3)), *(np.empty(shape, np.float32) for shape in shapes))
    over_range(_unpack, n, order, rows, kept, state, fewest=ELEMENTS)
    return state


@njit
def _unpack(first, last, order, rows, kept, state):  # type: ignore[no-untyped-def]
    x, v, affine, elastic, total, tau, memory = state
    for p in range(first, last):
        q = order[p]
        memory[q] = rows.strain[p, MEMORY]
        for c in range(3):
            x[q, c], v[q, c] = rows.x[p, c], rows.motion[p, c]
        for c in range(6):
            tau[q, c] = rows.strain[p, TAU + c]
        for c in range(9):
            affine[q, c] = rows.motion[p, 4 + 4 * (c % 3) + c // 3]
            elastic[q, c] = rows.strain[p, c]
            if kept:
                total[q, c] = rows.matter[p, TOTAL + c]
