"""What several tests of one stage share."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from drgs_blender.render.device.on_device import OnDevice


@pytest.fixture(scope="session")
def _device() -> OnDevice:
    pytest.importorskip("warp", reason="warp-lang is not installed")
    from drgs_blender.render.device.on_device import OnDevice

    return OnDevice("cpu")


@pytest.fixture
def device(_device: OnDevice) -> Iterator[OnDevice]:
    """Warp's processor, as a card; what it failed at would be done here, and be like itself."""
    _device.failed = ""
    yield _device
    assert not _device.failed, _device.failed
