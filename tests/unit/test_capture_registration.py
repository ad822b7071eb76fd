"""Cameras from features and from marker sheets, and the world that they get."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image, ImageFilter
from scipy.spatial.transform import Rotation

from drgs_blender.capture import capture_folder, features, libraries, pipeline, soundness
from drgs_blender.capture.features import Photo, extract, pairs
from drgs_blender.capture.left_out import Cause, Reason, tell_left_out
from drgs_blender.capture.pictures import Picture
from drgs_blender.capture.pipeline import Settings, make_capture
from drgs_blender.capture.preparation import Prepared
from drgs_blender.capture.registration import Registration, register
from drgs_blender.capture.world_alignment import (
    LOWEST,
    TURNTABLE,
    align_to_ground,
    align_to_markers,
    ground_plane,
    similarity,
    turntable_axis,
)
from drgs_blender.core.errors import AssetError, Cancelled, DeviceError, UsageError, WriteError
from drgs_blender.reconstruct.readers import read_capture
from drgs_blender.reconstruct.readers.layout import OPENCV_TO_BLENDER
from drgs_blender.reconstruct.readers.lens import Lens, distort

LENS = Lens(800, 600, 760.0, 760.0, 405.0, 296.0, "RADIAL", (-0.05, 0.01))


def tell(phase: str, part: float) -> None:
    assert 0 <= part <= 1


def never() -> bool:
    return False


def towards(eye, target=(0.0, 0.0, 0.02), roll=0.0) -> np.ndarray:
    """Camera to world, Blender's axes."""
    z = np.asarray(eye, float) - target
    z /= np.linalg.norm(z)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    matrix = np.eye(4)
    turn = np.array([[math.cos(roll), -math.sin(roll), 0], [math.sin(roll), math.cos(roll), 0], [0, 0, 1]])
    matrix[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1) @ turn
    matrix[:3, 3] = eye
    return matrix


def ring(count: int, seed: int = 0) -> dict[str, np.ndarray]:
    random = np.random.default_rng(seed)
    made = {}
    for k in range(count):
        angle, height = 2 * math.pi * k / count, 0.6 + 0.4 * random.random()
        eye = 0.5 * np.array([math.cos(angle) * math.cos(height), math.sin(angle) * math.cos(height), math.sin(height)])
        made[f"{k:02d}.jpg"] = towards(eye, roll=0.1 * (random.random() - 0.5))
    return made


def seen(points: np.ndarray, matrix: np.ndarray, lens: Lens) -> np.ndarray:
    """(n, 2) pixels."""
    local = (points - matrix[:3, 3]) @ (matrix[:3, :3] @ OPENCV_TO_BLENDER[:3, :3])
    return np.stack(distort(lens, local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]), axis=1)


def registration(cameras: dict[str, np.ndarray], points: np.ndarray) -> Registration:
    one = dict.fromkeys(cameras, 1)
    return Registration(
        dict(cameras), dict.fromkeys(cameras, LENS), one, one, points, np.zeros((len(points), 3), np.uint8), ""
    )


def moved(found: Registration, scale: float, seed: int) -> Registration:
    """The same in another world."""
    turn, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    shift = np.array([3.0, -2.0, 5.0])
    cameras = {}
    for name, matrix in found.matrices.items():
        cameras[name] = np.eye(4)
        cameras[name][:3, :3] = turn @ matrix[:3, :3]
        cameras[name][:3, 3] = scale * turn @ matrix[:3, 3] + shift
    return replace(found, matrices=cameras, points=scale * found.points @ turn.T + shift)


def scene(table: bool) -> np.ndarray:
    """Points of a lump on the ground, with or without a table around it, and some strays."""
    random = np.random.default_rng(3)
    lump = random.normal(size=(1500, 3))
    lump *= 0.06 / np.linalg.norm(lump, axis=1, keepdims=True)
    lump[:, 2] += 0.06
    parts = [lump, 2 * (random.random((20, 3)) - 0.5)]
    if table:
        flat = np.column_stack([0.6 * (random.random((1500, 2)) - 0.5), 0.0005 * random.normal(size=1500)])
        parts.append(flat)
    return np.concatenate(parts)


