"""Passes as compositors use them: light without colour, colours, Mist, UV, indices; their mean over time and lens."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from shapes import sphere_mesh

from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.model import Asset, Mesh
from drgs_blender.core.errors import AssetError
from drgs_blender.core.frame import Camera, Frame, Light, MeshState, Mist, ObjectState, RenderSettings, World
from drgs_blender.core.materials import Material
from drgs_blender.core.passes import COLOURS, with_colours, without_colour
from drgs_blender.deform.attach import attach
from drgs_blender.engine.session import Session
from drgs_blender.ipc.blur import averaged, sample_frame
from drgs_blender.ipc.protocol import Passes
from drgs_blender.render.integrator import brdf

Scene = tuple[Session, Frame]
LIGHT = ("DiffDir", "DiffInd", "DiffCol", "GlossDir", "GlossInd", "GlossCol", "Emit", "Env")
SETTINGS = RenderSettings(samples=8, subpixel_samples=4, bounces=1)


def recombined(p: dict[str, np.ndarray]) -> np.ndarray:
    """What a compositor makes of the passes of light."""
    diffuse, glossy = (p[f"{lobe}Dir"] + p[f"{lobe}Ind"] for lobe in ("Diff", "Gloss"))
    return diffuse * p["DiffCol"] + glossy * p["GlossCol"] + p["Emit"] + p["Env"]


def from_above(size: int = 24, orthographic: bool = True) -> Camera:
    matrix = np.eye(4)
    matrix[2, 3] = 6
    scale = size / 4 if orthographic else size * 1.5
    return Camera(matrix, size, size, scale, scale, size / 2, size / 2, orthographic=orthographic)


def plate(name: str, z: float, side: float, material: Material, uv: bool = False) -> MeshState:
    corners = side * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) + [0, 0, z]
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    places = (corners[:, :2] / (2 * side) + 0.5).astype(np.float32)[faces] if uv else None
    return MeshState(
        name, corners.astype(np.float32), faces, np.eye(4)[None], np.zeros(1, np.int32), materials=[material],
        uv_map=places,
    )  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A ball of surfels over a coloured floor with a lamp, a plate that glows, and a blue world."""
    vertices, faces = sphere_mesh(2)
    n = len(vertices)
    mesh = Mesh(0.6 * vertices, faces, np.full((n, 3), (0.8, 0.5, 0.0)), np.full(n, 0.3), np.linspace(0, 1, n))
    surfels, binding, _ = attach(mesh)
    path = tmp_path_factory.mktemp("asset") / "ball.drgs"
    write_asset(path, Asset(surfels, mesh, binding))
    session = Session()
    place = np.eye(4)
    place[:3, 3] = 0.3, 0.4, 4
    ball = ObjectState("ball", session.load_asset(path), pass_index=4, material_pass_index=9)
    floor = plate("floor", -1.0, 1.5, Material("floor", (0.9, 0.2, 0.1), 0.4, 0.3, pass_index=5), uv=True)
    glow = plate("glow", -0.9, 0.2, Material("glow", (0, 0, 0), 1.0, 0.0, (2.0, 1.0, 0.5), pass_index=6))
    glow.matrices[0, 0, 3] = 1.2
    frame = Frame(
        0, from_above(), [ball], World(colour=(0.2, 0.3, 0.5)), SETTINGS, ("Combined", *LIGHT), [floor, glow],
        [Light("lamp", "point", place, power=200.0, radius=0.3)],
    )  # fmt: skip
    return session, frame


def rendered(scene: Scene, *names: str, **changes: object) -> dict[str, np.ndarray]:
    session, frame = scene
    return session.render(replace(frame, passes=names or frame.passes, **changes))


@pytest.mark.parametrize("look", ["principled", "paper"])
@pytest.mark.parametrize("denoise", ["none", "svgf"])
def test_light_times_colour_is_the_picture(scene: Scene, look: str, denoise: str) -> None:
    """Where a colour is black in a channel (the ball's blue), no light is lost, but what SVGF spreads there."""
    settings = replace(SETTINGS, shading_model=look, denoise=denoise)
    p = rendered(scene, settings=settings)
    lost = np.abs(recombined(p) - p["Combined"][..., :3])
    assert lost.max() < (1e-6 if denoise == "none" else 0.02) and np.median(lost) < 1e-7
    assert p["DiffDir"].max() > 0.5 and p["GlossDir"].max() > 0.1 and p["Emit"].max() > 1


