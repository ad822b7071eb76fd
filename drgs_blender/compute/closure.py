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
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from .folders import cache_folder, write_atomically

#: The folder `drgs_blender` and the name under which its modules import each other.
PACKAGE = Path(__file__).resolve().parent.parent
#: What a release brings, see `shipped`.
SHIPPED = Path(__file__).with_name("kernels")
#: What kernels' modules import and machine code does not depend on, or only through the target's name.
NEUTRAL = frozenset(f"drgs_blender/{name}.py" for name in (
    "compute/closure", "compute/folders", "compute/shipped", "compute/targets", "core/errors", "core/file_lock",
    "core/system", "core/user_cache", "core/version",
))  # fmt: skip
_DIGITS = 16
_MOST_ROWS = 4000


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
    total, own = hashlib.sha256(), str(path)
    for member in sorted(_members(own), key=lambda file: (file != own, _name(file))):
        total.update(_name(member).encode() + b"\0" + _facts(member)[0].encode())
    _index.save()
    return total.hexdigest()[:_DIGITS]


def package_digest() -> str:
    """Digest of all sources of the package, for caches that do not know which of them a kernel is made of."""
    total = hashlib.sha256()
    for file in sorted(_sources()):
        total.update(_name(file).encode() + b"\0" + Path(file).read_bytes())
    return total.hexdigest()[:_DIGITS]


def _sources() -> Iterator[str]:
    for folder, folders, files in os.walk(str(PACKAGE)):
        folders[:] = [name for name in folders if name != "__pycache__"]
        yield from (os.path.join(folder, name) for name in files if name.endswith(".py"))


#: File -> what it was when this process began to import kernels.
_noted: dict[str, tuple[int, ...] | None] = {}


def note(file: str) -> None:
    """Remember a source file as it is when its module is imported."""
    if file not in _noted:
        _noted[file] = _stamp(file)


def note_package() -> None:
    """Remember all sources of the package, before the modules of kernels are imported."""
    for file in _sources():
        note(file)


def changed(path: Path) -> bool:
    """Whether sources of a module's kernels were changed after they were imported: its digest is then another's."""
    return any(map(_is_changed, _members(str(path))))


@functools.cache
def _is_changed(file: str) -> bool:
    """Asked after `_facts` has read the file, which is never read again."""
    return file in _noted and _noted[file] != _stamp(file)


def _stamp(file: str) -> tuple[int, ...] | None:
    """Of a file that is unpacked or copied over another the modification time alone may be the same."""
    try:
        facts = os.stat(file)
    except OSError:
        return None
    return facts.st_mtime_ns, facts.st_ctime_ns, facts.st_size, facts.st_ino


def closure(path: Path) -> frozenset[Path]:
    """Source files of `path` and of everything of the package that it imports, directly or not, but `NEUTRAL` ones."""
    return frozenset(map(Path, _members(str(path))))


# Files are texts from here on: a start asks thousands of times which file comes after which, and texts are compared in
# a tenth of the time of a `Path`.


@functools.cache
def _members(file: str) -> frozenset[str]:
    seen, pending = {file}, [file]
    while pending:
        for other in _facts(pending.pop())[1]:
            if other not in seen:
                seen.add(other)
                pending.append(other)
    return frozenset(seen)


@functools.cache
def _name(file: str) -> str:
    """The same on every machine: below the package, or the bare name."""
    path = Path(file)
    return path.relative_to(PACKAGE.parent).as_posix() if path.is_relative_to(PACKAGE) else path.name


@functools.cache
def _facts(file: str) -> tuple[str, tuple[str, ...]]:
    """Digest of a source file without comments and docstrings, and the package's files that it imports."""
    source = Path(file).read_bytes()
    key = hashlib.sha256(_name(file).encode() + b"\0" + source).hexdigest()
    if key not in _index.rows:
        _index.add(key, *_parse(source, Path(file)))
    facts, imported = _index.rows[key]
    found = {other for name in imported for other in _files(name)} - {file}
    return facts, tuple(sorted(other for other in found if _name(other) not in NEUTRAL))


