"""Particle-driven deformation: surfels carried by particles that know their deformation gradient (Algorithm 2).

Each surfel takes its centre and deformation gradient F from the particles around it, by generalised moving least
squares (`gmls`); its scaled tangents become F T and its normal cof(F) n, exactly. The particles are those of a
simulation, or any points that deform (`sources`). This needs no mesh, and knows how space moves beside the surface: a
surfel far from its face is carried a thousand times as exactly as by that face (docs/benchmarks.md, *Surfels by
particles*).
"""

from __future__ import annotations

import copy
from typing import NamedTuple

import numpy as np

from ..compute.jit import njit
from ..compute.threads import ELEMENTS, over_range
from ..core.asset.model import Binding, Mesh, PosedSurfels
from ..geometry.occupancy import Volume, spacings, volume_of
from .face_frames import Faces
from .gmls import Weights, bind_points, carry

Array = np.ndarray

#: A surfel is far from its face from this many mean edges of it on; a face is coarse from this many spacings of the
#: particles on.
_FAR, _COARSE = 1.0, 2.0
#: A surfel is smeared by its face where this makes it so many times as long as the particles do.
_SMEARED = 2.0


class Frames(NamedTuple):
    """Surfels at rest, object space: (n, 3) float32 arrays, metres, tangents scaled, normals of unit length."""

    centre: Array
    tangent_u: Array
    tangent_v: Array
    normal: Array

    @classmethod
    def of(cls, posed: PosedSurfels) -> Frames:
        """Of an object that was posed at rest, with no matrix."""
        return cls(*(getattr(posed, name) for name in cls._fields))


class ParticleDriven:
    """Poses surfels by particles.

    Parameters
    ----------
    rest : Frames
        Of the surfels of an object.
    particles : (s, 3) float array
        At rest, object space.
    on_mesh : (n,) bool array, optional
        Surfels that stay where their face has put them, unless it has smeared them; None: none does.

    Attributes
    ----------
    rest : Frames
    on_mesh : (n,) bool array or None
    count : int
        Particles.
    spacing : float
        Metres from one particle to those around it, at rest.
    weights : Weights
        Of the surfels.
    hidden_count, turned : int
        Surfels of the last pose that have particles that are not finite, and those that one particle alone carried,
        see `gmls.carry`.

    Raises
    ------
    UsageError
        There are no particles.
    """

    def __init__(self, rest: Frames, particles: Array, on_mesh: Array | None = None) -> None:
        self.rest, self.on_mesh, self.count = rest, on_mesh, len(particles)
        nearest, self.spacing = spacings(particles)
        space = volume_of(particles, nearest, self.spacing)
        parts = None if space is None else _parts_at(space, particles)
        self.weights = bind_points(self.rest.centre, particles, space=space, parts=parts)
        self.hidden_count = self.turned = 0

    def first(self, count: int) -> ParticleDriven:
        """The same of the first `count` surfels alone."""
        few, w, rows = copy.copy(self), self.weights, slice(count)
        few.on_mesh = None if self.on_mesh is None else self.on_mesh[rows]
        few.rest = Frames(*(array[rows] for array in self.rest))
        few.weights = Weights(w.source[rows], w.weight[rows], w.offset[rows], w.reach[rows])
        return few

    def pose(
        self, posed: PosedSurfels, points: Array, gradients: Array, matrix_world: Array | None = None,
        opacity: Array | None = None,
    ) -> None:  # fmt: skip
        """Put surfels where the particles take them.

        Parameters
        ----------
        posed : PosedSurfels
            World space, as their faces have them where there is `on_mesh`. Places, tangents and normals are written,
            and opacities.
        points : (s, 3) float array
            The particles now, object space.
        gradients : (s, 3, 3) float array
            Their deformation gradients since rest.
        matrix_world : (4, 4) array, optional
            Object-to-world; may scale, shear or mirror.
        opacity : (n,) float32 array, optional
            Of surfels that particles carry, also where faces that are torn have hidden them; None: as posed.
        """
        matrix = np.eye(4) if matrix_world is None else np.asarray(matrix_world, np.float64)
        centre, at, self.turned = carry(self.weights, np.ascontiguousarray(points, np.float32), gradients)
        n = len(centre)
        on_mesh = np.zeros(n, np.bool_) if self.on_mesh is None else self.on_mesh
        shown = np.array(posed.opacity)
        out = *(getattr(posed, name) for name in Frames._fields), shown
        hidden = np.zeros(n, np.bool_)
        linear, sign = np.ascontiguousarray(matrix[:3, :3]), -1.0 if np.linalg.det(matrix[:3, :3]) < 0 else 1.0
        affine = linear, np.ascontiguousarray(matrix[:3, 3]), sign
        own = posed.opacity if opacity is None else opacity
        given = (centre, at.reshape(-1, 9)), (*self.rest, own, on_mesh)
        over_range(_place, n, *given, affine, out, hidden, fewest=ELEMENTS)
        posed.opacity = shown
        self.hidden_count = int(np.count_nonzero(hidden))


