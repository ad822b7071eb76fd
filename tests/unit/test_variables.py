"""Environment variables: the tables of the documentation have those that the code reads, and no others."""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
#: Code of users, and of developers.
PROGRAM, DEVELOPMENT = ("drgs_blender", "addon", "operators"), ("tests", "tools", "bench", "examples")
#: Variables by which a test or a benchmark hands a job to the Blender that it starts.
OF_JOBS = {
    "DRGS_WINDOW_JOB",
    "DRGS_WINDOW_ASSET",
    "DRGS_WINDOW_FILE",
    "DRGS_SOAK",
    "DRGS_WINDOW_PICTURES",
    "DRGS_VIEWPORT_JOB",
}
#: Read by other libraries for the program, or set by it for them.
INDIRECT = {"OMP_WAIT_POLICY", "PATH", "TMPDIR", "TEMP", "TMP"}


def is_environ(node: ast.expr) -> bool:
    """Whether an expression is ``os.environ``."""
    return isinstance(node, ast.Attribute) and node.attr == "environ"


def keys_of(tree: ast.Module) -> set[str]:
    """Names with which a module asks ``os.environ`` or `switches.is_on`; constants of the module are resolved."""
    constants = {
        target.id: node.value.value
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    found: set[str] = set()
    for node in ast.walk(tree):
        keys: list[ast.expr] = []
        if isinstance(node, ast.Subscript) and is_environ(node.value):
            keys = [node.slice]
        elif isinstance(node, ast.Call):
            asks = isinstance(node.func, ast.Attribute) and is_environ(node.func.value)
            keys = node.args[:1] if asks or (isinstance(node.func, ast.Name) and node.func.id == "is_on") else []
        elif isinstance(node, ast.Compare) and any(is_environ(side) for side in node.comparators):
            keys = [node.left]
        for key in keys:
            if isinstance(key, ast.Constant):
                found.add(key.value)
            elif isinstance(key, ast.Name) and key.id in constants:
                found.add(constants[key.id])
    return {key for key in found if isinstance(key, str)}


def read_in(folders: tuple[str, ...]) -> set[str]:
    """Variables that the Python code in some folders reads, and the scripts that it writes (``${DRGS_...}``)."""
    found: set[str] = set()
    for path in (path for folder in folders for path in (ROOT / folder).rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        if "environ" in source or "is_on" in source:  # few do, and to parse all takes seconds
            found |= keys_of(ast.parse(source))
        found |= set(re.findall(r"\$\{+(DRGS_\w+)", source))
        # A module that imports the name of a variable from another, which is found there.
    return found


def table(page: str) -> set[str]:
    """Variables in the table below the heading "Variables"."""
    text = (ROOT / page).read_text(encoding="utf-8").partition("## Variables\n")[2].partition("\n## ")[0]
    cells = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    return {name for cell in cells for name in re.findall(r"`(\w+)`", cell)}


def test_users_find_every_variable_that_the_program_reads() -> None:
    read = read_in(PROGRAM)
    assert {"DRGS_ENGINE", "DRGS_CPU_TARGET", "DRGS_FARM", "DRGS_PAUSE", "OMP_WAIT_POLICY"} <= read
    assert table("docs/command-line.md") == read | INDIRECT


def test_developers_find_the_others() -> None:
    read = {name for name in read_in(DEVELOPMENT) if name.startswith("DRGS_")}
    assert table("CONTRIBUTING.md") == read - table("docs/command-line.md") - OF_JOBS
