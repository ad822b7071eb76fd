"""Simulate the matter that fills an asset, without Blender: particles and mesh of every frame into a cache folder.

What is simulated is in a JSON file (docs/simulation.md lists its keys), in options, or both; options win. A bake that
was stopped goes on when the same command is given again.
"""

from __future__ import annotations

import argparse
import io
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.errors import UsageError
from ..core.file_types import USD_SUFFIXES
from ..core.frame_sequences import frame_path
from ..core.particle_cache import ParticleCache
from .interrupt import interruptible
from .json_file import read_json
from .output import check_suffix, check_writable
from .progress import FractionBar, clock, frames_on, prepare_engine
from .proxy_file import add_proxy, read_proxy
from .sampling import int_range

if TYPE_CHECKING:
    from ..core.asset import Mesh
    from ..simulation.settings import Settings

logger = logging.getLogger(__name__)

EXAMPLES = """examples:
  drgs simulate cat.drgs --material jelly --youngs-modulus 1e5 --floor 0 --frames 48 --out bake
  drgs simulate cat.drgs --settings drop.json --out bake --vertices 'poses/####.npy' --export cat.pc2
  drgs simulate fern.drgs --proxy hull.ply --settings wind.json --out bake
  drgs relight cat.drgs --env studio.hdr --camera front.json --cache bake --frames 24 --out 24.png
  drgs simulate --settings bodies.json --out bake
"""

#: Time steps a frame from which a bake is slower than its settings let expect.
_WARN_STEPS = 2000
#: Bytes; rows of moving force fields are most of it.
_LARGEST_SETTINGS = 1 << 28
#: Options that are a number of the material.
_MATTER = ("youngs_modulus", "poisson", "density")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``drgs simulate``."""
    parser.add_argument(
        "asset", type=Path, nargs="?", metavar="ASSET", help=".drgs file; settings with bodies name theirs"
    )
    parser.add_argument(
        "--out", type=Path, metavar="CACHE", help="folder of the frames; of several bodies, of a folder for each"
    )
    parser.add_argument("--settings", type=Path, metavar="S.json", help="settings of the simulation")
    parser.add_argument("--overwrite", action="store_true", help="remove what the folder holds of other settings")
    add_proxy(parser, "its inside is simulated")
    parser.add_argument("--threads", type=int_range(0, 1024), default=0, help="threads, 0 for all cores")
    group = parser.add_argument_group("settings, over those of the file")
    group.add_argument(
        "--material", metavar="NAME", help="jelly, rubber, cloth, metal, clay, foam, sand, snow, water, ..."
    )
    group.add_argument("--youngs-modulus", type=float, metavar="PA", help="stiffness: Young's modulus")
    group.add_argument("--poisson", type=float, metavar="NU", help="Poisson's ratio, below 0.5")
    group.add_argument("--density", type=float, metavar="KG/M3", help="density")
    group.add_argument("--resolution", type=int, metavar="N", help="grid cells along the longest side; default 48")
    group.add_argument("--solver", metavar="NAME", help="mpm, xpbd for a quick look, or rigid")
    group.add_argument("--device", metavar="NAME", help="device: cpu or cuda (an NVIDIA GPU); without one the CPU")
    group.add_argument("--gravity", type=_vector, metavar="X,Y,Z", help="m/s^2; default 0,0,-9.81")
    group.add_argument("--velocity", type=_vector, metavar="X,Y,Z", help="m/s, at the start")
    group.add_argument("--floor", type=float, metavar="Z", help="height of a floor, metres")
    group.add_argument(
        "--pin", action="append", default=[], metavar="GROUP", help="vertex group that stays; repeatable"
    )
    group.add_argument("--collider", action="append", default=[], metavar="MESH", help="mesh in the way; repeatable")
    group.add_argument("--frames", type=int_range(1, 1_000_000), metavar="N", help="frames, the one at rest included")
    group.add_argument("--fps", type=float, help="frames a second; default 24")
    made = parser.add_argument_group("also written")
    made.add_argument("--vertices", metavar="V####.npy", help="the mesh of each frame, for `drgs relight --vertices`")
    made.add_argument(
        "--export",
        type=Path,
        metavar="FILE",
        help="all frames: the mesh as .pc2 or .mdd, mesh and particles as .usdc, .usda, .usd or .usdz",
    )


def _vector(text: str) -> list[float]:
    values = [float(word) for word in text.split(",")]
    if len(values) != 3:
        raise argparse.ArgumentTypeError(f"{text} is not three numbers X,Y,Z")
    return values


def run(args: argparse.Namespace) -> int:
    """Simulate."""
    from ..formats.point_cache import SUFFIXES
    from ..formats.usd_splats import check_usd
    from .simulate_coupled import is_coupled, run_coupled

    if args.export:
        check_suffix(args.export, (*SUFFIXES, *USD_SUFFIXES))
        if args.export.suffix.lower() in USD_SUFFIXES:
            check_usd(str(args.export))
        check_writable(args.export)
    if args.vertices:
        if "#" not in Path(args.vertices).name:
            raise UsageError(f"--vertices {args.vertices}", "has no # for the frame's number", "Write it as v/####.npy")
        check_writable(frame_path(args.vertices, 1))
    data, folder = _given(args)
    if is_coupled(data):
        return run_coupled(args, data, folder)
    if args.asset is None or args.out is None:
        what = "ASSET" if args.asset is None else "--out"
        raise UsageError(what, "is not given", "Only settings with several bodies (--settings) go without")
    check_writable(args.out / "cache.json")

    from ..compute.threads import use_threads
    from ..core.asset.container import read_asset
    from ..simulation.bake import bake
    from ..simulation.job import prepare

    settings = _settings(args, data, folder)
    use_threads(args.threads)
    asset = read_asset(args.asset)
    if not len(asset.mesh.faces) and args.proxy is None:
        remedy = "Give a closed mesh around them with --proxy (Add Proxy Mesh makes one in Blender)"
        raise UsageError(str(args.asset), "has surfels alone, which say nothing of what they enclose", remedy)
    mesh = asset.mesh if args.proxy is None else read_proxy(args.proxy, asset, str(args.asset))
    prepare_engine(args, "simulate")
    with clock(args, "filling"):
        job = prepare(mesh, settings, str(args.asset if args.proxy is None else args.proxy))
    report = job.filling.report
    parts = f" in {report['parts']} parts" if report["parts"] > 1 else ""
    steps = job.solver.steps_of(1 / settings.fps)
    print(
        f"{report['particles']} particles{parts} ({report['method']}), at least {steps} time steps a frame", flush=True
    )
    warn(str(args.asset), report, steps)
    cache = ParticleCache(args.out)
    with FractionBar(args, "simulating") as bar, interruptible() as stopped:
        done = bake(
            job,
            cache,
            overwrite=args.overwrite,
            cancelled=stopped,
            progress=frames_on(bar, settings.first, settings.last),
        )
    print(f"{args.out}: frames {settings.first} to {settings.last}, {done} of them computed now")
    _write_exports(args, cache, mesh, settings)
    return 0


def warn(name: str, report: dict[str, Any], steps: int) -> None:
    """Say what a body's filling leaves out, and whether its bake takes long."""
    if steps > _WARN_STEPS:
        logger.warning(
            "%s: %d time steps a frame take long; a lower stiffness or resolution, or a larger body, needs fewer",
            name, steps,
        )  # fmt: skip
    if report["dropped_parts"]:
        logger.warning("%s: %d small parts of the mesh's interior are left out", name, report["dropped_parts"])
    if bare := report["bare_vertices"]:
        logger.warning("%s: %d vertices are on walls too thin to fill; they follow near particles", name, bare)


