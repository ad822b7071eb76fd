"""Bakes and previews: export, simulation, display, in short timer steps, so that the interface stays responsive.

What runs is known to this module alone; nothing of it is stored in the .blend.
"""

from __future__ import annotations

import atexit
import shutil
import tempfile
import time
from collections.abc import Generator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import bpy
import numpy as np

from ...drgs_blender.core.errors import DrgsError, EngineError, UsageError
from ...drgs_blender.core.particle_cache import ParticleCache
from .. import assets, cache_playback, messages, output_check
from ..export.export_cache import uid
from . import bake_time, coupling, particle_display, scene_export
from .settings_export import INPUT, Removed, adopt, claim, exclusive_folder, subject_of
from .simulate_process import SimulateProcess, ending

#: What is being done, by the `uid` of its object.
running: dict[int, Job] = {}
#: Objects whose bake begins when those before it have ended, by `uid`.
waiting: set[int] = set()


@dataclass(slots=True)
class Member:
    """An object of a job: `uid`, names, folders of cache and capture, and how many frames can be played."""

    key: int
    name: str
    subject: str
    folder: Path
    inputs: Path
    playback: cache_playback.Playback | None = None
    count: int = 0

    def object(self) -> bpy.types.Object:
        """The object; undo makes new ones, so none is kept.

        Raises
        ------
        Removed
            There is none any more.
        """
        found = object_of(self.key)
        if found is None:
            raise Removed(self.subject, "was removed while it was simulated", "Undo or redo, and bake again")
        return found

    def read_frames(self, seconds: float) -> None:
        """Read new frames for about `seconds`."""
        if self.playback is None:
            path = self.inputs / scene_export.MATRICES
            self.playback = cache_playback.Playback(self.folder, np.load(path) if path.exists() else None)
        self.count = self.playback.follow(seconds)

    def show(self, first: int, renew: bool) -> None:
        """Have the object play what there is."""
        if not self.count or self.playback is None:
            return
        obj = self.object()
        if renew or cache_playback.modifier_of(obj) is None:
            cache_playback.attach(obj, self.playback.path, first)
        obj.update_tag(refresh={"DATA"})


