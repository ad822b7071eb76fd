"""Camera rays eight at a time meet what single ones meet, to the bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from shapes import look_along_y, sphere_mesh

from drgs_blender.core.frame import Camera, MeshState, RenderSettings, Visibility
from drgs_blender.render.camera import camera_parameters
from drgs_blender.render.gbuffer import camera_hits
from drgs_blender.render.scene.embree import packet_address
from drgs_blender.render.scene.ray_masks import CAMERA
from drgs_blender.render.scene.trace_scene import TraceObject, TraceScene

CAMERAS = {
    "perspective": look_along_y(61),
    "orthographic": look_along_y(61, focal=12.0, orthographic=True),
    "clipped": look_along_y(61, clip_start=2.2, clip_end=4.4),
    "fisheye": replace(look_along_y(61), panorama="fisheye", fov=2.0),
}


def instances() -> TraceScene:
    """A ball, a wall behind it, three plates of one mesh before it, and one that the camera does not see."""
    vertices, faces = sphere_mesh(4)
    shades = np.full((len(vertices), 3), 0.5, np.float32), np.full(len(vertices), 0.6), np.zeros(len(vertices))
    corners = np.float32([[-2, 2, -2], [2, 2, -2], [2, 2.5, 2], [-2, 2.5, 2]])
    square = np.int32([[0, 1, 2], [0, 2, 3]])
    places = np.tile(np.eye(4), (3, 1, 1))
    places[:, :3, :3] *= np.array([0.25, 0.4, 0.15])[:, None, None]
    places[:, :3, 3] = [[-1, -2.4, 0.3], [0.4, -2.5, -0.4], [0.9, -2.3, 0.8]]
    one, numbers = np.eye(4)[None], np.zeros(1, np.int32)
    scene = TraceScene()
    scene.update(
        [TraceObject("ball", vertices, faces, *shades)],
        [
            MeshState("wall", corners, square, one, numbers),
            MeshState("plates", corners, square, places, np.arange(3, dtype=np.int32)),
            MeshState(
                "unseen", corners - np.float32([0, 5, 0]), square, one, numbers, visibility=Visibility(camera=False)
            ),
        ],
    )
    return scene


@pytest.mark.skipif(packet_address() == 0, reason="Embree traces no packets of eight rays on this processor")
@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
def test_packets_find_what_single_rays_find(camera: Camera, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, subpixels = instances(), 3
    parameters = camera_parameters(camera, RenderSettings(subpixel_samples=subpixels, camera_sees="mesh", seed=5), 2)
    shape = (61, 61, subpixels)  # the last packet is not full
    packets = camera_hits.trace_camera(scene, parameters, 0, 0, shape, CAMERA)
    monkeypatch.setattr(camera_hits, "packet_address", lambda: 0)
    single = camera_hits.trace_camera(scene, parameters, 0, 0, shape, CAMERA)
    np.testing.assert_array_equal(packets.owner, single.owner)
    met = single.owner >= 0
    assert len(np.unique(single.owner[met])) >= 3 and not met.all()
    for found, expected in zip(packets.arrays, single.arrays, strict=True):
        np.testing.assert_array_equal(found[met], expected[met])
