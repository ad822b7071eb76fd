"""A scene that nothing lights: the picture is black, and a warning says why, as long as it is so."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drgs_blender.core.asset.container import read_asset, write_asset
from drgs_blender.core.asset.model import Asset, Mesh
from drgs_blender.core.frame import Frame, Light, MeshState, Visibility, World
from drgs_blender.core.materials import Image, Material, Texture
from drgs_blender.deform.attach import attach
from drgs_blender.engine.session import Session
from drgs_blender.render.surfels.harmonics import CONSTANT

DARK = World(strength=0.0)


def is_said(session: Session, frame: Frame) -> bool:
    return any(text.startswith("nothing lights the scene") for text in session.render(frame).warnings)


def square(material: Material, **seen: bool) -> MeshState:
    corners = np.float32([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]])
    return MeshState(
        "Square", corners, np.int32([[0, 1, 2], [0, 2, 3]]), np.eye(4)[None], np.int32([0]),
        uvs=np.zeros((2, 3, 2), np.float32), materials=[material], visibility=Visibility(**seen),
    )  # fmt: skip


BLACK_WORLDS = [
    World(colour=(0.0, 0.0, 0.0)),
    World(strength=0.0),
    World(np.zeros((8, 16, 3), np.float32)),
    World(np.ones((8, 16, 3), np.float32), colour=(0.0, 0.0, 0.0)),
]


@pytest.mark.parametrize("world", BLACK_WORLDS)
@pytest.mark.parametrize("settings", [{}, {"camera_sees": "mesh"}, {"rays_see": "surfels"}], ids=str)
def test_a_black_picture_is_explained(
    session: Session, make_frame: Callable[..., Frame], world: World, settings: dict[str, str]
) -> None:
    frame = replace(make_frame(**settings), world=world)
    picture = session.render(frame)
    assert not picture["Combined"][..., :3].any() and picture["Combined"][..., 3].any()
    (text,) = picture.warnings
    assert text.startswith("nothing lights the scene: ") and "Add a lamp" in text
    assert session.view("A", frame).warnings == picture.warnings


def test_it_is_said_of_plain_meshes_and_of_lamps_that_are_off(
    session: Session, make_frame: Callable[..., Frame]
) -> None:
    lamp = Light("Lamp", "point", np.diag([1.0, 1, 1, 1]), power=0.0)
    frame = replace(make_frame(), objects=[], meshes=[square(Material("Grey"))], world=DARK, lights=[lamp])
    assert is_said(session, frame)


def test_it_is_no_longer_said_once_something_lights(session: Session, make_frame: Callable[..., Frame]) -> None:
    frame = replace(make_frame(), world=DARK)
    assert is_said(session, frame)
    place = np.eye(4)
    place[1, 3] = -3.0
    lit = replace(frame, lights=[Light("Lamp", "point", place, power=50.0)])
    assert not is_said(session, lit) and session.render(lit)["Combined"][..., :3].any()
    assert not is_said(session, replace(frame, world=World(strength=1e-3)))
    assert is_said(session, frame)
    frame.settings.seed = 5  # nothing that gives light
    assert is_said(session, frame)


def glowing_ball(mesh: Mesh, path: Path, with_mesh: bool) -> Path:
    """The ball with vertices, or surfels alone, that emit."""
    own = replace(mesh, emission=np.full((len(mesh.vertices), 3), 2.0, np.float32))
    surfels, binding, _ = attach(own, density=4.0)
    bare = Mesh(mesh.vertices[:0], mesh.faces[:0], mesh.albedo[:0], mesh.roughness[:0], mesh.metallic[:0])
    write_asset(path, Asset(surfels, own, binding) if with_mesh else Asset(surfels, bare))
    return path


@pytest.mark.parametrize("case", ["colour", "image", "asset", "surfels alone", "captured", "hidden lamp"])
def test_what_glows_by_itself_lights_the_scene(
    session: Session, make_frame: Callable[..., Frame], mesh: Mesh, asset_path: Path, tmp_path: Path, case: str
) -> None:
    frame = replace(make_frame(rays_see="surfels" if case == "surfels alone" else "mesh"), world=DARK)
    (ball,) = frame.objects
    if case == "colour":
        frame.meshes = [square(Material("Lamp", emission=(0.0, 1e-3, 0.0)))]
    elif case == "image":
        frame.images = [Image("Glow", np.ones((2, 2, 4), np.float32))]
        lamp = Material("Lamp", emission=(1.0, 1.0, 1.0), emission_texture=Texture("Glow"))
        frame.meshes = [square(lamp)]
    elif case == "hidden lamp":  # lights, and is not seen
        frame.meshes = [square(Material("Lamp", emission=(1.0, 1.0, 1.0)), camera=False)]
    elif case == "captured":
        asset = read_asset(asset_path)
        sh = np.zeros((len(asset.surfels), 1, 3), np.float32) + 0.2 / CONSTANT
        path = tmp_path / "captured.drgs"
        write_asset(path, replace(asset, surfels=replace(asset.surfels, sh=sh)))
        ball.asset, ball.captured_colours, ball.vertices = session.load_asset(path), True, None
    else:
        ball.asset = session.load_asset(glowing_ball(mesh, tmp_path / "glowing.drgs", case == "asset"))
        ball.vertices = None
    assert not is_said(session, frame)
    assert session.render(frame)["Combined"][..., :3].any()


def test_pictures_that_need_no_light_are_not_warned_of(session: Session, make_frame: Callable[..., Frame]) -> None:
    dark = replace(make_frame(), world=DARK)
    assert not is_said(session, replace(dark, passes=("Depth", "Normal", "Albedo")))
    assert is_said(session, replace(dark, passes=("DiffDir",)))
    cut = square(Material("Grey"), holdout=True)
    assert not is_said(session, replace(dark, objects=[], meshes=[cut]))
    assert not is_said(session, replace(dark, objects=[]))  # there is nothing; that is said instead