class Job:
    """A run of the engine's program for an object, or for several that push each other.

    Parameters
    ----------
    objects : the one that is asked for and those that are baked with it
    folders : of their caches
    still : only the first frame counts

    Attributes
    ----------
    cancelled : asked to end before its time

    Raises
    ------
    UsageError
        The object cannot be simulated as it is, or already is.
    """

    #: Whether the program needs time at its end to keep what it has done.
    _saves = True

    def __init__(
        self, objects: list[bpy.types.Object], scene: bpy.types.Scene, folders: list[Path], *, still: bool
    ) -> None:
        self.members = [
            Member(uid(obj), obj.name, subject_of(obj), folder, folder / INPUT) for obj, folder in zip(objects, folders)
        ]
        for member in self.members:
            if member.key in running:
                raise UsageError(member.subject, "is being baked already", "Wait until it is done, or cancel it")
        coupling.check_together(objects)
        self.key, self.folder, self._inputs = self.members[0].key, self.members[0].folder, self.members[0].inputs
        alone = len(objects) == 1
        self.subject = subject_of(objects[0]) if alone else "Objects " + ", ".join(f'"{obj.name}"' for obj in objects)
        self.cancelled = False
        self._threads = scene.render.threads if scene.render.threads_mode == "FIXED" else 0
        self._device = scene.drgs.device.lower() if objects[0].drgs.physics.solver == "mpm" else "cpu"
        self._capture = self._captured_scene(scene, still)
        self._captured = 0.0
        self._process: SimulateProcess | None = None
        running.update((member.key, self) for member in self.members)

    def _captured_scene(self, scene: bpy.types.Scene, still: bool) -> Generator[float, None, None]:
        """Capture the bodies one after the other; yields the part that is done."""
        count = len(self.members)
        for i, member in enumerate(self.members):
            obj = member.object()
            bodies = [other.object() for other in self.members]
            coupled = coupling.describe(obj) if count > 1 else {}
            for part in scene_export.export_scene(
                obj, scene, member.inputs, still=still, coupled=coupled, bodies=bodies
            ):
                yield (i + part) / count
            if self._saves:
                claim(member.folder, member.name)
        if count > 1:
            bodies_file = self._inputs / scene_export.BODIES
            named = [(member.name, member.inputs, member.folder) for member in self.members]
            coupling.write_bodies(bodies_file, named, self._device)

    @property
    def process(self) -> SimulateProcess:
        """The engine's program, once the scene is read."""
        assert self._process is not None, "the scene is still being read"
        return self._process

    @property
    def capturing(self) -> bool:
        """Whether the scene is still being read: it must not be edited meanwhile."""
        return self._process is None

    def step(self, seconds: float = float("inf")) -> bool:
        """Go on for about `seconds`; return whether all is done.

        Raises
        ------
        DrgsError
            Whatever went wrong; `close` it then.
        """
        for member in self.members:
            member.object()
        if self._process is None:
            until = time.monotonic() + seconds
            for part in self._capture:
                self._captured = part
                if time.monotonic() > until:
                    return False
            if ending():
                return False
            others = [member.inputs for member in self.members[1:]]
            self._process = SimulateProcess(self._inputs, self.folder, self._threads, self._device, others)
            return False
        alive = self._process.alive
        if self._read_frames(seconds) or alive:
            return False
        for line in self._process.result(self.subject, self._kept_results()):
            messages.note("WARNING", line)
        self._finish()
        return True

    def close(self) -> None:
        """End whatever runs. What is done stays."""
        self._capture.close()
        self.end_process()
        for member in self.members:
            running.pop(member.key, None)

    def end_process(self) -> None:
        """End the engine's program if it runs."""
        if self._process is not None:
            self._process.end(self._saves)

    def progress(self) -> tuple[float, str]:
        """The part that is done, and words for it."""
        if self._process is None:
            return 0.0, f"Reading the scene {self._captured:.0%}"
        counts = self._process.counts
        if counts is not None:
            return 0.0, f"{counts[0]:,} particles"
        part, text = self._process.preparation
        return (part, text) if part < 1.0 and text else (0.0, "Filling the body")

    def _read_frames(self, seconds: float) -> bool:
        """Read new results for about `seconds`; whether there were any."""
        return False

    def _kept_results(self) -> str:
        """Sentence about the results that remain after an early end."""
        return ""

    def _finish(self) -> None:
        """The program has done its job."""

    def _raise_missing(self, what: str) -> NoReturn:
        """Raise the error of a program that reported success without writing its output."""
        missing = [Path(f"{what} in {self.folder}")]
        held = f". {self._kept_results()}" if self._kept_results() else ""
        raise EngineError(self.subject, output_check.complaint(self.process.name, missing), output_check.REMEDY + held)


