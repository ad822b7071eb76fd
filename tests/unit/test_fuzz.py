"""Damaged files of every kind: refused by name or read as something usable, quickly and in little memory.

`DRGS_FAULTS=whole` reads a thousand of each kind, otherwise few.
"""

from __future__ import annotations

import gzip
import json
import os
import signal
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from fuzz_files import kinds
from PIL import Image

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")

WHOLE = os.environ.get("DRGS_FAULTS") == "whole"
COUNT = 1000 if WHOLE else 20
#: Kinds for each of whose files a process is started.
SLOW = ("surflets.usda", "splats.usd", "splats.usda", "splats.usdc", "mesh.3mf", "mesh.3mf inside", "mesh.dae")
PROGRAM = Path(__file__).with_name("fuzz_files.py")
KINDS = list(kinds())
#: Kinds that are read by one process: a process takes longer to start than to read few files.
GROUPS = [[kind] for kind in KINDS] if WHOLE else [[k for k in KINDS if k not in SLOW][n::4] for n in range(4)]


def problems(names: list[str], count: int, folder: Path, seconds: int = 5) -> list[list[object]]:
    """[kind, number, what is wrong] of every damaged file with which something is, crashes too."""
    environment = os.environ | {"DRGS_FUZZ_SECONDS": str(seconds)}
    found: list[list[object]] = []
    first = 0
    while True:
        command = [sys.executable, str(PROGRAM), str(folder), str(first), str(count), *names]
        limit = 7200 if WHOLE else 900  # a hang ends the program itself, long before
        result = subprocess.run(command, capture_output=True, text=True, timeout=limit, env=environment)
        lines = [json.loads(line) for line in result.stdout.splitlines() if line.startswith("[")]
        if lines and lines[-1][0] == "done":
            return found + lines[:-1]
        assert (folder / "now").exists(), result.stderr
        kind, number = json.loads((folder / "now").read_text())
        end = "took too long" if result.returncode == -signal.SIGPROF else f"ended the process ({result.returncode})"
        found += [*lines, [kind, number, f"{end}: {result.stderr[-300:]}"]]
        first, names = number + 1, names[names.index(kind) :]
        assert len(found) < 20, found


@pytest.mark.slow
@pytest.mark.parametrize("group", GROUPS, ids=lambda group: group[0] if len(group) == 1 else f"{len(group)} kinds")
def test_damaged_files_do_no_harm(group: list[str], tmp_path: Path) -> None:
    found = problems(group, COUNT, tmp_path)
    assert not found, f"{len(found)} in {tmp_path}: {found[:5]}"


@pytest.mark.slow
@pytest.mark.skipif(WHOLE, reason="among the others then")
def test_damaged_files_that_are_read_apart_do_no_harm(tmp_path: Path) -> None:
    found = problems(list(SLOW), COUNT // 5, tmp_path)
    assert not found, f"{len(found)} in {tmp_path}: {found[:5]}"


@pytest.mark.slow
def test_published_collections_of_broken_files_do_no_harm(shared_data: Path, tmp_path: Path) -> None:
    found = problems([str(shared_data / "malformed")], 0, tmp_path)
    assert not found, found


@pytest.mark.slow
def test_bombs_cost_a_second_and_little_memory_at_most(tmp_path: Path) -> None:
    """Small files that would unpack to a quarter of a gigabyte, wherever a format lets itself be unpacked."""
    bombs = tmp_path / "bombs"
    bombs.mkdir()
    nothing = bytes(1 << 28)
    for name, member in (
        ("a.sog", "meta.json"),
        ("b.sog", "means_l.webp"),
        ("a.map", "a/data.pkl"),
        ("b.map", "a/data/0"),
    ):
        with zipfile.ZipFile(bombs / name, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            if name[0] == "b":
                archive.writestr("a/data.pkl" if name == "b.map" else "meta.json", "{}")
            archive.writestr(member, nothing)
    splats = struct.pack("<4sIIBBBB", b"NGSP", 3, 10_000_000, 3, 12, 0, 0)
    (bombs / "a.spz").write_bytes(gzip.compress(splats + nothing, 1))
    (bombs / "b.spz").write_bytes(gzip.compress(nothing, 1))
    Image.new("1", (16000, 16000)).save(bombs / "a.png")
    assert max(path.stat().st_size for path in bombs.iterdir()) < 2 << 20
    found = problems([str(bombs)], 0, tmp_path, seconds=1)
    assert not found, found


@pytest.mark.slow
def test_a_reader_that_fails_is_noticed(tmp_path: Path) -> None:
    """Crash, hang, appetite and credulity of a reader, each as the program reports it."""
    bad = {
        "crash": "import os; os.kill(os.getpid(), 11)",
        "hang": "while True: pass",
        "appetite": "bytearray(200 << 20); raise fuzz_files.DrgsError(str(path), 'x')",
        "hang apart": "run('while time.process_time() < 3: pass'); raise fuzz_files.DrgsError(str(path), 'x')",
        "appetite apart": "run('bytearray(400 << 20)'); raise fuzz_files.DrgsError(str(path), 'x')",
        "credulity": "return [fuzz_files.np.full(3, fuzz_files.np.nan)]",
        "anonymity": "raise fuzz_files.DrgsError('a file', 'x')",
        "error": "raise KeyError(1)",
    }
    for name, body in bad.items():
        script = f"""
import sys; sys.path.insert(0, {str(PROGRAM.parent)!r})
import fuzz_files, subprocess
from pathlib import Path
fuzz_files.SECONDS = {0.5 if "hang" in name else 1.5}
def run(code):
    subprocess.run([sys.executable, "-c", "import time\\n" + code])
def read(path):
    {body}
print(fuzz_files.attempt(fuzz_files.Kind("a", {{}}, read=read), Path({str(tmp_path / "here.ply")!r}), 1000))
"""
        result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
        expected = {"crash": -11, "hang": -signal.SIGPROF}
        assert result.returncode == expected.get(name, 0), (name, result.stderr)
        assert bool(result.stdout.strip()) == (name not in expected), (name, result.stdout)
