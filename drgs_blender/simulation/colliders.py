"""SDF colliders: signed distance fields of meshes that stand, move rigidly or deform.

A mesh that moves as a rigid body has one field in its own space. One that deforms gets a new field, around the
particles alone, each time it has moved half a cell.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ..core.errors import AssetError, UsageError
from .contact import CONTACTS, Contact, Field, Motion, Surface, look

Array = np.ndarray
log = logging.getLogger(__name__)

#: Cells behind and before the surface of a mesh where its distance is known.
_BAND = 8
_MOST_CELLS = 1 << 23
#: Cells between a surface that lies on a collider and the collider.
_CLEARANCE = 0.02
#: Part of the depth from which on particles are said to be inside, and share of them that is refused where it is all.
_SUNK, _REFUSED = 0.25, 0.01
_OVERLAP = "overlaps {} at the start: {} of {} particles are inside it"
_THROUGH = "passes through {} at the start: {} of {} particles have it between them and the next"
#: Distance of neighbours in a body, in that of the nearest.
_NEIGHBOURS = 1.5


@dataclass(slots=True)
class Collider:
    """A mesh that matter cannot enter.

    Attributes
    ----------
    name : str
        Used in messages.
    faces : (m, 3) int array
    vertices : (n, 3) or (k, n, 3) array
        World, metres; of k frames from the first one simulated on, of which the last stays.
    contact : {"separate", "slip", "sticky"}
        "sticky" holds what touches it, "slip" lets it slide and never leave, "separate" lets it leave.
    friction : float
        Coulomb's coefficient, of "separate".
    thickness : float
        Metres by which the surface is moved outwards.
    """

    name: str
    faces: Array
    vertices: Array
    contact: Contact = "separate"
    friction: float = 0.5
    thickness: float = 0.0

    def __post_init__(self) -> None:
        self.faces = np.ascontiguousarray(self.faces, np.int64)
        self.vertices = np.ascontiguousarray(self.vertices, np.float64)
        if self.vertices.ndim == 2:
            self.vertices = self.vertices[None]
        if self.contact not in CONTACTS:
            raise UsageError(self.name, f"has contact {self.contact!r}", f"There are {', '.join(CONTACTS)}")
        shaped = self.vertices.ndim == 3 and self.vertices.shape[2] == 3 and self.faces.ndim == 2
        if not shaped or not len(self.vertices) or not len(self.faces) or self.faces.min() < 0:
            raise AssetError(self.name, "is not a mesh with faces", "Choose a mesh for the collider")
        if self.faces.max() >= self.vertices.shape[1]:
            problem = f"has {self.vertices.shape[1]} vertices in its animation, its faces need {self.faces.max() + 1}"
            raise AssetError(self.name, problem, "Export its vertices from this mesh")
        if not np.isfinite(self.vertices).all():
            raise AssetError(self.name, "has vertices that are not finite", "Clean the mesh up")
        if not 0 <= self.friction < np.inf:
            raise UsageError(self.name, f"has a friction of {self.friction}", "It must be at least 0")

    @property
    def surface(self) -> Surface:
        """Contact properties for compiled code."""
        return Surface(self.thickness, CONTACTS[self.contact], self.friction)

    def at(self, frame: int) -> Array:
        """(n, 3) vertices, frames counted from 0."""
        return self.vertices[min(max(frame, 0), len(self.vertices) - 1)]


_STILL = np.zeros((0, 0, 0, 3), np.float32)


def make_field(
    vertices: Array,
    faces: Array,
    closed: bool,
    spacing: float,
    low: Array,
    high: Array,
    velocities: Array | None = None,
) -> Field | None:
    """Signed distance from a mesh within the box from `low` to `high`; None where the two are apart.

    The sign is that of the winding number; of a mesh with a rim it is the side of the closest face, so that behind a
    single face is inside.

    Parameters
    ----------
    vertices : (n, 3) array
    faces : (m, 3) array
    closed : bool
        See `is_closed`.
    spacing : float
        Metres.
    low, high : (3,) array
        Corners of the box that the field covers.
    velocities : (n, 3) array, optional
        Of the vertices, m/s.
    """
    import igl

    low = np.maximum(vertices.min(axis=0) - _BAND * spacing, low)
    high = np.minimum(vertices.max(axis=0) + _BAND * spacing, high)
    if (low >= high).any():
        return None
    size = np.ceil((high - low) / spacing).astype(np.int64) + 1
    if size.prod() > _MOST_CELLS:
        spacing *= float((size.prod() / _MOST_CELLS) ** (1 / 3))
        size = np.ceil((high - low) / spacing).astype(np.int64) + 1
        log.warning("a collider is large: its surface is known to %.3g m only", spacing)
    nodes = low + np.stack(np.meshgrid(*(np.arange(n) for n in size), indexing="ij"), -1).reshape(-1, 3) * spacing
    distance, face, closest, *_ = igl.signed_distance(nodes, vertices, faces, _sign(closed))
    velocity = _STILL
    if velocities is not None:
        corners = vertices[faces[face]]
        weights = _barycentric(np.asarray(closest), corners)
        moving = np.einsum("nk,nkc->nc", weights, velocities[faces[face]])
        velocity = moving.astype(np.float32).reshape(*size, 3)
    return Field(low, spacing, np.ascontiguousarray(distance, np.float32).reshape(size), velocity)


def is_closed(faces: Array) -> bool:
    """Whether every edge has two faces, or four, ..."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return bool((np.unique(edges, axis=0, return_counts=True)[1] % 2 == 0).all())


