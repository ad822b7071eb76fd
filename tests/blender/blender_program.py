"""`blender` for tests: a program that takes Blender's arguments, where Blender is the Python module.

Known are ``-b``, ``--python-exit-code N``, ``--python FILE``, the name of a .blend, and what comes after ``--``. The
extension is installed in the user folder, and enabled, as in the preferences of someone who uses it.
"""

from __future__ import annotations

import os
import runpy
import sys
import traceback

import bpy

PACKAGE = "bl_ext.user_default.drgs"


def main(words: list[str]) -> int:
    """Run the arguments in their order; the return value is the exit code."""
    bpy.ops.preferences.addon_enable(module=PACKAGE)
    failed, code = 0, 0
    words = words[: words.index("--")] if "--" in words else words
    while words:
        word = words.pop(0)
        if word == "--python-exit-code":
            failed = int(words.pop(0))
        elif word == "--python":
            try:
                runpy.run_path(words.pop(0), run_name="__main__")
            except SystemExit as end:
                code = code or int(end.code or 0)
            except Exception:
                traceback.print_exc()
                code = code or failed
        elif word != "-b":
            bpy.ops.wm.open_mainfile(filepath=os.path.abspath(word))
    bpy.ops.preferences.addon_disable(module=PACKAGE)
    return code


if __name__ == "__main__":
    code = main(sys.argv[1:])
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # Blender 4.2 as a module crashes when Python tidies up after it
