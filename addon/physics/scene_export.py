"""The scene as files for the engine: the body, its pins and regions, its motion, and the colliders'.

Capturing is a generator that goes on by a frame at a time, so that Blender's window stays alive meanwhile.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

import bpy
import numpy as np

from ...drgs_blender.core.asset import Asset, Binding, Mesh, Surfels
from ...drgs_blender.core.asset.archive import replace_file
from ...drgs_blender.core.asset.container import write_asset
from ...drgs_blender.core.errors import UsageError, WriteError
from .. import assets, cache_playback, mesh_arrays, messages, proxies
from ..export.topology_check import check_modifiers, check_topology
from ..physics_settings import DrgsPhysicsCollider
from .forces import describe_field, fields_on, row_of
from .settings_export import OWNER, PANEL, describe, subject_of

Array = np.ndarray

BODY, SETTINGS, MATRICES, MOTION = "body.drgs", "settings.json", "matrices.npy", "motion.npy"
#: Settings of all bodies that are baked together.
BODIES = "bodies.json"
_COLLIDER = "collider_"
#: A file of a collider, as `_capture_motion` calls it after the object, its name as in URLs.
COLLIDER_FILE = re.compile(_COLLIDER + r"\d{3}_(.*?)\.(?:ply|npy)")
#: Standard output and log of the engine's program, beside its input.
STDOUT, LOG = "stdout.txt", "log.txt"
#: What STDOUT was called earlier: old bakes still have it.
_OLD_STDOUT = "said.txt"
#: Least volume to which the object may scale a cubic metre, as the engine holds it.
_FLATTEST = 1e-12
#: Types of attributes that can mark a part of a mesh.
_KINDS = {"BOOLEAN": bool, "FLOAT": np.float32, "INT": np.int32}


def export_scene(
    obj: bpy.types.Object,
    scene: bpy.types.Scene,
    folder: Path,
    *,
    still: bool = False,
    coupled: dict[str, Any] | None = None,
    bodies: Sequence[bpy.types.Object] = (),
) -> Generator[float, None, None]:
    """Write body, settings and all that moves into `folder`, which is emptied before.

    The scene is evaluated at every frame of the bake if anything in it may have an effect, and at its own again in
    the end, also when the generator is closed early.

    Parameters
    ----------
    obj : DR-GS object; what it was baked to before plays no part
    still : only the body, at the first frame
    coupled : settings of one that is baked with others
    bodies : those others, which are no colliders

    Yields
    ------
    float
        The part that is done.

    Raises
    ------
    AssetError, UsageError
        Naming the object that is in the way, and the remedy.
    WriteError
        Naming file and reason.
    """
    physics, subject = obj.drgs.physics, subject_of(obj)
    frames = range(physics.frame_start, physics.frame_end + 1)
    now = scene.frame_current, scene.frame_subframe
    with _writing(folder), cache_playback.hidden(obj):
        clear(folder)
        folder.mkdir(parents=True, exist_ok=True)
        try:
            scene.frame_set(frames[0])
            data = describe(obj, scene) | (coupled or {})
            vertices, faces, matrix = _read(obj, fits=True)
            if not (np.isfinite(vertices).all() and np.isfinite(matrix).all()):
                problem = "has vertices or a transform that are not finite in the first frame"
                raise UsageError(subject_of(obj), problem, "Correct them and their drivers")
            if abs(np.linalg.det(matrix[:3, :3])) < _FLATTEST:
                raise UsageError(subject_of(obj), "is scaled to nothing in the first frame", "Give it a size")
            data["matrix_world"] = matrix.tolist()
            _write_body(folder / BODY, obj, data, vertices, faces)
            if still:
                data |= {"pins": [], "last": frames[0]}
            else:
                obstacles = list(_obstacles(obj, bodies))
                yield from _capture_motion(obj, scene, frames, folder, data, (vertices, matrix), obstacles)
            text = json.dumps(data, indent=1, sort_keys=True)
            replace_file(folder / SETTINGS, [text.encode()])
        except ReferenceError as error:
            raise UsageError(
                subject, "a collider or force field was removed while the scene was read", "Bake again"
            ) from error
        finally:
            with suppress(ReferenceError):  # undo has made another scene, or it was removed
                scene.frame_set(now[0], subframe=now[1])
    yield 1.0


def stored(folder: Path) -> dict[str, Any] | None:
    """The settings that `export_scene` wrote last; None without."""
    try:
        data = json.loads((folder / SETTINGS).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return data if isinstance(data, dict) else None


def clear(folder: Path) -> None:
    """Remove what `export_scene` wrote and the folder, as far as nothing else is in it."""
    with suppress(OSError):
        for path in folder.iterdir():
            written = path.name in (BODY, SETTINGS, BODIES, MATRICES, MOTION, STDOUT, _OLD_STDOUT, LOG, OWNER)
            if written or path.name.startswith(_COLLIDER):
                path.unlink(missing_ok=True)
        os.rmdir(folder)


@contextmanager
def _writing(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise WriteError(
            str(error.filename or folder), f"cannot be written ({reason})", "Free some space or choose another folder"
        ) from error


def _capture_motion(
    obj: bpy.types.Object,
    scene: bpy.types.Scene,
    frames: range,
    folder: Path,
    data: dict[str, Any],
    rest: tuple[Array, Array],
    obstacles: list[tuple[bpy.types.Object, DrgsPhysicsCollider]],
) -> Iterator[float]:
    """Where colliders, fields, pinned parts and the object itself are in every frame; completes `data`."""
    vertices, matrix = rest
    pushing = fields_on(obj, scene)
    rows = [[row_of(other, obj.drgs.physics.fields, _depsgraph())] for other in pushing]
    motion = _Track(folder / MOTION, vertices, len(frames)) if data["pins"] else None
    matrices, tracks = [matrix], []
    data["colliders"] = []
    for i, (other, settings) in enumerate(obstacles):
        local, faces, placed = _read(other)
        world = _moved(local, placed)
        name = f"{_COLLIDER}{i:03d}_{quote(other.name, safe=' ')}"  # the engine's messages name the file
        _write_ply(folder / f"{name}.ply", world, faces)
        data["colliders"].append({"mesh": f"{name}.ply"} | _contact(settings))
        tracks.append(_Track(folder / f"{name}.npy", world, len(frames)))
    if tracks or pushing or motion is not None or _may_move(obj):
        to_rest = np.linalg.inv(matrix)
        for i, frame in enumerate(frames[1:], 1):
            scene.frame_set(frame)
            if motion is not None:
                now, _, placed = _read(obj, fits=True)
                motion.add(i, now if np.array_equal(placed, matrix) else _moved(now, to_rest @ placed))
            matrices.append(np.array(obj.evaluated_get(_depsgraph()).matrix_world, np.float64))
            for other, pushes in zip(pushing, rows):
                pushes.append(row_of(other, obj.drgs.physics.fields, _depsgraph()))
            for (other, _), track in zip(obstacles, tracks):
                local, _, placed = _read(other)
                if local.shape != track.first.shape:
                    raise UsageError(
                        subject_of(other),
                        f"has {len(local)} vertices in frame {frame} and {len(track.first)} at the start",
                        "A collider must keep them: remove the modifier that changes their number",
                    )
                track.add(i, _moved(local, placed))
            yield i / len(frames)
    data["fields"] = [
        describe_field(other) | {"frames": pushes if pushes != pushes[:1] * len(pushes) else pushes[:1]}
        for other, pushes in zip(pushing, rows)
    ]
    if motion is not None and motion.moved:
        data["motion"] = motion.path.name
    for entry, track in zip(data["colliders"], tracks):
        if track.moved:
            entry["vertices"] = track.path.name
    if any(not np.array_equal(m, matrix) for m in matrices):
        np.save(folder / MATRICES, np.stack(matrices))


def contacts(obj: bpy.types.Object, bodies: Sequence[bpy.types.Object]) -> list[dict[str, Any]]:
    """Contact settings of each collider, as `export_scene` writes it."""
    return [_contact(settings) for _, settings in _obstacles(obj, bodies)]


def _contact(settings: DrgsPhysicsCollider) -> dict[str, Any]:
    numbers = {name: float(f"{getattr(settings, name):.6g}") for name in ("friction", "thickness")}
    return {"contact": settings.contact} | numbers


class _Track:
    """Vertices of every frame on disk, for as long as they do not turn out to stand still.

    They are appended, not mapped into memory: where the disk is full that is an error, and not the end of Blender.

    Attributes
    ----------
    moved : whether anything did, so that the file exists
    """

    def __init__(self, path: Path, first: Array, frames: int) -> None:
        self.path, self.first = path, first
        self._frames = frames
        self.moved = False

    def add(self, index: int, vertices: Array) -> None:
        """Take the vertices of a frame in; frames come in order."""
        if self.moved:
            self._append([vertices])
        elif not np.array_equal(vertices, self.first):
            self.moved = True
            with open(self.path, "wb") as file:
                about = {"descr": "<f4", "fortran_order": False, "shape": (self._frames, *self.first.shape)}
                np.lib.format.write_array_header_1_0(file, about)
            self._append([self.first] * index + [vertices])

    def _append(self, frames: list[Array]) -> None:
        with open(self.path, "ab") as file:
            for vertices in frames:
                file.write(np.ascontiguousarray(vertices, "<f4").tobytes())


def _depsgraph() -> bpy.types.Depsgraph:
    return bpy.context.evaluated_depsgraph_get()


def _read(obj: bpy.types.Object, *, fits: bool = False) -> tuple[Array, Array, Array]:
    """Vertices (n, 3) float32, triangles (m, 3) int32, matrix to world (4, 4) float64, as evaluated now.

    Parameters
    ----------
    fits : the mesh must be the object's asset, moved, or its proxy
    """
    depsgraph = _depsgraph()
    evaluated = obj.evaluated_get(depsgraph)
    if not (evaluated.is_evaluated and obj.visible_get()):  # Blender does not evaluate the modifiers of others
        raise UsageError(subject_of(obj), "is hidden or in no collection of this view layer", "Show it while baking")
    if fits:
        check_modifiers(evaluated, depsgraph)
    mesh = evaluated.to_mesh(preserve_all_data_layers=True, depsgraph=depsgraph)
    try:
        asset = assets.load(assets.file_of(obj)) if fits else None
        if asset is not None and not proxies.is_proxy(mesh, asset):
            check_topology(evaluated, mesh, asset.mesh, lambda text: messages.note("INFO", text))
        vertices = mesh_arrays.read_vertices(mesh)
        corners, _ = mesh_arrays.read_loop_triangles(mesh)
        faces = mesh_arrays.read_corner_vertices(mesh)[corners]
    finally:
        evaluated.to_mesh_clear()
    if not len(faces):
        raise UsageError(subject_of(obj), "has no faces", f"Remove it from {PANEL}")
    return vertices, faces, np.array(evaluated.matrix_world, np.float64)


def _moved(vertices: Array, matrix: Array) -> Array:
    """(n, 3) float32 points by a (4, 4) matrix."""
    return (vertices @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)


def _may_move(obj: bpy.types.Object) -> bool:
    """Whether the object's transform may be animated."""
    while obj is not None:
        if obj.animation_data or obj.constraints or obj.parent_type in ("BONE", "VERTEX", "VERTEX_3"):
            return True
        obj = obj.parent
    return False


