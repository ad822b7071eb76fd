"""What people read is spelt as in Britain: pages, docstrings, and what Blender shows. `lint` looks for misspellings."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import codespell_lib
import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = [*ROOT.glob("*.md"), *sorted((ROOT / "docs").rglob("*.md")), ROOT / "examples" / "README.md"]
MODULES = [path for folder in ("addon", "operators", "drgs_blender") for path in sorted((ROOT / folder).rglob("*.py"))]
#: Words of computers, of Blender, and one of a message that argparse has likewise.
EXCEPT = {"program", "programs", "disk", "disks", "dialog", "dialogs", "math", "unrecognized"}
#: Code, addresses, names of files and of options, and what Blender calls so ("Base Color").
NO_PROSE = re.compile(
    r"```.*?```|^ {4,}\S.*?$|`+[^`]+`+|\]\([^)]*\)|--[\w-]+|\w*[./_]\w+\S*|\w+_\b|\*[^*\n]+\*|\b[A-Z]\w*",
    re.DOTALL | re.MULTILINE,
)


def american() -> dict[str, str]:
    """Words of American spelling, with the British ones."""
    table = Path(codespell_lib.__file__).parent / "data" / "dictionary_en-GB_to_en-US.txt"
    pairs = (line.split("->") for line in table.read_text(encoding="utf-8").split())
    found = {us.strip(","): gb for gb, *others in pairs for us in others}
    return {us: gb for us, gb in found.items() if us not in EXCEPT}


AMERICAN = american()


def faults(text: str) -> list[str]:
    """American words of a text, each as it should be."""
    words = re.findall(r"\b[a-z]+\b", NO_PROSE.sub(" ", text))
    return [f"{word}: {AMERICAN[word]}" for word in words if word in AMERICAN]


def strings(module: Path) -> Iterator[str]:
    """Docstrings, descriptions, labels and messages, of a module that has such a word somewhere."""
    text = module.read_text(encoding="utf-8")
    if AMERICAN.keys().isdisjoint(re.findall(r"[a-z]+", text)):
        return
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield node.value


def test_a_fault_is_seen_and_names_are_none() -> None:
    assert len(AMERICAN) > 500
    assert faults("Its color and\nthe gray of *Base color*, `color`, Color, --color, color.py, vertex_color") == [
        "color: colour",
        "gray: grey",
    ]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_pages_are_british(page: Path) -> None:
    assert not faults(page.read_text(encoding="utf-8"))


def test_docstrings_and_messages_are_british() -> None:
    found = [f"{m.relative_to(ROOT)}: {fault}" for m in MODULES for text in strings(m) for fault in faults(text)]
    assert not found, "\n".join(sorted(set(found)))
