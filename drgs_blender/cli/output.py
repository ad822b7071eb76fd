"""Output paths of commands: checked before work starts, written in one step."""

from __future__ import annotations

import argparse
import contextlib
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..core.asset import Asset
from ..core.errors import UsageError, WriteError


def file_name(text: str) -> Path:
    """Parser of the path of a file or folder, which is not empty."""
    return Path(file_pattern(text))


def file_pattern(text: str) -> str:
    """Parser of a pattern of files, which is not empty."""
    if not text:
        raise argparse.ArgumentTypeError("an empty file name")
    return text


def check_suffix(path: Path, suffixes: tuple[str, ...]) -> None:
    """Refuse an output whose extension is not one of `suffixes`."""
    if path.suffix.lower() not in suffixes:
        raise UsageError(f"--out {path}", f"does not end in {' or '.join(suffixes)}", "Choose such a name")


def check_writable(path: Path, inputs: Iterable[Path | None] = ()) -> None:
    """Make the folder of `path` and prove that a file can be written there; a long job must not find out last.

    Parameters
    ----------
    path : Path
        File to write; it may be there.
    inputs : iterable of Path or None
        Files that are read, which `path` must not replace.

    Raises
    ------
    UsageError
        `path` is one of `inputs`, or OpenEXR cannot write a file of that name.
    WriteError
        Naming the path and the system's reason.
    """
    check_not_input(path, inputs)
    _check_name(path)
    check_folders(path)
    try:
        if path.is_dir():
            raise WriteError(str(path), "is a folder", "Choose the name of a file")
        if path.exists() and not path.is_file():  # it would be replaced by a file, and who reads a pipe would wait
            raise WriteError(str(path), "is a pipe or a device", "Choose the name of a file")
        target = path.resolve() if path.is_symlink() else path  # where it leads is where the file will be written
        target.parent.mkdir(parents=True, exist_ok=True)
        # As long as the temporary name under which the file will be written: a long name must not fail last either.
        with tempfile.NamedTemporaryFile(dir=target.parent, prefix=f".{target.name}.", suffix=".tmp"):
            pass
    except (OSError, RuntimeError) as error:  # pathlib's RuntimeError: links in a circle
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise WriteError(str(path), f"cannot be written ({reason})", "Check the folder and its permissions") from error


def check_folders(path: Path) -> None:
    """Refuse an output below something that is no folder. Raises WriteError, which names that."""
    for parent in path.parents:
        with contextlib.suppress(OSError, RuntimeError):  # one that cannot be looked at is told when it is made
            if parent.exists() and not parent.is_dir():
                raise WriteError(str(parent), "is no folder", f"Choose another place for {path.name}, or remove it")


def check_not_input(path: Path, inputs: Iterable[Path | None]) -> None:
    """Refuse an output that is one of the files read, also under another name. Raises UsageError."""
    for source in inputs:
        with contextlib.suppress(OSError, ValueError):  # what is not there is no input
            if source is not None and path.samefile(source):
                raise UsageError(str(path), "is also the input", "Choose another name")


def _check_name(path: Path) -> None:
    """Refuse a name that OpenEXR, which takes UTF-8, cannot open. Raises UsageError."""
    try:
        os.fspath(path.absolute()).encode()
    except UnicodeEncodeError as error:
        if path.suffix.lower() == ".exr":
            shown = os.fsencode(path).decode(errors="backslashreplace")
            raise UsageError(shown, "is not a name in UTF-8", "Choose another name or folder") from error


def write_and_report(path: Path, asset: Asset) -> None:
    """Write an asset and say on stdout what it holds, and what its maker noted."""
    from ..core.asset.container import write_asset

    write_asset(path, asset)
    print(f"{path}: {len(asset.surfels)} surfels on {len(asset.mesh.faces)} triangles")
    if "materials" in asset.provenance:
        print(f"  materials: {asset.provenance['materials']}")
    for note in notes_of(asset.provenance):
        print(f"  {note}")


def notes_of(provenance: Mapping[str, Any]) -> Iterator[str]:
    """Every text in lists called notes, at any depth: what a reader converted, assumed or left out."""
    for key, value in provenance.items():
        if isinstance(value, Mapping):
            yield from notes_of(value)
        elif key.endswith("notes"):
            yield from value


def write_preview(path: Path, combined: np.ndarray) -> None:
    """Write a picture to look at.

    Parameters
    ----------
    path : Path
        PNG file.
    combined : (h, w, 4) float32 array
        Linear Rec.709, premultiplied alpha; written as 8-bit sRGB, straight alpha, clipped to [0, 1]. Nothing else is
        done to it: view transforms belong to Blender.
    """
    from ..core.color import linear_to_srgb
    from ..formats.images import write_png

    alpha = np.clip(np.nan_to_num(combined[..., 3:4]), 0, 1)
    linear = np.clip(np.nan_to_num(combined[..., :3]) / np.maximum(alpha, 1e-6), 0, 1)
    pixels = (np.concatenate([linear_to_srgb(linear), alpha], axis=-1) * 255 + 0.5).astype(np.uint8)
    write_png(path, pixels)
