"""Shortcuts through Numba while it compiles a kernel: the same machine code's arithmetic, a quarter less time.

Most of compiling is Numba's own Python, and much of that is done again and again:

- which implementation of an operator or function takes the types at hand is searched for at each use (`_call_type`);
- which variables live where is computed after each of some ten passes, of which the last one needs it (`_postprocess`);
- the variables of an instruction are looked for in all it holds, its line number included (`_list_vars`);
- each call of LLVM is an event, of which nobody wants to hear (`_start_event`);
- each function is optimised in full before it is linked into its kernel, which is optimised in full again
  (`optimize_functions`);
- arrays that a function only borrows have their references counted at each use (`Lowering`).

The methods of Numba are replaced while a kernel is compiled, under Numba's own lock, and only in versions that
`kernel_compiler.TESTED` lists.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterable, Iterator
from types import FunctionType
from typing import Any

from llvmlite import binding
from numba.core import base, codegen, config, event, ir, postproc, transforms, types
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import NativeLowering

_get_call_type = types.BaseFunction.get_call_type
_run = postproc.PostProcessor.run
_start, _end = event.start_event, event.end_event
_refresh_all = base.BaseContext.refresh
_inspect_loc: Any = getattr(base, "_has_loc", None)  # versions that were not tried may lack it, and take no shortcuts
#: The event of each call of LLVM.
_CALLS = "numba:llvm_lock"
#: What an instruction holds that is no variable.
_NO_VARIABLES = frozenset({str, int, bool, float, type(None), ir.Loc, ir.Const, ir.Global, ir.FreeVar, ir.Arg})


@contextlib.contextmanager
def shortcuts() -> Iterator[None]:
    """Have Numba take the shortcuts of this module."""
    replaced = {
        (types.BaseFunction, "get_call_type"): _call_type,
        (postproc.PostProcessor, "run"): _postprocess,
        (ir.Inst, "_rec_list_vars"): _list_vars,
        (event, "start_event"): _start_event,
        (event, "end_event"): _end_event,
        (base.BaseContext, "refresh"): _refresh,
        (base, "_has_loc"): _has_loc,
    }
    originals = {key: getattr(*key) for key in replaced}
    for (owner, name), method in replaced.items():
        setattr(owner, name, method)
    try:
        yield
    finally:
        for (owner, name), method in originals.items():
            setattr(owner, name, method)


def _call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
    """``BaseFunction.get_call_type``, which remembers what it found.

    Not where the implementation is a function compiled for these types, which has its own memory: that is what it is
    when the implementation's key is not the function itself.
    """
    if kws:
        return _get_call_type(self, context, args, kws)
    known = self.__dict__.setdefault("_drgs_call_types", {})
    key = context, tuple(args)
    signature: Any = known.get(key)
    if signature is None:
        signature = _get_call_type(self, context, args, kws)
        if self._impl_keys.get(signature.args) is self.typing_key:
            known[key] = signature
    return signature


def _postprocess(self: Any, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
    """``PostProcessor.run``: lifetimes are computed where they are asked for."""
    function = self.func_ir
    if emit_dels or function.is_generator:
        _run(self, emit_dels, extend_lifetimes)
        return
    function.blocks = transforms.canonicalize_cfg(function.blocks)
    function.variable_lifetime = postproc.VariableLifetime(function.blocks)
    function.generator_info = None


def _list_vars(self: Any, value: Any) -> list[Any]:
    """``Inst._rec_list_vars``, into one list, by the type of what is looked at."""
    found: list[Any] = []
    _gather((value,), found)
    return found


def _gather(parts: Iterable[Any], found: list[Any]) -> None:
    """Append the variables among parts of an instruction to those found, in order."""
    for part in parts:
        kind = type(part)
        if kind is ir.Var:
            found.append(part)
        elif kind in _NO_VARIABLES:
            pass
        elif kind is ir.Expr:
            _gather(part._kws.values(), found)
        elif kind is dict:
            _gather(part.values(), found)
        elif isinstance(part, (list, tuple)):
            _gather(part, found)
        elif isinstance(part, ir.Inst):
            found.extend(part.list_vars())


def _start_event(kind: str, data: Any = None) -> None:
    """``event.start_event``, which tells nobody that LLVM is called: some 70,000 times for a frame's kernels."""
    if kind != _CALLS:
        _start(kind, data)


