"""A sheet of AprilTag markers to stand an object on: its geometry, its detection, its PDF."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ..core.arrays import Array
from ..core.asset.archive import replace_file
from . import libraries

_POINTS_PER_MM = 72 / 25.4


@dataclass(frozen=True, slots=True)
class Paper:
    """A size of paper: millimetres, columns and rows of markers, their side, the number of the first, the free middle.

    ``free`` are half the columns and rows that are left out for the object.
    """

    width: float
    height: float
    columns: int
    rows: int
    marker: float
    first: int
    free: tuple[float, float]


#: Sheets; each has markers of its own, so a picture says which it shows. Family 36h11 (Olson 2011) has 587.
PAPERS = {
    "a4": Paper(210.0, 297.0, 5, 7, 30.0, 0, (1.5, 1.5)),
    "letter": Paper(215.9, 279.4, 5, 6, 30.0, 100, (1.5, 1.0)),
    "a3": Paper(297.0, 420.0, 7, 10, 30.0, 200, (2.5, 3.0)),
}
#: Cells of a marker's side without its white rim, and the gap between markers in parts of their side.
_CELLS, _GAP = 8, 0.25


class MarkerSheet:
    """The markers of one paper as printed, possibly larger or smaller than meant.

    The sheet's frame: origin at its centre, X right, Y up the page, Z out of it; metres.

    Parameters
    ----------
    paper : str
        A key of `PAPERS`.
    marker : float, optional
        Side of the black squares as measured, millimetres; None: as they are meant to be printed.
    """

    def __init__(self, paper: str, marker: float | None = None) -> None:
        self.name, self.paper = paper, PAPERS[paper]
        self.scale = (marker or self.paper.marker) / self.paper.marker

    @cached_property
    def corners(self) -> dict[int, Array]:
        """Number of a marker -> (4, 3) float64 corners, metres: as OpenCV lists them, clockwise from the upper left.

        The middle is free for the object.
        """
        paper, step = self.paper, self.paper.marker * (1 + _GAP)
        found: dict[int, Array] = {}
        number = paper.first
        for row in range(paper.rows):
            for column in range(paper.columns):
                x = (column - (paper.columns - 1) / 2) * step
                y = ((paper.rows - 1) / 2 - row) * step
                number += 1
                if abs(x) < paper.free[0] * step and abs(y) < paper.free[1] * step:
                    continue
                half = paper.marker / 2
                square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
                found[number - 1] = (square + np.array([x, y, 0.0])) * self.scale / 1000
        return found

    def squares(self) -> Array:
        """(n, 4) float64 black rectangles: x, y of the lower left corner from the page's, width, height; mm."""
        family = _family()
        cell = self.paper.marker / _CELLS
        boxes = []
        for number, corners in MarkerSheet(self.name).corners.items():
            left, top = corners[0, 0] * 1000 + self.paper.width / 2, corners[0, 1] * 1000 + self.paper.height / 2
            picture = family.generateImageMarker(number, _CELLS, borderBits=1)
            for row, line in enumerate(picture == 0):
                edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(int), [0]])))
                for begin, end in edges.reshape(-1, 2):
                    boxes.append((left + begin * cell, top - (row + 1) * cell, (end - begin) * cell, cell))
        return np.array(boxes)

    def picture(self, pixels_per_mm: float = 8.0) -> Array:
        """(h, w) uint8 of the page, row 0 at the top."""
        height, width = round(self.paper.height * pixels_per_mm), round(self.paper.width * pixels_per_mm)
        page = np.full((height, width), 255, np.uint8)
        for x, y, w, h in self.squares() * pixels_per_mm:
            page[round(height - y - h) : round(height - y), round(x) : round(x + w)] = 0
        return page


def _family() -> Any:
    """OpenCV's dictionary of AprilTag 36h11. Raises DeviceError."""
    aruco = libraries.load("opencv").aruco
    return aruco.getPredefinedDictionary(aruco.DICT_APRILTAG_36h11)


def detect(grey: Array) -> dict[int, Array]:
    """Markers in a picture: number -> (4, 2) float64 corners, pixels, pixel centres at +0.5.

    Parameters
    ----------
    grey : (h, w) uint8 array
    """
    aruco = libraries.load("opencv").aruco
    parameters = aruco.DetectorParameters()
    # Lines through the edges, as AprilTag fits them: half the error of corners alone. Its pixel centres are at +0.5.
    parameters.cornerRefinementMethod = aruco.CORNER_REFINE_APRILTAG
    corners, numbers, _ = aruco.ArucoDetector(_family(), parameters).detectMarkers(grey)
    if numbers is None:
        return {}
    return {int(k): c.reshape(4, 2).astype(np.float64) for k, c in zip(np.ravel(numbers), corners)}


def recognise(numbers: set[int]) -> str | None:
    """The paper whose markers most of `numbers` are, None where there are fewer than two of one."""
    counts = {name: len(numbers & MarkerSheet(name).corners.keys()) for name in PAPERS}
    best = max(counts, key=counts.__getitem__)
    return best if counts[best] >= 2 else None


def write_pdf(path: Path, paper: str) -> None:
    """Write a sheet as PDF 1.4 in its true size, with a ruler and how to use it. Raises WriteError, DeviceError."""
    sheet = MarkerSheet(paper)
    size = sheet.paper
    lines = ["0 g"]
    lines += [f"{' '.join(f'{v * _POINTS_PER_MM:.3f}' for v in box)} re f" for box in sheet.squares()]
    below = size.height / 2 - (size.rows * (1 + _GAP) - _GAP) / 2 * size.marker
    y = max(5.0, below / 2 - 1)
    ruler = (size.width / 2 - 50) * _POINTS_PER_MM, y * _POINTS_PER_MM, 100 * _POINTS_PER_MM
    lines.append(f"0.5 w {ruler[0]:.3f} {ruler[1]:.3f} m {ruler[0] + ruler[2]:.3f} {ruler[1]:.3f} l S")
    for tick in range(11):
        x = ruler[0] + ruler[2] * tick / 10
        lines.append(f"{x:.3f} {ruler[1]:.3f} m {x:.3f} {ruler[1] + (8 if tick % 5 == 0 else 4):.3f} l S")
    text = (
        f"{paper.upper()}  AprilTag 36h11, markers {size.marker:g} mm. Print at 100 %: the line is 100 mm long, else "
        "give drgs capture --marker-length. Object in the middle, sheet flat and unmoved."
    )
    lines.append(f"BT /F 6.5 Tf {12 * _POINTS_PER_MM:.2f} {ruler[1] - 9:.2f} Td ({text}) Tj ET")
    stream = "\n".join(lines).encode("ascii")
    box = f"[0 0 {size.width * _POINTS_PER_MM:.3f} {size.height * _POINTS_PER_MM:.3f}]"
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        b"<< /Type /Page /Parent 2 0 R /MediaBox %s /Contents 4 0 R /Resources << /Font << /F 5 0 R >> >> >>"
        % box.encode(),
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(stream), stream),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    data, offsets = b"%PDF-1.4\n", []
    for number, body in enumerate(objects, 1):
        offsets.append(len(data))
        data += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    table = b"".join(b"%010d 00000 n \n" % offset for offset in offsets)
    end = b"xref\n0 %d\n0000000000 65535 f \n%strailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n"
    replace_file(path, [data, end % (len(objects) + 1, table, len(objects) + 1, len(data))])
