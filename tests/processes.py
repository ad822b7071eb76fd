"""Other processes as tests see them: a process that ends while one looks is no error."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterable
from pathlib import Path

import psutil


def gone(pid: int) -> bool:
    """Whether a process has ended (a zombie that nobody collects has)."""
    try:
        return psutil.Process(pid).status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def all_gone(pids: Iterable[int], seconds: float) -> bool:
    """Whether processes end in time."""
    deadline, left = time.monotonic() + seconds, set(pids)
    while left and time.monotonic() < deadline:
        time.sleep(0.02)
        left = {pid for pid in left if not gone(pid)}
    return not left


def children(pid: int, recursive: bool = False) -> dict[int, str]:
    """Process id -> command line of all that `pid` started and that still runs."""
    found: dict[int, str] = {}
    with contextlib.suppress(psutil.NoSuchProcess):
        for child in psutil.Process(pid).children(recursive):
            with contextlib.suppress(psutil.NoSuchProcess):
                found[child.pid] = " ".join(child.cmdline())
    return found


def marked(*environment: str, command: str = "") -> list[int]:
    """Ids of other processes with all of `environment` (NAME=VALUE) and `command` in their command line (Linux)."""
    wanted, found = {text.encode() for text in environment}, []
    for place in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it ended just now
            line = (place / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            if command in line and wanted <= set((place / "environ").read_bytes().split(b"\0")):
                found.append(int(place.name))
    return [pid for pid in found if pid != os.getpid()]


def open_files(pid: int) -> list[str]:
    """What the open descriptors of a process name: paths, ``socket:[…]``, ``pipe:[…]`` (Linux)."""
    found = []
    for link in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(OSError):  # closed just now
            found.append(os.readlink(link))
    return found


def listening(pid: int) -> set[str]:
    """Sockets on which a process listens, whatever the family (Linux)."""
    own = {link[8:-1] for link in open_files(pid) if link.startswith("socket:[")}
    found = set()
    for table in ("tcp", "tcp6", "udp", "udp6"):
        lines = [line.split() for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]]
        found |= {fields[1] for fields in lines if fields[9] in own}
    lines = [line.split() for line in Path(f"/proc/{pid}/net/unix").read_text().splitlines()[1:]]
    return found | {fields[6] for fields in lines if fields[6] in own and fields[3] == "00010000"}
