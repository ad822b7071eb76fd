"""Lens models and their removal: every photograph becomes a pinhole's.

Coordinates on the image plane are (x, y) = (X / Z, Y / Z) with x to the right, y down and z forward (OpenCV's and
COLMAP's camera); a model says where on that plane a distorting lens puts them. The formulas are COLMAP's
(sensor/models.h) and OpenCV's, whose models are the same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from ...core.errors import AssetError

Array = np.ndarray
#: (x, y, coefficients) -> (x, y) as distorted
Distort = Callable[[Array, Array, Array], tuple[Array, Array]]


@dataclass(frozen=True, slots=True)
class Lens:
    """Lens model of a camera: intrinsics and distortion.

    Attributes
    ----------
    width, height : int
        Pixels of the picture that was calibrated.
    fx, fy, cx, cy : float
        Pixels; pixel centres are at +0.5.
    model : str
        A key of `MODELS`.
    coefficients : tuple of float
        Of the model, in COLMAP's order, without focal lengths and principal point.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str = "PINHOLE"
    coefficients: tuple[float, ...] = ()

    @property
    def distorts(self) -> bool:
        """Whether the model moves anything."""
        return self.model not in UNDISTORTED and (self.model in ALWAYS or any(self.coefficients))

    def scaled(self, width: int, height: int) -> Lens:
        """The same lens in front of a picture of another size."""
        x, y = width / self.width, height / self.height
        return Lens(
            width, height, self.fx * x, self.fy * y, self.cx * x, self.cy * y, self.model, self.coefficients
        )  # fmt: skip


def _tangential(x: Array, y: Array, p1: float, p2: float) -> tuple[Array, Array]:
    squared = x * x + y * y
    return 2 * p1 * x * y + p2 * (squared + 2 * x * x), 2 * p2 * x * y + p1 * (squared + 2 * y * y)


def _radial(x: Array, y: Array, k: Array) -> tuple[Array, Array]:
    squared = x * x + y * y
    factor = 1 + squared * (k[0] + squared * (k[1] if len(k) > 1 else 0.0))
    return x * factor, y * factor


def _opencv(x: Array, y: Array, k: Array) -> tuple[Array, Array]:
    across, down = _tangential(x, y, k[2], k[3])
    x, y = _radial(x, y, k[:2])
    return x + across, y + down


def _full_opencv(x: Array, y: Array, k: Array) -> tuple[Array, Array]:
    k1, k2, p1, p2, k3, k4, k5, k6 = k
    r = x * x + y * y
    factor = (1 + r * (k1 + r * (k2 + r * k3))) / (1 + r * (k4 + r * (k5 + r * k6)))
    across, down = _tangential(x, y, p1, p2)
    return x * factor + across, y * factor + down


def _equidistant(x: Array, y: Array) -> tuple[Array, Array]:
    """The angle from the axis as distance from the centre."""
    radius = np.hypot(x, y)
    factor = np.where(radius > 1e-9, np.arctan(radius) / np.maximum(radius, 1e-9), 1.0)
    return x * factor, y * factor


def _fisheye(x: Array, y: Array, k: Array) -> tuple[Array, Array]:
    x, y = _equidistant(x, y)
    squared = x * x + y * y
    factor = 1 + np.polynomial.polynomial.polyval(squared, [0.0, *k])
    return x * factor, y * factor


def _fov(x: Array, y: Array, k: Array) -> tuple[Array, Array]:
    omega = k[0]
    radius = np.hypot(x, y)
    if abs(omega) < 1e-6:
        return x, y
    slope = 2 * np.tan(omega / 2)
    factor = np.where(radius > 1e-9, np.arctan(radius * slope) / np.maximum(radius * omega, 1e-12), slope / omega)
    return x * factor, y * factor


def _thin_prism_fisheye(x: Array, y: Array, k: Array) -> tuple[Array, Array]:
    k1, k2, p1, p2, k3, k4, s1, s2 = k
    x, y = _equidistant(x, y)
    r = x * x + y * y
    factor = 1 + r * (k1 + r * (k2 + r * (k3 + r * k4)))
    across, down = _tangential(x, y, p1, p2)
    return x * factor + across + s1 * r, y * factor + down + s2 * r


def _rad_tan_thin_prism_fisheye(x: Array, y: Array, k: Array) -> tuple[Array, Array]:
    x, y = _fisheye(x, y, k[:6])
    p0, p1, s0, s1, s2, s3 = k[6:]
    r = x * x + y * y
    across, down = (r + 2 * x * x) * p0 + 2 * x * y * p1, (r + 2 * y * y) * p1 + 2 * x * y * p0
    return x + across + r * (s0 + s1 * r), y + down + r * (s2 + s3 * r)


def _none(x: Array, y: Array, k: Array) -> tuple[Array, Array]:
    return x, y


