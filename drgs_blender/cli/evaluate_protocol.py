"""`drgs evaluate --protocol`: the figures of published tables, for whoever has the sets."""

from __future__ import annotations

import argparse
import json
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.errors import EXIT_BAD_ASSET, AssetError, DrgsError, UsageError, first_of
from ..core.frame import Adjustment, Camera, ObjectState, RenderSettings, World
from .interrupt import interruptible
from .output import check_writable
from .progress import WORK_SECONDS, FractionBar

if TYPE_CHECKING:
    from ..core.asset import Asset
    from ..evaluate.protocols import Protocol
    from ..evaluate.protocols.bench import Renderer
    from ..reconstruct.pipeline import Progress
    from ..reconstruct.settings import Reading, Settings

logger = logging.getLogger(__name__)

#: Names of the table of protocols, which is not imported for a parser.
NAMES = ("glossysynthetic", "tensoir", "stanford-orb", "shiny-blender")

#: Options of --make-scenes alone.
_OF_SCENES = ("small", "size", "train", "test", "spp", "lights", "meshes", "blender")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of protocols."""
    group = parser.add_argument_group(
        "published sets", "A.drgs (or a folder of OBJECT.drgs) and the folder of the set; or that folder and --out"
    )
    group.add_argument("--protocol", choices=NAMES, help="score as the tables of this set are made")
    group.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="reconstruct each object there first, as OBJECT.drgs, where it is not yet",
    )
    group.add_argument("--lights-from", type=Path, metavar="DIR", help="folder of the set's lights, if not in the set")
    group.add_argument(
        "--most-views", type=int, metavar="N", help="of each part at most, evenly chosen: for a try, not for a table"
    )
    group.add_argument("--config", type=Path, metavar="FILE", help="of --out: as for drgs reconstruct")
    group.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="of --out: likewise")


def refuse_options(args: argparse.Namespace) -> None:
    """Raise UsageError where options of protocols are given without one."""
    for name in ("out", "lights_from", "most_views", "config", "set"):
        if getattr(args, name) not in (None, []):
            raise UsageError(f"--{name.replace('_', '-')}", "is an option of --protocol", "Leave it out")


def run(args: argparse.Namespace, settings: RenderSettings) -> int:
    """Score the objects of a set and print the table."""
    from ..evaluate.flip import find_flip
    from ..evaluate.lpips import Lpips
    from ..evaluate.protocols import PROTOCOLS, Bench
    from ..evaluate.protocols.table import complete, differences, strangers, table

    protocol = PROTOCOLS[args.protocol]
    root, assets = _places(args)
    _check(args, protocol)
    names = _objects(args, protocol, root, assets)
    for name in names:
        protocol.check(root, name, args.lights_from)  # before hours of work
    counts = {name: protocol.counts(root, name) for name in names}
    notes = strangers(names, protocol) + [text for name in names for text in differences(name, counts[name], protocol)]
    for note in notes:
        logger.warning("%s: %s: not the published set", root, note)
    lpips = Lpips(*args.lpips) if args.lpips else None
    if args.pictures is not None:
        check_writable(args.pictures / names[0] / "views-000.png")
    failed: dict[str, DrgsError] = {}
    notes += [] if args.out is None else _reconstruct(args, protocol, root, names, failed)
    flip = find_flip()
    report: dict[str, Any] = {"protocol": protocol.name, "samples": settings.samples, "objects": {}}
    with FractionBar(args, "rendering", every=WORK_SECONDS) as bar:
        for k, name in enumerate(names):
            begun: list[str] = []  # parts of this object

            def tell(part: str, done: int, of: int, k: int = k, name: str = name, begun: list[str] = begun) -> None:
                if part not in begun:
                    begun.append(part)
                done_here = (len(begun) - 1 + done / of) / protocol.parts
                bar(f"{name}, {part}, {done} of {of}", (k + done_here) / len(names))

            if name in failed:
                continue
            with _apart(name, names, failed):
                file = assets if assets.is_file() else assets / f"{name}.drgs"
                asset, render, digest = _loaded(file, settings)
                bench = Bench(asset, render, args.resolution, args.most_views, flip, lpips, tell, _writer(args, name))
                figures = protocol.measure(bench, root, name, args.lights_from)
                report["objects"][name] = {"asset": digest, "counts": counts[name], **figures}
    report["failed"] = {name: str(error) for name, error in failed.items()}
    network = lpips.network if lpips else ""
    report = complete(report, protocol, network, args.most_views, args.resolution, notes)
    print(json.dumps(report, indent=1, allow_nan=False) if args.json else "\n".join(table(report, protocol)))
    return EXIT_BAD_ASSET if failed else 0


@contextmanager
def _apart(name: str, names: list[str], failed: dict[str, DrgsError]) -> Iterator[None]:
    """Keep what is wrong with one object of several from ending the run: it is told, and put into `failed`."""
    try:
        yield
    except (AssetError, UsageError) as error:
        if len(names) == 1:
            raise
        failed[name] = error
        logger.error("%s is not scored: %s", name, error)


def _places(args: argparse.Namespace) -> tuple[Path, Path]:
    """(folder of the set, asset or folder of assets)."""
    given = [path for path in (args.asset, args.capture) if path is not None]
    wanted = 1 if args.out is not None else 2
    if len(given) != wanted:
        remedy = f"drgs evaluate --protocol {args.protocol} " + ("SET --out DIR" if args.out else "A.drgs SET")
        raise UsageError("--protocol", f"needs {'the folder of the set' if args.out else 'assets and the set'}", remedy)
    root, assets = given[-1], args.out or given[0]
    if not root.is_dir():
        raise AssetError(str(root), "is no folder" if root.exists() else "is not there", "Give the folder of the set")
    if args.out is None and not assets.exists():
        raise AssetError(str(assets), "is not there", "Give an asset, or a folder of assets named as the objects")
    return root, assets


def _check(args: argparse.Namespace, protocol: Protocol) -> None:
    """Raise UsageError on options that have no meaning here."""
    idle = {
        "--relit": args.relit, "--test-every": args.test_every, "--up": args.up, "--axes": args.axes != "opengl",
        "--lights-from": args.lights_from and not protocol.lights,
    } | {f"--{name}": getattr(args, name) for name in _OF_SCENES}  # fmt: skip
    of_out = {"--config": args.config and not args.out, "--set": args.set and not args.out}
    for options, where in ((idle, ""), (of_out, " without --out")):
        if wrong := [name for name, given in options.items() if given]:
            problem = f"has no effect with --protocol {protocol.name}{where}"
            raise UsageError(first_of(wrong), problem, "Leave it out")
    if args.most_views is not None and args.most_views < 1:
        raise UsageError("--most-views", f"is {args.most_views}", "Choose at least 1")


def _objects(args: argparse.Namespace, protocol: Protocol, root: Path, assets: Path) -> list[str]:
    """Names of the objects that are scored: of --objects, else those of the tables that are there."""
    there = [name for name in protocol.objects if protocol.folder(root, name).is_dir()]
    if args.objects:
        wrong = [name for name in args.objects if not protocol.folder(root, name).is_dir()]
        if wrong:
            problem = f"has no object {first_of(wrong)}; there are {first_of(there) or 'none of ' + protocol.name}"
            raise AssetError(str(root), problem, "Check the folder of the set and --objects")
        there = list(dict.fromkeys(args.objects))
    if not there:
        example = protocol.folder(root, protocol.objects[0])
        raise AssetError(str(root), f"holds no object of {protocol.name}: no {example}", "Give the folder of the set")
    if args.out is not None:
        return there
    if assets.is_file():
        named = [name for name in there if name == assets.stem] or there
        if len(named) != 1:
            problem = f"may be any of {first_of(there)}"
            raise UsageError(str(assets), problem, "Say by --objects which one, or name the file as the object")
        return named
    found = [name for name in there if (assets / f"{name}.drgs").is_file()]
    lacking = [name for name in there if name not in found]
    if not found or (args.objects and lacking):
        raise AssetError(str(assets), f"has no {first_of(lacking)}.drgs", "Reconstruct it there, or let --out do it")
    if lacking:
        logger.warning("%s: has no asset of %s, which are not scored", assets, first_of(lacking))
    return found


def _reconstruct(
    args: argparse.Namespace, protocol: Protocol, root: Path, names: list[str], failed: dict[str, DrgsError]
) -> list[str]:
    """Make the assets that are not there yet; notes on those that are there, made otherwise."""
    settings, reading = _settings(args, protocol)
    notes = []
    for name in names:
        file = args.out / f"{name}.drgs"
        with _apart(name, names, failed):
            if not file.exists():
                _make(args, protocol, root, name, file, settings, reading)
            elif note := _made_otherwise(file, settings, reading):
                notes.append(f"{name} {note}")
                logger.warning("%s: %s; it is scored as it is. Remove it to make it again", file, note)
    return notes


def _settings(args: argparse.Namespace, protocol: Protocol) -> tuple[Settings, Reading]:
    """Settings of --out. Raises UsageError on those of reading that the set gives itself."""
    from ..reconstruct.settings import Reading
    from .reconstruct import reconstruction, resolved_settings

    reconstruction()  # its absence is told at once
    settings, reading = resolved_settings(args.config, {}, args.set)
    for field in fields(Reading):
        if field.name != "resolution" and getattr(reading, field.name) != field.default:
            problem = f"has no effect with --protocol {protocol.name}: the set says it"
            raise UsageError(f"capture.{field.name}", problem, "Leave it out of --set and --config")
    if reading.resolution is None:
        reading = replace(reading, resolution=args.resolution or protocol.side)
    return settings, reading


def _made_otherwise(file: Path, settings: Settings, reading: Reading) -> str:
    """How the settings of an asset differ, "" where they do not."""
    from ..capture.masks.default_mode import AUTO_WITHOUT_CAMERAS
    from ..core.asset.container import inspect_asset
    from ..reconstruct.settings import Reading, Settings
    from ..reconstruct.settings_file import flat
    from ..reconstruct.settings_table import as_tables

    kept = inspect_asset(file, verify=False)["provenance"].get("settings")
    if not isinstance(kept, dict):
        return "was made with settings that it does not keep"
    wanted, usual = flat(as_tables(settings, reading)), flat(as_tables(Settings(), Reading()))
    made = usual | flat(kept)  # settings that are newer than the asset had their defaults
    for values in (wanted, made):
        if values["capture.masks"] == AUTO_WITHOUT_CAMERAS:
            values["capture.masks"] = "given"  # the sets have cameras
    other = [name for name in made if name not in wanted or made[name] != wanted[name]]
    return f"was made with other settings ({first_of(other)})" if other else ""


def _make(
    args: argparse.Namespace,
    protocol: Protocol,
    root: Path,
    name: str,
    file: Path,
    settings: Settings,
    reading: Reading,
) -> None:
    from ..core.asset.container import write_asset
    from ..reconstruct.settings_table import as_tables
    from .reconstruct import clear, reconstruction

    reconstruct = reconstruction()
    check_writable(file)
    work = file.with_name(f"{name}.reconstruct")
    with interruptible() as cancelled, FractionBar(args, "reconstructing", every=WORK_SECONDS) as bar:

        def tell(progress: Progress) -> None:
            bar(f"{name}, {progress.phase}", progress.part)

        capture = protocol.read(root, name, reading.resolution)
        asset = reconstruct(capture, settings, tell, cancelled, work)
    asset.provenance.setdefault("settings", as_tables(settings))["capture"] = as_tables(settings, reading)["capture"]
    write_asset(file, asset)
    clear(work, file)
    if not args.quiet:
        print(f"drgs: {file}: {len(asset.surfels)} surfels", file=sys.stderr)


def _loaded(file: Path, settings: RenderSettings) -> tuple[Asset, Renderer, str]:
    """(asset, what renders it, its digest)."""
    from ..core.asset.container import digest_asset
    from ..engine.session import Session
    from .evaluate import compared_passes

    session = Session()
    key = session.load_asset(file)

    def render(camera: Camera, radiance: np.ndarray, factors: tuple[float, float, float]) -> dict[str, np.ndarray]:
        adjustment = None if factors == (1.0, 1.0, 1.0) else Adjustment(tint=factors)
        state = ObjectState(file.stem, key, adjustment=adjustment)
        return compared_passes(session, state, camera, World(radiance), settings)

    return session.asset(key), render, digest_asset(key)


def _writer(args: argparse.Namespace, name: str) -> Any:
    """Writes pictures to --pictures/OBJECT, else does nothing."""
    if args.pictures is None:
        return lambda *_: None
    from .evaluate import writer

    check_writable(args.pictures / name / "views-000.png")
    return writer(args.pictures / name)
