"""Both programs against numbers rendered with Cycles of Blender 5.0.1: Principled BSDF, distribution GGX.

The scene: a plane with base colour (0.8, 0.5, 0.2) under `sky`, turned by a Mapping node with Rotation Z of 40 degrees,
seen by an orthographic camera whose view direction has the cosine given and the azimuth of 0.6 radians; direct light
only, means of 32 x 32 pixels with 1024 samples (error 0.01 %). Cycles holds the picture in half precision, which
accounts for a deviation of 0.1 %.
"""

from __future__ import annotations

import importlib
import math
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from drgs_blender.core.frame import RenderSettings, World  # noqa: E402
from drgs_blender.render.integrator.integrate import integrate as kernel_integrate  # noqa: E402
from drgs_blender.render.lights.environment import EnvironmentLight  # noqa: E402
from drgs_blender.render.reference.integrate import EmptyTracer, SurfacePoints, integrate_quadrature  # noqa: E402
from drgs_blender.render.reference.light import Light  # noqa: E402
from drgs_blender.render.scene.trace_scene import TraceScene  # noqa: E402
from drgs_blender.render.shading_points import ShadingPoints  # noqa: E402

torch.set_num_threads(1)

# (roughness, metallic, cosine of the view), diffuse direct, glossy direct; colour included.
CYCLES = [
    ((0.2, 0.0, 0.9), (0.49050, 0.26007, 0.10613), (0.02051, 0.01992, 0.00927)),
    ((0.5, 0.0, 0.5), (0.47076, 0.24956, 0.10184), (0.02585, 0.01543, 0.01888)),
    ((0.8, 0.0, 0.25), (0.46938, 0.24882, 0.10155), (0.02602, 0.01863, 0.02184)),
    ((1.0, 0.0, 0.9), (0.48984, 0.25976, 0.10597), (0.00888, 0.00743, 0.00770)),
    ((0.3, 1.0, 0.7), (0.0, 0.0, 0.0), (0.36631, 0.14941, 0.03285)),
    ((0.7, 1.0, 0.3), (0.0, 0.0, 0.0), (0.29377, 0.14636, 0.06578)),
    ((0.5, 0.5, 0.6), (0.23939, 0.12697, 0.05182), (0.15327, 0.07280, 0.03292)),
    ((0.15, 0.3, 0.35), (0.29919, 0.15861, 0.06476), (0.12240, 0.02670, 0.05378)),
]
EXPECTED = np.array([(diffuse, glossy) for _, diffuse, glossy in CYCLES])


def sky() -> World:
    """Low-resolution noise with a light: every error of mapping, rotation or interpolation shows."""
    image = np.random.default_rng(3).random((8, 16, 3)).astype(np.float32) ** 2
    image[2, 5] = 12.0
    c, s = math.cos(math.radians(40)), math.sin(math.radians(40))
    return World(image, np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]))


def plane_points() -> dict[str, np.ndarray]:
    roughness, metallic, cosine = np.array([setup for setup, *_ in CYCLES]).T
    sine = np.sqrt(1 - cosine**2)
    up = np.tile((0.0, 0.0, 1.0), (len(CYCLES), 1))
    return {
        "origin": 0 * up,
        "normal": up,
        "geometric_normal": up,
        "view": np.stack([sine * math.cos(0.6), sine * math.sin(0.6), cosine], 1),
        "albedo": np.tile((0.8, 0.5, 0.2), (len(CYCLES), 1)),
        "roughness": roughness,
        "metallic": metallic,
    }


def test_reference_agrees_with_cycles():
    points = SurfacePoints(**{name: torch.from_numpy(values) for name, values in plane_points().items()})
    found = integrate_quadrature(EmptyTracer(), Light.from_world(sky()), points, 256).numpy()
    np.testing.assert_allclose(found[:, [0, 2]], EXPECTED, rtol=2e-3, atol=1e-5)


def test_kernel_agrees_with_cycles():
    """Means of 4000 pixels of 32 rays; the deviation is judged by the spread of the pixels."""
    pixels, points = 4000, plane_points()
    n = len(CYCLES)
    rows = {name: np.tile(values, (pixels, *[1] * (values.ndim - 1))) for name, values in points.items()}
    strip = ShadingPoints(np.arange(n * pixels), np.zeros(n * pixels), np.ones(n * pixels), **rows)
    scene = TraceScene()
    scene.update([])
    found = kernel_integrate(
        scene, EnvironmentLight(sky()), strip, RenderSettings(samples=32, bounces=0, subpixel_samples=1), 1
    )
    scene.close()
    found = found.components[:, [0, 2]].reshape(pixels, n, 2, 3).astype(float)
    error = found.std(0) / math.sqrt(pixels)
    assert (np.abs(found.mean(0) - EXPECTED) <= 4 * error + 2e-3 * EXPECTED + 1e-5).all()
    assert (error <= 0.01 * EXPECTED + 1e-5).all()


@pytest.mark.parametrize("difference", [0.0, 0.004])
def test_systematic_error_sees_through_noise(monkeypatch, difference):
    """Rare bright dots ten times as bad as the difference do not move its estimate by more than its error says."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "bench"))
    judge = importlib.import_module("judge")
    rng = np.random.default_rng(11)
    grey = np.full((4, 64, 64, 4), 0.3)
    dots = np.where(rng.random((4, 64, 64, 1)) < 2e-3, 0.4, 0.0)
    theirs = grey + dots - dots.mean() + rng.normal(0, 0.01, grey.shape)
    ours = grey + rng.normal(0, 0.01, grey.shape)
    # Given in sRGB, so that the expected error is the difference squared.
    slope = (judge.to_srgb(0.301) - judge.to_srgb(0.299)) / 0.002
    ours += difference / slope
    mask = np.ones((64, 64), bool)
    error, deviation = judge.systematic_error(ours, theirs, mask)
    assert abs(error - difference**2) < 4 * deviation
    assert deviation < 2e-6 < 1e-5 < 10 ** (-judge.psnr(ours[0], theirs[0], mask) / 10)
