"""The Python reference: pages in MyST Markdown, one per public module of ``drgs_blender``, from its docstrings.

The sources are read by griffe and never imported, so neither torch nor Blender is needed. Docstrings are numpydoc, with
types or without; what stands in backticks and is a public name becomes a link.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from itertools import accumulate, groupby
from pathlib import Path
from typing import Any

import griffe

PACKAGE = "drgs_blender"
#: Longest default value that a signature shows.
LONGEST = 40
#: Sections of a docstring that list things, and their titles.
LISTS = {
    "parameters": "Parameters",
    "other parameters": "Other parameters",
    "attributes": "Attributes",
    "returns": "Returns",
    "yields": "Yields",
    "receives": "Receives",
    "raises": "Raises",
    "warns": "Warns",
}
#: How Markdown writes what the docstring means literally, outside of code.
LITERAL = str.maketrans({c: "\\" + c for c in "_<>[]{}$~"})


def public_modules(root: Path, package: str = PACKAGE) -> list[str]:
    """Dotted names of the public modules below `root`, packages first.

    Parameters
    ----------
    root : Path
        Folder that holds the package.
    package : str
        Name of the package.

    Returns
    -------
    list of str
        Modules no part of whose name begins with an underscore.
    """
    found = []
    for path in sorted((root / package).rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        parts = parts[:-1] if parts[-1] == "__init__" else parts
        if not any(part.startswith("_") for part in parts):
            found.append(".".join(parts))
    return sorted(found)


def pages(root: Path, package: str = PACKAGE) -> dict[str, str]:
    """The pages of the reference.

    Parameters
    ----------
    root : Path
        Folder that holds the package.
    package : str
        Name of the package.

    Returns
    -------
    dict of str to str
        Name of a module to the text of its page.
    """
    tree: Any = griffe.load(package, search_paths=[str(root)], allow_inspection=False)
    names = public_modules(root, package)
    modules = {name: tree if name == package else tree[name.removeprefix(package + ".")] for name in names}
    writer = Writer(tree, {o.path for m in modules.values() for o in documented(m)} | set(modules))
    made = {}
    for name, module in modules.items():
        made[name] = writer.page(module, [(n, m) for n, m in modules.items() if n.rpartition(".")[0] == name])
    return made


def documented(module: Any) -> Iterator[Any]:
    """The public objects of a module, with those of its classes."""
    for obj in members(module):
        if not obj.is_attribute or comment(module, obj):
            yield obj
        if obj.is_class:
            yield from (m for m in members(obj) if m.is_function or "property" in m.labels)


def members(parent: Any) -> list[Any]:
    """Public functions, classes and attributes of a module or class, in the order of the source."""
    found = [o for n, o in parent.members.items() if not n.startswith("_") and not o.is_alias and not o.is_module]
    return sorted(found, key=lambda o: o.lineno or 0)


class Writer:
    """Writes pages.

    Parameters
    ----------
    tree : griffe.Module
        The package.
    known : set of str
        Paths of everything that has a place in the reference, which links may go to.
    """

    def __init__(self, tree: griffe.Module, known: set[str]) -> None:
        self.tree, self.known = tree, known

    def page(self, module: Any, inside: list[tuple[str, Any]]) -> str:
        """The page of one module; `inside` are names and objects of a package's own modules."""
        # outside of the navigation: a tree of all modules in every page would take most of the site's time and size
        out = ["---", "orphan: true", "---", "", f"# {module.path.translate(LITERAL)}", ""]
        if parents := list(accumulate(module.path.split(".")[:-1], lambda above, part: f"{above}.{part}")):
            out += ["In " + " › ".join(f"[{p.rpartition('.')[2].translate(LITERAL)}]({p}.md)" for p in parents), ""]
        out += [f"```{{py:module}} {module.path}", "```", ""]
        out += self.text(module.docstring.value if module.docstring else "", module)
        if exports := self.exports(module):
            out += ["", f"Also from here: {', '.join(exports)}."]
        if inside:
            rows = [f"| [{n.rpartition('.')[2].translate(LITERAL)}]({n}.md) | {self.summary(m)} |" for n, m in inside]
            out += ["", "| Module | What it is |", "|---|---|", *rows]
        own = members(module)
        constants = [(o, about) for o in own if o.is_attribute and (about := comment(module, o))]
        classes, functions = [o for o in own if o.is_class], [o for o in own if o.is_function]
        for title, objects in (("Classes", classes), ("Functions", functions)):
            if objects:
                out += ["", f"## {title}", ""]
                for obj in objects:
                    out += [*self.class_(obj), ""] if obj.is_class else [*self.function(obj, "py:function"), ""]
        if constants:
            out += ["", "## Constants", ""]
            for obj, about in constants:
                value = f":value: {short(obj.value)}" if obj.value is not None else ""
                body = self.text(about, module)
                out += [*fenced(5, "py:data", obj.name, body, [value] if value else []), ""]
        return "\n".join(out) + "\n"

    def summary(self, module: Any) -> str:
        """The first sentence of a module's docstring, for a table."""
        text = " ".join(module.docstring.value.split("\n\n")[0].split()) if module.docstring else ""
        return self.inline(text, module).replace("|", "\\|")

    def exports(self, module: Any) -> list[str]:
        """Links to what a package names in ``__all__`` and another module defines."""
        found = []
        for name in module.exports or ():
            member = module.members.get(str(name))
            if member is not None and member.is_alias and member.target_path in self.known:
                found.append(f"{{py:obj}}`{name} <{member.target_path}>`")
        return found

    def class_(self, obj: Any) -> list[str]:
        """A class with its methods."""
        init = "__init__" in obj.members or "dataclass" in obj.labels
        signature = self.signature(obj.parameters, obj) if init else ""
        body = self.docstring(obj)
        bases = [str(base) for base in obj.bases]
        if bases:
            body = [f"Base: {', '.join(self.name(base, obj) for base in bases)}.", "", *body]
        body += self.fields(obj)
        for member in members(obj):
            if "property" in member.labels:
                kind = [f":type: {self.annotation(member.annotation, member)}"] if member.annotation else []
                body += ["", *fenced(5, "py:property", member.name, self.docstring(member), kind)]
            elif member.is_function:
                body += ["", *self.function(member, "py:method")]
        return fenced(6, "py:class", obj.name + signature, body)

    def function(self, obj: Any, directive: str) -> list[str]:
        """A function or a method."""
        labels = {"staticmethod": ":staticmethod:", "classmethod": ":classmethod:", "async": ":async:"}
        options = [option for label, option in labels.items() if label in obj.labels]
        returns = f" -> {self.annotation(obj.returns, obj)}" if obj.returns is not None else ""
        signature = obj.name + self.signature(obj.parameters, obj) + returns
        return fenced(5, directive, signature, self.docstring(obj), options)

    def fields(self, obj: Any) -> list[str]:
        """Public fields of a class that its docstring does not list."""
        listed = {name for section in sections(obj) if section.kind.value == "attributes" for name in split(section)}
        out = []
        for member in members(obj):
            if not member.is_attribute or "property" in member.labels or member.name in listed:
                continue
            if about := comment(obj.module, member):
                out.append(self.entry(member.name, str(member.annotation or ""), about, obj))
        return ["", "**Fields**", "", *out] if out else []

    def docstring(self, obj: Any) -> list[str]:
        """The body of a docstring as Markdown."""
        out: list[str] = []
        for section in sections(obj):
            kind = section.kind.value
            if kind == "text":
                out += [*self.text(section.value, obj), ""]
            elif kind in LISTS:
                out += [f"**{LISTS[kind]}**", ""]
                for item in section.value:
                    name = getattr(item, "name", "") or ""
                    out.append(self.entry(name, str(item.annotation or ""), item.description, obj))
                out.append("")
            elif kind == "examples":
                out += ["**Examples**", ""]
                for part, text in section.value:
                    out += self.text(text, obj) if part.value == "text" else ["```python", text, "```"]
                out.append("")
            else:  # notes, warnings, see also
                out += [f"**{(section.title or kind).strip().capitalize()}**", ""]
                value = section.value
                contents = getattr(value, "description", None) or getattr(value, "contents", value)
                out += [*self.text(str(contents), obj), ""]
        return out

    def entry(self, name: str, type_: str, description: str, scope: Any) -> str:
        """One item of a list: a name, its type, what it is."""
        head = f"**{name.translate(LITERAL)}**" if name else ""
        if type_:
            about = self.inline(" ".join(type_.split()), scope, types=True)
            head += f" : {about}" if head else about
        lines = self.text(description, scope) if description else []
        if head and lines:
            head += "\\"  # as numpydoc has it: what it is stands below name and type
        return "\n".join([f"- {head}" if head else f"- {lines.pop(0)}", *("  " + line for line in lines)])

    def text(self, text: str, scope: Any) -> list[str]:
        """Paragraphs of a docstring as Markdown, line by line; what is indented by four spaces is code."""
        lines: list[tuple[bool, str]] = []
        code = False
        for line in text.strip("\n").split("\n"):
            blank = not lines or not lines[-1][1].strip()
            code = (code or blank) if line.startswith("    ") else code and not line.strip()
            lines.append((code, line))
        out: list[str] = []
        for is_code, run in groupby(lines, key=lambda pair: pair[0]):
            part = "\n".join(line for _, line in run)  # as one, because a name in backticks may go over two lines
            found = part if is_code else self.inline(part, scope)
            out += [line if is_code else self.block_start(line) for line in found.split("\n")]
        return out

    @staticmethod
    def block_start(line: str) -> str:
        """A line that begins no heading, comment or rule of Markdown and ends in one colon."""
        return re.sub(r"^(\s*)([#%>]|\+{3}|={2,}|-{3,})", r"\1\\\2", re.sub(r"::$", ":", line))

    def inline(self, text: str, scope: Any, types: bool = False) -> str:
        """Text as Markdown; with `types`, names of classes outside of backticks are links, too."""
        parts = re.split(r"(`+)([^`]+)\1", text)
        out = []
        for index in range(0, len(parts), 3):
            plain = parts[index]
            if types:
                words = re.split(r"(\b[A-Z]\w+\b)", plain)
                out += [self.name(w, scope, code=False) if i % 2 else w.translate(LITERAL) for i, w in enumerate(words)]
            else:
                out.append(plain.translate(LITERAL))
            if index + 2 < len(parts):
                out.append(self.name(parts[index + 2], scope))
        return "".join(out)

    def name(self, text: str, scope: Any, code: bool = True) -> str:
        """A link where `text` names something of the reference from inside `scope`, otherwise code or the text."""
        target = self.resolve(text.removesuffix("()"), scope)
        if target is not None:
            return f"{{py:obj}}`{text} <{target}>`"
        return f"`{text}`" if code else text.translate(LITERAL)

    def resolve(self, text: str, scope: Any) -> str | None:
        """Path in the reference of a name, as the code around it would find it."""
        if not re.fullmatch(r"[A-Za-z_][\w.]*", text):
            return None
        if text in self.known:
            return text
        first, _, rest = text.partition(".")
        for place in (scope, scope.parent, scope.module):
            if place is None:
                continue
            try:
                path = place.resolve(first)
            except griffe.GriffeError:
                continue
            path = self.origin(f"{path}.{rest}" if rest else path)
            if path in self.known:
                return path
            if f"{place.path}.{text}" in self.known:
                return f"{place.path}.{text}"
        return None

    def origin(self, path: str) -> str:
        """Definition of an object that a package re-exports."""
        name = path.removeprefix(self.tree.path + ".")
        try:
            member = self.tree[name] if name != path else None
        except KeyError:
            return path
        return member.target_path if member is not None and member.is_alias else path

    def signature(self, parameters: Any, obj: Any) -> str:
        """Parameters in parentheses, with full names of the types that the reference holds."""
        method = obj.is_class or (obj.parent is not None and obj.parent.is_class and "staticmethod" not in obj.labels)
        out: list[str] = []
        before = None
        for index, p in enumerate(parameters):
            if index == 0 and method and p.name in ("self", "cls"):
                continue
            kind = p.kind.value if p.kind else ""
            if before == "positional-only" and kind != before:
                out.append("/")
            if kind == "keyword-only" and before not in ("keyword-only", "variadic positional"):
                out.append("*")
            before = kind
            star = {"variadic positional": "*", "variadic keyword": "**"}.get(kind, "")
            text = star + p.name
            if p.annotation is not None:
                text += f": {self.annotation(p.annotation, obj)}"
            if p.default is not None and not star:
                text += f" = {short(p.default)}" if p.annotation is not None else f"={short(p.default)}"
            out.append(text)
        if before == "positional-only":
            out.append("/")
        return f"({', '.join(out)})"

    def annotation(self, expression: Any, scope: Any) -> str:
        """A type hint on one line, its names written in full where the reference holds them."""
        if isinstance(expression, str):
            return " ".join(expression.split())
        out = []
        for part in expression.iterate(flat=True):
            name = isinstance(part, griffe.ExprName)
            out.append((self.resolve(part.name, scope) if name else None) or str(part))
        return " ".join("".join(out).split())


