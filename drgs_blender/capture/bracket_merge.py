"""Exposure brackets to one linear picture each: the weighted mean of what every exposure says of the radiance."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from ..core.arrays import Array
from ..core.asset.archive import replace_file
from ..core.color import linear_to_srgb, srgb_to_linear, to_unit
from ..core.errors import AssetError, Cancelled, first_of
from ..formats.exr import write_exr_picture
from .brackets import Bracket, Brackets, reference, stops_of, white_of
from .features import Tell
from .left_out import Cause, Reason
from .pictures import Picture, decode

logger = logging.getLogger(__name__)

#: Encoded values from which a pixel counts as saturated: JPEG writes clipped ones a little lower, too.
_SATURATED = 0.98
#: Least weight of an unsaturated value, so that black in every exposure is black.
_LEAST = 1e-3
#: Cells along the longer side in which exposures are compared, and pixels of one at least; cells that must be
#: comparable; least mean of one, encoded: below it noise and rounding decide.
_CELLS, _BLOCK, _ENOUGH, _DARK = 64, 4, 20, 0.08
#: Least correlation of the logarithms of two exposures of one view; stops of contrast below which that says nothing.
_ALIKE, _FLAT = 0.9, 0.15
#: Stops by which the ratio of two exposures may differ from what EXIF says; what EXIF's rounding explains of that, as
#: of 1/60 s for 1/64 s: up to there the pictures know better, by so many cells.
_AGREE, _ROUNDED, _MEASURED = 0.5, 0.12, 50
#: Rows that are added at once.
_ROWS = 256
#: Part of the pixels above white from which the report says so.
_ABOVE = 1e-3
#: A picture whose exposures are all longer than that of white by so many stops is left out where more than this part of
#: its pixels is saturated in each: what is lost there is darker than white, and would look grey.
_BELOW, _DARKENED = 0.5, 0.02


@dataclass(slots=True)
class Merged:
    """What became of brackets: pictures in the order of their files, files that are left out and why, lines to say."""

    pictures: list[Picture]
    left_out: dict[str, Cause] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)


@dataclass(slots=True)
class _Outcome:
    """What became of one bracket; kept beside its picture, for a run that goes on.

    Attributes
    ----------
    used : list of str
        Names of the merged files: of several views the middle exposure alone; none where none can be read.
    unread : dict of str to str
        Name -> what is wrong.
    views : bool
        They show several views.
    error : float
        Stops by which exposures differ otherwise than EXIF says.
    lost, above : float
        Parts of the pixels that are saturated in every exposure, that are brighter than white.
    """

    used: list[str] = field(default_factory=list)
    unread: dict[str, str] = field(default_factory=dict)
    views: bool = False
    error: float = 0.0
    lost: float = 0.0
    above: float = 0.0

    @property
    def notes(self) -> list[str]:
        """What is unusual about the merged picture."""
        notes = [f"merged from {len(self.used)} exposures ({', '.join(self.used)})"]
        if self.lost > _ABOVE:
            notes.append(f"{self.lost:.1%} of its pixels are saturated in every exposure")
        if self.above > _ABOVE:
            notes.append(f"{self.above:.1%} of its pixels are brighter than white")
        return notes


def merge_brackets(pictures: Sequence[Picture], found: Brackets, folder: Path, subject: str, tell: Tell,
                   cancelled: Callable[[], bool]) -> Merged:  # fmt: skip
    """Merge brackets to EXR files, linear Rec.709, of one scale: 1 is white at the median of the middle exposures.

    The radiance of a pixel is the mean over the exposures of its linear value divided by the exposure, weighted by the
    exposure and a hat over the encoded value (Debevec and Malik 1997, with the curve of sRGB); saturated values count
    only where all are: then the shortest exposure is what is known.

    Parameters
    ----------
    pictures : sequence of Picture
        All of the folder.
    found : Brackets
    folder : Path
        To write into; pictures that a run before this has merged there from the same files are kept.
    subject : str
        For messages.
    tell, cancelled : callable

    Raises
    ------
    AssetError
        No picture is left.
    Cancelled
        `cancelled` said so.
    """
    folder.mkdir(parents=True, exist_ok=True)
    references = reference(found)
    outcomes = []
    for index, group in enumerate(found.groups):
        if cancelled():
            raise Cancelled
        tell("merging exposures", index / len(found.groups))
        outcomes.append(_outcome(group, folder / f"{group.middle.name}.exr", white_of(group, references)))
    left_out = {name: Cause(Reason.UNREADABLE, why) for one in outcomes for name, why in one.unread.items()}
    made: dict[int, Picture] = {}
    alone = {id(picture) for picture in found.others}
    dark: list[str] = []
    for group, outcome in zip(found.groups, outcomes, strict=True):
        names = [picture.path.name for picture in group.pictures if picture.path.name not in left_out]
        if outcome.views:
            unlike = [name for name in names if name not in outcome.used]
            left_out |= dict.fromkeys(unlike, Cause(Reason.UNLIKE_BRACKET))
        if _is_darkened(group, outcome, white_of(group, references)):
            dark += outcome.used
        elif outcome.used:
            made[id(group.pictures[0])] = _picture(group, folder, white_of(group, references), outcome)
    left_out |= dict.fromkeys(dark, Cause(Reason.SATURATED))
    result = [made.get(id(one), one) for one in pictures if id(one) in made or id(one) in alone]
    if not result:
        problem = f"has only pictures that cannot be read: {first_of(list(left_out))}"
        raise AssetError(subject, problem, "Copy them again")
    _tell(found.groups, outcomes, dark, subject)
    return Merged(result, left_out, _lines(found, outcomes))


def _is_darkened(group: Bracket, outcome: _Outcome, white: float) -> bool:
    """Whether what is saturated in every exposure is darker than white."""
    used = [stops_of(picture) for picture in group.pictures if picture.path.name in outcome.used]
    return bool(used) and outcome.lost > _DARKENED and max(used) < white - _BELOW


def _picture(group: Bracket, folder: Path, white: float, outcome: _Outcome) -> Picture:
    """The merged picture of a bracket."""
    middle = group.middle
    masks = [picture.mask for picture in (middle, *group.pictures) if picture.mask is not None]
    exif = replace(middle.exif, orientation=1)
    if exif.exposure is not None:
        exif = replace(exif, exposure=white)
    picture = Picture(folder / f"{middle.name}.exr", middle.name, masks[0] if masks else None, exif, middle.size)
    sources = [f"{one.path.name}: {note}" for one in group.pictures for note in one.notes]
    picture.notes = [*outcome.notes, *sources]
    picture.alpha, picture.merged = middle.alpha, tuple(outcome.used)
    return picture


def _outcome(group: Bracket, target: Path, white: float) -> _Outcome:
    """A bracket merged into `target`, or what a run before this says of it."""
    kept = target.with_suffix(".json")
    try:
        before = _Outcome(**json.loads(kept.read_text(encoding="utf-8")))
        if not before.unread and target.is_file():  # what could not be read then may be there now
            return before
    except (OSError, ValueError, TypeError):
        pass
    outcome = _merge(group, target, white)
    replace_file(kept, [json.dumps(asdict(outcome)).encode()])  # after the picture: then that is whole
    return outcome


def _merge(group: Bracket, target: Path, white: float) -> _Outcome:
    """A bracket merged into `target`, unless its pictures are none or cannot be read."""
    radiance, outcome = _Radiance(white), _Outcome()
    for one in sorted(group.pictures, key=stops_of, reverse=True):  # the shortest exposure first
        try:
            pixels = decode(one)
        except AssetError as error:
            outcome.unread[one.path.name] = error.problem
            continue
        if not radiance.add(pixels, stops_of(one), one is group.middle):
            alone = _merge(Bracket([group.middle]), target, white)
            return replace(alone, unread=alone.unread | outcome.unread, views=True)
    outcome.used = [one.path.name for one in group.pictures if one.path.name not in outcome.unread]
    if outcome.used:
        merged = radiance.result()
        write_exr_picture(target, merged)
        outcome.error, outcome.lost = radiance.error, radiance.lost
        outcome.above = float((merged[..., :3].max(axis=2) > 1).mean())
    return outcome


class _Radiance:
    """The weighted mean as it grows by one exposure after the other, the shortest first."""

    def __init__(self, white: float) -> None:
        self._white = white
        self._total: Array | None = None
        self._weight: Array | None = None
        self._shortest: Array | None = None
        self._alpha: Array | None = None
        self._cells: tuple[Array, Array] | None = None
        self._shift = self._middle_shift = 0.0
        self.error = 0.0
        self.lost = 0.0

    def add(self, pixels: Array, stops: float, middle: bool) -> bool:
        """Add (h, w, 3 or 4) pixels of `decode`; False where they show another view."""
        cells = _compared(pixels, np.float32(2.0 ** (stops - self._white)))
        if self._cells is not None and not self._same_view(cells):
            return False
        self._cells = cells[0] * np.float32(2.0**self._shift), cells[1]
        if middle:
            self._middle_shift = self._shift
        scale = np.float32(2.0 ** (stops + self._shift - self._white))
        if pixels.shape[2] == 4 and (self._alpha is None or middle):
            self._alpha = np.clip(to_unit(pixels[..., 3:]), 0, 1)
        first = self._total is None
        if first:
            self._total, self._weight, self._shortest = (np.zeros((*pixels.shape[:2], 3), np.float32) for _ in range(3))
        assert self._total is not None and self._weight is not None and self._shortest is not None
        for row in range(0, len(pixels), _ROWS):  # memory: whole planes of both would double it
            rows = slice(row, row + _ROWS)
            linear, weight = _linear_and_weight(pixels[rows, :, :3])
            linear *= scale
            weight /= scale
            self._weight[rows] += weight
            if first:
                self._shortest[rows] = linear
            self._total[rows] += linear * weight
        return True

    def _same_view(self, cells: tuple[Array, Array]) -> bool:
        """Whether cells fit those of the exposure before; how far they are from what EXIF says is kept.

        Ratios that EXIF only rounds are measured: `_shift` is what makes the exposure that of the one before.
        """
        assert self._cells is not None
        (one, one_valid), (other, other_valid) = self._cells, cells
        if one.shape != other.shape:
            return False
        valid = one_valid & other_valid
        if valid.sum() < _ENOUGH:
            return True  # nothing to compare
        a, b = np.log2(one[valid]), np.log2(other[valid])
        apart = float(np.median(a - b)) - self._shift
        self.error = max(self.error, abs(apart))
        if abs(apart) <= _ROUNDED and len(a) >= _MEASURED:
            self._shift += apart
        if min(a.std(), b.std()) < _FLAT:
            return True
        return float(np.corrcoef(a, b)[0, 1]) >= _ALIKE

    def result(self) -> Array:
        """(h, w, 3 or 4) float32, linear; colours are multiplied by the alpha, as EXR has them."""
        assert self._total is not None and self._weight is not None and self._shortest is not None
        known = self._weight > 0
        self.lost = float((~known).any(axis=2).mean())
        colour = np.divide(self._total, self._weight, out=self._shortest, where=known)
        colour *= np.float32(2.0**-self._middle_shift)  # the middle exposure has the scale that EXIF says
        if self._alpha is None:
            return colour
        return np.concatenate([colour * self._alpha, self._alpha], axis=2, dtype=np.float32)


def _most(pixels: Array) -> float:
    return float(np.iinfo(pixels.dtype).max) if pixels.dtype.kind == "u" else 1.0


def _linear_and_weight(colour: Array) -> tuple[Array, Array]:
    """Linear values of (...) pixels, and their weights: a hat over the encoded value, 0 where saturated."""
    if colour.dtype.kind == "u":  # a table is a tenth of the work
        steps = np.arange(int(_most(colour)) + 1, dtype=np.float32) / np.float32(_most(colour))
        return srgb_to_linear(steps)[colour], _hat(steps)[colour]
    linear = np.maximum(colour, 0).astype(np.float32)
    return linear, _hat(linear_to_srgb(np.minimum(linear, 1)))


def _hat(encoded: Array) -> Array:
    weight = np.minimum(encoded, 1 - encoded) + np.float32(_LEAST)
    return np.where(encoded >= _SATURATED, 0, weight).astype(np.float32)


def _compared(pixels: Array, scale: np.float32) -> tuple[Array, Array]:
    """(mean radiance of green in cells, which of them have no saturated pixel and are not dark)."""
    height, width = pixels.shape[:2]
    longest = min(_CELLS, max(height, width) // _BLOCK)
    cells = [max(1, round(longest * side / max(height, width))) for side in (height, width)]
    rows, columns = (np.linspace(0, side, n + 1).astype(int)[:-1] for side, n in zip((height, width), cells))
    ends = np.append(rows, height), np.append(columns, width)
    area = np.diff(ends[0])[:, None] * np.diff(ends[1])
    limit = _SATURATED * _most(pixels) if pixels.dtype.kind == "u" else float(srgb_to_linear(np.array(_SATURATED)))
    green = _linear_and_weight(pixels[..., 1])[0]
    free = (pixels[..., :3].max(axis=2) < limit).astype(np.float32)
    mean, part = (
        np.add.reduceat(np.add.reduceat(one, rows, axis=0), columns, axis=1) / np.maximum(area, 1)
        for one in (green, free)
    )
    dark = float(srgb_to_linear(np.array(_DARK)))
    return mean * scale, (part >= 1 - 1e-6) & (mean > dark)


def _tell(groups: Sequence[Bracket], outcomes: Sequence[_Outcome], dark: Sequence[str], subject: str) -> None:
    """Warnings, one for each kind of doubt."""
    pairs = list(zip(groups, outcomes, strict=True))
    if unread := [f"{name} ({why})" for one in outcomes for name, why in one.unread.items()]:
        logger.warning(
            "%s: %d exposures cannot be read and are left out of their brackets: %s",
            subject, len(unread), first_of(unread),
        )  # fmt: skip
    if views := [str(group) for group, one in pairs if one.views]:
        logger.warning(
            "%s: %d brackets by EXIF show no one view and are not merged; their middle exposures are used alone: %s",
            subject, len(views), first_of(views),
        )  # fmt: skip
    if dark:
        logger.warning(
            "%s: %d pictures are left out: saturated below white, and shorter exposures of them are missing: %s",
            subject, len(dark), first_of(dark),
        )  # fmt: skip
    if disagree := [f"{group} ({one.error:.1f} stops)" for group, one in pairs if one.error > _AGREE]:
        logger.warning(
            "%s: %d brackets differ otherwise in brightness than EXIF says, so their colours are not those of the "
            "light: %s. The camera's contrast curve does that, or light that changed; develop raw files to linear EXR, "
            "or to TIFF without a curve",
            subject, len(disagree), first_of(disagree),
        )  # fmt: skip


def _lines(found: Brackets, outcomes: Sequence[_Outcome]) -> list[str]:
    """What is said of the brackets."""
    merged = sum(bool(one.used) for one in outcomes)
    if not merged:
        return []
    steps = found.complete[0].steps if found.complete else []
    stops = ", ".join(f"{-step:+.1f}" if step else "0" for step in steps)
    line = f"brackets: {merged} merged, of {found.size} exposures ({stops} stops)"
    above = max(one.above for one in outcomes)
    if above > _ABOVE:
        line += f"; up to {above:.1%} of a picture is brighter than white: only materials and light are learned from it"
    return [line]
