"""Benchmarks of an earlier commit and of this one, in turn: what a change costs where it should cost nothing.

    python bench/bench_earlier.py COMMIT ["frame" "deform" "simulate --part throughput" ...] [--pairs 3]

Each is a program's name with its options. It runs in a clone of either commit, in an environment with this one's
packages, and writes the clone's own docs/benchmarks.md; the numbers of its tables are compared cell by cell. Those that
are the same in all runs, as counts and errors are, are left out, as are those that only one commit has. What is not
measured keeps its rows. Needs `make env`; `viewport` needs DRGS_UI_BLENDER.
"""

from __future__ import annotations

import argparse
import re
import shlex
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from checkouts import Checkout
from report import DOCUMENT, ROOT, section_pattern, table, write_section

PROGRAMS = ("frame", "deform", "simulate --part throughput")
COLUMNS = ["benchmark", "line", "column", "earlier", "now", "now / earlier", "quartiles"]
#: (line, column) of a table -> its number.
Cells = dict[tuple[str, str], float]


def cells(checkout: Checkout, program: str) -> Cells:
    """Run a benchmark of a checkout: the numbers in the tables that it writes."""
    name, *options = shlex.split(program)
    document = checkout.root / "docs" / "benchmarks.md"
    document.unlink(missing_ok=True)
    command = [checkout.python, f"bench/bench_{name}.py", *options]
    done = subprocess.run(command, cwd=checkout.root, env=checkout.environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{program} of {checkout.root} failed:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    found: Cells = {}
    columns: list[str] = []
    for line in document.read_text(encoding="utf-8").splitlines():
        parts = [part.strip() for part in line.strip("|").split("|")] if line.startswith("|") else []
        for column, part in zip(columns, parts, strict=False):
            if re.fullmatch(r"[\d.]+(e[-+]\d+)?", part):
                found[parts[0], column] = float(part)
        columns = columns or parts if parts else []
    return found


def compare(program: str, earlier: Checkout, now: Checkout, pairs: int) -> list[list[object]]:
    """Rows of `COLUMNS` of a program; the first run of either compiles and is not counted."""
    for checkout in (earlier, now):
        cells(checkout, program)
    runs = [(cells(earlier, program), cells(now, program)) for _ in range(pairs)]
    same = [cell for cell in runs[0][1] if all(cell in found for pair in runs for found in pair)]
    if not same:
        raise SystemExit(f"{program} has other tables now than it had: its commits cannot be compared")
    rows: list[list[object]] = []
    for cell in same:
        before, after = [old[cell] for old, _ in runs], [new[cell] for _, new in runs]
        if len({*before, *after}) > 1:
            ratios = np.array(after) / before
            low, high = np.quantile(ratios, [0.25, 0.75])
            medians = [float(np.median(values)) for values in (before, after, ratios)]
            rows.append([program, *cell, *medians, f"{low:.2f} to {high:.2f}"])
    return rows


def _section(commit: str) -> str:
    return f"earlier {commit}"


def measured_before(commit: str, document: str) -> list[list[object]]:
    """Rows of `COLUMNS` that docs/benchmarks.md has for the same commit."""
    section = section_pattern(_section(commit)).search(document)
    if section is None:
        return []
    lines = re.findall(r"^\| (.+) \|$", section[0], re.MULTILINE)
    return [list(line.split(" | ")) for line in lines[1:]]


def main() -> None:
    """Measure and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commit", help="the earlier one")
    parser.add_argument("programs", nargs="*", metavar="PROGRAM", help=f"by default: {', '.join(PROGRAMS)}")
    parser.add_argument("--pairs", type=int, default=3, help="runs of either that count")
    options = parser.parse_intermixed_args()
    asked = ["git", "rev-parse", "--short", options.commit]
    options.commit = subprocess.run(asked, cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()
    programs = options.programs or PROGRAMS
    before = measured_before(options.commit, DOCUMENT.read_text(encoding="utf-8"))
    rows = [row for row in before if row[0] not in programs]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        earlier, now = Checkout(options.commit, folder / "earlier"), Checkout("HEAD", folder / "now")
        for program in programs:
            rows += compare(program, earlier, now, options.pairs)
            body = (
                f"The same programs of commit {options.commit} and of this one in turn, {options.pairs} pairs (of the "
                "programs measured last) after one that compiles: medians, and the ratios of the pairs. Times and "
                "rates, as in the program's own section.\n\n"
            )
            write_section(_section(options.commit), f"Against commit {options.commit}", body + table(COLUMNS, rows))


if __name__ == "__main__":
    main()
