"""Cameras from a marker sheet, without features: lens and poses that fit its corners, in metres."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..core.arrays import Array
from ..reconstruct.readers.layout import OPENCV_TO_BLENDER, invert
from ..reconstruct.readers.lens import Lens
from . import libraries
from .features import Photo
from .left_out import Cause, Reason
from .marker_sheet import MarkerSheet
from .registration import Registration

logger = logging.getLogger(__name__)

#: Markers that a picture must show.
FEWEST_MARKERS = 2
#: Pictures of a lens from which its focal length is found.
_FOR_FOCAL = 3
#: Pictures of a lens from which its first and second radial coefficient and its principal point are found.
_FOR_K1, _FOR_K2, _FOR_CENTRE = 8, 15, 20
#: Error above which a marker is taken for misread: pixels of a picture of 1600; times the median of all pictures, where
#: that is more.
_STRAY, _TIMES = 3.0, 4.0
#: The same from the plane of the others, before the lens and its distortion are known.
_OFF_PLANE = 16.0


@dataclass(slots=True)
class _Sight:
    """Markers in one picture: corners on the sheet (n, 3), in the picture (n, 2), numbers (n,)."""

    file: str
    points: Array
    pixels: Array


def poses_from_markers(
    sheet: MarkerSheet, found: Mapping[str, Mapping[int, Array]], photos: list[Photo]
) -> Registration:
    """Cameras of the pictures that show at least `FEWEST_MARKERS` of the sheet.

    Lenses are calibrated with the poses in one bundle adjustment over all corners (Zhang 2000, OpenCV's
    ``calibrateCamera``), beginning at the focal length of EXIF where there is one; corners that do not fit are left out
    and the adjustment is repeated. One or two pictures of a size say no focal length: where EXIF does not either, it is
    that of the same camera turned upright or level, else they are left out (`Registration.unsound`).

    Parameters
    ----------
    sheet : MarkerSheet
    found : dict of str to dict of int to (4, 2) array
        File -> number of a marker -> its corners, pixels.
    photos : list of Photo

    Returns
    -------
    Registration
        In the sheet's frame, without points: none are on the object.
    """
    groups: dict[tuple[object, ...], list[tuple[Photo, _Sight]]] = defaultdict(list)
    seen: dict[str, int] = {}
    for photo in photos:
        markers = {k: c for k, c in found.get(photo.file, {}).items() if k in sheet.corners}
        seen[photo.file] = len(markers)
        if len(markers) >= FEWEST_MARKERS:
            points = np.concatenate([sheet.corners[k] for k in markers])
            sight = _plane(_Sight(photo.file, points, np.concatenate(list(markers.values()))), max(photo.size))
            if sight is not None:
                groups[photo.lens].append((photo, sight))
    result = Registration({}, {}, {}, {}, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), "marker sheet")
    errors: list[Array] = []
    lenses: dict[tuple[object, ...], Lens] = {}
    for kind, group in sorted(groups.items(), key=lambda item: -len(item[1])):
        turned = lenses.get((*kind[1::-1], *kind[2:]))
        photo, sights = group[0][0], [sight for _, sight in group]
        if len(group) < _FOR_FOCAL and turned is None and photo.focal is None:
            why = f"{len(group)} of its size show the sheet, and EXIF does not have it"
            result.unsound |= {sight.file: Cause(Reason.NO_FOCAL, why) for sight in sights}
        else:
            lenses[kind] = _calibrate(sights, photo, turned if len(group) < _FOR_FOCAL else None, errors, result)
    for file in seen.keys() - result.matrices.keys():
        reason = Reason.FEW_MARKERS if seen[file] < FEWEST_MARKERS else Reason.POOR_MARKERS
        result.unregistered[file] = Cause(reason, f"{seen[file]} seen")
    return result


def _plane(sight: _Sight, size: int) -> _Sight | None:
    """The markers that lie on one plane with most others, by a homography; None where too few are left."""
    cv2 = libraries.load("opencv")
    limit = _OFF_PLANE * size / 1600
    _, fits = cv2.findHomography(sight.points[:, :2], sight.pixels, cv2.RANSAC, limit)
    if fits is None:
        return None
    good = (np.ravel(fits).reshape(-1, 4) > 0).all(axis=1).repeat(4)  # markers whole
    return _Sight(sight.file, sight.points[good], sight.pixels[good]) if good.sum() >= 4 * FEWEST_MARKERS else None


def _calibrate(
    sights: list[_Sight], photo: Photo, turned: Lens | None, known: list[Array], result: Registration
) -> Lens:
    """Lens and poses of pictures with one lens, into `result`; with `turned` that lens, of the camera held otherwise.

    `known` has the errors of other lenses' corners in parts of the longer side; those of this one are added.
    """
    cv2 = libraries.load("opencv")
    width, height = photo.size
    longer = max(width, height)
    focal = (photo.focal or 1.0) * longer if turned is None else turned.fx * longer / max(turned.width, turned.height)
    camera = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    given = np.zeros(5)
    if turned is not None:
        given[:2] = turned.coefficients[:2]
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
    if len(sights) < _FOR_CENTRE:
        flags |= cv2.CALIB_FIX_PRINCIPAL_POINT
    if len(sights) < _FOR_K2:
        flags |= cv2.CALIB_FIX_K2
    if len(sights) < _FOR_K1:
        flags |= cv2.CALIB_FIX_K1
        if photo.focal is not None or turned is not None:
            flags |= cv2.CALIB_FIX_FOCAL_LENGTH
    limit = _STRAY * longer / 1600
    for attempt in range(3):
        _, camera, distortion, turns, shifts = cv2.calibrateCamera(
            [sight.points.astype(np.float32) for sight in sights],
            [sight.pixels.astype(np.float32) for sight in sights],
            (width, height), camera.copy(), given.copy(), flags=flags,
        )  # fmt: skip
        errors = [
            np.linalg.norm(cv2.projectPoints(s.points, r, t, camera, distortion)[0].reshape(-1, 2) - s.pixels, axis=1)
            for s, r, t in zip(sights, turns, shifts)
        ]
        allowed = max(
            limit, _TIMES * longer * float(np.median(np.concatenate([*known, *(e / longer for e in errors)])))
        )
        if attempt == 2 or max(error.max() for error in errors) <= allowed:
            break
        kept = []
        for sight, error in zip(sights, errors):
            good = (error.reshape(-1, 4).max(axis=1) <= allowed).repeat(4)  # markers whole
            if good.sum() >= 4 * FEWEST_MARKERS:
                kept.append(_Sight(sight.file, sight.points[good], sight.pixels[good]))
        if not kept:
            break
        sights = kept
    known += [error / longer for error in errors]
    coefficients = np.ravel(distortion)[:2]
    lens = Lens(
        width, height, float(camera[0, 0]), float(camera[1, 1]), float(camera[0, 2]), float(camera[1, 2]), "OPENCV",
        (float(coefficients[0]), float(coefficients[1]), 0.0, 0.0),
    )  # fmt: skip
    for sight, turn, translation, error in zip(sights, turns, shifts, errors):
        matrix = np.eye(4)
        matrix[:3, :3] = cv2.Rodrigues(turn)[0]
        matrix[:3, 3] = np.ravel(translation)
        if error.mean() > allowed:
            continue
        result.matrices[sight.file] = invert(matrix) @ OPENCV_TO_BLENDER
        result.lenses[sight.file] = lens
        result.errors[sight.file] = float(error.mean())
        result.observations[sight.file] = len(sight.points)
    return lens
