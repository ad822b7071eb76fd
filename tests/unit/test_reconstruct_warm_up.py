"""Before the clock of a reconstruction runs, its kernels are ready."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("torch")
pytest.importorskip("skimage")

from capture_cases import balls

from drgs_blender.core.phases import PREPARING
from drgs_blender.reconstruct.inverse_rendering.settings import Settings as Decoupling
from drgs_blender.reconstruct.optim.schedule import Schedule
from drgs_blender.reconstruct.pipeline import Settings, reconstruct

#: A process of its own, where nothing is compiled yet: prints the steps by which a kernel was made or loaded.
STEPS = """
import gc, sys
from numba.core.dispatcher import Dispatcher
sys.path.insert(0, sys.argv[1])
from capture_cases import balls
from drgs_blender.reconstruct import pipeline as job
from drgs_blender.reconstruct.inverse_rendering import run
from drgs_blender.reconstruct.inverse_rendering.settings import Settings as Decoupling
from drgs_blender.reconstruct.optim.schedule import Schedule
from drgs_blender.reconstruct.optim.train import Training

variant, masked = sys.argv[2], sys.argv[3] == "masks"
watching, warm_up = False, job.warm_up

def kernels():
    return sum(len(found.overloads) for found in gc.get_objects() if isinstance(found, Dispatcher))

def watched(step):
    def watch(self):
        before = kernels()
        step(self)
        if watching and kernels() > before:
            at = self.learner if isinstance(self, Training) else self.schedule
            print(type(self).__name__, at.iteration)
    return watch

def then_watch(*arguments):
    global watching
    warm_up(*arguments)
    watching = True

Training.step, run.Job.step, job.warm_up = watched(Training.step), watched(run.Job.step), then_watch
capture = balls(18, 24, masks=masked)
if not masked:
    capture.background = None
quick = Decoupling(iterations=8, pixels=64, normals=True)
schedule = Schedule(iterations=30, surfels=400, patches=float(sys.argv[4]))
job.reconstruct(capture, job.Settings(variant, schedule, mesh_resolution=16, minutes=100.0, decoupling=quick))
print("watched:", watching)
"""


@pytest.mark.slow
@pytest.mark.parametrize(("variant", "masks", "patches"), [("m", "masks", "0"), ("p", "none", "0.5")])
def test_no_step_that_is_timed_compiles(variant, masks, patches):
    command = [sys.executable, "-c", STEPS, str(Path(__file__).parent), variant, masks, patches]
    said = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert said.stdout == "watched: True\n", said.stdout + said.stderr
    assert said.stderr.count("patches are not compared") <= 1, "of the capture alone"


@pytest.mark.parametrize(
    ("minutes", "seconds"), [(None, 0.0), (0.01, 0.0), (None, 0.2)], ids=["by steps", "by the clock", "by seconds"]
)
def test_too_little_time_for_materials_is_said(minutes, seconds, monkeypatch, caplog):
    warmed, told = [], []
    monkeypatch.setattr("drgs_blender.reconstruct.pipeline.warm_up", lambda *_: warmed.append(1))
    limited = minutes is not None or seconds > 0
    quick = Decoupling(iterations=10**6 if limited else 4, pixels=64, normals=True, seconds=seconds)
    settings = Settings(schedule=Schedule(iterations=10, surfels=400), mesh_resolution=16, decoupling=quick)
    reconstruct(balls(8, 24), replace(settings, minutes=minutes), told.append)
    assert bool(warmed) == any(progress.phase == PREPARING for progress in told) == (minutes is not None)
    assert ("materials got" in caplog.text) == limited
    assert minutes is None or ("in their part of 0.01 minutes" in caplog.text and "Give more minutes" in caplog.text)
    assert not seconds or ("in their 0.2 seconds" in caplog.text and "decoupling.seconds=S" in caplog.text)