def _parse(source: bytes, path: Path) -> tuple[str, list[str]]:
    """The digest, and the dotted names that are imported from the package."""
    tree = ast.parse(source)
    imported: set[str] = set()
    package = path.parent.relative_to(PACKAGE.parent).parts if path.is_relative_to(PACKAGE) else ()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imported.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            stem = (*base, *(node.module.split(".") if node.module else ()))
            imported.update(".".join((*stem, alias.name)) for alias in node.names)
        elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Module)):
            first = node.body[0] if node.body else None
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                node.body[:1] = [] if len(node.body) > 1 else [ast.Pass()]
    digest = hashlib.sha256(ast.dump(tree).encode()).hexdigest()
    return digest, sorted(name for name in imported if name.split(".")[0] == PACKAGE.name)


def shipped_index() -> str:
    """File name of the index that a release brings for this Python: what other patches of it parse is the same."""
    own = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:_DIGITS]
    return f"sources-{sys.implementation.cache_tag}-{own}.json"


class _Index:
    """What `_parse` found, by the digest of the bytes it read, kept in the cache folder: parsing takes a second."""

    def __init__(self) -> None:
        self.added = False

    @functools.cached_property
    def name(self) -> str:
        version = hashlib.sha256(sys.version.encode() + Path(__file__).read_bytes()).hexdigest()[:_DIGITS]
        return f"sources-{version}.json"

    @property
    def path(self) -> Path | None:
        folder = cache_folder().path
        return folder and folder / self.name

    @functools.cached_property
    def rows(self) -> dict[str, tuple[str, list[str]]]:
        found: dict[str, tuple[str, list[str]]] = {}
        if self.path:
            with contextlib.suppress(OSError):
                os.utime(self.path)  # what is used is not removed
        own = (folder / self.name for folder in cache_folder().sources)
        for path in (SHIPPED / shipped_index(), *own):
            with contextlib.suppress(OSError, ValueError, TypeError, AttributeError, RecursionError):
                rows = unpacked(path.read_bytes())
                found |= {str(key): (str(facts), [str(n) for n in names]) for key, (facts, names) in rows.items()}
        return found

    def add(self, key: str, facts: str, imported: list[str]) -> None:
        if len(self.rows) >= _MOST_ROWS:  # of sources that are edited, each version is one
            self.rows.clear()
        self.rows[key] = facts, imported
        self.added = True

    def save(self) -> None:
        if self.added and self.path:
            self.added = False
            with contextlib.suppress(OSError):
                write_atomically(self.path, packed(self.rows))


def packed(rows: dict[str, tuple[str, list[str]]]) -> bytes:
    """The bytes of an index, the digest of the others first."""
    text = json.dumps(rows, sort_keys=True).encode()
    return hashlib.sha256(text).hexdigest().encode() + b"\n" + text


def unpacked(data: bytes) -> dict[str, tuple[str, list[str]]]:
    """Inverse of `packed`.

    Raises
    ------
    ValueError
        When it is damaged.
    """
    digest, _, text = data.partition(b"\n")
    if hashlib.sha256(text).hexdigest().encode() != digest:
        raise ValueError("its digest is another")
    rows: dict[str, tuple[str, list[str]]] = json.loads(text)
    return rows


_index = _Index()


@functools.cache
def _files(name: str) -> tuple[str, ...]:
    """Files that run when a dotted name is imported from the package: its module and the packages above it."""
    first, *parts = name.split(".")
    if first != PACKAGE.name:
        return ()
    found, folder = [], str(PACKAGE)
    for part in (*parts, ""):
        files, folders = _inside(folder)
        found += [os.path.join(folder, file) for file in ("__init__.py", f"{part}.py") if file in files]
        if f"{part}.py" in files or part not in folders:
            break
        folder = os.path.join(folder, part)
    return tuple(found)


@functools.cache
def _inside(folder: str) -> tuple[frozenset[str], frozenset[str]]:
    """Names of the files and of the folders in a folder: to list it is quicker than to ask for each."""
    with os.scandir(folder) as entries:
        kinds = [(entry.name, entry.is_dir()) for entry in entries]
    return frozenset(name for name, is_dir in kinds if not is_dir), frozenset(name for name, is_dir in kinds if is_dir)
