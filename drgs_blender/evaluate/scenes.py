"""Scenes with known truth, rendered by Cycles: what no published set has is the same object relit *and* deformed.

An object's folder is a NeRF-synthetic capture (``transforms_train.json``, ``transforms_test.json``, RGBA pictures),
which any program can read, and beside it everything else that is known, listed in ``truth.json`` (see truth.py).
Pictures that are there already are not rendered again.
"""

from __future__ import annotations

import io
import json
import logging
import subprocess
import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..core.asset import Environment
from ..core.asset.archive import replace_file
from ..core.color import LUMINANCE, linear_to_srgb
from ..core.errors import AssetError, DeviceError, EngineError, UsageError
from ..formats.exr import write_exr_environment
from ..formats.images import write_png
from ..formats.registry import read_environment
from ..render.film.frame_files import write_frame
from .subjects import OBJECTS, make_subject

Array = np.ndarray
logger = logging.getLogger(__name__)
#: Called with the number of pictures done, the number of all, and the name of the newest.
Progress = Callable[[int, int, str], None]

#: Horizontal and vertical field of view, radians, and distance of the cameras from the unit sphere's centre.
ANGLE, DISTANCE = 0.6911112, 3.2
#: Environments are scaled to this mean radiance and to at most this height.
MEAN_RADIANCE, LIGHT_HEIGHT = 0.35, 256
#: Light of the training views, and those the test views are relit with; of Blender's own studio lights.
LIGHTS = ("courtyard", "city", "studio", "sunset")
POSED = "bend"
#: Begins the lines that Blender's side says; Blender itself prints, too.
_WORD = "DRGS-SCENE"


@dataclass(frozen=True, slots=True)
class Plan:
    """Settings of the scenes to be made.

    Attributes
    ----------
    objects : tuple of str
        Of `subjects.OBJECTS`.
    size : int
        Pixels of a side.
    train, test : int
        Views.
    samples : int
        Of a pixel, before denoising.
    lights : tuple of str
        The first one lights the training views; names of Blender's studio lights, or files.
    bounces : int
        Of light.
    """

    objects: tuple[str, ...] = OBJECTS
    size: int = 256
    train: int = 120
    test: int = 16
    samples: int = 64
    lights: tuple[str, ...] = LIGHTS
    bounces: int = 4


#: A try: a minute on two cores.
SMALL = Plan(("spot",), 128, 32, 3, 16, LIGHTS[:2], 2)


@dataclass(frozen=True, slots=True)
class _Set:
    """Pictures of one light and pose."""

    name: str
    light: str
    posed: bool
    matrices: list[Array]
    maps: bool


def make_scenes(
    out: Path, plan: Plan, command: list[str], meshes: Path, progress: Progress | None = None, threads: int = 0
) -> list[Path]:
    """Render what is missing of the scenes of `plan`; returns the objects' folders.

    Parameters
    ----------
    out : Path
        Folder, made when it is not there.
    plan : Plan
    command : list of str
        Starts a Blender that runs scene_job.py.
    meshes : Path
        Folder of the example meshes.
    progress : callable, optional
    threads : int
        Of Cycles; 0 is all.

    Raises
    ------
    UsageError
        The folder holds scenes of another plan; an object or a light is unknown.
    EngineError
        Blender ended before it was done; what is there stays, and the next call goes on.
    """
    for name in plan.objects:
        if name not in OBJECTS:
            raise UsageError(f"object {name}", "is not known", f"Choose from {', '.join(OBJECTS)}")
    _check_plan(out / "plan.json", plan)
    lights = _write_lights(out / "lights", plan, command)
    replace_file(out / "plan.json", [_settings(plan).encode()])
    folders = [out / name for name in plan.objects]
    everything = [(folder, _sets(plan, lights)) for folder in folders]
    total = sum(len(item.matrices) for _, sets in everything for item in sets)
    done = 0
    for folder, sets in everything:
        for name in _render(folder, sets, plan, lights, command, meshes, threads):
            done += 1
            if progress is not None:
                progress(done, total, name)
        _write_manifest(folder, sets, plan, lights)
    return folders


def _check_plan(file: Path, plan: Plan) -> None:
    """Find that there is no plan yet, or that it is this one."""
    if file.exists() and file.read_text(encoding="utf-8") != _settings(plan):
        problem = "holds scenes made with other settings"
        raise UsageError(str(file.parent), problem, f"Choose another folder, or the settings in {file}")


def _settings(plan: Plan) -> str:
    """What pictures of one folder have in common."""
    return json.dumps({**asdict(plan), "objects": None}, indent=1)