class Bake(Job):
    """Frames into the object's cache and its mesh.

    Attributes
    ----------
    frames : how many there will be
    count : how many can be played
    """

    def __init__(self, obj: bpy.types.Object, scene: bpy.types.Scene) -> None:
        objects = coupling.members(obj)
        super().__init__(objects, scene, [exclusive_folder(other) for other in objects], still=False)
        physics = obj.drgs.physics
        self.first, self.frames, self.count = physics.frame_start, physics.frame_end - physics.frame_start + 1, 0
        self._begun = 0, time.monotonic()
        for other, member in zip(objects, self.members):
            particle_display.hide(other)
            adopt(other, member.folder)

    def progress(self) -> tuple[float, str]:
        """The part that is done, and words for it."""
        if not self.count:
            return super().progress()
        text = f"Frame {min(self.count, self.frames)} of {self.frames}"
        fresh, spent = self.count - self._begun[0], time.monotonic() - self._begun[1]
        if fresh > 0 and self.count < self.frames:
            text += f", {bake_time.clock(spent / fresh * (self.frames - self.count))} left"
        return min(1.0, self.count / self.frames), text

    def cancel(self) -> bool:
        """End before its time; whether the object plays frames. Another bake goes on from them."""
        self.close()
        with suppress(DrgsError):  # whatever it is, the next bake says it
            if self._process is not None and not self.count:
                self._read_frames(0.0)
            self._show()  # what played them may be undone
            return self.count > 0
        return False

    def _read_frames(self, seconds: float) -> bool:
        if self.process.counts is None:
            return False  # until then the folder holds what was there before
        before, counts = self.count, [member.count for member in self.members]
        for member in self.members:
            member.read_frames(seconds / len(self.members))
        self.count = min(member.count for member in self.members)
        if counts == [member.count for member in self.members]:
            return False
        if self.count and (not before or self.count < before):
            self._begun = self.count, time.monotonic()
        for member, count in zip(self.members, counts):
            member.show(self.first, renew=not count)
        return True

    def _kept_results(self) -> str:
        return f"The first {self.count} frames can be played" if self.count else ""

    def _finish(self) -> None:
        self._show()
        if self.count < self.frames:
            self._raise_missing(f"frames {self.first + self.count} to {self.first + self.frames - 1}")

    def _show(self) -> None:
        for member in self.members:
            member.show(self.first, renew=True)


class Preview(Job):
    """The particles that the object is filled with, as points in viewports.

    Attributes
    ----------
    counts : particles, time steps a frame at least; known in the end
    """

    _saves = False

    def __init__(self, obj: bpy.types.Object, scene: bpy.types.Scene) -> None:
        self._temporary = Path(tempfile.mkdtemp(prefix="drgs-fill-"))
        self.counts = (0, 0)
        try:
            super().__init__([obj], scene, [self._temporary], still=True)
        except DrgsError:
            shutil.rmtree(self._temporary, ignore_errors=True)
            raise

    def close(self) -> None:
        """End whatever runs."""
        super().close()
        shutil.rmtree(self._temporary, ignore_errors=True)

    def _finish(self) -> None:
        cache = ParticleCache(self.folder)
        counts = self.process.counts
        if counts is None or cache.header() is None:
            self._raise_missing("the particles")
        self.counts = counts
        particle_display.show(self.members[0].object(), cache.rest().points, self.counts)


def chosen(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Objects to bake: the selected ones with physics, the active one last, or the one an editor is pinned to.

    Of those that are baked together, one.
    """
    active = context.active_object
    if context.object != active:
        found = [context.object]
    else:
        found = [*(obj for obj in context.selected_objects if obj != active), active]
    return coupling.apart(obj for obj in found if assets.is_drgs(obj) and obj.drgs.physics.use)


def is_waiting(obj: bpy.types.Object | None) -> bool:
    """Whether the bake of an object begins when others have ended."""
    return obj is not None and uid(obj) in waiting


def of(obj: bpy.types.Object | None) -> Job | None:
    """The running job of an object."""
    return None if obj is None else running.get(uid(obj))


def object_of(key: int) -> bpy.types.Object | None:
    """The object that has this `uid`."""
    return next((obj for obj in bpy.data.objects if obj.session_uid == key), None)


def end_all() -> None:
    """End everything that runs."""
    waiting.clear()
    for job in list(running.values()):
        job.close()


def _end_processes() -> None:
    """Blender closes: what it has in memory may be gone already, but the programs must not go on."""
    for job in running.values():
        job.end_process()


@bpy.app.handlers.persistent
def _before_loading(*_: object) -> None:
    """Another file is about to be loaded."""
    end_all()


def register() -> None:
    bpy.app.handlers.load_pre.append(_before_loading)
    atexit.register(_end_processes)


def unregister() -> None:
    bpy.app.handlers.load_pre.remove(_before_loading)
    atexit.unregister(_end_processes)
    end_all()
