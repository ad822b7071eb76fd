"""Plots beside tables of docs/benchmarks.md, drawn from the tables' own numbers when the site is built.

So a plot never disagrees with its table, and measuring again is enough to draw it again. Standard library only.
"""

from __future__ import annotations

import html
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

#: Okabe and Ito's colours, which all kinds of eyes tell apart, on white and on black.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
#: Size of a plot in pixels, what is left around it for numbers and legend, and the height of a bar.
WIDTH, HEIGHT = 680, 340
LEFT, RIGHT, TOP, BOTTOM = 62, 190, 28, 44
BAR, LABEL = 15, 235
NUMBER = r"\d[\d,]*(?:\.\d+)?"


class PlotError(Exception):
    """A table has not what is to be drawn of it."""


@dataclass(frozen=True)
class Table:
    """A table of a page: its head, its rows, and where it ends in the text."""

    head: list[str]
    rows: list[list[str]]
    end: int

    def column(self, name: str) -> int:
        """Place of a column; PlotError where there is none."""
        if name not in self.head:
            raise PlotError(f"a table has no column {name}, but {', '.join(self.head)}")
        return self.head.index(name)


@dataclass(frozen=True)
class Series:
    """Numbers of one line, or of the bars of one colour: what they are called, pairs of x and y, and the look."""

    name: str
    points: list[tuple[float, float]]
    colour: str
    dashed: bool = False


@dataclass(frozen=True)
class Chart:
    """What is drawn: lines over numbers, or, where there are `labels`, bars at each."""

    title: str
    y: str
    series: list[Series]
    x: str = ""
    logarithmic: tuple[bool, bool] = (False, False)
    labels: list[str] = field(default_factory=list)


def numbers(cell: str) -> list[float]:
    """The numbers of a cell: `31.7 / 39.6`, `81,920 triangles`."""
    return [float(found.replace(",", "")) for found in re.findall(NUMBER, cell)]


def tables(text: str) -> Iterator[Table]:
    """The tables of a text."""
    for found in re.finditer(r"^\|.*\|\n\|[-| ]+\|\n((?:\|.*\|\n)+)", text, re.MULTILINE):
        head, _, *rows = ([cell.strip() for cell in line.strip("|").split("|")] for line in found[0].splitlines())
        yield Table(head, rows, found.end())


# What is drawn of which section


def equal_error(table: Table) -> Chart | None:
    """Error over time of two programs, a colour for each subject."""
    programs = [name.removesuffix(" dB") for name in table.head if name.endswith(" dB") and name[0].isalpha()]
    if not programs:
        return None
    lines = []
    for row, colour in zip(table.rows, COLOURS):
        for number, program in enumerate(programs):
            points = zip(numbers(row[table.column(f"{program} s")]), numbers(row[table.column(f"{program} dB")]))
            lines.append(Series(f"{row[0]}, {program}", list(points), colour, dashed=number > 0))
    title = f"Time against error: {' (solid) and '.join(programs)} (dashed)"
    return Chart(title, "PSNR, dB", lines, "seconds, set-up included", (True, False))


def bars(title: str, unit: str, *columns: str, only: str = "") -> Callable[[Table], Chart | None]:
    """Bars of columns, one or several for each row (that has `only` in a cell)."""

    def draw(table: Table) -> Chart | None:
        if columns[0] not in table.head:
            return None
        rows = [row for row in table.rows if (not only or only in row) and numbers(row[table.column(columns[0])][:1])]
        made = []
        for name, colour in zip(columns, COLOURS):
            values = [(float(i), numbers(row[table.column(name)])[0]) for i, row in enumerate(rows)]
            made.append(Series(name, values, colour))
        return Chart(title, unit, made, labels=[row[0] for row in rows])

    return draw


