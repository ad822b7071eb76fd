"""Trees of triangles on a device, on Warp's device "cpu": they follow what moves, and are rebuilt when worn out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("warp", reason="warp-lang is not installed")

from cards import DEVICE
from test_device_integrate import ball, floor, placed

from drgs_blender.compute.warp.kernels import WarpKernel
from drgs_blender.core.frame import Visibility
from drgs_blender.render.gpu.native_functions import NATIVES
from drgs_blender.render.gpu.scene_mirror import Mirror
from drgs_blender.render.gpu.warp_backend import WarpRenderBackend
from drgs_blender.render.scene.interaction import nearest
from drgs_blender.render.scene.ray_masks import DIFFUSE
from drgs_blender.render.scene.trace_scene import TraceObject, TraceScene


def cast(thread, stride, scratch, tracer, origin, direction, mask, out):  # type: ignore[no-untyped-def]
    depth, face, place = out
    for i in range(thread, len(origin), stride):
        depth[i], face[i], place[i], _, _, _, _, _ = nearest(
            tracer, origin[i, 0], origin[i, 1], origin[i, 2], direction[i, 0], direction[i, 1], direction[i, 2],
            np.float32(0.0), np.float32(100.0), np.int32(mask),
        )  # fmt: skip


CAST = WarpKernel(cast, (), NATIVES)


def hits(device: WarpRenderBackend, scene: TraceScene, count: int = 4000) -> list[tuple[np.ndarray, ...]]:
    """(depth, face, place) of random rays by Embree and by the device."""
    rng = np.random.default_rng(3)
    origin = rng.normal(size=(count, 3)).astype(np.float32)
    origin *= np.float32(6) / np.linalg.norm(origin, axis=1, keepdims=True)
    direction = (rng.normal(size=(count, 3)) * 0.8 - origin).astype(np.float32)
    t, face, instance, _, _ = scene.bvh.hits(origin, direction, tfar=100.0, mask=DIFFUSE)
    out = np.empty(count, np.float32), np.empty(count, np.int32), np.empty(count, np.int32)
    device.launcher.launch(CAST, count, (device.mirror.tracer(scene), origin, direction, DIFFUSE), out)
    return [(t, face, instance), out]


def assert_agree(device: WarpRenderBackend, scene: TraceScene) -> None:
    (t, face, instance), found = hits(device, scene)
    assert (face >= 0).mean() > 0.2
    other = (found[1] != face) | ((found[2] >= 0) != (instance >= 0))
    assert other.mean() < 0.003  # a ray along an edge meets the other face
    same = (face >= 0) & ~other
    np.testing.assert_allclose(found[0][same], t[same], rtol=1e-4)


@pytest.fixture
def device() -> WarpRenderBackend:
    return WarpRenderBackend(DEVICE)


def moved(item: TraceObject, by: np.ndarray) -> TraceObject:
    return replace(item, vertices=np.ascontiguousarray(by, np.float32))


def builds(mirror: Mirror) -> int:
    assert mirror._trees is not None
    return sum(tree.builds for tree in mirror._trees.trees)


def test_a_tree_is_refitted_until_it_is_worn_out(device: WarpRenderBackend) -> None:
    """What was near goes everywhere: the boxes of the old tree would all be met, and the hits are Embree's still."""
    scene, item = TraceScene(), ball((0.0, 0.0, 0.0), 2.0)
    scene.update([item])
    assert_agree(device, scene)
    bent = item.vertices * np.float32([1.2, 0.9, 1.0]) + np.float32(0.1) * np.sin(3 * item.vertices[:, ::-1])
    scene.update([moved(item, bent)])
    assert_agree(device, scene)
    assert builds(device.mirror) == 1
    shuffled = item.vertices[np.random.default_rng(2).permutation(len(item.vertices))]
    scene.update([moved(item, shuffled)])
    assert_agree(device, scene)
    assert builds(device.mirror) == 2
    scene.update([moved(item, shuffled * np.float32(1.1))])  # as good as when it was built
    assert_agree(device, scene)
    assert builds(device.mirror) == 2


def test_what_stands_in_places_is_followed(device: WarpRenderBackend) -> None:
    """Places move, come and go; of two kinds of masks only one is worn out; a face dies and lives again."""
    scene, item = TraceScene(), ball((0.0, 0.0, 0.0), 1.0)
    shut, narrow = Visibility(glossy=False), floor().vertices * np.float32([1.0, 0.3, 1.0])
    for k in range(5):
        plates = [placed(2.0 - 0.3 * k, j - 2.0, 0.2 * k + 0.31 * j, 0.2 + 0.1 * j) for j in range(5)]
        vertices = item.vertices.copy()
        if k == 1:
            vertices[::9] = np.nan
        if k >= 3:
            vertices = vertices[::-1][np.random.default_rng(2).permutation(len(vertices))]
        split = 2 + k // 2 % 2  # as many places and masks as before, of other shapes
        few, others = plates[:split], plates[split:]
        meshes = [floor(*few, visibility=shut), floor(*others, visibility=shut, name="others", vertices=narrow)]
        scene.update([moved(item, vertices)], meshes)
        assert_agree(device, scene)


def test_of_a_scene_that_moves_only_vertices_go_to_a_card(monkeypatch: pytest.MonkeyPatch) -> None:
    device, scene, item, copied = WarpRenderBackend(DEVICE), TraceScene(), ball((0.0, 0.0, 0.0), 1.0), []
    device.launcher.apart, copy = True, device.launcher.array
    monkeypatch.setattr(
        device.launcher, "array", lambda array, *more, **how: copied.append(array.nbytes) or copy(array, *more, **how)
    )
    scene.update([item])
    device.mirror.tracer(scene)
    for k in range(2):
        scene.update([moved(item, item.vertices * np.float32(1.1 + k))])
        copied.clear()
        tracer = device.mirror.tracer(scene)
        assert sum(copied) == scene.vertices.nbytes + 24 and tracer.kinds == 1  # and one row of the table
        assert_agree(device, scene)
