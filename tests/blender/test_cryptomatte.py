"""Cryptomatte through Blender: the numbers that Cycles writes for the same objects and materials."""

from __future__ import annotations

import json
import os
import subprocess

import bpy
import numpy as np
import pytest
from scenes import mesh_object, new_world
from test_composed import CUBE, SIDES, painted
from test_motion import layers_of

pytestmark = pytest.mark.blender_api

#: Run by the engine's Python, which has OpenEXR: texts of a file's header.
HEADER = """
import json, sys, OpenEXR
with OpenEXR.File(sys.argv[1]) as file:
    print(json.dumps({k: v for k, v in file.header().items() if k.startswith("cryptomatte/")}))
"""


def header_of(path) -> dict[str, str]:
    command = [os.environ["DRGS_ENGINE"], "-c", HEADER, str(path)]
    return json.loads(subprocess.run(command, check=True, capture_output=True, timeout=100).stdout)


def test_files_name_their_mattes_as_those_of_cycles_do(ball, scene, tmp_path):
    """Blender's own Cryptomatte node finds both in the file."""
    new_world(scene)
    painted(mesh_object('A "cube"', CUBE, SIDES), (0.5, 0.5, 0.5))
    layer = scene.view_layers[0]
    layer.use_pass_cryptomatte_object = layer.use_pass_cryptomatte_material = True
    scene.cycles.device, scene.cycles.samples = "CPU", 1
    said = {}
    for engine in ("DRGS", "CYCLES"):
        layers_of(scene, engine, tmp_path)
        said[engine] = header_of(tmp_path / f"{engine}.exr")
    ours, theirs = said["DRGS"], said["CYCLES"]
    assert ours.keys() == theirs.keys() and len(ours) == 8
    manifests = 0
    for key in ours:
        if not key.endswith("/manifest"):
            assert ours[key] == theirs[key]
            continue
        mine = json.loads(ours[key])
        known = json.loads(theirs[key].replace('A "cube"', 'A \\"cube\\"'))  # Cycles forgets to
        assert mine == {name: known.get(name, mine[name]) for name in mine}
        assert {"ball", 'A "cube"'} <= mine.keys() or "DR-GS" in mine
        manifests += 1
    assert manifests == 2
    if bpy.app.version < (5, 0):  # there only a scene's own tree takes the node
        scene.use_nodes = True
        tree = scene.node_tree
    else:
        tree = bpy.data.node_groups.new("Mattes", "CompositorNodeTree")
    node = tree.nodes.new("CompositorNodeCryptomatteV2")
    node.source, node.image = "IMAGE", bpy.data.images.load(str(tmp_path / "DRGS.exr"))
    for name in ("CryptoObject", "CryptoMaterial"):
        node.layer_name = f"{layer.name}.{name}"


@pytest.mark.parametrize("of", ["Object", "Material"])
def test_mattes_are_those_of_cycles(ball, scene, tmp_path, of):
    new_world(scene)
    cube = painted(mesh_object("A cube with a long näme", CUBE, SIDES), (0.5, 0.5, 0.5))
    cube.scale, cube.location = (0.4, 0.4, 0.4), (1.0, -1, 0.2)
    setattr(scene.view_layers[0], f"use_pass_cryptomatte_{of.lower()}", True)
    scene.drgs.camera_sees, scene.drgs.subpixel_samples = "mesh", 16
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
