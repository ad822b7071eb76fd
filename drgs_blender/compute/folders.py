"""The cache folder of compiled kernels: where it is, its permissions, and what is wrong with it."""

from __future__ import annotations

import atexit
import contextlib
import errno
import functools
import logging
import os
import re
import shlex
import shutil
import stat
import tempfile
import time
import uuid
from pathlib import Path

from ..core.file_lock import FileLock
from ..core.system import replace
from ..core.user_cache import named_cache, user_cache

log = logging.getLogger(__name__)
_MONTH = 30 * 24 * 3600.0
#: Names of what is put into the folder; nothing else in it is ever removed.
_OURS = re.compile(r"\w+-[0-9a-f]{16}|sources-[0-9a-f]{16}\.json|\..+\.[0-9a-f]{12}\.tmp")
#: And into its folders.
_INSIDE = re.compile(r".+-[0-9a-f]{24}\.kernel|\..+\.(lock|[0-9a-f]{12})\.tmp")
#: Of temporary folders; a user's may have such a name, too.
_TEMPORARY = "drgs-kernels-"
#: The file in a temporary folder that its process holds locked for as long as it lives.
_ALIVE = ".drgs-temporary.lock"
#: The temporary folders that were made here, by which process, and their locks.
_made: dict[Path, tuple[int, FileLock | None]] = {}


class CacheFolder:
    """A folder that belongs to this user alone, or a temporary one where there is none.

    What lies in it is executed: a folder of another user, or one into which others may write, is not used. One that
    cannot be written, as where it is part of a sealed image, is still read.

    Parameters
    ----------
    wanted : Path or None
        Made when it does not exist; None where there is no place for it.

    Attributes
    ----------
    path : Path or None
        Where kernels are put; None where not even a temporary folder can be made.
    sources : tuple of Path
        Where kernels are looked for.
    trouble : str
        Why compiled kernels are not kept for the next start, for the user; "" when they are.
    has_failed : bool
        Whether a kernel could not be written: there is no use in compiling more than are called.
    """

    def __init__(self, wanted: Path | None) -> None:
        self.trouble, self.has_failed = "", False
        self.path: Path | None = wanted
        self.sources: tuple[Path, ...] = ()
        if wanted is None:
            self.trouble = "compiled kernels cannot be kept, there is no home folder: name a folder in DRGS_CACHE_DIR"
        elif problem := _unsafe(wanted):
            self.trouble = f"compiled kernels cannot be kept in {wanted} ({problem}): every start compiles them again"
        elif problem := _sealed(wanted):
            self.sources = (wanted,)
            self.trouble = f"no more compiled kernels can be kept in {wanted} ({problem}): every start compiles others"
        if self.trouble:
            log.warning("%s", self.trouble)
            self.path = _temporary()
        if self.path is not None:
            self.sources = (self.path, *self.sources)

    def failed(self, path: Path, error: OSError) -> None:
        """Note that a kernel could not be written."""
        self.give_up(f"compiled kernels cannot be kept in {path.parent} ({error.strerror or error})")

    def give_up(self, trouble: str) -> None:
        """Note, once, why no more kernels are kept."""
        if not self.has_failed:
            self.has_failed = True
            self.trouble = self.trouble or trouble
            log.warning("%s", trouble)


def wanted_folder() -> Path:
    """``DRGS_CACHE_DIR``, else the system's user cache folder + ``drgs/kernels``; absolute.

    Raises
    ------
    RuntimeError
        When the user has no home folder.
    """
    return named_cache() or user_cache() / "drgs" / "kernels"


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


