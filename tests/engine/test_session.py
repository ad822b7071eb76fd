"""The session: what it keeps never shows in a picture."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
from pictures import assert_same_bits, fresh, with_meshes

from drgs_blender.core.asset.container import read_asset, write_asset
from drgs_blender.core.asset.model import Asset, Mesh, Surfels
from drgs_blender.core.errors import AssetError, Cancelled, UsageError
from drgs_blender.core.frame import Adjustment, Light, MeshState, ObjectState, Visibility, World
from drgs_blender.core.materials import Material
from drgs_blender.engine.scene_objects import traced_object
from drgs_blender.ipc.change_detection import reuse_equal


def turned(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def test_history_does_not_show(session, make_frame, asset_path):
    """After every kind of change a frame has the bits it has in a fresh session."""
    frames = [make_frame(bend) for bend in (0.0, 0.3, 0.3)]
    frames[1].world.rotation = turned(40)
    frames[2].world.strength = 3.0
    two = make_frame(0.1)
    second = ObjectState("Second", two.objects[0].asset)
    second.matrix_world[:3, 3] = 1.5, 1.0, 0.0
    two.objects.append(second)
    swapped = make_frame(0.1)
    swapped.objects = [second, two.objects[0]]
    mesh = make_frame(0.2, camera_sees="mesh")
    constant = make_frame(0.2)
    constant.world = World(colour=(0.2, 0.4, 0.8))
    painted = make_frame()
    painted.objects[0].albedo = np.full_like(painted.objects[0].vertices, 0.9)
    twins = make_frame(0.1)
    twins.objects = [two.objects[0], ObjectState("Ball", second.asset, second.matrix_world)]
    tinted = make_frame()
    tinted.objects[0].adjustment = Adjustment(tint=(0.2, 1.0, 0.5), mask=painted.objects[0].albedo[:, 0].copy())
    for frame in (*frames, two, swapped, twins, mesh, constant, painted, tinted, frames[0]):
        assert_same_bits(session.render(frame), fresh(asset_path, frame))


def test_history_of_meshes_does_not_show(session, make_frame, asset_path):
    """As above with ordinary meshes next to the object: every change gives the bits of a fresh session."""
    frames = [with_meshes(make_frame(0.1)) for _ in range(2)]
    frames.append(with_meshes(make_frame(0.3)))
    base = frames[0].meshes
    for changes in (
        {"a_matrices": base[0].matrices + 0.1},
        {"b_matrices": base[1].matrices[::-1].copy()},
        {"b_matrices": base[1].matrices[:1], "b_pass_indices": np.int32([9])},
        {"b_vertices": base[1].vertices * 2},
        {"a_visibility": Visibility(camera=False)},
        {"a_visibility": Visibility(holdout=True)},
        {"b_materials": [Material("Plain", (0.1, 0.9, 0.1))]},
        {"b_uvs": base[1].uvs[::-1].copy()},
    ):
        frames.append(with_meshes(make_frame(0.1), **changes))
    repainted = with_meshes(make_frame(0.1))
    repainted.images[0].pixels[:] = 20
    hidden = with_meshes(make_frame(0.1))
    hidden.objects[0].visibility.camera = False
    for frame in (*frames, repainted, hidden, make_frame(0.1), frames[0]):
        assert_same_bits(session.render(frame), fresh(asset_path, frame))


def test_only_what_changed_is_given_on(session, make_frame):
    session.render(with_meshes(make_frame(0.1)))
    floor, squares = session._scene_cache.meshes
    built = session._scene_cache.scene.bvh.rebuilds
    frame = with_meshes(make_frame(0.1))
    frame.meshes[1].matrices[0, 0, 3] += 0.1
    session.render(frame)
    assert session._scene_cache.meshes[0] is floor and session._scene_cache.meshes[1] is not squares
    assert (
        session._scene_cache.meshes[1].vertices is squares.vertices
        and session._scene_cache.meshes[1].materials is squares.materials
    )
    assert session._scene_cache.scene.bvh.rebuilds == built
    before = list(session._scene_cache.meshes)
    session.render(frame)
    assert all(a is b for a, b in zip(before, session._scene_cache.meshes, strict=True))


def test_a_camera_that_does_not_see_the_object_sees_the_mesh_behind_it(session, make_frame):
    frame = with_meshes(make_frame(0.0))
    seen = session.render(frame)
    frame.objects[0].visibility.camera = False
    unseen = session.render(frame)
    assert unseen["Depth"].max() <= seen["Depth"].max() + 1e-3 or (unseen["Depth"] == 1e10).any()
    frame.objects = []
    gone = session.render(frame)
    np.testing.assert_array_equal(unseen["Depth"], gone["Depth"])
    assert not np.array_equal(unseen["Combined"], gone["Combined"])  # it still throws shadows


def test_unusable_instances_are_named(session, make_frame):
    frame = with_meshes(make_frame())
    frame.meshes[1].matrices[1] = np.nan
    frame.meshes[1].materials[0].base_colour_texture.image = "Nothing"
    passes = session.render(frame)
    assert any(text.startswith("Squares: 1 instances are flat") for text in passes.warnings)
    assert any("'Nothing' is missing" in text for text in passes.warnings)
    assert all(np.isfinite(array).all() for array in passes.values())
    assert session.render(with_meshes(make_frame())).warnings == []


def test_renewed_shares_what_is_equal():
    frame = with_meshes_state()
    known = reuse_equal(frame, None)
    assert known is not frame and not known.vertices.flags.writeable
    assert reuse_equal(frame, known) is known
    frame.materials[0].roughness = 0.25
    changed = reuse_equal(frame, known)
    assert changed is not known and changed.vertices is known.vertices and changed.visibility is known.visibility
    assert known.materials[0].roughness == 0.5 and changed.materials[0].roughness == 0.25
    frame.vertices[0, 0] = np.nan
    again = reuse_equal(frame, changed)
    assert again.vertices is not changed.vertices and reuse_equal(frame, again) is again


def with_meshes_state():
    square = np.float32([[-1, -1, 0], [1, -1, 0], [1, 1, 0]])
    return MeshState("Square", square, np.int32([[0, 1, 2]]), np.eye(4)[None], np.int32([0]))


def test_array_changed_in_place_is_noticed(session, make_frame, asset_path):
    frame = make_frame()
    before = session.render(frame)["Combined"].copy()
    frame.world.environment[:8] *= 2
    brighter = session.render(frame)
    assert brighter["Combined"][..., :3].sum() > before[..., :3].sum()
    assert_same_bits(brighter, fresh(asset_path, frame))


def test_nothing_is_made_again_when_nothing_changed(session, make_frame):
    session.render(make_frame(0.1))
    light, objects = session._scene_cache.environment, list(session._scene_cache.objects)
    frame = make_frame(0.1)
    frame.camera.matrix_world[0, 3] = 0.4
    session.render(frame)
    assert session._scene_cache.environment is light
    assert session._scene_cache.objects == objects and session._scene_cache.objects[0] is objects[0]
    frame.world.rotation = turned(10)
    session.render(frame)
    assert session._scene_cache.environment is light


def test_another_background_is_seen_and_does_not_light(session, make_frame, asset_path):
    def opaque():
        frame = make_frame(film_transparent=False)
        frame.passes = ("Combined", "Depth", "DiffDir", "GlossDir", "Env")
        return frame

    plain, frame = session.render(opaque()), opaque()
    frame.background = World(colour=(0.2, 0.4, 0.8))
    seen = session.render(frame)
    empty = seen["Depth"][..., 0] > 1e9
    assert 0 < empty.sum() < empty.size
    np.testing.assert_allclose(seen["Env"][empty], [(0.2, 0.4, 0.8)] * empty.sum(), rtol=1e-6)
    for name in ("DiffDir", "GlossDir"):
        np.testing.assert_array_equal(plain[name], seen[name])
    light = session._scene_cache.background
    frame = replace(frame, background=World(colour=(0.2, 0.4, 0.8)))
    assert_same_bits(session.render(frame), fresh(asset_path, frame))
    assert session._scene_cache.background is light, "it did not change"
    assert_same_bits(session.render(opaque()), plain)
    assert session._scene_cache.background is None
    frame.background.rotation = np.eye(3) * 2
    with pytest.raises(UsageError, match=r"rotation.*scales"):
        session.render(frame)


def test_vanished_objects_are_dropped(session, make_frame):
    frame = make_frame()
    session.render(frame)
    frame.objects = []
    empty = session.render(frame)
    assert session._scene_cache.objects == []
    assert empty.statistics["triangles"] == 0
    np.testing.assert_allclose(empty["Depth"], 1e10)


def test_rewritten_asset_is_loaded_again(tmp_path, session, make_frame, asset_path):
    path = tmp_path / "copy.drgs"
    shutil.copy(asset_path, path)
    key = session.load_asset(path)
    frame = make_frame()
    frame.objects[0].asset = key
    before = session.render(frame)["Combined"]
    kept = session.asset(key)
    assert session.load_asset(path) == key
    assert session.asset(key) is kept
    asset = read_asset(path)
    surfels = asset.surfels
    surfels.albedo = 1 - surfels.albedo
    write_asset(path, Asset(surfels, asset.mesh, asset.binding))
    assert session.load_asset(path) == key
    assert not np.array_equal(session.render(frame)["Combined"], before)


def test_mirrored_object_is_lit_from_outside(session, make_frame, mesh):
    """A mirrored copy of a symmetric mesh keeps its faces and corner normals outward."""
    asset = session.asset(make_frame().objects[0].asset)
    state = ObjectState("Ball", "k", np.diag([-2.0, 1.0, 1.0, 1.0]))
    corners = mesh.vertices[mesh.faces]
    state.corner_normals = (corners / np.linalg.norm(corners, axis=2, keepdims=True)).astype(np.float32)
    traced = traced_object(state, asset)
    a, b, c = (traced.vertices[traced.faces[:, k]] for k in range(3))
    face_normals = np.cross(b - a, c - a)
    assert (np.einsum("ij,ij->i", face_normals, a + b + c) > 0).all()
    assert traced.corner_normals is not None
    assert (np.einsum("ij,ikj->ik", face_normals, traced.corner_normals) > 0).mean() > 0.95
    np.testing.assert_allclose(np.linalg.norm(traced.corner_normals, axis=2), 1, atol=1e-5)


@pytest.mark.parametrize("surface", ["mesh", "surfels"])
def test_a_torn_body_leaves_its_gap_free(session, make_frame, surface):
    """The upper half is carried off: with `tear`, neither camera nor rays meet the faces that join the halves."""
    frame = make_frame(size=(40, 60), samples=1, camera_sees=surface, rays_see=surface)
    whole = frame.objects[0].vertices

    def alpha(lifted, tear):
        moved = whole + np.where(whole[:, 2:] > 0.1, np.float32([[0, 0, lifted]]), 0)
        frame.objects[0].vertices, frame.objects[0].tear = moved.astype(np.float32), tear
        return session.render(frame)["Combined"][..., 3]

    gap = slice(17, 25)  # rows between the halves
    still = alpha(0.0, 0.3)
    joined = alpha(1.2, 0.0)
    assert joined[gap].max() > 0.99
    torn = alpha(1.2, 0.3)
    assert torn[gap].max() < 0.02, "surfels reach a little beyond their faces"
    assert torn[30:].sum() == pytest.approx(joined[30:].sum(), rel=0.05)
    assert torn[:14].sum() > 20, "the upper half is there"
    assert not session.render(frame).warnings
    np.testing.assert_array_equal(alpha(0.0, 0.3), still)
    np.testing.assert_array_equal(alpha(1.2, 1.5), joined, err_msg="less apart than that")


def test_unfit_objects_are_named_with_both_counts(session, make_frame):
    def refused(error, *words, **change):
        frame = make_frame()
        for name, value in change.items():
            setattr(frame.objects[0], name, value)
        with pytest.raises(error) as caught:
            session.render(frame)
        text = str(caught.value)
        assert all(word in text for word in ("Ball", *words)), text
        assert caught.value.remedy

    count = len(make_frame().objects[0].vertices)
    refused(AssetError, "7", str(count), vertices=np.zeros((7, 3), np.float32))
    refused(AssetError, "albedo", str(count), albedo=np.zeros((3, 3), np.float32))
    refused(AssetError, "corner normals", corner_normals=np.zeros((2, 3, 3), np.float32))
    refused(AssetError, "not loaded", asset="/nowhere.drgs")
    refused(UsageError, "matrix", matrix_world=np.full((4, 4), np.nan))


def test_unusable_settings_are_refused(session, make_frame):
    for name, value in (("samples", -1), ("bounces", -2)):
        frame = make_frame()
        setattr(frame.settings, name, value)
        with pytest.raises(UsageError, match="negative"):
            session.render(frame)
    frame = make_frame()
    frame.passes = ("Combined", "Nonsense")
    with pytest.raises(UsageError, match="Nonsense"):
        session.render(frame)


@pytest.mark.parametrize("camera_sees", ["surfels", "mesh"])
def test_materials_out_of_range_are_as_at_its_end_on_surfels_and_mesh_alike(session, make_frame, mesh, camera_sees):
    def picture(**materials):
        frame = make_frame(camera_sees=camera_sees)
        frame.passes = ("Combined", "Albedo", "Roughness", "Metallic", "DiffDir")
        for name, value in materials.items():
            setattr(frame.objects[0], name, np.full_like(getattr(mesh, name), value))
        return session.render(frame)

    for name, beyond, end in (("albedo", -1, 0), ("metallic", 5, 1), ("roughness", np.inf, 1), ("roughness", -3, 0)):
        assert_same_bits(picture(**{name: beyond}), picture(**{name: end}))
    own, lost = picture(), picture(metallic=np.nan)
    assert_same_bits(own, lost)
    (text,) = lost.warnings
    assert text.startswith("Ball: ") and "metallic" in text and str(len(mesh.vertices)) in text


def test_environment_that_is_not_only_turned_is_refused(session, make_frame):
    frame = make_frame()
    frame.world.rotation = np.eye(3) * 1e20
    with pytest.raises(UsageError, match=r"rotation.*scales"):
        session.render(frame)


def test_vertices_of_a_huge_object_are_not_called_infinite_alone(session, make_frame, caplog):
    frame = make_frame(camera_sees="mesh")
    frame.objects[0].matrix_world[:3, :3] *= 1e20
    (text,) = session.render(frame).warnings
    assert text.startswith("Ball: ") and "not finite or too far away" in text
    frame = make_frame()
    frame.objects[0].vertices[1] = np.nan
    session.render(frame)
    assert not [r for r in caplog.records if r.levelname == "WARNING"], "the user reads the frame's warnings"


@pytest.mark.parametrize(("part", "problem"), [("surfels", "has no surfels"), ("faces", "has no surfels")])
def test_asset_of_which_nothing_would_be_seen_is_refused(tmp_path, session, make_frame, asset_path, part, problem):
    asset = read_asset(asset_path)
    flat, wide = np.empty(0, np.float32), np.empty((0, 3), np.float32)
    mesh, none = asset.mesh, Surfels(wide, wide[:, :2], np.empty((0, 4), np.float32), flat, wide, flat, flat)
    if part == "faces":
        mesh = Mesh(mesh.vertices, mesh.faces[:0], mesh.albedo, mesh.roughness, mesh.metallic)
    path = tmp_path / "empty.drgs"
    write_asset(path, Asset(none, mesh))
    frame = make_frame()
    frame.objects[0].asset = session.load_asset(path)
    with pytest.raises(AssetError, match=f"Ball.*{problem}"):
        session.render(frame)
    frame.settings.camera_sees = "mesh"
    if part == "surfels":
        assert session.render(frame)["Combined"][..., 3].max() > 0.9
    else:
        with pytest.raises(AssetError, match=r"Ball.*has no faces"):
            session.render(frame)


def test_frame_without_an_object_says_so(session, make_frame):
    frame = make_frame()
    frame.objects = []
    assert [text for text in session.render(frame).warnings if "no DR-GS object" in text]


def test_bad_vertices_are_counted_and_leave_no_bad_pixel(session, make_frame):
    frame = make_frame()
    frame.objects[0].vertices[[1, 5]] = np.nan, np.inf, 0.0
    passes = session.render(frame)
    (text,) = passes.warnings
    assert text.startswith("Ball: 2 vertices are not finite or too far away; ") and "surfels are left out" in text
    assert all(np.isfinite(array).all() for array in passes.values())
    assert session.render(make_frame()).warnings == []


def test_every_fault_of_a_scene_is_counted_by_the_name_of_its_object(session, make_frame):
    """Vertices that are no numbers, faces without area, texels that are no light; no pixel shows it."""
    frame = make_frame()
    corners = np.float32([[-9, 2, -1], [9, 2, -1], [9, 2, 9], [np.nan, 2, 9], [0, 2, 0]])
    faces = np.int32([[0, 1, 2], [0, 2, 3], [4, 4, 1], [0, 0, 0]])
    frame.meshes = [MeshState("Wall", corners, faces, np.eye(4)[None], np.int32([0]))]
    frame.objects[0].vertices[7] = np.inf
    frame.world.environment[3, 4], frame.world.environment[0, 0] = np.nan, -1.0
    passes = session.render(frame)
    assert all(np.isfinite(array).all() for array in passes.values())
    ball, wall, empty, world = passes.warnings
    assert ball.startswith("Ball: 1 vertices are not finite")
    assert wall.startswith("Wall: 1 vertices are not finite") and "1 faces are left out" in wall
    assert empty == "Wall: 2 faces have no area; light passes through them"
    assert world.startswith("world: 2 pixels of the environment are negative, infinite or no number")


@pytest.mark.parametrize("index", [-1, 4, 2**31 - 1])
def test_faces_of_vertices_that_are_not_there_are_refused_by_name(session, make_frame, index):
    frame = make_frame()
    square = np.float32([[-1, 2, -1], [1, 2, -1], [1, 2, 1], [-1, 2, 1]])
    frame.meshes = [MeshState("Wall", square, np.int32([[0, 1, index]]), np.eye(4)[None], np.int32([0]))]
    with pytest.raises(UsageError, match=r"Wall: faces refer to vertices outside 0\.\.3"):
        session.render(frame)
    frame.meshes = []
    assert np.isfinite(session.render(frame)["Combined"]).all()


def test_unbound_surfels_need_binding_or_the_mesh(tmp_path, session, make_frame, asset_path):
    asset = read_asset(asset_path)
    path = tmp_path / "unbound.drgs"
    write_asset(path, Asset(asset.surfels, asset.mesh))
    frame = make_frame()
    frame.objects[0].asset = session.load_asset(path)
    with pytest.raises(AssetError, match=r"Ball.*not bound"):
        session.render(frame)
    frame.settings.camera_sees = "mesh"
    assert session.render(frame)["Combined"][..., 3].max() > 0.9


def test_cancelled_between_stages(session, make_frame):
    with pytest.raises(Cancelled):
        session.render(make_frame(), cancelled=lambda: True)


def test_statistics_and_stages(session, make_frame):
    passes = session.render(make_frame(camera_sees="surfels"))
    stages = ("seconds.deform", "seconds.light", "seconds.render", "seconds.total")
    assert all(passes.statistics[name] >= 0 for name in stages)
    assert passes.statistics["surfels"] == len(session.asset(make_frame().objects[0].asset).surfels)
    assert passes.statistics["samples"] == 48 * 36 * 6


def test_a_threshold_that_cannot_be_followed_is_named(session, make_frame):
    frame = make_frame()
    frame.settings = replace(frame.settings, noise_threshold=0.1, samples=7, subpixel_samples=4)
    assert any("noise threshold" in text and "7 samples" in text for text in session.render(frame).warnings)
    frame.settings = replace(frame.settings, samples=32)
    assert not any("noise threshold" in text for text in session.render(frame).warnings)


def test_regions_and_history_do_not_show_in_adaptive_frames(session, make_frame, asset_path):
    """Whether a pixel goes on is its own affair: a region is a crop, with a light in the scene too."""
    frame = make_frame(0.2)
    frame.settings = replace(frame.settings, noise_threshold=0.2, samples=64, subpixel_samples=2)
    place = np.eye(4)
    place[:3, 3] = (0.5, -1.0, 3.0)
    frame.lights = [Light("Panel", "area", place, power=60.0, size_x=0.5)]
    whole = session.render(frame)["Combined"]
    camera = frame.camera
    x0, y0, x1, y1 = camera.width // 4, camera.height // 4, camera.width // 2 + 3, camera.height // 2 + 5
    frame.camera = replace(camera, region=(x0, y0, x1, y1))
    np.testing.assert_array_equal(fresh(asset_path, frame)["Combined"], whole[y0:y1, x0:x1])


@pytest.mark.parametrize("camera_sees", ["surfels", "mesh"])
def test_an_adjustment_changes_what_is_seen_and_keeps_its_detail(session, make_frame, camera_sees):
    """A tint is a factor on every pixel's albedo, whatever stands between vertices; a mask leaves a half alone."""
    names = ("Combined", "Albedo", "Roughness", "Coverage", "Position")
    frame = replace(make_frame(camera_sees=camera_sees), passes=names)
    before = session.render(frame)
    frame.objects[0].adjustment = Adjustment(tint=(0.5, 1.0, 0.25), roughness=(0.5, 0.1, 0.0, 1.0))
    after = session.render(frame)
    covered = before["Coverage"][..., 0] > 0
    np.testing.assert_allclose(
        after["Albedo"][covered], before["Albedo"][covered] * np.float32([0.5, 1, 0.25]), atol=1e-5
    )
    np.testing.assert_allclose(
        after["Roughness"], np.where(covered[..., None], before["Roughness"] / 2 + 0.1, 0), atol=1e-5
    )
    asset = session.asset(frame.objects[0].asset)
    frame.objects[0].adjustment.mask = (asset.mesh.vertices[:, 2] > 0).astype(np.float32)
    masked, height = session.render(frame), before["Position"][..., 2]
    far = 0.35 if camera_sees == "mesh" else 0.75  # surfels are as wide as faces, and soft
    low, high = covered & (height < -far), covered & (height > far)
    assert low.any() and high.any()
    np.testing.assert_allclose(masked["Albedo"][low], before["Albedo"][low], atol=1e-6)
    np.testing.assert_allclose(masked["Albedo"][high], after["Albedo"][high], atol=1e-6)
    frame.objects[0].adjustment.mask = np.ones(3, np.float32)
    with pytest.raises(AssetError, match="mask of its adjustments"):
        session.render(frame)


