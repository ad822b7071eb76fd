"""Photographs without cameras: found, turned, described; what is wrong with them is said by name."""

from __future__ import annotations

import io
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from capture_cases import balls
from PIL import ExifTags, Image, ImageFilter, ImageOps
from scipy.ndimage import convolve, uniform_filter

from drgs_blender.capture import pictures
from drgs_blender.capture.exif import Metadata, read_exif
from drgs_blender.capture.inspection import FEWEST, inspect, look, tell_of_views
from drgs_blender.capture.left_out import Cause, Reason
from drgs_blender.capture.pictures import Picture, decode, find_pictures, has_pictures, shown, write_picture
from drgs_blender.capture.preparation import prepare
from drgs_blender.core.color import linear_to_srgb, srgb_to_linear
from drgs_blender.core.errors import AssetError
from drgs_blender.formats.exr import write_exr_picture


def texture(seed: int, width: int = 96, height: int = 64) -> Image.Image:
    """Noise of two scales, another one a seed."""
    random = np.random.default_rng(seed)
    coarse = Image.fromarray(random.integers(0, 255, (8, 12, 3), np.uint8)).resize((width, height))
    return Image.blend(coarse, Image.fromarray(random.integers(0, 255, (height, width, 3), np.uint8)), 0.4)


def exif(**values: object) -> Image.Exif:
    found = Image.Exif()
    for name, value in values.items():
        target = found if name in ("Orientation", "Make", "Model") else found.get_ifd(ExifTags.IFD.Exif)
        target[ExifTags.Base[name]] = value
    return found


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_are_turned_as_viewers_turn_them(tmp_path, orientation):
    path = tmp_path / "a.jpg"
    texture(0).save(path, exif=exif(Orientation=orientation), quality=95)
    (picture,) = find_pictures(tmp_path)
    with Image.open(path) as image:
        wanted = np.asarray(ImageOps.exif_transpose(image))
    np.testing.assert_array_equal(decode(picture), wanted)
    assert picture.size == (wanted.shape[1], wanted.shape[0])
    out = tmp_path / "out"
    out.mkdir()
    written = write_picture(picture, out)
    with Image.open(written) as image:
        assert image.getexif().get(ExifTags.Base.Orientation, 1) == 1
        assert np.abs(np.asarray(image, int) - wanted).mean() < 3
    assert orientation != 1 or written.read_bytes() == path.read_bytes()


def test_focal_length_and_exposure_of_exif(tmp_path):
    path = tmp_path / "a.jpg"
    values = {"Make": "Maker", "Model": "M1", "FocalLength": 50.0, "FocalLengthIn35mmFilm": 50}
    texture(0, 360, 240).save(path, exif=exif(**values, FNumber=8.0, ExposureTime=1 / 64, ISOSpeedRatings=200))
    with Image.open(path) as image:
        found = read_exif(image)
    assert found.focal == pytest.approx(50 / 36)  # of a picture with the shape of the film
    assert found.camera == "Maker M1 50 mm"
    assert found.exposure == pytest.approx(6 + 6 - 1, abs=0.01)  # 2 log2 N - log2 t - log2(ISO / 100)


def test_linear_and_deep_pictures_are_read_and_keep_their_depth(tmp_path):
    linear = np.full((8, 12, 3), 0.18, np.float32)
    linear[0, 0] = 4.0
    write_exr_picture(tmp_path / "a.exr", linear)
    (picture,) = find_pictures(tmp_path)
    assert shown(decode(picture))[4, 4, 0] == 118 and shown(decode(picture))[0, 0, 0] == 255
    out = tmp_path / "out"
    out.mkdir()
    written = Picture(write_picture(picture, out), "a")
    pixels = decode(written)
    np.testing.assert_array_equal(pixels, linear)  # as one value is brighter than white
    linear[0, 0] = 1.0
    write_exr_picture(tmp_path / "a.exr", linear)
    pixels = decode(Picture(write_picture(picture, out), "a"))
    assert pixels.dtype == np.uint16 and pixels[4, 4, 0] == pytest.approx(0.4614 * 65535, rel=1e-3)


def test_masks_of_another_shape_are_refused_by_name(tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "masks").mkdir()
    for k in range(3):
        texture(k).save(tmp_path / "images" / f"{k}.png")
        Image.new("L", (96, 64), 255).save(tmp_path / "masks" / f"{k}.png")
    assert all(picture.mask for picture in find_pictures(tmp_path))
    Image.new("L", (64, 96), 255).save(tmp_path / "masks" / "1.png")
    with pytest.raises(
        AssetError, match=r"masks/1.png: is 64 x 96 pixels, 1.png 96 x 64. Draw the mask over the turned"
    ):
        find_pictures(tmp_path)


