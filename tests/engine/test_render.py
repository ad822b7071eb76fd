"""Frames through the process: the same bits as without it, whatever happens on the way."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from drgs_blender.core.errors import AssetError, Cancelled, EngineError, UsageError
from drgs_blender.engine.session import Session

posix = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
ENDLESS = {"size": (400, 300), "samples": 4096}


@pytest.fixture(scope="module")
def expected(make_frame, asset_path):
    """The frame without a process."""
    session = Session()
    session.load_asset(asset_path)
    return session.render(make_frame(0.2))


@pytest.fixture
def client(make_client, asset_path):
    made = make_client()
    made.load_asset(str(asset_path))
    return made


def assert_same_bits(a, b):
    assert set(a) == set(b)
    for name in a:
        assert a[name].dtype == np.float32
        assert a[name].tobytes() == b[name].tobytes(), name


class Kill:
    """Progress callback that sends a signal to the engine when it first renders."""

    def __init__(self, client, number, times=1):
        self.client, self.number, self.left, self.pids = client, number, times, []

    def __call__(self, phase, fraction):
        if self.left and self.client.pid not in (0, *self.pids):
            self.left -= 1
            self.pids.append(self.client.pid)
            os.kill(self.client.pid, self.number)


@pytest.mark.parametrize("shared", [True, False])
def test_process_gives_the_bits_of_the_library(make_client, make_frame, asset_path, expected, shared):
    client = make_client(shared=shared)
    client.load_asset(str(asset_path))
    frame = make_frame(0.2)
    first, second = client.render(frame), client.render(frame)
    assert first["Combined"].shape == (36, 48, 4)
    assert np.isfinite(first["Combined"]).all()
    assert first["Combined"][..., :3].max() > 0.01
    assert 0.1 < first["Combined"][..., 3].mean() < 0.9
    assert_same_bits(first, expected)
    assert_same_bits(second, expected)
    assert first.statistics["triangles"] == expected.statistics["triangles"] > 0
    first["Combined"][:] = 0  # the result belongs to the caller
    assert_same_bits(client.render(frame), expected)


def test_only_what_changed_travels(client, make_frame):
    frame = make_frame()
    vertices, environment = frame.objects[0].vertices.nbytes, frame.world.environment.nbytes
    client.render(frame)
    sent = client.bulk_bytes[0]
    assert sent >= vertices + environment
    client.render(make_frame())  # equal, but other arrays
    assert client.bulk_bytes[0] == sent
    client.render(make_frame(0.3))
    moved = client.bulk_bytes[0] - sent
    assert vertices <= moved < vertices + 64
    frame.camera.matrix_world[2, 3] += 0.5
    frame.objects[0].vertices = make_frame(0.3).objects[0].vertices
    client.render(frame)
    assert client.bulk_bytes[0] - sent - moved == 128  # the camera's matrix alone


def test_array_changed_in_place_is_noticed(client, make_frame):
    frame = make_frame(0.2)
    before = client.render(frame)["Combined"]
    frame.objects[0].vertices[:, 2] *= 0.5
    assert not np.array_equal(client.render(frame)["Combined"], before)


def test_progress_is_told_on_the_calling_thread_and_grows(client, make_frame):
    told = []
    client.render(make_frame(), lambda *arguments: told.append((threading.current_thread(), *arguments)))
    assert {thread for thread, _, _ in told} == {threading.current_thread()}
    assert all(isinstance(phase, str) and 0 <= part <= 1 for _, phase, part in told)
    assert len({phase for _, phase, _ in told}) >= 2


@pytest.mark.alone
@pytest.mark.parametrize("delay", [0.0, 0.3, pytest.param(1.0, marks=pytest.mark.slow)])
def test_cancel_is_quick_and_the_engine_goes_on(client, make_frame, expected, delay):
    client.render(make_frame())
    pid, asked = client.pid, []

    def cancelled():
        asked.append(time.monotonic())
        return asked[-1] - asked[0] >= delay

    start = time.monotonic()
    with pytest.raises(Cancelled):
        client.render(make_frame(**ENDLESS), cancelled=cancelled)
    assert time.monotonic() - start < delay + 0.5
    assert np.diff(asked).max(initial=0) < 0.25  # 50 ms, and room for a busy machine
    assert_same_bits(client.render(make_frame(0.2)), expected)
    assert client.pid == pid


@pytest.mark.alone
@pytest.mark.slow
@posix
def test_engine_that_does_not_obey_is_ended(client, make_frame, expected):
    client.render(make_frame())
    pid = client.pid
    os.kill(pid, signal.SIGSTOP)
    start = time.monotonic()
    with pytest.raises(Cancelled):
        client.render(make_frame(), cancelled=lambda: True)
    assert time.monotonic() - start < 0.5
    assert_same_bits(client.render(make_frame(0.2)), expected)
    assert time.monotonic() - start < 15
    assert client.pid != pid


#: An engine whose later pictures take longer than one may that was asked to stop.
SLOW = """
import time
from drgs_blender.engine.session import Session
original = Session.render

