"""Viewports without a window: exports that follow changes, cameras, and the thread that talks to the engine."""

from __future__ import annotations

import dataclasses
import time
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from mathutils import Matrix, Vector
from scenes import mesh_object, new_world, part, read_exr, select

pytestmark = pytest.mark.blender_api

PLANE = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]


@pytest.fixture
def crowd(ball):
    """The DR-GS ball, a second one that shares its mesh, a plane with a material, a light and a world."""
    scene = bpy.context.scene
    twin = bpy.data.objects.new("Twin", ball.data)
    twin.drgs.asset = ball.drgs.asset
    twin.location.x = 3
    scene.collection.objects.link(twin)
    plane = mesh_object("Plane", PLANE, [(0, 1, 2, 3)])
    plane.data.materials.append(bpy.data.materials.new("Paint"))
    light = bpy.data.objects.new("Light", bpy.data.lights.new("Light", "POINT"))
    scene.collection.objects.link(light)
    new_world(scene)
    return SimpleNamespace(scene=scene, ball=ball, twin=twin, plane=plane, light=light)


def exported():
    """The viewport's export of the scene as it is now."""
    return part("addon.viewport.scenes").exported(bpy.context.evaluated_depsgraph_get())


def fresh():
    """The same by an export that knows nothing."""
    scenes, caching = part("addon.viewport.scenes"), part("addon.export.export_cache")
    return scenes._export(bpy.context.evaluated_depsgraph_get(), caching.ExportCache(), None)


def bits(value):
    """`value` with arrays as bytes, to be compared."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if dataclasses.is_dataclass(value):
        return {f.name: bits(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, (list, tuple)):
        return [bits(item) for item in value]
    return value


def arrays(value, path=""):
    """Path -> array, of everything in a frame."""
    if isinstance(value, np.ndarray):
        return {path: value}
    found = {}
    if dataclasses.is_dataclass(value):
        for f in dataclasses.fields(value):
            found |= arrays(getattr(value, f.name), f"{path}/{f.name}")
    elif isinstance(value, (list, tuple)):
        for i, item in enumerate(value):
            found |= arrays(item, f"{path}/{i}")
    return found


def new_arrays(change, crowd):
    """Paths of the arrays that `change` had read again."""
    before = {id(a) for a in arrays(exported().frame).values()}
    keep = exported()  # so that no address is used twice
    change(crowd)
    bpy.context.view_layer.update()
    after = exported()
    assert after is not keep
    return {path for path, array in arrays(after.frame).items() if id(array) not in before}


def move(c):
    c.ball.location.z += 1


def bend(c):
    c.ball.data.vertices[0].co.z += 0.1
    c.ball.data.update()


def colour(c):
    material = c.plane.data.materials[0]
    if material.node_tree is None:
        material.use_nodes = True
    next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED").inputs["Base Color"].default_value = (
        0.9, 0.1, 0.2, 1,
    )  # fmt: skip


def shine(c):
    c.light.data.energy *= 2


def brighten(c):
    background = next(n for n in c.scene.world.node_tree.nodes if n.type == "BACKGROUND")
    background.inputs["Strength"].default_value += 1


def swap(c):
    """Another mesh of the same size where the old one was in memory."""
    bpy.data.objects.remove(c.plane)
    c.plane = mesh_object("Plane", [(x, y, 1) for x, y, _ in PLANE], [(0, 1, 2, 3)])
    c.plane.data.materials.append(bpy.data.materials["Paint"])


def slot(c):
    c.plane.data.materials[0] = bpy.data.materials.new("Other")


def modify(c):
    c.plane.modifiers.new("Solid", "SOLIDIFY").thickness = 0.3


def key(c):
    if c.twin.data.shape_keys is None:
        c.twin.shape_key_add(name="Basis")
        c.twin.shape_key_add(name="Up").data[3].co.z += 1
    c.twin.data.shape_keys.key_blocks["Up"].value = 0.5


def hide(c):
    c.twin.hide_viewport = True


def rename(c):
    c.plane.name = "Floor"


def paint(c):
    c.ball.data.attributes["roughness"].data[0].value = 0.123
    c.ball.data.update()


def catch(c):
    c.plane.is_shadow_catcher = True


def instance(c):
    collection = bpy.data.collections.new("Group")
    collection.objects.link(c.plane)
    empty = bpy.data.objects.new("Empty", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", collection
    empty.location.x = 9
    c.scene.collection.objects.link(empty)


CHANGES = (move, bend, colour, shine, brighten, swap, slot, modify, key, hide, rename, paint, catch, instance)


def test_what_was_remembered_never_shows(crowd):
    """After every kind of change the export is that of somebody who has seen nothing else; so is each undone."""
    exported()
    for change in CHANGES:
        change(crowd)
        bpy.context.view_layer.update()
        assert bits(exported()) == bits(fresh()), change.__name__


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (move, {"/objects/0/matrix_world"}),
        (bend, {"/objects/0/vertices", "/objects/1/vertices"}),
        (brighten, set()),
        (shine, set()),
        (paint, {"/objects/0/roughness", "/objects/1/roughness"}),
    ],
)
def test_only_what_changed_is_new(crowd, change, expected):
    """The others are the very same arrays, so that the engine's client need not even compare them."""
    assert new_arrays(change, crowd) == expected


