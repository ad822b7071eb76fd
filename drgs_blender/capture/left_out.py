"""Why pictures are left out of a capture: one named cause for each, grouped for messages and the report."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.arrays import Array
from ..core.errors import first_of

if TYPE_CHECKING:
    from .features import Photo
    from .pictures import Picture
    from .registration import Registration

logger = logging.getLogger(__name__)

#: Features below which a picture has too little texture: sharp ones with texture have thousands.
_FEATURES = 100
#: Features that are matched with pictures that have cameras, below which COLMAP tries no camera by default.
_MATCHED = 30
#: Names that a line has at most.
_NAMES = 20
_BETWEEN = "Add pictures between these and the others, each sharing most of its view with the next"
_AGAIN = "Take them again, sharp: more light or a shorter exposure, the camera held still"


class Reason(Enum):
    """Why a picture is left out: its key in the report, what is said of such pictures, what to do.

    Of `DOUBTFUL_MASK` pictures are used, but should be looked at.
    """

    UNREADABLE = "unreadable", "cannot be read", "Copy or convert them again"
    EMPTY_MASK = (
        "empty mask", "the mask has nothing of the object",
        "Draw it white on the object, leave the picture out, or give --masks none",
    )  # fmt: skip
    SATURATED = "saturated", "saturated below white, and shorter exposures are missing", "Add shorter exposures"
    UNLIKE_BRACKET = (
        "bracket shows several views", "its bracket shows no one view: the middle exposure is used alone",
        "Take brackets from a tripod, or give --brackets none",
    )  # fmt: skip
    BRACKET = "exposure bracket", "in an exposure bracket that is not merged", "--brackets 3 merges each three of them"
    DUPLICATE = "duplicate", "the same as another one of them", "They add nothing"
    BLURRED = "blurred", "blurred", _AGAIN
    FEW_MARKERS = (
        "too few markers", "too few markers of the sheet are seen", "Let each show several, uncovered and sharp",
    )  # fmt: skip
    POOR_MARKERS = (
        "markers do not fit", "markers of the sheet do not fit those of the other pictures",
        "Glue the sheet on something flat, and take these pictures again, sharp",
    )  # fmt: skip
    NO_FOCAL = (
        "unknown focal length", "nothing says its focal length",
        "Take three or more of each size, or keep the EXIF of the camera",
    )  # fmt: skip
    NO_TEXTURE = (
        "too little texture", "too little texture: few features",
        "Lay a newspaper, a patterned cloth or a marker sheet (drgs markers) under the object",
    )  # fmt: skip
    FEW_MATCHES = "too few matches", "too few matches with the other pictures", _BETWEEN
    APART = (
        "matches only pictures left out", "fits only pictures that have no camera in this capture either",
        f"{_BETWEEN}; of another object, give them a folder of their own",
    )  # fmt: skip
    NO_POSE = (
        "no consistent pose", "matched, but no place of the camera agrees with the matches",
        f"Leave object and surroundings where they are; where sides look alike, lay a pattern beside them. {_BETWEEN}",
    )  # fmt: skip
    CONTRADICTED = (
        "pose not trusted: contradicted", "the camera may be wrong: matches contradict it",
        f"Where sides look alike, lay a pattern beside them. {_BETWEEN}",
    )  # fmt: skip
    LOOSE = "pose not trusted: loosely tied", "the camera may be wrong: few points tie it to the others", _BETWEEN
    LEANING = "pose not trusted: leans on others", "the camera may be wrong: it leans on pictures left out", _BETWEEN
    DOUBTFUL_MASK = (
        "doubtful mask", "used, but the mask is doubtful",
        "Look at masks.png, and draw these masks by hand or leave the pictures out",
    )  # fmt: skip

    def __init__(self, key: str, said: str, remedy: str):
        self.key, self.said, self.remedy = key, said, remedy


@dataclass(frozen=True, slots=True)
class Cause:
    """Why one picture is left out.

    Attributes
    ----------
    reason : Reason
    detail : str
        What of this picture shows it.

    Examples
    --------
    >>> str(Cause(Reason.DUPLICATE, "cup.jpg"))
    'the same as another one of them (cup.jpg)'
    """

    reason: Reason
    detail: str = ""

    def __str__(self) -> str:
        return f"{self.reason.said} ({self.detail})" if self.detail else self.reason.said


def grouped(causes: Mapping[str, Cause]) -> dict[Reason, dict[str, Cause]]:
    """File names and their causes by reason, in the order of `Reason`."""
    groups: dict[Reason, dict[str, Cause]] = {}
    for reason in Reason:
        if members := {name: cause for name, cause in causes.items() if cause.reason is reason}:
            groups[reason] = members
    return groups


def lines(causes: Mapping[str, Cause], most: int = _NAMES, remedies: bool = True) -> list[str]:
    """Lines of the printed report, one a reason, with at most so many names each, and what to do.

    Examples
    --------
    >>> lines({"a.jpg": Cause(Reason.BLURRED, "sharpness 4% of the others'"), "b.jpg": Cause(Reason.UNREADABLE)})[1]
    "1 blurred: a.jpg (sharpness 4% of the others'). Take them again, sharp: more light or a shorter exposure, the camera held still"
    """  # noqa: E501
    return [
        f"{len(members)} {reason.said}: {_named(members, most)}{f'. {reason.remedy}' if remedies else ''}"
        for reason, members in grouped(causes).items()
    ]


def _named(members: Mapping[str, Cause], most: int) -> str:
    names = [f"{name} ({cause.detail})" if cause.detail else name for name, cause in members.items()]
    return ", ".join(names[:most]) + (", ..." if len(names) > most else "")


def as_report(causes: Mapping[str, Cause]) -> list[dict[str, Any]]:
    """Entries of `capture.json`, one a reason: its pictures with their details, what is said of them, what to do."""
    return [
        {
            "reason": reason.key,
            "said": reason.said,
            "remedy": reason.remedy,
            "left_out": reason is not Reason.DOUBTFUL_MASK,
            "pictures": {name: cause.detail for name, cause in members.items()},
        }
        for reason, members in grouped(causes).items()
    ]


def why_unregistered(
    colmap: Any, database: Path, verified: Sequence[tuple[int, int, Array]], photos: Sequence[Photo],
    kept: Iterable[str],
) -> dict[str, Cause]:  # fmt: skip
    """Why pictures have no camera, by their features and matches.

    Parameters
    ----------
    colmap : module
        pycolmap.
    database : Path
        COLMAP's, with features and matches.
    verified : sequence of (int, int, (n, 2) array)
        Of `soundness.read_matches`.
    photos : sequence of Photo
    kept : iterable of str
        Files that have a camera; may be none.

    Returns
    -------
    dict of str to Cause
        File -> cause, of all but those kept.
    """
    given = {photo.file: photo.given or photo.file for photo in photos}
    with colmap.Database.open(str(database)) as data:
        names = {image.image_id: image.name for image in data.read_all_images()}
        features = {names[number]: data.num_keypoints_for_image(number) for number in names}
        matched = dict(zip(*data.read_num_matches(), strict=True))
    kept = set(kept)
    raw: dict[str, dict[str, int]] = defaultdict(dict)
    for pair, count in matched.items():
        a, b = (names.get(number, "") for number in colmap.pair_id_to_image_pair(pair))
        raw[a][b] = raw[b][a] = int(count)
    shared: dict[str, dict[str, Array]] = defaultdict(dict)
    for first, second, pairs in verified:
        a, b = names.get(first, ""), names.get(second, "")
        shared[a][b], shared[b][a] = pairs[:, 0], pairs[:, 1]
    found = {}
    for file in given.keys() - kept:
        found[file] = _cause(features.get(file, 0), raw[file], shared[file], kept, given)
    return {photo.file: found[photo.file] for photo in photos if photo.file in found}


def _cause(features: int, raw: Mapping[str, int], shared: Mapping[str, Array], kept: set[str],
           given: Mapping[str, str]) -> Cause:  # fmt: skip
    """Of one picture: `raw` counts its matches, `shared` has its features of verified ones, with each other picture."""
    if features < _FEATURES:
        return Cause(Reason.NO_TEXTURE, f"{features} features")
    if not shared:
        other = max(raw, key=raw.__getitem__, default="")
        some = f", {raw[other]} unverified with {given.get(other, other)} at most" if raw.get(other) else ""
        return Cause(Reason.FEW_MATCHES, f"none with any that geometry verifies{some}")
    partners = {other: indices for other, indices in shared.items() if other in kept}
    if kept and not partners:
        other = max(shared, key=lambda name: len(shared[name]))
        return Cause(Reason.APART, f"{len(shared[other])} matches with {given.get(other, other)}")
    partners = partners or dict(shared)
    other = max(partners, key=lambda name: len(partners[name]))
    count = len(np.unique(np.concatenate(list(partners.values()))))
    most = f"{len(partners[other])} of them with {given.get(other, other)}"
    if count < _MATCHED:
        return Cause(Reason.FEW_MATCHES, f"{count} of its features, {most}")
    return Cause(Reason.NO_POSE, f"{count} of its features are matched, {most}")


def tell_left_out(found: Registration, photos: Sequence[Photo], by_file: Mapping[str, Picture], source: Path) -> None:
    """Warn of pictures that have no camera, by reason; of an object that moved, and of pictures of another object."""
    names = {photo.file: by_file[photo.file].path.name for photo in photos}
    causes = {names[photo.file]: cause_of(found, photo.file) for photo in photos if photo.file not in found.matrices}
    for line in lines(causes):
        logger.warning("%s: of %d pictures left out: %s", source, len(photos), line)
    if found.moved is not None:
        files = [photo.file for photo in photos if photo.file in found.matrices]
        moment = files.index(found.moved)
        last, first = (names[file] for file in files[moment - 1 : moment + 1])
        logger.warning(
            "%s: the object or a part of it moved between %s and %s: it is there twice. Use the pictures of one place "
            "alone (%d pictures before it, %d after), or photograph it again", source, last, first, moment,
            len(files) - moment,
        )  # fmt: skip
    for group in found.apart:
        logger.warning(
            "%s: %d pictures fit together but share nothing with the others, as of another object: %s. Give them "
            "a folder of their own, or add pictures between", source, len(group),
            first_of([names[file] for file in group]),
        )  # fmt: skip


def cause_of(found: Registration, file: str) -> Cause:
    """Why a file has no camera."""
    return found.unsound.get(file) or found.unregistered.get(file) or Cause(Reason.FEW_MATCHES)
