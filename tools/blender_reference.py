"""The reference of Blender's side: operators, and the settings that a script may set, as Blender knows them.

    .venv-blender/bin/python tools/blender_reference.py --out build/docs/blender

Installs the extension from its zip into a folder of its own, as a user does, and asks Blender for every operator and
property. What has no description is an error: it would be a gap in the interface, too.
"""

from __future__ import annotations

import argparse
import inspect
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
#: The extension as Blender names it.
PACKAGE = "bl_ext.user_default.drgs"
#: Properties that every operator or group has from Blender.
OWN = {"rna_type", "name", "bl_idname"}
#: What Blender says of an operator without a description.
UNDESCRIBED = "(undocumented operator)"
#: Limits from which on a number is unlimited.
UNLIMITED = 2**30
#: The word for a value per type of property.
WORDS = {"BOOLEAN": "bool", "INT": "int", "FLOAT": "float", "STRING": "str", "ENUM": "enum"}
#: What Blender's scripts call the owner of settings.
OWNERS = {"Scene": "scene", "ViewLayer": "view_layer", "Object": "object"}


class ReferenceIncomplete(Exception):
    """Operators or properties without a description."""


def operators(package: str = PACKAGE) -> dict[str, Any]:
    """The registered operators whose classes are in a package.

    Parameters
    ----------
    package : str
        Root of the extension's modules.

    Returns
    -------
    dict of str to bpy.types.Struct
        Name behind ``bpy.ops.`` to the operator's type, sorted by name.
    """
    import bpy

    found = {}
    for group in dir(bpy.ops):
        for name in dir(getattr(bpy.ops, group)):
            operator = getattr(getattr(bpy.ops, group), name)
            cls = bpy.types.Operator.bl_rna_get_subclass_py(operator.idname())
            if cls is not None and cls.__module__.startswith(package):
                found[operator.idname_py()] = operator.get_rna_type()
    return dict(sorted(found.items()))


def groups(package: str = PACKAGE) -> dict[str, Any]:
    """The property groups that a script reaches, outermost first.

    Parameters
    ----------
    package : str
        Root of the extension's modules.

    Returns
    -------
    dict of str to bpy.types.Struct
        Expression, such as ``object.drgs.physics``, to the group's type.
    """
    import bpy

    found: dict[str, Any] = {}
    for owner in (getattr(bpy.types, name) for name in dir(bpy.types)):
        rna = getattr(owner, "bl_rna", None)
        if rna is None or not issubclass(owner, bpy.types.bpy_struct) or (rna.base and "drgs" in rna.base.properties):
            continue  # a base class has it already
        for prop in rna.properties:
            if prop.is_runtime and prop.type in ("POINTER", "COLLECTION") and own_group(prop.fixed_type, package):
                start = OWNERS.get(rna.identifier, rna.identifier)
                found |= {f"{start}.{prop.identifier}{path}": group for path, group in nested(prop.fixed_type, package)}
    preferences = bpy.context.preferences.addons[package].preferences
    return found | {f'preferences.addons["{package}"].preferences': preferences.bl_rna}


def own_group(rna: Any, package: str) -> bool:
    """Whether a type is a property group of the extension's."""
    import bpy

    cls = bpy.types.PropertyGroup.bl_rna_get_subclass_py(rna.identifier)
    return cls is not None and cls.__module__.startswith(package)


def nested(rna: Any, package: str) -> Iterator[tuple[str, Any]]:
    """(path, type) of a group and those inside it."""
    yield "", rna
    for prop in properties(rna):
        if prop.type in ("POINTER", "COLLECTION") and own_group(prop.fixed_type, package):
            part = f".{prop.identifier}" + ("[i]" if prop.type == "COLLECTION" else "")
            yield from ((part + path, group) for path, group in nested(prop.fixed_type, package))


def properties(rna: Any) -> list[Any]:
    """The properties that a group or operator adds to what Blender gives it.

    Hidden ones without a description are between Blender's file browser and an operator.
    """
    is_group = rna.base is not None and rna.base.identifier == "PropertyGroup"  # Blender 5.3 adds a name to each
    added = [p for p in rna.properties if p.identifier not in OWN or (p.is_runtime and not is_group)]
    return [p for p in added if p.description.strip() or not p.is_hidden]


