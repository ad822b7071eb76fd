"""Readers of captures: every layout gives the cameras and pixels it was written from; bad ones are refused."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace
from pathlib import Path

import captures
import numpy as np
import pytest
from PIL import Image

from drgs_blender.capture.capture_folder import WORK
from drgs_blender.cli.main import main
from drgs_blender.core.color import linear_to_srgb, srgb_to_linear
from drgs_blender.core.errors import AssetError, UsageError
from drgs_blender.reconstruct.readers import BYTES_A_PIXEL, read_capture
from drgs_blender.reconstruct.readers.lens import MODELS, Lens, distort, lens_of, resample, undistorted
from drgs_blender.reconstruct.readers.world_frame import turn_upright

WRITERS = {
    "nerf": lambda scene: captures.write_nerf(scene),
    "nerfstudio": captures.write_nerfstudio,
    "colmap text": lambda scene: captures.write_colmap(scene, False),
    "colmap binary": lambda scene: captures.write_colmap(scene, True),
    "llff": captures.write_llff,
    "nero": captures.write_nero,
    "tensoir": captures.write_tensoir,
}


@pytest.mark.parametrize("layout", WRITERS)
def test_every_layout_gives_the_cameras_and_pixels_it_was_written_from(tmp_path, layout):
    scene = captures.make(tmp_path / "c")
    WRITERS[layout](scene)
    capture = read_capture(scene.folder)
    assert len(capture.views) == len(scene.cameras)
    found = {view.name: view for view in capture.views}
    assert len(found) == len(capture.views)
    # Names differ from layout to layout; cameras are matched by place.
    for matrix in scene.cameras:
        view = min(capture.views, key=lambda v: np.linalg.norm(v.camera.matrix_world[:3, 3] - matrix[:3, 3]))
        np.testing.assert_allclose(view.camera.matrix_world, matrix, atol=2e-5)
        assert (view.camera.width, view.camera.height) == (captures.WIDTH, captures.HEIGHT)
        assert view.camera.fx == pytest.approx(captures.FOCAL) and view.camera.cy == captures.HEIGHT / 2
        wanted = captures.picture(matrix)
        inside = wanted[..., 3] > 0
        np.testing.assert_array_equal(view.mask > 0.5, inside)
        np.testing.assert_allclose(view.colour[inside], wanted[inside, :3] / 255, atol=1e-6)
    rgba = layout in ("nerf", "tensoir")
    assert capture.background == ((1.0, 1.0, 1.0) if rgba else (0.0, 0.0, 0.0))
    assert all(np.allclose(view.colour[view.mask == 0], capture.background) for view in capture.views)


@pytest.mark.parametrize("layout", WRITERS)
def test_inspect_says_where_photographs_were_taken(tmp_path, capsys, layout):
    scene = captures.make(tmp_path / "capture")
    WRITERS[layout](scene)
    assert main(["inspect", str(scene.folder), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    capture = read_capture(scene.folder)
    assert said["kind"] == "capture" and said["photographs"] == len(capture.views) == len(scene.cameras)
    assert said["test_views"] == sum(view.test for view in capture.views)
    for camera, view in zip(said["cameras"], capture.views, strict=True):
        assert Path(camera["image"]).is_file() and camera["name"] == view.name
        np.testing.assert_allclose(camera["matrix_world"], view.camera.matrix_world, atol=1e-9)
        assert (camera["width"], camera["fx"]) == (view.camera.width, pytest.approx(view.camera.fx))


def test_a_set_made_for_learning_and_one_for_testing(tmp_path, caplog):
    scene = captures.make(tmp_path)
    captures.write_nerf(scene, "train")
    captures.write_nerf(captures.make(tmp_path, 5), "test")
    capture = read_capture(tmp_path, test_every=2)  # the files' own split counts
    assert "says itself which views are left out" in caplog.text
    assert (len(capture.training), len(capture.testing)) == (12, 5)
    assert {view.name for view in capture.testing} == {f"test/r_{k}" for k in range(5)}
    alone = read_capture(tmp_path / "transforms_train.json", test_every=4)
    assert [view.name for view in alone.testing] == ["r_0", "r_4", "r_8"]  # r_10 comes after r_9
    assert len(caplog.records) == 1


def test_a_split_that_leaves_nothing_out_is_none(tmp_path):
    captures.write_tensoir(captures.make(tmp_path))
    for k, folder in enumerate(sorted(tmp_path.glob("test_*"))):
        folder.rename(tmp_path / f"train_{4 * k:03d}")
    assert [view.name for view in read_capture(tmp_path, test_every=6).testing] == ["train_000", "train_006"]


def test_sparse_points_turn_with_the_cameras(tmp_path):
    # A world on its side: both must come back upright together.
    scene = captures.make(tmp_path)
    turn = np.eye(4)
    turn[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    upright = scene.cameras
    scene.cameras = [turn @ m for m in upright]
    captures.write_colmap(scene, True)
    for camera, matrix in zip(scene.cameras, upright):  # the pictures are those of the upright scene
        name = f"{next(k for k, m in enumerate(scene.cameras) if m is camera):03d}.png"
        Image.fromarray(captures.picture(matrix)[..., :3]).save(tmp_path / "images" / name)
        Image.fromarray(captures.picture(matrix)[..., 3]).save(tmp_path / "masks" / name)
    capture = read_capture(tmp_path)
    for view in capture.views:
        assert view.camera.matrix_world[2, 1] > 0.8  # the camera's up is the world's
        assert abs(view.camera.matrix_world[2, 0]) < 1e-6  # level
    centres = np.array([v.camera.matrix_world[:3, 3] for v in capture.views])
    wanted = np.array([m[:3, 3] for m in upright])
    points = np.array([[0.5, 0, 0], [0, 0.25, 0], [0, 0, 0.125]]) @ turn[:3, :3]
    distances = np.linalg.norm(centres[:, None] - capture.points[None], axis=-1)
    np.testing.assert_allclose(distances, np.linalg.norm(wanted[:, None] - points[None], axis=-1), atol=1e-5)


def test_any_tilt_of_the_world_is_taken_out():
    from scipy.spatial.transform import Rotation

    cameras = np.stack(captures.ring(9))
    for seed in range(20):
        turned = cameras.copy()
        turned[:, :3] = Rotation.random(random_state=seed).as_matrix() @ cameras[:, :3]
        found = turn_upright(turned)
        np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(found) == pytest.approx(1)
        np.testing.assert_allclose((found @ turned[:, :3, 0].T)[2], 0, atol=1e-9)
        assert ((found @ turned[:, :3, 1].T)[2] > 0).all()


@pytest.mark.parametrize("backdrop", [255, 0, 90, None])
def test_an_object_before_a_plain_backdrop_needs_no_masks(tmp_path, backdrop, caplog):
    """Not even where the backdrop is noisy and each photograph exposed in its own way (None)."""
    scene = captures.make(tmp_path)
    path = captures.write_nerf(scene)
    rng = np.random.default_rng(0)
    for k, matrix in enumerate(scene.cameras):
        pixels = captures.picture(matrix)
        behind = 150 + 4 * k + rng.normal(scale=1.5, size=pixels.shape[:2]) if backdrop is None else backdrop
        behind = np.broadcast_to(np.asarray(behind, float)[..., None], (*pixels.shape[:2], 3))
        inside = pixels[..., 3:] > 0
        # A speck of the backdrop's colour within the object is of the object.
        pixels[18:20, 22, :3] = behind[18:20, 22].round()
        Image.fromarray(np.where(inside, pixels[..., :3], behind).round().astype(np.uint8)).save(
            tmp_path / "train" / f"r_{k}.png"
        )
    capture = read_capture(path)
    assert "has no masks" in caplog.text
    for view in capture.views:
        matrix = min(scene.cameras, key=lambda m: np.abs(m - view.camera.matrix_world).max())
        np.testing.assert_array_equal(view.mask >= 0.5, captures.picture(matrix)[..., 3] > 0)
    if backdrop is None:
        assert capture.background is None
    else:
        np.testing.assert_allclose(capture.background, backdrop / 255)


def before_clutter(scene):
    """The capture of `scene` with surroundings and without masks."""
    path = captures.write_nerf(scene)
    rng = np.random.default_rng(0)
    for k, matrix in enumerate(scene.cameras):
        pixels = captures.picture(matrix)
        behind = rng.integers(0, 255, pixels[..., :3].shape)
        pixels = np.where(pixels[..., 3:] > 0, pixels[..., :3], behind).astype(np.uint8)
        Image.fromarray(pixels).save(scene.folder / "train" / f"r_{k}.png")
    return path


@pytest.mark.parametrize("unknown", [False, True])
def test_photographs_of_different_exposures_come_out_alike(tmp_path, caplog, unknown):
    file = captures.write_nerf(captures.make(tmp_path, 9))
    before = read_capture(tmp_path).views
    text = json.loads(file.read_text())
    stops = [0.0, 1.5, -1.0, 0.0, 0.0, 2.0, -2.0, 0.0, -0.5]  # of light; the median is 0
    for frame, more in zip(text["frames"], stops, strict=True):
        path = tmp_path / f"{frame['file_path']}.png"
        pixels = np.asarray(Image.open(path)) / np.float32(255)
        pixels[..., :3] = linear_to_srgb(srgb_to_linear(pixels[..., :3]) * 2.0**more).clip(0, 1)
        Image.fromarray((pixels * 255 + 0.5).astype(np.uint8)).save(path)
        if not (unknown and more == 0):
            frame["exposure_value"] = 10.0 - more
    file.write_text(json.dumps(text))
    caplog.clear()
    after = read_capture(tmp_path).views
    (line,) = [record.getMessage() for record in caplog.records if "exposures" in record.getMessage()]
    assert "differ by 4.0 stops (EXIF), from r_6.png (least light) to r_5.png" in line
    assert ("4 photographs that do not say theirs" in line) == unknown
    for one, other, more in zip(before, after, stops, strict=True):
        stored = linear_to_srgb(srgb_to_linear(one.colour) * 2.0**more)
        gain = 2.0**-0.5 if unknown and more else 1.0  # to the median of those that are known
        wanted = linear_to_srgb(srgb_to_linear(one.colour) * gain).clip(0, 1)
        inside = (one.mask > 0.99)[..., None]
        assert np.abs(other.colour - wanted)[inside & (stored < 0.975)].max() < 0.03
        assert other.colour[inside & (stored > 1)].min(initial=1.0) == 1.0  # known to be clipped, as before


def test_exposures_that_exif_rounds_are_left_alone(tmp_path, caplog):
    file = captures.write_nerf(captures.make(tmp_path, 4))
    before = [view.colour for view in read_capture(tmp_path).views]
    text = json.loads(file.read_text())
    for k, frame in enumerate(text["frames"]):
        frame["exposure_value"] = (10.0, 10.09, True, "bright")[k]
    file.write_text(json.dumps(text))
    caplog.clear()
    assert all(np.array_equal(a, view.colour) for a, view in zip(before, read_capture(tmp_path).views, strict=True))
    assert "exposures" not in caplog.text


def test_real_surroundings_are_not_taken_for_a_backdrop(tmp_path, caplog):
    capture = read_capture(before_clutter(captures.make(tmp_path)))
    assert all(view.mask is None for view in capture.views) and "has no masks" not in caplog.text


def test_resolution_means_the_mean_of_what_a_pixel_covers(tmp_path):
    captures.write_nerf(captures.make(tmp_path))
    full, half = read_capture(tmp_path), read_capture(tmp_path, resolution=24)
    a, b = full.views[3], half.views[3]
    assert (b.camera.width, b.camera.height, b.camera.fx) == (24, 20, captures.FOCAL / 2)
    np.testing.assert_allclose(b.mask, a.mask.reshape(20, 2, 24, 2).mean((1, 3)), atol=1e-6)
    np.testing.assert_allclose(b.colour, a.colour.reshape(20, 2, 24, 2, 3).mean((1, 3)), atol=1e-6)
    for bad in ({"resolution": 4}, {"test_every": 1}, {"axes": "maya"}, {"up": "x"}):
        with pytest.raises(UsageError):
            read_capture(tmp_path, **bad)


#: model -> (coefficients, pixels of (.4, -.7) and (-.9, .2) with f 500 (and 480), centre (321, 243)); by pycolmap 4.2.
PYCOLMAP = {
    "SIMPLE_PINHOLE": ([], [[521.0, -107.0], [-129.0, 343.0]]),
    "PINHOLE": ([], [[521.0, -93.0], [-129.0, 339.0]]),
    "SIMPLE_RADIAL": ([0.1], [[534.0, -129.75], [-167.25, 351.5]]),
    "RADIAL": ([0.1, -0.03], [[531.465, -125.31375], [-157.49625, 349.3325]]),
    "OPENCV": ([0.1, -0.03, 0.004, -0.002], [[529.375, -106.914], [-160.68625, 347.2104]]),
    "OPENCV_FISHEYE": ([0.05, -0.02, 0.01, 0.003], [[492.669613, -45.404949], [-51.108412, 322.383128]]),
    "FULL_OPENCV": (
        [0.1, -0.03, 0.004, -0.002, 0.01, 0.02, -0.01, 0.005],
        [[527.804364, -104.275331], [-157.346135, 346.497842]],
    ),
    "FOV": ([0.9], [[503.398264, -63.429083], [-73.628212, 327.187352]]),
    "SIMPLE_RADIAL_FISHEYE": ([0.06], [[493.971177, -59.69956], [-54.638742, 326.475276]]),
    "RADIAL_FISHEYE": ([0.06, -0.02], [[493.25761, -58.450818], [-52.401209, 325.978046]]),
    "THIN_PRISM_FISHEYE": (
        [0.05, -0.02, 0.004, -0.002, 0.01, 0.003, 0.006, -0.005],
        [[492.57045, -43.912413], [-51.526103, 322.442649]],
    ),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        [0.05, -0.02, 0.01, 0.003, -0.001, 0.0005, 0.004, -0.002, 0.006, -0.005, 0.003, 0.002],
        [[495.372103, -46.435696], [-46.571752, 322.458287]],
    ),
}


@pytest.mark.parametrize("model", MODELS)
def test_every_lens_distorts_as_colmap_says(model):
    coefficients, pixels = PYCOLMAP[model]
    focal = [500.0, 480.0][: MODELS[model][0]]
    lens = lens_of(model, 640, 480, np.array([*focal, 321.0, 243.0, *coefficients]), "test")
    found = np.stack(distort(lens, np.array([0.4, -0.9]), np.array([-0.7, 0.2])), -1)
    np.testing.assert_allclose(found, pixels, atol=1e-5)


@pytest.mark.parametrize("model", [m for m, (c, _) in PYCOLMAP.items() if c])
def test_straightened_photographs_show_what_a_pinhole_would(model):
    # A photograph whose pixels hold their own place: straightened, each pixel says which place it came from.
    lens = Lens(64, 48, 50.0, 50.0, 32.5, 23.0, model, tuple(PYCOLMAP[model][0]))
    pinhole, positions = undistorted(lens)
    py, px = np.mgrid[:48, :64] + 0.5
    photograph = np.stack([px, py], -1).astype(np.float32)
    straight = resample(photograph, positions)
    x, y = (px - pinhole.cx) / pinhole.fx, (py - pinhole.cy) / pinhole.fy
    wanted = np.stack(distort(lens, x, y), -1)
    # Nothing outside of the photograph is needed, and some border pixel touches its edge.
    assert wanted.min() > -0.6 and (wanted[..., 0].max(), wanted[..., 1].max()) < (64.6, 48.6)
    edge = min(wanted.min(), 64 - wanted[..., 0].max(), 48 - wanted[..., 1].max())
    assert edge < 1.5
    inner = (wanted > 0.5).all(-1) & (wanted[..., 0] < 63.5) & (wanted[..., 1] < 47.5)
    np.testing.assert_allclose(straight[inner], wanted[inner], atol=1e-3)


def test_a_distorted_capture_is_read_as_a_pinhole(tmp_path):
    scene = captures.make(tmp_path)
    captures.write_nerfstudio(scene, k1=0.2)
    view = read_capture(tmp_path).views[0]
    pinhole, _ = undistorted(Lens(48, 40, 60.0, 60.0, 24.0, 20.0, "OPENCV", (0.2, 0, 0, 0)))
    assert view.camera.fx == pytest.approx(pinhole.fx) and pinhole.fx > captures.FOCAL


def test_pixels_that_are_not_square_keep_their_two_focal_lengths(tmp_path):
    captures.write_nerfstudio(captures.make(tmp_path), fl_y=1.25 * captures.FOCAL)
    camera = read_capture(tmp_path, resolution=24).views[0].camera
    assert (camera.fx, camera.fy) == (captures.FOCAL / 2, 1.25 * captures.FOCAL / 2)


# --- bad input ------------------------------------------------------------------------------------------------------


def assert_refused(path, *words, error=AssetError, **options):
    with pytest.raises(error) as caught:
        read_capture(path, **options)
    for word in words:
        assert word in str(caught.value), str(caught.value)


@pytest.mark.parametrize("axes", ["opencv", "opengl-inverse", "opencv-inverse"])
def test_cameras_of_another_convention_are_named_by_their_silhouettes(tmp_path, axes):
    convert = {
        "opencv": lambda m: m @ captures.OPENCV,
        "opengl-inverse": np.linalg.inv,
        "opencv-inverse": lambda m: np.linalg.inv(m @ captures.OPENCV),
    }[axes]
    scene = captures.make(tmp_path)
    captures.write_nerf(scene, convert=convert)
    assert_refused(tmp_path, "silhouettes do not meet", f"--axes {axes}")
    view = read_capture(tmp_path, axes=axes).views[0]
    np.testing.assert_allclose(view.camera.matrix_world, scene.cameras[0], atol=1e-9)


def test_silhouettes_of_other_objects_are_refused(tmp_path):
    captures.write_nerf(captures.make(tmp_path))
    rng = np.random.default_rng(0)
    for k in range(12):
        pixels = np.zeros((40, 48, 4), np.uint8)
        x, y = rng.integers(0, 40), rng.integers(0, 32)
        pixels[y : y + 6, x : x + 6] = 255
        Image.fromarray(pixels).save(tmp_path / "train" / f"r_{k}.png")
    assert_refused(tmp_path, "no common shape")


def test_inverted_masks_are_told(tmp_path):
    captures.write_nerfstudio(captures.make(tmp_path))
    for mask in (tmp_path / "masks").iterdir():
        Image.fromarray(255 - np.asarray(Image.open(mask))).save(mask)
    assert_refused(tmp_path, "masks that are inverted", "white is the object")


def test_holes_in_masks_that_fill_the_picture_are_not_taken_for_inverted(tmp_path):
    """As of shine that somebody's mask leaves out, each time elsewhere."""
    captures.write_nerfstudio(captures.make(tmp_path))
    rng = np.random.default_rng(0)
    for mask in (tmp_path / "masks").iterdir():
        pixels = np.full((captures.HEIGHT, captures.WIDTH), 255, np.uint8)
        x, y = rng.integers(1, 34), rng.integers(1, 26)
        pixels[y : y + 12, x : x + 12] = 0
        Image.fromarray(pixels).save(mask)
    assert len(read_capture(tmp_path).views) == 12


