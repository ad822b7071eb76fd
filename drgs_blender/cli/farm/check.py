"""Checks a scene before it is sent to a farm: what it would miss on a node."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ...core.errors import AssetError, DrgsError
from ..blender_process import BlenderProcess
from ..find_blender import Blender

#: Stands for many files: the tiles of an image.
_TILES = re.compile(r"<(UDIM|UVTILE)>")


@dataclass(slots=True)
class Report:
    """Findings of a check.

    Attributes
    ----------
    faults : list of str
        Requirements that a node lacks.
    notes : list of str
        Differences on a node, certain or possible.
    files : list of Path
        Existing files that the scene refers to.
    error : DrgsError, optional
        The first fault that DR-GS itself met.
    """

    faults: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    error: DrgsError | None = None

    def raise_fault(self, scene: Path) -> None:
        """Raise the error that says a node would fail, if it would."""
        if self.error is not None:
            raise self.error
        if self.faults:
            raise AssetError(str(scene), "needs what a node would miss, named above", "Correct it, or use --no-check")


def check_scene(
    scene: Path, frames: Sequence[int], blender: Blender, shared: Sequence[Path] = (), scripts: bool = False
) -> Report:
    """Open the scene as a node would, evaluate its first and last frame, and look at every file it names.

    Parameters
    ----------
    scene : Path
        .blend file.
    frames : sequence of int
    blender : Blender
    shared : sequence of Path
        Folders that every node sees under the same path; files outside of them are faults when there are any.
    scripts : bool
        Let the file run its own Python scripts.
    """
    report = Report()
    warnings: dict[str, None] = {}
    job = {
        "scene": str(scene), "frames": sorted({frames[0], frames[-1]}), "scripts": scripts,
        "passes": None, "report": True,
    }  # fmt: skip
    try:
        with BlenderProcess(blender, job, str) as process:
            try:
                for evaluated in process.frames():
                    warnings.update(dict.fromkeys(evaluated.warnings))
            finally:
                about = process.report
                _check_files(report, about.get("files", []), shared)
                report.notes += about.get("notes", [])
    except DrgsError as error:
        report.error = error
        report.faults.append(str(error))
    report.notes += warnings
    if shared and not _below(scene, shared):
        report.faults.append(f"{scene}: is not in a shared folder")
    return report


def _check_files(report: Report, files: Sequence[Sequence[str]], shared: Sequence[Path]) -> None:
    """Look at (path as stored, path on this machine) of every file."""
    for stored, found in files:
        path = Path(found)
        there = any(path.parent.glob(_TILES.sub("*", path.name))) if _TILES.search(path.name) else path.exists()
        if not there:
            report.faults.append(f"{stored}: does not exist")
            continue
        report.files.append(path)
        if shared and not _below(path, shared):
            report.faults.append(f"{stored}: is not in a shared folder")
        elif not shared and not stored.startswith("//"):
            report.notes.append(f"{stored}: is an absolute path, which a node must have as well")


def _below(path: Path, folders: Sequence[Path]) -> bool:
    real = path.resolve()
    return any(real.is_relative_to(folder.resolve()) for folder in folders)
