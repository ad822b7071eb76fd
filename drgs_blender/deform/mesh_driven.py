"""Mesh-driven deformation: surfels follow the faces they hang on, exactly.

A face and its unit normal span space, so the deformation gradient of a face is F = [e1' e2' n'] [e1 e2 n]^-1 and the
scaled tangents become T' = F T. With C = [e1 e2 n]^-1 T precomputed, a frame costs three vertices, one normal and a
3x3 by 3x2 product a surfel. Rotations are never blended: F comes from the face, and the shading normal from smooth
vertex normals. A surfel larger than its face has a second F, of three vertices as far apart as it is large, and takes
the one that stretches it less: neither a single face that is carried badly nor a gap within its reach smears it.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ..compute.jit import njit, plain, prange
from ..core.asset.model import MATERIAL_CHANNELS, Binding, Mesh, PosedSurfels, Surfels
from ..core.errors import AssetError
from ..geometry.normals import VertexNormals, rotation_matrices, unit
from .face_frames import Faces
from .wide_support import spans

Array = np.ndarray
log = logging.getLogger(__name__)

#: Surfels of a block.
_BLOCK = 256


class Posing(NamedTuple):
    """What a pose is made from, checked.

    Attributes
    ----------
    vertices : (n, 3) float32 array
        World space.
    normals : (3 m, 3) float32 array or None
        Of the corners; None: smooth ones are to be made.
    bent : (m, 3) int32 array
        Faces that smooth normals are made from: those that are torn are points.
    linear : array
        See `pose_surfels`.
    side : float
        See `pose_surfels`.
    opacity : array
        Of the surfels where all vertices are finite.
    channels : dict of str to array
        Materials of the surfels; the asset's own arrays where nothing was edited.
    """

    vertices: Array
    normals: Array | None
    bent: Array
    linear: Array
    side: float
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
    lost : int
        Surfels of the last pose whose face had a vertex that was not finite; they are transparent.
    rest : tuple of array
        What `pose_surfels` reads of the binding: face, weights, offset in metres, the faces' mean edge where they have
        no area (else 0), normal, the tangents in the frame of edges and normal, `wide_support.spans` and the same in
        theirs.
    """

    def __init__(self, mesh: Mesh, surfels: Surfels, binding: Binding) -> None:
        if len(binding.face) != len(surfels):
            raise AssetError(
                "binding", f"is of {len(binding.face)} surfels but there are {len(surfels)}", "Bind the surfels again"
            )
        if len(binding.face) and (binding.face.min() < 0 or binding.face.max() >= len(mesh.faces)):
            raise AssetError(
                "binding", f"refers to a face that the mesh of {len(mesh.faces)} faces lacks", "Bind the surfels again"
            )
        self.mesh, self.surfels, self.binding = mesh, surfels, binding
        self.normals = VertexNormals(mesh.faces, len(mesh.vertices))
        faces, normals = Faces.of(mesh.vertices, mesh.faces), self.normals(mesh.vertices)
        self.degenerate_faces = int(faces.degenerate.sum())
        self.lost = 0
        face, corners = binding.face, faces.corners
        offset = (binding.offset * faces.mean_edge[face]).astype(np.float32)
        rest_edge = np.where(faces.degenerate, faces.mean_edge, 0).astype(np.float32)  # 0: a proper face

        tangents = rotation_matrices(surfels.rotation.astype(np.float64))[..., :2] * surfels.scale[:, None, :]
        basis = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], faces.normal], -1)
        if self.degenerate_faces:
            log.warning("mesh: %d faces have no area at rest", self.degenerate_faces)
            smooth = normals.astype(np.float64)[mesh.faces].mean(axis=1)
            for f in np.flatnonzero(faces.degenerate):
                frame = _tangent_frame(*basis[f, :, 0].tolist(), *basis[f, :, 1].tolist(), *smooth[f].tolist())
                basis[f] = np.reshape(frame, (3, 3)).T
        coordinates = np.ascontiguousarray(np.linalg.inv(basis)[face] @ tangents, dtype=np.float32)
        span = spans(mesh.vertices, mesh.faces, normals, faces, face, binding.barycentric, surfels.scale.max(axis=1))
        rest = (binding.face, binding.barycentric, offset, rest_edge, binding.normal, coordinates)
        self.rest = tuple(map(plain, (*rest, span, _in_spans(mesh.vertices, span, tangents))))

    def pose(
        self,
        vertices_world: Array,
        corner_normals_world: Array | None = None,
        materials: Mapping[str, Array | None] | None = None,
        *,
        matrix_world: Array | None = None,
        object_index: int = 0,
        torn: Array | None = None,
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

        Returns
        -------
        PosedSurfels
            Always finite. A collapsed face yields flat or vanishing tangents and a finite normal.
        """
        posing = self.posing(vertices_world, corner_normals_world, materials, matrix_world, torn)
        by_corner, normals = posing.normals is not None, posing.normals
        if normals is None:
            normals = np.empty_like(posing.vertices)
            self.normals.into(posing.vertices, posing.bent, normals)
            if posing.side < 0:
                normals = -normals
        n = len(self.surfels)
        opacity = posing.opacity.copy()
        centre, tangent_u, tangent_v, normal = (np.empty((n, 3), np.float32) for _ in range(4))
        _pose(
            (plain(posing.vertices), plain(self.mesh.faces), plain(normals)), by_corner, posing.linear, posing.side,
            self.rest, (centre, tangent_u, tangent_v, normal, opacity),
        )  # fmt: skip
        self.lost = int(np.count_nonzero(opacity != posing.opacity))
        if self.lost:
            log.debug("%d surfels hang on vertices that are not finite; they are hidden", self.lost)
        owner = np.full(n, object_index, np.int32)
        return PosedSurfels(centre, tangent_u, tangent_v, normal, opacity, **posing.channels, object_index=owner)

    def posing(
        self, vertices_world: Array, corner_normals_world: Array | None, materials: Mapping[str, Array | None] | None,
        matrix_world: Array | None, torn: Array | None,
    ) -> Posing:  # fmt: skip
        """What a pose is made from; parameters as of `pose`."""
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
        bent, opacity = self.normals.faces, self.surfels.opacity
        if torn is not None:
            bent = np.where(torn[:, None], np.int32(0), bent)
            opacity = np.where(torn[self.binding.face], np.float32(0.0), opacity)
        channels = {name: self._channel(name, (materials or {}).get(name)) for name in MATERIAL_CHANNELS}
        side = -1.0 if np.linalg.det(linear) < 0 else 1.0
        return Posing(vertices, normals, bent, linear, side, opacity, channels)

    def _channel(self, name: str, edited: Array | None) -> Array:
        """A material channel of the surfels after the vertices' values became `edited`."""
        own, rest = getattr(self.surfels, name), getattr(self.mesh, name)
        if edited is None:
            return own
        edited = np.ascontiguousarray(edited, dtype=np.float32)
        if edited.shape != rest.shape:
            raise AssetError(f"{name} of the vertices", f"has shape {edited.shape}, expected {rest.shape}")
        changed = np.abs(edited - rest) > 1e-6
        if changed.ndim == 2:
            changed = changed.any(axis=1)
        if not changed.any():
            return own
        result = own.reshape(len(own), -1).copy()
        _repaint(
            plain(self.mesh.faces), plain(self.binding.face), plain(self.binding.barycentric), changed,
            plain(edited.reshape(len(rest), -1)), result,
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
def _raised(linear: Any, nx: float, ny: float, nz: float) -> tuple[float, float, float]:
    """What stands off a surface with unit normal n goes through matrix_world: A normalise(A^T n), A its linear part."""
    ox = linear[0, 0] * nx + linear[1, 0] * ny + linear[2, 0] * nz
    oy = linear[0, 1] * nx + linear[1, 1] * ny + linear[2, 1] * nz
    oz = linear[0, 2] * nx + linear[1, 2] * ny + linear[2, 2] * nz
    length = math.sqrt(ox * ox + oy * oy + oz * oz)
    length = 1.0 / length if length > 1e-300 else 0.0
    ox, oy, oz = ox * length, oy * length, oz * length
    return (
        linear[0, 0] * ox + linear[0, 1] * oy + linear[0, 2] * oz,
        linear[1, 0] * ox + linear[1, 1] * oy + linear[1, 2] * oz,
        linear[2, 0] * ox + linear[2, 1] * oy + linear[2, 2] * oz,
    )


@njit
def _tangents(
    ux: float, uy: float, uz: float, vx: float, vy: float, vz: float, hx: float, hy: float, hz: float,
    coordinates: Any, i: Any,
) -> tuple[float, float, float, float, float, float]:  # fmt: skip
    """Both tangents of a surfel whose `coordinates` are in the frame of u, v and h."""
    p, q, r = coordinates[i, 0, 0], coordinates[i, 1, 0], coordinates[i, 2, 0]
    a, b, c = coordinates[i, 0, 1], coordinates[i, 1, 1], coordinates[i, 2, 1]
    return (
        ux * p + vx * q + hx * r, uy * p + vy * q + hy * r, uz * p + vz * q + hz * r,
        ux * a + vx * b + hx * c, uy * a + vy * b + hy * c, uz * a + vz * b + hz * c,
    )  # fmt: skip


@njit
def _tangent_frame(
    ax: float, ay: float, az: float, bx: float, by: float, bz: float, sx: float, sy: float, sz: float
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Axes t, b, s of the shading frame: s = normalised (sx, sy, sz), t = a (else b, else an axis) projected off s."""
    length = math.sqrt(sx * sx + sy * sy + sz * sz)
    if not (length > 1e-12):
        sx, sy, sz, length = 0.0, 0.0, 1.0, 1.0
    sx, sy, sz = sx / length, sy / length, sz / length
    tx, ty, tz, length = 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        if k == 1:
            ax, ay, az = bx, by, bz
        elif k == 2:
            along_x = abs(sx) <= abs(sy) and abs(sx) <= abs(sz)
            along_y = not along_x and abs(sy) <= abs(sz)
            ax, ay = 1.0 if along_x else 0.0, 1.0 if along_y else 0.0
            az = 1.0 - ax - ay
        d = ax * sx + ay * sy + az * sz
        tx, ty, tz = ax - d * sx, ay - d * sy, az - d * sz
        length = math.sqrt(tx * tx + ty * ty + tz * tz)
        if length > 1e-6 * math.sqrt(ax * ax + ay * ay + az * az):
            break
    tx, ty, tz = tx / length, ty / length, tz / length
    return tx, ty, tz, sy * tz - sz * ty, sz * tx - sx * tz, sx * ty - sy * tx, sx, sy, sz


@njit(parallel=True)
def _pose(mesh: Any, by_corner: bool, linear: Array, side: float, rest: Any, out: Any) -> None:
    blocks = (len(rest[0]) + _BLOCK - 1) // _BLOCK
    for block in prange(blocks):
        pose_surfels(block, blocks, 0, mesh, by_corner, linear, side, rest, out)


@njit
def pose_surfels(lane, lanes, room, mesh, by_corner, linear, side, rest, out):  # type: ignore[no-untyped-def]
    """Pose every so-manyth (`lanes`) block of surfels, from the `lane`-th on.

    Arithmetic in double so that a small object far from the origin stays exact.

    Parameters
    ----------
    lane, lanes : int
    room : object
        Not used.
    mesh : tuple of array
        Posed vertices, faces, normals of the vertices or (`by_corner`) of the corners.
    by_corner : bool
    linear : (3, 3) float64 array
        Of the object's matrix.
    side : float
        -1 if that mirrors, else 1.
    rest : tuple of array
        `MeshDriven.rest`.
    out : tuple of array
        Written: centre, tangent_u, tangent_v, normal; opacity where a vertex is not finite.
    """
    vertices, faces, normals = mesh
    face, weights, offset, rest_edge, local_normal, coordinates, span, in_span = rest
    centre, tangent_u, tangent_v, normal, opacity = out
    for block in range(lane, (len(face) + _BLOCK - 1) // _BLOCK, lanes):
        for i in range(block * _BLOCK, min((block + 1) * _BLOCK, len(face))):
            f = face[i]
            ia, ib, ic = faces[f, 0], faces[f, 1], faces[f, 2]
            wa, wb, wc = np.float64(weights[i, 0]), np.float64(weights[i, 1]), np.float64(weights[i, 2])
            ax, ay, az = np.float64(vertices[ia, 0]), np.float64(vertices[ia, 1]), np.float64(vertices[ia, 2])
            ux, uy, uz = vertices[ib, 0] - ax, vertices[ib, 1] - ay, vertices[ib, 2] - az
            vx, vy, vz = vertices[ic, 0] - ax, vertices[ic, 1] - ay, vertices[ic, 2] - az
            size = abs(ax) + abs(ay) + abs(az) + abs(ux) + abs(uy) + abs(uz) + abs(vx) + abs(vy) + abs(vz)
            if not (size < 1e30):  # a comparison: math.isfinite(a + b) is folded to True when sums may be reordered
                opacity[i] = 0.0
                for k in range(3):
                    centre[i, k] = tangent_u[i, k] = tangent_v[i, k] = 0.0
                    normal[i, k] = 1.0 if k == 2 else 0.0
                continue

            # Smooth normal: of the vertices or of the corners.
            ja, jb, jc = (3 * f, 3 * f + 1, 3 * f + 2) if by_corner else (ia, ib, ic)
            pa, pb, pc = max(wa, 0.0), max(wb, 0.0), max(wc, 0.0)  # weights may leave the face, its normal does not
            sx = pa * normals[ja, 0] + pb * normals[jb, 0] + pc * normals[jc, 0]
            sy = pa * normals[ja, 1] + pb * normals[jb, 1] + pc * normals[jc, 1]
            sz = pa * normals[ja, 2] + pb * normals[jb, 2] + pc * normals[jc, 2]

            # Outward unit face normal; a collapsed face takes the smooth one.
            nx, ny, nz = side * (uy * vz - uz * vy), side * (uz * vx - ux * vz), side * (ux * vy - uy * vx)
            length = math.sqrt(nx * nx + ny * ny + nz * nz)
            uu, vv = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz
            if not (length > 1e-10 * (uu + vv)):
                nx, ny, nz = sx, sy, sz
                length = math.sqrt(nx * nx + ny * ny + nz * nz)
                if not (length > 1e-12):
                    nx, ny, nz, length = 0.0, 0.0, 1.0, 1.0
            nx, ny, nz = nx / length, ny / length, nz / length
            if not (sx * sx + sy * sy + sz * sz > 1e-12):
                sx, sy, sz = nx, ny, nz
            tx, ty, tz, bx, by, bz, sx, sy, sz = _tangent_frame(ux, uy, uz, vx, vy, vz, sx, sy, sz)

            hx, hy, hz = _raised(linear, nx, ny, nz)
            d = np.float64(offset[i])
            centre[i, 0] = ax + wb * ux + wc * vx + d * hx
            centre[i, 1] = ay + wb * uy + wc * vy + d * hy
            centre[i, 2] = az + wb * uz + wc * vz + d * hz

            if rest_edge[f] > 0.0:
                wx, wy, wz = vx - ux, vy - uy, vz - uz
                edges = math.sqrt(uu) + math.sqrt(vv) + math.sqrt(wx * wx + wy * wy + wz * wz)
                grow = edges / (3.0 * rest_edge[f])
                ux, uy, uz = grow * tx, grow * ty, grow * tz
                vx, vy, vz = side * grow * bx, side * grow * by, side * grow * bz
                hx, hy, hz = grow * sx, grow * sy, grow * sz
            fx, fy, fz, gx, gy, gz = _tangents(ux, uy, uz, vx, vy, vz, hx, hy, hz, coordinates, i)
            if span[i, 0] >= 0:
                ia, ib, ic = span[i, 0], span[i, 1], span[i, 2]
                ax, ay, az = np.float64(vertices[ia, 0]), np.float64(vertices[ia, 1]), np.float64(vertices[ia, 2])
                ux, uy, uz = vertices[ib, 0] - ax, vertices[ib, 1] - ay, vertices[ib, 2] - az
                vx, vy, vz = vertices[ic, 0] - ax, vertices[ic, 1] - ay, vertices[ic, 2] - az
                nx, ny, nz = side * (uy * vz - uz * vy), side * (uz * vx - ux * vz), side * (ux * vy - uy * vx)
                length = math.sqrt(nx * nx + ny * ny + nz * nz)
                if length > 1e-10 * (ux * ux + uy * uy + uz * uz + vx * vx + vy * vy + vz * vz):
                    hx, hy, hz = _raised(linear, nx / length, ny / length, nz / length)
                    px, py, pz, qx, qy, qz = _tangents(ux, uy, uz, vx, vy, vz, hx, hy, hz, in_span, i)
                    own = fx * fx + fy * fy + fz * fz + gx * gx + gy * gy + gz * gz
                    if (
                        px * px + py * py + pz * pz + qx * qx + qy * qy + qz * qz < own
                    ):  # a comparison: false if not finite
                        fx, fy, fz, gx, gy, gz = px, py, pz, qx, qy, qz
            tangent_u[i, 0], tangent_u[i, 1], tangent_u[i, 2] = fx, fy, fz
            tangent_v[i, 0], tangent_v[i, 1], tangent_v[i, 2] = gx, gy, gz

            lx, ly, lz = np.float64(local_normal[i, 0]), side * local_normal[i, 1], np.float64(local_normal[i, 2])
            nx = tx * lx + bx * ly + sx * lz
            ny = ty * lx + by * ly + sy * lz
            nz = tz * lx + bz * ly + sz * lz
            length = math.sqrt(nx * nx + ny * ny + nz * nz)
            if not (length > 1e-12):
                nx, ny, nz, length = sx, sy, sz, 1.0
            normal[i, 0], normal[i, 1], normal[i, 2] = nx / length, ny / length, nz / length


@njit(parallel=True)
def _repaint(faces: Array, face: Array, weights: Array, changed: Array, edited: Array, values: Array) -> None:
    """Blend `values` (n, c) of the surfels towards the `edited` (k, c) values of their changed vertices."""
    for i in prange(len(face)):
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
