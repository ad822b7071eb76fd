"""Report of a capture: a picture of the cameras around the sparse points, and their data for other programs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as Pillow
from PIL import ImageDraw

from ..core.arrays import Array
from ..core.asset.archive import replace_file
from ..core.errors import printable
from ..formats.images import write_image
from .registration import Registration

#: Pixels of one of the two drawings; margin.
_SIDE, _MARGIN = 800, 40
_CAMERA, _GROUND, _TEXT = (214, 84, 24), (150, 150, 150), (60, 60, 60)
#: Views: title, rows (right, up) of the drawing in the world.
_VIEWS = (
    ("from above", np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])),
    ("from the front", np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])),
)


def draw_cameras(path: Path, found: Registration, said: list[str]) -> None:
    """Write a PNG of cameras and sparse points, from above and from the front.

    Parameters
    ----------
    path : Path
    found : Registration
        Z up.
    said : list of str
        Lines below the drawings.
    """
    page = Pillow.new("RGB", (2 * _SIDE, _SIDE + 18 * (len(said) + 1)), "white")
    draw = ImageDraw.Draw(page)
    matrices = np.stack(list(found.matrices.values()))
    centres = matrices[:, :3, 3]
    middle = (centres.min(axis=0) + centres.max(axis=0)) / 2
    extent = 1.25 * max(float(np.ptp(centres, axis=0).max()), 1e-6)
    order = np.random.default_rng(0).permutation(len(found.points))[:60_000]
    for index, (title, axes) in enumerate(_VIEWS):
        centre = axes @ middle if index == 0 else np.array([middle[0], 0.3 * extent])
        scale = (_SIDE - 2 * _MARGIN) / extent

        def place(points: Array, axes: Array = axes, centre: Array = centre, left: int = index * _SIDE,
                  scale: float = scale) -> Array:  # fmt: skip
            flat = (points @ axes.T - centre) * scale
            return np.stack([left + _SIDE / 2 + flat[:, 0], _SIDE / 2 - flat[:, 1]], axis=1)

        if index == 1:
            y = place(np.zeros((1, 3)))[0, 1]
            draw.line([(_SIDE + _MARGIN, y), (2 * _SIDE - _MARGIN, y)], fill=_GROUND)
        for (x, y), colour in zip(place(found.points[order]), found.colours[order], strict=True):
            if index * _SIDE <= x < (index + 1) * _SIDE and 0 <= y < _SIDE:
                draw.point((x, y), fill=tuple(int(c) for c in colour))
        for matrix, lens in zip(matrices, found.lenses.values(), strict=True):
            _frustum(draw, matrix, lens.width / lens.fx, lens.height / lens.fy, 0.05 * extent, place)
        draw.text((index * _SIDE + _MARGIN, 12), title, fill=_TEXT)
    for line, text in enumerate(said):
        draw.text((_MARGIN, _SIDE + 18 * line), printable(text), fill=_TEXT)
    write_image(path, page)


def _frustum(draw: ImageDraw.ImageDraw, matrix: Array, width: float, height: float, size: float, place: Any) -> None:
    """The pyramid of one camera; its upper edge is drawn twice as wide."""
    x, y = width / 2 * size, height / 2 * size
    corners = np.array([[-x, y, -size], [x, y, -size], [x, -y, -size], [-x, -y, -size], [0, 0, 0]])
    at = [tuple(point) for point in place(corners @ matrix[:3, :3].T + matrix[:3, 3])]
    for i in range(4):
        draw.line([at[i], at[(i + 1) % 4]], fill=_CAMERA, width=2 if i == 0 else 1)
        draw.line([at[i], at[4]], fill=_CAMERA)


def write_report(path: Path, found: Registration, more: dict[str, Any]) -> None:
    """Write cameras and figures as JSON: matrices are camera to world, Blender's axes, metres; lenses in pixels."""
    cameras = [
        {
            "file": name,
            "matrix": np.round(matrix, 9).tolist(),
            "width": found.lenses[name].width,
            "height": found.lenses[name].height,
            "focal": found.lenses[name].fx,
            "centre": [found.lenses[name].cx, found.lenses[name].cy],
            "error": round(found.errors[name], 3),
            "points": found.observations[name],
        }
        for name, matrix in found.matrices.items()
    ]
    text = json.dumps({"format": "drgs capture", "version": 1, **more, "cameras": cameras}, indent=1)
    replace_file(path, [text.encode()])