def cameras(count: int, lowest: float, highest: float, turn: float) -> list[Array]:
    """Camera-to-world matrices spread evenly around the unit sphere, level, looking at its centre.

    Parameters
    ----------
    count : int
    lowest, highest : float
        Degrees of elevation.
    turn : float
        Radians about Z, by which test views differ from training views.
    """
    low, high = np.sin(np.radians([lowest, highest]))
    matrices = []
    for k in range(count):
        z = low + (high - low) * (k + 0.5) / count
        angle = turn + k * np.pi * (3 - np.sqrt(5))  # a Fibonacci lattice
        back = np.array([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z])
        right = np.cross([0, 0, 1.0], back)
        right /= np.linalg.norm(right)
        matrix = np.eye(4)
        matrix[:3] = np.column_stack([right, np.cross(back, right), back, DISTANCE * back])
        matrices.append(matrix)
    return matrices


def _sets(plan: Plan, lights: dict[str, Path]) -> list[_Set]:
    """All pictures of an object: training, test, relit; test and relit once more, posed."""
    first, *others = lights
    train, test = cameras(plan.train, -25, 80, 0.0), cameras(plan.test, 0, 60, 1.0)
    return [
        _Set("train", first, False, train, False),
        _Set("test", first, False, test, True),
        *(_Set(f"relit-{light}", light, False, test, False) for light in others),
        _Set("posed", first, True, test, True),
        *(_Set(f"posed-{light}", light, True, test, False) for light in others),
    ]


