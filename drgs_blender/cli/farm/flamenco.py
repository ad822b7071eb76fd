"""Flamenco: a job type for the Manager's folder of scripts, and a job of that type."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path

from ...core.asset.archive import replace_file
from ...core.errors import UsageError
from .job import Job

#: The job type, as the Manager calls it: the script's name without its suffix, dashes for underscores.
JOB_TYPE = "drgs-render"
SCRIPT = Path(__file__).with_name("drgs_render.js")
_PLATFORMS = {"linux": "linux", "darwin": "darwin", "win32": "windows"}


def write_job(job: Job, folder: Path, manager: str) -> str:
    """Write the job type ``drgs_render.js`` and the job ``job.json``.

    Parameters
    ----------
    job : Job
    folder : Path
    manager : str
        Address of the Flamenco Manager.

    Returns
    -------
    str
        The shell command that submits the job.

    Raises
    ------
    UsageError
        Flamenco cannot express it: frames below 0, an option with a blank, a program (Managers name it).
    WriteError
    """
    if min(job.frames) < 0:
        raise UsageError(f"--frames {job.range}", "has negative frames, which Flamenco does not know", "Leave them out")
    if blank := next((option for option in job.options if len(option.split()) != 1), None):
        raise UsageError(f"option {blank!r}", "has a blank in it, at which the job type divides", "Avoid it")
    settings = {
        "blendfile": str(job.scene),
        "frames": _frames(job.frames),
        "chunk_size": job.chunk,
        "render_output_path": job.out,
        "denoised_output_path": job.clean or "",
        "options": " ".join(job.options),
    }
    described = {
        "name": job.name,
        "type": JOB_TYPE,
        "priority": 50,
        "submitter_platform": _PLATFORMS.get(sys.platform, "linux"),
        "settings": settings,
        "metadata": {"project": job.scene.parent.name},
    }
    folder.mkdir(parents=True, exist_ok=True)
    replace_file(folder / SCRIPT.name, [SCRIPT.read_bytes()])
    replace_file(folder / "job.json", [json.dumps(described, indent=2).encode()])
    header, data = "Content-Type: application/json", f"@{folder / 'job.json'}"
    return shlex.join(["curl", "-f", "-H", header, "--data-binary", data, f"{manager.rstrip('/')}/api/v3/jobs"])


def _frames(frames: list[int]) -> str:
    """Flamenco's own notation: ranges without steps, in rising order."""
    terms: list[list[int]] = []
    for frame in sorted(frames):
        if terms and terms[-1][1] == frame - 1:
            terms[-1][1] = frame
        else:
            terms.append([frame, frame])
    return ",".join(str(first) if first == last else f"{first}-{last}" for first, last in terms)
