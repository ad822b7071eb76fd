"""Bakes and previews: export, simulation, display, in short timer steps, so that the interface stays responsive.

What runs is known to this module alone; nothing of it is stored in the .blend.
"""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import bpy
import numpy as np

from ...drgs_blender.core.errors import DrgsError, EngineError, UsageError
from ...drgs_blender.core.particle_cache import ParticleCache
from ...drgs_blender.core.sim_materials import MATERIALS
from .. import assets, cache_playback, messages, output_check
from ..export.export_cache import uid
from ..physics_settings import DrgsPhysicsSettings
from . import particle_display, scene_export
from .settings_export import Removed, check, describe, exclusive_folder, folder_of, subject_of
from .simulate_process import SimulateProcess, ending

#: Where a capture lies inside the cache.
INPUT = "drgs_input"
#: Steps of particles that a core makes in a second at best, by material model (bench/bench_simulate.py measures it);
#: models that need singular values, and the preview (XPBD).
_RATES, _SLOW, _QUICK = {"elastic": 1.2e7, "fluid": 1e7}, 2.7e6, 1.5e8
#: Seconds that the start takes, a frame besides, and a particle in it.
_START, _FRAME, _KEEP = 3.0, 0.02, 5e-7

#: What is being done, by the `uid` of its object.
running: dict[int, Job] = {}
#: Objects whose bake begins when those before it have ended, by `uid`.
waiting: set[int] = set()


class Job:
    """A run of the engine's program for one object.

    Parameters
    ----------
    inputs : folder for what is captured
    folder : of the cache
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

    def __init__(self, obj: bpy.types.Object, scene: bpy.types.Scene, inputs: Path, folder: Path, still: bool) -> None:
        self.key, self.subject = uid(obj), subject_of(obj)
        if self.key in running:
            raise UsageError(self.subject, "is being baked already", "Wait until it is done, or cancel it")
        check(obj)
        self.folder, self.cancelled = folder, False
        self._inputs = inputs
        self._threads = scene.render.threads if scene.render.threads_mode == "FIXED" else 0
        self._device = scene.drgs.device.lower() if obj.drgs.physics.solver == "mpm" else "cpu"
        self._capture = scene_export.export_scene(obj, scene, inputs, still=still)
        self._captured = 0.0
        self._process: SimulateProcess | None = None
        running[self.key] = self

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
        self.target()
        if self._process is None:
            until = time.monotonic() + seconds
            for part in self._capture:
                self._captured = part
                if time.monotonic() > until:
                    return False
            if ending():
                return False
            self._process = SimulateProcess(self._inputs, self.folder, self._threads, self._device)
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
        running.pop(self.key, None)

    def end_process(self) -> None:
        """End the engine's program if it runs."""
        if self._process is not None:
            self._process.end(self._saves)

    def target(self) -> bpy.types.Object:
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
        folder = exclusive_folder(obj)
        super().__init__(obj, scene, folder / INPUT, folder, still=False)
        physics = obj.drgs.physics
        self.first, self.frames, self.count = physics.frame_start, physics.frame_end - physics.frame_start + 1, 0
        self._playback: cache_playback.Playback | None = None
        self._begun = 0, time.monotonic()
        particle_display.hide(obj)

    def progress(self) -> tuple[float, str]:
        """The part that is done, and words for it."""
        if not self.count:
            return super().progress()
        text = f"Frame {min(self.count, self.frames)} of {self.frames}"
        fresh, spent = self.count - self._begun[0], time.monotonic() - self._begun[1]
        if fresh > 0 and self.count < self.frames:
            text += f", {clock(spent / fresh * (self.frames - self.count))} left"
        return min(1.0, self.count / self.frames), text

    def cancel(self) -> bool:
        """End before its time; whether the object plays frames. Another bake goes on from them."""
        self.close()
        with suppress(DrgsError):  # whatever it is, the next bake says it
            if self._process is not None and not self.count:
                self._read_frames(0.0)
            self._show(renew=True)  # what played them may be undone
            return self.count > 0
        return False

    def _read_frames(self, seconds: float) -> bool:
        if self.process.counts is None:
            return False  # until then the folder holds what was there before
        if self._playback is None:
            path = self._inputs / scene_export.MATRICES
            self._playback = cache_playback.Playback(self.folder, np.load(path) if path.exists() else None)
        before, self.count = self.count, self._playback.follow(seconds)
        if self.count == before:
            return False
        if not before or self.count < before:
            self._begun = self.count, time.monotonic()
        self._show(renew=not before)
        return True

    def _kept_results(self) -> str:
        return f"The first {self.count} frames can be played" if self.count else ""

    def _finish(self) -> None:
        self._show(renew=True)
        if self.count < self.frames:
            self._raise_missing(f"frames {self.first + self.count} to {self.first + self.frames - 1}")

    def _show(self, renew: bool) -> None:
        if not self.count or self._playback is None:
            return
        obj = self.target()
        if renew or cache_playback.modifier_of(obj) is None:
            cache_playback.attach(obj, self._playback.path, self.first)
        obj.update_tag(refresh={"DATA"})


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
            super().__init__(obj, scene, self._temporary / INPUT, self._temporary, still=True)
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
        particle_display.show(self.target(), cache.rest().points, self.counts)


