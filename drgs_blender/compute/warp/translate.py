"""Translates Numba's scalar functions for Warp: the same source, compiled for the CPU here and the device there.

What is translated are functions of numbers, tuples, named tuples and elements of arrays, as the renderer's kernels
call them for one ray or one point. Their types are inferred from those of the first arguments as Numba infers them, and
every conversion is written out, for Warp converts nothing by itself. Tuples vanish: they become their parts.
"""

from __future__ import annotations

import ast
import inspect
import sys
import textwrap
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from .body import Body
from .expressions import assigned
from .types import SCALARS, Struct, TranslationError, Type, given, shaped, spelled

#: A constant of a module, by the module's and its own name, as the device has it instead.
Constants = Callable[[types.ModuleType, str, Any], Any]


def replacing(module: types.ModuleType, name: str, number: int) -> Constants:
    """`Constants` of which one differs on the device.

    Parameters
    ----------
    module : module
        Whose functions have the constant among their globals.
    name : str
    number : int
        What the device has instead.

    Raises
    ------
    AttributeError
        The module has no such constant, so that nothing would be replaced.
    """
    getattr(module, name)
    return lambda owner, asked, value: number if owner is module and asked == name else value


_HEAD = '''"""Made of this package's sources; changes are lost."""

import warp as wp

wp.set_module_options({{"enable_backward": False, "max_unroll": 1, "fuse_fp": {fused}}})

# A variable that starts as a named constant is one with it, in Warp 1.19: loops would change the constant.
'''
_FRESH = "@wp.func\ndef fresh_{kind}(x: wp.{kind}):\n    return x"


@dataclass(frozen=True)
class Native:
    """A function of the device's own, in place of one that only the CPU has.

    Attributes
    ----------
    source : str
        Text of a Warp function; its name is ``name``.
    name : str
        Unlike any other's.
    result : object
        Type of what it returns.
    structs : tuple of type
        Named tuples that it takes.
    uses : tuple
        Functions that natives stand for, which it calls.
    """

    source: str
    name: str
    result: Type
    structs: tuple[type, ...] = ()
    uses: tuple[Any, ...] = ()


@dataclass
class Made:
    """A translated function: its name, and the type of what it returns; `Known` where every return says the same."""

    name: str
    result: Type = None


@dataclass
class Translation:
    """Source of a Warp module, made function by function.

    Parameters
    ----------
    natives : mapping
        Replacements of functions that are not translated: the device's own, or translated ones.
    constants : callable
        May replace integers of modules, see `Constants`.
    fused : bool
        Whether products and sums may be fused, which rounds otherwise than the CPU does.
    """

    natives: Mapping[Any, Native | types.FunctionType] = field(default_factory=dict)
    constants: Constants = lambda module, name, value: value
    fused: bool = False
    _made: dict[Any, Made] = field(default_factory=dict)
    _texts: list[str] = field(default_factory=list)
    _numbers: dict[tuple[str, str], str] = field(default_factory=dict)
    _structs: dict[type, str] = field(default_factory=dict)
    _natives: dict[str, Native] = field(default_factory=dict)

    @property
    def source(self) -> str:
        """The module's text."""
        numbers = [f"{name} = wp.constant(wp.{kind}({text}))" for (kind, text), name in self._numbers.items()]
        natives = [native.source.strip() for native in self._natives.values()]
        fresh = [_FRESH.format(kind=kind) for kind in SCALARS]
        parts = [_HEAD.format(fused=self.fused).strip(), *fresh, "\n".join(numbers), *self._structs.values(), *natives]
        return "\n\n\n".join([*parts, *self._texts]) + "\n"

    def add(self, text: str) -> None:
        """Append hand-written text, such as a kernel, that uses what was translated."""
        self._texts.append(text.strip())

    def function(self, function: Any, arguments: Sequence[Type]) -> Made:
        """Translate a function, and all that it calls, for arguments of these types.

        Raises
        ------
        TranslationError
            Names the function and the line that has no counterpart.
        """
        function = getattr(function, "py_func", function)
        native = self.natives.get(function)
        if isinstance(native, types.FunctionType):
            function, native = native, None
        if native is None and not isinstance(function, types.FunctionType):
            raise TranslationError(str(function), "has no counterpart", "Write it otherwise")
        if native is not None:
            for used in native.uses:
                self.function(used, ())
            self._natives[native.name] = native
            for kind in native.structs:
                self.struct(kind)
            return Made(native.name, native.result)
        key = function, tuple(arguments)
        if key not in self._made:
            module = function.__module__.rsplit(".", 1)[-1]
            made = self._made[key] = Made(f"{module}_{function.__name__.strip('_')}_{len(self._made)}")
            self._define(function, arguments, made)
        return self._made[key]

    def struct(self, kind: type) -> str:
        """Declare a named tuple; return its name."""
        if kind not in self._structs:
            lines = []
            for name, inner in Struct(kind).fields.items():
                if isinstance(inner, Struct):
                    self.struct(inner.kind)
                lines.append(f"    {name}: {spelled(inner)}")
            self._structs[kind] = "\n".join(["@wp.struct", f"class {kind.__name__}:", *lines])
        return kind.__name__

    def number(self, value: Any, kind: str) -> str:
        """Name of a constant: Warp would take large integers in the text for small ones."""
        if kind == "bool":
            return f"wp.bool({bool(value)})"
        text = repr(float(value)) if kind.startswith("float") else repr(int(value))
        text = text.replace("inf", "wp.inf").replace("nan", "wp.nan")
        return self._numbers.setdefault((kind, text), f"N{len(self._numbers)}")

    def resolve(self, function: Any, name: str) -> Any:
        """Translation of a global name of a function."""
        if name in function.__globals__:
            return self.constants(sys.modules[function.__module__], name, function.__globals__[name])
        closure = inspect.getclosurevars(function)
        found = {**closure.builtins, **closure.nonlocals}
        if name not in found:
            raise TranslationError(f"name {name!r}", "is unknown", "Define it")
        return found[name]

    def _define(self, function: Any, arguments: Sequence[Type], made: Made) -> None:
        source = textwrap.dedent(inspect.getsource(function))
        tree = ast.parse(source).body[0]
        assert isinstance(tree, ast.FunctionDef)
        names = [a.arg for a in tree.args.args]
        if len(names) != len(arguments):
            raise TranslationError(made.name, f"takes {len(names)} arguments, not {len(arguments)}", "Check the call")
        parameters, values = [], {}
        changed = assigned(tree)
        for name, kind in zip(names, arguments):
            own = f"{name}_given" if name in changed else name
            texts = [f"{own}_{i}" for i in range(len(given(kind)))] if isinstance(kind, tuple) else [own]
            for text, scalar in zip(texts, given(kind)):
                if isinstance(scalar, Struct):
                    self.struct(scalar.kind)
                parameters.append(f"{text}: {spelled(scalar)}")
            values[name] = shaped(kind, texts)
        body = Body(self, function, tree, values)
        try:
            lines = body.translated()
        except TranslationError as error:
            place = f"{function.__code__.co_filename}:{function.__code__.co_firstlineno + body.line - 1}"
            raise TranslationError(f"{place}, {error.subject}", error.problem, error.remedy) from error
        made.result = body.result
        self._texts.append("\n".join(["@wp.func", f"def {made.name}({', '.join(parameters)}):", *lines]))
