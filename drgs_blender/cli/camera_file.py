"""Cameras as JSON files, for rendering without Blender."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..core.errors import UsageError, first_of
from ..core.frame import Camera
from ..core.json_values import excerpt, is_number, number_array
from .json_file import read_json

_KEYS = {
    *("matrix_world", "width", "height", "fov_x", "fx", "fy", "cx", "cy", "orthographic", "clip_start", "clip_end"),
    *("panorama", "fov", "lens"),
}
KINDS: tuple[Literal["equirectangular", "fisheye", "equisolid"], ...] = ("equirectangular", "fisheye", "equisolid")
#: Full angle of a fisheye, degrees.
_FOV = (1e-3, 360.0)
LARGEST_SIDE = 65536
#: Bytes; a camera is a few hundred.
LARGEST_FILE = 1 << 20
#: Horizontal field of view, degrees.
_FOV_X = (1e-3, 179.999)
#: Focal length, pixels (pixels per metre when orthographic).
_FOCAL = (1e-6, 1e9)
#: Largest magnitude of elements of the matrix, and of the principal point in pixels.
_FAR = 1e9
#: Clipping distances, metres; files of other programs have huge ones for "none".
_CLIP = (1e-9, 1e30)


def read_camera(path: str | Path) -> Camera:
    """Read a camera.

    Parameters
    ----------
    path : str or Path
        A JSON object with the keys

        - ``matrix_world``: 4 rows of 4 numbers, camera to world, rigid, metres: the world is Z up; the camera looks
          along its own -Z, its own Y is up
        - ``width``, ``height``: pixels
        - ``fov_x``: horizontal field of view in degrees, **or** ``fx``, ``fy`` in pixels (pixels per metre when
          orthographic) and optionally ``cx``, ``cy``, the principal point, by default the centre
        - optionally ``orthographic`` (true or false), ``clip_start``, ``clip_end`` in metres
        - optionally ``panorama``: "equirectangular", "fisheye" or "equisolid" (`core.frame.Camera`), then ``fx`` and
          ``fy`` are pixels per radian, of "equisolid" per focal length, by default what has the picture show all
          directions, or the fisheye's ``fov`` in degrees (default 180); ``lens``: the 5 coefficients of a "fisheye"

    Raises
    ------
    UsageError
        Naming the file and the key.

    Examples
    --------
    A field of view of 90 degrees is as wide as twice the focal length:

    >>> matrix = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]
    >>> import json
    >>> text = json.dumps({"matrix_world": matrix, "width": 64, "height": 48, "fov_x": 90})
    >>> _ = Path("camera.json").write_text(text)
    >>> camera = read_camera("camera.json")
    >>> round(camera.fx, 6), round(camera.fy, 6), camera.cx, camera.cy
    (32.0, 32.0, 32.0, 24.0)
    """
    subject = f"camera {path}"
    data = read_json(Path(path), subject, LARGEST_FILE, "a camera")
    if not isinstance(data, dict):
        raise UsageError(subject, "is not a JSON object", "Choose a JSON file of a camera")
    if unknown := sorted(set(data) - _KEYS):
        raise UsageError(subject, f"has unknown keys {first_of(unknown)}", f"The keys are {', '.join(sorted(_KEYS))}")
    return _Reader(subject, data).camera()


class _Reader:
    """Takes typed values out of the file's object, with messages that name the key."""

    def __init__(self, subject: str, data: dict[str, Any]) -> None:
        self.subject, self.data = subject, data

    def fail(self, key: str, problem: str) -> UsageError:
        return UsageError(self.subject, f"{key} {problem}", "See `drgs relight --help`")

    def number(self, key: str, low: float, high: float, default: float | None = None) -> float:
        value = self.data.get(key, default)
        if value is None:
            raise self.fail(key, "is missing")
        if not is_number(value, -math.inf, math.inf):
            raise self.fail(key, f"is {excerpt(value, 40)}, not a number")
        if not is_number(value, low, high):
            raise self.fail(key, f"is {excerpt(value, 40)}; it must be from {low:.12g} to {high:.12g}")
        return float(value)

    def side(self, key: str) -> int:
        value = self.number(key, 1, LARGEST_SIDE)
        if value != int(value):
            raise self.fail(key, f"is {excerpt(self.data[key], 40)}, not a whole number of pixels")
        return int(value)

    def matrix(self, key: str) -> np.ndarray:
        if self.data.get(key) is None:
            raise self.fail(key, "is missing")
        matrix = number_array(self.data[key], (4, 4), _FAR)
        if matrix is None:
            raise self.fail(key, f"is not 4 rows of 4 numbers from {-_FAR:g} to {_FAR:g}")
        rotation = matrix[:3, :3]
        if not np.allclose(matrix[3], (0, 0, 0, 1)):
            raise self.fail(key, "does not end with the row 0 0 0 1 (is it transposed?)")
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
            raise self.fail(key, "is not rigid (it scales, shears or mirrors)")
        return matrix

    def camera(self) -> Camera:
        matrix, width, height = self.matrix("matrix_world"), self.side("width"), self.side("height")
        orthographic = self.data.get("orthographic", False)
        if not isinstance(orthographic, bool):
            raise self.fail("orthographic", "is not true or false")
        panorama, lens = self.panorama(), self.data.get("lens")
        fov = math.radians(self.number("fov", *_FOV, 360.0 if panorama == "equirectangular" else 180.0))
        if orthographic and panorama:
            raise self.fail("orthographic", "and panorama exclude each other")
        if not panorama and (clash := sorted({"fov", "lens"} & set(self.data))):
            raise self.fail(clash[0], "is of panoramas; fov_x is the field of view of a flat picture")
        if "fov_x" in self.data:
            if panorama:
                raise self.fail("fov_x", "is of flat pictures; give fov, or fx and fy")
            if clash := sorted({"fx", "fy"} & set(self.data)):
                raise self.fail("fov_x", f"and {clash[0]} exclude each other")
            if orthographic:
                raise self.fail("fov_x", "means nothing to an orthographic camera; give fx and fy in pixels per metre")
            fx = fy = 0.5 * width / math.tan(math.radians(self.number("fov_x", *_FOV_X)) / 2)
        elif "fx" in self.data:
            fx = self.number("fx", *_FOCAL)
            fy = self.number("fy", *_FOCAL, fx)
        elif panorama == "equirectangular":
            fx, fy = width / (2 * math.pi), height / math.pi
        elif panorama:
            across = fov if panorama == "fisheye" else 4 * math.sin(fov / 4)
            fx, fy = width / across, height / across
        else:
            raise self.fail("fov_x", "is missing, and so is fx")
        clip_start, clip_end = self.number("clip_start", *_CLIP, 1e-3), self.number("clip_end", *_CLIP, 1e6)
        if clip_end <= clip_start:
            raise self.fail("clip_end", f"is {clip_end:g}, not beyond clip_start, {clip_start:g}")
        camera = Camera(
            matrix_world=matrix,
            width=width,
            height=height,
            fx=fx,
            fy=fy,
            cx=self.number("cx", -_FAR, _FAR, width / 2),
            cy=self.number("cy", -_FAR, _FAR, height / 2),
            orthographic=orthographic,
            clip_start=clip_start,
            clip_end=clip_end,
        )
        if panorama:
            camera.panorama, camera.fov = panorama, fov
        if lens is not None:
            numbers = number_array(lens, (5,), _FAR)
            if panorama != "fisheye" or numbers is None:
                raise self.fail("lens", 'is not the 5 coefficients of the panorama "fisheye"')
            k0, k1, k2, k3, k4 = (float(x) for x in numbers)
            camera.lens = (k0, k1, k2, k3, k4)
        return camera

    def panorama(self) -> Literal["", "equirectangular", "fisheye", "equisolid"]:
        name = self.data.get("panorama", "")
        if name == "":
            return ""
        for known in KINDS:
            if name == known:
                return known
        raise self.fail("panorama", f"is {excerpt(name, 40)}; it must be one of {', '.join(KINDS)}")
