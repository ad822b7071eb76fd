"""Tables of protocols: a row per object, their mean, and what keeps them from being compared with published ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...core.errors import first_of
from ..compare import without_nan
from . import Protocol


def complete(
    report: dict[str, Any],
    protocol: Protocol,
    network: str,
    most_views: int | None,
    resolution: int | None,
    notes: Sequence[str] = (),
) -> dict[str, Any]:
    """The report with the means over the objects and notes on how it differs from published tables.

    Parameters
    ----------
    report : dict of str to object
        "objects", by name what `Protocol.measure` returns.
    protocol : Protocol
    network : str
        Of LPIPS, "" where it is not computed.
    most_views, resolution : int, optional
        As given by the user.
    notes : sequence of str
        Others.
    """
    report = without_nan(report)
    rows = list(report["objects"].values())
    means: dict[str, Any] = {}
    for column in protocol.columns:
        values = [figure(row, column.path) for row in rows]
        numbers = [value for value in values if value is not None]
        _put(means, column.path, float(np.mean(numbers)) if numbers and len(numbers) == len(values) else None)
    missing = [name for name in protocol.objects if name not in report["objects"]]
    notes = list(notes)
    if missing:
        notes.append(f"the mean is of {len(rows)} objects; published ones have {first_of(missing)}, too")
    if most_views is not None:
        notes.append(f"at most {most_views} views of each part")
    if resolution is not None:
        notes.append(f"at most {resolution} pixels a side")
    return report | {
        "mean": means,
        "missing": missing,
        "lpips": network or None,
        "about": protocol.about,
        "notes": notes,
    }


def differences(name: str, found: dict[str, int], protocol: Protocol) -> list[str]:
    """What an object has more or less of than in the published set, as "bell has 8 training views, not 96"."""
    wrong = [f"{found[kind]} {kind}, not {count}" for kind, count in protocol.expected.items() if found[kind] != count]
    return [f"{name} has {'; '.join(wrong)}"] if wrong else []


def strangers(names: Sequence[str], protocol: Protocol) -> list[str]:
    """A note on objects that the published tables have not."""
    found = [name for name in names if name not in protocol.objects]
    return [f"published means are without {first_of(found)}"] if found else []


def figure(row: dict[str, Any], path: str) -> float | None:
    """The figure at a path such as "relit.psnr"; None where there is none."""
    value: Any = row
    for name in path.split("."):
        value = value.get(name) if isinstance(value, dict) else None
    return value if isinstance(value, int | float) else None


def _put(tree: dict[str, Any], path: str, value: float | None) -> None:
    *names, last = path.split(".")
    for name in names:
        tree = tree.setdefault(name, {})
    tree[last] = value


def table(report: dict[str, Any], protocol: Protocol) -> list[str]:
    """The report as lines for a person."""
    columns = [column for column in protocol.columns if report["lpips"] or not column.path.endswith(".lpips")]
    rows = [("object", *(column.title for column in columns))]
    for name, row in (*report["objects"].items(), ("mean", report["mean"])):
        values = (figure(row, column.path) for column in columns)
        rows.append((name, *("-" if v is None else f"{v:.{c.digits}f}" for v, c in zip(values, columns))))
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = ["  ".join([row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:]))]) for row in rows]
    lines.insert(-1, "-" * len(lines[0]))
    lines += ["", f"{report['about']}."]
    if report["lpips"]:
        lines.append(f"LPIPS is that of {report['lpips']}.")
    if report["notes"]:
        lines.append(f"Not to be compared with published tables: {'; '.join(report['notes'])}.")
    return lines
