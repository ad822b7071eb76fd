"""Exposure brackets: found by EXIF, merged to the radiance they show; what is amiss is named before long work."""

from __future__ import annotations

import json

import numpy as np
import pytest
import tifffile
from PIL import ExifTags, Image

from drgs_blender.capture import bracket_merge, pipeline
from drgs_blender.capture.brackets import Brackets, find_brackets
from drgs_blender.capture.exif import read_exr_metadata
from drgs_blender.capture.inspection import inspect
from drgs_blender.capture.pictures import Picture, decode, find_pictures, write_picture
from drgs_blender.capture.preparation import prepare
from drgs_blender.core.color import linear_to_srgb
from drgs_blender.core.errors import AssetError, Cancelled, UsageError
from drgs_blender.formats.exr import write_exr_picture
from drgs_blender.reconstruct.readers.layout import load_picture

#: Stops of one bracket relative to the middle exposure of 1/60 s; more is brighter.
STOPS = (0, -3, 3)
SIZE = (48, 36)


def radiance(view: int) -> np.ndarray:
    """(h, w, 3) of a smooth scene over 10 stops, in parts of the middle exposure's white."""
    random = np.random.default_rng(view)
    noise = random.normal(size=(5, 6, 3)).astype(np.float32)
    planes = [np.asarray(Image.fromarray(noise[..., c]).resize(SIZE, Image.Resampling.BICUBIC)) for c in range(3)]
    stack = np.stack(planes, axis=-1)
    stack = (stack - stack.min()) / np.ptp(stack)
    return (2.0 ** (-6.5 + 10 * stack)).astype(np.float32)


def tags(seconds, number=8.0, iso=100, second=0, **more) -> Image.Exif:
    """EXIF as a camera writes it; `second` of the day."""
    found = Image.Exif()
    found[ExifTags.Base.Make], found[ExifTags.Base.Model] = "Maker", "M1"
    details = found.get_ifd(ExifTags.IFD.Exif)
    values = {"ExposureTime": seconds, "FNumber": number, "ISOSpeedRatings": iso, "FocalLength": 50.0}
    values["DateTimeOriginal"] = f"2026:01:01 10:{second // 60:02d}:{second % 60:02d}"
    for name, value in (values | more).items():
        if value is not None:
            details[ExifTags.Base[name]] = value
    return found


def expose(linear: np.ndarray) -> np.ndarray:
    return np.asarray(linear_to_srgb(np.clip(linear, 0, 1)) * 255 + 0.5, np.uint8)


def shoot(folder, views: int, stops=STOPS, end="png", left_out=(), **more) -> list[str]:
    """Write brackets of views, 20 s apart, 1 s from exposure to exposure; names of the files."""
    folder.mkdir(exist_ok=True)
    names = []
    for view in range(views):
        for k, stop in enumerate(stops):
            name = f"{view:02d}_{k}.{end}"
            if (view, k) in left_out:
                continue
            image = Image.fromarray(expose(radiance(view) * 2.0**stop))
            image.save(folder / name, exif=tags(2.0**stop / 60, second=20 * view + k, **more), quality=95)
            names.append(name)
    return names


def found_in(folder, setting="auto") -> Brackets | None:
    return find_brackets(find_pictures(folder), setting, folder)


def merged(folder, tmp_path, setting="auto") -> bracket_merge.Merged:
    pictures = find_pictures(folder)
    found = find_brackets(pictures, setting, folder)
    assert found is not None
    return bracket_merge.merge_brackets(pictures, found, tmp_path / "work", "photos", lambda *_: None, lambda: False)