def test_the_ground_under_the_object_becomes_zero():
    cameras = ring(20)
    found = moved(registration(cameras, scene(table=True)), 7.0, 1)
    centres = np.stack([matrix[:3, 3] for matrix in cameras.values()])
    alignment = align_to_ground(found, float(np.median(np.linalg.norm(centres - [0, 0, 0.02], axis=1))))
    alignment.apply(found)
    assert alignment.ground_from == "plane under the object"
    for name, matrix in cameras.items():
        np.testing.assert_allclose(found.matrices[name][2, 3], matrix[2, 3], atol=0.002)
        assert found.matrices[name][2, :3] @ matrix[2, :3] > 1 - 1e-3  # up, as each camera sees it
    table = found.points[-1500:]
    assert np.abs(table[:, 2]).max() < 0.005


def test_without_a_table_up_is_how_cameras_were_held_and_points_begin_at_zero():
    found = moved(registration(ring(20), scene(table=False)), 0.2, 2)
    alignment = align_to_ground(found)
    alignment.apply(found)
    assert (alignment.ground_from, alignment.scale_from.split(":")[0]) == ("lowest points", "unknown")
    assert found.points[:1500, 2].min() == pytest.approx(0.0, abs=0.05)
    centres = np.stack([m[:3, 3] for m in found.matrices.values()])
    assert np.median(np.linalg.norm(centres, axis=1)) == pytest.approx(1.0, rel=0.15)


def test_a_slab_through_the_foot_of_an_object_is_no_ground():
    """A statue on a turntable, masked: all points are on it, most on its foot."""
    random = np.random.default_rng(5)
    angle, height = 2 * np.pi * random.random(1500), random.random(1500)
    height[:900] *= 0.16
    wide = np.where(height < 0.16, 0.06, 0.05)
    statue = np.column_stack([wide * np.cos(angle), wide * np.sin(angle), 0.25 * height])
    cameras = {}
    for k, degrees in enumerate([0, 12, 24, 36, 48, 60, 80, 100, 120, 140, 170, 200, 230, 260, 290, 320, 340]):
        eye = [0.5 * np.cos(np.radians(degrees)), 0.5 * np.sin(np.radians(degrees)), 0.3]
        cameras[f"{k:02d}.jpg"] = towards(np.array(eye), roll=0.05)
    up, centres = np.array([0, 0, 1.0]), np.stack([matrix[:3, 3] for matrix in cameras.values()])
    assert ground_plane(statue, centres, up, 0.55) is None
    found = moved(registration(cameras, statue), 0.2, 2)
    alignment = align_to_ground(found)
    alignment.apply(found)
    assert (alignment.up_from, alignment.ground_from) == (TURNTABLE, LOWEST) and "up" in alignment.guessed
    heights = np.stack([matrix[2, 3] for matrix in found.matrices.values()])
    assert np.ptp(heights) < 1e-6
    assert found.points[:, 2].min() == pytest.approx(0.0, abs=0.01)


def posed(count: int, tilt: float = 0.0, jitter: float = 0.0, elevation: float = 0.3) -> np.ndarray:
    """(n, 4, 4) cameras around the origin; `tilt` of their circle, held upright all the same, and jitter, degrees."""
    random = np.random.default_rng(1)
    lean = Rotation.from_euler("x", tilt, degrees=True).as_matrix()
    found = []
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
        eye = lean @ np.array([0.5 * np.cos(angle), 0.5 * np.sin(angle), elevation])
        pose = towards(eye, roll=np.radians(jitter) * random.normal())
        pose[:3, :3] = Rotation.from_rotvec(np.radians(jitter) * random.normal(size=3)).as_matrix() @ pose[:3, :3]
        found.append(pose)
    return np.stack(found)


