"""Kernels that a release brings compiled: one archive per target in the folder `kernels` beside this module.

They are the files of the cache (`kernel_cache`) under the same names, so they are found only where everything on which
machine code depends is the same; each is checked by its digest before it is used.
"""

from __future__ import annotations

import functools
import logging
import zipfile
from pathlib import Path

import numba

log = logging.getLogger(__name__)
FOLDER = Path(__file__).with_name("kernels")


def has(name: str) -> bool:
    """Whether the release brings a kernel."""
    return name in _names()


def read(name: str) -> bytes | None:
    """A kernel's file; None where the release does not bring it, or the archive is damaged."""
    archive = _archive()
    if archive is None or name not in _names():
        return None
    try:
        return archive.read(name)
    except (OSError, zipfile.BadZipFile, NotImplementedError, EOFError) as error:
        log.warning("%s: %s: %s", archive.filename, name, error)
        return None


@functools.cache
def _archive() -> zipfile.ZipFile | None:
    path = FOLDER / f"{numba.config.CPU_NAME or 'native'}.zip"
    try:
        return zipfile.ZipFile(path)
    except FileNotFoundError:
        return None
    except (OSError, zipfile.BadZipFile) as error:
        log.warning("%s is damaged (%s): kernels are compiled", path, error)
        return None


@functools.cache
def _names() -> frozenset[str]:
    archive = _archive()
    return frozenset(archive.namelist() if archive else ())
