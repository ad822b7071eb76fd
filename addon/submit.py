"""Jobs for farm managers: what the artist sets, and the one run of ``drgs submit`` under way, followed by a timer."""

from __future__ import annotations

import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import IO

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty, StringProperty

from ..drgs_blender.core.errors import DeviceError, UsageError
from ..drgs_blender.ipc.child_process import clean_environment
from . import blend_paths, engine_link, messages, output_check

INTERVAL = 0.2
MANAGERS = (
    ("openjd", "OpenJD", "A job bundle of the Open Job Description, for Deadline Cloud and other schedulers"),
    ("slurm", "Slurm", "An array job"),
    ("flamenco", "Flamenco", "A job and its job type for a Flamenco Manager"),
)
#: What each of them is given, in the job's folder.
JOB_FILES = {"openjd": "template.json", "slurm": "submit.sh", "flamenco": "job.json"}


class DrgsSubmitSettings(bpy.types.PropertyGroup):
    """How frames are rendered on a farm; see `drgs submit`."""

    manager: EnumProperty(name="Manager", description="Who runs the job", items=MANAGERS, default="openjd")
    out: StringProperty(
        name="Frames",
        description="EXR files; #### becomes the frame's number, // is the folder of the .blend",
        default="//frames/####.exr",
        subtype="FILE_PATH",
        options=blend_paths.RELATIVE,
    )
    use_denoise: BoolProperty(
        name="Temporal Denoising",
        description="Let a second step take the noise out of finished frames, each with the help of its neighbours",
        default=False,
    )
    denoised: StringProperty(
        name="Denoised Frames",
        description="EXR files of the second step",
        default="//denoised/####.exr",
        subtype="FILE_PATH",
        options=blend_paths.RELATIVE,
    )
    chunk: IntProperty(
        name="Frames per Task", description="Frames that a node renders in one go", min=1, soft_max=100, default=5
    )
    folder: StringProperty(
        name="Job Folder",
        description="Where the job is written",
        default="//job",
        subtype="DIR_PATH",
        options=blend_paths.RELATIVE,
    )
    use_check: BoolProperty(
        name="Check Scene",
        description="First open the saved file as a node would, and name what a node would miss",
        default=True,
    )
    shared: StringProperty(
        name="Shared Folder",
        description="Folder that all nodes share under the same path; files outside are reported. Empty: not checked",
        subtype="DIR_PATH",
        options=blend_paths.RELATIVE,
    )
    program: StringProperty(
        name="Program", description="Command by which a node of the farm starts drgs", default="drgs"
    )
    options: StringProperty(
        name="Options", description="Further options of drgs render, such as --threads 8 --memory-mb 6000"
    )
    retries: IntProperty(
        name="Retries", description="How often a task is retried when the engine crashes", min=0, soft_max=10, default=3
    )
    sbatch: StringProperty(
        name="Options of sbatch", description="Separated by spaces, such as --partition=farm --cpus-per-task=8"
    )
    manager_url: StringProperty(
        name="Address", description="Address of the Flamenco Manager", default="http://localhost:8080"
    )


