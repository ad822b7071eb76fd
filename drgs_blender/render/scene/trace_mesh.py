"""One object's place in the traced scene: how its vertices, normals and materials get there.

Nothing that stays the same is done again. An array of an object is taken for unchanged when it is the same array as in
the last update; nobody may write into it meanwhile.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ...compute.jit import plain
from ...compute.threads import ELEMENTS, over_range
from ...core.arrays import outside
from ...core.asset.model import as_float
from ...core.errors import UsageError
from ...core.frame import MeshState, Visibility
from ...geometry.normals import VertexNormals
from ..surfel_columns import NORMAL
from .instances import Instances, flattens, normal_matrices
from .object_mesh import ObjectMesh
from .ray_masks import ORDINARY, group_mask
from .trace_kernels import (
    FARTHEST,
    copy_materials,
    copy_vertices,
    corner_normals,
    count_empty,
    move_vertices,
    turn_normals,
    unit_normals,
)

Array = np.ndarray

_NORMALS = ("corner_normals", "vertex_normals")


@dataclass(slots=True)
class TraceObject:
    """One DR-GS object as rays see it.

    Attributes
    ----------
    name : str
        Used in messages.
    vertices : (n, 3) float32 array
        Metres, world space.
    faces : (m, 3) int32 array
    albedo : (n, 3) array
        Per vertex in [0, 1]; linear Rec.709.
    roughness, metallic : (n,) array
        Per vertex in [0, 1]; linear Rec.709.
    corner_normals : (m, 3, 3) float32 array, optional
        World space, or None: smooth angle-weighted vertex normals.
    pass_index : int
        Blender's object index pass.
    visibility : Visibility
        Which rays meet it.
    seen_only : bool
        Whether only the camera meets its triangles, light its surfels.
    sheeted : bool
        Whether light meets sheets of its surfels (`surfels.sheets`).
    torn : (m,) bool array, optional
        Faces that no ray meets.
    terminator_offset : float
        See `terminator`.
    """

    name: str
    vertices: Array
    faces: Array
    albedo: Array
    roughness: Array
    metallic: Array
    corner_normals: Array | None = None
    pass_index: int = 0
    visibility: Visibility = field(default_factory=Visibility)
    seen_only: bool = False
    sheeted: bool = False
    torn: Array | None = None
    terminator_offset: float = 0.0


@dataclass(slots=True)
class Part:
    """One object or mesh in the scene's arrays.

    Attributes
    ----------
    source : int
        Its index among the objects, then meshes, of the update.
    item : TraceObject or MeshState, optional
        The object of the last update; None before the first.
    faces : (m, 3) int32 array
        Of its own vertices.
    vertex, face, row : slice
        Its rows among vertices, faces, and ``shading`` (objects) or ``normals`` (meshes).
    mask : int
        Of its group.
    smooth : bool
        Whether normals are made from the faces.
    instanced : bool
        Whether its vertices are in object space.
    dead : (m,) bool array, optional
        Faces that touch an unusable vertex or are torn.
    reach : float
        Metres, the largest coordinate of its vertices.
    bad_vertices, bad_faces : int
        Numbers of unusable vertices, and of faces with one.
    empty_faces, flat_faces : int
        Without area as a shape, and where its matrix puts it.
    """

    source: int
    name: str
    faces: Array
    vertex: slice
    face: slice
    row: slice
    mask: int
    smooth: bool
    instanced: bool = False
    item: TraceObject | MeshState | None = None
    dead: Array | None = None
    reach: float = 0.0
    bad_vertices: int = 0
    bad_faces: int = 0
    empty_faces: int = 0
    flat_faces: int = 0
    smoother: VertexNormals | None = None
    own_normals: Array | None = None  # of meshes, object space

    def fits(self, item: TraceObject | MeshState, instances: Instances | None) -> bool:
        """Whether `item` can take the part's place without a new layout."""
        return (
            self.smooth == (item.corner_normals is None)
            and self.instanced == (instances is not None and instances.instanced)
            and self.mask == mask_of(item)
            and self.vertex.stop - self.vertex.start == len(item.vertices)
            and (self.faces is item.faces or np.array_equal(self.faces, item.faces))
        )

    @property
    def owner(self) -> int:
        """Which of the objects, or behind them of the meshes, its faces are of."""
        return self.item.owner if isinstance(self.item, ObjectMesh) else self.source

    @property
    def corner_rows(self) -> Array:
        """(m, 3) int32: which of its rows of normals each corner has."""
        return self.faces if self.smooth else np.arange(self.faces.size, dtype=np.int32).reshape(-1, 3)

    @property
    def traced_faces(self) -> Array:
        """Its faces with the dead ones collapsed to one point, where no ray meets them."""
        if self.dead is None:
            return self.faces
        faces = self.faces.copy()
        faces[self.dead] = 0
        return faces

    def take_vertices(
        self, vertices: Array, matrix: Array | None, target: Array, torn: Array | None = None
    ) -> tuple[bool, bool]:
        """Bring (n, 3) `vertices`, moved by a (3, 4) matrix, to `target`; returns (anything moved, other dead faces).

        Unusable vertices are put at the origin.
        """
        bad, moved, self.reach = _put_vertices(plain(vertices), matrix, target)
        self.bad_vertices, self.bad_faces = bad, 0
        before, dead = self.dead, torn
        if bad:
            with np.errstate(invalid="ignore", over="ignore"):
                world = vertices if matrix is None else vertices @ matrix[:, :3].T + matrix[:, 3]
                unusable = ~(np.abs(world) < FARTHEST).all(axis=1)
            dead = unusable[self.faces].any(axis=1)
            self.bad_faces = int(dead.sum())
            dead = dead if torn is None else dead | torn
        self.dead = dead
        same = before is dead or (before is not None and dead is not None and np.array_equal(before, dead))
        return bool(moved), not same

    def count_empty(self, vertices: Array) -> int:
        """Living faces without area."""
        faces = self.traced_faces
        empty = over_range(count_empty, len(faces), plain(vertices), plain(faces), fewest=ELEMENTS)
        return sum(empty) - (0 if self.dead is None else int(self.dead.sum()))

    def smooth_normals(self, vertices: Array, out: Array) -> None:
        """Normals of `vertices` from the living faces, into (n, 3) `out`."""
        if self.smoother is None:
            self.smoother = VertexNormals(self.faces, len(vertices))
        empty = self.smoother.into(vertices, self.traced_faces, out)
        self.empty_faces = empty - (0 if self.dead is None else int(self.dead.sum()))

    def vertex_normals(self, normals: Array, vertices: Array, out: Array) -> None:
        """Unit normals from those given, one per vertex, into (n, 3) `out`; (0, 0, 1) where they are unusable."""
        given = as_float(normals, out.shape, f"vertex normals of {self.name}")
        over_range(unit_normals, len(out), plain(given), out, fewest=ELEMENTS)
        self.empty_faces = self.count_empty(vertices)

    def given_normals(self, normals: Array, vertices: Array, out: Array) -> None:
        """Unit normals from those given, one a corner, into (3 m, 3) `out`; a face's own where they are unusable."""
        given = as_float(normals, (len(self.faces), 3, 3), f"corner normals of {self.name}")
        faces = self.traced_faces
        empty = over_range(corner_normals, len(faces), plain(given), vertices, faces, out, fewest=ELEMENTS)
        self.empty_faces = sum(empty) - (0 if self.dead is None else int(self.dead.sum()))


