"""Panoramic cameras: framing of Cycles to the pixel, and its pictures."""

from __future__ import annotations

import math

import bpy
import numpy as np
import pytest
from mathutils import Matrix
from scenes import mesh_object, new_world, part, read_exr, shine_as_position, sphere

CASES = {
    "equirectangular": {"panorama_type": "EQUIRECTANGULAR"},
    "part of it": {
        "panorama_type": "EQUIRECTANGULAR", "longitude_min": -1.0, "longitude_max": 2.0, "latitude_min": -0.4,
        "latitude_max": 1.1, "shift_x": 0.1, "shift_y": -0.05,
    },
    "equidistant": {"panorama_type": "FISHEYE_EQUIDISTANT", "fisheye_fov": 3.4, "shift_x": 0.06, "shift_y": 0.1},
    "equisolid": {"panorama_type": "FISHEYE_EQUISOLID", "fisheye_lens": 9.0, "fisheye_fov": 2.9},
    "equisolid, vertical fit": {
        "panorama_type": "FISHEYE_EQUISOLID", "fisheye_lens": 9.0, "fisheye_fov": 2.9, "sensor_fit": "VERTICAL",
    },
    "polynomial": {
        "panorama_type": "FISHEYE_LENS_POLYNOMIAL", "fisheye_fov": 2.6, "fisheye_polynomial_k0": -0.01,
        "fisheye_polynomial_k1": -0.06, "fisheye_polynomial_k2": 4e-4, "fisheye_polynomial_k3": -2e-5,
        "fisheye_polynomial_k4": 1e-7,
    },
}  # fmt: skip


def aim(scene, case) -> None:
    """Give the scene's camera a panorama."""
    data = scene.camera.data
    data.type = "PANO"
    lens = part("addon.export.camera").lens_of(data)
    for name, value in case.items():
        setattr(data if name.startswith(("shift", "sensor")) else lens, name, value)


def directions(camera) -> np.ndarray:
    """(n, 3) world directions of the pixel centres of the window, by the formulas in frame.Camera; 0: none."""
    x0, y0, x1, y1 = camera.window
    py, px = np.mgrid[y0:y1, x0:x1] + 0.5
    x, y = (px - camera.cx) / camera.fx, -(py - camera.cy) / camera.fy
    r = np.hypot(x, y)
    if camera.panorama == "equirectangular":
        local = np.stack((np.cos(y) * np.sin(x), np.sin(y), -np.cos(y) * np.cos(x)), -1)
    else:
        powers = np.stack([r**k for k in range(5)], -1)
        angle = powers @ camera.lens if camera.panorama == "fisheye" else 2 * np.arcsin(np.minimum(r / 2, 1))
        side = np.sin(angle) / r
        local = np.stack((side * x, side * y, -np.cos(angle)), -1)
        local[np.abs(angle) > camera.fov / 2] = 0
    return local @ camera.matrix_world[:3, :3].T


@pytest.mark.blender_api
@pytest.mark.parametrize("name", CASES)
def test_every_pixel_of_cycles_looks_where_ours_does(scene, name):
    """A large sphere around the camera shines as its position; with a border and pixels that are not square."""
    aim(scene, CASES[name])
    render = scene.render
    render.resolution_x, render.resolution_y, render.pixel_aspect_y = 70, 44, 1.3
    render.use_border = render.use_crop_to_border = True
    render.border_min_x, render.border_min_y, render.border_max_x, render.border_max_y = 0.1, 0.05, 0.9, 0.97
    scene.camera.matrix_world = (
        Matrix.Translation((3, 1, 2)) @ Matrix.Rotation(1.3, 4, "X") @ Matrix.Rotation(0.4, 4, "Y")
    )
    vertices, faces = sphere(200, 300)
    wall = mesh_object("Wall", 100 * vertices + (3, 1, 2), faces)
    shine_as_position(wall, 200)
    scene.camera.data.clip_end = 1000
    bpy.context.view_layer.update()
    camera = part("addon.export.camera").export_camera(scene.camera, render)
    render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 1, False
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BOX", 0.01
    bpy.ops.render.render(write_still=True)
    x0, y0, x1, y1 = camera.window
    picture = read_exr(render.filepath, x1 - x0, y1 - y0)
    ours = directions(camera)
    seen = np.abs(ours).max(axis=2) > 0
    lit = picture[..., :3].sum(axis=2) > 0  # positions are; beyond a fisheye's picture all is black
    assert (seen != lit).mean() < 0.01 and seen.any()
    both = seen & lit
    theirs = picture[..., :3].astype(np.float64) - 200 - camera.matrix_world[:3, 3]
    theirs /= np.linalg.norm(theirs, axis=2, keepdims=True)
    # A hundredth of a pixel is 1e-3 of a radian at most; Cycles draws its one sample within 0.01 pixels.
    assert np.abs(ours - theirs)[both].max() < 2e-3


