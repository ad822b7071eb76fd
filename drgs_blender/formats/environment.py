"""Environment pictures of every kind to linear lat-long radiance in Blender's mapping."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..core.asset import Environment
from ..core.color import srgb_to_linear, to_unit
from .exr import read_exr
from .files import EnvironmentFile
from .hdr import read_hdr
from .images import load_image
from .latlong import directions, openexr_cube, sample_cube

Array = np.ndarray

#: Negative values down to this part of the mean are rounding of programs that write pictures: too little to be told.
_ROUNDING = 1e-3
#: CIE XYZ (white point E, as Radiance means it) to Rec.709 with D65 scaled to equal energy.
_XYZ_TO_REC709 = np.array([[2.6899, -1.2758, -0.4138], [-1.0221, 1.9783, 0.0438], [0.0612, -0.2245, 1.1633]])


def read_hdr_environment(path: Path) -> EnvironmentFile:
    """A Radiance picture. Exposure and XYZ files are converted; values are never negative."""
    radiance, variables = read_hdr(path)
    notes = []
    if "xyze" in variables.get("FORMAT", ""):
        radiance = np.maximum(radiance @ _XYZ_TO_REC709.T, 0.0)
        notes.append("converted from CIE XYZ")
    try:
        exposure = float(variables.get("EXPOSURE", "1"))
    except ValueError:
        exposure = 1.0
    if exposure > 0 and exposure != 1.0 and np.isfinite(exposure):
        radiance = radiance / exposure
        notes.append(f"divided by the exposure {exposure:g} of the file")
    return _finish(radiance, "Radiance HDR", notes)


def read_exr_environment(path: Path) -> EnvironmentFile:
    """An OpenEXR picture: lat-long, or a cube map in OpenEXR's arrangement, which is resampled."""
    radiance, cube, notes = read_exr(path)
    if cube and radiance.shape[0] == 6 * radiance.shape[1]:
        size = radiance.shape[1]
        # OpenEXR's lat-long has +Z in the middle, +X left of it and +Y up: Blender's (x, y, z) is its (z, x, y).
        look = directions(2 * size)[..., [1, 2, 0]]
        radiance = sample_cube(radiance.reshape(6, size, size, 3), look, openexr_cube(size))
        notes.append("cube map resampled to lat-long")
    return _finish(radiance, "OpenEXR", notes)


def read_picture_environment(path: Path) -> EnvironmentFile:
    """A PNG, JPEG or other display-referred picture: decoded from sRGB. TIFF with floats is linear."""
    pixels = load_image(path)[..., :3]
    if pixels.dtype.kind == "f":
        return _finish(pixels, "TIFF", [])
    note = "display-referred picture decoded from sRGB: nothing in it is brighter than 1"
    return _finish(srgb_to_linear(to_unit(pixels)), "picture", [note])


def _finish(radiance: Array, layout: str, notes: list[str]) -> EnvironmentFile:
    """Check what every environment must be: not negative, and about twice as wide as high."""
    if negative := int(np.count_nonzero(radiance < 0)):
        lowest, radiance = radiance.min(), np.maximum(radiance, 0.0)
        if -lowest > _ROUNDING * radiance.mean(dtype=np.float64):
            notes.append(f"{negative} negative values set to 0")
    if not radiance.any():
        notes.append("completely black: it gives no light")
    height, width = radiance.shape[:2]
    if abs(width - 2 * height) > 0.02 * width:
        notes.append(f"{width} x {height} is not 2:1; it is taken as lat-long all the same")
    return EnvironmentFile(Environment(radiance), layout, notes)
