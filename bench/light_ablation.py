"""What visibility and inter-reflection bring: the paper's ablation pictures. Part of bench_light.py; draws a figure."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from judge import environments, look_at, psnr, to_srgb
from ours import SESSION, pinhole
from report import picture_grid, table
from subjects import asset_path

from drgs_blender.core.color import LUMINANCE
from drgs_blender.core.frame import Frame, MeshState, ObjectState, RenderSettings, Visibility, World
from drgs_blender.core.materials import Material
from drgs_blender.formats.registry import read_environment

FIGURE = "ablation.png"
#: Indirect bounces of the full method.
BOUNCES = 3
#: Seen by the camera and by nothing else: every point has the whole sky.
ALONE = Visibility(diffuse=False, glossy=False, shadow=False)


def _without_bounces(frame: Frame) -> Frame:
    return replace(frame, settings=replace(frame.settings, bounces=0))


def _without_visibility(frame: Frame) -> Frame:
    objects, meshes = ([replace(item, visibility=ALONE) for item in items] for items in (frame.objects, frame.meshes))
    return replace(_without_bounces(frame), objects=objects, meshes=meshes)


VARIANTS: dict[str, Callable[[Frame], Frame]] = {
    "full": lambda frame: frame,
    "no inter-reflection": _without_bounces,
    "no visibility": _without_visibility,
}


def on_ground(name: str, height: float, x: float, y: float, turn: float = 0.0, **materials: float) -> ObjectState:
    """An example on the ground, so tall, turned about the vertical by degrees; `materials` are the same all over."""
    key = SESSION.load_asset(asset_path(name, max_triangles=82000))
    vertices = SESSION.asset(key).mesh.vertices
    low, high = vertices.min(0), vertices.max(0)
    scale, a = height / float(high[2] - low[2]), np.radians(turn)
    matrix = np.eye(4)
    matrix[:3, :3] = scale * np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    middle = np.append((low + high)[:2] / 2, low[2])
    matrix[:3, 3] = np.array([x, y, 0]) - matrix[:3, :3] @ middle
    shape = {"roughness": (len(vertices),), "metallic": (len(vertices),), "albedo": (len(vertices), 3)}
    painted = {kind: np.full(shape[kind], value, np.float32) for kind, value in materials.items()}
    return ObjectState(name, key, matrix, **painted)


def ground(roughness: float) -> MeshState:
    corners = np.float32([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]])
    material = Material("ground", (0.5, 0.5, 0.5), roughness)
    faces = np.int32([[0, 1, 2], [0, 2, 3]])
    return MeshState("ground", corners, faces, np.eye(4)[None], np.zeros(1, np.int32), materials=[material])


def frame_of(
    objects: list[ObjectState], meshes: list[MeshState], light: str, angle: float, options: argparse.Namespace
) -> Frame:
    """A frame of things about a metre tall at the origin; `angle` of view in degrees."""
    size = options.ablation_size
    matrix = look_at(np.array([0.6, -3.6, 1.3]), np.array([0.0, 0.0, 0.5]))
    camera = pinhole({"matrix_world": matrix.tolist(), "width": size, "height": size, "fov_x": angle})
    world = World(read_environment(environments() / f"{light}.exr").radiance, strength=0.6)
    settings = RenderSettings(options.ablation_rays, bounces=BOUNCES, camera_sees="mesh")
    return Frame(1, camera, objects, world, settings, ("Combined", "Coverage"), meshes)


def scenes(options: argparse.Namespace) -> dict[str, Frame]:
    """A polished object alone, and a composed scene."""
    polished = on_ground("robot", 1.0, 0, 0, 25, roughness=0.1, metallic=1.0, albedo=0.9)
    several = [
        on_ground("helmet", 0.6, 0.6, -0.3, 20),
        on_ground("robot", 1.1, -0.25, 0.2, 20),
        on_ground("spot", 0.5, 0.1, -0.7, 60, roughness=0.15, metallic=1.0, albedo=0.9),
    ]
    return {
        "one object": frame_of([polished], [], "forest", 20, options),
        "composed": frame_of(several, [ground(0.25)], "sunset", 27, options),
    }


def ablation(options: argparse.Namespace) -> str:
    """The part's text; draws the figure."""
    shown, rows = [], []
    for scene, frame in scenes(options).items():
        made = {name: SESSION.render(change(frame)) for name, change in VARIANTS.items()}
        mask = made["full"]["Coverage"][..., 0] > 0.999
        found = {name: passes["Combined"] for name, passes in made.items()}
        shown.append({name: to_srgb(picture[..., :3]) for name, picture in found.items()})
        light = {name: float((picture[mask][:, :3] @ np.array(LUMINANCE)).mean()) for name, picture in found.items()}
        for name in list(VARIANTS)[1:]:
            ratio = light[name] / light["full"]
            rows.append((scene, name, f"{ratio:.3f}", f"{psnr(found[name], found['full'], mask):.1f}"))
    picture_grid(FIGURE, shown, options)
    return (
        f"{options.ablation_size}x{options.ablation_size}, {options.ablation_rays} rays, mesh as primary surface, "
        f"{BOUNCES} indirect bounces in full. One object: robot, roughness 0.1, metallic 1, forest.exr; composed: "
        "helmet, robot and a metallic spot on a glossy ground, sunset.exr. Without inter-reflection: no bounce, rays "
        "that meet something bring nothing. Without visibility: every point has the whole sky. Light and PSNR over "
        "what the objects cover.\n\n"
        f"![Full, without inter-reflection, without visibility](images/{FIGURE})\n\n"
        + table(("Scene", "Variant", "mean light / full", "PSNR against full, dB"), rows)
    )
