"""Paths through any BSDF: the light that batches find, in any division; glass, sheets, and what stays as it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_integrate import points, settings
from test_surface import mesh_state

from drgs_blender.compute import manifest, threads
from drgs_blender.core.frame import Camera, Frame, Layer, Light, RenderSettings, Visibility, World
from drgs_blender.core.materials import TEXTURED, Image, Material, Part, SurfaceDetail, Texture
from drgs_blender.engine.kernel_jobs import jobs_of
from drgs_blender.engine.session import Session
from drgs_blender.render.integrator import paths
from drgs_blender.render.integrator.integrate import integrate
from drgs_blender.render.lights.environment import EnvironmentLight
from drgs_blender.render.scene.material_rows import material_rows
from drgs_blender.render.scene.trace_scene import TraceScene
from drgs_blender.render.shading_points import SECOND

SQUARE = np.float32([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
FACES = np.int32([[0, 1, 2], [0, 2, 3]])
BOX = np.float32([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
SIDES = np.int32([
    [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
    [1, 5, 7], [1, 7, 3],
])  # fmt: skip


def at(z: float, scale: float = 1.0) -> np.ndarray:
    matrix = np.diag([scale, scale, scale, 1.0])
    matrix[2, 3] = z
    return matrix


def flat(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(m, 3, 3) normals of the faces, at their corners."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    normal = np.cross(b - a, c - a)
    return np.repeat((normal / np.linalg.norm(normal, axis=1, keepdims=True))[:, None], 3, axis=1).astype(np.float32)


def card(material: Material, z: float = 0.0, scale: float = 1.0, **changes):
    uvs = np.ascontiguousarray((SQUARE[FACES][..., :2] + 1) / 2)
    return mesh_state(SQUARE, FACES, at(z, scale), name=material.name, materials=[material], uvs=uvs, **changes)


def box(material: Material, z: float = 0.0, scale: float = 1.0):
    normals = flat(BOX, SIDES)
    return mesh_state(BOX, SIDES, at(z, scale), name=material.name, materials=[material], corner_normals=normals)


def seen(meshes, passes=("Combined",), world=1.0, size=12, lights=(), images=(), height=5.0, **settings):
    """From above, orthographic, one metre wide."""
    camera = Camera(at(height), size, size, size, size, size / 2, size / 2, orthographic=True)
    how = RenderSettings(**{"samples": 64, "bounces": 4, "camera_sees": "mesh"} | settings)
    given = world if isinstance(world, World) else World(strength=world)
    return Session().render(Frame(0, camera, [], given, how, passes, list(meshes), list(lights), list(images)))


def picture(*args, **kwargs) -> np.ndarray:
    return seen(*args, **kwargs)["Combined"][..., :3].astype(np.float64)


SPEC = Material("spec", (0.6, 0.5, 0.4), 0.3, 0.4)
#: Out of sight and of no effect, but with a row: the paths shade all surfaces.
FAR = card(Material("far", (0, 0, 0), coat=0.1), -500.0, 1e-3)


def sky() -> World:
    """Bright above and to one side."""
    rows = np.linspace(2.0, 0.1, 16)[:, None, None] * (1 + np.cos(np.linspace(0, 6, 32)))[None, :, None]
    return World((rows * [1.0, 0.9, 0.8]).astype(np.float32))


@pytest.mark.parametrize("light", (None, Light("l", "area", at(1.5), power=20.0, size_x=0.5)))
def test_plain_surfaces_get_the_light_that_batches_find(light):
    meshes, lights = [card(SPEC), box(Material("red", (0.8, 0.2, 0.1)), 0.6, 0.2)], [light] if light else []
    settings = {"samples": 1024, "size": 6, "bounces": 2, "subpixel_samples": 16}
    batches = picture(meshes, world=sky(), lights=lights, **settings)
    paths = picture([*meshes, FAR], world=sky(), lights=lights, **settings)
    assert paths.mean(axis=(0, 1)) == pytest.approx(batches.mean(axis=(0, 1)), rel=0.01)
    assert not np.array_equal(paths, batches)


def test_threads_and_pieces_of_the_picture_change_no_sample():
    meshes = [box(Material("glass", roughness=0.3, transmission=1.0), 0.0, 0.4), card(SPEC, -1.0, 3.0)]
    whole = picture(meshes, world=sky(), samples=16)
    threads.use_threads(1)
    np.testing.assert_array_equal(whole, picture(meshes, world=sky(), samples=16, threads=1))
    np.testing.assert_array_equal(whole, picture(meshes, world=sky(), samples=16, threads=2))
    camera = Camera(at(5.0), 12, 12, 12, 12, 6, 6, orthographic=True, region=(2, 3, 9, 8))
    how = RenderSettings(samples=16, bounces=4, camera_sees="mesh")
    part = Session().render(Frame(0, camera, [], sky(), how, ("Combined",), meshes))["Combined"]
    np.testing.assert_array_equal(whole[3:8, 2:9], part[..., :3])


def test_the_kernel_is_compiled_ahead_where_a_material_needs_it():
    """The list has it as it is called; frames without such a material, or of another model, do not ask for it."""
    glass, plain = card(Material("glass", kind="glass")), card(SPEC)
    picture([glass], size=4, samples=4)
    lamp = Light("l", "point", at(2.0))

    def jobs(meshes, passes=("Combined",), lights=(), **settings):
        camera, how = Camera(at(5.0), 4, 4, 4, 4, 2, 2), RenderSettings(**settings)
        return jobs_of(Frame(0, camera, [], World(), how, passes, meshes, list(lights)))

    def listed(*args, **settings):
        kernels = manifest.needed(jobs(*args, **settings))
        return {manifest.signature(k) for k in kernels if k.module == paths.__name__ and k.name == "_kernel"}

    (own,) = listed([glass])
    assert own in paths._kernel.signatures
    assert not listed([plain]) and not listed([glass], shading_model="paper")
    (linked,) = listed([glass], lights=[replace(lamp, receivers=0)])
    (grouped,) = listed([glass], ("Combined", "Combined_key"), [replace(lamp, light_group="key")])
    assert set(paths._kernel.signatures) <= {own, linked, grouped} and len({own, linked, grouped}) == 3
    coloured = ["lobe colours" in jobs([glass], (name,)) for name in ("Combined", "DiffDir", "TransCol")]
    assert coloured == [False, True, True]


def test_smooth_glass_in_an_even_world_cannot_be_seen():
    glass = Material("glass", (1, 1, 1), 0.0, transmission=1.0, ior=1.7)
    np.testing.assert_allclose(picture([box(glass, 0.0, 0.2)], bounces=60), 1.0, rtol=1e-4)


def test_colour_of_glass_is_the_square_of_two_roots():
    """Without reflection, light passes two faces, each of which takes the root of the colour."""
    glass = Material("glass", (0.25, 0.5, 1.0), 0.0, transmission=1.0, ior=1.001)
    found = picture([box(glass, 0.0, 1.0)], size=4)
    np.testing.assert_allclose(found, np.broadcast_to([0.25, 0.5, 1.0], found.shape), rtol=2e-3)


@pytest.mark.parametrize("mirrored", (False, True))
def test_a_slab_moves_what_is_behind_it_by_snells_law(mirrored):
    """Seen at an angle; with a mirroring matrix inside stays inside."""
    glass = Material("glass", (1, 1, 1), 0.0, transmission=1.0, ior=1.5)
    stripe = Material("stripe", (0, 0, 0), emission=(1, 1, 1))
    black = Material("black", (0, 0, 0), 1.0, specular_level=0.0)
    slab = box(glass, 0.0, 1.0)
    slab.matrices = np.diag([-20.0 if mirrored else 20.0, 20.0, 0.5, 1.0])[None]
    edge = card(stripe, -0.6)
    edge.matrices = np.array([[[10.0, 0, 0, 10.0], [0, 10, 0, 0], [0, 0, 1, -0.6], [0, 0, 0, 1]]])
    ground = card(black, -2.0, 50.0)
    angle = np.radians(40)
    turn = np.array(
        [[np.cos(angle), 0, np.sin(angle), 0], [0, 1, 0, 0], [-np.sin(angle), 0, np.cos(angle), 0], [0, 0, 0, 1]]
    )
    camera = Camera(turn @ at(5.0), 200, 2, 100, 100, 100, 1, orthographic=True)
    how = RenderSettings(samples=64, bounces=0, camera_sees="mesh")

    def edge_at(meshes):
        shown = Session().render(Frame(0, camera, [], World(strength=0.0), how, ("Combined",), meshes))
        row = shown["Combined"][0, :, 0]
        return (row < 0.5 * row.max()).sum() / 100.0

    moved = edge_at([slab, edge, ground]) - edge_at([edge, ground, FAR])
    inside = np.arcsin(np.sin(angle) / 1.5)
    # The sideways shift of a ray through a slab of thickness 1.
    assert abs(moved) == pytest.approx(np.sin(angle - inside) / np.cos(inside), abs=0.02)


def test_shadow_rays_end_at_glass_and_light_comes_through_paths():
    """A light without size cannot be met by chance: glass throws a full shadow, as in Cycles; one with size shines."""
    glass = card(Material("glass", (1, 1, 1), 0.0, transmission=1.0, thin_walled=True), 1.0, 3.0)
    glass.visibility = replace(glass.visibility, camera=False)
    ground = card(Material("ground", (0.5, 0.5, 0.5), 1.0, specular_level=0.0))
    settings = {"world": 0.0, "samples": 4096, "size": 2, "bounces": 2}
    point, area = Light("p", "point", at(3.0)), Light("a", "area", at(3.0), power=50.0, size_x=4.0)
    assert picture([glass, ground], lights=[point], **settings).max() == 0
    open_air = picture([ground], lights=[area], **settings).mean()
    assert 0.8 * open_air < picture([glass, ground], lights=[area], **settings).mean() < open_air


def test_translucent_card_is_lit_from_behind():
    leaf = Material("leaf", (0.5, 0.5, 0.5), kind="translucent")
    below = World(np.concatenate([np.zeros((8, 16, 3)), np.ones((8, 16, 3))]).astype(np.float32))
    assert picture([card(leaf)], world=below, samples=256).mean() == pytest.approx(0.5, rel=0.02)


def test_parts_add_up_by_weight():
    even = {"world": 1.0, "samples": 256, "size": 4}
    one, other = (Material(f"m{c}", (c, c, c), kind="diffuse") for c in (0.2, 0.8))
    mixed = Material("mixed", parts=[Part(one, (0.25,) * 3), Part(other, (0.5, 0.75, 0.75))])
    found = picture([card(mixed)], **even).mean(axis=(0, 1))
    np.testing.assert_allclose(found, [0.45, 0.65, 0.65], rtol=0.02)


#: Of which every parameter counts.
ALL = Material(
    "all", (0.8, 0.6, 0.4), 0.6, 0.3, ior=1.7, specular_level=0.7, specular_tint=(0.9, 0.8, 0.7), anisotropy=0.5,
    anisotropy_rotation=0.1, coat=0.5, coat_roughness=0.4, coat_ior=1.6, coat_tint=(0.7, 0.8, 0.9), sheen=0.6,
    sheen_roughness=0.4, sheen_tint=(0.9, 0.7, 0.5), transmission=0.3, diffuse_roughness=0.5,
)  # fmt: skip
LEFT, RIGHT = np.float32([0.55, 0.7, 0.85]), np.float32([0.95, 0.65, 0.75])
PAIR = Image("pair", np.concatenate([[[LEFT, RIGHT]], np.ones((1, 2, 1), np.float32)], axis=2).astype(np.float32))


@pytest.mark.parametrize("name", ("base_colour", "roughness", "metallic", *TEXTURED, "weight", "inverted weight"))
def test_a_texture_of_a_parameter_is_its_value_at_each_place(name):
    """An image of two texels is what two surfaces without images are, each on its side."""
    own = ALL if name.endswith("weight") else getattr(ALL, name)
    texture = Texture("pair", "rgb" if name.endswith("weight") or np.ndim(own) else "r", interpolation="closest")
    if name.endswith("weight"):
        inverted = name != "weight"
        given = Material("m", parts=[Part(ALL, (0.5, 0.6, 0.7), texture, inverted)])
        sides = [np.multiply(1 - c if inverted else c, (0.5, 0.6, 0.7)) for c in (LEFT, RIGHT)]
        constant = [Material("m", parts=[Part(ALL, tuple(map(float, side)))]) for side in sides]
    else:
        field = {} if name in TEXTURED else {f"{name}_texture": texture}
        given = replace(ALL, textures={name: texture} if name in TEXTURED else {}, **field)
        sides = [np.multiply(own, c if np.ndim(own) else c[0]) for c in (LEFT, RIGHT)]
        constant = [replace(ALL, **{name: tuple(map(float, v)) if np.ndim(v) else float(v)}) for v in sides]
    settings = {"world": sky(), "size": 2, "samples": 16, "bounces": 0}
    found = picture([card(given)], images=[PAIR], **settings)
    left, right = (picture([card(m)], **settings) for m in constant)
    np.testing.assert_allclose(found[:, 0], left[:, 0], rtol=1e-4)
    np.testing.assert_allclose(found[:, 1], right[:, 1], rtol=1e-4)
    assert np.abs(left / right - 1).max() > 3e-3


def test_highlights_follow_the_tangent_layer_and_turn_from_it_counterclockwise():
    """Two bright places of the sky, opposite to each other, halfway between the X and the Y axis."""
    sky = np.zeros((16, 32, 3), np.float32)
    sky[3:6, 3:6] = sky[3:6, 19:22] = 10.0

    def brushed(angle: float, rotation: float) -> np.ndarray:
        along = np.zeros((2, 3, 4), np.float32)
        along[..., :2] = np.cos(angle), np.sin(angle)
        metal = Material("m", (1, 1, 1), 0.5, 1.0, anisotropy=0.9, anisotropy_rotation=rotation, tangent="way")
        return picture([card(metal, layers=[Layer("way", along)])], world=World(sky), size=2, samples=256).mean()

    turned = brushed(0.2 * np.pi, 0.0)
    assert brushed(0.0, 0.1) == pytest.approx(turned, rel=0.02)
    assert brushed(0.2 * np.pi, -0.1) == pytest.approx(brushed(0.0, 0.0), rel=0.02)
    others = brushed(0.0, 0.0), brushed(-0.2 * np.pi, 0.0), brushed(0.4 * np.pi, 0.0)
    assert all(abs(other / turned - 1) > 0.2 for other in others)


def test_the_coat_is_smooth_unless_it_has_the_normal_map_of_what_is_below():
    tilt = [SurfaceDetail("world", None, tuple(np.array([0.3, 0.1, 0.9]) / 2 + 0.5))]
    coat = Material("coat", (0, 0, 0), 0.2, coat=1.0, coat_roughness=0.2, coat_ior=1.5, specular_level=0.0)
    dielectric = Material("dielectric", (0, 0, 0), 0.2, ior=1.5)
    settings = {"world": sky(), "size": 2, "samples": 256, "bounces": 0}
    smooth, tilted = (picture([card(replace(dielectric, details=d)), FAR], **settings) for d in ([], tilt))
    assert np.abs(smooth / tilted - 1).min() > 0.1
    np.testing.assert_allclose(picture([card(replace(coat, details=tilt))], **settings), smooth, rtol=0.03)
    own = replace(coat, details=tilt, coat_details=True)
    np.testing.assert_allclose(picture([card(own)], **settings), tilted, rtol=0.03)


def test_a_closed_box_is_as_bright_as_the_geometric_series_of_its_bounces():
    """Walls that give off light and reflect four fifths: paths that end early by chance count more where they go on."""
    walls = Material("walls", (0.8,) * 3, kind="diffuse", emission=(1.0,) * 3)
    found = picture([box(walls)], world=0.0, size=2, height=0.5, samples=2048, bounces=8)
    assert found.mean() == pytest.approx((1 - 0.8**10) / 0.2, rel=0.015)


def test_light_passes_six_panes():
    pane = Material("pane", (1, 1, 1), 0.0, transmission=1.0, ior=1.001)
    panes = [box(replace(pane, name=f"pane {i}"), float(i), 0.3) for i in range(-3, 3)]
    for each in panes:
        each.matrices[0, 2, 2] *= 0.5
    ground = card(Material("ground", (0, 0, 0), emission=(1, 1, 1), kind="diffuse"), -5.0, 50.0)
    found = picture([*panes, ground], world=0.0, size=2, samples=16, bounces=0)
    np.testing.assert_allclose(found, 1.0, rtol=2e-3)


def test_paths_meet_the_light_that_meshes_emit():
    """The same as in batches, and a thing far away, by which rays start higher above surfaces, changes nothing."""
    glow = card(Material("glow", (0, 0, 0), emission=(3.0, 2.0, 1.0)), 0.8, 0.5)
    glow.visibility = Visibility(camera=False)
    meshes = [card(SPEC), glow, box(Material("red", (0.8, 0.2, 0.1)), 0.4, 0.1)]
    settings = {"samples": 1024, "size": 4, "bounces": 1, "subpixel_samples": 16, "world": 0.0}
    batches, found = picture(meshes, **settings), picture([*meshes, FAR], **settings)
    np.testing.assert_allclose(found.mean(axis=(0, 1)), batches.mean(axis=(0, 1)), rtol=0.01)


def test_normal_maps_soften_diffuse_light_as_in_batches():
    tilt = SurfaceDetail("world", None, tuple(np.array([0.8, 0.0, 0.6]) / 2 + 0.5))
    meshes = [card(Material("m", (0.8, 0.6, 0.4), 1.0, details=[tilt]))]
    settings = {"samples": 1024, "size": 4, "bounces": 1, "subpixel_samples": 16, "world": sky()}
    batches, found = picture(meshes, **settings), picture([*meshes, FAR], **settings)
    np.testing.assert_allclose(found.mean(axis=(0, 1)), batches.mean(axis=(0, 1)), rtol=0.01)


@pytest.mark.parametrize(("kind", "other"), (("diffuse", "glossy"), ("glossy", "diffuse")))
def test_rays_of_a_lobe_meet_what_its_kind_of_rays_meets(kind, other):
    """A mesh that gives off light, hidden to one kind of rays, shines by the other kind of lobes alone."""
    surface = Material("surface", (0.8, 0.6, 0.4), 0.5, kind=kind)

    def lit(**hidden: bool) -> np.ndarray:
        glow = card(Material("glow", (0, 0, 0), emission=(1.0, 1.0, 1.0)), 0.8, 0.5)
        glow.visibility = Visibility(camera=False, **hidden)
        return picture([card(surface), glow], world=0.0, size=2, bounces=0)

    seen_by_all = lit()
    assert seen_by_all.min() > 0.05 and not lit(**{kind: False}).any()
    np.testing.assert_allclose(lit(**{other: False}), seen_by_all, rtol=1e-4)


def test_lights_shine_on_what_is_linked_at_every_vertex():
    """The lamp is there for the lid alone, which the mirror below shows."""
    lid = card(Material("lid", (0.5,) * 3), 0.8, 3.0)
    lid.visibility = Visibility(camera=False, lit_by=1)
    mirror = card(Material("mirror", (1, 1, 1), 0.1, 1.0))
    mirror.visibility = Visibility(lit_by=0)
    lamp = Light("l", "point", at(0.4), power=20.0, receivers=0)
    settings = {"world": 0.0, "lights": [lamp], "size": 2, "samples": 256, "bounces": 1}
    batches, found = (picture([lid, mirror, *more], **settings).mean() for more in ([], [FAR]))
    assert batches > 0.1 and found == pytest.approx(batches, rel=0.03)


def test_moments_are_sums_of_squares_and_second_points_have_numbers_of_their_own():
    """Of a single sample the one is the square of the other."""
    rows = material_rows([Material("m", coat=0.5)], None, lambda *_: None, [])
    kernel, how = paths.PathKernel(rows), settings(1, auto=True, shading_model="principled")
    given = points(64, albedo=0.5, roughness=0.4)
    flags = np.full(64, SECOND, np.uint32)
    first, second = (
        integrate(TraceScene(), EnvironmentLight(sky()), p, how, 0, kernel=kernel)
        for p in (given, replace(given, flags=flags))
    )
    assert (first.moments[:, 0] == 1).all() and (first.moments[:, 1:] > 0).any()
    np.testing.assert_allclose(first.moments[:, 2::2], first.moments[:, 1::2] ** 2, rtol=1e-5)
    assert not np.array_equal(first.components, second.components)


@pytest.mark.parametrize(
    "material",
    (
        Material("metal", (0.9, 0.0, 0.0), 1.0, 1.0, anisotropy=0.5),
        Material("glass", (0.9, 0.9, 0.9), 0.6, transmission=1.0, specular_tint=(1.0, 0.0, 0.0)),
        Material("thin", (0.9,) * 3, 0.6, transmission=1.0, specular_tint=(1.0, 0.0, 0.0), thin_walled=True),
    ),
    ids=lambda material: material.name,
)
def test_light_over_a_colour_that_is_almost_black_stays_small(material):
    """Light of the channel of which the surface has none is in the picture, and its pass is no larger than others."""
    names = ("Combined", "GlossDir", "GlossInd", "GlossCol", "TransDir", "TransInd", "TransCol")
    found = seen([card(material)], names, size=2)
    assert found["GlossCol"][..., 1:].min() > 0 and found["GlossDir"].max() < 2 and found["TransDir"].max() < 2
    parts = ((found[f"{k}Dir"] + found[f"{k}Ind"]) * found[f"{k}Col"] for k in ("Gloss", "Trans"))
    np.testing.assert_allclose(sum(parts), found["Combined"][..., :3], rtol=1e-3, atol=1e-6)


def test_other_looks_leave_the_paper_and_plain_scenes_alone():
    plain, coated = card(SPEC), card(replace(SPEC, coat=1.0))
    paper = {"shading_model": "paper", "world": sky()}
    np.testing.assert_array_equal(picture([plain], **paper), picture([coated], **paper))


def test_clamp_limits_what_paths_bring():
    glass = box(Material("glass", roughness=0.1, transmission=1.0), 0.0, 0.4)
    free, cut = (picture([glass], world=sky(), clamp_indirect=c).mean() for c in (0.0, 0.3))
    assert cut < free


@pytest.mark.parametrize("denoise", ("none", "svgf"))
def test_passes_of_light_times_colours_are_combined(denoise):
    """Glass, a leaf and a plain floor; what the glass lets pass has passes of its own."""
    names = ("Combined", "Emit", "Env", *(f"{a}{b}" for a in ("Diff", "Gloss", "Trans") for b in ("Dir", "Ind", "Col")))
    tinted = Material("glass", (0.4, 0.6, 0.9), 0.2, transmission=0.8, sheen=0.3, coat=0.4)
    meshes = [box(tinted, 0.5, 0.3), card(Material("leaf", (0.5,) * 3, kind="translucent"), 2.0, 0.1), card(SPEC)]
    found = seen(meshes, names, sky(), lights=[Light("l", "area", at(1.5), size_x=0.5)], denoise=denoise)
    total = found["Emit"] + found["Env"]
    for lobe in ("Diff", "Gloss", "Trans"):
        total = total + (found[f"{lobe}Dir"] + found[f"{lobe}Ind"]) * found[f"{lobe}Col"]
    np.testing.assert_allclose(total, found["Combined"][..., :3], rtol=1e-3, atol=1e-4)
    assert found["TransInd"].max() > 0
    floor = found["TransCol"].sum(axis=2) == 0
    assert floor.any() and not found["TransInd"][floor].any()


def test_colour_passes_add_up_the_lobes():
    glass = Material("glass", (0.25, 0.5, 1.0), 0.0, transmission=1.0, ior=1.5)
    found = seen([card(glass)], ("DiffCol", "GlossCol", "TransCol"), size=2)
    np.testing.assert_allclose(found["GlossCol"], 0.04, rtol=1e-3)
    np.testing.assert_allclose(found["TransCol"], 0.96 * np.sqrt([[[0.25, 0.5, 1.0]]]) * np.ones((2, 2, 1)), rtol=1e-3)
    assert not found["DiffCol"].any()
    leaf = Material("leaf", (0.5, 0.25, 0.125), kind="translucent")
    found = seen([card(leaf)], ("DiffCol", "GlossCol", "TransCol"), size=2)
    np.testing.assert_allclose(found["DiffCol"], np.broadcast_to([0.5, 0.25, 0.125], (2, 2, 3)), rtol=1e-5)
    assert not found["GlossCol"].any() and not found["TransCol"].any()
