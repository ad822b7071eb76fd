"""Results of bakes by their keys: in memory while exports use them, on disk for later ones. No bpy.

A key names all that a result depends on, so that results are never changed and may be shared by processes. A file that
is damaged is removed, and made again.
"""

from __future__ import annotations

import logging
import os
import shutil
import uuid
import zipfile
from pathlib import Path

import numpy as np

from ...drgs_blender.core.system import replace
from ...drgs_blender.core.user_cache import named_cache, user_cache

log = logging.getLogger("drgs")

#: A result: arrays by name, read-only.
Baked = dict[str, np.ndarray]

#: Bytes that the folder may hold; what was not used for the longest time goes first.
LIMIT = 4 << 30
#: Exports for which a result that none of them used stays in memory: view layers and scenes take turns.
KEPT_EXPORTS = 4
_SUFFIX = ".npz"
#: What results of a surface and of a World hold: the number of axes of each array.
_CONTENTS = ({"pixels": 3, "uvs": 2, "factor": 0}, {"map": 3, "suns": 2, "kept": 0})


def cache_folder() -> Path | None:
    """``bakes`` in the folder of ``DRGS_CACHE_DIR``, else ``drgs/bakes`` in the user's cache folder; None without."""
    try:
        return (named_cache() or user_cache() / "drgs") / "bakes"
    except RuntimeError:  # there is no home folder
        return None


class Store:
    """The results.

    Attributes
    ----------
    trouble : str
        Why the last results are not kept for the next start, for the user; "" when they are, and once it was said.
    """

    def __init__(self) -> None:
        self.trouble = ""
        self._known: dict[str, tuple[int, Baked]] = {}
        self._export = 0

    def find(self, key: str) -> Baked | None:
        """The result of `key`; None where there is none that can be read."""
        if key in self._known:
            found = self._known[key][1]
        else:
            folder = cache_folder()
            path = folder / f"{key}{_SUFFIX}" if folder is not None else None
            if path is None or not path.is_file():
                return None
            try:
                found = read(path)
                os.utime(path)
            except (OSError, ValueError) as error:
                log.warning("baked result %s cannot be read (%s); it is made again", path, error)
                _remove(path)
                return None
        self._known[key] = self._export, found
        return found

    def add(self, key: str, path: Path) -> None:
        """Take in the file `path` as the result of `key`.

        Raises
        ------
        OSError, ValueError
            The file is damaged.
        """
        self._known[key] = self._export, read(path)
        folder = cache_folder()
        try:
            if folder is None:
                raise OSError("there is no home folder: name a folder in DRGS_CACHE_DIR")
            folder.mkdir(parents=True, exist_ok=True)
            part = folder / f".{key}.{uuid.uuid4().hex[:12]}.tmp"
            try:
                shutil.copyfile(path, part)
                replace(part, folder / f"{key}{_SUFFIX}")
            except OSError:
                _remove(part)
                raise
            _prune(folder)
            self.trouble = ""
        except OSError as error:
            self.trouble = (
                f"Baked textures cannot be kept in {folder} ({error.strerror or error}): they are made at each start. "
                "Make room there, or name another folder in DRGS_CACHE_DIR"
            )

    def end_export(self) -> None:
        """Drop from memory what the last exports did not use."""
        self._export += 1
        old = [key for key, (used, _) in list(self._known.items()) if used < self._export - KEPT_EXPORTS]
        for key in old:
            self._known.pop(key, None)

    def forget(self) -> None:
        """Drop all from memory."""
        self._known.clear()


def read(path: Path) -> Baked:
    """All arrays of a file, read-only.

    Raises
    ------
    OSError, ValueError
        It cannot be read, or is damaged.
    """
    try:
        # NumPy leaves a damaged file open, and Windows lets nobody replace it then
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as data:
            found = {name: data[name] for name in data.files}  # the checksum of each is compared
    except (zipfile.BadZipFile, EOFError, KeyError, SyntaxError, MemoryError, NotImplementedError) as error:
        raise ValueError(str(error) or type(error).__name__) from error
    axes = {name: array.ndim for name, array in found.items()}
    if axes not in _CONTENTS:
        raise ValueError(f"holds {', '.join(axes) or 'nothing'}, which is no result of a bake")
    for array in found.values():
        array.flags.writeable = False
    return found


def _prune(folder: Path) -> None:
    """Remove the results that were not used for the longest time while they take more than `LIMIT`."""
    facts = []
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.endswith((_SUFFIX, ".tmp")) and entry.is_file(follow_symlinks=False):
                status = entry.stat()
                facts.append((status.st_mtime, status.st_size, Path(entry.path)))
    total = sum(size for _, size, _ in facts)
    for _, size, path in sorted(facts)[:-1]:  # never the newest
        if total <= LIMIT:
            return
        _remove(path)
        total -= size


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        log.info("%s: %s", path, error)
