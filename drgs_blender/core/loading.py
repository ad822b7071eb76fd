"""Importing many modules at once."""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Iterator


@contextlib.contextmanager
def many_imports() -> Iterator[None]:
    """Collect no garbage while modules are loaded, and freeze what is there at the end.

    Modules stay, and to look for garbage among them takes a tenth of the time of loading them. After `gc.freeze`
    nothing that exists at the end of the block is looked at again: cycles among it are never freed, in the whole
    process, until `gc.unfreeze`.
    """
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if collects:
            gc.enable()