def sections(obj: Any) -> list[Any]:
    """The parts of an object's docstring, none where it has no docstring."""
    return obj.docstring.parse("numpy", warnings=False) if obj.docstring else []


def split(section: Any) -> Iterator[str]:
    """The names that a section lists, also several of one line."""
    for item in section.value:
        yield from (name.strip() for name in item.name.split(","))


def comment(module: Any, obj: Any) -> str:
    """The comment ``#:`` above a constant or field, or its docstring; "" where it has neither."""
    if obj.docstring:
        return obj.docstring.value
    lines = module.lines_collection[module.filepath]
    found: list[str] = []
    for line in reversed(lines[: (obj.lineno or 1) - 1]):
        if not line.strip().startswith("#:"):
            break
        found.insert(0, line.strip()[2:].strip())
    return "\n".join(found)


def short(value: Any) -> str:
    """A value on one line, an ellipsis where it is long."""
    text = " ".join(str(value).split())
    return text if len(text) <= LONGEST else "..."


def fenced(ticks: int, directive: str, argument: str, body: list[str], options: Iterable[str] = ()) -> list[str]:
    """A directive between fences of backticks."""
    fence = "`" * ticks
    return [f"{fence}{{{directive}}} {argument}", *options, "", *body, fence]


def write(root: Path, folder: Path) -> list[str]:
    """Write the pages into `folder` and return the names of the modules."""
    folder.mkdir(parents=True, exist_ok=True)
    made = pages(root)
    for name, text in made.items():
        (folder / f"{name}.md").write_text(text, encoding="utf-8")
    return list(made)
