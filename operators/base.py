"""What all operators share: errors reach the artist, in the interface and in the message panel."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import bpy

from ..addon import messages, preferences
from ..drgs_blender.core.errors import DrgsError, UsageError, WriteError

#: Class of an operator -> the errors it has told that may still hold.
_errors: dict[str, set[str]] = {}


class DrgsOperator:
    """Base of operators that do their work in `run` and may raise DrgsError there."""

    # Of Blender's Operator, which subclasses have as a base beside this, and their own.
    if TYPE_CHECKING:
        bl_label: str
        filepath: str
        report: Callable[[set[str], str], None]

    def run(self, context: bpy.types.Context) -> set[str]:
        """The work; returns what execute returns."""
        return {"FINISHED"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        return self.guard(self.run, context)

    def guard(self, work: Callable[[bpy.types.Context], set[str]], context: bpy.types.Context) -> set[str]:
        """Do `work`, and report its errors; once it succeeds, those of before hold no longer, but of other objects."""
        chosen = {obj.name for obj in context.selected_objects or ()}
        try:
            result = work(context)
            if "FINISHED" in result:
                if not preferences.read("knows_sidebar", True):
                    preferences.write("knows_sidebar", True)
                for text in list(_errors.get(type(self).__name__, ())):
                    if messages.named_in(text, bpy.data.objects) in ("", *chosen):
                        messages.withdraw("ERROR", text)
                        _errors[type(self).__name__].discard(text)
            return result
        except DrgsError as error:
            return self.fail(error)
        except OSError as error:  # files, folders and disks that go away, refuse or have impossible names
            subject = str(error.filename or self.bl_label)
            problem = f"cannot be used ({error.strerror or error})"
            return self.fail(WriteError(subject, problem, "Check that it exists, its permissions and the free space"))

    def chosen(self, subject: str) -> str:
        """The operator's file; UsageError about `subject` where none is given."""
        if not self.filepath:
            raise UsageError(subject, "no file is given", "Choose one")
        return self.filepath

    def fail(self, error: DrgsError) -> set[str]:
        """Report an error; from a script it is raised as RuntimeError."""
        messages.note("ERROR", str(error))
        _errors.setdefault(type(self).__name__, set()).add(str(error))
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
