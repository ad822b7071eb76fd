"""A marker sheet as PDF, to stand an object on while it is photographed."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, StringProperty

from ..addon import blend_paths, engine_link, messages
from .base import DrgsOperator
from .engine_setup import without_capture

_PAPERS = (
    ("a4", "A4", "210 x 297 mm"),
    ("letter", "Letter", "8.5 x 11 inches"),
    ("a3", "A3", "297 x 420 mm, for larger objects"),
)


class DRGS_OT_print_markers(DrgsOperator, bpy.types.Operator):
    """Write a PDF of markers to stand an object on. Photographs that show them have cameras, true size and ground"""

    bl_idname = "drgs.print_markers"
    bl_label = "Print Marker Sheet"

    filepath: StringProperty(
        name="File",
        description="The PDF to write. Print it at 100 %",
        subtype="FILE_PATH",
        options={"SKIP_SAVE", *blend_paths.RELATIVE},
    )
    check_existing: BoolProperty(default=True, options={"HIDDEN"})
    filter_glob: StringProperty(default="*.pdf", options={"HIDDEN"})
    paper: EnumProperty(name="Paper", description="Size of the paper; each has markers of its own", items=_PAPERS)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self.filepath = self.filepath or "marker-sheet.pdf"
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def run(self, context: bpy.types.Context) -> set[str]:
        path = Path(bpy.path.ensure_ext(bpy.path.abspath(self.chosen("Marker sheet")), ".pdf")).absolute()
        if engine_link.lacks_capture():
            raise without_capture(str(path), "is of use for photographs without cameras")
        text = engine_link.output_of(["markers", str(path), "--paper", self.paper]).strip()
        messages.note("INFO", text)
        self.report({"INFO"}, text)
        return {"FINISHED"}


CLASSES = (DRGS_OT_print_markers,)