def test_only_cameras_before_a_turntable_see_its_axis_alike():
    up = np.array([0, 0, 1.0])
    lying = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    for held in (up, [0, 0.2, 0.98]):
        np.testing.assert_allclose(turntable_axis(posed(17), np.array(held)), up, atol=1e-9)
        np.testing.assert_allclose(turntable_axis(posed(17, elevation=-0.3), np.array(held)), up, atol=1e-9)
    assert turntable_axis(posed(24, tilt=10), up) is None  # each held upright on a circle that is not level
    assert turntable_axis(posed(24, jitter=3), up) is None  # carried by hand
    assert turntable_axis(posed(7), up) is None
    assert turntable_axis(posed(24)[:6], up) is None  # from one side
    sideways = posed(17)
    sideways[:, :3, :3] = lying @ sideways[:, :3, :3]
    assert turntable_axis(sideways, up) is None


@pytest.mark.parametrize("thick", [0.001, 0.01, 0.03])
def test_grass_is_ground(thick):
    random = np.random.default_rng(7)
    grass = np.column_stack([2 * random.random((4000, 2)) - 1, thick * random.random(4000)])
    statue = np.column_stack([0.1 * random.normal(size=(500, 2)), 0.3 * random.random(500)])
    cameras = posed(24)[:, :3, 3] * 2
    points = np.concatenate([grass, statue])
    found = ground_plane(points[np.linalg.norm(points, axis=1) < 1], cameras, np.array([0, 0.1, 0.99]), 1.0)
    assert found is not None and found[0][2] > np.cos(np.radians(0.3)) and -0.001 < found[1] < thick


def test_a_wall_is_no_ground():
    random = np.random.default_rng(0)
    wall = np.column_stack([random.random((800, 1)) - 0.5, 0.001 * random.normal(size=800) + 0.3, random.random(800)])
    cameras = np.stack([m[:3, 3] for m in ring(20).values()])
    assert ground_plane(wall, cameras, np.array([0, 0, 1.0]), 0.5) is None


def test_a_similarity_is_found_exactly():
    points = np.random.default_rng(0).normal(size=(6, 3))
    other = moved(registration(ring(3), points), 2.5, 4).points
    scale, rotation, shift = similarity(points, other)
    assert scale == pytest.approx(2.5)
    np.testing.assert_allclose(scale * points @ rotation.T + shift, other, atol=1e-9)


def test_markers_of_some_pictures_give_scale_and_ground_of_all_in_spite_of_one_that_moved():
    truth = registration(ring(12), scene(table=True))
    found = moved(truth, 4.0, 5)
    marked = replace(truth, matrices={name: truth.matrices[name].copy() for name in list(truth.matrices)[:6]})
    marked.matrices["02.jpg"][:3, 3] += 0.1
    alignment = align_to_markers(found, marked, "a4")
    assert alignment is not None
    alignment.apply(found)
    for name, matrix in truth.matrices.items():
        np.testing.assert_allclose(found.matrices[name], matrix, atol=1e-6)


def test_pairs_of_pictures():
    assert pairs(5, ordered=False) == [(i, j) for i in range(5) for j in range(i + 1, 5)]
    video = pairs(90, ordered=True)
    assert {(i, i + 1) for i in range(89)} <= set(video) and (0, 84) in video and len(video) < 1500


@pytest.fixture
def colmap():
    pytest.importorskip("pycolmap", reason="structure from motion needs pycolmap")
    return libraries.load("pycolmap")


def synthetic(colmap, database, cameras: int, points: int = 400):
    """COLMAP's own synthetic pictures: keypoints and matches in a database. (truth, photos)."""
    options = colmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, cameras
    options.num_points3D = points
    colmap.set_random_seed(0)
    with colmap.Database.open(str(database)) as data:
        truth = colmap.synthesize_dataset(options, data)
    names = sorted(truth.image(number).name for number in truth.reg_image_ids())
    camera = next(iter(truth.cameras.values()))
    return truth, [Photo(name, ("one",), None, (camera.width, camera.height)) for name in names]