@pytest.mark.skipif(os.name == "nt" or sys.platform == "darwin", reason="all names of files are Unicode")
def test_names_that_are_not_utf8_or_long_are_taken(tmp_path):
    for k, name in enumerate((b"caf\xe9.png", b"caf\xe8.png", b"x" * 251 + b".png", b"x" * 250 + b"y.png")):
        texture(k).save(tmp_path / f"{k}.png")
        os.rename(tmp_path / f"{k}.png", os.fsencode(tmp_path) + b"/" + name)
    found = find_pictures(tmp_path)
    assert sorted(picture.name for picture in found) == ["caf_", "caf_-2", "x" * 200, f"{'x' * 200}-2"]
    assert len(pictures.digest(found)) == 64


def test_working_copies_have_names_that_lists_of_pairs_can_hold(tmp_path):
    """A blank ends a name there, and what begins with # is no pair."""
    for k, name in enumerate(("IMG 1", "IMG_1", "new\nline" if os.name != "nt" else "new line", "# 4", "img_1")):
        texture(k).save(tmp_path / f"{name}{k}.png")
    given = [Picture(path, path.stem[:-1]) for path in sorted(tmp_path.glob("*.png"), key=lambda path: path.stem[-1])]
    ready = prepare(given, tmp_path / "work", 64, False, lambda *_: None, lambda: False)
    files = [photo.file for photo in ready.photos]
    assert files == ["IMG_1.jpg", "IMG_1-2.jpg", "new_line.jpg", "__4.jpg", "img_1-3.jpg"]
    assert sorted(files) == sorted(path.name for path in ready.folder.iterdir())
    assert [photo.given for photo in ready.photos] == [picture.path.name for picture in given]


def test_masks_that_say_nothing_are_told_before_the_work(tmp_path, caplog):
    (tmp_path / "images").mkdir()
    (tmp_path / "masks").mkdir()
    for k in range(4):
        texture(k).save(tmp_path / "images" / f"{k}.png")
        Image.new("L", (96, 64), 255 if k else 0).save(tmp_path / "masks" / f"{k}.png")
    Image.new("L", (96, 64)).save(tmp_path / "masks" / "3.png.png")
    given = find_pictures(tmp_path)
    assert not caplog.messages
    ready = prepare(given, tmp_path / "work", 64, False, lambda *_: None, lambda: False)
    assert list(ready.broken) == ["0.png"] and ready.broken["0.png"].reason is Reason.EMPTY_MASK
    assert "masks/0.png: is black all over" in caplog.messages[0]
    assert "3 of 3 masks are white along the edges" in caplog.messages[1] and len(caplog.messages) == 2
    caplog.clear()
    for k in range(4):
        (tmp_path / "masks" / f"{k}.png").rename(tmp_path / "masks" / f"mask_{k}.png")
    find_pictures(tmp_path)
    (told,) = caplog.messages
    assert "4 of 5 masks belong to no picture" in told and "mask_0.png" in told


def test_what_is_no_picture_to_use_is_told(tmp_path, caplog):
    texture(0).save(tmp_path / "a.png")
    Image.new("RGB", (1, 64)).save(tmp_path / "b.png")
    assert [picture.name for picture in find_pictures(tmp_path)] == ["a"]
    assert "b.png (is 1 x 64 pixels, too small)" in caplog.text
    with pytest.raises(AssetError, match=r"a\.png: is neither a folder of photographs nor a video"):
        find_pictures(tmp_path / "a.png")


def test_what_cannot_be_read_is_left_out_and_named(tmp_path, caplog):
    for k in range(4):
        texture(k).save(tmp_path / f"{k}.png")
    (tmp_path / "broken.jpg").write_bytes(b"no picture")
    (tmp_path / "phone.heic").write_bytes(b"")
    assert [picture.name for picture in find_pictures(tmp_path)] == ["0", "1", "2", "3"]
    assert "broken.jpg" in caplog.text and "phone.heic" in caplog.text


def test_raw_files_without_rawpy_are_named(tmp_path, caplog, monkeypatch):
    monkeypatch.setattr(pictures.libraries, "is_there", lambda name: False)
    for k in range(2):
        texture(k).save(tmp_path / f"{k}.jpg")
        (tmp_path / f"{k}.NEF").write_bytes(b"")
    (tmp_path / "alone.dng").write_bytes(b"")
    assert [picture.path.name for picture in find_pictures(tmp_path)] == ["0.jpg", "1.jpg"]
    assert "rawpy" in caplog.text and "alone.dng" in caplog.text


