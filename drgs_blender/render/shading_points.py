"""Shading points, which the integrator takes, and the light that it returns: what they send to the camera."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import NamedTuple

import numpy as np

from ..compute.jit import plain
from ..core.asset.model import as_float

Array = np.ndarray

#: Order of ``Radiance.components`` along its second axis.
DIFFUSE_DIRECT, DIFFUSE_INDIRECT, GLOSSY_DIRECT, GLOSSY_INDIRECT = range(4)

#: Bits of ``ShadingPoints.flags``. SECOND: an ordinary mesh seen next to surfels; a first point may have the same pixel
#: and sample, so random numbers must differ. CATCHER: of a shadow catcher, see ``Radiance.unshadowed``. UNLIT: of an
#: object shown as captured, which emits what is seen of it and reflects nothing. The bits from RECEIVER on are the set
#: of objects to which it belongs where lights are linked (`lights.light_links`).
SECOND, CATCHER, UNLIT, RECEIVER = 1, 2, 4, 3

_WIDTHS = {
    "weight": (), "origin": (3,), "normal": (3,), "geometric_normal": (3,), "view": (3,),
    "albedo": (3,), "roughness": (), "metallic": (),
}  # fmt: skip


class PointArrays(NamedTuple):
    """`ShadingPoints` for compiled code; `viewer` is its ``view``, a name that Numba takes for an array's method."""

    pixel: Array
    sample: Array
    flags: Array
    origin: Array
    normal: Array
    geometric_normal: Array
    viewer: Array
    albedo: Array
    roughness: Array
    metallic: Array
    own: Array
    size: Array
    smooth: Array
    terminator: Array
    face: Array


@dataclass(slots=True)
class ShadingPoints:
    """The visible surface points of a strip of the picture, structure of arrays, world space.

    Attributes
    ----------
    pixel : (n,) int32 array
        y * camera.width + x in the full picture; seeds the random numbers.
    sample : (n,) int32 array
        Sub-pixel sample, 0 .. subpixels - 1; a pair (pixel, sample) may occur twice, once flagged SECOND.
    weight : (n,) float32 array
        Alpha / subpixels, what the point contributes to its pixel.
    origin : (n, 3) float32 array
        Metres: on the traced mesh, where secondary rays start.
    normal : (n, 3) float32 array
        Unit: shading normal, faces the viewer.
    geometric_normal : (n, 3) float32 array
        Unit: of the traced mesh at ``origin``, faces the viewer.
    view : (n, 3) float32 array
        Unit: towards the camera.
    albedo : (n, 3) float32 array
        In [0, 1]; linear Rec.709.
    roughness, metallic : (n,) float32 array
        In [0, 1].
    flags : (n,) uint8 array
        SECOND, CATCHER, UNLIT; 0 when not given.
    own : (n,) int32 array
        Object whose surfels the point lies on, so that those near it do not shade it; -1: none. For rays that meet
        surfels; empty where they meet meshes alone.
    size : (n,) float32 array
        Metres: mean larger standard deviation of these surfels; as long as ``own``.
    smooth : (n, 3) float32 array
        Unit: shading normal without normal and bump maps, or 0 where it is ``normal``; empty in a scene without such.
    terminator : (n, 4) float32 array
        Where shadow rays of grazing light start, see `scene.terminator.terminator_at`; empty where everything has its
        rays start at ``origin``.
    face, instance : (n,) int32 array
        Face and instance of the mesh, as `interaction.nearest` numbers them; face -1: none. Empty where not known: then
        all surfaces have two lobes of GGX.
    place : (n, 2) float32 array
        Barycentric coordinates of the face's second and third corner.
    """

    pixel: Array
    sample: Array
    weight: Array
    origin: Array
    normal: Array
    geometric_normal: Array
    view: Array
    albedo: Array
    roughness: Array
    metallic: Array
    flags: Array = field(default_factory=lambda: np.zeros(0, np.uint8))
    own: Array = field(default_factory=lambda: np.zeros(0, np.int32))
    size: Array = field(default_factory=lambda: np.zeros(0, np.float32))
    smooth: Array = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    terminator: Array = field(default_factory=lambda: np.zeros((0, 4), np.float32))
    face: Array = field(default_factory=lambda: np.zeros(0, np.int32))
    instance: Array = field(default_factory=lambda: np.zeros(0, np.int32))
    place: Array = field(default_factory=lambda: np.zeros((0, 2), np.float32))

    def __post_init__(self) -> None:
        self.pixel = np.ascontiguousarray(self.pixel, np.int32)
        self.sample = np.ascontiguousarray(self.sample, np.int32)
        n = len(self.pixel)
        for name, width in _WIDTHS.items():
            setattr(self, name, as_float(getattr(self, name), (n, *width), f"shading point {name}"))
        self.flags = np.ascontiguousarray(self.flags if len(self.flags) else np.zeros(n), np.uint8)
        self.own = np.ascontiguousarray(self.own, np.int32)
        self.size = as_float(self.size, (len(self.own),), "shading point size")
        self.smooth = as_float(self.smooth, (len(self.smooth), 3), "shading point smooth")
        self.terminator = as_float(self.terminator, (len(self.terminator), 4), "shading point terminator")
        self.face = np.ascontiguousarray(self.face, np.int32)
        self.instance = np.ascontiguousarray(self.instance, np.int32)
        self.place = np.ascontiguousarray(self.place, np.float32)

    def __len__(self) -> int:
        return len(self.pixel)

    @property
    def arrays(self) -> PointArrays:
        """Arrays for compiled code."""
        names = (name if name != "viewer" else "view" for name in PointArrays._fields)
        return PointArrays(*(plain(getattr(self, name)) for name in names))

    def __getitem__(self, rows: slice | Array) -> ShadingPoints:
        """Return the points that `rows` (slice, mask or indices) selects."""
        values = (getattr(self, f.name) for f in fields(self))
        return ShadingPoints(*(value[rows] if len(value) else value for value in values))


