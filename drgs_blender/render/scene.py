"""Everything rays can meet in one frame: all objects as one world-space triangle soup with one tree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..asset.model import as_float
from ..errors import UsageError
from ..jit import njit, prange
from .tree import TriangleBVH

Array = np.ndarray

#: Columns of ``TraceScene.shading``.
NORMAL, ALBEDO, ROUGHNESS, METALLIC, SHADING_WIDTH = slice(0, 3), slice(3, 6), 6, 7, 8

#: Coordinates beyond this (metres) are as unusable as NaN: their products overflow.
_FARTHEST = 1e15


@dataclass(slots=True)
class TraceObject:
    """One object as rays see it.

    Attributes
    ----------
    name : used in messages
    vertices : (n, 3) float32, metres, world space
    faces : (m, 3) int32
    albedo, roughness, metallic : per vertex (n, 3), (n,), (n,) in [0, 1]; linear Rec.709
    corner_normals : (m, 3, 3) float32, world space, or None: smooth angle-weighted vertex normals
    pass_index : Blender's object index pass
    """

    name: str
    vertices: Array
    faces: Array
    albedo: Array
    roughness: Array
    metallic: Array
    corner_normals: Array | None = None
    pass_index: int = 0


@dataclass(slots=True)
class ObjectFaults:
    """What was wrong with one object's mesh in the last update; such faces are invisible to rays."""

    name: str
    bad_vertices: int  # NaN, infinite or absurdly far
    bad_faces: int  # touch a bad vertex
    empty_faces: int  # have no area


@njit(parallel=True)
def _copy_vertices(source, target):  # type: ignore[no-untyped-def]
    """Copy usable vertices, put the others at the origin; return how many there are of the latter."""
    bad = 0
    for i in prange(len(source)):
        x, y, z = source[i, 0], source[i, 1], source[i, 2]
        if not (abs(x) < _FARTHEST and abs(y) < _FARTHEST and abs(z) < _FARTHEST):
            x = y = z = np.float32(0.0)
            bad += 1
        target[i, 0], target[i, 1], target[i, 2] = x, y, z
    return bad


@njit
def _corners_of_rows(shading_faces, rows):  # type: ignore[no-untyped-def]
    """CSR lists of the face corners (3 face + k) that share each shading row, in ascending order."""
    start = np.zeros(rows + 1, np.int32)
    flat = shading_faces.ravel()
    for row in flat:
        start[row + 1] += 1
    for row in range(rows):
        start[row + 1] += start[row]
    corners = np.empty(len(flat), np.int32)
    place = start[:-1].copy()
    for c in range(len(flat)):
        corners[place[flat[c]]] = c
        place[flat[c]] += 1
    return start, corners


@njit
def _acos(x):  # type: ignore[no-untyped-def]
    """acos to 7e-5: Abramowitz and Stegun 4.4.45."""
    a = abs(x)
    y = np.sqrt(max(np.float32(0.0), np.float32(1.0) - a)) * (
        np.float32(1.5707288) + a * (np.float32(-0.2121144) + a * (np.float32(0.0742610) + a * np.float32(-0.0187293)))
    )
    return y if x >= 0 else np.float32(np.pi) - y


@njit(parallel=True)
def _face_terms(vertices, faces, first, last, weighted):  # type: ignore[no-untyped-def]
    """Fill weighted[f] = (unit face normal, corner angles) of faces first..last; return how many have no area."""
    empty = 0
    for f in prange(first, last):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        vx, vy, vz = vertices[c, 0] - vertices[b, 0], vertices[c, 1] - vertices[b, 1], vertices[c, 2] - vertices[b, 2]
        wx, wy, wz = vertices[a, 0] - vertices[c, 0], vertices[a, 1] - vertices[c, 1], vertices[a, 2] - vertices[c, 2]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        area = np.sqrt(nx * nx + ny * ny + nz * nz)
        if not area > 0.0:
            empty += 1
            weighted[f, :] = np.float32(0.0)
            continue
        scale = np.float32(1.0) / area
        weighted[f, 0], weighted[f, 1], weighted[f, 2] = nx * scale, ny * scale, nz * scale
        u2, v2, w2 = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, wx * wx + wy * wy + wz * wz
        weighted[f, 3] = _acos(-(ux * wx + uy * wy + uz * wz) / np.sqrt(u2 * w2))
        weighted[f, 4] = _acos(-(ux * vx + uy * vy + uz * vz) / np.sqrt(u2 * v2))
        weighted[f, 5] = _acos(-(vx * wx + vy * wy + vz * wz) / np.sqrt(v2 * w2))
    return empty


