"""Local features (SIFT) and their matches, in COLMAP's database; what is there already is not computed again."""

from __future__ import annotations

import logging
import shutil
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..core.errors import Cancelled, WriteError
from . import libraries

logger = logging.getLogger(__name__)

Tell = Callable[[str, float], None]
#: Number of pictures up to which every one is matched with every other.
EXHAUSTIVE = 120
#: Neighbours in the order of pictures that are matched, and the step of the pictures that are matched with all others
#: of that step: loops close there.
_OVERLAP, _LOOP_STEP = 12, 6
#: Pictures and pairs that are computed before the user can cancel.
_BATCH, _PAIRS = 8, 40
#: Bytes that must be free for a batch: its features or matches, twice, as SQLite writes them to its log first.
_ROOM = 32 << 20
#: Features a picture. Matching grows with their square.
_MOST = 6000
#: Contrast of the faintest feature, COLMAP's own and that inside masks, which leave fewer.
_PEAK, _PEAK_MASKED = 0.0067, 0.002


@dataclass(frozen=True, slots=True)
class Photo:
    """A picture as structure from motion sees it.

    Attributes
    ----------
    file : str
        Name in the folder of pictures.
    lens : tuple
        Pictures with equal ones share a camera.
    focal : float, optional
        Focal length in parts of the longer side, known from EXIF.
    size : tuple of int
        Width and height of the file, pixels.
    given : str
        Name of the user's file, for messages.
    """

    file: str
    lens: tuple[Any, ...]
    focal: float | None
    size: tuple[int, int]
    given: str = ""


def extract(database: Path, pictures: Path, masks: Path | None, photos: Sequence[Photo], tell: Tell,
            cancelled: Callable[[], bool], affine: bool = False) -> None:  # fmt: skip
    """Find the features of `photos`, one camera a lens, and keep them in `database`.

    Parameters
    ----------
    database, pictures : Path
        File; folder of the pictures.
    masks : Path, optional
        Folder of masks, ``NAME.jpg.png``; features lie where they are white, of pictures without one everywhere.
    photos : sequence of Photo
    tell, cancelled : callable
    affine : bool
        Features have an affine shape, and descriptors pooled over scales (Dong and Soatto 2015): they match between
        views farther apart, are a little less exact, and take four times as long.

    Raises
    ------
    DeviceError
        pycolmap is not installed.
    WriteError
        The disk is nearly full.
    Cancelled
        `cancelled` said so.
    """
    colmap = libraries.load("pycolmap")
    with colmap.Database.open(str(database)) as data:
        known = {image.name: image for image in data.read_all_images() if data.exists_descriptors(image.image_id)}
        names = {image.name: image.camera_id for image in known.values()}
    groups: dict[tuple[Any, ...], list[Photo]] = defaultdict(list)
    for photo in photos:
        groups[photo.lens].append(photo)
    options = colmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.sift.max_num_features = _MOST
    options.sift.peak_threshold = _PEAK_MASKED if masks else _PEAK
    options.sift.estimate_affine_shape = options.sift.domain_size_pooling = affine
    done = 0
    for group in groups.values():
        camera = next((names[photo.file] for photo in group if photo.file in names), -1)
        left = [photo for photo in group if photo.file not in names]
        done += len(group) - len(left)
        for batch, masked in _batches(left, masks):
            if cancelled():
                raise Cancelled
            check_room(database.parent)
            tell("finding features", done / len(photos))
            reader = colmap.ImageReaderOptions()
            reader.camera_model = "SIMPLE_RADIAL"
            if masked:
                reader.mask_path = str(masks)
            if camera >= 0:
                reader.existing_camera_id = camera
            elif batch[0].focal is not None:
                width, height = batch[0].size
                reader.camera_params = f"{batch[0].focal * max(width, height)},{width / 2},{height / 2},0"
            colmap.extract_features(
                str(database), str(pictures), [photo.file for photo in batch], colmap.CameraMode.SINGLE, reader,
                options, colmap.Device.cpu,
            )  # fmt: skip
            if camera < 0:
                with colmap.Database.open(str(database)) as data:
                    camera = data.read_image_with_name(batch[0].file).camera_id
            done += len(batch)
    tell("finding features", 1.0)


