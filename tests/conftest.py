"""Fixtures every suite may use."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from disks import mount, unmount
from pace import (  # noqa: F401  # hooks
    pytest_addoption,
    pytest_collection_modifyitems,
    pytest_fixture_setup,
    pytest_runtest_call,
    pytest_runtest_protocol,
)

# Started in the background, tests inherit that Ctrl+C is ignored, and programs that they start would, too.
signal.signal(signal.SIGINT, signal.default_int_handler)

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of development data (real meshes, rigs, captures); the test is skipped where it is absent."""
    folder = Path(os.environ.get("DRGS_SHARED", ROOT.parent / "shared")) / "data"
    if not folder.is_dir():
        pytest.skip(f"development data not found at {folder} (set DRGS_SHARED)")
    return folder


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Callable[[str], Path]]:
    """Function that mounts a disk with the options given, or changes those it has; skips where that is not allowed."""
    place = tmp_path / "disk"

    def disk(options: str) -> Path:
        if not mount(place, options):
            pytest.skip("a disk cannot be mounted here")
        return place

    yield disk
    unmount(place)
