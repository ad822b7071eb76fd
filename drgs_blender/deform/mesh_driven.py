"""Mesh-driven deformation: surfels follow exactly the faces that they are bound to.

A face and its unit normal span space, so the deformation gradient of a face is F = [e1' e2' n'] [e1 e2 n]^-1 and the
scaled tangents become T' = F T. With C = [e1 e2 n]^-1 T precomputed, a frame costs three vertices, one normal and a 3x3
by 3x2 product a surfel. Unlike skinning, this blends no rotations: F comes from the face, and the shading normal from
smooth vertex normals. A surfel larger than its face has a second F, of three vertices as far apart as it is large, and
takes the one that stretches it less: neither a single face that is carried badly nor a gap within its reach smears it.
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ..compute.jit import njit, plain
from ..compute.threads import ELEMENTS, checkpoint, over_range
from ..core.arrays import outside
from ..core.asset.model import BASE_CHANNELS, Binding, Mesh, PosedSurfels, Surfels, neutral_values
from ..core.asset.part import taken, taken_binding
from ..core.errors import AssetError
from ..geometry.normals import VertexNormals, rotation_matrices, unit
from .face_frames import Faces
from .pose import Posed, PosedMesh, Rest, tangent_frame
from .pose_blocks import pose
from .wide_support import spans

Array = np.ndarray
log = logging.getLogger(__name__)

#: Surfels whose rest is found at once.
_ROWS = 1 << 18


class Posing(NamedTuple):
    """Checked arguments of a pose.

    Attributes
    ----------
    vertices : (n, 3) float32 array
        World space.
    normals : (3 m, 3) float32 array or None
        Of the corners; None: smooth ones are to be made.
    smooth_faces : (m, 3) int32 array
        Faces that smooth normals are made from; torn ones have no area.
    linear : array
        See `pose.pose_surfels`.
    sign : float
        See `pose.pose_surfels`.
    opacity : array
        Of the surfels where all vertices are finite.
    channels : dict of str to array
        Materials of the surfels; the asset's own arrays where nothing was edited.
    """

    vertices: Array
    normals: Array | None
    smooth_faces: Array
    linear: Array
    sign: float
    opacity: Array
    channels: dict[str, Array]


class MeshDriven:
    """Poses bound surfels from the vertices of each frame.

    Parameters
    ----------
    mesh : Mesh
        At rest, object space.
    surfels : Surfels
        At rest, object space.
    binding : Binding
        Of the surfels to the mesh.

    Attributes
    ----------
    degenerate_faces : int
        Faces without area at rest. Their surfels keep their shape in the smooth shading frame and scale with the
        face's edges, since such a face has no deformation gradient.
    hidden_count : int
        Surfels of the last pose whose face had a vertex that was not finite; they are transparent.
    rest : Rest
        Constants of the binding, the same in every pose.
    """

    def __init__(self, mesh: Mesh, surfels: Surfels, binding: Binding) -> None:
        if len(binding.face) != len(surfels):
            raise AssetError(
                "binding", f"is of {len(binding.face)} surfels but there are {len(surfels)}", "Bind the surfels again"
            )
        if outside(binding.face, len(mesh.faces)) is not None:
            raise AssetError(
                "binding", f"refers to a face that the mesh of {len(mesh.faces)} faces lacks", "Bind the surfels again"
            )
        self.mesh, self.surfels, self.binding = mesh, surfels, binding
        self.normals = VertexNormals(mesh.faces, len(mesh.vertices))
        faces, normals = Faces.of(mesh.vertices, mesh.faces), self.normals(mesh.vertices)
        self.degenerate_faces = int(faces.degenerate.sum())
        self.hidden_count = 0
        face, corners = binding.face, faces.corners
        offset = (binding.offset * faces.mean_edge[face]).astype(np.float32)
        rest_edge = np.where(faces.degenerate, faces.mean_edge, 0).astype(np.float32)  # 0: a proper face

        basis = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], faces.normal], -1)
        if self.degenerate_faces:
            log.warning("mesh: %d faces have no area at rest", self.degenerate_faces)
            smooth = normals.astype(np.float64)[mesh.faces].mean(axis=1)
            for f in np.flatnonzero(faces.degenerate):
                frame = tangent_frame(*basis[f, :, 0].tolist(), *basis[f, :, 1].tolist(), *smooth[f].tolist())
                basis[f] = np.reshape(frame, (3, 3)).T
        inverse, n = np.linalg.inv(basis), len(surfels)
        coordinates, in_span = np.empty((2, n, 3, 2), np.float32)
        span = np.empty((n, 3), np.int32)
        for first in range(0, n, _ROWS):  # bounds memory
            checkpoint()
            rows = slice(first, first + _ROWS)
            scale = surfels.scale[rows]
            tangents = rotation_matrices(surfels.rotation[rows].astype(np.float64))[..., :2] * scale[:, None, :]
            coordinates[rows] = inverse[face[rows]] @ tangents
            given = face[rows], binding.barycentric[rows], scale.max(axis=1)
            span[rows] = spans(mesh.vertices, mesh.faces, normals, faces, *given)
            in_span[rows] = _in_spans(mesh.vertices, span[rows], tangents)
        rest = (binding.face, binding.barycentric, offset, rest_edge, binding.normal, coordinates)
        self.rest = Rest(*map(plain, (*rest, span, in_span)))

    def repainted(self, mesh: Mesh, surfels: Surfels) -> MeshDriven:
        """The same for the same mesh and surfels with other materials."""
        other = copy.copy(self)
        other.mesh, other.surfels = mesh, surfels
        return other

    def first(self, count: int) -> MeshDriven:
        """The same of the first `count` surfels alone."""
        few, rest = copy.copy(self), self.rest
        rows = slice(count)
        few.surfels = taken(self.surfels, rows)
        few.binding = taken_binding(self.binding, rows)
        of_surfels = {name: getattr(rest, name)[rows] for name in Rest._fields if name != "rest_edge"}
        few.rest = rest._replace(**of_surfels)
        return few

    def pose(
        self,
        vertices_world: Array,
        corner_normals_world: Array | None = None,
        materials: Mapping[str, Array | None] | None = None,
        *,
        matrix_world: Array | None = None,
        object_index: int = 0,
        torn: Array | None = None,
        placed: bool = True,
    ) -> PosedSurfels:
        """Surfels of one frame.

        Parameters
        ----------
        vertices_world : (n, 3) float32 array
            World space: the posed mesh.
        corner_normals_world : (m, 3, 3) float32 array, optional
            Unit normals of the face corners, pointing out of the object in the world (as they appear, mirrored or not);
            None computes smooth angle-weighted ones.
        materials : mapping of str to (array or None), optional
            "albedo" (n, 3), "roughness" (n,), "metallic" (n,) of the vertices in this frame; None or absent keeps the
            asset's. A surfel keeps its own value as far as its face's vertices are unchanged and takes the new value in
            proportion to the weights of the changed ones.
        matrix_world : (4, 4) array, optional
            Object-to-world that `vertices_world` contain. Needed where it mirrors or scales: it says which side of a
            face is out, and scales what stands off the surface. None is rigid.
        object_index : int
            Index into Frame.objects, copied to every surfel.
        torn : (m,) bool array, optional
            Faces that are not there: their surfels are transparent, and they bend no smooth normals.
        placed : bool
            False: centres, tangents and normals are left to be written by the caller.

        Returns
        -------
        PosedSurfels
            Always finite. A collapsed face yields flat or vanishing tangents and a finite normal.
        """
        posing = self.posing(vertices_world, corner_normals_world, materials, matrix_world, torn)
        n = len(self.surfels)
        opacity = posing.opacity.copy()
        centre, tangent_u, tangent_v, normal = (np.empty((n, 3), np.float32) for _ in range(4))
        posed = Posed(centre, tangent_u, tangent_v, normal, opacity)
        if placed:
            self._place(posing, posed)
        self.hidden_count = int(np.count_nonzero(opacity != posing.opacity))
        if self.hidden_count:
            log.debug("%d surfels hang on vertices that are not finite; they are hidden", self.hidden_count)
        owner = np.full(n, object_index, np.int32)
        return PosedSurfels(*posed, **posing.channels, object_index=owner)

    def _place(self, posing: Posing, posed: Posed) -> None:
        by_corner, normals = posing.normals is not None, posing.normals
        if normals is None:
            normals = np.empty_like(posing.vertices)
            self.normals.into(posing.vertices, posing.smooth_faces, normals)
            if posing.sign < 0:
                normals = -normals
        mesh = PosedMesh(plain(posing.vertices), plain(self.mesh.faces), plain(normals))
        pose(mesh, by_corner, posing.linear, posing.sign, self.rest, posed)

    def posing(
        self, vertices_world: Array, corner_normals_world: Array | None, materials: Mapping[str, Array | None] | None,
        matrix_world: Array | None, torn: Array | None,
    ) -> Posing:  # fmt: skip
        """Check the arguments of a pose; parameters as of `pose`."""
        vertices = np.ascontiguousarray(vertices_world, dtype=np.float32)
        if vertices.shape != self.mesh.vertices.shape:
            raise AssetError(
                "mesh", f"has {len(vertices)} vertices but was bound with {len(self.mesh.vertices)}", "Bind it again"
            )
        linear = np.eye(3) if matrix_world is None else np.ascontiguousarray(matrix_world, np.float64)[:3, :3].copy()
        normals = corner_normals_world
        if normals is not None:
            normals = np.ascontiguousarray(normals, dtype=np.float32).reshape(-1, 3)
            if len(normals) != 3 * len(self.mesh.faces):
                raise AssetError("corner normals", f"are {len(normals)}, expected {3 * len(self.mesh.faces)}")
        smooth_faces, opacity = self.normals.faces, self.surfels.opacity
        if torn is not None:
            smooth_faces = np.where(torn[:, None], np.int32(0), smooth_faces)
            opacity = np.where(torn[self.binding.face], np.float32(0.0), opacity)
        channels = {name: self.channel(name, (materials or {}).get(name)) for name in BASE_CHANNELS}
        sign = -1.0 if np.linalg.det(linear) < 0 else 1.0
        return Posing(vertices, normals, smooth_faces, linear, sign, opacity, channels)

    def channel(self, name: str, edited: Array | None) -> Array:
        """A material channel of the surfels after the vertices' values became `edited`; None: these are the asset's."""
        own: Array | None = getattr(self.surfels, name)
        if own is None:
            own = neutral_values(name, len(self.surfels))
        if edited is None:
            return own
        rest = self.mesh.channel(name)
        edited = np.ascontiguousarray(edited, dtype=np.float32)
        if edited.shape != rest.shape:
            raise AssetError(f"{name} of the vertices", f"has shape {edited.shape}, expected {rest.shape}")
        changed = np.abs(edited - rest) > 1e-6
        if changed.ndim == 2:
            changed = changed.any(axis=1)
        if not changed.any():
            return own
        result = own.reshape(len(own), -1).copy()
        over_range(
            _repaint, len(own), plain(self.mesh.faces), plain(self.binding.face), plain(self.binding.barycentric),
            changed, plain(edited.reshape(len(rest), -1)), result, fewest=ELEMENTS,
        )  # fmt: skip
        return result.reshape(own.shape)


def _in_spans(vertices: Array, span: Array, tangents: Array) -> Array:
    """(n, 3, 2) float32 `tangents` in the frames of edges and normal of triangles; 0 where there is none."""
    found = np.zeros(tangents.shape, np.float32)
    there = span[:, 0] >= 0
    corners = vertices[span[there]].astype(np.float64)
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    basis = np.stack([u, v, unit(np.cross(u, v))], -1)
    found[there] = np.linalg.inv(basis) @ tangents[there]
    return found


@njit
def _repaint(first, last, faces, face, weights, changed, edited, values):  # type: ignore[no-untyped-def]
    """Blend `values` (n, c) of the surfels towards the `edited` (k, c) values of their changed vertices."""
    for i in range(first, last):
        total, new = 0.0, 0.0
        for k in range(3):
            w = max(weights[i, k], np.float32(0.0))
            total += w
            if changed[faces[face[i], k]]:
                new += w
        if new > 0.0:
            for c in range(values.shape[1]):
                value = (total - new) * values[i, c]
                for k in range(3):
                    v = faces[face[i], k]
                    if changed[v]:
                        value += max(weights[i, k], np.float32(0.0)) * edited[v, c]
                values[i, c] = value / total
