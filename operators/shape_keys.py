"""Shape keys carried from meshes to a DR-GS object, with what animates them."""

from __future__ import annotations

import bpy
import numpy as np

from .nearest_surface import Match

Array = np.ndarray


def transfer_shape_keys(
    target: bpy.types.Object, matrix: Array, sources: list[tuple[bpy.types.Object, Array]], match: Match
) -> None:
    """Give `target` the shape keys of `sources`; keys of the same name become one.

    Offsets are relative to each key's own base, interpolated over the nearest triangle, and turned from the object
    space of the source (to world by its matrix) into that of the target (to world by `matrix`).
    """
    owners = [(i, obj, own) for i, (obj, own) in enumerate(sources) if obj.data.shape_keys]
    if not owners:
        return
    rest = np.empty((len(target.data.vertices), 3), np.float32)
    target.data.attributes["position"].data.foreach_get("vector", rest.ravel())
    offsets: dict[str, Array] = {}
    settings: dict[str, bpy.types.ShapeKey] = {}
    for number, obj, own in owners:
        rows = np.flatnonzero(match.source == number)
        turn = np.linalg.inv(matrix[:3, :3]) @ own[:3, :3]
        for key in obj.data.shape_keys.key_blocks:
            if key == obj.data.shape_keys.reference_key:
                continue
            delta = (_points(key) - _points(key.relative_key)) @ turn.T
            moved = np.einsum("nk,nkc->nc", match.barycentric[rows], delta[match.corners[rows]])
            offsets.setdefault(key.name, np.zeros_like(rest))[rows] += moved.astype(np.float32)
            settings.setdefault(key.name, key)
    if target.data.shape_keys is None:
        target.shape_key_add(name="Basis", from_mix=False)
    blocks = target.data.shape_keys.key_blocks
    for name, delta in offsets.items():
        key = blocks.get(name) or target.shape_key_add(name=name, from_mix=False)
        key.points.foreach_set("co", np.ascontiguousarray(rest + delta, np.float32).ravel())
        model = settings[name]
        key.slider_min, key.slider_max, key.mute, key.value = (
            model.slider_min,
            model.slider_max,
            model.mute,
            model.value,
        )
    for _, obj, _ in owners:
        if obj.data.shape_keys.animation_data:
            _copy_animation(obj.data.shape_keys, target.data.shape_keys)


def _points(key: bpy.types.ShapeKey) -> Array:
    points = np.empty((len(key.points), 3), np.float32)
    key.points.foreach_get("co", points.ravel())
    return points


def _copy_animation(source: bpy.types.Key, target: bpy.types.Key) -> None:
    """Share the action and copy the drivers: both address keys by name."""
    given, taken = source.animation_data, target.animation_data or target.animation_data_create()
    if given.action and not taken.action:
        taken.action = given.action
        if getattr(given, "action_slot", None):  # from Blender 4.4
            taken.action_slot = given.action_slot
    known = {d.data_path for d in taken.drivers}
    for driver in given.drivers:
        if driver.data_path not in known:
            taken.drivers.from_existing(src_driver=driver)
