"""The surface behind the pixels of the photographs: where a ray of each meets the mesh, and what colour was seen."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion

from ...core.asset.model import Mesh
from ...core.color import srgb_to_linear
from ...core.errors import UsageError
from ...geometry.normals import unit
from ...render.reference.raster import camera_rays, pixel_centres
from ...render.scene.triangle_bvh import TriangleBVH
from ..capture.capture import View
from .losses import CLIPPED

Array = np.ndarray
log = logging.getLogger(__name__)

#: Normals (h, w, 3) of a view's pixels, world space, of any length, facing the viewer.
Normals = Callable[[View], Array]

#: A mask counts as the object from here on.
_INSIDE = 0.99
#: Least cosine between the surface and the viewer: nearer to the outline a pixel mixes too much.
_GRAZING = 0.1
#: Pixels around clipped ones that may well mirror the same, as far as normals are known.
_BESIDE = 2


@dataclass(slots=True)
class Pixels:
    """Foreground pixels, structure of arrays.

    Attributes
    ----------
    view : (n,) int32 array
        Index among the training views.
    place : (n,) int32 array
        Index in the view's picture, row by row.
    face : (n,) int32 array
    corners : (n, 3) float32 array
        Barycentric coordinates on the face.
    origin : (n, 3) float32 array
        World: the point on the mesh.
    flat : (n, 3) float32 array
        Unit: normal of the face.
    towards : (n, 3) float32 array
        Unit: to the viewer.
    colour : (n, 3) float32 array
        Linear Rec.709 as photographed.
    clipped : (n, 3) bool array
        The light may have been any stronger.
    next_to_clipped : (n, 3) bool array
        Not clipped, but a pixel of the object `_BESIDE` away or nearer is, in this channel.
    detail_normal : (n, 3) float32 array
        Unit normal of finer detail than the mesh, facing the viewer; 0 where there is none.
    """

    view: Array
    place: Array
    face: Array
    corners: Array
    origin: Array
    flat: Array
    towards: Array
    colour: Array
    clipped: Array
    next_to_clipped: Array
    detail_normal: Array

    def __len__(self) -> int:
        return len(self.view)

    def select(self, index: Array) -> Pixels:
        """The pixels at `index`."""
        return Pixels(**{f.name: np.ascontiguousarray(getattr(self, f.name)[index]) for f in fields(self)})

    def onto_vertices(self, values: Array, faces: Array, count: int) -> Array:
        """Sums (count, c) at vertices of what the pixels show (n, c), by share and by how squarely they see it."""
        weight = self.corners * (self.flat * self.towards).sum(axis=1, keepdims=True)
        corner = faces[self.face].ravel()
        return np.stack([np.bincount(corner, (weight * column[:, None]).ravel(), count) for column in values.T], 1)


def foreground_pixels(
    views: list[View], mesh: Mesh, tree: TriangleBVH, most: int, seed: int = 0, normals: Normals | None = None
) -> Pixels:
    """The pixels of `views` that see the mesh, a pixel away from its outline and the mask's.

    Parameters
    ----------
    views : list of View
    mesh : Mesh
    tree : TriangleBVH
        Of the mesh's triangles.
    most : int
        Keep this many, evenly chosen.
    seed : int
    normals : callable, optional
        Normals other than the mesh's; see `Pixels.detail_normal`.

    Raises
    ------
    UsageError
        When no pixel sees the mesh.
    """
    generator = np.random.default_rng(seed)
    share = max(1, most // max(1, len(views)))
    parts, empty = [], []
    for index, view in enumerate(views):
        part = pixels_of(index, view, mesh, tree, normals)
        if not len(part):
            empty.append(view.name)
        elif len(part) > share:
            part = part.select(np.sort(generator.choice(len(part), share, replace=False)))
        parts.append(part)
    if empty and len(empty) < len(views):
        log.warning("%d of %d views do not see the mesh, such as %s", len(empty), len(views), empty[0])
    pixels = Pixels(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Pixels)})
    if not len(pixels):
        raise UsageError(
            "capture",
            f"none of its {len(views)} training views sees the mesh",
            "Check that cameras and mesh share one space, and that the masks are not empty",
        )
    return pixels


def pixels_of(index: int, view: View, mesh: Mesh, tree: TriangleBVH, normals: Normals | None = None) -> Pixels:
    """The foreground pixels of one view, the `index`-th; see `foreground_pixels`."""
    height, width = view.colour.shape[:2]
    x0, y0, x1, y1 = view.camera.window
    if (height, width) != (y1 - y0, x1 - x0):
        raise UsageError(
            f"view {view.name}",
            f"its picture has {width} x {height} pixels, its camera {x1 - x0} x {y1 - y0}",
            "Give each picture the camera of its own size",
        )
    origin, direction = (a.numpy().astype(np.float32) for a in camera_rays(view.camera, pixel_centres(view.camera)))
    t, face, u, v = tree.intersect(origin, direction, tnear=view.camera.clip_start, tfar=view.camera.clip_end)
    seen = (face >= 0).reshape(height, width)
    if view.mask is not None:
        seen &= np.asarray(view.mask).reshape(height, width) >= _INSIDE
    row = np.flatnonzero(binary_erosion(seen, border_value=1) if min(seen.shape) > 2 else seen)
    t, face, u, v, origin, direction = t[row], face[row], u[row], v[row], origin[row], direction[row]

    corners = mesh.vertices[mesh.faces[face]]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-30)
    towards = -direction / np.linalg.norm(direction, axis=1, keepdims=True)
    colour = srgb_to_linear(view.colour)
    clipped = colour >= CLIPPED if view.above_white is None else np.zeros(colour.shape, bool)
    if view.above_white is not None:
        colour = colour + view.above_white
    given = None if normals is None else np.asarray(normals(view), np.float32)
    part = Pixels(
        np.full(len(row), index, np.int32),
        row.astype(np.int32),
        face,
        np.stack([1 - u - v, u, v], -1),
        origin + t[:, None] * direction,
        flat,
        towards,
        colour.reshape(-1, 3)[row],
        clipped.reshape(-1, 3)[row],
        _beside(seen[..., None] & clipped)[row],
        np.zeros_like(flat) if given is None else unit(given.reshape(-1, 3)[row], (0, 0, 0)),
    )
    # A face seen from behind is an error of the mesh, or of its orientation: nothing can be learned there.
    usable = ((flat * towards).sum(1) > _GRAZING) & np.isfinite(part.colour).all(1)
    return part.select(np.flatnonzero(usable))


def _beside(clipped: Array) -> Array:
    """Which pixels and channels (h w, 3) are near to those that are `clipped` (h, w, 3), and not clipped themselves."""
    steps = np.arange(-_BESIDE, _BESIDE + 1)
    disc = (steps[:, None] ** 2 + steps**2 <= _BESIDE**2)[..., None]
    return (binary_dilation(clipped, disc) & ~clipped).reshape(-1, 3)
