"""Engines that may take only so much memory."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from drgs_blender.core.errors import EXIT_RETRY, EngineError
from drgs_blender.engine.memory_limit import requested_limit

linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux alone has such a limit")


def test_option_wins_over_the_variable(monkeypatch, caplog):
    monkeypatch.setenv("DRGS_MEMORY_MB", "500")
    assert requested_limit(["-m", "--memory-mb", "700"]) == 700
    assert requested_limit(["-m"]) == requested_limit(["-m", "--memory-mb"]) == 500
    for unlimited in ("", "0"):
        monkeypatch.setenv("DRGS_MEMORY_MB", unlimited)
        assert requested_limit([]) is None
    assert not caplog.messages
    for nonsense in ("-3", "much", "4GB", "9" * 20):
        monkeypatch.setenv("DRGS_MEMORY_MB", nonsense)
        assert requested_limit([]) is None
        assert caplog.messages.pop().startswith(f"DRGS_MEMORY_MB is {nonsense}, which is no number of megabytes")
        caplog.clear()


@linux
def test_allocations_beyond_the_limit_fail_and_others_do_not():
    program = """
import numpy as np
from drgs_blender.engine.memory_limit import limit_memory
assert limit_memory(400)
np.ones(100 << 17)
try:
    np.ones(500 << 17)
except MemoryError:
    print("refused")
"""
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert result.stdout == "refused\n", result.stderr


@pytest.mark.slow
@linux
def test_frame_that_does_not_fit_can_be_given_back_and_a_smaller_one_still_works(
    make_client, make_frame, asset_path, monkeypatch
):
    monkeypatch.setenv("DRGS_MEMORY_MB", "900")
    client = make_client()
    client.load_asset(str(asset_path))
    large = make_frame(size=(9000, 9000), samples=1)
    with pytest.raises(EngineError, match=r"memory|killed|exited") as caught:
        client.render(large)
    assert caught.value.exit_code == EXIT_RETRY
    assert np.isfinite(client.render(make_frame())["Combined"]).all()
