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
from ...render.reference.raster import camera_rays, pixel_centres
from ...render.scene.triangle_bvh import TriangleBVH
from ..capture.capture import Capture, View
from ..meshing.crops import cropped_views
from .losses import CLIPPED
from .settings import Settings

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
    index : (n, k) int32 array
        What carries materials there: the vertices of a face, or the surfels that are seen.
    share : (n, k) float32 array
        Of each of them, together 1: barycentric coordinates, or how much of the pixel it covers.
    origin : (n, 3) float32 array
        World: where rays start.
    flat : (n, 3) float32 array
        Unit: geometric normal.
    towards : (n, 3) float32 array
        Unit: to the viewer.
    colour : (n, 3) float32 array
        Linear Rec.709 as photographed.
    clipped : (n, 3) bool array
        The light may have been any stronger.
    next_to_clipped : (n, 3) bool array
        Not clipped, but a pixel of the object `_BESIDE` away or nearer is, in this channel.
    """

    view: Array
    place: Array
    index: Array
    share: Array
    origin: Array
    flat: Array
    towards: Array
    colour: Array
    clipped: Array
    next_to_clipped: Array

    def __len__(self) -> int:
        return len(self.view)

    def select(self, index: Array) -> Pixels:
        """The pixels at `index`."""
        return Pixels(**{f.name: np.ascontiguousarray(getattr(self, f.name)[index]) for f in fields(self)})

    def usable(self) -> Array:
        """Rows of those that face the viewer and have a colour."""
        return np.flatnonzero(((self.flat * self.towards).sum(1) > _GRAZING) & np.isfinite(self.colour).all(1))

    def blended(self, values: Array) -> Array:
        """(n, c) of the pixels, from `values` (v, c) of what they show."""
        return np.einsum("nk,nkc->nc", self.share, values[self.index])

    def onto(self, values: Array, count: int) -> Array:
        """Sums (count, c) at what the pixels show of `values` (n, c), by share and by how squarely they see it."""
        weight = self.share * (self.flat * self.towards).sum(axis=1, keepdims=True)
        row = self.index.ravel()
        return np.stack([np.bincount(row, (weight * column[:, None]).ravel(), count) for column in values.T], 1)


def of_training_views(capture: Capture, settings: Settings, of: Callable[[int, View], Pixels]) -> Pixels:
    """The foreground pixels of all training views, evenly chosen where there are more than settings allow.

    Parameters
    ----------
    capture : Capture
    settings : Settings
    of : callable
        Gives those of one view and its number.

    Raises
    ------
    UsageError
        Settings out of range; no training view; no pixel sees the object.
    """
    settings.check()
    views = capture.training
    if not views:
        raise UsageError(str(capture.source), "has no training view", "Leave fewer views out for the test")
    generator = np.random.default_rng(settings.seed)
    share = max(1, settings.most_pixels // len(views))
    parts, empty = [], []
    for index, view in enumerate(views):
        part = of(index, view)
        if not len(part):
            empty.append(view.name)
        elif len(part) > share:
            part = part.select(np.sort(generator.choice(len(part), share, replace=False)))
        parts.append(part)
    if empty and len(empty) < len(views):
        log.warning("%d of %d views do not see the object, such as %s", len(empty), len(views), empty[0])
    pixels = Pixels(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Pixels)})
    if not len(pixels):
        raise UsageError(
            "capture",
            f"none of its {len(views)} training views sees the object",
            "Check that cameras and mesh share one space, and that the masks are not empty",
        )
    return pixels


def pixels_of(index: int, view: View, mesh: Mesh, tree: TriangleBVH) -> Pixels:
    """The pixels of one view, the `index`-th, that see the mesh, a pixel away from its outline and the mask's."""
    check_size(view)
    height, width = view.colour.shape[:2]
    origin, direction = (a.numpy().astype(np.float32) for a in camera_rays(view.camera, pixel_centres(view.camera)))
    t, face, u, v = tree.intersect(origin, direction, tnear=view.camera.clip_start, tfar=view.camera.clip_end)
    seen = (face >= 0).reshape(height, width) & within_mask(view)
    row = np.flatnonzero(binary_erosion(seen, border_value=1) if min(seen.shape) > 2 else seen)
    t, face, u, v, origin, direction = t[row], face[row], u[row], v[row], origin[row], direction[row]

    corners = mesh.vertices[mesh.faces[face]]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-30)
    towards = -direction / np.linalg.norm(direction, axis=1, keepdims=True)
    part = Pixels(
        np.full(len(row), index, np.int32),
        row.astype(np.int32),
        mesh.faces[face].astype(np.int32),
        np.stack([1 - u - v, u, v], -1),
        origin + t[:, None] * direction,
        flat,
        towards,
        *photographed(view, seen, row),
    )
    # A face seen from behind is an error of the mesh, or of its orientation: nothing can be learned there.
    return part.select(part.usable())


def onto_vertices(mesh: Mesh, views: list[View], shown: Callable[[View], Array]) -> Array:
    """Sums (v, c) at a mesh's vertices of what is `shown` (h, w, c) of it in views cropped to it; see `Pixels.onto`."""
    tree, total = TriangleBVH(mesh.vertices, mesh.faces), np.zeros(())
    for index, view in enumerate(cropped_views(views, mesh.vertices)):
        pixels, picture = pixels_of(index, view, mesh, tree), shown(view)
        total = total + pixels.onto(picture.reshape(-1, picture.shape[-1])[pixels.place], len(mesh.vertices))
    return total


def check_size(view: View) -> None:
    """Raise UsageError where the picture of a view is not of its camera's size."""
    height, width = view.colour.shape[:2]
    x0, y0, x1, y1 = view.camera.window
    if (height, width) != (y1 - y0, x1 - x0):
        raise UsageError(
            f"view {view.name}",
            f"its picture has {width} x {height} pixels, its camera {x1 - x0} x {y1 - y0}",
            "Give each picture the camera of its own size",
        )


def within_mask(view: View) -> Array:
    """(h, w) bool: pixels that show nothing but the object."""
    size = view.colour.shape[:2]
    return np.ones(size, bool) if view.mask is None else np.asarray(view.mask).reshape(size) >= _INSIDE


def photographed(view: View, seen: Array, row: Array) -> tuple[Array, Array, Array]:
    """`Pixels.colour`, `clipped` and `next_to_clipped` of the pixels `row` (n,), those of the object `seen` (h, w)."""
    colour = srgb_to_linear(view.colour)
    clipped = colour >= CLIPPED if view.above_white is None else np.zeros(colour.shape, bool)
    if view.above_white is not None:
        colour = colour + view.above_white
    beside = _beside(seen[..., None] & clipped)
    return colour.reshape(-1, 3)[row], clipped.reshape(-1, 3)[row], beside[row]


def _beside(clipped: Array) -> Array:
    """Which pixels and channels (h w, 3) are near to those that are `clipped` (h, w, 3), and not clipped themselves."""
    steps = np.arange(-_BESIDE, _BESIDE + 1)
    disc = (steps[:, None] ** 2 + steps**2 <= _BESIDE**2)[..., None]
    return (binary_dilation(clipped, disc) & ~clipped).reshape(-1, 3)
