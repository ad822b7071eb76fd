"""What artists expect: docs/expectations.md, counted by the tests that it names.

    python bench/bench_expectations.py

Tests of tests/blender run in .venv-blender (or what `DRGS_BLENDER` names), those in another Blender in
.venv-blender-5.2 and so on where there is one, tests of tests/ui where `DRGS_UI_BLENDER` names a Blender with a
window, all others in .venv. What does not run, or skips, is named.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as xml
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from report import ROOT, table, write_section

sys.path.insert(0, str(ROOT / "tools"))
import environments

PAGE = ROOT / "docs" / "expectations.md"
IMPORTANCE = ("high", "mid", "low")
THERE = ("yes", "partly", "no")
MET, PARTLY, MISSING, FAILED, NOT_RUN = "met", "partly", "missing", "failed", "not run"
TEST = re.compile(r"`(tests/[\w/]+\.py::\w+(?:\[[^`]*\])?)`(?: in (\d\.\d))?")


class Test(NamedTuple):
    """A test's node id, and the series of Blender where it is not the main one."""

    name: str
    blender: str


class Expectation(NamedTuple):
    """A row of the page; `held` is its last cell, `tests` those that it names."""

    text: str
    importance: str
    there: str
    held: str
    tests: tuple[Test, ...]


def read(page: str) -> list[Expectation]:
    """The rows of the page's table."""
    rows = [line[2:-2].split(" | ") for line in page.splitlines() if line.startswith("| ")][1:]
    return [Expectation(*cells, tuple(Test(*found) for found in TEST.findall(cells[3]))) for cells in rows]


def suite(test: Test) -> tuple[Path, str] | None:
    """The interpreter that runs a test, and the folder of those beside it; None where there is no such interpreter."""
    folder = test.name.split("/")[1]
    if folder == "blender":
        python = environments.python_of(ROOT / f".venv-blender-{test.blender}")
        python = python if test.blender else environments.blender()
    elif folder == "ui" and not os.environ.get("DRGS_UI_BLENDER"):
        return None
    else:
        python = environments.python_of(environments.ENGINE)
    return (python, "engine" if folder == "unit" else folder) if python.is_file() else None


def run(python: Path, names: Iterable[str], root: Path = ROOT) -> dict[str, str]:
    """What came out of each test: MET, FAILED (in a case, or because it is not there), NOT_RUN (it skips)."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        subprocess.run([python, "-m", "pytest", "-q", f"--junitxml={report}", *names], cwd=root)
        cases = list(xml.parse(report).iter("testcase")) if report.is_file() else []
    found = {}
    for name in names:
        file, _, function = name.partition("::")
        module = file.removesuffix(".py").replace("/", ".")
        own = [c for c in cases if c.get("classname") == module and _is_case(c.get("name", ""), function)]
        kept = [c for c in own if c.find("skipped") is None]
        bad = [c for c in own if c.find("failure") is not None or c.find("error") is not None]
        found[name] = FAILED if bad or not own else MET if kept else NOT_RUN
    return found


def _is_case(name: str, function: str) -> bool:
    return name == function or name.startswith(f"{function}[")


def verdict(row: Expectation, outcomes: Mapping[Test, str]) -> str:
    """Whether an expectation is met: by the page, where its tests ran and passed."""
    if row.there == "no":
        return MISSING
    own = {outcomes[test] for test in row.tests}
    return next((bad for bad in (FAILED, NOT_RUN) if bad in own), MET if row.there == "yes" else PARTLY)


def summary(rows: list[Expectation], outcomes: Mapping[Test, str]) -> str:
    """Counts by importance, and the names of what is not met."""
    states = [(row, verdict(row, outcomes)) for row in rows]
    kinds = (MET, PARTLY, MISSING, FAILED, NOT_RUN)
    lines = []
    for importance in IMPORTANCE:
        own = [state for row, state in states if row.importance == importance]
        lines.append([importance, len(own), *(own.count(kind) for kind in kinds)])
    body = table(["Missed without", "expectations", "met", "partly", "missing", "test failed", "not tried here"], lines)
    others = [state for row, state in states if row.importance not in IMPORTANCE]
    body += f"\n\nOf {len(others)} that go without saying {others.count(MET)} are met."
    for kind in (MISSING, PARTLY):
        for importance in IMPORTANCE:
            if names := [row.text for row, state in states if (row.importance, state) == (importance, kind)]:
                body += f"\n\n{kind.capitalize()}, {importance}: {'; '.join(names)}."
    for kind in (FAILED, NOT_RUN):
        if names := [f"`{t.name}`{f' in {t.blender}' if t.blender else ''}" for t, o in outcomes.items() if o == kind]:
            body += f"\n\nTests that {'failed' if kind == FAILED else 'did not run'}: {', '.join(sorted(names))}."
    return body


def main() -> int:
    """Run the tests and write the section."""
    rows, begun = read(PAGE.read_text(encoding="utf-8")), time.monotonic()
    outcomes = {test: NOT_RUN for row in rows for test in row.tests}
    suites: dict[tuple[Path, str], list[Test]] = {}
    for test in outcomes:
        if (found := suite(test)) is not None:
            suites.setdefault(found, []).append(test)
    for (python, _), tests in suites.items():
        results = run(python, [test.name for test in tests])
        outcomes.update({test: results[test.name] for test in tests})
    body = (
        f"The [{len(rows)} expectations](expectations.md) by how much they are missed where they are not there. One is "
        "met where all its tests pass; what is missing or partly there says on that page what to do instead.\n\n"
        + summary(rows, outcomes)
        + f"\n\n{sum(o != NOT_RUN for o in outcomes.values())} tests in {(time.monotonic() - begun) / 60:.0f} minutes."
    )
    write_section("expectations", "What artists expect", body)
    return 1 if FAILED in outcomes.values() else 0


if __name__ == "__main__":
    sys.exit(main())
