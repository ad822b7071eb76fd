"""Runs inside Blender for ``drgs render``: evaluates frames and sends their descriptions to the waiting parent.

Started as a plain script, so nothing is imported from this package before the extension is enabled. What Blender
prints goes to stderr; stdin and the original stdout become a link of ipc.protocol, on which this side plays the
client: LoadAsset for every asset, Render for every frame and view layer, Failed when something is wrong.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import os
import shutil
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

READY = b"DRGS-BLENDER-READY\n"
ENGINE = "DRGS_BATCH"
ALIVE_SECONDS = 5.0


def main() -> None:
    """Do the job that the parent describes in one line of JSON."""
    reader, writer = private_streams()
    job = json.loads(read_line(reader))
    try:
        do(job, reader, writer)
    finally:
        shutil.rmtree(job["folder"], ignore_errors=True)  # the parent made it, and may have been killed


def do(job: dict[str, Any], reader: io.FileIO, writer: io.FileIO) -> None:
    """Greet the parent and render the frames of `job`; what goes wrong is sent to the parent."""
    package = enable_extension(job["repository"])
    protocol = importlib.import_module(f"{package}.drgs_blender.ipc.protocol")
    errors = importlib.import_module(f"{package}.drgs_blender.core.errors")
    version = importlib.import_module(f"{package}.drgs_blender.core.version").__version__
    link = protocol.Link(reader, writer)
    link.send(protocol.Hello(protocol.PROTOCOL, version, os.getpid()))
    threading.Thread(target=send_heartbeats, args=(link, protocol), daemon=True).start()
    try:
        exporter = Exporter(link, package, job["passes"])
        if job.get("alembic"):
            export_alembic(exporter, package, job)
        else:
            render_frames(exporter, job)
        link.send(protocol.Shutdown())
    except errors.DrgsError as error:
        link.send(protocol.Failed(0, type(error).__name__, error.subject, error.problem, error.remedy))
    except ParentExited:
        return
    except Exception as error:
        # Reported to the parent, which ends the job; the traceback is in Blender's output (-v).
        traceback.print_exc()
        link.send(protocol.Failed(0, "DrgsError", "Blender", f"{type(error).__name__}: {error}", ""))


class ParentExited(Exception):
    """The parent has ended: its end of the link is closed."""


def send_heartbeats(link: Any, protocol: Any) -> None:
    """Send a heartbeat every few seconds: it goes on during a long evaluation, and ends when Blender hangs."""
    with contextlib.suppress(OSError):
        while True:
            time.sleep(ALIVE_SECONDS)
            link.send(protocol.Progress(0, "evaluating", 0.0))


def private_streams() -> tuple[io.FileIO, io.FileIO]:
    """Take stdin and stdout for the link and point file descriptor 1, where Blender prints, at stderr."""
    sys.stdout.flush()
    writer = io.FileIO(os.dup(1), "w")
    os.dup2(2, 1)
    writer.write(b"\n" + READY)
    return io.FileIO(os.dup(0), "r"), writer


def read_line(reader: io.FileIO) -> bytes:
    """One line, unbuffered: what follows it belongs to the link."""
    line = bytearray()
    while not line.endswith(b"\n"):
        byte = reader.read(1)
        if not byte:
            raise EOFError("the parent is gone")
        line += byte
    return bytes(line)


def enable_extension(repository: str | None) -> str:
    """Enable DR-GS and return its package: from a local repository folder when given, else the installed one."""
    import bpy

    import addon_utils  # isort: skip  # the module bpy must be there first to find it

    installed = [m.__name__ for m in addon_utils.modules() if m.__name__.split(".")[-1] == "drgs"]
    if repository:
        for name in installed:
            addon_utils.disable(name)
        bpy.context.preferences.extensions.repos.new(name="drgs_job", module="drgs_job", custom_directory=repository)
        addon_utils.extensions_refresh(ensure_wheels=False)
        installed = ["bl_ext.drgs_job.drgs"]
    if not installed:
        raise RuntimeError("the extension DR-GS is not installed in this Blender")
    if addon_utils.enable(installed[0]) is None:
        raise RuntimeError(f"the extension {installed[0]} cannot be enabled; Blender's output says why")
    return installed[0]


class Exporter:
    """Sends evaluated frames over the link and waits until the parent has dealt with each."""

    def __init__(self, link: Any, package: str, passes: list[str] | None) -> None:
        self.link, self.passes = link, tuple(passes) if passes else None
        self.protocol = importlib.import_module(f"{package}.drgs_blender.ipc.protocol")
        self.errors = importlib.import_module(f"{package}.drgs_blender.core.errors")
        self.export = importlib.import_module(f"{package}.addon.export").export_baked
        self.blur = importlib.import_module(f"{package}.addon.render_engine.blur")
        self.steps = importlib.import_module(f"{package}.addon.export.blur_steps").steps
        self.encode_frame = importlib.import_module(f"{package}.drgs_blender.ipc.codec").encode_frame
        self.sent = importlib.import_module(f"{package}.drgs_blender.ipc.slots").SentSlots()
        self.keys: dict[Path, str] = {}
        self.requests = 0
        self.error: Exception | None = None
        self.baking = ""

    def key_of(self, path: Path) -> str:
        """The parent's key of the asset at `path`."""
        if path not in self.keys:
            self.requests += 1
            self.keys[path] = self.request(self.protocol.LoadAsset(self.requests, str(path))).key
        return self.keys[path]

    def request(self, message: Any, arrays: dict[str, Any] | None = None) -> Any:
        """Send a request and return the answer; ParentExited when the parent has ended."""
        try:
            self.link.send(message, arrays)
        except OSError as error:
            raise ParentExited from error
        answer = self.link.receive()
        if answer is None:
            raise ParentExited
        return answer[0]

    def more(self) -> list[int]:
        """Further frames from the parent, none when it has no more."""
        answer = self.request(self.protocol.Render(0, {}, {}))
        return answer.frame["frames"] if isinstance(answer, self.protocol.Render) else []

    def send(self, depsgraph: Any, frame_set: Any) -> None:
        """Describe the evaluated view layer; `frame_set` evaluates it at another time.

        Of a blurred one the pictures follow, which are averaged, as often as the parent asks for them.
        """
        warnings: list[str] = []

        def warn(text: str) -> None:
            if text not in warnings:
                warnings.append(text)

        def export(moments: bool) -> Any:
            set_moments = frame_set if moments else None
            passes = self.passes
            return self.export(depsgraph, self.key_of, warn, self.report, frame_set=set_moments, passes=passes)

        frame = export(True)
        scene = depsgraph.scene_eval
        steps = self.steps(scene, depsgraph.view_layer_eval, scene.camera.evaluated_get(depsgraph), warn)
        layers = [layer for layer in depsgraph.scene.view_layers if layer.use]
        about = {
            "number": depsgraph.scene.frame_current,
            "layer": depsgraph.view_layer.name if len(layers) > 1 else "",
            "pictures": len(steps),
        }
        while isinstance(self.submit(frame, about, warnings), self.protocol.Render):
            for picture in self.blur.pictures(frame, steps, depsgraph, lambda: export(False), frame_set):
                self.submit(picture, {}, warnings)

    def report(self, text: str, part: float) -> None:
        """Show in Blender's output what is being baked; `send_heartbeats` keeps the parent waiting."""
        if text != self.baking:
            self.baking = text
            sys.stderr.write(f"{text}\n")

    def submit(self, frame: Any, about: dict[str, Any], warnings: list[str]) -> Any:
        """Send a frame with its number, layer and count of pictures, `about`; return the answer."""
        described, arrays = self.encode_frame(frame)
        slots, changed = self.sent.changes(arrays)
        self.requests += 1
        return self.request(
            self.protocol.Render(self.requests, about | {"warnings": warnings, "frame": described}, slots), changed
        )


