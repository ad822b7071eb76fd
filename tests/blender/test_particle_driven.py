"""Splats that simulated particles carry: what Blender gives to the engine, in any frame and under any edit."""

from __future__ import annotations

from dataclasses import replace

import bpy
import numpy as np
import pytest
from physics_scenes import FRAMES, cache_of, particle_cache, vertices
from scenes import part

playback, core_frame = part("addon.cache_playback"), part("drgs_blender.core.frame")


@pytest.fixture
def baked(body, scene, captured):
    bpy.ops.drgs.bake_physics()
    return body


def state_at(obj, frame, between=0.0, *, export):
    bpy.context.scene.frame_set(frame, subframe=between)
    given, told = export()
    return next(state for state in given.objects if state.name == obj.name), told


def test_particles_go_with_the_frame_that_is_shown(baked, export):
    cache = cache_of(baked)
    for frame, between in ((1, 0.0), (4, 0.0), (3, 0.25), (-5, 0.0), (99, 0.0)):
        state, told = state_at(baked, frame, between, export=export)
        want = cache.driving(frame + between)[0]
        for name in ("rest", "points", "gradients"):
            np.testing.assert_allclose(getattr(state.particles, name), getattr(want, name), atol=1e-6)
        assert not state.particles.all and not [text for text in told if "splats follow" in text]
    moved = state_at(baked, FRAMES, export=export)[0].particles
    assert (moved.points[:, 2] < moved.rest[:, 2]).all(), "it falls"


def test_driven_by_chooses(baked, export):
    physics = baked.drgs.physics
    physics.driven_by = "particles"
    assert state_at(baked, 3, export=export)[0].particles.all
    physics.driven_by = "surface"
    assert not state_at(baked, 3, export=export)[0].particles.surfels, "they say only what has broken"
    physics.inside = "open"
    hollow = state_at(baked, 3, export=export)[0]
    assert not hollow.particles.surfels and hollow.inside is None, "hollow pieces break as closed ones do"
    physics.tear = False
    assert state_at(baked, 3, export=export)[0].particles is None
    physics.driven_by = "automatic"
    assert state_at(baked, 3, export=export)[0].particles is not None


def test_the_inside_reaches_the_engine(baked, export):
    physics, lattice = baked.drgs.physics, cache_of(baked).header().cells
    state = state_at(baked, 3, export=export)[0]
    assert state.inside == core_frame.Inside() and np.array_equal(state.particles.cells, lattice)
    places = state.particles.rest @ state.particles.cells[:3, :3].T + state.particles.cells[:3, 3]
    np.testing.assert_allclose(places % 1.0, 0.5, atol=1e-3)
    physics.inside, physics.inside_colour = "own", (0.5, 0.25, 0.125)
    physics.inside_roughness, physics.inside_metallic = 0.25, 1.0
    assert state_at(baked, 3, export=export)[0].inside == core_frame.Inside((0.5, 0.25, 0.125), 0.25, 1.0)
    physics.inside = "open"
    state = state_at(baked, 3, export=export)[0]
    assert state.inside is None and np.array_equal(state.particles.cells, lattice)
    physics.inside, physics.tear = "own", False
    state = state_at(baked, 3, export=export)[0]
    assert state.inside is None and state.particles.cells is None


def test_what_has_broken_reaches_the_engine_frame_by_frame(baked, export):
    """In any order, between two as in the later one; of an earlier cache it is told that cracks may close."""
    cache, physics = cache_of(baked), baked.drgs.physics
    kept = {}
    for frame in cache.frames():
        read = cache.read(frame)
        arrays = [np.array(a) for a in (read.points, read.gradients, read.vertices, read.broken)]
        assert not arrays[3].any()
        arrays[3][:frame] = 255
        cache.write(frame, particle_cache.ParticleFrame(*arrays))
        kept[frame] = arrays[3]
    physics.driven_by = "surface"
    for inside in ("automatic", "open"):
        physics.inside = inside
        for frame, between, shown in ((4, 0.0, 4), (2, 0.25, 3), (3, 0.0, 3), (1, 0.0, 1), (99, 0.0, FRAMES)):
            state, told = state_at(baked, frame, between, export=export)
            np.testing.assert_array_equal(state.particles.broken, kept[shown])
            assert not [text for text in told if "may close again" in text]
    for frame in (None, *cache.frames()):
        read = cache.rest() if frame is None else cache.read(frame)
        old = particle_cache.ParticleFrame(*(np.array(a) for a in (read.points, read.gradients, read.vertices)))
        cache.write_rest(old) if frame is None else cache.write(frame, old)
    cache.describe(replace(cache.header(), version=2))
    state, told = state_at(baked, 3, export=export)
    assert state.particles.broken is None
    assert [text for text in told if baked.name in text and "cracks may close again. Bake again" in text]


