"""The passes that are switched on in a view layer, and their names in Blender; `core.passes` is the engine's table."""

from __future__ import annotations

import bpy

from ..drgs_blender.core.passes import AOV_COLOUR, AOV_VALUE, LIGHT_GROUP, PASSES, TEMPORAL, Pass, pass_of
from .view_layer_settings import switch_of

#: Names that Blender 5.0 spelled out; compositor nodes and its EXR files know only these.
_FULL_NAMES = {
    "IndexOB": "Object Index",
    "DiffDir": "Diffuse Direct",
    "DiffInd": "Diffuse Indirect",
    "GlossDir": "Glossy Direct",
    "GlossInd": "Glossy Indirect",
    "DiffCol": "Diffuse Color",
    "GlossCol": "Glossy Color",
    "TransDir": "Transmission Direct",
    "TransInd": "Transmission Indirect",
    "TransCol": "Transmission Color",
    "IndexMA": "Material Index",
    "Env": "Environment",
    "Emit": "Emission",
}

#: Blender's other passes, by the properties of view layers that switch them on.
_NOT_RENDERED = {
    "use_pass_shadow": "Shadow",
    "use_pass_ambient_occlusion": "Ambient Occlusion",
    **{f"use_pass_subsurface_{part}": f"Subsurface {part.title()}" for part in ("direct", "indirect", "color")},
    **{f"use_pass_volume_{part}": f"Volume {part.title()}" for part in ("direct", "indirect")},
    "use_pass_shadow_catcher": "Shadow Catcher",
    "use_pass_cryptomatte_asset": "Cryptomatte Asset",
}


def not_rendered(view_layer: bpy.types.ViewLayer) -> list[str]:
    """Names of passes that are switched on in a view layer, for other engines, and that DR-GS does not make."""
    owners = [view_layer, *filter(None, (getattr(view_layer, name, None) for name in ("cycles", "eevee")))]
    found = [text for name, text in _NOT_RENDERED.items() if any(getattr(owner, name, False) for owner in owners)]
    taken = {blender_name(p) for p in PASSES}
    return found + [
        f'Shader AOV "{aov.name}" (the name is taken; choose another)'
        for aov in view_layer.aovs
        if not _is_usable(aov, taken)
    ]


def _is_usable(aov: bpy.types.AOV, taken: set[str]) -> bool:
    """Whether a shader AOV has a name of its own, unlike those of other passes (`taken`)."""
    return aov.is_valid and aov.name not in taken and not aov.name.startswith(LIGHT_GROUP)


def named(view_layer: bpy.types.ViewLayer) -> list[Pass]:
    """The passes that a view layer names itself: shader AOVs and light groups."""
    taken = {blender_name(p) for p in PASSES}
    starts = {"COLOR": AOV_COLOUR, "VALUE": AOV_VALUE}
    names = [starts[aov.type] + aov.name for aov in view_layer.aovs if _is_usable(aov, taken)]
    names += [LIGHT_GROUP + group.name for group in view_layer.lightgroups]
    return [p for name in names if (p := pass_of(name)) is not None]


def label(render_pass: Pass) -> str:
    """Full name, for the interface."""
    return _FULL_NAMES.get(render_pass.name, render_pass.layer)


def blender_name(render_pass: Pass) -> str:
    """Name of a pass in this Blender."""
    return label(render_pass) if bpy.app.version >= (5, 0, 0) else render_pass.layer


def enabled(scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer) -> list[Pass]:
    """The passes switched on in a view layer of a scene; Combined always, as Blender always has it."""
    extra = view_layer.drgs
    needed = TEMPORAL if scene.drgs.use_denoising_data else ()
    return [
        p
        for p in PASSES
        if p.name == "Combined"
        or p.name in needed
        or (getattr(view_layer, p.blender, False) if p.blender else getattr(extra, switch_of(p)))
    ] + named(view_layer)
