"""A million splats read and written: wall time, processor time, and memory next to the arrays.

python bench/bench_formats.py [--count 1000000]
"""

from __future__ import annotations

import argparse
import ctypes
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from report import table, write_section

from drgs_blender.formats.files import SurfelFile
from drgs_blender.formats.registry import read_surfels
from drgs_blender.formats.splats import Splats
from drgs_blender.formats.writers import WRITERS

RUNS = 3
#: What is held to: seconds by format, and memory as a multiple of the arrays.
SECONDS, MEMORY = {"3DGS PLY": 1.0, "SPZ": 3.0, "SOG": 3.0}, 3


def random_splats(n: int) -> Splats:
    """Splats with harmonics of degree 3, over a few metres."""
    rng = np.random.default_rng(0)
    rotation = rng.normal(size=(n, 4)).astype(np.float32)
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    return Splats(
        rng.normal(size=(n, 3)).astype(np.float32),
        np.exp(rng.uniform(-7, -3, (n, 3))).astype(np.float32),
        rotation,
        rng.uniform(0, 1, n).astype(np.float32),
        rng.normal(scale=0.2, size=(n, 16, 3)).astype(np.float32),
    )


def measured(work: Callable[[], object], arrays: Callable[[object], int]) -> list[object]:
    """[wall s, processor s, peak of memory as a multiple of the arrays]: the best of a few runs, then one watched."""
    times = []
    for _ in range(RUNS):
        wall, processor = time.perf_counter(), time.process_time()
        work()
        times.append((time.perf_counter() - wall, time.process_time() - processor))
    ctypes.CDLL(None).malloc_trim(0)  # what the runs have left behind would serve this one
    command = [sys.executable, "-c", WATCH, str(os.getpid())]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as watcher:
        assert watcher.stdin is not None and watcher.stdout is not None
        before = int(watcher.stdout.readline())
        result = work()
        watcher.stdin.close()
        peak = int(watcher.stdout.read())
    return [*min(times), (peak - before) / arrays(result)]


#: A program that prints what a process and those it starts (but this one) keep in memory, mapped files apart: at first,
#: and the most of it until its input ends. From outside it sees libraries' own memory, too, and waits for no lock.
WATCH = """
import os, select, sys

def kept(pid):
    try:
        with open(f"/proc/{pid}/status") as status, open(f"/proc/{pid}/task/{pid}/children") as children:
            own = int(status.read().split("RssAnon:")[1].split()[0]) << 10
            return own + sum(kept(int(child)) for child in children.read().split() if int(child) != os.getpid())
    except (OSError, IndexError):
        return 0

most = kept(sys.argv[1])
print(most, flush=True)
while not select.select([sys.stdin], [], [], 0.001)[0]:
    most = max(most, kept(sys.argv[1]))
print(most)
"""


def surfel_bytes(file: object) -> int:
    """Bytes of the arrays that a reader returned."""
    assert isinstance(file, SurfelFile)
    s = file.surfels
    arrays = [s.centre, s.scale, s.rotation, s.opacity, s.albedo, s.roughness, s.metallic, *s.extras.values()]
    return sum(a.nbytes for a in arrays) + (0 if s.sh is None else s.sh.nbytes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1_000_000)
    n = parser.parse_args().count
    splats = random_splats(n)
    given = sum(a.nbytes for a in (splats.centre, splats.scale, splats.rotation, splats.opacity, splats.sh))
    rows: list[list[object]] = []
    with tempfile.TemporaryDirectory() as folder:
        for writer in WRITERS:
            if writer.kind != "splats" or (writer.name == "USD splats" and find_spec("pxr") is None):
                continue
            path = Path(folder) / f"a{writer.extensions[0]}"
            write = lambda writer=writer, path=path: writer.write(path, splats)  # noqa: E731
            limit = f"{SECONDS[writer.name]:g} s, {MEMORY} arrays" if writer.name in SECONDS else ""
            rows.append([writer.name, "write", *measured(write, lambda _: given), path.stat().st_size / 1e6, limit])
            read = lambda path=path: read_surfels(path)  # noqa: E731
            rows.append([writer.name, "read", *measured(read, surfel_bytes), path.stat().st_size / 1e6, limit])
            path.unlink()
    body = f"{n:,} splats with harmonics of degree 3, which are noise, the slowest case. Memory is the most that the "
    body += "process and those it starts have beyond what they had before, libraries and all, over the size of the "
    body += "arrays read or written; for writing without those arrays themselves."
    columns = ["format", "", "wall s", "processor s", "memory / arrays", "MB", "hold to"]
    write_section("formats", "Splat files", f"{body}\n\n{table(columns, rows)}")


if __name__ == "__main__":
    main()
