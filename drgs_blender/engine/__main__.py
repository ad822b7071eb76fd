"""``python -m drgs_blender.engine``: the engine, on pipes; started by the extension, not by hand."""

from ..core.loading import many_imports

if __name__ == "__main__":
    with many_imports():
        from .server import main

    main()
