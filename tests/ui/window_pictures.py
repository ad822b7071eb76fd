"""Pictures of Blender's window for the guide, taken anew.

    DRGS_UI_BLENDER="path/to/blender" .venv/bin/python tests/ui/window_pictures.py

Writes docs/images/guide-*.png, those of pictured.py, or of them the ones that are named: `guide-clean guide-farm`.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
import window
from PIL import Image

#: Pixels that are kept around what is drawn, colours of a picture of panels, and what the gaps between editors reach.
MARGIN, COLOURS, BLACK = 6, 64, 22


def drawn(image: Image.Image) -> Image.Image:
    """The part of a region in which something is drawn: where it differs from its lowest row, without black edges."""
    dark = np.asarray(image).max(axis=2) < BLACK
    ys, xs = (np.flatnonzero(dark.mean(axis=axis) < 0.9) for axis in (1, 0))
    image = image.crop((xs[0], ys[0], xs[-1] + 1, ys[-1] + 1))
    pixels = np.asarray(image, np.int16)
    differs = np.abs(pixels - np.median(pixels[-1], axis=0)).max(axis=2) > 6
    ys, xs = np.flatnonzero(differs.any(axis=1)), np.flatnonzero(differs.any(axis=0))
    if not len(ys):
        raise ValueError("nothing is drawn in it")
    right, bottom = min(xs[-1] + 1 + MARGIN, image.width), min(ys[-1] + 1 + MARGIN, image.height)
    return image.crop((max(xs[0] - MARGIN, 0), max(ys[0] - MARGIN, 0), right, bottom))


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        seen = window.run("pictures_job.py", Path(folder), DRGS_WINDOW_PICTURES=" ".join(sys.argv[1:]))
    for name, box in seen.result["boxes"].items():
        with Image.open(seen.pictures / f"{name}.png") as image:
            whole = image.convert("RGB")
        kept = whole.crop(box) if box else whole
        if box and name != "guide-surfels":
            kept = drawn(kept)
        path = window.ROOT / "docs" / "images" / f"{name}.png"
        # Colours of a window are few: a palette halves the file.
        kept = kept.quantize(COLOURS, dither=Image.Dither.NONE) if box else kept.quantize(256)
        kept.save(path, optimize=True)
        print(path, kept.size, path.stat().st_size)
    if "error" in seen.result:
        print(seen.result["error"], file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
