"""Simulation of DR-GS objects: the files that the engine's process gets, that process, and what becomes of its frames.

`settings_export` and `scene_export` turn `physics_settings` and the scene into files, `simulate_process` runs the
engine on them, `particle_display` shows particles in viewports; `bake_job` does all of that in order, in small steps.
The mesh plays the frames by `cache_playback`.
"""

from __future__ import annotations

from . import bake_job, particle_display

#: In order of registration; undone in reverse.
MODULES = (particle_display, bake_job)


def register() -> None:
    for module in MODULES:
        module.register()


def unregister() -> None:
    for module in reversed(MODULES):
        module.unregister()
