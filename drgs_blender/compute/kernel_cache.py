"""The kernel cache: compiled kernels on disk, one file each, checked before it is used.

A file's name says everything on which the machine code depends: the function and its argument types, the import
closure of its module (`closure`), the target processor, and the versions of Python, Numba and LLVM. Its content
starts with its own digest: a damaged file is compiled again. Numba's public hook, a cache locator, chooses only the
folder; Numba then reads what it finds unchecked, and two processes that compile at once lose entries of its index.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib
import json
import logging
import os
import pickle
import re
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import CodeType
from typing import Any

import llvmlite
import numba
import numpy as np
from llvmlite import binding
from numba.core import sigutils, types
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.runtime import rtsys
from numba.core.serialize import dumps

from ..core.file_lock import FileLock
from . import closure, shipped
from .folders import cache_folder, read_own, write_atomically
from .kernel_compiler import KernelCompiler, LoadedLibrary, is_nested

log = logging.getLogger(__name__)
_MAGIC = b"drgs kernel 3\n"
_DIGEST = 32
ENDING = ".kernel"


#: Settings of Numba that change machine code.
_CONFIG = ("OPT", "BOUNDSCHECK", "DEBUGINFO_DEFAULT", "LOOP_VECTORIZE", "SLP_VECTORIZE", "USING_SVML")


class DamagedError(Exception):
    """A file is damaged: its content is not what was written."""


class Claim:
    """A lock that keeps processes from compiling the same kernel; without one where files cannot be locked."""

    def __init__(self, lock: FileLock | None = None) -> None:
        self._lock = lock

    @classmethod
    def of(cls, path: Path) -> Claim | None:
        """The lock on `path`, which is made where it is not there; None while another process has it."""
        lock: FileLock | None = None
        try:
            path.parent.mkdir(exist_ok=True, mode=0o700)
            lock = FileLock(path)
            if lock.acquire():
                return cls(lock)
        except OSError:
            return cls(lock)
        lock.close()
        return None

    def close(self) -> None:
        """Release it."""
        if self._lock is not None:
            self._lock.close()


@functools.cache
def _warn_of_record(path: str, reason: str) -> None:
    """Warn, once, of a file that cannot be written."""
    log.warning("DRGS_RECORD_KERNELS: kernels are not recorded in %s (%s)", path, reason)


class KernelCache(NullCache):
    """The compiled forms of one function.

    Parameters
    ----------
    function : callable
        The Python function.
    kind : str
        Forms of one function that are compiled in another way have another kind.
    options : dict, optional
        Options of Numba's decorator.
    """

    def __init__(self, function: Any, kind: str = "kernel", options: dict[str, Any] | None = None) -> None:
        self.function, self.kind, self.options = function, kind, options or {}
        self._names: dict[tuple[Any, ...], str | None] = {}
        self._source = _source(function.__code__.co_filename)

    @property
    def cache_path(self) -> str | None:
        """Folder of the files."""
        path = self._path("")
        return str(path) if path else None

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled form for `sig`, None if there is none (that can be used)."""
        if is_nested():
            return None  # machine code cannot be linked into the caller
        self._record(sig, 0.0)
        name = self.file_name(sig, target_context.codegen())
        if name is None:
            return None
        for data in self._found(name):
            try:
                return _rebuild(target_context, _checked(data))
            except Exception as error:  # of what is damaged, unpickling makes anything
                log.warning("compiled kernel %s is damaged (%s: %s): compiling it", name, type(error).__name__, error)
        return None

    def save_overload(self, sig: Any, cres: Any) -> None:
        """Keep a compiled form; where it cannot be written, the next start compiles again and logs why."""
        if cres.library.has_dynamic_globals or any(not x.can_cache for x in cres.lifted):
            return
        cres.library._ensure_finalized()  # a callback's is not yet
        self._record(sig, KernelCompiler.seconds)
        name = self.file_name(sig, cres.codegen)
        path = self._path(name) if name is not None else None
        if path is None:
            return
        try:
            path.parent.mkdir(exist_ok=True, mode=0o700)
            write_atomically(path, pack(_reduce(cres)))
        except OSError as error:
            cache_folder().failed(path, error)

    def is_there(self, sig: Any, codegen: Any) -> bool:
        """Whether the compiled form for `sig` need not be compiled; a damaged file is as good as none."""
        name = self.file_name(sig, codegen)
        if name is None:
            return True  # it would not be kept
        return shipped.has(name) or any(map(_is_whole, self._kept(name)))

    def claim(self, sig: Any, codegen: Any) -> Claim | None:
        """The right to compile for `sig`, until it is closed; None while another process has it."""
        path = self._path(f".{self.file_name(sig, codegen)}.lock.tmp")
        return Claim.of(path) if path is not None else Claim()

    def file_name(self, sig: Any, codegen: Any) -> str | None:
        """Name of the file for `sig`; None for types that have no name of their own, of which none is kept."""
        key = sig, codegen.magic_tuple()
        if key not in self._names:
            self._names[key] = self._make_name(sig, codegen)
        return self._names[key]

    def _make_name(self, sig: Any, codegen: Any) -> str | None:
        arguments = describe(sigutils.normalize_signature(sig)[0])
        if arguments is None or not self._closure:
            return None
        cells = self.function.__closure__ or ()
        triple, *target = codegen.magic_tuple()
        # Machine code calls nothing of NumPy. What it keeps of dtypes is read by all versions of one major number.
        numpy = np.__version__.partition(".")[0]
        facts = (
            *(self.kind, self.function.__module__, self.function.__qualname__, arguments, self._closure),
            sorted((name, repr(value)) for name, value in self.options.items()),
            *_code_facts(self.function),
            hashlib.sha256(dumps(tuple(cell.cell_contents for cell in cells))).hexdigest() if cells else "",
            re.sub(r"(darwin|macosx?)[\d.]+", r"\1", triple),  # each update of macOS has another, with the same code
            *(*target, numba.__version__, llvmlite.__version__, numpy, sys.implementation.cache_tag),
            [(name, getattr(numba.config, name)) for name in _CONFIG],
        )
        digest = hashlib.sha256("\0".join(map(str, facts)).encode()).hexdigest()
        return f"{self.function.__qualname__.replace('<locals>.', '')}-{digest[:24]}{ENDING}"

    def _record(self, sig: Any, seconds: float) -> None:
        """For ``tools/kernels.py``: append what is called, and how long it took to compile, to a file."""
        if self.kind == "kernel" and (path := os.environ.get("DRGS_RECORD_KERNELS")):
            arguments = describe(sigutils.normalize_signature(sig)[0])
            row = [self.function.__module__, self.function.__qualname__, arguments, round(seconds, 2)]
            try:
                with open(path, "a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")
            except (OSError, ValueError) as error:  # a name that cannot be is a ValueError
                _warn_of_record(path, str(error))

    def _found(self, name: str) -> Iterator[bytes]:
        if (data := shipped.read(name)) is not None:
            yield data
        yield from self._kept(name)

    def _kept(self, name: str) -> Iterator[bytes]:
        for folder in cache_folder().sources:
            path = folder / self._folder / name
            try:
                data = read_own(path)
                with contextlib.suppress(OSError):
                    os.utime(path.parent)
            except FileNotFoundError:
                continue
            except OSError as error:
                log.info("%s: %s", path, error)
                continue
            yield data

    @functools.cached_property
    def _closure(self) -> str:
        """Digest of the sources; "" where they are not what is being run, or cannot be read."""
        try:
            digest = closure.digest(self._source)
            if not closure.changed(self._source):
                return digest
            problem = "its sources, or those that it imports, changed after they were imported"
        except (OSError, SyntaxError, ValueError) as error:
            problem = f"its sources cannot be read, {error}"
        log.warning("compiled kernels of %s are not kept: %s", self._source, problem)
        return ""

    def _path(self, name: str) -> Path | None:
        """A file of this function's folder, or the folder for no name; None where nothing is kept."""
        folder = cache_folder().path
        if folder is None or not self._closure:
            return None
        return folder / self._folder / name

    @property
    def _folder(self) -> str:
        return f"{self.function.__module__.rpartition('.')[2]}-{self._closure}"


