"""Mesh lights: surfaces that emit, sampled by triangles, one of which is picked by `mesh_light_tree`.

What a triangle is estimated to send takes the mean of its texture; what it sends is looked up exactly.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ...compute.jit import njit
from ...core.color import LUMINANCE as WEIGHTS
from ..memory import AddressOf, address, load_float, load_int32, load_int64
from ..sampling import ONE, ZERO, F, unit
from ..scene.interaction import Geometry, emitted
from ..scene.mesh_materials import EmissiveMesh
from ..scene.see_through import opacity_at
from ..scene.trace_scene import TraceScene
from .light_shapes import DIFFUSE, GLOSSY, SHADOW
from .mesh_light_tree import Tree, build, emitter_probability, emitters_weight, morton_order, pick_emitter
from .triangle_light import (
    ABSENT,
    AREA,
    BITS,
    CLOSED,
    CORNER,
    EDGE,
    LONGEST,
    LUMINANCE,
    NORMAL,
    SIDE,
    WIDTH,
    triangle_density,
    triangle_direction,
)

Array = np.ndarray

#: Triangles that are sampled; meshes with the most are left to chance first.
MOST = 1 << 20
#: Triangles that have less than this part of the power are left to chance, and those with less area (square metres).
_FAINTEST, _SMALLEST = 1e-9, 1e-18
#: Barycentric coordinates at which a triangle's texture is looked up.
_LOOKUPS = np.array([[4, 4, 4], [8, 2, 2], [2, 8, 2], [2, 2, 8]], np.float32) / 12


class EmitterTables(NamedTuple):
    """Emitters for compiled code; valid as long as they live and the scene is not updated. All are int64.

    Attributes
    ----------
    tree : Tree
        See `mesh_light_tree`.
    faces : int
        Address of (n,) int32, the scene's face of each row.
    slot : int
        Address of (m - vertex_faces,) int32, of each face, or -1; counted within the mesh where it is instanced.
    first : int
        Address of (instances,) int32, offset of each instance.
    row : int
        Address of (slots,) int32, or -1.
    geometry : Geometry
        The scene's.
    """

    tree: Tree
    faces: int
    slot: int
    first: int
    row: int
    geometry: Geometry


class Emitters:
    """The emitting triangles of a scene.

    Parameters
    ----------
    scene : TraceScene, optional
        None: there are none.
    previous : Emitters, optional
        Of the frame before; what has not changed is taken over.
    receivers : int, optional
        Only meshes that shine on objects with these bits of ``Visibility.lit_by``; None: all.

    Attributes
    ----------
    count : int
        Triangles that are sampled.
    rays_differ : bool
        Whether diffuse and glossy rays see different lights.
    warnings : list of str
    """

    def __init__(
        self, scene: TraceScene | None = None, previous: Emitters | None = None, receivers: int | None = None
    ) -> None:
        self._scene = scene
        meshes = scene.emissive_meshes if scene is not None else []
        if receivers is not None:
            meshes = [m for m in meshes if m.mesh.receivers < 0 or receivers >> m.mesh.receivers & 1]
        self._known: list[Any] = [scene and scene.mesh_materials.table]
        for emitter in meshes:
            self._known += [
                emitter.mesh,
                int(emitter.faces[0]),
                None if emitter.instances is None else emitter.instances.start,
            ]
        if previous is not None and _same(self._known, previous._known):
            self._take(previous)
            return
        self.warnings: list[str] = []
        self.rows, self.faces = np.zeros((1, WIDTH), np.float32), np.zeros(1, np.int32)
        self.slot, self.first, self.row = (np.full(1, -1, np.int32) for _ in range(3))
        self.count, self.scale, self.rays_differ = 0, 0.0, False
        self._shut: list[tuple[Array, bool]] = []  # faces of meshes, whether they are closed
        if scene is not None and meshes:
            self._gather(scene, meshes, previous._shut if previous is not None else [])
        self.nodes, self.sums = build(self.rows[: self.count], self.scale)

    def _take(self, other: Emitters) -> None:
        names = (
            "warnings",
            "rows",
            "faces",
            "slot",
            "first",
            "row",
            "count",
            "scale",
            "rays_differ",
            "nodes",
            "sums",
            "_shut",
        )
        for name in names:
            setattr(self, name, getattr(other, name))

    @property
    def address(self) -> int:
        """Address of the tables for compiled code, 0 where there are none; until the next update of the scene."""
        return self.address_at(address)

    def address_at(self, address_of: AddressOf) -> int:
        """`address` of arrays that lie elsewhere."""
        if self._scene is None or not self.count:
            return 0
        where = [address_of(array) for array in (self.rows, self.nodes, self.sums)] + [self.count, len(self.nodes) // 2]
        where += [address_of(array) for array in (self.faces, self.slot, self.first, self.row)]
        self._tables = np.array([*where, *self._scene.geometry_at(address_of)], np.int64)
        return address_of(self._tables)

    def power(self, centre: Array, radius: float) -> float:
        """Luminance that arrives at a sphere from all directions together, as `Lights.power`."""
        if not self.count:
            return 0.0
        rows = self.rows.astype(np.float64)
        middle = rows[:, CORNER : CORNER + 3] + (rows[:, EDGE : EDGE + 3] + rows[:, SIDE : SIDE + 3]) / 3.0
        square = np.maximum(((middle - centre) ** 2).sum(axis=1), max(float(radius), 1e-9) ** 2)
        return float((rows[:, LUMINANCE] * rows[:, AREA] / square).sum() * self.scale)

    def _gather(self, scene: TraceScene, meshes: list[EmissiveMesh], known: list[tuple[Array, bool]]) -> None:
        """Fill all arrays."""
        sizes = [
            len(emitter.faces) * (1 if emitter.instances is None else len(emitter.instances)) for emitter in meshes
        ]
        slots = 0
        kept: list[tuple[EmissiveMesh, int, int]] = []
        self.slot = np.full(len(scene.faces) - scene.vertex_faces, -1, np.int32)
        self.first = np.zeros(max(len(scene.instances), 1), np.int32)
        for index in np.argsort(sizes, kind="stable"):
            emitter, size = meshes[index], sizes[index]
            if slots + size > MOST:
                self.warnings.append(
                    f"{emitter.mesh.name}: {size} emitting faces are too many to be sampled; rays find them by chance"
                )
                continue
            kept.append((emitter, slots, size))
            slots += size
        rows, faces = np.zeros((slots, WIDTH), np.float32), np.zeros(slots, np.int32)
        here = np.eye(3, 4, dtype=np.float32)[None]
        for emitter, start, size in kept:
            own = np.arange(len(emitter.faces), dtype=np.int32)
            self.slot[emitter.faces - scene.vertex_faces] = own + (start if emitter.instances is None else 0)
            matrices = here
            if emitter.instances is not None:
                self.first[emitter.instances.start : emitter.instances.stop] = start + len(own) * np.arange(
                    len(emitter.instances)
                )
                matrices = scene.instances[emitter.instances.start : emitter.instances.stop]
            part = slice(start, start + size)
            v = emitter.mesh.visibility
            bits = DIFFUSE * v.diffuse | GLOSSY * v.glossy | SHADOW | ABSENT * (not v.shadow_catcher)
            self.rays_differ |= v.diffuse != v.glossy
            faces[part] = np.tile(emitter.faces, len(matrices))
            shut = next((entry for entry in known if entry[0] is emitter.mesh.faces), None)
            shut = shut or (emitter.mesh.faces, _is_closed(emitter.mesh.faces))
            self._shut.append(shut)
            bits |= CLOSED * shut[1]
            # Normals look outwards where the surface is closed; a mirrored instance turns the order of the corners.
            inwards = shut[1] and _volume(scene.vertices, scene.faces[emitter.shape]) < 0.0
            turned = (np.linalg.det(matrices[:, :, :3]) < 0.0) != inwards
            luminance = _luminance(emitter, scene)
            _fill(emitter.faces, scene.vertices, scene.faces, matrices, luminance, F(bits), turned, rows[part])
        self._order(rows, faces)

    def _order(self, rows: Array, faces: Array) -> None:
        """Keep the rows that count, in the order of the tree."""
        # Products of what the tree handles stay within float32's range.
        power = rows[:, LUMINANCE].astype(np.float64) * rows[:, AREA]
        kept = np.flatnonzero((rows[:, AREA] > _SMALLEST) & (power > _FAINTEST * power.sum()))
        self.row, self.count = np.full(max(len(rows), 1), -1, np.int32), len(kept)
        if not self.count:
            return
        kept = kept[morton_order(rows[kept])]
        self.rows, self.faces = np.ascontiguousarray(rows[kept]), np.ascontiguousarray(faces[kept])
        self.row[kept] = np.arange(self.count, dtype=np.int32)
        self.scale = float(self.rows[:, LUMINANCE].max())
        self.rows[:, LUMINANCE] /= self.scale


def _same(a: list[Any], b: list[Any]) -> bool:
    return len(a) == len(b) and all(x is y or (isinstance(x, int) and x == y) for x, y in zip(a, b))


def _luminance(emitter: EmissiveMesh, scene: TraceScene) -> Array:
    """(k,) float32 estimates of the mean luminance of each face: half of it its own, half its material's."""
    table, weights = scene.mesh_materials.table, np.array(WEIGHTS)
    out = np.zeros(len(emitter.faces), np.float32)
    for material in np.unique(emitter.material):
        own = emitter.material == material
        mean = float(table.mean_emission(material) @ weights)
        out[own] = mean
        if table.arrays[1][material, 3] >= 0:
            uvs = np.zeros((len(own), 3, 2), np.float32) if emitter.uvs is None else emitter.uvs
            uv = np.einsum("pc,fcd->fpd", _LOOKUPS, uvs[own]).reshape(-1, 2)
            faces = np.repeat(emitter.faces[own] - scene.vertex_faces, len(_LOOKUPS))
            where = np.tile(_LOOKUPS[:, 1:], (int(np.count_nonzero(own)), 1))
            found = table.lookup(np.full(len(uv), material, np.int32), uv, faces, where)[:, 5:] @ weights
            out[own] = 0.5 * (mean + found.reshape(-1, len(_LOOKUPS)).mean(axis=1))
    return out


