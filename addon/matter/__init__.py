"""Simulated matter: what an object is made of, the engine's bake of it, and the frames that its mesh plays.

`properties` is what the artist sets; `describe` and `capture` turn it, and the scene around, into files for the
engine; `program` is the engine's process; `playback` lets the mesh follow its frames, `points` shows particles; `work`
is all of that in order, in small steps.
"""

from __future__ import annotations

from . import points, properties, work

#: In order of registration; undone in reverse.
MODULES = (properties, points, work)


def register() -> None:
    for module in MODULES:
        module.register()


def unregister() -> None:
    for module in reversed(MODULES):
        module.unregister()