def render(self, frame, progress=None, cancelled=None):
    time.sleep(0.8 * frame.noise_index)
    return original(self, frame, progress, cancelled)

Session.render = render
"""


def test_a_cancel_that_comes_too_late_ends_no_later_request(make_client, make_frame, asset_path, monkeypatch):
    """The answer was on its way; whoever looks whether the engine obeys may see the next request begun."""
    monkeypatch.setattr("drgs_blender.ipc.child_process.OBEY_SECONDS", 0.3)
    client, frame = make_client(SLOW), make_frame()
    client.load_asset(str(asset_path))
    frame.noise_index = 0
    client.render(frame)
    frame.noise_index, pid, answered, asked = 1, client.pid, client._number, []

    def stop() -> bool:
        if not asked:
            client._child.cancel(answered)
        asked.append(True)
        return False

    client.render(frame, None, stop)
    assert asked and client.pid == pid


@pytest.mark.slow
@posix
def test_killed_engine_is_replaced_and_the_picture_is_the_same(client, make_frame, expected):
    for _ in range(3):
        kill = Kill(client, signal.SIGKILL)
        assert_same_bits(client.render(make_frame(0.2), kill), expected)
        assert kill.pids and client.pid not in kill.pids
    os.kill(client.pid, signal.SIGKILL)  # while idle
    assert_same_bits(client.render(make_frame(0.2)), expected)


@pytest.mark.slow
@posix
def test_engine_killed_again_and_again_is_an_error(client, make_frame, expected):
    with pytest.raises(EngineError, match="killed by signal 9"):
        client.render(make_frame(), Kill(client, signal.SIGKILL, times=2))
    assert_same_bits(client.render(make_frame(0.2)), expected)


@pytest.mark.slow
@posix
@pytest.mark.parametrize("restarts", [0, 1] * (5 if os.environ.get("DRGS_FAULTS") == "whole" else 1))
def test_stopped_engine_meets_the_deadline(make_client, make_frame, asset_path, expected, restarts):
    client = make_client(silence=2.0, restarts=restarts)
    client.load_asset(str(asset_path))
    client.render(make_frame())
    stop = Kill(client, signal.SIGSTOP)
    start = time.monotonic()
    if restarts:
        assert_same_bits(client.render(make_frame(0.2), stop), expected)
    else:
        with pytest.raises(EngineError, match="did not answer for 2 s"):
            client.render(make_frame(0.2), stop)
    assert 2.0 <= time.monotonic() - start < 15
    assert_same_bits(client.render(make_frame(0.2)), expected)


@pytest.mark.slow
@posix
def test_asset_that_is_cut_off_in_place_is_an_error_until_it_is_whole(make_client, make_frame, asset_path, tmp_path):
    """The system ends an engine that looks at mapped bytes which are not there any more."""
    path = tmp_path / "ball.drgs"
    path.write_bytes(asset_path.read_bytes())
    client = make_client()
    key = client.load_asset(str(path))

    def frame(bend: float):
        made = make_frame(bend)
        return replace(made, objects=[replace(made.objects[0], asset=key)])

    before = client.render(frame(0.2))
    os.truncate(path, 1000)
    with pytest.raises((AssetError, EngineError)):
        for bend in (0.3, 0.4):
            client.load_asset(str(path))
            client.render(frame(bend))
    path.with_name("whole").write_bytes(asset_path.read_bytes())
    path.with_name("whole").replace(path)
    client.load_asset(str(path))
    assert_same_bits(client.render(frame(0.2)), before)


def test_closing_from_another_thread_ends_a_render(client, make_frame):
    client.render(make_frame())
    timer = threading.Timer(0.5, client.close)
    timer.start()
    start = time.monotonic()
    with pytest.raises(Cancelled):
        client.render(make_frame(**ENDLESS))
    timer.join()
    assert time.monotonic() - start < 3.0
    assert client.pid == 0


def test_a_second_thread_waits_its_turn_and_may_give_up(client, make_frame, expected):
    stop = threading.Event()
    ended = []

    def first():
        try:
            client.render(make_frame(**ENDLESS), cancelled=stop.is_set)
        except Cancelled:
            ended.append("first")

    thread = threading.Thread(target=first)
    thread.start()
    time.sleep(0.3)
    with pytest.raises(Cancelled):
        client.render(make_frame(), cancelled=lambda: True)
    stop.set()
    assert_same_bits(client.render(make_frame(0.2)), expected)
    thread.join(5)
    assert ended == ["first"]


def test_callback_that_raises_stops_the_engine_and_leaves_it_usable(client, make_frame, expected):
    def fail(phase, fraction):
        raise KeyError("from the caller")

    with pytest.raises(KeyError):
        client.render(make_frame(**ENDLESS), fail)
    assert_same_bits(client.render(make_frame(0.2)), expected)


def test_unusable_frames_are_refused_by_name_and_the_engine_lives(client, make_frame, expected):
    pid = client.pid
    frame = make_frame()
    frame.camera.fx = float("nan")
    with pytest.raises(UsageError, match="camera/fx"):
        client.render(frame)
    frame = make_frame()
    frame.objects[0].vertices = frame.objects[0].vertices[:-5]
    with pytest.raises(AssetError, match=r"Ball.*vertices"):
        client.render(frame)
    frame = make_frame()
    frame.objects[0].vertices[3] = np.nan
    passes = client.render(frame)
    assert any("Ball: 1 vertices are not finite" in text for text in passes.warnings)
    assert np.isfinite(passes["Combined"]).all()
    assert_same_bits(client.render(make_frame(0.2)), expected)
    assert client.pid == pid


def test_engine_that_lost_an_array_asks_for_it(client, make_frame, expected):
    client.render(make_frame(0.2))
    sent = client.bulk_bytes[0]
    client._sent._held = {slot: (version + 100, array) for slot, (version, array) in client._sent._held.items()}
    assert_same_bits(client.render(make_frame(0.2)), expected)
    assert client.bulk_bytes[0] >= 2 * sent - 64  # all of it, once more


def test_impatient_viewport_gets_its_picture_from_a_cold_engine(make_client, make_frame, asset_path, expected):
    """Cancelling again and again while the engine starts does not keep it from starting."""
    client = make_client()
    pids = set()
    for _ in range(30):
        deadline = time.monotonic() + 0.1
        try:
            client.load_asset(str(asset_path), cancelled=lambda: time.monotonic() > deadline)  # noqa: B023
            client.render(make_frame(), cancelled=lambda: time.monotonic() > deadline)  # noqa: B023
        except Cancelled:
            pass
        pids.add(client.pid)
    client.load_asset(str(asset_path))
    assert_same_bits(client.render(make_frame(0.2)), expected)
    assert len({*pids, client.pid}) == 1


def test_engine_outlives_the_thread_that_started_it(make_client, make_frame, asset_path, expected):
    """Linux ties a child to the *thread* that made it; Blender renders in threads that come and go."""
    client = make_client()
    thread = threading.Thread(target=client.load_asset, args=(str(asset_path),))
    thread.start()
    thread.join()
    pid = client.pid
    time.sleep(0.2)
    assert_same_bits(client.render(make_frame(0.2)), expected)
    assert client.pid == pid


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_engines_that_come_and_go_leave_no_thread_and_no_file_behind(client, make_frame):
    def held():
        return threading.active_count(), len(os.listdir("/proc/self/fd"))

    client.render(make_frame())
    before = held()
    for _ in range(3):
        os.kill(client.pid, signal.SIGKILL)
        client.render(make_frame())
    assert held() == before
    client.close()
    assert held()[0] == before[0] - 3
    assert held()[1] <= before[1] - 4