def test_folders_with_pictures_are_known(tmp_path):
    assert not has_pictures(tmp_path) and not has_pictures(tmp_path / "absent")
    (tmp_path / "walk.MP4").write_bytes(b"")
    assert has_pictures(tmp_path) and pictures.find_video(tmp_path) == tmp_path / "walk.MP4"
    texture(0).save(tmp_path / "a.jpg")
    assert pictures.find_video(tmp_path) is None


def looks(images, exposures=None):
    """(pictures, looks) of images in memory."""
    exposures = exposures or [None] * len(images)
    made = [Picture(Path(f"{k}.jpg"), str(k), exif=Metadata(exposure=e), size=im.size)
            for k, (im, e) in enumerate(zip(images, exposures))]  # fmt: skip
    return made, [look(np.asarray(image)) for image in images]


def test_blurred_pictures_and_duplicates_are_left_out(caplog):
    images = [texture(k) for k in range(10)]
    images[3] = images[3].filter(ImageFilter.GaussianBlur(6))
    images[7] = images[2].copy()
    fit, left_out = inspect(*looks(images), "photos")
    assert set(left_out) == {"3.jpg", "7.jpg"} and len(fit) == 8
    assert left_out["3.jpg"].reason is Reason.BLURRED and left_out["7.jpg"] == Cause(Reason.DUPLICATE, "2.jpg")
    assert "of 10 pictures left out: 1 blurred: 3.jpg (sharpness" in caplog.text
    assert "3.jpg" in caplog.text and "7.jpg" in caplog.text


def test_of_two_alike_the_one_with_a_mask_is_kept():
    pictures, seen = looks([texture(k if k != 7 else 2) for k in range(10)])
    pictures[7].mask = Path("masks/7.png")
    _, left_out = inspect(pictures, seen, "photos")
    assert left_out == {"2.jpg": Cause(Reason.DUPLICATE, "7.jpg")}


