"""Translates the expressions of a Numba function for Warp; see `body`."""

from __future__ import annotations

import ast
import math
import types
from typing import TYPE_CHECKING, Any

import numpy as np

from .types import (
    BOOL,
    FLOAT32,
    FLOAT64,
    INT64,
    Array,
    Known,
    Record,
    Struct,
    TranslationError,
    Type,
    Value,
    flat,
    given,
    is_struct,
    promoted,
    shaped,
    together,
    type_of,
    unified,
)

if TYPE_CHECKING:
    from .translate import Translation

_OPERATORS = {
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.FloorDiv: "//", ast.Mod: "%",
    ast.BitAnd: "&", ast.BitOr: "|", ast.BitXor: "^", ast.LShift: "<<", ast.RShift: ">>",
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=",
}  # fmt: skip
#: Functions of one or two numbers, which Numba evaluates in the precision of the arguments.
_MATHS = {
    math.sqrt: "sqrt", math.sin: "sin", math.cos: "cos", math.tan: "tan", math.acos: "acos", math.asin: "asin",
    math.atan: "atan", math.atan2: "atan2", math.exp: "exp", math.log: "log", math.pow: "pow", np.sqrt: "sqrt",
    np.floor: "floor", math.copysign: "copysign", np.exp: "exp", np.log: "log", np.abs: "abs", np.sin: "sin",
    np.cos: "cos", np.arccos: "acos", np.degrees: "degrees",
}  # fmt: skip
_CASTS = {int: INT64, float: FLOAT64, bool: BOOL}
_ANY = object()


