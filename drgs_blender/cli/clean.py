"""Clean an asset: a new file without floaters, faint, large or distant surfels, and without what lies outside a box."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core.errors import UsageError
from .output import check_not_input, check_suffix, check_writable
from .relight import finite, positive

if TYPE_CHECKING:
    from ..core.asset.model import Asset

logger = logging.getLogger(__name__)

EXAMPLES = """examples:
  drgs clean statue.drgs --floaters --out clean.drgs
  drgs clean statue.drgs --floaters 2 --opacity 0.05 --out clean.drgs
  drgs clean statue.drgs --floaters --faces --out clean.drgs
  drgs clean room.drgs --box=-1,-1,0,1,1,2 --out corner.drgs
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``drgs clean``."""
    parser.add_argument("asset", type=Path, metavar="A.drgs", help="asset")
    parser.add_argument("--out", type=Path, required=True, metavar="B.drgs", help="asset to write")
    parser.add_argument(
        "--floaters", type=positive, nargs="?", const=1.0, metavar="S",
        help="surfels in the air: small parts, and faint, wide or distant ones that stand alone; S above 1 finds more",
    )  # fmt: skip
    parser.add_argument("--opacity", type=finite, metavar="MIN", help="surfels that are fainter")
    parser.add_argument("--wider", type=positive, metavar="K", help="surfels larger than K times the median")
    parser.add_argument(
        "--distance", type=positive, metavar="K", help="surfels farther from the mesh than K times the median size"
    )
    parser.add_argument(
        "--box", type=_box, metavar="X0,Y0,Z0,X1,Y1,Z1",
        help="keep what lies in this box alone, surfels and faces: lowest and highest corner, object space, metres",
    )  # fmt: skip
    parser.add_argument(
        "--faces", action="store_true", help="also the faces that only removed surfels covered: they throw shadows"
    )


def _box(text: str) -> list[float]:
    """Parser of six numbers."""
    numbers = [finite(part) for part in text.split(",")]
    if len(numbers) != 6:
        raise argparse.ArgumentTypeError(f"{text} is not six numbers, X0,Y0,Z0,X1,Y1,Z1")
    return numbers


def run(args: argparse.Namespace) -> int:
    """Clean."""
    check_suffix(args.out, (".drgs",))
    if all(getattr(args, name) is None for name in ("floaters", "opacity", "wider", "distance", "box")):
        raise UsageError(
            "clean", "is told nothing to remove", "Give --floaters, --opacity, --wider, --distance or --box"
        )
    if args.box is not None and not all(a < b for a, b in zip(args.box[:3], args.box[3:], strict=True)):
        raise UsageError("--box", "has no inside", "Give its lowest corner first, then its highest")
    check_not_input(args.out, [args.asset])
    check_writable(args.out, [args.asset])

    from ..core.asset.container import read_asset, write_asset
    from ..core.asset.part import part_of, part_of_faces, whole_of

    asset = read_asset(args.asset)
    count, mesh = len(asset.surfels), asset.mesh
    gone = np.zeros(count, bool)
    for name, rule in _RULES.items():
        if (value := getattr(args, name)) is None:
            continue
        found = rule(asset, value)
        print(f"{name}: {int(found.sum())} of {count} surfels")
        gone |= found
    faces: np.ndarray = np.ones(len(mesh.faces), bool)
    if args.box is not None:
        low, high = np.array(args.box[:3]), np.array(args.box[3:])
        inside = np.all((mesh.vertices >= low) & (mesh.vertices <= high), axis=1)
        faces = np.all(inside[mesh.faces], axis=1)
        print(f"box: {int((~faces).sum())} of {len(faces)} faces")
    if args.faces and gone.any():
        from ..core.bare_faces import bare_faces

        bare = bare_faces(asset, np.flatnonzero(gone))
        print(f"faces: {int((bare & faces).sum())} of {len(faces)}")
        faces = faces & ~bare
    if gone.all() or (len(faces) and not faces.any()):
        raise UsageError(str(args.asset), "would be gone as a whole", "Remove less")
    whole = faces.all()
    part = whole_of(mesh) if whole else part_of_faces(mesh, faces)
    if gone.any():
        part.removed = np.flatnonzero(gone).astype(np.int32)
    cut = part_of(asset, part, str(args.asset)) if gone.any() or not whole else asset
    if not len(cut.surfels):
        raise UsageError(str(args.asset), "would have no surfel", "Remove less")
    write_asset(args.out, replace(cut, provenance={**asset.provenance, "cleaned_from": args.asset.name}))
    print(f"{args.out}: {len(cut.surfels)} of {count} surfels on {len(cut.mesh.faces)} of {len(mesh.faces)} triangles")
    return 0


def _floaters(asset: Asset, strength: float) -> np.ndarray:
    from ..core.floaters import distance_from_mesh, find_floaters

    return find_floaters(asset.surfels, distance_from_mesh(asset), strength)


def _faint(asset: Asset, least: float) -> np.ndarray:
    return np.asarray(asset.surfels.opacity < least)


def _wide(asset: Asset, factor: float) -> np.ndarray:
    from ..core.floaters import median_size

    return np.asarray(asset.surfels.scale.max(axis=1) > factor * median_size(asset.surfels))


def _distant(asset: Asset, factor: float) -> np.ndarray:
    from ..core.floaters import distance_from_mesh, median_size

    away = distance_from_mesh(asset)
    if away is None:
        logger.warning("the surfels are bound to no mesh: --distance removes none")
        return np.zeros(len(asset.surfels), bool)
    return np.asarray(away > factor * median_size(asset.surfels))


def _outside(asset: Asset, box: list[float]) -> np.ndarray:
    centre = asset.surfels.centre
    return ~np.all((centre >= box[:3]) & (centre <= box[3:]), axis=1)


#: Option -> which surfels of an asset go by its value.
_RULES: dict[str, Callable[..., np.ndarray]] = {
    "floaters": _floaters,
    "opacity": _faint,
    "wider": _wide,
    "distance": _distant,
    "box": _outside,
}
