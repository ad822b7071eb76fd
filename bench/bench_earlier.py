"""Benchmarks of an earlier commit and of this one, in turn: what a change costs where it should cost nothing.

    python bench/bench_earlier.py COMMIT ["frame" "deform" "simulate --part throughput" ...] [--pairs 3]

Each is a program's name with its options. It runs in a clone of either commit, in an environment with this one's
packages, and writes the clone's own docs/benchmarks.md; the first numbers of the lines of its tables are compared, one
line after the other. Needs `make env`; `viewport` needs DRGS_UI_BLENDER.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from report import ROOT, table, write_section

sys.path.insert(0, str(ROOT / "tools"))
from environments import blender, borrowing

PROGRAMS = ("frame", "deform", "simulate --part throughput")
COLUMNS = ["benchmark", "line", "earlier", "now", "now / earlier", "least and most"]
Lines = dict[str, float]


class Checkout:
    """A clone of one commit, and how its programs are run.

    Parameters
    ----------
    commit : str
    folder : Path
        Does not exist yet.
    """

    def __init__(self, commit: str, folder: Path) -> None:
        self.root = folder / "checkout"
        subprocess.run(["git", "clone", "--quiet", "--shared", "--no-checkout", ROOT, self.root], check=True)
        subprocess.run(["git", "-C", self.root, "checkout", "--quiet", "--detach", commit], check=True)
        if (ROOT.parent / "shared").is_dir():
            (folder / "shared").symlink_to(ROOT.parent / "shared")
        (self.root / ".venv-blender").symlink_to(blender().parent.parent)
        python, _ = borrowing(folder / "environment", self.root)
        self._python = python
        own = {"PYTHONPATH": str(self.root), "DRGS_ENGINE": str(python), "DRGS_SHIPPED": "0"}
        self._environment = os.environ | own | {"DRGS_CACHE_DIR": str(folder / "kernels")}

    def lines(self, program: str) -> Lines:
        """Run a benchmark: the first number of each line of the tables that it writes, by the line's first cell."""
        name, *options = shlex.split(program)
        document = self.root / "docs" / "benchmarks.md"
        document.unlink(missing_ok=True)
        command = [self._python, f"bench/bench_{name}.py", *options]
        done = subprocess.run(command, cwd=self.root, env=self._environment, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"{program} of {self.root} failed:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
        found: Lines = {}
        for line in document.read_text(encoding="utf-8").splitlines():
            name, *cells = [cell.strip() for cell in line.strip("|").split("|")]
            numbers = [float(cell) for cell in cells if re.fullmatch(r"[\d.]+(e[-+]\d+)?", cell)]
            if line.startswith("|") and numbers:
                found[name if name not in found else f"{name} ({len(found)})"] = numbers[0]
        return found


def compare(program: str, earlier: Checkout, now: Checkout, pairs: int) -> list[list[object]]:
    """Rows of `COLUMNS` of a program; the first run of either compiles and is not counted."""
    for checkout in (earlier, now):
        checkout.lines(program)
    runs = [(earlier.lines(program), now.lines(program)) for _ in range(pairs)]
    if len({len(found) for pair in runs for found in pair}) > 1:
        raise SystemExit(f"{program} has other lines now than it had: its commits cannot be compared")
    rows: list[list[object]] = []
    for number, line in enumerate(runs[0][1]):
        before, after = ([list(found.values())[number] for found in column] for column in zip(*runs, strict=True))
        if any(before):
            ratios = [b / a for a, b in zip(before, after, strict=True) if a]
            median = [statistics.median(values) for values in (before, after, ratios)]
            rows.append([program, line, *median, f"{min(ratios):.2f} to {max(ratios):.2f}"])
    return rows


def main() -> None:
    """Measure and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commit", help="the earlier one")
    parser.add_argument("programs", nargs="*", metavar="PROGRAM", help=f"by default: {', '.join(PROGRAMS)}")
    parser.add_argument("--pairs", type=int, default=3, help="runs of either that count")
    options = parser.parse_args()
    rows: list[list[object]] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in ("earlier", "now"):
            (folder / part).mkdir()
        earlier, now = Checkout(options.commit, folder / "earlier"), Checkout("HEAD", folder / "now")
        for program in options.programs or PROGRAMS:
            rows += compare(program, earlier, now, options.pairs)
            body = (
                f"The same programs of commit {options.commit} and of this one in turn, {options.pairs} pairs after "
                "one that compiles: medians, and the ratio of each pair. Lines are milliseconds, seconds or rates, as "
                "in the program's own section.\n\n"
            )
            write_section("earlier", "Against an earlier commit", body + table(COLUMNS, rows))


if __name__ == "__main__":
    main()
