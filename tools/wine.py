"""Try a Windows zip of the extension under Wine: its packages, the engine, pictures as on this machine.

    .venv/bin/python tools/wine.py dist/drgs-0.1.0-windows-x64-blender-4.2.zip PYTHON [--wine wine]

PYTHON is a folder with Windows' Python of the zip's version, such as python.org's embeddable package, whose
``python3xx._pth`` has the line ``import site``, and NumPy in ``Lib/site-packages``, as Blender has it. Wine 10 is known
to do. Nothing is fetched. What is tried is printed with its seconds; exit code 1: something failed.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
#: Decibels below which pictures are not the same: sines and powers of the two C libraries differ in their last bits.
ALIKE = 90.0
#: Asked of Windows' Python: the client, which starts an engine, loses it, stops it, and writes over what it shows.
CLIENT = r"""
import sys, time
from pathlib import Path
import numpy as np
from drgs_blender.core import memory
from drgs_blender.core.asset.container import read_asset, write_asset
from drgs_blender.core.errors import Cancelled
from drgs_blender.core.frame import Camera, Frame, ObjectState, RenderSettings, World
from drgs_blender.ipc.client import EngineClient
from drgs_blender.ipc.locate import engine_command

path = Path(sys.argv[1])
asset = read_asset(path)
camera = Camera(np.array([[1, 0, 0, 0], [0, 0, -1, -3], [0, 1, 0, 0], [0, 0, 0, 1]], float), 48, 48, 60., 60., 24., 24.)
world = World(np.full((32, 64, 3), 0.5, np.float32))
with EngineClient(engine_command()) as client:
    key = client.load_asset(str(path))
    frame = Frame(1, camera, [ObjectState("cow", key)], world, RenderSettings(samples=4, subpixel_samples=1))
    first = client.render(frame)["Combined"]
    pid = client._child.pid
    client._child.kill()
    assert np.array_equal(client.render(frame)["Combined"], first) and client._child.pid != pid
    print("a killed engine is started again, the picture is the same")
    large = Frame(1, Camera(camera.matrix_world, 800, 800, 1000., 1000., 400., 400.), frame.objects, world,
                  RenderSettings(samples=1024, subpixel_samples=16))
    began, pid = time.monotonic(), client._child.pid
    try:
        client.render(large, cancelled=lambda: time.monotonic() - began > 2)
        raise AssertionError("it was not cancelled")
    except Cancelled:
        assert time.monotonic() - began < 4
    assert np.array_equal(client.render(frame)["Combined"], first) and client._child.pid == pid
    print("a picture that is cancelled ends, the engine lives on")
    write_asset(path, asset)
    assert client.load_asset(str(path)) == key
    print("an asset that the engine and this program show is written again")
