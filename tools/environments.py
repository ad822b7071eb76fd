"""The environments as steps that run side by side, and the kernels of the engine's. Standard library only."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
from pathlib import Path

from steps import Step, counted

ROOT = Path(__file__).resolve().parent.parent
ENGINE = ROOT / ".venv"
BLENDER = ROOT / ".venv-blender"
#: In a folder of an environment, what was installed there.
STAMP = "drgs-stamp.json"
#: Names of the steps.
FOR_ENGINE, FOR_BLENDER = "engine", "blender"


def python_of(folder: Path) -> Path:
    """The interpreter of an environment."""
    return folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def borrowing(folder: Path, *first: Path) -> tuple[Path, Path]:
    """Make an environment with the packages of this one, behind its own and the folders `first`.

    Returns
    -------
    tuple of Path
        Its interpreter, and the folder of its own packages.
    """
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    site = Path(sysconfig.get_path("purelib", vars={"base": str(folder)}))
    paths = [*map(str, first), sysconfig.get_path("purelib")]
    (site / "borrowed.pth").write_text("".join(f"{path}\n" for path in paths), encoding="utf-8")
    return python_of(folder), site


def blender() -> Path:
    """What DRGS_BLENDER names, otherwise the environment with Blender as a module."""
    return Path(os.environ.get("DRGS_BLENDER") or python_of(BLENDER))


def environments(seconds: tuple[float, float] = (90.0, 30.0)) -> list[Step]:
    """The engine's environment and Blender's, each a moment's work where it is there, made to its end.

    Parameters
    ----------
    seconds : that they take
    """
    command = [sys.executable, ROOT / "tools" / "dev.py", "env"]
    engine_there, blender_there = is_whole(ENGINE), is_whole(BLENDER)
    text = _doing(engine_there, "the engine's Python (.venv)")
    found = [Step(FOR_ENGINE, text, [*command, "--engine"], 1.0 if engine_there else seconds[0])]
    if not os.environ.get("DRGS_BLENDER"):
        after = 1.0 if blender_there else seconds[1]
        text = _doing(blender_there, "Blender's Python (.venv-blender)")
        found.append(Step(FOR_BLENDER, text, [*command, "--blender"], after))
    return found


def is_whole(folder: Path) -> bool:
    """Whether an environment was once made to its end: the stamp comes last."""
    return python_of(folder).is_file() and (folder / STAMP).is_file()


def _doing(is_there: bool, what: str) -> str:
    return f"{'Checking' if is_there else 'Making'} {what}"


def kernels(name: str, *jobs: str, seconds: float, after: str = FOR_ENGINE) -> Step:
    """What the engine compiles for `jobs`, as soon as its environment stands, or `after` another step."""
    command = [python_of(ENGINE), "-m", "drgs_blender.compute.prepare", *jobs]
    title = "Preparing the engine"
    return Step(name, "Starting the engine", command, seconds, (after,), count=counted, title=title)
