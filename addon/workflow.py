"""The workflow: steps from a file to a picture, which are done, and which is next."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import bpy

from . import assets, carrier_nodes, engine_link, setup_job, world_setup

ENGINE = "DRGS"
#: Modifiers that follow another object, in the order in which an artist thinks of them.
BENDS = ("ARMATURE", "LATTICE", "SURFACE_DEFORM")


class Step(NamedTuple):
    """One step of the workflow.

    Attributes
    ----------
    key : name in code
    label : name for people
    done : whether it needs nothing more
    needed : whether there is no picture without it
    text : the state of the step, and the next action
    """

    key: str
    label: str
    done: bool
    needed: bool
    text: str


def steps(context: bpy.types.Context) -> list[Step]:
    """All steps in their order. Reads no file but the engine's stamp, so panels may call it as they draw."""
    return list(_steps(context))


def next_step(found: list[Step]) -> Step | None:
    """What to do now: the first step without which there is no picture, else the first that is not done."""
    open_ones = [s for s in found if not s.done]
    return next((s for s in open_ones if s.needed), open_ones[0] if open_ones else None)


def target(context: bpy.types.Context) -> bpy.types.Object | None:
    """The DR-GS object that the workflow is about: the active one or what that bends, else the first of the scene."""
    active = context.object
    if assets.is_drgs(active):
        return active
    found = [o for o in context.scene.objects if assets.is_drgs(o)]
    return next((o for o in found if active is not None and poser_of(o) == active), found[0] if found else None)


def poser_of(obj: bpy.types.Object) -> bpy.types.Object | None:
    """The object that deforms a DR-GS object: armature, lattice or cage, in this order."""
    moved_by = {m.type: m.target if m.type == "SURFACE_DEFORM" else m.object for m in obj.modifiers if m.type in BENDS}
    carriers = (*(moved_by.get(kind) for kind in BENDS), *map(carrier_nodes.carrier_of, obj.modifiers))
    return next((found for found in carriers if found is not None), None)


def _steps(context: bpy.types.Context) -> Iterator[Step]:
    scene, obj = context.scene, target(context)
    problem = engine_link.problem()
    if setup_job.running():
        problem = "Is being set up"
    yield Step("engine", "Engine", not problem, True, problem)
    count = sum(assets.is_drgs(o) for o in scene.objects)
    text = f"{count} object{'s' * (count != 1)}" if count else "Drop files on the viewport, or press Import"
    yield Step("import", "Import", bool(count), True, text)
    yield _bind(obj)
    yield _pose(obj)
    lit = world_setup.shines(scene.world) or any(o.type == "LIGHT" and not o.hide_render for o in scene.objects)
    dark = scene.world is None
    text = "Nothing lights the scene" if dark else "Only the plain colour of the World; choose an image, or add lights"
    yield Step("light", "Light", lit, dark, "" if lit else text)
    space = context.space_data
    shading = space.shading.type if space is not None and space.type == "VIEW_3D" else ""
    chosen = scene.render.engine == ENGINE
    seen = (chosen and shading == "RENDERED") or scene.drgs.overlay == "LIT"
    text = "" if seen else "See the result here while you work"
    yield Step("view", "View", not text, not chosen, text)
    text = "" if scene.camera is not None else "The scene has no camera"
    yield Step("render", "Render", False, bool(text), text or "F12. Choose the quality first")


def _bind(obj: bpy.types.Object | None) -> Step:
    """Whether something can bend the object."""
    if obj is None:
        return Step("bind", "Bind", False, False, "")
    if not len(obj.data.vertices):
        return Step("bind", "Bind", True, False, "Has no mesh; a proxy bends it")
    poser = poser_of(obj)
    if poser is not None:
        return Step("bind", "Bind", True, False, f"Follows {poser.name}")
    if obj.data.shape_keys is not None or len(obj.modifiers):
        return Step("bind", "Bind", True, False, "Has shape keys or modifiers")
    return Step(
        "bind",
        "Bind",
        False,
        False,
        "Select its rigged mesh, an armature or a cage too. Lattice and Cage also make new ones",
    )


def _pose(obj: bpy.types.Object | None) -> Step:
    """Whether something moves."""
    if obj is None:
        return Step("pose", "Pose", False, False, "")
    poser = poser_of(obj)
    moving = [d for d in (obj, poser, obj.data.shape_keys, poser and poser.data) if d is not None]
    if any(d.animation_data is not None and d.animation_data.action is not None for d in moving):
        return Step("pose", "Pose", True, False, "Has keyframes")
    return Step("pose", "Pose", False, False, "Move it and press I for a keyframe" if poser else "")