def test_close_ups_of_parts_are_not_taken_for_wrong_cameras(tmp_path):
    # Hardly any two pictures show the same part: there is no common shape, and nothing is wrong with the cameras.
    rng = np.random.default_rng(0)
    scene = captures.make(tmp_path, 16)
    for k, a in enumerate(np.arange(16) * 2 * np.pi / 16):
        eye = np.array([4 * np.cos(a), 4 * np.sin(a), 1 + k % 2])
        scene.cameras[k] = captures.look_at(eye, rng.uniform(-0.9, 0.9, 3) * captures.AXES)
    captures.write_nerfstudio(scene, fl_x=300.0, fl_y=300.0)
    for k, matrix in enumerate(scene.cameras):
        pixels = captures.picture(matrix, focal=300.0)
        Image.fromarray(pixels[..., :3]).save(tmp_path / "images" / f"frame_{k:05d}.png")
        Image.fromarray(pixels[..., 3]).save(tmp_path / "masks" / f"frame_{k:05d}.png")
    assert len(read_capture(tmp_path).views) >= 8


def test_groups_of_cameras_that_look_at_different_things_are_refused(tmp_path):
    scene = captures.make(tmp_path, 16)
    for matrix in scene.cameras[10:]:
        matrix[:3, 3] += [60, 20, 0]
    assert_refused(before_clutter(scene), "two groups of cameras", "10 with r_0", "6 with r_10", "nothing in common")


