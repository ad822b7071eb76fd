"""The folder of a capture: pictures, masks, `transforms.json` as nerfstudio has it, sparse points, the report."""

from __future__ import annotations

import contextlib
import json
import logging
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as Pillow

from ..core.asset.archive import replace_file
from ..core.errors import UsageError, WriteError, first_of
from ..core.file_lock import FileLock
from ..formats.images import write_image
from ..reconstruct.readers.layout import WORK, decode_mask
from .pictures import FOLDERS, MASKS, Picture, write_picture
from .registration import Registration
from .report import draw_cameras, write_report

logger = logging.getLogger(__name__)

#: Files of a finished capture; the last is written last.
REPORT, DRAWING, POINTS, CAMERAS = "capture.json", "capture.png", "sparse_points.ply", "transforms.json"
#: In `WORK`: locked by the process that makes the capture.
LOCK = "lock"
#: In it: the key of the inputs that it belongs to.
INPUTS = "inputs"


def check_folder(folder: Path, source: Path) -> None:
    """Raise an error where a capture cannot be made in `folder`; it may be a new one beside the photographs.

    Raises
    ------
    UsageError
        It is the input, or one of its folders of pictures or inside that, or has files that are not a capture's of
        ours, or its name is not in UTF-8, which COLMAP wants.
    WriteError
        It cannot be made.
    """
    try:
        inner, outer = folder.resolve(), source.resolve()
        taken = [outer / name for name in (*(name for name in FOLDERS if name != "."), MASKS)]
        if inner == outer or any(inner == one or one in inner.parents for one in taken):
            raise UsageError(str(folder), "is where the pictures or masks are", "Choose another folder for the capture")
        if folder.exists() and any(folder.iterdir()) and not _is_ours(folder):
            raise UsageError(str(folder), "holds other files", "Choose a new or empty folder for the capture")
        str(inner).encode()
    except UnicodeEncodeError as error:
        raise UsageError(str(folder), "is not a name in UTF-8", "Choose another folder") from error
    except (OSError, RuntimeError) as error:  # pathlib's RuntimeError: links in a circle
        raise _cannot_be_made(folder, error) from error


@contextlib.contextmanager
def open_folder(folder: Path) -> Iterator[Path]:
    """Make the folder of a capture for this process alone; what it gives is the folder of work in it.

    That goes where the capture is complete.

    Raises
    ------
    UsageError
        Another process is at work there.
    WriteError
        It cannot be made.
    """
    work = folder / WORK
    try:
        work.mkdir(parents=True, exist_ok=True)
        lock = FileLock(work / LOCK)
    except OSError as error:
        raise _cannot_be_made(folder, error) from error
    with lock:
        try:
            free = lock.acquire()
        except OSError:  # a drive that cannot lock files
            free = True
        if not free:
            raise UsageError(str(folder), "is being made by another process", "Wait for it, or choose another folder")
        yield work
    if complete(folder):  # not before: Windows and network drives cannot remove a file that is open
        shutil.rmtree(work, ignore_errors=True)


def _cannot_be_made(folder: Path, error: OSError | RuntimeError) -> WriteError:
    reason = (error.strerror if isinstance(error, OSError) else None) or error
    return WriteError(str(folder), f"cannot be made ({reason})", "Choose another folder")


def keep_work(work: Path, key: str) -> None:
    """Empty the folder of work unless it is that of the same `key`: the same pictures, prepared in the same way."""
    mark = work / INPUTS
    if mark.is_file() and mark.read_text(encoding="utf-8") == key:
        logger.warning("%s: going on with what an earlier run of the same pictures has done", work)
        return
    mark.unlink(missing_ok=True)  # first: what is left after a kill belongs to nothing
    for old in work.iterdir():
        if old.name != LOCK:
            remove(old)
    if left := sorted(old.name for old in work.iterdir() if old.name != LOCK):
        raise WriteError(str(work), f"cannot be emptied ({first_of(left)})", "Remove it, or choose another folder")
    replace_file(mark, [key.encode()])


