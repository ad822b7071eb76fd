"""The packages that came with the extension, by which Blender's own Python runs the engine.

Blender unpacks the wheels of its manifest into a folder of extensions' packages. The zip for developers has none.
Standard library only.
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
import sys
import tomllib
from pathlib import Path

#: The extension's folder.
SOURCE = Path(__file__).resolve().parents[1]
_PYTHON = re.compile(r"cp(\d)(\d+)$")


@functools.cache
def wheels(source: Path = SOURCE) -> tuple[str, ...]:
    """File names of the wheels that the extension's manifest names; none where the zip brought none."""
    manifest = tomllib.loads((source / "blender_manifest.toml").read_text(encoding="utf-8"))
    return tuple(path.rpartition("/")[2] for path in manifest.get("wheels", ()))


def fault(source: Path = SOURCE) -> str:
    """What the packages lack, "" where they are complete or the zip brought none. Reads names of folders alone."""
    names = wheels(source)
    unpacked = _unpacked() if names else {}
    if names and not Path(sys.executable or "").stem.lower().startswith("python"):
        return f"need Blender's own Python as a program, which this Blender lacks (it names {sys.executable!r})"
    for name in names:
        parts = name.removesuffix(".whl").split("-")
        if len(parts) < 5:
            return f"name {name}, which is no wheel: install the zip again"
        distribution, version, *_, tag, abi, _ = parts
        made = _PYTHON.match(tag)
        if made and not abi.startswith("abi") and (int(made[1]), int(made[2])) != sys.version_info[:2]:
            ours = ".".join(map(str, sys.version_info[:2]))
            return f"are for Python {made[1]}.{made[2]}, and this Blender has {ours}: get the zip for this Blender"
        if not any(distribution.lower() in found for found in unpacked.values()):
            return f"lack {distribution} {version}: disable and enable the extension, and Blender unpacks it again"
    return ""


def site_packages(source: Path = SOURCE) -> Path:
    """The folder into which Blender unpacked them; FileNotFoundError where there is none."""
    brought = {name.partition("-")[0].lower() for name in wheels(source)}
    # Blender's own and those of other add-ons may have some of them, too
    found = max(((len(brought & names), folder) for folder, names in _unpacked().items()), default=(0, ""))
    if not found[0]:
        raise FileNotFoundError("Blender has not unpacked the packages of the extension")
    return Path(found[1])


def _unpacked() -> dict[str, set[str]]:
    """Folders of packages -> names of those in them, of any version: another extension may have a newer one."""
    found = {}
    for folder in map(str, sys.path):  # some add-ons append a Path
        if folder.endswith("site-packages"):
            with contextlib.suppress(OSError):
                names = os.listdir(folder)
                found[folder] = {n.partition("-")[0].lower() for n in names if n.endswith(".dist-info")}
    return found
