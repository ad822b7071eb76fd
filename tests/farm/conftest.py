"""A scene to render, and ways to start and to spoil jobs."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from blend_files import make_blend_files

from drgs_blender.cli.find_blender import CHECKOUT
from drgs_blender.cli.main import main
from drgs_blender.render.film.frame_files import read_frame

#: How a node of a test starts ``drgs``: this checkout, whatever else is installed.
PROGRAM = ("" if os.name == "nt" else f"env PYTHONPATH={CHECKOUT} ") + f"{sys.executable} -m drgs_blender.cli.main"
#: The slow faults run as well.
WHOLE = os.environ.get("DRGS_FAULTS") == "whole"


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An asset and Blender files that show it moving to the right from frame 1 to 3."""
    folder = tmp_path_factory.mktemp("scene")
    make_blend_files(folder)
    return folder


@pytest.fixture
def drgs(capsys: pytest.CaptureFixture) -> Callable[..., tuple[int, list[str], str]]:
    """Function that runs ``drgs`` in this process; returns (exit code, lines on stdout, text on stderr)."""

    def run(*arguments: object) -> tuple[int, list[str], str]:
        capsys.readouterr()
        code = main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return code, captured.out.splitlines(), captured.err

    return run


def same_pixels(first: Path, second: Path) -> bool:
    """Whether two frames have the same passes, bit for bit."""
    a, b = read_frame(first)[0], read_frame(second)[0]
    return a.keys() == b.keys() and all(np.array_equal(a[name], b[name], equal_nan=True) for name in a)
