"""Run DR-GS in Blender's own Python, with the packages that the extension brings.

A program, started by its path:

    python -I -Xutf8 .../drgs_blender/cli/bundled.py SITE_PACKAGES -m drgs_blender.engine [arguments]
    python -I -Xutf8 .../drgs_blender/cli/bundled.py SITE_PACKAGES -c "code" [arguments]

``-I`` keeps the user's packages and settings out, and with them the folders of the extension: these are added here,
last, so that what Blender's Python has, NumPy among it, is found first. ``-Xutf8``: on Windows pipes have the code page
of the user else, and Blender reads UTF-8.
"""

import runpy
import sys
import traceback
from pathlib import Path


def main() -> None:
    """Find the packages, then do what Python would do with the rest of the command line."""
    site, kind, what, *arguments = sys.argv[1:]
    sys.path += [site, str(Path(__file__).resolve().parents[2])]
    from drgs_blender.core import own_python

    own_python.bundled = [sys.executable, "-I", "-Xutf8", __file__, site]
    sys.argv = [kind, *arguments]
    try:
        if kind == "-m":
            runpy.run_module(what, run_name="__main__", alter_sys=True)
        else:
            exec(compile(what, "<string>", "exec"), {"__name__": "__main__"})
    except ImportError as error:
        traceback.print_exc()
        sys.exit(f"A package that came with the extension is broken: {error}")


if __name__ == "__main__":
    main()
