"""The engine's own environment: what its folder holds, and what it lacks.

Standard library only.
"""

from __future__ import annotations

import functools
import hashlib
import json
import re
import tomllib
from pathlib import Path
from typing import NamedTuple

from ..drgs_blender.core.own_python import SET_UP
from ..drgs_blender.core.system import WINDOWS, replace

#: The extension's folder: what the engine needs and the engine itself come with it.
SOURCE = Path(__file__).resolve().parents[1]
PACKAGE = "drgs_blender"
PYTHONS = "3.11 to 3.13"


class Group(NamedTuple):
    """Packages that are set up together.

    Attributes
    ----------
    extra : their name in pyproject.toml, "" for what every engine needs
    download, disk : bytes that are fetched and that they take, about; measured with Python 3.11 on Linux
    """

    extra: str
    download: float
    disk: float


ENGINE = Group("", 175e6, 650e6)
#: PyTorch. On Linux the package index has it with CUDA, which the engine does not use; measured without.
RECONSTRUCT = Group("reconstruct", 200e6, 900e6)
#: COLMAP, OpenCV and PyAV, which find the cameras of photographs and videos; ONNX Runtime, which runs models of masks.
CAPTURE = Group("capture", 200e6, 480e6)
#: NVIDIA Warp, for graphics cards.
GPU = Group("gpu", 150e6, 400e6)
#: OpenUSD, and what reads 3MF and COLLADA.
FILES = Group("files", 35e6, 180e6)
CUDA_BYTES = 3e9


@functools.cache
def requirements(source: Path = SOURCE, group: Group = ENGINE) -> tuple[str, ...]:
    """The packages of a group, as pip knows them."""
    project = tomllib.loads((source / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return tuple(project["optional-dependencies"][group.extra] if group.extra else project["dependencies"])


@functools.cache
def digest(source: Path = SOURCE) -> str:
    """Fingerprint of the engine's sources."""
    found = hashlib.sha256()
    for path in sorted((source / PACKAGE).rglob("*.py")):
        found.update(path.relative_to(source).as_posix().encode())
        found.update(path.read_bytes())
    return found.hexdigest()


@functools.cache
def pinned(source: Path = SOURCE) -> tuple[str, ...]:
    """The very versions of Numba and LLVM for which the release brings compiled kernels, as pip knows them."""
    try:
        versions = json.loads((source / PACKAGE / "compute" / "kernels" / "versions.json").read_text(encoding="utf-8"))
        return tuple(f"{name}=={versions[name]}" for name in ("numba", "llvmlite"))
    except (OSError, ValueError, KeyError, TypeError):
        return ()


def interpreter(folder: Path) -> Path:
    """Path of the Python of the environment `folder`, also before it exists."""
    return folder / ("Scripts/python.exe" if WINDOWS else "bin/python")


def state(folder: Path, source: Path = SOURCE) -> str:
    """State of `folder`: "absent", "partial" (a set-up was not finished), "old" (of another version), or "ready"."""
    if not alive(folder):
        return "partial" if folder.is_dir() and any(folder.iterdir()) else "absent"
    sources = read_stamp(folder).get("sources")
    if sources is None or needs_network(folder, source):
        return "partial"
    return "ready" if sources == digest(source) else "old"


def needs_network(folder: Path, source: Path = SOURCE, group: Group = ENGINE) -> bool:
    """Whether packages of a group are to be fetched for `folder`."""
    return not alive(folder) or read_stamp(folder).get(entry(group)) != list(requirements(source, group))


def entry(group: Group) -> str:
    """Key of the stamp for the installed packages of a group."""
    return group.extra or "packages"


def alive(folder: Path) -> bool:
    """Whether `folder` is an environment whose Python is there, and the one that it was made with too."""
    if not interpreter(folder).is_file():
        return False
    try:
        text = (folder / "pyvenv.cfg").read_text(encoding="utf-8")
    except OSError:
        return False
    home = re.search(r"^home\s*=\s*(.+?)\s*$", text, re.MULTILINE)
    return home is not None and Path(home[1]).is_dir()


def read_stamp(folder: Path) -> dict[str, object]:
    try:
        found = json.loads((folder / SET_UP).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def write_stamp(folder: Path, **entries: object) -> None:
    """Remember what is done in `folder`."""
    partial = folder / f"{SET_UP}.part"
    partial.write_text(json.dumps(read_stamp(folder) | entries, indent=2), encoding="utf-8")
    replace(partial, folder / SET_UP)


def site_packages(folder: Path) -> Path:
    """Folder of the packages of the environment `folder`; FileNotFoundError where there is none."""
    if WINDOWS:
        return folder / "Lib" / "site-packages"
    found = sorted((folder / "lib").glob("python3*/site-packages"))
    if not found:
        raise FileNotFoundError(f"{folder / 'lib'} holds no site-packages")
    return found[-1]
