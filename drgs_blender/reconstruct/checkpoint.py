"""State of an optimisation on disk: named arrays and what they belong to, written in one step."""

from __future__ import annotations

import hashlib
import json
import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..core.arrays import Array
from ..core.asset.archive import replace_file
from ..core.asset.tensors import decode, encode
from ..core.errors import AssetError
from ..core.version import __version__
from .capture.capture import Capture

log = logging.getLogger(__name__)

#: What states mean. To be raised with every change after which an older one would go on to something else: versions of
#: the package change less often.
MEANING = 2


def fingerprint(capture: Capture, **settings: Any) -> str:
    """Digest of what a state depends on.

    Photographs, masks, normals, cameras, background, sparse points, settings that JSON can hold, this version, and
    `MEANING`.
    """
    digest = hashlib.sha256(
        f"{__version__} {MEANING} ".encode() + json.dumps(settings, sort_keys=True, default=str).encode()
    )
    digest.update(f"{capture.background}".encode())
    if capture.points is not None:
        digest.update(np.ascontiguousarray(capture.points).data)
    for view in capture.views:
        camera = view.camera
        digest.update(f"{view.name} {view.test} {view.linear} {camera.width} {camera.height}".encode())
        digest.update(np.asarray(camera.matrix_world, np.float64).tobytes())
        digest.update(np.array([camera.fx, camera.fy, camera.cx, camera.cy]).tobytes())
        digest.update(np.ascontiguousarray(view.colour).data)
        if view.mask_band:
            digest.update(f"mask_band {view.mask_band}".encode())
        for name in ("mask", "normals", "above_white", "turn"):
            if (layer := getattr(view, name)) is not None:
                digest.update(name.encode())
                digest.update(np.ascontiguousarray(layer).data)
    return digest.hexdigest()


def save(path: Path, arrays: dict[str, Array], key: str) -> None:
    """Write `arrays` under the fingerprint `key`; WriteError names the path."""
    label = np.frombuffer(key.encode(), np.uint8)
    replace_file(path, encode({"fingerprint": label, **{k: np.atleast_1d(v) for k, v in arrays.items()}}))


def load(path: Path, key: str) -> dict[str, Array] | None:
    """The state that `save` wrote; None where there is none, or with a warning where it is of another run."""
    if not path.exists():
        return None
    try:
        arrays = decode(np.fromfile(path, np.uint8), str(path))
        found = bytes(arrays.pop("fingerprint")).decode()
    except (OSError, AssetError, KeyError, UnicodeDecodeError) as error:
        log.warning("%s cannot be used (%s); starting over", path, error)
        return None
    if found != key:
        log.warning("%s belongs to other photographs or settings, or another drgs; starting over", path)
        return None
    return arrays


class Checkpoint:
    """The file of a run's state, if one is wanted.

    Parameters
    ----------
    path : Path, optional
        Without it, nothing is written or read.
    key : str
        Of `fingerprint`.
    every : float
        Seconds between two states.
    now : callable
        Monotonic clock, seconds.
    """

    def __init__(self, path: Path | None, key: str, every: float, now: Callable[[], float] = time.monotonic) -> None:
        self._path, self._key, self._every, self._now = path, key, every, now
        self._saved = now()

    def load(self) -> dict[str, Array] | None:
        """The state that lies there and belongs to this run."""
        return None if self._path is None else load(self._path, self._key)

    def is_due(self, at_once: bool = False) -> bool:
        """Whether a state is wanted, `at_once` or because the last one was written a while ago."""
        return self._path is not None and (at_once or self._now() - self._saved > self._every)

    def save(self, state: dict[str, Array]) -> None:
        """Write a state; WriteError names the path."""
        if self._path is not None:
            save(self._path, state, self._key)
            self._saved = self._now()
