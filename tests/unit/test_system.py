"""What Windows does otherwise: files that are open, standard input of programs, their end. Tried on any system."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from drgs_blender.compute.worker_pool import end_process, start_process
from drgs_blender.core import own_python, system
from drgs_blender.core.asset import archive
from drgs_blender.ipc.child_process import Child, is_crash
from drgs_blender.ipc.locate import bundled_command, engine_command

ROOT = Path(__file__).resolve().parents[2]
CLAIM = """
import os
from drgs_blender.core.system import claim_input
own = claim_input()
print(os.path.samestat(os.fstat(0), os.stat(os.devnull)), os.read(0, 1), os.read(own, 9))
"""
#: Ends by the handler of SIGTERM as on Windows, where the pipe at its standard input is closed; "deaf" asks for no end.
END = """
import signal, sys, threading, time
from drgs_blender.core import system
system.WINDOWS, system._END_SECONDS = True, 0.2
signal.signal(signal.SIGTERM, lambda *_: sys.argv[1] == "deaf" or sys.exit(7))
threading.Thread(target=system.end_at_close, args=(system.claim_input(),), daemon=True).start()
print("ready", flush=True)
while True:
    time.sleep(0.01)
"""
linux = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")


def run(code: str, *arguments: str, **options: object) -> subprocess.Popen[bytes]:
    pipe = subprocess.PIPE
    return subprocess.Popen([sys.executable, "-c", code, *arguments], stdin=pipe, stdout=pipe, cwd=ROOT, **options)


def input_of(pid: int, seconds: float = 30.0) -> str:
    """What standard input of a process is once it is no pipe any more, or after `seconds`."""
    until = time.monotonic() + seconds
    while (found := os.readlink(f"/proc/{pid}/fd/0")).startswith("pipe:") and time.monotonic() < until:
        time.sleep(0.05)
    return found


def test_a_program_that_waits_for_its_input_leaves_the_null_device_there():
    said, _ = run(CLAIM).communicate(b"request")
    assert said.split(b"\n")[0].strip() == b"True b'' b'request'"


@linux
def test_the_processes_that_compile_leave_the_null_device_there():
    """On Windows they hung for ever: what SciPy brings asks, when it is loaded, what standard input is."""
    process = start_process()
    try:
        assert input_of(process.pid) == os.devnull
    finally:
        end_process(process)


@linux
def test_the_engine_leaves_the_null_device_there():
    child = Child(engine_command(), shared=False)
    try:
        assert input_of(child.pid) == os.devnull
    finally:
        child.close(0)


@pytest.mark.parametrize("how, code", [("by its handler", 7), ("deaf", 143)])
def test_the_end_of_a_system_without_signals(how, code):
    process = run(END, how)
    assert process.stdout.readline().strip() == b"ready"
    time.sleep(0.1)
    assert process.poll() is None
    process.stdin.close()
    assert process.wait(10) == code
    process.stdout.close()


def test_a_file_that_is_open_for_a_moment_is_replaced_after_it(tmp_path, monkeypatch):
    """The refusal is Windows', which Linux cannot make: the rest is real."""
    source, target, refused = tmp_path / "new", tmp_path / "old", [PermissionError(13, "open")] * 3
    source.write_text("new")
    target.write_text("old")
    rename = os.replace

    def replace(*paths):
        if refused:
            raise refused.pop()
        rename(*paths)

    monkeypatch.setattr(os, "replace", replace)
    monkeypatch.setattr(system, "WINDOWS", False)
    with pytest.raises(PermissionError):
        system.replace(source, target)
    assert target.read_text() == "old"
    monkeypatch.setattr(system, "WINDOWS", True)
    system.replace(source, target)
    assert target.read_text() == "new" and not source.exists()
    monkeypatch.setattr(system, "_OPEN_SECONDS", 0.1)
    refused += [PermissionError(13, "open")] * 1000
    with pytest.raises(PermissionError):
        system.replace(target, source)


@linux
@pytest.mark.parametrize("windows", [False, True])
def test_windows_maps_no_asset(tmp_path, monkeypatch, windows):
    """Nobody could write it again while it is used there. Elsewhere it is mapped, which costs nothing."""
    monkeypatch.setattr(archive, "WINDOWS", windows)
    values = np.arange(1000, dtype=np.uint8)
    archive.write_archive(tmp_path / "some.drgs", [("values", [values.data])])
    found = archive.read_archive(tmp_path / "some.drgs", check=["values"])["values"]
    assert np.array_equal(found, values) and not found.flags.writeable
    assert (str(tmp_path) in Path("/proc/self/maps").read_text()) is not windows


def test_what_blender_reads_is_utf8():
    """Of programs whose output is a pipe: on Windows, they would write the user's code page."""
    engine, bundled = engine_command(sys.executable), bundled_command(sys.executable, ROOT)
    flags = "import sys; print(sys.flags.utf8_mode)"
    for command in (engine, bundled):
        before = command[: command.index("-m")]
        again = f"import subprocess; from {own_python.__name__} import command as own; "
        again += f"subprocess.run([*own('-I'), '-c', {flags!r}])"
        for code in (flags, again) if command is bundled else (flags,):
            done = subprocess.run([*before, "-c", code], capture_output=True, env=os.environ | {"LC_ALL": "C.UTF-8"})
            assert done.stdout.strip() == b"1", done.stderr


def test_a_crash_on_windows_is_told_from_an_exit():
    assert is_crash(-11) and is_crash(0xC0000409)
    assert not any(map(is_crash, (0, 1, 143, 255)))
