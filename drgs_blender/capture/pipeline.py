"""From photographs or a video to a capture: frames, inspection, cameras, world, folder."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ..core.errors import AssetError, UsageError
from . import bracket_merge, brackets, capture_folder, features, gravity, libraries, marker_poses, pictures, video
from .features import Photo, Tell
from .inspection import check_count, inspect
from .left_out import Cause, Reason, as_report, cause_of, lines, tell_left_out
from .marker_sheet import MarkerSheet, recognise
from .masks import stage as mask_stage
from .masks.still_background import StillBackground, find_still_background, small_copies, write_turned
from .pictures import Picture
from .preparation import Prepared, prepare
from .registration import FEWEST, Registration, register
from .soundness import check_directions
from .still_camera import stood_still
from .world_alignment import Alignment, align_to_ground, align_to_markers

logger = logging.getLogger(__name__)

POSES = ("auto", "markers", "features")
#: Part of the pictures that must show the sheet for it alone to give the cameras.
_MARKED = 0.8
_STOOD_STILL = "shows the same surroundings in all pictures: the camera stood still, and the object was turned"
_STILL_REMEDY = (
    "Draw masks (white on the object, folder masks), or lay a marker sheet under the object and turn it with it "
    "(drgs markers)"
)


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of `make_capture`.

    Attributes
    ----------
    frames : int
        Of a video that are used, about.
    size : int
        Pixels of the longer side at which features are found.
    poses : str
        One of `POSES`: cameras from a marker sheet or from features; auto: the sheet, where most pictures show it.
    marker_length : float, optional
        Side of the sheet's black squares as measured, mm; None: printed in true size.
    distance : float, optional
        Median distance of the cameras from the object, metres, where no sheet gives the scale.
    masks : str
        One of `masks.stage.MODES`: given: those that are there are used; auto: where there are none they are made;
        none: neither. Or a segmentation model that makes them, see `masks.segmentation_model`.
    brackets : str
        Exposure brackets that are merged: "auto", by EXIF; a number, of so many files each; "none".
    """

    frames: int = video.DEFAULT_FRAMES
    size: int = 1600
    poses: str = "auto"
    marker_length: float | None = None
    distance: float | None = None
    masks: str = "given"
    brackets: str = brackets.AUTO


@dataclass(slots=True)
class Made:
    """A capture that was made: how many pictures, of how many, what was left out and why, what it rests on."""

    folder: Path
    pictures: int
    of: int
    left_out: dict[str, Cause]
    method: str
    error: float
    alignment: Alignment | None = None
    kept: bool = False
    lines: list[str] = field(default_factory=list)


def make_capture(source: Path, folder: Path, settings: Settings, tell: Tell, cancelled: Callable[[], bool]) -> Made:
    """Make a capture with cameras, in a folder that `reconstruct` reads.

    A run that was stopped goes on where it was when it is called again with the same inputs and settings.

    Parameters
    ----------
    source : Path
        Folder of photographs (or with `images`, and `masks` beside it), video, or folder with one.
    folder : Path
        To write.
    settings : Settings
    tell : callable
        Called as (phase, part done).
    cancelled : callable

    Raises
    ------
    AssetError
        Pictures cannot be used, or too few can be registered.
    UsageError
        `folder` is not free, or a setting is unknown.
    DeviceError
        A library is not installed.
    Cancelled
        `cancelled` said so.
    """
    check_settings(settings)
    if not source.exists():
        raise AssetError(str(source), "does not exist", "Check the path")
    capture_folder.check_folder(folder, source)
    film = pictures.find_video(source)
    given = pictures.find_pictures(source) if film is None else [Picture(film, film.stem)]
    if settings.masks == "none":
        for picture in given:
            picture.mask, picture.alpha = None, False
    if film is not None and settings.brackets not in (brackets.AUTO, brackets.NONE):
        raise UsageError("brackets", f"is {settings.brackets}, and {film.name} a video", "Leave it out for videos")
    bracketed = brackets.find_brackets(given, settings.brackets, source) if film is None else None
    if film is None and len(given) < FEWEST:
        check_count(given, str(source))
    with capture_folder.open_folder(folder) as work:
        return _make(source, folder, work, film, given, bracketed, settings, tell, cancelled)


