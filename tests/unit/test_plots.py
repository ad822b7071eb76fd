"""Plots of the site show the numbers of the tables above them."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "tools"))

import plots  # noqa: E402

PAGE = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8")
PLOTS = plots.PLOTS
TABLE = """<!-- begin frame -->
| Frame | Seconds |
|---|---|
| ours | 1.5 |
| theirs | 6 |
| held to | |
<!-- end frame -->
"""


def drawn(page: str, monkeypatch: pytest.MonkeyPatch, section: str) -> list[ElementTree.Element]:
    """The plots of one section."""
    monkeypatch.setattr(plots, "PLOTS", {section: PLOTS[section]})
    return [ElementTree.fromstring(svg) for svg in re.findall(r"<svg.*?</svg>", plots.with_plots(page))]


def parts(svg: ElementTree.Element, tag: str) -> list[ElementTree.Element]:
    return svg.findall(f"{{http://www.w3.org/2000/svg}}{tag}")


@pytest.mark.parametrize("section", PLOTS)
def test_the_page_has_what_is_plotted(section: str, monkeypatch: pytest.MonkeyPatch) -> None:
    found = drawn(PAGE, monkeypatch, section)
    assert found
    for svg in found:
        width, height = (float(svg.get(side)) for side in ("width", "height"))
        assert svg.get("aria-label") and parts(svg, "circle") + parts(svg, "rect")
        for circle in parts(svg, "circle"):
            assert 0 < float(circle.get("cx")) < width and 0 < float(circle.get("cy")) < height
        for bar in parts(svg, "rect"):
            assert float(bar.get("x")) + float(bar.get("width")) < width and float(bar.get("y")) < height


def test_bars_are_as_long_as_the_numbers_and_rows_without_one_have_none(monkeypatch: pytest.MonkeyPatch) -> None:
    (svg,) = drawn(TABLE, monkeypatch, "frame")
    short, long = (float(bar.get("width")) for bar in parts(svg, "rect"))
    assert long == pytest.approx(4 * short, abs=0.5)
    assert {"ours", "theirs", "1.5", "6"} < {text.text for text in parts(svg, "text")}


def test_lines_go_through_the_numbers_of_the_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    head = "| Subject | ours dB | ours s | Cycles dB | Cycles s |\n|---|---|---|---|---|\n"
    row = "| cat | 20 / 40 | 0.1 / 1 | 20 / 30 | 1 / 10 |\n"
    page = f"<!-- begin light-mitsuba -->\n{head}{row}<!-- end light-mitsuba -->"
    (svg,) = drawn(page, monkeypatch, "light-mitsuba")
    places = [(float(circle.get("cx")), float(circle.get("cy"))) for circle in parts(svg, "circle")]
    (a, low), (b, high), (c, low_again), (d, middle) = places
    assert b - a == pytest.approx(d - c, abs=0.2) and c == b  # ten times the time, wherever on the axis
    assert low_again == low and middle == pytest.approx((low + high) / 2, abs=0.2)


def test_a_table_that_is_not_there_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(plots.PlotError, match="no section frame"):
        drawn("", monkeypatch, "frame")
    with pytest.raises(plots.PlotError, match="the section frame has no table"):
        drawn(TABLE.replace("Seconds", "Minutes"), monkeypatch, "frame")
    with pytest.raises(plots.PlotError, match="no column ours s"):
        drawn(TABLE.replace("Seconds", "ours dB").replace("frame", "light-mitsuba"), monkeypatch, "light-mitsuba")


@pytest.mark.parametrize("logarithmic", (False, True))
@pytest.mark.parametrize(("low", "high"), ((0.03, 0.9), (17.0, 52.5), (3.0, 3.0), (1e6, 5e6)))
def test_an_axis_holds_its_numbers_between_few_round_ones(low: float, high: float, logarithmic: bool) -> None:
    marks = plots.ticks(low, high, logarithmic)
    assert marks[0] <= low <= high <= marks[-1] and 2 <= len(marks) <= 9 and marks == sorted(set(marks))
