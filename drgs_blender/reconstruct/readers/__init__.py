"""Readers of captures: COLMAP, NeRF transforms, LLFF, NeRO, TensoIR; recognised by the files of the folder."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...core.errors import AssetError, UsageError, first_of
from ...core.file_types import TURNTABLE
from ...formats.axes import UP_AXES
from ..capture.capture import Capture, View
from ..capture.turntable import is_turned, light_turns
from ..memory_budget import check_fits
from . import colmap, llff, nero, tensoir, transforms
from .camera_overlap import check_overlap
from .exposures import find_gains
from .layout import WORK, Layout
from .lens import Lens
from .photograph_loading import cut_out, find_background, load_photograph
from .usable_photographs import usable
from .world_frame import AXES, check_positions, check_silhouettes, turn_upright

logger = logging.getLogger(__name__)

__all__ = ["AXES", "LAYOUTS", "Reader", "has_cameras", "read_capture"]


@dataclass(frozen=True, slots=True)
class Reader:
    """A layout of captures: its name, how it is recognised, how it is read, one line of documentation.

    ``read`` of a layout with ``lights``, which holds pictures under several, takes the name of one of them as well.
    """

    name: str
    sniff: Callable[[Path], bool]
    read: Callable[..., Layout]
    about: str
    lights: bool = False


#: The table; the first that recognises a path reads it.
LAYOUTS = (
    Reader("transforms", transforms.sniff, transforms.read, "transforms*.json of NeRF-synthetic, NGP, nerfstudio"),
    Reader("NeRO", nero.sniff, nero.read, "GlossySynthetic: k.png, k-depth.png, k-camera.pkl"),
    Reader("TensoIR", tensoir.sniff, tensoir.read, "train_000/{metadata.json, rgba_LIGHT.png} ...", lights=True),
    Reader("COLMAP", colmap.sniff, colmap.read, "sparse/0 with cameras and images, text or binary, beside images"),
    Reader("LLFF", llff.sniff, llff.read, "poses_bounds.npy beside images"),
)
#: Bytes that are kept of every pixel: colour, mask, the colour without its surroundings, and all in half size.
BYTES_A_PIXEL = 32


def read_capture(
    path: str | Path,
    resolution: int | None = None,
    test_every: int | None = None,
    axes: str = "opengl",
    up: str | None = None,
    light: str | None = None,
    turntable: str = "auto",
    tell_guesses: bool = True,
) -> Capture:
    """Read calibrated photographs of one object.

    Parameters
    ----------
    path : str or Path
        A folder of any layout of `LAYOUTS`, or its transforms.json.
    resolution : int, optional
        Pixels of the longer side at most; None keeps the photographs' size.
    test_every : int, optional
        Leave out every n-th view, from the first in the order of their names; where the capture itself says which
        views are left out, that counts instead.
    axes : str
        Convention of the file's matrices, a key of `AXES`; "opengl" is each layout's own convention.
    up : str, optional
        The world's up axis, a key of `formats.axes.UP_AXES`; None: as the layout prescribes, else found from the
        cameras, which people hold level.
    light : str, optional
        Which pictures to read where a layout has every view under several lights.
    turntable : {"auto", "yes", "no"}
        Whether the object was turned and the light stood still with the camera; "auto": where the surroundings of the
        object are the same in all pictures, with a warning.
    tell_guesses : bool
        Warn of what `drgs capture` guessed of the world; not where it has just said so.

    Returns
    -------
    Capture
        Lenses straightened, Z up. Pictures with alpha are laid on white. Where there are neither alpha nor masks but
        every picture has a border of one colour, what differs from it is the mask. Photographs that cannot be used
        are left out with a warning, see `usable_photographs.usable`; exposures that differ are evened out with one, see
        `exposures.find_gains`.

    Raises
    ------
    AssetError
        Naming the file: nothing is recognised, images are missing or of another shape than their mask or calibration,
        fewer than two cameras, cameras whose silhouettes do not meet or that look at different things.
    UsageError
        A parameter out of range, or more pixels than the memory holds.
    """
    path = Path(path)
    _check_parameters(resolution, test_every, axes, up, turntable)
    layout, turn = read_layout(path, axes, up, light)
    photographs = layout.photographs
    _check_memory(layout, resolution, path)
    if tell_guesses:
        _tell_guesses(layout, path, up)
    known: dict[Lens, tuple[Lens, np.ndarray]] = {}
    gains = find_gains(photographs, str(path))
    developed = [(p, load_photograph(p, layout, resolution, known, g)) for p, g in zip(photographs, gains, strict=True)]
    views = usable(developed, str(path))
    _tell_notes(layout, path)
    if all(view.mask is None for view in views) and cut_out(views):
        logger.warning(
            "%s: has no masks; what differs from the colour of the pictures' borders is taken for the object. "
            "Draw masks if it has parts of that colour",
            path,
        )
    if test_every is not None:
        if len({view.test for view in views}) > 1:
            logger.warning("%s: says itself which views are left out; every %d-th is not", path, test_every)
        else:
            for index, view in enumerate(views):
                view.test = index % test_every == 0
    learned = [view for view in views if not view.test]
    check_silhouettes(learned, str(path), axes)
    if all(view.mask is None for view in learned):
        check_overlap(learned, str(path))
    _turn_light(views, turntable, path)
    points = None if layout.points is None else (layout.points @ turn[:3, :3].T).astype(np.float32)
    return Capture(path, views, find_background(views), points)


def _turn_light(views: list[View], turntable: str, path: Path) -> None:
    """Let the light stand still with the camera where the object was turned."""
    if turntable == "no" or (turntable == "auto" and not is_turned(views)):
        return
    if turntable == "auto":
        logger.warning(
            "%s: the surroundings are the same in all pictures, wherever the camera should be: the object was turned, "
            "and the light is taken to stand still with the camera. If it does not, give --turntable no",
            path,
        )
    for view, turn in zip(views, light_turns(views), strict=True):
        view.turn = turn


def read_layout(
    path: Path, axes: str = "opengl", up: str | None = None, light: str | None = None
) -> tuple[Layout, np.ndarray]:
    """Where the photographs of a capture were taken, without their pixels.

    Parameters
    ----------
    path : Path
    axes : str
    up, light : str, optional
        As of `read_capture`.

    Returns
    -------
    layout : Layout
        Photographs in the order of their names; their matrices are of a world with Z up, its points of the capture's.
    turn : (4, 4) float64 array
        From the capture's world to that with Z up.

    Raises
    ------
    AssetError
        Nothing is recognised, or cameras are impossible.
    """
    reader = find_layout(path)
    layout = reader.read(path, light) if reader.lights else reader.read(path)
    layout.photographs.sort(key=lambda photograph: _natural(photograph.name))
    matrices = np.stack([AXES[axes](photograph.matrix) for photograph in layout.photographs])
    check_positions(matrices, str(path), axes)
    turn = _turn(layout, matrices, axes, up)
    for photograph, matrix in zip(layout.photographs, matrices):
        photograph.matrix = turn @ matrix
    return layout, turn


def _tell_guesses(layout: Layout, path: Path, up: str | None) -> None:
    """Warn once of what `drgs capture` assumed of the world, but for an up that is given now."""
    guessed = [f"{name} ({why})" for name, why in layout.guessed.items() if name != "up" or up is None]
    if guessed:
        logger.warning(
            "%s: was made without knowing %s. Turn, move and scale the object where it is used, or capture it again "
            "with a marker sheet (drgs markers)", path, ", ".join(guessed),
        )  # fmt: skip


def _tell_notes(layout: Layout, path: Path) -> None:
    """Warn once of photographs that are used otherwise than they are stored."""
    if layout.notes:
        (image, note), count = layout.notes[0], len({image for image, _ in layout.notes})
        logger.warning("%s: of %d pictures not all is used as stored, as of %s: %s", path, count, image.name, note)


def find_layout(path: Path) -> Reader:
    """The layout of the capture at `path`. Raises AssetError, listing what is understood."""
    understood = "Understood: " + "; ".join(f"{reader.name} ({reader.about})" for reader in LAYOUTS)
    try:
        if not path.exists():
            raise AssetError(str(path), "does not exist", "Check the path")
        if reader := _known(path):
            return reader
        inner = sorted(path.iterdir()) if path.is_dir() else []
        captures = [str(one) for one in inner if os.access(one, os.R_OK | os.X_OK) and one.is_dir() and _known(one)]
    except OSError as error:
        raise AssetError(str(path), f"cannot be read: {error.strerror or error}", "Check its permissions") from error
    if captures:
        raise AssetError(str(path), f"is no capture, but holds some: {first_of(captures)}", "Give one of them")
    if (path / WORK).is_dir():
        raise AssetError(
            str(path), "is a capture that is not finished", "Give the drgs capture command again: it goes on"
        )
    raise AssetError(str(path), "is no capture", f"{understood}. Photographs without cameras: drgs capture")


def has_cameras(path: Path) -> bool:
    """Whether there are photographs with cameras at `path`, in a layout of `LAYOUTS`, or in a folder below it."""
    try:
        inner = [one for one in path.iterdir() if one.is_dir()] if path.is_dir() else []
        return any(_known(one) for one in (path, *inner))
    except OSError:
        return False


def _known(path: Path) -> Reader | None:
    """The first layout that `path` has."""
    return next((reader for reader in LAYOUTS if reader.sniff(path)), None)


def _natural(name: str) -> list[tuple[int, str]]:
    """Sorting key by which r_2 comes before r_10."""
    return [(int(part or -1), text) for text, part in re.findall(r"(\D*)(\d*)", name)]


def _check_parameters(
    resolution: int | None, test_every: int | None, axes: str, up: str | None, turntable: str
) -> None:
    if resolution is not None and resolution < 8:
        raise UsageError("resolution", f"is {resolution} pixels", "Choose at least 8")
    if test_every is not None and test_every < 2:
        raise UsageError("test-every", f"is {test_every}, which leaves nothing to learn from", "Choose at least 2")
    if axes not in AXES:
        raise UsageError("axes", f"is {axes!r}", f"Choose from {', '.join(AXES)}")
    if turntable not in TURNTABLE:
        raise UsageError("turntable", f"is {turntable!r}", f"Choose from {', '.join(TURNTABLE)}")
    if up is not None and up not in UP_AXES:
        raise UsageError("up", f"is {up!r}", f"Choose from {', '.join(UP_AXES)}")


def _turn(layout: Layout, matrices: np.ndarray, axes: str, up: str | None) -> np.ndarray:
    """(4, 4) rotation of the capture's world to Z up."""
    turn = np.eye(4)
    if up is not None:
        turn[:3, :3] = UP_AXES[up]
    elif not layout.upright:
        turn[:3, :3] = turn_upright(matrices)
    return turn


def _check_memory(layout: Layout, resolution: int | None, path: Path) -> None:
    """Raise UsageError where the pixels of all views would not fit in half of the memory."""
    pixels = 0.0
    for photograph in layout.photographs:
        width, height = photograph.lens.width, photograph.lens.height
        factor = 1.0 if resolution is None else min(1.0, resolution / max(width, height))
        pixels += width * height * factor**2
    largest = max(max(p.lens.width, p.lens.height) for p in layout.photographs)
    value = min(resolution or largest, largest)
    check_fits(pixels * BYTES_A_PIXEL, str(path), "pixels", "--resolution", value, 2)