def test_a_new_colour_reads_no_geometry(crowd, monkeypatch):
    exported()
    reads = []
    arrays = part("addon.mesh_arrays")
    original = arrays.read_vertices
    monkeypatch.setattr(arrays, "read_vertices", lambda mesh: (reads.append(mesh.name), original(mesh))[1])
    colour(crowd)
    move(crowd)
    bpy.context.view_layer.update()
    mesh = exported().frame.meshes[0]
    # From 5.3 on Blender says that the geometry of an object with the material changed, too
    assert set(reads) <= ({"Plane"} if bpy.app.version >= (5, 3) else set())
    reads.clear()
    bend(crowd)
    bpy.context.view_layer.update()
    exported()
    assert len(reads) == 2  # of the ball and of its twin
    assert mesh.materials[0].base_colour == pytest.approx((0.9, 0.1, 0.2))


def test_what_does_not_show_makes_no_new_frame(crowd):
    """Selecting or naming a camera must not start the picture again."""
    before = exported()
    crowd.twin.select_set(True)
    crowd.scene.camera.name = "Other"
    crowd.scene.frame_end += 1
    bpy.context.view_layer.update()
    assert exported() is before


def test_a_missing_asset_is_told_and_forgiven(crowd, ball_file):
    exported()
    hidden = ball_file.with_suffix(".gone")
    ball_file.rename(hidden)
    move(crowd)
    bpy.context.view_layer.update()
    assert "does not exist" in exported().error and exported().frame is None
    hidden.rename(ball_file)
    move(crowd)
    bpy.context.view_layer.update()
    assert exported().frame is not None


def test_a_local_view_shows_its_objects_alone(crowd):
    scenes = part("addon.viewport.scenes")
    depsgraph = bpy.context.evaluated_depsgraph_get()
    alone = scenes.exported(depsgraph, "local", lambda obj: obj.original == crowd.twin).frame
    assert [state.name for state in alone.objects] == ["Twin"] and not alone.meshes and not alone.lights
    assert len(scenes.exported(depsgraph).frame.objects) == 2


# --- cameras -------------------------------------------------------------------------------------------------------


