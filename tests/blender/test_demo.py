"""The demo's scene: who moves in it, and that what the artist set reaches every frame."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Vector
from scenes import part

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def script(name):
    specification = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def demo():
    before = list(sys.path)
    sys.path.insert(0, str(EXAMPLES))
    yield script("demo_scene")
    sys.path[:] = before


@pytest.fixture(scope="module")
def film(demo):
    return script("demo_film_scene")


def points(obj, frame):
    """(n, 3) vertices of an object at a frame, in the world."""
    bpy.context.scene.frame_set(frame)
    evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    found = np.empty((len(evaluated.data.vertices), 3), np.float32)
    evaluated.data.vertices.foreach_get("co", found.ravel())
    matrix = np.array(evaluated.matrix_world)
    return found @ matrix[:3, :3].T + matrix[:3, 3]


@pytest.mark.slow
def test_the_robot_dances_on_its_feet_and_keeps_its_brows(scene, demo):
    robot = demo.add_robot(1.5, Vector((0, 0, 0)), 0.0)
    rest, low = points(robot, 1), None
    feet = rest[:, 2] < 0.08
    head = [v.index for v in robot.data.vertices if v.co.z > 0.2]
    apart = lambda p: np.linalg.norm(p[head] - p[head].mean(axis=0), axis=1)  # noqa: E731
    moved = []
    for frame in (4, 7, 10):
        now = points(robot, frame)
        moved.append(np.linalg.norm(now - rest, axis=1))
        low = moved[-1][feet].max()
        assert low < 0.05, "feet stay on the ground"
        np.testing.assert_allclose(apart(now), apart(rest), atol=2e-3, err_msg="the head is rigid, brows and all")
    assert np.max(moved) > 0.3


@pytest.mark.slow
def test_day_becomes_evening_and_the_lamp_goes_on(scene, demo, export):
    demo.add_stage()
    demo.add_lamp(Vector((1, 1, 0)))
    demo.add_day()
    frames = {}
    for frame in (1, demo.FRAMES):
        scene.frame_set(frame)
        frames[frame], warnings = export()
        assert not warnings
    noon, evening = frames.values()
    down = [np.asarray(f.lights[0].matrix_world)[:3, 2][2] for f in (noon, evening)]
    assert down[0] > 0.8 and 0.1 < down[1] < 0.3, "the sun sinks"
    glow = [max(max(m.emission) for mesh in f.meshes for m in mesh.materials) for f in (noon, evening)]
    assert glow[0] == 0 and glow[1] > 5


@pytest.mark.parametrize("part_of", ("add_stage", "add_lamp"))
def test_faces_of_the_scene_have_an_area(scene, demo, part_of):
    """Else each render of the demo would tell of faces without."""
    getattr(demo, part_of)(*([Vector((1, 1, 0))] if part_of == "add_lamp" else []))
    meshes = [obj.data for obj in scene.objects if obj.type == "MESH"]
    assert len(meshes) == 2
    for mesh in meshes:
        mesh.calc_loop_triangles()
        assert min(triangle.area for triangle in mesh.loop_triangles) > 1e-9, mesh.name
        edges = [edge for polygon in mesh.polygons for edge in polygon.edge_keys]
        assert all(edges.count(edge) <= 2 for edge in edges[:50]), mesh.name


def test_the_film_begins_at_the_camera_of_the_photograph(scene, film, export):
    scene.render.resolution_x, scene.render.resolution_y = 640, 360
    film.go_around("robot")
    photograph = part("drgs_blender.cli.camera_file").read_camera(EXAMPLES / "captured" / "robot.json")
    cameras = {}
    for frame in (1, film.ROUND // 2, film.ROUND):
        scene.frame_set(frame)
        cameras[frame] = export()[0].camera
    for frame in (1, film.ROUND):
        np.testing.assert_allclose(cameras[frame].matrix_world, photograph.matrix_world, atol=1e-5)
    assert cameras[1].fy / 360 == pytest.approx(photograph.fy / 256, rel=1e-5), "as much of it, from top to bottom"
    away = cameras[film.ROUND // 2].matrix_world[:3, 3] @ photograph.matrix_world[:3, 3]
    assert away < 0, "half way round it is behind"


def test_the_cat_of_the_film_becomes_the_gold_of_the_preset(scene, demo, film, export):
    film.turn_to_gold(demo.import_drgs(EXAMPLES / "captured" / "cat.drgs"), 3, 9)
    scene.frame_set(3)
    (before,) = export()[0].objects
    assert before.adjustment is None or before.adjustment == part("drgs_blender.core.frame").Adjustment()
    scene.frame_set(9)
    (after,) = export()[0].objects
    mesh = part("drgs_blender.core.asset.container").read_asset(EXAMPLES / "captured" / "cat.drgs").mesh
    materials = {name: getattr(mesh, name) for name in ("albedo", "roughness", "metallic")}
    gold = part("drgs_blender.core.material_adjustments").adjusted(materials, after.adjustment)
    np.testing.assert_allclose(gold["albedo"], np.broadcast_to((1.0, 0.78, 0.34), gold["albedo"].shape), atol=1e-5)
    np.testing.assert_allclose(gold["metallic"], 1, atol=1e-6)
    assert gold["roughness"].max() <= 0.2 + 1e-6