def mask_of(item: TraceObject | MeshState) -> int:
    """Group mask of an object or a mesh."""
    if isinstance(item, TraceObject) or (isinstance(item, ObjectMesh) and not item.ordinary):
        return group_mask(item.visibility, True, item.seen_only)
    if isinstance(item, ObjectMesh) and item.tied:
        return group_mask(item.visibility, True, item.seen_only) | ORDINARY * item.visibility.camera
    return group_mask(item.visibility, False, clear=any(material.clear for material in item.materials))


def own_faces(item: TraceObject | MeshState) -> Array:
    """(m, 3) int32 faces of `item`; UsageError when they refer to vertices that do not exist."""
    faces = np.ascontiguousarray(item.faces, np.int32).reshape(-1, 3)
    n = len(item.vertices)
    if outside(faces, n) is not None:
        raise UsageError(item.name, f"faces refer to vertices outside 0..{n - 1}", "Check the mesh's indices")
    return faces


def take_object(part: Part, item: TraceObject, vertices: Array, shading: Array) -> tuple[bool, bool]:
    """Bring an object up to date in the scene's `vertices` and `shading`; what `Part.take_vertices` returns."""
    before = part.item if isinstance(part.item, TraceObject) else None
    moved, died = False, False
    own, rows = vertices[part.vertex], shading[part.row]
    if before is None or before.vertices is not item.vertices or before.torn is not item.torn:
        given = as_float(item.vertices, (-1, 3), f"vertices of {item.name}")
        moved, died = part.take_vertices(given, None, own, item.torn)
    if before is None or moved or died or before.corner_normals is not item.corner_normals:
        if item.corner_normals is None:
            part.smooth_normals(own, rows[:, NORMAL : NORMAL + 3])
        else:
            part.given_normals(item.corner_normals, own, rows[:, NORMAL : NORMAL + 3])
    names = ("albedo", "roughness", "metallic")
    if before is None or any(getattr(before, name) is not getattr(item, name) for name in names):
        n = len(own)
        of_rows = np.arange(n, dtype=np.int32) if part.smooth else part.faces.ravel()
        albedo = as_float(item.albedo, (n, 3), f"albedo of {item.name}")
        roughness = as_float(item.roughness, (n,), f"roughness of {item.name}")
        metallic = as_float(item.metallic, (n,), f"metallic of {item.name}")
        values = plain(albedo), plain(roughness), plain(metallic)
        over_range(copy_materials, len(of_rows), of_rows, *values, rows, fewest=ELEMENTS)
    part.item = item
    return moved, died