def through(camera, scene, width, height, zoom=1.0, curved=False):
    """A region that shows what `camera` sees, as Blender's own camera view does."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    projection = camera.calc_matrix_camera(depsgraph, x=width, y=height)
    for i in range(2):
        projection[i][:] = [v * zoom for v in projection[i]]
    rv3d = SimpleNamespace(
        window_matrix=projection,
        view_matrix=camera.matrix_world.normalized().inverted(),
        is_perspective=camera.data.type != "ORTHO",
        view_perspective="CAMERA",
    )
    space = SimpleNamespace(camera=camera, clip_start=0.1, clip_end=100.0, use_render_border=False)
    region = SimpleNamespace(width=width, height=height)
    return part("addon.export.view").view_camera(region, space, rv3d, scene, curved)


@pytest.mark.parametrize("kind", ["PERSP", "ORTHO"])
@pytest.mark.parametrize("size", [(640, 360), (300, 500)])
@pytest.mark.parametrize("fit", ["AUTO", "VERTICAL"])
def test_camera_view_is_the_final_frame(scene, kind, size, fit):
    """A region as large as the picture shows the picture."""
    camera = scene.camera
    camera.data.type, camera.data.sensor_fit = kind, fit
    camera.data.shift_x, camera.data.shift_y, camera.data.clip_end = 0.2, -0.1, 50.0
    camera.rotation_euler = 1.2, 0.3, 0.4
    scene.render.resolution_x, scene.render.resolution_y = size
    bpy.context.view_layer.update()
    final = part("addon.export.camera").export_camera(camera, scene.render)
    seen = through(camera, scene, *size)
    assert (seen.width, seen.height, seen.orthographic, seen.region) == (*size, kind == "ORTHO", None)
    np.testing.assert_allclose(seen.matrix_world, final.matrix_world, atol=1e-6)
    for name in ("fx", "fy", "cx", "cy", "clip_start", "clip_end"):
        assert getattr(seen, name) == pytest.approx(getattr(final, name), rel=2e-4), name


def test_a_panoramic_camera_fills_its_frame_in_the_view(scene):
    """Zoomed out by two, its picture is the middle half of the region, and the border a part of that."""
    data, render = scene.camera.data, scene.render
    data.type = "PANO"
    part("addon.export.camera").lens_of(data).panorama_type = "EQUIRECTANGULAR"
    render.resolution_x, render.resolution_y = 640, 360
    final = part("addon.export.camera").export_camera(scene.camera, render)
    seen = through(scene.camera, scene, 640, 360, curved=True)
    names = ("width", "height", "fx", "fy", "cx", "cy", "region", "panorama")
    assert all(getattr(seen, name) == getattr(final, name) for name in names)
    half = through(scene.camera, scene, 640, 360, zoom=0.5, curved=True)
    assert half.panorama == "equirectangular" and half.window == (160, 90, 480, 270)
    assert (half.fx, half.cx, half.cy) == pytest.approx((final.fx / 2, 320, 180), rel=1e-4)
    render.use_border = True
    render.border_min_x, render.border_max_x, render.border_min_y, render.border_max_y = 0.25, 0.75, 0.1, 0.6
    assert through(scene.camera, scene, 640, 360, zoom=0.5, curved=True).window == (240, 162, 400, 252)
    assert through(scene.camera, scene, 640, 360).panorama == ""


def test_a_panorama_without_rays_is_refused_in_its_view_as_by_f12(scene, ball, monkeypatch):
    part("addon.export.camera").lens_of(scene.camera.data).panorama_type = "MIRRORBALL"
    views = part("addon.viewport.views")
    asked = []
    monkeypatch.setattr(views.worker, "submit", lambda name, request: asked.append(name))
    monkeypatch.setattr(views, "_start", lambda: None)
    depsgraph = bpy.context.evaluated_depsgraph_get()
    space = SimpleNamespace(camera=scene.camera, local_view=None, clip_start=0.1, clip_end=100, use_render_border=False)
    projection = scene.camera.calc_matrix_camera(depsgraph, x=64, y=48)
    place = {"view_matrix": scene.camera.matrix_world.inverted(), "is_perspective": True}
    for kind, seen_through, composited, refused in (
        ("PANO", "CAMERA", False, True),
        ("PANO", "PERSP", False, False),
        ("PANO", "CAMERA", True, False),
        ("PERSP", "CAMERA", False, False),
    ):
        scene.camera.data.type = kind
        rv3d = SimpleNamespace(window_matrix=projection, view_perspective=seen_through, **place)
        context = SimpleNamespace(region=SimpleNamespace(width=64, height=48), space_data=space, region_data=rv3d)
        views.forget()
        asked.clear()
        error = views.update(context, depsgraph, "view", composited)
        assert ("Choose Equirectangular" in error) == refused and bool(asked) != refused
    views.forget()


def test_orthographic_view_sees_behind_itself(scene):
    """As Blender's own does, from -clip_end on; the same points are on the same pixels and at the same clip planes."""
    projection = Matrix.Identity(4)
    projection[0][0], projection[1][1], projection[2][2] = 0.2, 0.3, -0.01  # clips at -100 and 100
    space = SimpleNamespace(camera=None, clip_start=0.1, clip_end=100.0, use_render_border=False)
    rv3d = SimpleNamespace(
        window_matrix=projection,
        view_matrix=Matrix.Rotation(0.5, 4, "X"),
        is_perspective=False,
        view_perspective="ORTHO",
        view_distance=5.0,
    )
    view = part("addon.export.view")
    camera = view.view_camera(SimpleNamespace(width=640, height=360), space, rv3d, scene)
    inverse = np.linalg.inv(camera.matrix_world)
    for z in (-99.0, -3.0, 0.0, 60.0, 99.0):
        point = rv3d.view_matrix.inverted() @ Vector((1.5, -2.0, z))
        x, y, depth = (inverse @ np.array([*point, 1.0]))[:3]
        assert camera.clip_start <= -depth <= camera.clip_end
        ndc = projection @ Vector((1.5, -2.0, z))
        assert camera.cx + camera.fx * x == pytest.approx(320 * (1 + ndc.x), abs=1e-3)
        assert camera.cy - camera.fy * y == pytest.approx(180 * (1 - ndc.y), abs=1e-3)
        moved = part("addon.viewport.overlay")._from_behind(rv3d)
        assert moved[2, 2] * depth + moved[2, 3] == pytest.approx(ndc.z, abs=1e-4)


