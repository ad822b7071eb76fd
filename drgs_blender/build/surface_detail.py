"""What a mesh file shows between the vertices of its asset: shading normals, normal maps and textures, for surfels.

Tangents are MikkTSpace's, as Blender and glTF have them: of each corner the mean, weighted by angles, over the faces
around its vertex that continue its texture coordinates in the same orientation. Between corners, normal and tangent are
interpolated and not normalised, as in Cycles' Normal Map node.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.asset.model import MATERIAL_CHANNELS, Binding, Mesh, Surfels
from ..deform.face_frames import Faces, dot, shading_frames
from ..geometry.distinct_rows import distinct_row_indices
from ..geometry.normals import VertexNormals, unit
from .texture import CUT, Materials
from .topology import Net

Array = np.ndarray

#: Turn of the normal, radians, and difference of the materials (albedo as its square root) within a surfel's piece of
#: face at which it is cut.
TURN, DIFFERENCE = 0.1, 0.06
#: Surfels that pieces cut for detail may reach.
MAX_SURFELS = 400_000
#: A surfel averages its textures over this part of its piece's extent in texture coordinates.
FOOTPRINT = 0.7
#: Where a piece is compared with its middle: near its corners.
_PROBES = np.array([[4, 1, 1], [1, 4, 1], [1, 1, 4]]) / 6
#: Cosine to the face below which a normal of a map is not believed.
LEAST_FACING = 0.05


@dataclass(frozen=True, slots=True)
class CornerFrames:
    """Shading frames at the corners of a file's faces.

    Attributes
    ----------
    normal, tangent : (f, 3, 3) float64 array
        Unit, object space.
    side : (f,) float64 array
        -1 where the texture is mirrored, else 1: the bitangent is ``side * cross(normal, tangent)``.
    """

    normal: Array
    tangent: Array
    side: Array

    @classmethod
    def of(cls, vertices: Array, faces: Array, uvs: Array, normals: Array | None) -> CornerFrames:
        """Frames of faces.

        Parameters
        ----------
        vertices : (n, 3) float64 array
            Welded.
        faces : (f, 3) int array
        uvs : (f, 3, 2) float64 array
        normals : (f, 3, 3) float64 array, optional
            Of the corners; None: smooth ones of the vertices.
        """
        if normals is None:
            smooth = VertexNormals(np.ascontiguousarray(faces, np.int32), len(vertices))
            normals = smooth(np.ascontiguousarray(vertices, np.float32))[faces].astype(np.float64)
        corners = vertices[faces]
        (e1, e2), (d1, d2) = ([x[:, k] - x[:, 0] for k in (1, 2)] for x in (corners, uvs))
        area = d1[:, 0] * d2[:, 1] - d2[:, 0] * d1[:, 1]
        side = np.where(area < 0, -1.0, 1.0)
        along = (e1 * d2[:, 1:] - e2 * d1[:, 1:]) * side[:, None]
        flat = ~(area != 0)
        along[flat] = e1[flat]
        tangent = unit(along)[:, None] - normals * np.einsum("fkc,fc->fk", normals, unit(along))[..., None]
        tangent = unit(tangent.reshape(-1, 3), (1.0, 0.0, 0.0))
        ahead, back = unit(np.roll(corners, -1, 1) - corners), unit(np.roll(corners, 1, 1) - corners)
        angle = np.arccos(np.clip((ahead * back).sum(-1), -1, 1)).reshape(-1)
        group = distinct_row_indices(faces.reshape(-1), np.repeat(side > 0, 3).astype(np.int64), *uvs.reshape(-1, 2).T)
        total = np.stack([np.bincount(group, angle * tangent[:, c]) for c in range(3)], -1)
        return cls(normals, unit(total[group], (1.0, 0.0, 0.0)).reshape(-1, 3, 3), side)

    def normals_at(self, face: Array, weights: Array, bumps: Array | None) -> Array:
        """Unit shading normals (n, 3) of points at barycentric coordinates (n, 3) in faces, object space.

        Parameters
        ----------
        face : (n,) int array
        weights : (n, 3) array
        bumps : (n, 3) array, optional
            Normals of a map in tangent space.
        """
        normal = np.einsum("nk,nkc->nc", weights, self.normal[face])
        if bumps is None:
            return unit(normal)
        tangent = np.einsum("nk,nkc->nc", weights, self.tangent[face])
        bitangent = self.side[face, None] * np.cross(normal, tangent)
        return unit(bumps[:, :1] * tangent + bumps[:, 1:2] * bitangent + bumps[:, 2:] * normal)


class SurfaceDetail:
    """Materials and normals of a file anywhere on the faces of the mesh that was made of it.

    Parameters
    ----------
    net : Net
        Divided, with tags (material, part, face of the file).
    materials : Materials
    frames : CornerFrames
        Of the faces of the file.
    divided : bool
        Whether `net` has other faces than the file.
    """

    def __init__(self, net: Net, materials: Materials, frames: CornerFrames, divided: bool) -> None:
        self._net, self._materials, self._frames, self._divided = net, materials, frames, divided
        self._finest = 1.5 * materials.texel_size(bumps=True)

    @property
    def any(self) -> bool:
        """Whether it knows more than the vertices do."""
        used = np.unique(self._net.tags[:, 0])
        shown = self._materials.textured | self._materials.bumpy
        return self._divided or bool(self._materials.cut_out[used].any()) or bool(shown[used].any())

    def values_at(self, face: Array, weights: Array, extent: Array) -> Array:
        """Materials (n, channels) of points, averaged over an extent (n, 2) in texture coordinates."""
        net = self._net
        values = self._materials.sample(net.tags[face, 0], self._uvs(face, weights), FOOTPRINT * extent)
        own = np.einsum("nk,nkc->nc", weights, net.values[net.faces[face]])
        values[:, :3] *= own[:, :3]
        np.copyto(values[:, 3:], own[:, 3:], where=np.isfinite(own[:, 3:]))
        return self._materials.clipped(values.T).T

    def normals_at(self, face: Array, weights: Array, extent: Array) -> Array:
        """Unit shading normals (n, 3) of points, object space; of a map averaged over an extent (n, 2)."""
        net = self._net
        bumps = self._materials.normals(net.tags[face, 0], self._uvs(face, weights), FOOTPRINT * extent)
        return self._frames.normals_at(net.tags[face, 2], np.einsum("nk,nkc->nc", weights, net.inside[face]), bumps)

    def hidden_by(self, face: Array, pieces: Array) -> Array:
        """How much a piece of face hides: 0 where one surfel shows all, else its share of the surface times the error.

        Parameters
        ----------
        face : (n,) int array
        pieces : (n, 3, 3) array
            Barycentric coordinates of the corners.
        """
        net = self._net
        material, extent = net.tags[face, 0], self.extent_of(face, pieces)
        shown = np.flatnonzero(
            (self._materials.textured | self._materials.bumpy)[material] & (extent.max(1) > self._finest[material])
        )
        error = np.zeros(len(face))
        if not len(shown):
            return error
        some, fine = face[shown], 0.35 * extent[shown]
        middle = pieces[shown].mean(axis=1)
        values, normals = (
            self._materials.perceived(self.values_at(some, middle, fine).T),
            self.normals_at(some, middle, fine),
        )
        worst = np.zeros(len(shown))
        for probe in _PROBES:
            at = np.einsum("k,nkc->nc", probe, pieces[shown])
            apart = (
                np.abs(self._materials.perceived(self.values_at(some, at, fine).T) - values).max(axis=0) / DIFFERENCE
            )
            turn = np.arccos(np.clip(dot(self.normals_at(some, at, fine), normals), -1, 1)) / TURN
            worst = np.maximum(worst, np.maximum(apart, turn))
        corners = np.einsum("nij,njc->nic", pieces[shown], net.vertices[net.faces[some]])
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        error[shown] = np.where(worst > 1, worst * area, 0)
        return error

    def extent_of(self, face: Array, pieces: Array) -> Array:
        """Extent (n, 2) of pieces of faces in texture coordinates."""
        uvs = np.einsum("nij,njc->nic", pieces, self._net.uvs[face])
        return np.ptp(uvs, axis=1)

    def give(self, mesh: Mesh, surfels: Surfels, binding: Binding, pieces: Array) -> None:
        """Give surfels the materials and normals at their places.

        Parameters
        ----------
        mesh : Mesh
        surfels : Surfels
        binding : Binding
        pieces : (n, 3, 3) array
            Of `hidden_by`, one for each surfel.
        """
        face, weights = binding.face, binding.barycentric.astype(np.float64)
        extent = self.extent_of(face, pieces)
        values = self.values_at(face, weights, extent).astype(np.float32)
        for name, own in self._materials.columns.items():
            channel = np.ascontiguousarray(values[:, own] if own.stop - own.start > 1 else values[:, own.start])
            if name == CUT:
                surfels.opacity *= channel
            elif MATERIAL_CHANNELS[name].surfels:
                setattr(surfels, name, channel)
        faces = Faces.of(mesh.vertices, mesh.faces)
        normals = self.normals_at(face, weights, extent)
        inward = dot(normals, faces.normal[face]) < LEAST_FACING
        frames = shading_frames(faces, mesh.faces, mesh.vertices, face, weights)
        local = np.einsum("nij,ni->nj", frames, normals)
        binding.normal = np.where(inward[:, None], (0.0, 0.0, 1.0), unit(local)).astype(np.float32)

    def _uvs(self, face: Array, weights: Array) -> Array:
        return np.einsum("nk,nkc->nc", weights, self._net.uvs[face])
