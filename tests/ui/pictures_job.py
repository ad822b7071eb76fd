"""Runs inside Blender with a window, for window_pictures.py: what the guide has pictures of."""

from __future__ import annotations

import math
import os
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import bpy
from mathutils import Vector

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "examples"))
sys.path.insert(0, str(Path(__file__).parent))

import hands
from blender_scenes import add_material, import_drgs, stand
from hands import found, move, part, photograph, press, settled, where
from pictured import SIDEBAR, TABS, TALL

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
found["boxes"] = {}
#: Pictures to take; all of them, if none is named.
NAMES = os.environ["DRGS_WINDOW_PICTURES"].split()
#: Pixels: the column of tabs in a sidebar, a scroll bar, the corners of an editor, the lines above a viewport.
TAB_STRIP, SCROLL_BAR, EDGE, HEADERS = 22, 8, 4, 56
#: What names of panels get, so that Blender does not remember whether they were open.
FRESH = "_pictured"


def is_wanted(name: str) -> bool:
    return not NAMES or name in NAMES


def taken(name: str, kind: str, region: str, right: int = 0) -> Iterator[float]:
    """A photograph, of which a region without `right` pixels is kept; window_pictures.py crops it to what is there."""
    window, _, r = where(kind, region)
    left, top, bottom = r.x + EDGE, window.height - r.y - r.height + EDGE, window.height - r.y - EDGE
    found["boxes"][name] = [left, top, r.x + r.width - right - EDGE, bottom]
    yield from move(hands.middle(kind) if kind == "FILE_BROWSER" else (2, 2))  # where no tooltip covers it
    yield 0.5
    yield from photograph(name)


def show_only(names: Sequence[str], **place: str) -> None:
    """Leave these panels alone in a place, open, and at its top where what they stand below is not among them."""
    for panel in bpy.types.Panel.__subclasses__():
        if panel.is_registered and all(getattr(panel, f"bl_{key}", "") == value for key, value in place.items()):
            bpy.utils.unregister_class(panel)
    panels = {panel.__name__: panel for panel in bpy.types.Panel.__subclasses__()}
    for name in names:
        panel = panels[name]
        panel.bl_idname = name + FRESH
        panel.bl_options = set(getattr(panel, "bl_options", ())) - {"DEFAULT_CLOSED"}
        parent = getattr(panel, "bl_parent_id", "").removesuffix(FRESH)
        panel.bl_parent_id = parent + FRESH if parent in names else ""
        bpy.utils.register_class(panel)


def sidebar(name: str) -> Iterator[float]:
    if not is_wanted(name):
        return
    show_only(SIDEBAR[name], space_type="VIEW_3D", category="DR-GS")
    yield 0.5
    yield from taken(name, "VIEW_3D", "UI", TAB_STRIP)


def tab(name: str) -> Iterator[float]:
    if not is_wanted(name):
        return
    context, panels = TABS[name]
    show_only(panels, space_type="PROPERTIES", context=context.lower())
    where("PROPERTIES")[1].spaces.active.context = context
    bpy.context.preferences.view.ui_scale = 0.75 if name in TALL else 1.0
    yield 0.5
    yield from taken(name, "PROPERTIES", "WINDOW", SCROLL_BAR)


def activate(obj: bpy.types.Object) -> None:
    for other in bpy.context.view_layer.objects:
        other.select_set(other == obj)
    bpy.context.view_layer.objects.active = obj


def scene() -> list[bpy.types.Object]:
    """Three captured objects on a floor, the cow first."""
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)
    bpy.ops.mesh.primitive_plane_add(size=14)
    bpy.context.object.data.materials.append(add_material("Ground", (0.5, 0.47, 0.43), roughness=0.6))
    made = []
    for name, height, x, turn in (("spot", 0.85, -1.25, -35), ("robot", 1.5, 0.0, 8), ("cat", 1.0, 1.25, -25)):
        shutil.copy(EXAMPLES / "captured" / f"{name}.drgs", hands.FOLDER)
        made.append(import_drgs(hands.FOLDER / f"{name}.drgs"))
        stand(made[-1], height, Vector((x, 0, 0)), math.radians(turn))
    lights = {s.name: s.path for s in bpy.context.preferences.studio_lights if s.type == "WORLD"}
    bpy.ops.drgs.choose_light(filepath=lights["courtyard.exr"])
    activate(made[0])
    bpy.ops.wm.save_as_mainfile(filepath=str(hands.FOLDER / "cow.blend"))
    bpy.ops.file.make_paths_relative()
    return made


def work() -> Iterator[float]:
    with hands.context_of():
        cow, robot, _ = scene()
    space = where()[1].spaces.active
    space.overlay.show_floor, space.overlay.show_axis_x, space.overlay.show_axis_y = False, False, False
    space.region_3d.view_perspective = "PERSP"
    space.lens = 60
    view = space.region_3d
    view.view_rotation = Vector((0.12, -1.0, 0.24)).to_track_quat("Z", "Y")
    view.view_location, view.view_distance = (0.05, 0, 0.62), 6.2
    yield from hands.show_tab()
    yield 1.0
    if is_wanted("guide-window"):
        with hands.context_of():
            bpy.ops.drgs.show_rendered()
        yield from settled()
        found["boxes"]["guide-window"] = []
        yield from photograph("guide-window")
        space.shading.type = "SOLID"
    bpy.context.scene.render.engine = "DRGS"
    bpy.context.preferences.system.use_region_overlap = False
    part("addon.messages").clear()
    yield from fog(cow)
    for name in SIDEBAR:
        if name != "guide-clean":
            yield from sidebar(name)
    yield from surfels(cow)
    yield from dialogs()
    where("PROPERTIES")[1].type = "INFO"  # too low
    with hands.context_of():
        bpy.ops.screen.area_split(direction="VERTICAL", factor=0.42)
    yield 1.0
    where()[1].type = "PROPERTIES"
    yield 1.0
    for obj in (cow, robot):
        obj.drgs.physics.use = True
    cow.drgs.physics.regions.add().material = "rubber"
    cow.drgs.physics.colliders.add()
    yield from tabs(cow)
    yield from preferences()


