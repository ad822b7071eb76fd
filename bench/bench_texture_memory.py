"""Memory of large textures on a large mesh: this program and its engine process against Cycles, in the same .blend.

python bench/bench_texture_memory.py [--triangles 1000000] [--textures 8] [--side 4096]

Both are whole processes: Blender, and what it starts. Memory that processes share counts once (Pss of Linux).
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from judge import blender_python
from report import ROOT, table, write_section

_PROGRAM = Path(__file__).with_name("texture_memory_job.py")
#: Seconds between two readings; a reading of a large process takes some milliseconds itself.
INTERVAL = 0.02


def kept(pid: int) -> int:
    """Bytes that a process and those it started keep, mapped files apart: anonymous and shared memory."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii").splitlines()
        threads = Path(f"/proc/{pid}/task").glob("*/children")
        children = [int(child) for thread in threads for child in thread.read_text(encoding="ascii").split()]
    except OSError:  # it has ended
        return 0
    fields = dict(line.split(":", 1) for line in lines[1:])
    own = sum(int(fields[name].split()[0]) << 10 for name in ("Pss_Anon", "Pss_Shmem"))
    return own + sum(map(kept, children))


def measure(engine: str, folder: Path, extension: Path) -> tuple[int, int]:
    """(most, at the end): bytes beyond those before the render, of one engine in a fresh Blender."""
    environment = os.environ | {"BLENDER_USER_RESOURCES": str(folder / engine), "DRGS_ENGINE": sys.executable}
    command = [str(blender_python()), str(_PROGRAM), "render", str(folder), engine, str(extension)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, **pipes, text=True, env=environment) as blender:
        assert blender.stdin is not None and blender.stdout is not None
        _wait(blender.stdout)
        before = most = kept(blender.pid)
        ended = threading.Event()

        def watch() -> None:
            nonlocal most
            while not ended.wait(INTERVAL):
                most = max(most, kept(blender.pid))

        watcher = threading.Thread(target=watch)
        watcher.start()
        blender.stdin.write("\n")
        blender.stdin.flush()
        _wait(blender.stdout)
        ended.set()
        watcher.join()
        after = kept(blender.pid)
        blender.communicate("\n", timeout=60)
        if blender.returncode:
            raise RuntimeError(f"{engine} ended with {blender.returncode}")
    return most - before, after - before


def _wait(lines: object) -> None:
    for line in lines:  # type: ignore[attr-defined]
        if line == "READY\n":
            return
    raise RuntimeError("Blender ended early")


def main() -> None:
    """Measure and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--triangles", type=int, default=1_000_000)
    parser.add_argument("--textures", type=int, default=8)
    parser.add_argument("--side", type=int, default=4096)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        extension = folder / "extension.zip"
        subprocess.run([sys.executable, str(ROOT / "tools/extension.py"), "--out", str(extension)], check=True)
        sizes = [str(n) for n in (options.triangles, options.textures, options.side)]
        subprocess.run([str(blender_python()), str(_PROGRAM), "make", str(folder), *sizes], check=True, timeout=1200)
        measure("DRGS", folder, extension)  # kernels are compiled once, in no measurement
        found = {engine: measure(engine, folder, extension) for engine in ("CYCLES", "DRGS")}
    most, after = (found["DRGS"][i] / found["CYCLES"][i] for i in (0, 1))
    rows = [[name, *(f"{n / 2**30:.2f}" for n in found[name])] for name in found]
    rows.append(["ours / Cycles", f"{most:.2f}", f"{after:.2f}"])
    body = (
        f"{options.triangles:,} triangles in waves, {options.textures} PNG files of {options.side} x {options.side} as "
        "base colour, roughness, normal map and metallic, one small picture. Memory of Blender and the processes it "
        "starts beyond what Blender has with the file open; what processes share counts once, mapped files do not.\n\n"
    )
    columns = ["", "most while rendering, GiB", "after the picture, GiB"]
    write_section("texture_memory", "Memory of textures", body + table(columns, rows))


if __name__ == "__main__":
    main()
