"""Docstrings in numpydoc form: every entry of Parameters, Attributes and Returns has a type and a name that exists.

Where there are no annotations, as in kernels, every parameter has such an entry.
"""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "drgs_blender"
FOLDERS = sorted(path.name for path in PACKAGE.iterdir() if (path / "__init__.py").is_file())
Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
SECTIONS = ("Parameters", "Attributes", "Returns", "Yields")

#: What a type may be beside classes of the package, choices and containers.
WORDS = {
    "bool",
    "bytes",
    "bytearray",
    "memoryview",
    "int",
    "float",
    "complex",
    "str",
    "object",
    "type",
    "None",
    "dtype",
}
WORDS |= {
    "Path",
    "path-like",
    "bytes-like",
    "callable",
    "module",
    "function",
    "context manager",
    "file object",
    "slice",
}
WORDS |= {"dict", "list", "tuple", "set", "mapping", "sequence", "iterable", "iterator", "namedtuple"}
CONTAINERS = "list|tuple|set|sequence|iterable|iterator"
NUMBER = r"(?:bool|u?int(?:8|16|32|64)?|float(?:16|32|64)?|complex(?:64|128)?)"
SHAPE = r"\([\w.+*^ /-]+,(?:[\w.+*^ /-]+,)*[\w.+*^ /-]*\)"
ARRAY = re.compile(
    rf"(?:{SHAPE}(?:(?:, | or ){SHAPE})* )?(?:unit )?(?:{NUMBER}(?:(?:, | or ){NUMBER})* )?(?:array|tensor)s?"
)


class Entry(NamedTuple):
    """One entry of a section: the names (none in a nameless return value), the type, and the line in the file."""

    section: str
    names: tuple[str, ...]
    slot: str
    line: int


@cache
def sources() -> dict[Path, str]:
    return {path: path.read_text(encoding="utf-8") for path in sorted(PACKAGE.rglob("*.py"))}


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(sources()[path])


def definitions(node: ast.AST) -> Iterator[Definition]:
    """Functions and classes at any depth; faster than to walk through expressions, too."""
    for field in ("body", "orelse", "handlers", "finalbody"):
        for inner in getattr(node, field, ()):
            if isinstance(inner, Definition):
                yield inner
            yield from definitions(inner)


@cache
def class_files() -> dict[str, list[Path]]:
    """Where classes of the package are, by name."""
    found: dict[str, list[Path]] = {}
    for path, text in sources().items():
        for name in re.findall(r"^ *class (\w+)", text, re.M):
            found.setdefault(name, []).append(path)
    return found


def cuts(text: str, separators: tuple[str, ...]) -> list[tuple[int, int]]:
    """Beginnings and ends of separators that are outside of brackets and quotes."""
    found, depth, quoted = [], 0, False
    for i, letter in enumerate(text):
        quoted ^= letter == '"'
        depth += (letter in "([{") - (letter in ")]}")
        if not depth and not quoted:
            found += [(i, i + len(s)) for s in separators if text.startswith(s, i)]
    return found


def split(text: str, *separators: str) -> list[str]:
    places = cuts(text, separators)
    return [text[i:j] for i, j in zip([0, *(end for _, end in places)], [*(start for start, _ in places), len(text)])]


@cache
def is_type(slot: str) -> bool:
    """Whether `slot` says of what type something is, as numpydoc wants it."""
    return is_union(slot.removesuffix(", optional"))


def is_union(text: str) -> bool:
    """One type, or several between commas and "or", which also stand within the types of arrays."""
    starts = [0]
    for end, after in [*cuts(text, (", ", " or ")), (len(text), len(text) + 1)]:
        if any(is_single(text[start:end]) for start in starts):
            starts.append(after)
    return starts[-1] == len(text) + 1


def is_single(text: str) -> bool:
    if text in WORDS or text in class_files() or ARRAY.fullmatch(text) or re.fullmatch(NUMBER, text):
        return True
    if re.fullmatch(r"[a-z_]\w*(\.\w+)+", text):  # a class of another library, such as argparse.Namespace
        return True
    if re.fullmatch(r"\{.+\}", text):
        return all(re.fullmatch(r'"[^"]*"|-?[\d.]+|True|False|None', part) for part in split(text[1:-1], ", "))
    if found := re.fullmatch(rf"(?:{CONTAINERS}) of (.+)", text):
        return is_element(found[1])
    if found := re.fullmatch(r"(?:dict|mapping) of (.+)", text):
        parts = split(found[1], " to ")
        return any(is_element(" to ".join(parts[:i])) and is_element(" to ".join(parts[i:])) for i in range(len(parts)))
    return False


