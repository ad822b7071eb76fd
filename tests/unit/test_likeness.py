"""Which vertices photographs show alike, and what is learned of them together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from shapes import plain_mesh

torch = pytest.importorskip("torch")

from drgs_blender.core.asset import Mesh  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.likeness import LikePoints, features  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.pixels import Pixels  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.radiance_cache import edges_of  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.regularisers import Regularisers  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.settings import Settings  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.surface import Pairs, Surface  # noqa: E402

torch.set_num_threads(1)
RED, BLUE = np.float32([0.4, 0.1, 0.1]), np.float32([0.1, 0.1, 0.4])
VIEWS = 12


@pytest.fixture(scope="module")
def ball() -> Mesh:
    shape = trimesh.creation.icosphere(3)
    return plain_mesh(np.asarray(shape.vertices), shape.faces)


def pixels(mesh: Mesh, colour: np.ndarray) -> Pixels:
    """Each face as each view shows it, but for the lowest ones: colours (views, faces, 3)."""
    face = np.flatnonzero(mesh.vertices[mesh.faces][..., 2].mean(1) > -0.9).astype(np.int32)
    view = np.repeat(np.arange(VIEWS, dtype=np.int32), len(face))
    face = np.tile(face, VIEWS)
    third, none = np.full((len(face), 3), 1 / 3, np.float32), np.zeros((len(face), 3), np.float32)
    place = np.arange(len(face), dtype=np.int32)
    return Pixels(
        view,
        place,
        mesh.faces[face],
        third,
        none,
        none,
        none,
        colour[view, face].astype(np.float32),
        none > 0,
        none > 0,
    )


def of(mesh: Mesh, colour: np.ndarray) -> np.ndarray:
    """Features of the vertices."""
    return features(pixels(mesh, colour), len(mesh.vertices), edges_of(mesh.faces))


def painted(mesh: Mesh) -> np.ndarray:
    """Red on one side, blue on the other; there a view in four shows a highlight."""
    left = mesh.vertices[mesh.faces][..., 0].mean(1)[:, None] < 0
    colour = np.repeat(np.where(left, RED, BLUE)[None], VIEWS, axis=0)
    colour[::4, ~left[:, 0]] += 0.5
    return colour


def sides(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertices that lie wholly on one side."""
    return mesh.vertices[:, 0] < -0.2, mesh.vertices[:, 0] > 0.2


def test_features_leave_highlights_out_and_tell_what_reflects(ball):
    left, right = sides(ball)
    found = of(ball, painted(ball))
    assert np.isfinite(found).all()
    chroma, log, score = found[:, :2] * 0.03, found[:, 2] * 0.5, found[:, 3] * 0.4
    assert chroma[left] == pytest.approx(np.tile(RED[:2] / RED.sum(), (left.sum(), 1)), abs=0.01)
    assert chroma[right] == pytest.approx(np.tile(BLUE[:2] / BLUE.sum(), (right.sum(), 1)), abs=0.05)
    assert log[left] == pytest.approx(np.log(0.22), abs=0.01)  # of .2, and the knee
    assert abs(score[left]).max() < 0.01 and score[right].min() > 0.3


def test_points_that_have_no_share_of_a_pixel_take_nothing_of_it(ball):
    """As where a pixel shows fewer surfels than others."""
    seen = pixels(ball, painted(ball))
    padded = replace(
        seen, index=np.pad(seen.index, ((0, 0), (0, 2))), share=np.pad(seen.share, ((0, 0), (0, 2)))
    )  # of the first vertex
    count, edges = len(ball.vertices), edges_of(ball.faces)
    assert np.array_equal(features(padded, count, edges), features(seen, count, edges))


def test_light_of_another_brightness_changes_no_chromaticity_and_no_score(ball):
    colour = 2 * painted(ball)  # bright enough for the knee not to matter much
    one, other = (of(ball, c) for c in (colour, 4 * colour))
    assert other[:, :2] == pytest.approx(one[:, :2], abs=0.01)
    assert other[:, 3] == pytest.approx(one[:, 3], abs=0.2)
    assert (other[:, 2] - one[:, 2]).mean() * 0.5 == pytest.approx(np.log(4), rel=0.05)


def test_pairs_of_other_looks_or_from_afar_do_not_count(ball):
    """Even for a spot too small to find enough of its like: the rest of its nearest vertices weigh nothing."""
    colour = painted(ball)
    spot = ball.vertices[ball.faces].mean(1)[:, 0] < -0.985
    colour[:, spot] = RED[[1, 0, 1]]
    inside = np.setdiff1d(ball.faces[spot], ball.faces[~spot])
    assert len(inside) and len(np.unique(ball.faces[spot])) < 12
    like = LikePoints(of(ball, colour), ball.vertices, 0)
    pairs, weight = (x.numpy() for x in like.draw(np.random.default_rng(1)))
    assert pairs.shape == (len(weight), 2) and weight.min() >= 0 and weight.max() <= 1
    left, right = sides(ball)
    out = np.isin(pairs[:, 0], inside) & ~np.isin(pairs[:, 1], ball.faces[spot])
    assert out.any() and weight[out].max() < 0.01
    across = (left[pairs[:, 0]] & right[pairs[:, 1]]) | (right[pairs[:, 0]] & left[pairs[:, 1]])
    assert weight[across].sum() < 1e-3 * weight.sum()
    assert weight.mean() > 0.1


def test_pairs_keep_their_weights_among_the_vertices_of_a_step(ball):
    """Whatever pixels and edges use beside them."""
    surface = Surface(ball.vertices, ball.vertices, Settings(coarse=0), np.ones(3), False)
    surface.parameters["detail"][:] = torch.arange(len(ball.vertices))[:, None] / 100 - 3
    pairs = Pairs(torch.tensor([[7, 300], [2, 511], [300, 9]]), torch.tensor([0.1, 0.5, 0.9]))
    seen = pixels(ball, painted(ball)).select(np.arange(5))
    samples = surface.at(seen, edges_of(ball.faces)[:4], pairs)
    assert torch.equal(samples.pairs.weight, pairs.weight)
    assert torch.equal(samples.columns[samples.pairs.ends], surface.materials.at(pairs.ends.flatten()).view(3, 2, -1))


def test_likeness_makes_materials_of_pairs_alike_by_their_weight():
    held = Regularisers(np.array([[0, 1], [1, 2]]), np.full((3, 3), 0.5), Settings(same_material=0.5))
    columns = torch.tensor([[0.2] * 5, [0.3] * 5, [0.9] * 5], requires_grad=True)
    loss = held.of_likeness(columns, Pairs(torch.tensor([[0, 1], [1, 2]]), torch.tensor([1.0, 0.0])))
    assert float(loss.detach()) == pytest.approx(0.5 * 0.1 * 6 / 2, rel=1e-5)
    loss.backward()
    assert (columns.grad[0] < 0).all() and (columns.grad[1] > 0).all() and not columns.grad[2].any()