@njit(parallel=True)
def _row_normals(weighted, start, corners, shading):  # type: ignore[no-untyped-def]
    """Sum angle-weighted face normals at each shading row, always in the same order."""
    for row in prange(len(shading)):
        x = y = z = np.float32(0.0)
        for k in range(start[row], start[row + 1]):
            f, c = corners[k] // 3, corners[k] % 3
            angle = weighted[f, 3 + c]
            x, y, z = x + angle * weighted[f, 0], y + angle * weighted[f, 1], z + angle * weighted[f, 2]
        length = np.sqrt(x * x + y * y + z * z)
        if length > np.float32(1e-12):
            scale = np.float32(1.0) / length
            x, y, z = x * scale, y * scale, z * scale
        else:
            x, y, z = np.float32(0.0), np.float32(0.0), np.float32(1.0)
        shading[row, 0], shading[row, 1], shading[row, 2] = x, y, z


@njit(parallel=True)
def _given_normals(normals, first, shading):  # type: ignore[no-untyped-def]
    """Overwrite normals from row `first` on by those given, where these are usable."""
    for i in prange(len(normals)):
        x, y, z = normals[i, 0], normals[i, 1], normals[i, 2]
        length = np.sqrt(x * x + y * y + z * z)
        if length > 1e-12 and length < _FARTHEST:
            scale = np.float32(1.0) / length
            shading[first + i, 0], shading[first + i, 1], shading[first + i, 2] = x * scale, y * scale, z * scale


@njit(parallel=True)
def _materials(rows, first, albedo, roughness, metallic, shading):  # type: ignore[no-untyped-def]
    """Copy the material of vertex rows[i] to shading row first + i, within [0, 1]; NaN becomes 0."""
    for i in prange(len(rows)):
        v = rows[i]
        for k in range(3):
            shading[first + i, 3 + k] = min(np.float32(1.0), max(np.float32(0.0), albedo[v, k]))
            if not shading[first + i, 3 + k] >= 0.0:
                shading[first + i, 3 + k] = 0.0
        shading[first + i, 6] = min(np.float32(1.0), max(np.float32(0.0), roughness[v]))
        shading[first + i, 7] = min(np.float32(1.0), max(np.float32(0.0), metallic[v]))
        for k in (6, 7):
            if not shading[first + i, k] >= 0.0:
                shading[first + i, k] = 0.0


@dataclass(slots=True)
class _Part:
    """Where an object lies in the scene's arrays, and the topology this was made for."""

    faces: Array
    vertex: slice
    face: slice
    row: slice
    rows: Array  # vertex of the object behind each of its shading rows
    smooth: bool

    def fits(self, item: TraceObject) -> bool:
        return (
            self.vertex.stop - self.vertex.start == len(item.vertices)
            and self.smooth == (item.corner_normals is None)
            and np.array_equal(self.faces, item.faces)
        )


