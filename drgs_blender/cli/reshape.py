"""Write an asset with the shape of an edited mesh, as Blender's *Save Edited Shape* gives it, or on another mesh.

EDIT.npz has vertices (n, 3), source (n,), faces (m, 3), face (m,) and perhaps removed (k,): `build.reshape.Edit`. From
Blender's *Swap Mesh* it has more: material channels that were painted on these vertices, a matrix (4, 4) by which the
asset is moved then, and mesh_vertices (p, 3), mesh_faces (q, 3) of the other mesh.
"""

from __future__ import annotations

import argparse
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core.asset.model import MATERIAL_CHANNELS
from ..core.errors import AssetError, UsageError
from ..formats.axes import UP_AXES
from .output import check_not_input, check_suffix, check_writable, write_and_report

if TYPE_CHECKING:
    from ..core.asset.model import Asset

EXAMPLES = """examples:
  drgs reshape statue.drgs --edit mended.npz --out mended.drgs
  drgs reshape statue.drgs --mesh retopology.obj --out light.drgs
"""
#: Arrays of an edit -> their types.
_ARRAYS: dict[str, type] = {
    "vertices": np.float32, "source": np.int32, "faces": np.int32, "face": np.int32, "removed": np.int32,
}  # fmt: skip
#: Those of a mesh that takes the place of the asset's.
_SWAP: dict[str, type] = {"matrix": np.float64, "mesh_vertices": np.float32, "mesh_faces": np.int32}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``drgs reshape``."""
    parser.add_argument("asset", type=Path, metavar="A.drgs", help="asset")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--edit", type=Path, metavar="EDIT.npz", help="the edited mesh")
    what.add_argument(
        "--mesh", type=Path, help="another mesh at the same place, on which the surfels hang from then on"
    )
    parser.add_argument("--up", choices=tuple(UP_AXES), help="up axis of --mesh; default: what its format says")
    parser.add_argument("--out", type=Path, required=True, metavar="B.drgs", help="asset to write")


def run(args: argparse.Namespace) -> int:
    """Reshape."""
    given = args.edit or args.mesh
    check_suffix(args.out, (".drgs",))
    check_not_input(args.out, [args.asset, given])
    check_writable(args.out, [args.asset, given])
    if args.up and not args.mesh:
        raise UsageError("--up", "belongs to --mesh", "Give both")
    arrays = {} if args.mesh else read_arrays(args.edit)

    from ..core.asset.container import read_asset

    asset = read_asset(args.asset)
    made = asset
    if arrays.keys() & _ARRAYS.keys():
        made, counts = _edited(asset, arrays, str(args.edit))
        if counts["new_faces"]:
            print(f"{counts['new_faces']} new faces with {counts['new_surfels']} surfels")
    if args.mesh or "mesh_faces" in arrays:
        made = _swapped(made, arrays, args)
    made.provenance = {**asset.provenance, "edited_from": args.asset.name}
    write_and_report(args.out, made)
    return 0


def _edited(asset: Asset, arrays: dict[str, np.ndarray], name: str) -> tuple[Asset, dict[str, int]]:
    """The asset with the shape, and what is painted, of an edit."""
    from ..build.reshape import Edit, reshape
    from ..core.material_adjustments import edited_asset

    made, counts = reshape(asset, Edit(**{key: arrays[key] for key in _ARRAYS if key in arrays}), name)
    painted = {channel: arrays[channel] for channel in MATERIAL_CHANNELS if channel in arrays}
    if wrong := [channel for channel, values in painted.items() if len(values) != len(made.mesh.vertices)]:
        raise AssetError(name, f"{', '.join(wrong)} are of other vertices", "Write it again")
    return (edited_asset(made, painted) if painted else made), counts


def _swapped(asset: Asset, arrays: dict[str, np.ndarray], args: argparse.Namespace) -> Asset:
    """The asset on the other mesh."""
    from ..build.make import mesh_with_materials, read_mesh_file
    from ..build.swap_mesh import swap_mesh, transformed

    if args.mesh is None:
        moved = transformed(asset, arrays.get("matrix", np.eye(4)))
        made, report = swap_mesh(moved, arrays["mesh_vertices"], arrays["mesh_faces"])
    else:
        file = replace(
            read_mesh_file(args.mesh), materials=[], face_material=None, vertex_colours=None, vertex_roughness=None,
            vertex_metallic=None,
        )  # fmt: skip
        mesh, of_file = mesh_with_materials(file, str(args.mesh), up=args.up)
        made, report = swap_mesh(asset, mesh.vertices, mesh.faces, str(args.mesh), mesh.source)
        for note in of_file["notes"]:
            print(f"{args.mesh.name}: {note}")
    print(f"bound to {len(made.mesh.faces)} faces, at a median distance of {report['distance_median']:.3g} m")
    return made


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an edit in a file. Raises AssetError."""
    remedy = "Write it by Save Edited Shape in Blender"
    types = {**_ARRAYS, **_SWAP, **dict.fromkeys(MATERIAL_CHANNELS, np.float32)}
    try:
        with np.load(path, allow_pickle=False) as file:
            found = {name: np.asarray(file[name]) for name in types if name in file.files}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, MemoryError) as error:
        raise AssetError(str(path), f"cannot be read ({error})", remedy) from error
    of_edit = found.keys() & _ARRAYS.keys()
    wanted = [name for name in _ARRAYS if name != "removed"] if of_edit or "mesh_faces" not in found else []
    wanted += ["mesh_vertices", "mesh_faces"] if found.keys() & _SWAP.keys() else []
    if missing := [name for name in wanted if name not in found]:
        raise AssetError(str(path), f"lacks {', '.join(missing)}", remedy)
    for name, array in found.items():
        if array.dtype != types[name]:
            raise AssetError(str(path), f"{name} are of type {array.dtype}, expected {np.dtype(types[name])}", remedy)
    for name in found.keys() & _SWAP.keys():
        if found[name].shape != ((4, 4) if name == "matrix" else (*found[name].shape[:1], 3)):
            raise AssetError(str(path), f"{name} have shape {found[name].shape}", remedy)
    return found
