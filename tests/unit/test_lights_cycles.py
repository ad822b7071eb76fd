"""Blender's lights as Cycles of Blender 5.0.1 has them: irradiance on a plane, radiance along rays, who sees them."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from test_light_sampler import light

from drgs_blender.core.frame import Light
from drgs_blender.render.lights.light_sampler import Lights, light_flags
from drgs_blender.render.lights.light_shapes import CAMERA, DIFFUSE, GLOSSY, SHADOW
from drgs_blender.render.sampling import sobol

ROOT = Path(__file__).resolve().parents[2]
JOB = Path(__file__).with_name("cycles_lights.py")

#: Irradiance at the origin, facing up.
LIT = {
    "point": light("point", 1, 0, 2),
    "point, scaled": light("point", 1, 0, 2, scale=(2, 2, 2)),
    "point, not normalised": light("point", 1, 0, 2, normalize=False),
    "coloured": light("point", 0, 0, 3, colour=(1.0, 0.5, 0.1), power=33),
    "soft point": light("point", 0, 0, 2, radius=0.5),
    "soft point at the horizon": light("point", 2, 0, 0.2, radius=0.5),
    "in a soft point": light("point", 0.1, 0, 0.2, radius=0.5),
    "soft point, not normalised": light("point", 0, 1, 2, radius=0.5, normalize=False),
    "sphere": light("point", 0.5, 0, 1, radius=0.6, soft_falloff=False),
    "sphere at the horizon": light("point", 2, 0, 0.2, radius=0.5, soft_falloff=False),
    "in a sphere": light("point", 0.1, 0, 0.2, radius=0.5, soft_falloff=False),
    "sun, sharp": light("sun", 0, 0, 0, tilt=1.0, power=3),
    "sun": light("sun", 0, 0, 0, tilt=1.0, power=3, angle=0.00918),
    "sun, wide": light("sun", 0, 0, 0, tilt=1.2, power=3, angle=1.5),
    "sun, half the sky": light("sun", 0, 0, 0, power=3, angle=math.pi),
    "sun, not normalised": light("sun", 0, 0, 0, tilt=0.3, power=3, angle=0.7, normalize=False),
    "spot": light("spot", 0, 0, 2, tilt=0.1),
    "spot, in the blend": light("spot", 0, 0, 2, tilt=0.35, spot_size=0.8, spot_blend=0.5),
    "spot, all blend": light("spot", 0, 0, 2, tilt=0.5, spot_size=2.0, spot_blend=1.0),
    "spot, hard": light("spot", 0, 0, 2, tilt=0.39, spot_size=0.8, spot_blend=0.0),
    "spot, half the sky": light("spot", 0, 0, 2, tilt=1.5, spot_size=math.pi, spot_blend=0.3),
    "spot, stretched": light("spot", 0, 0, 2, tilt=0.5, scale=(1, 2, 1.2), spot_size=0.8, spot_blend=1.0),
    "spot, not normalised": light("spot", 0, 0, 2, normalize=False),
    "soft spot": light("spot", 0, 0, 2, tilt=0.4, radius=0.5, spot_size=0.8, spot_blend=0.5),
    "spot of a sphere": light("spot", 0, 0, 2, tilt=0.4, radius=0.5, spot_size=0.8, spot_blend=0.5, soft_falloff=False),
    "square": light("area", 0, 0.3, 2, tilt=0.4, size_x=0.5),
    "square, near": light("area", 0, 0.3, 0.1, size_x=0.5),
    "square, far": light("area", 3, 3, 12, tilt=0.2, size_x=0.5),
    "square, edge on": light("area", 0, 1.0, 0.6, tilt=0.5, size_x=1.0),
    "rectangle": light("area", 0, 0.3, 1, tilt=0.4, shape="rectangle", size_x=0.5, size_y=2),
    "rectangle, scaled": light("area", 0, 0.3, 1, scale=(2, 0.5, 3), shape="rectangle", size_x=0.5, size_y=2),
    "disk": light("area", 0, 0.3, 1, tilt=0.4, shape="disk", size_x=0.8),
    "ellipse": light("area", 0, 0.3, 1, tilt=0.4, shape="ellipse", size_x=0.5, size_y=2),
    "area, not normalised": light("area", 0, 0.3, 1, tilt=0.4, size_x=0.5, normalize=False),
    "spread": light("area", 0.2, 0.3, 1, tilt=0.3, size_x=0.8, spread=1.2),
    "spread, narrow": light("area", 0.1, 0, 1, size_x=0.8, spread=0.08),
    "spread, none": light("area", 0.1, 0, 1, size_x=0.8, spread=0.0),
    "spread of a disk": light("area", 0.3, 0, 1, shape="disk", size_x=1.0, spread=0.5),
}

#: Radiance from an origin in a direction.
SEEN = {
    "soft point": (light("point", 0, 0, 2, radius=0.5), (0.45, 0, 0), (0, 0, 1)),
    "beside a soft point": (light("point", 0, 0, 2, radius=0.5), (0.55, 0, 0), (0, 0, 1)),
    "soft point, slanting": (light("point", 0, 0, 2, radius=0.5), (0, 0, 0), (0.24, 0, 1)),
    "beside a sphere": (light("point", 0, 0, 2, radius=0.5, soft_falloff=False), (0, 0, 0), (0.265, 0, 1)),
    "sphere, slanting": (light("point", 0, 0, 2, radius=0.5, soft_falloff=False), (0, 0, 0), (0.255, 0, 1)),
    "sun": (light("sun", 0, 0, 0, tilt=0.5, angle=0.4), (0, 0, 0), (0, math.sin(-0.32), math.cos(0.32))),
    "beside the sun": (light("sun", 0, 0, 0, tilt=0.5, angle=0.4), (0, 0, 0), (0, math.sin(-0.28), math.cos(0.28))),
    "soft spot": (light("spot", 0, 0, 2, tilt=0.3, radius=0.5, spot_size=0.9), (0, 0.3, 0), (0, -0.1, 1)),
    "area": (light("area", 0, 0, 2, shape="rectangle", size_x=0.5, size_y=2), (0.2, 0.9, 0), (0, 0, 1)),
    "corner of an ellipse": (light("area", 0, 0, 2, shape="ellipse", size_x=0.5, size_y=2), (0.2, 0.9, 0), (0, 0, 1)),
    "area, mirrored": (light("area", 0, 0, 2, scale=(-1, 1, 1)), (0, 0, 0), (0, 0, 1)),
    "area, turned over": (light("area", 0, 0, 2, scale=(1, 1, -1)), (0, 0, 0), (0, 0, 1)),
    "area from behind": (light("area", 0, 0, 2, tilt=math.pi), (0, 0, 0), (0, 0, 1)),
    "wide spread": (light("area", 0, 0, 2, size_x=3, spread=3.0), (0, 0, 0), (0.3, 0.2, 1)),
    "spread": (light("area", 0, 0, 2, size_x=3, spread=1.0), (0, 0, 0), (0.3, 0.2, 1)),
    "narrow spread": (light("area", 0, 0, 2, size_x=3, spread=0.09), (0, 0, 0), (0.01, 0.02, 1)),
    "outside the spread": (light("area", 0, 0, 2, size_x=3, spread=0.6), (0, 0, 0), (0.3, 0.2, 1)),
}


@pytest.fixture(scope="module")
def cycles(tmp_path_factory) -> dict[str, np.ndarray]:
    """What Cycles says of all the above, by name, and of three lights that a kind of ray does not see."""
    python = ROOT / ".venv-blender" / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    python = Path(os.environ.get("DRGS_BLENDER", python))
    if not python.exists():
        pytest.skip("Blender's Python is not installed in .venv-blender")

    def entry(one: Light, **more) -> dict:
        return dataclasses.asdict(one) | {"matrix_world": np.asarray(one.matrix_world).tolist()} | more

    above = light("area", 0, 0, 1)
    jobs = {f"lit {name}": entry(one) for name, one in LIT.items()}
    for name, (one, origin, direction) in SEEN.items():
        jobs[f"seen {name}"] = entry(dataclasses.replace(one, camera=True), look=(origin, direction))
    jobs["no camera"] = entry(above, look=((0, 0, 0), (0, 0, 1)))
    jobs["no diffuse"] = entry(dataclasses.replace(above, diffuse=False))
    jobs["no glossy"] = entry(dataclasses.replace(above, glossy=False))
    jobs["no glossy, glossy"] = entry(dataclasses.replace(above, glossy=False), glossy_roughness=0.5)
    jobs["no diffuse, glossy"] = entry(dataclasses.replace(above, diffuse=False), glossy_roughness=0.5)
    path = tmp_path_factory.mktemp("lights") / "job.json"
    path.write_text(json.dumps(list(jobs.values())))
    subprocess.run([str(python), str(JOB), str(path)], check=True, timeout=300, capture_output=True)
    results = json.loads(path.with_suffix(".result.json").read_text())
    return dict(zip(jobs, np.array(results), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("name", LIT)
def test_irradiance(cycles, name):
    sampler = Lights([LIT[name]])
    directions, _, radiance, density, _ = sampler.sample(sobol(1 << 17), (0, 0, 0))
    hit = density != 0
    terms = radiance[hit] * (np.maximum(directions[hit, 2], 0) / np.abs(density[hit]))[:, None].astype(float)
    assert cycles[f"lit {name}"].max() > 0
    np.testing.assert_allclose(terms.sum(axis=0) / len(hit), cycles[f"lit {name}"], rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", SEEN)
def test_radiance_along_a_ray(cycles, name):
    one, origin, direction = SEEN[name]
    unit = np.array([direction]) / np.linalg.norm(direction)
    found = Lights([dataclasses.replace(one, camera=True)]).along(origin, unit, seen_by=CAMERA)[0]
    expected = cycles[f"seen {name}"]
    np.testing.assert_allclose(found, expected, rtol=1e-3)
    hidden = ("beside", "corner", "turned", "behind", "outside")
    assert (expected.max() == 0) == any(word in name for word in hidden)


@pytest.mark.slow
def test_who_sees_a_light(cycles):
    """Blender hides lights from the camera unless told otherwise; a lobe does not see what its rays do not see."""
    assert cycles["no camera"].max() == 0
    assert cycles["no diffuse"].max() == 0 < cycles["no glossy"].max()
    assert cycles["no glossy, glossy"].max() == 0 < cycles["no diffuse, glossy"].max()
    sampler = Lights([light("area", 0, 0, 1, diffuse=False)])
    assert light_flags(0, sampler.tables) == GLOSSY | SHADOW
    assert not sampler.along((0, 0, 0), [[0, 0, 1]], seen_by=DIFFUSE).any()
    assert not sampler.along((0, 0, 0), [[0, 0, 1]], seen_by=CAMERA).any()
    assert sampler.along((0, 0, 0), [[0, 0, 1]], seen_by=GLOSSY).all()
