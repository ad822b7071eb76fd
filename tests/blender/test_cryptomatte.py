"""Cryptomatte through Blender: the numbers that Cycles writes for the same objects and materials."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import mesh_object, new_world
from test_composed import CUBE, SIDES, painted
from test_motion import layers_of


@pytest.mark.parametrize("of", ["Object", "Material"])
def test_mattes_are_those_of_cycles(ball, scene, tmp_path, of):
    new_world(scene)
    cube = painted(mesh_object("A cube with a long näme", CUBE, SIDES), (0.5, 0.5, 0.5))
    cube.scale, cube.location = (0.4, 0.4, 0.4), (1.0, -1, 0.2)
    setattr(scene.view_layers[0], f"use_pass_cryptomatte_{of.lower()}", True)
    scene.drgs.primary, scene.drgs.aa = "mesh", 16
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.use_denoising, cycles.pixel_filter_type = "CPU", 16, False, "BOX"
    found = {}
    for engine in ("DRGS", "CYCLES"):
        layers = layers_of(scene, engine, tmp_path)
        pairs = np.concatenate([layers[f"Crypto{of}{i:02}"] for i in range(3)], axis=2).reshape(48, 64, 6, 2)
        numbers = np.unique(pairs[..., 0][pairs[..., 1] > 0.2])
        found[engine] = {n: np.where(pairs[..., 0] == n, pairs[..., 1], 0).sum(axis=2) for n in numbers if n}
    assert len(found["DRGS"]) == 2 and set(found["DRGS"]) == set(found["CYCLES"])
    for number, coverage in found["DRGS"].items():
        assert coverage.sum() > 50
        np.testing.assert_allclose(coverage.sum(), found["CYCLES"][number].sum(), rtol=0.03)
