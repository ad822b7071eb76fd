"""Motion steps: camera and shapes at another time -> frame.MotionStep, for passes of motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import bpy
import numpy as np

from ...drgs_blender.core.arrays import same_bits
from ...drgs_blender.core.asset.part import Part
from ...drgs_blender.core.frame import Frame, MotionStep, ObjectState, Particles, Pose, ProxyMesh
from .. import assets, mesh_arrays, proxies
from .camera import export_camera, picture_of
from .hair import read_strands
from .instances import Key, uncancelled, visible
from .particles import particles_of

Array = np.ndarray
#: Evaluates the scene of the depsgraph at another frame, a whole number and a part in [0, 1).
FrameSet = Callable[[int, float], None]

#: What carries the surfels of an object without a mesh.
Carriers = tuple[Particles | None, ProxyMesh | None]

#: Passes that need another time, by which one.
BEFORE, AFTER = frozenset({"Vector", "Previous Position"}), frozenset({"Vector"})


def add_moments(
    frame: Frame,
    depsgraph: bpy.types.Depsgraph,
    frame_set: FrameSet,
    object_keys: list[Key],
    mesh_keys: list[list[Key]],
    cancelled: Callable[[], bool] | None = None,
) -> None:
    """Fill in where everything is one frame earlier and later, as far as the passes of `frame` need it.

    The scene is evaluated at these frames and then at its own again, as Cycles does, so that a frame is the same
    whichever were rendered before it.

    Parameters
    ----------
    object_keys, mesh_keys : which instance each of the frame's objects, and each place of its meshes, is
    cancelled : asked before each object; then `Cancelled` is raised, the scene being at its own frame again
    """
    scene = depsgraph.scene
    now, part = scene.frame_current, scene.frame_subframe
    camera = depsgraph.scene_eval.camera.original
    wanted = set(frame.passes)
    try:
        if BEFORE & wanted:
            frame_set(now - 1, part)
            frame.previous = _moment(frame, depsgraph, camera, object_keys, mesh_keys, cancelled)
        if AFTER & wanted:
            frame_set(now + 1, part)
            frame.next = _moment(frame, depsgraph, camera, object_keys, mesh_keys, cancelled)
    finally:
        if BEFORE & wanted:
            frame_set(now, part)


def _vertices(obj: bpy.types.Object, part: Part) -> Array:
    """Vertices of the part of its asset that an object has now; all of them where it has another then."""
    vertices = mesh_arrays.read_vertices(obj.data)
    rows = mesh_arrays.read_source_vertices(obj.data, assets.load(assets.file_of(obj)).mesh)
    return vertices if rows is None or not np.array_equal(rows[rows >= 0], part.vertices) else vertices[rows >= 0]


def _carrier(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph, now: ObjectState) -> Carriers:
    """What carries the surfels of a proxy as it is evaluated then; nothing where it is at rest, then and `now`."""
    if now.particles is not None:
        given = mesh_arrays.read_vertices(obj.data), proxies.read_rest(obj.data)
        particles = particles_of(obj, depsgraph, *given, lambda text: None)  # which the frame itself has told
        if particles is not None and particles.surfels:
            return replace(particles, all=True), None
    pose = proxies.read_pose(obj.data)
    still = now.proxy is None and now.particles is None and np.array_equal(pose.rest, pose.vertices)
    return None, None if still else pose


def _moment(
    frame: Frame,
    depsgraph: bpy.types.Depsgraph,
    camera: bpy.types.Object,
    object_keys: list[Key],
    mesh_keys: list[list[Key]],
    cancelled: Callable[[], bool] | None,
) -> MotionStep:
    """The scene as `depsgraph` is evaluated now; what is not there any more is taken as not moved."""
    shape_of = {key: ("object", i) for i, key in enumerate(object_keys)}
    shape_of |= {key: ("mesh", i) for i, keys in enumerate(mesh_keys) for key in keys}
    matrices: dict[Key, Array] = {}
    read: dict[tuple[int, bool], Array] = {}
    carriers: dict[int, Carriers] = {}
    vertices: dict[tuple[str, int], Array] = {}
    for item in uncancelled(visible(depsgraph), cancelled):
        if item.key not in shape_of:
            continue
        matrices[item.key] = item.matrix_world
        shape, mesh = shape_of[item.key], item.object.data
        # While a mesh is edited, its evaluated data has no arrays; nor does it move.
        if shape not in vertices and (item.is_hair or not mesh.is_editmode):
            which = mesh.as_pointer(), item.is_hair
            if shape[0] == "object" and proxies.is_proxy(mesh, assets.load(assets.file_of(item.object))):
                carriers[shape[1]] = _carrier(item.object, depsgraph, frame.objects[shape[1]])
                continue
            if which not in read:
                part = frame.objects[shape[1]].part if shape[0] == "object" else None
                if item.is_hair:
                    read[which] = read_strands(item.object, depsgraph.mode).tubes().vertices
                else:
                    read[which] = mesh_arrays.read_vertices(mesh) if part is None else _vertices(item.object, part)
                read[which].flags.writeable = False
            vertices[shape] = read[which]

    def moved(shape: tuple[str, int], now: Array | None) -> Array | None:
        other = vertices.get(shape)
        return None if other is None or (now is not None and same_bits(other, now)) else other

    objects: list[Pose | None] = []
    for i, (key, state) in enumerate(zip(object_keys, frame.objects)):
        pose = None
        if key in matrices:
            own = moved(("object", i), state.vertices)
            pose = Pose(state.name, matrices[key][None], own, *carriers.get(i, (None, None)))
        objects.append(pose)
    meshes: list[Pose | None] = []
    for i, (keys, mesh) in enumerate(zip(mesh_keys, frame.meshes)):
        places = np.stack([matrices.get(key, now) for key, now in zip(keys, mesh.matrices)])
        meshes.append(Pose(mesh.name, places, moved(("mesh", i), mesh.vertices)))
    scene = depsgraph.scene_eval
    return MotionStep(export_camera(camera.evaluated_get(depsgraph), picture_of(scene)), objects, meshes)