class Submission:
    """One run of ``drgs submit`` for the saved file of a scene.

    Attributes
    ----------
    text : present or last step
    notes : differences on a node
    command : command that submits the job, "" until it is written
    error : why there is no job, "" when there is none

    Raises
    ------
    DeviceError, UsageError
        There is no engine, or it cannot be started; the options cannot be divided into words.
    """

    def __init__(self, scene: bpy.types.Scene) -> None:
        settings = scene.drgs.submit
        self.text = "Checking the scene" if settings.use_check else "Writing the job"
        self.notes: list[str] = []
        self.command = self.error = ""
        engine = engine_link.command_line()
        python = engine[: engine.index("-m")]
        words = [*python, "-m", "drgs_blender.cli.main", "--no-progress", "submit", *arguments(scene)]
        self._python = python[0]
        self._program = f"drgs submit of {python[0]}"
        self._expected = output_check.ExpectedFiles(
            [Path(bpy.path.abspath(settings.folder)).absolute() / JOB_FILES[settings.manager]]
        )
        no_window = getattr(subprocess, "CREATE_NO_WINDOW", 0)  # Windows alone has it
        self._stdout, self._log = tempfile.TemporaryFile(), tempfile.TemporaryFile()  # noqa: SIM115 - until it has ended
        try:
            self._process = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=self._stdout,
                stderr=self._log,
                env=clean_environment(),
                creationflags=no_window,
            )
        except OSError as error:
            raise DeviceError(f"engine {python[0]}", f"cannot be started ({error})", engine_link.SET_UP) from error
        self.done = False

    def poll(self) -> bool:
        """Whether it has ended; reads what it said then."""
        if not self.done and self._process.poll() is not None:
            self._finish()
        return self.done

    def cancel(self) -> None:
        """End it."""
        if not self.done:
            self._process.terminate()
            try:
                self._process.wait(5)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._finish()
            self.error = ""
            self.text = "Cancelled"

    def _finish(self) -> None:
        lines, log = (self._read(stream) for stream in (self._stdout, self._log))
        marks = ("note ", "missing ")
        self.notes = [line.partition(" ")[2].strip() for line in lines if line.startswith(marks)]
        missing = self._expected.missing()
        if self._process.returncode == 0 and (missing or len(lines) < 2):
            self.text = "No job was written"
            problem = output_check.complaint(self._program, missing) if missing else f"{self._program} named no command"
            self.error = f"{problem}. {output_check.REMEDY}."
        elif self._process.returncode == 0:
            self.text, self.command = lines[-2].removesuffix(". Submit with"), lines[-1]
        else:
            last = log[-1] if log else f"ended with code {self._process.returncode} and no word"
            self.text, self.error = "No job was written", last.removeprefix("drgs: ")
            try:
                engine_link.check_installed(self._python, last)
            except DeviceError as error:
                self.error = str(error)
        self.done = True

    @staticmethod
    def _read(stream: IO[bytes]) -> list[str]:
        stream.seek(0)
        with stream:
            return stream.read().decode("utf-8", "replace").splitlines()


#: The last run of this session, finished or not.
job: Submission | None = None


def arguments(scene: bpy.types.Scene) -> list[str]:
    """Command line of ``drgs submit`` for the settings of `scene`.

    Raises
    ------
    UsageError
    """
    settings = scene.drgs.submit
    words = [settings.manager, bpy.data.filepath, f"--frames={frames(scene)}"]
    words += [f"--out={bpy.path.abspath(settings.out)}", f"--to={bpy.path.abspath(settings.folder)}"]
    words += [
        f"--chunk={settings.chunk}",
        f"--name={scene.name}",
        f"--drgs={settings.program}",
        f"--options={settings.options}",
    ]
    if settings.use_denoise:
        words.append(f"--denoised={bpy.path.abspath(settings.denoised)}")
    if settings.use_check:
        words.append(f"--blender={bpy.app.binary_path or sys.executable}")
        words += [f"--shared={bpy.path.abspath(settings.shared)}"] if settings.shared else []
    else:
        words.append("--no-check")
    if settings.manager == "slurm":
        try:
            words += [f"--retries={settings.retries}", *(f"--sbatch={word}" for word in shlex.split(settings.sbatch))]
        except ValueError as error:
            raise UsageError(
                "Options of sbatch", f"cannot be divided into words ({error})", "Close the quotes"
            ) from error
    elif settings.manager == "flamenco":
        words.append(f"--manager-url={settings.manager_url}")
    return words


def frames(scene: bpy.types.Scene) -> str:
    """The scene's range in the notation of ``drgs render``."""
    step = f"x{scene.frame_step}" if scene.frame_step > 1 else ""
    return f"{scene.frame_start}-{scene.frame_end}{step}"


def running() -> bool:
    """Whether a job is being written."""
    return job is not None and not job.done


def start(scene: bpy.types.Scene) -> Submission:
    """Begin; without a window wait until it has ended."""
    global job
    job = Submission(scene)
    if bpy.app.background:
        while not job.poll():
            time.sleep(0.02)
        _report(job)
    elif not bpy.app.timers.is_registered(follow):
        bpy.app.timers.register(follow, first_interval=INTERVAL, persistent=True)
    return job


def follow() -> float | None:
    """Look whether it has ended; called by Blender. Returns seconds to the next call."""
    if job is None:
        return None
    ended = job.poll()
    if ended:
        _report(job)
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "PROPERTIES":
                area.tag_redraw()
    return None if ended else INTERVAL


def _report(job: Submission) -> None:
    for note in job.notes:
        messages.note("WARNING", note)
    messages.note("ERROR" if job.error else "INFO", job.error or job.text)


def register() -> None:
    bpy.utils.register_class(DrgsSubmitSettings)


def unregister() -> None:
    global job
    if bpy.app.timers.is_registered(follow):
        bpy.app.timers.unregister(follow)
    if job is not None and not job.done:
        job.cancel()
    job = None
    bpy.utils.unregister_class(DrgsSubmitSettings)
