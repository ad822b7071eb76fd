"""Programs of the engine's environment that Blender starts: their standard input, and how they are asked to end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest
from scenes import part

link = part("addon.engine_link")
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")


@pytest.fixture
def program():
    """A command of ``drgs`` that takes some seconds, once it watches its standard input."""
    process = subprocess.Popen(
        [*link.drgs_command(), "doctor"], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, env=link.clean_environment()
    )
    while os.readlink(f"/proc/{process.pid}/fd/0").startswith("pipe:"):
        assert process.poll() is None, "it ended, and never let go of the pipe: on Windows it would have hung"
        time.sleep(0.01)
    yield process
    process.kill()
    process.wait()


@pytest.mark.parametrize("windows", [False, True])
def test_what_is_asked_to_end_does(program, monkeypatch, windows):
    """By a signal, or where there is none by the end of its standard input."""
    assert os.readlink(f"/proc/{program.pid}/fd/0") == os.devnull
    assert program.poll() is None
    monkeypatch.setattr(link, "WINDOWS", windows)
    link.ask_to_end(program)
    assert program.stdin.closed is windows
    assert program.wait(10) in (143, -signal.SIGTERM)
