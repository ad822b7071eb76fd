"""What the documentation tells people to type is what the program takes."""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path

import pytest
from doc_blocks import blocks

from drgs_blender.cli.main import build_parser, join_values
from drgs_blender.core.passes import PASSES

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def typed() -> Iterator[tuple[str, str]]:
    """(page, command line) of every command of `drgs` in a block of code."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8").replace("\\\n", " ")
        shell = "".join(code for language, code in blocks(text) if language == "sh")
        for line in [*text.splitlines(), *(" " * 4 + line for line in shell.splitlines() if line[:1] != " ")]:
            if found := re.match(r" {4,}(?:RUN |\.venv/bin/)?drgs (.*)", line):
                yield page.name, re.split(r" \|\|? ", found[1].replace("$matter", "jelly"))[0]


COMMANDS = list(typed())


@pytest.mark.parametrize(("page", "line"), COMMANDS, ids=[f"{page}-{i}" for i, (page, _) in enumerate(COMMANDS)])
def test_commands_are_understood(page: str, line: str) -> None:
    words = shlex.split(line, comments=True)
    assert build_parser().parse_args(join_values(words)).command == words[0]


def test_there_are_commands_and_options_to_look_at() -> None:
    assert len(COMMANDS) > 20 and {page for page, _ in COMMANDS} >= {"README.md", "command-line.md", "nodes.md"}


def test_options_that_are_named_exist() -> None:
    parser = build_parser()
    (commands,) = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    known = {option for sub in commands.choices.values() for option in sub._option_string_actions}
    text = (ROOT / "docs" / "command-line.md").read_text(encoding="utf-8")
    named = {flag for code in re.findall(r"`([^`\n]+)`", text) for flag in re.findall(r"(?<![\w-])--[a-z][\w-]*", code)}
    assert len(named) > 30 and not named - known - {"--help", "--version"}


def test_names_of_the_code_exist() -> None:
    """Identifiers in code marks, but the names of tests' modules and what other programs call theirs."""
    folders = ("drgs_blender", "addon", "operators", "tests", "tools", "bench", "examples")
    paths = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    text = "\n".join(path.read_text(encoding="utf-8") for path in [*paths, ROOT / "pyproject.toml"])
    known = set(re.findall(r"[A-Za-z_]\w*", text)) | {path.stem for path in paths}
    known |= {"rgba_city", "MaxArraySize"}  # a file of TensoIR's, a limit of Slurm's
    known |= {f"use_pass_{p.name.lower().replace(' ', '_')}" for p in PASSES}
    for page in PAGES:
        code = [c for c in re.findall(r"(?<!`)`([^`\n]+)`(?!`)", page.read_text(encoding="utf-8")) if " " not in c]
        named = {
            name
            for c in code
            for name in re.findall(r"[A-Za-z_]\w*", c)
            if "_" in name or re.search("[a-z][A-Z]", name)
        }
        assert not named - known, page.name


def test_the_table_of_the_readme_has_every_command_as_it_is_typed() -> None:
    parser = build_parser()
    (commands,) = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    rows = re.findall(r"^\| `drgs ([^`]+)` \|", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    for row in rows:
        words = shlex.split(re.sub(r"[\[\]]", "", row))
        assert parser.parse_args(join_values(words)).command == words[0], row
    assert {row.split()[0] for row in rows} == set(commands.choices)


PICTURES = sorted((ROOT / "docs" / "images").iterdir())
#: Pages that say below each picture which program makes it.
GALLERIES = [ROOT / "docs" / f"{name}.md" for name in ("gallery", "paper-figures", "benchmarks")]


def shown(page: Path) -> list[tuple[str, str]]:
    """Each picture of a page, as it names it, and what is below it in its section."""
    sections = re.split("^## ", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return [(m[1], text[m.end() :]) for text in sections for m in re.finditer(r"!\[[^]]*\]\(([^)]+)\)", text)]


def test_pictures_are_shown_and_small() -> None:
    named = {(page.parent / name).resolve() for page in PAGES for name, _ in shown(page)}
    assert {path for path in named if not path.is_file()} == set()
    assert set(PICTURES) - named == set()
    assert [path.name for path in PICTURES if path.stat().st_size > 700_000] == []


def test_pictures_say_what_they_show() -> None:
    """In words, for who does not see them."""
    said = [m for page in PAGES for m in re.findall(r"!\[([^]]*)\]\(([^)]+)\)", page.read_text(encoding="utf-8"))]
    assert said and [name for words, name in said if len(words.split()) < 4] == []


@pytest.mark.parametrize("page", GALLERIES, ids=lambda page: page.stem)
def test_programs_below_pictures_exist(page: Path) -> None:
    targets = (ROOT / "Makefile").read_text(encoding="utf-8")
    for name, below in shown(page):
        own = below if page.stem == "benchmarks" else below.partition("![")[0]  # one run may draw all of a section
        python = "python" if page.stem == "benchmarks" else r"\.venv/bin/python"  # bench/report.py writes the former
        made_by = re.search(rf"`(?:make ([\w-]+)|{python} (\S+\.py)([^`]*))`", own)
        assert made_by, f"{name}: no program"
        target, program, options = made_by.groups()
        if target:
            assert re.search(rf"^{target}\b|[: ]{target}\b", targets, re.MULTILINE), name
            continue
        source = (ROOT / program).read_text(encoding="utf-8")
        flags = re.findall(r"(?<!\S)--[a-z][\w-]*", options)
        assert [flag for flag in flags if f'"{flag}"' not in source] == [], name
        assert page.stem == "benchmarks" or "--publish" not in options, f"{name}: would overwrite a tracked picture"
        if part := re.fullmatch(r"images/gallery-(\w+)\.webp", name):
            assert f"--part {part[1]}" in options and f'"{part[1]}":' in source


def test_each_picture_has_a_page_that_names_its_program() -> None:
    named = {Path(name).name for page in GALLERIES for name, _ in shown(page)}
    patterns = re.findall(r"`docs/images/([^`]+)`", (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"))
    left = [path.name for path in PICTURES if path.name not in named]
    assert [name for name in left if not any(fnmatch(name, pattern) for pattern in patterns)] == []
