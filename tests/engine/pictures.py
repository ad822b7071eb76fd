"""Frames and pictures that the tests of the session share."""

from __future__ import annotations

import numpy as np

from drgs_blender.core.frame import MeshState
from drgs_blender.core.materials import Image, Material, Texture
from drgs_blender.engine.session import Session


def fresh(asset_path, frame):
    """The frame in a session that has seen nothing else."""
    made = Session()
    made.load_asset(asset_path)
    return made.render(frame)


def assert_same_bits(a, b):
    assert {name: array.tobytes() for name, array in a.items()} == {name: array.tobytes() for name, array in b.items()}


def with_meshes(frame, **changes):
    """The frame with a floor and two small squares in front of it, the latter with an image."""
    square = np.float32([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = np.int32([[0, 1, 2], [0, 2, 3]])
    floor = np.diag([5.0, 5.0, 1.0, 1.0])
    floor[2, 3] = -1.2
    places = np.stack([np.diag([0.2, 0.2, 0.2, 1.0])] * 2)
    places[:, :3, 3] = (0.8, 0.5, -0.5), (-0.8, 0.5, 0.5)
    picture = Image("Picture", np.full((2, 2, 4), 200, np.uint8), "srgb")
    painted = Material("Painted", (1, 1, 1), base_colour_texture=Texture("Picture"), emission=(0.1, 0.2, 0.3))
    uvs = square[faces][:, :, :2].copy()
    frame.meshes = [
        MeshState("Floor", square.copy(), faces, floor[None], np.int32([5])),
        MeshState("Squares", square.copy(), faces, places, np.int32([6, 7]), uvs=uvs, materials=[painted]),
    ]
    frame.images = [picture]
    for path, value in changes.items():
        index, name = path.split("_", 1)
        setattr(frame.meshes["ab".index(index)], name, value)
    return frame
