"""Slurm: an array job that gives frames back when the engine died, and an array that denoises afterwards."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

from ...core.asset.archive import replace_file
from ...core.errors import EXIT_CANNOT_WRITE, EXIT_RETRY, UsageError
from .job import Job

#: How often a chunk is queued again that ended with code 75 (an engine died), or 73 (a disk was full) after a pause.
RETRIES = 3

_FRAMES, _THREADS = "--frames=$frames", "--threads=${SLURM_CPUS_ON_NODE:-0}"

_SCRIPT = """\
#!/bin/bash
# Written by `drgs submit slurm`.
{directives}
chunks=({chunks})
frames=${{chunks[SLURM_ARRAY_TASK_ID]}}
attempt=${{SLURM_RESTART_COUNT:-0}}
echo "drgs: frames $frames, attempt $((attempt + 1)), node ${{SLURMD_NODENAME:-unknown}}"
{command}
code=$?
if ((code == {full} && attempt < {retries})); then
  echo "drgs: frames $frames wait for room on the disk"
  sleep "${{DRGS_PAUSE:-60}}"
fi
if ((code == {again} || code == {full})); then
  if ((attempt >= {retries})); then
    echo "drgs: frames $frames are given up after $((attempt + 1)) attempts"
    exit 1
  fi
  # Slurm ends this script here. Where users may not requeue, RequeueExit={again} of slurm.conf does it.
  # SLURM_JOB_ID of the last task is that of the whole array.
  scontrol requeue "${{SLURM_ARRAY_JOB_ID}}_$SLURM_ARRAY_TASK_ID" && sleep 60
  exit {again}
fi
exit $code
"""

_SUBMIT = """\
#!/bin/sh
# Submits the job; further options go to sbatch.
set -e
job=$(sbatch --parsable "$@" {render})
echo "render: job $job"
"""

_THEN = """\
job=$(sbatch --parsable --dependency="afterok:${{job%%;*}}" --kill-on-invalid-dep=yes "$@" {denoise})
echo "denoise: job $job"
"""


def write_job(job: Job, folder: Path, retries: int = RETRIES, directives: tuple[str, ...] = ()) -> str:
    """Write ``render.sbatch``, ``denoise.sbatch`` where that is wanted, and ``submit.sh``.

    Parameters
    ----------
    job : Job
    folder : Path
        On a disk that every node sees; the logs go there as well.
    retries : int
        How often a chunk is queued again after exit code 75 or 73.
    directives : tuple of str
        Further options of sbatch, such as ``--partition=farm``.

    Returns
    -------
    str
        The shell command that submits the job.

    Raises
    ------
    UsageError
        An option or the folder has a line break, after which the script would run what follows; or the folder has a
        backslash, which Slurm takes for the end of all patterns in the name of a log.
    WriteError
    """
    for text in (*directives, str(folder)):
        if len(text.splitlines()) > 1:
            raise UsageError(repr(text), "has a line break, at which an option of Slurm ends", "Leave it out")
    if "\\" in folder.as_posix():
        problem, remedy = "has a backslash, and Slurm would write no log into it", "Choose another folder"
        raise UsageError(f"folder {folder}", problem, remedy)
    (folder / "logs").mkdir(parents=True, exist_ok=True)
    steps = {"render": job.render("$frames")}
    if job.clean:
        steps["denoise"] = job.denoise("$frames")
    for name, command in steps.items():
        text = _SCRIPT.format(
            directives="\n".join(f"#SBATCH {line}" for line in _directives(job, name, folder, directives)),
            chunks=" ".join(shlex.quote(chunk) for chunk in job.chunks),
            command=_shell(command),
            again=EXIT_RETRY,
            full=EXIT_CANNOT_WRITE,
            retries=retries,
        )
        replace_file(folder / f"{name}.sbatch", [text.encode(errors="surrogateescape")])
    scripts = {name: shlex.quote(str(folder / f"{name}.sbatch")) for name in steps}
    submit = _SUBMIT.format(**scripts) + (_THEN.format(**scripts) if job.clean else "")
    replace_file(folder / "submit.sh", [submit.encode(errors="surrogateescape")])
    return f"sh {shlex.quote(str(folder / 'submit.sh'))}"


def _directives(job: Job, step: str, folder: Path, more: tuple[str, ...]) -> list[str]:
    """Options of sbatch, those of the user last: they win."""
    name = re.sub(r"[^\w.-]+", "_", f"{job.name}-{step}")
    # A percent sign begins a pattern of Slurm's own, a quotation mark ends the name.
    logs = (folder / "logs").as_posix().replace("%", "%%").replace('"', r"\"")
    return [
        f"--job-name={name}",
        f"--array=0-{len(job.chunks) - 1}",
        "--requeue",
        "--open-mode=append",
        f'--output="{logs}/{step}-%A_%a.log"',
        *more,
    ]


def _shell(words: list[str]) -> str:
    """A command line in which the variables of the script, and nothing else, are expanded."""
    if not any(word.startswith("--threads") for word in words):
        words = [*words, _THREADS]
    return " ".join(f'"{word}"' if word in (_FRAMES, _THREADS) else shlex.quote(word) for word in words)
