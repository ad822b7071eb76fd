"""Framing is Blender's to the pixel: against its own projection and against a Cycles picture of positions."""

from __future__ import annotations

import itertools
import json
import re
from pathlib import Path

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Matrix, Vector
from scenes import mesh_object, part, read_exr, shine_as_position

pytestmark = pytest.mark.blender_api


def project(camera, points: np.ndarray) -> np.ndarray:
    """(n, 2) pixel positions of world points by the formula in frame.Camera."""
    local = np.linalg.inv(camera.matrix_world) @ np.column_stack((points, np.ones(len(points)))).T
    x, y, z = local[:3]
    depth = 1 if camera.orthographic else -z
    return np.stack((camera.cx + camera.fx * x / depth, camera.cy - camera.fy * y / depth), axis=1)


def exported(scene):
    bpy.context.view_layer.update()
    depsgraph = bpy.context.evaluated_depsgraph_get()
    return part("addon.export.camera").export_camera(scene.camera.evaluated_get(depsgraph), scene.render)


POINTS = np.random.default_rng(7).uniform((-2, -1, -2), (2, 4, 2), (40, 3))


@pytest.mark.parametrize("kind", ["PERSP", "ORTHO"])
@pytest.mark.parametrize("fit", ["AUTO", "HORIZONTAL", "VERTICAL"])
def test_projection_equals_blenders(scene, kind, fit):
    data = scene.camera.data
    data.type, data.sensor_fit = kind, fit
    data.sensor_width, data.sensor_height, data.lens, data.ortho_scale = 30, 22, 41, 5.5
    # A scaled, rotated, parented camera: of its matrix only rotation and position count.
    scene.camera.matrix_world = (
        Matrix.Translation((0.3, -6, 0.5)) @ Matrix.Rotation(1.4, 4, "X") @ Matrix.Rotation(0.2, 4, "Z")
    ) @ Matrix.Diagonal((2, 2, 2, 1))
    cases = itertools.product(
        [(640, 360), (300, 700), (512, 512)], [(0, 0), (0.3, -0.2)], [(1, 1), (2, 1), (1, 1.5)], [100, 50]
    )
    for (width, height), shift, aspect, percentage in cases:
        scene.render.resolution_x, scene.render.resolution_y = width, height
        scene.render.resolution_percentage = percentage
        scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = aspect
        data.shift_x, data.shift_y = shift
        camera = exported(scene)
        assert (camera.width, camera.height) == (width * percentage // 100, height * percentage // 100)
        flat = np.array([world_to_camera_view(scene, scene.camera, Vector(p)) for p in POINTS])
        expected = np.stack((flat[:, 0] * camera.width, (1 - flat[:, 1]) * camera.height), axis=1)
        np.testing.assert_allclose(project(camera, POINTS), expected, atol=1e-3, err_msg=f"{width} {shift} {aspect}")


@pytest.mark.parametrize("size", [(64, 48), (48, 64)])
def test_the_script_of_the_manual_writes_the_camera_for_relight(scene, tmp_path, size):
    scene.render.resolution_x, scene.render.resolution_y = size
    scene.camera.scale = (2, 2, 2)
    camera = exported(scene)
    manual = Path(__file__).parents[2] / "docs" / "command-line.md"
    (code,) = (c for c in re.findall(r"```python\n(.*?)```", manual.read_text("utf-8"), re.S) if "fx" in c)
    path = tmp_path / "front.json"
    exec(code.replace("/tmp/front.json", path.as_posix()), {})
    written = json.loads(path.read_text())
    np.testing.assert_allclose(written["matrix_world"], camera.matrix_world, atol=1e-6)
    assert (written["width"], written["height"]) == size and written["fx"] == pytest.approx(camera.fx, rel=1e-6)


CASES = {
    "plain": {},
    "wide shift": {"resolution": (90, 40), "shift": (0.25, -0.15)},
    "tall auto": {"resolution": (40, 90), "shift": (-0.1, 0.2)},
    "vertical fit": {"resolution": (90, 40), "fit": "VERTICAL", "shift": (0.1, 0.1)},
    "pixel aspect": {"resolution": (70, 50), "aspect": (1, 2), "shift": (0.1, -0.3)},
    "wide pixels": {"resolution": (50, 70), "aspect": (1.7, 1)},
    "percentage": {"resolution": (101, 67), "percentage": 61, "shift": (0.2, 0.1)},
    "orthographic": {"kind": "ORTHO", "resolution": (80, 60), "shift": (0.2, -0.1)},
    "ortho tall aspect": {"kind": "ORTHO", "resolution": (40, 80), "aspect": (1, 1.5)},
    "border": {"border": (0.13, 0.21, 0.77, 0.9), "shift": (0.1, 0)},
    "crop": {"border": (0.13, 0.21, 0.77, 0.9), "crop": True, "resolution": (83, 59)},
}


@pytest.mark.parametrize("name", CASES)
def test_every_pixel_of_a_cycles_picture_of_positions_projects_to_itself(scene, name):
    case = CASES[name]
    render, data = scene.render, scene.camera.data
    render.resolution_x, render.resolution_y = case.get("resolution", (64, 48))
    render.resolution_percentage = case.get("percentage", 100)
    render.pixel_aspect_x, render.pixel_aspect_y = case.get("aspect", (1, 1))
    data.type, data.sensor_fit = case.get("kind", "PERSP"), case.get("fit", "AUTO")
    data.shift_x, data.shift_y = case.get("shift", (0, 0))
    if "border" in case:
        render.use_border, render.use_crop_to_border = True, case.get("crop", False)
        render.border_min_x, render.border_min_y, render.border_max_x, render.border_max_y = case["border"]
    # A tilted wall that fills the picture and shines as its position (offset, because light is not negative).
    wall = mesh_object("Wall", [(-30, -2, -30), (30, 4, -30), (30, 9, 30), (-30, 3, 30)], [(0, 1, 2, 3)])
    shine_as_position(wall, 50)
    render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 1, False
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BOX", 0.01
    bpy.ops.render.render(write_still=True)
    camera = exported(scene)
    x0, y0, x1, y1 = camera.window
    cropped = case.get("crop", False)
    size = (x1 - x0, y1 - y0) if cropped else (camera.width, camera.height)
    picture = read_exr(render.filepath, *size)
    if not cropped:
        filled = np.argwhere(picture[..., 3] > 0)
        assert tuple(filled.min(0)) == (y0, x0) and tuple(filled.max(0) + 1) == (y1, x1)
        picture = picture[y0:y1, x0:x1]
    assert (picture[..., 3] > 0.999).all()
    found = project(camera, picture[..., :3].reshape(-1, 3).astype(np.float64) - 50)
    y, x = np.mgrid[y0:y1, x0:x1]
    np.testing.assert_allclose(found, np.stack((x + 0.5, y + 0.5), -1).reshape(-1, 2), atol=0.03)


def test_custom_camera_is_refused_with_a_remedy(scene):
    if "CUSTOM" not in scene.camera.data.bl_rna.properties["type"].enum_items:
        pytest.skip("this Blender has no custom cameras")
    scene.camera.data.type = "CUSTOM"
    with pytest.raises(part("drgs_blender.core.errors").UsageError, match=r'"Camera".*Perspective, Orthographic or'):
        exported(scene)


def test_empty_region_is_refused(scene):
    scene.render.use_border = True
    scene.render.border_min_x = scene.render.border_max_x = 0.5
    with pytest.raises(part("drgs_blender.core.errors").UsageError, match="Render Region"):
        exported(scene)


@pytest.mark.parametrize("kind", ["EMPTY", "MESH"])
def test_object_that_is_no_camera_is_named(scene, export, kind):
    mesh = mesh_object("Plate", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])
    empty = bpy.data.objects.new("Target", None)
    scene.collection.objects.link(empty)
    scene.camera = mesh if kind == "MESH" else empty
    name = scene.camera.name
    with pytest.raises(
        part("drgs_blender.core.errors").UsageError, match=rf'"{name}".*{kind.capitalize()}.*Scene > Camera'
    ):
        export()


def test_orthographic_scale_of_zero_is_refused(scene, export):
    scene.camera.data.type, scene.camera.data.ortho_scale = "ORTHO", 0
    if scene.camera.data.ortho_scale > 0:
        pytest.skip("this Blender does not allow it")
    with pytest.raises(part("drgs_blender.core.errors").UsageError, match=r'"Camera".*Orthographic Scale of 0'):
        export()


@pytest.mark.parametrize("scale", [(0, 0, 0), (1, 0, 1), (float("nan"), 1, 1), (float("inf"), 1, 1)])
def test_camera_without_a_direction_is_named(scene, export, scale):
    scene.camera.scale = scale
    with pytest.raises(
        part("drgs_blender.core.errors").UsageError, match=r'Camera "Camera".*scale of 0 or.*not finite'
    ):
        export()
