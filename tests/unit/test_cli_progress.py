"""What commands say while kernels are compiled: bars on terminals, lines for people and for programs without."""

from __future__ import annotations

import argparse
import io
import re
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from drgs_blender.cli import picture as pictures
from drgs_blender.cli import progress
from drgs_blender.cli.frame_lines import FrameLines
from drgs_blender.cli.progress import FractionBar, Steps
from drgs_blender.core.errors import Cancelled, EngineError
from drgs_blender.core.phases import PREPARING, is_counted, is_preparing
from drgs_blender.ipc.protocol import Passes

COUNTED = [(f"{PREPARING}, {i} of 4", i / 4) for i in range(1, 5)]


def options(**given: object) -> argparse.Namespace:
    return argparse.Namespace(**{"quiet": False, "progress": None} | given)


def test_phases_are_told_apart():
    assert is_preparing(PREPARING) and not is_counted(PREPARING)
    assert all(is_preparing(phase) and is_counted(phase) for phase, _ in COUNTED)
    assert not is_preparing("Rendering") and not is_preparing("")


def test_the_bar_of_the_work_begins_anew_after_that_of_its_kernels(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    with FractionBar(options(progress=True), "rendering") as bar:
        for phase, part in COUNTED:
            bar(phase, part)
        bar._bar.refresh()
        bar("Rendering", 0.25)
        bar._bar.refresh()
    said = capsys.readouterr().err
    assert re.search(rf"{re.escape(COUNTED[-1][0])}.*100%", said) and re.search(r"Rendering.* 25%", said)


def test_without_a_terminal_a_line_says_it_now_and_then(capsys, monkeypatch):
    monkeypatch.setattr(progress, "PEOPLE_SECONDS", 0.0)
    for given in ({}, {"quiet": True}, {"progress": False}):
        with FractionBar(options(**given), "rendering") as bar:
            for phase, part in (*COUNTED, ("Rendering", 0.5)):
                bar(phase, part)
    assert capsys.readouterr().err.splitlines() == [f"drgs: {phase}" for phase, _ in COUNTED]


def test_without_a_terminal_long_work_says_how_far_it_is(capsys):
    for every, said in ((0.0, []), (60.0, ["drgs: 1 of 3 views"])):
        with FractionBar(options(), "rendering", every=every) as bar:
            for k in (1, 2, 3):
                bar(f"{k} of 3 views", k / 3)
        assert capsys.readouterr().err.splitlines() == said
    with FractionBar(options(), "capturing", every=60.0) as bar:
        bar("matching features", 0.4)
    assert capsys.readouterr().err.splitlines() == ["drgs: matching features, 40% of all"]


def test_a_second_try_takes_nothing_back(capsys):
    with FractionBar(options(), "capturing", every=1e-9) as bar:
        for part in (0.59, 0.54, 0.6):
            bar("matching features", part)
    said = [line.rsplit(" ", 3)[1] for line in capsys.readouterr().err.splitlines()]
    assert said == ["59%", "59%", "60%"]


def test_programs_read_it_with_its_fraction(capsys, monkeypatch):
    monkeypatch.setattr(progress, "PROGRAM_SECONDS", 0.0)
    with FractionBar(options(progress=False), "preparing", programs=True) as bar:
        for phase, part in COUNTED:
            bar(phase, part)
    assert not capsys.readouterr().out, "nobody asked"
    monkeypatch.setenv("DRGS_PROGRESS", "1")
    with FractionBar(options(progress=False), "preparing", programs=True) as bar:
        for phase, part in COUNTED:
            bar(phase, part)
    out = capsys.readouterr().out.splitlines()
    assert out[0] == f'DRGS_PROGRESS part=0.250 phase="{PREPARING}, 1 of 4"'
    assert out[-1] == 'DRGS_PROGRESS part=1.000 phase="Ready"'
    with FractionBar(options(progress=False), "preparing", programs=True):
        pass  # nothing was missing
    assert not capsys.readouterr().out


def test_farms_read_that_nothing_of_the_frame_is_done(capsys):
    with FrameLines(interval=0, openjd=2) as lines:
        lines.begin(7, 16)
        for phase, part in COUNTED:
            lines.progress(7, phase, part)
    out = capsys.readouterr().out
    assert f"Fra:7 | {PREPARING}, 3 of 4 | Sample 0/16" in out
    assert set(re.findall(r"openjd_progress: ([\d.]+)", out)) == {"0.0"}
    assert f"openjd_status: frame 7, {PREPARING}, 3 of 4" in out


class Engine:
    """Compiles, then renders, for so many seconds; told all the time, as by an engine's client."""

    def __init__(self, compiles: float, renders: float) -> None:
        self.times = ((f"{PREPARING}, 1 of 2", compiles), ("Rendering", renders))

    def render(self, frame, on_progress, cancelled):
        for phase, seconds in self.times:
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                on_progress(phase, 0.5)
                if cancelled():
                    raise Cancelled
                time.sleep(0.01)
        return Passes({"Combined": np.zeros((1, 1, 4), np.float32)}, [], {})


def test_kernels_do_not_count_as_time_of_a_frame(monkeypatch):
    monkeypatch.setattr(pictures.frame_store, "settings_hash", lambda frame, assets: "")
    frame = SimpleNamespace(noise_index=0)  # of the noise, as Animated Seed is off: it is not the one that is rendered
    shot = pictures.Picture.__new__(pictures.Picture)
    shot._shot, shot.frame = SimpleNamespace(count=0, number=7), frame
    told = []
    shot.render(Engine(1.0, 0.1), {}, lambda phase, part: told.append(phase), timeout=0.5)
    assert told[0] == f"{PREPARING}, 1 of 2" and told[-1] == "Rendering"
    with pytest.raises(EngineError, match=r"frame 7: took longer than 0\.5 s"):
        shot.render(Engine(0.1, 2.0), {}, lambda phase, part: None, timeout=0.5)


def test_ctrl_c_ends_the_wait_for_kernels(monkeypatch):
    """The first one is heard by whoever compiles."""
    from drgs_blender.compute import prepare

    began = threading.Event()

    def slow(jobs, show, stopped):
        assert jobs == ("simulate",)
        end = time.monotonic() + 30
        while time.monotonic() < end:
            show(*COUNTED[0])
            began.set()
            if stopped():
                raise Cancelled
            time.sleep(0.01)

    monkeypatch.setattr(prepare, "prepare_kernels", slow)
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    import _thread

    threading.Thread(target=lambda: (began.wait(30), _thread.interrupt_main()), daemon=True).start()
    start = time.monotonic()
    with pytest.raises(Cancelled):
        progress.prepare_engine(options(), "simulate")
    assert time.monotonic() - start < 10


def test_steps_are_one_bar(capsys, monkeypatch):
    """Where a step ends the next one begins; compiling kernels counts by itself."""
    monkeypatch.setattr(progress, "WORK_SECONDS", 1e-9)
    steps = Steps(options(), "reconstructing")
    for part, phases in ((0.25, ("matching", "registering")), (1.0, ("surfels", "mesh"))):
        with steps.step(part) as bar:
            for phase, done in zip(phases, (0.2, 1.0)):
                bar(phase, done)
            assert bar.of_all(1.0) == (0.25 if part < 1 else 1.0)
    said = [line.split(", ")[1] for line in capsys.readouterr().err.splitlines()]
    assert said == ["5% of all", "25% of all", "40% of all", "100% of all"]
