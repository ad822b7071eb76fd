"""The list of kernels that jobs call, and their compiled forms for a release.

    .venv/bin/python tools/kernels.py record
    .venv/bin/python tools/kernels.py build [--target NAME ...] [--python INTERPRETER ...] [--out FOLDER]

`record` writes `drgs_blender/compute/kernels.json`: the kernels that each kind of job calls, found by doing the jobs.
To be run after a kernel that Python calls has got other arguments; a test says so. Takes some minutes: everything is
compiled again, in an empty cache, by one process at a time, to measure how long each kernel takes.

`build` compiles all of the list for fixed targets into `drgs_blender/compute/kernels` (docs/kernels.md).
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import kernel_archive

if TYPE_CHECKING:
    import numpy as np

    from drgs_blender.core.frame import ObjectState

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = ROOT / "examples"
MANIFEST = ROOT / "drgs_blender" / "compute" / "kernels.json"


def commands(folder: Path) -> Iterator[tuple[str, list[object]]]:
    """(job, command) of everything that is done; the same job may have several commands."""
    drgs = [sys.executable, "-m", "drgs_blender.cli.main"]
    asset, light = folder / "spot.drgs", EXAMPLES / "front.json"
    own = [sys.executable, Path(__file__).resolve(), "record", "--do"]
    yield "make", [*own, "environment", folder]
    yield "make", [*drgs, "make", EXAMPLES / "spot/spot_triangulated.obj", "--out", asset]
    yield "make", [*drgs, "make", EXAMPLES / "robot/RobotExpressive.glb", "--out", folder / "robot.drgs"]
    yield "import", [*drgs, "import", EXAMPLES / "playbot/playbot.ply", "--up=-y", "--out", folder / "playbot.drgs"]
    relight = [*drgs, "relight", asset, "--camera", folder / "camera.json", "--env", folder / "light.exr",
               "--samples", "4", "--out", folder / "frame.exr"]  # fmt: skip
    assert light.is_file()
    yield "frame", relight
    yield "hdr", [*relight[:8], folder / "light.hdr", *relight[9:]]
    yield "frame", [*own, "frame", folder]
    yield "mesh", [*relight, "--camera-sees", "mesh"]
    yield "lights", [*own, "lights", folder]
    yield "denoise", [*relight, "--denoise", "svgf"]
    yield "denoise", [*own, "denoise", folder]
    yield "mattes", [*own, "mattes", folder]
    yield "motion", [*own, "motion", folder]
    yield "viewport", [*own, "viewport", folder]
    yield "captured", [*drgs, "relight", folder / "playbot.drgs", "--captured", *relight[relight.index("--camera") :]]
    yield "surface passes", [*own, "surface passes", folder]
    yield "broken", [*own, "broken", folder]
    yield "panorama", [*own, "panorama", folder]
    yield "linked lights", [*own, "linked lights", folder]
    yield "light groups", [*own, "light groups", folder]
    for job in ("paths", "linked paths", "grouped paths", "lobe colours"):
        yield job, [*own, job, folder]
    yield "surfel rays", [*relight, "--rays-see", "surfels"]
    for solver in ("mpm", "xpbd", "rigid"):
        yield "simulate", [*drgs, "simulate", asset, "--solver", solver, "--resolution", "12", "--frames", "3",
                           "--floor", "-1", "--out", folder / f"bake-{solver}"]  # fmt: skip
        yield "simulate", [*drgs, "simulate", asset, "--solver", solver, "--settings", folder / "settings.json",
                           "--out", folder / f"bake-{solver}-all"]  # fmt: skip
    yield "coupled", [*drgs, "simulate", "--settings", folder / "bodies.json", "--out", folder / "bake-bodies"]
    yield "frame", [*relight[:-2], "--cache", folder / "bake-mpm", "--frames", "2", "--out", folder / "baked.exr"]
    for variant in ("p", "m"):
        yield "reconstruct", [*own, f"reconstruct-{variant}", folder]


def make_environment(folder: Path) -> None:
    """A small sky with a sun in two formats, the camera file, and settings of a simulation with all that may act."""
    import numpy as np

    from drgs_blender.formats.exr import write_exr_picture

    sky = np.full((32, 64, 3), 0.5, np.float32)
    sky[6, 20] = 200.0
    write_exr_picture(folder / "light.exr", sky)
    # Radiance's format, each row's channels one after the other, in runs of up to 128 bytes that differ
    channels = b"".join(bytes([64]) + bytes([128 + 8 * i] * 64) for i in range(4))
    header = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 32 +X 64\n"
    (folder / "light.hdr").write_bytes(header + 32 * (bytes([2, 2, 0, 64]) + channels))
    (folder / "ground.obj").write_text("v -2 -2 -1\nv 2 -2 -1\nv 0 2 -1\nf 1 2 3\n")
    pins, fields = [{"box": [[-1, -1, -1], [1, 1, -0.5]]}], [{"kind": "wind", "strength": 2.0, "flow": 1.0}]
    ground = {"mesh": str(folder / "ground.obj")}
    settings = {"resolution": 12, "last": 3, "colliders": [ground], "pins": pins, "fields": fields}
    settings["velocity"] = [9, 0, 0]  # particles leave their blocks within a frame
    (folder / "settings.json").write_text(json.dumps(settings))
    above = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]
    pile = {"asset": "spot.drgs", "name": "pile", "material": "sand", "pins": pins}
    bodies = [{"asset": "spot.drgs", "matrix_world": above, "pins": []}, pile]
    (folder / "bodies.json").write_text(json.dumps(settings | {"bodies": bodies}))
    camera = {"matrix_world": [[1, 0, 0, 0], [0, 0, -1, -3], [0, 1, 0, 0], [0, 0, 0, 1]], "width": 48, "height": 48}
    (folder / "camera.json").write_text(json.dumps(camera | {"fov_x": 40}))


def torn(body: ObjectState, lifted: float) -> ObjectState:
    """An object of which particles have lifted the upper half."""
    from dataclasses import replace

    import numpy as np

    from drgs_blender.core.asset.container import read_asset
    from drgs_blender.core.frame import Inside, Particles
    from drgs_blender.simulation.fill import fill

    mesh = read_asset(Path(body.asset)).mesh
    height = np.ptp(mesh.vertices[:, 2])
    filled = fill(mesh.vertices, mesh.faces, height / 12)
    spacing, rest = filled.space.spacing, np.ascontiguousarray(filled.points, np.float32)
    to_cells = np.eye(4)
    to_cells[:3, :3] /= spacing
    to_cells[:3, 3] = -filled.space.origin / spacing
    middle = mesh.vertices[:, 2].min() + height / 2

    def moved(places: np.ndarray) -> np.ndarray:
        up = np.where(places[:, 2:] > middle, [[0.0, 0.0, lifted * height]], 0.0)
        return np.asarray(places + up, np.float32)

    gradients = np.tile(np.eye(3, dtype=np.float32), (len(rest), 1, 1))
    particles = Particles(rest, moved(rest), gradients, cells=to_cells)
    return replace(
        body, vertices=moved(mesh.vertices), particles=particles, tear=2 * spacing, inside=Inside((0.0, 1.0, 0.0))
    )


def engine(folder: Path, what: str) -> None:
    """Frames as Blender sends them: to an engine process, arrays in shared memory."""
    from dataclasses import replace

    import numpy as np

    from drgs_blender.core.asset.container import read_asset
    from drgs_blender.core.frame import (  # fmt: skip
        Camera,
        Frame,
        Light,
        MeshState,
        MotionStep,
        ObjectState,
        Pose,
        RenderSettings,
        World,
    )
    from drgs_blender.core.materials import Material  # fmt: skip
    from drgs_blender.ipc.client import EngineClient, locate_engine

    matrix = np.array([[1, 0, 0, 0], [0, 0, -1, -3], [0, 1, 0, 0], [0, 0, 0, 1]], float)
    camera = Camera(matrix, 48, 48, 60.0, 60.0, 24.0, 24.0)
    mesh = read_asset(folder / "spot.drgs").mesh
    world = World(np.full((32, 64, 3), 0.5, np.float32))
    settings = RenderSettings(samples=4, subpixel_samples=1)
    with EngineClient(locate_engine()) as client:
        key = client.load_asset(str(folder / "spot.drgs"))
        body = ObjectState("cow", key, vertices=np.array(mesh.vertices, np.float32))
        frame = Frame(1, camera, [body], world, settings)
        if what == "frame":
            client.render(frame)
            client.render(
                replace(frame, objects=[ObjectState("cow", key)], settings=replace(settings, subpixel_samples=4))
            )
        elif what == "mattes":
            client.render(replace(frame, passes=("Combined", "CryptoObject00", "CryptoMaterial00")))
        elif what == "lights":
            place = np.eye(4)
            place[:3, 3] = 0, -1, 2
            lights = [Light(kind, kind, place) for kind in ("point", "sun", "spot", "area")]
            glowing = Material("glowing", emission=(1.0, 1.0, 1.0))
            floor = MeshState(
                "floor", np.array([[-2, -2, -1], [2, -2, -1], [2, 2, -1], [-2, 2, -1]], np.float32),
                np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.eye(4)[None], np.zeros(1, np.int32), materials=[glowing],
            )  # fmt: skip
            client.render(replace(frame, lights=lights, meshes=[floor]))
            client.render(replace(frame, lights=lights, meshes=[floor], settings=replace(settings, camera_sees="mesh")))
        elif what == "denoise":
            frame = replace(frame, settings=replace(settings, denoise="svgf"), history="shot")
            client.render(frame)
            client.render(replace(frame, noise_index=2))
        elif what == "motion":
            step = MotionStep(camera, [Pose("cow", matrix[None].copy(), body.vertices)])
            client.render(replace(frame, previous=step, next=step, passes=("Combined", "Vector")))
        elif what == "surface passes":
            names = ("DiffDir", "GlossDir", "Mist", "UV", "IndexMA")
            client.render(replace(frame, passes=names))
        elif what == "broken":
            for sees in ("surfels", "mesh"):
                for lifted in (0.05, 1.0):  # as whole as it was; then apart
                    client.render(
                        replace(frame, objects=[torn(body, lifted)], settings=replace(settings, camera_sees=sees))
                    )
        elif what == "panorama":
            around = replace(camera, panorama="fisheye", fov=3.0)
            client.render(replace(frame, camera=around, settings=replace(settings, film_transparent=True)))
        elif what == "linked lights":
            lit = [Light("lamp", "point", matrix, receivers=0, blockers=0)]
            client.render(replace(frame, lights=lit))
        elif what == "light groups":
            lit = [Light("lamp", "point", matrix, light_group="key")]
            client.render(replace(frame, lights=lit, passes=("Combined", "Combined_key")))
        elif what.endswith("paths") or what == "lobe colours":
            pane = MeshState(
                "pane", np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1]], np.float32), np.array([[0, 1, 2]], np.int32),
                np.eye(4)[None], np.zeros(1, np.int32), materials=[Material("glass", kind="glass")],
            )  # fmt: skip
            links = 0 if what == "linked paths" else -1
            lit = [Light("lamp", "point", matrix, light_group="key", receivers=links, blockers=links)]
            passes = {"grouped paths": ("Combined", "Combined_key"), "lobe colours": ("Combined", "DiffCol")}
            given = passes.get(what, ("Combined",))
            client.render(replace(frame, lights=lit, meshes=[pane], passes=given))
        elif what == "viewport":
            for denoise in ("none", "svgf"):
                seen = replace(frame, settings=replace(settings, denoise=denoise))
                client.view("view", seen)
                client.view("view", seen, go_on=True)
            turned = matrix.copy()
            turned[0, 3] = 0.1
            for place in (matrix, turned):
                client.view("view", replace(seen, camera=replace(camera, matrix_world=place), history="view"))


def reconstruct(variant: str) -> None:
    """The trial run that every reconstruction with a time budget begins with."""
    from drgs_blender.reconstruct.backend import CPU
    from drgs_blender.reconstruct.jit_warmup import warm_up
    from drgs_blender.reconstruct.pipeline import Settings

    for masked in (True, False):
        warm_up(Settings(variant=variant), masked, CPU, lambda: False)  # type: ignore[arg-type]


def do(what: str, folder: Path) -> None:
    """One of the commands of `commands` that no command of ``drgs`` does."""
    if what == "environment":
        make_environment(folder)
    elif what.startswith("reconstruct-"):
        reconstruct(what[-1])
    else:
        engine(folder, what)


def record(folder: Path, only: set[str]) -> dict[str, dict[tuple[str, str, str], float]]:
    """Do the jobs; job -> kernel -> seconds of compiling."""
    found: dict[str, dict[tuple[str, str, str], float]] = {}
    seconds: dict[tuple[str, str, str], float] = {}
    failed: list[str] = []
    for number, (job, command) in enumerate(commands(folder)):
        if only and job not in only and "environment" not in command and "make" not in command:
            continue
        print(job, *(str(part).replace(str(folder), "") for part in command[1:]), flush=True)
        path = folder / f"kernels-{number}.jsonl"
        environment = os.environ | {
            "DRGS_RECORD_KERNELS": str(path), "DRGS_CACHE_DIR": str(folder / "cache"), "DRGS_PREPARE": "0",
            "DRGS_ENGINE": sys.executable,
        }  # fmt: skip
        code = subprocess.run(list(map(str, command)), timeout=1800, env=environment, cwd=ROOT).returncode
        if code:
            failed.append(job)
        for line in path.read_text().splitlines() if path.exists() else ():
            *kernel, took = json.loads(line)
            key = tuple(kernel)
            seconds[key] = max(seconds.get(key, 0.0), took)
            if kernel[2] is None:
                print(f"  not kept, its types have no name: {kernel[0]}:{kernel[1]}")
            else:
                found.setdefault(job, {})[key] = 0.0
    if failed:
        print(f"incomplete, these jobs failed: {', '.join(failed)}", file=sys.stderr)
    return {job: {key: seconds[key] for key in keys} for job, keys in found.items()}


def write(found: dict[str, dict[tuple[str, str, str], float]], path: Path) -> None:
    """The manifest: kernels in alphabetical order, one line each, and for each job their numbers."""
    kernels = sorted({key for keys in found.values() for key in keys})
    seconds = {key: took for keys in found.values() for key, took in keys.items()}
    rows = ",\n".join("  " + json.dumps([*key, seconds[key]]) for key in kernels)
    jobs = ",\n".join(f"  {json.dumps(job)}: {sorted(map(kernels.index, keys))}" for job, keys in sorted(found.items()))
    path.write_text(f'{{"kernels": [\n{rows}\n],\n"jobs": {{\n{jobs}\n}}}}\n', encoding="utf-8")


def run_record(options: argparse.Namespace) -> int:
    """Write the list."""
    if options.do:
        do(options.do[0], Path(options.do[1]))
        return 0
    with tempfile.TemporaryDirectory() as folder:
        write(record(Path(folder), set(options.only)), options.out)
    print(options.out)
    return 0


def run_build(options: argparse.Namespace) -> int:
    """Write archives of compiled kernels."""
    for path in kernel_archive.build(options.target, options.python, options.out, options.only):
        print(f"{path}, {path.stat().st_size / 1e6:.1f} MB")
    return 0


def main() -> int:
    """The command line; the return value is the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    verbs = parser.add_subparsers(required=True, metavar="VERB")
    verb = verbs.add_parser("record", help="write the list of kernels")
    verb.set_defaults(run=run_record)
    verb.add_argument("--out", type=Path, default=MANIFEST)
    verb.add_argument("--only", nargs="*", default=[], metavar="JOB", help="these jobs alone, to look at")
    verb.add_argument("--do", nargs=2, help=argparse.SUPPRESS)
    verb = verbs.add_parser("build", help="compile the list for a release")
    verb.set_defaults(run=run_build)
    verb.add_argument("--target", nargs="+", default=[], metavar="NAME", help="all of this machine's architecture")
    verb.add_argument("--python", nargs="+", default=[sys.executable], help="interpreters with the engine's packages")
    verb.add_argument("--out", type=Path, default=kernel_archive.FOLDER, help="folder of the archives")
    verb.add_argument("--only", nargs="+", default=[], metavar="JOB", help="the kernels of these jobs alone")
    options = parser.parse_args()
    try:
        return int(options.run(options))
    except kernel_archive.BuildError as error:
        print(f"kernels.py: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
