"""Write an asset with the shape of an edited mesh, as Blender's *Save Edited Shape* gives it.

EDIT.npz has vertices (n, 3), source (n,), faces (m, 3), face (m,) and perhaps removed (k,): `build.reshape.Edit`.
"""

from __future__ import annotations

import argparse
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core.errors import AssetError
from .output import check_not_input, check_suffix, check_writable, write_and_report

if TYPE_CHECKING:
    from ..build.reshape import Edit

EXAMPLES = """examples:
  drgs reshape statue.drgs --edit mended.npz --out mended.drgs
"""
#: Arrays of an edit -> their types.
_ARRAYS = {"vertices": np.float32, "source": np.int32, "faces": np.int32, "face": np.int32, "removed": np.int32}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``drgs reshape``."""
    parser.add_argument("asset", type=Path, metavar="A.drgs", help="asset")
    parser.add_argument("--edit", type=Path, required=True, metavar="EDIT.npz", help="the edited mesh")
    parser.add_argument("--out", type=Path, required=True, metavar="B.drgs", help="asset to write")


def run(args: argparse.Namespace) -> int:
    """Reshape."""
    check_suffix(args.out, (".drgs",))
    check_not_input(args.out, [args.asset, args.edit])
    check_writable(args.out, [args.asset, args.edit])
    edit = read_edit(args.edit)

    from ..build.reshape import reshape
    from ..core.asset.container import read_asset

    asset = read_asset(args.asset)
    made, counts = reshape(asset, edit, str(args.edit))
    made.provenance = {**asset.provenance, "edited_from": args.asset.name}
    write_and_report(args.out, made)
    if counts["new_faces"]:
        print(f"  {counts['new_faces']} new faces with {counts['new_surfels']} surfels")
    return 0


def read_edit(path: Path) -> Edit:
    """The edit in a file. Raises AssetError."""
    from ..build.reshape import Edit

    remedy = "Write it by Save Edited Shape in Blender"
    try:
        with np.load(path, allow_pickle=False) as file:
            found = {name: np.asarray(file[name]) for name in _ARRAYS if name in file.files}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, MemoryError) as error:
        raise AssetError(str(path), f"cannot be read ({error})", remedy) from error
    if missing := [name for name in _ARRAYS if name not in found and name != "removed"]:
        raise AssetError(str(path), f"lacks {', '.join(missing)}", remedy)
    for name, dtype in _ARRAYS.items():
        if name in found and found[name].dtype != dtype:
            raise AssetError(str(path), f"{name} are of type {found[name].dtype}, expected {np.dtype(dtype)}", remedy)
    return Edit(**found)
