"""Score an asset against its capture: views left out, and lights, poses, materials and shape where they are known.

With --make-scenes, Cycles renders scenes of which everything is known, for this command and any other program. With
--protocol, the figures of published tables are computed for whoever has their sets.
"""

from __future__ import annotations

import argparse
import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.errors import UsageError
from ..core.file_types import CAMERAS, TURNTABLE
from ..core.frame import Camera, Frame, ObjectState, RenderSettings, Visibility, World
from ..formats.axes import UP_AXES
from . import evaluate_protocol, sampling
from .output import check_writable
from .progress import WORK_SECONDS, FractionBar

if TYPE_CHECKING:
    from ..core.asset.model import Asset
    from ..engine.session import Session
    from ..evaluate.compare import Posed, Renderer
    from ..evaluate.scenes import Plan

logger = logging.getLogger(__name__)

EXAMPLES = """examples:
  drgs evaluate head.drgs photographs/head --test-every 8
  drgs evaluate spot.drgs scenes/spot --json
  drgs evaluate lego.drgs TensoIR/lego --relit TensoIR/lego lights/city.hdr --relit TensoIR/lego lights/night.hdr
  drgs evaluate --protocol tensoir TensoIR_Synthetic --out assets --objects lego
  drgs evaluate --protocol stanford-orb assets stanfordorb --json
  drgs evaluate --make-scenes scenes
  drgs evaluate --make-scenes scenes --objects spot fern --size 128 --train 40 --test 8 --spp 24
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``drgs evaluate``."""
    parser.add_argument("asset", type=Path, nargs="?", metavar="A.drgs", help="asset")
    parser.add_argument("capture", type=Path, nargs="?", metavar="CAPTURE", help="folder or file of the photographs")
    parser.add_argument("--json", action="store_true", help="write the figures as JSON")
    parser.add_argument(
        "--pictures", type=Path, metavar="DIR", help="write ours, the true ones and their difference, side by side"
    )
    parser.add_argument(
        "--test-every",
        type=sampling.int_range(2, 10**6),
        metavar="N",
        help="views left out, if the capture does not say; default: as the asset was reconstructed",
    )
    parser.add_argument(
        "--resolution", type=sampling.int_range(8, 65536), metavar="N", help="longer side of the views left out"
    )
    parser.add_argument("--axes", choices=tuple(CAMERAS), default="opengl", help="as given to drgs reconstruct")
    parser.add_argument("--up", choices=tuple(UP_AXES), help="as given to drgs reconstruct")
    parser.add_argument("--turntable", choices=TURNTABLE, default="auto", help="as given to drgs reconstruct")
    parser.add_argument(
        "--lpips",
        type=Path,
        nargs=2,
        metavar=("NETWORK", "HEADS"),
        help="weights for LPIPS: torchvision's AlexNet or VGG-16 and LPIPS's linear layers of it; without them it is "
        "not computed",
    )
    parser.add_argument(
        "--relit",
        type=Path,
        nargs=2,
        action="append",
        default=[],
        metavar=("CAPTURE", "LIGHT"),
        help="a capture of the object under a known light (EXR, HDR), which is named as the pictures where a layout "
        "has several lights (TensoIR); may be given several times",
    )
    evaluate_protocol.add_arguments(parser)
    parser.add_argument(
        "--driven-by", choices=("automatic", "surface", "particles"), default="automatic",
        help="what carries the surfels where the true object is posed: the asset's faces; points of the true surface; "
        "or these only what does not lie on the mesh (default)",
    )  # fmt: skip
    scenes = parser.add_argument_group("scenes with known truth")
    scenes.add_argument("--make-scenes", type=Path, metavar="OUT", help="render them; goes on where it was stopped")
    scenes.add_argument("--small", action="store_true", help="one object, small and few views, in a minute")
    scenes.add_argument(
        "--objects",
        nargs="+",
        metavar="NAME",
        help="which of spot, cat, robot, helmet, fern; default all. Of --protocol: objects of the set",
    )
    scenes.add_argument("--size", type=sampling.int_range(16, 4096), metavar="N", help="pixels of a side; default 256")
    scenes.add_argument("--train", type=sampling.int_range(2, 10000), metavar="N", help="training views; default 120")
    scenes.add_argument("--test", type=sampling.int_range(2, 10000), metavar="N", help="views left out; default 16")
    scenes.add_argument(
        "--spp",
        type=sampling.int_range(1, 65536),
        metavar="N",
        help="of Cycles, a pixel, before denoising; default 64",
    )
    scenes.add_argument(
        "--lights", nargs="+", metavar="NAME", help="Blender's studio lights or files; the first is for training"
    )
    scenes.add_argument("--meshes", type=Path, metavar="DIR", help="folder of the example meshes")
    scenes.add_argument("--blender", metavar="PATH", help="Blender, or a Python that has bpy")
    sampling.add_arguments(parser, defaults=True, output=False, samples=128)
    parser.set_defaults(film_transparent=True)  # sampling.override looks for it


def run(args: argparse.Namespace) -> int:
    """Make scenes, or score one asset."""
    if args.protocol is None:
        evaluate_protocol.refuse_options(args)
    elif args.make_scenes is not None:
        raise UsageError("--make-scenes", "cannot be given with --protocol", "Leave one of them out")
    if args.make_scenes is not None:
        if args.asset is not None:
            raise UsageError("--make-scenes", "takes no asset", "Score assets in a second command")
        return make(args)
    if args.protocol is not None:
        return evaluate_protocol.run(args, sampling.override(RenderSettings(), args))
    if args.asset is None or args.capture is None:
        raise UsageError("evaluate", "needs an asset and its capture", "See `drgs evaluate --help`")
    return score(args)