def test_the_surface_of_particles_reaches_the_engine(baked, export):
    physics = baked.drgs.physics
    physics.tear, physics.driven_by = False, "surface"
    assert state_at(baked, 3, export=export)[0].particles is None, "of matter that keeps its shape the mesh is shown"
    physics.surface = "particles"
    particles = state_at(baked, 3, export=export)[0].particles
    assert particles.skin and not particles.surfels
    assert np.array_equal(particles.cells, cache_of(baked).header().cells)
    bpy.ops.drgs.free_physics()
    physics.surface, physics.material = "automatic", "water"
    bpy.ops.drgs.bake_physics()
    assert state_at(baked, 3, export=export)[0].particles.skin
    physics.surface = "mesh"
    assert state_at(baked, 3, export=export)[0].particles is None


def test_particles_move_with_what_moves_the_whole_mesh(baked, export):
    """A modifier after the simulation that turns the mesh turns the particles; one that bends it leaves them behind."""
    before = state_at(baked, 4, export=export)[0].particles
    holder = bpy.data.objects.new("Holder", None)
    bpy.context.collection.objects.link(holder)
    hook = baked.modifiers.new("Turn", "HOOK")
    hook.object = holder
    hook.vertex_indices_set(range(len(baked.data.vertices)))
    holder.rotation_euler = (0.0, 0.0, 0.5)
    holder.location = (0.3, 0.0, 0.0)
    state, told = state_at(baked, 4, export=export)
    assert not [text for text in told if "splats follow" in text]
    turn = np.array([[np.cos(0.5), -np.sin(0.5), 0], [np.sin(0.5), np.cos(0.5), 0], [0, 0, 1]])
    simulated = cache_of(baked).read(4).vertices
    shown = vertices(baked, 4)
    linear = np.linalg.lstsq(simulated - simulated.mean(axis=0), shown - shown.mean(axis=0), rcond=None)[0].T
    np.testing.assert_allclose(linear, turn, atol=1e-3)
    np.testing.assert_allclose(state.particles.gradients, turn @ before.gradients, atol=2e-3)
    shift = shown.mean(axis=0) - turn @ simulated.mean(axis=0)
    np.testing.assert_allclose(state.particles.points, before.points @ turn.T + shift, atol=2e-3)

    wave = baked.modifiers.new("Wave", "SIMPLE_DEFORM")
    wave.deform_method, wave.angle = "TWIST", 1.0
    state, told = state_at(baked, 4, export=export)
    assert state.particles is None
    assert [text for text in told if baked.name in text and "splats follow the mesh" in text]
    wave.show_viewport = False
    assert state_at(baked, 4, export=export)[0].particles is not None


def test_other_speeds_of_playback(baked, export):
    """The frame that the modifier shows, whatever its start, speed and interpolation."""
    modifier, cache = playback.modifier_of(baked), cache_of(baked)
    for settings in ({"frame_scale": 2.0}, {"frame_start": 0.5}, {"frame_scale": 0.5, "interpolation": "NONE"}):
        for name, value in settings.items():
            setattr(modifier, name, value)
        state, told = state_at(baked, 3, export=export)
        assert not [text for text in told if "splats follow" in text], settings
        shown = vertices(baked, 3)
        fits = [at for at in np.arange(1, FRAMES + 0.5, 0.5) if np.allclose(cache.driving(at)[1], shown, atol=1e-5)]
        np.testing.assert_allclose(state.particles.points, cache.driving(fits[0])[0].points, atol=1e-5)


