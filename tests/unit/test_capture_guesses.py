"""What `drgs capture` takes from pictures without being told: alpha as the mask, a guessed world. Nothing is silent."""

from __future__ import annotations

import json
import os
from dataclasses import replace

import numpy as np
import pytest
import tifffile
from PIL import Image
from test_capture_pictures import exif, texture
from test_capture_registration import registration, ring, scene

from drgs_blender.capture import capture_folder, pipeline
from drgs_blender.capture.masks import stage
from drgs_blender.capture.pictures import Picture, decode, find_pictures, write_picture
from drgs_blender.capture.preparation import prepare
from drgs_blender.capture.world_alignment import GUESSED, LOWEST, PLANE, Alignment, align_to_ground
from drgs_blender.core.color import srgb_to_linear
from drgs_blender.core.errors import AssetError, DeviceError, UsageError, WriteError
from drgs_blender.formats.exr import write_exr_picture
from drgs_blender.formats.images import load_image
from drgs_blender.reconstruct.readers import read_capture
from drgs_blender.reconstruct.readers.layout import load_picture

MASK = np.zeros((64, 96), np.float32)
MASK[20:50, 30:80] = 1


def prepared(folder, tmp_path):
    return prepare(find_pictures(folder), tmp_path / "work", 96, False, lambda *_: None, lambda: False)


def write_with_alpha(path, k: int, alpha: np.ndarray) -> None:
    """A picture with alpha in the way of its kind: associated in EXR, straight elsewhere."""
    colour = np.asarray(texture(k), np.float32) / 255
    if path.suffix == ".exr":
        linear = srgb_to_linear(colour) * alpha[..., None]
        write_exr_picture(path, np.dstack([linear, alpha]).astype(np.float32))
        return
    pixels = np.dstack([colour, alpha])
    if path.suffix == ".png":
        Image.fromarray((pixels * 255 + 0.5).astype(np.uint8)).save(path)
    else:
        kind = np.float32 if "float" in path.stem else np.uint16
        stored = pixels if kind is np.float32 else pixels * 65535 + 0.5
        tifffile.imwrite(path, stored.astype(kind), photometric="rgb", extrasamples=["unassalpha"])


KINDS = ["a.png", "a.tif", "float.tif", "a.exr"]


@pytest.mark.parametrize("name", KINDS)
def test_alpha_is_the_mask_of_every_kind_of_picture_and_is_kept(tmp_path, name):
    photos, out = tmp_path / "photos", tmp_path / "out"
    photos.mkdir()
    out.mkdir()
    write_with_alpha(photos / name, 0, MASK)
    ready = prepared(photos, tmp_path)
    assert ready.masks is not None
    with Image.open(ready.masks / f"{ready.photos[0].file}.png") as image:
        np.testing.assert_array_equal(np.asarray(image) > 127, MASK > 0.5)
    written = write_picture(ready.pictures[0], out)  # which drgs reconstruct takes the mask from
    pixels, _ = load_picture(written)
    assert pixels.shape[2] == 4
    np.testing.assert_allclose(np.asarray(pixels[..., 3], float) / pixels[..., 3].max(), MASK, atol=1e-3)
    with Image.open(ready.folder / ready.photos[0].file) as copy:  # the object shines as it did
        shown = np.asarray(copy, float)[MASK > 0.5]
    wanted = np.asarray(texture(0), float)[MASK > 0.5]
    if name != "float.tif":  # whose values are linear
        assert abs(shown.mean() - wanted.mean()) < 3


@pytest.mark.parametrize("name", KINDS)
def test_an_opaque_alpha_is_no_mask(tmp_path, name):
    photos = tmp_path / "photos"
    photos.mkdir()
    write_with_alpha(photos / name, 0, np.ones_like(MASK))
    ready = prepared(photos, tmp_path)
    assert ready.masks is None and decode(ready.pictures[0]).shape[2] == 3


def test_a_mask_file_counts_before_alpha(tmp_path):
    photos, masks = tmp_path / "images", tmp_path / "masks"
    photos.mkdir()
    masks.mkdir()
    write_with_alpha(photos / "a.exr", 0, MASK)
    Image.fromarray(((1 - MASK) * 255).astype(np.uint8)).save(masks / "a.png")
    ready = prepared(tmp_path, tmp_path)
    with Image.open(ready.masks / "a.jpg.png") as image:
        np.testing.assert_array_equal(np.asarray(image) > 127, MASK < 0.5)


def test_pictures_without_alpha_among_those_with_are_named(tmp_path, caplog):
    photos = tmp_path / "photos"
    photos.mkdir()
    for k in range(3):
        write_with_alpha(photos / f"{k}.exr", k, MASK if k != 1 else np.ones_like(MASK))
    prepared(photos, tmp_path)
    assert "1 of 3 pictures have neither a mask nor an alpha that is one: 1.exr" in caplog.text


