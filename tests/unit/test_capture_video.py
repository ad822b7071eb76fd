"""Frames of a video: sharp ones, evenly by motion; what is damaged is used as far as it goes."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image, ImageFilter

from drgs_blender.capture.video import Sample, _Path, _upright, choose, extract_frames
from drgs_blender.core.errors import AssetError


def tell(phase: str, part: float) -> None:
    assert 0 <= part <= 1


def test_of_each_window_the_sharpest_frame_is_taken():
    samples = [Sample(k, 1.0 + (k % 5 == 3), 1.0) for k in range(100)]
    chosen = choose(samples, 20)
    assert len(chosen) == 20 and sum(k % 5 == 3 for k in chosen) >= 18


def test_a_camera_that_rests_gives_few_frames():
    samples = [Sample(k, 1.0, 0.0 if k < 50 else 2.0) for k in range(100)]
    chosen = choose(samples, 20)
    assert sum(k < 50 for k in chosen) <= 4 and len(chosen) >= 18


def test_short_videos_are_used_whole():
    assert choose([Sample(k, 1.0, 1.0) for k in range(12)], 20) == list(range(12))


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """60 frames of a texture that moves; every third is sharp."""
    av = pytest.importorskip("av", reason="video needs PyAV")
    path = tmp_path_factory.mktemp("film") / "walk.mkv"
    random = np.random.default_rng(0)
    large = Image.fromarray(random.integers(0, 255, (60, 90, 3), np.uint8)).resize((360, 240), Image.Resampling.NEAREST)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 160, 120, "yuv420p", 4_000_000
        stream.gop_size = 1
        for k in range(60):
            picture = large.crop((2 * k, k, 2 * k + 160, k + 120))
            if k % 3:
                picture = picture.filter(ImageFilter.GaussianBlur(3))
            for packet in stream.encode(av.VideoFrame.from_ndarray(np.asarray(picture), format="rgb24")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


def encoded(path, pictures) -> None:
    """A video of (h, w, 3) uint8 pictures, of the quality of a phone's."""
    av = pytest.importorskip("av", reason="video needs PyAV")
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=30)
        stream.height, stream.width, stream.pix_fmt, stream.bit_rate = *pictures[0].shape[:2], "yuv420p", 2_000_000
        for picture in pictures:
            for packet in stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)


@pytest.mark.parametrize("slow", [0.125, 0.25])
def test_slow_parts_of_a_video_keep_their_frames(tmp_path, slow):
    """By less than half a pixel a frame, which whole pixels between neighbours never show, then by two."""
    random = np.random.default_rng(0)
    wide = Image.fromarray(random.integers(0, 255, (90, 260, 3), np.uint8)).resize(
        (2080, 720), Image.Resampling.BICUBIC
    )
    at = np.cumsum(np.r_[np.full(160, slow), np.full(20, 2.0)])
    sensor = random.normal(0, 3, (4, 80, 112, 3))
    pictures = []
    for k, x in enumerate(at):
        left = round(8 * x)
        small = wide.crop((left, 0, left + 8 * 112, 8 * 80)).resize((112, 80), Image.Resampling.BOX)
        pictures.append(np.clip(np.asarray(small) + sensor[k % 4], 0, 255).astype(np.uint8))
    encoded(tmp_path / "slow.mp4", pictures)
    paths = extract_frames(tmp_path / "slow.mp4", tmp_path / "frames", 30, tell, lambda: False)
    numbers = [int(path.stem.split("_")[1]) for path in paths]
    share = 0.8 * at[159] / at[-1] + 0.2 * 160 / 180  # of the path, and of the time
    assert sum(number < 160 for number in numbers) == pytest.approx(30 * share, abs=3)


def test_a_camera_that_rests_does_not_move_by_its_noise():
    random = np.random.default_rng(0)
    still = random.random((60, 80)).astype(np.float32)
    path = _Path()
    assert sum(path.moved_on(still + random.normal(0, 0.03, still.shape).astype(np.float32)) for _ in range(50)) == 0


def test_sharp_frames_of_a_video_are_written(film, tmp_path):
    paths = extract_frames(film, tmp_path, 15, tell, lambda: False)
    numbers = [int(path.stem.split("_")[1]) for path in paths]
    assert 14 <= len(paths) <= 15 and sum(number % 3 == 0 for number in numbers) >= 12
    with Image.open(paths[0]) as image:
        assert image.size == (160, 120)


def test_of_a_truncated_video_the_frames_that_are_there_are_used(film, tmp_path, caplog):
    cut = tmp_path / "cut.mkv"
    data = film.read_bytes()
    cut.write_bytes(data[: len(data) // 2])
    paths = extract_frames(cut, tmp_path / "frames", 15, tell, lambda: False)
    assert len(paths) >= 10 and "cut.mkv" in caplog.text
    cut.write_bytes(data[:200])
    with pytest.raises(AssetError):
        extract_frames(cut, tmp_path / "frames", 15, tell, lambda: False)


def test_what_is_no_video_is_refused(tmp_path):
    pytest.importorskip("av", reason="video needs PyAV")
    (tmp_path / "a.mp4").write_bytes(b"no video" * 100)
    with pytest.raises(AssetError, match="is no video"):
        extract_frames(tmp_path / "a.mp4", tmp_path / "frames", 15, tell, lambda: False)


@pytest.mark.parametrize(("rotation", "turns"), [(0, 0), (90, 1), (-90, 3), (180, 2), (-180, 2)])
def test_frames_are_turned_as_their_metadata_say(rotation, turns):
    class Frame:
        def to_ndarray(self, format):
            return np.arange(24, dtype=np.uint8).reshape(2, 4, 3)

    frame = Frame()
    frame.rotation = rotation  # degrees counter-clockwise, as FFmpeg's display matrix has them
    np.testing.assert_array_equal(_upright(frame), np.rot90(frame.to_ndarray("rgb24"), turns))
