"""Cryptomatte: the hash of the specification, coverages in order, names of instances and materials."""

from __future__ import annotations

import json

import numpy as np
import OpenEXR
import pytest
from shapes import look_along_y, sphere_mesh

from drgs_blender.core.asset.model import PosedSurfels
from drgs_blender.core.cryptomatte import identities, metadata, name_hash
from drgs_blender.core.frame import Frame, MeshState, ObjectState, RenderSettings, World
from drgs_blender.core.materials import Material
from drgs_blender.render.film.frame_files import read_frame, write_frame
from drgs_blender.render.lights.environment import EnvironmentLight
from drgs_blender.render.pipeline import render
from drgs_blender.render.prepared_scene import PreparedScene
from drgs_blender.render.scene.trace_scene import TraceObject, TraceScene


def test_hash_is_murmur3_with_usable_exponents():
    """Values that the Cryptomatte specification and the hash's own tests give."""
    assert name_hash("hello") == 0x248BFA47 and name_hash("hello, world") == 0x149BBB7F
    assert name_hash("The quick brown fox jumps over the lazy dog") == 0x2E4FF723
    many = identities([f"thing {i}" for i in range(5000)])
    assert np.isfinite(many).all() and (np.abs(many) >= np.finfo(np.float32).tiny).all()


def test_files_say_which_number_is_whose_name(tmp_path):
    """As the specification's readers look for it: under the layer's own hash, in JSON, one name for the passes."""
    names = ['a "quoted"\\', "line\nbreak", "ünï 球", "plain"]
    passes = ("Combined", "CryptoObject00")
    frame = Frame(1, look_along_y(), [ObjectState(name, "") for name in names], passes=passes)
    pictures = {name: np.ones((2, 2, 4), np.float32) for name in passes}
    write_frame(tmp_path / "a.exr", pictures, {"seed": "1"} | metadata(frame))
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        header = {k: v for k, v in dict(file.header()).items() if k.startswith("cryptomatte/")}
        assert {c.split("00.")[0] for c in file.channels() if "Crypto" in c} == {"CryptoObject"}
    key = f"cryptomatte/{name_hash('CryptoObject'):08x}"[:-1]
    assert header.keys() == {f"{key}/{field}" for field in ("name", "hash", "conversion", "manifest")}
    assert header[f"{key}/name"] == "CryptoObject" and header[f"{key}/conversion"] == "uint32_to_float32"
    assert header[f"{key}/hash"] == "MurmurHash3_32"
    manifest = json.loads(header[f"{key}/manifest"])
    numbers = np.array([int(manifest[name], 16) for name in names], np.uint32).view(np.float32)
    np.testing.assert_array_equal(numbers, identities(names))
    assert read_frame(tmp_path / "a.exr")[1] == {"seed": "1"} | header


@pytest.fixture(scope="module")
def passes():
    """A ball of two materials that stands in two places, and a DR-GS ball before one of them."""
    vertices, faces = sphere_mesh(2)
    places = np.tile(np.eye(4), (2, 1, 1))
    places[:, :3, 3] = (-0.8, 1, 0), (0.8, 1, 0)
    upper = (vertices[faces].mean(axis=1)[:, 2] > 0).astype(np.int32)
    mesh = MeshState(
        "Twin", vertices * 0.5, faces, places, np.zeros(2, np.int32), material_index=upper,
        materials=[Material("Below"), Material("Above")],
    )  # fmt: skip
    scene = TraceScene()
    grey, one = np.full((len(vertices), 3), 0.5), np.ones(len(vertices))
    near = TraceObject("Ball", (vertices * 0.4 + [0.8, 0, 0]).astype(np.float32), faces, grey, one, one * 0)
    scene.update([near], [mesh], [])
    names = tuple(f"Crypto{of}{i:02}" for of in ("Object", "Material") for i in range(3))
    settings = RenderSettings(samples=3, bounces=0, subpixel_samples=16, camera_sees="mesh", film_transparent=True)
    frame = Frame(
        1, look_along_y(), [ObjectState("Ball", "")], settings=settings, meshes=[mesh], passes=("Coverage", *names)
    )
    empty, flat = np.empty((0, 3), np.float32), np.empty(0, np.float32)
    nothing = PosedSurfels(empty, empty, empty, empty, flat, empty, flat, flat, np.empty(0, np.int32))
    made = render(PreparedScene(scene, EnvironmentLight(World()), nothing), frame)
    scene.close()
    return made


def coverage_of(passes, kind: str, name: str) -> np.ndarray:
    pairs = np.concatenate([passes[f"Crypto{kind}{i:02}"] for i in range(3)], axis=2).reshape(48, 48, 6, 2)
    return np.where(pairs[..., 0] == identities([name])[0], pairs[..., 1], 0).sum(axis=2)


def test_every_object_and_material_has_its_part_of_the_pixels(passes):
    coverage = passes["Coverage"][..., 0]
    ball, twin = (coverage_of(passes, "Object", name) for name in ("Ball", "Twin"))
    np.testing.assert_allclose(ball + twin, coverage, atol=1e-6)
    assert ball[:, :22].max() == 0 and ball[24, 38] == 1 and twin[24, 11] == 1 and twin[24, 38] == 0
    below, above, own = (coverage_of(passes, "Material", name) for name in ("Below", "Above", "DR-GS"))
    np.testing.assert_allclose(own, ball, atol=1e-6)
    np.testing.assert_allclose(below + above, twin, atol=1e-6)
    assert above[:20].sum() > 20 and below[:20].sum() == 0 and below[28:].sum() > 20 and above[28:].sum() == 0


def test_what_covers_most_comes_first(passes):
    shares = np.concatenate([passes[f"CryptoObject{i:02}"] for i in range(3)], axis=2)[..., 1::2]
    assert (np.diff(shares, axis=2) <= 0).all() and (shares[..., 1] > 0).any()