def outside_files() -> list[tuple[str, str]]:
    """External files of the open .blend, as stored and as found here; without the brushes of its tools."""
    import bpy

    stored = bpy.utils.blend_paths(absolute=False, packed=False, local=False)
    found = bpy.utils.blend_paths(absolute=True, packed=False, local=False)
    brushes = f"{os.sep}{os.path.join('datafiles', 'assets', 'brushes')}{os.sep}"  # Blender's own, on every node
    return sorted({pair for pair in (*zip(stored, found), *_caches()) if brushes not in pair[1]})


def _caches() -> Iterator[tuple[str, str]]:
    """What Mesh Cache modifiers play, which Blender does not name; of simulated matter also what it was made of."""
    import bpy

    for obj in bpy.data.objects:
        for modifier in obj.modifiers:
            if modifier.type == "MESH_CACHE" and modifier.filepath:
                stored, found = modifier.filepath, bpy.path.abspath(modifier.filepath, library=obj.library)
                yield stored, found
                if modifier.name.startswith("DR-GS Physics"):
                    cut = len(os.path.basename(stored.replace("\\", "/")))
                    yield stored[:-cut] + "cache.json", os.path.join(os.path.dirname(found), "cache.json")


def differences(scene: Any) -> list[str]:
    """Settings of the file that a batch render ignores."""
    import bpy

    notes = []
    if bpy.data.version[:2] > bpy.app.version[:2]:
        saved, here = (".".join(map(str, version[:2])) for version in (bpy.data.version, bpy.app.version))
        notes.append(f"The file was saved by Blender {saved}, this is Blender {here}")
    if bpy.app.autoexec_fail:
        notes.append(f"The file has scripts that do not run without --enable-scripts ({bpy.app.autoexec_fail_message})")
    if bpy.app.version >= (5, 0, 0):
        composited, strips = scene.compositing_node_group is not None, "strips_all"
    else:
        composited, strips = scene.use_nodes and scene.node_tree is not None, "sequences_all"
    if scene.render.use_compositing and composited:
        notes.append("The compositor is not run; give it the finished frames")
    if scene.render.use_sequencer and scene.sequence_editor and len(getattr(scene.sequence_editor, strips)):
        notes.append("The sequencer is not run; give it the finished frames")
    return notes