def remove(path: Path) -> None:
    """Remove a file or folder, as far as that is possible."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink()


def _is_ours(folder: Path) -> bool:
    return (folder / WORK).is_dir() or (folder / REPORT).is_file()


def complete(folder: Path, digest: str | None = None) -> bool:
    """Whether `folder` has a finished capture, of these inputs and settings where given, with all its pictures."""
    try:
        report = json.loads((folder / REPORT).read_text(encoding="utf-8"))
        frames = json.loads((folder / CAMERAS).read_text(encoding="utf-8"))["frames"]
        files = [frame[key] for frame in frames for key in ("file_path", "mask_path") if key in frame]
        return bool(digest in (None, report["digest"]) and all((folder / file).is_file() for file in files))
    except (OSError, ValueError, KeyError, TypeError):
        return False


def known_ground(folder: Path) -> str | None:
    """What the ground of a capture of ours rests on, as its report says; None of other folders."""
    try:
        return str(json.loads((folder / REPORT).read_text(encoding="utf-8"))["ground"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def write_capture(
    folder: Path, pictures: dict[str, Picture], found: Registration, said: list[str], more: dict[str, Any],
    guessed: dict[str, str],
) -> None:  # fmt: skip
    """Write the pictures with their cameras, and the report; `transforms.json` comes last.

    Parameters
    ----------
    folder : Path
    pictures : dict of str to Picture
        Registered file -> picture.
    found : Registration
        Z up, ground at 0, metres.
    said : list of str
        Lines of the report's drawing.
    more : dict
        Further entries of `capture.json`.
    guessed : dict of str to str
        `Alignment.guessed`, which readers of the capture say again.

    Raises
    ------
    WriteError
        A file cannot be written.
    """
    images, masks = folder / "images", folder / "masks"
    (folder / CAMERAS).unlink(missing_ok=True)  # first: what is left after a kill is no capture
    for old in (images, masks, *folder.glob(".*.tmp")):  # the last of runs that were killed
        remove(old)
    images.mkdir()
    frames, notes = [], {}
    for file, matrix in sorted(found.matrices.items()):
        picture = pictures[file]
        lens = found.lenses[file].scaled(*picture.size)
        found.lenses[file] = lens
        written = write_picture(picture, images)
        k = [*lens.coefficients, 0.0, 0.0, 0.0, 0.0]
        frame: dict[str, Any] = {
            "file_path": f"images/{written.name}",
            "transform_matrix": matrix.tolist(),
            "camera_model": "OPENCV",
        }
        frame |= {"w": lens.width, "h": lens.height, "fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy}
        frame |= dict(zip(("k1", "k2", "p1", "p2"), k))
        if picture.mask is not None:
            masks.mkdir(exist_ok=True)
            target = masks / f"{written.stem}.png"
            drawn = Pillow.fromarray(np.asarray(decode_mask(picture.mask) * 255 + 0.5, np.uint8))
            write_image(target, drawn)
            frame["mask_path"] = f"masks/{target.name}"
            if picture.mask_band:
                frame["mask_band"] = round(picture.mask_band, 2)
        frames.append(frame)
        if picture.notes:
            notes[picture.path.name] = "; ".join(picture.notes)
        if picture.exif.exposure is not None:
            frame["exposure_value"] = picture.exif.exposure
    (folder / POINTS).unlink(missing_ok=True)
    if len(found.points):
        _write_points(folder / POINTS, found)
    draw_cameras(folder / DRAWING, found, said)
    write_report(folder / REPORT, found, {"notes": notes, "guessed": guessed, **more})
    # nerfstudio's keys: the world stays as it is (Z up); the points that surfels begin at.
    text: dict[str, Any] = {"camera_model": "OPENCV", "orientation_override": "none", "frames": frames}
    if len(found.points):
        text["ply_file_path"] = POINTS
    if guessed:
        text["guessed"] = guessed
    replace_file(folder / CAMERAS, [json.dumps(text, indent=1).encode()])


def _write_points(path: Path, found: Registration) -> None:
    """Sparse points as binary PLY."""
    rows = np.empty(len(found.points), [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    rows["xyz"], rows["rgb"] = found.points, found.colours
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property float {axis}" for axis in "xyz"] + [f"property uchar {c}" for c in ("red", "green", "blue")]
    replace_file(path, ["\n".join([*header, "end_header\n"]).encode("ascii"), rows.tobytes()])
