"""``python -m drgs_blender.engine``: the engine, on pipes; started by the extension, not by hand."""

import gc

if __name__ == "__main__":
    gc.disable()  # until all modules are there, see `Server.serve`
    from .server import main

    main()
