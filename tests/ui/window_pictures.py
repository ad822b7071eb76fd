"""Pictures of Blender's window for the guide, taken anew.

    DRGS_UI_BLENDER="path/to/blender" .venv/bin/python tests/ui/window_pictures.py

Writes docs/images/guide-*.png.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import window
from PIL import Image


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        seen = window.run("pictures_job.py", Path(folder))
    if "error" in seen.result:
        print(seen.result["error"], file=sys.stderr)
        return 1
    for name, box in seen.result["boxes"].items():
        with Image.open(seen.pictures / f"{name}.png") as image:
            whole = image.convert("RGB")
        kept = whole.crop(box) if box else whole
        path = window.ROOT / "docs" / "images" / f"{name}.png"
        # Colours of a window are few: a palette halves the file.
        kept.quantize(256, dither=Image.Dither.NONE if box else Image.Dither.FLOYDSTEINBERG).save(path, optimize=True)
        print(path, kept.size, path.stat().st_size)
    return 0


if __name__ == "__main__":
    sys.exit(main())