def test_pictures_without_a_mask_file_are_named(tmp_path, caplog):
    photos, masks = tmp_path / "images", tmp_path / "masks"
    photos.mkdir()
    masks.mkdir()
    for k in range(3):
        texture(k).save(photos / f"{k}.png")
        if k != 2:
            Image.fromarray((MASK * 255).astype(np.uint8)).save(masks / f"{k}.png")
    prepared(tmp_path, tmp_path)
    assert "1 of 3 pictures have neither a mask nor an alpha that is one: 2.png" in caplog.text


def test_an_alpha_of_nothing_is_named_and_left_out(tmp_path, caplog):
    photos = tmp_path / "photos"
    photos.mkdir()
    for k in range(3):
        write_with_alpha(photos / f"{k}.exr", k, MASK * (k != 1))
    ready = prepared(photos, tmp_path)
    assert list(ready.broken) == ["1.exr"] and "alpha that is 0 everywhere" in str(ready.broken["1.exr"])
    assert "1.exr: has an alpha that is 0 everywhere" in caplog.text


@pytest.mark.parametrize("name", KINDS)
def test_without_masks_alpha_is_left_out(tmp_path, name):
    photos, out = tmp_path / "photos", tmp_path / "out"
    photos.mkdir()
    out.mkdir()
    write_with_alpha(photos / name, 0, MASK)
    (picture,) = find_pictures(photos)
    picture.alpha = False
    assert decode(picture).shape[2] == 3
    assert load_picture(write_picture(picture, out))[0].shape[2] == 3


def test_values_that_are_no_numbers_are_named_once(tmp_path, caplog):
    pixels = np.full((8, 12, 3), 0.2, np.float32)
    for k in range(3):
        pixels[0, :k] = np.nan
        write_exr_picture(tmp_path / f"{k}.exr", pixels)
    found = find_pictures(tmp_path)
    told = [text for text in caplog.messages if "not used as they are stored" in text]
    assert len(told) == 1 and "2 pictures" in told[0] and "1.exr: 3 values that are NaN" in told[0]
    assert [len(picture.notes) for picture in found] == [0, 1, 1]


