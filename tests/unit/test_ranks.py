"""Who imports whom: the rank table of docs/architecture.md, held against every import in the code."""

from __future__ import annotations

import ast
import functools
import re
import sys
from pathlib import Path

import pytest

from drgs_blender.compute import closure

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "drgs_blender"
#: What the extension may use of the engine's package.
LIGHT = ("core", "ipc")


def rank_table() -> dict[str, int]:
    """Package or module directly under drgs_blender -> its rank, read from the architecture page."""
    page, _, _ = (ROOT / "docs/architecture.md").read_text(encoding="utf-8").partition("## The extension")
    rows = re.findall(r"^\| (\d) \| ([^|]+) \|", page, re.M)
    return {name: int(rank) for rank, names in rows for name in re.findall(r"`(\w+)`", names)}


RANKS = rank_table()
#: Folders of the extension, the lower one first.
EXTENSION = ("addon", "operators")
#: Files of the extension that may import inside functions, and why.
LATE_IMPORTS = {
    "__init__.py": "Blender is there only when it registers the extension; pytest and type checkers import it before"
}


def extension_ranks() -> dict[tuple[str, str], tuple[int, int]]:
    """(folder, module or package in it) -> its rank; those of `operators` are above all of `addon`."""
    _, _, page = (ROOT / "docs/architecture.md").read_text(encoding="utf-8").partition("## The extension")
    found: dict[tuple[str, str], tuple[int, int]] = {}
    for level, folder in enumerate(EXTENSION):
        _, _, table = page.partition(f"| Rank | In `{folder}/`")
        rows = re.findall(r"^\| (\d) \| ([^|]+) \|", table.partition("\n\n")[0], re.M)
        found |= {(folder, name): (level, int(rank)) for rank, names in rows for name in re.findall(r"`(\w+)`", names)}
    return found


def extension_sources() -> list[Path]:
    return [path for folder in EXTENSION for path in sources(ROOT / folder)]


def extension_unit(path: Path) -> tuple[str, str]:
    """Folder of the extension, and the module or package in it that a file belongs to."""
    folder, name = path.relative_to(ROOT).parts[:2]
    return folder, name.removesuffix(".py")


def module_name(path: Path) -> str:
    """As "addon.export.frame"; of a package its own name."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def cycle(graph: dict[str, set[str]]) -> list[str]:
    """Names along one circle of a graph, the first of them again at the end; empty without any."""
    done: set[str] = set()

    def descend(node: str, way: list[str]) -> list[str]:
        if node in way:
            return [*way[way.index(node) :], node]
        if node in done:
            return []
        for other in sorted(graph.get(node, ())):
            if found := descend(other, [*way, node]):
                return found
        done.add(node)
        return []

    return next((found for node in sorted(graph) if (found := descend(node, []))), [])


@functools.cache  # several rules are about the same files
def imports(path: Path, root: Path) -> list[tuple[int, str, int]]:
    """(line, absolute dotted module, level) of every import of a file, wherever in the file it stands."""
    found, package = [], path.relative_to(root).with_suffix("").parts[:-1]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            for alias in node.names:
                found.append((node.lineno, alias.name, 0))
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            stem = (*base, *((node.module or "").split(".") if node.module else ()))
            for alias in node.names:
                found.append((node.lineno, ".".join((*stem, alias.name)), node.level))
    return found


def sources(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.rglob("*.py")) if "__pycache__" not in path.parts]


def top_level(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def test_every_module_has_a_rank():
    assert {top_level(path) for path in sources(PACKAGE)} - {"__init__"} <= set(RANKS)


def test_lower_ranks_never_import_higher_ones():
    wrong = []
    for path in sources(PACKAGE):
        own = top_level(path)
        rank = RANKS.get(own, 0)
        for line, module, _ in imports(path, ROOT):
            parts = module.split(".")
            if parts[0] != "drgs_blender" or len(parts) < 2 or parts[1] not in RANKS:
                continue
            other = RANKS[parts[1]]
            sideways = other == rank and parts[1] != own and own != "__init__"
            if other > rank or sideways:
                wrong.append(f"{path.relative_to(ROOT)}:{line} (rank {rank}) imports {module} (rank {other})")
    assert not wrong, "\n".join(wrong)


def test_kernels_do_not_depend_on_the_folders_above_them():
    """Their compiled forms are kept when those folders change."""
    above = {name for name, rank in RANKS.items() if rank >= RANKS["engine"]} - {"reconstruct"}
    kernels = [path for path in sources(PACKAGE) if re.search("^@njit", path.read_text(encoding="utf-8"), re.M)]
    assert kernels
    wrong = [
        f"{path.relative_to(PACKAGE)} needs {other.relative_to(PACKAGE)}"
        for path in kernels
        for other in closure.closure(path)
        if top_level(other) in above
    ]
    assert not wrong, "\n".join(wrong)


def test_folders_of_the_renderer_use_those_on_their_left():
    page = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    line = next(line for line in page.splitlines() if line.endswith("<- progressive"))
    order = {name: rank for rank, names in enumerate(line.split("<-")) for name in names.split()}
    folder = PACKAGE / "render"
    assert {p.stem for p in folder.iterdir() if p.stem not in ("__init__", "__pycache__", "reference")} == set(order)
    wrong = []
    for path in sources(folder):
        own = path.relative_to(folder).parts[0].removesuffix(".py")
        for number, module, _ in imports(path, ROOT):
            parts = module.split(".")
            if own not in order or parts[:2] != ["drgs_blender", "render"] or len(parts) < 3 or parts[2] == own:
                continue
            if order.get(parts[2], len(order)) >= order[own] and not order[own] == order.get(parts[2]) == 0:
                wrong.append(f"{path.relative_to(ROOT)}:{number} imports {module}")
    assert not wrong, "\n".join(wrong)


def test_the_engine_never_imports_blender():
    wrong = [
        f"{path.relative_to(ROOT)}:{line} imports {module}"
        for path in sources(PACKAGE)
        if path.name not in ("blender_job.py", "scene_job.py")  # the scripts of the package that run inside Blender
        for line, module, _ in imports(path, ROOT)
        if module.split(".")[0] in ("bpy", "mathutils", "bl_ext", "addon_utils")
    ]
    assert not wrong, "\n".join(wrong)


def light_sources() -> list[Path]:
    """Files that run in Blender's Python."""
    return [PACKAGE / "__init__.py", *(path for name in LIGHT for path in sources(PACKAGE / name))]


