"""Cryptomatte: the hash of the specification, coverages in order, names of instances and materials."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import look_along_y, sphere_mesh

from drgs_blender.asset.model import PosedSurfels
from drgs_blender.frame import Frame, Material, MeshState, ObjectState, RenderSettings, World
from drgs_blender.render.lights.light import EnvironmentLight
from drgs_blender.render.picture.cryptomatte import identities, name_hash
from drgs_blender.render.pipeline import render
from drgs_blender.render.trace.scene import TraceObject, TraceScene


def test_hash_is_murmur3_with_usable_exponents():
    """Values that the Cryptomatte specification and the hash's own tests give."""
    assert name_hash("hello") == 0x248BFA47 and name_hash("hello, world") == 0x149BBB7F
    assert name_hash("The quick brown fox jumps over the lazy dog") == 0x2E4FF723
    many = identities([f"thing {i}" for i in range(5000)])
    assert np.isfinite(many).all() and (np.abs(many) >= np.finfo(np.float32).tiny).all()


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
    settings = RenderSettings(1, 1, 1, bounces=0, aa=16, primary="mesh", film_transparent=True)
    frame = Frame(
        1, look_along_y(), [ObjectState("Ball", "")], settings=settings, meshes=[mesh], passes=("Coverage", *names)
    )
    empty, flat = np.empty((0, 3), np.float32), np.empty(0, np.float32)
    nothing = PosedSurfels(empty, empty, empty, empty, flat, empty, flat, flat, np.empty(0, np.int32))
    made = render(scene, EnvironmentLight(World()), nothing, frame)
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
