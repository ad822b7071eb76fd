"""The cache folder of compiled kernels: where it is, its permissions, and what is wrong with it."""

from __future__ import annotations

import atexit
import contextlib
import functools
import logging
import os
import re
import shutil
import stat
import sys
import tempfile
import time
import uuid
from pathlib import Path

log = logging.getLogger(__name__)
_MONTH = 30 * 24 * 3600.0
#: Names of what is put into the folder; nothing else in it is ever removed.
_OURS = re.compile(r"\w+-[0-9a-f]{16}|sources-[0-9a-f]{16}\.json|\..+\.[0-9a-f]{12}\.tmp")
#: Of temporary folders, with the process that made it.
_TEMPORARY = "drgs-kernels-"


class CacheFolder:
    """A folder that belongs to this user alone, or a temporary one where there is none.

    What lies in it is executed: a folder of another user, or one into which others may write, is not used.

    Parameters
    ----------
    wanted : Path or None
        Made when it does not exist; None where there is no place for it.

    Attributes
    ----------
    path : Path or None
        The folder; None where not even a temporary one can be made.
    trouble : str
        Why compiled kernels are not kept for the next start, for the user; "" when they are.
    """

    def __init__(self, wanted: Path | None) -> None:
        self.trouble = ""
        self.path: Path | None = wanted
        if wanted is None:
            self.trouble = "compiled kernels cannot be kept, there is no home folder: name a folder in DRGS_CACHE_DIR"
        elif problem := _problem(wanted):
            self.trouble = f"compiled kernels cannot be kept in {wanted} ({problem}): every start compiles them again"
        if self.trouble:
            log.warning("%s", self.trouble)
            self.path = _temporary()

    def failed(self, path: Path, error: OSError) -> None:
        """Note that a kernel could not be written."""
        if not self.trouble:
            self.trouble = f"compiled kernels cannot be kept in {path.parent} ({error.strerror or error})"
            log.warning("%s", self.trouble)


def wanted_folder() -> Path:
    """``DRGS_CACHE_DIR``, else the system's user cache folder + ``drgs/kernels``; absolute.

    Raises
    ------
    RuntimeError
        When the user has no home folder.
    """
    if override := os.environ.get("DRGS_CACHE_DIR"):
        return Path(override).expanduser().absolute()
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData/Local")
    elif sys.platform == "darwin":
        base = Path.home() / "Library/Caches"
    else:
        named = Path(os.environ.get("XDG_CACHE_HOME", ""))
        base = named if named.is_absolute() else Path.home() / ".cache"
    return base / "drgs" / "kernels"


@functools.cache
def cache_folder() -> CacheFolder:
    """The folder of this process, found at the first call."""
    try:
        folder = CacheFolder(wanted_folder())
    except RuntimeError:
        folder = CacheFolder(None)
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
    _sweep()
    try:
        folder = Path(tempfile.mkdtemp(prefix=f"{_TEMPORARY}{os.getpid()}-"))
    except OSError:
        return None
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def leave_temporary() -> None:
    """Remove the temporary folder, if there is one: for a process that ends without Python's own end."""
    if cache_folder.cache_info().currsize and (path := cache_folder().path) and path.name.startswith(_TEMPORARY):
        shutil.rmtree(path, ignore_errors=True)


def _sweep() -> None:
    """Remove temporary folders of this user's processes that were killed."""
    if not hasattr(os, "geteuid"):
        return
    for folder in Path(tempfile.gettempdir()).glob(f"{_TEMPORARY}*-*"):
        try:
            process = int(folder.name.removeprefix(_TEMPORARY).partition("-")[0])
            if folder.lstat().st_uid == os.geteuid() and not folder.is_symlink():
                os.kill(process, 0)
        except ProcessLookupError:
            shutil.rmtree(folder, ignore_errors=True)
        except (OSError, ValueError):
            continue


def _prune(folder: Path) -> None:
    """Remove what was not used for a month; a clock that jumped back makes nothing old."""
    now = time.time()
    try:
        found = _ours(folder)
    except OSError as error:
        log.info("old kernels in %s: %s", folder, error)
        return
    for path in found:
        try:
            if now - path.lstat().st_mtime > _MONTH:
                _remove(path)
        except OSError as error:
            log.info("old kernels in %s: %s", path, error)


def _ours(folder: Path) -> list[Path]:
    """What was put into a folder, and unfinished files in its folders; each start asks."""
    found = []
    with os.scandir(folder) as entries:
        for entry in entries:
            if _OURS.fullmatch(entry.name):
                found.append(Path(entry.path))
            with contextlib.suppress(OSError):  # a link in a circle, or another process has removed it
                hidden = [name for name in os.listdir(entry.path) if name[0] == "."] if entry.is_dir() else []
                found += [Path(entry.path, name) for name in hidden if _OURS.fullmatch(name)]
    return found


def _remove(path: Path) -> None:
    """Remove a file of ours, or a folder with what is ours in it."""
    if path.is_symlink() or not path.is_dir():
        path.unlink(missing_ok=True)
        return
    for kernel in (*path.glob("*.kernel"), *path.glob(".*.tmp")):
        kernel.unlink(missing_ok=True)
    path.rmdir()  # an error where it holds anything else
