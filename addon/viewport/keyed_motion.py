"""Where objects stand at other times, by their keyframes alone.

A redraw may not evaluate the scene at another frame: that would change the frame of the user, and take back what is not
keyed yet. F-curves of transforms, along chains of parents, can be read at any time. What else moves or bends an object
is found and named, and the object is left where it is.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import bpy
import numpy as np
from mathutils import Euler, Matrix, Quaternion

Array = np.ndarray

#: Properties of an object that place it.
TRANSFORMS = (
    "location", "rotation_euler", "rotation_quaternion", "rotation_axis_angle", "scale",
    "delta_location", "delta_rotation_euler", "delta_rotation_quaternion", "delta_scale",
)  # fmt: skip
#: Modifiers that bend a mesh as time goes on, whatever is keyed.
TIMED = {
    "BUILD", "CLOTH", "DYNAMIC_PAINT", "EXPLODE", "FLUID", "MESH_CACHE", "MESH_SEQUENCE_CACHE", "PARTICLE_INSTANCE",
    "SOFT_BODY", "WAVE",
}  # fmt: skip
#: Nodes by which a tree depends on time.
_TIMED_NODES = {"GeometryNodeInputSceneTime", "GeometryNodeSimulationOutput", "GeometryNodeImportVDB"}
#: Part of an object's size by which keyframes may miss where it stands now.
_SAME = 1e-4
#: What `KeyedMotion` calls movement that it can follow.
KEYED = "keyframes"


class KeyedMotion:
    """Movement around the frame of an evaluated scene.

    Attributes
    ----------
    lacking : dict of str to str
        Name of an object that moves otherwise than by keyframes of its transform -> by what.
    """

    def __init__(self, depsgraph: bpy.types.Depsgraph) -> None:
        self._depsgraph, scene = depsgraph, depsgraph.scene
        #: Time remapping stretches what keyframes say.
        self._rate = scene.render.frame_map_old / scene.render.frame_map_new
        self._now = scene.frame_current + scene.frame_subframe
        self._simulated = scene.rigidbody_world is not None and scene.rigidbody_world.enabled
        self._tracks: dict[int, str | None] = {}
        self._curves: dict[int, dict[tuple[str, int], bpy.types.FCurve]] = {}
        self.lacking: dict[str, str] = {}

    def moves(self, obj: bpy.types.Object) -> bool:
        """Whether keyframes move an original object; what moves it otherwise is noted as `lacking`."""
        return self._track(obj) == KEYED

    def check_shape(self, obj: bpy.types.Object) -> None:
        """Note as `lacking` what may bend the surface of an original object."""
        if (why := self._bends(obj)) is not None:
            self.lacking.setdefault(obj.name, why)

    def world_at(self, obj: bpy.types.Object, time: float) -> Matrix:
        """World matrix of an original object, `time` frames from now. One that does not move by keyframes stays."""
        return self._world(obj, (self._now + time) * self._rate) if self.moves(obj) else self._evaluated(obj)

    def change(self, obj: bpy.types.Object, time: float) -> Array:
        """(4, 4) float64: brings what stands on an object that moves to where it is `time` frames from now."""
        now = self._world(obj, self._now * self._rate)
        return np.array(self.world_at(obj, time), np.float64) @ np.linalg.inv(np.array(now, np.float64))

    # --- what moves an object --------------------------------------------------------------------------------

    def _track(self, obj: bpy.types.Object) -> str | None:
        """`KEYED`, None for what stands still, or what else moves it."""
        key = obj.as_pointer()
        if key not in self._tracks:
            self._tracks[key] = None  # what depends on itself stands still
            found = self._find_track(obj)
            if found == KEYED and not self._agrees(obj):
                found = "stands elsewhere than its keyframes say"
            self._tracks[key] = found
            if found not in (None, KEYED):
                self.lacking[obj.name] = str(found)
        return self._tracks[key]

    def _find_track(self, obj: bpy.types.Object) -> str | None:
        if (why := _animated_otherwise(obj, TRANSFORMS)) is not None:
            return why
        if self._simulated and obj.rigid_body is not None and (obj.rigid_body.type == "ACTIVE"):
            return "rigid body"
        parent = obj.parent
        above = None if parent is None else self._track(parent)
        if above not in (None, KEYED):
            return f'parent "{parent.name}"'
        own = KEYED if self._own_curves(obj) else None
        for constraint in obj.constraints:
            if not constraint.enabled or constraint.mute:
                continue
            keyed = any(path.startswith(f'constraints["{constraint.name}"]') for path in _paths(obj))
            if keyed or own or above or any(self._is_alive(target) for target in _objects_of(constraint)):
                return f"constraint {constraint.name}"
        if parent is not None and parent.type == "CURVE" and parent.data.use_path and parent.data.animation_data:
            return f'path "{parent.name}"'
        on_a_part = parent is not None and obj.parent_type in ("BONE", "VERTEX", "VERTEX_3")
        if on_a_part and (own or self._bends(parent) is not None):
            return f"parent {obj.parent_type.split('_')[0].lower()}"
        return own or above

    def _is_alive(self, obj: bpy.types.Object) -> bool:
        """Whether an object may move or bend."""
        return self._track(obj) is not None or self._bends(obj) is not None

    def _bends(self, obj: bpy.types.Object) -> str | None:
        """What may bend an object, None for one that keeps its shape."""
        if any(path.startswith("pose.bones") for path in _paths(obj)):
            return "pose"
        data = obj.data if obj.type not in ("CAMERA", "LIGHT") else None
        if data is not None and getattr(data, "animation_data", None) is not None:
            return f"keyframes of {data.name}"
        keys = getattr(data, "shape_keys", None)
        if keys is not None and keys.animation_data is not None:
            return "shape keys"
        for modifier in obj.modifiers:
            if modifier.show_viewport and self._is_timed(obj, modifier):
                return f"modifier {modifier.name}"
        return None

    def _is_timed(self, obj: bpy.types.Object, modifier: bpy.types.Modifier) -> bool:
        if modifier.type in TIMED:
            return True
        if any(path.startswith(f'modifiers["{modifier.name}"]') for path in _paths(obj)):
            return True
        tree = getattr(modifier, "node_group", None)
        if tree is not None and _is_tree_timed(tree, set()):
            return True
        return any(target != obj and self._is_alive(target) for target in _objects_of(modifier))

    # --- where it stands --------------------------------------------------------------------------------

    def _own_curves(self, obj: bpy.types.Object) -> dict[tuple[str, int], bpy.types.FCurve]:
        """F-curves of an object's transform by property and component."""
        key = obj.as_pointer()
        if key not in self._curves:
            found = _curves_of(obj)
            self._curves[key] = {(c.data_path, c.array_index): c for c in found if c.data_path in TRANSFORMS}
        return self._curves[key]

    def _agrees(self, obj: bpy.types.Object) -> bool:
        """Whether keyframes put an object where it stands now."""
        said, real = np.array(self._world(obj, self._now * self._rate)), np.array(self._evaluated(obj))
        return bool(np.allclose(said, real, rtol=_SAME, atol=_SAME * max(1e-6, float(np.abs(real[:3, :3]).max()))))

    def _evaluated(self, obj: bpy.types.Object) -> Matrix:
        return obj.evaluated_get(self._depsgraph).matrix_world

    def _world(self, obj: bpy.types.Object, at: float) -> Matrix:
        """World matrix at a time of the F-curves."""
        curves = self._own_curves(obj)
        parent = obj.parent
        if parent is None:
            return _basis(obj, curves, at) if curves else self._evaluated(obj)
        above = self._world(parent, at)
        if obj.parent_type in ("BONE", "VERTEX", "VERTEX_3") or not curves:
            return above @ self._evaluated(parent).inverted_safe() @ self._evaluated(obj)
        return above @ obj.matrix_parent_inverse @ _basis(obj, curves, at)


