"""From nothing to a picture: kernels compiled and shipped, the engine, the demo.

    python bench/bench_startup.py [--repeats N] [--demo] [--tests] [--ci] [--earlier]

Cold is an empty cache folder, without kernels of a release. ``--demo`` runs ``make demo`` with one, the environments
standing, and again; ``--tests`` runs ``make test`` with one. ``--earlier`` measures the first frame of an earlier
commit and of this one in turn. What is not measured keeps the figure and the date that docs/benchmarks.md has.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import OpenEXR
from bench_engine import first_frame, plane_asset
from checkouts import Checkout
from report import DOCUMENT, ROOT, table, write_section

#: The first whole frame of this commit and of another one, measured in turn.
IN_TURN = "the same, in turn with the next row", "the same of an earlier commit"
#: What -> whether a viewport waits for it, whose first picture is coarse.
FIRST_PIXELS = {
    "engine process to first pixel of a viewport, warm": True,
    "engine process to first whole frame, warm": False,
}
#: What -> (hold, stretch), seconds.
GOALS = {
    "all kernels, cold": (60, 35),
    "kernels of one relit frame, cold": (25, 12),
    "`drgs relight`, start to picture, cold": (25, 12),
    "`drgs relight`, start to picture, kernels shipped": (3, 1),
    "`drgs relight`, start to picture, warm": ("", ""),
    **dict.fromkeys(FIRST_PIXELS, (0.8, 0.4)),
    IN_TURN[0]: ("", ""),
    IN_TURN[1]: ("", ""),
    "`make demo` after the environments, cold": ("", ""),
    "`make demo` after the environments, kernels there": (75, 45),
    "`make test`, cold": (480, 300),
    "`.ci/run`, environments and cache cold": (2100, 1500),
}


#: Pixels of a picture's side, and samples per pixel, of `drgs relight`.
SIZE, SAMPLES = 256, 32
#: Of which docs/benchmarks.md has the first pixel of another machine, or hour.
EARLIER = "0a3e415"
_PACE: list[float] = []


def pace() -> float:
    """Processor seconds of ten million additions in Python: what a shared machine does at the time."""
    begun, total = time.process_time(), 0
    for i in range(10_000_000):
        total += i
    return time.process_time() - begun


def run(command: list[object], **environment: object) -> float:
    """Seconds that a command takes; it must succeed.

    It hears of no variable of ours or Numba's but these, and which torch the environments have.
    """
    ours = "DRGS_", "NUMBA_"
    merged = {name: value for name, value in os.environ.items() if not name.startswith(ours) or name == "DRGS_TORCH"}
    merged |= {name: str(value) for name, value in environment.items()}
    _PACE.append(pace())
    begun = time.perf_counter()
    done = subprocess.run(list(map(str, command)), env=merged, cwd=ROOT, capture_output=True, text=True)
    seconds = time.perf_counter() - begun
    _PACE.append(pace())
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, command))} failed:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    return seconds


def relight(folder: Path) -> list[object]:
    """One relit frame of a cow of 100,000 surfels, `SIZE` x `SIZE`, under an HDRI."""
    drgs = [sys.executable, "-m", "drgs_blender.cli.main"]
    if not (folder / "spot.drgs").exists():
        run([*drgs, "make", ROOT / "examples/spot/spot_triangulated.obj", "--out", folder / "spot.drgs"])
        kernels = [sys.executable, ROOT / "tools/kernels.py", "record", "--do", "environment", folder]
        run(kernels)  # writes light.exr
    camera = {"matrix_world": [[1, 0, 0, 0], [0, 0, -1, -3], [0, 1, 0, 0], [0, 0, 0, 1]], "width": SIZE, "height": SIZE}
    (folder / "camera.json").write_text(json.dumps(camera | {"fov_x": 40}))
    return [*drgs, "relight", folder / "spot.drgs", "--camera", folder / "camera.json", "--env", folder / "light.exr",
            "--samples", SAMPLES, "--out", folder / "frame.exr"]  # fmt: skip


def cold(command: list[object], folder: Path, repeats: int) -> float:
    """Median seconds of a command with an empty cache folder, shipped kernels left out."""
    seconds = []
    for _ in range(repeats):
        cache = folder / "cache"
        shutil.rmtree(cache, ignore_errors=True)
        seconds.append(run(command, DRGS_CACHE_DIR=cache, DRGS_SHIPPED="0"))
    return statistics.median(seconds)


def measure(folder: Path, repeats: int) -> dict[str, float]:
    """The figures of the kernels and of the engine."""
    prepare = [sys.executable, "-m", "drgs_blender.compute.prepare"]
    picture = relight(folder)
    rows = {
        "all kernels, cold": cold([*prepare, "--all"], folder, repeats),
        "kernels of one relit frame, cold": cold([*prepare, "frame"], folder, repeats),
        "`drgs relight`, start to picture, cold": cold(picture, folder, repeats),
    }
    warm = [run(picture, DRGS_CACHE_DIR=folder / "cache", DRGS_SHIPPED="0") for _ in range(repeats + 2)]
    rows["`drgs relight`, start to picture, warm"] = statistics.median(warm)
    with OpenEXR.File(str(folder / "frame.exr")) as file:
        assert file.channels()["RGBA"].pixels.shape[:2] == (SIZE, SIZE)
    shipped = folder / "shipped"
    if (ROOT / "drgs_blender/compute/kernels").is_dir():
        rows["`drgs relight`, start to picture, kernels shipped"] = statistics.median(
            _shipped(picture, shipped) for _ in range(repeats + 2)
        )
    plane_asset(folder / "sheet.drgs")
    for what, in_viewport in FIRST_PIXELS.items():
        starts = [first_frame(folder / "sheet.drgs", in_viewport)["start_to_first_frame_s"] for _ in range(8)]
        rows[what] = statistics.median(starts[1:])
    return rows


def _shipped(picture: list[object], cache: Path) -> float:
    """With the kernels of a release, all of them: none may be compiled meanwhile."""
    shutil.rmtree(cache, ignore_errors=True)
    seconds = run(picture, DRGS_CACHE_DIR=cache)
    if made := sorted(path.name for path in cache.rglob("*.kernel")):
        raise SystemExit(f"the release lacks {', '.join(made)}: run tools/kernels.py build")
    return seconds


def dev_command_seconds(folder: Path, *command: object) -> float:
    """Seconds of a command of tools/dev.py with an empty cache folder, without the kernels of a release."""
    shutil.rmtree(folder / "cache", ignore_errors=True)
    kernels, hidden = ROOT / "drgs_blender/compute/kernels", ROOT / "build/kernels-hidden"
    hidden.parent.mkdir(exist_ok=True)
    if kernels.is_dir():
        kernels.replace(hidden)
    try:
        return run([sys.executable, ROOT / "tools/dev.py", *command], DRGS_CACHE_DIR=folder / "cache")
    finally:
        if hidden.is_dir():
            hidden.replace(kernels)


def clone(folder: Path) -> float:
    """Seconds of the whole check in a clean clone of what is committed."""
    copy = folder / "clone"
    subprocess.run(["git", "clone", "--quiet", ROOT, copy], check=True)
    return run([copy / ".ci/run"], DRGS_CACHE_DIR=folder / "cache-of-clone")


#: Prints the seconds to the first pixel of the checkout that it runs in.
_FIRST_PIXEL = """
import pathlib, sys
from bench_engine import first_frame, plane_asset
path = pathlib.Path(sys.argv[1])
if not path.exists():
    plane_asset(path)
    first_frame(path)
