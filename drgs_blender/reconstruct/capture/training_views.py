"""Training views: over one background, in full and half size, with what never changes computed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from ...core.arrays import Array
from ...core.errors import AssetError
from ...core.frame import Camera
from ..losses.photometric import Photograph
from ..meshing.visual_hull import silhouettes
from .capture import Capture, View

#: Pixels of all views up to which what SSIM knows of photographs beforehand is kept: 24 bytes each.
MAX_CACHED_PIXELS = 30_000_000
#: Background given to photographs whose masks take their real one away, sRGB.
GREY = (0.5, 0.5, 0.5)


@dataclass(slots=True)
class Target:
    """One view at one size.

    Attributes
    ----------
    camera : Camera
        Of that size.
    photograph : Photograph or tensor
        The photograph to be matched; on a device the colour alone, (h, w, 3).
    mask : (h, w) tensor or None
        Tensor in 0..1, or None where nothing is known of it.
    background : (h, w, 3) tensor or None
        What is behind the surfels, sRGB; None: the one colour of `background_of`.
    """

    camera: Camera
    photograph: Photograph | Tensor
    mask: Tensor | None
    background: Tensor | None = None

    @property
    def colour(self) -> Tensor:
        """(h, w, 3) of the photograph."""
        known = self.photograph
        return torch.from_numpy(known.colour) if isinstance(known, Photograph) else known


def background_of(capture: Capture) -> tuple[float, float, float]:
    """Background colour behind the surfels."""
    if capture.background is not None:
        return capture.background
    masked = all(view.mask is not None for view in capture.training)
    return GREY if masked else (0.0, 0.0, 0.0)


def composed(view: View, capture: Capture) -> Array:
    """The colour of `view` over `background_of` the capture, (h, w, 3)."""
    if capture.background is not None or view.mask is None:
        return view.colour
    mask = view.mask[..., None]
    return view.colour * mask + np.asarray(GREY, np.float32) * (1 - mask)


def targets(capture: Capture) -> list[list[Target]]:
    """Training views in full and in half size: [full, half].

    Raises
    ------
    AssetError: pictures that are all black; masks, see `silhouettes`.
    """
    views = capture.training
    if max(float(view.colour.max()) for view in views) < 2 / 255:
        raise AssetError(str(capture.source), "has black pictures alone", "Check the exposure and the files")
    drawn = silhouettes(capture)
    masks: list[Array | None] = [None for _ in views] if drawn is None else [*drawn]
    keep = sum(view.colour[..., 0].size for view in views) <= MAX_CACHED_PIXELS
    full, half = [], []
    for view, mask in zip(views, masks, strict=True):
        colour = composed(view, capture)
        full.append(_target(view.camera, colour, mask, keep))
        smaller = None if mask is None else half_size(mask[..., None])[..., 0]
        half.append(_target(halved(view.camera), half_size(colour), smaller, keep))
    return [full, half]


def _target(camera: Camera, colour: Array, mask: Array | None, keep: bool) -> Target:
    known = None if mask is None else torch.from_numpy(np.ascontiguousarray(mask, np.float32))
    return Target(camera, Photograph.of(colour, keep), known)


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
    local = _local_rays(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, device)
    turn = torch.tensor(np.asarray(camera.matrix_world)[:3, :3].T, dtype=torch.float32, device=device)
    return local @ turn


@lru_cache(maxsize=8)
def _local_rays(
    width: int, height: int, fx: float, fy: float, cx: float, cy: float, device: torch.device | None
) -> Tensor:
    """The same in the camera's own frame: views of one lens share it."""
    x, y = (np.arange(width) + 0.5 - cx) / fx, -(np.arange(height) + 0.5 - cy) / fy
    rays = np.stack([*np.meshgrid(x, y), np.full((height, width), -1.0)], -1)
    return torch.tensor(rays, dtype=torch.float32, device=device)
