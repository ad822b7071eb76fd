"""Proxy meshes: what Blender shows and bends in place of a capture that has no mesh.

Each vertex knows where it stands when the surfels are as they were captured; armatures, lattices, cages, shape keys,
simulations and nodes move it as they move any mesh, and the surfels follow.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable
from typing import NamedTuple

import bpy
import numpy as np

from ..drgs_blender.core.asset import Asset
from ..drgs_blender.core.frame import ProxyMesh
from . import lookups, mesh_arrays

Array = np.ndarray

#: Attribute with the place of each vertex at rest, object space, metres; 0, as Blender has it, of those added later.
REST = "drgs_rest"
#: Property of a proxy's mesh that its copies and parts share.
_MADE = "drgs_proxy"
#: Modifiers that copy or thicken a mesh.
_COPYING = {"ARRAY", "MIRROR", "SOLIDIFY", "BEVEL", "WIREFRAME", "SCREW"}
#: Parts along the longest side of the surfels, each of which viewports move rigidly, and vertices that move each.
_PARTS, _NEAREST = 32, 12
#: Divisions that are kept.
_KEPT = 8


def is_proxy(mesh: bpy.types.Mesh, asset: Asset) -> bool:
    """Whether a mesh stands for an asset that has none."""
    attribute = mesh.attributes.get(REST)
    known = attribute is not None and (attribute.data_type, attribute.domain) == ("FLOAT_VECTOR", "POINT")
    return known and not len(asset.mesh.vertices) and bool(len(mesh.vertices))


def fill(mesh: bpy.types.Mesh, vertices: Array, triangles: Array) -> None:
    """Make an empty mesh a proxy of (n, 3) vertices and (m, 3) triangles, object space, which are at rest."""
    vertices = np.where(vertices.any(axis=1, keepdims=True), vertices, 1e-9)
    mesh.clear_geometry()
    mesh.from_pydata(vertices.tolist(), [], triangles.tolist())
    mesh[_MADE] = uuid.uuid4().hex
    attribute = mesh.attributes.new(REST, "FLOAT_VECTOR", "POINT")
    attribute.data.foreach_set("vector", np.ascontiguousarray(vertices, np.float32).ravel())
    mesh.update()


def check(obj: bpy.types.Object, rest: Array, warn: Callable[[str], None], *, final: bool) -> None:
    """Warn of what an evaluated proxy has that does not move surfels as it looks; `rest` is that of `read_rest`."""
    if lost := int((~np.isfinite(rest).all(axis=1)).sum()):
        warn(
            f'"{obj.name}": {lost} vertices of its proxy do not know where they are at rest (added by hand, or joined '
            "to it), so they carry nothing"
        )
    for modifier in obj.original.modifiers:
        if not (modifier.show_render if final else modifier.show_viewport):
            continue
        smooth = modifier.type == "SUBSURF" and modifier.subdivision_type != "SIMPLE"
        if smooth and (modifier.render_levels if final else modifier.levels):
            warn(
                f'"{obj.name}": modifier "{modifier.name}" shrinks its proxy, and its surfels with it: set it to Simple'
            )
        elif modifier.type in _COPYING:
            warn(
                f'"{obj.name}": modifier "{modifier.name}" gives its proxy another shape, which surfels take for a '
                "motion: disable it"
            )


def read(mesh: bpy.types.Mesh) -> ProxyMesh | None:
    """What an evaluated proxy does; None where it is as at rest."""
    proxy = read_pose(mesh)
    return None if np.array_equal(proxy.rest, proxy.vertices) else proxy


def read_pose(mesh: bpy.types.Mesh) -> ProxyMesh:
    """What an evaluated proxy does, also at rest.

    Vertices of no face are left out where there are faces, and those that do not know where they are at rest.
    """
    rest = read_rest(mesh)
    vertices, faces = mesh_arrays.read_vertices(mesh), mesh_arrays.loop_triangles(mesh)
    known = np.isfinite(rest).all(axis=1)
    faces = faces[known[faces].all(axis=1)]
    used = np.flatnonzero(known)
    if len(faces):
        used, faces = np.unique(faces, return_inverse=True)
    rest, vertices = np.ascontiguousarray(rest[used]), np.ascontiguousarray(vertices[used])
    faces = np.ascontiguousarray(faces.reshape(-1, 3), np.int32)
    for array in (rest, vertices, faces):
        array.flags.writeable = False  # so that the engine's client need not copy it
    return ProxyMesh(rest, vertices, faces)


def read_rest(mesh: bpy.types.Mesh) -> Array:
    """(n, 3) float32 places of the vertices of a proxy at rest; NaN of those that do not know theirs."""
    rest = np.empty((len(mesh.vertices), 3), np.float32)
    mesh.attributes[REST].data.foreach_get("vector", rest.ravel())
    rest[~rest.any(axis=1)] = np.nan
    return rest


class Separated:
    """Tells of proxies that were one mesh once: each of them shows all surfels."""

    def __init__(self, warn: Callable[[str], None]) -> None:
        self._warn = warn
        self._known: dict[str, dict[int, tuple[str, Array]]] = {}

    def add(self, obj: bpy.types.Object) -> None:
        """Take in an evaluated object that has a proxy."""
        parts = self._known.setdefault(str(obj.original.data.get(_MADE, obj.name)), {})
        key = obj.original.data.as_pointer()
        if key in parts:  # as instances and linked copies have it
            return
        rest = read_rest(obj.original.data)
        rows = _rows(rest) if parts else set()
        for name, others in ((name, _rows(known)) for name, known in parts.values()):
            if 2 * len(rows & others) < min(len(rows), len(others)):  # both have the rim of the cut
                self._warn(
                    f'"{name}" and "{obj.name}": parts of one proxy, so the surfels are there twice. Take them away '
                    "from each by Crop or Edit Surfels, or undo the separation"
                )
                break
        parts[key] = obj.name, rest


def _rows(rest: Array) -> set[bytes]:
    return {row.tobytes() for row in rest[np.isfinite(rest).all(axis=1)]}


class _Parts(NamedTuple):
    """Parts of space: which one each surfel is in, and the vertices that move each, at rest."""

    centre: Array
    rest: Array
    part: Array
    nearest: Array
    weight: Array
    middle: Array
    offset: Array


#: The last first. What is left of an asset is another array after every edit, so that values count.
_parts: list[_Parts] = []


def carried(centre: Array, proxy: ProxyMesh, rows: Array | slice = slice(None)) -> Array:
    """(n, 3) float32 about where a proxy takes surfels of an asset, for viewports; the engine's are exact.

    Parameters
    ----------
    centre : (n, 3) float32 array
        Of the surfels at rest.
    proxy : ProxyMesh
    rows : (k,) int array or slice
        Chooses surfels.
    """
    parts = lookups.recall(
        _parts,
        lambda known: _same(known.centre, centre) and _same(known.rest, proxy.rest),
        lambda: _divided(centre, proxy.rest),
        _KEPT,
    )
    now = proxy.vertices.astype(np.float64)[parts.nearest]
    middle = np.einsum("pk,pkc->pc", parts.weight, now)
    moved = np.nan_to_num(now - middle[:, None])
    u, _, vt = np.linalg.svd(np.einsum("pk,pki,pkj->pij", parts.weight, moved, parts.offset))
    side = np.ones((len(u), 3))
    side[:, 2] = np.linalg.det(u @ vt)
    turn = (u * side[:, None]) @ vt
    at = parts.part[rows]
    found = np.einsum("nij,nj->ni", turn[at], centre[rows] - parts.middle[at]) + middle[at]
    return np.ascontiguousarray(found, np.float32)


def _same(a: Array, b: Array) -> bool:
    return a is b or np.array_equal(a, b)


def _divided(centre: Array, rest: Array) -> _Parts:
    side = max(float(np.ptp(centre, axis=0).max()) / _PARTS, 1e-9)
    cells, part = np.unique(np.floor(centre / side).astype(np.int32), axis=0, return_inverse=True)
    nearest, distance = lookups.nearest(rest, (cells + 0.5) * side, _NEAREST)
    weight = 1.0 / (distance**2 + (0.25 * side) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    places = rest.astype(np.float64)[nearest]
    middle = np.einsum("pk,pkc->pc", weight, places)
    return _Parts(centre, rest, part.reshape(-1), nearest, weight, middle, places - middle[:, None])