@pytest.mark.parametrize("bare", [0, 1])
def test_pictures_without_a_mask_among_masked_ones_have_features_everywhere(colmap, tmp_path, bare):
    pictures, masks = tmp_path / "pictures", tmp_path / "masks"
    pictures.mkdir()
    masks.mkdir()
    photos = []
    for k in range(3):
        noise = np.random.default_rng(k).integers(0, 255, (30, 40, 3), np.uint8)
        Image.fromarray(noise).resize((320, 240), Image.Resampling.BICUBIC).save(pictures / f"{k}.jpg")
        photos.append(Photo(f"{k}.jpg", ("one",), None, (320, 240)))
        if k != bare:
            left = np.zeros((240, 320), np.uint8)
            left[:, :160] = 255
            Image.fromarray(left).save(masks / f"{k}.jpg.png")
    extract(tmp_path / "database.db", pictures, masks, photos, tell, never)
    with colmap.Database.open(str(tmp_path / "database.db")) as data:
        images = {image.name: image for image in data.read_all_images()}
        right = {name: data.read_keypoints(image.image_id)[:, 0].max() > 170 for name, image in images.items()}
    assert right == {f"{k}.jpg": k == bare for k in range(3)}
    assert len({image.camera_id for image in images.values()}) == 1


def test_cameras_are_found_from_matches(colmap, tmp_path):
    truth, photos = synthetic(colmap, tmp_path / "database.db", 8)
    found = register(tmp_path / "database.db", tmp_path, tmp_path / "models", photos, "photos", tell, never)
    assert sorted(found.matrices) == [photo.file for photo in photos]
    ours = np.stack([found.matrices[photo.file][:3, 3] for photo in photos])
    theirs = np.stack([truth.find_image_with_name(photo.file).projection_center() for photo in photos])
    scale, rotation, shift = similarity(ours, theirs)
    size = np.linalg.norm(theirs - theirs.mean(axis=0), axis=1).mean()
    assert np.linalg.norm(scale * ours @ rotation.T + shift - theirs, axis=1).max() < 1e-3 * size
    assert max(found.errors.values()) < 0.1 and len(found.points) > 200


def test_too_few_matched_pictures_are_refused_with_their_names(colmap, tmp_path):
    _, photos = synthetic(colmap, tmp_path / "database.db", 6)
    strangers = [replace(photos[0], file=f"other_{k}.jpg", given=f"OTHER_{k}.PNG") for k in range(9)]
    with pytest.raises(AssetError, match=r"6 of 15 pictures fit together. Not registered: .* OTHER_0.PNG"):
        register(tmp_path / "database.db", tmp_path, tmp_path / "models", photos + strangers, "photos", tell, never)


def model_of(colmap, folder, cameras: int = 9, points: int = 200):
    """A true model of synthetic pictures, and their verified matches."""
    truth, _ = synthetic(colmap, folder / "database.db", cameras, points)
    return truth, soundness.read_matches(colmap, folder / "database.db")


def turned_to(model, file: str, like: str) -> None:
    """Give a picture another one's camera."""
    one, other = model.find_image_with_name(file), model.find_image_with_name(like)
    one.frame.rig_from_world = other.cam_from_world()


def names(model) -> set[str]:
    return {model.image(number).name for number in model.reg_image_ids()}


def test_true_cameras_are_sound(colmap, tmp_path):
    model, matches = model_of(colmap, tmp_path)
    assert soundness.leave_out_unsound(model, matches) == {} and model.num_reg_images() == 9


def test_a_camera_that_matches_contradict_is_left_out_alone(colmap, tmp_path):
    model, matches = model_of(colmap, tmp_path)
    wrong, *_, other = sorted(names(model))
    turned_to(model, wrong, other)
    number = model.find_image_with_name(wrong).image_id
    for point in list(model.points3D.values()):  # its own points, as of a side that looks alike
        if number in {element.image_id for element in point.track.elements}:
            model.delete_observation(number, next(e.point2D_idx for e in point.track.elements if e.image_id == number))
    out = soundness.leave_out_unsound(model, matches)
    assert list(out) == [wrong] and out[wrong].reason is Reason.CONTRADICTED
    assert wrong not in names(model) and model.num_reg_images() == 8