def test_brackets_become_the_radiance_of_the_scene(tmp_path):
    shoot(tmp_path / "photos", 2)
    done = merged(tmp_path / "photos", tmp_path)
    assert [picture.name for picture in done.pictures] == ["00_0", "01_0"] and not done.left_out
    assert done.lines[0].startswith("brackets: 2 merged, of 3 exposures (0, -3.0, +3.0 stops)")
    for view, picture in enumerate(done.pictures):
        truth, found = radiance(view), decode(picture)
        assert truth.max() / truth.min() > 400 and found.dtype == np.float32
        # Rounding to 8 bits is half a step of the longest exposure that is not saturated: below 1 % from 1/5 on.
        known = (truth < 0.95 * 8) & (truth * 8 > srgb_floor())
        assert known.mean() > 0.6
        assert np.abs(found / truth - 1)[known].max() < 0.02
        bright = truth > 8 * 1.02  # saturated in all: what the shortest shows
        assert bright.any()
        np.testing.assert_allclose(found[bright], 8, rtol=0.01)


def srgb_floor() -> float:
    """Linear value from which half a step of 8 bits is less than 1 %."""
    from drgs_blender.core.color import srgb_to_linear

    return float(srgb_to_linear(np.float32(0.42)))


def larger(pixels: np.ndarray) -> np.ndarray:
    """The same with 5 x 5 pixels for each."""
    return np.kron(pixels, np.ones((5, 5, 1), np.float32))


def test_exposure_times_that_exif_rounds_are_measured(tmp_path):
    """Cameras write 1/60 s for 1/64 s and 1/250 s for 1/256 s: 4 % of the light between them."""
    photos = tmp_path / "photos"
    photos.mkdir()
    for view in range(2):
        for k, (stop, time) in enumerate(((0, 60), (-2, 250), (2, 15))):
            image = Image.fromarray(expose(larger(radiance(view)) * 2.0**stop))
            image.save(photos / f"{view}{k}.png", exif=tags(1 / time, second=20 * view + k))
    for view, picture in enumerate(merged(photos, tmp_path).pictures):
        truth, found = larger(radiance(view)), decode(picture)
        known = (truth < 0.95 * 4) & (truth * 4 > srgb_floor())
        assert np.abs(found / truth - 1)[known].max() < 0.02


def test_saturated_exposures_do_not_count(tmp_path):
    """A flat picture that is clipped in all but the shortest exposure."""
    photos = tmp_path / "photos"
    photos.mkdir()
    for view in range(2):
        for k, stop in enumerate(STOPS):
            pixels = np.full((36, 48, 3), 5.0) * 2.0**stop
            Image.fromarray(expose(pixels)).save(
                photos / f"{view}{k}.png", exif=tags(2.0**stop / 60, second=20 * view + k)
            )
    np.testing.assert_allclose(decode(merged(photos, tmp_path).pictures[0]), 5.0, rtol=0.01)


