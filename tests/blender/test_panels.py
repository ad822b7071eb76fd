"""Every panel and menu drawn, in every state of the scene, onto a layout that knows what Blender's would refuse.

In a window Blender only prints such errors, panel by panel, when somebody looks; here nothing of it is missed.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import bpy
import pytest
from scenes import PACKAGE, armature_object, mesh_object, new_world, part, select

pytestmark = pytest.mark.blender_api

FUNCTIONS = bpy.types.UILayout.bl_rna.functions
PROPERTIES = bpy.types.UILayout.bl_rna.properties


class Values:
    """What an operator's button is given; only what the operator has."""

    def __init__(self, operator: str) -> None:
        group, name = operator.split(".")
        object.__setattr__(self, "known", getattr(getattr(bpy.ops, group), name).get_rna_type().properties)
        object.__setattr__(self, "operator", operator)

    def __setattr__(self, name, value):
        assert name in self.known, f"{self.operator} has no property {name}"
        kind = self.known[name]
        if kind.type == "ENUM" and kind.enum_items:
            assert value in kind.enum_items, f"{self.operator}.{name} is never {value}"


class Layout:
    """Blender's layout as its own description has it: functions, their arguments, icons, what they name."""

    def __init__(self, drawn: list[str]) -> None:
        object.__setattr__(self, "drawn", drawn)

    def __setattr__(self, name, value):
        assert name in PROPERTIES, f"a layout has no property {name}"

    def __getattr__(self, name):
        assert name in FUNCTIONS, f"a layout cannot {name}"
        parameters = FUNCTIONS[name].parameters
        order = [p.identifier for p in parameters if not p.is_output]

        def draw(*values, **named):
            named |= dict(zip(order, values))
            self.drawn.append(name)
            for key, value in named.items():
                assert key in parameters, f"{name} takes no {key}"
                kind = parameters[key]
                if kind.type == "ENUM" and isinstance(value, str):
                    assert value in kind.enum_items or (key == "icon" and value == ""), f"{name}({key}={value!r})"
                if kind.type == "STRING" and key in ("text", "heading"):
                    assert isinstance(value, str)
            return self.check(name, named) or self

        return draw

    def check(self, name, named):
        """What is named must be there."""
        if name.startswith("operator"):
            values = Values(named["operator"])
            if name.startswith("operator_") and "property" in named:
                assert named["property"] in values.known
            return values
        for data, prop in (("data", "property"), ("search_data", "search_property"), ("dataptr", "propname")):
            owner, wanted = named.get(data), named.get(prop)
            if owner is not None and wanted is not None and not wanted.startswith("["):
                assert wanted in owner.bl_rna.properties, f"{owner!r} has no {wanted}"
        for key, types in (("menu", bpy.types), ("panel", bpy.types), ("listtype_name", bpy.types)):
            if key in named:
                assert hasattr(types, named[key]), f"{named[key]} is not registered"
        return None


def drawables() -> list[type]:
    """All panels and menus of the extension."""
    kinds = (bpy.types.Panel, bpy.types.Menu)
    return [c for kind in kinds for c in kind.__subclasses__() if c.__module__.startswith(PACKAGE)]


def empty(ball_file):
    bpy.context.scene.camera = None


def imported(ball_file):
    bpy.ops.import_scene.drgs(filepath=str(ball_file))


def unselected(ball_file):
    imported(ball_file)
    select(bpy.context.scene.camera)
    bpy.context.view_layer.objects.active = None


def damaged(ball_file):
    imported(ball_file)
    ball_file.unlink()
    part("addon.messages").note("ERROR", 'Object "ball": its file is gone. Find it')


def bound(ball_file):
    imported(ball_file)
    new_world(bpy.context.scene)
    bpy.ops.drgs.bind_to_lattice()
    bpy.ops.drgs.pose()


def painted(ball_file):
    imported(ball_file)
    bpy.ops.drgs.paint(channel="roughness")


def others(ball_file):
    imported(ball_file)
    plane = mesh_object("Plane", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])
    light = bpy.data.objects.new("Light", bpy.data.lights.new("Light", "AREA"))
    bpy.context.scene.collection.objects.link(light)
    select(armature_object({"Bone": ((0, 0, 0), (0, 0, 1))}), plane, light)


def elsewhere(ball_file):
    imported(ball_file)
    bpy.context.scene.render.engine = "CYCLES"
    bpy.context.scene.drgs.overlay = "SURFELS"