@pytest.mark.parametrize(("bridge", "kept"), [(soundness.LEAST_POINTS - 1, 6), (soundness.LEAST_POINTS, 9)])
def test_pictures_that_few_points_tie_to_the_others_are_left_out(colmap, tmp_path, bridge, kept):
    model, _ = model_of(colmap, tmp_path)
    group = {model.find_image_with_name(name).image_id for name in sorted(names(model))[:3]}
    left = bridge
    for k, point in enumerate(list(model.points3D.values())):
        elements = [(element.image_id, element.point2D_idx) for element in point.track.elements]
        if left and {number for number, _ in elements} >= set(model.reg_image_ids()):
            left -= 1
            continue
        for number, index in elements:  # every other point is seen by the group, the rest by the others
            if (number in group) != k % 2 and model.image(number).points2D[index].has_point3D():
                model.delete_observation(number, index)
    assert left == 0
    out = soundness.leave_out_unsound(model, [])
    assert model.num_reg_images() == kept and len(out) == 9 - kept
    assert {str(why) for why in out.values()} <= {str(Cause(Reason.LOOSE, f"fewer than {soundness.LEAST_POINTS}"))}


@pytest.mark.parametrize(("found", "affine", "method"), [
    ((8,), (False,), "mapping"),
    ((6, 7), (False, True), "mapping, affine features"),
    ((7, 6), (False, True), "mapping"),
    ((0, 6), (False, True), "mapping, affine features"),
    ((6, 0), (False, True), "mapping"),
])  # fmt: skip
def test_missing_pictures_are_sought_by_affine_features(monkeypatch, tmp_path, found, affine, method):
    cameras, asked, counts = ring(8), [], list(found)

    def extract(database, folder, masks, photos, tell, cancelled, affine):
        asked.append(affine)

    def register(database, folder, work, photos, subject, tell, cancelled):
        count = counts.pop(0)
        if not count:
            raise AssetError(subject, "cannot be calibrated", "Add pictures")
        return replace(registration(dict(list(cameras.items())[:count]), scene(table=True)), method="mapping")

    monkeypatch.setattr(pipeline.features, "extract", extract)
    monkeypatch.setattr(pipeline.features, "match", lambda *args: None)
    monkeypatch.setattr(pipeline, "register", register)
    photos = [Photo(name, ("one",), None, (800, 600)) for name in cameras]
    made = pipeline._by_features(Prepared(tmp_path / "pictures"), photos, False, "photos", tell, never)
    assert tuple(asked) == affine and made.method == method and len(made.matrices) == max(found)


def test_left_out_cameras_are_named_with_their_reason(caplog, tmp_path):
    cameras = ring(6)
    photos = [Photo(name, ("one",), None, (800, 600)) for name in cameras]
    by_file = {name: Picture(tmp_path / f"IMG_{name}", name) for name in cameras}
    kept = dict(list(cameras.items())[2:])
    found = replace(
        registration(kept, scene(table=True)), unsound={"01.jpg": Cause(Reason.CONTRADICTED, "90% of them")}
    )
    found.unregistered = {"00.jpg": Cause(Reason.NO_POSE, "61 matches with IMG_04.jpg")}
    found.apart = [["00.jpg"]]
    tell_left_out(found, photos, by_file, tmp_path)
    strange, unsound, apart = [record.getMessage() for record in caplog.records]
    assert "of 6 pictures left out: 1 matched, but no place" in strange and "IMG_01" not in strange
    assert "IMG_00.jpg (61 matches with IMG_04.jpg). Leave object" in strange
    assert "IMG_01.jpg (90% of them). Where sides look alike" in unsound and "IMG_00" not in unsound
    assert "share nothing with the others, as of another object: IMG_00.jpg." in apart


def test_a_missing_library_is_named_with_the_command_that_installs_it(monkeypatch):
    monkeypatch.setitem(
        libraries.LIBRARIES, "pycolmap", libraries.Library("no_such_module", "pycolmap>=4.2", "structure")
    )
    monkeypatch.setitem(libraries.LIBRARIES, "av", libraries.Library("no_such_module", "av>=14", "video"))
    with pytest.raises(DeviceError, match=r'needs pycolmap.*pip install "pycolmap>=4.2".* "av>=14"'):
        libraries.load("pycolmap")


@pytest.fixture
def cv2():
    pytest.importorskip("cv2", reason="marker sheets need OpenCV")
    return libraries.load("opencv")


