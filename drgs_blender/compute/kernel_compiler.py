"""Numba's compiler, changed so that functions that only kernels call are compiled once, as a part of their kernels.

Numba makes of each compiled function a library of its own, with machine code and a wrapper for Python, even of one
that no Python code calls; and it optimises its code again in all that call it. Both are left out here for functions
met while another one is compiled: they become LLVM code to be linked into their callers, which are optimised whole.
That halves the time of compiling and leaves the arithmetic as it is.

A function gets this compiler by ``pipeline_class``, which Numba documents. The rest (`numba_shortcuts`, the kinds of
library, the dispatcher's cache and overloads, see `adopt`) is what Numba does not promise: the versions that it was
tried with are listed, and with others Numba compiles and keeps kernels in its own way.
"""

from __future__ import annotations

import contextlib
import gc
import time
import types as python_types
from collections.abc import Iterator
from typing import Any

import numba
from llvmlite import binding
from numba.core import codegen, compiler, errors, sigutils, targetconfig, typed_passes

from . import numba_shortcuts

#: Versions of Numba with which frames are the same bit for bit (tools/numba_versions.py).
TESTED = ("0.63", "0.64", "0.65", "0.66", "0.67", "0.68")


def is_tested() -> bool:
    """Whether this version of Numba is one of `TESTED`."""
    return ".".join(numba.__version__.split(".")[:2]) in TESTED


#: How functions come that are linked in: the same one may be found in several libraries.
_SHARED = binding.Linkage.linkonce_odr, binding.Linkage.weak_any, binding.Linkage.weak_odr


def is_nested() -> bool:
    """Whether Numba is compiling something right now, so that another function is compiled for its sake."""
    return targetconfig.ConfigStack.top_or_none() is not None


class _Flags(compiler.Flags):
    """Numba's flags, compared by what was set: they are part of the key of each look-up among overloads."""

    __slots__ = ()

    def __hash__(self) -> int:
        return len(self._values)

    def __eq__(self, other: object) -> bool:
        if type(other) is type(self):
            return self._values == other._values
        return super().__eq__(other)


class EntryLibrary(codegen.JITCodeLibrary):
    """Code that Python calls."""

    _linking_libraries: list[Any]
    _shared_module: Any

    def finalize(self) -> None:
        """Link in what is called, and what that calls, each once; then as Numba does."""
        for library in self._linking_libraries:
            self._final_module.link_in(_own_module(library), preserve=True)
            self._reload_init.update(library._reload_init)
        self._linking_libraries = []
        super().finalize()

    def _optimize_functions(self, ll_module: Any) -> None:
        numba_shortcuts.optimize_functions(self, ll_module)

    def add_linking_library(self, library: Any) -> None:
        """Note a library that is called, and those that it calls itself, each once."""
        library._ensure_finalized()
        called = library._linking_libraries if isinstance(library, InnerLibrary) else ()
        self._linking_libraries = list(dict.fromkeys((*self._linking_libraries, library, *called)))

    def _optimize_final_module(self) -> None:
        """Optimise; what was linked in is this library's alone.

        Numba has it seen by all code of the process, under names that count compiled functions or hold an address:
        kernels that were compiled in other processes may bring another function of the same name.
        """
        for function in self._final_module.functions:
            if not function.is_declaration and function.linkage in _SHARED:
                function.linkage = "private"
        super()._optimize_final_module()


class InnerLibrary(EntryLibrary):
    """Code that is only linked into other libraries: not optimised by itself, never made machine code of.

    What it calls is not linked into it but, each once, into the library that Python calls.
    """

    def finalize(self) -> None:
        """End it: nothing is added any more."""
        for function in self._final_module.functions:
            if not function.is_declaration and function.linkage == binding.Linkage.external:
                function.linkage = "weak_odr"
        self._finalize_dynamic_globals()
        self._finalized = True

    def _get_module_for_linking(self) -> Any:
        """With what it calls: for libraries of Numba's own kinds, which link only what they call themselves."""
        if self._shared_module is None:
            self._shared_module = self._final_module.clone()
            for library in self._linking_libraries:
                self._shared_module.link_in(_own_module(library), preserve=True)
        return self._shared_module

    def get_pointer_to_function(self, name: str) -> int:
        """None: nothing calls it but compiled code."""
        self._ensure_finalized()
        return 0


def _own_module(library: Any) -> Any:
    """LLVM code to link: of our libraries without what they call, which is linked in by itself."""
    return library._final_module if isinstance(library, InnerLibrary) else library._get_module_for_linking()


class LoadedLibrary(EntryLibrary):
    """Machine code that was compiled before; there is nothing to link into others."""


