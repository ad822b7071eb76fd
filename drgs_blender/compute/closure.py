"""Import closure of a module: the sources on which its compiled kernels depend, and their digest.

A kernel is compiled from its own source and from all that it calls, which its module imports. What is not in that
closure cannot change the kernel, and neither can comments and docstrings: they are not part of the digest.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import hashlib
import json
import sys
from pathlib import Path

from .folders import cache_folder, write_atomically

#: The folder `drgs_blender` and the name under which its modules import each other.
PACKAGE = Path(__file__).resolve().parent.parent
#: What a release brings, see `shipped`.
SHIPPED = Path(__file__).with_name("kernels")
#: What kernels' modules import and machine code does not depend on, or only through the target's name.
NEUTRAL = frozenset(f"drgs_blender/{name}.py" for name in (
    "compute/closure", "compute/folders", "compute/shipped", "compute/targets", "errors", "version",
))  # fmt: skip
_DIGITS = 16


@functools.cache
def digest(path: Path) -> str:
    """Digest of the sources that a module and, through its imports, its kernels are made of.

    Parameters
    ----------
    path : Path
        Source file of the module; one outside the package may import from it by absolute names.

    Returns
    -------
    str
        16 hexadecimal digits.
    """
    total = hashlib.sha256()
    for member in sorted(closure(path), key=lambda file: (file != path, _name(file))):
        total.update(_name(member).encode() + b"\0" + _facts(member)[0].encode())
    _index.save()
    return total.hexdigest()[:_DIGITS]


@functools.cache
def closure(path: Path) -> frozenset[Path]:
    """Source files of `path` and of everything of the package that it imports, directly or not, but `NEUTRAL` ones."""
    seen, pending = {path}, [path]
    while pending:
        for other in _facts(pending.pop())[1]:
            if other not in seen and _name(other) not in NEUTRAL:
                seen.add(other)
                pending.append(other)
    return frozenset(seen)


@functools.cache
def _name(path: Path) -> str:
    """The same on every machine: below the package, or the bare name."""
    return path.relative_to(PACKAGE.parent).as_posix() if path.is_relative_to(PACKAGE) else path.name


@functools.cache
def _facts(path: Path) -> tuple[str, tuple[Path, ...]]:
    """Digest of a source file without comments and docstrings, and the package's files that it imports."""
    source = path.read_bytes()
    key = hashlib.sha256(source).hexdigest()
    if key not in _index.rows:
        _index.add(key, *_parse(source, path))
    facts, imported = _index.rows[key]
    return facts, tuple(PACKAGE.parent / name for name in imported)


def _parse(source: bytes, path: Path) -> tuple[str, list[str]]:
    tree = ast.parse(source)
    imported: set[Path] = set()
    package = path.parent.relative_to(PACKAGE.parent).parts if path.is_relative_to(PACKAGE) else ()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                imported.update(_files(tuple(alias.name.split("."))))
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            stem = (*base, *(node.module.split(".") if node.module else ()))
            for alias in node.names:
                imported.update(_files((*stem, alias.name)))
        elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Module)):
            first = node.body[0] if node.body else None
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                node.body[:1] = [] if len(node.body) > 1 else [ast.Pass()]
    imported.discard(path)
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest(), sorted(_name(file) for file in imported)


def shipped_index() -> str:
    """File name of the index that a release brings for this Python: what other patches of it parse is the same."""
    own = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:_DIGITS]
    return f"sources-{sys.implementation.cache_tag}-{own}.json"


class _Index:
    """What `_parse` found, by the digest of the bytes it read, kept in the cache folder: parsing takes a second."""

    def __init__(self) -> None:
        self.added = False

    @functools.cached_property
    def path(self) -> Path | None:
        folder = cache_folder().path
        version = hashlib.sha256(sys.version.encode() + Path(__file__).read_bytes()).hexdigest()[:_DIGITS]
        return folder and folder / f"sources-{version}.json"

    @functools.cached_property
    def rows(self) -> dict[str, tuple[str, list[str]]]:
        found: dict[str, tuple[str, list[str]]] = {}
        for path in (SHIPPED / shipped_index(), self.path):
            with contextlib.suppress(OSError, ValueError, TypeError, AttributeError):
                rows = json.loads(path.read_bytes()) if path else {}
                found |= {str(key): (str(facts), [str(n) for n in names]) for key, (facts, names) in rows.items()}
        return found

    def add(self, key: str, facts: str, imported: list[str]) -> None:
        self.rows[key] = facts, imported
        self.added = True

    def save(self) -> None:
        if self.added and self.path:
            self.added = False
            with contextlib.suppress(OSError):
                write_atomically(self.path, json.dumps(self.rows).encode())


_index = _Index()


def _files(name: tuple[str, ...]) -> list[Path]:
    """Files that run when a dotted name is imported from the package: its module and the packages above it."""
    if not name or name[0] != PACKAGE.name:
        return []
    found, folder = [], PACKAGE
    for part in name[1:]:
        found.append(folder / "__init__.py")
        if (folder / f"{part}.py").is_file():
            found.append(folder / f"{part}.py")
            break
        folder = folder / part
        if not folder.is_dir():
            break
    else:
        found.append(folder / "__init__.py")
    return [path for path in found if path.is_file()]
