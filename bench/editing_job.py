"""Runs inside Blender's Python: edits materials by what an artist presses, and renders after each edit.

    .venv-blender/bin/python bench/editing_job.py JOB.json

The job names the extension's zip, the subjects' .drgs files, two HDRIs, size, rays and the folder to write to:
NAME-STEP-surfels.exr, NAME-STEP-mesh.exr, pictures of either primary surface with the passes of the materials, those
of the mesh of one point a pixel; and NAME.npz, faces, vertices in the world, at rest and posed, and masks.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np

sys.path.append(str(Path(__file__).parent))
from composed_job import camera, subject

#: What is painted: the colour, and the roughness of varnish.
PAINT, VARNISH = (0.5, 0.01, 0.015), 0.15
TINT = (0.25, 0.5, 1.0)


@dataclass
class Subject:
    """How an example stands, and the masks of its edits: attributes that it came with, or vertex groups."""

    turn: float
    lens: float
    gilded: str
    painted: str
    tinted: str
    groups: Callable[[np.ndarray], dict[str, np.ndarray]] = lambda vertices: {}


def _of_cow(v: np.ndarray) -> dict[str, np.ndarray]:
    """Vertex groups of spot, drawn by coordinates."""
    _, y, z = v.T
    head = (y > 0.25) & (z > 0.15)
    legs = z < -0.3
    return {"Head": head, "Legs": legs, "Body": ~head & ~legs}


SUBJECTS = {
    "helmet": Subject(0.5, 72, "MetalPartsMat", "LeatherPartsMat", "RubberWoodMat"),
    "spot": Subject(3.75, 74, "Head", "Legs", "Body", _of_cow),
}


def adjust(obj: bpy.types.Object, **values: object) -> None:
    """What sliders of the panel Adjustments do."""
    for name, value in values.items():
        setattr(obj.drgs.adjustment, name, value)


def paint(obj: bpy.types.Object, channel: str, mask: str, colour: tuple[float, float, float]) -> None:
    """Fill a part in Vertex Paint: what Set Vertex Colors does where a selection masks the brush."""
    bpy.ops.drgs.paint(channel=channel)
    brushes = bpy.context.tool_settings.vertex_paint
    unified = brushes.unified_paint_settings
    unified.use_unified_color, unified.color = True, colour
    obj.data.use_paint_mask_vertex = True
    obj.data.vertices.foreach_set("select", masks_of(obj)[mask] > 0)
    bpy.ops.paint.vertex_color_set()
    obj.data.use_paint_mask_vertex = False
    bpy.ops.object.mode_set(mode="OBJECT")


def gold(obj: bpy.types.Object, how: Subject) -> None:
    bpy.ops.drgs.set_material(preset="GOLD")


def mirror(obj: bpy.types.Object, how: Subject) -> None:
    adjust(obj, roughness_gain=0.1, metallic_offset=1.0, value=3.0)


def gilded(obj: bpy.types.Object, how: Subject) -> None:
    bpy.ops.drgs.set_material(preset="GOLD", mask=how.gilded)


def painted(obj: bpy.types.Object, how: Subject) -> None:
    paint(obj, "albedo", how.painted, PAINT)
    paint(obj, "roughness", how.painted, (VARNISH,) * 3)


def tinted(obj: bpy.types.Object, how: Subject) -> None:
    adjust(obj, tint=TINT, mask=how.tinted)


def everything(obj: bpy.types.Object, how: Subject) -> None:
    gilded(obj, how)
    painted(obj, how)
    tinted(obj, how)


EDITS = {"gold": gold, "mirror": mirror, "gilded": gilded, "painted": painted, "tinted": tinted, "all": everything}


def masks_of(obj: bpy.types.Object) -> dict[str, np.ndarray]:
    """(n,) float32 of every vertex group and every attribute that is true or false."""
    count = len(obj.data.vertices)
    found = {}
    for attribute in obj.data.attributes:
        if attribute.data_type == "BOOLEAN" and attribute.domain == "POINT":
            values = np.empty(count, bool)
            attribute.data.foreach_get("value", values)
            found[attribute.name] = values.astype(np.float32)
    for group in obj.vertex_groups:
        found[group.name] = np.zeros(count, np.float32)
    names = [group.name for group in obj.vertex_groups]
    for vertex in obj.data.vertices:
        for element in vertex.groups:
            found[names[element.group]][vertex.index] = element.weight
    return found


def world_vertices(obj: bpy.types.Object) -> np.ndarray:
    """(n, 3) as they are rendered."""
    evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    vertices = np.empty(3 * len(evaluated.data.vertices), np.float32)
    evaluated.data.vertices.foreach_get("co", vertices)
    matrix = np.array(evaluated.matrix_world)
    return vertices.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]


def pose(obj: bpy.types.Object) -> None:
    """Lean by a lattice: its upper points move and turn."""
    bpy.ops.drgs.bind_to_lattice(points=(2, 2, 4))
    lattice = bpy.context.object
    for point in lattice.data.points:
        up = point.co.z + 0.5
        angle = 0.4 * up**2
        x, y = point.co.x, point.co.y
        point.co_deform.x = np.cos(angle) * x - np.sin(angle) * y + 0.25 * up**2
        point.co_deform.y = np.sin(angle) * x + np.cos(angle) * y
    bpy.ops.object.select_all(action="DESELECT")
    obj.select_set(True)
    bpy.context.view_layer.objects.active = obj


def prepare(job: dict) -> bpy.types.Scene:
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    scene = bpy.context.scene
    bpy.ops.wm.save_as_mainfile(filepath=str(Path(job["out"], "editing.blend")))
    bpy.ops.drgs.show_rendered()
    render = scene.render
    render.resolution_x = render.resolution_y = job["size"]
    render.film_transparent = True
    scene.view_settings.view_transform = "Raw"
    image = render.image_settings
    image.media_type = "MULTI_LAYER_IMAGE"
    image.file_format, image.color_depth = "OPEN_EXR_MULTILAYER", "32"
    settings = scene.drgs
    settings.bounces = 2
    layer = scene.view_layers[0]
    layer.use_pass_position = True
    for name in ("albedo", "roughness", "metallic", "coverage"):
        setattr(layer.drgs, f"use_pass_{name}", True)
    return scene


def main(path: str) -> None:
    job = json.loads(Path(path).read_text())
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.extensions.package_install_files(filepath=job["zip"], repo="user_default", enable_on_install=True)
    for name, asset in job["assets"].items():
        scene, how, out = prepare(job), SUBJECTS[name], Path(job["out"])

        def picture(step: str, scene: bpy.types.Scene = scene, stem: Path = out / name) -> None:
            for camera_sees, samples, subpixels in (("surfels", job["samples"], 16), ("mesh", 16, 1)):
                scene.drgs.camera_sees, scene.drgs.samples, scene.drgs.subpixel_samples = (
                    camera_sees,
                    samples,
                    subpixels,
                )
                scene.drgs.denoise = "none"
                scene.render.filepath = f"{stem}-{step}-{camera_sees}.exr"
                bpy.ops.render.render(write_still=True)

        obj = subject(asset, how.turn)
        camera((0.7, -3.6, 1.3), (0.05, 0, 0.75), how.lens)
        local = np.array([v.co for v in obj.data.vertices])
        for group, members in how.groups(local).items():
            obj.vertex_groups.new(name=group).add(np.flatnonzero(members).tolist(), 1.0, "REPLACE")
        first, second = job["lights"]
        bpy.ops.drgs.choose_light(filepath=first)
        bpy.context.view_layer.update()
        faces = np.empty(len(obj.data.loops), np.int32)
        obj.data.loops.foreach_get("vertex_index", faces)
        arrays = {"faces": faces.reshape(-1, 3), "rest": world_vertices(obj)} | masks_of(obj)
        picture("captured")
        for step, edit in EDITS.items():
            bpy.ops.drgs.restore_material()
            edit(obj, how)
            picture(step)
        obj.drgs.show_captured = True
        picture("shown")
        pose(obj)
        bpy.ops.drgs.choose_light(filepath=second)
        bpy.context.view_layer.update()
        arrays["posed"] = world_vertices(obj)
        picture("posed-captured")
        obj.drgs.show_captured = False
        picture("posed-all")
        bpy.ops.drgs.restore_material()
        obj.modifiers.clear()
        bpy.ops.drgs.choose_light(filepath=first)
        picture("restored")
        np.savez(out / f"{name}.npz", **arrays)
    bpy.ops.drgs.engine_stop()


if __name__ == "__main__":
    main(sys.argv[1])
