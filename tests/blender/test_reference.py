"""The reference of operators and properties is whole, and everything in it is described."""

from __future__ import annotations

import re

import blender_reference
import bpy
import pytest
from bpy.props import BoolProperty, PointerProperty
from scenes import PACKAGE, part


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    return blender_reference.pages(PACKAGE)


def sections(page: str) -> dict[str, str]:
    """Headings of a page, without Markdown's backslashes, and what is below each."""
    parts = re.split(r"^## (.+)$", page, flags=re.MULTILINE)
    return {title.replace("\\", ""): text for title, text in zip(parts[1::2], parts[2::2])}


def rows(section: str) -> set[str]:
    """The properties that a table has with a description."""
    return set(re.findall(r"^\| `(\w+)` \|[^|]*\|[^|]*\| (?:\*[^*]+\*: )?[^ |].*\|$", section, re.MULTILINE))


def test_every_registered_operator_is_listed(pages):
    listed = sections(pages["operators.md"])
    assert {f"drgs.{name}" for name in dir(bpy.ops.drgs)} <= set(listed) and len(listed) > 40
    classes = [cls for module in part("operators").MODULES for cls in module.CLASSES]
    names = {cls.bl_idname for cls in classes if issubclass(cls, bpy.types.Operator)}
    assert set(listed) == names, "an operator outside of operators/ is listed, or one of them is not"
    for name, section in listed.items():
        assert f"bpy.ops.{name}(" in section and re.search(r"^\*.+\*: \S", section, re.MULTILINE), name


def test_every_argument_of_an_operator_is_listed(pages):
    listed = sections(pages["operators.md"])
    count = 0
    for name, section in listed.items():
        group, _, verb = name.partition(".")
        rna = getattr(getattr(bpy.ops, group), verb).get_rna_type()
        shown = {p.identifier for p in rna.properties if not p.is_hidden and p.is_runtime}
        assert shown <= rows(section), name
        count += len(shown)
    assert count > 50


def test_every_property_of_every_group_is_listed(pages):
    listed = sections(pages["properties.md"])
    physics, properties = part("addon.physics_settings"), part("addon.properties")
    groups = {
        "scene.drgs": properties.DrgsSceneSettings,
        "scene.drgs.submit": part("addon.submit").DrgsSubmitSettings,
        "view_layer.drgs": part("addon.view_layer_settings").DrgsViewLayerSettings,
        "object.drgs": properties.DrgsObjectSettings,
        "object.drgs.adjustment": part("addon.adjustment_settings").DrgsAdjustmentSettings,
        "object.drgs.physics": physics.DrgsPhysicsSettings,
        "object.drgs.physics.regions[i]": physics.DrgsPhysicsRegion,
        "object.drgs.physics.colliders[i]": physics.DrgsPhysicsCollider,
        f'preferences.addons["{PACKAGE}"].preferences': part("addon.panels.preferences").DrgsPreferences,
    }
    assert set(listed) == set(groups)
    for name, cls in groups.items():
        own = {n for base in cls.__mro__ for n in getattr(base, "__annotations__", {}) if n in cls.bl_rna.properties}
        assert own and own <= rows(listed[name]), name


def test_a_group_that_nobody_reaches_is_none():
    reached = {rna.identifier for rna in blender_reference.groups(PACKAGE).values()}
    own = {c.__name__ for c in bpy.types.PropertyGroup.__subclasses__() if c.__module__.startswith(PACKAGE)}
    assert own and own <= reached, "a property group of the extension is in no page"


def test_nothing_lacks_a_description():
    assert blender_reference.undescribed(PACKAGE) == []


def test_what_lacks_a_description_is_named():
    class Silent(bpy.types.PropertyGroup):
        __module__ = f"{PACKAGE}.silent"
        __annotations__ = {"said": BoolProperty(description="Something"), "unsaid": BoolProperty()}

    class DRGS_OT_silent(bpy.types.Operator):
        __module__ = f"{PACKAGE}.silent"
        bl_idname, bl_label = "drgs.silent", "Silent"
        __annotations__ = {"unsaid": BoolProperty()}

    for cls in (Silent, DRGS_OT_silent):
        bpy.utils.register_class(cls)
    bpy.types.WindowManager.silent = PointerProperty(type=Silent)
    try:
        expected = {"bpy.ops.drgs.silent", "bpy.ops.drgs.silent(unsaid)", "WindowManager.silent.unsaid"}
        assert set(blender_reference.undescribed(PACKAGE)) == expected
        with pytest.raises(blender_reference.ReferenceIncomplete, match=r"silent\.unsaid"):
            blender_reference.pages(PACKAGE)
    finally:
        del bpy.types.WindowManager.silent
        for cls in (DRGS_OT_silent, Silent):
            bpy.utils.unregister_class(cls)


@pytest.mark.parametrize(
    ("low", "high", "said"),
    [(0.0, 1.0, "0 to 1"), (3, 2**31 - 1, "from 3"), (-3.4e38, 3.4e38, ""), (-(2**31), 9, "to 9")],
)
def test_ranges(low, high, said):
    assert blender_reference.limits(low, high) == said
