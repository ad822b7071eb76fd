"""Vertex groups (skinning weights) as sparse arrays: read, interpolated over triangles, written."""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np

Array = np.ndarray


@dataclass(slots=True)
class Weights:
    """Triplets (vertex, group, weight); at most one for a vertex and group.

    Attributes
    ----------
    groups : names
    vertex, group : (k,) int64
    weight : (k,) float64
    """

    groups: list[str]
    vertex: Array
    group: Array
    weight: Array

    def interpolated(self, corners: Array, barycentric: Array, rows: Array) -> Weights:
        """Weights of new vertices `rows` (n,) that lie in triangles `corners` (n, 3) at `barycentric` (n, 3)."""
        order = np.argsort(self.vertex, kind="stable")
        vertex, group, weight = self.vertex[order], self.group[order], self.weight[order]
        flat, share = corners.ravel(), barycentric.ravel()
        first = np.searchsorted(vertex, flat, side="left")
        count = np.where(share > 0, np.searchsorted(vertex, flat, side="right") - first, 0)
        # Entry numbers of every corner, one corner behind the other.
        entry = np.repeat(first - np.cumsum(count) + count, count) + np.arange(count.sum())
        rows = np.repeat(np.repeat(rows, 3), count)
        return _summed(self.groups, rows, group[entry], weight[entry] * np.repeat(share, count))

    def totals(self, count: int) -> Array:
        """(count,) float64 sum of the weights of each vertex."""
        return np.bincount(self.vertex, self.weight, count)

    @staticmethod
    def joined(groups: list[str], parts: list[Weights]) -> Weights:
        """Several sets of weights with the same groups as one."""
        if not parts:
            return Weights(groups, np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0))
        arrays = (np.concatenate([getattr(p, name) for p in parts]) for name in ("vertex", "group", "weight"))
        return _summed(groups, *arrays)


def _summed(groups: list[str], vertex: Array, group: Array, weight: Array) -> Weights:
    """Add up the entries of the same vertex and group; drop zeros."""
    key, inverse = np.unique(vertex.astype(np.int64) * max(len(groups), 1) + group, return_inverse=True)
    total = np.bincount(inverse, weight, len(key))
    kept = total > 0
    key = key[kept]
    return Weights(groups, key // max(len(groups), 1), key % max(len(groups), 1), total[kept])


def read_weights(obj: bpy.types.Object, index: dict[str, int]) -> Weights:
    """Weights of a mesh object for the groups in `index`, name -> number.

    An object that is parented to a bone follows it with every vertex, at weight 1.
    """
    count = len(obj.data.vertices)
    bone = _parent_bone(obj)
    if bone in index:
        vertices = np.arange(count)
        return Weights(list(index), vertices, np.full(count, index[bone]), np.ones(count))
    numbers = {g.index: index[g.name] for g in obj.vertex_groups if g.name in index}
    found = [
        (v.index, numbers[g.group], g.weight)
        for v in obj.data.vertices
        for g in v.groups
        if g.group in numbers and g.weight > 0
    ]
    table = np.array(found, np.float64).reshape(-1, 3)
    return Weights(list(index), table[:, 0].astype(np.int64), table[:, 1].astype(np.int64), table[:, 2])


def _parent_bone(obj: bpy.types.Object) -> str:
    """Bone that the object or one of its parents hangs on, "" when a modifier deforms it or there is none."""
    if obj.find_armature() is not None and any(m.type == "ARMATURE" for m in obj.modifiers):
        return ""
    while obj is not None and obj.type != "ARMATURE":
        if obj.parent_type == "BONE":
            return obj.parent_bone
        obj = obj.parent
    return ""


def write_weights(obj: bpy.types.Object, weights: Weights) -> None:
    """Set the object's vertex groups of the names in `weights` to exactly these weights."""
    for name in weights.groups:
        if (old := obj.vertex_groups.get(name)) is not None:
            obj.vertex_groups.remove(old)
    order = np.lexsort((weights.weight, weights.group))
    vertex, group, weight = (a[order] for a in (weights.vertex, weights.group, weights.weight))
    # One call serves all vertices that share group and weight; rigid parts are one call.
    change = np.flatnonzero((np.diff(group) != 0) | (np.diff(weight) != 0)) + 1
    made: dict[int, bpy.types.VertexGroup] = {}
    for run in np.split(np.arange(len(order)), change) if len(order) else ():
        number = int(group[run[0]])
        if number not in made:
            made[number] = obj.vertex_groups.new(name=weights.groups[number])
        made[number].add(vertex[run].tolist(), float(weight[run[0]]), "REPLACE")
