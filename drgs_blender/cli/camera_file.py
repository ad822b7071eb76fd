"""Cameras as JSON files, for rendering without Blender."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import UsageError
from ..core.frame import Camera

_KEYS = {"matrix_world", "width", "height", "fov_x", "fx", "fy", "cx", "cy", "orthographic", "clip_start", "clip_end"}
LARGEST_SIDE = 65536
#: Bytes; a camera is a few hundred.
LARGEST_FILE = 1 << 20


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

    Raises
    ------
    UsageError
        Naming the file and the key.

    Examples
    --------
    A field of view of 90 degrees is as wide as twice the focal length:

    >>> matrix = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]
    >>> text = json.dumps({"matrix_world": matrix, "width": 64, "height": 48, "fov_x": 90})
    >>> _ = Path("camera.json").write_text(text)
    >>> camera = read_camera("camera.json")
    >>> round(camera.fx, 6), round(camera.fy, 6), camera.cx, camera.cy
    (32.0, 32.0, 32.0, 24.0)
    """
    subject = f"camera {path}"
    path = Path(path)
    try:
        size = path.stat().st_size
        if not path.is_file() or size > LARGEST_FILE:
            problem = f"has {size} bytes" if path.is_file() else "is not a regular file"
            raise UsageError(subject, problem, "Choose a JSON file of a camera")
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(subject, f"cannot be read ({error.strerror})", "Check the path") from error
    except (ValueError, RecursionError) as error:
        raise UsageError(subject, f"is not JSON ({error})", "Choose a JSON file of a camera") from error
    if not isinstance(data, dict):
        raise UsageError(subject, "is not a JSON object", "Choose a JSON file of a camera")
    if unknown := sorted(set(data) - _KEYS):
        raise UsageError(subject, f"has unknown keys {', '.join(unknown)}", f"The keys are {', '.join(sorted(_KEYS))}")
    return _Reader(subject, data).camera()


class _Reader:
    """Takes typed values out of the file's object, with messages that name the key."""

    def __init__(self, subject: str, data: dict[str, Any]) -> None:
        self.subject, self.data = subject, data

    def fail(self, key: str, problem: str) -> UsageError:
        return UsageError(self.subject, f"{key} {problem}", "See `drgs relight --help`")

    def number(self, key: str, default: float | None = None, low: float = -math.inf, high: float = math.inf) -> float:
        value = self.data.get(key, default)
        if value is None:
            raise self.fail(key, "is missing")
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise self.fail(key, f"is {value!r}, not a finite number")
        if not low < value < high:
            raise self.fail(key, f"is {value:g}, outside {low:g} to {high:g}")
        return float(value)

    def side(self, key: str) -> int:
        value = self.number(key, low=0, high=LARGEST_SIDE + 1)
        if value != int(value):
            raise self.fail(key, f"is {value:g}, not a whole number of pixels")
        return int(value)

    def matrix(self, key: str) -> np.ndarray:
        rows = self.data.get(key)
        if rows is None:
            raise self.fail(key, "is missing")
        try:
            matrix = np.array(rows, dtype=np.float64)
        except (TypeError, ValueError):
            raise self.fail(key, "is not 4 rows of 4 numbers") from None
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise self.fail(key, "is not 4 rows of 4 finite numbers")
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
        if "fov_x" in self.data:
            if clash := sorted({"fx", "fy"} & set(self.data)):
                raise self.fail("fov_x", f"and {clash[0]} exclude each other")
            if orthographic:
                raise self.fail("fov_x", "means nothing to an orthographic camera; give fx and fy in pixels per metre")
            fx = fy = 0.5 * width / math.tan(math.radians(self.number("fov_x", low=0, high=180)) / 2)
        elif "fx" in self.data:
            fx = self.number("fx", low=0)
            fy = self.number("fy", fx, low=0)
        else:
            raise self.fail("fov_x", "is missing, and so is fx")
        clip_start = self.number("clip_start", 1e-3, low=0)
        return Camera(
            matrix_world=matrix,
            width=width,
            height=height,
            fx=fx,
            fy=fy,
            cx=self.number("cx", width / 2),
            cy=self.number("cy", height / 2),
            orthographic=orthographic,
            clip_start=clip_start,
            clip_end=self.number("clip_end", 1e6, low=clip_start),
        )