class Expressions:
    """Translation of the expressions of a function.

    A call of what returns a tuple takes lines of its own, which go before the one under way.

    Parameters
    ----------
    translation : Translation
        Of which the function is a part.
    function : callable
    tree : ast.FunctionDef
        Its syntax.
    arguments : dict of str to Value
        Its parameters by name.

    Attributes
    ----------
    result : object
        Type of what the function returns.
    line : int
        Of the function's text, under way; for errors.
    """

    def __init__(
        self, translation: Translation, function: Any, tree: ast.FunctionDef, arguments: dict[str, Value]
    ) -> None:
        self._all, self._function, self._tree = translation, function, tree
        self._arguments = arguments
        self._types: dict[str, Type] = {name: value.type for name, value in arguments.items()}
        self._handles: dict[str, Value] = {}
        self._assigned = assigned(tree)
        self.result: Type = None
        self._lines: list[str] = []
        self._indent = 1
        self._temporaries = 0
        self.line = 1

    def _emit(self, text: str) -> None:
        self._lines.append("    " * self._indent + text)

    def _place(self, node: ast.expr) -> str:
        indices = node.elts if isinstance(node, ast.Tuple) else [node]
        return ", ".join(self._as(self.value(i), "int32") for i in indices)

    def _temporary(self) -> str:
        self._temporaries += 1
        return f"t_{self._temporaries}"

    def _kept(self, value: Value) -> Value:
        """A value that later assignments do not change."""
        if value.parts:
            return together([self._kept(part) for part in value.parts], value.type)
        if not isinstance(value.type, str) or value.constant is not None:
            return value
        name = self._temporary()
        self._emit(f"{name} = wp.{value.type}({value.text})")
        return Value(name, value.type)

    def _fresh(self, value: Value, kind: str) -> str:
        """Text of a value that a variable starts with."""
        return f"{'wp.' if value.constant is None else 'fresh_'}{kind}({self._as(value, kind)})"

    def _as(self, value: Value, kind: str) -> str:
        """Text of a value as a number of a type."""
        if value.constant is not None and value.type != kind:
            return self._all.number(_python(kind)(value.constant), kind)
        return value.as_type(kind)

    def value(self, node: ast.expr) -> Value:
        """An expression."""
        constant = self._constant(node)
        if constant is not _ANY:
            return self._number(constant)
        handler = getattr(self, f"_of_{type(node).__name__}", None)
        if handler is None:
            raise TranslationError(ast.unparse(node), "has no counterpart", "Write it otherwise")
        found: Value = handler(node)
        return found

    def _number(self, constant: Any) -> Value:
        if isinstance(constant, tuple):
            return together([self._number(part) for part in constant])
        kind = type_of(constant)
        if kind is None:
            raise TranslationError(repr(constant), "is no number", "Use numbers")
        return Value(self._all.number(constant, kind), kind, constant)

    def _object(self, node: ast.expr) -> Any:
        """What an expression without variables is: a number, a function, a module; `_ANY` if it has variables."""
        if isinstance(node, ast.Constant):
            return node.value
        if isinstance(node, ast.Name):
            local = node.id in self._arguments or node.id in self._assigned
            return _ANY if local else self._all.resolve(self._function, node.id)
        if isinstance(node, ast.Attribute):
            owner = self._object(node.value)
            if owner is _ANY:
                return _ANY
            found = getattr(owner, node.attr)
            return self._all.constants(owner, node.attr, found) if isinstance(owner, types.ModuleType) else found
        return _ANY

    def _constant(self, node: ast.expr) -> Any:
        """Value of an expression of constants alone, or `_ANY`."""
        found = self._object(node)
        if found is not _ANY:
            known = isinstance(found, tuple) or type_of(found) is not None
            return found if known else _ANY
        if isinstance(node, (ast.BinOp, ast.UnaryOp, ast.Subscript, ast.Compare, ast.BoolOp)) or (
            isinstance(node, ast.Call) and not node.keywords and self._pure(self._object(node.func))
        ):
            names: dict[str, Any] = {}
            replaced = _Replaced(self, names).visit(ast.parse(ast.unparse(node), mode="eval"))
            if names.pop("variables", None) is None:
                with np.errstate(over="ignore"):
                    return eval(compile(ast.fix_missing_locations(replaced), "constant", "eval"), names)
        return _ANY

    def _pure(self, found: Any) -> bool:
        return (
            found in _CASTS or found in (min, max, abs) or (isinstance(found, type) and issubclass(found, np.generic))
        )

    def _of_Name(self, node: ast.Name) -> Value:
        if node.id in self._handles:
            return self._handles[node.id]
        if node.id in self._arguments and node.id not in self._assigned:
            return self._arguments[node.id]
        if self._types.get(node.id) is None:
            raise TranslationError(node.id, "is read before it is assigned", "Assign it")
        return named(node.id, self._types[node.id])

    def _of_Tuple(self, node: ast.Tuple) -> Value:
        return together(self._list(node.elts))

    def _list(self, nodes: list[ast.expr]) -> list[Value]:
        values: list[Value] = []
        for node in nodes:
            if isinstance(node, ast.Starred):
                values += self.value(node.value).elements()
            else:
                values.append(self.value(node))
        return values

    def _of_Attribute(self, node: ast.Attribute) -> Value:
        owner = self.value(node.value)
        if isinstance(owner.type, Array) and node.attr == "shape":
            sizes = [f"wp.int64({owner.text}.shape[{axis}])" for axis in range(owner.type.axes)]
            return together([Value(size, INT64) for size in sizes])
        if isinstance(owner.type, Record) and node.attr in owner.type.kind._fields:
            return owner.parts[owner.type.kind._fields.index(node.attr)]
        if not isinstance(owner.type, Struct):
            raise TranslationError(ast.unparse(node), "is no field", "Use a named tuple")
        return Value(f"{owner.text}.{node.attr}", owner.type.fields[node.attr])

    def _of_Subscript(self, node: ast.Subscript) -> Value:
        owner = self.value(node.value)
        if isinstance(owner.type, Array):
            fewer = owner.type.axes - (len(node.slice.elts) if isinstance(node.slice, ast.Tuple) else 1)
            kind = Array(owner.type.element, fewer) if fewer else owner.type.element
            return Value(f"{owner.text}[{self._place(node.slice)}]", kind)
        if not owner.parts:
            raise TranslationError(ast.unparse(node), "is no element", "Index arrays and tuples")
        if isinstance(node.slice, ast.Slice):
            bounds = [None if b is None else self._constant(b) for b in (node.slice.lower, node.slice.upper)]
            return together(list(owner.parts[slice(*bounds)]))
        which = self._constant(node.slice)
        if which is _ANY:
            raise TranslationError(ast.unparse(node), "is not known beforehand", "Index tuples by constants")
        return owner.parts[which]

    def _of_UnaryOp(self, node: ast.UnaryOp) -> Value:
        value = self.value(node.operand)
        if isinstance(node.op, ast.Not):
            return Value(f"(not {self._as(value, BOOL)})", BOOL)
        kind = value.type if value.type in (FLOAT32, FLOAT64) else promoted(value.type, value.type)
        sign = {ast.USub: "-", ast.Invert: "~", ast.UAdd: "+"}[type(node.op)]
        return Value(f"({sign}{self._as(value, kind)})", kind)

    def _of_BinOp(self, node: ast.BinOp) -> Value:
        return self._binary(node.op, self.value(node.left), self.value(node.right))

    def _binary(self, operator: ast.operator, left: Value, right: Value) -> Value:
        if isinstance(operator, ast.Pow) and {left.type, right.type} <= {FLOAT32, FLOAT64}:
            kind = promoted(left.type, right.type)
            return Value(f"wp.pow({self._as(left, kind)}, {self._as(right, kind)})", kind)
        if type(operator) not in _OPERATORS:
            raise TranslationError(type(operator).__name__, "has no counterpart", "Write it otherwise")
        if isinstance(operator, (ast.LShift, ast.RShift)):
            kind = promoted(left.type, left.type)
        else:
            kind = promoted(left.type, right.type)
            if isinstance(operator, ast.Div) and kind not in (FLOAT32, FLOAT64):
                kind = FLOAT64
        sides = self._as(left, kind), self._as(right, kind)
        return Value(f"({sides[0]} {_OPERATORS[type(operator)]} {sides[1]})", kind)

    def _of_Compare(self, node: ast.Compare) -> Value:
        if isinstance(node.ops[0], (ast.In, ast.NotIn)):
            own, among = self.value(node.left), self.value(node.comparators[0]).parts
            equal = [f"({own.text} == {self._as(other, own.type)})" for other in among]
            found = f"({' or '.join(equal)})"
            return Value(found if isinstance(node.ops[0], ast.In) else f"(not {found})", BOOL)
        values = self._list([node.left, *node.comparators])
        tests = []
        for operator, left, right in zip(node.ops, values, values[1:]):
            kind = FLOAT32 if FLOAT32 in (left.type, right.type) and (left.small or right.small) else None
            kind = kind or promoted(left.type, right.type, arithmetic=False)
            tests.append(f"({self._as(left, kind)} {_OPERATORS[type(operator)]} {self._as(right, kind)})")
        return Value(tests[0] if len(tests) == 1 else f"({' and '.join(tests)})", BOOL)

    def _of_BoolOp(self, node: ast.BoolOp) -> Value:
        start = len(self._lines)
        values = [self.value(inner) for inner in node.values]
        if len(self._lines) != start:
            raise TranslationError("a condition", "calls what returns a tuple", "Call it before")
        word = "and" if isinstance(node.op, ast.And) else "or"
        known = [v for v in values if v.constant is not None]
        if any(bool(v.constant) != (word == "and") for v in known):
            return self._number(word == "or")
        texts = [self._as(v, BOOL) for v in values if v.constant is None]
        return Value(f"({f' {word} '.join(texts)})", BOOL) if texts else self._number(word == "and")

    def _of_IfExp(self, node: ast.IfExp) -> Value:
        test, start = self.value(node.test), len(self._lines)
        if test.constant is not None:
            return self.value(node.body if test.constant else node.orelse)
        body, other = self.value(node.body), self.value(node.orelse)
        if len(self._lines) != start:
            raise TranslationError("a choice", "calls what returns a tuple", "Use if")
        kind = unified(body.type, other.type)
        pairs = zip(body.flat(), other.flat(), flat(kind))
        texts = [f"({self._as(a, k)} if {self._as(test, BOOL)} else {self._as(b, k)})" for a, b, k in pairs]
        return shaped(kind, texts)

    def _of_Call(self, node: ast.Call) -> Value:
        function = self._object(node.func)
        if function is _ANY:
            raise TranslationError(ast.unparse(node.func), "is no function known beforehand", "Name it")
        values = self._list(node.args)
        if node.keywords:
            raise TranslationError(ast.unparse(node), "names its arguments", "Give them in order")
        if isinstance(function, type) and issubclass(function, np.generic):
            return Value(self._as(values[0], function.__name__), function.__name__)
        if isinstance(function, type) and hasattr(function, "_fields"):
            return self._named_tuple(function, values)
        if function in _CASTS:
            return Value(self._as(values[0], _CASTS[function]), _CASTS[function])
        if function in (min, max):
            kind = values[0].type
            for other in values[1:]:
                kind = promoted(kind, other.type, arithmetic=False)
            text = self._as(values[0], kind)
            for other in values[1:]:
                text = f"wp.{function.__name__}({text}, {self._as(other, kind)})"
            return Value(text, kind)
        if function is abs:
            return Value(f"wp.abs({values[0].text})", values[0].type)
        if function is math.floor:
            return Value(f"wp.int64(wp.floor({values[0].text}))", INT64)
        if function is len:
            return Value(f"wp.int64({values[0].text}.shape[0])", INT64)
        if function in _MATHS:
            kind = values[0].type if len(values) == 1 else promoted(values[0].type, values[1].type)
            kind = kind if kind == FLOAT32 else FLOAT64
            if function is math.copysign:
                size, sign = f"wp.abs({self._as(values[0], kind)})", self._as(values[1], kind)
                return Value(f"wp.where({sign} < wp.{kind}(0.0), -{size}, {size})", kind)
            return Value(f"wp.{_MATHS[function]}({', '.join(self._as(v, kind) for v in values)})", kind)
        return self._call(function, values)

    def _named_tuple(self, kind: Any, values: list[Value]) -> Value:
        if not is_struct(kind):
            if len(values) != len(kind._fields):
                raise TranslationError(kind.__name__, f"is made of {len(values)} fields", "Give all of them")
            return together(values, Record(kind, ()))
        name = self._temporary()
        self._emit(f"{name} = {self._all.struct(kind)}()")
        for (field, inner), value in zip(Struct(kind).fields.items(), values):
            self._emit(f"{name}.{field} = {self._as(value, inner) if isinstance(inner, str) else value.text}")
        return Value(name, Struct(kind))

    def _call(self, function: Any, values: list[Value]) -> Value:
        made = self._all.function(function, [v.known for v in values])
        texts = [part.text for v in values for part in v.flat() if not isinstance(part.known, Known)]
        call = f"{made.name}({', '.join(texts)})"
        if isinstance(made.result, Known):
            return shaped(made.result, [])
        if not isinstance(made.result, tuple):
            return Value(call, made.result)
        names = [self._temporary() for _ in given(made.result)]
        self._emit(f"{', '.join(names)} = {call}")
        return shaped(made.result, names)