def fog(cow: bpy.types.Object) -> Iterator[float]:
    """Something that is not rendered, so that there is a message."""
    with hands.context_of():
        bpy.ops.object.volume_add()
        bpy.context.object.name = "Fog"
    where()[1].spaces.active.shading.type = "RENDERED"
    history = part("addon.messages").history
    yield from hands.until(lambda: any(m.level == "WARNING" for m in history), "the warning")
    for message in [m for m in history if m.level == "INFO"]:  # where the engine is
        history.remove(message)
    where()[1].spaces.active.shading.type = "SOLID"
    activate(cow)
    yield 1.0


def surfels(cow: bpy.types.Object) -> Iterator[float]:
    """Surfels as points, the widest selected, and the panel Clean meanwhile."""
    bpy.data.objects.remove(bpy.data.objects["Fog"])
    with hands.context_of():
        bpy.ops.drgs.edit_surfels()
        bpy.ops.mesh.select_all(action="SELECT")
        bpy.ops.view3d.view_selected(use_all_regions=False)
        bpy.ops.drgs.select_surfels(criterion="SIZE", size=1.5)
    where()[1].spaces.active.region_3d.view_distance *= 1.5
    yield 1.0
    yield from sidebar("guide-clean")
    if is_wanted("guide-surfels"):
        where()[1].spaces.active.overlay.show_text = where()[1].spaces.active.show_gizmo = False
        yield from taken("guide-surfels", "VIEW_3D", "WINDOW")
        _, top, _, bottom = found["boxes"]["guide-surfels"]
        left, above, right, below = hands.box_of(bpy.context.object)
        found["boxes"]["guide-surfels"] = [left, max(above, top + HEADERS), right, min(below, bottom)]
    with hands.context_of():
        bpy.ops.drgs.finish_surfels()
    activate(cow)


def dialogs() -> Iterator[float]:
    """The fields beside the files."""
    bpy.context.preferences.view.filebrowser_display_type = "SCREEN"
    for name, operator, given in (
        ("guide-import", bpy.ops.drgs.import_parts, {"browse": True}),
        ("guide-photographs", bpy.ops.drgs.reconstruct, {}),
    ):
        if not is_wanted(name):
            continue
        with hands.context_of():
            operator("INVOKE_DEFAULT", **given)
        yield from hands.until(lambda: hands.there("FILE_BROWSER"), "the file browser", 30)
        yield 1.0
        where("FILE_BROWSER")[1].spaces.active.params.directory = str(EXAMPLES).encode()
        yield 1.0
        _, _, r = where("FILE_BROWSER", "TOOL_PROPS")
        edge = r.x, r.y + r.height // 2
        yield from hands.drag(edge, (r.x - 120, edge[1]))
        yield from taken(name, "FILE_BROWSER", "TOOL_PROPS")
        yield from press("file.cancel", "FILE_BROWSER", "EXECUTE")
        yield from hands.until(lambda: not hands.there("FILE_BROWSER"), "the end of the file browser", 30)
        yield 1.0


def tabs(cow: bpy.types.Object) -> Iterator[float]:
    """The tabs of the Properties editor."""
    scene, layer = bpy.context.scene, bpy.context.view_layer
    for name in ("Key", "Rim"):
        layer.lightgroups.add(name=name)
    layer.aovs.add().name = "Mask"
    lamp = bpy.data.objects.new("Area", bpy.data.lights.new("Area", "AREA"))
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.data.type = "PANO"
    for obj in (lamp, camera):
        scene.collection.objects.link(obj)
    scene.render.use_motion_blur = True
    shown = {"guide-beam": lamp, "guide-panorama": camera}
    for name in TABS:
        activate(shown.get(name, cow))
        if name == "guide-compositing":
            scene.render.engine = "CYCLES"
            camera.data.type, scene.camera = "PERSP", camera
            bpy.ops.drgs.set_up_compositing()
        yield from tab(name)


def preferences() -> Iterator[float]:
    """The extension's preferences, drawn as Blender does, without the paths that it has above them."""
    if not is_wanted("guide-preferences"):
        return
    os.environ.pop("DRGS_ENGINE", None)  # as on a computer where nothing was set up
    part("addon.engine_link").stop()

    class Shown(bpy.types.Panel):
        bl_idname = "DRGS_PT_preferences_shown"
        bl_label = "Preferences"
        bl_space_type, bl_region_type, bl_context = "PROPERTIES", "WINDOW", "scene"

        def draw(self, context: bpy.types.Context) -> None:
            own = context.preferences.addons[hands.PACKAGE].preferences
            own.layout = self.layout
            own.draw(context)

    show_only((), space_type="PROPERTIES", context="scene")
    bpy.utils.register_class(Shown)
    where("PROPERTIES")[1].spaces.active.context = "SCENE"
    yield 1.0
    yield from taken("guide-preferences", "PROPERTIES", "WINDOW", SCROLL_BAR)


hands.run(work())
