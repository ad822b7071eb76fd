"""What the measurements of farms share: how a node starts drgs, frames compared, what is left on the machine."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from report import ROOT

sys.path.append(str(ROOT / "tests"))
from processes import marked

from drgs_blender.render.film.frame_files import read_frame

#: In the environment of all that is started here, and of nothing else.
MARK = f"DRGS_MEASURED={os.getpid()}"
os.environ.update([MARK.split("=")])
#: How a node starts drgs: this checkout.
PROGRAM = f"env PYTHONPATH={ROOT} {sys.executable} -m drgs_blender.cli.main"


def drgs(*words: str) -> subprocess.CompletedProcess[str]:
    """Run a command of this checkout to its end."""
    done = subprocess.run([*PROGRAM.split(), *words], capture_output=True, text=True, timeout=900)
    if done.returncode:
        raise SystemExit(f"drgs {words[0]} ended with {done.returncode}: {done.stderr[-500:]}")
    return done


def frames_differ(first: Path, second: Path, count: int) -> int:
    """How many of frames 1 to `count` are not the same, bit for bit, in two folders; one that is missing differs."""
    wrong = 0
    for number in range(1, count + 1):
        paths = [folder / f"{number:04d}.exr" for folder in (first, second)]
        if not all(path.is_file() for path in paths):
            wrong += 1
            continue
        a, b = (read_frame(path)[0] for path in paths)
        same = a.keys() == b.keys() and all(np.array_equal(a[name], b[name], equal_nan=True) for name in a)
        wrong += not same
    return wrong


def listening() -> set[str]:
    """Addresses on which somebody listens on this machine."""
    found = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A":
                found.add(fields[1])
    return found


def leftovers(before: set[str] | None = None, folder: Path | None = None, seconds: float = 3.0) -> set[str] | int:
    """What is on the machine of jobs: processes of DR-GS, shared memory, listening sockets, entries of `folder`.

    With `before`, an earlier answer, how much has been added and does not go within `seconds`.
    """

    def now() -> set[str]:
        found = {f"process {pid}" for pid in marked(MARK, command="drgs_blender")}
        found |= {f"/dev/shm/{name}" for name in os.listdir("/dev/shm")} | listening()
        return found | ({str(path) for path in folder.iterdir()} if folder else set())

    deadline = time.monotonic() + seconds
    found = now()
    while before is not None and found - before and time.monotonic() < deadline:
        time.sleep(0.1)
        found = now()
    return found if before is None else len(found - before)
