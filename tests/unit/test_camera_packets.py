"""Camera rays eight at a time meet what single ones meet, to the bit, and the same in every tile."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shapes import look_along_y, sphere_mesh

from drgs_blender.core.frame import Camera, MeshState, RenderSettings, Visibility
from drgs_blender.render.camera import camera_parameters
from drgs_blender.render.gbuffer import camera_hits
from drgs_blender.render.gbuffer.mesh_hits import MeshHits
from drgs_blender.render.scene.embree import packet_address
from drgs_blender.render.scene.ray_masks import CAMERA
from drgs_blender.render.scene.trace_scene import TraceObject, TraceScene

CAMERAS = {
    "perspective": look_along_y(61),
    "orthographic": look_along_y(61, focal=12.0, orthographic=True),
    "clipped": look_along_y(61, clip_start=2.2, clip_end=4.4),
    "fisheye": replace(look_along_y(61), panorama="fisheye", fov=2.0),
    "equirectangular": replace(look_along_y(61), panorama="equirectangular"),
}


#: Faces of a wall with four corners.
SQUARE = np.int32([[0, 1, 2], [0, 2, 3]])


def ball() -> TraceObject:
    vertices, faces = sphere_mesh(4)
    shades = np.full((len(vertices), 3), 0.5, np.float32), np.full(len(vertices), 0.6), np.zeros(len(vertices))
    return TraceObject("ball", vertices, faces, *shades)


def instances() -> TraceScene:
    """A ball, a wall behind it, three plates of one mesh before it, and one that the camera does not see."""
    corners = np.float32([[-2, 2, -2], [2, 2, -2], [2, 2.5, 2], [-2, 2.5, 2]])
    places = np.tile(np.eye(4), (3, 1, 1))
    places[:, :3, :3] *= np.array([0.25, 0.4, 0.15])[:, None, None]
    places[:, :3, 3] = [[-1, -2.4, 0.3], [0.4, -2.5, -0.4], [0.9, -2.3, 0.8]]
    one, numbers = np.eye(4)[None], np.zeros(1, np.int32)
    scene = TraceScene()
    scene.update(
        [ball()],
        [
            MeshState("wall", corners, SQUARE, one, numbers),
            MeshState("plates", corners, SQUARE, places, np.arange(3, dtype=np.int32)),
            MeshState(
                "unseen", corners - np.float32([0, 5, 0]), SQUARE, one, numbers, visibility=Visibility(camera=False)
            ),
        ],
    )
    return scene


def twice() -> TraceScene:
    """A ball, a wall that is there twice, as two instances, and once more as another mesh."""
    corners = np.float32([[-2, 2, -2], [2, 2, -2], [2, 2, 2], [-2, 2, 2]])
    walls = [
        MeshState(name, corners, SQUARE, np.tile(np.eye(4), (n, 1, 1)), np.arange(n))
        for name, n in (("two", 2), ("third", 1))
    ]
    scene = TraceScene()
    scene.update([ball()], walls)
    return scene


def find(scene: TraceScene, camera: Camera, x0: int, y0: int, shape: tuple[int, int, int]) -> MeshHits:
    settings = RenderSettings(subpixel_samples=shape[2], camera_sees="mesh", seed=5)
    return camera_hits.trace_camera(scene, camera_parameters(camera, settings, 2), x0, y0, shape, CAMERA)


def test_processors_with_avx2_trace_packets() -> None:
    info = Path("/proc/cpuinfo")
    if not info.exists() or " avx2 " not in info.read_text():
        pytest.skip("not known to have AVX2")
    assert packet_address() != 0


@pytest.mark.skipif(packet_address() == 0, reason="Embree traces no packets of eight rays on this processor")
@pytest.mark.parametrize("subpixels", [8, 16])
@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
def test_packets_find_what_single_rays_find(camera: Camera, subpixels: int, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, tile = instances(), (7, 5, (43, 51, subpixels))
    packets = find(scene, camera, *tile)
    monkeypatch.setattr(camera_hits, "packet_address", lambda: 0)
    single = find(scene, camera, *tile)
    np.testing.assert_array_equal(packets.owner, single.owner)
    met = single.owner >= 0
    assert len(np.unique(single.owner[met])) >= 3 and not met.all()
    for found, expected in zip(packets.arrays, single.arrays, strict=True):
        np.testing.assert_array_equal(found[met], expected[met])


@pytest.mark.parametrize("subpixels", [1, 4, 8, 12])
@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
def test_surfaces_in_one_place_are_met_alike_in_every_tile(camera: Camera, subpixels: int) -> None:
    scene = twice()
    whole, part = (find(scene, camera, x0, y0, (61 - y0, 61 - x0, subpixels)) for x0, y0 in ((0, 0), (3, 1)))
    met = part.owner >= 0
    assert met.sum() > 1000
    for found, expected in zip(part.arrays, whole.arrays, strict=True):
        np.testing.assert_array_equal(found[met], expected[1:, 3:][met])
