"""What all operators share: errors reach the artist, in the interface and in the message panel."""

from __future__ import annotations

import bpy

from ..addon import messages
from ..drgs_blender.errors import DrgsError, UsageError


class DrgsOperator:
    """Base of operators that do their work in `run` and may raise DrgsError there."""

    def run(self, context: bpy.types.Context) -> set[str]:
        """The work; returns what execute returns."""
        return {"FINISHED"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            return self.run(context)
        except DrgsError as error:
            return self.fail(error)

    def chosen(self, subject: str) -> str:
        """The operator's file; UsageError about `subject` where none is given."""
        if not self.filepath:
            raise UsageError(subject, "no file is given", "Choose one")
        return self.filepath

    def fail(self, error: DrgsError) -> set[str]:
        """Report an error; from a script it is raised as RuntimeError."""
        messages.note("ERROR", str(error))
        self.report({"ERROR"}, str(error))
        return {"CANCELLED"}

    def warn(self, text: str) -> None:
        """Report something that went otherwise than expected."""
        messages.note("WARNING", text)
        self.report({"WARNING"}, text)


class DropTarget:
    """Base of file handlers: where files may be dropped."""

    areas: tuple[str, ...] = ("VIEW_3D", "OUTLINER")

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return context.area is not None and context.area.type in cls.areas