def growth(title: str, x: str, y: str, row: str, *columns: str) -> Callable[[Table], Chart | None]:
    """Columns over the number in the first cell, of rows that have a cell which begins with `row`, a pattern."""

    def draw(table: Table) -> Chart | None:
        if columns[0] not in table.head:
            return None
        rows = [cells for cells in table.rows if any(re.match(row, cell) for cell in cells) and numbers(cells[0])]
        if len(rows) < 2:
            return None
        made = []
        for name, colour in zip(columns, COLOURS):
            points = [(numbers(cells[0])[0], numbers(cells[table.column(name)])[0]) for cells in rows]
            made.append(Series(name, points, colour))
        return Chart(title, y, made, x, (True, True))

    return draw


PLOTS: dict[str, Callable[[Table], Chart | None]] = {
    "frame": bars("Time of a frame", "seconds", "Seconds"),
    "scene": growth("Update of the traced scene", "triangles", "milliseconds", NUMBER + " triangles", "wall ms"),
    "light-equal-psnr": equal_error,
    "light-mitsuba": equal_error,
    "light-denoised": equal_error,
    "light-cost": growth("The integrator", "triangles", "seconds", f"integrator, {NUMBER} triangles", "Measured"),
    "formats": bars("Size of 1,000,000 splats", "MB", "MB", only="write"),
    "simulate-throughput": bars(
        "Simulated matter", "million particle steps a second", "M steps/s, one core", "M steps/s, 2 threads"
    ),
    "lod": growth(
        "Pictures while the view moves", "surfels", "pictures a second", "pictures a second, orbit", "Automatic", "Full"
    ),
}


def with_plots(text: str) -> str:
    """The page with a plot below each table of `PLOTS`.

    Raises
    ------
    PlotError
        A section is not there, or has no table of which the plot can be drawn.
    """
    for section, draw in PLOTS.items():
        found = re.search(rf"<!-- begin {section} -->\n(.*?)<!-- end {section} -->", text, re.DOTALL)
        if found is None:
            raise PlotError(f"there is no section {section}")
        part, drawn = found[1], 0
        for table in reversed(list(tables(part))):
            if (chart := draw(table)) is not None:
                figure = f'\n```{{raw}} html\n<div class="plot">{svg(chart)}</div>\n```\n'
                part, drawn = part[: table.end] + figure + part[table.end :], drawn + 1
        if not drawn:
            raise PlotError(f"the section {section} has no table to draw its plot of")
        text = text[: found.start(1)] + part + text[found.end(1) :]
    return text


# Drawing


def svg(chart: Chart) -> str:
    """A chart as SVG, in the colours of the text around it."""
    if not all(series.points for series in chart.series):
        raise PlotError(f"{chart.title}: there is nothing to draw")
    height, parts = _bars(chart) if chart.labels else (HEIGHT, _lines(chart))
    title = html.escape(chart.title)
    head = f'<svg xmlns="http://www.w3.org/2000/svg" role="img" aria-label="{title}" viewBox="0 0 {WIDTH} {height}"'
    style = f'width="{WIDTH}" height="{height}" fill="currentColor" font-family="sans-serif" font-size="12"'
    return "".join([f"{head} {style}>", _text(chart.title, LEFT, 16, weight="bold"), *parts, "</svg>"])


def _text(text: str, x: float, y: float, anchor: str = "start", weight: str = "normal", turn: int = 0) -> str:
    turned = f' transform="rotate({turn} {x:.1f} {y:.1f})"' if turn else ""
    look = f'text-anchor="{anchor}" font-weight="{weight}"'
    return f'<text x="{x:.1f}" y="{y:.1f}" {look}{turned}>{html.escape(text)}</text>'


def _line(points: Sequence[tuple[float, float]], colour: str, width: float, more: str = "") -> str:
    places = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polyline points="{places}" fill="none" stroke="{colour}" stroke-width="{width}"{more}/>'