def _write_lights(folder: Path, plan: Plan, command: list[str]) -> dict[str, Path]:
    """Name -> lat-long EXR of each light, scaled to one mean radiance, small enough to be searched quickly."""
    wanted = {Path(light).stem: light for light in plan.lights}
    if len(wanted) != len(plan.lights):
        raise UsageError("--lights", "names a light twice", "Name different lights")
    files = {name: folder / f"{name}.exr" for name in wanted}
    if all(file.exists() for file in files.values()):
        return files
    inside: dict[str, str] = {}
    if any(not Path(light).suffix for light in plan.lights):
        inside = next(json.loads(words) for word, words in _converse(command, {}) if word == "lights")
    folder.mkdir(parents=True, exist_ok=True)
    for name, light in wanted.items():
        source = light if Path(light).suffix else inside.get(light)
        if source is None:
            raise UsageError(f"light {light}", "is none of Blender's own", f"Choose from {', '.join(sorted(inside))}")
        radiance = read_environment(source).radiance
        step = -(-radiance.shape[0] // LIGHT_HEIGHT)
        height, width = radiance.shape[0] // step, radiance.shape[1] // step
        radiance = radiance[: height * step, : width * step].reshape(height, step, width, step, 3).mean(axis=(1, 3))
        area = np.sin((np.arange(height) + 0.5) / height * np.pi)
        mean = np.average((radiance @ np.array(LUMINANCE)).mean(axis=1), weights=area)
        write_exr_environment(files[name], Environment(radiance * (MEAN_RADIANCE / max(mean, 1e-9))))
    return files


def _converse(command: list[str], job: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Run Blender with a job; yields (word, rest) of what it says."""
    pipe = subprocess.PIPE
    try:
        started = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, encoding="utf-8")
    except OSError as error:
        raise DeviceError(
            f"Blender at {command[0]}", f"does not start ({error})", "Name another by --blender"
        ) from error
    with started as process:
        assert process.stdin is not None and process.stdout is not None and process.stderr is not None
        words = _Listener(process.stderr)
        try:
            process.stdin.write(json.dumps({**job, "word": _WORD}) + "\n")
            process.stdin.close()
            for line in process.stdout:
                if line.startswith(_WORD):
                    _, word, rest = line.split(maxsplit=2)
                    yield word, rest.strip()
        except BrokenPipeError:
            logger.debug("Blender closed its input")  # its exit code says the rest
        except BaseException:
            process.kill()
            raise
        if process.wait():
            problem = f"ended before the scenes were done: {words.last()}"
            raise EngineError("Blender", problem, "Run the command again: it goes on where it stopped")


class _Listener:
    """Keeps the last lines of a stream, which would otherwise fill its pipe."""

    def __init__(self, stream: Any) -> None:
        self._words: deque[str] = deque(maxlen=20)
        self._thread = threading.Thread(target=lambda: self._words.extend(stream), daemon=True)
        self._thread.start()

    def last(self) -> str:
        """The last line that says something."""
        self._thread.join(2)
        return next((line.strip() for line in reversed(self._words) if line.strip()), "it said nothing")


def _render(
    folder: Path, sets: list[_Set], plan: Plan, lights: dict[str, Path], command: list[str], meshes: Path, threads: int
) -> Iterator[str]:
    """Render an object's missing pictures; yields the name of each picture that is there."""
    folder.mkdir(parents=True, exist_ok=True)
    mesh, posed = folder / "mesh.npz", folder / f"{POSED}.npy"
    if not mesh.exists():
        _write_mesh(mesh, make_subject(folder.name, meshes))
    renders: list[dict[str, Any]] = []
    waiting: list[tuple[_Set, str]] = []
    for item in sets:
        (folder / item.name).mkdir(exist_ok=True)
        for k, matrix in enumerate(item.matrices):
            name = f"{item.name}/r_{k:03d}"
            wanted = [folder / f"{name}.png", *([folder / f"{name}.exr"] if item.maps else [])]
            if all(file.exists() for file in wanted):
                yield name
                continue
            raw = folder / f"raw-{len(waiting)}.exr"
            renders.append(
                {
                    "index": len(waiting),
                    "out": str(raw.resolve()),
                    "matrix": matrix.tolist(),
                    "light": str(lights[item.light].resolve()),
                    "posed": item.posed,
                }
            )
            waiting.append((item, name))
    if not renders and posed.exists():
        return
    job = {
        "mesh": str(mesh.resolve()),
        "posed": str(posed.resolve()),
        "renders": renders,
        "size": plan.size,
        "samples": plan.samples,
        "bounces": plan.bounces,
        "angle": ANGLE,
        "threads": threads,
    }
    for word, rest in _converse(command, job):
        if word == "done":
            item, name = waiting[int(rest)]
            raw = Path(renders[int(rest)]["out"])
            _develop(raw, folder / name, item.maps)
            raw.unlink()
            yield name


def _write_mesh(path: Path, arrays: dict[str, Array]) -> None:
    data = io.BytesIO()
    np.savez_compressed(data, **arrays)  # type: ignore[arg-type]
    replace_file(path, [data.getvalue()])


def read_layers(path: Path) -> dict[str, Array]:
    """Layer -> (h, w, c) float32 of one of Blender's multi-layer files; layers by their own names, "Combined" first.

    Raises
    ------
    AssetError
        The file is damaged.
    """
    import OpenEXR

    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {
                name: np.array(channel.pixels, np.float32)
                for part in file.parts
                for name, channel in part.channels.items()
            }
    except Exception as error:  # the binding raises whatever the C++ library threw, of no common type
        raise AssetError(str(path), f"is damaged ({error})", "Remove it and render again") from error
    grouped: dict[str, dict[str, Array]] = {}
    for name, pixels in channels.items():
        _, layer, letter = name.rsplit(".", 2)
        grouped.setdefault(layer, {})[letter] = pixels
    order = "RGBAXYZV"
    return {
        layer: np.stack([planes[c] for c in sorted(planes, key=order.index)], axis=-1)
        for layer, planes in grouped.items()
    }


def _develop(raw: Path, stem: Path, maps: bool) -> None:
    """Write the picture of a render, and its maps; the picture last, so that it is there when all is."""
    layers = read_layers(raw)
    combined = layers["Combined"]
    alpha = np.clip(combined[..., 3:4], 0, 1)
    if maps:
        share = np.where(alpha > 0, 1 / np.maximum(alpha, 1e-6), 0)
        normal = layers["Normal"]
        normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
        passes = {
            "Combined": combined,
            "Depth": np.where(alpha > 0, layers["Depth"][..., :1], np.float32(1e10)),
            "Normal": np.where(alpha > 0, normal, 0),
            "Albedo": layers["albedo"][..., :3] * share,
            "Roughness": layers["roughness"][..., :1] * share,
            "Metallic": layers["metallic"][..., :1] * share,
            "Coverage": alpha,
        }
        float32 = {name: values.astype(np.float32) for name, values in passes.items()}
        write_frame(stem.with_name(f"{stem.name}.exr"), float32, {"made": "Cycles"})
    straight = np.clip(combined[..., :3] / np.maximum(alpha, 1e-6), 0, 1) * (alpha > 0)
    pixels = (np.concatenate([linear_to_srgb(straight), alpha], axis=-1) * 255 + 0.5).astype(np.uint8)
    write_png(stem.with_name(f"{stem.name}.png"), pixels)


def _write_manifest(folder: Path, sets: list[_Set], plan: Plan, lights: dict[str, Path]) -> None:
    """The cameras as NeRF-synthetic has them, and truth.json."""
    for item in sets:
        frames = [
            {"file_path": f"./{item.name}/r_{k:03d}", "transform_matrix": matrix.tolist()}
            for k, matrix in enumerate(item.matrices)
        ]
        text = json.dumps({"camera_angle_x": ANGLE, "frames": frames}, indent=1)
        replace_file(folder / f"transforms_{item.name}.json", [text.encode()])
    truth = {
        "format": 1,
        "mesh": "mesh.npz",
        "posed": f"{POSED}.npy",
        "lights": {name: f"../lights/{path.name}" for name, path in lights.items()},
        "sets": [
            {
                "name": item.name,
                "cameras": f"transforms_{item.name}.json",
                "light": item.light,
                "posed": item.posed,
                "maps": item.maps,
            }
            for item in sets
            if item.name != "train"
        ],
        "training_light": next(iter(lights)),
    }
    replace_file(folder / "truth.json", [json.dumps(truth, indent=1).encode()])