def test_colours_do_not_depend_on_light_and_light_not_on_colours(scene: Scene) -> None:
    p = rendered(scene)
    dark = rendered(scene, lights=[], world=World(colour=(0.0, 0.0, 0.0)))
    assert np.array_equal(p["DiffCol"], dark["DiffCol"]) and np.array_equal(p["GlossCol"], dark["GlossCol"])
    floor, glow = scene[1].meshes
    white = replace(floor, materials=[replace(floor.materials[0], base_colour=(1.0, 1.0, 1.0))])
    other = rendered(scene, "DiffDir", "DiffCol", meshes=[white, glow])
    on_floor = rendered(scene, "IndexMA")["IndexMA"][..., 0] == 5
    edge = np.abs(other["DiffDir"] - p["DiffDir"])[on_floor]
    assert np.quantile(edge, 0.9) < 1e-5 and np.abs(other["DiffCol"] - p["DiffCol"])[on_floor].max() > 0.5


def test_floor_colours_are_those_of_the_formula(scene: Scene) -> None:
    p = rendered(scene, "DiffCol", "GlossCol", "IndexMA", "Coverage", objects=[], meshes=[scene[1].meshes[0]])
    inside = p["Coverage"][..., 0] > 0.999
    layer = brdf.layer_albedo(np.float32(0.4), np.float32(1), brdf.layer_table())
    schlick = brdf.layer_albedo(np.float32(0.4), np.float32(1), brdf.schlick_table())
    base = np.array([0.9, 0.2, 0.1])
    np.testing.assert_allclose(
        p["DiffCol"][inside], np.broadcast_to(0.7 * (1 - layer) * base, (inside.sum(), 3)), rtol=1e-4
    )
    glossy = 0.7 * layer + 0.3 * (base + (1 - base) * schlick)
    np.testing.assert_allclose(p["GlossCol"][inside], np.broadcast_to(glossy, (inside.sum(), 3)), rtol=1e-4)
    # Half covered pixels have half of it.
    np.testing.assert_allclose(p["DiffCol"], p["Coverage"] * p["DiffCol"][inside][0], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("orthographic", [True, False])
@pytest.mark.parametrize("falloff", [1.0, 2.0, 0.5])
def test_mist(scene: Scene, orthographic: bool, falloff: float) -> None:
    camera = from_above(orthographic=orthographic)
    floor = scene[1].meshes[0]
    p = rendered(
        scene, "Mist", "Position", "Coverage", objects=[], meshes=[floor], camera=camera, mist=Mist(5.0, 4.0, falloff)
    )  # fmt: skip
    cover = p["Coverage"][..., 0]
    place = p["Position"] - [0, 0, 6]
    far = -place[..., 2] if orthographic else np.linalg.norm(place, axis=-1)
    expected = ((far - 5) / 4) ** falloff
    np.testing.assert_allclose(p["Mist"][cover > 0.999][:, 0], expected[cover > 0.999], atol=2e-3)
    if orthographic:
        np.testing.assert_allclose(p["Mist"][..., 0], 1 - cover * (1 - 0.5**falloff), atol=1e-5)
    for mist, value in ((Mist(8.0, 4.0), 0.0), (Mist(1.0, 2.0), 1.0), (Mist(1.0, 0.0), 0.0)):
        solid = rendered(scene, "Mist", objects=[], meshes=[floor], mist=mist)["Mist"][..., 0]
        np.testing.assert_allclose(solid[cover > 0.999], value, atol=1e-6)


def test_uv_and_indices(scene: Scene) -> None:
    p = rendered(scene, "UV", "IndexMA", "IndexOB", "Position", "Coverage")
    floor = p["IndexMA"][..., 0] == 5
    inside = floor & (p["Coverage"][..., 0] > 0.999) & (p["UV"][..., 2] > 0.999)
    assert inside.sum() > 50
    np.testing.assert_allclose(p["UV"][inside][:, :2], p["Position"][inside][:, :2] / 3 + 0.5, atol=1e-4)
    assert set(np.unique(p["IndexMA"])) == {0, 5, 6, 9}
    ball = p["IndexOB"][..., 0] == 4
    assert ball.any() and (p["IndexMA"][ball] == 9).all() and (p["UV"][p["IndexMA"][..., 0] == 6][:, 2] < 1).all()
    assert (p["UV"][p["Coverage"][..., 0] == 0] == 0).all()


def test_objects_have_the_same_numbers_whatever_is_beside_them(scene: Scene) -> None:
    """Two of one pass index differ; another object before them changes neither number nor index."""
    _, frame = scene
    floor, glow = frame.meshes
    ball = [replace(frame.objects[0], pass_index=0)]
    p = rendered(scene, "Object", "IndexMA", objects=ball)
    numbers = {int(k): np.unique(p["Object"][p["IndexMA"] == k]) for k in (0, 5, 6, 9)}
    assert numbers[0] == [0] and all(len(found) == 1 for found in numbers.values())
    assert len({float(found[0]) for found in numbers.values()}) == 4
    before = replace(glow, name="other", vertices=glow.vertices - np.float32([0, 0, 5]))
    q = rendered(scene, "Object", "IndexMA", "IndexOB", objects=ball, meshes=[before, floor, glow])
    assert np.array_equal(q["Object"], p["Object"]) and not q["IndexOB"].any()


def test_uv_map_of_another_size_is_named(scene: Scene) -> None:
    bad = replace(scene[1].meshes[0], uv_map=np.zeros((3, 3, 2), np.float32))
    with pytest.raises(AssetError, match="UV map of floor"):
        rendered(scene, "UV", meshes=[bad])


def test_without_colour_is_cycles_division() -> None:
    light = np.array([[[0.4, 0.2, 0.0], [0.1, 0.2, 0.3], [0.0, 0.0, 0.0]]], np.float32)
    colour = np.array([[[0.8, 0.1, 0.0], [0.5, 0.5, 0.5], [0.0, 0.0, 0.0]]], np.float32)
    np.testing.assert_allclose(without_colour(light, colour), [[[0.5, 2, 1.25], [0.2, 0.4, 0.6], [0, 0, 0]]], rtol=1e-6)


def test_division_by_colour_takes_hardly_more_memory_than_the_pass() -> None:
    """And rows are divided apart: each as it is alone."""
    rng = np.random.default_rng(3)
    light, colour = rng.random((2, 640, 50, 3), np.float32)
    light[100:300], colour[colour < 0.2] = 0, 0
    tracemalloc.start()
    made = without_colour(light, colour)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2 * made.nbytes
    np.testing.assert_array_equal(made, [without_colour(a[None], b[None])[0] for a, b in zip(light, colour)])


def test_mean_of_blurred_pictures_recombines(scene: Scene) -> None:
    """The mean of pictures over time, each with its own colours, is that of their beauties."""
    rng = np.random.default_rng(0)
    names = ("Combined", "DiffDir", "GlossInd", "Mist", "Variance")
    asked = sample_frame(Frame(0, from_above(), [], settings=SETTINGS, passes=(*names, "Depth")), 3, 0).passes
    assert set(asked) == {*names, "DiffCol", "GlossCol"}
    parts = []
    for _ in range(3):
        made = {name: rng.random((4, 5, 3)).astype(np.float32) for name in asked}
        made["Combined"] = made["DiffDir"] * made["DiffCol"] + made["GlossInd"] * made["GlossCol"]
        parts.append(Passes(made, [], {}))
    mean = averaged(parts, (*with_colours(names), "Depth"))
    assert "Depth" not in mean and np.allclose(mean["Variance"], sum(p["Variance"] for p in parts) / 9)
    total = mean["DiffDir"] * mean["DiffCol"] + mean["GlossInd"] * mean["GlossCol"]
    np.testing.assert_allclose(total, mean["Combined"], rtol=1e-5)
    assert tuple(averaged(parts, names)) == names and set(COLOURS) == {
        f"{a}{b}" for a in ("Diff", "Gloss", "Trans") for b in ("Dir", "Ind")
    }
