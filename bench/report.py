"""Where measured figures go: one section of docs/benchmarks.md a program, replaced each time it runs."""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import sys
from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
DOCUMENT = ROOT / "docs" / "benchmarks.md"
OUT = ROOT / "out" / "bench"
#: Pictures of pages, and where they go unless they are published.
IMAGES, GALLERY = ROOT / "docs" / "images", ROOT / "out" / "gallery"

HEADER = """# Benchmarks

Every figure here was measured by a program in `bench/`, which wrote its own section over the one before. `make bench`
runs them all, which takes many hours; in the commands below `python` is that of the checkout, `.venv/bin/python`. Some
need the development data, the folder that `DRGS_SHARED` names ([CONTRIBUTING](../CONTRIBUTING.md#variables)). Some
tables have a plot below them in the site that `make docs` builds, drawn from their numbers.
"""


def machine() -> str:
    """One line that names processor, core count, system and Python."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        found = re.search(r"model name\s*:\s*(.+)", cpuinfo.read_text())
        model = found.group(1) if found else model
    return f"{model}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}"


def processor_seconds(children: bool = False) -> float:
    """Seconds of processor time so far, of this process or of its children that have ended."""
    import resource  # not on Windows

    used = resource.getrusage(resource.RUSAGE_CHILDREN if children else resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def table(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A Markdown table; floats are shown with three significant figures, what kept rows have not as a dash."""

    def cell(value: object) -> str:
        if not isinstance(value, float):
            return str(value)
        return f"{value:.3g}" if abs(value) < 1e3 else f"{value:.0f}"

    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    whole = [[*map(cell, row), *"-" * (len(columns) - len(row))] for row in rows]
    lines += ["| " + " | ".join(row) + " |" for row in whole]
    return "\n".join(lines)


def command_line() -> str:
    """How this program was called, from the checkout's folder; where files of this machine lie is left out."""
    words = (f"/path/to/{Path(word).name}" if os.path.isabs(word) else word for word in sys.argv[1:])
    return " ".join(["python", f"bench/{Path(sys.argv[0]).name}", *words])


def store_row(file: Path, name: str, value: Any) -> dict[str, Any]:
    """Put what was measured to what `file` holds of earlier runs; all of it."""
    file.parent.mkdir(parents=True, exist_ok=True)
    rows: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {}
    rows[name] = value
    file.write_text(json.dumps(rows, indent=1))
    return rows


def add_publish(parser: argparse.ArgumentParser) -> None:
    """Declare ``--publish`` of programs that draw pictures of pages."""
    parser.add_argument("--publish", action="store_true", help="pictures go to docs/images, not to out/gallery")


def picture_path(name: str, options: argparse.Namespace) -> Path:
    """Where a picture of a page is written, which is said: out/gallery, with ``--publish`` docs/images."""
    folder = IMAGES if options.publish else GALLERY
    folder.mkdir(parents=True, exist_ok=True)
    print(f"writes {(folder / name).relative_to(ROOT)}", flush=True)
    return folder / name


def picture_grid(name: str, rows: Sequence[dict[str, Any]], options: argparse.Namespace) -> None:
    """Write a figure of pictures, (h, w, 3) in [0, 1], sRGB, by row and title, to `picture_path`."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, places = pyplot.subplots(len(rows), len(rows[0]), figsize=(9, 6.2), constrained_layout=True)
    for line, pictures in zip(places, rows, strict=True):
        for axes, (title, picture) in zip(line, pictures.items(), strict=True):
            axes.imshow(picture)
            axes.set_title(title, fontsize="small")
            axes.axis("off")
    figure.savefig(picture_path(name, options), dpi=100)
    pyplot.close(figure)


def section_pattern(name: str) -> re.Pattern[str]:
    """What finds section `name` in the text of docs/benchmarks.md."""
    return re.compile(f"<!-- begin {re.escape(name)} -->.*?<!-- end {re.escape(name)} -->", re.DOTALL)


def write_section(name: str, title: str, body: str) -> None:
    """Replace section `name` of docs/benchmarks.md (or append it) and print it."""
    text = DOCUMENT.read_text() if DOCUMENT.exists() else HEADER
    begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
    section = (
        f"{begin}\n## {title}\n\n{body.strip()}\n\n`{command_line()}` · {date.today().isoformat()} · {machine()}\n{end}"
    )
    pattern = section_pattern(name)
    if before := pattern.search(text):
        rows = [len(re.findall(r"^\|", part, re.MULTILINE)) for part in (before.group(), section)]
        if rows[1] < rows[0]:  # those that a program keeps from run to run in `OUT` are not in a fresh clone
            print(
                f"{name}: {rows[0] - rows[1]} lines of the table before are gone: `git diff` shows them",
                file=sys.stderr,
            )
        text = pattern.sub(lambda _: section, text)
    else:
        text = text.rstrip() + "\n\n" + section + "\n"
    DOCUMENT.write_text(text)
    print(section)
