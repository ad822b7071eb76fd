"""Exposure brackets: which photographs belong together, and what is said of those that do not."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np

from ..core.errors import AssetError, UsageError, first_of
from .pictures import Picture

logger = logging.getLogger(__name__)

#: Values of the setting that are no number; the numbers.
AUTO, NONE = "auto", "none"
FEWEST, MOST = 2, 9
#: Stops by which exposures of one bracket differ at least, and those of equal steps at most: EXIF rounds.
_STEP, _EQUAL = 0.4, 0.3
#: Stops that a bracket spans at least, where it is recognised by itself.
_SPAN = 1.0
#: Patterns that are tried at most.
_CANDIDATES = 8
#: Seconds between pictures of a bracket, beside their own.
_PAUSE = 5.0


@dataclass(slots=True)
class Bracket:
    """Photographs of one view in several exposures.

    Attributes
    ----------
    pictures : list of Picture
        In the order of their files.
    """

    pictures: list[Picture] = field(default_factory=list)

    @property
    def stops(self) -> list[float]:
        """Exposure values, stops; larger lets in less light."""
        return [stops_of(picture) for picture in self.pictures]

    @property
    def steps(self) -> list[float]:
        """Exposure values less that of the first."""
        return [value - self.stops[0] for value in self.stops]

    @property
    def middle(self) -> Picture:
        """The picture of middle exposure, of two the brighter."""
        return sorted(self.pictures, key=stops_of)[(len(self.pictures) - 1) // 2]

    def __str__(self) -> str:
        return " + ".join(picture.path.name for picture in self.pictures)


@dataclass(slots=True)
class Brackets:
    """The brackets of a folder.

    Attributes
    ----------
    groups : list of Bracket
        In the order of their files; incomplete ones have fewer pictures than `size`.
    others : list of Picture
        Those of no bracket: their exposure is not known.
    size : int
        Pictures of a complete bracket.
    """

    groups: list[Bracket]
    others: list[Picture]
    size: int

    @property
    def complete(self) -> list[Bracket]:
        """Those with all their pictures."""
        return [group for group in self.groups if len(group.pictures) == self.size]


def check_setting(value: str) -> None:
    """Raise UsageError unless `value` is "auto", "none" or a number of pictures."""
    if value in (AUTO, NONE) or (value.isdecimal() and FEWEST <= int(value) <= MOST):
        return
    raise UsageError("brackets", f"is {value!r}", f"Choose auto, none, or a number from {FEWEST} to {MOST}")


def stops_of(picture: Picture) -> float:
    """Exposure value, stops; NaN where it is not known."""
    stops = picture.exif.stops
    return float("nan") if stops is None else stops


def find_brackets(pictures: Sequence[Picture], setting: str, source: Path) -> Brackets | None:
    """The exposure brackets of photographs, in the order of files; None where there are none. Warnings name doubts.

    Files that follow each other are a bracket where they have the same size, camera, lens and known exposure settings,
    each another exposure, and, as far as they say when they were taken, no more than `_PAUSE` seconds between them.
    Where all say when they were taken and the pauses divide them into brackets, the pauses decide (`_by_pauses`).
    The most common pattern of exposures counts; it must span a stop, be there twice and be that of half of the
    pictures. What fits in with some of its exposures left out is an incomplete bracket.

    Parameters
    ----------
    pictures : sequence of Picture
    setting : str
        "auto"; "none"; or how many pictures are a bracket, without regard to when they were taken.
    source : Path
        For messages.

    Raises
    ------
    AssetError
        A number is given, and there are no brackets of so many pictures.
    UsageError
        The setting is none of these.
    """
    check_setting(setting)
    if setting == NONE:
        return None
    count = None if setting == AUTO else int(setting)
    known = [picture for picture in pictures if picture.exif.stops is not None]
    others = [picture for picture in pictures if picture.exif.stops is None]
    groups = _by_pauses(pictures, count)
    size = max((len(group.pictures) for group in groups), default=0)
    if not groups and (pattern := _pattern(known, pictures, count)) is not None:
        groups, size = _split(pictures, pattern, count is None), len(pattern)
    if not groups:
        if count is not None:
            problem = f"has no {count} files that follow each other with different exposures and the same size and lens"
            if others:
                named = first_of(_names(others))
                problem += f"; {len(others)} of {len(pictures)} do not say how they were exposed, as {named}"
            raise AssetError(
                str(source), problem, "Check that their EXIF has the exposure time, or give --brackets none"
            )
        _hint(known, source)
        return None
    found = Brackets(groups, others, size)
    _tell(found, source)
    return found


def _by_pauses(pictures: Sequence[Picture], count: int | None) -> list[Bracket]:
    """Brackets by the pauses between their files, where these tell; else none.

    Pictures of a bracket follow each other at once, brackets do not: of all pauses that may divide them, the one after
    which most have the same number of different exposures. A file that is missing or exposed otherwise moves no other.
    """
    if any(picture.exif.taken is None or picture.exif.stops is None for picture in pictures):
        return []
    pauses = [_pause(one, other) for one, other in pairwise(pictures)]
    best: tuple[int, list[Bracket]] = 0, []
    for longest in sorted(set(pauses))[:-1]:
        if count is None and longest > _PAUSE:
            break
        groups = [Bracket([pictures[0]])] if pictures else []
        for picture, pause in zip(pictures[1:], pauses):
            if pause <= longest:
                groups[-1].pictures.append(picture)
            else:
                groups.append(Bracket([picture]))
        if not all(_differ(group) for group in groups):
            continue
        sizes = [len(group.pictures) for group in groups]
        size = count or max(set(sizes), key=sizes.count)
        whole = [group for group in groups if len(group.pictures) == size]
        if size < FEWEST or max(sizes) > size or 2 * size * len(whole) < len(pictures):
            continue
        if count is None and (len(whole) < 2 or not _alike(whole)):
            continue
        best = max(best, (size * len(whole), groups), key=lambda one: (one[0], -len(one[1])))
    return best[1]


def _pause(one: Picture, other: Picture) -> float:
    """Whole seconds, as EXIF has them, between two pictures, beside the exposure; without end for another camera."""
    assert one.exif.taken is not None and other.exif.taken is not None
    if _kind(one) != _kind(other):
        return float("inf")
    return float(round(max(0.0, abs(other.exif.taken - one.exif.taken) - (one.exif.seconds or 0.0))))


def _differ(group: Bracket) -> bool:
    return all(abs(a - b) >= _STEP for a, b in combinations(group.stops, 2))


def _alike(groups: Sequence[Bracket]) -> bool:
    """Whether most have the same steps, which span enough to be no accident."""
    steps = groups[len(groups) // 2].steps
    same = sum(_equal(steps, group.steps) for group in groups)
    return max(steps) - min(steps) >= _SPAN and 2 * same > len(groups)


def _hint(known: Sequence[Picture], source: Path) -> None:
    """Say that there may be brackets where exposures differ as in some."""
    stops = [stops_of(picture) for picture in known]
    if stops and max(stops) - min(stops) >= 2.0:
        logger.warning(
            "%s: exposures differ by %.1f stops, and no brackets are recognised. If files that follow each other are "
            "brackets of n exposures, give --brackets n", source, max(stops) - min(stops),
        )  # fmt: skip


def _pattern(known: Sequence[Picture], pictures: Sequence[Picture], count: int | None) -> list[float] | None:
    """Steps of the most common bracket; None where there are none to rely on."""
    runs = [run for run in _split(pictures, None, count is None, count or MOST) if len(run.pictures) >= FEWEST]
    if count is not None:
        runs = [run for run in runs if len(run.pictures) == count]
    candidates: list[tuple[int, list[float]]] = []
    for run in runs:
        steps = run.steps
        if count is None and max(steps) - min(steps) < _SPAN:
            continue
        if not any(_equal(steps, other) for _, other in candidates):
            candidates.append((sum(_equal(steps, other.steps) for other in runs), steps))
    best: tuple[tuple[int, int], int, list[float]] | None = None
    for _, steps in sorted(candidates, key=lambda one: -one[0])[:_CANDIDATES]:
        # A missing picture shifts the runs after it, not brackets of the right pattern.
        groups = _split(pictures, steps, count is None)
        whole = sum(len(group.pictures) == len(steps) for group in groups)
        score = whole * len(steps), -len(groups)
        if best is None or score > best[0]:
            best = score, whole, steps
    if best is None:
        return None
    (covered, _), whole, steps = best
    return None if count is None and (whole < 2 or 2 * covered < len(known)) else steps


def _equal(steps: Sequence[float], others: Sequence[float]) -> bool:
    return len(steps) == len(others) and all(abs(a - b) <= _EQUAL for a, b in zip(steps, others))


def _split(
    pictures: Sequence[Picture], pattern: Sequence[float] | None, timed: bool, most: int = MOST
) -> list[Bracket]:
    """Pictures that follow each other, cut where they are of another bracket; of `pattern`, where there is one."""
    groups: list[Bracket] = []
    before: Picture | None = None
    for picture in pictures:
        if picture.exif.stops is None:
            before = None
            continue
        if before is not None and _follows(before, picture, timed) and _fits(groups[-1], picture, pattern, most):
            groups[-1].pictures.append(picture)
        else:
            groups.append(Bracket([picture]))
        before = picture
    return groups


def _follows(one: Picture, other: Picture, timed: bool) -> bool:
    """Whether two pictures may be of one bracket, by camera and time."""
    if _kind(one) != _kind(other):
        return False
    if not timed or one.exif.taken is None or other.exif.taken is None:
        return True
    longest = (one.exif.seconds or 0.0) + (other.exif.seconds or 0.0)
    return abs(other.exif.taken - one.exif.taken) <= _PAUSE + longest


def _kind(picture: Picture) -> tuple[object, ...]:
    """Equal for pictures whose exposures can be compared."""
    return (*picture.lens, picture.exif.aperture is None, picture.exif.iso is None)


def _fits(group: Bracket, picture: Picture, pattern: Sequence[float] | None, most: int) -> bool:
    """Whether the exposure of a picture goes on with a bracket."""
    steps = Bracket([*group.pictures, picture]).steps
    if pattern is None:
        return len(steps) <= most and all(abs(steps[-1] - step) >= _STEP for step in steps[:-1])
    return any(_equal(steps, [value - chosen[0] for value in chosen]) for chosen in combinations(pattern, len(steps)))


def _names(pictures: Sequence[Picture]) -> list[str]:
    return [picture.path.name for picture in pictures]


def _tell(found: Brackets, source: Path) -> None:
    """Name incomplete brackets, pictures of another size among them, and pictures without an exposure."""
    short = [group for group in found.groups if len(group.pictures) < found.size]
    if short:
        odd = _of_other_size(found.groups)
        logger.warning(
            "%s: %d exposure brackets have not all %d exposures and are merged from those there are: %s%s",
            source, len(short), found.size, first_of([str(group) for group in short]),
            f". Of another size than their neighbours are {first_of(odd)}" if odd else "",
        )  # fmt: skip
    if found.others:
        logger.warning(
            "%s: %d pictures do not say how long they were exposed (or 0 s) and are used as they are, beside merged "
            "brackets: %s", source, len(found.others), first_of(_names(found.others)),
        )  # fmt: skip


def _of_other_size(groups: Sequence[Bracket]) -> list[str]:
    """Pictures of a size that few have."""
    sizes = [picture.size for group in groups for picture in group.pictures]
    usual = max(set(sizes), key=sizes.count)
    odd = [picture for group in groups for picture in group.pictures if picture.size != usual]
    return [f"{p.path.name} ({p.size[0]} x {p.size[1]}, not {usual[0]} x {usual[1]})" for p in odd]


def reference(found: Brackets) -> dict[tuple[object, ...], float]:
    """Kind of pictures -> exposure value at which 1 is white in merged ones: the median of the middle exposures."""
    middles: dict[tuple[object, ...], list[float]] = {}
    complete = {_comparable(group.middle) for group in found.complete}
    for group in found.groups:
        kind = _comparable(group.middle)
        if len(group.pictures) == found.size or kind not in complete:
            middles.setdefault(kind, []).append(stops_of(group.middle))
    return {kind: float(np.median(values)) for kind, values in middles.items()}


def _comparable(picture: Picture) -> tuple[object, ...]:
    return picture.exif.aperture is None, picture.exif.iso is None


def white_of(group: Bracket, references: dict[tuple[object, ...], float]) -> float:
    """The exposure value of `reference` for a bracket."""
    return references[_comparable(group.middle)]