def _make(source: Path, folder: Path, work: Path, film: Path | None, given: list[Picture],
          bracketed: brackets.Brackets | None, settings: Settings, tell: Tell,
          cancelled: Callable[[], bool]) -> Made:  # fmt: skip
    """`make_capture` in a folder that is open."""
    digest = pictures.digest(given, settings)
    if capture_folder.complete(folder, digest):
        return Made(folder, 0, 0, {}, "", 0.0, kept=True, lines=[f"{folder}: is made of the same pictures already"])
    capture_folder.keep_work(work, work_key(given, settings))
    if film is not None:
        given = _frames(film, work, settings.frames, _part(tell, 0.0, 0.1), cancelled)
    unread, bracket_lines = dict[str, Cause](), list[str]()
    if bracketed is not None:
        merged = bracket_merge.merge_brackets(
            given, bracketed, work / "brackets", str(source), _part(tell, 0.0, 0.1), cancelled
        )
        given, unread, bracket_lines = merged.pictures, merged.left_out, merged.lines
    seek = settings.poses != "features"
    ready = prepare(given, work, settings.size, seek, _part(tell, 0.1, 0.2), cancelled)
    fit, left_out = inspect(ready.pictures, ready.looks, str(source))
    left_out |= ready.broken | unread
    photos = [photo for photo, picture in zip(ready.photos, ready.pictures) if any(picture is one for one in fit)]
    by_file = {photo.file: picture for photo, picture in zip(ready.photos, ready.pictures)}
    ups = {photo.file: up for photo in photos if (up := by_file[photo.file].exif.up) is not None}
    still = _still_background(ready, photos, settings, str(source), _part(tell, 0.2, 0.22), cancelled)
    sought = ready
    if still is not None:
        sought = replace(ready, masks=write_turned(still, work / "turned", photos))
        for file, behind in still.behind.items():
            by_file[file].behind = behind
    found, alignment = _cameras(
        sought, photos, ups, film is not None, source, settings, _part(tell, 0.22, 0.85), cancelled
    )
    alignment.apply(found)
    for photo in photos:
        if photo.file not in found.matrices:
            left_out[by_file[photo.file].path.name] = cause_of(found, photo.file)
    made = Made(folder, len(found.matrices), len(given), left_out, found.method, 0.0, alignment)
    made.error = sum(found.errors.values()) / len(found.errors)
    mode, of_masks = mask_stage.mode_on_ground(settings.masks, ready.masks, alignment.ground_from)
    _tell_guesses(alignment, source, of_masks)
    masked = mask_stage.make_or_check(
        mode, found, by_file, ready.folder, work / "object_masks", folder / mask_stage.CONTACT_SHEET,
        ready.masks, str(source), _part(tell, 0.85, 0.96), cancelled,
    )  # fmt: skip
    if still is not None and not any(picture.mask for picture in by_file.values()):
        raise AssetError(
            str(source), f"{_STOOD_STILL}, and no masks could be made: the room would become part of the object",
            _STILL_REMEDY,
        )  # fmt: skip
    told = _lines(made) + bracket_lines + masked.lines
    made.lines = told + [f"left out: {line}" for line in lines(left_out)]
    tell_left_out(found, photos, by_file, source)
    doubtful = {fit.name: Cause(Reason.DOUBTFUL_MASK, fit.said) for fit in masked.fits if fit.doubtful}
    tell("writing the capture", 0.96)
    more = {
        "digest": digest,
        "method": found.method,
        "left_out": {name: str(cause) for name, cause in left_out.items()},
        "reasons": as_report(left_out | doubtful),
        "scale": alignment.scale_from,
        "up": alignment.up_from,
        "ground": alignment.ground_from,
        "error": round(made.error, 4),
    }
    if bracketed is not None:
        more["brackets"] = {picture.name: picture.merged for picture in given if picture.merged}
    if masked.fits:
        more["masks"] = {
            fit.name: {"outside": round(fit.outside, 4), "missing": round(fit.missing, 4)} for fit in masked.fits
        }
    said = [f"{source.name}: {told[0]}", *told[1:], *(f"left out: {line}" for line in lines(left_out, 3))]
    capture_folder.write_capture(folder, by_file, found, said, more, alignment.guessed)
    return made