#: Model -> (focal lengths it has, coefficients it has, its function); names and order of COLMAP.
MODELS: dict[str, tuple[int, int, Distort]] = {
    "SIMPLE_PINHOLE": (1, 0, _none),
    "PINHOLE": (2, 0, _none),
    "SIMPLE_RADIAL": (1, 1, _radial),
    "RADIAL": (1, 2, _radial),
    "OPENCV": (2, 4, _opencv),
    "OPENCV_FISHEYE": (2, 4, _fisheye),
    "FULL_OPENCV": (2, 8, _full_opencv),
    "FOV": (2, 1, _fov),
    "SIMPLE_RADIAL_FISHEYE": (1, 1, _fisheye),
    "RADIAL_FISHEYE": (1, 2, _fisheye),
    "THIN_PRISM_FISHEYE": (2, 8, _thin_prism_fisheye),
    "RAD_TAN_THIN_PRISM_FISHEYE": (2, 12, _rad_tan_thin_prism_fisheye),
}
UNDISTORTED = ("SIMPLE_PINHOLE", "PINHOLE")
#: Fisheyes: far from a pinhole even where all coefficients are 0.
ALWAYS = tuple(name for name in MODELS if "FISHEYE" in name)
#: How far the pinhole may zoom in to leave out what the lens did not see.
_MOST_ZOOM = 8.0


def lens_of(model: str, width: int, height: int, parameters: Array, subject: str) -> Lens:
    """The lens of COLMAP's list of parameters: focal lengths, principal point, coefficients.

    Raises
    ------
    AssetError
        The model is unknown, or has another number of parameters.
    """
    if model not in MODELS:
        raise AssetError(subject, f"has the camera model {model}", f"Known are {', '.join(MODELS)}")
    focal, count, _ = MODELS[model]
    if len(parameters) != focal + 2 + count:
        raise AssetError(subject, f"has {len(parameters)} parameters of a {model} camera, not {focal + 2 + count}")
    values = np.asarray(parameters, np.float64)
    if not np.isfinite(values).all() or min(values[:focal]) <= 0 or min(width, height) <= 0:
        raise AssetError(subject, f"has an impossible {model} camera", "Calibrate the cameras again")
    fx, fy = values[0], values[focal - 1]
    cx, cy = values[focal : focal + 2]
    return Lens(width, height, float(fx), float(fy), float(cx), float(cy), model, tuple(values[focal + 2 :].tolist()))


def distort(lens: Lens, x: Array, y: Array) -> tuple[Array, Array]:
    """Pixel positions (px, py) at which `lens` shows the directions (x, y, 1); float64."""
    across, down = MODELS[lens.model][2](x, y, np.asarray(lens.coefficients, np.float64))
    return across * lens.fx + lens.cx, down * lens.fy + lens.cy


def undistorted(lens: Lens) -> tuple[Lens, Array]:
    """The pinhole that stands for a lens, and where its pixels are found.

    The pinhole has the size and principal point of the photograph, and the widest view that the photograph fills.

    Returns
    -------
    pinhole : Lens
    positions : array
        (2, height, width) float64, (row, column) in pixels of the photograph, pixel centres at integers.
    """
    zoom = _zoom(lens)
    pinhole = Lens(lens.width, lens.height, lens.fx * zoom, lens.fy * zoom, lens.cx, lens.cy)
    py, px = np.mgrid[: lens.height, : lens.width] + 0.5
    column, row = distort(lens, (px - pinhole.cx) / pinhole.fx, (py - pinhole.cy) / pinhole.fy)
    return pinhole, np.stack([row, column]) - 0.5


def _zoom(lens: Lens) -> float:
    """The least factor on the focal length with which the border of the pinhole's picture lies in the photograph."""
    along = np.linspace(0.0, 1.0, 33)
    low, high = np.zeros(33), np.ones(33)
    px = np.concatenate([along, along, low, high]) * lens.width
    py = np.concatenate([low, high, along, along]) * lens.height

    def fits(zoom: float) -> bool:
        # The whole way out from the centre must lie inside: strong polynomials fold back further out.
        for part in (0.25, 0.5, 0.75, 1.0):
            x, y = (px - lens.cx) / (lens.fx * zoom) * part, (py - lens.cy) / (lens.fy * zoom) * part
            column, row = distort(lens, x, y)
            slack = 0.5
            if min(column.min(), row.min()) < -slack:
                return False
            if column.max() > lens.width + slack or row.max() > lens.height + slack:
                return False
        return True

    low_zoom, high_zoom = 1 / _MOST_ZOOM, _MOST_ZOOM
    if not fits(high_zoom):
        return 1.0
    for _ in range(30):
        middle = np.sqrt(low_zoom * high_zoom)
        low_zoom, high_zoom = (low_zoom, middle) if fits(middle) else (middle, high_zoom)
    return float(high_zoom)


def resample(picture: Array, positions: Array) -> Array:
    """`picture` (h, w, c) at fractional (row, column) `positions` (2, H, W), bilinear, edges repeated; float32."""
    channels = [
        map_coordinates(picture[..., c], positions, order=1, mode="nearest", output=np.float32)
        for c in range(picture.shape[2])
    ]
    return np.stack(channels, axis=-1)