def test_border_of_the_camera_view_is_the_render_region(scene):
    render = scene.render
    render.resolution_x, render.resolution_y = 640, 360
    render.use_border = True
    render.border_min_x, render.border_max_x, render.border_min_y, render.border_max_y = 0.25, 0.75, 0.1, 0.6
    assert through(scene.camera, scene, 640, 360).window == (160, 144, 480, 324)
    # Zoomed out by two, the camera's frame is the middle half of the region.
    assert through(scene.camera, scene, 640, 360, zoom=0.5).window == (240, 162, 400, 252)


def test_pixel_size_divides_the_region(scene):
    scene.render.preview_pixel_size = "4"
    camera = through(scene.camera, scene, 640, 360)
    assert (camera.width, camera.height) == (160, 90)
    scene.render.preview_pixel_size = "1"
    assert camera.fx == pytest.approx(through(scene.camera, scene, 640, 360).fx / 4)


# --- the worker ----------------------------------------------------------------------------------------------------


@pytest.fixture
def worker():
    made = part("addon.viewport.worker").Worker()
    yield made
    made.stop()
    part("addon.engine_link").stop()


def request(scene, x=0.0, size=(64, 48), samples=None):
    """What a viewport `x` to the side would ask for."""
    module, frame = part("addon.viewport.worker"), exported()
    model = part("drgs_blender.core.frame")
    matrix = np.array(scene.camera.matrix_world)
    matrix[0, 3] += x
    camera = model.Camera(matrix, *size, size[0], size[0], size[0] / 2, size[1] / 2)
    settings = frame.frame.settings
    if samples is not None:
        settings = dataclasses.replace(settings, samples=samples, strategy_samples=None)
    found = dataclasses.replace(frame.frame, camera=camera, passes=("Combined",), settings=settings)
    return module.Request(found, part("addon.engine_link").client(), frame.assets)