class TraceScene:
    """All objects of a frame in world space.

    Attributes
    ----------
    bvh : TriangleBVH over everything
    vertices : (n, 3) float32, faces : (m, 3) int32: as traced (``bvh``'s own arrays); a face with a bad vertex is
        collapsed to one point
    face_object : (m,) int32: index of each face's object in the list given to ``update``
    shading_faces : (m, 3) int32: rows of ``shading`` at the corners of each face
    shading : (k, 8) float32: unit shading normal (3), albedo (3), roughness, metallic
    pass_index : (objects,) int32
    extent : float, metres: the largest absolute coordinate, the scale of rounding errors
    faults : what was wrong, one entry an object
    """

    def __init__(self) -> None:
        self.bvh = TriangleBVH()
        self.shading_faces: Array = np.empty((0, 3), np.int32)
        self.shading: Array = np.empty((0, SHADING_WIDTH), np.float32)
        self.face_object: Array = np.empty(0, np.int32)
        self.pass_index: Array = np.empty(0, np.int32)
        self.extent = 0.0
        self.faults: list[ObjectFaults] = []
        self._parts: list[_Part] = []
        self._vertex_count = 0
        self._faces: Array = np.empty((0, 3), np.int32)  # all of them, bad or not
        self._traced: Array = self._faces  # what the tree was built with
        self._weighted: Array = np.empty((0, 6), np.float32)
        self._start: Array = np.zeros(1, np.int32)
        self._corners: Array = np.empty(0, np.int32)

    @property
    def vertices(self) -> Array:
        """(n, 3) float32 world-space vertices of all objects, metres."""
        return self.bvh.vertices

    @property
    def faces(self) -> Array:
        """(m, 3) int32 faces of all objects, as traced."""
        return self.bvh.faces

    def update(self, objects: list[TraceObject]) -> None:
        """Take the objects of a new frame: refit when only vertices or materials changed, rebuild otherwise.

        Raises
        ------
        UsageError
            When an object's arrays do not fit together.
        """
        same = len(objects) == len(self._parts) and all(p.fits(o) for p, o in zip(self._parts, objects))
        if not same:
            self._lay_out(objects)
        self.pass_index = np.array([o.pass_index for o in objects], np.int32)
        self.faults = [ObjectFaults(o.name, 0, 0, 0) for o in objects]
        vertices = self.bvh.vertices if same else np.empty((self._vertex_count, 3), np.float32)
        for part, item, fault in zip(self._parts, objects, self.faults):
            given = as_float(item.vertices, (-1, 3), f"vertices of {item.name}")
            fault.bad_vertices = int(_copy_vertices(given, vertices[part.vertex]))
        faces = self._without_bad_vertices(objects) if any(f.bad_vertices for f in self.faults) else self._faces
        if same and (faces is self._traced or np.array_equal(faces, self._traced)):
            self.bvh.refit()
        else:
            self.bvh.build(vertices, faces)
            self._traced = faces
        self.extent = float(np.abs(vertices).max(initial=0.0))
        self._shade(objects)

    def close(self) -> None:
        """Give the tree's memory back."""
        self.bvh.close()

    def _lay_out(self, objects: list[TraceObject]) -> None:
        """Give every object its place in the scene's arrays; all that depends on topology alone."""
        self._parts = []
        faces, shading_faces = [np.empty((0, 3), np.int32)], [np.empty((0, 3), np.int32)]
        vertex = face = row = 0
        for item in objects:
            n, own = len(item.vertices), np.array(item.faces, np.int32).reshape(-1, 3)
            m = len(own)
            if m and (own.min() < 0 or own.max() >= n):
                raise UsageError(item.name, f"faces refer to vertices outside 0..{n - 1}", "Check the mesh's indices")
            smooth = item.corner_normals is None
            # Corners with normals of their own get a shading row each.
            rows = np.arange(n, dtype=np.int32) if smooth else own.ravel()
            faces.append(own + np.int32(vertex))
            shading_faces.append((own if smooth else np.arange(3 * m, dtype=np.int32).reshape(m, 3)) + np.int32(row))
            spans = slice(vertex, vertex + n), slice(face, face + m), slice(row, row + len(rows))
            self._parts.append(_Part(own, spans[0], spans[1], spans[2], rows, smooth))
            vertex, face, row = (span.stop for span in spans)
        self._vertex_count = vertex
        self._faces = np.concatenate(faces)
        self.shading_faces = np.concatenate(shading_faces)
        self.shading = np.zeros((row, SHADING_WIDTH), np.float32)
        counts = [len(p.faces) for p in self._parts]
        self.face_object = np.repeat(np.arange(len(objects), dtype=np.int32), counts)
        self._weighted = np.empty((face, 6), np.float32)
        self._start, self._corners = _corners_of_rows(self.shading_faces, row)

    def _without_bad_vertices(self, objects: list[TraceObject]) -> Array:
        """Faces with those that touch a bad vertex collapsed to one point."""
        faces = self._faces.copy()
        for part, item, fault in zip(self._parts, objects, self.faults):
            with np.errstate(invalid="ignore"):
                bad = ~(np.abs(np.asarray(item.vertices)) < _FARTHEST).all(axis=1)
            dead = bad[part.faces].any(axis=1)
            fault.bad_faces = int(dead.sum())
            faces[part.face][dead] = part.vertex.start
        return faces

    def _shade(self, objects: list[TraceObject]) -> None:
        """Recompute shading normals and copy materials."""
        for part, fault in zip(self._parts, self.faults):
            empty = _face_terms(self.vertices, self.faces, part.face.start, part.face.stop, self._weighted)
            fault.empty_faces = int(empty) - fault.bad_faces
        _row_normals(self._weighted, self._start, self._corners, self.shading)
        for part, item in zip(self._parts, objects):
            if item.corner_normals is not None:
                normals = as_float(item.corner_normals, (len(part.faces), 3, 3), f"corner normals of {item.name}")
                _given_normals(normals.reshape(-1, 3), part.row.start, self.shading)
            n = part.vertex.stop - part.vertex.start
            albedo = as_float(item.albedo, (n, 3), f"albedo of {item.name}")
            roughness = as_float(item.roughness, (n,), f"roughness of {item.name}")
            metallic = as_float(item.metallic, (n,), f"metallic of {item.name}")
            _materials(part.rows, part.row.start, albedo, roughness, metallic, self.shading)