def take_mesh(part: Part, item: MeshState, instances: Instances, vertices: Array, normals: Array) -> tuple[bool, bool]:
    """Bring a mesh up to date in the scene's `vertices` and `normals`; what `Part.take_vertices` returns."""
    before = part.item if isinstance(part.item, MeshState) else None
    own, rows = vertices[part.vertex], normals[part.row]
    given = as_float(item.vertices, (-1, 3), f"vertices of {item.name}")
    matrix = None if part.instanced else instances.matrices[0]
    moved, died = False, False
    other_shape = before is None or before.vertices is not item.vertices
    if other_shape or not part.instanced:
        moved, died = part.take_vertices(given, matrix, own)
    same = before is not None and all(getattr(before, name) is getattr(item, name) for name in _NORMALS)
    if other_shape or died or not same:
        if part.own_normals is None:
            part.own_normals = rows if part.instanced else np.empty_like(rows)
        # In object space, as Blender makes them: a stretched shape has the normals of the shape, stretched.
        if item.corner_normals is not None:
            part.given_normals(item.corner_normals, given, part.own_normals)
        elif item.vertex_normals is not None:
            part.vertex_normals(item.vertex_normals, given, part.own_normals)
        else:
            part.smooth_normals(given, part.own_normals)
    if matrix is not None:
        turn = normal_matrices(instances.matrices[:1])[0]
        over_range(turn_normals, len(rows), part.own_normals, turn, rows, fewest=ELEMENTS)
        part.flat_faces = part.count_empty(own) if flattens(matrix) else 0
    part.item = item
    return moved, died


def place_vertices(vertices: Array | None, matrix: Array | None, target: Array) -> None:
    """Bring (n, 3) `vertices`, moved by a (3, 4) matrix, to `target`; what is unusable or None leaves it as it is."""
    if vertices is None or np.shape(vertices) != target.shape:
        return
    moved = np.empty_like(target)
    given = plain(np.asarray(vertices, np.float32))
    bad, _, _ = _put_vertices(given, matrix, moved)
    if bad:
        with np.errstate(invalid="ignore", over="ignore"):
            world = given if matrix is None else given @ matrix[:, :3].T + matrix[:, 3]
            usable = (np.abs(world) < FARTHEST).all(axis=1)
        target[usable] = moved[usable]
    else:
        target[:] = moved


def _put_vertices(source: Array, matrix: Array | None, target: Array) -> tuple[int, int, float]:
    """Usable vertices, moved by a matrix; how many are not, how many changed, the largest coordinate."""
    kernel, arguments = (copy_vertices, ()) if matrix is None else (move_vertices, (matrix,))
    found = over_range(kernel, len(source), source, *arguments, target, fewest=ELEMENTS)
    bad, moved, reach = zip(*found, strict=True) if found else ((), (), ())
    return sum(bad), sum(moved), max(reach, default=0.0)
