"""Frames in which the camera sees no surfels are drawn as those of meshes: edges get as many sub-pixel samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pictures import assert_same_bits

from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.model import Asset, Mesh
from drgs_blender.core.frame import Frame, MeshState, ObjectState
from drgs_blender.deform.attach import attach
from drgs_blender.engine.session import Session


def without_objects(frame: Frame, session: Session, folder: Path) -> Frame:
    """The frame with the ball as a plain mesh."""
    (ball,) = frame.objects
    mesh = session.asset(ball.asset).mesh
    frame.objects.clear()
    frame.meshes = [MeshState("Ball", mesh.vertices, mesh.faces, np.eye(4)[None], np.int32([0]))]
    return frame


def unseen(frame: Frame, session: Session, folder: Path) -> Frame:
    """As `without_objects`, with an object beside it that the camera does not see."""
    frame = without_objects(replace(frame, objects=list(frame.objects)), session, folder)
    hidden = ObjectState("Hidden", session.load_asset(folder.parent / "ball.drgs"), np.eye(4))
    hidden.visibility = replace(hidden.visibility, camera=False)
    frame.objects.append(hidden)
    return frame


def veil(frame: Frame, session: Session, folder: Path) -> Frame:
    """The frame with a ball that light passes, which the camera sees by its mesh."""
    known = session.asset(frame.objects[0].asset).mesh
    own = replace(known, opacity=np.full(len(known.vertices), 0.5, np.float32))
    surfels, binding, _ = attach(own, density=2.0)
    write_asset(folder / "veil.drgs", Asset(surfels, own, binding))
    frame.objects[0].asset = session.load_asset(folder / "veil.drgs")
    return frame


@pytest.fixture
def session(asset_path: Path) -> Session:
    made = Session()
    made.load_asset(asset_path)
    return made


@pytest.fixture
def folder(asset_path: Path, tmp_path: Path) -> Path:
    """A folder of the test's own, beside the asset of the ball."""
    (tmp_path / "ball.drgs").write_bytes(asset_path.read_bytes())
    (tmp_path / "own").mkdir()
    return tmp_path / "own"


@pytest.mark.parametrize("scene", [without_objects, unseen, veil])
def test_edges_of_meshes_are_as_smooth_as_with_camera_sees_mesh(
    session: Session, make_frame: Callable[..., Frame], folder: Path, scene: Callable[..., Frame]
) -> None:
    """Final frame, part of it and viewport, at few samples and the automatic number of positions."""
    frame = scene(make_frame(samples=5, subpixel_samples=0), session, folder)
    by_mesh = replace(frame, settings=replace(frame.settings, camera_sees="mesh"))
    assert frame.settings.subpixel_count == 4 and by_mesh.settings.subpixel_count == 7
    seen, expected = session.render(frame), session.render(by_mesh)
    if scene is veil:
        assert len(np.unique(expected["Combined"][..., 3].round(4))) > 6
    else:
        assert set(np.unique((7 * expected["Combined"][..., 3]).round(3))) == set(range(8))
    assert_same_bits(seen, expected)
    session.view("A", frame)
    while (later := session.refine("A")).statistics["view.fraction"] < 1.0:
        pass
    np.testing.assert_allclose(later["Combined"], expected["Combined"], rtol=1e-4, atol=2e-6)
    part = replace(frame, camera=replace(frame.camera, region=(7, 5, 31, 29)))
    np.testing.assert_array_equal(session.render(part)["Depth"], expected["Depth"][5:29, 7:31])


def test_an_object_beside_a_mesh_keeps_its_surfels(
    session: Session, make_frame: Callable[..., Frame], mesh: Mesh
) -> None:
    frame = make_frame(samples=5, subpixel_samples=0)
    frame.meshes = [
        MeshState("Other", mesh.vertices + np.float32([1, 0, 0]), mesh.faces, np.eye(4)[None], np.int32([0]))
    ]
    four = replace(frame, settings=replace(frame.settings, subpixel_samples=4))
    assert_same_bits(session.render(frame), session.render(four))


def test_what_is_said_of_a_mesh_in_place_of_surfels_stays(
    session: Session, make_frame: Callable[..., Frame], folder: Path
) -> None:
    """A frame that is drawn as of meshes is still one of *Camera Sees: Surfels*."""
    frame = veil(make_frame(subpixel_samples=0), session, folder)
    said = session.render(frame).warnings
    told = "Ball: part of it is transparent (such as glass), so the camera sees its mesh instead of its surfels"
    assert said == [told]
    session.view("A", frame)
    refined = session.refine("A")
    assert refined is not None and refined.warnings == said


def test_a_history_goes_on_where_nothing_is_seen_but_meshes(
    session: Session, make_frame: Callable[..., Frame], folder: Path
) -> None:
    frame = without_objects(make_frame(samples=5, subpixel_samples=0, denoise="svgf"), session, folder)
    frame.history = "shot"
    assert [session.render(replace(frame, noise_index=i)).statistics["history"] for i in range(3)] == [0, 1, 2]
