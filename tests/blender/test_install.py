"""The zip installs, what is registered works, nothing is left behind."""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import bpy
import extension
import pytest
from bl_ui.utils import PresetPanel
from scenes import PACKAGE, ROOT, part

pytestmark = pytest.mark.blender_api


def test_extension_is_enabled_from_the_zip():
    assert PACKAGE in bpy.context.preferences.addons
    assert Path(part("addon").__file__).is_relative_to(bpy.utils.user_resource("EXTENSIONS"))
    assert bpy.types.RenderEngine.bl_rna_get_subclass_py("DRGS") is not None


def test_manifest_has_no_fault_and_faults_are_found():
    manifest = tomllib.loads((ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))
    version = extension.project_version()
    assert extension.faults(manifest, version) == []
    broken = {"tagline": "Too long " * 9, "version": "9.9.9", "tags": ["Surfels"], "platforms": ["amiga"], "id": "a-b"}
    for key, value in broken.items():
        assert any(key.rstrip("s") in fault for fault in extension.faults(manifest | {key: value}, version)), key
    assert extension.faults({}, version)


def test_zip_is_reproducible_and_equals_what_blenders_builder_takes(tmp_path):
    first, second = extension.build(tmp_path / "1.zip"), extension.build(tmp_path / "2.zip")
    assert first.read_bytes() == second.read_bytes()
    with zipfile.ZipFile(first) as archive:
        ours = set(archive.namelist())
    assert {"__init__.py", "blender_manifest.toml", "LICENSE", "addon/__init__.py"} <= ours
    assert not any(name.startswith(("tests/", "bench/", "docs/", ".")) for name in ours)
    builders = list(Path(bpy.utils.resource_path("LOCAL")).glob("scripts/addons_core/bl_pkg/cli/blender_ext.py"))
    builder = builders[0]
    # A copy of what is tracked: Blender's builder would also walk through environments of a working folder.
    source = tmp_path / "source"
    for name in ours:
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).write_bytes((ROOT / name).read_bytes())
    for stray in ("tests/test_x.py", "docs/a.md", ".git/config", "drgs_blender/__pycache__/a.pyc", "Makefile"):
        (source / stray).parent.mkdir(parents=True, exist_ok=True)
        (source / stray).write_text("")
    command = [sys.executable, str(builder), "build", "--source-dir", str(source), "--output-dir", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
    (built,) = tmp_path.glob("drgs-*.zip")
    with zipfile.ZipFile(built) as archive:
        assert {n for n in archive.namelist() if not n.endswith("/")} == ours


def test_the_index_is_that_of_blenders_own_repositories(tmp_path):
    archive = extension.build(tmp_path / "drgs.zip")
    ours = json.loads(extension.write_index([archive]).read_text(encoding="utf-8"))
    (tmp_path / "index.json").unlink()
    (builder,) = Path(bpy.utils.resource_path("LOCAL")).glob("scripts/addons_core/bl_pkg/cli/blender_ext.py")
    command = [sys.executable, str(builder), "server-generate", "--repo-dir", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
    theirs = json.loads((tmp_path / "index.json").read_text(encoding="utf-8"))
    theirs.pop("assetlib_auth_method", None)  # of asset libraries, from Blender 5.3 on
    assert ours == theirs


def test_no_absolute_import_of_the_engine_package():
    assert not [name for name in sys.modules if name.split(".")[0] == "drgs_blender"]


ICONS = set(bpy.types.UILayout.bl_rna.functions["prop"].parameters["icon"].enum_items.keys())


class Layout:
    """Stands in for UILayout: takes the calls that panels make and checks what they name."""

    def row(self, **_):
        return Layout()

    column = box = grid_flow = row

    def prop(self, data, name, icon="NONE", **_):
        assert name in data.bl_rna.properties, f"{data} has no property {name}"
        assert icon in ICONS

    def menu(self, name, icon="NONE", **_):
        assert hasattr(bpy.types, name) and icon in ICONS

    def popover(self, panel, icon="NONE", **_):
        self.menu(panel, icon)

    def progress(self, text="", factor=0.0):
        assert text and 0 <= factor <= 1

    template_ID = prop

    def prop_search(self, data, name, among, names, **_):
        self.prop(data, name)
        self.prop(among, names)

    def separator(self, **_):
        pass

    def template_list(self, kind, _, among, names, current, index, **__):
        assert hasattr(bpy.types, kind)
        self.prop(among, names)
        self.prop(current, index)

    def operator(self, name, icon="NONE", **_):
        group, verb = name.split(".")
        known = getattr(getattr(bpy.ops, group), verb).get_rna_type()
        assert known.name and icon in ICONS
        return Choices(known)

    def operator_menu_enum(self, name, prop, icon="NONE", **_):
        assert self.operator(name, icon).known.properties[prop].enum_items

    def label(self, text="", icon="NONE"):
        assert isinstance(text, str) and icon in ICONS


class Choices:
    """Stands in for the properties of a button's operator."""

    def __init__(self, known):
        self.__dict__["known"] = known

    def __setattr__(self, name, value):
        assert name in self.known.properties, name


@pytest.mark.parametrize("loaded", [False, True])
def test_every_panel_draws_and_every_poll_answers(scene, ball_file, loaded):
    if loaded:
        bpy.ops.import_scene.drgs(filepath=str(ball_file))
        part("addon.messages").note("WARNING", "a rather long message " * 6)
        physics = bpy.context.object.drgs.physics
        physics.use = physics.use_floor = True
        for rows in ("regions", "colliders"):
            bpy.ops.drgs.physics_row(rows=rows)
    classes = part("addon.panels").CLASSES
    assert len(classes) >= 8
    drawn = 0
    for cls in classes:
        if getattr(cls, "poll", lambda _: True)(bpy.context):
            stand_in = type("StandIn", (), {"layout": Layout(), "bl_rna": cls.bl_rna})()
            if issubclass(cls, PresetPanel):  # Blender draws its list of files
                assert {Path(f).stem for p in bpy.utils.preset_paths(cls.preset_subdir) for f in Path(p).iterdir()}
            else:
                cls.draw(stand_in, bpy.context)
            drawn += 1
    assert drawn >= (13 if loaded else 7)
    for module in part("operators").MODULES:
        for cls in module.CLASSES:
            if hasattr(cls, "bl_idname") and "." in cls.bl_idname:
                group, name = cls.bl_idname.split(".")
                assert getattr(getattr(bpy.ops, group), name).poll() in (True, False)


@pytest.mark.parametrize("kind", ["POINT", "AREA"])
def test_panels_of_a_light_draw(scene, kind):
    obj = bpy.data.objects.new("Light", bpy.data.lights.new("Light", kind))
    facts = {"engine": "DRGS", "object": obj, "light": obj.data, "world": bpy.data.worlds.new("World")}
    facts["view_layer"] = bpy.context.view_layer
    context = type("Context", (), facts)
    rays = part("addon.panels.ray_visibility")
    for cls in rays.CLASSES:
        assert cls.poll(context)
        cls.draw(type("StandIn", (), {"layout": Layout()})(), context)
    context.engine = "CYCLES"
    assert not any(cls.poll(context) for cls in rays.CLASSES)


def test_blenders_own_panels_are_shared_and_given_back(scene):
    shared = [p for p in bpy.types.Panel.__subclasses__() if "DRGS" in getattr(p, "COMPAT_ENGINES", ())]
    assert {"RENDER_PT_format", "RENDER_PT_output"} <= {p.__name__ for p in shared}
    panels = part("addon.render_engine.panels")
    assert {p.__name__ for p in shared} >= panels.INCLUDED, "nodes of materials and worlds, quantities of lights"
    panels.withdraw_panels()
    try:
        assert not [p for p in bpy.types.Panel.__subclasses__() if "DRGS" in getattr(p, "COMPAT_ENGINES", ())]
    finally:
        panels.share_panels()


def test_disable_and_enable_again(scene):
    bpy.ops.preferences.addon_disable(module=PACKAGE)
    assert not hasattr(bpy.types.Scene, "drgs")
    assert not [h for h in bpy.app.handlers.load_post if h.__module__.startswith(PACKAGE)]
    bpy.ops.preferences.addon_enable(module=PACKAGE)
    assert scene.drgs.samples == 64