def _code_facts(function: Any) -> tuple[str, str]:
    """What a function does, as its byte code says, and the numbers that it takes from its module."""
    names: set[str] = set()

    def facts(code: CodeType, doc: str | None = None) -> list[Any]:
        names.update(code.co_names)
        constants = [facts(c) if isinstance(c, CodeType) else _constant(c) for c in code.co_consts if c != doc]
        return [code.co_code.hex(), code.co_names, constants]

    said = json.dumps(facts(function.__code__, function.__doc__))
    values = {name: function.__globals__[name] for name in sorted(names) if name in function.__globals__}
    numbers = [
        (name, repr(value)) for name, value in values.items() if isinstance(value, (bool, int, float, np.generic))
    ]
    return hashlib.sha256(said.encode()).hexdigest(), str(numbers)


def _constant(value: Any) -> str:
    return repr(sorted(map(repr, value)) if isinstance(value, frozenset) else value)


@functools.cache
def _source(name: str) -> Path:
    """The file of a module that is being imported."""
    path = Path(name).resolve()
    closure.note(str(path))
    return path


def pack(content: bytes) -> bytes:
    """The bytes of a file."""
    return _MAGIC + hashlib.sha256(content).digest() + content


def _is_whole(data: bytes) -> bool:
    try:
        _checked(data)
    except DamagedError:
        return False
    return True