print(first_frame(path)["start_to_first_frame_s"])
"""


def first_pixels(commits: list[str], folder: Path, pairs: int = 9) -> list[float]:
    """Median seconds to the first pixel of commits, each in an environment of its own, measured in turn."""
    _PACE.append(pace())
    starts = []
    for number, commit in enumerate(commits):
        checkout = Checkout(commit, folder / f"commit{number}")
        command = [str(checkout.python), "-P", "-c", _FIRST_PIXEL, str(folder / f"sheet{number}.drgs")]
        starts.append((command, checkout.environment))
    seconds = [
        [
            float(subprocess.run(command, env=variables, check=True, capture_output=True).stdout)
            for command, variables in starts
        ]
        for _ in range(pairs + 1)  # the first compiles
    ]
    return [statistics.median(column) for column in zip(*seconds[1:], strict=True)]


def earlier(document: str) -> dict[str, list[object]]:
    """The rows that docs/benchmarks.md has: what -> seconds, date, pace."""
    rows: dict[str, list[object]] = {}
    for what in GOALS:
        if found := re.search(rf"^\| {re.escape(what)} \| ([\d.]+) \| ([\d-]+) \| ([\d.]*) \|", document, re.MULTILINE):
            rows[what] = [float(found[1]), found[2], found[3]]
    return rows


def write(rows: dict[str, list[object]], repeats: int) -> None:
    """Write the section."""
    shown = [[what, *(rows.get(what, ["not measured"]) + [""] * 3)[:3], *goals] for what, goals in GOALS.items()]
    text = (
        "Cold: an empty cache folder, without kernels of a release. Whole processes, their start included; medians of "
        f"{repeats}, of {repeats + 2} where warm or shipped, of 7 for the first pixel, of 9 for the two in turn; the "
        f"last three rows once. `drgs relight` renders {SIZE} x {SIZE} pixels with {SAMPLES} samples. A viewport of "
        "400 x 400 begins with pixels of 2 x 2. The earlier "
        f"commit, {EARLIER}, is the one whose first whole frame took 0.845 s in the section *The engine process*, on "
        "another day. Pace: seconds that ten million additions in Python took before and after: machines that are "
        "shared are fast at one time and slow at another.\n\n"
    )
    columns = "What", "Seconds", "Measured", "Pace", "Hold", "Stretch"
    write_section("startup", "Starting", text + table(columns, shown))


def main() -> None:
    """Measure and write the section."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--no-kernels", action="store_true", help="only what the other options ask for")
    parser.add_argument("--demo", action="store_true", help="measure `make demo` as well")
    parser.add_argument("--tests", action="store_true", help="measure `make test` as well")
    parser.add_argument("--ci", action="store_true", help="measure `.ci/run` of a clean clone as well")
    parser.add_argument("--earlier", action="store_true", help=f"measure the first pixel of {EARLIER} as well")
    options = parser.parse_args()
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # else each start compiles all sources: users have them compiled
    rows = earlier(DOCUMENT.read_text(encoding="utf-8"))

    def record(found: dict[str, float]) -> None:
        meanwhile = round(statistics.median(_PACE), 2)
        _PACE.clear()
        rows.update({what: [seconds, time.strftime("%Y-%m-%d"), meanwhile] for what, seconds in found.items()})
        write(rows, options.repeats)

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if not options.no_kernels:
            record(measure(folder, options.repeats))
        if options.earlier:
            other, this = first_pixels([EARLIER, "HEAD"], folder)
            record({IN_TURN[0]: this, IN_TURN[1]: other})
        if options.demo:
            cold = dev_command_seconds(folder, "demo", "--out", folder / "demo")
            again = [sys.executable, ROOT / "tools/dev.py", "demo", "--out", folder / "again"]
            warm = run(again, DRGS_CACHE_DIR=folder / "cache")
            what = "`make demo` after the environments, {}"
            record({what.format("cold"): cold, what.format("kernels there"): warm})
        if options.tests:
            record({"`make test`, cold": dev_command_seconds(folder, "test")})
        if options.ci:
            record({"`.ci/run`, environments and cache cold": clone(folder)})


if __name__ == "__main__":
    main()