def _obstacles(
    obj: bpy.types.Object, bodies: Sequence[bpy.types.Object]
) -> Iterator[tuple[bpy.types.Object, DrgsPhysicsCollider]]:
    """Every collider once, with its settings; a row without anything chosen is none, nor is one of `bodies`."""
    seen = {obj.name_full, *(other.name_full for other in bodies)}
    for settings in obj.drgs.physics.colliders:
        chosen = [settings.object] if settings.object else []
        if settings.collection:
            chosen += settings.collection.all_objects
        for other in chosen:
            if other.type == "MESH" and other.name_full not in seen:
                seen.add(other.name_full)
                yield other, settings


def _write_body(path: Path, obj: bpy.types.Object, data: dict[str, Any], vertices: Array, faces: Array) -> None:
    """The mesh at rest, with the groups that the settings name, as an asset without surfels."""
    names = [entry["group"] for entry in (*data["regions"], *data["pins"])]
    groups = {name: _members(obj, name) for name in names}
    n = len(vertices)
    empty = np.empty((0, 3), np.float32)
    surfels = Surfels(
        centre=empty,
        scale=empty[:, :2],
        rotation=np.empty((0, 4), np.float32),
        opacity=empty[:, 0],
        albedo=empty,
        roughness=empty[:, 0],
        metallic=empty[:, 0],
    )
    mesh = Mesh(vertices, faces, np.ones((n, 3), np.float32), np.ones(n, np.float32), np.zeros(n, np.float32), groups)
    write_asset(path, Asset(surfels, mesh, Binding(np.empty(0, np.int32), empty, empty[:, 0], empty), None))


