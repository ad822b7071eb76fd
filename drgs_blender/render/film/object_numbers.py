"""Numbers of the objects that pixels show: Blender's pass index, and one by which denoisers keep objects apart."""

from __future__ import annotations

import zlib
from typing import NamedTuple

import numpy as np

from ..scene.trace_scene import TraceScene

Array = np.ndarray

#: Numbers below this are exact as float32.
_MOST = 1 << 24


class ObjectNumbers(NamedTuple):
    """Of all objects and instances, as `TraceScene.source` lists them; pixels hold rows of these.

    Attributes
    ----------
    pass_index : (n,) int32 array
        Blender's, of the pass IndexOB.
    name : (n,) int32 array
        From 1 on, made of the object's name: the same in every frame and file. Instances have that of their object.
        Two names have the same number by a chance of 1 in 2^24, and are then kept apart by shape alone.
    """

    pass_index: Array
    name: Array


def object_numbers(scene: TraceScene) -> ObjectNumbers:
    """The numbers of the objects of a scene."""
    names = [fault.name for fault in scene.faults]
    numbers = np.array([zlib.crc32(name.encode()) % (_MOST - 1) + 1 for name in names], np.int32)
    return ObjectNumbers(scene.pass_index, numbers[scene.source])


def number_of(objects: ObjectNumbers | None, kind: str, row: Array, empty: Array) -> Array:
    """(h, w) float32 of a field of `ObjectNumbers` by pixels' rows, 0 where they are `empty` or there is no object."""
    if objects is None or not len(objects.name):
        return np.zeros(row.shape, np.float32)
    return np.where(empty, 0, getattr(objects, kind)[row.astype(np.int32)]).astype(np.float32)