def wait(condition, seconds=120.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "nothing came"
        time.sleep(0.005)


def done(worker, name, wanted):
    picture = worker.picture(name)
    return picture is not None and picture.request is wanted and picture.fraction == 1.0


def test_pictures_grow_to_the_final_one_in_all_viewports(scene, ball, worker):
    asked = {"a": request(scene), "b": request(scene, 0.5, (40, 30))}
    began = time.perf_counter()
    for name, what in asked.items():
        worker.submit(name, what)
    assert time.perf_counter() - began < 0.1  # nobody waits for the engine, which is not even started
    wait(lambda: all(done(worker, name, what) for name, what in asked.items()))
    for name, what in asked.items():
        final = part("addon.engine_link").render(what.frame)["Combined"]
        np.testing.assert_allclose(worker.picture(name).passes["Combined"], final, rtol=1e-4, atol=2e-6)
    assert not worker.busy()


def test_it_is_busy_until_there_is_a_picture_of_what_was_asked_last(scene, ball, worker):
    first = request(scene)
    worker.submit("a", first)
    wait(lambda: done(worker, "a", first))
    for shift in (0.1, 0.2, 0.3):
        latest = request(scene, shift)
        worker.submit("a", latest)
        shown = False
        while not shown:
            busy = worker.busy()
            shown = worker.picture("a").request is latest
            assert busy or shown


@pytest.mark.slow
@pytest.mark.parametrize("threshold", [0.0, 0.03])
@pytest.mark.parametrize("border", [False, True])
def test_f12_is_the_last_picture_of_the_camera_view(scene, ball, worker, threshold, border):
    """Through the camera, in a region as large as the picture, with the same seed: rays and pixels are the same."""
    new_world(scene)
    settings, render = scene.drgs, scene.render
    settings.use_strategy_samples, settings.samples, settings.subpixel_samples, settings.seed = False, 64, 4, 7
    settings.use_noise_threshold, settings.noise_threshold = threshold > 0, max(threshold, 1e-3)
    render.use_border = render.use_crop_to_border = border
    render.border_min_x, render.border_max_x, render.border_min_y, render.border_max_y = 0.26, 0.77, 0.11, 0.83
    scene.camera.location, scene.camera.rotation_euler = (0.3, -3, 0.9), (1.3, 0.05, 0.1)
    scene.frame_set(5)
    views, request_of = part("addon.viewport.views"), part("addon.viewport.worker").Request
    camera = through(scene.camera, scene, 64, 48)
    frame = exported().frame
    frame = dataclasses.replace(frame, camera=camera, **views._options(scene, "a", False))
    worker.submit("a", what := request_of(frame, part("addon.engine_link").client(), exported().assets))
    wait(lambda: done(worker, "a", what))
    seen = worker.picture("a").passes["Combined"]
    bpy.ops.render.render(write_still=True)
    height, width = seen.shape[:2]
    final = read_exr(scene.render.filepath, width, height)
    assert border == ((width, height) != (64, 48))
    if threshold:
        np.testing.assert_array_equal(seen, final)
    else:
        np.testing.assert_allclose(seen, final, rtol=1e-4, atol=2e-6)


def test_newest_request_wins_and_first_pictures_are_shown_meanwhile(scene, ball, worker):
    worker.submit("a", last := request(scene))
    wait(lambda: done(worker, "a", last))
    seen = {}  # keeps the requests, whose numbers would else be given to later ones
    for i in range(60):
        worker.submit("a", last := request(scene, 0.01 * i, samples=512))
        end = time.monotonic() + 0.02
        while time.monotonic() < end:
            shown = worker.picture("a").request
            seen[id(shown)] = shown
            time.sleep(0.002)
    assert len(seen) > 20  # while it moves
    wait(lambda: worker.picture("a").request is last)
    wait(lambda: done(worker, "a", last))


def test_nothing_is_refined_between_two_moves(scene, ball, worker, monkeypatch):
    """The engine would be at work on what is never seen when the next move comes."""
    module = part("addon.viewport.worker")
    monkeypatch.setattr(module, "PAUSE_SECONDS", 1e6)  # it goes on moving
    for shift in (0.0, 0.1):
        worker.submit("a", what := request(scene, shift))
        wait(lambda what=what: worker.picture("a") is not None and worker.picture("a").request is what)
        assert worker._next() is None
        assert worker.picture("a").fraction == 0.0
    monkeypatch.setattr(module, "PAUSE_SECONDS", 0.0)
    with worker._changed:
        worker._changed.notify()
    wait(lambda: done(worker, "a", what))


def test_final_render_has_the_engine_to_itself(scene, ball, worker):
    worker.submit("a", what := request(scene, samples=4096, size=(400, 300)))
    wait(lambda: worker.picture("a") is not None)
    worker.hold()
    link = part("addon.engine_link")
    link.render(request(scene).frame)
    stood = worker.picture("a").fraction
    link.render(request(scene).frame)
    assert worker.picture("a").fraction == stood < 1.0
    worker.release()
    wait(lambda: worker.picture("a").fraction > stood)
    worker.drop("a")
    assert worker.picture("a") is None and what.client.pid


def test_news_that_come_while_one_looks_are_not_lost(monkeypatch):
    """The last picture may come at that very moment; nothing else would have it drawn."""
    views = part("addon.viewport.views")
    redrawn: list[int] = []
    looks: list[int] = []

    class Busy:
        news_of = iter((1, 2, 3, 3, 3, 3, 3, 3, 3, 3))

        @property
        def news(self):
            return next(self.news_of)

        def busy(self):
            return False

        def drop(self, name):
            pass

    monkeypatch.setattr(views, "worker", Busy())
    monkeypatch.setattr(views, "_last_news", 0)
    monkeypatch.setattr(views, "_viewports", {"a": views.ViewportState()})
    monkeypatch.setattr(views, "_live", lambda: [("a", SimpleNamespace(tag_redraw=lambda: redrawn.append(len(looks))))])
    for i in range(4):
        views._poll()
        looks.append(i)
    assert redrawn == [0, 1, 2]


def test_error_is_told_and_the_next_request_is_served(scene, ball, worker):
    bad = request(scene)
    bad.frame.camera.fx = -1.0
    worker.submit("a", bad)
    wait(lambda: worker.state("a")[1])
    assert "focal lengths" in worker.state("a")[1]
    worker.submit("a", good := request(scene))
    wait(lambda: done(worker, "a", good))
    assert worker.state("a")[1] == ""


def test_engine_that_dies_is_replaced(scene, ball, worker):
    worker.submit("a", what := request(scene))
    wait(lambda: done(worker, "a", what))
    pid = what.client.pid
    import os
    import signal

    os.kill(pid, signal.SIGTERM)
    worker.submit("a", what := request(scene, 0.3))
    wait(lambda: done(worker, "a", what))
    assert what.client.pid not in (0, pid)


# --- composited over other engines ---------------------------------------------------------------------------------


def looked_up(table, colours):
    """What the shader does with the table, for (n, 3) scene-linear colours."""
    display = part("addon.viewport.view_transform")
    n = display.SIZE
    place = (np.log2(np.maximum(colours, 0) + 2.0**display.LOW) - display.LOW) / (display.HIGH - display.LOW)
    place = np.clip(place, 0, 1) * (n - 1)
    low = np.minimum(place, n - 2).astype(int)
    share = place - low
    cube = table.reshape(n, n, n, 4)[..., :3]  # blue, green, red
    found = np.zeros_like(colours)
    for corner in range(8):
        step = np.array([corner & 1, corner >> 1 & 1, corner >> 2])
        weight = np.where(step, share, 1 - share).prod(axis=1)
        r, g, b = (low + step).T
        found += weight[:, None] * cube[b, g, r]
    return found


def displayed(scene, colours, path):
    """What Blender makes of (n, 3) scene-linear colours when it saves a picture."""
    image = bpy.data.images.new("Colours", len(colours), 1, float_buffer=True)
    image.pixels.foreach_set(np.column_stack((colours, np.ones(len(colours)))).astype(np.float32).ravel())
    settings = scene.render.image_settings
    settings.file_format, settings.color_mode, settings.color_depth = "PNG", "RGB", "16"
    scene.render.dither_intensity = 0
    image.save_render(str(path), scene=scene)
    back = bpy.data.images.load(str(path))
    back.colorspace_settings.name = "Non-Color"
    pixels = np.empty(4 * len(colours), np.float32)
    back.pixels.foreach_get(pixels)
    return pixels.reshape(-1, 4)[:, :3]


@pytest.mark.parametrize("transform", ["AgX", "Filmic", "Standard"])
def test_table_shows_colours_as_blender_does(scene, tmp_path, transform):
    scene.view_settings.view_transform = transform
    display = part("addon.viewport.view_transform")
    before = len(bpy.data.scenes), len(bpy.data.images)
    table = display.table(display.key_of(scene))
    assert (len(bpy.data.scenes), len(bpy.data.images)) == before
    rng = np.random.default_rng(3)
    colours = np.concatenate(
        [
            np.exp2(rng.uniform(-9, 4, (500, 1))) * rng.uniform(0.05, 1, (500, 3)),
            np.linspace(0, 1, 200)[:, None] ** [1, 2, 3],
        ]
    )
    error = np.abs(looked_up(table, colours) - displayed(scene, colours, tmp_path / "colours.png"))
    assert 255 * error.mean() < 0.5
    assert 255 * np.percentile(error, 99) < 2.0


def test_meshes_are_boxes_while_the_overlay_is_on(crowd):
    settings, objects = crowd.scene.drgs, (crowd.ball, crowd.twin, crowd.plane)
    crowd.twin.display_type = "WIRE"
    before = [obj.display_type for obj in objects]
    settings.overlay = "LIT"
    assert [obj.display_type for obj in objects] == ["BOUNDS", "BOUNDS", before[2]]
    settings.overlay = "SURFELS"
    settings.overlay = "OFF"
    assert [obj.display_type for obj in objects] == before


def test_discs_follow_the_mesh(ball, ball_file):
    """At rest they are the surfels; where the mesh is turned and moved, so are they."""
    asset = part("addon.assets").load(ball_file)
    places = part("addon.viewport.surfels").posed_centres
    np.testing.assert_allclose(places(asset, asset.mesh.vertices), asset.surfels.centre, atol=1e-6)
    lifted = dataclasses.replace(asset.binding, offset=np.full_like(asset.binding.offset, 0.3))
    high = dataclasses.replace(asset, binding=lifted)
    turn, shift = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], np.float32), np.float32([1, 2, 3])
    moved = places(high, asset.mesh.vertices @ turn.T + shift)
    np.testing.assert_allclose(moved, places(high, asset.mesh.vertices) @ turn.T + shift, atol=1e-5)
    assert (
        np.linalg.norm(places(high, asset.mesh.vertices), axis=1) > np.linalg.norm(asset.surfels.centre, axis=1)
    ).all()
    assert np.array_equal(places(asset, asset.mesh.vertices[:5]), asset.surfels.centre)
    rows = np.arange(0, len(asset.surfels), 7)[::-1]
    np.testing.assert_array_equal(places(high, asset.mesh.vertices, rows), places(high, asset.mesh.vertices)[rows])


