"""What a client hears while kernels are compiled, and that it can leave at any time."""

from __future__ import annotations

import sys
import time

import pytest
from processes import all_gone, children

from drgs_blender.core.errors import Cancelled
from drgs_blender.core.phases import PREPARING, STARTING, is_counted, is_preparing

#: An engine that counts kernels before its pictures, as if they were compiled elsewhere.
COUNTED = f"""
import time
from drgs_blender.engine.session import Session
from drgs_blender.core.errors import Cancelled
original = Session.render

def render(self, frame, progress=None, cancelled=None):
    for i in range({{steps}}):
        for _ in range(4):
            progress({PREPARING!r} + f", {{{{i}}}} of 12", i / 12)
            if cancelled():
                raise Cancelled
            time.sleep(0.1)
    return original(self, frame, progress, cancelled)

Session.render = render
"""


@pytest.mark.slow
def test_a_kernel_that_is_compiled_is_told_and_can_be_left_at_once(make_client, make_frame, asset_path, tmp_path):
    """The engine has no kernels, and is in the middle of one when it is asked to stop."""
    client = make_client(f"import os; os.environ['DRGS_CACHE_DIR'] = {str(tmp_path)!r}")
    client.load_asset(str(asset_path))
    told: list[tuple[str, float]] = []

    def stop() -> bool:
        return is_preparing(told[-1][0]) if told else False

    for _ in range(2):  # also while the engine has not yet heard of the first time
        told.clear()
        with pytest.raises(Cancelled):
            client.render(make_frame(), lambda phase, part: told.append((phase, part)), stop)
        seen = next(i for i, (phase, _) in enumerate(told) if is_preparing(phase))
        assert all(not is_preparing(phase) for phase, _ in told[:seen])
    began = time.monotonic()
    with pytest.raises(Cancelled):
        client.render(make_frame(), None, lambda: True)
    assert time.monotonic() - began < 0.5
    began = time.monotonic()
    client.close()
    assert time.monotonic() - began < 3.0


def test_counted_kernels_reach_the_client_with_their_fraction(make_client, make_frame, asset_path):
    client = make_client(COUNTED.format(steps=4))
    client.load_asset(str(asset_path))
    told: list[tuple[str, float]] = []
    client.render(make_frame(), lambda phase, part: told.append((phase, part)))
    counted = list(dict.fromkeys((phase, round(12 * part)) for phase, part in told if is_counted(phase)))
    assert counted == [(f"{PREPARING}, {i} of 12", i) for i in range(4)]
    last = max(i for i, (phase, _) in enumerate(told) if is_counted(phase))
    assert len(told) > last + 1  # the picture follows
    first = next(i for i, (phase, _) in enumerate(told) if is_counted(phase))
    assert {phase for phase, _ in told[first : last + 1]} == {phase for phase, _ in told if is_counted(phase)}
    assert {phase for phase, _ in told[:first]} <= {STARTING, "Deforming"}


@pytest.mark.slow
def test_counted_kernels_are_no_reason_to_kill_the_engine(make_client, make_frame, asset_path, monkeypatch):
    """They take longer than an engine may that was asked to stop, and are heard of all the time."""
    client = make_client(COUNTED.format(steps=12))
    client.load_asset(str(asset_path))
    client.render(make_frame())
    pid = client.pid
    told: list[str] = []
    began = 0.0

    def stop() -> bool:
        nonlocal began
        if not began and any("3 of 12" in phase for phase in told):
            began = time.monotonic()
        return began > 0

    with pytest.raises(Cancelled):
        client.render(make_frame(), lambda phase, part: told.append(phase), stop)
    assert time.monotonic() - began < 0.5
    client.render(make_frame())
    assert client.pid == pid


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_who_compiles_ends_with_a_killed_engine(make_client, make_frame, asset_path, tmp_path):
    """In the middle of a kernel, which takes seconds; Blender may have been closed."""
    before = f"import os; os.environ |= {{'DRGS_CACHE_DIR': {str(tmp_path)!r}, 'DRGS_PREPARE': '1'}}"
    client = make_client(before)
    client.load_asset(str(asset_path))
    workers: list[int] = []

    def tell(phase: str, part: float) -> None:
        if is_counted(phase):
            workers[:] = children(client.pid)

    with pytest.raises(Cancelled):
        client.render(make_frame(), tell, lambda: len(workers) > 0 and (client._child.kill() or True))
    assert all_gone(workers, 5.0)


@pytest.mark.slow
def test_a_folder_that_cannot_keep_kernels_is_named_with_each_picture(make_client, make_frame, asset_path, tmp_path):
    """Otherwise nobody would know why every start takes so long; the picture is the same."""
    (tmp_path / "file").write_text("")
    client = make_client(f"import os; os.environ |= {{'DRGS_CACHE_DIR': {str(tmp_path / 'file' / 'kernels')!r}}}")
    engines = make_client(), client
    for engine in engines:
        engine.load_asset(str(asset_path))
    usual, found = (engine.render(make_frame()) for engine in engines)
    assert not any("compiled kernels" in warning for warning in usual.warnings)
    assert any(str(tmp_path) in warning and "cannot be kept" in warning for warning in found.warnings)
    assert (found["Combined"] == usual["Combined"]).all()
