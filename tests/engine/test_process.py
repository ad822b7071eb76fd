"""The engine as a process: handshake, faults, and nothing left behind."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from processes import all_gone, gone, open_files

from drgs_blender.core.errors import (
    EXIT_INTERNAL,
    EXIT_RETRY,
    EXIT_VERSION,
    AssetError,
    DeviceError,
    EngineError,
    VersionError,
)
from drgs_blender.core.version import __version__
from drgs_blender.ipc import protocol
from drgs_blender.ipc.child_process import clean_environment
from drgs_blender.ipc.client import EngineClient
from drgs_blender.ipc.codec import encode_frame
from drgs_blender.ipc.protocol import Link

from .conftest import ROOT, engine_program

linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")


def wait_until(condition, seconds: float) -> float:
    """Seconds until `condition` held; fails the test when it does not within `seconds`."""
    start = time.monotonic()
    while not condition():
        assert time.monotonic() - start < seconds, f"not within {seconds} s"
        time.sleep(0.01)
    return time.monotonic() - start


def raw_engine() -> subprocess.Popen[bytes]:
    """An engine on plain pipes, to be spoken to by hand."""
    pipe = subprocess.PIPE
    return subprocess.Popen(engine_program(), bufsize=0, stdin=pipe, stdout=pipe, stderr=pipe, env=clean_environment())


def test_starts_quickly_and_ends_when_closed(make_client):
    client = make_client()
    client.start()
    pid = client.pid
    assert pid > 0
    start = time.monotonic()
    client.close()
    assert time.monotonic() - start < 2.0
    assert client.pid == 0
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_other_version_is_refused_at_once_and_both_are_named(make_client):
    client = make_client("import drgs_blender.core.version as v; v.__version__ = '9.8.7'")
    start = time.monotonic()
    with pytest.raises(VersionError) as caught:
        client.start()
    assert time.monotonic() - start < 2.0
    assert "9.8.7" in str(caught.value)
    assert __version__ in str(caught.value)
    assert client.pid == 0


def test_other_protocol_is_refused(make_client):
    client = make_client("import drgs_blender.ipc.protocol as p; p.PROTOCOL = 99")
    with pytest.raises(VersionError, match="protocol 99"):
        client.start()


def test_engine_refuses_a_client_of_another_version():
    engine = raw_engine()
    link = Link(engine.stdout, engine.stdin)  # type: ignore[arg-type]
    assert isinstance(link.receive()[0], protocol.Hello)  # type: ignore[index]
    link.send(protocol.Welcome(protocol.PROTOCOL, "0.0.1", -1, -1, -1))
    failed = link.receive()[0]  # type: ignore[index]
    assert failed.error == "VersionError"
    assert "0.0.1" in failed.problem
    assert engine.wait(5) == EXIT_VERSION
    engine.communicate()


@pytest.mark.parametrize(
    ("command", "problem"),
    [
        (["/nowhere/python"], "cannot be started"),
        ([sys.executable, "-c", "raise SystemExit('no such engine')"], "no such engine"),
        ([sys.executable, "-c", "print('hello' * 100)"], "does not speak as an engine does"),
        ([sys.executable, "-c", "while True: print('hello')"], "does not speak as an engine does"),
    ],
)
def test_what_is_no_engine_is_an_error_that_says_why(command, problem):
    client = EngineClient(command)
    with pytest.raises(DeviceError, match=problem):
        client.start()
    assert client.pid == 0
    client.close()


def test_command_that_says_nothing_meets_the_deadline_once(tmp_path):
    """It is no engine, so that another start would only make the user wait longer."""
    program = f"open({str(tmp_path / 'starts')!r}, 'a').write('x'); import time; time.sleep(60)"
    client = EngineClient([sys.executable, "-c", program], handshake=1.5)
    start = time.monotonic()
    with pytest.raises(DeviceError, match="does not greet as an engine does"):
        client.start()
    assert time.monotonic() - start < 8.0
    assert (tmp_path / "starts").read_text() == "x"
    assert client.pid == 0
    client.close()


@pytest.mark.skipif(os.name == "nt", reason="signals")
@pytest.mark.parametrize("deaths", [1, 2])
def test_engine_killed_while_it_starts_is_started_once_more(make_client, tmp_path, deaths):
    """As the system does where memory is short: the engine is there, and may fit the next time."""
    die = f"""