def _given(args: argparse.Namespace) -> tuple[Any, Path]:
    """What the file of settings holds, and the folder that its paths start from."""
    if not args.settings:
        return {}, Path()
    data = read_json(args.settings, str(args.settings), _LARGEST_SETTINGS, "the settings of a simulation")
    return data, args.settings.parent


def _settings(args: argparse.Namespace, data: Any, folder: Path) -> Settings:
    """Settings of the file with those of the options."""
    from ..simulation.settings import parse_settings

    if isinstance(data, dict):
        data = dict(data)
        changes = {name: getattr(args, name) for name in _MATTER if getattr(args, name) is not None}
        if args.material:
            data["material"] = args.material
        own = data.get("material", "jelly")
        if changes and isinstance(own, str | dict):  # anything else is refused below
            data["material"] = ({"name": own} if isinstance(own, str) else own) | changes
        for name in ("resolution", "solver", "device", "gravity", "velocity", "floor", "fps"):
            if getattr(args, name) is not None:
                data[name] = getattr(args, name)
        first, pins, colliders = data.get("first", 1), data.get("pins", []), data.get("colliders", [])
        if args.frames and isinstance(first, int):
            data["last"] = first + args.frames - 1
        if args.pin and isinstance(pins, list):
            data["pins"] = [*pins, *({"group": name} for name in args.pin)]
        if args.collider and isinstance(colliders, list):
            here = [{"mesh": str(Path(path).resolve())} for path in args.collider]
            data["colliders"] = [*colliders, *here]
    return parse_settings(data, str(args.settings or "settings"), folder)


def _write_exports(args: argparse.Namespace, cache: ParticleCache, mesh: Mesh, settings: Settings) -> None:
    """Poses as arrays and a file for other programs, from the cache."""
    if args.vertices:
        write_vertices(args.vertices, cache, settings)
    if args.export is not None and args.export.suffix.lower() in USD_SUFFIXES:
        write_usd(args.export, [(args.asset.stem, mesh, cache, settings)])
    elif args.export is not None:
        write_points(args.export, cache, settings)


def write_vertices(pattern: str, cache: ParticleCache, settings: Settings) -> None:
    """The mesh of each frame as an array."""
    from ..core.asset.archive import replace_file

    for frame in range(settings.first, settings.last + 1):
        encoded = io.BytesIO()
        np.save(encoded, cache.read(frame).vertices)
        replace_file(frame_path(pattern, frame), [encoded.getvalue()])


def write_usd(path: Path, bodies: list[tuple[str, Mesh, ParticleCache, Settings]]) -> None:
    """Bodies, each with its name, moving in one USD file."""
    from ..formats.usd_sequence import MovingObject, write_usd_sequence
    from .convert_source import posed_mesh

    def moving(frame: int) -> list[MovingObject]:
        found = []
        for name, mesh, cache, settings in bodies:
            state, matrix = cache.read(frame), np.array(settings.matrix_world)
            found.append(MovingObject(name, posed_mesh(mesh, state.vertices), matrix, points=state.points))
        return found

    settings = bodies[0][3]
    frames = range(settings.first, settings.last + 1)
    write_usd_sequence(path, ((frame, moving(frame)) for frame in frames), settings.fps)


def write_points(path: Path, cache: ParticleCache, settings: Settings) -> None:
    """The mesh of all frames as a point cache."""
    from ..formats.point_cache import write_point_cache

    frames = range(settings.first, settings.last + 1)
    moving = (cache.read(frame).vertices for frame in frames)
    write_point_cache(path, moving, len(frames), len(cache.rest().vertices), settings.first, settings.fps)
