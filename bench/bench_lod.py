"""Level of detail: viewports of captures of a million and of five million surfels, Automatic against Full.

python bench/bench_lod.py [--surfels 1000000 5000000] [--seconds 5] [--dry]

An engine process is asked by the extension's own thread (`addon/viewport/worker.py`), as fast as a mouse moves; what
Blender draws comes on top. The capture is that of examples/ with each surfel as many.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import time
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from judge import environments, frame_camera
from large_capture import large_asset
from ours import pinhole
from report import ROOT, table, write_section

from drgs_blender.core.asset.container import read_asset
from drgs_blender.formats.registry import read_environment

#: Pixels of the viewport, and seconds between two moves of a mouse.
SIZE, TICK = (640, 360), 1 / 60
#: Without the package's own start, which needs Blender.
PACKAGE = "drgs_without_blender"


def extension(name: str) -> Any:
    """A module of the extension that needs no Blender."""
    for part in ("", ".addon", ".addon.viewport"):
        package = types.ModuleType(PACKAGE + part)
        package.__path__ = [str(ROOT.joinpath(*part.split(".")[1:]))]
        sys.modules.setdefault(PACKAGE + part, package)
    return importlib.import_module(f"{PACKAGE}.{name}")


class Viewport:
    """A viewport of one capture, without Blender."""

    def __init__(self, path: Path, most: int) -> None:
        self.most, self.path = most, str(path.resolve())
        self._model = extension("drgs_blender.core.frame")
        self._worker = extension("addon.viewport.worker")
        self.client = extension("drgs_blender.ipc.client").EngineClient(command=engine_program())
        self.worker = self._worker.Worker()
        self.vertices = read_asset(path).mesh.vertices
        self._light = read_environment(environments() / "city.exr").radiance
        self._cameras: dict[float, Any] = {}
        self.seen: list[tuple[float, Any]] = []

    def camera(self, azimuth: float) -> Any:
        """The camera of a view, made once: it looks at all vertices, as no mouse does."""
        if azimuth not in self._cameras:
            width, height = SIZE
            made = pinhole(frame_camera(self.vertices, width, azimuth=azimuth, fill=0.66) | {"height": height})
            fields = {name: getattr(made, name) for name in self._model.Camera.__slots__}
            self._cameras[azimuth] = self._model.Camera(**fields)
        return self._cameras[azimuth]

    def move(self, azimuth: float, bend: float = 0.0) -> Any:
        """Ask for another picture."""
        model, camera = self._model, self.camera(azimuth)
        vertices = self.vertices * np.float32(1 + 0.01 * bend) if bend else self.vertices
        subject = model.ObjectState("subject", self.path, vertices=vertices)
        settings = model.RenderSettings(samples=32)
        frame = model.Frame(1, camera, [subject], model.World(self._light), settings)
        request = self._worker.Request(frame, self.client, ((self.path, (0, 0)),), (), self.most)
        self.worker.submit("bench", request)
        return request

    def watch(self, seconds: float) -> None:
        """Note the pictures that come for a while."""
        end = time.perf_counter() + seconds
        while True:
            now = time.perf_counter()
            error = self.worker.state("bench")[1]
            if error:
                raise SystemExit(error)
            picture = self.worker.picture("bench")
            if picture is not None and (not self.seen or self.seen[-1][1] is not picture):
                self.seen.append((now, picture))
            if now >= end:
                return
            time.sleep(0.001)

    def wait(self, request: Any, fraction: float = 0.0) -> float:
        """Seconds until a picture of a request has a part of its samples."""
        began = time.perf_counter()
        while not (self.seen and self.seen[-1][1].request is request and self.seen[-1][1].fraction >= fraction):
            self.watch(0.002)
        return self.seen[-1][0] - began

    def wait_sharp(self, request: Any) -> float:
        """Seconds until a picture of a request has all its pixels."""
        began = time.perf_counter()
        self.wait(request)
        while self.seen[-1][1].passes["Combined"].shape[:2] != SIZE[::-1]:
            self.watch(0.002)
        return self.seen[-1][0] - began

    def close(self) -> None:
        """End the engine."""
        self.worker.stop()
        self.client.close()


def engine_program() -> list[str]:
    """Command of the engine of this checkout."""
    start = f"import sys; sys.path.insert(0, {str(ROOT)!r}); from drgs_blender.engine.server import main; main()"
    return [sys.executable, "-I", "-c", start]


def memory(viewport: Viewport) -> float:
    """Gigabytes that the engine has taken at most; 0 where the system does not say."""
    child = viewport.client._child
    status = Path(f"/proc/{child._process.pid}/status") if child is not None else Path("/nowhere")
    lines = status.read_text().splitlines() if status.exists() else []
    return next((float(line.split()[1]) / 1e6 for line in lines if line.startswith("VmHWM")), 0.0)


def measured(count: int, most: int, seconds: float) -> dict[str, float]:
    """The figures of one capture and setting."""
    path = large_asset(count)
    viewport = Viewport(path, most)
    try:
        found = {"first picture after the engine has started, s": viewport.wait(viewport.move(0.0))}
        found["until all samples at rest, s"] = viewport.wait(viewport.move(1.0), 1.0)
        for i in range(5):  # its pixels become as large as the machine needs
            viewport.wait(viewport.move(2.0 + i))
        found["pictures a second, orbit"], found["longest wait, orbit, s"] = turned(viewport, seconds)
        latencies = [viewport.wait(viewport.move(20.0, 1 + i)) for i in range(8)]
        found["first picture of another pose, s"] = float(np.median(latencies))
        found["until a sharp picture at rest, s"] = viewport.wait_sharp(viewport.move(40.0))
        found["memory of the engine, GB"] = memory(viewport)
        return found
    finally:
        viewport.close()


def turned(viewport: Viewport, seconds: float) -> tuple[float, float]:
    """Pictures a second while the view turns without a pause, and the longest time without a new one."""
    way = [10.0 + 0.7 * i for i in range(int(seconds / TICK))]
    for azimuth in way:
        viewport.camera(azimuth)
    viewport.seen.clear()
    began = time.perf_counter()
    for i, azimuth in enumerate(way):
        viewport.move(azimuth)
        viewport.watch(max(0.0, began + (i + 1) * TICK - time.perf_counter()))
    times = [began, *(when for when, _ in viewport.seen), time.perf_counter()]
    return len(viewport.seen) / (times[-1] - began), float(np.diff(times).max())


def rows_of(counts: list[int], seconds: float) -> Iterator[list[object]]:
    """Rows of the table."""
    most = extension("drgs_blender.core.level_of_detail").MOST_SURFELS
    for count in counts:
        automatic, full = measured(count, most, seconds), measured(count, 0, seconds)
        for name, value in automatic.items():
            ratio = value / full[name] if name.startswith("pictures") else full[name] / max(value, 1e-9)
            yield [f"{count:,}", name, value, full[name], ratio]


def busy() -> str:
    """What else the machine did, where it says so."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    cores = os.cpu_count() or 1
    return f" **On a busy machine**: load {load:.0f} on {cores} cores." if load > 1.5 * cores else ""


def main() -> None:
    """Measure and write the section."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--surfels", type=int, nargs="+", default=[1_000_000, 5_000_000])
    parser.add_argument("--seconds", type=float, default=5.0, help="of turning without a pause")
    parser.add_argument("--dry", action="store_true", help="print, and leave docs/benchmarks.md as it is")
    args = parser.parse_args()
    body = (
        f"The capture of `examples/playbot` with each surfel as many smaller ones, {SIZE[0]} x {SIZE[1]} pixels, 32 "
        "samples; the extension's thread and an engine process without Blender's own drawing, a move every 60th of a "
        f"second. *Better* is Automatic against Full.{busy()}\n\n"
        + table(["surfels", "", "Automatic", "Full", "times better"], list(rows_of(args.surfels, args.seconds)))
    )
    if args.dry:
        print(body)
    else:
        write_section("lod", "Level of detail", body)


if __name__ == "__main__":
    main()