def test_an_object_that_moves_by_itself_has_its_matter_where_it_is(body, scene, captured, export):
    """In the world the particles stand as they were simulated, between frames, too, while the object turns."""
    for frame, angle in ((1, 0.0), (FRAMES, 1.2)):
        body.rotation_euler = (0.0, 0.0, angle)
        body.keyframe_insert("rotation_euler", frame=frame)
    bpy.ops.drgs.bake_physics()
    scene.frame_set(1)
    first = np.array(body.matrix_world)
    for frame, between in ((4, 0.0), (3, 0.5)):
        state, told = state_at(body, frame, between, export=export)
        assert not [text for text in told if "splats follow" in text]
        points = state.particles.points @ state.matrix_world[:3, :3].T + state.matrix_world[:3, 3]
        baked = cache_of(body).driving(frame + between)[0].points @ first[:3, :3].T + first[:3, 3]
        assert np.abs(points - baked).max() < (1e-4 if between == 0 else 0.03)


def test_flat_meshes_turn_with_both_their_sides():
    affine = part("addon.export.particles")._affine
    flat = np.random.default_rng(0).normal(size=(60, 3)).astype(np.float32) * np.float32([1, 0.7, 0])
    for angle in (0.3, 1.57, 3.0):
        cos, sin = np.cos(angle), np.sin(angle)
        turn = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
        linear, offset = affine(flat, (flat @ turn.T + [1, 2, 3]).astype(np.float32))
        np.testing.assert_allclose(linear, turn, atol=1e-4)
        np.testing.assert_allclose(offset, [1, 2, 3], atol=1e-4)
    line = flat * np.float32([1, 0, 0])
    assert affine(line, line @ np.float32([[0, 1, 0], [1, 0, 0], [0, 0, 1]])) is None
    bent = flat.copy()
    bent[:, 2] = flat[:, 0] ** 2
    assert affine(flat, bent) is None


def test_hidden_playback_reads_nothing(baked, export):
    playback.modifier_of(baked).show_viewport = False
    cache_of(baked).path(3).write_bytes(b"nothing")
    state, told = state_at(baked, 3, export=export)
    assert state.particles is None and not [text for text in told if "splats follow" in text]


def test_matter_that_flows_is_followed_by_its_surface(body, scene, captured, export):
    body.drgs.physics.material = "sand"
    body.drgs.physics.frame_end = 3
    bpy.ops.drgs.bake_physics()
    state, told = state_at(body, 3, export=export)
    assert state.particles is None and not [text for text in told if "splats follow" in text]
    body.drgs.physics.driven_by = "particles"
    state, told = state_at(body, 3, export=export)
    assert state.particles is None and [text for text in told if "flows" in text and body.name in text]


def test_a_damaged_cache_is_told_and_the_mesh_plays_on(baked, export):
    cache_of(baked).path(3).write_bytes(b"nothing")
    state, told = state_at(baked, 3, export=export)
    assert state.particles is None
    assert [text for text in told if baked.name in text and "cannot be read" in text]
    state, told = state_at(baked, 4, export=export)
    assert state.particles is not None and not [text for text in told if "cannot be read" in text]


def test_a_simulation_that_begins_posed_leaves_surfels_to_the_mesh(body, scene, captured, export):
    """Its particles at rest are not where the surfels were captured."""
    bend = body.modifiers.new("Bend", "SIMPLE_DEFORM")
    bend.deform_method, bend.angle = "BEND", 1.0
    bpy.ops.drgs.bake_physics()
    state, told = state_at(body, 3, export=export)
    assert not state.particles.surfels and not [text for text in told if "splats follow" in text]
    begun = cache_of(body).rest().vertices
    assert np.array_equal(state.particles.began, begun) and np.abs(begun - vertices(body, 1)).max() < 1e-6
    body.drgs.physics.driven_by = "particles"
    state, told = state_at(body, 3, export=export)
    assert not state.particles.surfels and [text for text in told if "begins with another shape" in text]
    body.drgs.physics.tear = False
    assert state_at(body, 3, export=export)[0].particles is None
