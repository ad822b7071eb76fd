"""What protocols share: pictures of an asset under lights, the truth beside them, and scores of both."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from ...core.asset import Asset
from ...core.errors import AssetError, UsageError, first_of
from ...core.frame import Camera
from ...formats.registry import read_environment
from ...reconstruct.capture.capture import View
from ...reconstruct.readers.layout import Layout, Photograph
from ...reconstruct.readers.photograph_loading import load_photograph
from ..metrics import on_white, psnr, ssim, straight

Array = np.ndarray
logger = logging.getLogger(__name__)

#: (camera, radiance of the light (h, w, 3), factors on the albedo) -> pass name -> (h, w, c):
#: `compare.COMPARED_PASSES`, on a transparent film.
Renderer = Callable[[Camera, Array, tuple[float, float, float]], dict[str, Array]]
Item = TypeVar("Item")
Distance = Callable[[Array, Array], float]
#: Extensions of light files, in the order in which they are looked for.
LIGHTS = (".exr", ".hdr")


@dataclass(slots=True)
class Bench:
    """One asset, and how its pictures are scored.

    Attributes
    ----------
    asset : Asset
    render : callable
        See `Renderer`.
    resolution : int, optional
        Pixels of the longer side at most; None: those of the protocol.
    most_views : int, optional
        Of each part, evenly over all; None: all of the protocol.
    flip, lpips : callable, optional
        None where they are not computed.
    progress : callable
        Called with the name of the part and the pictures done there, and of how many.
    show : callable
        Called with the part, the number of the view, ours and the true picture, both encoded.
    """

    asset: Asset
    render: Renderer
    resolution: int | None = None
    most_views: int | None = None
    flip: Distance | None = None
    lpips: Distance | None = None
    progress: Callable[[str, int, int], None] = field(default=lambda part, done, of: None)
    show: Callable[[str, int, Array, Array], None] = field(default=lambda part, number, ours, true: None)

    def own_light(self) -> Array:
        """Radiance of the light that the asset was found in. Raises UsageError where it has none."""
        if self.asset.environment is None:
            raise UsageError("the asset", "has no light of its own", "Reconstruct it with materials")
        return self.asset.environment.radiance

    def chosen(self, items: Sequence[Item]) -> list[Item]:
        """The views that are rendered: at most `most_views`, evenly over all."""
        count = min(len(items), self.most_views or len(items))
        return [items[k * len(items) // count] for k in range(count)]

    def views(self, part: str, layout: Layout, photographs: Iterable[Photograph]) -> Iterator[tuple[int, View]]:
        """(number, view) of the photographs that are rendered, each read when it is needed.

        Raises
        ------
        AssetError
            One cannot be read, is of one colour all over, or of another size than the first.
        """
        known: dict = {}
        chosen = self.chosen(list(photographs))
        size: tuple[int, int] | None = None
        for number, photograph in enumerate(chosen):
            self.progress(part, number, len(chosen))
            view = load_photograph(photograph, layout, self.resolution, known)
            if view is None:
                raise AssetError(str(photograph.image), "is of one colour all over", "Download it again")
            found = view.camera.width, view.camera.height
            if found != (size := size or found):
                problem = f"is {found[0]} x {found[1]} pixels, others of the set are {size[0]} x {size[1]}"
                raise AssetError(str(photograph.image), problem, "Download it again")
            yield number, view
        self.progress(part, len(chosen), len(chosen))

    def warn_of_known(self, views: Iterable[str], subject: str) -> None:
        """Warn where the asset was learned from views by which it is measured, or in another world than the set's."""
        learned = self.asset.provenance.get("learned_from")
        if known := [name for name in views if isinstance(learned, list) and name in learned]:
            logger.warning(
                "%s: the asset was learned from %d of the views by which it is measured (%s): their figures are too "
                "good. Let --protocol reconstruct it", subject, len(known), first_of(known),
            )  # fmt: skip
        settings = self.asset.provenance.get("settings")
        reading = settings.get("capture") if isinstance(settings, dict) else None
        for name, usual in (("axes", "opengl"), ("up", None)):
            if isinstance(reading, dict) and reading.get(name, usual) != usual:
                logger.warning(
                    "%s: the asset was reconstructed with --%s %s: its world is not that of the set, whose cameras see "
                    "it from elsewhere", subject, name, reading[name],
                )  # fmt: skip

    def scores(self, ours: Array, true: Array, border: bool = False) -> dict[str, float | None]:
        """PSNR, SSIM, FLIP and LPIPS of two (h, w, 3) encoded pictures; `border`: SSIM of the outermost pixels too."""
        return {
            "psnr": psnr(ours, true),
            "ssim": ssim(ours, true, border),
            "flip": None if self.flip is None else self.flip(ours, true),
            "lpips": None if self.lpips is None else self.lpips(ours, true),
        }


def shown_on_white(passes: dict[str, Array]) -> Array:
    """(h, w, 3) encoded picture on white, as the published sets are."""
    return on_white(*straight(passes))


def eight_bits(picture: Array) -> Array:
    """Values in [0, 1] as a PNG keeps them."""
    return np.round(np.clip(picture, 0, 1) * 255) / 255


def split_counts(layout: Layout) -> dict[str, int]:
    """How many views of a capture are for training, and how many are left out."""
    left_out = sum(photograph.test for photograph in layout.photographs)
    return {"training views": len(layout.photographs) - left_out, "views left out": left_out}


def mean_of(rows: Sequence[Mapping[str, float | None]]) -> dict[str, float | None]:
    """Mean of each figure over the rows; None where one has none."""
    found: dict[str, float | None] = {}
    for name in rows[0] if rows else ():
        values = [row.get(name) for row in rows]
        numbers = [value for value in values if value is not None and np.isfinite(value)]
        found[name] = float(np.mean(numbers)) if len(numbers) == len(values) else None
    return found


def find_light(folders: Iterable[Path], name: str) -> Path:
    """The file of the light `name`: that name alone or with more behind an underscore, in the first folder with one.

    Raises
    ------
    AssetError
        There is none, or several in one folder.
    """
    looked = list(folders)
    for folder in looked:
        files = sorted(folder.glob("*")) if folder.is_dir() else []
        named = [file for file in files if file.suffix.lower() in LIGHTS]
        found = [file for file in named if file.stem.lower() == name] or [
            file for file in named if file.stem.lower().startswith(f"{name}_")
        ]
        if len(found) > 1:
            problem = f"holds {len(found)} files for the light {name}: {first_of([file.name for file in found])}"
            raise AssetError(str(folder), problem, "Leave one of them there")
        if found:
            return found[0]
    problem = f"is not there: no {name}.exr or {name}.hdr in {first_of([str(folder) for folder in looked])}"
    raise AssetError(f"light {name}", problem, "Name the folder of the lights by --lights-from")


def read_light(path: Path) -> Array:
    """(h, w, 3) float32 radiance, Blender's mapping, nothing negative."""
    return np.maximum(read_environment(path).radiance, 0)


def existing(folder: Path, subject: str) -> Path:
    """The folder; AssetError where it is not there or empty."""
    if not folder.is_dir():
        raise AssetError(str(folder), f"is not there: {subject}", "Check the folder of the set")
    if not any(folder.iterdir()):
        raise AssetError(str(folder), f"is empty: {subject}", "Unpack the set again")
    return folder