class _Replaced(ast.NodeTransformer):
    """An expression with its globals as they are on the device; notes whether it has variables."""

    def __init__(self, body: Expressions, names: dict[str, Any]) -> None:
        self._body, self._names = body, names

    def visit_Name(self, node: ast.Name) -> ast.expr:
        return self._replace(node)

    def visit_Attribute(self, node: ast.Attribute) -> ast.expr:
        return self._replace(node)

    def visit_Call(self, node: ast.Call) -> ast.expr:
        if not self._body._pure(self._body._object(node.func)):
            self._names["variables"] = True
        self.generic_visit(node)
        return node

    def _replace(self, node: ast.expr) -> ast.expr:
        found = self._body._object(node)
        if found is _ANY:
            self._names["variables"] = True
            return node
        name = f"c{len(self._names)}"
        self._names[name] = found
        return ast.copy_location(ast.Name(name, ast.Load()), node)


def _python(kind: str) -> type:
    return bool if kind == BOOL else float if kind in (FLOAT32, FLOAT64) else int


def named(name: str, kind: Type) -> Value:
    """A variable; of a tuple, its parts."""
    return shaped(kind, [f"{name}_{i}" for i in range(len(flat(kind)))] if isinstance(kind, tuple) else [name])


def assigned(tree: ast.FunctionDef) -> dict[str, int]:
    """Number of assignments of each variable of a function."""
    found: dict[str, int] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found[node.id] = found.get(node.id, 0) + 1
    return found
