"""Locates the engine's interpreter. Never downloads, never guesses in the user's PATH."""

from __future__ import annotations

import os
from pathlib import Path

from ..core import own_python
from ..core.errors import DeviceError

#: Environment variable that names the engine: farms start Blender with factory settings.
VARIABLE = "DRGS_ENGINE"
#: Nothing of the user's own Python settings; what is printed is UTF-8, which on Windows it is not by itself.
_ALONE = ("-I", "-Xutf8")


def _interpreter_in(folder: Path) -> Path | None:
    """The Python of the environment `folder`, or beside a program in `folder`."""
    for candidate in ("bin/python3", "bin/python", "Scripts/python.exe", "python.exe", "python3", "python"):
        if (folder / candidate).is_file():
            return folder / candidate
    return None


def _interpreter(place: Path) -> Path | None:
    """The Python of `place`: an interpreter, a ``drgs`` program, or the folder of an environment or of a checkout."""
    if place.is_dir():
        return _interpreter_in(place) or _interpreter_in(place / ".venv")
    if not place.is_file():
        return None
    if place.stem.lower() == "drgs":
        return _interpreter_in(place.parent) or _interpreter_in(place.resolve().parent)
    return place if os.access(place, os.X_OK) else None


def engine_command(interpreter: str | os.PathLike[str] | None = None) -> list[str]:
    """Command that runs the engine on `interpreter`, which has DR-GS installed, or on this very Python.

    No setting of this process leaks in.
    """
    python = own_python.command(*_ALONE) if interpreter is None else [os.fspath(interpreter), *_ALONE]
    return [*python, "-m", "drgs_blender.engine"]


def bundled_command(python: str | os.PathLike[str], site_packages: str | os.PathLike[str]) -> list[str]:
    """Command that runs the engine of this very package on `python`, with the packages of a folder."""
    script = Path(__file__).resolve().parents[1] / "cli" / "bundled.py"
    return [os.fspath(python), *_ALONE, str(script), os.fspath(site_packages), "-m", "drgs_blender.engine"]


def locate_engine(preference: str | os.PathLike[str] | None = None) -> list[str]:
    """Find the engine; return the command for `EngineClient`.

    Looked at in this order: the environment variable ``DRGS_ENGINE``, `preference`, and ``.venv`` beside the package
    when it runs from a source checkout. The first two may name an interpreter, a ``drgs`` program or the folder of an
    environment, or of a checkout with ``.venv``; one that is set but leads nowhere is an error, never skipped.

    Raises
    ------
    DeviceError
        Naming every place looked at.
    """
    looked: list[str] = []
    for origin, value in ((f"environment variable {VARIABLE}", os.environ.get(VARIABLE)), ("preference", preference)):
        if not value:
            looked.append(f"{origin} is not set")
            continue
        place = Path(value).expanduser()
        if found := _interpreter(place):
            return engine_command(found)
        what = "has no Python in it" if place.is_dir() else "is not an interpreter" if place.exists() else "is absent"
        remedy = "Set it to the folder of an environment with DR-GS installed, or to its python or drgs program"
        raise DeviceError(f"engine ({origin})", f"{place} {what}", remedy)
    checkout = Path(__file__).resolve().parents[2]
    if (checkout / "pyproject.toml").is_file():
        if found := _interpreter(checkout / ".venv"):
            return engine_command(found)
        looked.append(f"{checkout / '.venv'} has no Python in it")
    raise DeviceError(
        "engine",
        f"not found: {'; '.join(looked)}",
        f"Create an environment with `python -m venv` and `pip install .` in a checkout of DR-GS, then name its "
        f"folder in the add-on preferences or in {VARIABLE}",
    )