@dataclass(frozen=True, slots=True)
class Cached:
    """Content of an object's particle cache.

    Attributes
    ----------
    frames : how many, from the first on
    expected : frames that a bake makes
    changed : settings are not those of the frames, so that a bake starts over
    """

    frames: int
    expected: int
    changed: bool


def cached(obj: bpy.types.Object, scene: bpy.types.Scene) -> Cached:
    """Content of the object's cache: baked frames, expected frames, changed settings.

    Raises
    ------
    DrgsError
        The folder is unknown or cannot be read.
    """
    folder, physics = folder_of(obj), obj.drgs.physics
    frames = ParticleCache(folder).frames()
    known = scene_export.stored(folder / INPUT)
    changed = False
    # Values that are animated are those of the first frame, so that only there a change of them shows.
    if frames and known is not None and (obj.animation_data is None or scene.frame_current == physics.frame_start):
        now = describe(obj, scene)
        changed = any(known.get(key) != now.get(key) for key in (set(now) | {"floor", "domain"}) - {"last"})
        before = [{k: v for k, v in row.items() if k not in ("mesh", "vertices")} for row in known.get("colliders", [])]
        changed |= before != scene_export.contacts(obj)
    return Cached(len(frames), physics.frame_end - physics.frame_start + 1, changed)


def free(obj: bpy.types.Object) -> None:
    """Remove all files of an object's cache, the folder if nothing else is in it, and what plays them.

    Raises
    ------
    DrgsError
        Naming the file that stays, or why the folder is unknown.
    """
    folder = folder_of(obj)
    while ending():
        time.sleep(0.02)
    ParticleCache(folder).clear()
    scene_export.clear(folder / INPUT)
    cache_playback.detach(obj)
    with suppress(OSError):
        (folder / cache_playback.FILE).unlink(missing_ok=True)
        os.rmdir(folder)


def chosen(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Objects to bake: the selected objects with physics, the active one last, or the one an editor is pinned to."""
    active = context.active_object
    if context.object != active:
        found = [context.object]
    else:
        found = [*(obj for obj in context.selected_objects if obj != active), active]
    return [obj for obj in found if assets.is_drgs(obj) and obj.drgs.physics.use]


def is_waiting(obj: bpy.types.Object | None) -> bool:
    """Whether the bake of an object begins when others have ended."""
    return obj is not None and uid(obj) in waiting


def of(obj: bpy.types.Object | None) -> Job | None:
    """The running job of an object."""
    return None if obj is None else running.get(uid(obj))


def object_of(key: int) -> bpy.types.Object | None:
    """The object that has this `uid`."""
    return next((obj for obj in bpy.data.objects if obj.session_uid == key), None)


def estimate(physics: DrgsPhysicsSettings, counts: tuple[int, int], cores: int) -> float:
    """Seconds that a bake takes at least, from particles and time steps a frame."""
    particles, steps = counts
    rate = max(_RATES.get(MATERIALS[part.material].model, _SLOW) for part in (physics, *physics.regions))
    if physics.solver != "mpm":
        rate = _QUICK
    frame = _FRAME + _KEEP * particles + particles * steps / (rate * max(1, cores) ** 0.85)
    return _START + (physics.frame_end - physics.frame_start) * frame


def clock(seconds: float) -> str:
    """A duration in words."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


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
