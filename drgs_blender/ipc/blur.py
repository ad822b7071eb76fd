"""Motion blur and depth of field as the mean of many pictures: the share of each, and the mean.

The extension says from where each is seen.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from ..core.frame import Camera, Frame, RenderSettings
from ..core.passes import BY_NAME, COLOURS, with_colours, without_colour
from .messages import Passes

Array = np.ndarray

#: Passes that are not blurred: what they say of a surface has no mean.
SHARP = frozenset(
    name
    for name, p in BY_NAME.items()
    if (p.kind != "COLOR" or p.exact or name == "Albedo") and name not in ("Variance", "Mist")
)


def camera_on_lens(camera: Camera, lens: tuple[float, float], distance: float) -> Camera:
    """`camera` from another place of its lens, metres to the right and up; what is at `distance` stays in its pixel."""
    x, y = lens
    pose = np.array(camera.matrix_world)
    aside = x * pose[:3, 0] + y * pose[:3, 1]
    pose[:3, 3] += aside
    if camera.orthographic:
        pose[:3, 2] += aside / distance
        return replace(camera, matrix_world=pose)
    cx, cy = camera.cx + camera.fx * x / distance, camera.cy - camera.fy * y / distance
    return replace(camera, matrix_world=pose, cx=cx, cy=cy)


def sharp_frame(frame: Frame) -> Frame | None:
    """The picture with those passes of a blurred one that stay sharp; None where none is wanted."""
    names = tuple(name for name in frame.passes if name in SHARP)
    if not names:
        return None
    cheap = replace(frame.settings, samples=3, strategy_samples=None, bounces=0, denoise="none", noise_threshold=0.0)
    return replace(frame, passes=names, settings=cheap)


def sample_frame(frame: Frame, count: int, index: int) -> Frame:
    """One of the `count` pictures that are averaged, of a frame at its time and place on the lens."""
    names = tuple(name for name in frame.passes if name not in SHARP)
    return replace(
        frame,
        passes=with_colours(names),
        settings=sample_settings(frame.settings, count, index),
        previous=None,
        next=None,
        history="",
    )


def sample_settings(settings: RenderSettings, count: int, index: int) -> RenderSettings:
    """The settings of one of `count` pictures: its part of the samples, with noise of its own."""
    given = settings.strategy_samples
    return replace(
        settings,
        samples=-(-settings.samples // count),
        strategy_samples=given and (-(-given[0] // count), -(-given[1] // count), -(-given[2] // count)),
        subpixel_samples=-(-settings.subpixel_samples // count),
        noise_threshold=0.0,
        seed=(settings.seed + 0x9E3779B1 * index) % 2**31,
    )


class Mean:
    """The mean of pictures as they come.

    Light is averaged with the surfaces' colour, of which the mean is then taken out.

    Attributes
    ----------
    count : int
        Pictures so far, without the sharp one.
    """

    def __init__(self) -> None:
        self.count = 0
        self._sums: dict[str, Array] = {}
        self._kept: dict[str, Array] = {}
        self._statistics: dict[str, float] = {}
        self._warnings: list[str] = []

    def add(self, part: Passes) -> None:
        """Take one picture in, or the one that stays sharp."""
        self.count += any(name not in SHARP for name in part)
        for name, values in part.items():
            if name in SHARP:
                self._kept[name] = values
                continue
            if name in COLOURS:
                values = values * part[COLOURS[name]]
            sums = self._sums
            sums[name] = values.astype(np.float64) if name not in sums else sums[name] + values
        self._warnings += [text for text in part.warnings if text not in self._warnings]
        known = self._statistics
        for name, value in part.statistics.items():
            added = name.startswith("seconds.") or name == "samples"
            known[name] = known.get(name, 0.0) + value if added else value

    def passes(self, names: tuple[str, ...]) -> Passes:
        """The passes `names` of all so far; seconds and samples are added up."""
        # The pictures' noise is independent.
        n = self.count
        means = {name: total / (n**2 if name == "Variance" else n) for name, total in self._sums.items()}
        means |= {name: without_colour(means[name], means[colour]) for name, colour in COLOURS.items() if name in means}
        made = self._kept | {name: mean.astype(np.float32) for name, mean in means.items()}
        found = {name: made[name] for name in names if name in made}
        return Passes(found, list(self._warnings), dict(self._statistics))


def averaged(parts: Iterable[Passes], names: tuple[str, ...]) -> Passes:
    """The passes `names` of the sharp picture and those that are averaged, see `Mean`."""
    mean = Mean()
    for part in parts:
        mean.add(part)
    return mean.passes(names)
