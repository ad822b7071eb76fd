"""Torn objects in pictures: pieces are closed, of the inside's material, and what is whole keeps its bits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pictures import assert_same_bits, fresh

from drgs_blender.compute import manifest
from drgs_blender.core.errors import AssetError
from drgs_blender.core.frame import Inside, MotionStep, Particles, Pose
from drgs_blender.deform import bond_kernels, crack_nodes, cut_faces, wall_faces
from drgs_blender.deform.bonds import Bonds
from drgs_blender.engine.kernel_jobs import jobs_of
from drgs_blender.engine.scene_warnings import scene_warnings
from drgs_blender.render.scene.ray_masks import CAMERA, ORDINARY, SHADOW, SURFELS
from drgs_blender.render.scene.trace_mesh import mask_of
from drgs_blender.simulation.fill import fill

GREEN = Inside((0.0, 1.0, 0.0), 1.0, 0.0)


@pytest.fixture(scope="module")
def filling(mesh):
    return fill(mesh.vertices, mesh.faces, 0.1)


def torn_frame(make_frame, filling, lifted, inside, **settings):
    """The ball with its upper part lifted off, tilted so that one looks onto the lower part."""
    frame = make_frame(size=(48, 64), **settings)
    state, spacing = frame.objects[0], filling.space.spacing
    to_cells = np.eye(4)
    to_cells[:3, :3] /= spacing
    to_cells[:3, 3] = -filling.space.origin / spacing

    def moved(places):
        return (places + np.where(places[:, 2:] > 0.1, [[0, 0, lifted]], 0)).astype(np.float32)

    rest = np.ascontiguousarray(filling.points, np.float32)
    gradients = np.tile(np.eye(3, dtype=np.float32), (len(rest), 1, 1))
    state.particles = Particles(rest, moved(rest), gradients, cells=to_cells)
    state.vertices, state.tear, state.inside = moved(state.vertices), 2 * spacing, inside
    c, s = np.cos(0.7), np.sin(0.7)
    state.matrix_world = np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]])
    return frame


def pushed_frame(make_frame, filling, lifted, inside=GREEN, **settings):
    """The ball of `torn_frame` after it has been torn, wherever its upper part is now."""
    frame = torn_frame(make_frame, filling, lifted, inside, **settings)
    apart = torn_frame(make_frame, filling, 1.2, inside).objects[0].particles
    bonds = Bonds(apart.rest, apart.cells)
    state = frame.objects[0]
    state.particles = replace(state.particles, broken=bonds.packed(bonds.broken(bonds.placed(apart.points), 2.0)))
    return frame


def green(passes):
    """How much of each pixel is the inside's: of nothing else the colour has green alone."""
    colour = passes["DiffCol"]
    return colour[..., 1] - np.maximum(colour[..., 0], colour[..., 2])


@pytest.mark.parametrize("surface", ["mesh", "surfels"])
def test_a_torn_body_shows_its_inside(session, make_frame, filling, surface):
    hollow = torn_frame(make_frame, filling, 1.2, None, camera_sees=surface, rays_see=surface)
    closed = torn_frame(make_frame, filling, 1.2, GREEN, camera_sees=surface, rays_see=surface)
    for frame in (hollow, closed):
        frame.passes = ("Combined", "DiffCol")
    shown, seen = session.render(hollow), session.render(closed)
    assert green(shown).max() < 0.4
    wall = green(seen) > 0.9
    assert wall.sum() > 100
    assert seen["Combined"][..., 3][wall].min() > 0.99 and not seen.warnings
    closed.objects[0].inside = Inside()
    plain = session.render(closed)["DiffCol"][wall]
    assert np.ptp(plain, axis=0).max() < 0.05, "of one colour, the mean"


def first_hits(scene, places, directions):
    """Cosines between rays and the faces that they meet first; NaN of rays that meet none."""
    a, b, c = scene.vertices[scene.faces].astype(np.float64).transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    found = np.full(len(places), np.nan)
    for i, (start, way) in enumerate(zip(places, directions)):
        with np.errstate(all="ignore"):
            across = np.cross(way, c - a)
            scale = np.einsum("ij,ij->i", b - a, across)
            u = np.einsum("ij,ij->i", start - a, across) / scale
            turned = np.cross(start - a, b - a)
            v = turned @ way / scale
            t = np.einsum("ij,ij->i", c - a, turned) / scale
            t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)
        nearest = int(np.argmin(t))
        if np.isfinite(t[nearest]):
            found[i] = normal[nearest] @ way
    return found