@njit
def _tables(emitters):  # type: ignore[no-untyped-def]
    """EmitterTables, from where they stand."""
    e = emitters
    tree = Tree(load_int64(e, 0), load_int64(e, 1), load_int64(e, 2), load_int64(e, 3), load_int64(e, 4))
    geometry = Geometry(
        load_int64(e, 9), load_int64(e, 10), load_int64(e, 11), load_int64(e, 12), load_int64(e, 13),
        load_int64(e, 14), load_int64(e, 15), load_int64(e, 16), load_int64(e, 17), load_int64(e, 18),
        np.int64(0),
    )  # fmt: skip
    return EmitterTables(tree, load_int64(e, 5), load_int64(e, 6), load_int64(e, 7), load_int64(e, 8), geometry)


def _is_closed(faces: Array) -> bool:
    """Whether each edge of (m, 3) faces belongs to two of them that are turned alike."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    one, two = np.sort(edges[:, 0] << 32 | edges[:, 1]), np.sort(edges[:, 1] << 32 | edges[:, 0])
    return len(one) > 0 and bool((one[1:] != one[:-1]).all() and np.array_equal(one, two))


@njit
def _volume(vertices, faces):  # type: ignore[no-untyped-def]
    """That a closed surface encloses, negative where its normals look inwards."""
    volume = 0.0
    o = vertices[faces[0, 0]].astype(np.float64)
    for f in range(len(faces)):
        a, b, c = vertices[faces[f, 0]] - o, vertices[faces[f, 1]] - o, vertices[faces[f, 2]] - o
        volume += a[0] * (b[1] * c[2] - b[2] * c[1])
        volume += a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0])
    return volume


@njit
def _fill(own, vertices, faces, matrices, luminance, bits, turned, rows):  # type: ignore[no-untyped-def]
    """Rows of faces of (k, 3, 4) instances; where (k,) `turned`, the normals look the other way."""
    corners, edges = np.empty((3, 3)), np.empty((2, 3))
    for j in range(len(own) * len(matrices)):
        m, face = matrices[j // len(own)], own[j % len(own)]
        for c in range(3):
            x, y, z = vertices[faces[face, c], 0], vertices[faces[face, c], 1], vertices[faces[face, c], 2]
            for k in range(3):
                corners[c, k] = (
                    np.float64(m[k, 0]) * x + np.float64(m[k, 1]) * y + np.float64(m[k, 2]) * z + np.float64(m[k, 3])
                )
        e, f, g = 0.0, 0.0, 0.0
        for k in range(3):
            edges[0, k], edges[1, k] = corners[1, k] - corners[0, k], corners[2, k] - corners[0, k]
            rows[j, CORNER + k], rows[j, EDGE + k], rows[j, SIDE + k] = corners[0, k], edges[0, k], edges[1, k]
            e, f, g = e + edges[0, k] ** 2, f + edges[1, k] ** 2, g + (edges[1, k] - edges[0, k]) ** 2
        nx = edges[0, 1] * edges[1, 2] - edges[0, 2] * edges[1, 1]
        ny = edges[0, 2] * edges[1, 0] - edges[0, 0] * edges[1, 2]
        nz = edges[0, 0] * edges[1, 1] - edges[0, 1] * edges[1, 0]
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        if length > 0.0:
            scale = (-1.0 if turned[j // len(own)] else 1.0) / length
            rows[j, NORMAL], rows[j, NORMAL + 1], rows[j, NORMAL + 2] = nx * scale, ny * scale, nz * scale
        rows[j, AREA], rows[j, LONGEST] = 0.5 * length, max(e, max(f, g))
        rows[j, LUMINANCE], rows[j, BITS] = luminance[j % len(own)], bits


@njit
def sample_emitter(rest, n1, n2, px, py, pz, emitters):  # type: ignore[no-untyped-def]
    """Light sampling among emitting triangles, see `light_sampler.sample_light`.

    Parameters
    ----------
    rest : float64
        Random number in [0, 1) for the pick.
    n1, n2 : uint32
        Random numbers for the place on the triangle.
    px, py, pz : float32
        Point, world, m.
    emitters : int64
        Address, see `LightTables`; not 0.

    Returns
    -------
    lx, ly, lz : float32
        Unit, world.
    distance : float32
        Metres.
    r, g, b : float32
        Radiance, linear Rec.709.
    pdf : float32
        Per solid angle times the probability of the pick, sr^-1; 0 when nothing is sent here.
    row : int64
        Of the triangle; -1 for none.
    """
    tables = _tables(emitters)
    i, probability = pick_emitter(rest, px, py, pz, tables.tree)
    if i < 0:
        return ZERO, ZERO, ONE, ZERO, ZERO, ZERO, ZERO, ZERO, np.int64(-1)
    lx, ly, lz, t, u, v, density = triangle_direction(i, unit(n1), unit(n2), px, py, pz, tables.tree.rows)
    pdf = F(probability * density)
    if not (t > ZERO and pdf > ZERO and pdf < F(np.inf)):
        return ZERO, ZERO, ONE, ZERO, ZERO, ZERO, ZERO, ZERO, i
    face = load_int32(tables.faces, i)
    r, g, b = emitted(face, u, v, tables.geometry)
    # Rays that look for surfaces stop here by chance.
    alpha = opacity_at(face, u, v, tables.geometry)
    if alpha < ONE:
        r, g, b = r * alpha, g * alpha, b * alpha
    return lx, ly, lz, t, r, g, b, pdf, i


@njit
def emitter_row(face, instance, emitters):  # type: ignore[no-untyped-def]
    """Row of the triangle that a ray hit, -1 when it is not sampled.

    Parameters
    ----------
    face, instance : int32
        As of `Hit`.
    emitters : int64
        Address, see `LightTables`; 0: there are none.

    Returns
    -------
    int64
    """
    if emitters == 0:
        return np.int64(-1)
    tables = _tables(emitters)
    own = np.int64(face) - tables.geometry.vertex_faces
    if own < 0:
        return np.int64(-1)
    slot = np.int64(load_int32(tables.slot, own))
    if slot < 0:
        return slot
    if instance >= 0:
        slot += load_int32(tables.first, np.int64(instance))
    return np.int64(load_int32(tables.row, slot))


@njit
def emitter_bits(i, emitters):  # type: ignore[no-untyped-def]
    """Bits of an emitting triangle, see `triangle_light`.

    Parameters
    ----------
    i : int64
        Row.
    emitters : int64
        Address, see `LightTables`.

    Returns
    -------
    int64
    """
    return np.int64(load_float(_tables(emitters).tree.rows, WIDTH * i + BITS))


@njit
def emitter_source(i, emitters):  # type: ignore[no-untyped-def]
    """Source of an emitting triangle: DR-GS objects and meshes are numbered in the order of the frame.

    Parameters
    ----------
    i : int64
        Row.
    emitters : int64
        Address, see `LightTables`.

    Returns
    -------
    int32
    """
    tables = _tables(emitters)
    return load_int32(tables.geometry.face_object, np.int64(load_int32(tables.faces, i)))


@njit
def emitter_pdf(i, px, py, pz, lx, ly, lz, t, emitters):  # type: ignore[no-untyped-def]
    """The pdf per solid angle, pick included, of `sample_emitter` in a direction that meets a triangle.

    Parameters
    ----------
    i : int64
        Row of the triangle.
    px, py, pz : float32
        Point, world, m.
    lx, ly, lz : float32
        Direction from it, unit, world.
    t : float32
        Distance at which it meets the triangle, m.
    emitters : int64
        Address, see `LightTables`.

    Returns
    -------
    float32
        sr^-1.
    """
    tree = _tables(emitters).tree
    density = triangle_density(i, px, py, pz, lx, ly, lz, t, tree.rows)
    return F(density * emitter_probability(i, px, py, pz, tree))


@njit
def emitters_luminance(px, py, pz, emitters):  # type: ignore[no-untyped-def]
    """Estimated luminance that arrives at a point from all triangles that are sampled, unshadowed.

    Parameters
    ----------
    px, py, pz : float32
        Point, world, m.
    emitters : int64
        Address, see `LightTables`.

    Returns
    -------
    float64
        From all directions together, as `Lights.power`.
    """
    return emitters_weight(px, py, pz, _tables(emitters).tree)
