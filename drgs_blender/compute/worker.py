"""A process that compiles kernels into the cache: each request is a line of JSON, answered by ``done``.

It ends with its standard input, so with the process that started it, also in the middle of a kernel.
"""

from __future__ import annotations

import gc
import json
import logging
import os
import queue
import signal
import sys
import threading

signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl+C in the terminal is for the program that waits

from . import jit, manifest  # noqa: E402, F401  (jit sets Numba up)
from .manifest import Kernel  # noqa: E402

log = logging.getLogger(__name__)


def main() -> None:
    """Compile until the input ends."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what anything else prints is no answer
    gc.disable()  # a search through all of the compiler's objects takes longer than it gives back
    lines: queue.SimpleQueue[str] = queue.SimpleQueue()

    def listen() -> None:
        for line in sys.stdin:
            lines.put(line)
        os._exit(0)

    threading.Thread(target=listen, daemon=True).start()
    while True:
        module, name, arguments = json.loads(lines.get())
        kernel = Kernel(module, name, arguments, 0.0)
        try:
            manifest.dispatcher(kernel).compile(manifest.signature(kernel))
        except Exception as error:  # of a list that does not fit any more; the first call says what is wrong
            log.warning("kernel %s is not compiled ahead: %s: %s", name, type(error).__name__, error)
        answers.write("done\n")
        answers.flush()


if __name__ == "__main__":
    main()