def make(args: argparse.Namespace) -> int:
    """Render scenes with known truth."""
    from ..evaluate.scenes import make_scenes
    from .find_blender import CHECKOUT, find_blender

    plan = plan_of(args)
    check_writable(args.make_scenes / "plan.json")
    script = Path(__file__).resolve().parents[1] / "evaluate" / "scene_job.py"
    command = find_blender(args.blender).command(script)
    meshes = args.meshes or CHECKOUT / "examples"
    with FractionBar(args, "rendering", every=WORK_SECONDS) as bar:

        def report(done: int, of: int, name: str) -> None:
            bar(f"{done} of {of} views, {name}", done / of)

        folders = make_scenes(args.make_scenes, plan, command, meshes, report, args.threads)
    for folder in folders:
        print(folder)
    return 0


def plan_of(args: argparse.Namespace) -> Plan:
    """The plan of scenes from the options."""
    from ..evaluate.scenes import SMALL, Plan

    given: dict[str, Any] = {
        name: value for name in ("size", "train", "test") if (value := getattr(args, name)) is not None
    }
    if args.spp is not None:
        given["samples"] = args.spp
    given |= {name: tuple(value) for name in ("objects", "lights") if (value := getattr(args, name)) is not None}
    return replace(SMALL if args.small else Plan(), **given)


def score(args: argparse.Namespace) -> int:
    """Compare one asset with its capture."""
    settings = sampling.override(RenderSettings(), args)
    if args.pictures is not None:
        check_writable(args.pictures / "novel-000.png")

    from ..core.asset.container import digest_asset
    from ..engine.session import Session
    from ..evaluate.compare import compare, table
    from ..evaluate.lpips import Lpips
    from ..evaluate.truth import Truth, read_relit, read_truth
    from ..reconstruct.readers import read_capture

    lpips = Lpips(*args.lpips) if args.lpips else None
    session = Session()
    key = session.load_asset(args.asset)
    folder = capture_of(args.capture, args.asset)
    test_every = args.test_every or left_out_by(session.asset(key))
    capture = read_capture(folder, args.resolution, test_every, args.axes, args.up, turntable=args.turntable)
    truth = read_truth(folder)
    relit = [read_relit(folder, light, args.resolution, args.axes, args.up) for folder, light in args.relit]
    if relit:
        truth = truth or Truth([])
        truth.sets += relit

    with FractionBar(args, "rendering") as bar:
        report = compare(
            session.asset(key),
            capture,
            truth,
            session_renderer(session, key, settings, driven_by=args.driven_by),
            lpips,
            lambda part, name: bar(name, part),
            writer(args.pictures) if args.pictures is not None else None,
        )
    report = {"asset": digest_asset(key), "capture": capture.name, "samples": settings.samples, **report}
    print(json.dumps(report, indent=1) if args.json else "\n".join(table(report)))
    return 0


def capture_of(given: Path, asset: Path) -> Path:
    """The capture to score with: `given`, or the one beside the asset that was made of photographs without cameras."""
    from ..reconstruct.readers import has_cameras

    beside = asset.with_name(f"{asset.stem}.capture")
    if not given.exists() or has_cameras(given) or not has_cameras(beside):
        return given
    logger.info("%s has no cameras: those of %s are used", given, beside)
    return beside


def left_out_by(asset: Asset) -> int | None:
    """The `capture.test_every` with which an asset was reconstructed, where it says that."""
    settings = asset.provenance.get("settings")
    reading = settings.get("capture") if isinstance(settings, dict) else None
    every = reading.get("test_every") if isinstance(reading, dict) else None
    return every if isinstance(every, int) and every >= 2 else None


def session_renderer(
    session: Session, key: str, settings: RenderSettings, visibility: Visibility | None = None,
    driven_by: str = "automatic", tear: float = 0.0,
) -> Renderer:  # fmt: skip
    """Renders the loaded asset `key` for `evaluate.compare`, with `settings` on a transparent film.

    Faces that have grown by more than `tear` metres (`ObjectState.tear`) are left out; 0: none are.
    """

    def render(camera: Camera, light: World, pose: Posed | None) -> dict[str, np.ndarray]:
        state = ObjectState(Path(key).stem, key, visibility=visibility or Visibility())
        if pose is not None:
            state.vertices, state.tear = pose.vertices, tear
            if driven_by != "surface":
                state.particles = replace(pose.particles, all=driven_by == "particles")
        return compared_passes(session, state, camera, light, settings)

    return render


def compared_passes(
    session: Session, state: ObjectState, camera: Camera, light: World, settings: RenderSettings
) -> dict[str, np.ndarray]:
    """Passes of one object under a light, with `settings` on a transparent film."""
    from ..evaluate.compare import COMPARED_PASSES

    settings = replace(settings, film_transparent=True)
    frame = Frame(noise_index=1, camera=camera, objects=[state], world=light, settings=settings, passes=COMPARED_PASSES)
    return dict(session.render(frame))


def writer(folder: Path) -> Any:
    """Writes pictures: ours on the left, the true one in the middle, their difference on the right."""
    from ..formats.images import write_png

    def show(name: str, number: int, ours: np.ndarray, true: np.ndarray) -> None:
        strip = np.concatenate([ours, true, np.abs(ours - true)], axis=1)
        write_png(folder / f"{name}-{number:03d}.png", (np.clip(strip, 0, 1) * 255 + 0.5).astype(np.uint8))

    return show