def reconstructing(ball_file):
    reconstruction = part("addon.reconstruction")
    reconstruction.job = reconstruction.Reconstruction(ball_file, ball_file.parent)
    image = bpy.data.images.new("Preview", 8, 4)
    image.file_format, image.filepath_raw = "PNG", str(ball_file.with_name("ball.preview.png"))
    image.save()


def physics(ball_file):
    """Two objects of which one waits for the bake of the other."""
    imported(ball_file)
    bpy.context.active_object.drgs.physics.use = True
    other = bpy.context.active_object.copy()
    bpy.context.scene.collection.objects.link(other)
    select(other, bpy.context.active_object)
    part("addon.physics.bake_job").waiting.add(part("addon.export.export_cache").uid(bpy.context.active_object))


STATES = [empty, imported, unselected, damaged, bound, painted, others, elsewhere, reconstructing, physics]


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("engine", [True, False])
def test_every_panel_and_menu_is_drawn(scene, ball_file, state, engine, monkeypatch):
    monkeypatch.setattr(part("addon.reconstruction"), "job", None)
    monkeypatch.setattr(part("addon.physics.bake_job"), "waiting", set())
    state(ball_file)
    if not engine:
        monkeypatch.setenv("DRGS_ENGINE", "/nowhere")
    drawn: dict[str, list[str]] = {}
    for cls in drawables():
        if hasattr(cls, "poll") and not cls.poll(bpy.context):
            continue
        calls = drawn[cls.__name__] = []
        stand_in = SimpleNamespace(layout=Layout(calls), is_popover=False, bl_space_type="", **_own(cls))
        for name in ("draw_header", "draw_header_preset", "draw"):
            draw = cls.__dict__.get(name) or getattr(cls, name, None)
            if draw is not None and getattr(draw, "__module__", "").startswith(PACKAGE):
                draw(stand_in, bpy.context)
    if bpy.context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    assert "DRGS_PT_workflow" in drawn and len(drawn["DRGS_PT_workflow"]) > 10
    assert all(drawn[name] for name in ("DRGS_PT_messages", "DRGS_PT_engine"))


def _own(cls: type) -> dict[str, object]:
    """Methods and values of a class that its drawing may use."""
    names = (n for c in cls.__mro__ if c.__module__.startswith(PACKAGE) for n in vars(c))
    return {n: getattr(cls, n) for n in names if not n.startswith(("__", "draw", "poll", "bl_"))}


def test_the_bake_button_says_of_how_many_objects_and_what_is_waited_for(scene, ball_file, monkeypatch):
    physics(ball_file)
    bake_job = part("addon.physics.bake_job")
    before = SimpleNamespace(subject='Object "A"', progress=lambda: (0.5, "Frame 3 of 6"))
    monkeypatch.setattr(bake_job, "running", {-1: before})
    texts = []

    class Panel(Layout):
        def check(self, name, named):
            texts.append(named.get("text"))
            return super().check(name, named)

    draw = part("addon.panels.physics")._draw_bake
    draw(Panel([]), bpy.context)
    assert texts[1:] == ["Waits for the bakes before it", "", 'Object "A": Frame 3 of 6']
    bake_job.waiting.clear()
    texts.clear()
    draw(Panel([]), bpy.context)
    assert texts == [None, "Bake 2 Objects"]
    select(bpy.context.active_object)
    texts.clear()
    draw(Panel([]), bpy.context)
    assert texts == [None, "Bake"]
    # What a copy of a .blend plays of the first can be seen, and taken off.
    elsewhere = Path(bpy.path.abspath("//drgs_cache/another/ball"))
    part("addon.cache_playback").attach(bpy.context.active_object, elsewhere / "mesh.pc2", 1)
    texts.clear()
    draw(Panel([]), bpy.context)
    said = " ".join(text for text in texts if text)
    assert "Plays the frames of" in said and said.endswith("Bake") and texts[-2:] == ["Bake", ""]


def test_the_newest_problem_is_in_the_header_of_viewports(scene, monkeypatch):
    messages = part("addon.messages")
    monkeypatch.setattr(messages, "history", type(messages.history)(maxlen=3))
    monkeypatch.setattr(part("addon.preferences"), "read", lambda name, default: True)  # the sidebar is known
    (draw,) = (f for f in bpy.types.VIEW3D_HT_header.draw._draw_funcs if f.__module__.startswith(PACKAGE))
    told = []

    class Header(Layout):
        def check(self, name, named):
            super().check(name, named)
            told.append((named["text"], named["icon"]))

    for level, text in (("INFO", "Engine"), ("WARNING", "word " * 20), ("ERROR", "Gone"), ("INFO", "Engine")):
        messages.note(level, text)
        draw(SimpleNamespace(layout=Header([])), bpy.context)
    assert [icon for _, icon in told] == ["ERROR", "CANCEL", "CANCEL"] and told[1][0] == told[2][0] == "Gone"
    assert told[0][0].startswith("word word") and len(told[0][0]) <= 40


