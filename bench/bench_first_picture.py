"""From the start of Blender with the extension to the first relit picture of a file, in a window, by clicks and keys.

    DRGS_UI_BLENDER="path/to/blender" python bench/bench_first_picture.py

Runs the job of tests/ui/test_first_picture.py with a mesh and a capture, in a fresh profile without network, and keeps
what other Blenders took. The engine is that of this Python, with its kernels compiled, as a zip brings them.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from report import OUT, ROOT, store_row, table, write_section

sys.path.insert(0, str(ROOT / "tests" / "ui"))
import window

FILES = ROOT / "examples/cat/egyptian_cat.glb", ROOT / "examples/playbot/playbot.ply"
#: Most clicks and keys, and seconds to the first pixels.
GOALS = 8, 30


def measure(file: Path) -> list[object]:
    """Blender, file, clicks and seconds, and what was clicked."""
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as name:
        copy = shutil.copy(file, name)
        found = window.run("first_picture_job.py", Path(name), DRGS_WINDOW_FILE=str(copy)).result
    if "error" in found:
        raise SystemExit(found["error"])
    seconds = found["seconds"]
    shown = [seconds["object"], seconds["first pixels"], seconds["all samples"]]
    clicks = found["done"]
    return [found["blender"], file.name, len(clicks), *shown, shown[0] + shown[1], load, ", ".join(clicks)]


def main() -> None:
    """Measure and write the section."""
    subprocess.run([sys.executable, "-m", "drgs_blender.compute.prepare", "--all"], check=True, capture_output=True)
    os.environ["DRGS_ENGINE"] = sys.executable
    for file in FILES:
        row = measure(file)
        kept = store_row(OUT / "first_picture.json", f"{row[0]} {row[1]}", row)
    rows = [row[:-1] for _, row in sorted(kept.items())]
    columns = ("Blender", "File", "Clicks and keys", "Object, s", "First pixels, s", "All samples, s",
               "File to pixels, s", "Load")  # fmt: skip
    write_section(
        "first-picture",
        "The first picture by clicks",
        f"From the start of Blender with the installed extension: {row[-1]}. Goals: {GOALS[0]} clicks and keys, "
        f"{GOALS[1]} s. Seconds are those of Blender and the engine: from the choice of the file to the object, whose "
        "asset is made meanwhile, and from *Show Rendered* to the first pixels and to all samples of the viewport in a "
        "window of 1280 x 800, drawn without a graphics card. Load: the machine's, by other programs, before each.\n\n"
        + table(columns, rows),
    )


if __name__ == "__main__":
    main()
