"""The pictures of which a blurred viewport's picture is made: those of F12, as far as keyframes tell.

Cycles has depth of field in viewports through a camera, too, and no motion blur.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar, overload

import bpy
import numpy as np

from ...drgs_blender.core.frame import Frame
from ...drgs_blender.ipc.blur import camera_on_lens, sample_frame
from .. import messages
from ..export.blur_steps import Step, depth_of, focus_distance, steps
from ..export.instances import Key, Keys
from . import scenes
from .keyed_motion import KeyedMotion

Array = np.ndarray
I = TypeVar("I")
#: Objects that a message names.
_NAMED = 4


@dataclass(frozen=True, slots=True)
class Moment:
    """Where the parts of a frame are at one time, by their index; what is not there does not move.

    Attributes
    ----------
    objects, lights : (4, 4) float64, the change of the world matrix
    meshes : of a mesh and one of its places
    camera : (4, 4) float64, the change of the pose; None where it stands still or nobody looks through it
    focus : metres along the view axis at which things are sharp
    """

    focus: float
    camera: Array | None = None
    objects: dict[int, Array] = field(default_factory=dict)
    meshes: dict[tuple[int, int], Array] = field(default_factory=dict)
    lights: dict[int, Array] = field(default_factory=dict)

    def key(self) -> tuple[object, ...]:
        """Everything about it, comparable."""
        moved = [{k: v.tobytes() for k, v in part.items()} for part in (self.objects, self.meshes, self.lights)]
        return self.focus, None if self.camera is None else self.camera.tobytes(), *(tuple(m.items()) for m in moved)

    def seen(self, sharp: Frame, lens: tuple[float, float]) -> Frame:
        """The frame at this time, from a place of the lens."""
        camera = sharp.camera
        if self.camera is not None:
            camera = replace(camera, matrix_world=self.camera @ camera.matrix_world)
        objects, meshes, lights = list(sharp.objects), list(sharp.meshes), list(sharp.lights)
        for i, change in self.objects.items():
            objects[i] = replace(objects[i], matrix_world=change @ objects[i].matrix_world)
        for i, change in self.lights.items():
            lights[i] = replace(lights[i], matrix_world=change @ lights[i].matrix_world)
        for i in {i for i, _ in self.meshes}:
            matrices = np.array(meshes[i].matrices)
            for (mesh, place), change in self.meshes.items():
                if mesh == i:
                    matrices[place] = change @ matrices[place]
            meshes[i] = replace(meshes[i], matrices=matrices)
        seen = camera_on_lens(camera, lens, self.focus)
        return replace(sharp, camera=seen, objects=objects, meshes=meshes, lights=lights)


@dataclass(frozen=True, slots=True)
class Parts(Sequence[Frame]):
    """The pictures whose mean is the blurred one, made when they are asked for."""

    sharp: Frame
    steps: Sequence[Step]
    moments: Sequence[Moment]

    def __len__(self) -> int:
        return len(self.steps)

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Frame]: ...
    def __getitem__(self, index: int | slice) -> Frame | Sequence[Frame]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        frame = self.moments[index].seen(self.sharp, self.steps[index].lens)
        return sample_frame(frame, len(self), index)


@dataclass(frozen=True, slots=True)
class Blur:
    """How a viewport's picture is blurred.

    Attributes
    ----------
    given : what `steps` and `moments` were made for
    key : everything about them, comparable
    told : messages of what is not blurred
    """

    given: tuple[object, ...] = ()
    steps: Sequence[Step] = ()
    moments: Sequence[Moment] = ()
    key: tuple[object, ...] = ()
    told: tuple[str, ...] = ()

    def parts(self, sharp: Frame) -> Sequence[Frame]:
        """The pictures that make the blurred one of a frame; none where all is sharp."""
        return Parts(sharp, self.steps, self.moments) if self.steps else ()

    def withdraw(self) -> None:
        """Take back what was told."""
        for text in self.told:
            messages.withdraw("WARNING", text)


def of(
    context: bpy.types.Context,
    depsgraph: bpy.types.Depsgraph,
    camera: bpy.types.Object | None,
    known: Blur,
    local: str,
) -> Blur:
    """The blur of a viewport; `known`, the last one, where nothing changed.

    Motion is not blurred while it plays: pictures are coarse then, and follow each other.

    Parameters
    ----------
    camera : through which one looks
    local : as of `scenes.exported`
    """
    scene = depsgraph.scene
    texts: list[str] = []
    plays = getattr(getattr(context, "screen", None), "is_animation_playing", False)
    lens = camera.evaluated_get(depsgraph) if camera is not None and camera.type == "CAMERA" else None
    moving = scene.drgs.use_viewport_motion_blur and not plays
    wanted = steps(scene, depsgraph.view_layer, lens, texts.append, moving)
    parts = scenes.parts(depsgraph, local)
    given = tuple(wanted), tuple(texts), lens is not None and lens.name_full, parts.version
    if given == known.given:
        return known
    made: list[Moment] = []
    if wanted:
        made, lacking = moments(wanted, parts.keys, lens, depsgraph)
        texts += [text] if (text := message(lacking)) else []
    told = known.told if plays else tuple(texts)
    for text in set(known.told) - set(told):
        messages.withdraw("WARNING", text)
    for text in sorted(set(told) - set(known.told)):
        messages.note("WARNING", text)
    return Blur(given, wanted, made, (tuple(wanted), tuple(moment.key() for moment in made)), told)


def moments(
    steps: Sequence[Step], keys: Keys, camera: bpy.types.Object | None, depsgraph: bpy.types.Depsgraph
) -> tuple[list[Moment], dict[str, str]]:
    """Where everything is at each of the steps, and what cannot be followed: name -> by what it moves.

    Parameters
    ----------
    keys : of the exported frame
    camera : evaluated, through which one looks; None for a view of its own
    """
    focus = 1.0 if camera is None else focus_distance(camera, depsgraph)
    if not any(step.time for step in steps):
        return [Moment(focus)] * len(steps), {}
    keyed, known = KeyedMotion(depsgraph), {obj.as_pointer(): obj for obj in bpy.data.objects}
    mover = _movers(keyed, known)
    objects = _moving(enumerate(keys.objects), mover)
    lights = _moving(enumerate(keys.lights), mover)
    places = (((i, j), key) for i, mesh in enumerate(keys.meshes) for j, key in enumerate(mesh))
    meshes = _moving(places, mover)
    made = []
    for step in steps:
        pose, distance = _camera_at(keyed, camera, step.time, focus)
        changes = {obj: keyed.change(obj, step.time) for obj in {*objects.values(), *lights.values(), *meshes.values()}}
        made.append(
            Moment(
                distance,
                pose,
                {i: changes[obj] for i, obj in objects.items()},
                {i: changes[obj] for i, obj in meshes.items()},
                {i: changes[obj] for i, obj in lights.items()},
            )
        )
    return made, keyed.lacking


def message(lacking: dict[str, str]) -> str:
    """What a user is told of movement that is not blurred; "" where there is none."""
    if not lacking:
        return ""
    named = [f'"{name}" ({why})' for name, why in sorted(lacking.items())]
    text = ", ".join(named[:_NAMED]) + (f" and {len(named) - _NAMED} more" if len(named) > _NAMED else "")
    return f"Motion blur in viewports follows keyframes of transforms alone; F12 also blurs what else moves: {text}"


def _movers(keyed: KeyedMotion, known: dict[int, bpy.types.Object]) -> Callable[[Key], bpy.types.Object | None]:
    """Function: the object with which an instance moves, None where it stands still."""

    def mover(key: Key) -> bpy.types.Object | None:
        obj, parent = known.get(key[0]), known.get(key[1])
        if obj is None:
            return None
        keyed.check_shape(obj)
        if not key[1]:
            return obj if keyed.moves(obj) else None
        if parent is None:
            return None
        keyed.check_shape(parent)
        if keyed.moves(obj) and obj.parent != parent:
            keyed.lacking.setdefault(obj.name, f'in the instance "{parent.name}"')
        return parent if keyed.moves(parent) else None

    return mover


def _moving(
    items: Iterable[tuple[I, Key]], mover: Callable[[Key], bpy.types.Object | None]
) -> dict[I, bpy.types.Object]:
    """Index -> object with which it moves."""
    return {i: obj for i, key in items if (obj := mover(key)) is not None}


def _camera_at(
    keyed: KeyedMotion, camera: bpy.types.Object | None, time: float, focus: float
) -> tuple[Array | None, float]:
    """Change of a camera's pose, and the distance at which it is sharp."""
    if camera is None:
        return None, focus
    own, dof = camera.original, camera.data.dof
    if camera.original.data.animation_data is not None:
        keyed.lacking.setdefault(own.name, "keyframes of its lens")
    target = None if dof.focus_object is None or not dof.use_dof else dof.focus_object.original
    moves = keyed.moves(own)
    if not moves and (target is None or not keyed.moves(target)):
        return None, focus
    pose, now = keyed.world_at(own, time).normalized(), camera.matrix_world.normalized()
    change = np.array(pose, np.float64) @ np.linalg.inv(np.array(now, np.float64)) if moves else None
    if target is None or dof.focus_subtarget:
        return change, focus
    return change, depth_of(keyed.world_at(target, time), pose)
