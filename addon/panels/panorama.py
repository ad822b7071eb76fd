"""Camera properties: the panorama of a camera, which Blender's own panel shows for Cycles alone."""

from __future__ import annotations

import bpy

from ..export.camera import PANORAMAS, lens_of

#: Properties by panorama type, with their labels.
_OF_TYPE: dict[str, tuple[tuple[str, str], ...]] = {
    "EQUIRECTANGULAR": (
        *(("latitude_min", "Latitude Min"), ("latitude_max", "Max")),
        *(("longitude_min", "Longitude Min"), ("longitude_max", "Max")),
    ),
    "FISHEYE_EQUIDISTANT": (("fisheye_fov", "Field of View"),),
    "FISHEYE_EQUISOLID": (("fisheye_lens", "Lens"), ("fisheye_fov", "Field of View")),
    "FISHEYE_LENS_POLYNOMIAL": (
        ("fisheye_fov", "Field of View"),
        *((f"fisheye_polynomial_k{i}", f"K{i}") for i in range(5)),
    ),
}


class DRGS_PT_panorama(bpy.types.Panel):
    bl_label = "Panorama"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "data"
    bl_parent_id = "DATA_PT_lens"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        camera = getattr(context, "camera", None)
        return context.engine == "DRGS" and camera is not None and camera.type == "PANO"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        lens = lens_of(context.camera)
        if lens is None:
            layout.label(text="Enable Cycles, which has the settings", icon="ERROR")
            return
        layout.prop(lens, "panorama_type", text="Type")
        if lens.panorama_type not in PANORAMAS:
            layout.label(text="DR-GS has no rays for this type", icon="ERROR")
        column = layout.column(align=True)
        for name, text in _OF_TYPE.get(lens.panorama_type, ()):
            column.prop(lens, name, text=text)


CLASSES = (DRGS_PT_panorama,)
