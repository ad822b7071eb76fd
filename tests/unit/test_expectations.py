"""docs/expectations.md: what it names exists, and what is not there says what to do instead."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "bench"))

import bench_expectations as bench  # noqa: E402

ROWS = bench.read(bench.PAGE.read_text(encoding="utf-8"))


def anchors(page: Path) -> set[str]:
    """Headings of a page, as links name them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


def broken_links(text: str, folder: Path) -> Iterator[str]:
    for link in re.findall(r"\]\(([^)]+)\)", text):
        name, _, anchor = link.partition("#")
        if not (folder / name).is_file() or (anchor and anchor not in anchors(folder / name)):
            yield link


def faults(row: bench.Expectation) -> Iterator[str]:
    """What is wrong with a row."""
    if row.importance not in (*bench.IMPORTANCE, "-") or row.there not in bench.THERE:
        yield f"{row.importance} / {row.there}"
    if row.there == "yes" and not row.tests:
        yield "no test holds it"
    if row.there != "yes" and not re.search(r"\b[Ii]nstead: .*\]\(", row.held):
        yield "does not say what to do instead, with a link"
    if row.held.count("::") != len(row.tests):
        yield "names tests in another form"
    yield from broken_links(row.held, bench.PAGE.parent)
    for test in row.tests:
        path, _, name = test.name.partition("::")
        tree = ast.parse((ROOT / path).read_text(encoding="utf-8")) if (ROOT / path).is_file() else ast.Module([], [])
        if name.partition("[")[0] not in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}:
            yield f"{test.name} does not exist"


def test_rows_are_sound_and_none_is_there_twice() -> None:
    found = {row.text: list(faults(row)) for row in ROWS}
    assert len(ROWS) > 60 and len(found) == len(ROWS)
    assert not any(found.values()), {text: wrong for text, wrong in found.items() if wrong}


def test_what_is_missing_links_to_the_guide() -> None:
    """What is missed much is named where users look for it."""
    missing = [row for row in ROWS if row.importance == "mid" and row.there == "no"]
    assert missing and not [row.text for row in missing if "user-guide.md#what-is-missing" not in row.held]


@pytest.mark.parametrize(
    ("held", "there", "fault"),
    [
        ("`tests/unit/test_expectations.py::test_of_nothing`", "yes", "test_of_nothing does not exist"),
        ("`tests/unit/test_of_nothing.py::test_it`", "yes", "test_it does not exist"),
        ("", "yes", "no test holds it"),
        ("`tests/unit/test_expectations.py::TestIt::test_it`", "yes", "another form"),
        ("Instead: nothing", "no", "with a link"),
        ("Instead: [this](user-guide.md#nowhere)", "no", "nowhere"),
        ("Instead: [this](nowhere.md)", "partly", "nowhere"),
        ("Instead: [this](user-guide.md)", "perhaps", "perhaps"),
    ],
)
def test_faults_are_found(held: str, there: str, fault: str) -> None:
    (row,) = bench.read(f"| head | a | b | c |\n|---|---|---|---|\n| It works | high | {there} | {held} |\n")
    assert any(fault in found for found in faults(row))


def test_verdicts() -> None:
    """Met where all tests pass; a failed test counts more than one that did not run, and both more than the page."""
    one, other = bench.Test("tests/unit/test_a.py::test_one", ""), bench.Test("tests/unit/test_a.py::test_other", "")

    def verdict(there: str, first: str, second: str) -> str:
        return bench.verdict(bench.Expectation("", "high", there, "", (one, other)), {one: first, other: second})

    assert verdict("yes", bench.MET, bench.MET) == bench.MET
    assert verdict("partly", bench.MET, bench.MET) == bench.PARTLY
    assert verdict("yes", bench.NOT_RUN, bench.MET) == bench.NOT_RUN
    assert verdict("partly", bench.NOT_RUN, bench.FAILED) == bench.FAILED
    assert verdict("no", bench.MET, bench.MET) == bench.MISSING


def test_tests_are_run_and_what_skips_is_not_met(tmp_path: Path) -> None:
    """Tests in a process of their own: one passes, one fails in a case, one skips, and none stands for another."""
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    (tmp_path / "tests/unit").mkdir(parents=True)
    (tmp_path / "tests/unit/test_them.py").write_text(
        "import pytest\n"
        "def test_good(): pass\n"
        "def test_good_too(): assert False\n"
        "@pytest.mark.parametrize('n', [0, 1])\ndef test_bad(n): assert n\n"
        "def test_absent(): pytest.skip('no such thing here')\n"
    )
    good, too, bad, case, absent = (
        f"tests/unit/test_them.py::test_{name}" for name in ("good", "good_too", "bad", "bad[1]", "absent")
    )
    python = Path(sys.executable)
    found = bench.run(python, [good, too, bad, absent], tmp_path)
    assert found == {good: bench.MET, too: bench.FAILED, bad: bench.FAILED, absent: bench.NOT_RUN}
    assert bench.run(python, [case], tmp_path) == {case: bench.MET}
    nowhere = "tests/unit/test_them.py::test_nowhere"
    assert bench.run(python, [nowhere], tmp_path) == {nowhere: bench.FAILED}
