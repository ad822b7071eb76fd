"""Start, test and stop the engine; clear the message panel."""

from __future__ import annotations

import time

import bpy
from bpy.props import IntProperty

from ..addon import engine_link, messages, running
from ..drgs_blender.core.errors import UsageError
from .base import DrgsOperator


class DRGS_OT_engine_test(DrgsOperator, bpy.types.Operator):
    """Start the engine if it does not run, and talk to it"""

    bl_idname = "drgs.engine_test"
    bl_label = "Test Engine"

    def run(self, context: bpy.types.Context) -> set[str]:
        begin = time.perf_counter()
        client = engine_link.client()
        client.start()
        text = f"The engine answers (process {client.pid}, {time.perf_counter() - begin:.1f} s): {client.command[0]}"
        messages.note("INFO", text)
        self.report({"INFO"}, text)
        return {"FINISHED"}


class DRGS_OT_engine_stop(DrgsOperator, bpy.types.Operator):
    """End the engine process and free its memory; the next render starts it again"""

    bl_idname = "drgs.engine_stop"
    bl_label = "Stop Engine"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("The engine does not run")
        return engine_link.is_running()

    def run(self, context: bpy.types.Context) -> set[str]:
        engine_link.stop()
        messages.note("INFO", "Engine stopped")
        return {"FINISHED"}


class DRGS_OT_clear_messages(DrgsOperator, bpy.types.Operator):
    """Empty the list of messages"""

    bl_idname = "drgs.clear_messages"
    bl_label = "Clear"

    def run(self, context: bpy.types.Context) -> set[str]:
        messages.clear()
        return {"FINISHED"}


class DRGS_OT_cancel_command(DrgsOperator, bpy.types.Operator):
    """End this work; what it has not finished is removed"""

    bl_idname = "drgs.cancel_command"
    bl_label = "Cancel"
    bl_options = {"INTERNAL"}  # noqa: RUF012 - read by Blender

    index: IntProperty(name="Number", description="Which of those that run", min=0, options={"SKIP_SAVE"})

    def run(self, context: bpy.types.Context) -> set[str]:
        if self.index >= len(running.commands):
            raise UsageError("Cancel", "there is no such work any more", "It has ended")
        running.commands[self.index].cancelled = True
        return {"FINISHED"}


CLASSES = (DRGS_OT_engine_test, DRGS_OT_engine_stop, DRGS_OT_clear_messages, DRGS_OT_cancel_command)