def ticks(low: float, high: float, logarithmic: bool) -> list[float]:
    """Round numbers from below `low` to above `high`, at both ends of which an axis can end."""
    if logarithmic:
        exponents = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        every = [round(factor * 10.0**e, 12) for e in exponents for factor in (1, 2, 5)]
        first = max(i for i, mark in enumerate(every) if mark <= low)
        last = next(i for i, mark in enumerate(every) if mark >= high and i > first)
        return every[first : last + 1]
    step = 10.0 ** math.floor(math.log10((high - low) or high or 1.0))
    step = next(step * factor for factor in (0.2, 0.5, 1, 2) if (high - low) / (step * factor) <= 6)
    first = math.floor(low / step)
    return [step * i for i in range(first, max(math.ceil(high / step), first + 1) + 1)]


def _lines(chart: Chart) -> list[str]:
    parts = []
    scales = []
    for axis in (0, 1):
        values = [point[axis] for series in chart.series for point in series.points]
        marks = ticks(min(values), max(values), chart.logarithmic[axis])
        form = math.log10 if chart.logarithmic[axis] else float
        start, end = (LEFT, WIDTH - RIGHT) if axis == 0 else (HEIGHT - BOTTOM, TOP)
        scale = _scale(form, marks, start, end)
        scales.append(scale)
        for mark in marks:
            at = scale(mark)
            ends = [(at, HEIGHT - BOTTOM), (at, TOP)] if axis == 0 else [(LEFT, at), (WIDTH - RIGHT, at)]
            parts.append(_line(ends, "currentColor", 1, ' opacity="0.2"'))
            place = (at, HEIGHT - BOTTOM + 16, "middle") if axis == 0 else (LEFT - 6, at + 4, "end")
            parts.append(_text(f"{mark:,.10g}", *place))
    parts.append(_text(chart.x, (LEFT + WIDTH - RIGHT) / 2, HEIGHT - 8, "middle"))
    parts.append(_text(chart.y, 14, (TOP + HEIGHT - BOTTOM) / 2, "middle", turn=-90))
    for number, series in enumerate(chart.series):
        dash = ' stroke-dasharray="5 3"' if series.dashed else ""
        places = [(scales[0](x), scales[1](y)) for x, y in series.points]
        y = TOP + 10 + 20 * number
        parts.append(_line(places, series.colour, 2, dash))
        parts += [f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3" fill="{series.colour}"/>' for a, b in places]
        if len(chart.series) > 1:
            parts.append(_line([(WIDTH - RIGHT + 12, y), (WIDTH - RIGHT + 36, y)], series.colour, 2, dash))
            parts.append(_text(series.name, WIDTH - RIGHT + 42, y + 4))
    return parts


def _scale(form: Callable[[float], float], marks: list[float], start: float, end: float) -> Callable[[float], float]:
    low, high = form(marks[0]), form(marks[-1])
    return lambda value: start + (form(value) - low) / ((high - low) or 1.0) * (end - start)


def _bars(chart: Chart) -> tuple[int, list[str]]:
    """Height and parts of bars that lie, each with its number."""
    most = max(value for series in chart.series for _, value in series.points)
    group = BAR * len(chart.series) + 9
    parts = [_text(f"{chart.y}:", LABEL, TOP + 10)] if len(chart.series) < 2 else []
    legend = LABEL
    for series in chart.series if len(chart.series) > 1 else ():
        parts.append(f'<rect x="{legend}" y="{TOP + 1}" width="10" height="10" fill="{series.colour}"/>')
        parts.append(_text(series.name, legend + 15, TOP + 10))
        legend += 170
    for number, series in enumerate(chart.series):
        for i, value in series.points:
            y, wide = TOP + 20 + i * group + number * BAR, (WIDTH - LABEL - 60) * value / most
            parts.append(
                f'<rect x="{LABEL}" y="{y:.1f}" width="{wide:.1f}" height="{BAR - 2}" fill="{series.colour}"/>'
            )
            parts.append(_text(f"{value:,g}", LABEL + wide + 5, y + 11))
    for i, label in enumerate(chart.labels):
        parts.append(_text(label, LABEL - 8, TOP + 20 + i * group + BAR * len(chart.series) / 2 + 4, "end"))
    return TOP + 24 + group * len(chart.labels), parts
