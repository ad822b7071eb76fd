"""Broken matter as closed pieces: volumes, surfaces that close, walls that fit, and meshes that nothing has torn."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from drgs_blender.compute.threads import use_threads
from drgs_blender.deform.closed_matter import Breakable
from drgs_blender.simulation.fill import fill

Array = np.ndarray

#: Of each shape: how finely it is divided.
SHAPES = {"ball": 4, "cube": 3, "coarse cube": 0}


def shape_of(name: str) -> tuple[Array, Array]:
    made = trimesh.creation.icosphere(SHAPES[name]) if name == "ball" else trimesh.creation.box()
    for _ in range(0 if name == "ball" else SHAPES[name]):
        made = made.subdivide()
    return np.array(made.vertices, float), np.array(made.faces, np.int32)


class Body:
    """A shape full of particles, in an object space that is scaled and turned against the lattice."""

    def __init__(self, name: str, cells: int = 16) -> None:
        world, self.faces = shape_of(name)
        spacing = float(np.ptp(world, axis=0).max()) / cells
        filling = fill(world, self.faces, spacing)
        angle = 0.5
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        self.linear = 0.5 * turn  # of world places
        to_cells = np.eye(4)
        to_cells[:3, :3] = np.linalg.inv(self.linear) / spacing
        to_cells[:3, 3] = -filling.space.origin / spacing
        self.world, self.world_points = world, filling.points
        self.vertices, self.points = world @ self.linear.T, filling.points @ self.linear.T
        self.gap = 2 * 0.5 * spacing
        self.matter = Breakable(self.vertices, self.faces, self.points, to_cells)

    def parted(self, sides, moves) -> tuple[Array, Array, Array]:
        """Vertices, particles and gradients with each side moved by a rotation about z and a shift."""

        def moved(places):
            side = sides(places)
            out, turns = places.copy(), np.tile(np.eye(3), (len(places), 1, 1))
            for number, (angle, shift) in enumerate(moves):
                c, s = np.cos(angle), np.sin(angle)
                turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
                rows = side == number
                out[rows], turns[rows] = places[rows] @ turn.T + shift, turn
            back = np.linalg.inv(self.linear)
            return out @ self.linear.T, self.linear @ turns @ back

        vertices, _ = moved(self.world)
        points, gradients = moved(self.world_points)
        return vertices, points, gradients

    def closed(self, sides, moves, gap=None):
        return self.matter.closed(*self.parted(sides, moves), self.gap if gap is None else gap)


def in_two(places: Array) -> Array:
    """Sides of a wavy, slanted cut."""
    return (places @ [1.0, 0.35, 0.2] + 0.1 * np.sin(6 * places[:, 1]) > 0.03).astype(int)


APART = ((0.0, np.zeros(3)), (0.4, np.array([3.0, 0.5, 0.0])))


def all_faces(body: Body, closed) -> tuple[Array, Array]:
    """Vertices and faces of everything, with corners in the same place as one."""
    places = np.concatenate([closed.vertices, closed.points]).astype(np.float64)
    first = len(closed.vertices)
    faces = np.concatenate([body.faces[~closed.cut], closed.rim + first, closed.walls + first])
    return places, faces


def volume(places: Array, faces: Array) -> float:
    a, b, c = places[faces].transpose(1, 0, 2)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def open_area(places: Array, faces: Array) -> float:
    """What a surface lacks to be closed: the length of its summed area, 0 of a closed one, however it is divided."""
    a, b, c = places[faces].transpose(1, 0, 2)
    return float(np.linalg.norm(np.cross(b - a, c - a).sum(axis=0)) / 2)


@pytest.mark.parametrize("name", SHAPES)
def test_a_body_in_two_is_two_closed_solids_of_its_volume(name):
    body = Body(name)
    closed = body.closed(in_two, APART)
    places, faces = all_faces(body, closed)
    whole, area = volume(body.vertices, body.faces), trimesh.Trimesh(body.vertices, body.faces).area
    first = places[faces].mean(axis=1) @ np.linalg.inv(body.linear).T @ [1, 0, 0] < 1.2
    pieces = [volume(places, faces[side]) for side in (first, ~first)]
    # Cut edges next to faces that are not cut have corners in between: the sum of areas counts, not edges.
    for side in (first, ~first):
        assert open_area(places, faces[side]) < 1e-6 * area
    assert sum(pieces) == pytest.approx(whole, rel=1e-5)
    share = in_two(body.world_points).mean()
    assert min(pieces) / whole == pytest.approx(min(share, 1 - share), abs=0.02)


def test_pieces_in_place_are_the_whole(name="ball"):
    """With both sides where they were, walls lie on each other and what is left of cut faces on the faces."""
    body = Body(name)
    closed = body.closed(in_two, APART)
    apart, faces = all_faces(body, closed)
    first = len(closed.vertices)
    side = apart[: first + len(closed.points)] @ np.linalg.inv(body.linear).T @ [1, 0, 0] > 1.2
    world = apart @ np.linalg.inv(body.linear).T
    c, s = np.cos(0.4), np.sin(0.4)
    world[side] = (world[side] - APART[1][1]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    walls = np.sort(world[closed.walls + first].mean(axis=1).round(4), axis=0)
    np.testing.assert_allclose(walls[::2], walls[1::2], atol=2e-3)
    rim = world[closed.rim + first]
    assert np.abs(np.linalg.norm(rim.reshape(-1, 3), axis=1) - 1).max() < 0.02, "on the ball"
    assert len(faces) and np.abs(np.linalg.norm(world[closed.walls + first], axis=-1)).max() < 1.01, "not outside of it"


def test_a_crack_that_ends_leaves_one_closed_solid():
    """Opened like a mouth: the matter behind the crack holds."""
    body = Body("ball")

    def mouth(places):
        return np.where(places[:, 0] > -0.3, np.where(places[:, 2] > 0, 1, 2), 0)

    vertices, points, gradients = body.parted(mouth, ((0, np.zeros(3)), (0, np.zeros(3)), (0, np.zeros(3))))
    for at, rest in ((vertices, body.world), (points, body.world_points)):
        opened = np.clip(rest[:, 0] + 0.3, 0, None) * np.where(rest[:, 2] > 0, 1, -1) * 0.5
        at[:, 2] += opened
    closed = body.matter.closed(vertices, points, gradients, body.gap)
    places, faces = all_faces(body, closed)
    assert len(closed.walls) and open_area(places, faces) < 1e-5
    assert volume(places, faces) == pytest.approx(volume(body.vertices, body.faces), rel=0.05)


def test_what_has_not_broken_is_not_touched():
    body = Body("ball", 12)
    vertices, points, gradients = body.parted(in_two, ((0.3, np.zeros(3)),) * 2)
    assert body.matter.closed(2.9 * vertices, 2.9 * points, 2.9 * gradients, body.gap) is None, "stretched, not broken"
    apart = body.closed(in_two, ((0.0, np.zeros(3)), (0.0, np.array([0.05, 0, 0]))))
    assert apart is None, "nearer than the gap"


def test_shattered_matter_is_closed_and_does_not_grow():
    """Every eighth of the ball flies off: twelve flat walls and a corner where eight pieces met."""
    body = Body("ball")
    sides = [np.array([(n >> k & 1) - 0.5 for k in range(3)]) for n in range(8)]

    def octant(places):
        return (places > 0.01) @ [1, 2, 4]

    closed = body.closed(octant, [(0.0, 6 * side) for side in sides])
    places, faces = all_faces(body, closed)
    world = places @ np.linalg.inv(body.linear).T
    number = octant(world[faces].mean(axis=1))
    volumes = [volume(world, faces[number == n]) for n in range(8)]
    assert max(open_area(world, faces[number == n]) for n in range(8)) < 1e-5
    assert sum(volumes) == pytest.approx(volume(body.world, body.faces), rel=1e-5)
    assert min(volumes) > 0.1 * sum(volumes)


def test_gradients_that_count_the_tear_as_stretch_carry_nothing_away():
    """Particles beside a crack believe to be stretched tenfold: corners stay within the matter all the same."""
    body = Body("ball")
    vertices, points, gradients = body.parted(in_two, APART)
    near = np.abs(body.world_points @ [1.0, 0.35, 0.2]) < 0.3
    gradients[near] *= 10.0
    places, faces = all_faces(body, body.matter.closed(vertices, points, gradients, body.gap))
    assert volume(places, faces) == pytest.approx(volume(body.vertices, body.faces), rel=0.02)


def test_bits_do_not_depend_on_threads():
    body = Body("cube")
    found = []
    for threads in (1, 2):
        use_threads(threads)
        found.append(body.closed(in_two, APART))
    use_threads(0)
    for name in ("vertices", "cut", "points", "rim", "walls", "rim_normals"):
        assert getattr(found[0], name).tobytes() == getattr(found[1], name).tobytes(), name
