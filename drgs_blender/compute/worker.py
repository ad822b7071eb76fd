"""A process that compiles kernels into the cache: each request is a line of JSON.

The answer is ``done``, or ``failed:`` and why nothing can be kept, which is the end of all compiling ahead. The process
ends with its standard input, so with the one that started it, also in the middle of a kernel.
"""

from __future__ import annotations

import gc
import json
import logging
import os
import queue
import signal
import threading

signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl+C in the terminal is for the program that waits

from ..core.system import claim_input  # noqa: E402
from . import folders, jit, manifest  # noqa: E402, F401  (jit sets Numba up)
from .manifest import Kernel  # noqa: E402

log = logging.getLogger(__name__)


def main() -> None:
    """Compile until the input ends."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    requests = os.fdopen(claim_input(), encoding="utf-8")
    os.dup2(2, 1)  # what anything else prints is no answer
    logging.getLogger(folders.__name__).setLevel(logging.ERROR)  # what it warns of is the answer
    gc.disable()  # a search through all of the compiler's objects takes longer than it gives back
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()

    def listen() -> None:
        for line in requests:
            lines.put(line)
        os._exit(0)

    threading.Thread(target=listen, daemon=True).start()
    while True:
        module, name, arguments = json.loads(lines.get())
        kernel = Kernel(module, name, arguments, 0.0)
        if not folders.cache_folder().trouble:
            _compile(kernel)
        if trouble := folders.cache_folder().trouble:
            folders.leave_temporary()
            answers.write(f"failed: {' '.join(trouble.splitlines())}\n")
        else:
            answers.write("done\n")
        answers.flush()


def _compile(kernel: Kernel) -> None:
    try:
        manifest.dispatcher(kernel).compile(manifest.signature(kernel))
    except Exception as error:  # of a list that does not fit any more; the first call says what is wrong
        log.warning("kernel %s is not compiled ahead: %s: %s", kernel.name, type(error).__name__, error)


if __name__ == "__main__":
    main()
