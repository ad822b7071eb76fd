"""The table of all settings of a reconstruction, read from their dataclasses: names, limits, defaults, descriptions.

The command line, its files, the metadata of assets and the documentation all follow it. A name is that of the field,
after the stage's and a dot: "schedule.iterations"; settings of the run itself have no stage: "variant".
"""

from __future__ import annotations

import difflib
import inspect
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache
from typing import Any

from ..core.errors import UsageError, first_of
from .ranges import Allowed, allowed
from .settings import Reading, Settings

#: Stage -> what it is. The first, without a name, is the run; fields of `Settings`, but "capture", which is `Reading`.
STAGES = {
    "": "The run",
    "capture": "How photographs are read",
    "schedule": "Stage (i): surfels",
    "decoupling": "Stage (ii): materials and light",
}
#: What stands for None in files and on the command line, which have no word for it.
NONE = "none"


@dataclass(frozen=True, slots=True)
class Row:
    """One setting.

    Attributes
    ----------
    stage, field : str
    allowed : Allowed
    default : object
        A value as Python has it.
    about : str
        From the docstring.
    """

    stage: str
    field: str
    allowed: Allowed
    default: Any
    about: str

    @property
    def name(self) -> str:
        """As in "schedule.iterations"."""
        return f"{self.stage}.{self.field}" if self.stage else self.field


@cache
def table() -> dict[str, Row]:
    """Name -> row, stage by stage in the order of the fields."""
    rows = []
    for stage in STAGES:
        values = _part(Settings(), Reading(), stage)
        texts = descriptions(type(values))
        rules = allowed(type(values))
        rows += [Row(stage, name, rule, getattr(values, name), texts[name]) for name, rule in rules.items()]
    return {row.name: row for row in rows}


def _part(settings: Settings, reading: Reading, stage: str) -> Any:
    return reading if stage == "capture" else getattr(settings, stage) if stage else settings


def descriptions(settings: type) -> dict[str, str]:
    """Field of a dataclass -> what its numpydoc docstring says of it, in one line."""
    doc = inspect.getdoc(settings) or ""
    found: dict[str, list[str]] = {}
    names: list[str] = []
    for line in doc.partition("Attributes\n----------\n")[2].splitlines():
        if head := re.match(r"(\w[\w, ]*) : ", line):
            names = head[1].split(", ")
            found |= {name: [] for name in names}
        elif line.startswith(" "):
            for name in names:
                found[name].append(line.strip())
    return {name: " ".join(lines).replace("None:", f'"{NONE}":') for name, lines in found.items()}


def as_tables(settings: Settings, reading: Reading | None = None) -> dict[str, Any]:
    """All settings as JSON has them, those of a stage in a dict of its name; without `reading`, none of "capture"."""

    def plain(part: Any) -> dict[str, Any]:
        values = {field.name: getattr(part, field.name) for field in fields(part)}
        kept = {name: value for name, value in values.items() if not is_dataclass(value)}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in kept.items()}

    stages = [stage for stage in STAGES if stage and (stage != "capture" or reading is not None)]
    return plain(settings) | {stage: plain(_part(settings, reading or Reading(), stage)) for stage in stages}


def with_values(
    settings: Settings, reading: Reading, values: Mapping[str, Any], subject: str = ""
) -> tuple[Settings, Reading]:
    """Settings with some values changed.

    Parameters
    ----------
    settings : Settings
    reading : Reading
    values : mapping of str to object
        By name, see `table`; lists as they are in TOML and JSON, `NONE` or None where nothing is meant.
    subject : str
        Of messages, before the name: where the values come from.

    Raises
    ------
    UsageError
        A name is unknown (the nearest one is given), or a value is of another type or out of its range.
    """
    where = f"{subject}, " if subject else ""
    stages: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        row = table().get(name)
        if row is None:
            problem = f"is no setting of a reconstruction{_nearest(name)}"
            raise UsageError(f"{where}{name}", problem, "`drgs reconstruct --print-settings` shows all")
        if row.allowed.optional and value == NONE:
            value = None
        if type(value) is int:  # a number among texts, which one writes without quotes
            value = next((text for text in row.allowed.choices if text.isdigit() and int(text) == value), value)
        if text := row.allowed.problem(value):
            raise UsageError(f"{where}{name}", text, row.about.rstrip("."))
        if row.allowed.type is float and isinstance(value, int):
            value = float(value)
        if isinstance(value, list | tuple):
            value = tuple(row.allowed.type(item) for item in value)
        stages.setdefault(row.stage, {})[row.field] = value
    for stage, changed in stages.items():
        part = replace(_part(settings, reading, stage), **changed)
        if stage == "capture":
            reading = part
        else:
            settings = replace(settings, **{stage: part}) if stage else part
    return settings, reading


def _nearest(name: str) -> str:
    """A hint at the settings that may be meant, "" where none is near."""
    same = [known for known, row in table().items() if row.field == name.rpartition(".")[2]]
    near = same or difflib.get_close_matches(name, table(), n=1, cutoff=0.6)
    if not near:
        fields_of = {row.field: known for known, row in table().items()}
        near = [fields_of[k] for k in difflib.get_close_matches(name.rpartition(".")[2], fields_of, n=1, cutoff=0.6)]
    return f"; the nearest is {first_of(near).replace(', ', ' or ')}" if near else ""