import os, pathlib, signal
starts = pathlib.Path({str(tmp_path / "starts")!r})
count = len(starts.read_text()) if starts.exists() else 0
starts.write_text("x" * (count + 1))
if count < {deaths}: os.kill(os.getpid(), signal.SIGKILL)
"""
    client = make_client(die)
    if deaths == 1:
        client.start()
        assert client.pid
    else:
        with pytest.raises(EngineError, match="killed by signal 9") as caught:
            client.start()
        assert caught.value.exit_code == EXIT_RETRY
    assert (tmp_path / "starts").read_text() == "xx"


@pytest.mark.parametrize("after_handshake", [False, True])
def test_garbage_ends_the_engine_with_a_message(after_handshake):
    engine = raw_engine()
    link = Link(engine.stdout, engine.stdin)  # type: ignore[arg-type]
    assert link.receive() is not None
    if after_handshake:
        link.send(protocol.Welcome(protocol.PROTOCOL, __version__, -1, -1, -1))
    assert engine.stdin is not None
    engine.stdin.write(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
    while isinstance((answer := link.receive())[0], protocol.Alive | protocol.Progress):  # type: ignore[index]
        pass
    assert answer is not None
    assert answer[0].error == "EngineError"
    assert "expected the start of a message" in answer[0].problem
    assert engine.wait(5) == EXIT_INTERNAL
    assert b"protocol" in engine.communicate()[1]


def test_mutated_conversations_neither_crash_nor_hang(make_frame):
    """Whole sessions with damage in them: the engine answers or ends by itself, never by a signal."""
    rng = random.Random(11)
    from io import BytesIO

    pipe = BytesIO()
    link = Link(pipe, pipe)  # type: ignore[arg-type]
    link.send(protocol.Welcome(protocol.PROTOCOL, __version__, -1, -1, -1))
    start = len(pipe.getvalue())
    data, arrays = encode_frame(make_frame())
    arrays = {name: array[:2] for name, array in arrays.items()}
    link.send(protocol.LoadAsset(1, "/nowhere/a.drgs"))
    link.send(protocol.Render(2, data, dict.fromkeys(arrays, 1)), arrays)
    valid = pipe.getvalue()
    for _ in range(6):
        engine = raw_engine()
        damaged = bytearray(valid)
        for _ in range(rng.choice((1, 3))):
            damaged[rng.randrange(start, len(damaged))] = rng.randrange(256)
        engine.communicate(bytes(damaged), timeout=20)
        assert engine.returncode in (0, EXIT_INTERNAL), engine.returncode


def test_stray_output_cannot_corrupt_the_pipe(make_client):
    noise = "import os\nimport drgs_blender.engine.server as s\nold = s.Server.serve\n"
    noise += "def serve(self):\n    print('stray ' * 2000, flush=True); os.write(1, b'raw stray\\n'); old(self)\n"
    client = make_client(noise + "s.Server.serve = serve")
    with pytest.raises(AssetError, match="nowhere"):
        client.load_asset("/nowhere/ball.drgs")
    wait_until(lambda: "raw stray" in client.log, 2.0)  # another thread reads it
    assert len(client.log) < 1_500_000


def test_asset_error_crosses_the_link_with_its_parts(make_client, tmp_path):
    path = tmp_path / "broken.drgs"
    path.write_bytes(b"not an asset")
    with pytest.raises(AssetError) as caught:
        make_client().load_asset(str(path))
    assert caught.value.subject.startswith(str(path))
    assert caught.value.problem


@linux
def test_no_socket_has_an_address(make_client, make_frame, asset_path):
    client = make_client()
    client.load_asset(str(asset_path))
    client.render(make_frame())
    files = open_files(client.pid)
    assert [name for name in files if name.startswith("pipe:")]
    (pair,) = [name for name in files if name.startswith("socket:")]  # by which files of arrays come
    unix = [line.split() for line in Path("/proc/net/unix").read_text().splitlines()[1:]]
    assert next(row for row in unix if row[6] == pair.removeprefix("socket:[").rstrip("]"))[7:] == []


@linux
def test_engine_ends_with_its_killed_client_and_leaves_nothing(tmp_path, make_frame, asset_path):
    """The client is killed while the engine computes, so that only the system can tell it."""
    before = set(os.listdir("/dev/shm"))
    program = f"""
import sys; sys.path.insert(0, {str(ROOT)!r})
import json, numpy as np
from drgs_blender.ipc.client import EngineClient
from drgs_blender.core.frame import *
client = EngineClient({engine_program()!r})
key = client.load_asset({str(asset_path)!r})
camera = Camera(np.eye(4), 400, 300, 400, 400, 200, 150)
camera.matrix_world[2, 3] = 4
frame = Frame(1, camera, [ObjectState("Ball", key)], settings=RenderSettings(samples=12288))
client.render(frame, lambda phase, part: print(client.pid, phase, flush=True))
"""
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    parent = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, env=environment, text=True)
    assert parent.stdout is not None
    pid = int(parent.stdout.readline().split()[0])
    time.sleep(0.5)
    assert not gone(pid)
    parent.kill()
    parent.wait()
    assert all_gone([pid], 2.0)
    parent.stdout.close()
    assert set(os.listdir("/dev/shm")) <= before
    assert list(tmp_path.iterdir()) == []


@linux
def test_engine_ends_on_sigterm(make_client):
    client = make_client()
    client.start()
    pid = client.pid
    os.kill(pid, signal.SIGTERM)
    assert all_gone([pid], 5.0)
    with pytest.raises(AssetError):  # the next request starts another one
        client.load_asset("/nowhere")
    assert client.pid not in (0, pid)


def test_forgotten_client_takes_its_engine_along(make_client):
    client = EngineClient(engine_program())
    client.start()
    pid = client.pid
    del client
    assert all_gone([pid], 2.0)