def test_what_every_redraw_says_again_is_printed_once(scene, monkeypatch, caplog):
    messages = part("addon.messages")
    monkeypatch.setattr(messages, "history", type(messages.history)(maxlen=3))
    for text in ("Gone", "Gone", "Back", "Gone"):
        messages.note("ERROR", text)
    assert [record.message for record in caplog.records] == ["Gone", "Back", "Gone"]


GROUPS = (
    ("addon.properties", "DrgsSceneSettings"),
    ("addon.view_layer_settings", "DrgsViewLayerSettings"),
    ("addon.properties", "DrgsObjectSettings"),
    ("addon.physics_settings", "DrgsPhysicsSettings"),
    ("addon.physics_settings", "DrgsPhysicsRegion"),
    ("addon.physics_settings", "DrgsPhysicsCollider"),
    ("addon.adjustment_settings", "DrgsAdjustmentSettings"),
    ("addon.submit", "DrgsSubmitSettings"),
)


@pytest.mark.parametrize(("module", "name"), GROUPS)
def test_labels_fit_beside_their_field_and_say_more_when_pointed_at(module, name):
    """Blender's panels give a label some 24 letters at their default width; a tooltip that repeats it says nothing."""
    properties = getattr(part(module), name).bl_rna.properties
    own = [p for p in properties if p.identifier not in ("rna_type", "name")]
    own = [p for p in own if not p.identifier.startswith("use_pass_")]  # whose texts are the engine's
    assert own
    assert not {p.name for p in own if len(p.name) > 24}
    silent = {
        p.identifier for p in own if p.type not in ("POINTER", "COLLECTION") and len(p.description) <= len(p.name)
    }
    assert not silent


def test_a_command_that_runs_is_shown_with_its_progress_and_ends_by_a_click(ball):
    running = part("addon.running")
    command = running.begin("Making cat.drgs")
    try:
        assert command.shown() == "Making cat.drgs, 0:00" and command.part is None
        drawn: list[str] = []
        panel = SimpleNamespace(layout=Layout(drawn))
        bpy.types.DRGS_PT_workflow.draw(panel, bpy.context)
        before = drawn.count("progress")
        command.follow(
            'x\nDRGS_PROGRESS part=0.250 phase="Preparing the engine"\nDRGS_PROGRESS part=0.5 phase="Preparing"\n'
        )
        assert (command.part, command.phase) == (0.5, "Preparing")
        drawn.clear()
        bpy.types.DRGS_PT_workflow.draw(panel, bpy.context)
        assert drawn.count("progress") == before + 1
        assert bpy.ops.drgs.cancel_command(index=0) == {"FINISHED"} and command.cancelled
        command.follow('DRGS_PROGRESS part=1.000 phase="Ready"\n')
        assert command.part is None
    finally:
        running.end(command)
    running.end(command)  # whoever ends it first
    assert running.commands == []
    with pytest.raises(RuntimeError, match="there is no such work any more"):
        bpy.ops.drgs.cancel_command(index=0)


def test_long_paths_break_after_folders():
    broken_paths = part("addon.panels.text_layout").broken_paths
    path, windows = "/home/artist/captures/statue/statue.drgs:", "C:\\Users\\artist\\captures\\statue.ply"
    for whole in (path, windows):
        lines = broken_paths(whole, 16).split()
        assert "".join(lines) == whole and max(map(len, lines)) <= 16
        assert all(line[-1] in "/\\" for line in lines[:-1])
    assert broken_paths("toy/a.ply is absent", 40) == "toy/a.ply is absent"
    assert broken_paths("n" * 40, 16) == "n" * 40


def test_the_header_says_where_the_sidebar_is_until_it_is_known(ball):
    """Nobody has to hunt for the tab; the first operator that succeeds ends it."""
    preferences = bpy.context.preferences.addons[PACKAGE].preferences
    header, drawn = part("addon.panels.header"), []
    shown = SimpleNamespace(layout=Layout(drawn))
    context = SimpleNamespace(scene=bpy.context.scene, space_data=None)
    preferences.knows_sidebar = False
    part("addon.messages").clear()
    header.draw(shown, context)
    assert drawn == ["operator"]
    assert bpy.ops.drgs.set_material(preset="GOLD") == {"FINISHED"}
    assert preferences.knows_sidebar
    drawn.clear()
    header.draw(shown, context)
    assert drawn == []