def test_discs_have_the_colours_that_are_painted_and_adjusted(ball, ball_file):
    surfels, asset = part("addon.viewport.surfels"), part("addon.assets").load(ball_file)

    def shown():
        return surfels.shown_asset(ball.evaluated_get(bpy.context.evaluated_depsgraph_get()), asset)[0].surfels.albedo

    np.testing.assert_array_equal(shown(), asset.surfels.albedo)
    bpy.ops.drgs.set_material(preset="GOLD")
    np.testing.assert_allclose(shown(), np.broadcast_to((1.0, 0.78, 0.34), shown().shape), atol=1e-6)
    ball.drgs.adjustment.tint = 0.5, 1, 1
    np.testing.assert_allclose(shown()[:, 0], 0.5, atol=1e-6)
    bpy.ops.object.mode_set(mode="EDIT")
    try:
        np.testing.assert_allclose(shown()[:, 0], 0.5, atol=1e-6)
    finally:
        bpy.ops.object.mode_set(mode="OBJECT")


def test_discs_of_an_object_in_edit_mode_are_what_is_left_of_it(ball, ball_file):
    """Deleted vertices take theirs along while they are edited, and points of surfels each its own."""
    import bmesh

    surfels, asset = part("addon.viewport.surfels"), part("addon.assets").load(ball_file)

    def shown():
        depsgraph = bpy.context.evaluated_depsgraph_get()
        left, vertices, _ = surfels.shown_asset(ball.evaluated_get(depsgraph), asset, depsgraph)
        return surfels.posed_centres(left, vertices)

    def delete(obj, chosen):
        mesh = bmesh.from_edit_mesh(obj.data)
        for vertex in mesh.verts:
            vertex.select_set(chosen(vertex.co))
        mesh.select_flush(True)
        bmesh.update_edit_mesh(obj.data)
        bpy.ops.mesh.delete(type="VERT")

    select(ball)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.transform.translate(value=(3, 0, 0))
    delete(ball, lambda place: place.z > 0.1)
    assert 0 < len(shown()) < len(asset.surfels) and shown()[:, 2].max() < 0.1
    assert surfels.is_edited(ball)
    bpy.ops.object.mode_set(mode="OBJECT")
    assert not surfels.is_edited(ball)
    bpy.ops.drgs.edit_surfels()
    before = len(shown())
    delete(bpy.context.edit_object, lambda place: place.z < -0.5)
    assert len(shown()) < before and shown()[:, 2].min() > -0.5 and surfels.is_edited(ball)
    bpy.ops.drgs.finish_surfels()
    assert not surfels.is_edited(ball)


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_what_is_set_back_looks_the_same_and_is_farther(projection):
    from mathutils import Matrix, Vector

    if projection == "perspective":
        near, far = 0.1, 1000.0
        depths = -(far + near) / (far - near), -2 * far * near / (far - near)
        window = Matrix(((2, 0, 0, 0), (0, 3, 0, 0), (0, 0, *depths), (0, 0, -1, 0)))
    else:
        window = Matrix(((0.2, 0, 0, 0), (0, 0.3, 0, 0), (0, 0, -0.002, 0), (0, 0, 0, 1)))
    place, behind = (window @ Vector((0.5, -0.4, z, 1)) for z in (-7, -7.25))
    moved = part("addon.viewport.surfels").set_back(window, 7, 0.25) @ place
    assert moved.xy == place.xy and moved.w == place.w
    assert moved.z / moved.w == pytest.approx(behind.z / behind.w, abs=1e-6) and moved.z > place.z


def test_points_of_surfels_stand_in_front_of_a_mesh_but_not_of_splats(ball):
    select(ball)
    bpy.ops.drgs.edit_surfels()
    points, settings = bpy.context.edit_object, bpy.context.scene.drgs
    assert points.show_in_front
    settings.overlay = "SURFELS"
    assert not points.show_in_front  # they would be drawn over
    settings.overlay = "OFF"
    assert points.show_in_front


def test_composited_frame_shows_our_objects_alone(crowd):
    views = part("addon.viewport.views")
    crowd.light.visible_camera = True
    frame = exported().frame
    alone = views._alone(frame)
    assert frame.meshes[0].visibility.camera and not alone.meshes[0].visibility.camera
    assert alone.meshes[0].visibility.shadow and alone.meshes[0].vertices is frame.meshes[0].vertices
    assert not alone.lights[0].camera and alone.objects is frame.objects
    holes = views._alone(frame, True).meshes[0].visibility
    assert holes.holdout and holes.camera and holes.shadow, "what stands before ours cuts them"
    options = views._options(crowd.scene, "a", True)
    assert options["passes"] == ("Combined", "Depth") and options["settings"].film_transparent
    assert not views._options(crowd.scene, "a", False)["settings"].film_transparent