def is_element(text: str) -> bool:
    """What a container is of: one type, or in brackets the types of its places or a choice."""
    if text.startswith("(") and text.endswith(")") and all(map(is_union, split(text[1:-1], ", "))):
        return True
    return is_single(text) or (text.startswith("(") and text.endswith(")") and is_union(text[1:-1]))


def entries(node: Definition) -> Iterator[Entry]:
    """Entries of the docstring of a function or class."""
    head = node.body[0] if node.body else None
    if not (isinstance(head, ast.Expr) and isinstance(head.value, ast.Constant) and isinstance(head.value.value, str)):
        return
    doc = inspect.cleandoc(head.value.value)
    first = head.lineno
    lines = doc.split("\n")
    section = ""
    for i, line in enumerate(lines):
        if re.fullmatch(r"-{3,}", line):
            section = lines[i - 1]
        elif i + 1 < len(lines) and re.fullmatch(r"-{3,}", lines[i + 1]):
            section = ""
        elif section in SECTIONS and line and not line.startswith(" "):
            names, colon, slot = line.partition(" : ")
            if not colon and section in ("Returns", "Yields"):
                names, slot = "", line
            yield Entry(section, tuple(n.strip(" *") for n in names.split(",") if n), slot, first + i)


def parameters(node: ast.FunctionDef | ast.AsyncFunctionDef, typed: bool = False) -> set[str]:
    """Names of the parameters, if `typed` of those alone whose annotation says something."""
    a = node.args
    every = [*a.posonlyargs, *a.args, *a.kwonlyargs, *filter(None, (a.vararg, a.kwarg))]
    if typed:
        every = [argument for argument in every if argument.annotation and ast.unparse(argument.annotation) != "Any"]
    return {argument.arg for argument in every} - {"self", "cls"}


def family(node: ast.ClassDef) -> list[ast.ClassDef]:
    """The class and those classes of the package that it is made from."""
    bases = [b.attr if isinstance(b, ast.Attribute) else getattr(b, "id", "") for b in node.bases]
    trees = [(name, tree(path)) for name in bases for path in class_files().get(name, [])]
    above = [c for name, found in trees for c in definitions(found) if isinstance(c, ast.ClassDef) and c.name == name]
    return [node, *(found for c in above if c is not node for found in family(c))]


def fields(node: ast.ClassDef) -> set[str]:
    """Annotated names of the class's body: fields of dataclasses and named tuples."""
    return {s.target.id for s in node.body if isinstance(s, ast.AnnAssign) and isinstance(s.target, ast.Name)}


def attributes(node: ast.ClassDef) -> set[str]:
    """What instances have: fields, properties, and what methods assign to ``self``."""
    found = fields(node)
    for inner in ast.walk(node):
        if isinstance(inner, ast.FunctionDef):
            found.add(inner.name)
        elif isinstance(inner, ast.Attribute) and isinstance(inner.ctx, ast.Store):
            found.add(inner.attr)
        elif isinstance(inner, ast.Assign):
            found |= {target.id for target in inner.targets if isinstance(target, ast.Name)}
    return found


def known_names(node: Definition, section: str) -> set[str] | None:
    """Names that entries of the section may have; None where any will do."""
    if section in ("Returns", "Yields"):
        return None
    if not isinstance(node, ast.ClassDef):
        return parameters(node)
    if section == "Attributes":
        return set().union(*map(attributes, family(node)))
    return parameters(maker) if (maker := maker_of(node)) else set().union(*map(fields, family(node)))


def maker_of(node: Definition) -> ast.FunctionDef | ast.AsyncFunctionDef | None:
    """The function whose parameters the docstring has: of a class its ``__init__``."""
    if not isinstance(node, ast.ClassDef):
        return node
    inits = (s for c in family(node) for s in c.body if isinstance(s, ast.FunctionDef) and s.name == "__init__")
    return next(inits, None)


def faults(module: ast.Module) -> Iterator[tuple[str, str]]:
    """("type", "name" or "missing", what is wrong in which line) of every entry that is not as it should be."""
    for node in definitions(module):
        listed = {name for entry in entries(node) if entry.section == "Parameters" for name in entry.names}
        maker = maker_of(node) if listed else None
        if maker and (missing := parameters(maker, typed=True) - listed):
            yield "missing", f"{node.lineno}: {node.name} has parameters, but not {', '.join(sorted(missing))}"
        for entry in entries(node):
            known = known_names(node, entry.section)
            where = f"{entry.line}: {node.name}: {', '.join(entry.names)}"
            if known is not None and (stale := [name for name in entry.names if name not in known]):
                yield "name", f"{where}: {', '.join(stale)} does not exist"
            if not is_type(entry.slot):
                yield "type", f"{where} : {entry.slot!r} is no type"