@pytest.mark.parametrize("across", [0.0, 2.0])
def test_close_ups_and_pictures_from_afar_are_one_capture(tmp_path, across):
    """Also where hardly two of the close-ups show the same part."""
    scene = captures.make(tmp_path, 8)
    rng = np.random.default_rng(0)
    for k in range(6):
        target = np.array([0, across * (k - 2.5) / 2.5, 0])
        scene.cameras.append(captures.look_at(target + rng.normal([40, 0, 1], 0.3), target))
    path = before_clutter(scene)
    data = json.loads(path.read_text())
    for frame in data["frames"][8:]:
        frame["camera_angle_x"] = 0.02
    path.write_text(json.dumps(data))
    assert len(read_capture(path).views) == 14


def test_missing_images_are_counted_and_named(tmp_path):
    captures.write_nerf(captures.make(tmp_path))
    (tmp_path / "train" / "r_3.png").unlink()
    assert_refused(tmp_path, "1 of 12 images", "train/r_3")
    scene = captures.make(tmp_path / "colmap")
    captures.write_colmap(scene, True)
    (scene.folder / "images" / "005.png").unlink()
    assert_refused(scene.folder, "1 of 12 images", "005.png")
    scene = captures.make(tmp_path / "llff")
    captures.write_llff(scene)
    (scene.folder / "images" / "005.png").unlink()
    assert_refused(scene.folder, "12 cameras", "images: 11")
    scene = captures.make(tmp_path / "nero")
    captures.write_nero(scene)
    (scene.folder / "7.png").unlink()
    assert_refused(scene.folder, "1 of 12 images", "7.png")
    scene = captures.make(tmp_path / "tensoir")
    captures.write_tensoir(scene)
    (scene.folder / "train_005" / "rgba_sunset.png").unlink()
    assert_refused(scene.folder, "1 of 12 images", "train_005/rgba_sunset.png")


