"""Open Job Description: a bundle that openjd-cli, Deadline Cloud and other schedulers run as it is."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ...core.asset.archive import replace_file
from ...core.errors import UsageError
from ..frame_range import write_frames
from .job import Job

#: Names in the template of what a node may have elsewhere.
_SCENE, _OUT, _CLEAN = "SceneFile", "OutputFolder", "DenoisedFolder"
#: Where the Blender and the engine of a session wait for chunks.
_SESSION = "{{Session.WorkingDirectory}}/drgs"


def write_bundle(job: Job, folder: Path, seconds: int = 0, files: Iterable[Path] = ()) -> str:
    """Write ``template.json``, ``parameter_values.json`` and ``asset_references.json``.

    Parameters
    ----------
    job : Job
    folder : Path
        Of the bundle.
    seconds : int
        How long a chunk should take, for schedulers that adapt its size; 0 leaves it at ``job.chunk`` frames.
    files : iterable of Path
        Files that the scene needs, for schedulers that copy them to the nodes.

    Returns
    -------
    str
        The shell command that runs the bundle in a local session.

    Raises
    ------
    UsageError
        Something has ``{{`` in it, with which templates are filled in.
    WriteError
    """
    values = {_SCENE: str(job.scene), _OUT: str(Path(job.out).parent)}
    if job.clean:
        values[_CLEAN] = str(Path(job.clean).parent)
    for text in (job.name, *job.program, *job.options, Path(job.out).name, Path(job.clean or "").name):
        if "{{" in text:
            raise UsageError(repr(text), "has {{ in it, which means something else in a template", "Rename it")
    references = {
        "inputs": {"filenames": [str(job.scene), *map(str, files)], "directories": []},
        "outputs": {"directories": [str(path) for path in job.outputs]},
        "referencedPaths": [],
    }
    folder.mkdir(parents=True, exist_ok=True)
    parameters = [{"name": name, "value": value} for name, value in values.items()]
    for name, content in (
        ("template", template(job, seconds)),
        ("parameter_values", {"parameterValues": parameters}),
        ("asset_references", {"assetReferences": references}),
    ):
        replace_file(folder / f"{name}.json", [json.dumps(content, indent=2).encode()])
    words = ["openjd", "run", str(folder / "template.json"), "--step", "Denoise" if job.clean else "Render"]
    words += ["--run-dependencies"] if job.clean else []
    for name, value in values.items():
        words += ["-p", f"{name}={value}"]
    return shlex.join(words)


def template(job: Job, seconds: int = 0) -> dict[str, Any]:
    """The job template (specification 2023-09 with TASK_CHUNKING)."""
    out = f"{{{{Param.{_OUT}}}}}/{Path(job.out).name}"
    frames = "{{Task.Param.Frame}}"
    steps = [_step("Render", seconds, job.render(frames, f"{{{{Param.{_SCENE}}}}}", out))]
    if job.clean:
        clean = f"{{{{Param.{_CLEAN}}}}}/{Path(job.clean).name}"
        steps.append(_step("Denoise", seconds, job.denoise(frames, out, clean, "{{Param.Sequence}}")))
        steps[1]["dependencies"] = [{"dependsOn": "Render"}]
    every = write_frames(sorted(job.frames))  # its ranges may not overlap
    parameters = [
        _path(_SCENE, "FILE", "IN", "Blender file; what it refers to lies beside it"),
        _path(_OUT, "DIRECTORY", "OUT", "Folder of the rendered frames"),
        {"name": "Frames", "type": "STRING", "default": every, "description": "Frames: 1-24, 1-24:2,30"},
        {"name": "ChunkSize", "type": "INT", "default": job.chunk, "minValue": 1, "description": "Frames a task"},
    ]
    if job.clean:
        parameters.append(_path(_CLEAN, "DIRECTORY", "OUT", "Folder of the denoised frames"))
        about = "All frames of the shot, the neighbours of Frames, which may be a part of them"
        parameters.append({"name": "Sequence", "type": "STRING", "default": every, "description": about})
    return {
        "specificationVersion": "jobtemplate-2023-09",
        "extensions": ["TASK_CHUNKING"],
        "name": job.name,
        "parameterDefinitions": parameters,
        "jobEnvironments": [_checked_node(job), _warm_engine(job)],
        "steps": steps,
    }


def _path(name: str, kind: str, flow: str, about: str) -> dict[str, Any]:
    """A parameter that a scheduler maps to where the file is on the node."""
    return {"name": name, "type": "PATH", "objectType": kind, "dataFlow": flow, "description": about}


def _step(name: str, seconds: int, command: list[str]) -> dict[str, Any]:
    """A step that runs `command` for chunks of frames in the warm process of the session."""
    # Chunks that must be contiguous would be single frames wherever a range has steps.
    chunks: dict[str, Any] = {"defaultTaskCount": "{{Param.ChunkSize}}", "rangeConstraint": "NONCONTIGUOUS"}
    if seconds:
        chunks["targetRuntimeSeconds"] = seconds
    frame = {"name": "Frame", "type": "CHUNK[INT]", "range": "{{Param.Frames}}", "chunks": chunks}
    return {
        "name": name,
        "parameterSpace": {"taskParameterDefinitions": [frame]},
        "script": {"actions": {"onRun": _action([*command, "--openjd", f"--session={_SESSION}"])}},
    }


def _checked_node(job: Job) -> dict[str, Any]:
    """An environment that cannot be entered where DR-GS cannot render."""
    return {
        "name": "CheckedNode",
        "description": "Ends the session where DR-GS cannot render",
        "script": {"actions": {"onEnter": _action([*job.program, "doctor", "--node"])}},
    }


def _warm_engine(job: Job) -> dict[str, Any]:
    """An environment in which Blender, with the scene, and the engine stay from chunk to chunk."""
    start, stop = (_action([*job.program, "session", verb, _SESSION]) for verb in ("start", "stop"))
    return {
        "name": "WarmEngine",
        "description": "Chunks of a session share one Blender and one engine",
        "script": {"actions": {"onEnter": start, "onExit": stop}},
    }


def _action(command: list[str]) -> dict[str, Any]:
    """Run a command; it is asked to end before it is killed."""
    return {
        "command": command[0],
        "args": command[1:],
        "cancelation": {"mode": "NOTIFY_THEN_TERMINATE", "notifyPeriodInSeconds": 15},
    }
