"""Surfaces of particles: their volume, how flat they are, drops, and the same bits on any number of threads."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from drgs_blender.compute.threads import use_threads
from drgs_blender.geometry.particle_surface import particle_surface

SPACING = 0.05


def box(*counts: int) -> np.ndarray:
    """(n, 3) particles that fill a box, a little in disorder, in their spacings."""
    cells = np.stack(np.meshgrid(*[np.arange(count) + 0.5 for count in counts], indexing="ij"), -1).reshape(-1, 3)
    return cells + np.random.default_rng(2).uniform(-0.2, 0.2, cells.shape)


def volume(surface) -> float:
    a, b, c = surface.vertices[surface.faces].astype(np.float64).transpose(1, 0, 2)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def test_water_in_a_box_has_its_volume_and_a_level_top():
    particles = box(22, 20, 12)
    surface = particle_surface(particles * SPACING, SPACING)
    assert trimesh.Trimesh(surface.vertices, surface.faces).is_watertight
    assert volume(surface) == pytest.approx(len(particles) * SPACING**3, rel=0.03)
    top = surface.vertices[(surface.vertices[:, 2] > 8 * SPACING) & (np.abs(surface.vertices[:, 0] - 0.55) < 0.25)
                           & (np.abs(surface.vertices[:, 1] - 0.5) < 0.25)]  # fmt: skip
    assert np.abs(top[:, 2] - 12 * SPACING).max() < 0.25 * SPACING, "an eighth of a cell of the grid"
    assert surface.normals[np.argmax(surface.vertices[:, 2])][2] > 0.9 and not surface.coarse


def test_one_particle_that_flies_off_costs_the_others_nothing():
    particles = box(14, 12, 10)
    alone = particle_surface(particles, 1.0)
    found = particle_surface(np.concatenate([particles, [[1e6, 0.0, 0.0]]]), 1.0)
    assert (found.far, found.coarse, alone.far) == (1, False, 0)
    assert np.array_equal(found.vertices, alone.vertices) and np.array_equal(found.faces, alone.faces)


def test_every_particle_is_there():
    """Drops of one, two and five particles have surfaces of their own, of about their volume."""
    groups = [[[0, 0, 0]], [[9, 0, 0], [9, 1, 0]], [[0, 9, 0], [1, 9, 0], [0, 10, 0], [1, 10, 0], [0, 9, 1]]]
    particles = np.concatenate([np.array(group, float) for group in groups])
    surface = particle_surface(particles, 1.0)
    parts = trimesh.Trimesh(surface.vertices, surface.faces).split()
    assert len(parts) == len(groups)
    for part in parts:
        held = sum(np.linalg.norm(particles - part.centroid, axis=1) < 3)
        assert 0.5 * held < part.volume < 2.5 * held


def test_a_surface_does_not_pop():
    """A drop that nears a pool by a tenth of a spacing at a time never changes the volume by more than a particle."""
    pool = box(10, 10, 5)
    volumes = []
    for height in np.arange(7.5, 5.2, -0.1):
        surface = particle_surface(np.concatenate([pool, [[5.0, 5.0, height]]]), 1.0)
        volumes.append(volume(surface))
    assert np.abs(np.diff(volumes)).max() < 1.0


def test_what_is_moved_has_the_same_surface():
    particles = box(8, 7, 6)
    here = particle_surface(particles, 1.0)
    there = particle_surface(particles + np.array([100.0, -30.0, 0.5]), 1.0)
    np.testing.assert_allclose(there.vertices, here.vertices + np.float32([100, -30, 0.5]), atol=1e-4)


def test_bits_do_not_depend_on_threads():
    found = []
    for threads in (1, 2):
        use_threads(threads)
        found.append(particle_surface(box(14, 13, 12) * SPACING, SPACING))
    use_threads(0)
    for a, b in zip(found[0][:3], found[1][:3]):
        assert a.tobytes() == b.tobytes()


def test_no_particles_no_surface(monkeypatch):
    assert not len(particle_surface(np.zeros((0, 3)), 1.0).faces)
    assert not len(particle_surface(np.full((4, 3), np.nan), 1.0).faces)
    monkeypatch.setattr("drgs_blender.geometry.particle_surface._MOST", 1 << 18)
    far = particle_surface(np.array([[0.0, 0, 0], [1e4, 1e4, 1e4]]), 1.0)
    assert far.coarse, "memory is bounded"
