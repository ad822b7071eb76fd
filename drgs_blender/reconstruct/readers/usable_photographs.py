"""Which photographs of a capture can be used: the others are left out, and named."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from ...core.errors import AssetError, first_of
from ..capture.capture import View
from .layout import Photograph, turned_by_exif

logger = logging.getLogger(__name__)

_BLANK = "black or of one colour"
#: A photograph and what became of it.
Pair = tuple[Photograph, View]


def usable(developed: Sequence[tuple[Photograph, View | None]], subject: str) -> list[View]:
    """The views of a capture that say something of the object, in their order; warnings name the files of the others.

    Left out are photographs that are black or of one colour, those without a mask where most have one, and those whose
    mask is empty. Where most have no mask, the others lose theirs. Views to learn from and views to test are counted
    apart.

    Parameters
    ----------
    developed : list
        Results of `load_photograph` for each photograph.
    subject : str
        The capture, for messages.

    Raises
    ------
    AssetError
        Most photographs are black or of one colour.
    """
    pairs = _without_blank(developed, subject)
    if all(view.mask is None or view.mask.min() >= 1 for _, view in pairs):  # an alpha channel that says nothing
        for _, view in pairs:
            view.set_mask(None)
    left_out = [*_unmasked(pairs, False, subject), *_unmasked(pairs, True, subject), *_empty(pairs, subject)]
    pairs = [pair for pair in pairs if not any(pair is other for other in left_out)]
    if turned := [photograph.image for photograph, _ in pairs if turned_by_exif(photograph.image)]:
        logger.warning(
            "%s: %d photographs are marked as turned (EXIF orientation), the first is %s. Their pixels are used as "
            "they are stored, as COLMAP does: if your cameras are of the turned pictures, turn the files themselves",
            subject, len(turned), turned[0].name,
        )  # fmt: skip
    return [view for _, view in pairs]


def _named(files: Sequence[Path]) -> str:
    """The first names of a list of files."""
    return first_of([file.name for file in files])


def _without_blank(developed: Sequence[tuple[Photograph, View | None]], subject: str) -> list[Pair]:
    pairs = [(photograph, view) for photograph, view in developed if view is not None]
    if blank := [photograph.image for photograph, view in developed if view is None]:
        if len(pairs) < max(2, len(blank)):
            raise AssetError(
                subject, f"has {len(blank)} images that are {_BLANK} ({_named(blank)})", "Export the photographs again"
            )
        logger.warning("%s: %d images are %s and left out: %s", subject, len(blank), _BLANK, _named(blank))
    return pairs


def _unmasked(pairs: list[Pair], test: bool, subject: str) -> list[Pair]:
    """Views without a mask among more that have one; where they are not fewer, the others lose theirs."""
    group = [pair for pair in pairs if pair[1].test == test]
    without = [pair for pair in group if pair[1].mask is None]
    if len(without) in (0, len(group)):
        return []
    fewer = 2 * len(without) < len(group)
    logger.warning(
        "%s: %d of %d photographs have no mask (%s): %s",
        subject, len(without), len(group), _named([photograph.image for photograph, _ in without]),
        "left out. Draw their masks to use them" if fewer else "the masks of the others are not used. Draw all or none",
    )  # fmt: skip
    if fewer:
        return without
    for _, view in group:
        view.set_mask(None)
    return []


def _empty(pairs: list[Pair], subject: str) -> list[Pair]:
    """Views whose mask has nothing of the object, unless that is all of them."""
    masked = [pair for pair in pairs if pair[1].mask is not None]
    empty = [pair for pair in masked if pair[1].mask.max() < 0.5]  # type: ignore[union-attr]
    if len(empty) in (0, len(masked)):
        return []
    files = [photograph.mask or photograph.image for photograph, _ in empty]
    logger.warning(
        "%s: %d of %d masks are empty, and their photographs left out: %s. Draw these masks again, or take the "
        "photographs out", subject, len(empty), len(masked), _named(files),
    )  # fmt: skip
    return empty