def mask_file(masks: Path, file: str) -> Path:
    """Where COLMAP looks for the mask of the picture `file`, in the folder `masks`."""
    return masks / f"{file}.png"


def _batches(photos: Sequence[Photo], masks: Path | None) -> Iterator[tuple[list[Photo], bool]]:
    """At most `_BATCH` pictures each, and whether all have a mask or none has: COLMAP skips what lacks its mask."""
    groups: dict[bool, list[Photo]] = {True: [], False: []}
    for photo in photos:
        groups[masks is not None and mask_file(masks, photo.file).is_file()].append(photo)
    for masked, some in groups.items():
        for start in range(0, len(some), _BATCH):
            yield some[start : start + _BATCH], masked


def check_room(folder: Path) -> None:
    """Raise WriteError where a disk is nearly full: where COLMAP cannot write, it ends the whole process."""
    if (free := shutil.disk_usage(folder).free) < _ROOM:
        raise WriteError(
            str(folder), f"has {free / 1e6:.0f} MB of free space left, {_ROOM / 1e6:.0f} are needed to go on",
            "Free some and give the same command again, or choose another folder",
        )  # fmt: skip


def pairs(count: int, ordered: bool) -> list[tuple[int, int]]:
    """Indices of the pictures that are matched with each other.

    All with all, up to `EXHAUSTIVE` pictures that have no order; else neighbours, and all pairs among every sixth.

    Examples
    --------
    >>> len(pairs(40, ordered=False)), len(pairs(90, ordered=True)) < 1400
    (780, True)
    """
    if count <= EXHAUSTIVE and not ordered:
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    near = {(i, j) for i in range(count) for j in range(i + 1, min(i + _OVERLAP + 1, count))}
    coarse = range(0, count, _LOOP_STEP)
    far = {(i, j) for i in coarse for j in coarse if i < j}
    return sorted(near | far)


def match(database: Path, photos: Sequence[Photo], ordered: bool, masked: bool, tell: Tell,
          cancelled: Callable[[], bool]) -> None:  # fmt: skip
    """Match the features of pairs of `photos` and verify them by epipolar geometry.

    Parameters
    ----------
    database : Path
    photos : sequence of Photo
    ordered : bool
        Neighbours in the sequence show nearly the same, as in a video.
    masked : bool
        Features are few: matches are sought a second time along epipolar lines.
    tell, cancelled : callable

    Raises
    ------
    WriteError
        The disk is nearly full.
    Cancelled
        `cancelled` said so.
    """
    colmap = libraries.load("pycolmap")
    wanted = [(photos[i].file, photos[j].file) for i, j in pairs(len(photos), ordered)]
    if len(photos) > EXHAUSTIVE and not ordered:
        logger.warning(
            "%d pictures are matched with %d neighbours in the order of their names, and every %d-th with each other; "
            "up to %d would all be matched", len(photos), 2 * _OVERLAP, _LOOP_STEP, EXHAUSTIVE,
        )  # fmt: skip
    with colmap.Database.open(str(database)) as data:
        numbers = {image.name: image.image_id for image in data.read_all_images()}
        left = [(a, b) for a, b in wanted if not data.exists_two_view_geometry(numbers[a], numbers[b])]
    options = colmap.FeatureMatchingOptions()
    options.use_gpu = False
    options.guided_matching = masked
    geometry = colmap.TwoViewGeometryOptions()
    geometry.min_num_inliers = 12 if masked else 15
    geometry.ransac.random_seed = 0
    pairing = colmap.ImportedPairingOptions()
    listed = database.with_name("pairs.txt")
    for start in range(0, len(left), _PAIRS):
        if cancelled():
            raise Cancelled
        check_room(database.parent)
        tell("matching features", 1 - (len(left) - start) / len(wanted))
        batch = left[start : start + _PAIRS]
        listed.write_text("".join(f"{a} {b}\n" for a, b in batch), encoding="utf-8")
        pairing.match_list_path = str(listed)
        colmap.match_image_pairs(str(database), options, pairing, geometry, colmap.Device.cpu)
    listed.unlink(missing_ok=True)
    tell("matching features", 1.0)
