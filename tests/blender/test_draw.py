"""What the viewport's shaders draw, on a real GPU context without a window."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Matrix
from scenes import part

pytestmark = pytest.mark.blender_api

SIZE = 24


class _Context(bpy.types.RenderEngine):
    """Blender has a GPU context in the background only while an engine that asks for it renders."""

    bl_idname = "DRGS_TEST_GPU"
    bl_label = "GPU"
    bl_use_gpu_context = True
    work = None
    result = None

    def render(self, depsgraph):
        try:
            _Context.result = _Context.work()
        except BaseException as error:
            _Context.result = error


@pytest.fixture
def with_gpu(scene):
    """Function that calls another one while there is a GPU context; skips where there is none."""
    bpy.utils.register_class(_Context)
    scene.render.engine = "DRGS_TEST_GPU"
    scene.render.resolution_x = scene.render.resolution_y = 8

    def run(work):
        _Context.work, _Context.result = staticmethod(work), None
        bpy.ops.render.render()
        if isinstance(_Context.result, SystemError):
            pytest.skip(f"no GPU context: {_Context.result}")
        if isinstance(_Context.result, BaseException):
            raise _Context.result
        return _Context.result

    yield run
    scene.render.engine = "DRGS"
    bpy.utils.unregister_class(_Context)


def drawn(draw, background=(0.0, 0.0, 0.0, 0.0), depth=1.0):
    """(SIZE, SIZE, 4) float32 of what `draw` leaves on the background, row 0 at the top."""
    import gpu

    colour = gpu.types.GPUTexture((SIZE, SIZE), format="RGBA32F")
    buffer = gpu.types.GPUTexture((SIZE, SIZE), format="DEPTH_COMPONENT32F")
    target = gpu.types.GPUFrameBuffer(color_slots=colour, depth_slot=buffer)
    with target.bind():
        target.clear(color=background, depth=depth)
        draw()
        found = target.read_color(0, 0, SIZE, SIZE, 4, 0, "FLOAT")
    return np.array(found.to_list(), np.float32).reshape(SIZE, SIZE, 4)[::-1]


def strips(rows=10**6, **passes):
    """Passes on the graphics card, so many rows at a time."""
    draw, height = part("addon.viewport.draw"), len(passes["Combined"])
    return [draw.strip(passes, top, min(top + rows, height)) for top in range(0, height, rows)]


def test_picture_is_drawn_pixel_by_pixel(with_gpu):
    pixels = np.random.default_rng(1).uniform(0, 4, (SIZE, SIZE, 4)).astype(np.float32)
    pixels[..., 3] = 1
    draw = part("addon.viewport.draw")
    found = with_gpu(lambda: drawn(lambda: draw.picture(strips(Combined=pixels), (0, 0, 1, 1))))
    np.testing.assert_allclose(found, pixels, rtol=2e-3)


@pytest.mark.parametrize("size", [SIZE, SIZE // 3])
@pytest.mark.parametrize("rows", [1, 5, 7])
def test_strips_are_the_whole_picture(with_gpu, size, rows):
    """Smoothed across their edges, and without a gap."""
    pixels = np.random.default_rng(1).uniform(0, 1, (size, size, 4)).astype(np.float32)
    draw = part("addon.viewport.draw")
    whole, parts = with_gpu(
        lambda: [
            drawn(lambda r=r: draw.picture(strips(r, Combined=pixels), (0, 0, 1, 1)), (1.0, 0.0, 1.0, 1.0))
            for r in (size, rows)
        ]
    )
    np.testing.assert_allclose(parts, whole, atol=1e-4)


def test_a_redraw_uploads_a_strip_and_the_picture_changes_when_all_are_there(with_gpu, monkeypatch):
    """What arrives is finished even when newer pictures wait; then the newest is next."""
    views, request = part("addon.viewport.views"), object()
    Picture, Passes = part("addon.viewport.worker").Picture, part("drgs_blender.ipc.protocol").Passes
    monkeypatch.setattr(views, "STRIP_PIXELS", 10 * SIZE)

    def picture(value):
        return Picture(request, Passes({"Combined": np.full((SIZE, SIZE, 4), value, np.float32)}, [], {}), 1.0, 0.0)

    pictures = [picture(v) for v in (0.25, 0.5, 0.75)]
    current = [pictures[0]]
    monkeypatch.setattr(views.worker, "picture", lambda name: current[0])
    views._viewports["a"] = views.ViewportState()
    try:

        def redraws():
            seen = []
            for i in range(12):
                if i >= 1:
                    current[0] = pictures[min(i, 2)]
                shown = views.newest("a")
                seen.append(None if shown is None else [p is shown.picture for p in pictures].index(True))
            return seen, [len(s.textures) for s in views._viewports["a"].strips]

        seen, textures = with_gpu(redraws)
    finally:
        del views._viewports["a"]
    assert seen == [None, None, 0, 0, 0, 2, 2, 2, 2, 2, 2, 2] and textures == [1, 1, 1]


@pytest.mark.parametrize("size", [(1, 1), (5, 7), (2160, 3840), (4320, 7680), (3, 1 << 22)])
def test_strips_are_small_and_cover_the_picture(size):
    views = part("addon.viewport.views")
    rows = views.rows_of_strip(*size)
    assert 1 <= rows <= size[0]
    assert rows == 1 or rows * size[1] <= views.STRIP_PIXELS + size[1]


def test_picture_of_a_region_stays_in_it(with_gpu):
    """Premultiplied, over what is there; the region counts from the bottom left."""
    pixels = np.zeros((4, 4, 4), np.float32)
    pixels[:] = 0.25, 0.5, 0.0, 0.5
    draw = part("addon.viewport.draw")
    found = with_gpu(
        lambda: drawn(lambda: draw.picture(strips(Combined=pixels), (0.5, 0.0, 1.0, 0.25)), (1.0, 0.0, 0.0, 1.0))
    )
    inside = np.zeros((SIZE, SIZE), bool)
    inside[-SIZE // 4 :, SIZE // 2 :] = True
    np.testing.assert_allclose(found[inside], np.broadcast_to((0.75, 0.5, 0, 1), (inside.sum(), 4)), atol=1e-3)
    np.testing.assert_allclose(found[~inside], np.broadcast_to((1.0, 0, 0, 1), ((~inside).sum(), 4)))


def test_composite_is_hidden_by_what_is_nearer(with_gpu):
    """Left half 2 m, right half 6 m away, an object at 4 m: only the left half is seen; empty pixels never are."""
    draw, display = part("addon.viewport.draw"), part("addon.viewport.view_transform")
    near, far, away = 1.0, 100.0, 4.0
    projection = np.diag([1.0, 1.0, -(far + near) / (far - near), 0.0])
    projection[2, 3], projection[3, 2] = -2 * far * near / (far - near), -1.0
    there = 0.5 * (projection[2, 2] * -away + projection[2, 3]) / away + 0.5
    light = np.full((SIZE, SIZE, 4), 0.5, np.float32)
    light[..., 3] = 1.0
    light[:4] = 0.0
    depth = np.full((SIZE, SIZE, 1), 2.0, np.float32)
    depth[:, SIZE // 2 :] = 6.0
    depth[:4] = 1e10

    def draw_it():
        table = np.ones((display.SIZE**2, display.SIZE, 4), np.float32)
        table[..., :3] = np.clip(display.grid(), 0, 1)
        pictures = strips(7, Combined=light, Depth=depth)
        draw.composite(pictures, draw.texture(table), (0, 0, 1, 1), projection, (1.0, 1.0))

    found = with_gpu(lambda: drawn(draw_it, (0.0, 0.0, 1.0, 1.0), float(there)))
    blue = np.array((0, 0, 1, 1), np.float32)
    hidden = (found == blue).all(axis=-1)
    assert hidden[:4].all() and hidden[:, SIZE // 2 + 1 :].all()
    assert not hidden[4:, : SIZE // 2].any()
    linear = ((0.5 + 0.055) / 1.055) ** 2.4  # the buffer encodes it as sRGB again
    np.testing.assert_allclose(found[6:, : SIZE // 2 - 1, :3], linear, atol=4e-3)


def test_discs_are_round_and_as_large_as_said(with_gpu):
    draw = part("addon.viewport.draw")

    def draw_it():
        places, albedo = np.zeros((1, 3), np.float32), np.float32([[0.2, 0.4, 0.6]])
        draw.discs(draw.disc_batch(places, albedo, np.float32([1.0])), Matrix.Identity(4), SIZE / 2, False)

    found = with_gpu(lambda: drawn(draw_it))
    covered = found[..., 3] > 0
    assert covered.sum() == pytest.approx(np.pi * (SIZE / 4) ** 2, rel=0.15)
    np.testing.assert_allclose(found[covered], np.broadcast_to((0.2, 0.4, 0.6, 1), (covered.sum(), 4)), atol=1e-3)
