"""The extension inside Blender: settings, panels, the render engine, and the way to the engine process."""

from __future__ import annotations

from . import engine_link, handlers, panels, preferences, properties, render_engine

#: In order of registration; undone in reverse.
MODULES = (preferences, properties, engine_link, handlers, render_engine, panels)


def register() -> None:
    """Register everything, or nothing when one part fails."""
    done = []
    try:
        for module in MODULES:
            module.register()
            done.append(module)
    except Exception:
        for module in reversed(done):
            module.unregister()
        raise


def unregister() -> None:
    """Undo `register`."""
    for module in reversed(MODULES):
        module.unregister()
