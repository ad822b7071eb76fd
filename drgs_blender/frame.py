"""The description of one frame: all that changes from frame to frame, in one message.

World space, Z up, metres. Pixel coordinates: x to the right, y **down**, (0, 0) is the top-left corner of the
full picture, pixel centres at +0.5. Picture arrays have row 0 at the top.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

Array = np.ndarray


@dataclass(slots=True)
class Camera:
    """A perspective or orthographic camera.

    The ray through pixel position (px, py) has, in the camera's own frame (Blender's: looking down -Z, Y up), the
    direction ``((px - cx) / fx, -(py - cy) / fy, -1)`` from the camera centre; when orthographic it starts at
    ``((px - cx) / fx, -(py - cy) / fy, 0)`` and runs along -Z, so fx is in pixels per metre.

    Attributes
    ----------
    matrix_world : (4, 4) float64 camera-to-world, rigid, Blender's convention
    width, height : full picture in pixels (after resolution %)
    fx, fy, cx, cy : pixels; fx != fy expresses pixel aspect
    region : (x0, y0, x1, y1) in pixels, half-open: what is rendered (border); None is everything. Results are always
        of the region's size.
    """

    matrix_world: Array
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    orthographic: bool = False
    clip_start: float = 1e-3
    clip_end: float = 1e6
    region: tuple[int, int, int, int] | None = None

    @property
    def window(self) -> tuple[int, int, int, int]:
        """(x0, y0, x1, y1): the pixels to render."""
        return self.region or (0, 0, self.width, self.height)


@dataclass(slots=True)
class ObjectState:
    """One DR-GS object in one frame.

    Attributes
    ----------
    name : object name, used in messages
    asset : key of a loaded asset (see Session.load_asset)
    matrix_world : (4, 4) float64 object-to-world; may scale, shear or mirror
    vertices : (n, 3) float32, **object space**, the evaluated mesh; None is the asset's rest mesh
    corner_normals : (m, 3, 3) float32 unit, object space, one a face corner, or None for smooth angle-weighted
        vertex normals computed by the engine
    albedo, roughness, metallic : per-vertex overrides (n, 3), (n,), (n,); None keeps the asset's
    pass_index : Blender's object index pass
    """

    name: str
    asset: str
    matrix_world: Array = field(default_factory=lambda: np.eye(4))
    vertices: Array | None = None
    corner_normals: Array | None = None
    albedo: Array | None = None
    roughness: Array | None = None
    metallic: Array | None = None
    pass_index: int = 0


@dataclass(slots=True)
class World:
    """Distant light. Radiance from world direction d is ``image(rotation @ d) * colour * strength``.

    ``environment`` is (h, w, 3) float32 lat-long in Blender's mapping (see asset.Environment) or None for a constant
    colour. ``rotation`` is what a Mapping node does to the vector: Rotation Z of t degrees is rotation about +Z by
    +t. ``colour`` is linear Rec.709.
    """

    environment: Array | None = None
    rotation: Array = field(default_factory=lambda: np.eye(3))
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)
    strength: float = 1.0


@dataclass(slots=True)
class RenderSettings:
    """How a frame is solved.

    ``cosine``, ``ggx``, ``environment`` are samples a pixel of each strategy (their sum is "rays"); ``aa`` is the
    number of sub-pixel positions among which they are divided. ``bounces`` counts indirect bounces. ``look`` is
    "principled" (Blender's Principled BSDF, GGX) or "paper" (the paper's BRDF). ``threads`` 0 is all cores.
    """

    cosine: int = 16
    ggx: int = 8
    environment: int = 8
    bounces: int = 1
    aa: int = 4
    primary: Literal["surfels", "mesh"] = "surfels"
    denoise: Literal["none", "svgf"] = "none"
    look: Literal["principled", "paper"] = "principled"
    film_transparent: bool = False
    seed: int = 0
    threads: int = 0

    @property
    def rays(self) -> int:
        """Samples a pixel over all strategies."""
        return self.cosine + self.ggx + self.environment


@dataclass(slots=True)
class Frame:
    """Everything the engine needs, next to loaded assets, to render one picture."""

    number: int
    camera: Camera
    objects: list[ObjectState]
    world: World = field(default_factory=World)
    settings: RenderSettings = field(default_factory=RenderSettings)
    passes: tuple[str, ...] = ("Combined",)


def split_rays(rays: int) -> tuple[int, int, int]:
    """Divide `rays` as the paper does: half cosine, a quarter GGX, a quarter environment; each at least 1."""
    ggx = environment = max(1, rays // 4)
    return max(1, rays - ggx - environment), ggx, environment
