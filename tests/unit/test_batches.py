"""Batches of points: long enough to keep a device busy, short enough for drivers that end what takes two seconds."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drgs_blender.core.frame import RenderSettings
from drgs_blender.render import pipeline
from drgs_blender.render.backend import RenderBackend
from drgs_blender.render.prepared_scene import PreparedScene
from drgs_blender.render.shading_points import Radiance, ShadingPoints


class Timed(RenderBackend):
    """A processor that takes so many seconds a point, dearer ones from a point on; notes what each batch took."""

    def __init__(self, seconds: float, dear: float, first_dear: int) -> None:
        self.seconds, self.dear, self.first_dear = seconds, dear, first_dear
        self.clock, self.took, self.sizes = 0.0, [], []  # type: ignore[var-annotated]

    def integrate(self, *arguments: Any, surfels: object = None) -> Radiance:
        points = arguments[2]
        dear = int((points.pixel >= self.first_dear).sum())
        self.took.append((len(points) - dear) * self.seconds + dear * self.dear)
        self.sizes.append(len(points))
        self.clock += self.took[-1]
        return Radiance.dark(len(points))


@pytest.mark.parametrize("seconds", [1e-9, 1e-7, 1e-5])
def test_no_launch_takes_long_whatever_points_cost(seconds: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Half way, points take thirty times as long."""
    n, rows = 3_000_000, np.zeros((1, 3), np.float32)
    flat = np.broadcast_to(rows, (n, 3)), np.broadcast_to(rows[:, 0], (n,))
    normal = np.broadcast_to(np.float32([0, 0, 1]), (n, 3))
    points = ShadingPoints(
        np.arange(n), np.zeros(n), flat[1], flat[0], normal, normal, normal, flat[0], flat[1], flat[1]
    )  # fmt: skip
    slow = Timed(seconds, 30 * seconds, n // 2)
    monkeypatch.setattr(pipeline, "time", SimpleNamespace(perf_counter=lambda: slow.clock))
    frame: Any = SimpleNamespace(settings=RenderSettings(samples=16), noise_index=0)
    nothing: Any = None
    pipeline.Batches(PreparedScene(nothing, nothing, nothing), frame, lambda: None, slow).trace(points, (0, 1))
    assert sum(slow.sizes) == n and max(slow.took) < 1.0
    tail = slow.took[-max(1, len(slow.took) // 4) :]
    assert max(tail) < 2 * pipeline.BATCH_SECONDS, "it has learned what the dear ones cost"
    assert max(slow.sizes) <= 1 << 20 and (seconds > 1e-8 or max(slow.sizes) == 1 << 20)