def _sign(closed: bool) -> Any:
    """How inside and outside are distinguished."""
    import igl

    return igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER if closed else igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL


def _barycentric(points: Array, corners: Array) -> Array:
    """(n, 3) weights of points on triangles (n, 3, 3), within [0, 1]."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = points - corners[:, 0]
    aa, ab, bb = (np.einsum("nc,nc->n", s, t) for s, t in ((a, a), (a, b), (b, b)))
    pa, pb = np.einsum("nc,nc->n", p, a), np.einsum("nc,nc->n", p, b)
    area = np.maximum(aa * bb - ab * ab, 1e-300)
    u, v = (bb * pa - ab * pb) / area, (aa * pb - ab * pa) / area
    weights = np.clip(np.stack([1 - u - v, u, v], -1), 0, 1)
    return weights / weights.sum(axis=1, keepdims=True)


def rigid_motion(rest: Array, moved: Array) -> tuple[Array, Array, float]:
    """Rotation (3, 3), shift (3,) and the largest remaining distance of the best rigid motion (Kabsch 1976)."""
    a, b = rest.mean(axis=0), moved.mean(axis=0)
    u, _, vt = np.linalg.svd((moved - b).T @ (rest - a))
    turn = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt)) or 1.0]) @ vt
    shift = b - turn @ a
    return turn, shift, float(np.linalg.norm(rest @ turn.T + shift - moved, axis=1).max())


class MovingCollider:
    """A collider during one frame: where it is, how fast, and its field."""

    def __init__(self, collider: Collider, spacing: float, low: Array, high: Array) -> None:
        self.collider, self.spacing = collider, spacing
        self._low, self._high = low, high
        self._rest = collider.at(0)
        self._closed = is_closed(collider.faces)
        self._own: Field | None = None  # in the collider's own space
        self._have_own = False
        self.speed = 0.0

    def enter(self, frame: int, seconds: float, low: Array, high: Array) -> None:
        """Begin a frame of `seconds`, with particles from `low` to `high`."""
        self._before, self._after = self.collider.at(frame), self.collider.at(frame + 1)
        self._seconds = seconds
        self.speed = float(np.linalg.norm(self._after - self._before, axis=1).max() / seconds)
        reach = (np.linalg.norm(high - low) + 8 * self.spacing) / 4
        self._near = np.maximum(low - reach, self._low), np.minimum(high + reach, self._high)
        size = float(np.ptp(self._rest, axis=0).max())
        first, second = rigid_motion(self._rest, self._before), rigid_motion(self._rest, self._after)
        self._rigid = max(first[2], second[2]) < 1e-4 * size + 1e-9
        self._turn, self._shift = first[0], first[1]
        turned = second[0] @ first[0].T
        self._spin = Rotation.from_matrix(turned).as_rotvec()
        self._centre_before, self._centre_after = self._before.mean(axis=0), self._after.mean(axis=0)
        self._centre_rest = self._rest.mean(axis=0)
        self._built_at = -np.inf

    @property
    def deforms(self) -> bool:
        """Whether it changes its shape in this frame."""
        return not self._rigid

    def at(self, part: float) -> tuple[Field | None, Motion]:
        """The field at `part` (0 to 1) of the frame, None where nothing can be touched, and its motion."""
        if not self._rigid:
            return self._deforming(part)
        if not self._have_own:
            still = len(self.collider.vertices) == 1
            low, high = (self._low, self._high) if still else (np.full(3, -np.inf), np.full(3, np.inf))
            self._own = self._make_field(self._rest, low, high)
            self._have_own = True
        turn = Rotation.from_rotvec(part * self._spin).as_matrix() @ self._turn
        centre = (1 - part) * self._centre_before + part * self._centre_after
        linear = (self._centre_after - self._centre_before) / self._seconds
        spin = self._spin / self._seconds
        shift = centre - turn @ self._centre_rest
        # v(x) = linear + spin x (x - centre), expressed about the point `shift`.
        return self._own, Motion(turn, shift, linear + np.cross(spin, shift - centre), spin)

    def look(self, points: Array, part: float) -> Array | None:
        """(n, 7) what `contact.surface_near` says of points at `part` of the frame; None where nothing is touched."""
        field, motion = self.at(part)
        found: Array | None = None if field is None else look(points, field, motion)
        return found

    def distances(self, points: Array, part: float) -> Array:
        """(n,) signed distances of points at `part` of the frame, as matter feels them; infinite far away."""
        seen = self.look(points, part)
        return np.full(len(points), np.inf) if seen is None else seen[:, 0]

    def closest(self, points: Array, start: bool = False) -> tuple[Array, Array, Array]:
        """Signed distances (n,) from the mesh, its closest points, and the way out, (n, 3).

        The mesh is that at the end of the frame, or at its `start`.
        """
        import igl

        faces, vertices = self.collider.faces, self._before if start else self._after
        distance, face, closest, *_ = igl.signed_distance(points, vertices, faces, _sign(self._closed))
        a, b, c = np.moveaxis(vertices[faces[face]], 1, 0)
        normal = np.cross(b - a, c - a)
        on = np.abs(distance) < 1e-6 * self.spacing
        out = np.where(on[:, None], normal, (points - closest) * np.sign(distance)[:, None])
        return distance, closest, out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-300)

    def count_divided(self, points: Array, distances: Array) -> int:
        """Number of a body's points that the mesh separates from a neighbour at the start of the frame.

        Parameters
        ----------
        points : (n, 3) array
        distances : (n,) array
            As `distances` has them, infinite also in the middle of what is as thick as a cell.
        """
        low, high = self._before.min(axis=0) - self.spacing, self._before.max(axis=0) + self.spacing
        far = np.isfinite(distances) & (np.abs(distances) >= self.spacing)
        near = points[((points > low) & (points < high)).all(axis=1) & ~far]
        if len(near) < 2:
            return 0
        tree = cKDTree(near)
        reach = _NEIGHBOURS * float(np.median(tree.query(near[: 1 << 12], 2)[0][:, 1]))
        pairs = tree.query_pairs(reach, output_type="ndarray")
        out = self.closest(near, start=True)[2]
        divided = (out[pairs[:, 0]] * out[pairs[:, 1]]).sum(axis=1) < -0.5
        return len(np.unique(pairs[divided]))

    def _make_field(self, vertices: Array, low: Array, high: Array, velocities: Array | None = None) -> Field | None:
        return make_field(vertices, self.collider.faces, self._closed, self.spacing, low, high, velocities)

    def _deforming(self, part: float) -> tuple[Field | None, Motion]:
        if self._built_at < 0 or (part - self._built_at) * self._seconds * self.speed > 0.5 * self.spacing:
            vertices = (1 - part) * self._before + part * self._after
            velocities = (self._after - self._before) / self._seconds
            self._field = self._make_field(vertices, *self._near, velocities)
            self._built_at = part
        return self._field, Motion(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))


def check_apart(
    points: Array, depth: float, colliders: Sequence[MovingCollider], planes: Array, body: str = "the body"
) -> None:
    """Refuse a body that is inside of what it should meet, and warn of one that is a little, before anything moves.

    What is thinner than a cell is not seen in the field of a collider: there the neighbours on its two sides decide.

    Parameters
    ----------
    points : (n, 3) array
        Of the body, world.
    depth : float
        Metres that are no matter.
    colliders : sequence of MovingCollider
    planes : array
        Rows of `contact.plane_rows`.
    body : str
        Of the points, in messages.

    Raises
    ------
    UsageError
        More than a hundredth of the points are deeper inside than that.
    """
    sunk = {"floor or wall": (planes[:, 3] - points @ planes[:, :3].T).max(axis=1, initial=-np.inf)}
    low, high = points.min(axis=0), points.max(axis=0)
    through = {}
    for moving in colliders:
        moving.enter(0, 1.0, low, high)
        distances = moving.distances(points, 0.0)
        sunk[moving.collider.name] = moving.collider.thickness - distances
        through[moving.collider.name] = moving.count_divided(points, distances)
    for name, depths in sunk.items():
        count, deep = (int(np.count_nonzero(depths > part * depth)) for part in (_SUNK, 1.0))
        if deep > _REFUSED * len(points):
            remedy = "Move one of the two apart, or simulate from a frame in which they are apart"
            raise UsageError(name, _OVERLAP.format(body, deep, len(points)), remedy)
        if count:
            log.warning("%s: %s, and begin there; move the two apart", name, _OVERLAP.format(body, count, len(points)))
        elif divided := through.get(name, 0):
            log.warning("%s: %s; move the two apart", name, _THROUGH.format(body, divided, len(points)))


def lift_surface(points: Array, spacing: float, colliders: Sequence[MovingCollider], planes: Array) -> Array:
    """A body's surface with what has sunk into obstacles, by a cell at most, lying on them.

    Matter enters obstacles by parts of a cell, which its points do not mind; of a surface that much would be hidden,
    and what looks out would get no light.

    Parameters
    ----------
    points : (n, 3) float64 array
        World, at the end of the frame that the colliders have entered.
    spacing : float
        Of the grid, metres.
    colliders : sequence of MovingCollider
    planes : array
        Rows of `contact.plane_rows`.
    """
    points = np.array(points)
    clearance = _CLEARANCE * spacing
    for normal, offset in zip(planes[:, :3], planes[:, 3], strict=True):
        sunk = offset + clearance - (points * normal).sum(axis=1)
        points += np.where(sunk <= spacing, np.maximum(sunk, 0.0), 0.0)[:, None] * normal
    for moving in colliders:
        near = np.flatnonzero(np.abs(moving.distances(points, 1.0)) < 3 * spacing)
        if len(near):
            distance, closest, out = moving.closest(points[near])
            sunk = (distance >= -spacing) & (distance < clearance)
            points[near[sunk]] = closest[sunk] + clearance * out[sunk]
    return points
