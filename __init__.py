"""DR-GS for Blender: captured objects that are animated and relit. The root package of the extension.

Nothing of Blender is imported before `register`, so this folder can be collected by pytest and type checkers.
"""


def register() -> None:
    """Called by Blender when the extension is enabled."""
    from . import addon, operators

    addon.register()
    try:
        operators.register()
    except Exception:
        addon.unregister()
        raise


def unregister() -> None:
    """Called by Blender when the extension is disabled, and at exit."""
    from . import addon, operators

    operators.unregister()
    addon.unregister()
