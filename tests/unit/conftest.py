"""What several tests of one stage share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from cards import DEVICE

if TYPE_CHECKING:
    from drgs_blender.render.gpu.warp_backend import WarpRenderBackend


@pytest.fixture(scope="session")
def _device() -> WarpRenderBackend:
    pytest.importorskip("warp", reason="warp-lang is not installed")
    from drgs_blender.render.gpu.warp_backend import WarpRenderBackend

    return WarpRenderBackend(DEVICE)


@pytest.fixture
def device(_device: WarpRenderBackend) -> Iterator[WarpRenderBackend]:
    """Warp's processor, as a card; what it failed at would be done here, and be like itself."""
    _device.failed = ""
    yield _device
    assert not _device.failed, _device.failed


@pytest.fixture
def compiled() -> Iterator[list[str]]:
    """The names of functions that were compiled for Python, but Numba's own: those whichever test comes first needs."""
    from numba.core import event

    names: list[str] = []

    class Count(event.Listener):
        def on_start(self, event: event.Event) -> None:
            function = event.data["dispatcher"].py_func
            if "numba" not in Path(function.__code__.co_filename).parts:
                names.append(function.__name__)

        def on_end(self, event: event.Event) -> None:
            pass

    count = Count()
    event.register("numba:compile", count)
    yield names
    event.unregister("numba:compile", count)
