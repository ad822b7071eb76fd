"""Multiscatter GGX of surfaces with two lobes: no light is lost, and what has plain GGX keeps every bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drgs_blender.core.frame import Camera, Frame, MeshState, RenderSettings, World
from drgs_blender.core.materials import Material
from drgs_blender.engine.session import Session
from drgs_blender.render.integrator.brdf import PAPER, PRINCIPLED, layer_table
from drgs_blender.render.integrator.multiscatter import energy_tables, lobe_weights
from drgs_blender.render.integrator.records import Settings

F = np.float32
ROUGHNESS = (0.1, 0.3, 0.5, 0.8, 1.0)
WHITE = Material("white", (1.0, 1.0, 1.0), 0.5, 1.0, multiscatter=True)


def plates(*materials: Material, turn: float = 0.0) -> list[MeshState]:
    """Squares in a row, a metre apart, that look up or are turned about the row."""
    corners = 0.45 * np.float32([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    sine, cosine = np.sin(turn), np.cos(turn)
    found = []
    for i, material in enumerate(materials):
        matrix = np.eye(4)
        matrix[:3, :3] = [[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]]
        matrix[0, 3] = i
        faces = np.int32([[0, 1, 2], [0, 2, 3]])
        found.append(MeshState(f"plate {i}", corners, faces, matrix[None], np.int32([i]), materials=[material]))
    return found


def picture(meshes: list[MeshState], world: float = 1.0, **settings: object) -> np.ndarray:
    """(8, 8 n, 3) light of n plates under an even sky, from above."""
    n, matrix = len(meshes), np.eye(4)
    matrix[:3, 3] = (n - 1) / 2, 0, 6
    camera = Camera(matrix, 8 * n, 8, 8.0, 8.0, 4 * n, 4, orthographic=True)
    options = {"samples": 256, "subpixel_samples": 1, "bounces": 0, "camera_sees": "mesh"} | settings
    frame = Frame(0, camera, [], World(colour=(world,) * 3), RenderSettings(**options), ("Combined",), meshes)
    return Session().render(frame)["Combined"][..., :3]


def means(meshes: list[MeshState], **settings: object) -> np.ndarray:
    """(n, 3) mean light of each plate, without its rim."""
    found = picture(meshes, **settings)[3:5]
    return found.reshape(2, len(meshes), 8, 3)[:, :, 2:6].mean(axis=(0, 2))


@pytest.mark.parametrize("turn", [0.0, 1.2])
@pytest.mark.parametrize("metallic", [0.0, 0.5, 1.0])
def test_white_furnace(turn: float, metallic: float) -> None:
    """White surfaces send on all light of an even sky, whatever their roughness; by plain GGX rough metals do not."""
    materials = [replace(WHITE, roughness=r, metallic=metallic) for r in ROUGHNESS]
    found = means(plates(*materials, turn=turn))
    np.testing.assert_allclose(found, 1.0, atol=0.015)
    single = means(plates(*(replace(m, multiscatter=False) for m in materials), turn=turn))
    assert single[-1].max() < 1 - 0.4 * metallic + 0.01
    assert np.abs(single[0] - found[0]).max() < 0.003


@pytest.mark.parametrize("colour", [0.2, 0.7])
def test_coloured_metals_have_the_colour_of_many_reflections(colour: float) -> None:
    """The closed form of Kulla and Conty, over single reflections: 1 + F' E' / (1 - F' (1 - E')) (1 - E) / E."""
    energy, mean = energy_tables()
    metal = Material("metal", (colour,) * 3, 1.0, 1.0, multiscatter=True)
    single = means(plates(replace(metal, multiscatter=False)), samples=1024)[0, 0]
    fresnel, e, average = colour + (1 - colour) / 21, energy[-1, -1], mean[-1]
    scale = 1 + fresnel * average / (1 - fresnel * (1 - average)) * (1 - e) / e
    assert means(plates(metal), samples=1024)[0, 0] == pytest.approx(single * scale, rel=1e-5)
    assert scale > 1.05


def test_what_has_plain_ggx_keeps_every_bit() -> None:
    rough = replace(WHITE, roughness=0.9)
    plain, mixed = Material("plain", (0.5, 0.3, 0.2), 0.6, 0.7), replace(rough, multiscatter=False)
    before, after = picture(plates(plain, mixed)), picture(plates(plain, rough))
    assert np.array_equal(before[:, :8], after[:, :8]) and (after[:, 10:14] > before[:, 10:14] * 1.2)[2:6].all()
    paper = {"shading_model": "paper"}
    assert np.array_equal(picture(plates(plain, mixed), **paper), picture(plates(plain, rough), **paper))


def reflected(multiscatter: bool, *others: Material) -> float:
    """Light that a mirror, tilted by 45 degrees, shows of a rough metal beside it, with further materials far away."""
    rough = replace(WHITE, base_colour=(0.6, 0.6, 0.6), roughness=0.9, multiscatter=multiscatter)
    (mirror,) = plates(Material("mirror", (1.0, 1.0, 1.0), 0.0, 1.0), turn=np.pi / 4)
    (wall,) = plates(rough, turn=np.pi / 2)
    wall.matrices[0, 1, 3] = -1.0
    far = plates(*others)
    for plate in far:
        plate.matrices[0, 0, 3] = 50
    return float(picture([mirror, wall, *far], bounces=1)[3:5, 2:6].mean())


def test_what_rays_hit_has_it_too() -> None:
    single, many = reflected(False), reflected(True)
    assert many > 1.3 * single > 0


@pytest.mark.slow
def test_paths_through_any_bsdf_agree() -> None:
    """Any material with more lobes lets all light be solved path by path."""
    assert reflected(True, Material("far", coat=1.0)) == pytest.approx(reflected(True), rel=0.01)


def test_weights_are_the_material_s_own_without_it() -> None:
    settings = Settings(0, PRINCIPLED, layer_table(), *energy_tables())
    given = F(0.6), F(0.9), F(0.3), (F(0.5), F(0.2), F(0.1))
    plain = lobe_weights(*given, False, settings)
    assert plain[1] == (F(0.3),) * 3 and plain[2] == F(0.7)
    assert lobe_weights(*given, True, settings._replace(shading_model=PAPER))[1:] == plain[1:]
    kd, metal, dielectric = lobe_weights(*given, True, settings)
    assert kd > plain[0] and dielectric > plain[2] and metal[0] > metal[1] > metal[2] > F(0.3)
