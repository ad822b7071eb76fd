"""Parts of assets: what is left of one, copies of it, and pictures of both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pictures import assert_same_bits, fresh

from drgs_blender.core.asset.container import read_asset, write_asset
from drgs_blender.core.asset.part import Part, part_of, part_of_faces
from drgs_blender.core.errors import AssetError
from drgs_blender.engine.session import Session


@pytest.fixture
def upper(asset_path):
    asset = read_asset(asset_path)
    return part_of_faces(asset.mesh, asset.mesh.vertices[asset.mesh.faces][..., 2].min(axis=1) > -0.2)


def test_a_part_has_the_surfels_of_its_faces_in_order(asset_path, upper):
    asset = read_asset(asset_path)
    cut = part_of(asset, upper)
    rows = np.flatnonzero(np.isin(asset.binding.face, upper.face))
    np.testing.assert_array_equal(cut.surfels.centre, asset.surfels.centre[rows])
    places = np.einsum("nk,nkc->nc", cut.binding.barycentric, cut.mesh.vertices[cut.mesh.faces[cut.binding.face]])
    before = asset.mesh.vertices[asset.mesh.faces[asset.binding.face]]
    np.testing.assert_allclose(places, np.einsum("nk,nkc->nc", asset.binding.barycentric, before)[rows], atol=1e-6)
    np.testing.assert_array_equal(cut.mesh.albedo, asset.mesh.albedo[upper.vertices])
    some = replace(upper, removed=rows[::3].astype(np.int32))
    np.testing.assert_array_equal(
        part_of(asset, some).surfels.centre, np.delete(asset.surfels.centre[rows], np.s_[::3], 0)
    )


def test_copies_have_surfels_of_their_own(asset_path, upper):
    asset, n = read_asset(asset_path), len(upper.vertices)
    twice = Part(np.tile(upper.vertices, 2), np.concatenate([upper.faces, upper.faces + n]), np.tile(upper.face, 2))
    one, two = part_of(asset, upper), part_of(asset, twice)
    assert len(two.surfels) == 2 * len(one.surfels)
    for copy in (0, 1):
        mine = two.binding.face // len(upper.face) == copy
        np.testing.assert_array_equal(two.surfels.centre[mine], one.surfels.centre)
        np.testing.assert_array_equal(two.binding.face[mine] % len(upper.face), one.binding.face)


@pytest.mark.parametrize("camera_sees", ["mesh", "surfels"])
def test_a_part_is_rendered_as_an_asset_of_it_alone(asset_path, make_frame, upper, camera_sees, tmp_path):
    """Also posed, painted and once the part has changed; nothing of the whole shows."""
    asset = read_asset(asset_path)
    write_asset(alone := tmp_path / "alone.drgs", part_of(asset, upper))
    frame = make_frame(0.3, camera_sees=camera_sees)
    state = frame.objects[0]
    arrays = {"vertices": state.vertices[upper.vertices], "albedo": asset.mesh.albedo[upper.vertices][:, ::-1].copy()}
    session = Session()
    whole = session.render(replace(frame, objects=[replace(state, asset=session.load_asset(asset_path))]))
    of_part = session.render(replace(frame, objects=[replace(state, part=upper, **arrays)]))
    expected = fresh(alone, replace(frame, objects=[replace(state, asset=str(alone.resolve()), **arrays)]))
    assert_same_bits(of_part, expected)
    assert of_part["Combined"][..., 3].sum() < 0.9 * whole["Combined"][..., 3].sum()
    fewer = part_of_faces(asset.mesh, np.isin(np.arange(len(asset.mesh.faces)), upper.face[::2]))
    arrays = {"vertices": state.vertices[fewer.vertices]}
    again = replace(frame, objects=[replace(state, part=fewer, **arrays)])
    assert_same_bits(session.render(again), fresh(asset_path, again))


def test_what_is_not_cut_away_looks_as_before(asset_path, make_frame, upper):
    """Lit by a constant world, without rays to what is gone: pixels far from the rim have the very values."""
    frame = make_frame(camera_sees="mesh")
    whole = fresh(asset_path, frame)
    state = frame.objects[0]
    cut = fresh(
        asset_path, replace(frame, objects=[replace(state, part=upper, vertices=state.vertices[upper.vertices])])
    )
    top = slice(0, 10)
    there = whole["Depth"][top] < 100
    assert there.any()
    np.testing.assert_array_equal(cut["Depth"][top], whole["Depth"][top])
    np.testing.assert_array_equal(cut["Normal"][top], whole["Normal"][top])


def test_instances_share_one_cut(asset_path, make_frame, upper, monkeypatch):
    from drgs_blender.engine import part_cache

    cuts = []
    monkeypatch.setattr(part_cache, "part_of", lambda *given: cuts.append(given) or part_of(*given))
    frame = make_frame()
    state = replace(frame.objects[0], part=upper, vertices=frame.objects[0].vertices[upper.vertices])
    frame = replace(frame, objects=[state, replace(state, name="Second")])
    session = Session()
    session.load_asset(asset_path)
    session.render(frame)
    session.render(replace(frame, noise_index=4))
    assert len(cuts) == 1


@pytest.mark.parametrize(
    "change", [{"vertices": np.int32([5000])}, {"faces": np.int32([[0, 1, 9999]])}, {"face": np.int32([0])},
               {"face": None}, {"removed": np.int32([-1])}, {"vertices": np.float32([0.5])}],
)  # fmt: skip
def test_a_part_that_does_not_fit_names_the_object(asset_path, make_frame, upper, change):
    frame = make_frame()
    if change == {"face": None}:
        change = {"face": np.full_like(upper.face, 10**6)}
    frame.objects[0] = replace(frame.objects[0], part=replace(upper, **change))
    with pytest.raises(AssetError, match=r"object Ball.*of its part"):
        fresh(asset_path, frame)