def place(rest: Frames, centre: Array, gradients: Array, matrix_world: Array) -> Frames:
    """Surfels in the world at `centre` (n, 3) of object space, deformed by `gradients` (n, 3, 3) since rest."""
    n, linear = len(centre), np.ascontiguousarray(matrix_world[:3, :3], np.float64)
    out = Frames(*(np.zeros((n, 3), np.float32) for _ in Frames._fields))
    affine = linear, np.array(matrix_world[:3, 3], np.float64), -1.0 if np.linalg.det(linear) < 0 else 1.0
    ones, none = np.ones(n, np.float32), np.zeros(n, np.bool_)
    carried = np.ascontiguousarray(centre, np.float32), np.ascontiguousarray(gradients, np.float32).reshape(-1, 9)
    _place(0, n, carried, (*rest, ones, none), affine, (*out, ones.copy()), none.copy())
    return out


def on_the_mesh(mesh: Mesh, binding: Binding, centre: Array, spacing: float) -> Array:
    """Which surfels follow the faces of the mesh at least as well as particles that move it.

    Not those that lie beside their face, or farther from it than it is large, and not those of faces that are coarser
    than the particles. The others are shaded more evenly by the mesh, whose normals are smooth where gradients of
    particles are not, as in thin parts.

    Parameters
    ----------
    mesh : Mesh
        At rest.
    binding : Binding
    centre : (n, 3) array
        Of the surfels at rest, object space.
    spacing : float
        Metres from one particle to those around it, at rest.

    Returns
    -------
    (n,) bool array
    """
    faces = Faces.of(mesh.vertices, mesh.faces)
    edge, corners = faces.mean_edge[binding.face], faces.corners[binding.face]
    share = binding.barycentric.clip(0, 1).astype(np.float64)
    share /= np.maximum(share.sum(axis=1, keepdims=True), 1e-30)
    away = np.linalg.norm(centre - np.einsum("nk,nkc->nc", share, corners), axis=1)
    found: Array = (away <= _FAR * edge) & (edge <= _COARSE * spacing)
    return found


def _parts_at(space: Volume, points: Array) -> Array:
    """(n,) int32 number of the connected part of each point."""
    cell = ((np.asarray(points, np.float64) - space.origin) / space.spacing).astype(np.int64)
    return space.part[tuple(np.clip(cell, 0, np.array(space.part.shape) - 1).T)]


@njit
def _place(first, last, carried, rest, affine, out, hidden):  # type: ignore[no-untyped-def]
    """Centre, F T and normalised cof(F) n in the world; the rest normal where F collapses space onto a line."""
    (centre, gradients), (linear, offset, sign) = carried, affine
    _, tangent_u, tangent_v, normal, own, on_mesh = rest
    out_centre, out_u, out_v, out_normal, opacity = out
    g, p, u, v = np.empty(9), np.empty(3), np.empty(3), np.empty(3)
    for i in range(first, last):
        f, ok = gradients[i], 0.0
        by_face = by_particles = 0.0
        for r in range(3):
            a, b, c = linear[r, 0], linear[r, 1], linear[r, 2]
            for j in range(3):
                g[3 * r + j] = a * f[j] + b * f[3 + j] + c * f[6 + j]
            p[r] = a * centre[i, 0] + b * centre[i, 1] + c * centre[i, 2] + offset[r]
            u[r] = g[3 * r] * tangent_u[i, 0] + g[3 * r + 1] * tangent_u[i, 1] + g[3 * r + 2] * tangent_u[i, 2]
            v[r] = g[3 * r] * tangent_v[i, 0] + g[3 * r + 1] * tangent_v[i, 1] + g[3 * r + 2] * tangent_v[i, 2]
            ok += p[r] + g[3 * r] + g[3 * r + 1] + g[3 * r + 2]
            by_particles += u[r] * u[r] + v[r] * v[r]
            by_face += np.float64(out_u[i, r]) ** 2 + np.float64(out_v[i, r]) ** 2
        if on_mesh[i] and not (by_face > _SMEARED * _SMEARED * by_particles):
            continue
        if not np.isfinite(ok):
            if not on_mesh[i]:
                hidden[i], opacity[i] = True, np.float32(0.0)
                for r in range(3):
                    out_centre[i, r], out_normal[i, r] = np.float32(offset[r]), normal[i, r]
                    out_u[i, r] = out_v[i, r] = np.float32(0.0)
            continue
        opacity[i] = own[i]
        x, y, z = np.float64(normal[i, 0]), np.float64(normal[i, 1]), np.float64(normal[i, 2])
        a = sign * ((g[4] * g[8] - g[5] * g[7]) * x + (g[5] * g[6] - g[3] * g[8]) * y + (g[3] * g[7] - g[4] * g[6]) * z)
        b = sign * ((g[2] * g[7] - g[1] * g[8]) * x + (g[0] * g[8] - g[2] * g[6]) * y + (g[1] * g[6] - g[0] * g[7]) * z)
        c = sign * ((g[1] * g[5] - g[2] * g[4]) * x + (g[2] * g[3] - g[0] * g[5]) * y + (g[0] * g[4] - g[1] * g[3]) * z)
        length = np.sqrt(a * a + b * b + c * c)
        if length > 1e-20:
            x, y, z = a / length, b / length, c / length
        out_normal[i, 0], out_normal[i, 1], out_normal[i, 2] = x, y, z
        for r in range(3):
            out_centre[i, r], out_u[i, r], out_v[i, r] = p[r], u[r], v[r]