def _checked(data: bytes) -> bytes:
    """The content of a file.

    Raises
    ------
    DamagedError
    """
    start = len(_MAGIC) + _DIGEST
    content = data[start:]
    if data[: len(_MAGIC)] != _MAGIC or hashlib.sha256(content).digest() != data[len(_MAGIC) : start]:
        raise DamagedError("its digest is another")
    return content


def describe(arguments: tuple[Any, ...]) -> str | None:
    """Argument types as text, the same in every process; None if one has an address for a name."""
    text = ", ".join(map(_described, arguments))
    return None if re.search(r"\bat 0x[0-9a-f]+", text) else text


def _described(kind: Any) -> str:
    if isinstance(kind, types.Dispatcher):
        function = kind.dispatcher.py_func
        return f"{function.__module__}:{function.__qualname__}"
    if isinstance(kind, types.BaseTuple):  # type: ignore[attr-defined]
        inner = ", ".join(map(_described, kind.types))
        owner = getattr(kind, "instance_class", None)
        return f"{owner.__module__}:{owner.__qualname__}({inner})" if owner else f"({inner})"
    if isinstance(kind, types.Array):
        return f"array({kind.dtype}, {kind.ndim}, {kind.layout}, {kind.mutable}, {kind.aligned})"
    return str(kind)


def _reduce(cres: Any) -> bytes:
    """A compile result as bytes: as Numba's own, without the LLVM code, which is for callers in compiled code."""
    library, descriptor = cres.library, cres.fndesc
    descriptor.typemap = descriptor.calltypes = None  # not wanted any more, and some cannot be pickled
    module = library._final_module
    values = [*module.functions, *module.global_variables]
    symbols = [value.name for value in values if not value.is_declaration]
    needed = [value.name for value in values if value.is_declaration and not value.name.startswith("llvm.")]
    environments = tuple(cres._find_referenced_environments())
    modules = sorted({str(other.globals["__name__"]) for other in environments})
    code = library.name, library._get_compiled_object(), symbols, needed, modules
    environments = _in_use(environments, str(module))
    return dumps((code, descriptor, cres.environment, cres.signature, cres.objectmode, cres.reload_init, environments))


def _in_use(environments: tuple[Any, ...], llvm_code: str) -> tuple[Any, ...]:
    """Environments to which LLVM code refers: of most functions in a kernel no more is left than a variable for it.

    Each would be looked for when the kernel is loaded, and the module imported that it is of: much of Numba.
    """
    uses = Counter(re.findall(r"_ZN08NumbaEnv[\w.$]*", llvm_code))
    return tuple(other for other in environments if uses[other.env_name] != 1)


#: Functions outside of kernels that were found.
_there: set[str] = set()


def _provide(symbols: list[str], target_context: Any, modules: Iterable[str] = ()) -> None:
    """Have the functions of Numba there that machine code calls, which some of its `modules` may bring.

    Its registries of all that it can compile, with SciPy's linear algebra, take a third of a second to load: they are
    left to the first kernel that is compiled, or that calls what only they bring.
    """
    rtsys.initialize(target_context)
    known = target_context.codegen()._engine._defined_symbols

    def missing() -> list[str]:
        new = set(symbols) - _there - known
        return [name for name in sorted(new) if binding.address_of_symbol(name) is None]

    if missing():
        for name in modules:
            importlib.import_module(name)
    if missing():
        target_context.refresh()
        if absent := missing():
            raise DamagedError(f"nothing has {', '.join(absent)}")  # to run it would end the process
    _there.update(symbols)


def _rebuild(target_context: Any, content: bytes) -> Any:
    code, descriptor, environment, signature, objectmode, reload_init, environments = pickle.loads(content)
    name, machine_code, symbols, needed, modules = code
    for function in reload_init:
        function()
    codegen = target_context.codegen()
    _provide(needed, target_context, modules)
    library = LoadedLibrary(codegen, name)
    library.enable_object_caching()
    library._set_compiled_object(machine_code)
    library._finalize_final_module()
    codegen._engine._defined_symbols.update(symbols)
    entry = target_context.get_executable(library, descriptor, environment)
    for other in environments:
        codegen.set_env(other.env_name, other)
    fields = dict.fromkeys(CompileResult._fields) | {
        "target_context": target_context, "typing_context": target_context.typing_context, "library": library,
        "environment": environment, "entry_point": entry, "fndesc": descriptor, "type_annotation": "",
        "signature": signature, "objectmode": objectmode, "lifted": (), "reload_init": reload_init,
        "referenced_envs": environments,
    }  # fmt: skip
    return CompileResult(**fields)
