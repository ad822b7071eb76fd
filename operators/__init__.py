"""One module an artist's verb."""

from __future__ import annotations

import bpy

from . import bind, engine, import_asset, import_parts

MODULES = (import_asset, import_parts, bind, engine)


def _file_import(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    menu.layout.operator("import_scene.drgs", text="DR-GS asset (.drgs)")
    menu.layout.operator("drgs.import_parts", text="DR-GS from surfels and mesh")


def register() -> None:
    for module in MODULES:
        for cls in module.CLASSES:
            bpy.utils.register_class(cls)
    bpy.types.TOPBAR_MT_file_import.append(_file_import)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_import.remove(_file_import)
    for module in reversed(MODULES):
        for cls in reversed(module.CLASSES):
            bpy.utils.unregister_class(cls)