def test_sharp_pictures_of_different_contrast_are_kept():
    images = [texture(k) for k in range(6)]
    images[1] = Image.eval(images[1], lambda v: 100 + v // 5)
    assert not inspect(*looks(images), "photos")[1]


def test_of_an_exposure_bracket_the_middle_is_used():
    images, exposures = [], []
    for k in range(6):
        for stops in (0, -2, 2):
            images.append(Image.eval(texture(k), lambda v, f=2.0 ** (stops / 2.2): min(255, int(v * f * 0.5))))
            exposures.append(10.0 - stops)
    fit, left_out = inspect(*looks(images, exposures), "photos")
    assert [picture.name for picture in fit] == [str(3 * k) for k in range(6)] and len(left_out) == 12


def test_too_few_pictures_are_refused():
    with pytest.raises(AssetError, match=rf"has 3 usable pictures .* shape needs {FEWEST} or more"):
        inspect(*looks([texture(k) for k in range(3)]), "photos")


def test_different_exposures_and_sizes_are_told(caplog):
    images = [texture(k, *((96, 64) if k % 2 else (64, 96))) for k in range(6)]
    inspect(*looks(images, [10.0, 10.0, 10.0, 12.0, 10.0, 10.0]), "photos")
    assert "2.0 stops" in caplog.text and "3 of 64 x 96: 0.jpg, 2.jpg, 4.jpg" in caplog.text


def exposed(image: Image.Image, stops: float) -> Image.Image:
    linear = srgb_to_linear(np.asarray(image) / 255) * 2.0**stops
    return Image.fromarray((linear_to_srgb(linear.clip(0, 1)) * 255 + 0.5).astype(np.uint8))


@pytest.mark.parametrize("spread", [2.5, 4.0])
def test_brightness_says_how_far_exposures_without_exif_are_apart(caplog, spread):
    stops = np.linspace(0, -spread, 8)[[3, 0, 5, 1, 7, 2, 6, 4]]
    images = [exposed(Image.eval(texture(k), lambda v: v // 2), s) for k, s in enumerate(stops)]
    inspect(*looks(images), "photos")
    (line,) = [r.getMessage() for r in caplog.records if "brightness" in r.getMessage()]
    assert float(line.partition("differ by ")[2].split()[0]) == pytest.approx(spread, abs=0.3)
    assert "from 4.jpg (darkest) to 1.jpg" in line


def test_exposures_count_where_one_picture_does_not_say_its_own(caplog):
    images = [texture(k) for k in range(20)]
    inspect(*looks(images, [None, *(10.0 + 2 * (k % 2) for k in range(18)), 12.5]), "photos")
    (line,) = [r.getMessage() for r in caplog.records if "exposures differ" in r.getMessage()]
    assert "2.5 stops (EXIF), from 19.jpg (least light) to 1.jpg" in line and "for 1 pictures that do not say" in line


def test_unknown_focal_lengths_are_told_once_with_names(caplog):
    pictures, seen = looks([texture(k) for k in range(20)])
    for picture in pictures[2:]:
        picture.exif = Metadata(focal=1.2)
    inspect(pictures, seen, "photos")
    (line,) = [r.getMessage() for r in caplog.records if "lens was" in r.getMessage()]
    assert line.startswith("photos: 2 of 20 pictures") and "0.jpg, 1.jpg" in line


@pytest.mark.parametrize("along", ["rows", "columns", "diagonal"])
def test_pictures_of_a_camera_that_moved_are_blurred(along):
    """Along the edges they stay sharp: the variance of the Laplacian has a tenth of the others' left."""
    path = 15
    kernel = {"rows": np.ones((1, path)), "columns": np.ones((path, 1)), "diagonal": np.eye(path)}[along]
    images = [texture(k, 480, 320) for k in range(8)]
    moved = np.stack([convolve(c, kernel / path) for c in np.moveaxis(np.asarray(images[3], float), 2, 0)], axis=2)
    images[3] = Image.fromarray(moved.astype(np.uint8))
    assert set(inspect(*looks(images), "photos")[1]) == {"3.jpg"}


def turntable(degrees: float, side: int, seed: int = 0, width: int = 480, height: int = 360) -> Image.Image:
    """A textured cylinder, `side` pixels wide and half as high again, before a plain backdrop with noise of its own."""
    random = np.random.default_rng(5)
    cover = 0.5 + 0.5 * (random.random((16, 64)) - 0.5)
    grey = np.linspace(0.5, 0.6, width)[None].repeat(height, 0)
    angle = np.arcsin((np.arange(side) + 0.5) / side * 2 - 1) + np.radians(degrees)
    column = np.floor(angle / (2 * np.pi) * 64).astype(int) % 64
    rows = np.arange(3 * side // 2) * 16 // (3 * side // 2)
    top, left = (height - len(rows)) // 2, (width - side) // 2
    grey[top : top + len(rows), left : left + side] = cover[rows][:, column]
    grey = grey + 0.01 * np.random.default_rng(seed).standard_normal(grey.shape)
    return Image.fromarray((grey.clip(0, 1) * 255).astype(np.uint8)).convert("RGB")


@pytest.mark.parametrize("part", [0.01, 0.02, 0.04])
def test_small_objects_on_a_turntable_are_not_taken_for_duplicates(part):
    side = round((part * 480 * 360 / 1.5) ** 0.5)
    assert not inspect(*looks([turntable(10 * k, side, k) for k in range(12)]), "photos")[1]


@pytest.mark.parametrize(("quality", "part"), [(95, 1.0), (60, 1.0), (90, 0.5)])
def test_a_picture_that_was_compressed_again_or_made_smaller_is_a_duplicate(quality, part):
    images = [turntable(10 * k, 48, k, 960, 720) for k in range(8)]
    again = io.BytesIO()
    small = images[4].resize((round(960 * part), round(720 * part)), Image.Resampling.LANCZOS)
    small.save(again, "JPEG", quality=quality)
    images.insert(1, Image.open(again).convert("RGB"))
    left_out = inspect(*looks(images), "photos")[1]
    assert left_out.keys() == ({"1.jpg"} if part < 1 else {"5.jpg"})


def test_views_with_cameras_are_told_and_kept(caplog):
    capture = balls(8, 64, masks=False)
    views = capture.training
    for k, view in enumerate(views):
        view.colour = np.asarray(texture(k, 64, 64), np.float32) / 255
    views[1].colour = uniform_filter(views[1].colour, (5, 1, 1))  # it moved
    views[3].colour = views[2].colour.copy()
    tell_of_views(capture)
    blurred, twice = [record.getMessage() for record in caplog.records]
    assert "1 photographs are blurred" in blurred and f"{views[1].name} (" in blurred
    assert "1 photographs show the same" in twice and f"{views[3].name} ({views[2].name})" in twice
    assert len(capture.training) == len(views)
