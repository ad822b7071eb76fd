"""Frames of a video: the sharpest of each window, evenly by motion (decoded by FFmpeg through PyAV)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as Pillow
from scipy.ndimage import laplace

from ..core.arrays import Array
from ..core.errors import AssetError, Cancelled
from ..formats.images import write_image
from . import libraries

logger = logging.getLogger(__name__)

#: Frames of a video, at least and at most, and by default.
FRAMES = (10, 400)
DEFAULT_FRAMES = 90
#: Pixels of the longer side at which frames are compared, and of the grid of motion.
_SIZE = 320
#: Pixels that a picture has moved by when the frames after it are no longer held against it: enough that whole pixels
#: say how far, few enough that it still looks alike.
_STEP = 4.0
#: JPEG quality of the frames that are kept.
_QUALITY = 97


@dataclass(slots=True)
class Sample:
    """One decoded frame: its number, how sharp it is, by how much the picture moved on from the frames before."""

    number: int
    sharpness: float
    motion: float


def extract_frames(
    video: Path, folder: Path, count: int, tell: Callable[[str, float], None], cancelled: Callable[[], bool]
) -> list[Path]:
    """Write the chosen frames of a video as JPEG files, upright; the files in the order of time.

    The video is decoded twice: once small, to choose, once to write.

    Raises
    ------
    AssetError
        The file holds no video, or fewer than ten frames can be decoded.
    DeviceError
        PyAV is not installed.
    Cancelled
        `cancelled` said so.
    """
    samples, broken = [], ""
    moved = _Path()
    for number, total, frame, problem in _frames(video):
        broken = problem
        if frame is None:
            break
        if cancelled():
            raise Cancelled
        grey = _small(frame)
        samples.append(Sample(number, float(laplace(grey).var()), moved.moved_on(grey)))
        tell("looking at frames", 0.6 * number / max(total, number + 1))
    if len(samples) < FRAMES[0]:
        why = f" ({broken})" if broken else ""
        raise AssetError(str(video), f"has {len(samples)} frames that can be read{why}", "Record ten seconds or more")
    if broken:
        logger.warning("%s: is damaged after frame %d (%s); the frames before are used", video, len(samples), broken)
    chosen = choose(samples, count)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for number, _, frame, _ in _frames(video):
        if frame is None or number > chosen[-1]:
            break
        if cancelled():
            raise Cancelled
        if number in chosen:
            path = folder / f"frame_{number:06d}.jpg"
            shown = Pillow.fromarray(_upright(frame))
            write_image(path, shown, "JPEG", quality=_QUALITY, subsampling=0)
            paths.append(path)
            tell("writing frames", 0.6 + 0.4 * len(paths) / len(chosen))
    logger.info("%s: %d of %d frames are used", video, len(paths), len(samples))
    return paths


def _frames(video: Path) -> Iterator[tuple[int, int, Any, str]]:
    """(number, frames in all as the file says, frame, problem); the last one has no frame where decoding broke off."""
    av = libraries.load("av")
    try:
        container = av.open(str(video))
    except (OSError, ValueError) as error:  # FFmpegError is a subclass of either
        raise AssetError(str(video), f"is no video that can be read ({error})", "Convert it to MP4 (H.264)") from error
    with container:
        if not container.streams.video:
            raise AssetError(str(video), "has no pictures", "Choose a video")
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        rate = float(stream.average_rate or 30)
        total = stream.frames or int(float(container.duration or 0) / 1e6 * rate)
        number = 0
        try:
            for frame in container.decode(stream):
                yield number, total, frame, ""
                number += 1
        except av.FFmpegError as error:
            yield number, total, None, str(error)
            return
        if total and number < 0.9 * total:
            yield number, total, None, f"{number} of {total} frames are there"


def _small(frame: Any) -> Array:
    """(h, w) float32 luminance in 0..1, at most `_SIZE` on the longer side."""
    factor = min(1.0, _SIZE / max(frame.width, frame.height))
    width, height = (max(16, round(n * factor / 2) * 2) for n in (frame.width, frame.height))
    return frame.to_ndarray(width=width, height=height, format="gray").astype(np.float32) / 255


def _upright(frame: Any) -> Array:
    """(h, w, 3) uint8 sRGB, turned as the video's metadata say."""
    pixels = frame.to_ndarray(format="rgb24")
    # Degrees counter-clockwise by which the stored picture is shown.
    return np.ascontiguousarray(np.rot90(pixels, round(getattr(frame, "rotation", 0) / 90) % 4))


class _Path:
    """How far pictures moved, one after the other, in whole pixels that add up.

    Each is held against the same one before until it has moved by `_STEP` from there: of motion by less than a pixel a
    frame nothing is rounded away, and noise of a camera that rests adds up to nothing.
    """

    def __init__(self) -> None:
        self._from: Array | None = None
        self._away = 0.0

    def moved_on(self, picture: Array) -> float:
        """Pixels by which the picture is farther away than any since the one it is held against."""
        if self._from is None:
            self._from = picture
        away = shift(self._from, picture)
        motion = max(away - self._away, 0.0)
        self._away += motion
        if away >= _STEP:
            self._from, self._away = picture, 0.0
        return motion


def shift(before: Array, after: Array) -> float:
    """By how many pixels a picture moved on the whole, by phase correlation (Kuglin and Hines 1975); up to half of it.

    Examples
    --------
    >>> noise = np.random.default_rng(0).random((48, 64)).astype(np.float32)
    >>> round(shift(noise, np.roll(noise, (3, 4), (0, 1))))
    5
    """
    spectrum = np.fft.rfft2(after - after.mean()) * np.conj(np.fft.rfft2(before - before.mean()))
    peak = np.fft.irfft2(spectrum / np.maximum(np.abs(spectrum), 1e-9), after.shape)
    row, column = np.unravel_index(int(peak.argmax()), peak.shape)
    h, w = peak.shape
    return float(np.hypot(min(row, h - row), min(column, w - column)))


def choose(samples: list[Sample], count: int) -> list[int]:
    """Numbers of about `count` frames: the sharpest of each of as many windows along the path of the picture.

    Windows are equally long in motion, so that a camera that rests gives few frames; a fifth of each window is time, so
    that motion which is not seen still counts.
    """
    if len(samples) <= count:
        return [sample.number for sample in samples]
    motion = np.array([sample.motion for sample in samples])
    usual = float(np.median(motion[motion > 0])) if (motion > 0).any() else 0.0
    motion = np.minimum(motion, 10 * max(usual, 0.5))  # cuts and failures of the correlation
    path = np.cumsum(motion) / max(float(motion.sum()), 1e-9)
    time = np.arange(len(samples)) / (len(samples) - 1)
    window = np.minimum((0.8 * path + 0.2 * time) * count, count - 1e-6).astype(int)
    chosen = []
    for k in np.unique(window):
        members = np.flatnonzero(window == k)
        chosen.append(samples[max(members, key=lambda i: samples[i].sharpness)].number)
    return chosen
