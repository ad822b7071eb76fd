"""The extension's preferences: reading and writing them. `panels.preferences` declares and draws them."""

from __future__ import annotations

from typing import Any

import bpy

#: Root package of the extension, the key of its preferences.
ROOT = __package__.rpartition(".")[0]


def read(name: str, default: Any) -> Any:
    """One preference; `default` where the extension runs without stored preferences (a test, a bare script)."""
    addon = bpy.context.preferences.addons.get(ROOT)
    return getattr(addon.preferences, name, default) if addon and addon.preferences else default


def write(name: str, value: Any) -> bool:
    """Set one preference; return whether there are any."""
    addon = bpy.context.preferences.addons.get(ROOT)
    if addon is None or addon.preferences is None:
        return False
    setattr(addon.preferences, name, value)
    return True