def _part(tell: Tell, start: float, end: float) -> Tell:
    """`tell` for one part of the work."""
    return lambda phase, part: tell(phase, start + (end - start) * part)


def work_key(given: list[Picture], settings: Settings) -> str:
    """Fingerprint of what features and matches depend on."""
    return pictures.digest(given, settings.frames, settings.size, settings.brackets, settings.masks == "none")


def _frames(film: Path, work: Path, count: int, tell: Tell, cancelled: Callable[[], bool]) -> list[Picture]:
    """The frames of a video as pictures; written once."""
    folder, done = work / "frames", work / "frames.done"
    if not done.is_file():
        shutil.rmtree(folder, ignore_errors=True)
        video.extract_frames(film, folder, count, tell, cancelled)
        done.touch()
    return pictures.find_pictures(folder)


def _cameras(ready: Prepared, photos: list[Photo], ups: dict[str, gravity.Vector], ordered: bool, source: Path,
             settings: Settings, tell: Tell,
             cancelled: Callable[[], bool]) -> tuple[Registration, Alignment]:  # fmt: skip
    """Cameras, from a marker sheet or from features, and the world they belong in."""
    sheet = None
    marked: Registration | None = None
    numbers = {number for photo in photos for number in ready.markers.get(photo.file, ())}
    if settings.poses != "features" and (paper := recognise(numbers)):
        sheet = MarkerSheet(paper, settings.marker_length)
        marked = marker_poses.poses_from_markers(sheet, ready.markers, photos)
        logger.info("%s: %d of %d pictures show the %s marker sheet", source, len(marked.matrices), len(photos), paper)
    if settings.poses == "markers" and (marked is None or len(marked.matrices) < FEWEST):
        count = 0 if marked is None else len(marked.matrices)
        raise AssetError(
            str(source),
            f"shows a marker sheet in {count} pictures, of {FEWEST} that are needed",
            "Print one (drgs markers), keep it flat, and let each picture show several markers",
        )
    if marked is not None and sheet is not None:
        enough = len(marked.matrices) >= max(FEWEST, _MARKED * len(photos))
        if settings.poses == "markers" or enough:
            return marked, _of_sheet(sheet)
    try:
        found = _by_features(ready, photos, ordered, str(source), tell, cancelled)
        check_directions(found, str(source))
    except AssetError as error:
        if marked is None or sheet is None or len(marked.matrices) < FEWEST:
            raise
        logger.warning("%s. The %d pictures that show the marker sheet are used", error, len(marked.matrices))
        return marked, _of_sheet(sheet)
    alignment = None
    if marked is not None and sheet is not None:
        alignment = align_to_markers(found, marked, sheet.name)
        if alignment is None and marked.matrices:
            logger.warning(
                "%s: the marker sheet does not fit the other cameras; it may have moved. It is not used", source
            )
    if alignment is None:
        alignment = align_to_ground(found, settings.distance, gravity.measured_up(found, ups, str(source)))
    return found, alignment


def _still_background(ready: Prepared, photos: list[Photo], settings: Settings, subject: str, tell: Tell,
                      cancelled: Callable[[], bool]) -> StillBackground | None:  # fmt: skip
    """What stood still, where pictures without masks show an object that was turned before a still camera, else None.

    Refused where masks are not to be made, or nothing is seen to turn, unless the object turned with a marker sheet;
    `Settings.poses` "features" tries them all the same.
    """
    files = {photo.file for photo in photos}
    looks = [one.signature for photo, one in zip(ready.photos, ready.looks, strict=True) if photo.file in files]
    if ready.masks is not None or not stood_still(looks):
        return None
    if settings.masks not in ("given", "none"):
        cv2 = libraries.load("opencv")
        found = find_still_background(cv2, small_copies(ready.folder, photos), tell, cancelled)
        if found is not None:
            logger.info("%s %s: features and masks are sought where something turned", subject, _STOOD_STILL)
            return found
        problem = f"{_STOOD_STILL}, and what turned cannot be told from what stood still"
    else:
        problem = f"{_STOOD_STILL}: features would find the room, not the object"
    if settings.poses == "features":
        logger.warning("%s %s. %s", subject, problem, _STILL_REMEDY)
        return None
    marked = {photo.file for photo in photos if ready.markers.get(photo.file)}
    if len(marked) >= max(FEWEST, _MARKED * len(photos)):
        return None
    remedy = _STILL_REMEDY if settings.masks != "given" else f"Give --masks auto. Else: {_STILL_REMEDY}"
    raise AssetError(subject, problem, f"{remedy}; --poses features tries it all the same")