class KernelCompiler(compiler.Compiler):
    """Numba's compiler, which knows whether Python called what it compiles or another function did.

    Attributes
    ----------
    seconds : float
        Processor time of the last function that Python called.
    """

    seconds = 0.0

    def __init__(self, typingctx: Any, targetctx: Any, library: Any, args: Any, return_type: Any, flags: Any,
                 locals: Any) -> None:  # fmt: skip
        kind, flags = EntryLibrary, _Flags(flags)
        if is_nested():
            kind = InnerLibrary
            flags.no_compile = flags.no_cpython_wrapper = True
        if is_nested() or not flags.no_cpython_wrapper:  # else C calls it
            flags.no_cfunc_wrapper = True
        super().__init__(typingctx, targetctx, library, args, return_type, flags, locals)
        self._kind = kind

    def define_pipelines(self) -> list[Any]:
        """Numba's passes, with our own lowering."""
        pipelines = super().define_pipelines()
        for pipeline in pipelines:
            own = {typed_passes.NativeLowering: numba_shortcuts.Lowering}
            pipeline.passes = [(own.get(kind, kind), text) for kind, text in pipeline.passes]
            pipeline.finalize()
        return pipelines

    def compile_extra(self, func: Any) -> Any:
        """Compile `func`; the garbage collector waits, which would visit all of the compiler's objects."""
        if self.state.library is None:
            library = self._kind(self.state.targetctx.codegen(), func.__qualname__)
            library.enable_object_caching()
            self.state.library = library
        if is_nested():
            return super().compile_extra(func)
        collects, begun = gc.isenabled(), time.process_time()
        gc.disable()
        try:
            with _inner_libraries(self.state.targetctx.codegen()), numba_shortcuts.shortcuts():
                return super().compile_extra(func)
        finally:
            KernelCompiler.seconds = time.process_time() - begun
            if collects:
                gc.enable()


@contextlib.contextmanager
def _inner_libraries(code_generator: Any) -> Iterator[None]:
    """Whatever Numba compiles meanwhile is for the kernel alone: bodies of parallel loops, its own functions."""
    set_env = code_generator.set_env

    def set_existing(name: str, environment: Any) -> None:
        if code_generator._engine.is_symbol_defined(name):
            set_env(name, environment)

    code_generator._library_class, code_generator.set_env = InnerLibrary, set_existing
    try:
        yield
    finally:
        del code_generator._library_class, code_generator.set_env


def _compile(dispatcher: Any, sig: Any) -> Any:
    """``Dispatcher.compile``: what was compiled for other kernels is compiled again when Python calls it."""
    arguments = tuple(sigutils.normalize_signature(sig)[0])
    known = dispatcher.overloads.get(arguments)
    if known is not None and not fits(known.library):
        dispatcher.overloads.pop(arguments, None)
        known = None
    if not is_nested():
        return type(dispatcher).compile(dispatcher, sig)
    if known is None:  # the same without Numba's timers, of which each would hear of each call of LLVM in each other
        known = _compile_inner(dispatcher, sig)
    return known.entry_point


def _compile_inner(dispatcher: Any, sig: Any) -> Any:
    arguments, return_type = sigutils.normalize_signature(sig)
    with dispatcher._compiling_counter:
        try:
            result = dispatcher._compiler.compile(arguments, return_type)
        except errors.ForceLiteralArg as error:
            raise error.bind_fold_arguments(
                lambda args, kws: dispatcher._compiler.fold_argument_types(args, kws)[1]
            ) from None
    dispatcher.add_overload(result)
    return dispatcher.overloads[tuple(result.signature.args)]


def fits(library: Any) -> bool:
    """Whether a library can be used now: to link it, its LLVM code must be there; to call it, its machine code."""
    return not isinstance(library, LoadedLibrary if is_nested() else InnerLibrary)


def _add_overload(dispatcher: Any, cres: Any) -> None:
    """``Dispatcher.add_overload``: what has no machine code is known to the compiler, not to Python."""
    if not isinstance(cres.library, InnerLibrary):
        type(dispatcher).add_overload(dispatcher, cres)
        return
    cres = cres._replace(entry_point=object())  # the name under which callers find it
    dispatcher.targetctx.insert_user_function(cres.entry_point, cres.fndesc, [cres.library])
    dispatcher.overloads[tuple(cres.signature.args)] = cres


def adopt(dispatcher: Any) -> None:
    """Have a dispatcher made with `KernelCompiler` distinguish the two kinds of code."""
    dispatcher.compile = python_types.MethodType(_compile, dispatcher)
    dispatcher.add_overload = python_types.MethodType(_add_overload, dispatcher)
