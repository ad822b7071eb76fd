"""Registration of pictures by COLMAP: cameras, lenses and sparse points by incremental or global mapping."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..core.arrays import Array
from ..core.errors import AssetError, Cancelled
from ..reconstruct.readers.layout import OPENCV_TO_BLENDER, invert
from ..reconstruct.readers.lens import Lens
from . import libraries, moved_object, soundness
from .features import Photo, Tell, check_room
from .left_out import Cause, lines, why_unregistered

logger = logging.getLogger(__name__)

#: Least pictures, and part of all, that must be registered.
FEWEST, PART = 5, 0.5
#: Reprojection error, pixels, above which a further attempt is made although all pictures are registered.
_GOOD_ERROR = 1.5
#: Pictures that must share a lens before its second radial coefficient and its principal point are refined.
_FOR_DISTORTION = 15
_SEED = 0


@dataclass(slots=True)
class Registration:
    """Cameras found for pictures.

    Attributes
    ----------
    matrices : dict of str to (4, 4) float64 array
        File -> camera to world, Blender's axes.
    lenses : dict of str to Lens
        File -> lens, pixels of the registered file.
    errors : dict of str to float
        File -> mean reprojection error of its points, pixels.
    observations : dict of str to int
        File -> points it sees.
    points : (n, 3) float64 array
        Sparse points, world.
    colours : (n, 3) uint8 array
        sRGB.
    method : str
        What found them.
    apart : list of list of str
        Files of further models that share nothing with this one.
    unsound : dict of str to Cause
        File that was registered and is left out -> why its camera cannot be trusted.
    unregistered : dict of str to Cause
        File that was not registered -> why.
    moved : str, optional
        The first file in whose picture a part of the scene stands elsewhere than in those before it.
    """

    matrices: dict[str, Array]
    lenses: dict[str, Lens]
    errors: dict[str, float]
    observations: dict[str, int]
    points: Array
    colours: Array
    method: str
    apart: list[list[str]] = field(default_factory=list)
    unsound: dict[str, Cause] = field(default_factory=dict)
    unregistered: dict[str, Cause] = field(default_factory=dict)
    moved: str | None = None


def _default(options: Any) -> None:
    """COLMAP's own thresholds."""


def _relaxed(options: Any) -> None:
    """Fewer matches suffice, and smaller angles: pictures inside masks, far from their neighbours."""
    options.min_num_matches = 10
    mapper, triangulation = options.mapper, options.triangulation
    mapper.init_min_num_inliers, mapper.init_min_tri_angle = 40, 8.0
    mapper.abs_pose_min_num_inliers, mapper.abs_pose_min_inlier_ratio = 12, 0.12
    mapper.max_reg_trials = 6
    mapper.filter_min_tri_angle = triangulation.min_angle = 0.8
    triangulation.ignore_two_view_tracks = False


#: Incremental attempts in their order: (name, settings, whether it goes on from the best one before).
_ATTEMPTS = (
    ("incremental mapping", _default, False),
    ("global mapping", None, False),
    ("relaxed thresholds", _relaxed, True),
    ("relaxed thresholds from the start", _relaxed, False),
)


def register(database: Path, pictures: Path, work: Path, photos: Sequence[Photo], subject: str, tell: Tell,
             cancelled: Callable[[], bool]) -> Registration:  # fmt: skip
    """Find cameras of matched pictures: attempts until one has all pictures, then the best.

    Best is what has most pictures whose cameras are sound, and of equal ones the lowest reprojection error.

    Parameters
    ----------
    database, pictures, work : Path
        COLMAP's database; folder of the pictures; folder for models, emptied.
    photos : sequence of Photo
    subject : str
        For messages.
    tell, cancelled : callable

    Raises
    ------
    AssetError
        Too few pictures are registered, with their names.
    WriteError
        The disk is nearly full.
    Cancelled
        `cancelled` said so.
    """
    colmap = libraries.load("pycolmap")
    matches = soundness.read_matches(colmap, database)
    best: Any = None
    method, apart, unsound = "", [], dict[str, Cause]()
    for index, (name, settings, goes_on) in enumerate(_ATTEMPTS):
        if goes_on and best is None:
            continue
        folder = work / f"model_{index}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        start = folder / "start"
        if goes_on:
            start.mkdir()
            best.write(str(start))
        models = _attempt(
            colmap, database, pictures, folder, settings, start if goes_on else None, len(photos), name, tell, cancelled
        )
        left_out = {id(model): soundness.leave_out_unsound(model, matches) for model in models}
        models = sorted((model for model in models if model.num_reg_images()), key=_rank, reverse=True)
        if models:
            out = left_out[id(models[0])]
            logger.info("%s: %d of %d pictures, %.2f px; left out: %s", name, models[0].num_reg_images(), len(photos),
                        models[0].compute_mean_reprojection_error(), "; ".join(lines(out)) or "none")  # fmt: skip
        if models and (best is None or _rank(models[0]) > _rank(best)):
            best, method = models[0], f"{method} + {name}" if goes_on else name
            unsound = (unsound if goes_on else {}) | out
            apart = _apart(models)
        if (
            best is not None
            and best.num_reg_images() == len(photos)
            and best.compute_mean_reprojection_error() < _GOOD_ERROR
        ):
            break
    if best is None:
        _refuse([], photos, subject, why_unregistered(colmap, database, matches, photos, ()))
    tell("adjusting cameras", 0.95)
    colmap = libraries.load("pycolmap")  # mapping sets its messages back to all
    _refine(colmap, best)
    while more := soundness.leave_out_unsound(best, matches):
        unsound |= more
        _refine(colmap, best)
    found = _read(best, method, apart)
    found.unsound = {name: why for name, why in unsound.items() if name not in found.matrices}
    found.unregistered = why_unregistered(colmap, database, matches, photos, found.matrices)
    if len(found.matrices) < max(FEWEST, PART * len(photos)):
        _refuse(list(found.matrices), photos, subject, found.unregistered | found.unsound)
    found.moved = moved_object.moved_at(colmap, best, database, [photo.file for photo in photos])
    return found


