"""Modules stay short enough to be read; longer ones say here why. Docstrings do not count."""

from __future__ import annotations

import ast
import functools
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
LONGEST = 375
#: Modules above it, and why they are one.
REASONS = {
    "tools/dev.py": "one command per function; it runs before there is any environment",
}


def length(path: Path) -> int:
    """Lines but for those of docstrings."""
    text = path.read_text(encoding="utf-8")
    count = len(text.splitlines())
    places = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, places) and ast.get_docstring(node, clean=False) is not None:
            first = node.body[0]
            count -= (first.end_lineno or first.lineno) - first.lineno + 1
    return count


@functools.cache
def lengths() -> dict[str, int]:
    folders = ("drgs_blender", "addon", "operators", "tools")
    paths = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    return {path.relative_to(ROOT).as_posix(): length(path) for path in paths}


@pytest.mark.parametrize("kind", ["long without a reason", "named and short"])
def test_long_modules_have_a_reason(kind):
    found = {name for name, lines in lengths().items() if lines > LONGEST}
    wrong = found - REASONS.keys() if kind == "long without a reason" else REASONS.keys() - found
    assert not wrong, f"{kind}: {sorted(wrong)}"
