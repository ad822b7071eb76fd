"""Fixtures every suite may use."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of development data (real meshes, rigs, captures); the test is skipped where it is absent."""
    folder = Path(os.environ.get("DRGS_SHARED", ROOT.parent / "shared")) / "data"
    if not folder.is_dir():
        pytest.skip(f"development data not found at {folder} (set DRGS_SHARED)")
    return folder