def undescribed(package: str = PACKAGE) -> list[str]:
    """Names of operators and properties without a description.

    Parameters
    ----------
    package : str
        Root of the extension's modules.

    Returns
    -------
    list of str
        Operators as ``bpy.ops.drgs.bake``, properties as ``scene.drgs.rays_see``.
    """
    found = []
    for name, rna in operators(package).items():
        found += [f"bpy.ops.{name}"] * (rna.description.strip() in ("", UNDESCRIBED))
        found += [f"bpy.ops.{name}({p.identifier})" for p in properties(rna) if not p.description.strip()]
    for name, rna in groups(package).items():
        found += [f"{name}.{p.identifier}" for p in properties(rna) if not p.description.strip()]
    return found


def pages(package: str = PACKAGE) -> dict[str, str]:
    """The pages of the reference.

    Parameters
    ----------
    package : str
        Root of the extension's modules.

    Returns
    -------
    dict of str to str
        File name to Markdown.

    Raises
    ------
    ReferenceIncomplete
        Something has no description.
    """
    if missing := undescribed(package):
        raise ReferenceIncomplete(f"without a description: {', '.join(missing)}. Give each one where it is defined")
    return {"operators.md": operators_page(package), "properties.md": properties_page(package), "index.md": INDEX}


INDEX = """# Operators and properties

What `blender -b --python script.py` and add-ons use. The extension is enabled as
`bl_ext.user_default.drgs`, or under the name of the repository that it was installed from.

- [Operators](operators.md): `bpy.ops.drgs`
- [Properties](properties.md): the settings of scenes, view layers and objects, and the preferences

```{toctree}
:hidden:

operators
properties
```
"""

OPERATORS = """All arguments are keywords, and all have defaults. An operator that cannot run where it is called, or
that fails, raises RuntimeError in a script, with the message that an artist sees. Operators act on the active or the
selected objects of `bpy.context`, as in the window."""

PROPERTIES = """`scene` is a `bpy.types.Scene`, such as `bpy.context.scene`; `view_layer` one of `scene.view_layers`;
`object` a `bpy.types.Object`; `preferences` is `bpy.context.preferences`. `[i]` is an item of a collection: `add()` on
the collection makes one. Angles are in radians, lengths in metres."""


def operators_page(package: str) -> str:
    """The operators, one a heading."""
    out = ["# Operators", "", OPERATORS]
    for name, rna in operators(package).items():
        own = properties(rna)
        call = f"bpy.ops.{name}({', '.join(f'{p.identifier}={default(p)}' for p in own)})"
        out += ["", f"## {name}", "", f"*{text(rna.name)}*: {text(rna.description)}", "", "```python", call, "```"]
        out += ["", *table(own)] if own else []
    return "\n".join(out) + "\n"


def properties_page(package: str) -> str:
    """The property groups, one a heading."""
    out = ["# Properties", "", PROPERTIES]
    for name, rna in groups(package).items():
        out += ["", f"## {text(name)}", ""]
        cls = python_class(rna)
        about = inspect.getdoc(cls) or rna.description if cls is not None else rna.description
        out += [text(about), "", *table(properties(rna))]
        computed = [(n, p) for n, p in vars(cls).items() if isinstance(p, property) and p.__doc__] if cls else []
        if computed:
            out += ["", "Only to be read:", "", *(f"- `{n}`: {text(p.__doc__ or '')}" for n, p in computed)]
    return "\n".join(out) + "\n"


def python_class(rna: Any) -> Any:
    """The class of a group or of preferences; None where Blender knows none."""
    import bpy

    for base in (bpy.types.PropertyGroup, bpy.types.AddonPreferences):
        if (cls := base.bl_rna_get_subclass_py(rna.identifier)) is not None:
            return cls
    return None