def test_a_sheet_gives_lens_and_cameras_in_metres(cv2):
    from drgs_blender.capture.marker_poses import poses_from_markers
    from drgs_blender.capture.marker_sheet import MarkerSheet

    sheet = MarkerSheet("a4", marker=29.0)
    cameras = ring(24)
    random = np.random.default_rng(0)
    found = {
        name: {
            k: seen(corners, matrix, LENS) + 0.05 * random.normal(size=(4, 2)) for k, corners in sheet.corners.items()
        }
        for name, matrix in cameras.items()
    }
    found["03.jpg"][5] += 60.0  # misread
    photos = [Photo(name, ("one",), None, (800, 600)) for name in cameras]
    result = poses_from_markers(sheet, found, photos)
    assert len(result.matrices) == 24 and max(result.errors.values()) < 0.2
    for name, matrix in cameras.items():
        np.testing.assert_allclose(result.matrices[name], matrix, atol=2e-3)
    lens = result.lenses["03.jpg"]
    assert (lens.fx, lens.cx, lens.cy) == pytest.approx((LENS.fx, LENS.cx, LENS.cy), abs=1.5)


@pytest.mark.parametrize("same", [True, False], ids=["one camera", "two cameras"])
def test_few_pictures_held_otherwise_have_the_focal_length_of_the_rest_or_none(cv2, same):
    """Two pictures say little of a focal length: the guess was 28 % off, without a word."""
    from drgs_blender.capture.marker_poses import poses_from_markers
    from drgs_blender.capture.marker_sheet import MarkerSheet

    sheet, cameras, found, photos = MarkerSheet("a4"), ring(14), {}, []
    for k, (name, matrix) in enumerate(cameras.items()):
        width, height = (800, 600) if k in (4, 9) else (600, 800)
        lens = Lens(width, height, 620.0, 620.0, width / 2, height / 2, "RADIAL", (-0.05, 0.01))
        corners = {number: seen(points, matrix, lens) for number, points in sheet.corners.items()}
        found[name] = {n: c for n, c in corners.items() if (c > 0).all() and (c < (width, height)).all()}
        photos.append(Photo(name, (width, height, "" if same or width < height else "M2"), None, (width, height)))
    result = poses_from_markers(sheet, found, photos)
    few = {"04.jpg", "09.jpg"}
    if same:
        assert len(result.matrices) == 14 and not result.unsound
        assert all(result.lenses[name].fx == pytest.approx(620, rel=0.01) for name in cameras)
        for name in few:
            np.testing.assert_allclose(result.matrices[name], cameras[name], atol=5e-3)
    else:
        assert set(result.unsound) == few and len(result.matrices) == 12
        assert "nothing says its focal length (2 of its size" in str(result.unsound["04.jpg"])


def test_pictures_of_a_lens_that_fit_worse_than_those_of_the_others_are_left_out(cv2):
    from drgs_blender.capture.marker_poses import poses_from_markers
    from drgs_blender.capture.marker_sheet import MarkerSheet

    sheet, cameras, found, photos = MarkerSheet("a4"), ring(14), {}, []
    random = np.random.default_rng(0)
    for k, (name, matrix) in enumerate(cameras.items()):
        bent = (0.3, 3.5)[k in (4, 9)] * random.normal(size=(len(sheet.corners), 4, 2))  # shaken, or a bent sheet
        found[name] = {n: seen(c, matrix, LENS) + b for (n, c), b in zip(sheet.corners.items(), bent, strict=True)}
        photos.append(Photo(name, (800, 600, f"M{k in (4, 9)}"), LENS.fx / 800, (800, 600)))
    result = poses_from_markers(sheet, found, photos)
    assert set(cameras) - set(result.matrices) == result.unregistered.keys() == {"04.jpg", "09.jpg"}
    assert {cause.reason for cause in result.unregistered.values()} == {Reason.POOR_MARKERS}