def _attempt(colmap: Any, database: Path, pictures: Path, folder: Path, settings: Callable[[Any], None] | None,
             start: Path | None, count: int, name: str, tell: Tell,
             cancelled: Callable[[], bool]) -> list[Any]:  # fmt: skip
    """The models that one attempt finds."""
    if cancelled():
        raise Cancelled
    check_room(folder)
    tell(name, 0.0)
    colmap.set_random_seed(_SEED)
    if settings is None:
        options = colmap.GlobalPipelineOptions()
        options.random_seed = _SEED
        try:
            return list(colmap.global_mapping(str(database), str(pictures), str(folder), options).values())
        except Exception as error:  # pybind's, of whatever COLMAP threw: too few pairs
            logger.info("%s: %s", name, error)
            return []
    options = colmap.IncrementalPipelineOptions()
    settings(options)
    options.min_model_size = 3
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = _SEED
    options.extract_colors = True
    token = colmap.CancellationToken()
    registered = 0

    def next_image() -> None:
        nonlocal registered
        registered += 1
        tell(name, min(registered / count, 1.0))
        if cancelled():
            token.cancel()

    model = str(start) if start else ""
    try:
        found = colmap.incremental_mapping(
            str(database), str(pictures), str(folder), options, model, lambda: None, next_image, token
        )
    except InterruptedError as error:  # COLMAP's word for a token that was cancelled
        raise Cancelled from error
    if cancelled():
        raise Cancelled
    return list(found.values())


def _rank(model: Any) -> tuple[int, float]:
    return model.num_reg_images(), -model.compute_mean_reprojection_error()


def _apart(models: list[Any]) -> list[list[str]]:
    """Files of models beside the first that are none of its own."""
    first = _names(models[0])
    groups = [sorted(_names(model) - first) for model in models[1:]]
    return [group for group in groups if len(group) >= FEWEST]


def _names(model: Any) -> set[str]:
    return {model.image(number).name for number in model.reg_image_ids()}


def _refine(colmap: Any, model: Any) -> None:
    """Adjust all cameras, points and lenses together; lenses with many pictures get two radial coefficients."""
    users: dict[int, int] = {}
    for number in model.reg_image_ids():
        camera = model.image(number).camera_id
        users[camera] = users.get(camera, 0) + 1
    for number, count in users.items():
        camera = model.camera(number)
        if count >= _FOR_DISTORTION and camera.model_name == "SIMPLE_RADIAL":
            focal, cx, cy, k = camera.params
            camera.model = colmap.CameraModelId.RADIAL
            camera.params = [focal, cx, cy, k, 0.0]
    options = colmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = True
    options.refine_principal_point = False
    options.print_summary = False
    # As `pycolmap.bundle_adjustment` does, which turns COLMAP's log on for everything after it.
    colmap.ObservationManager(model).filter_observations_with_negative_depth()
    config = colmap.BundleAdjustmentConfig()
    for number in model.reg_image_ids():
        config.add_image(number)
    config.fix_gauge(colmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    colmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()


def _read(model: Any, method: str, apart: list[list[str]]) -> Registration:
    """What COLMAP found, as arrays."""
    found = Registration({}, {}, {}, {}, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), method, apart)
    for number in model.reg_image_ids():
        image = model.image(number)
        seen = [point.point3D_id for point in image.points2D if point.has_point3D()]
        matrix = np.eye(4)
        matrix[:3] = image.cam_from_world().matrix()
        found.matrices[image.name] = invert(matrix) @ OPENCV_TO_BLENDER
        camera = model.camera(image.camera_id)
        focal, cx, cy, *coefficients = camera.params
        found.lenses[image.name] = Lens(
            camera.width, camera.height, float(focal), float(focal), float(cx), float(cy), "RADIAL",
            (float(coefficients[0]), float(coefficients[1]) if len(coefficients) > 1 else 0.0),
        )  # fmt: skip
        found.errors[image.name] = float(np.mean([model.point3D(k).error for k in seen]))
        found.observations[image.name] = len(seen)
    points = [point for point in model.points3D.values() if point.error < 4 and point.track.length() > 2]
    if points:
        found.points = np.array([point.xyz for point in points], np.float64)
        found.colours = np.array([point.color for point in points], np.uint8)
    return found


def _refuse(registered: list[str], photos: Sequence[Photo], subject: str, causes: dict[str, Cause]) -> None:
    """Raise AssetError with the pictures that are not registered, and why."""
    missing = {photo.given or photo.file: causes[photo.file] for photo in photos if photo.file not in registered}
    listed = "; ".join(lines(missing, 40, remedies=False))
    raise AssetError(
        subject,
        f"cannot be calibrated: {len(registered)} of {len(photos)} pictures fit together. Not registered: {listed}",
        "Pictures need texture, on the object or under it (a newspaper, a marker sheet: drgs markers), and neighbours "
        "that share most of their view. On a turntable the background stands still: draw masks, or use a marker sheet",
    )
