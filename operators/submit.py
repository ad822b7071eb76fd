"""Write a job for a farm manager, and copy the command that submits it."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..addon import submit
from ..drgs_blender.core.errors import UsageError
from .base import DrgsOperator


class DRGS_OT_submit(DrgsOperator, bpy.types.Operator):
    """Write a job for the farm from the saved file. Nothing is sent: the command that submits it is shown"""

    bl_idname = "drgs.submit"
    bl_label = "Write Job"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        problem = ""
        if submit.running():
            problem = "A job is being written"
        elif not bpy.data.filepath:
            problem = "Save the file first: nodes open it from the disk"
        elif bpy.data.is_dirty and not bpy.app.background:  # without a window Blender does not keep that up to date
            problem = "Save the file: nodes would not see the changes"
        if problem:
            cls.poll_message_set(problem)
        return not problem

    def run(self, context: bpy.types.Context) -> set[str]:
        if not Path(bpy.data.filepath).is_file():
            raise UsageError(bpy.data.filepath, "is not there any more", "Save the file again")
        job = submit.start(context.scene)
        if job.done and job.error:
            self.report({"ERROR"}, job.error)
            return {"CANCELLED"}
        if job.done:  # without a window no panel shows it
            self.report({"INFO"}, f"{job.text}. Submit with")
            self.report({"INFO"}, job.command)
        return {"FINISHED"}


class DRGS_OT_submit_cancel(DrgsOperator, bpy.types.Operator):
    """Stop writing the job"""

    bl_idname = "drgs.submit_cancel"
    bl_label = "Cancel"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("No job is being written")
        return submit.running()

    def run(self, context: bpy.types.Context) -> set[str]:
        assert submit.job is not None, "poll has looked"
        submit.job.cancel()
        return {"FINISHED"}


class DRGS_OT_copy_submit(DrgsOperator, bpy.types.Operator):
    """Copy the command that submits the job to the clipboard"""

    bl_idname = "drgs.copy_submit"
    bl_label = "Copy Command"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if submit.job is None or not submit.job.command:
            cls.poll_message_set("Write a job first")
            return False
        return True

    def run(self, context: bpy.types.Context) -> set[str]:
        assert submit.job is not None, "poll has looked"
        context.window_manager.clipboard = submit.job.command
        return {"FINISHED"}


CLASSES = (DRGS_OT_submit, DRGS_OT_submit_cancel, DRGS_OT_copy_submit)
