"""Kernels that a release brings compiled: archives in the folder `kernels` beside this module, one for each target.

They are the files of the cache (`kernel_cache`) under the same names, so they are found only where everything on which
machine code depends is the same; each is checked by its digest before it is used. ``tools/kernels.py build`` makes
them.
"""

from __future__ import annotations

import functools
import json
import logging
import sys
import zipfile
import zlib

from ..core.switches import is_on
from . import closure, targets

log = logging.getLogger(__name__)
FOLDER = closure.SHIPPED
#: What a damaged archive, or one of another program, raises.
_DAMAGE = (OSError, ValueError, EOFError, NotImplementedError, RuntimeError, zipfile.BadZipFile, zlib.error)


def archive_name(target: str) -> str:
    """File name of the archive for a target on this system: object code differs from system to system."""
    return f"{sys.platform}-{target}.zip"


def has(name: str) -> bool:
    """Whether the release brings a kernel."""
    return name in _names()


def brings_any() -> bool:
    """Whether the release brings kernels for this machine."""
    return bool(_names())


def read(name: str) -> bytes | None:
    """A kernel's file; None where the release does not bring it, or the archive is damaged."""
    archive = _archive()
    if archive is None or name not in _names():
        return None
    try:
        return archive.read(name)
    except _DAMAGE as error:
        log.warning("%s: %s is damaged (%s): compiling it", archive.filename, name, error)
        return None


def versions() -> dict[str, str]:
    """Package -> version for which the release's kernels were made; nothing where it brings none."""
    try:
        facts = json.loads((FOLDER / "versions.json").read_text(encoding="utf-8"))
        return {name: str(facts[name]) for name in ("numba", "llvmlite")}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, KeyError, TypeError) as error:
        log.warning("%s: versions.json is damaged (%s)", FOLDER, error)
        return {}


@functools.cache
def _archive() -> zipfile.ZipFile | None:
    if not is_on("DRGS_SHIPPED", True):
        return None
    from . import jit  # noqa: F401 - settles the target; a process that prepares has not imported it yet

    path = FOLDER / archive_name(targets.current())
    try:
        return zipfile.ZipFile(path)
    except FileNotFoundError:
        return None
    except _DAMAGE as error:
        log.warning("%s is damaged (%s): kernels are compiled", path, error)
        return None


@functools.cache
def _names() -> frozenset[str]:
    archive = _archive()
    return frozenset(archive.namelist() if archive else ())