def open_scene(exporter: Exporter, job: dict[str, Any]) -> None:
    """Open the file of `job`."""
    import bpy

    try:
        bpy.ops.wm.open_mainfile(filepath=job["scene"], load_ui=False, use_scripts=job["scripts"])
    except RuntimeError as error:
        reason = str(error).strip().removeprefix("Error: ")
        raise exporter.errors.AssetError(job["scene"], f"cannot be opened ({reason})", "Check the file") from error


def export_alembic(exporter: Exporter, package: str, job: dict[str, Any]) -> None:
    """Let Blender write the DR-GS objects of `job` as Alembic."""
    import bpy

    open_scene(exporter, job)
    given = job["alembic"]
    write = importlib.import_module(f"{package}.addon.alembic").write_alembic
    names = write(bpy.context, Path(given["path"]), job["frames"], given["objects"], given["scale"])
    exporter.request(exporter.protocol.Render(0, {"objects": names}, {}))


def render_frames(exporter: Exporter, job: dict[str, Any]) -> None:
    """Evaluate every frame as a final render does: render visibility, render levels, handlers, each view layer."""
    import bpy

    class BatchEngine(bpy.types.RenderEngine):
        """Hands the evaluated scene on; the picture is made and written elsewhere."""

        bl_idname = ENGINE
        bl_label = "DR-GS batch"
        bl_use_postprocess = False

        def render(self, depsgraph: Any) -> None:
            try:
                if exporter.error is None:
                    exporter.send(depsgraph, self.evaluate)
            except Exception as error:
                # Blender prints and forgets what is raised here; it is raised again below.
                exporter.error = error

        def evaluate(self, frame: int, subframe: float) -> None:
            self.frame_set(frame, subframe=subframe)

    open_scene(exporter, job)
    bpy.utils.register_class(BatchEngine)
    try:
        scene = bpy.context.scene
        if job.get("report"):
            about = {
                "files": outside_files(),
                "notes": differences(scene),
                "fps": scene.render.fps / scene.render.fps_base,
            }
            exporter.request(exporter.protocol.Render(0, about, {}))
        if not any(layer.use for layer in scene.view_layers):  # Blender would crash
            problem, remedy = "has no view layer that is rendered", "Switch on Use for Rendering of one"
            raise exporter.errors.UsageError(f'scene "{scene.name}"', problem, remedy)
        if job.get("surfaces") and scene.camera is None:  # Blender renders nothing without one
            scene.camera = bpy.data.objects.new("DR-GS", bpy.data.cameras.new("DR-GS"))
            scene.collection.objects.link(scene.camera)
        scene.render.engine = ENGINE
        scene.render.use_compositing = scene.render.use_sequencer = False
        scene.render.use_persistent_data = True
        frames = job["frames"]
        while frames:
            if min(frames) < 0:
                bpy.context.preferences.edit.use_negative_frames = True  # else Blender stops at 0
            for number in frames:
                scene.frame_current = number
                if scene.frame_current != number:
                    problem = f"cannot be reached, Blender goes to {scene.frame_current}"
                    raise exporter.errors.UsageError(f"frame {number}", problem, "Choose other frames")
                try:
                    bpy.ops.render.render()
                except RuntimeError as error:
                    problem = f"is refused by Blender ({str(error).strip().removeprefix('Error: ')})"
                    remedy = "Check its resolution, render region and camera"
                    raise exporter.errors.UsageError(f'scene "{scene.name}"', problem, remedy) from error
                if exporter.error:
                    raise exporter.error
            frames = exporter.more() if job.get("keep") else []
    finally:
        bpy.utils.unregister_class(BatchEngine)


if __name__ == "__main__":
    try:
        main()
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(70)
    # Nothing is left to save, and the exit of some Blender versions hangs or crashes after a render.
    sys.stderr.flush()
    os._exit(0)