def test_masks_and_photographs_of_another_shape_are_refused(tmp_path):
    scene = captures.make(tmp_path)
    captures.write_nerfstudio(scene)
    mask = tmp_path / "masks" / "frame_00002.png"
    Image.new("L", (40, 48)).save(mask)
    assert_refused(tmp_path, "frame_00002.png", "40 x 48")
    Image.fromarray(captures.picture(scene.cameras[2], 96, 80)[..., 3]).save(mask)  # the same shape, larger
    capture = read_capture(tmp_path)
    assert abs(capture.views[2].mask.mean() - capture.views[8].mask.mean()) < 0.05
    image = tmp_path / "images" / "frame_00004.png"
    Image.new("RGB", (40, 48), "red").save(image)
    assert_refused(tmp_path, "calibrated for 48 x 40")
    mask.unlink()
    assert_refused(tmp_path, "names the mask")


def test_a_picture_of_another_shape_than_the_one_camera_of_a_file_is_refused(tmp_path):
    scene = captures.make(tmp_path)
    path = captures.write_nerf(scene)
    image = tmp_path / "train" / "r_5.png"
    Image.fromarray(captures.picture(scene.cameras[5], 96, 80)).save(image)  # the same shape, larger
    assert len(read_capture(tmp_path).views) == 12
    Image.fromarray(captures.picture(scene.cameras[5])[10:26]).save(image)
    assert_refused(tmp_path, "r_5.png", "48 x 16 pixels", "48 x 40")
    data = json.loads(path.read_text())
    for frame in data["frames"]:  # each says what it was taken with
        frame["camera_angle_x"] = data["camera_angle_x"]
    path.write_text(json.dumps(data))
    assert len(read_capture(tmp_path).views) == 12


