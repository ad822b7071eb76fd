"""Operators of the extension: one module per group of operators."""

from __future__ import annotations

import bpy

from . import (
    bake,
    bakes,
    bind_armature,
    bind_cage,
    bind_lattice,
    bind_rig,
    capture_cameras,
    clean,
    compositing,
    convert,
    drive_from,
    engine,
    engine_setup,
    export,
    import_asset,
    import_parts,
    light,
    mark_assets,
    marker_sheet,
    mask_selection,
    material,
    physics,
    point_caches,
    presets,
    proxy,
    reconstruct,
    report,
    save_asset,
    save_shape,
    splats,
    submit,
    swap_mesh,
    workflow,
)

MODULES = (
    import_asset,
    import_parts,
    reconstruct,
    capture_cameras,
    marker_sheet,
    export,
    convert,
    splats,
    mark_assets,
    bind_rig,
    bind_armature,
    bind_lattice,
    bind_cage,
    drive_from,
    proxy,
    point_caches,
    physics,
    workflow,
    light,
    material,
    mask_selection,
    clean,
    save_asset,
    save_shape,
    swap_mesh,
    bake,
    bakes,
    compositing,
    presets,
    submit,
    report,
    engine,
    engine_setup,
)


def _file_import(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    menu.layout.operator("import_scene.drgs", text="DR-GS asset (.drgs)")
    menu.layout.operator("drgs.import_parts", text="DR-GS asset from splats and mesh")
    menu.layout.operator("drgs.reconstruct", text="DR-GS asset from photographs")
    menu.layout.operator("drgs.import_cameras", text="Cameras of photographs")
    menu.layout.operator("drgs.print_markers", text="Marker sheet to take photographs on (PDF)")


def _file_export(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    menu.layout.operator("drgs.export", text="DR-GS as splats, mesh or light")


def _object_convert(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    menu.layout.separator()
    menu.layout.operator("drgs.convert", text="DR-GS")
    menu.layout.operator("drgs.splats", text="Splats from DR-GS")


#: Where our operators stand in Blender's own menus.
_MENUS = (
    (bpy.types.TOPBAR_MT_file_import, _file_import),
    (bpy.types.TOPBAR_MT_file_export, _file_export),
    (bpy.types.VIEW3D_MT_object_convert, _object_convert),
)


def register() -> None:
    for module in MODULES:
        for cls in module.CLASSES:
            bpy.utils.register_class(cls)
    for menu, draw in _MENUS:
        menu.append(draw)


def unregister() -> None:
    for menu, draw in _MENUS:
        menu.remove(draw)
    for module in reversed(MODULES):
        for cls in reversed(module.CLASSES):
            bpy.utils.unregister_class(cls)