@dataclass(slots=True)
class Radiance:
    """Light that leaves each shading point towards the camera.

    Attributes
    ----------
    components : (n, 4, 3) float32 array
        Linear Rec.709: diffuse direct, diffuse indirect, glossy direct, glossy indirect; surface colour included; their
        sum is the point's radiance. Not yet multiplied by ``ShadingPoints.weight``.
    variance : (n, 2) float32 array
        Estimated variance of the luminance of the diffuse and of the glossy sum.
    unshadowed : (n,) float32 array, optional
        For points flagged CATCHER the luminance that would leave them if rays met shadow catchers alone (masks shifted
        by `ray_masks.WITHOUT`); not read elsewhere.
    moments : (n, 5) float32 array
        Moments for ``variance`` (`integrator.variance`): number of samples, then sum and sum of squares of their
        luminance, diffuse and glossy; may be empty.
    groups : (n, g, 3) float32 array, optional
        The part of the sum of each light group that is asked for, and of all light that belongs to none.
    transmitted : (n, 2, 3) float32 array, optional
        The part of the two glossy components, direct and indirect, that surfaces let pass; None: no surface does.
    """

    components: Array
    variance: Array
    unshadowed: Array | None = None
    moments: Array = field(default_factory=lambda: np.zeros((0, 5), np.float32))
    groups: Array | None = None
    transmitted: Array | None = None

    @classmethod
    def dark(cls, n: int) -> Radiance:
        """No light of `n` points, from no samples."""
        return cls(np.zeros((n, 4, 3), np.float32), np.zeros((n, 2), np.float32), None, np.zeros((n, 5), np.float32))

    @property
    def total(self) -> Array:
        """(n, 3) float32: the sum of the four components."""
        return self.components.sum(axis=1)
