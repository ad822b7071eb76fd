"""Objects that were found to be thin when they were reconstructed: light meets sheets of their surfels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from pictures import assert_same_bits, fresh

from drgs_blender.core.asset import Asset, Mesh
from drgs_blender.core.asset.container import read_asset, write_asset
from drgs_blender.core.frame import Frame, MeshState, Visibility, World
from drgs_blender.engine.session import Session
from drgs_blender.render.surfels.sheets import OFF, sheets

THIN = {"report": {"thin": True}}


@pytest.fixture(scope="session")
def thin_path(tmp_path_factory: pytest.TempPathFactory, asset_path: Path) -> Path:
    path = tmp_path_factory.mktemp("thin") / "thin.drgs"
    write_asset(path, replace(read_asset(asset_path), provenance=THIN))
    return path


@pytest.fixture
def frame_of(make_frame: Callable[..., Frame]) -> Callable[..., Frame]:
    """Function that makes a frame of one of the two assets."""

    def make(path: Path, bend: float = 0.0, **settings: object) -> Frame:
        frame = make_frame(bend, **settings)
        frame.objects[0].asset = str(path.resolve())
        return frame

    return make


def test_a_sheet_has_the_area_and_the_plane_of_its_surfel():
    rng = np.random.default_rng(0)
    centre, u, v = rng.normal(size=(3, 5, 3)).astype(np.float32)
    v -= u * ((u * v).sum(1) / (u * u).sum(1))[:, None]
    opacity = rng.uniform(0.1, 1, 5).astype(np.float32)
    vertices, faces = sheets(centre, u, v, opacity)
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(cross, axis=1).reshape(5, 2).sum(1)
    kernel = 2 * np.pi * opacity * np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1)
    assert area == pytest.approx(kernel, rel=1e-4)
    normal = np.cross(u, v)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    off = np.einsum("nkc,nc->nk", vertices.reshape(5, 4, 3) - centre[:, None], normal)
    assert np.ptp(off, axis=1).max() < 1e-5 and np.abs(off).max() <= OFF * np.sqrt(area.max()) < 0.01
    middle = vertices.reshape(5, 4, 3).mean(1) - off.mean(1)[:, None] * normal
    assert middle == pytest.approx(centre, abs=1e-5)


def test_no_two_sheets_of_a_face_are_in_one_plane():
    """Of those that are, light would meet the one that is found first, which the history of the tree decides."""
    n = 2000
    centre = np.zeros((n, 3), np.float32)
    u, v = np.tile(np.float32([0.1, 0, 0]), (n, 1)), np.tile(np.float32([0, 0.1, 0]), (n, 1))
    vertices, _ = sheets(centre, u, v, np.ones(n, np.float32))
    assert len(np.unique(vertices[::4, 2])) > 0.99 * n


def test_in_even_light_it_does_not_shade_itself(tmp_path, asset_path, frame_of):
    """Sheets at all angles beside each other: as bright as with the mesh, but for its hollows."""
    whole, bright = read_asset(asset_path), []
    noise = np.random.default_rng(1).normal(0, 0.15, whole.surfels.rotation.shape)
    rotation = (whole.surfels.rotation + noise).astype(np.float32)
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    uneven = replace(whole, surfels=replace(whole.surfels, rotation=rotation))
    for name, provenance in (("thin", THIN), ("closed", {})):
        path = tmp_path / f"{name}.drgs"
        write_asset(path, replace(uneven, provenance=provenance))
        frame = frame_of(path, samples=16)
        frame.world = World()
        picture = fresh(path, frame)["Combined"]
        bright.append(picture[picture[..., 3] > 0.99][:, :3].mean())
    assert bright[0] == pytest.approx(bright[1], rel=0.1) and bright[0] != bright[1]


def test_its_shadow_is_that_of_its_surfels_not_of_its_mesh(tmp_path, asset_path, frame_of):
    """Half of the surfels are gone, all of the mesh is there."""
    whole = read_asset(asset_path)
    keep = whole.surfels.centre[:, 0] > 0
    rows = lambda of: type(of)(**{f.name: _some(getattr(of, f.name), keep) for f in fields(of)})  # noqa: E731
    half = replace(whole, surfels=rows(whole.surfels), binding=rows(whole.binding))
    lit = {}
    for name, provenance in (("thin", THIN), ("closed", {})):
        path = tmp_path / f"{name}.drgs"
        write_asset(path, replace(half, provenance=provenance))
        frame = frame_of(path, samples=16, size=(64, 48))
        frame.objects[0].visibility = Visibility(camera=False)
        frame.world = World()
        square = np.float32([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
        wall = np.array([[3.0, 0, 0, 0], [0, 0, -3.0, 1.5], [0, 3.0, 0, 0], [0, 0, 0, 1]])
        frame.meshes = [MeshState("Wall", square, np.int32([[0, 1, 2], [0, 2, 3]]), wall[None], np.int32([0]))]
        picture = fresh(path, frame)["Combined"][..., :3].mean(-1)
        lit[name] = picture[12:36, :24].mean(), picture[12:36, 40:].mean()
    assert lit["thin"][0] > 1.05 * lit["closed"][0]  # where surfels are gone
    assert lit["thin"][1] == pytest.approx(lit["closed"][1], rel=0.1)


def _some(values, keep):
    return values[keep] if isinstance(values, np.ndarray) else values


def test_sheets_follow_what_moves(thin_path, frame_of):
    """The same session, bent and moved, shows what a new one does."""
    made = Session()
    made.load_asset(thin_path)
    turned = frame_of(thin_path, 0.2)
    turned.objects[0] = replace(turned.objects[0], matrix_world=np.diag([1.1, 0.9, 1.0, 1.0]))
    for frame in (frame_of(thin_path), frame_of(thin_path, 0.2), turned, frame_of(thin_path, rays_see="surfels")):
        frame.passes = ("Combined", "Normal", "Vector")
        assert_same_bits(made.render(frame), fresh(thin_path, frame))


def test_coarse_pictures_of_a_viewport_meet_the_sheets_of_the_fine_ones(thin_path, frame_of):
    """Nothing is laid out again between them, and the light does not jump."""
    made = Session()
    made.load_asset(thin_path)
    frame = frame_of(thin_path, samples=1, size=(480, 360))
    versions, pictures = [], []
    for _ in range(2):
        pictures.append(made.view("view", frame))
        versions.append(made._scene_cache.scene.version)
        while pictures[-1].statistics["view.fraction"] < 1.0:
            pictures.append(made.refine("view"))
            versions.append(made._scene_cache.scene.version)
    assert pictures[0].statistics["view.pixel"] > 1
    assert all(version is versions[0] for version in versions)
    coarse, fine = (picture["Combined"][..., :3].mean() for picture in (pictures[0], pictures[-1]))
    assert coarse == pytest.approx(fine, rel=0.05)


@pytest.mark.parametrize("settings", [{"rays_see": "surfels"}, {"camera_sees": "mesh"}])
def test_what_is_asked_for_otherwise_is_met(asset_path, thin_path, frame_of, settings):
    """Surfels along rays, or the mesh that the camera sees, as of other objects."""
    pictures = [fresh(path, frame_of(path, **settings)) for path in (asset_path, thin_path)]
    assert_same_bits(*pictures)


def test_what_has_no_mesh_is_met_as_sheets_and_casts_a_shadow(tmp_path, asset_path, frame_of):
    """Without any setting; as dark as where rays meet the surfels themselves."""
    path, below = tmp_path / "bare.drgs", []
    write_asset(path, Asset(read_asset(asset_path).surfels, Mesh.empty(), None))
    for rays_see, shadow in (("mesh", False), ("mesh", True), ("surfels", True)):
        frame = frame_of(path, samples=64, rays_see=rays_see)
        frame.objects[0].vertices = None
        frame.objects[0].visibility = Visibility(camera=False, shadow=shadow, diffuse=shadow, glossy=shadow)
        frame.world = World()
        corners = np.float32([[-3, -3, -1.05], [3, -3, -1.05], [3, 3, -1.05], [-3, 3, -1.05]])
        floor = MeshState("floor", corners, np.int32([[0, 1, 2], [0, 2, 3]]), np.eye(4)[None], np.int32([0]))
        frame.meshes = [floor]
        picture = fresh(path, frame)
        assert not picture.warnings
        below.append(picture["Combined"][..., :3].mean())
    free, sheets_, surfels = below
    assert free - surfels > 0.02 * free
    assert free - sheets_ == pytest.approx(free - surfels, rel=0.3)


def test_a_shadow_catcher_without_a_mesh_is_told(tmp_path, asset_path, frame_of):
    path = tmp_path / "bare.drgs"
    write_asset(path, Asset(read_asset(asset_path).surfels, Mesh.empty(), None))
    frame = frame_of(path, samples=1)
    frame.objects[0].vertices, frame.world = None, World()
    frame.objects[0].visibility = Visibility(shadow_catcher=True)
    (warning,) = fresh(path, frame).warnings
    assert "has no mesh" in warning and "shadow catcher" in warning
    frame.settings.rays_see = "surfels"
    assert not fresh(path, frame).warnings
