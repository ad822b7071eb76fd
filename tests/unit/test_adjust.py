"""Adjustments of materials: the same as the standard library's HSV, nothing where nothing is asked, kept in bounds."""

from __future__ import annotations

import colorsys

import numpy as np
import pytest
from shapes import sphere_mesh

from drgs_blender.core.asset.model import Asset, Binding, Mesh, Surfels
from drgs_blender.core.frame import Adjustment
from drgs_blender.core.material_adjustments import adjusted, edited_asset
from drgs_blender.deform.mesh_driven import MeshDriven


@pytest.fixture
def materials():
    random = np.random.default_rng(3)
    albedo = random.random((200, 3), np.float32)
    albedo[:4] = [(0, 0, 0), (1, 1, 1), (0.5, 0.5, 0.5), (1, 0, 0)]
    return {
        "albedo": albedo,
        "roughness": random.random(200, np.float32),
        "metallic": random.random(200, np.float32),
    }


def test_nothing_is_changed_by_default(materials):
    for name, values in adjusted(materials, Adjustment()).items():
        np.testing.assert_array_equal(values, materials[name])
    # A whole turn of the hue goes all the way through HSV and back.
    np.testing.assert_allclose(adjusted(materials, Adjustment(hue=1.0))["albedo"], materials["albedo"], atol=1e-6)


def test_hue_saturation_and_value_are_those_of_the_standard_library(materials):
    made = adjusted(materials, Adjustment(hue=0.3, saturation=0.7, value=0.9, tint=(0.5, 1, 0.25)))["albedo"]
    for colour, new in zip(materials["albedo"].astype(float), made):
        h, s, v = colorsys.rgb_to_hsv(*colour)
        expected = np.multiply(colorsys.hsv_to_rgb((h + 0.3) % 1, s * 0.7, v * 0.9), (0.5, 1, 0.25))
        np.testing.assert_allclose(new, expected, atol=2e-6)


def test_brightness_and_contrast_are_those_of_blenders_node(materials):
    """After hue, saturation and value, before the tint."""
    change = Adjustment(value=0.8, brightness=0.1, contrast=0.5, tint=(0.5, 1, 1))
    made = adjusted(materials, change)["albedo"]
    expected = np.maximum(1.5 * (0.8 * materials["albedo"]) + 0.1 - 0.25, 0) * (0.5, 1, 1)
    np.testing.assert_allclose(made, expected.clip(0, 1), atol=1e-6)


def test_gain_offset_and_limits(materials):
    made = adjusted(materials, Adjustment(roughness=(2.0, -0.25, 0.1, 0.6), metallic=(-1.0, 1.0, 0.0, 1.0)))
    np.testing.assert_allclose(made["roughness"], np.clip(2 * materials["roughness"] - 0.25, 0.1, 0.6), atol=1e-6)
    np.testing.assert_allclose(made["metallic"], 1 - materials["metallic"], atol=1e-6)
    # Limits the wrong way round, and values beyond what a material can have, give materials all the same.
    wild = adjusted(materials, Adjustment(tint=(9, 9, 9), roughness=(5, 3, 0.8, 0.2)))
    assert wild["albedo"].max() == 1 and np.allclose(wild["roughness"], 0.8)


def test_the_mask_says_how_much(materials):
    mask = np.linspace(-0.5, 1.5, 200).astype(np.float32)
    mask[7] = np.nan
    change = Adjustment(tint=(0, 1, 1), metallic=(0, 1, 0, 1))
    whole, made = adjusted(materials, change), adjusted(materials, change, mask)
    share = np.clip(np.nan_to_num(mask), 0, 1)
    for name, old in materials.items():
        part = share[:, None] if old.ndim == 2 else share
        np.testing.assert_allclose(made[name], old + part * (whole[name] - old), atol=1e-6)


@pytest.fixture
def asset():
    """A ball with one surfel a face, of colours that no interpolation of the vertices gives."""
    random = np.random.default_rng(4)
    vertices, faces = sphere_mesh(1)
    n, m = len(vertices), len(faces)
    mesh = Mesh(vertices, faces, random.random((n, 3)), random.random(n), random.random(n))
    barycentric = random.dirichlet((1, 1, 1), m).astype(np.float32)
    turns = np.tile(np.float32([1, 0, 0, 0]), (m, 1))
    centre = np.einsum("nk,nkc->nc", barycentric, vertices[faces])
    colours = random.random((m, 3)), random.random(m), random.random(m)
    surfels = Surfels(centre, np.full((m, 2), 0.1), turns, np.ones(m), *colours)
    return Asset(surfels, mesh, Binding(np.arange(m), barycentric, np.zeros(m), np.tile((0, 0, 1), (m, 1))))


def test_an_edited_asset_looks_as_the_engine_shows_it(asset):
    """Surfels follow painted vertices as in the deformation; what is not painted keeps every bit."""
    random = np.random.default_rng(5)
    painted = asset.mesh.albedo.copy()
    painted[::3] = random.random((len(painted[::3]), 3))
    posed = MeshDriven(asset.mesh, asset.surfels, asset.binding).pose(
        asset.mesh.vertices, materials={"albedo": painted}
    )
    made = edited_asset(asset, {"albedo": painted})
    np.testing.assert_allclose(made.surfels.albedo, posed.albedo, atol=1e-6)
    assert (np.abs(made.surfels.albedo - asset.surfels.albedo) > 1e-3).any()
    np.testing.assert_array_equal(made.mesh.albedo, painted)
    np.testing.assert_array_equal(made.surfels.roughness, asset.surfels.roughness)
    tinted = edited_asset(asset, {}, Adjustment(tint=(0.5, 1, 1), mask=np.ones(len(painted), np.float32)))
    np.testing.assert_allclose(tinted.surfels.albedo, asset.surfels.albedo * np.float32([0.5, 1, 1]), atol=1e-6)