@pytest.fixture
def room(scene):
    """A room of coloured walls with a ball and a slab, lit by a lamp and a world that shines through the open roof."""
    corners = [(x, y, z) for z in (-1.5, 2) for y in (-3, 3) for x in (-3, 3)]
    sides = {
        "floor": (0, 2, 3, 1),
        "left": (0, 4, 6, 2),
        "right": (1, 3, 7, 5),
        "back": (2, 6, 7, 3),
        "front": (0, 1, 5, 4),
    }
    for index, (name, side) in enumerate(sides.items()):
        wall = mesh_object(name, corners, [side])
        colour = np.full(3, 0.3)
        colour[index % 3] = 0.75
        _paint(wall, (*colour, 1), 0.8, 0.0)
    ball = mesh_object("ball", 0.6 * sphere(40, 60)[0] + (0.9, 1.1, -0.6), sphere(40, 60)[1])
    for polygon in ball.data.polygons:
        polygon.use_smooth = True
    _paint(ball, (0.8, 0.6, 0.3, 1), 0.5, 0.0)
    light = bpy.data.objects.new("Lamp", bpy.data.lights.new("Lamp", "AREA"))
    light.data.energy, light.data.size, light.location = 150, 1.0, (-0.5, 0.3, 1.9)
    scene.collection.objects.link(light)
    _, background = new_world(scene)
    background.inputs["Color"].default_value = (0.4, 0.55, 0.8, 1)
    scene.camera.location = (-0.4, -0.8, 0.1)
    scene.camera.rotation_euler = (1.45, 0.1, 0.2)
    scene.render.resolution_x, scene.render.resolution_y = 128, 72
    return scene


def _paint(obj, colour, roughness, metallic):
    material = bpy.data.materials.new(obj.name)
    if material.node_tree is None:
        material.use_nodes = True
    shader = next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED")
    shader.inputs["Base Color"].default_value = colour
    shader.inputs["Roughness"].default_value = roughness
    shader.inputs["Metallic"].default_value = metallic
    shader.distribution = "GGX"  # ours has no multiple scattering
    obj.data.materials.append(material)


def picture(scene, engine, samples, transparent=False, passes=0):
    """(h, w, 4) of a render with `engine`, both with the same filter, one bounce and so many passages of glass."""
    scene.render.engine, scene.render.film_transparent = engine, transparent
    cycles, settings = scene.cycles, scene.drgs
    cycles.device, cycles.samples, cycles.pixel_filter_type = "CPU", samples, "BOX"
    cycles.filter_width = 1.0
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.diffuse_bounces = cycles.glossy_bounces = 1
    cycles.max_bounces, cycles.transmission_bounces = 1 + passes, passes
    cycles.sample_clamp_indirect = cycles.blur_glossy = 0.0
    cycles.caustics_reflective = True
    settings.use_strategy_samples, settings.samples, settings.bounces = False, samples, 1
    settings.subpixel_samples, settings.filter_width = 16, 0.0
    bpy.ops.render.render(write_still=True)
    return read_exr(scene.render.filepath, scene.render.resolution_x, scene.render.resolution_y)


def srgb_psnr(a, b) -> float:
    """PSNR of display colours."""
    return -10 * math.log10(np.mean((np.clip(a, 0, 1) ** (1 / 2.2) - np.clip(b, 0, 1) ** (1 / 2.2)) ** 2))


@pytest.mark.slow
@pytest.mark.judged
@pytest.mark.parametrize("name", [name for name in CASES if name not in ("part of it", "equisolid, vertical fit")])
def test_pictures_are_those_of_cycles(room, name):
    aim(room, CASES[name])
    transparent = name == "equidistant"
    theirs, ours = picture(room, "CYCLES", 512, transparent), picture(room, "DRGS", 512, transparent)
    found = srgb_psnr(ours[..., :3], theirs[..., :3])
    print(f"{name}: {found:.1f} dB")
    assert found >= 40, f"{found:.1f} dB"
    assert np.abs(ours[..., 3] - theirs[..., 3]).mean() < 0.003


@pytest.mark.parametrize("kind", ["MIRRORBALL", "EQUIANGULAR_CUBEMAP_FACE"])
def test_panorama_without_rays_is_refused_with_a_remedy(scene, kind):
    aim(scene, {"panorama_type": kind})
    with pytest.raises(part("drgs_blender.core.errors").UsageError, match=r'"Camera".*Choose Equirectangular'):
        part("addon.export.camera").export_camera(scene.camera, scene.render)


def test_limits_that_end_before_they_begin_are_refused(scene):
    aim(scene, {"panorama_type": "EQUIRECTANGULAR", "longitude_min": 1.0, "longitude_max": -1.0})
    with pytest.raises(part("drgs_blender.core.errors").UsageError, match=r'"Camera".*end before they begin'):
        part("addon.export.camera").export_camera(scene.camera, scene.render)


@pytest.mark.parametrize("values", [(0.1, 0, 0, 0, 0), (0, math.nan, 0, 0, 0), (0, 1, math.inf, 0, 0)])
def test_lens_polynomials_without_a_picture_are_refused(scene, values):
    case = {f"fisheye_polynomial_k{i}": value for i, value in enumerate(values)}
    aim(scene, {"panorama_type": "FISHEYE_LENS_POLYNOMIAL", **case})
    with pytest.raises(part("drgs_blender.core.errors").UsageError, match=r'"Camera".*Lens Polynomial.*K1 to K4'):
        part("addon.export.camera").export_camera(scene.camera, scene.render)


def test_depth_of_field_of_a_panorama_is_told(scene, captured):
    aim(scene, {"panorama_type": "EQUIRECTANGULAR"})
    scene.camera.data.dof.use_dof = True
    bpy.ops.render.render()
    assert len(captured) == 1 and captured[0].camera.panorama == "equirectangular"
    assert any('"Camera"' in m.text and "no depth of field" in m.text for m in part("addon.messages").history)