@pytest.mark.parametrize("paper", ["a4", "letter", "a3"])
def test_markers_are_found_where_they_are_printed(cv2, paper, tmp_path):
    from drgs_blender.capture.marker_sheet import MarkerSheet, detect, recognise, write_pdf

    sheet = MarkerSheet(paper)
    found = detect(sheet.picture(4.0))
    assert found.keys() == sheet.corners.keys() and recognise(set(found)) == paper
    middle = np.array([sheet.paper.width / 2, sheet.paper.height / 2])
    for number, corners in sheet.corners.items():
        printed = (corners[:, :2] * [1000, -1000] + middle) * 4.0
        np.testing.assert_allclose(found[number], printed, atol=0.5)
    write_pdf(tmp_path / "sheet.pdf", paper)
    data = (tmp_path / "sheet.pdf").read_bytes()
    width, height = (n * 72 / 25.4 for n in (sheet.paper.width, sheet.paper.height))
    assert data.startswith(b"%PDF-1.4") and b"/MediaBox [0 0 %.3f %.3f]" % (width, height) in data
    start = int(data.rsplit(b"startxref\n", 1)[1].split()[0])
    assert data[start:].startswith(b"xref")
    for offset in data[start:].split(b"trailer")[0].splitlines()[3:]:
        assert (
            data[int(offset.split()[0]) :][:9].rstrip(b"<").endswith(b"obj\n")
            or b" 0 obj" in data[int(offset[:10]) :][:9]
        )


def photographs_of_a_sheet(cv2, folder, count: int) -> dict[str, np.ndarray]:
    """Photographs of a flat sheet by a pinhole, by homographies; true cameras."""
    from drgs_blender.capture.marker_sheet import MarkerSheet

    sheet = MarkerSheet("a4")
    page, lens = sheet.picture(4.0), replace(LENS, model="PINHOLE", coefficients=())
    height, width = page.shape
    corners = np.array([[-105, 148.5, 0], [105, 148.5, 0], [105, -148.5, 0], [-105, -148.5, 0]]) / 1000
    flat = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32) - 0.5
    cameras = ring(count)
    folder.mkdir()
    for name, matrix in cameras.items():
        turn = cv2.getPerspectiveTransform(flat, (seen(corners, matrix, lens) - 0.5).astype(np.float32))
        picture = cv2.warpPerspective(page, turn, (800, 600), flags=cv2.INTER_AREA, borderValue=90)
        Image.fromarray(picture).convert("RGB").save(folder / name, quality=95)
    return cameras


def test_the_report_says_why_each_picture_is_left_out(cv2, tmp_path):
    photos, out = tmp_path / "photos", tmp_path / "capture"
    photographs_of_a_sheet(cv2, photos, 9)
    with Image.open(photos / "03.jpg") as sharp:
        sharp.save(photos / "03 again.jpg", quality=95)
    with Image.open(photos / "05.jpg") as sharp:
        sharp.filter(ImageFilter.GaussianBlur(12)).save(photos / "05.jpg")
    noise = np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8)  # no marker is seen
    Image.fromarray(noise).resize((800, 600), Image.Resampling.NEAREST).save(photos / "07.jpg", quality=95)
    made = make_capture(photos, out, Settings(), tell, never)
    report = json.loads((out / capture_folder.REPORT).read_text())
    why = {group["reason"]: group for group in report["reasons"]}
    assert {key: list(group["pictures"]) for key, group in why.items()} == {
        "duplicate": ["03.jpg"], "blurred": ["05.jpg"], "too few markers": ["07.jpg"],
    }  # fmt: skip
    assert made.pictures == 7 and report["left_out"].keys() == made.left_out.keys() == {"03.jpg", "05.jpg", "07.jpg"}
    assert why["too few markers"]["pictures"] == {"07.jpg": "0 seen"} and why["blurred"]["left_out"]
    told = [line for line in made.lines if line.startswith("left out: ")]
    assert len(told) == 3 and any("1 blurred: 05.jpg" in line and "Take them again, sharp" in line for line in told)