def _by_features(ready: Prepared, photos: list[Photo], ordered: bool, subject: str, tell: Tell,
                 cancelled: Callable[[], bool]) -> Registration:  # fmt: skip
    """Cameras by features; where pictures are missing once more, by features that views farther apart share.

    Of frames, and where there are too many pictures to match all, missing ones are not worth the time.
    """
    best: Registration | None = None
    affine = (False,) if ordered or len(photos) > features.EXHAUSTIVE else (False, True)
    for again in affine:
        part = _part(tell, 0.6, 1.0) if again else _part(tell, 0.0, 0.6)
        suffix = "_affine" if again else ""
        database, models = (ready.folder.with_name(name) for name in (f"database{suffix}.db", f"models{suffix}"))
        features.extract(database, ready.folder, ready.masks, photos, _part(part, 0.0, 0.3), cancelled, again)
        features.match(database, photos, ordered, ready.masks is not None, _part(part, 0.3, 0.75), cancelled)
        try:
            found = register(database, ready.folder, models, photos, subject, _part(part, 0.75, 1.0), cancelled)
        except AssetError:
            if again == affine[-1] and best is None:
                raise
            continue
        found.method += ", affine features" if again else ""
        if best is None or len(found.matrices) > len(best.matrices):
            best = found
        if len(best.matrices) == len(photos):
            break
    assert best is not None
    return best


def _tell_guesses(alignment: Alignment, source: Path, of_masks: str = "") -> None:
    """Warn of what is assumed of the world and what masks suffer by it, and say what would tell it."""
    guessed = alignment.guessed
    if "scale" in guessed:
        logger.warning(
            "%s: nothing says how large the object is: the cameras are taken to be 1 m from it. A marker sheet "
            "(drgs markers) or --camera-distance gives the scale", source,
        )  # fmt: skip
    if "ground" in guessed:
        logger.warning(
            "%s: no level plane is found under the object: %s (%s) guessed. Lay a marker sheet (drgs markers) or "
            "something with texture under it, or turn and move the object where it is used%s",
            source, "up and the height of the ground are" if "up" in guessed else "the height of the ground is",
            "; ".join(why for name, why in guessed.items() if name != "scale"), f". {of_masks}" if of_masks else "",
        )  # fmt: skip


def _of_sheet(sheet: MarkerSheet) -> Alignment:
    """The sheet's own frame."""
    import numpy as np

    said = f"marker sheet ({sheet.name})"
    return Alignment(1.0, np.eye(3), np.zeros(3), said, said, said)


def _lines(made: Made) -> list[str]:
    """What is said of a capture."""
    alignment: Any = made.alignment
    doubt = {name: " (guessed)" for name in alignment.guessed}
    return [
        f"{made.pictures} of {made.of} pictures have cameras ({made.method}; reprojection error {made.error:.2f} px)",
        f"scale: {alignment.scale_from}",
        f"up: {alignment.up_from}{doubt.get('up', '')}; ground: {alignment.ground_from}{doubt.get('ground', '')}",
    ]


def check_settings(settings: Settings) -> None:
    """Raise UsageError for unknown settings, and DeviceError where a library that they need is absent."""
    if settings.poses not in POSES:
        raise UsageError("poses", f"is {settings.poses!r}", f"Choose from {', '.join(POSES)}")
    brackets.check_setting(settings.brackets)
    libraries.load("opencv" if settings.poses == "markers" else "pycolmap")
    mask_stage.check_mode(settings.masks)
