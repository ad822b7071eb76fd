"""Frames on disk: which are there already and may stay, and writing the others."""

from __future__ import annotations

import contextlib
import glob
import hashlib
import io
import json
import logging
import os
import re
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from ..core import cryptomatte
from ..core.asset.container import digest_asset
from ..core.errors import AssetError
from ..core.frame import Frame
from ..core.passes import pass_of
from ..core.version import __version__
from ..ipc.codec import encode_frame
from ..render.denoise.noisy_frames import camera_metadata
from ..render.film.frame_files import read_frame, write_frame

logger = logging.getLogger(__name__)

#: Name of the settings hash in a frame's metadata.
SETTINGS = "settings"
#: Longer than the writing of any frame takes.
ABANDONED_SECONDS = 900.0


def settings_hash(frame: Frame, assets: Mapping[str, Path]) -> str:
    """SHA-256 over all that decides what the picture is.

    That is the description of the frame down to the last vertex, the content of its assets, and the version of DR-GS;
    not the number of threads or the device.

    Parameters
    ----------
    frame : Frame
    assets : mapping of str to Path
        Path of the asset behind each ``ObjectState.asset``.
    """
    description, arrays = encode_frame(frame)
    for name in ("threads", "device"):
        del description["settings"][name]
    for state in description["objects"]:
        state["asset"] = digest_asset(assets[state["asset"]])
    digest = hashlib.sha256(json.dumps([__version__, description], sort_keys=True).encode())
    for slot, array in sorted(arrays.items()):
        digest.update(f"{slot} {array.dtype.str} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def is_complete(path: Path, frame: Frame, settings: str) -> bool:
    """Whether `path` is a frame that decodes, has the right size and passes, and was made with these settings."""
    stored = read_complete(path)
    x0, y0, x1, y1 = frame.camera.window
    kinds = (kind for name in frame.passes if (kind := pass_of(name)))
    expected = {kind.name: (y1 - y0, x1 - x0, len(kind.channels)) for kind in kinds}
    return (
        stored is not None
        and stored[1].get(SETTINGS) == settings
        and {name: p.shape for name, p in stored[0].items()} == expected
    )


def read_complete(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]] | None:
    """Passes and metadata of the frame at `path`; None where there is none that decodes."""
    if not path.is_file():
        return None
    try:
        with quiet_descriptors():
            return read_frame(path)
    except AssetError as error:
        logger.info("made again: %s", error)
        return None


def remove_abandoned(template: str) -> None:
    """Remove unfinished frames whose writers were killed: those that nobody has added to for long.

    Parameters
    ----------
    template : str
        Pattern of the frames, with ``#``.
    """
    folder, name = Path(template).parent, re.sub("#+", "*", glob.escape(Path(template).name))
    stem, suffix = os.path.splitext(name)
    with contextlib.suppress(OSError), tempfile.TemporaryFile(dir=folder) as new:
        now = os.fstat(new.fileno()).st_mtime  # by the clock of the disk, which may not be that of this machine
        for found in glob.glob(f".{stem}*{suffix}.*.tmp", root_dir=folder):
            if now - (folder / found).stat().st_mtime > ABANDONED_SECONDS:
                (folder / found).unlink()


@contextlib.contextmanager
def quiet_descriptors() -> Iterator[None]:
    """Silence stdout and stderr: OpenEXR prints "Warning:", on which strict farms fail a task.

    Its C++ side writes to the descriptors, its Python side to the streams.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [os.dup(1), os.dup(2)]
    try:
        with open(os.devnull, "wb") as nothing:
            os.dup2(nothing.fileno(), 1)
            os.dup2(nothing.fileno(), 2)
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            yield
    finally:
        for target, copy in enumerate(kept, 1):
            os.dup2(copy, target)
            os.close(copy)


def save(path: Path, pictures: Mapping[str, np.ndarray], frame: Frame, number: int, settings: str) -> None:
    """Write a frame; WriteError when it cannot be written and read back."""
    metadata = {SETTINGS: settings, "frame": str(number), "seed": str(frame.settings.seed)}
    write_frame(path, dict(pictures), metadata | camera_metadata(frame) | cryptomatte.metadata(frame))
