"""The reconstruction under way, as panels show it. The operator that runs it keeps it up to date; nothing is stored."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import bpy.utils.previews

_LINE = re.compile(r'DRGS_PROGRESS part=([\d.]+) surfels=(\d+) (?:psnr=(-?[\d.]+) )?phase="([^"]*)"')


class Reconstruction:
    """Progress of a run of ``drgs reconstruct``.

    Parameters
    ----------
    out : the asset that it makes

    Attributes
    ----------
    part : fraction that is done, 0..1
    text : in which phase it is, and how good
    cancelled : asked to end before its time
    """

    def __init__(self, out: Path) -> None:
        self.out, self.part, self.text, self.cancelled = out, 0.0, "Reading the photographs", False
        self._shown = 0

    def follow(self, output: str) -> None:
        """Update the progress from all output of the program so far."""
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


#: The one under way.
job: Reconstruction | None = None
#: Blender's collection of preview pictures; there while registered.
_previews: Any = None


def register() -> None:
    global _previews
    _previews = bpy.utils.previews.new()


def unregister() -> None:
    global job, _previews
    job = None
    bpy.utils.previews.remove(_previews)
    _previews = None
