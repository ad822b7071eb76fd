"""3D Gaussian splats as other programs know them: the record of a splat, and the way from surfels to it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..core.asset import Surfels
from ..core.color import linear_to_srgb, srgb_to_linear
from ..core.errors import AssetError
from ..geometry.normals import rotation_matrices, unit
from .axes import FARTHEST, from_z_up, multiply_quaternions, scaled_lengths, vectors_from_z_up
from .gaussian_ply import METALLIC, ROUGHNESS, SH_C0
from .harmonics import rotate_harmonics, whole_bands

Array = np.ndarray

#: Thickness of an exported surfel as part of its shorter axis: flat to every reader, and no singular matrix.
THICKNESS = 0.01
#: Shortest axis written, metres: the logarithm of 0 is not finite.
SHORTEST = 1e-9
#: Sizes whose logarithm comes back as a number of 32 bits; shorter quaternions are no rotation.
THINNEST, WIDEST = np.float32(1e-37), np.float32(1e37)
SHORT = 1e-15


@dataclass(slots=True)
class SplatMaterials:
    """What light meets on splats; formats keep it as `docs/relightable-splats.md` says.

    Attributes
    ----------
    albedo : (n, 3) float32 array
        In [0, 1], linear Rec.709.
    roughness, metallic : (n,) float32 array
        In [0, 1].
    """

    albedo: Array
    roughness: Array
    metallic: Array

    def arrays(self) -> tuple[Array, Array, Array]:
        """All of it."""
        return self.albedo, self.roughness, self.metallic


@dataclass(slots=True)
class Splats:
    """3D Gaussians, activated.

    Attributes
    ----------
    centre : (n, 3) float32 array
        Metres.
    scale : (n, 3) float32 array
        Metres, linear: standard deviations along the rotated X, Y and Z axes.
    rotation : (n, 4) float32 array
        Unit quaternion wxyz.
    opacity : (n,) float32 array
        In [0, 1].
    sh : (n, k, 3) float32 array
        With k = 1, 4, 9 or 16: outgoing colour, display-referred, in the basis and order of 3DGS.
    materials : SplatMaterials, optional
    """

    centre: Array
    scale: Array
    rotation: Array
    opacity: Array
    sh: Array
    materials: SplatMaterials | None = None

    def __len__(self) -> int:
        return len(self.centre)


def splats_of(surfels: Surfels, colour: Array | None = None) -> Splats:
    """Surfels as splats with a third axis along the normal: as thick as the splats they were read from, else thin.

    Parameters
    ----------
    surfels : Surfels
        Any space.
    colour : (n, 3) array, optional
        Linear Rec.709 colour to show from all sides; None is the captured colour (``surfels.sh``) where there is one,
        else the albedo. Linear colour is encoded as sRGB, which is what viewers of splats expect.
    """
    if colour is None and surfels.sh is not None:
        sh = whole_bands(surfels.sh)
    else:
        shown = linear_to_srgb(np.clip(surfels.albedo if colour is None else colour, 0.0, 1.0))
        sh = ((shown - 0.5) / SH_C0).astype(np.float32)[:, None]
    scale = np.empty((len(surfels), 3), np.float32)
    scale[:, :2] = np.maximum(surfels.scale, SHORTEST)
    thickness = surfels.extras.get("thickness")
    if thickness is None:
        scale[:, 2] = scale[:, :2].min(axis=1) * THICKNESS
    else:
        scale[:, 2] = np.maximum(thickness, SHORTEST)
    materials = SplatMaterials(surfels.albedo, surfels.roughness, surfels.metallic)
    return Splats(surfels.centre, scale, surfels.rotation, surfels.opacity, sh, materials)


def normals(rotation: Array) -> Array:
    """(n, 3) unit float32 normals of surfels: the third axes of rotations wxyz (n, 4)."""
    return unit(rotation_matrices(rotation)[..., 2]).astype(np.float32)


def scaled(splats: Splats, factor: float) -> Splats:
    """Splats with all lengths times `factor`. Raises UsageError, see `axes.scaled_lengths`."""
    if factor == 1:
        return splats
    centre, scale = scaled_lengths(splats.centre, splats.scale, factor)
    return replace(splats, centre=centre, scale=scale)


def writable(splats: Splats, subject: str) -> Splats:
    """Splats that every reader takes: opacities and sizes within their limits, rotations of unit length.

    Raises
    ------
    AssetError
        Some have numbers that readers drop: NaN, infinite, too far away, no size, no rotation. Names `subject`.
    """
    with np.errstate(over="ignore"):
        length = np.linalg.norm(splats.rotation, axis=1)
    numbers = [splats.centre, splats.scale, splats.rotation, splats.opacity, splats.sh]
    if splats.materials is not None:
        numbers += splats.materials.arrays()
    good = all(np.isfinite(f(array, initial=0)) for array in numbers for f in (np.min, np.max))  # NaN shows in both
    if len(splats) and not (
        good
        and np.abs(splats.centre).max() <= FARTHEST
        and splats.scale.min() > 0
        and SHORT < length.min() <= length.max() < np.inf
    ):
        problem = f"would hold splats whose numbers are NaN, infinite, not above 0 or beyond {FARTHEST:g} m"
        raise AssetError(subject, problem, "Choose another input, pose or scale")
    if np.abs(length - 1).max(initial=0) > 1e-3:
        splats = replace(splats, rotation=(splats.rotation / length[:, None]).astype(np.float32))
    if splats.opacity.min(initial=0) < 0 or splats.opacity.max(initial=0) > 1:
        splats = replace(splats, opacity=splats.opacity.clip(0, 1))
    if splats.scale.min(initial=1) < THINNEST or splats.scale.max(initial=1) > WIDEST:
        splats = replace(splats, scale=splats.scale.clip(THINNEST, WIDEST))
    if splats.materials is not None:
        inside = (array.clip(0, 1).astype(np.float32, copy=False) for array in splats.materials.arrays())
        splats = replace(splats, materials=SplatMaterials(*inside))
    return splats


def join_splats(parts: list[Splats]) -> Splats:
    """All splats as one, harmonics filled up with zeros, materials as `gaussian_ply` assumes them."""
    if len(parts) == 1:
        return parts[0]
    sh = np.zeros((sum(map(len, parts)), max(splats.sh.shape[1] for splats in parts), 3), np.float32)
    first = 0
    for splats in parts:
        sh[first : first + len(splats), : splats.sh.shape[1]] = splats.sh
        first += len(splats)

    def joined(name: str) -> Array:
        return np.concatenate([getattr(splats, name) for splats in parts])

    materials = None
    if any(splats.materials is not None for splats in parts):
        columns = zip(*((splats.materials or _assumed(splats)).arrays() for splats in parts), strict=True)
        materials = SplatMaterials(*(np.concatenate(column) for column in columns))
    return Splats(joined("centre"), joined("scale"), joined("rotation"), joined("opacity"), sh, materials)


def _assumed(splats: Splats) -> SplatMaterials:
    """Materials of splats that have none: the albedo is their mean colour."""
    albedo = srgb_to_linear(np.clip(0.5 + SH_C0 * splats.sh[:, 0], 0.0, 1.0)).astype(np.float32)
    numbers = (np.full(len(splats), value, np.float32) for value in (ROUGHNESS, METALLIC))
    return SplatMaterials(albedo, *numbers)


def splats_from_z_up(splats: Splats, up: str) -> Splats:
    """Turn splats from Z up to the up axis `up` (a key of `axes.UP_AXES`), their colours with them."""
    if up == "z":
        return splats
    turn, quaternion = from_z_up(up)
    return replace(
        splats,
        centre=vectors_from_z_up(splats.centre, up),
        rotation=multiply_quaternions(quaternion, splats.rotation).astype(np.float32),
        sh=rotate_harmonics(splats.sh, turn),
    )