def _end_event(kind: str, data: Any = None, exc_details: Any = None) -> None:
    if kind != _CALLS:
        _end(kind, data, exc_details)


def _refresh(self: Any) -> None:
    """``BaseContext.refresh``, if a module was imported, or an implementation registered, since the last time."""
    registries = (*self._registries, *self.typing_context._registries)
    state = len(sys.modules), sum(len(part) for registry in registries for part in vars(registry).values())
    if self.__dict__.get("_drgs_refreshed") != state:
        _refresh_all(self)
        self._drgs_refreshed = state


def _has_loc(function: Any) -> bool:
    """``_has_loc``, which tells from a function's code whether it takes ``loc``."""
    if type(function) is not FunctionType or function.__dict__:  # it may say that it has another's signature
        return bool(_inspect_loc(function))
    code = function.__code__
    return "loc" in code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]


def optimize_functions(library: Any, module: Any) -> None:
    """Make a module's functions shorter before they are linked; they are optimised in full as parts of a kernel.

    Parameters
    ----------
    library : numba.core.codegen.JITCodeLibrary
    module : llvmlite.binding.ModuleRef
        Changed in place.
    """
    module.data_layout = library._codegen._data_layout
    builder = binding.create_pass_builder(library._codegen._tm, binding.create_pipeline_tuning_options(speed_level=1))
    passes = binding.create_new_function_pass_manager()
    passes.add_sroa_pass()
    passes.add_simplify_cfg_pass()
    passes.add_instruction_combine_pass()
    if config.LLVM_REFPRUNE_PASS:
        passes.add_refprune_pass(codegen._parse_refprune_flags())
    for function in module.functions:
        if not function.is_declaration:
            passes.run(function, builder)


@register_pass(mutates_CFG=True, analysis_only=False)
class Lowering(NativeLowering):
    """Numba's lowering, without counts of references in functions that only borrow arrays."""

    _name = "native_lowering"

    def run_pass(self, state: Any) -> bool:
        """Lower a function."""
        if not _borrows(state):
            return super().run_pass(state)
        counting = state.targetctx
        state.targetctx = counting.subtarget(enable_nrt=False)
        try:
            return super().run_pass(state)
        finally:
            state.targetctx = counting


#: Expressions that pass on what they are made of.
_VIEWS = frozenset({"build_tuple", "cast", "exhaust_iter", "getiter", "iternext", "pair_first", "pair_second", "phi"})


def _borrows(state: Any) -> bool:
    """Whether a function gets no memory of its own: it returns none, none of its calls does, all arrays are views.

    What it calls may: its arrays are released before it returns. In doubt it does not.
    """
    kinds, blocks = state.typemap, state.func_ir.blocks.values()

    def counted(kind: Any) -> bool:
        return state.targetctx.data_model_manager[kind].contains_nrt_meminfo()

    def plain(kind: Any) -> bool:
        """Arrays and tuples of them, or nothing that is counted; no lists and strings."""
        if isinstance(kind, types.containers.BaseTuple):
            return all(map(plain, kind.types))
        if isinstance(kind, types.Callable):
            return not isinstance(kind, types.ObjModeDispatcher)
        return isinstance(kind, types.Array) or not counted(kind)

    def is_view(value: Any) -> bool:
        if value.op == "call":
            return isinstance(kinds[value.func.name], types.NamedTupleClass)
        if value.op == "getattr":
            return value.attr != "imag"
        if value.op in ("getitem", "typed_getitem", "static_getitem"):
            index = value.index_var if value.op == "static_getitem" else value.index
            if isinstance(index, ir.Var) and counted(kinds[index.name]):
                return False  # by an array: a copy
            return value.op == "static_getitem" or isinstance(kinds[value.value.name], types.Array)
        return value.op in _VIEWS

    if counted(state.return_type) or state.func_ir.is_generator or not all(map(plain, kinds.values())):
        return False
    for statement in (statement for block in blocks for statement in block.body):
        if isinstance(statement, (ir.DynamicRaise, ir.Print)):
            return False
        if isinstance(statement, (ir.SetItem, ir.StaticSetItem)):
            index = getattr(statement, "index_var", None) or statement.index
            if any(isinstance(v, ir.Var) and counted(kinds[v.name]) for v in (statement.value, index)):
                return False  # the value may have to be copied
        value = getattr(statement, "value", None)
        if isinstance(value, ir.Expr) and counted(kinds[statement.target.name]) and not is_view(value):
            return False
    return True
