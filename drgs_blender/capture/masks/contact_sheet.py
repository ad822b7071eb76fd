"""A picture of all masks over their photographs, doubtful ones framed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image as Pillow
from PIL import ImageDraw

from ...core.arrays import Array
from ...formats.images import write_image
from .hull_check import Fit
from .mask_view import MaskView

#: Pixels of a cell, cells in a row; colours of good and doubtful masks.
_CELL, _ROW = (240, 200), 6
_GOOD, _DOUBTFUL = (40, 160, 60), (220, 60, 30)


def draw_contact_sheet(path: Path, views: Sequence[MaskView], masks: Sequence[Array], fits: Sequence[Fit]) -> None:
    """Write a PNG: per view the object in colour, the rest faded, with its name and figures."""
    width, height = _CELL
    rows = -(-len(views) // _ROW)
    page = Pillow.new("RGB", (_ROW * width, rows * height), "white")
    draw = ImageDraw.Draw(page)
    for k, (view, mask, fit) in enumerate(zip(views, masks, fits, strict=True)):
        left, top = k % _ROW * width, k // _ROW * height
        faded = np.where(mask[..., None], view.pixels, 160 + view.pixels // 3).astype(np.uint8)
        small = Pillow.fromarray(faded)
        small.thumbnail((width - 8, height - 24))
        page.paste(small, (left + 4, top + 20))
        colour = _DOUBTFUL if fit.doubtful else _GOOD
        draw.rectangle((left + 1, top + 1, left + width - 2, top + height - 2), outline=colour, width=2)
        text = f"{fit.name[:22]}  +{fit.outside:.0%} -{fit.missing:.0%}"
        draw.text((left + 6, top + 5), text, fill=colour)
    write_image(path, page)