def test_no_ray_from_outside_sees_the_back_of_a_face(session, make_frame, filling):
    generator = np.random.default_rng(3)
    places = generator.normal(size=(600, 3))
    places *= 5 / np.linalg.norm(places, axis=1, keepdims=True)
    targets = generator.uniform(-0.6, 0.6, (600, 3)) + np.array([0, 0.4, 0.5])
    backs = []
    for inside in (None, GREEN):
        session.render(torn_frame(make_frame, filling, 1.2, inside, camera_sees="mesh"))
        cosines = first_hits(session._scene_cache.scene, places, targets - places)
        assert np.isfinite(cosines).sum() > 300
        backs.append(int((cosines > 0).sum()))
    assert backs[0] > 30 and backs[1] == 0


@pytest.mark.parametrize("surface", ["mesh", "surfels"])
def test_whole_objects_keep_their_bits(session, make_frame, filling, surface):
    """At rest, and stretched but joined, the picture is that of an object whose pieces stay hollow."""
    for lifted in (0.0, 0.05):
        frames = [torn_frame(make_frame, filling, lifted, inside, camera_sees=surface) for inside in (None, GREEN)]
        assert_same_bits(*[session.render(frame) for frame in frames])


def test_history_does_not_show_in_broken_objects(session, make_frame, filling, asset_path):
    for lifted, inside in ((0.0, GREEN), (1.2, GREEN), (1.4, GREEN), (1.4, None), (1.4, Inside()), (0.0, GREEN)):
        frame = torn_frame(make_frame, filling, lifted, inside)
        assert_same_bits(session.render(frame), fresh(asset_path, frame))


def test_passes_name_the_object_inside_and_out(session, make_frame, filling):
    frame = torn_frame(make_frame, filling, 1.2, GREEN)
    frame.objects[0].pass_index = 7
    frame.passes = ("DiffCol", "IndexOB", "CryptoObject00", "Vector", "Combined")
    frame.settings = replace(frame.settings, denoise="svgf")
    passes = session.render(frame)
    wall = green(passes) > 0.9
    assert (passes["IndexOB"][wall] == 7).all()
    outside = (passes["Combined"][..., 3] > 0.99) & (green(passes) < 0.1)
    assert len(np.unique(passes["CryptoObject00"][..., 0][wall | outside])) == 1


@pytest.mark.parametrize("surface", ["mesh", "surfels"])
def test_what_is_torn_and_stands_still_has_no_motion(session, make_frame, filling, surface):
    """Though matter at cracks is not where the mesh has it."""
    frame = torn_frame(make_frame, filling, 1.2, GREEN, camera_sees=surface)
    frame.passes = ("Vector", "Combined")
    state = frame.objects[0]
    pose = Pose(state.name, np.array(state.matrix_world)[None], state.vertices)
    frame.previous = frame.next = MotionStep(frame.camera, [pose])
    assert np.abs(session.render(frame)["Vector"]).max() < 1e-3


def test_a_broken_object_that_is_moved_is_closed_once(session, make_frame, filling, asset_path):
    """What has broken is that of before; the picture is that of a session that knows nothing of it."""
    frame = torn_frame(make_frame, filling, 1.2, GREEN)
    session.render(frame)
    closed = session._scene_cache.objects[0].closed
    frame.objects[0] = replace(frame.objects[0], matrix_world=np.eye(4), pass_index=3)
    picture = session.render(frame)
    assert session._scene_cache.objects[0].closed is closed is not None
    assert_same_bits(picture, fresh(asset_path, frame))


def test_damaged_particles_are_refused_by_name(session, make_frame, filling):
    frame = torn_frame(make_frame, filling, 1.2, GREEN)
    particles = frame.objects[0].particles
    wrong = [
        replace(particles, cells=np.zeros((4, 4))),
        replace(particles, cells=np.full((4, 4), np.nan)),
        replace(particles, points=particles.points[1:]),
    ]
    for given in wrong:
        frame.objects[0].particles = given
        with pytest.raises(AssetError, match=frame.objects[0].name):
            session.render(frame)