def _curves_of(owner: bpy.types.ID) -> Iterator[bpy.types.FCurve]:
    """F-curves that Blender evaluates of a datablock's action."""
    data = owner.animation_data
    action = None if data is None else data.action
    if action is None:
        return
    bags: list[Any] = [action]
    if hasattr(data, "action_slot"):  # from Blender 4.4 on
        slot = data.action_slot
        strips = [strip for layer in action.layers for strip in layer.strips]
        bags = [bag for strip in strips if slot is not None and (bag := strip.channelbag(slot)) is not None]
    for bag in bags:
        for curve in bag.fcurves:
            if not (curve.mute or curve.is_empty or (curve.group is not None and curve.group.mute)):
                yield curve


def _paths(owner: bpy.types.ID) -> list[str]:
    """Properties of a datablock that keyframes or drivers change."""
    data = owner.animation_data
    if data is None:
        return []
    return [curve.data_path for curve in _curves_of(owner)] + [driver.data_path for driver in data.drivers]


def _animated_otherwise(obj: bpy.types.Object, properties: Iterable[str]) -> str | None:
    """What besides the keyframes of its own action moves an object."""
    data = obj.animation_data
    if data is None:
        return None
    moving = {*properties, "rotation_mode"}
    if any(driver.data_path in moving and not driver.mute for driver in data.drivers):
        return "driver"
    if data.use_tweak_mode or (data.use_nla and any(track.strips and not track.mute for track in data.nla_tracks)):
        return "NLA tracks"
    return "keyframes of its rotation mode" if "rotation_mode" in _paths(obj) else None