def test_black_photographs_are_left_out_and_a_black_capture_is_refused(tmp_path, caplog):
    captures.write_nerfstudio(captures.make(tmp_path))
    for k in range(12):
        if k == 3:
            assert len(read_capture(tmp_path).views) == 11
            assert "frame_00002.png" in caplog.text
        if k >= 2:
            Image.new("RGB", (48, 40)).save(tmp_path / "images" / f"frame_{k:05d}.png")
    assert_refused(tmp_path, "images that are black")


def test_photographs_of_one_colour_are_left_out(tmp_path, caplog):
    """Burned out, or masked whole by an alpha channel that nobody drew."""
    captures.write_nerf(captures.make(tmp_path))
    for k in range(3):
        Image.new("RGBA", (48, 40), (255, 255, 255, 255)).save(tmp_path / "train" / f"r_{k}.png")
    assert {view.name for view in read_capture(tmp_path).views}.isdisjoint({"r_0", "r_1", "r_2"})
    assert "3 images are black or of one colour and left out: r_0.png, r_1.png" in caplog.text


@pytest.mark.parametrize("size", [(1, 1), (48, 1), (3, 40)])
def test_pictures_of_hardly_a_pixel_are_refused(tmp_path, size):
    captures.write_nerf(captures.make(tmp_path))
    for file in (tmp_path / "train").iterdir():
        Image.effect_noise(size, 100).convert("RGBA").save(file)
    assert_refused(tmp_path, "r_0.png", f"{size[0]} x {size[1]} pixels", "larger photographs")