def read_own(path: Path) -> bytes:
    """The bytes of a file that this user owns, or root, as in the image of a container.

    The folder was looked at once, by its path. Whoever may write into a folder above it, or turn a link on the way, can
    put another in its place at any later time, but cannot make files of ours: so each that is read is asked itself.

    Raises
    ------
    OSError
    """
    with open(path, "rb") as file:
        if hasattr(os, "geteuid") and os.fstat(file.fileno()).st_uid not in (os.geteuid(), 0):
            raise PermissionError(errno.EPERM, "it belongs to another user", str(path))
        return file.read()


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file so that others see all of it or nothing; nothing is left of it when that fails.

    Raises
    ------
    OSError
    """
    part = path.with_name(f".{path.name}.{uuid.uuid4().hex[:12]}.tmp")
    try:
        part.write_bytes(data)
        # Not flushed to the disk before, which on a busy one takes longer than to compile: where the power is lost,
        # the file may be empty, which its digest shows.
        replace(part, path)
    except OSError:
        part.unlink(missing_ok=True)
        raise


def _unsafe(folder: Path) -> str:
    """Why what lies in a folder is not to be executed, "" where it may; makes the folder where there is none."""
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        facts = folder.stat()  # of what a link leads to: the link may be anybody's, see `read_own`
    except OSError as error:
        return error.strerror or str(error)
    if hasattr(os, "geteuid"):
        if facts.st_uid not in (os.geteuid(), 0):
            return "it belongs to another user; name a folder of your own in DRGS_CACHE_DIR"
        if facts.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            order = f"chmod go-w {shlex.quote(str(folder))}"
            return f"other users may write into it; run {order}, or name another folder in DRGS_CACHE_DIR"
    return ""


def _sealed(folder: Path) -> str:
    """Why nothing can be written into a folder, "" where it can."""
    try:
        with tempfile.TemporaryFile(dir=folder) as trial:
            trial.write(b"\0" * 4096)
    except OSError as error:
        return error.strerror or str(error)
    return ""


def _temporary() -> Path | None:
    """A folder that ends with this process: its child processes still share what they compile."""
    _sweep()
    try:
        folder = Path(tempfile.mkdtemp(prefix=_TEMPORARY))
    except OSError:
        return None
    if not _made:
        atexit.register(leave_temporary)
    _made[folder] = os.getpid(), _signed(folder)
    return folder


def _signed(folder: Path) -> FileLock | None:
    """Put the locked file into a temporary folder; None where files cannot be locked: `_sweep` leaves it alone."""
    unlocked = folder / f"{_ALIVE}.new"
    try:
        lock = FileLock(unlocked)
        if lock.acquire():
            unlocked.rename(folder / _ALIVE)  # it has this name only locked, at no time does its process look dead
            return lock
    except OSError as error:
        log.info("%s: %s", unlocked, error)
    return None


def leave_temporary() -> None:
    """Remove the temporary folders of this process: for one that ends without Python's own end."""
    for folder, (process, lock) in tuple(_made.items()):
        if process == os.getpid():  # not in a fork of the process that made it
            if lock is not None:
                lock.close()
            shutil.rmtree(folder, ignore_errors=True)
            del _made[folder]


def _sweep() -> None:
    """Remove temporary folders of this user's processes that were killed, here or in other containers.

    Numbers of processes say nothing: each container has its own. The lock on a file in the folder is of all that share
    the disk.
    """
    if not hasattr(os, "geteuid"):
        return
    for folder in Path(tempfile.gettempdir()).glob(f"{_TEMPORARY}*"):
        with contextlib.suppress(OSError):
            if _is_private(folder, stat.S_IFDIR) and _is_private(folder / _ALIVE, stat.S_IFREG):
                with FileLock(folder / _ALIVE) as lock:
                    if lock.acquire():
                        shutil.rmtree(folder, ignore_errors=True)


def _is_private(path: Path, kind: int) -> bool:
    """Whether something is of a kind, and this user's alone; a link is neither folder nor file."""
    facts = path.lstat()
    return stat.S_IFMT(facts.st_mode) == kind and facts.st_uid == os.geteuid() and not facts.st_mode & 0o077


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
    for name in filter(_INSIDE.fullmatch, os.listdir(path)):
        (path / name).unlink(missing_ok=True)
    path.rmdir()  # an error where it holds anything else
