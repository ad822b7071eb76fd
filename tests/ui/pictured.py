"""Which panels the pictures of the guide show: `docs/images/NAME.png` for each name here, by window_pictures.py.

Besides that takes guide-window, the whole window, for README.md.
"""

from __future__ import annotations

#: Pictures of panels, with their classes from top to bottom: in the sidebar, and in tabs of the Properties editor.
SIDEBAR = {
    "guide-sidebar": ("DRGS_PT_workflow",),
    "guide-object": ("DRGS_PT_object",),
    "guide-clean": ("DRGS_PT_clean",),
    "guide-messages": ("DRGS_PT_engine", "DRGS_PT_messages"),
}
TABS = {
    "guide-physics": ("PHYSICS", ("DRGS_PT_physics",)),
    "guide-physics-forces": ("PHYSICS", ("DRGS_PT_physics_regions", "DRGS_PT_physics_forces")),
    "guide-physics-bodies": (
        "PHYSICS",
        ("DRGS_PT_physics_colliders", "DRGS_PT_physics_coupling", "DRGS_PT_physics_cache"),
    ),
    "guide-adjustments": ("DATA", ("DRGS_PT_asset", "DRGS_PT_adjust_data")),
    "guide-rays": ("OBJECT", ("DRGS_PT_rays",)),
    "guide-world": ("WORLD", ("DRGS_PT_world_group",)),
    "guide-beam": ("DATA", ("DRGS_PT_beam",)),
    "guide-panorama": ("DATA", ("DRGS_PT_panorama",)),
    "guide-passes": ("VIEW_LAYER", ("DRGS_PT_passes",)),
    "guide-light-groups": ("VIEW_LAYER", ("DRGS_PT_aovs", "DRGS_PT_light_groups")),
    "guide-render": ("RENDER", ("DRGS_PT_sampling",)),
    "guide-surface": ("RENDER", ("DRGS_PT_light", "DRGS_PT_blur", "DRGS_PT_film")),
    "guide-bakes": ("RENDER", ("DRGS_PT_bakes",)),
    "guide-farm": ("RENDER", ("DRGS_PT_submit",)),
    "guide-compositing": ("RENDER", ("DRGS_PT_compositing",)),
}
#: Of these the ones that are higher than the editor: their panels are drawn smaller.
TALL = ("guide-adjustments", "guide-passes")
#: Pictures of what is no panel: of dialogs the fields beside the files.
OTHERS = {
    "guide-import": (),
    "guide-photographs": (),
    "guide-surfels": (),
    "guide-preferences": ("DrgsPreferences",),
}
#: What no picture shows, and why.
LEFT_OUT = {
    "DRGS_PT_presets": "opens from the header of Sampling: a list of names",
    "DRGS_PT_adjust": "the Adjustments of guide-adjustments, in the sidebar",
}