def test_a_resolution_that_leaves_hardly_a_pixel_of_a_narrow_picture_is_refused(tmp_path):
    captures.write_nerf(captures.make(tmp_path))
    for file in (tmp_path / "train").iterdir():
        Image.effect_noise((12, 100), 100).convert("RGBA").save(file)
    assert_refused(tmp_path, "r_0.png", "1 x 8 pixels", "larger --resolution", resolution=8)


def test_an_empty_mask_is_named_and_its_photograph_left_out(tmp_path, caplog):
    captures.write_nerfstudio(captures.make(tmp_path))
    for k in range(12):
        Image.new("L", (48, 40)).save(tmp_path / "masks" / f"frame_{k:05d}.png")
        if k == 3:
            names = {view.name for view in read_capture(tmp_path).views}
            assert names == {f"frame_{n:05d}" for n in range(4, 12)}
            assert "4 of 12 masks are empty" in caplog.text and "frame_00000.png" in caplog.text
    # All of them: what is done with the capture says so.
    assert len(read_capture(tmp_path).views) == 12


def test_empty_alpha_is_an_empty_mask(tmp_path, caplog):
    scene = captures.make(tmp_path)
    captures.write_nerf(scene)
    pixels = captures.picture(scene.cameras[5])
    pixels[..., 3] = 0
    Image.fromarray(pixels).save(tmp_path / "train" / "r_5.png")
    assert "r_5" not in {view.name for view in read_capture(tmp_path).views}
    assert "1 of 12 masks" in caplog.text and "r_5.png" in caplog.text


def test_few_photographs_without_a_mask_are_left_out_and_most_without_take_the_others(tmp_path, caplog):
    scene = captures.make(tmp_path)
    captures.write_nerf(scene)
    for k, matrix in enumerate(scene.cameras):
        Image.fromarray(captures.picture(matrix)[..., :3]).save(tmp_path / "train" / f"r_{k}.png")
        if k == 4:
            capture = read_capture(tmp_path)
            assert {view.name for view in capture.views} == {f"r_{n}" for n in range(5, 12)}
            assert all(view.mask is not None for view in capture.views) and capture.background == (1.0, 1.0, 1.0)
            assert "5 of 12 photographs have no mask (r_0.png, r_1.png, r_2.png, ...)" in caplog.text
        if k == 6:
            caplog.clear()
            assert len(read_capture(tmp_path).views) == 12
            assert "7 of 12 photographs" in caplog.text and "masks of the others are not used" in caplog.text


