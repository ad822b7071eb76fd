"""``drgs simulate`` of several bodies that push each other, as a file of settings with "bodies" names them."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..core.errors import UsageError
from ..core.file_types import USD_SUFFIXES
from ..core.particle_cache import ParticleCache
from .interrupt import interruptible
from .output import check_writable
from .progress import FractionBar, clock, frames_on, prepare_engine

#: Options that are of one body alone.
_OF_ONE = (
    "material", "youngs_modulus", "poisson", "density", "resolution", "solver", "device", "gravity", "velocity",
    "floor", "pin", "collider", "proxy",
)  # fmt: skip


def is_coupled(data: Any) -> bool:
    """Whether settings name several bodies."""
    return isinstance(data, Mapping) and "bodies" in data


def run_coupled(args: argparse.Namespace, data: Any, folder: Path) -> int:
    """Simulate the bodies that `data` names, with paths that start from `folder`."""
    from ..compute.threads import use_threads
    from ..core.asset.container import read_asset
    from ..simulation.coupled_bake import bake_coupled
    from ..simulation.coupled_job import prepare_coupled
    from ..simulation.coupled_settings import parse_coupled
    from .simulate import warn

    subject = str(args.settings)
    if args.asset is not None:
        raise UsageError(str(args.asset), f"is given, but {subject} names bodies", "Give one of the two")
    for name in _OF_ONE:
        if getattr(args, name) not in (None, []):
            option = f"--{name.replace('_', '-')}"
            raise UsageError(
                option, "is an option for one object", f"Write it into {subject}, beside its bodies or in one"
            )
    shared = dict(data)
    if args.fps is not None:
        shared["fps"] = args.fps
    if args.frames and isinstance(shared.get("first", 1), int):
        shared["last"] = shared.get("first", 1) + args.frames - 1
    scene = parse_coupled(shared, subject, folder, args.out)
    for body in scene.bodies:
        check_writable(body.out / "cache.json")
    use_threads(args.threads)
    meshes = [read_asset(body.asset).mesh for body in scene.bodies]
    for body, mesh in zip(scene.bodies, meshes, strict=True):
        if not len(mesh.faces):
            problem = "has surfels alone, which say nothing of what they enclose"
            raise UsageError(f'body "{body.name}", {body.asset}', problem, "Bake it alone, with --proxy")
        for path in _exports(args, body.name):
            if Path(body.name).name != body.name or "#" in body.name:
                raise UsageError(f'body "{body.name}"', "has a name that no file can have", 'Give it another "name"')
            check_writable(path)
    prepare_engine(args, "coupled")
    with clock(args, "filling"):
        job = prepare_coupled(meshes, scene)
    settings = job.settings
    steps = max(one.solver.steps_of(1 / settings.fps) for one in job.jobs)
    reports = [one.filling.report for one in job.jobs]
    for body, report in zip(job.bodies, reports, strict=True):
        print(f"{body.name}: {report['particles']} of the particles ({report['method']}), frames in {body.out}")
    total = sum(report["particles"] for report in reports)
    many = "bodies" if len(reports) > 1 else "body"
    print(f"{total} particles in {len(reports)} {many}, at least {steps} time steps a frame", flush=True)
    for i, (body, report) in enumerate(zip(job.bodies, reports, strict=True)):
        warn(f'body "{body.name}"', report, 0 if i else steps)
    caches = [ParticleCache(body.out) for body in job.bodies]
    with FractionBar(args, "simulating") as bar, interruptible() as stopped:
        done = bake_coupled(
            job,
            caches,
            overwrite=args.overwrite,
            cancelled=stopped,
            progress=frames_on(bar, settings.first, settings.last),
        )
    names = ", ".join(body.name for body in job.bodies)
    print(f"{names}: frames {settings.first} to {settings.last}, {done} of them computed now")
    _write_exports(args, list(zip([b.name for b in job.bodies], meshes, caches, [j.settings for j in job.jobs])))
    return 0


def _exports(args: argparse.Namespace, name: str) -> list[Path]:
    """Files that are written for a body alone: the pattern of its poses, its motion."""
    found = [Path(args.vertices)] if args.vertices else []
    if args.export is not None and args.export.suffix.lower() not in USD_SUFFIXES:
        found.append(args.export)
    return [path.parent / f"{name}_{path.name}" for path in found]


def _write_exports(args: argparse.Namespace, bodies: list[tuple[str, Any, ParticleCache, Any]]) -> None:
    """All bodies in one USD file; of other formats a file for each, which is named after it."""
    from .simulate import write_points, write_usd, write_vertices

    if args.export is not None and args.export.suffix.lower() in USD_SUFFIXES:
        write_usd(args.export, bodies)
    for name, _, cache, settings in bodies:
        for path in _exports(args, name):
            if "#" in path.name:
                write_vertices(str(path), cache, settings)
            else:
                write_points(path, cache, settings)
