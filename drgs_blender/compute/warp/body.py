"""Translates the statements of a Numba function for Warp; see `translate`."""

from __future__ import annotations

import ast

import numpy as np

from .expressions import Expressions, named
from .types import BOOL, INT64, Array, Known, TranslationError, Type, Value, alike, flat, unified


class Body(Expressions):
    """Statements of a function, written again as Warp's."""

    def translated(self) -> list[str]:
        """Indented lines, once the types of all variables hold wherever they are used."""
        while True:
            before = dict(self._types), self.result
            self._lines, self._indent, self._temporaries = [], 1, 0
            self._block(self._tree.body)
            if (self._types, self.result) == before:
                break
        declared = []
        for name in sorted(self._assigned):
            kind = self._types.get(name)
            if name in self._handles or kind is None:
                continue
            starts = self._arguments[name].flat() if name in self._arguments else [None] * len(flat(kind))
            for part, value in zip(named(name, kind).flat(), starts):
                if isinstance(part.type, str):
                    start = self._number(np.dtype(part.type).type(0)) if value is None else value
                    declared.append(f"    {part.text} = {self._fresh(start, part.type)}")
        return declared + (self._lines or ["    pass"])

    def _block(self, statements: list[ast.stmt]) -> None:
        for statement in statements:
            self.line = statement.lineno
            handler = getattr(self, f"_on_{type(statement).__name__}", None)
            if handler is None:
                raise TranslationError(type(statement).__name__, "has no counterpart", "Write it otherwise")
            handler(statement)

    def _indented(self, statements: list[ast.stmt]) -> None:
        self._indent += 1
        start = len(self._lines)
        self._block(statements)
        if len(self._lines) == start:
            self._emit("pass")
        self._indent -= 1

    def _on_Pass(self, node: ast.Pass) -> None:
        pass

    def _on_Continue(self, node: ast.Continue) -> None:
        self._emit("continue")

    def _on_Break(self, node: ast.Break) -> None:
        self._emit("break")

    def _on_Assert(self, node: ast.Assert) -> None:
        pass

    def _on_Expr(self, node: ast.Expr) -> None:
        if isinstance(node.value, ast.Constant):
            return
        value = self.value(node.value)
        if value.text:
            self._emit(value.text)

    def _on_Return(self, node: ast.Return) -> None:
        if node.value is None:
            self._emit("return")
            return
        value = self.value(node.value)
        self.result = unified(self.result, value.known)
        parts = [(v, k) for v, k in zip(value.flat(), flat(self.result)) if not isinstance(k, Known)]
        self._emit("return " + ", ".join(self._as(v, k) if isinstance(k, str) else v.text for v, k in parts))

    def _on_If(self, node: ast.If) -> None:
        test = self.value(node.test)
        if test.constant is not None:
            self._block(node.body if test.constant else node.orelse)
            return
        self._emit(f"if {self._as(test, BOOL)}:")
        self._indented(node.body)
        if node.orelse:
            self._emit("else:")
            self._indented(node.orelse)

    def _on_While(self, node: ast.While) -> None:
        start = len(self._lines)
        test = self.value(node.test)
        if len(self._lines) != start:
            raise TranslationError("a loop's condition", "calls what returns a tuple", "Call it in the loop")
        self._emit(f"while {self._as(test, BOOL)}:")
        self._indented(node.body)

    def _on_For(self, node: ast.For) -> None:
        call = node.iter
        if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "range"):
            raise TranslationError("a loop", "is not over a range", "Count")
        assert isinstance(node.target, ast.Name)
        bounds = ", ".join(self._as(self.value(a), "int32") for a in call.args)
        counter = self._temporary()
        self._emit(f"for {counter} in range({bounds}):")
        self._indent += 1
        self._assign(node.target, Value(counter, "int32"), kind=INT64)
        self._indent -= 1
        self._indented(node.body)

    def _on_AugAssign(self, node: ast.AugAssign) -> None:
        load = ast.parse(ast.unparse(node.target), mode="eval").body
        self._assign(node.target, self._binary(node.op, self.value(load), self.value(node.value)))

    def _on_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self._assign(node.target, self.value(node.value))

    def _on_Assign(self, node: ast.Assign) -> None:
        value = self.value(node.value)
        if len(node.targets) > 1 or isinstance(node.value, ast.Tuple):
            value = self._kept(value)  # all is read before anything is written
        for target in node.targets:
            self._assign(target, value)

    def _assign(self, target: ast.expr, value: Value, kind: Type = None) -> None:
        if isinstance(target, ast.Name):
            if target.id != "_":
                self._assign_name(target.id, value, kind)
        elif isinstance(target, ast.Tuple):
            parts = value.elements()
            if len(target.elts) != len(parts):
                raise TranslationError("an assignment", "of a tuple of another length", "Count")
            for inner, part in zip(target.elts, parts):
                self._assign(inner, part)
        elif isinstance(target, ast.Subscript):
            self._store(target, value)
        else:
            raise TranslationError(ast.unparse(target), "cannot be assigned to", "Use a variable")

    def _assign_name(self, name: str, value: Value, kind: Type) -> None:
        known = all(isinstance(part.constant, bool) for part in value.flat())
        if (known and self._assigned.get(name) == 1) or any(not isinstance(k, str) for k in flat(value.type)):
            # Arrays and named tuples are not copied: the name is another one for them.
            if self._assigned.get(name, 0) > 1:
                raise TranslationError(name, "is assigned more than once", "Use two names")
            self._handles[name], self._types[name] = value, value.type
            return
        kind = value.type if kind is None else kind
        if not all(alike(a, b) for a, b in zip(flat(self._types.get(name) or kind), flat(kind))):
            # Numba gives each assignment a variable of its own, and takes no account of other ones' types.
            raise TranslationError(name, f"is {self._types[name]} here and {kind} there", "Use two names")
        self._types[name] = kind = unified(self._types.get(name), kind)
        for part, own in zip(named(name, kind).flat(), value.flat()):
            self._emit(f"{part.text} = {self._fresh(own, part.type)}")

    def _store(self, target: ast.Subscript, value: Value) -> None:
        array = self.value(target.value)
        if not isinstance(array.type, Array):
            raise TranslationError(ast.unparse(target), "is no element of an array", "Use an array")
        if isinstance(target.slice, ast.Slice):
            names = [self._temporary() for _ in range(array.type.axes)]
            for axis, name in enumerate(names):
                self._emit(f"{'    ' * axis}for {name} in range({array.text}.shape[{axis}]):")
            place, inner = ", ".join(names), "    " * len(names)
            self._emit(f"{inner}{array.text}[{place}] = {self._as(value, array.type.element)}")
            return
        self._emit(f"{array.text}[{self._place(target.slice)}] = {self._as(value, array.type.element)}")
