"""Places in a pixel through which inverse rendering sees the surface: a photograph shows the mean over the pixel."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import plain_mesh, sphere_mesh

torch = pytest.importorskip("torch")

from capture_cases import camera  # noqa: E402

from drgs_blender.core.asset.model import Mesh  # noqa: E402
from drgs_blender.reconstruct.capture.capture import View  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.losses import unbiased_loss  # noqa: E402
from drgs_blender.reconstruct.inverse_rendering.pixels import PLACES, Pixels, Subpixels, foreground_pixels  # noqa: E402
from drgs_blender.render.reference.raster import pixel_centres, project  # noqa: E402
from drgs_blender.render.scene.triangle_bvh import TriangleBVH  # noqa: E402

VIEWS = [View(str(k), camera(k, 6, 48), np.full((48, 48, 3), 0.5, np.float32)) for k in range(6)]


@pytest.fixture(scope="module")
def seen() -> tuple[Mesh, Pixels, Subpixels]:
    mesh = plain_mesh(*sphere_mesh(3))
    tree = TriangleBVH()
    tree.build(mesh.vertices, mesh.faces)
    pixels = foreground_pixels(VIEWS, mesh, tree, 10**6)
    return mesh, pixels, Subpixels(pixels, VIEWS, mesh, tree)


@pytest.mark.parametrize("number", range(len(PLACES)))
def test_a_point_lies_behind_its_place_in_the_pixel(seen: tuple[Mesh, Pixels, Subpixels], number: int) -> None:
    mesh, pixels, points = seen
    shown = points.select(np.arange(len(pixels)), np.full(len(pixels), number))
    assert np.array_equal(shown.place, pixels.place) and np.array_equal(shown.colour, pixels.colour)
    for index, view in enumerate(VIEWS):
        own = shown.view == index
        at, _ = project(view.camera, torch.from_numpy(shown.origin[own].astype(np.float64)))
        off = at.numpy() - pixel_centres(view.camera).numpy()[shown.place[own]]
        centre = np.abs(off).max(axis=1) < 1e-3  # where the place shows nothing to learn from
        assert centre.mean() < 0.05 and np.abs(off[~centre] - PLACES[number]).max() < 1e-3
    corner = mesh.vertices[mesh.faces[shown.face]]
    np.testing.assert_allclose(np.einsum("nk,nkc->nc", shown.corners, corner), shown.origin, atol=1e-6)
    np.testing.assert_allclose((shown.flat * (corner[:, 0] - corner[:, 1])).sum(1), 0, atol=1e-5)
    assert ((shown.flat * shown.towards).sum(1) > 0).all()


def test_estimates_at_two_places_find_no_error_in_what_is_the_pixels_mean(seen: tuple[Mesh, Pixels, Subpixels]) -> None:
    """At an edge between two materials; through the centres alone, the true surface would have an error there."""
    mesh, pixels, points = seen
    bright, rows = (mesh.vertices[:, 2] > 0.1).astype(np.float32), np.arange(len(pixels))
    shown = []
    for number in range(len(PLACES)):
        behind = points.select(rows, np.full(len(pixels), number))
        shown.append((behind.corners * bright[mesh.faces[behind.face]]).sum(1))
    photographed = torch.tensor(np.mean(shown, axis=0), dtype=torch.float32)[:, None].expand(-1, 3)
    random, losses = np.random.default_rng(0), []
    for _ in range(400):
        drawn = np.choose(random.integers(0, len(PLACES), (2, len(pixels))), shown).T
        losses.append(float(unbiased_loss(torch.tensor(drawn)[..., None].expand(-1, -1, 3).float(), photographed)))
    centre = (pixels.corners * bright[mesh.faces[pixels.face]]).sum(1)
    through = torch.tensor(centre)[:, None, None].expand(-1, 2, 3).float()
    assert abs(np.mean(losses)) < 3 * np.std(losses) / len(losses) ** 0.5
    assert float(unbiased_loss(through, photographed)) > 5 * np.std(losses) / len(losses) ** 0.5
