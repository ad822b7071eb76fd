"""The folder in which compiled kernels are kept: where it is, whose it may be, and what is the matter with it."""

from __future__ import annotations

import atexit
import functools
import logging
import os
import shutil
import stat
import sys
import tempfile
import time
import uuid
from pathlib import Path

log = logging.getLogger(__name__)
_MONTH = 30 * 24 * 3600.0


class CacheFolder:
    """A folder that belongs to this user alone, or a temporary one where there is none.

    What lies in it is executed: a folder of another user, or one into which others may write, is not used.

    Parameters
    ----------
    wanted : Path
        Made when it does not exist.

    Attributes
    ----------
    path : Path or None
        The folder; None where not even a temporary one can be made.
    trouble : str
        Why compiled kernels are not kept for the next start, for the user; "" when they are.
    """

    def __init__(self, wanted: Path) -> None:
        self.trouble = ""
        self.path: Path | None = wanted
        problem = _problem(wanted)
        if problem:
            self.trouble = f"compiled kernels cannot be kept in {wanted} ({problem}): every start compiles them anew"
            log.warning("%s", self.trouble)
            self.path = _temporary()

    def failed(self, path: Path, error: OSError) -> None:
        """Note that a kernel could not be written."""
        if not self.trouble:
            self.trouble = f"compiled kernels cannot be kept in {path.parent} ({error.strerror or error})"
            log.warning("%s", self.trouble)


def wanted_folder() -> Path:
    """``DRGS_CACHE_DIR``, else the system's user cache folder + ``drgs/kernels``."""
    if override := os.environ.get("DRGS_CACHE_DIR"):
        return Path(override)
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData/Local"))
    elif sys.platform == "darwin":
        base = Path.home() / "Library/Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return base / "drgs" / "kernels"


@functools.cache
def cache_folder() -> CacheFolder:
    """The folder of this process, found at the first call."""
    folder = CacheFolder(wanted_folder())
    if folder.path and not folder.trouble:
        _prune(folder.path)
    return folder


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file so that others see all of it or nothing; nothing is left of it when that fails.

    Raises
    ------
    OSError
    """
    part = path.with_name(f".{path.name}.{uuid.uuid4().hex[:12]}.tmp")
    try:
        part.write_bytes(data)
        os.replace(part, path)
    except OSError:
        part.unlink(missing_ok=True)
        raise


def _problem(folder: Path) -> str:
    """Why kernels are not to be kept in a folder, "" where they may."""
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if hasattr(os, "geteuid"):
            facts = folder.stat()
            if facts.st_uid != os.geteuid():
                return "it belongs to another user"
            if facts.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
                return "other users may write into it"
        with tempfile.TemporaryFile(dir=folder) as trial:
            trial.write(b"\0" * 4096)
    except OSError as error:
        return error.strerror or str(error)
    return ""


def _temporary() -> Path | None:
    """A folder that ends with this process: its child processes still share what they compile."""
    try:
        folder = Path(tempfile.mkdtemp(prefix="drgs-kernels-"))
    except OSError:
        return None
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _prune(folder: Path) -> None:
    """Remove what was not used for a month; a clock that jumped back makes nothing old."""
    now = time.time()
    try:
        for other in folder.iterdir():
            if now - other.stat().st_mtime > _MONTH:
                shutil.rmtree(other, ignore_errors=True) if other.is_dir() else other.unlink(missing_ok=True)
    except OSError as error:
        log.info("old kernels in %s: %s", folder, error)