def test_test_views_need_no_masks(tmp_path, caplog):
    captures.write_nerf(captures.make(tmp_path), "train")
    captures.write_nerf(captures.make(tmp_path, 5), "test")
    for image in (tmp_path / "test").iterdir():
        Image.open(image).convert("RGB").save(image)
    capture = read_capture(tmp_path)
    assert (len(capture.training), len(capture.testing)) == (12, 5) and not caplog.records
    assert all(view.mask is not None for view in capture.training)


def test_pictures_that_exif_turns_are_used_as_stored_and_named(tmp_path, caplog):
    captures.write_colmap(captures.make(tmp_path), True)
    before = read_capture(tmp_path)
    assert not caplog.records
    exif = Image.Exif()
    for name, orientation in (("002.png", 1), ("005.png", 3), ("007.png", 6)):
        file = tmp_path / "images" / name
        exif[0x0112] = orientation
        Image.open(file).save(file, exif=exif)
    after = read_capture(tmp_path)
    assert all(np.array_equal(a.colour, b.colour) for a, b in zip(before.views, after.views, strict=True))
    assert len(caplog.records) == 1 and "2 photographs are marked as turned" in caplog.text and "005.png" in caplog.text


def test_one_camera_or_one_place_is_no_capture(tmp_path):
    captures.write_nerf(captures.make(tmp_path / "one", 1))
    assert_refused(tmp_path / "one", "one camera")
    scene = captures.make(tmp_path / "spot")
    for matrix in scene.cameras:
        matrix[:3, 3] = [1, 2, 3]
    captures.write_nerf(scene)
    assert_refused(scene.folder, "in one place")


@pytest.mark.parametrize("convert", [np.linalg.inv, lambda m: np.linalg.inv(m @ captures.OPENCV)])
def test_an_object_that_turns_before_one_camera_is_told_by_name(tmp_path, convert):
    """The matrices of cameras around the origin, all as far, that bring the world to the camera."""
    scene = captures.make(tmp_path)
    for matrix in scene.cameras:
        matrix[:3, 3] = 3 * matrix[:3, 2]
    captures.write_nerf(scene, convert=convert)
    assert_refused(tmp_path, "in one place", "--axes opengl-inverse")


def test_places_that_single_precision_cannot_tell_apart_are_refused(tmp_path):
    """As those of surveys, whose origin is on the equator."""
    scene = captures.make(tmp_path)
    for matrix in scene.cameras:
        matrix[:3, 3] += [5e5, 5e6, 0]
    captures.write_nerf(scene)
    assert_refused(tmp_path, "digits do not suffice", "origin near the object")


@pytest.mark.parametrize("scale", [1e-4, 1e6])
def test_captures_too_small_or_large_for_any_camera_are_refused(tmp_path, scale):
    """Cameras show nothing nearer than a millimetre or farther than a thousand kilometres."""
    scene = captures.make(tmp_path)
    for matrix in scene.cameras:
        matrix[:3, 3] *= scale
    captures.write_nerf(scene)
    assert_refused(tmp_path, "of each other", "another unit")


@pytest.mark.parametrize("wrong", [1, 5])
def test_few_cameras_of_another_convention_are_named(tmp_path, caplog, wrong):
    scene = captures.make(tmp_path)
    captures.write_nerf(scene)
    read_capture(tmp_path)
    assert not caplog.records
    path = tmp_path / "transforms_train.json"
    data = json.loads(path.read_text())
    for frame in data["frames"][3 : 3 + wrong]:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ captures.OPENCV).tolist()
    path.write_text(json.dumps(data))
    read_capture(tmp_path)
    assert f"{wrong} of 12 photographs show the object where the others do not have it: r_3" in caplog.text


def test_an_object_of_few_pixels_in_some_pictures_is_no_fault_of_the_cameras(tmp_path, caplog):
    scene = captures.make(tmp_path)
    captures.write_nerf(scene)
    for k in range(4):  # as large as on a photograph from afar, and there it is
        small = np.zeros((400, 480, 4), np.uint8)
        small[198:202, 238:242] = (200, 100, 50, 255)
        Image.fromarray(small).save(tmp_path / "train" / f"r_{k}.png")
    read_capture(tmp_path)
    assert "nan" not in caplog.text and "fit badly" not in caplog.text


def test_a_folder_of_captures_is_told_from_one(tmp_path):
    for name in ("b", "a"):
        (tmp_path / name).mkdir()
        captures.write_nerf(captures.make(tmp_path / name))
    assert_refused(tmp_path, "holds some", f"{tmp_path / 'a'}, {tmp_path / 'b'}. Give one")


