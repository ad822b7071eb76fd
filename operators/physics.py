"""Simulate objects: show their particles, bake, cancel, delete the bake. The engine works in a process of its own."""

from __future__ import annotations

import time
from collections.abc import Iterable
from functools import partial

import bpy
from bpy.props import EnumProperty, IntProperty

from ..addon import assets, messages
from ..addon.export.export_cache import uid
from ..addon.physics import bake_job, cache_state, coupling, particle_display, settings_export
from . import selection
from .base import DrgsOperator

#: Seconds between two looks at what the engine does, and at most spent on one.
_TICK, _SHARE = 0.1, 0.05


NEEDS = "Make a DR-GS object the active one, and enable Physics > DR-GS Physics"


def _has_physics(obj: bpy.types.Object | None) -> bool:
    return obj is not None and assets.is_drgs(obj) and obj.drgs.physics.use


def _idle(cls: type[bpy.types.Operator], objects: Iterable[bpy.types.Object | None]) -> bool:
    """Poll of what needs objects with physics for which nothing is being done."""
    objects = list(objects)
    has = bool(objects) and all(map(_has_physics, objects))
    cls.poll_message_set("Wait for what is being done, or cancel it" if has else NEEDS)
    return has and not any(bake_job.of(obj) or bake_job.is_waiting(obj) for obj in objects)


