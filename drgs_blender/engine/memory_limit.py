"""The memory limit of an engine, on machines that many programs share."""

from __future__ import annotations

import logging
import os
import sys

logger = logging.getLogger(__name__)

#: Environment variable with the most megabytes, for engines that the extension starts; `OPTION` wins.
VARIABLE = "DRGS_MEMORY_MB"
OPTION = "--memory-mb"
#: Megabytes of 16 TiB; what is beyond is mistyped.
_MOST = 1 << 24


def requested_limit(arguments: list[str]) -> int | None:
    """Megabytes that the command line or the environment allow; None for no limit. What makes no sense is warned of."""
    text = arguments[arguments.index(OPTION) + 1] if OPTION in arguments[:-1] else os.environ.get(VARIABLE, "")
    if text.isdecimal() and int(text) <= _MOST:
        return int(text) or None
    if text:
        name = OPTION if OPTION in arguments[:-1] else VARIABLE
        logger.warning("%s is %s, which is no number of megabytes: the memory has no limit", name, text)
    return None


def limit_memory(megabytes: int) -> bool:
    """Let allocations of this process fail beyond `megabytes` of private memory, instead of the system killing it.

    Linux counts what is writable and private (``RLIMIT_DATA``, since 4.7): arrays, trees, stacks; not mapped assets.
    Returns False on other systems, which have no such limit.
    """
    if not sys.platform.startswith("linux"):
        logger.warning("there is no limit of memory on this system")
        return False
    import resource

    limit = megabytes << 20
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (limit if hard < 0 else min(limit, hard), hard))
    return True
