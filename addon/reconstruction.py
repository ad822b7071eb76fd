"""The reconstruction under way, as panels show it. The operator that runs it keeps it up to date; nothing is stored."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import bpy.utils.previews

_LINE = re.compile(r'DRGS_PROGRESS part=([\d.]+) surfels=(\d+) (?:psnr=(-?[\d.]+) )?phase="([^"]*)"')


_CAPTURE = re.compile(r"^DRGS_CAPTURE (.+)$", re.MULTILINE)


class Reconstruction:
    """Progress of a run of ``drgs reconstruct``.

    Parameters
    ----------
    out : the asset that it makes
    capture : the photographs, or a video

    Attributes
    ----------
    capture : those photographs, or the folder in which their cameras were found
    part : fraction that is done, 0..1
    text : in which phase it is, and how good
    cancelled : asked to end before its time
    """

    def __init__(self, out: Path, capture: Path) -> None:
        self.capture = capture
        self.out, self.part, self.text, self.cancelled = out, 0.0, "Reading the photographs", False
        self._shown = 0

    def follow(self, output: str) -> None:
        """Update the progress from all output of the program so far."""
        if captured := _CAPTURE.findall(output):
            self.capture = Path(captured[-1])
        found = _LINE.findall(output)
        if found:
            part, surfels, psnr, phase = found[-1]
            self.part = float(part)
            self.text = f"{phase[:1].upper()}{phase[1:]}"
            if psnr:
                self.text += f", {float(psnr):.1f} dB"
            elif int(surfels):
                self.text += f", {int(surfels):,} surfels"

    def icon(self) -> int:
        """The newest preview, beside its photograph; 0 while there is none."""
        path = self.out.with_name(f"{self.out.stem}.preview.png")
        try:
            written = path.stat().st_mtime_ns
        except OSError:
            return 0
        if written != self._shown:
            _previews.clear()
            self._shown = written
            _previews.load(str(written), str(path), "IMAGE", True)
        return _previews[str(written)].icon_id


class Made:
    """What a finished run shows of how it went.

    Parameters
    ----------
    run : the run
    warnings : what it has warned of

    Attributes
    ----------
    out : the asset
    pictures : title -> file, of those that there are: masks on their photographs, cameras around the sparse points
    doubts : warnings about masks
    """

    def __init__(self, run: Reconstruction, warnings: Iterable[str]) -> None:
        self.out = run.out
        folder = run.capture if run.capture.is_dir() else run.capture.parent
        files = {"Masks": [run.out.with_name(f"{run.out.stem}.masks.png")], "Cameras": []}
        if (folder / "capture.json").is_file():  # of `drgs capture`
            files["Masks"].append(folder / "masks.png")
            files["Cameras"].append(folder / "capture.png")
        there = {title: next(filter(Path.is_file, paths), None) for title, paths in files.items()}
        self.pictures = {title: path for title, path in there.items() if path is not None}
        self.doubts = [text for text in warnings if re.search(r"\bmasks?\b", text)]


#: The one under way, and the last one of this session that has made its asset.
job: Reconstruction | None = None
made: Made | None = None
#: Blender's collection of preview pictures; there while registered.
_previews: Any = None


def register() -> None:
    global _previews
    _previews = bpy.utils.previews.new()


def unregister() -> None:
    global job, made, _previews
    job = made = None
    bpy.utils.previews.remove(_previews)
    _previews = None
