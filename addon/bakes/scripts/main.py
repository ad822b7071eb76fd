"""Runs inside the Blender that bakes: does the jobs that come as lines of JSON on standard input, one after another.

Started as a plain script; of the package `node_trees` and `core/system` alone are imported, by their path. What Blender
prints goes to standard error; answers are lines of JSON on the original standard output: of the job's key, and an error
or none. The process ends with its parent, whose end of standard input is closed then.
"""

from __future__ import annotations

import json
import os
import queue
import runpy
import sys
import threading
import traceback
from pathlib import Path

_FOLDER = Path(__file__).resolve().parent
_SYSTEM = _FOLDER.parents[2] / "drgs_blender" / "core" / "system.py"
sys.path[:0] = [str(_FOLDER), str(_FOLDER.parent)]


def main() -> None:
    sys.stdout.flush()
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    jobs: queue.Queue[str] = queue.Queue()
    threading.Thread(target=listen, args=(runpy.run_path(str(_SYSTEM))["claim_input"](), jobs), daemon=True).start()

    import bpy

    import addon_utils  # isort: skip  # the module bpy must be there first to find it

    bpy.ops.wm.read_factory_settings(use_empty=True)
    addon_utils.enable("cycles")
    import baked_surface
    import baked_world

    kinds = {"world": baked_world.bake, "surface": baked_surface.bake}
    while True:
        job = json.loads(jobs.get())
        error = ""
        try:
            bpy.ops.wm.read_factory_settings(use_empty=True)
            kinds[job["kind"]](job)
        except Exception as failure:
            traceback.print_exc()
            error = f"{type(failure).__name__}: {failure}"
        print(json.dumps({"key": job["key"], "error": error}), file=answers, flush=True)


def listen(pipe: int, jobs: queue.Queue[str]) -> None:
    """Take in jobs, also while one is done; end with the parent."""
    with open(pipe, encoding="utf-8") as lines:
        for line in lines:
            jobs.put(line)
    os._exit(0)


try:
    main()
except BaseException:
    traceback.print_exc()
    sys.stderr.flush()
    os._exit(70)