def table(props: list[Any]) -> list[str]:
    """Properties as a table."""
    rows = ["| Property | Type, default | Range | What it is |", "|---|---|---|---|"]
    for p in props:
        label = f"*{text(p.name)}*: " if p.name and p.name != p.identifier else ""
        kind = f"{kind_of(p)}, `{default(p)}`" if p.type not in ("POINTER", "COLLECTION") else kind_of(p)
        rows.append(f"| `{p.identifier}` | {kind} | {extent(p)} | {label}{text(p.description)}{choices(p)} |")
    return rows


def kind_of(p: Any) -> str:
    """The type of a property's value."""
    if p.type in ("POINTER", "COLLECTION"):
        return f"{p.fixed_type.identifier}" + (", a collection" if p.type == "COLLECTION" else "")
    if p.type == "ENUM" and p.is_enum_flag:
        return "set of enum"
    size = getattr(p, "array_length", 0)
    unit = {"ROTATION": " (radians)", "LENGTH": " (metres)"}.get(p.unit, "")
    return WORDS[p.type] + (f"[{size}]" if size else "") + unit


def default(p: Any) -> str:
    """The default value as Python writes it."""
    if p.type in ("POINTER", "COLLECTION"):
        return "None" if p.type == "POINTER" else "[]"
    if p.type == "ENUM" and p.is_enum_flag:
        return repr(set(p.default_flag)) if p.default_flag else "set()"
    if getattr(p, "array_length", 0):
        return f"({', '.join(number(v) for v in p.default_array)})"
    return number(p.default)


def number(value: Any) -> str:
    """A value as Python writes it, without the digits that float32 does not hold."""
    return f"{value:.6g}" if isinstance(value, float) else repr(value)


def extent(p: Any) -> str:
    """Limits of a number; the range of its slider, where that is narrower."""
    if p.type not in ("INT", "FLOAT"):
        return ""
    hard, soft = limits(p.hard_min, p.hard_max), limits(p.soft_min, p.soft_max)
    return hard if hard == soft or not soft else f"{hard or 'any'}; slider {soft}"


def limits(low: float, high: float) -> str:
    """A range in words, "" where it has no end."""
    ends = [None if abs(end) >= UNLIMITED else number(end) for end in (low, high)]
    if ends[0] is None or ends[1] is None:
        return f"from {ends[0]}" if ends[0] is not None else f"to {ends[1]}" if ends[1] is not None else ""
    return f"{ends[0]} to {ends[1]}"


def choices(p: Any) -> str:
    """The values of an enum with what they do."""
    if p.type != "ENUM":
        return ""
    items = [f"`{i.identifier}`: {text(i.description or i.name)}" for i in p.enum_items if i.identifier]
    return "<br>" + "<br>".join(items) if items else "<br>The values depend on the scene."


def text(value: str) -> str:
    """A description in one line of a Markdown table."""
    parts = " ".join(value.split()).split("`")
    for index in range(0, len(parts), 2):  # outside of code
        for sign in "\\|*_<[#{":
            parts[index] = parts[index].replace(sign, "\\" + sign)
    return "`".join(parts)


def main() -> int:
    """Register the extension, write the pages, unregister; the return value is the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the pages")
    args = parser.parse_args()
    user = os.environ["BLENDER_USER_RESOURCES"] = tempfile.mkdtemp(prefix="drgs-blender-")  # read by Blender's import
    sys.path.insert(0, str(ROOT / "tools"))
    import bpy
    import extension

    code = 0
    try:
        archive = extension.build(Path(user) / "drgs.zip")
        bpy.ops.extensions.package_install_files(filepath=str(archive), repo="user_default", enable_on_install=True)
        made = pages()
        bpy.ops.preferences.addon_disable(module=PACKAGE)
        args.out.mkdir(parents=True, exist_ok=True)
        for name, page in made.items():
            (args.out / name).write_text(page, encoding="utf-8")
    except ReferenceIncomplete as error:
        print(f"blender_reference.py: {error}", file=sys.stderr)
        bpy.ops.preferences.addon_disable(module=PACKAGE)
        code = 1
    finally:
        shutil.rmtree(user, ignore_errors=True)
    return code


if __name__ == "__main__":
    exit_code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(exit_code)  # Blender as a module may crash when Python tidies up after it
