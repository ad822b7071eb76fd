"""``python -m drgs_blender.engine``: the engine, on pipes; started by the extension, not by hand."""

from .server import main

if __name__ == "__main__":
    main()