def _members(obj: bpy.types.Object, name: str) -> Array:
    """(k,) int32 vertices of a vertex group or an attribute, those of 0.5 and more."""
    if not name:
        raise UsageError(subject_of(obj), "a region has no group", f"Choose one in {PANEL} > Regions, or remove it")
    mesh = obj.data
    attribute = mesh.attributes.get(name)
    group = obj.vertex_groups.get(name)
    if group is not None:
        index = group.index
        found = [v.index for v in mesh.vertices for g in v.groups if g.group == index and g.weight >= 0.5]
        members = np.array(found, np.int32)
    elif attribute is not None and attribute.domain == "POINT" and attribute.data_type in _KINDS:
        values = np.empty(len(mesh.vertices), _KINDS[attribute.data_type])
        attribute.data.foreach_get("value", values)
        members = np.flatnonzero(values >= 0.5).astype(np.int32)
    else:
        raise UsageError(
            subject_of(obj), f'has no vertex group or point attribute "{name}"', f"Choose another in {PANEL}"
        )
    if not len(members):
        raise UsageError(subject_of(obj), f'"{name}" marks no vertex with 0.5 or more', "Paint it, or choose another")
    return members


def _write_ply(path: Path, vertices: Array, faces: Array) -> None:
    """A binary PLY of triangles."""
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(faces), [("count", "u1"), ("index", "<i4", 3)])
    rows["count"], rows["index"] = 3, faces
    path.write_bytes(head.encode() + np.ascontiguousarray(vertices, "<f4").tobytes() + rows.tobytes())