class _JobOperator(DrgsOperator):
    """Runs a `bake_job.Job` for each of some objects, one after another.

    Step by step beside Blender's window, at once in background mode and without a window. Where one fails, that is
    reported, and the next begins.
    """

    _job: bake_job.Job
    _queue: list[int]
    _succeeded = False
    _timer: bpy.types.Timer | None = None

    @classmethod
    def objects(cls, context: bpy.types.Context) -> list[bpy.types.Object]:
        """The objects to simulate."""
        return [context.object]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return _idle(cls, cls.objects(context))

    def begin(self, obj: bpy.types.Object, scene: bpy.types.Scene) -> bake_job.Job:
        """The job for an object."""
        raise TypeError(f"{type(self).__name__} has no job")

    def done(self, context: bpy.types.Context) -> str:
        """The message when it is done."""
        return ""

    def stopped(self) -> set[str]:
        """End the job before its time; what the operator returns then."""
        self._job.close()
        return {"CANCELLED"}

    def ended(self) -> bool:
        """End the job, done or failed; whether the scene shows what there is of it, which is worth an undo step."""
        self._job.close()
        return False

    def run(self, context: bpy.types.Context) -> set[str]:
        self._queue = list(map(uid, self.objects(context)))
        bake_job.waiting.update(self._queue)
        try:
            if not self._next(context):
                return self._result()
        except Exception:
            self._abandon()
            raise
        if not bpy.app.background and context.window is not None:
            self._timer = context.window_manager.event_timer_add(_TICK, window=context.window)
            context.window_manager.modal_handler_add(self)
            return {"RUNNING_MODAL"}
        try:
            going = True
            while going:
                self.guard(self._run_blocking, context)
                going = self._next(context)
        finally:
            self.cancel(context)
        return self._result()

    def _run_blocking(self, context: bpy.types.Context) -> set[str]:
        """Run the present job, and wait for it."""
        try:
            while not self._job.step():
                time.sleep(_SHARE)
            return self._report_done(context)
        finally:
            self._job.close()

    def _next(self, context: bpy.types.Context) -> bool:
        """Begin with the next object for which that can be done; whether there is one."""
        while self._queue:
            key = self._queue.pop(0)
            if key not in bake_job.waiting:  # the artist thought better of it
                continue
            bake_job.waiting.discard(key)
            obj = bake_job.object_of(key)
            if obj is not None and self.guard(partial(self._begin_job, obj), context) == {"RUNNING_MODAL"}:
                return True
        return False

    def _begin_job(self, obj: bpy.types.Object, context: bpy.types.Context) -> set[str]:
        self._job = self.begin(obj, context.scene)
        return {"RUNNING_MODAL"}

    def _result(self) -> set[str]:
        return {"FINISHED"} if self._succeeded else {"CANCELLED"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if self._job.cancelled or (event.type == "ESC" and event.value == "PRESS"):
            self._abandon()
            self._release(context)
            return self.stopped()
        if event.type != "TIMER":
            return {"RUNNING_MODAL"} if self._job.capturing else {"PASS_THROUGH"}
        try:
            if self.guard(self._part, context) == {"PASS_THROUGH"}:
                return {"PASS_THROUGH"}
            self._succeeded |= self.ended()
            if self._next(context):
                return {"PASS_THROUGH"}
        except Exception:
            self.cancel(context)
            raise
        self._release(context)
        return self._result()

    def _part(self, context: bpy.types.Context) -> set[str]:
        """Go on with the present job for a moment."""
        try:
            if self._job.step(_SHARE):
                return self._report_done(context)
        except settings_export.Removed as removed:  # an error's window would swallow the artist's next keys
            self.warn(str(removed))
            return {"CANCELLED"}
        context.workspace.status_text_set(f"{self._job.subject}: {self._job.progress()[1]}. Esc cancels")
        _redraw(context, "PROPERTIES")
        return {"PASS_THROUGH"}

    def cancel(self, context: bpy.types.Context) -> None:
        """End the job, and those that were to follow; also called when its window closes, or another file is loaded."""
        self._abandon()
        if bake_job.running.get(self._job.key) is self._job:
            self.stopped()
        self._release(context)

    def _abandon(self) -> None:
        """Nothing is to follow."""
        bake_job.waiting.difference_update(self._queue)
        self._queue.clear()

    def _report_done(self, context: bpy.types.Context) -> set[str]:
        text = self.done(context)
        messages.note("INFO", text)
        self.report({"INFO"}, text)
        self._succeeded = True
        return {"FINISHED"}

    def _release(self, context: bpy.types.Context) -> None:
        if self._timer is not None:
            context.window_manager.event_timer_remove(self._timer)
            self._timer = None
            context.workspace.status_text_set(None)
        _redraw(context)


class DRGS_OT_bake_physics(_JobOperator, bpy.types.Operator):
    """Simulate all frames of the selected objects, and of those coupled with them, with the engine"""

    bl_idname = "drgs.bake_physics"
    bl_label = "Bake"
    bl_description = (
        "Simulate all frames of the selected objects with the engine, one object after another, the active one last; "
        "objects that are coupled together. "
        "Frames that are baked with these settings stay, others are replaced. Esc cancels, and the next bake goes on"
    )
    bl_options = {"UNDO"}  # noqa: RUF012 - read by Blender

    @classmethod
    def objects(cls, context: bpy.types.Context) -> list[bpy.types.Object]:
        return bake_job.chosen(context)

    def begin(self, obj: bpy.types.Object, scene: bpy.types.Scene) -> bake_job.Job:
        return bake_job.Bake(obj, scene)

    def stopped(self) -> set[str]:
        assert isinstance(self._job, bake_job.Bake), self._job
        kept = self._job.cancel()
        following = "Resume goes on" if kept else "Bake begins again"
        text = f"{self._job.subject}: stopped at {self._job.progress()[1].split(',')[0].lower()}; {following}"
        messages.note("INFO", text)
        self.report({"INFO"}, text)
        return {"FINISHED"} if kept or self._succeeded else {"CANCELLED"}

    def ended(self) -> bool:
        assert isinstance(self._job, bake_job.Bake), self._job
        return self._job.cancel()

    def done(self, context: bpy.types.Context) -> str:
        assert isinstance(self._job, bake_job.Bake), self._job
        folders = ", ".join(str(member.folder) for member in self._job.members)
        return f"{self._job.subject}: {self._job.frames} frames baked in {folders}"


class DRGS_OT_show_particles(_JobOperator, bpy.types.Operator):
    """Show the particles that fill the active object, and how long a bake takes at least"""

    bl_idname = "drgs.show_particles"
    bl_label = "Show Particles"
    bl_options: set[str] = set()  # noqa: RUF012 - read by Blender

    def begin(self, obj: bpy.types.Object, scene: bpy.types.Scene) -> bake_job.Job:
        return bake_job.Preview(obj, scene)

    def done(self, context: bpy.types.Context) -> str:
        assert isinstance(self._job, bake_job.Preview), self._job
        particles, steps = self._job.counts
        return f"{self._job.subject}: {particles:,} particles, at least {steps} time steps a frame"


class DRGS_OT_hide_particles(DrgsOperator, bpy.types.Operator):
    """Show the particles no more"""

    bl_idname = "drgs.hide_particles"
    bl_label = "Hide Particles"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("The active object shows no particles")
        return context.object is not None and particle_display.of(context.object) is not None

    def run(self, context: bpy.types.Context) -> set[str]:
        particle_display.hide(context.object)
        _redraw(context)
        return {"FINISHED"}


class DRGS_OT_cancel_physics(DrgsOperator, bpy.types.Operator):
    """Stop what is being done for this object, and what waits for that; Bake goes on later"""

    bl_idname = "drgs.cancel_physics"
    bl_label = "Cancel"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set("Nothing is being done for the active object")
        return bake_job.of(context.object) is not None or bake_job.is_waiting(context.object)

    def run(self, context: bpy.types.Context) -> set[str]:
        if bake_job.is_waiting(context.object):
            bake_job.waiting.discard(uid(context.object))
            return {"FINISHED"}
        job = bake_job.of(context.object)
        assert job is not None, "poll has looked"
        job.cancelled = True  # its own operator ends it
        return {"FINISHED"}


class DRGS_OT_free_physics(DrgsOperator, bpy.types.Operator):
    """Remove the active object's baked frames from the disk, and those of objects that are coupled with it; they are as
    they were before. Files cannot be brought back by undo"""

    bl_idname = "drgs.free_physics"
    bl_label = "Delete Bake"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 - read by Blender

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return _idle(cls, [context.object])

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_confirm(self, event)

    def run(self, context: bpy.types.Context) -> set[str]:
        selection.editable(coupling.members(context.object), vertices=False)
        for text in cache_state.free(context.object):
            self.warn(text)
        return {"FINISHED"}


class DRGS_OT_physics_row(DrgsOperator, bpy.types.Operator):
    """Add or remove a region or a collider"""

    bl_idname = "drgs.physics_row"
    bl_label = "Add or Remove"
    bl_options = {"REGISTER", "UNDO", "INTERNAL"}  # noqa: RUF012 - read by Blender

    rows: EnumProperty(
        name="Rows", description="Which list", items=(("regions", "Regions", ""), ("colliders", "Colliders", ""))
    )
    remove: IntProperty(name="Remove", description="Number of the row to remove; -1 adds one", default=-1, min=-1)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        cls.poll_message_set(NEEDS)
        return _has_physics(context.object)

    def run(self, context: bpy.types.Context) -> set[str]:
        selection.editable([context.object], vertices=False)
        rows = getattr(context.object.drgs.physics, self.rows)
        if self.remove < 0:
            rows.add()
        else:
            rows.remove(self.remove)
        return {"FINISHED"}


def _redraw(context: bpy.types.Context, *kinds: str) -> None:
    """Draw editors of these kinds again, by default those that show anything of simulations."""
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in (kinds or ("PROPERTIES", "VIEW_3D")):
                area.tag_redraw()


CLASSES = (
    DRGS_OT_bake_physics,
    DRGS_OT_show_particles,
    DRGS_OT_hide_particles,
    DRGS_OT_cancel_physics,
    DRGS_OT_free_physics,
    DRGS_OT_physics_row,
)