@pytest.mark.parametrize("orientation", [3, 6, 8])
@pytest.mark.parametrize("deep", [False, True])
def test_tiff_is_turned_once(tmp_path, orientation, deep):
    pixels = np.asarray(texture(0))
    if deep:
        tag = (274, "H", 1, orientation, True)
        tifffile.imwrite(tmp_path / "a.tif", pixels.astype(np.uint16) * 257, photometric="rgb", extratags=[tag])
    else:
        Image.fromarray(pixels).save(tmp_path / "a.tif", exif=exif(Orientation=orientation))
    (picture,) = find_pictures(tmp_path)
    turns = {3: 2, 6: 3, 8: 1}[orientation]
    found = decode(picture)
    wanted = np.rot90(pixels, turns)
    assert picture.size == (wanted.shape[1], wanted.shape[0])
    np.testing.assert_array_equal(found // 257 if deep else found, wanted)


def test_a_guessed_world_says_what_of_it_is_guessed():
    known = align_to_ground(registration(ring(20), scene(table=True)), 0.5)
    assert known.guessed == {} and known.ground_from == PLANE
    lump = align_to_ground(registration(ring(20), scene(table=False)))
    assert lump.guessed.keys() == {"scale", "up", "ground"} and lump.ground_from == LOWEST
    bare = align_to_ground(registration(ring(20), np.zeros((0, 3))), 0.5)
    assert bare.guessed == {"up": "how the cameras were held", "ground": GUESSED}


def test_cameras_held_in_all_ways_do_not_say_what_is_up():
    cameras = ring(24)
    for k, matrix in enumerate(cameras.values()):
        turn = np.eye(4)
        turn[:2, :2] = np.array([[np.cos(k), -np.sin(k)], [np.sin(k), np.cos(k)]])
        matrix[:] = matrix @ turn
    found = align_to_ground(registration(cameras, np.zeros((0, 3))))
    assert found.guessed["up"].startswith("nothing")


def six_cameras():
    """Registration of six pictures, as the report needs it."""
    found = registration(ring(6), np.zeros((0, 3)))
    found.errors, found.observations = dict.fromkeys(found.matrices, 0.1), dict.fromkeys(found.matrices, 9)
    return found


def written_capture(tmp_path, alignment: Alignment, bright: int = 0):
    """A capture folder of six pictures whose world is `alignment`; some are EXR, brighter than white."""
    found = six_cameras()
    pictures = {}
    for k, file in enumerate(found.matrices):
        path = tmp_path / f"{file}.{'exr' if k < bright else 'png'}"
        if k < bright:
            write_exr_picture(path, np.asarray(texture(k, 800, 600), np.float32) / 128)
        else:
            texture(k, 800, 600).save(path)
        pictures[file] = Picture(path, file[:-4], size=(800, 600))
    folder = tmp_path / "out"
    folder.mkdir(exist_ok=True)
    more = {"ground": alignment.ground_from}
    capture_folder.write_capture(folder, pictures, found, ["said"], more, alignment.guessed)
    return folder


def test_what_is_guessed_is_told_then_and_again_by_reconstruct(tmp_path, caplog):
    alignment = align_to_ground(registration(ring(20), scene(table=False)))
    pipeline._tell_guesses(alignment, tmp_path)
    assert "no level plane is found" in caplog.text and "drgs markers" in caplog.text and "1 m" in caplog.text
    folder = written_capture(tmp_path, alignment)
    assert json.loads((folder / "capture.json").read_text())["guessed"] == alignment.guessed
    caplog.clear()
    read_capture(folder, 64, tell_guesses=False)
    assert not caplog.messages
    read_capture(folder, 64)
    (told,) = [text for text in caplog.messages if "without knowing" in text]
    assert "up (how the cameras were held)" in told and "ground (lowest points)" in told and "scale" in told
    caplog.clear()
    read_capture(folder, 64, up="z")
    assert "up (" not in caplog.text and "ground (lowest points)" in caplog.text


def test_what_is_brighter_than_white_stays_so(tmp_path):
    folder = written_capture(tmp_path, align_to_ground(registration(ring(6), scene(True))), bright=2)
    views = read_capture(folder, 64).views
    assert [view.above_white is not None for view in views] == [True] * 2 + [False] * (len(views) - 2)
    assert views[0].above_white.max() > 0.5 and views[0].colour.max() > 0.999


def test_what_is_known_is_not_doubted(tmp_path, caplog):
    said = "marker sheet (a4)"
    alignment = replace(
        align_to_ground(registration(ring(6), scene(True))), scale_from=said, up_from=said, ground_from=said
    )
    pipeline._tell_guesses(alignment, tmp_path)
    read_capture(written_capture(tmp_path, alignment), 64)
    assert "guess" not in caplog.text and "without knowing" not in caplog.text


def test_masks_are_not_made_on_a_ground_that_only_cameras_guess(tmp_path, caplog):
    assert stage.mode_on_ground("auto", None, PLANE) == ("auto", "")
    assert stage.mode_on_ground("auto", tmp_path, GUESSED) == ("auto", "")  # given ones
    assert stage.mode_on_ground("given", None, GUESSED) == ("given", "")
    mode, said = stage.mode_on_ground("auto", None, LOWEST)
    assert mode == "auto" and "lack its foot" in said
    mode, said = stage.mode_on_ground("auto", None, GUESSED)
    assert mode == "none" and "No masks are made" in said
    pipeline._tell_guesses(align_to_ground(registration(ring(20), np.zeros((0, 3))), 0.5), tmp_path, said)
    (told,) = caplog.messages  # the ground and what masks suffer by it, once
    assert "no level plane is found" in told and said in told


def test_deep_tiff_with_alpha_is_read_back(tmp_path):
    picture = Picture(tmp_path / "a.exr", "a", size=(96, 64))
    write_with_alpha(picture.path, 0, MASK)
    assert load_image(write_picture(picture, tmp_path)).shape == (64, 96, 4)


def test_a_capture_may_lie_beside_its_photographs(tmp_path):
    capture_folder.check_folder(tmp_path / "a.capture", tmp_path)
    for taken in (tmp_path, tmp_path / "images", tmp_path / "masks" / "new"):
        with pytest.raises(UsageError, match="is where the pictures or masks are"):
            capture_folder.check_folder(taken, tmp_path)
    other = tmp_path / "other"
    other.mkdir()
    (other / "file").touch()
    with pytest.raises(UsageError, match="holds other files"):
        capture_folder.check_folder(other, tmp_path)


@pytest.mark.skipif(os.name == "nt", reason="links need rights there")
def test_folders_that_cannot_be_are_refused_by_name(tmp_path):
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(WriteError, match="a: cannot be made"):
        capture_folder.check_folder(tmp_path / "a", tmp_path / "photos")
    with pytest.raises(UsageError, match="is not a name in UTF-8"):
        capture_folder.check_folder(tmp_path / "caf\udce9", tmp_path / "photos")


def test_two_processes_do_not_make_one_capture(tmp_path):
    folder = tmp_path / "out"
    with capture_folder.open_folder(folder) as work:
        capture_folder.keep_work(work, "one")
        (work / "copy").touch()
        with pytest.raises(UsageError, match="is being made by another process"), capture_folder.open_folder(folder):
            pass
        capture_folder.keep_work(work, "one")
        assert (work / "copy").exists()
    with capture_folder.open_folder(folder) as work:  # the lock is kept, what is not of these pictures is not
        capture_folder.keep_work(work, "other")
        assert sorted(path.name for path in work.iterdir()) == ["inputs", capture_folder.LOCK]
        with pytest.raises(UsageError, match="is being made by another process"), capture_folder.open_folder(folder):
            pass


def test_what_a_killed_run_was_writing_is_removed_by_the_next(tmp_path):
    alignment = align_to_ground(registration(ring(6), scene(True)))
    (tmp_path / "out" / ".0123abcd.tmp").mkdir(parents=True)
    (tmp_path / "out" / ".0123abcd.tmp" / "file.png").touch()
    (tmp_path / "out" / ".capture.json.0123abcd.tmp").touch()
    folder = written_capture(tmp_path, alignment)
    assert not [path for path in folder.rglob("*") if path.name.endswith(".tmp")]


def test_what_is_refused_at_once_leaves_nothing(tmp_path):
    photographs, out = tmp_path / "photos", tmp_path / "out"
    photographs.mkdir()
    for count in (0, 3):
        for k in range(count):
            texture(k).save(photographs / f"{k}.png")
        with pytest.raises(AssetError):
            pipeline.make_capture(photographs, out, pipeline.Settings(), print, lambda: False)
        assert not out.exists()


def test_masks_of_alpha_are_not_kept_where_none_are_wanted(tmp_path):
    write_with_alpha(tmp_path / "a.png", 0, MASK)
    given = pipeline.pictures.find_pictures(tmp_path)
    assert pipeline.work_key(given, pipeline.Settings(masks="none")) != pipeline.work_key(given, pipeline.Settings())


def test_a_capture_without_one_of_its_pictures_is_made_again(tmp_path):
    alignment = align_to_ground(registration(ring(6), scene(True)))
    folder = written_capture(tmp_path, alignment)
    report = json.loads((folder / "capture.json").read_text())
    (folder / "capture.json").write_text(json.dumps(report | {"digest": "same"}))
    assert capture_folder.complete(folder, "same") and not capture_folder.complete(folder, "other")
    next((folder / "images").iterdir()).unlink()
    assert not capture_folder.complete(folder, "same")


@pytest.mark.parametrize(
    ("library", "settings"),
    [("pycolmap", {}), ("opencv", {"poses": "markers"}), ("opencv", {"masks": "auto"}), ("torch", {"masks": "auto"})],
)
def test_missing_libraries_are_told_before_anything_is_done(tmp_path, monkeypatch, library, settings):
    row = pipeline.libraries.LIBRARIES[library]
    monkeypatch.setitem(pipeline.libraries.LIBRARIES, library, row._replace(module="no_such_module"))
    texture(0).save(tmp_path / "a.jpg")
    with pytest.raises(DeviceError, match=f"needs {library}"):
        pipeline.make_capture(tmp_path, tmp_path / "out", pipeline.Settings(**settings), print, lambda: False)
    assert not (tmp_path / "out").exists()


def test_other_masks_or_scale_keep_the_work_that_was_done(tmp_path):
    """What is registered depends on the pictures and how they are prepared alone."""
    for k in range(3):
        texture(k).save(tmp_path / f"{k}.jpg")
    given = pipeline.pictures.find_pictures(tmp_path)
    keys = {pipeline.work_key(given, pipeline.Settings(**more)) for more in ({}, {"distance": 2.0}, {"masks": "auto"})}
    assert len(keys) == 1 and pipeline.work_key(given, pipeline.Settings(size=800)) not in keys


def test_the_folder_says_how_wrong_outlines_of_masks_may_be(tmp_path):
    found = six_cameras()
    pictures = {}
    for k, file in enumerate(found.matrices):
        for name, mode in ((f"{k}.png", "RGB"), (f"{k}-mask.png", "L")):
            texture(k, 800, 600).convert(mode).save(tmp_path / name)
        mask, band = (None, 0.0) if k == 0 else (tmp_path / f"{k}-mask.png", float(k - 1))
        pictures[file] = Picture(tmp_path / f"{k}.png", f"{k}", mask=mask, mask_band=band, size=(800, 600))
    (tmp_path / "out").mkdir()
    capture_folder.write_capture(tmp_path / "out", pictures, found, [], {}, {})
    frames = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"]
    assert [frame.get("mask_band") for frame in frames] == [None, None, 1.0, 2.0, 3.0, 4.0]
