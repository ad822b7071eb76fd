"""The extension inside Blender: settings, panels, the render engine, and the way to the engine process."""

from __future__ import annotations

from . import (
    background_render,
    bakes,
    engine_link,
    handlers,
    panels,
    physics,
    physics_settings,
    presets,
    properties,
    reconstruction,
    render_engine,
    setup_job,
    submit,
    viewport,
)

#: In order of registration; undone in reverse.
MODULES = (
    physics_settings,
    submit,
    properties,
    presets,
    engine_link,
    setup_job,
    reconstruction,
    bakes,
    handlers,
    physics,
    background_render,
    viewport,
    render_engine,
    panels,
)


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