def _objects_of(owner: Any) -> Iterator[bpy.types.Object]:
    """Objects that a constraint or modifier refers to."""
    for prop in owner.bl_rna.properties:
        if prop.type == "POINTER" and isinstance(value := getattr(owner, prop.identifier), bpy.types.Object):
            yield value
    for target in getattr(owner, "targets", ()):  # of an Armature constraint
        if target.target is not None:
            yield target.target


def _is_tree_timed(tree: bpy.types.NodeTree, seen: set[int]) -> bool:
    """Whether a tree of nodes, or a group in it, depends on time."""
    if tree.as_pointer() in seen:
        return False
    seen.add(tree.as_pointer())
    if tree.animation_data is not None:
        return True
    groups = (node.node_tree for node in tree.nodes if getattr(node, "node_tree", None) is not None)
    return any(node.bl_idname in _TIMED_NODES for node in tree.nodes) or any(_is_tree_timed(g, seen) for g in groups)


def _basis(obj: bpy.types.Object, curves: dict[tuple[str, int], bpy.types.FCurve], at: float) -> Matrix:
    """Transform of an object below its parent, as Blender puts it together."""
    values = {name: list(getattr(obj, name)) for name in TRANSFORMS}
    for (name, index), curve in curves.items():
        if index < len(values[name]):
            values[name][index] = curve.evaluate(at)
    mode = obj.rotation_mode
    if mode == "QUATERNION":
        turn = Quaternion(values["rotation_quaternion"]).normalized().to_matrix()
        delta = Quaternion(values["delta_rotation_quaternion"]).normalized().to_matrix()
    elif mode == "AXIS_ANGLE":
        angle, *axis = values["rotation_axis_angle"]
        turn = Matrix.Rotation(angle, 3, axis)
        delta = Matrix.Identity(3)  # Blender's interface has none
    else:
        turn = Euler(values["rotation_euler"], mode).to_matrix()
        delta = Euler(values["delta_rotation_euler"], mode).to_matrix()
    place = [a + b for a, b in zip(values["location"], values["delta_location"])]
    sizes = [a * b for a, b in zip(values["scale"], values["delta_scale"])]
    return Matrix.Translation(place) @ (delta @ turn @ Matrix.Diagonal(sizes)).to_4x4()