def test_what_the_extension_uses_needs_numpy_alone():
    allowed = {"numpy", "drgs_blender", *sys.stdlib_module_names}
    wrong = [
        f"{path.relative_to(ROOT)}:{line} imports {module}"
        for path in light_sources()
        for line, module, _ in imports(path, ROOT)
        if module.split(".")[0] not in allowed
    ]
    assert not wrong, "\n".join(wrong)


def test_what_the_extension_uses_imports_relatively():
    """Inside Blender the package is called bl_ext.<repository>.<id>.drgs_blender."""
    wrong = [
        f"{path.relative_to(ROOT)}:{line} imports {module}"
        for path in light_sources()
        for line, module, level in imports(path, ROOT)
        if module.split(".")[0] == "drgs_blender" and level == 0
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("folder", ["addon", "operators"])
def test_extension_uses_only_the_light_part_by_relative_import(folder):
    wrong = []
    for path in sources(ROOT / folder):
        for line, module, level in imports(path, ROOT):
            where = f"{path.relative_to(ROOT)}:{line} imports {module}"
            parts = module.split(".")
            if parts[0] in ("drgs_blender", "addon", "operators"):
                if level == 0:
                    wrong.append(f"{where} absolutely")
                inside = ".".join(parts[1:])
                is_light = inside in ("", "__version__") or parts[1] in LIGHT
                if parts[0] == "drgs_blender" and not is_light:
                    wrong.append(f"{where}, which needs more than numpy")
            elif parts[0] in ("numba", "torch", "embreex", "OpenEXR", "scipy", "trimesh", "igl", "PIL", "tqdm"):
                wrong.append(f"{where}, which Blender does not have")
    assert not wrong, "\n".join(wrong)


def test_every_part_of_the_extension_has_a_rank():
    found = {extension_unit(path) for path in extension_sources()}
    assert {(folder, name) for folder, name in found if name != "__init__"} == set(extension_ranks())


def test_lower_ranks_of_the_extension_never_import_higher_ones():
    ranks = extension_ranks()
    wrong = []
    for path in extension_sources():
        own = extension_unit(path)
        if own[1] == "__init__":  # registers all of its folder
            continue
        for line, module, _ in imports(path, ROOT):
            parts = module.split(".")
            other = (parts[0], parts[1]) if len(parts) > 1 else ("", "")
            if parts[0] not in EXTENSION or other == own:
                continue
            if ranks.get(other, (9, 9)) >= ranks[own]:
                wrong.append(f"{path.relative_to(ROOT)}:{line} imports {module}")
    assert not wrong, "\n".join(wrong)


def test_imports_of_the_extension_run_in_no_circle():
    files = {module_name(path): path for path in extension_sources()}
    graph: dict[str, set[str]] = {}
    for name, path in files.items():
        for _, module, _ in imports(path, ROOT):
            while module and module not in files:
                module = module.rpartition(".")[0]
            if module and module != name:
                graph.setdefault(name, set()).add(module)
    assert len(graph) > 80
    assert not cycle(graph), " -> ".join(cycle(graph))


def test_a_circle_is_found():
    assert cycle({"a": {"b", "c"}, "b": {"d"}, "c": {"e"}, "e": {"f"}, "f": {"c"}}) == ["c", "e", "f", "c"]
    assert cycle({"a": {"b", "c"}, "b": {"c"}}) == []


def test_the_extension_imports_inside_functions_only_where_it_must():
    late = set()
    for path in (ROOT / "__init__.py", *extension_sources()):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and any(
                isinstance(part, ast.ImportFrom) and part.level for part in ast.walk(node)
            ):
                late.add(path.relative_to(ROOT).as_posix())
    assert late == set(LATE_IMPORTS)


def test_addon_never_imports_operators_except_to_register_them():
    wrong = [
        f"{path.relative_to(ROOT)}:{line} imports {module}"
        for path in sources(ROOT / "addon")
        if path.name not in ("__init__.py", "registration.py", "register.py")
        for line, module, _ in imports(path, ROOT)
        if module.split(".")[0] == "operators"
    ]
    assert not wrong, "\n".join(wrong)


def test_long_modules_are_those_with_a_reason() -> None:
    """Neither may another one grow beyond 400 lines, nor the table keep one that is shorter."""
    page = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    table = page.partition("## Long modules")[2].partition("\n## ")[0]
    listed = {
        f"drgs_blender/{name}"
        for row in re.findall(r"^\| (`.+?) \|", table, re.M)
        for name in re.findall(r"`(.+?)`", row)
    }
    code = [path for folder in ("drgs_blender", *EXTENSION) for path in (ROOT / folder).rglob("*.py")]
    long = {
        path.relative_to(ROOT).with_suffix("").as_posix()
        for path in code
        if len(path.read_text(encoding="utf-8").splitlines()) > 400
    }
    assert long == listed