def test_linear_pictures_are_merged_and_name_their_exposure_by_attributes(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    import OpenEXR

    for view in range(2):
        for k, stop in enumerate(STOPS):
            pixels = np.clip(radiance(view) * 2.0**stop, 0, 1)
            header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
            header |= {"expTime": 2.0**stop / 60, "aperture": 8.0, "isoSpeed": 100.0}
            planes = {name: np.ascontiguousarray(pixels[..., i]) for i, name in enumerate("RGB")}
            with OpenEXR.File(header, planes) as file:
                file.write(str(photos / f"{view}{k}.exr"))
    assert read_exr_metadata(photos / "00.exr").exposure == pytest.approx(np.log2(64 * 60), abs=1e-4)
    found = decode(merged(photos, tmp_path).pictures[1])
    known = radiance(1) < 0.9 * 8
    np.testing.assert_allclose(found[known], radiance(1)[known], rtol=1e-3)


def test_pictures_of_all_views_have_one_scale(tmp_path):
    """Aperture priority: the second view is exposed twice as long all over; its radiance is the same."""
    photos = tmp_path / "photos"
    photos.mkdir()
    for view in range(3):
        for k, stop in enumerate(STOPS):
            longer = stop + (view == 1)
            image = Image.fromarray(expose(radiance(0) * 2.0**longer))
            image.save(photos / f"{view}{k}.png", exif=tags(2.0**longer / 60, second=20 * view + k))
    done = merged(photos, tmp_path)
    first, second, third = (decode(picture) for picture in done.pictures)
    np.testing.assert_array_equal(first, third)
    known = (radiance(0) < 3.5) & (radiance(0) > srgb_floor() / 8)
    np.testing.assert_allclose(second[known], first[known], rtol=0.025)
    assert len({picture.exif.exposure for picture in done.pictures}) == 1


def test_incomplete_brackets_are_named_and_merged_of_what_there_is(tmp_path, caplog):
    shoot(tmp_path / "photos", 5, left_out=((1, 1), (3, 0), (3, 2)))
    done = merged(tmp_path / "photos", tmp_path)
    assert len(done.pictures) == 5
    (told,) = [text for text in caplog.messages if "have not all" in text]
    assert "2 exposure brackets have not all 3 exposures" in told and "01_0.png + 01_2.png, 03_1.png" in told
    alone = done.pictures[3]
    assert alone.merged == ("03_1.png",)
    known = (radiance(3) < 7) & (radiance(3) / 8 > srgb_floor())
    assert np.abs(decode(alone) / radiance(3) - 1)[known].max() < 0.02  # on the scale of the others


def test_pictures_without_exif_are_untouched_and_named_beside_brackets(tmp_path, caplog):
    photos = tmp_path / "photos"
    shoot(photos, 3)
    Image.fromarray(expose(radiance(9))).save(photos / "99.png")
    Image.fromarray(expose(radiance(8))).save(photos / "98.png", exif=tags(0.0, second=400))
    done = merged(photos, tmp_path)
    assert [picture.path.name for picture in done.pictures] == ["00_0.exr", "01_0.exr", "02_0.exr", "98.png", "99.png"]
    assert (
        "2 pictures do not say how long they were exposed (or 0 s)" in caplog.text and "98.png, 99.png" in caplog.text
    )


def test_ordinary_photographs_are_no_brackets(tmp_path, caplog):
    photos = tmp_path / "photos"
    photos.mkdir()
    random = np.random.default_rng(0)
    for k in range(24):  # by automatic exposure, seconds apart
        image = Image.fromarray(expose(radiance(k)))
        image.save(photos / f"{k}.png", exif=tags(2.0 ** float(random.normal(0, 0.5)) / 60, second=3 * k))
    assert found_in(photos) is None
    for k in range(24):
        Image.fromarray(expose(radiance(k))).save(photos / f"{k}.png")
    assert found_in(photos) is None
    assert "bracket" not in caplog.text


def test_brackets_that_are_pauses_apart_are_no_brackets_unless_asked_for(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    for k in range(6):
        stop = STOPS[k % 3]
        image = Image.fromarray(expose(radiance(k // 3) * 2.0**stop))
        image.save(photos / f"{k}.png", exif=tags(2.0**stop / 60, second=60 * k))
    assert found_in(photos) is None
    found = found_in(photos, "3")
    assert found is not None and [len(group.pictures) for group in found.groups] == [3, 3]
    assert found_in(photos, "none") is None


def test_a_missing_first_exposure_does_not_shift_the_brackets_after_it(tmp_path):
    photos = tmp_path / "photos"
    shoot(photos, 4, left_out=((1, 0),), DateTimeOriginal=None)  # not even times
    found = found_in(photos)
    assert [str(group) for group in found.groups] == [
        "00_0.png + 00_1.png + 00_2.png", "01_1.png + 01_2.png",
        "02_0.png + 02_1.png + 02_2.png", "03_0.png + 03_1.png + 03_2.png",
    ]  # fmt: skip


def test_a_number_without_such_brackets_is_refused(tmp_path):
    photos = tmp_path / "photos"
    shoot(photos, 2)
    with pytest.raises(AssetError, match="has no 5 files that follow each other with different exposures"):
        found_in(photos, "5")
    for k in range(2):
        Image.fromarray(expose(radiance(k))).save(photos / f"9{k}.png")
    with pytest.raises(AssetError, match=r"2 of 8 do not say how they were exposed.*--brackets none"):
        found_in(photos, "5")
    for wrong in ("1", "10", "three", "-3"):
        with pytest.raises(UsageError, match="Choose auto, none, or a number from 2 to 9"):
            found_in(photos, wrong)


def test_another_size_in_a_bracket_is_named(tmp_path, caplog):
    photos = tmp_path / "photos"
    shoot(photos, 3)
    with Image.open(photos / "01_2.png") as image:
        small = image.resize((24, 18))
        small.save(photos / "01_2.png", exif=image.getexif())
    done = merged(photos, tmp_path)
    assert "01_2.png (24 x 18, not 48 x 36)" in caplog.text
    assert [picture.merged for picture in done.pictures][1] == ("01_0.png", "01_1.png") and len(done.pictures) == 3
    # Alone, it is saturated where the others are not yet white: no grey may stand for that.
    assert list(done.left_out) == ["01_2.png"] and "shorter exposures of them are missing: 01_2.png" in caplog.text


def test_a_truncated_exposure_is_named_and_the_others_are_merged(tmp_path, caplog):
    photos = tmp_path / "photos"
    shoot(photos, 3, end="jpg")
    data = (photos / "02_2.jpg").read_bytes()
    (photos / "02_2.jpg").write_bytes(data[: -len(data) // 8])
    done = merged(photos, tmp_path)
    assert len(done.pictures) == 3 and list(done.left_out) == ["02_2.jpg"]
    assert "1 exposures cannot be read" in caplog.text and "02_2.jpg (is no image that can be read" in caplog.text


def test_views_that_moved_between_exposures_are_not_merged(tmp_path, caplog):
    photos = tmp_path / "photos"
    shoot(photos, 3)
    image = Image.fromarray(expose(radiance(7) / 8))
    image.save(photos / "01_1.png", exif=tags(1 / 480, second=21))
    done = merged(photos, tmp_path)
    assert [picture.path.name for picture in done.pictures] == ["00_0.exr", "01_0.exr", "02_0.exr"]
    assert set(done.left_out) == {"01_1.png", "01_2.png"}
    np.testing.assert_allclose(decode(done.pictures[1]), np.clip(radiance(1), 0, 1), atol=0.01)  # of the common scale
    assert "show no one view and are not merged" in caplog.text and "01_0.png + 01_1.png + 01_2.png" in caplog.text


def test_exposures_that_are_not_what_exif_says_are_named(tmp_path, caplog):
    photos = tmp_path / "photos"
    shoot(photos, 3)
    Image.fromarray(expose(radiance(1) / 4)).save(photos / "01_1.png", exif=tags(1 / 480, second=21))
    merged(photos, tmp_path)
    assert "differ otherwise in brightness than EXIF says" in caplog.text and "(1.0 stops)" in caplog.text


def test_merged_pictures_travel_as_exr_with_their_mask(tmp_path):
    photos, out = tmp_path / "images", tmp_path / "out"
    names = shoot(photos, 3)
    (tmp_path / "masks").mkdir()
    out.mkdir()
    mask = np.zeros(SIZE[::-1], np.uint8)
    mask[5:20, 5:20] = 255
    for name in names:
        Image.fromarray(mask).save(tmp_path / "masks" / name)
    pictures = merged(photos, tmp_path).pictures
    ready = prepare(pictures, tmp_path / "prepared", 48, False, lambda *_: None, lambda: False)
    assert ready.masks is not None and all(picture.mask is not None for picture in pictures)
    stored, _ = load_picture(write_picture(pictures[0], out))
    assert stored.dtype == np.float32 and stored.max() > 4  # what is brighter than white is kept
    np.testing.assert_array_equal(stored, decode(pictures[0]))
    assert any("brighter than white" in note for note in pictures[0].notes)


def test_one_mask_is_enough_for_a_bracket(tmp_path, caplog):
    photos = tmp_path / "images"
    shoot(photos, 3)
    (tmp_path / "masks").mkdir()
    mask = np.zeros(SIZE[::-1], np.uint8)
    mask[5:20, 5:20] = 255
    for view in range(3):
        Image.fromarray(mask).save(tmp_path / "masks" / f"{view:02d}_{view}.png")  # each of another exposure
    pictures = merged(tmp_path, tmp_path).pictures
    prepare(pictures, tmp_path / "prepared", 48, False, lambda *_: None, lambda: False)
    assert [picture.mask.name for picture in pictures] == ["00_0.png", "01_1.png", "02_2.png"]
    assert "mask" not in caplog.text


def test_alpha_of_a_bracket_stays(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    alpha = np.zeros(SIZE[::-1], np.uint8)
    alpha[5:20, 5:20], alpha[20] = 255, 128
    for view in range(2):
        for k, stop in enumerate(STOPS):
            pixels = np.dstack([expose(radiance(view) * 2.0**stop), alpha])
            Image.fromarray(pixels).save(photos / f"{view}{k}.png", exif=tags(2.0**stop / 60, second=20 * view + k))
    found = decode(merged(photos, tmp_path).pictures[0])
    np.testing.assert_allclose(found[..., 3], alpha / 255, atol=1e-6)
    seen = (alpha > 0)[..., None] & (radiance(0) < 7) & (radiance(0) * 8 > srgb_floor())
    assert np.abs(found[..., :3] / radiance(0) - 1)[seen].max() < 0.02


def test_turned_brackets_are_turned_once(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    for view in range(2):
        for k, stop in enumerate(STOPS):
            details = tags(2.0**stop / 60, second=20 * view + k)
            details[ExifTags.Base.Orientation] = 6
            pixels = np.ascontiguousarray(np.rot90(expose(radiance(view) * 2.0**stop)))
            Image.fromarray(pixels).save(photos / f"{view}{k}.png", exif=details)
    (first, _) = merged(photos, tmp_path).pictures
    assert first.size == SIZE and first.exif.orientation == 1
    known = (radiance(0) < 7) & (radiance(0) * 8 > srgb_floor())
    assert np.abs(decode(first) / radiance(0) - 1)[known].max() < 0.02


def test_deep_pictures_are_merged_in_their_depth(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    for view in range(2):
        for k, stop in enumerate(STOPS):
            deep = np.asarray(linear_to_srgb(np.clip(radiance(view) * 2.0**stop, 0, 1)) * 65535 + 0.5, np.uint16)
            path = photos / f"{view}{k}.tif"
            tifffile.imwrite(path, deep, photometric="rgb")
    pictures = find_pictures(photos)
    for k, picture in enumerate(pictures):  # tifffile writes no EXIF
        from dataclasses import replace

        picture.exif = replace(picture.exif, seconds=2.0 ** STOPS[k % 3] / 60)
    found = find_brackets(pictures, "auto", photos)
    assert found is not None
    done = bracket_merge.merge_brackets(pictures, found, tmp_path / "w", "photos", lambda *_: None, lambda: False)
    known = radiance(0) < 7
    assert np.abs(decode(done.pictures[0]) / radiance(0) - 1)[known].max() < 2e-3


def test_a_run_that_goes_on_keeps_what_is_merged_and_says_it_again(tmp_path, caplog):
    photos, work = tmp_path / "photos", tmp_path / "work"
    shoot(photos, 3)
    Image.fromarray(expose(radiance(7) / 8)).save(photos / "01_1.png", exif=tags(1 / 480, second=21))
    pictures = find_pictures(photos)
    found = find_brackets(pictures, "auto", photos)
    assert found is not None
    answers = iter([False, False, True])
    with pytest.raises(Cancelled):
        bracket_merge.merge_brackets(pictures, found, work, "p", lambda *_: None, lambda: next(answers))
    before = (work / "00_0.exr").stat().st_mtime_ns
    assert not caplog.messages
    done = merged(photos, tmp_path)
    assert (work / "00_0.exr").stat().st_mtime_ns == before and len(done.pictures) == 3
    told, notes = caplog.messages, [picture.notes for picture in done.pictures]
    caplog.clear()
    again = merged(photos, tmp_path)
    assert caplog.messages == told and [picture.notes for picture in again.pictures] == notes and told


def test_merging_can_be_cancelled_and_goes_before_long_work(tmp_path):
    photos = tmp_path / "photos"
    shoot(photos, 3)
    pictures = find_pictures(photos)
    with pytest.raises(Cancelled):
        bracket_merge.merge_brackets(
            pictures, find_brackets(pictures, "auto", photos), tmp_path / "w", "p", lambda *_: None, lambda: True
        )
    # Three views are too few: told after the merge, by the names of the merged.
    with pytest.raises(AssetError, match=r"has 3 usable pictures \(00_0.exr, 01_0.exr, 02_0.exr\)"):
        pipeline.make_capture(
            photos, tmp_path / "out", pipeline.Settings(poses="features"), lambda *_: None, lambda: False
        )


def test_a_bracketed_set_becomes_a_capture_that_reconstruct_reads(tmp_path, monkeypatch, caplog):
    """The whole command but for structure from motion, whose cameras are made up."""
    from test_capture_registration import registration, ring

    from drgs_blender.reconstruct.readers import read_capture
    from drgs_blender.reconstruct.readers.lens import Lens

    photos, out = tmp_path / "photos", tmp_path / "out"
    shoot(photos, 6, left_out=((2, 2),))

    def register(database, folder, models, photos, *_):
        cameras = dict(zip([photo.file for photo in photos], ring(len(photos)).values(), strict=True))
        found = registration(cameras, np.zeros((0, 3)))
        found.lenses = dict.fromkeys(cameras, Lens(*SIZE, 45.0, 45.0, 24.0, 18.0))
        return found

    monkeypatch.setattr(pipeline, "register", register)
    monkeypatch.setattr(pipeline.features, "extract", lambda *_: None)
    monkeypatch.setattr(pipeline.features, "match", lambda *_: None)
    settings = pipeline.Settings(poses="features", masks="auto")
    made = pipeline.make_capture(photos, out, settings, lambda *_: None, lambda: False)
    assert "up: how the cameras were held (guessed); ground: what the cameras look at (guessed)" in made.lines
    assert any(line.startswith("brackets: 6 merged, of 3 exposures") for line in made.lines)
    assert (
        "No masks are made" in caplog.text
        and "up and the height of the ground are" in caplog.text
        and "02_0.png + 02_1.png" in caplog.text
    )
    report = json.loads((out / "capture.json").read_text())
    assert report["brackets"]["01_0"] == ["01_0.png", "01_1.png", "01_2.png"] and report["left_out"] == {}
    assert set(report["guessed"]) == {"scale", "up", "ground"}
    assert "merged from 2 exposures (02_0.png, 02_1.png)" in report["notes"]["02_0.exr"]
    frames = json.loads((out / "transforms.json").read_text())["frames"]
    assert len({frame["exposure_value"] for frame in frames}) == 1 and frames[0]["file_path"] == "images/00_0.exr"
    caplog.clear()
    capture = read_capture(out)
    assert len(capture.views) == 6 and "without knowing scale" in caplog.text
    wanted = linear_to_srgb(np.clip(radiance(0), 0, 1))
    np.testing.assert_allclose(capture.views[0].colour, wanted, atol=0.015)
    assert pipeline.make_capture(photos, out, settings, lambda *_: None, lambda: False).kept
    none = pipeline.Settings(poses="features", brackets="none")
    made = pipeline.make_capture(photos, out, none, lambda *_: None, lambda: False)
    assert not made.kept and made.of == made.pictures + len(made.left_out) == 17
    assert {path.suffix for path in (out / "images").iterdir()} == {".png"}


def test_merged_pictures_are_no_brackets_to_the_inspection(tmp_path):
    photos = tmp_path / "photos"
    shoot(photos, 6)
    pictures: list[Picture] = merged(photos, tmp_path).pictures
    ready = prepare(pictures, tmp_path / "prepared", 48, False, lambda *_: None, lambda: False)
    fit, left_out = inspect(ready.pictures, ready.looks, "photos")
    assert len(fit) == 6 and not left_out


def test_no_linear_value_is_negative(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    pixels = np.full((8, 12, 3), -0.5, np.float32)
    write_exr_picture(photos / "a.exr", pixels)
    linear, weight = bracket_merge._linear_and_weight(decode(Picture(photos / "a.exr", "a")))
    assert (linear == 0).all() and (weight > 0).all()


def test_a_curve_of_the_camera_is_named_and_no_other_view(tmp_path, caplog):
    photos = tmp_path / "photos"
    photos.mkdir()
    for view in range(2):
        for k, stop in enumerate(STOPS):
            z = linear_to_srgb(np.clip(larger(radiance(view)) * 2.0**stop, 0, 1))
            image = Image.fromarray(np.asarray((3 * z**2 - 2 * z**3) * 255 + 0.5, np.uint8))
            image.save(photos / f"{view}{k}.jpg", exif=tags(2.0**stop / 60, second=20 * view + k), quality=92)
    assert all(len(picture.merged) == 3 for picture in merged(photos, tmp_path).pictures)
    assert "2 brackets differ otherwise in brightness than EXIF says" in caplog.text


@pytest.mark.parametrize("setting", ["auto", "3"])
@pytest.mark.parametrize("gone", [((0, 0),), ((0, 0), (0, 1)), ((2, 1),)])
def test_missing_files_shift_no_bracket_whose_files_say_when_they_were_taken(tmp_path, setting, gone):
    photos = tmp_path / "photos"
    shoot(photos, 5, left_out=gone)
    found = found_in(photos, setting)
    assert found is not None and found.size == 3
    assert all(len({picture.path.name[:2] for picture in group.pictures}) == 1 for group in found.groups)
    assert len(found.groups) == 5 and len(found.complete) == 4


@pytest.mark.parametrize("setting", ["auto", "3"])
def test_one_exposure_that_is_another_tears_no_bracket(tmp_path, setting):
    photos = tmp_path / "photos"
    shoot(photos, 4)
    image = Image.fromarray(expose(radiance(1) * 2.0**-1.5))
    image.save(photos / "01_1.png", exif=tags(2.0**-1.5 / 60, second=21))
    found = found_in(photos, setting)
    assert found is not None and [len(group.pictures) for group in found.groups] == [3] * 4


def test_views_whose_exposure_drifts_are_brackets_of_their_own(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    for view in range(5):
        for k, stop in enumerate(STOPS):
            image = Image.fromarray(expose(radiance(view) * 2.0 ** (stop + 0.5 * view)))
            taken = tags(2.0 ** (stop + 0.5 * view) / 240, second=4 * view + (k > 1))
            image.save(photos / f"{view}{k}.png", exif=taken)
    found = found_in(photos)
    assert found is not None and [len(group.pictures) for group in found.groups] == [3] * 5


def test_exposures_far_apart_without_brackets_bring_a_hint(tmp_path, caplog):
    photos = tmp_path / "photos"
    photos.mkdir()
    for k in range(4):
        image = Image.fromarray(expose(radiance(k)))
        image.save(photos / f"{k}.png", exif=tags(2.0 ** -(3 * (k % 2)) / 60, second=60 * k))
    assert found_in(photos) is None
    assert (
        "exposures differ by 3.0 stops, and no brackets are recognised" in caplog.text and "--brackets n" in caplog.text
    )