def test_damaged_files_are_refused_by_name(tmp_path):
    assert_refused(tmp_path / "nothing", "does not exist")
    assert_refused(tmp_path / ("a" * 300), "cannot be read: File name too long")
    assert_refused(tmp_path, "is no capture", "COLMAP")
    (tmp_path / WORK).mkdir()
    assert_refused(tmp_path, "is a capture that is not finished", "drgs capture command again")
    file = tmp_path / "transforms.json"
    for text, word in (
        ("{", "not JSON"),
        ("[]", "not a JSON object"),
        ("{}", "no list of frames"),
        ('{"frames": []}', "no list of frames"),
        ('{"frames": [{"transform_matrix": 1}]}', "no file_path"),
    ):
        file.write_text(text)
        assert_refused(tmp_path, str(file), word)
    scene = captures.make(tmp_path / "c")
    path = captures.write_nerfstudio(scene)
    good = json.loads(path.read_text())
    for change, word in (
        ({"fl_x": "wide"}, "fl_x"),
        ({"fl_x": -3}, "impossible"),
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR"),
        ({"frames": [good["frames"][0] | {"transform_matrix": [[1, 2], [3, 4]]}]}, "4 rows of 4"),
        ({"frames": [good["frames"][0] | {"transform_matrix": np.diag([1, 1, -1, 1]).tolist()}]}, "mirrors"),
        ({"frames": [good["frames"][0] | {"transform_matrix": np.diag([1, 2, 1, 1]).tolist()}]}, "no rotation"),
        (
            {"frames": [good["frames"][0] | {"transform_matrix": [[1, 0, 0, 1e300], [0, 1, 0, 0], [0, 0, 1, 0]]}]},
            "1e+300",
        ),
        (
            {"frames": [good["frames"][0] | {"file_path": "a" * 5000}]},
            f"1 of 1 images that are not there: {200 * 'a'}. ",
        ),
        ({"test_filenames": 5}, "test_filenames"),
    ):
        path.write_text(json.dumps(good | change))
        assert_refused(scene.folder, word)
    colmap = captures.make(tmp_path / "colmap")
    captures.write_colmap(colmap, True)
    images = colmap.folder / "sparse/0/images.bin"
    images.write_bytes(images.read_bytes()[:-40])
    assert_refused(colmap.folder, "damaged")


def test_a_pickle_that_would_run_code_is_refused(tmp_path):
    scene = captures.make(tmp_path)
    captures.write_nero(scene)

    class Evil:
        def __reduce__(self):
            return (exec, (f"open({str(tmp_path / 'ran')!r}, 'w')",))

    (tmp_path / "3-camera.pkl").write_bytes(pickle.dumps(Evil()))
    assert_refused(tmp_path, "3-camera.pkl", "exec")
    assert not (tmp_path / "ran").exists()


def test_more_pixels_than_memory_are_refused_before_they_are_read(tmp_path):
    scene = captures.make(tmp_path)
    path = captures.write_nerfstudio(scene)
    data = json.loads(path.read_text())
    factor = 40000
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        data[key] *= factor
    path.write_text(json.dumps(data))
    assert_refused(tmp_path, "memory", "--resolution", error=UsageError)
    assert len(read_capture(tmp_path, resolution=24).views) == 12


def test_the_memory_counted_for_a_pixel_is_what_learning_keeps_of_it(tmp_path, monkeypatch):
    """Masks before real surroundings take most: colour, mask, the colour cut out, and all in half size."""
    targets = pytest.importorskip("drgs_blender.reconstruct.capture.training_views")
    monkeypatch.setattr(targets, "MAX_CACHED_PIXELS", 0)  # blurred copies are kept of few pixels alone
    captures.write_nerfstudio(captures.make(tmp_path))
    capture = replace(read_capture(tmp_path), background=None)
    held = {}
    for target in [target for views in targets.targets(capture) for target in views]:
        held |= {array.ctypes.data: array.nbytes for array in (target.photograph.colour, target.mask.numpy())}
    for view in capture.views:
        held |= {array.ctypes.data: array.nbytes for array in (view.colour, view.mask)}
    assert sum(held.values()) == BYTES_A_PIXEL * captures.WIDTH * captures.HEIGHT * len(capture.views)


@pytest.mark.slow
def test_real_captures(shared_data):
    head = read_capture(shared_data / "multiview" / "ethiopianHead_1000", resolution=64, test_every=8)
    assert (len(head.training), len(head.testing)) == (57, 9)
    assert head.background is None and all(view.mask is not None for view in head.views)
    heights = [view.camera.matrix_world[2, 1] for view in head.views]
    assert np.mean(heights) > 0.8  # the head stands upright
    lego = read_capture(shared_data / "multiview" / "lego_400", resolution=64)
    assert len(lego.views) == 50 and lego.background == (1.0, 1.0, 1.0)
