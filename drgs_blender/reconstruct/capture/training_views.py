"""Training views: over one background, cropped to the object, in full and half size, with what never changes computed.

Beyond its mask a view teaches nothing but the background. What is left of it around the object is wide enough to show
surfels that stray.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from ...core.arrays import Array
from ...core.errors import AssetError
from ...core.frame import Camera
from ...geometry.normals import unit
from ..losses.photometric import Photograph
from ..meshing.crops import box_of, cut
from ..meshing.visual_hull import silhouettes
from .capture import RGB, Capture, View

#: Pixels of all views up to which what SSIM knows of photographs beforehand is kept: 24 bytes each.
MAX_CACHED_PIXELS = 30_000_000
#: Margin of a crop around the mask: in parts of the mask's longer side, and in pixels at the least.
MARGIN, LEAST_MARGIN = 0.1, 16
#: Mask up to which a pixel shows no object: what compression leaves of 0.
TRACE = 0.02
#: Background given to photographs whose masks take their real one away, sRGB.
GREY = (0.5, 0.5, 0.5)


@dataclass(slots=True)
class Target:
    """One view at one size, cropped to the object.

    Attributes
    ----------
    camera : Camera
        Of that size and crop.
    photograph : Photograph or tensor
        The photograph to be matched; on a device the colour alone, (h, w, 3).
    mask : (h, w) tensor or None
        Tensor in 0..1, or None where nothing is known of it.
    background : (h, w, 3) tensor or None
        What is behind the surfels, sRGB; None: the one colour of `background_of`.
    normals : (h, w, 3) tensor or None
        See `View.normals`.
    turn : (3, 3) float32 array or None
        See `View.turn`.
    share : float
        Pixels of the crop in parts of the whole view's. Means over the crop count as much: a pixel of each view counts
        the same.
    unknown : (h, w) bool tensor or None
        Where the mask may be wrong, `near_outline` of `View.mask_band`: neither it nor the photograph teaches anything
        there. None: nowhere.
    """

    camera: Camera
    photograph: Photograph | Tensor
    mask: Tensor | None
    background: Tensor | None = None
    normals: Tensor | None = None
    turn: Array | None = None
    share: float = 1.0
    unknown: Tensor | None = None

    @property
    def colour(self) -> Tensor:
        """(h, w, 3) of the photograph."""
        known = self.photograph
        return torch.from_numpy(known.colour) if isinstance(known, Photograph) else known


def background_of(capture: Capture) -> RGB:
    """Background colour behind the surfels."""
    if capture.background is not None:
        return capture.background
    masked = all(view.mask is not None for view in capture.training)
    return GREY if masked else (0.0, 0.0, 0.0)


def composed(view: View, capture: Capture) -> Array:
    """The colour of `view` over `background_of` the capture, (h, w, 3)."""
    return view.colour if capture.background is not None else view.laid_on(GREY, None)


def targets(capture: Capture) -> list[list[Target]]:
    """Training views in full and in half size: [full, half]; errors as of `full_targets`."""
    full = full_targets(capture)
    return [full, [half_target(target) for target in full]]


def full_targets(capture: Capture) -> list[Target]:
    """Training views in full size.

    Raises
    ------
    AssetError: pictures that are all black; masks, see `silhouettes`.
    """
    views = capture.training
    if max(float(view.colour.max()) for view in views) < 2 / 255:
        raise AssetError(str(capture.source), "has black pictures alone", "Check the exposure and the files")
    drawn = silhouettes(capture)
    masks: list[Array | None] = [None for _ in views] if drawn is None else [*drawn]
    windows = [_window(view.camera, mask) for view, mask in zip(views, masks, strict=True)]
    keep = sum((x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in windows) <= MAX_CACHED_PIXELS
    found = []
    for view, mask, (x0, y0, x1, y1) in zip(views, masks, windows, strict=True):
        whole = view.camera
        camera = cut(whole, x0, y0, x1 - x0, y1 - y0)
        colour = composed(view, capture)[y0:y1, x0:x1]
        share = camera.width * camera.height / (whole.width * whole.height)
        if mask is not None:
            mask = np.ascontiguousarray(mask[y0:y1, x0:x1], np.float32)
        normals = None if view.normals is None else view.normals[y0:y1, x0:x1]
        found.append(_target(camera, colour, mask, normals, keep and not view.mask_band, share))
        found[-1].turn = view.turn
        if mask is not None and view.mask_band:
            found[-1].unknown = torch.from_numpy(near_outline(mask, view.mask_band))
    return found


def near_outline(mask: Array, band: float) -> Array:
    """(h, w) bool: `band` pixels on either side of the outline of `mask`; outside alone of parts that have no more."""
    inside = mask > 0.5
    if inside.all() or not inside.any():
        return np.zeros(mask.shape, bool)
    depth = distance_transform_edt(inside)
    core = depth > band
    thick = distance_transform_edt(~core) <= band + 1 if core.any() else core
    return np.where(inside, (depth <= band) & thick, distance_transform_edt(~inside) <= band)


def half_target(target: Target) -> Target:
    """A view of `full_targets` in half size."""
    photograph = target.photograph
    assert isinstance(photograph, Photograph)
    mask = None if target.mask is None else half_size(target.mask.numpy()[..., None])[..., 0]
    normals = None if target.normals is None else unit(half_size(target.normals.numpy()), (0, 0, 0))
    keep = photograph.kept is not None
    made = _target(halved(target.camera), half_size(photograph.colour), mask, normals, keep, target.share)
    made.turn = target.turn
    if target.unknown is not None:
        made.unknown = torch.from_numpy(half_size(target.unknown.numpy()[..., None].astype(np.float32))[..., 0] > 0)
    if target.background is not None:
        made.background = torch.from_numpy(half_size(target.background.numpy()))
    return made


def _window(camera: Camera, mask: Array | None) -> tuple[int, int, int, int]:
    """Pixels (x0, y0, x1, y1) around the object, all where it is not to be seen; halves of x0 and y0 are whole."""
    whole = (0, 0, camera.width, camera.height)
    if mask is None or (box := box_of(mask > TRACE)) is None:
        return whole
    x0, y0, x1, y1 = box
    margin = max(LEAST_MARGIN, math.ceil(MARGIN * max(x1 - x0 - 1, y1 - y0 - 1)))
    x0, y0 = (max(at - margin, 0) // 2 * 2 for at in (x0, y0))
    return x0, y0, min(x1 + margin, camera.width), min(y1 + margin, camera.height)


def _target(
    camera: Camera, colour: Array, mask: Array | None, normals: Array | None, keep: bool, share: float
) -> Target:
    known = None if mask is None else torch.from_numpy(mask)
    turned = None if normals is None else torch.from_numpy(np.ascontiguousarray(normals, np.float32))
    return Target(camera, Photograph.of(colour, keep), known, normals=turned, share=share)


def halved(camera: Camera) -> Camera:
    """The camera of the picture that `half_size` makes."""
    return replace(
        camera, width=camera.width // 2, height=camera.height // 2, fx=camera.fx / 2, fy=camera.fy / 2,
        cx=camera.cx / 2, cy=camera.cy / 2,
    )  # fmt: skip


def half_size(picture: Array) -> Array:
    """Means (h // 2, w // 2, c) of two by two pixels; an odd last row or column is dropped."""
    h, w = picture.shape[0] // 2, picture.shape[1] // 2
    return np.ascontiguousarray(picture[: 2 * h, : 2 * w].reshape(h, 2, w, 2, -1).mean(axis=(1, 3)), np.float32)


def pixel_rays(camera: Camera, device: torch.device | None = None) -> Tensor:
    """(h, w, 3) float32 directions of the pixels' centres, world space, of unit depth; on the CPU or a device."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = -(np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    right, up, back = np.asarray(camera.matrix_world)[:3, :3].T
    across = torch.tensor(x[:, None] * right, dtype=torch.float32, device=device)
    down = torch.tensor(y[:, None] * up - back, dtype=torch.float32, device=device)
    return across + down[:, None]
