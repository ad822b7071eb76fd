"""Broken matter as closed pieces: its mesh cut where bonds of its particles have broken, with walls inside the cuts.

The lattice of the particles partitions the mesh into cells. A face between cells that are not joined any more is open:
triangles across it are cut along it, and what of it lies inside of the mesh becomes a wall on either side. What meets
at a corner and is still joined there shares it (as the virtual nodes of Molino et al. 2004), so that walls and cut
surface close each piece, and a crack ends where matter holds. Each corner is carried by the particles of its own side
alone. Before anything is cut, corners of open faces move towards their neighbours' (surface nets, Gibson 1998), so that
cracks are smooth instead of stairs; both sides of a crack still fit. Sides that are pressed together again have their
walls in one place, and no line between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..geometry.normals import VertexNormals
from .bonds import Bonds, Cells
from .crack_nodes import cells_of, joined_at, node_keys, node_places, press_together, rows_of, smoothed_nodes, warp
from .crack_sides import BESIDE, Sides, believable, within
from .cut_faces import EDGE, FACE, VERTEX, Pieces, cut, near_open, open_faces
from .gmls import carry
from .wall_faces import walls

Array = np.ndarray

#: Cells below the surface that corners of cells stay near a crack.
_BELOW = 0.05


@dataclass(slots=True)
class ClosedMatter:
    """What stands in for the faces of a mesh that are cut.

    Attributes
    ----------
    vertices : (n, 3) float32 array
        Of the mesh, where matter of their own side carries them; the space of the given ones.
    cut : (m,) bool array
        Faces that are replaced.
    near : (m,) bool array
        These, and faces with vertices that their own side carries.
    crack : (k, 3) float32 array
        Places at rest along which the mesh is cut, and corners of walls, object space; not those that are together.
    opening : (k,) float32 array
        How far each is open, up to 1.
    sides : Sides
        Carries other points.
    points : (c, 3) float32 array
        Corners of what replaces them, the same space.
    rim : (r, 3) int32 array
        Faces that are left of those that were cut, among `points`.
    rim_face : (r,) int32 array
        Which face each is of.
    rim_share : (r, 3, 3) float32 array
        Barycentric coordinates of its corners in that face.
    rim_normals : (r, 3, 3) float32 array
        Of its corners, unit, the same space.
    walls : (w, 3) int32 array
        Faces inside, among `points`, counter-clockwise seen from outside of the matter.
    shut : (r + w,) bool array
        Which of `rim`, then of `walls`, are at cracks that are pressed together, and not near others.
    """

    vertices: Array
    cut: Array
    near: Array
    crack: Array
    opening: Array
    sides: Sides
    points: Array
    rim: Array
    rim_face: Array
    rim_share: Array
    rim_normals: Array
    walls: Array
    shut: Array


class _Corners(NamedTuple):
    """Corners of cuts, then those of cells.

    Attributes
    ----------
    rest : (c, 3) float64 array
        In cells.
    planes : (c, 3) int64 array
        The planes of the lattice on which each lies, -1: on none along this axis.
    key : (c, 5) int64 array
        Of those of cuts, see `Pieces`.
    """

    rest: Array
    planes: Array
    key: Array


class Breakable:
    """A mesh and the particles in it, at rest.

    Parameters
    ----------
    vertices : (n, 3) float array
        Metres, object space.
    faces : (m, 3) int32 array
    rest : (s, 3) float array
        Particles, metres, object space.
    to_cells : (4, 4) float array
        See `Bonds`.
    """

    def __init__(self, vertices: Array, faces: Array, rest: Array, to_cells: Array) -> None:
        self.bonds = Bonds(rest, to_cells)
        self.faces = np.ascontiguousarray(faces, np.int32)
        self.places = self.bonds.placed(vertices)
        self._linear = self.bonds.to_cells[:3, :3]
        a, b, c = self.places[self.faces].transpose(1, 0, 2)
        # Whichever way its faces point, walls point out of the matter.
        self._inverted = bool(np.einsum("ij,ij->i", a - a.mean(axis=0), np.cross(b - a, c - a)).sum() < 0)
        self._normals: Array | None = None

    def closed(
        self, vertices: Array, points: Array, gradients: Array, gap: float, band: float = 0.0, bits: Array | None = None
    ) -> ClosedMatter | None:
        """The mesh with closed pieces; None where nothing has broken that the mesh shows.

        Parameters
        ----------
        vertices : (n, 3) float array
            Now, metres, object space.
        points : (s, 3) float array
            Particles now.
        gradients : (s, 3, 3) float array
            Their deformation gradients since rest.
        gap : float
            Metres by which neighbours have moved apart at least where they have broken, see `fracture.torn_faces`.
        band : float
            Metres: faces that are no farther than this from a crack are replaced as well, by themselves.
        bits : (bytes,) uint8 array, optional
            What has broken until now, see `Bonds.packed`; without, that counts as broken which now is apart.

        Raises
        ------
        ValueError
            The bits are of other bonds.
        """
        bonds = self.bonds
        size = abs(float(np.linalg.det(self._linear))) ** (1 / 3)
        now = bonds.placed(points)
        broken = bonds.broken(now, gap * size) if bits is None else bonds.unpacked(bits)
        if not broken.up.any():
            return None
        zone = bonds.zone(broken)
        nodes = smoothed_nodes(zone)
        places = self.places + BESIDE
        warp(places, zone.size + 1, *nodes)
        pieces = cut(places, self.faces, near_open(places, self.faces, zone))
        row, axis = open_faces(pieces, zone)
        replaced = np.zeros(len(self.faces), bool)
        replaced[pieces.face[pieces.of[row >= 0]]] = True
        pieces = pieces.kept(replaced[pieces.face])
        if not len(pieces.face):
            return None
        row, _ = open_faces(pieces, zone)
        edge = np.flatnonzero(row >= 0)
        crack = np.einsum("ck,ckd->cd", pieces.share[edge], self.places[self.faces[pieces.face[pieces.of[edge]]]])
        if band > 0:
            whole = self._beside(crack, band * size) & ~replaced
            pieces, replaced = pieces.and_whole(np.flatnonzero(whole), self.faces), replaced | whole
        row, axis = open_faces(pieces, zone)
        own_f = self._linear @ np.asarray(gradients, np.float64) @ np.linalg.inv(self._linear)
        some = np.unique(zone.owner[zone.owner >= 0])
        own_f[some] = believable(own_f[some], bonds.stretch(now, broken.up, some))
        sides = Sides(bonds, zone, nodes, broken.up, now, own_f)
        moved, aside = self._parted_vertices(places, bonds.placed(vertices), sides)
        shown = np.array(vertices, np.float32)
        shown[aside] = bonds.returned(moved[aside])
        near = replaced | aside[self.faces].any(axis=1)
        open_at, opening, *made = self._assembled(pieces, (row, axis), places, moved, sides, band * size)
        return ClosedMatter(shown, replaced, near, bonds.returned(open_at), opening, sides, *made)

    def _beside(self, crack: Array, band: float) -> Array:
        """(m,) bool: faces with a vertex that is less than `band` cells from a crack."""
        return np.asarray(within(self.places, crack, band)[self.faces].any(axis=1))

    def _parted_vertices(self, places: Array, given: Array, sides: Sides) -> tuple[Array, Array]:
        """(n, 3) vertices now, and (n,) bool which of them are near a crack and are carried by their own side."""
        moved, aside, zone = given.copy(), np.zeros(len(given), bool), sides.zone
        row = np.empty(len(places), np.int64)
        rows_of(np.floor(np.where(np.isfinite(places), places, -1.0)).astype(np.int64), zone, row)
        some = np.flatnonzero(row >= 0)
        owner = zone.owner[row[some]]
        some, owner = some[owner >= 0], owner[owner >= 0]
        if len(some):
            weights, parted = self.bonds.carriers(self.places[some], owner, sides.broken)
            aside[some[parted]] = True
            moved[aside] = carry(weights, sides.now, sides.gradients)[0][parted]
        return moved, aside

    def _assembled(
        self, pieces: Pieces, on_open: tuple[Array, Array], places: Array, moved: Array, sides: Sides, band: float
    ) -> tuple[Array, ...]:
        """Corners at rest that are open, in cells, how far, and of `ClosedMatter` all from `points` on."""
        zone, nodes = sides.zone, sides.nodes
        corner = pieces.corner_ids()
        first = np.unique(corner, return_index=True)[1]
        where = self.faces[pieces.face[pieces.of[first]]]
        share = pieces.share[first]
        cut_at = np.einsum("ck,ckd->cd", share, places[where])
        wall, side, codes = self._walls(pieces, on_open, corner, cut_at, nodes, zone)
        node_key, node_of = np.unique(codes, return_inverse=True)
        rest = self._kept_inside(node_places(node_key.clip(0), nodes, zone.size + 1), pieces, on_open[0] >= 0)
        corners = self._corners(pieces.key[first], share, where, node_key, rest, zone)
        wall = np.where(codes >= 0, len(first) + node_of.reshape(codes.shape), wall)
        # (corner, cell) pairs, and which of them are one point.
        triangles, of = pieces.triangles()
        used = [
            (corner[triangles], np.repeat(pieces.cell[of][:, None], 3, axis=1)),
            (wall, np.repeat(side[0][:, None], 3, axis=1)),
            (wall[:, ::-1], np.repeat(side[1][:, None], 3, axis=1)),
        ]
        pair_corner = np.concatenate([c.reshape(-1) for c, _ in used])
        pair_cell = np.concatenate([c.reshape(-1, 3) for _, c in used])
        lies = np.flatnonzero(pair_corner < len(first))
        lies = lies[pieces.key[first[pair_corner[lies]], 0] == VERTEX]
        pair_cell[lies] = np.floor(cut_at[pair_corner[lies]]).astype(np.int64)
        group = np.empty(len(pair_corner), np.int64)
        joined_at(corners.planes[pair_corner], pair_cell, zone, group)
        rows, index = np.unique(np.stack([pair_corner, group], axis=1), axis=0, return_inverse=True)
        index = index.reshape(-1)
        at, turn = self._placed_corners(rows, corners, sides, moved, where, share)
        opening = np.empty(len(rows))
        press_together(rows[:, 0], at, turn, opening)
        parted = np.flatnonzero(opening > 0)
        parted = parted[np.unique(rows[parted, 0], return_index=True)[1]]
        split = np.cumsum([3 * len(triangles), 3 * len(wall)])
        rim, low, high = (i.reshape(-1, 3).astype(np.int32) for i in np.split(index, split))
        rim_face = pieces.face[of]
        rim_share = pieces.share[triangles]
        normals = self._rim_normals(rim, rim_face, rim_share, turn)
        made = self.bonds.returned(at), rim, rim_face.astype(np.int32), rim_share.astype(np.float32)
        open_at, inner = corners.rest[rows[parted, 0]], np.concatenate([low, high])
        near = opening > 0
        if band > 0 and len(parted):
            near |= within(corners.rest[rows[:, 0]], open_at, band)
        shut = ~near[np.concatenate([rim, inner])].any(axis=1)
        return open_at, opening[parted].astype(np.float32), *made, normals, inner, shut

    def _walls(
        self, pieces: Pieces, on_open: tuple[Array, Array], corner: Array, cut_at: Array, nodes: tuple[Array, Array],
        zone: Cells,
    ) -> tuple[Array, tuple[Array, Array], Array]:  # fmt: skip
        """Triangles of walls: (t, 3) corners of cuts, the cells on both sides, and (t, 3) keys of nodes, -1: none."""
        row, axis = on_open
        below = (row >= 0) & (pieces.label // 3 - 1 == pieces.cell[pieces.of, axis % 3] + 1)
        number = np.full(len(zone.keys) * 3, -1, np.int64)
        rows, axes = np.nonzero(zone.open)
        number[3 * rows + axes] = np.arange(len(rows))
        edge = np.flatnonzero(below)
        face = number[3 * row[edge] + axis[edge]]
        order = np.argsort(face, kind="stable")
        edge, face = edge[order], face[order]
        # The wall goes along the edge the other way.
        ends = np.stack([corner[pieces.following[edge]], corner[edge]], axis=1)
        if self._inverted:
            ends = ends[:, ::-1]
        start = np.searchsorted(face, np.arange(len(rows) + 1))
        cell = cells_of(zone.keys[rows], zone.size)
        of, triangles, bare = walls(cell, axes, start, np.ascontiguousarray(ends), cut_at)
        plain = np.flatnonzero(bare)
        plain = plain[self._inside(cell[plain], axes[plain], nodes, zone.size)]
        whole = np.repeat(np.array([[-1, -2, -3], [-1, -3, -4]])[None], len(plain), axis=0).reshape(-1, 3)
        of, triangles = np.concatenate([of, np.repeat(plain, 2)]), np.concatenate([triangles, whole])
        low = cell[of]
        high = low + np.eye(3, dtype=np.int64)[axes[of]]
        codes = np.full(triangles.shape, -1, np.int64)
        face_of, slot = np.nonzero(triangles < 0)
        codes[face_of, slot] = node_keys(low[face_of], axes[of[face_of]], -1 - triangles[face_of, slot], zone.size)
        return triangles, (low, high), codes

    def _inside(self, cell: Array, axis: Array, nodes: tuple[Array, Array], size: Array) -> Array:
        """Which open faces, of those whose sides the mesh does not meet, are inside of it."""
        found = self.bonds.filled(cell) & self.bonds.filled(cell + np.eye(3, dtype=np.int64)[axis])
        rest = np.flatnonzero(~found)
        if len(rest):
            import igl

            given = cell[rest], axis[rest]
            corners = np.stack([node_keys(*given, np.full(len(rest), c), size) for c in range(4)])
            middle = node_places(corners.reshape(-1), nodes, size + 1).reshape(4, -1, 3).mean(axis=0) - BESIDE
            number = igl.fast_winding_number(self.places, self.faces.astype(np.int64), middle)
            found[rest] = np.abs(number) >= 0.5
        return found

    def _kept_inside(self, nodes: Array, pieces: Pieces, open_edge: Array) -> Array:
        """Corners of cells, those beyond the surface where a crack comes out of it brought back onto it."""
        from scipy.spatial import cKDTree  # an engine starts without

        edge = np.flatnonzero(open_edge)
        a, b, c = (self.places[self.faces[pieces.face[pieces.of[edge]], k]] for k in range(3))
        crack = np.einsum("ck,kcd->cd", pieces.share[edge], np.stack([a, b, c]))
        normal = np.cross(b - a, c - a) * (-1.0 if self._inverted else 1.0)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        nearest = cKDTree(crack).query(nodes)[1]
        beyond = np.einsum("ij,ij->i", nodes - crack[nearest], normal[nearest])
        near = np.linalg.norm(nodes - crack[nearest], axis=1) < 1.0
        found: Array = nodes - np.where(near, (beyond + _BELOW).clip(0.0), 0.0)[:, None] * normal[nearest]
        return found

    def _corners(self, key: Array, share: Array, where: Array, node_key: Array, nodes: Array, zone: Cells) -> _Corners:
        planes = np.full((len(key) + len(node_key), 3), -1, np.int64)
        edge, face = np.flatnonzero(key[:, 0] == EDGE), np.flatnonzero(key[:, 0] == FACE)
        planes[edge, key[edge, 3]] = key[edge, 4]
        planes[face, key[face, 2] // 3] = key[face, 3]
        planes[face, key[face, 2] % 3] = key[face, 4]
        planes[len(key) :] = cells_of(node_key.clip(0), zone.size + 1)
        rest = np.einsum("ck,ckd->cd", share, self.places[where])
        return _Corners(np.concatenate([rest, nodes]), planes, key)

    def _placed_corners(
        self, rows: Array, corners: _Corners, sides: Sides, moved: Array, where: Array, share: Array
    ) -> tuple[Array, Array]:
        """(c, 3) places now and (c, 3, 3) gradients of corners, each of `rows` with the cell that it belongs to."""
        corner, group = rows.T
        owner = self.bonds.owners(group)
        lone = owner < 0
        weights, _ = self.bonds.carriers(corners.rest[corner], np.where(lone, 0, owner), sides.broken)
        at, turn, _ = carry(weights, sides.now, sides.gradients)
        own = corner < len(where)  # of the surface
        row = np.flatnonzero(own)
        flat = np.einsum("ck,ckd->cd", share[corner[row]], moved[where[corner[row]]])
        kind, key = corners.key[corner[row], 0], corners.key[corner[row]]
        # An edge that no crack crosses is straight for the triangles beside it, which may not be cut.
        torn = np.bincount(corner, minlength=len(corners.rest))[corner[row]] > 1
        edges = key[:, 1] * len(self.places) + key[:, 2]
        crossed = np.isin(edges, edges[torn & (kind == EDGE)])
        straight = (kind == VERTEX) | ((kind == EDGE) & ~crossed) | lone[row]
        at[row[straight]] = flat[straight]
        turn[lone] = np.eye(3)
        return at, turn

    def _rim_normals(self, rim: Array, face: Array, share: Array, turn: Array) -> Array:
        """(r, 3, 3) float32 unit normals of corners: those at rest, turned with the matter."""
        if self._normals is None:
            made = VertexNormals(self.faces, len(self.places))
            self._normals = np.zeros((len(self.places), 3), np.float32)
            made.into(self.places.astype(np.float32), self.faces, self._normals)
        rest = np.einsum("rck,rkd->rcd", share, self._normals[self.faces[face]].astype(np.float64))
        f = turn[rim].astype(np.float64)
        cofactors = np.stack(
            [np.cross(f[..., 1, :], f[..., 2, :]), np.cross(f[..., 2, :], f[..., 0, :]),
             np.cross(f[..., 0, :], f[..., 1, :])], axis=-2,
        )  # fmt: skip
        # Normals of cells to those of object space: by the transpose of what brings places into cells.
        found = np.einsum("rcij,rcj->rci", cofactors, rest) @ self._linear
        length = np.linalg.norm(found, axis=-1, keepdims=True)
        return np.where(length > 1e-20, found / np.maximum(length, 1e-20), rest).astype(np.float32)
