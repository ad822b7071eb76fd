"""The world of a capture: metric scale, up and ground, from a marker sheet, else from cameras and sparse points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.arrays import Array
from ..reconstruct.readers.world_frame import direction_up
from .registration import Registration

#: Distance of the cameras from the object where nothing says how large it is, metres.
UNKNOWN_DISTANCE = 1.0
#: How the scale is called where nothing says it.
_UNKNOWN = "unknown: "
#: Least cosine between the ground's normal and up as the cameras were held: 40 degrees.
_LEVEL = 0.766
#: Trials of the plane's RANSAC; thickness of the ground, in parts of the cameras' distance.
_TRIALS, _THICKNESS = 2000, 0.012
#: Part of the points within a camera's distance that the ground must have; part that may lie below it.
_GROUND, _BELOW = 0.12, 0.06
#: A slab through an object's foot is no ground: its points are further from the plane, in the median and in parts of
#: `_THICKNESS` (0.5 where they fill it), than the first, and it is thicker against its width than the second.
_FLAT, _WIDE = 0.3, 0.08
#: Cameras before a turntable: how many at least; most difference (root mean square) between the directions in which
#: they see its axis, radians; most length of the mean of directions across it, which cameras within 127 degrees exceed;
#: least cosine between the axis and up as the cameras were held, 20 degrees.
_CAMERAS, _ALIKE, _AROUND, _UPRIGHT = 8, 0.03, 0.8, 0.94
#: What the ground rests on: points on it; the lower end of all points; nothing but the cameras.
PLANE, LOWEST, GUESSED = "plane under the object", "lowest points", "what the cameras look at"
#: What up rests on without a plane: phones' accelerometers; how people hold cameras; nothing.
MEASURED = "gravity, as the phone measured it"
TURNTABLE = "the axis about which the cameras turn, as before a turntable"
HELD, UNKNOWN_UP = "how the cameras were held", "nothing: the cameras were held in all ways"


@dataclass(slots=True)
class Alignment:
    """A similarity to the capture's final world (Z up, ground at 0, metres), and what it rests on.

    Attributes
    ----------
    scale : float
    rotation : (3, 3) float64 array
    shift : (3,) float64 array
        New points are ``scale * rotation @ point + shift``.
    scale_from, up_from, ground_from : str
        For the report.
    """

    scale: float
    rotation: Array
    shift: Array
    scale_from: str
    up_from: str
    ground_from: str

    @property
    def guessed(self) -> dict[str, str]:
        """What is assumed of the world, not found in the pictures ("scale", "up", "ground"), and what it rests on."""
        found = {}
        if self.scale_from.startswith(_UNKNOWN):
            found["scale"] = self.scale_from
        if self.up_from in (TURNTABLE, HELD, UNKNOWN_UP):
            found["up"] = self.up_from
        if self.ground_from in (LOWEST, GUESSED):
            found["ground"] = self.ground_from
        return found

    def points(self, points: Array) -> Array:
        """(n, 3) points in the new world."""
        return self.scale * points @ self.rotation.T + self.shift

    def apply(self, found: Registration) -> None:
        """Move cameras and points."""
        for name, matrix in found.matrices.items():
            moved = np.eye(4)
            moved[:3, :3] = self.rotation @ matrix[:3, :3]
            moved[:3, 3] = self.points(matrix[None, :3, 3])[0]
            found.matrices[name] = moved
        found.points = self.points(found.points)


def similarity(source: Array, target: Array) -> tuple[float, Array, Array]:
    """Scale, rotation and shift that bring points to others with least squares (Umeyama 1991).

    Parameters
    ----------
    source, target : (n, 3) float64 array
        At least three points that lie on no line.
    """
    middle, other = source.mean(axis=0), target.mean(axis=0)
    p, q = source - middle, target - other
    u, s, vt = np.linalg.svd(q.T @ p)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    scale = float((s * sign).sum() / max((p**2).sum(), 1e-300))
    return scale, rotation, other - scale * rotation @ middle


def align_to_markers(found: Registration, markers: Registration, sheet: str) -> Alignment | None:
    """Cameras as found from features to the frame of a marker sheet; None where too few show it, or they differ.

    Cameras far from where the similarity of the others puts them are left out.
    """
    names = sorted(found.matrices.keys() & markers.matrices.keys())
    if len(names) < 3:
        return None
    ours, theirs = (np.stack([one.matrices[name][:3, 3] for name in names]) for one in (found, markers))
    keep = np.ones(len(names), bool)
    for _ in range(5):
        scale, rotation, shift = similarity(ours[keep], theirs[keep])
        error = np.linalg.norm(scale * ours @ rotation.T + shift - theirs, axis=1)
        limit = max(3 * float(np.median(error[keep])), 1e-4)
        if keep.sum() <= 3 or (error[keep] <= limit).all():
            break
        keep &= error <= limit
        if keep.sum() < 3:
            return None
    size = float(np.linalg.norm(theirs - theirs.mean(axis=0), axis=1).mean())
    if float(np.median(error[keep])) > 0.05 * size:
        return None
    said = f"marker sheet ({sheet}, {int(keep.sum())} pictures)"
    return Alignment(scale, rotation, shift, said, said, said)


def align_to_ground(found: Registration, distance: float | None = None, up: Array | None = None) -> Alignment:
    """Up and ground of cameras and points: the plane under the object, else the points' lower end.

    Parameters
    ----------
    found : Registration
    distance : float, optional
        True median distance of the cameras from the object, metres; None: not known.
    up : (3,) array, optional
        Up as it was measured, in the cameras' world; None: as they were held.
    """
    matrices = np.stack(list(found.matrices.values()))
    centres = matrices[:, :3, 3]
    centre = look_at(matrices)
    away = float(np.median(np.linalg.norm(centres - centre, axis=1)))
    up_from = MEASURED
    if up is None:
        held = direction_up(matrices)
        up_from = UNKNOWN_UP if held is None else HELD
        up = np.array([0.0, 0.0, 1.0]) if held is None else held
        axis = None if held is None else turntable_axis(matrices, up)
        up, up_from = (up, up_from) if axis is None else (axis, TURNTABLE)
    near = found.points[np.linalg.norm(found.points - centre, axis=1) < away] if len(found.points) else found.points
    plane = ground_plane(near, centres, up, away)
    if plane is not None:
        normal, offset = plane
        up_from = ground_from = PLANE
    else:
        normal = up
        heights = near @ normal
        offset = float(np.quantile(heights, 0.01)) if len(near) >= 20 else float(centre @ normal)
        ground_from = LOWEST if len(near) >= 20 else GUESSED
    scale = (distance or UNKNOWN_DISTANCE) / max(away, 1e-12)
    rotation = _turn_to_z(normal)
    foot = centre - (centre @ normal - offset) * normal
    said = (
        f"camera distance {distance:g} m, as given"
        if distance
        else f"{_UNKNOWN}cameras are {UNKNOWN_DISTANCE:g} m away"
    )
    return Alignment(scale, rotation, -scale * rotation @ foot, said, up_from, ground_from)


def look_at(matrices: Array) -> Array:
    """(3,) the point closest to the optical axes of cameras (n, 4, 4), strays damped by reweighting."""
    axis, centres = matrices[:, :3, 2], matrices[:, :3, 3]
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    weight = np.ones(len(matrices))
    for _ in range(8):
        left = np.einsum("n,nij->ij", weight, across) + 1e-9 * np.eye(3)
        point = np.linalg.solve(left, np.einsum("n,nij,nj->i", weight, across, centres))
        error = np.linalg.norm(np.einsum("nij,nj->ni", across, point - centres), axis=1)
        weight = 1 / np.maximum(error, 0.2 * float(np.median(error)) + 1e-12)
    return point


def turntable_axis(matrices: Array, up: Array) -> Array | None:
    """(3,) the direction about up that cameras (n, 4, 4) see alike, as before a turntable; None where there is none.

    Cameras that people hold differ by several degrees.
    """
    rotations = matrices[:, :3, :3]
    _, lengths, vt = np.linalg.svd(rotations.mean(axis=0).T)
    axis = vt[0] if vt[0] @ up > 0 else -vt[0]
    if len(matrices) < _CAMERAS or lengths[1] > _AROUND or axis @ up < _UPRIGHT:
        return None
    seen = axis @ rotations
    return axis if np.sqrt(((seen - seen.mean(axis=0)) ** 2).sum(axis=1).mean()) < _ALIKE else None


def ground_plane(points: Array, cameras: Array, up: Array, away: float) -> tuple[Array, float] | None:
    """(normal, offset) of the plane on which the object stands; points on it have ``point @ normal == offset``.

    RANSAC (Fischler and Bolles 1981) over planes about level that have all cameras above and few points below; the one
    with most points, refined by least squares. None where these fill a slab that is not wide either, as those of an
    object's foot do; grass is thick, and wide.

    Parameters
    ----------
    points : (n, 3) float64 array
        Around the object.
    cameras : (m, 3) float64 array
    up : (3,) array
        As the cameras were held.
    away : float
        Distance of the cameras from the object.
    """
    if len(points) < 50:
        return None
    random = np.random.default_rng(0)
    limit = _THICKNESS * away
    sample = points[random.choice(len(points), min(len(points), 4000), replace=False)]
    best: tuple[int, Array, float] | None = None
    for _ in range(_TRIALS):
        a, b, c = sample[random.choice(len(sample), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 1e-12:
            continue
        normal = normal / length * (1 if normal @ up > 0 else -1)
        if normal @ up < _LEVEL:
            continue
        offset = float(a @ normal)
        if np.mean(cameras @ normal > offset) < 0.95:
            continue
        heights = sample @ normal - offset
        count = int((np.abs(heights) < limit).sum())
        if (heights < -2 * limit).mean() <= _BELOW and (best is None or count > best[0]):
            best = count, normal, offset
    if best is None or best[0] < _GROUND * len(sample):
        return None
    _, normal, offset = best
    for _ in range(5):
        on = points[np.abs(points @ normal - offset) < limit]
        middle = on.mean(axis=0)
        _, _, vt = np.linalg.svd(on - middle, full_matrices=False)
        normal = vt[2] if vt[2] @ up > 0 else -vt[2]
        offset = float(middle @ normal)
        off = np.abs(points @ normal - offset)
        limit = max(0.3 * limit, 2.5 * float(np.median(off[off < limit])))
    heights = points @ normal - offset
    slab = np.abs(heights) < _THICKNESS * away
    across = np.linalg.svd(points[slab] - points[slab].mean(axis=0), compute_uv=False)
    flat = np.median(np.abs(heights[slab])) < _FLAT * _THICKNESS * away
    return (normal, offset) if flat or across[2] < _WIDE * across[1] else None


def _turn_to_z(up: Array) -> Array:
    """(3, 3) rotation that brings a unit vector to Z, no further than needed."""
    axis = np.cross(up, [0.0, 0.0, 1.0])
    if up[2] < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + skew + skew @ skew / (1 + up[2])