assert client.pid == 0
assert 1 << 28 < memory.available_memory() < memory.total_memory() < 1 << 45
print("the system says how much memory there is")
"""
#: One of two: a process that compiles the same kernels at the same time.
PREPARE = ("-m", "drgs_blender.compute.prepare", "motion")


class Windows:
    """A Windows with the extension unpacked as Blender does it, in folders with spaces and letters of all kinds.

    Parameters
    ----------
    wine : command that starts a program of Windows
    python : folder of its Python
    archive : the extension's zip
    folder : of all that is written; becomes Wine's prefix
    """

    def __init__(self, wine: str, python: Path, archive: Path, folder: Path) -> None:
        self._command = [wine, str(python / "python.exe"), "-I", "-Xutf8"]
        # Threads of OpenBLAS lock by Wine's server: to invert the matrices of an asset takes half a minute
        self._environment = {"WINEPREFIX": str(folder), "WINEDEBUG": "-all", "OPENBLAS_NUM_THREADS": "1"}
        subprocess.run([wine, "wineboot", "-i"], env=os.environ | self._environment, capture_output=True)
        self.folder = folder / "drive_c" / "Größe 1 объект"
        extensions = self.folder / "extensions"
        source, site = extensions / "user_default" / "drgs", extensions / ".local" / "site-packages"
        with zipfile.ZipFile(archive) as files:
            files.extractall(source)
        for wheel in (source / "wheels").glob("*.whl"):
            with zipfile.ZipFile(wheel) as files:
                files.extractall(site)
            for data in site.glob("*.data/platlib/*"):
                data.rename(site / data.name)
        self._command += [within(source / "drgs_blender" / "cli" / "bundled.py"), within(site)]

    def start(self, *arguments: object) -> subprocess.Popen[bytes]:
        """Start what the extension starts: ``-m`` or ``-c`` and what follows, paths of this machine or words."""
        words = [within(word) if isinstance(word, Path) else str(word) for word in arguments]
        pipe = subprocess.PIPE
        environment = os.environ | self._environment
        return subprocess.Popen([*self._command, *words], stdout=pipe, stderr=subprocess.STDOUT, env=environment)

    def run(self, *arguments: object) -> str:
        """What it prints; AssertionError where it fails."""
        return finished(self.start(*arguments))

    def drgs(self, *arguments: object) -> str:
        """The same of the command ``drgs``."""
        return self.run("-m", "drgs_blender.cli.main", *arguments)


def finished(process: subprocess.Popen[bytes]) -> str:
    """What a process prints; AssertionError where it fails."""
    text = process.communicate(timeout=1200)[0].decode("utf-8", "replace").replace("\r", "")
    assert process.returncode == 0, f"exit code {process.returncode}: {text[-2000:]}"
    return text


def within(path: Path) -> str:
    """A path of this machine as Wine has it."""
    return f"Z:{path.resolve()}".replace("/", "\\")


@contextmanager
def trial(name: str, failures: list[str]) -> Iterator[Callable[[str], None]]:
    """Print a name, what was found, and how long it took; an error is noted."""
    began = time.monotonic()
    found: list[str] = []
    try:
        yield found.append
        print(f"ok      {name}: {time.monotonic() - began:.1f} s{''.join(f', {text}' for text in found)}", flush=True)
    except (AssertionError, OSError, subprocess.TimeoutExpired) as error:
        failures.append(name)
        print(f"FAILED  {name}: {error}", flush=True)


#: Name -> options of `drgs relight` beyond the light.
PICTURES = {
    "first": [],
    "again": [],
    "svgf": ["--denoise", "svgf", "--bounces", "2"],
    "oidn": ["--denoise", "oidn"],
    "surfels": ["--camera-sees", "mesh", "--rays-see", "surfels"],
}


def difference(ours: Path, theirs: Path) -> str:
    """Of two pictures, in words; AssertionError where it can be seen."""
    from drgs_blender.render.film.frame_files import read_frame

    a, b = (read_frame(path)[0]["Combined"].astype(np.float64) for path in (ours, theirs))
    share, error = (a != b).any(-1).mean(), ((a / (1 + abs(a)) - b / (1 + abs(b))) ** 2).mean()
    decibels = -10 * np.log10(error) if error else np.inf
    assert decibels > ALIKE, f"{decibels:.1f} dB from the picture of this machine"
    return f"{decibels:.0f} dB from this machine's, {100 * share:.2f} % of pixels differ"


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("zip", type=Path, help="the extension for windows-x64")
    parser.add_argument("python", type=Path, help="folder of Windows' Python, with NumPy")
    parser.add_argument("--wine", default="wine", help="command that starts a program of Windows")
    options = parser.parse_args()
    failures: list[str] = []
    with tempfile.TemporaryDirectory(prefix="drgs-wine-") as place:
        windows = Windows(options.wine, options.python.resolve(), options.zip, Path(place) / "prefix")
        here, there = Path(place), windows.folder
        light, asset = there / "light.hdr", there / "Kuh.drgs"
        rows = b"".join(bytes([64]) + bytes([128 + 8 * i] * 64) for i in range(4))
        header = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 32 +X 64\n"
        light.write_bytes(header + 32 * (bytes([2, 2, 0, 64]) + rows))
        own = [sys.executable, "-m", "drgs_blender.cli.main"]
        with trial("doctor", failures) as note:
            said = windows.drgs("doctor")
            assert "can render here" in said, said
            note(re.search(r"kernels +(.*)", said)[1].partition(";")[0])  # type: ignore[index]
        with trial("make", failures):
            windows.drgs("make", ROOT / "examples/spot/spot_triangulated.obj", "--out", asset)
        for name, settings in PICTURES.items():
            given = ["relight", asset, "--env", light, "--size", "320", "--samples", "16", *settings]
            subprocess.run([*map(str, [*own, *given]), "--out", here / f"{name}.exr"], check=True, cwd=ROOT)
            with trial(f"relight, {name}", failures) as note:
                windows.drgs(*given, "--out", there / f"{name}.exr")
                note(difference(there / f"{name}.exr", here / f"{name}.exr"))
        with trial("engine and client", failures) as note:
            for line in windows.run("-c", CLIENT, asset).splitlines()[-4:]:
                note(line)
        with trial("two processes compile the same", failures):
            for process in [windows.start(*PREPARE) for _ in range(2)]:
                finished(process)
        bake = ["simulate", asset, "--resolution", "12", "--floor", "-1", "--out", there / "Bäcker"]
        with trial("simulate, and go on", failures):
            windows.drgs(*bake, "--frames", "2")
            windows.drgs(*bake, "--frames", "4")
            windows.drgs("relight", asset, "--env", light, "--size", "64", "--samples", "4", "--cache",
                         there / "Bäcker", "--frames", "4", "--out", there / "falling.png")  # fmt: skip
        with trial("formats", failures):
            for suffix in (".ply", ".spz", ".sog", ".glb"):
                windows.drgs("convert", asset, there / f"cow{suffix}")
                windows.drgs("inspect", there / f"cow{suffix}")
    return int(bool(failures))


if __name__ == "__main__":
    sys.exit(main())