def test_photographs_of_a_sheet_become_a_capture_that_reconstruct_reads(cv2, tmp_path):
    cameras = photographs_of_a_sheet(cv2, tmp_path / "photos", 6)
    out = tmp_path / "capture"
    made = make_capture(tmp_path / "photos", out, Settings(), tell, never)
    assert made.pictures == 6 and made.method == "marker sheet" and not made.left_out
    capture = read_capture(out)
    for view in capture.views:
        true = cameras[f"{view.name}.jpg"]
        np.testing.assert_allclose(view.camera.matrix_world, true, atol=8e-3)
    assert capture.points is None  # surfels must not begin on the sheet
    report = json.loads((out / capture_folder.REPORT).read_text())
    assert len(report["cameras"]) == 6 and report["scale"] == "marker sheet (a4)"
    with Image.open(out / capture_folder.DRAWING) as drawing:
        assert np.asarray(drawing).min() < 200
    assert not (out / capture_folder.WORK).exists()
    assert make_capture(tmp_path / "photos", out, Settings(), tell, never).kept


def test_a_stopped_run_keeps_its_work_for_the_same_pictures_alone(cv2, tmp_path):
    photographs_of_a_sheet(cv2, tmp_path / "photos", 6)
    out, calls = tmp_path / "capture", []

    def stop() -> bool:
        calls.append(0)
        return len(calls) > 3

    with pytest.raises(Cancelled):
        make_capture(tmp_path / "photos", out, Settings(), tell, stop)
    copies = sorted((out / capture_folder.WORK / "pictures").iterdir())
    times = [path.stat().st_mtime_ns for path in copies]
    assert len(copies) == 3 and not (out / capture_folder.CAMERAS).exists()
    with pytest.raises(Cancelled):
        make_capture(tmp_path / "photos", out, Settings(), tell, lambda: True)
    assert [path.stat().st_mtime_ns for path in copies] == times
    with pytest.raises(Cancelled):
        make_capture(tmp_path / "photos", out, Settings(size=400), tell, lambda: True)
    assert not any(path.exists() for path in copies)


def test_a_full_disk_is_told_before_colmap_ends_the_process(tmp_path, monkeypatch):
    pytest.importorskip("pycolmap", reason="structure from motion needs pycolmap")
    full = type("Usage", (), {"free": 3_000_000})
    monkeypatch.setattr(features.shutil, "disk_usage", lambda _: full)
    photos = [Photo(f"{k}.jpg", (), None, (64, 48)) for k in range(2)]
    with pytest.raises(WriteError, match="has 3 MB of free space left, 34 are needed"):
        features.extract(tmp_path / "a.db", tmp_path, None, photos, tell, never)


def test_folders_of_others_are_not_written_to(tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "letter.txt").write_text("")
    for folder in (tmp_path / "photos", tmp_path / "photos" / "images", tmp_path / "other"):
        with pytest.raises(UsageError):
            make_capture(tmp_path / "photos", folder, Settings(), tell, never)
    assert (tmp_path / "other" / "letter.txt").exists()


def test_without_markers_poses_by_markers_are_refused(cv2, tmp_path):
    (tmp_path / "photos").mkdir()
    for k in range(6):
        pixels = np.random.default_rng(k).integers(0, 255, (60, 80, 3), np.uint8)
        Image.fromarray(pixels).save(tmp_path / "photos" / f"{k}.png")
    with pytest.raises(AssetError, match="shows a marker sheet in 0 pictures"):
        make_capture(tmp_path / "photos", tmp_path / "out", Settings(poses="markers"), tell, never)


@pytest.mark.slow
def test_a_video_of_a_sheet_becomes_a_capture(cv2, tmp_path):
    av = pytest.importorskip("av", reason="video needs PyAV")
    cameras = photographs_of_a_sheet(cv2, tmp_path / "photos", 12)
    film = tmp_path / "walk.mkv"
    with av.open(str(film), "w") as container:
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 800, 600, "yuv420p", 20_000_000
        for name in cameras:
            with Image.open(tmp_path / "photos" / name) as image:
                container.mux(stream.encode(av.VideoFrame.from_image(image)))
        container.mux(stream.encode())
    made = make_capture(film, tmp_path / "capture", Settings(), tell, never)
    assert made.pictures == made.of == 12
    views = sorted(read_capture(tmp_path / "capture").views, key=lambda view: view.name)
    for view, matrix in zip(views, cameras.values(), strict=True):
        np.testing.assert_allclose(view.camera.matrix_world, matrix, atol=0.02)