@pytest.mark.parametrize("skin", [False, True])
def test_faces_without_area_are_told_of_what_can_be_mended(session, make_frame, filling, skin):
    """A skin, which is made anew in every frame, has some of hundreds of thousands: counted here as if it had."""
    frame = torn_frame(make_frame, filling, 0.0, None)
    frame.objects[0].particles = replace(frame.objects[0].particles, skin=skin, surfels=False)
    session.render(frame)
    cache = session._scene_cache
    cache.scene.faults[0].empty_faces = 4
    told = [text for text in scene_warnings(cache) if "4 faces have no area" in text]
    assert len(told) == (0 if skin else 1)


@pytest.mark.parametrize("surface", ["mesh", "surfels"])
def test_what_flows_is_shown_by_its_particles(session, make_frame, filling, surface, asset_path):
    """Poured into a flat box: camera and rays meet that, in the colours that the particles bring, and no surfel."""
    frame = torn_frame(make_frame, filling, 0.0, GREEN, camera_sees=surface, rays_see=surface)
    state, count = frame.objects[0], len(filling.points)
    spacing = filling.space.spacing
    n = int(np.ceil((count / 4) ** 0.5))
    i = np.arange(count)
    poured = np.stack([i % n - n / 2, (i // n) % n - n / 2, i // n**2 - 2], 1) * spacing
    state.matrix_world = np.eye(4)
    state.vertices[:] = 50.0
    state.particles = replace(state.particles, points=poured.astype(np.float32), skin=True, surfels=False)
    frame.passes = ("Combined", "DiffCol", "IndexOB", "CryptoObject00")
    state.pass_index = 3
    passes = session.render(frame)
    seen = passes["Combined"][..., 3] > 0.99
    rows, columns = np.nonzero(seen)
    assert np.ptp(columns) > 3 * np.ptp(rows) > 0 and (passes["IndexOB"][seen] == 3).all()
    assert passes["DiffCol"][seen].std() > 0.01, "not of one colour"
    assert [text for text in passes.warnings if "surface of its particles" in text]
    assert_same_bits(passes, fresh(asset_path, frame))
    frame.objects[0].particles = replace(state.particles, points=np.full_like(poured, np.nan, np.float32))
    passes = session.render(frame)
    assert not passes["Combined"][..., 3].any()
    assert [text for text in passes.warnings if f"{count} particles are not finite" in text]


def test_matter_that_was_posed_before_it_broke_is_closed(session, make_frame, filling):
    """Particles that filled the ball where a pose had put it: the same picture as of one that was there all along."""
    plain = torn_frame(make_frame, filling, 1.2, GREEN, camera_sees="mesh")
    posed = torn_frame(make_frame, filling, 1.2, GREEN, camera_sees="mesh")
    state, shift = posed.objects[0], np.float32([5.0, 0.0, 0.0])
    began = session.asset(state.asset).mesh.vertices + shift
    cells = state.particles.cells.copy()
    cells[:3, 3] -= cells[:3, :3] @ shift
    state.particles = replace(
        state.particles,
        rest=state.particles.rest + shift,
        points=state.particles.points + shift,
        cells=cells,
        began=began,
    )
    state.vertices = state.vertices + shift
    state.matrix_world = state.matrix_world.copy()
    state.matrix_world[:3, 3] -= state.matrix_world[:3, :3] @ shift
    for frame in (plain, posed):
        frame.passes = ("Combined", "DiffCol")
    shown = [green(session.render(frame)) for frame in (plain, posed)]
    assert (shown[0] > 0.9).sum() > 100
    np.testing.assert_allclose(shown[1], shown[0], atol=0.3)
    state.particles = replace(state.particles, began=began[1:])
    with pytest.raises(AssetError, match="began"):
        session.render(posed)


@pytest.mark.parametrize("lifted", [0.0, 0.04])  # of cells with sides of 0.1
@pytest.mark.parametrize(("surface", "inside"), [("mesh", GREEN), ("mesh", None), ("surfels", GREEN)])
def test_what_is_pushed_together_stays_broken_and_shows_no_seam(session, make_frame, filling, surface, inside, lifted):
    """Also where a small gap is left: the picture is that of a body that has never broken."""
    session.render(torn_frame(make_frame, filling, 1.2, inside))
    apart = session._scene_cache.objects[0].closed
    options = {"camera_sees": surface, "rays_see": surface, "samples": 96}
    whole = session.render(torn_frame(make_frame, filling, lifted, inside, **options))["Combined"]
    assert session._scene_cache.objects[0].closed is None
    seen = session.render(pushed_frame(make_frame, filling, lifted, inside, **options))["Combined"]
    closed = session._scene_cache.objects[0].closed
    assert len(closed.walls) == len(apart.walls) and not len(closed.crack)
    seen, whole = (picture[..., :3].mean(axis=-1)[whole[..., 3] > 0.99] for picture in (seen, whole))
    assert (seen / whole).min() > 0.8 and np.abs(seen / whole - 1).mean() < 0.01


def test_what_had_broken_does_not_depend_on_frames_before(session, make_frame, filling, asset_path):
    """Forwards, backwards and with leaps: each picture is that of a session that knows nothing of the others."""
    for lifted, inside in ((1.2, GREEN), (0.0, GREEN), (0.3, GREEN), (0.0, None), (1.2, None), (0.0, GREEN)):
        frame = pushed_frame(make_frame, filling, lifted, inside)
        assert_same_bits(session.render(frame), fresh(asset_path, frame))
    frame.objects[0].particles = replace(frame.objects[0].particles, broken=None)
    session.render(frame)
    assert session._scene_cache.objects[0].closed is None, "by where particles are nothing has broken"


def test_bits_of_other_bonds_are_refused_by_name(session, make_frame, filling):
    frame = pushed_frame(make_frame, filling, 1.2)
    state = frame.objects[0]
    bits = state.particles.broken
    for wrong in (bits[:-1], bits[:0], np.append(bits, bits[:1]), bits.astype(np.float32), bits[None]):
        state.particles = replace(state.particles, broken=wrong)
        with pytest.raises(AssetError, match=rf"{state.name}: what has broken of it.*Bake it again"):
            session.render(frame)


@pytest.mark.parametrize("rays", ["mesh", "surfels"])
def test_surfels_are_tied_to_what_is_left_of_cut_faces_and_not_to_walls(session, make_frame, filling, rays):
    """Where nothing tied them, those below the mesh were in its shadow: black flecks along cracks."""

    def masks(frame):
        session.render(frame)
        cracks = session._scene_cache.objects[0].cracks
        return {("wall", "rim")[int(mesh.material_index[0])]: mask_of(mesh) for mesh in cracks}

    light = SHADOW if rays == "mesh" else 0
    torn = masks(torn_frame(make_frame, filling, 1.2, GREEN, rays_see=rays))
    assert torn["wall"] & (ORDINARY | SURFELS | SHADOW) == ORDINARY | SHADOW
    assert torn["rim"] & (ORDINARY | SURFELS | SHADOW) == ORDINARY | SURFELS | light
    shut = masks(pushed_frame(make_frame, filling, 0.0, GREEN, rays_see=rays))
    assert len(shut) == 1
    for mask in shut.values():
        assert mask & (ORDINARY | SURFELS | SHADOW | CAMERA) == SURFELS | light | CAMERA


def test_kernels_of_broken_matter_are_compiled_ahead(session, make_frame, filling):
    """Those that a frame calls when its matter breaks are among those that are prepared while it is whole."""
    whole = torn_frame(make_frame, filling, 0.0, GREEN)
    session.render(torn_frame(make_frame, filling, 1.2, GREEN))
    jobs = jobs_of(whole)
    assert "broken" in jobs
    listed = {(kernel.module, kernel.name): manifest.signature(kernel) for kernel in manifest.needed(jobs)}
    called = [
        (module.__name__, name, found.signatures)
        for module in (bond_kernels, crack_nodes, cut_faces, wall_faces)
        for name, found in vars(module).items()
        if getattr(getattr(found, "_cache", None), "kind", "") == "kernel"
        and found.py_func.__module__ == module.__name__
        and found.signatures
    ]
    assert len(called) > 8
    for module_name, name, signatures in called:
        assert listed.get((module_name, name)) in signatures, f"{module_name}:{name}"
    whole.objects[0].tear = 0.0
    assert "broken" not in jobs_of(whole), "what cannot break needs none of them"
