"""A figure that a page quotes with a link to a section of the benchmarks is in that section."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from itertools import permutations
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "tools"))

import plots  # noqa: E402

NUMBER = r"(?<![\w.])[-−]?(?:\d[\d,]*)?\.?\d+(?![\w])"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def sections() -> dict[str, str]:
    """Text of the benchmarks below each heading, by the name that links have."""
    text = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    text = re.sub(r"^`.*` · \d{4}-\d\d-\d\d · .*$", "", text, flags=re.MULTILINE)  # command, date, machine
    parts = re.split(r"^## (.+)\n", text, flags=re.MULTILINE)
    names = (re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in parts[1::2])
    return dict(zip(names, parts[2::2], strict=True))


def quotations() -> Iterator[tuple[str, str, str]]:
    """(page, section, number) of every number that is the text of a link to a section."""
    for page in PAGES:
        for said, section in re.findall(
            r"\[([^\]]+)\]\([^)\s]*benchmarks\.md#([^)]+)\)", page.read_text(encoding="utf-8")
        ):
            for number in re.findall(NUMBER, said):
                yield page.relative_to(ROOT).as_posix(), section, number


def is_in(said: str, section: str) -> bool:
    """Whether a number is in a section, as it is rounded; with a sign it may be the step from one row to another."""
    value = float(said.replace(",", "").replace("−", "-"))
    half = 0.5 * 10.0 ** -len(said.partition(".")[2]) + 1e-9
    there = [float(n.replace(",", "").replace("−", "-")) for n in re.findall(NUMBER, section)]
    if any(abs(value - number) <= half for number in there):
        return True
    steps = (
        a - b
        for table in plots.tables(section)
        for column in zip(*table.rows, strict=True)
        for a, b in permutations([n for cell in column for n in plots.numbers(cell)[:1]], 2)
    )
    return said[0] in "-−" and any(abs(value - step) <= half for step in steps)


QUOTATIONS = list(quotations())
SECTIONS = sections()


@pytest.mark.parametrize(("page", "section", "number"), QUOTATIONS)
def test_quoted_figures_are_those_of_the_benchmarks(page: str, section: str, number: str) -> None:
    assert is_in(number, SECTIONS[section])


def test_there_are_quotations_and_a_wrong_one_is_seen() -> None:
    assert {page for page, _, _ in QUOTATIONS} >= {"README.md", "docs/paper.md"}
    section = "Median **8.0**.\n\n| a | dB |\n|---|---|\n| with | 31.25 |\n| without | 29.1 |\n"
    assert all(is_in(number, section) for number in ("8", "31.2", "31.3", "-2.1", "-2.2"))
    assert not any(is_in(number, section) for number in ("7", "32", "30.0", "2.2", "-2.4"))
