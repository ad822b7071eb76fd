"""`drgs reconstruct` at a terminal: what it shows, and how it stops."""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("torch")
pytest.importorskip("skimage")

from capture_cases import balls, write

from drgs_blender.cli.interrupt import interruptible
from drgs_blender.cli.main import main
from drgs_blender.cli.reconstruct import clear
from drgs_blender.core.errors import Cancelled
from drgs_blender.core.phases import PREPARING

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals and terminals of POSIX")


@pytest.fixture(scope="module")
def photographs(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("balls")
    write(balls(8, 32), folder)
    return folder


def command(photographs: Path, out: Path, *options: str) -> list[str]:
    program = [sys.executable, "-m", "drgs_blender.cli.main", "reconstruct", str(photographs), "--out", str(out)]
    return [*program, "--surfels", "400", "--voxels", "24", *options]


@pytest.mark.slow
def test_a_terminal_shows_a_bar_and_no_lines_for_programs(photographs, tmp_path):
    import pty

    ours, theirs = pty.openpty()  # of no size, as many that programs make
    words = command(photographs, tmp_path / "a.drgs", "--time-budget", "0.1")
    process = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=theirs, stderr=theirs)
    os.close(theirs)
    said = b""
    try:
        while some := os.read(ours, 4096):
            said += some
    except OSError:  # Linux's way to say that the other end is closed
        pass
    os.close(ours)
    text = said.decode()
    assert process.wait(60) == 0 and "DRGS_PROGRESS" not in text
    assert re.search(re.escape(PREPARING) + r"(, \d+ of \d+)?: +\d+%\|", text)
    assert re.search(r"materials, \d+ surfels, [\d.]+ dB:", text)
    assert "materials got" in text and "materials in the light that was found, pixels learned from: PSNR" in text


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)], ids=["SIGINT", "SIGTERM"])
def test_a_run_that_is_stopped_early_goes_on(photographs, tmp_path, number, code):
    words = command(photographs, tmp_path / "a.drgs", "--iterations", "1000000", "-v")
    said = []
    for _ in range(2):
        asked = os.environ | {"DRGS_PROGRESS": "1"}
        with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=asked) as process:
            line = process.stdout.readline()
            process.send_signal(number)
            said.append(process.communicate(timeout=60)[1])
            assert line.startswith("DRGS_PROGRESS") and process.returncode == code
        assert "the same command goes on from here" in said[-1]
    assert "going on" not in said[0]
    assert "an earlier run was stopped" in said[1] and "surfels: going on at step" in said[1]


def test_what_lies_where_the_run_keeps_its_own_stays(photographs, tmp_path, capsys):
    """As photographs in a folder that is named like the one beside the asset; a run that failed leaves nothing."""
    mine = tmp_path / "a.reconstruct"
    shutil.copytree(photographs, mine)
    before = {file.name for file in mine.iterdir()}
    options = ["--surfels", "400", "--voxels", "24", "--iterations", "4", "--no-materials"]
    assert main(["reconstruct", str(mine), "--out", str(tmp_path / "a.drgs"), *options]) == 0
    assert {file.name for file in mine.iterdir()} == before
    for picture in mine.glob("*.png"):
        Image.fromarray(np.zeros((32, 32, 4), np.uint8)).save(picture)
    assert main(["reconstruct", str(mine), "--out", str(tmp_path / "b.drgs"), *options]) == 65
    assert "b.reconstruct" not in {file.name for file in tmp_path.iterdir()}


def test_a_signal_is_not_lost_in_a_callback_from_c_and_a_second_one_ends_at_once():
    before = signal.getsignal(signal.SIGINT)
    interrupt = ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt), interruptible() as cancelled:
        assert not cancelled()
        interrupt()
        assert cancelled()
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before
    with pytest.raises(SystemExit, match="143"), interruptible() as cancelled:
        signal.raise_signal(signal.SIGTERM)
        raise Cancelled


def test_halves_of_assets_that_killed_runs_were_writing_go_with_what_they_kept(tmp_path):
    work, asset = tmp_path / "[a].reconstruct", tmp_path / "[a].drgs"
    work.mkdir()
    others = [tmp_path / name for name in (".a.drgs.12345678.tmp", ".[a].drgs.young.tmp", "[a].drgs")]
    mine = [work / "surfels.state", work / ".surfels.state.1234.tmp", tmp_path / ".[a].drgs.12345678.tmp"]
    for file in (*others, *mine):
        file.touch()
        if "young" not in file.name:
            os.utime(file, (1e9, 1e9))
    clear(work, asset)
    assert all(file.exists() for file in others) and not any(file.exists() for file in (*mine, work))