def test_lobes_that_the_papers_shading_leaves_out_are_named(session, make_frame):
    frame = with_meshes(make_frame(0.1), b_materials=[Material("Lacquer", coat=1.0), Material("Plain")])
    frame.settings.shading_model = "paper"
    (text,) = [text for text in session.render(frame).warnings if "Cook-Torrance" in text]
    assert "Lacquer" in text and "Plain" not in text
    frame.meshes[1].materials = [Material("Plain")]
    assert not any("Cook-Torrance" in text for text in session.render(frame).warnings)


def test_a_scene_of_meshes_alone_has_the_sub_pixel_samples_of_meshes(session, make_frame):
    """Whatever the camera sees of objects that are not there."""
    pictures = []
    for sees in ("surfels", "mesh"):
        frame = with_meshes(make_frame(camera_sees=sees))
        frame.objects.clear()
        pictures.append(session.render(frame))
    assert_same_bits(*pictures)


def dark(frame):
    frame.world = World(colour=(0.0, 0.0, 0.0))
    return frame


def test_a_scene_that_nothing_lights_is_named(session, make_frame):
    frame = dark(make_frame())
    (text,) = session.render(frame).warnings
    assert text.startswith("nothing lights the scene")
    assert session.view("a", frame).warnings == [text]
    lamp = Light("Lamp", "point", np.eye(4), power=10.0)
    assert text in session.render(replace(frame, lights=[replace(lamp, power=0.0)])).warnings
    assert session.render(replace(frame, lights=[lamp])).warnings == []
    vertices = frame.objects[0].vertices
    glowing = dark(make_frame())
    glowing.objects[0].emission = np.ones((len(vertices), 3), np.float32)
    lit = with_meshes(dark(make_frame()))
    lit.meshes[0].materials = [Material("Lit", emission=(1.0, 1.0, 1.0))]
    for shining in (glowing, lit, replace(frame, world=World(strength=0.1))):
        assert not any("lights the scene" in text for text in session.render(shining).warnings)