@cache
def all_faults(folder: str) -> list[tuple[str, str]]:
    headed = re.compile(rf"^ *({'|'.join(SECTIONS)})\n *---", re.M)
    paths = [p for p, text in sources().items() if p.is_relative_to(PACKAGE / folder) and headed.search(text)]
    return [(kind, f"{p.relative_to(ROOT)}:{text}") for p in paths for kind, text in faults(tree(p))]


def found_in(folder: str, kind: str) -> list[str]:
    return [text for what, text in all_faults(folder) if what == kind]


@pytest.mark.parametrize("folder", FOLDERS)
def test_entries_have_types(folder: str) -> None:
    assert not found_in(folder, "type"), "\n".join(found_in(folder, "type"))


@pytest.mark.parametrize("folder", FOLDERS)
def test_entries_name_what_exists(folder: str) -> None:
    assert not found_in(folder, "name"), "\n".join(found_in(folder, "name"))


@pytest.mark.parametrize("folder", FOLDERS)
def test_sections_of_parameters_are_whole(folder: str) -> None:
    assert not found_in(folder, "missing"), "\n".join(found_in(folder, "missing"))


#: Of intrinsics: what Numba gives itself.
OF_NUMBA = {"typing", "typingctx"}


def public_functions(node: ast.AST) -> Iterator[ast.FunctionDef]:
    """Functions and methods of a module that others may call; none that stand in functions."""
    for inner in getattr(node, "body", ()):
        if isinstance(inner, ast.FunctionDef) and not inner.name.startswith("_"):
            yield inner
        elif isinstance(inner, ast.ClassDef | ast.If | ast.Try):
            yield from public_functions(inner)


def undescribed(module: ast.Module) -> Iterator[str]:
    """Public functions that leave a parameter without annotation and without an entry."""
    for node in public_functions(module):
        a = node.args
        bare = {x.arg for x in [*a.posonlyargs, *a.args, *a.kwonlyargs] if not x.annotation} - {"self", "cls"}
        listed = {name for entry in entries(node) if entry.section == "Parameters" for name in entry.names}
        missing = (parameters(node) if bare - OF_NUMBA else set()) - OF_NUMBA - listed
        if missing:
            yield f"{node.lineno}: {node.name} has neither annotation nor entry of {', '.join(sorted(missing))}"


@pytest.mark.parametrize("folder", FOLDERS)
def test_parameters_without_annotation_are_described(folder: str) -> None:
    paths = [path for path in sources() if path.is_relative_to(PACKAGE / folder)]
    found = [f"{path.relative_to(ROOT)}:{text}" for path in paths for text in undescribed(tree(path))]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    "slot",
    [
        "int",
        "(n, 3) float32 array",
        "float32",
        "Path, int64 or tuple",
        "(n, 3) float32 array, optional",
        "(3,) or (n, 3) array",
        "(h, w, 4) uint8 or float32 array",
        '{"surfels", "mesh"}, optional',
        "str, Path or MeshFile",
        "list of Material",
        "list of (str or None)",
        "tuple of (int, (n, 3) float array, Path or None)",
        "dict of str to (n,) array",
        "mapping of str to list of int",
        "argparse.Namespace",
        "callable, optional",
    ],
)
def test_types(slot: str) -> None:
    assert is_type(slot)


@pytest.mark.parametrize(
    "slot",
    [
        "",
        "what rays meet",
        "(n, 3) float32",
        "metres, at rest",
        "list of frames",
        "NoSuchClass",
        "(n, 3) array of",
        '{"a"',
    ],
)
def test_prose_is_no_type(slot: str) -> None:
    assert not is_type(slot)


def test_faults_are_found() -> None:
    text = '''def f(a, b, d: int, e: Any):
    """Sum.

    Parameters
    ----------
    a : int
        A number.
    c : float
    b : the other

    Returns
    -------
    what comes out
    """
'''
    assert [(kind, text.split(":")[0]) for kind, text in faults(ast.parse(text))] == [
        ("missing", "1"),
        ("name", "8"),
        ("type", "9"),
        ("type", "13"),
    ]


def test_functions_without_annotations_are_found() -> None:
    text = '''@njit
def f(a, b, c):
    """Sum.

    Parameters
    ----------
    a, b : float32
    """

@njit
def g(a: int, b: float): ...

@njit
def _h(a): ...

@intrinsic
def k(typing, a):
    """Twice.

    Parameters
    ----------
    a : float32
    """
    def inner(b): ...
'''
    assert list(undescribed(ast.parse(text))) == ["2: f has neither annotation nor entry of c"]
