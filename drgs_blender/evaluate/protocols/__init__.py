"""Published sets scored as their tables are: layouts, splits, lights, alignment, metrics; one module a set.

None of these sets comes with this program: whoever has one names its folder (`drgs evaluate --protocol`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...reconstruct.capture.capture import Capture
from . import glossysynthetic, shiny_blender, stanford_orb, tensoir
from .bench import Bench

__all__ = ["PROTOCOLS", "Bench", "Column", "Protocol"]


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table.

    Attributes
    ----------
    path : str
        Where the figure is in the report of an object, as in "relit.psnr".
    title : str
    digits : int
        After the point.
    """

    path: str
    title: str
    digits: int = 2


@dataclass(frozen=True, slots=True)
class Protocol:
    """A published set and how it is scored.

    Attributes
    ----------
    name : str
    objects : tuple of str
        Those of the published tables.
    folder : callable
        (folder of the set, object) -> its photographs.
    read : callable
        (folder of the set, object, pixels of the longer side or None) -> the capture to learn from.
    check : callable
        (folder of the set, object, folder of the lights or None): raises AssetError where a file that is measured by is
        not there, before hours of work.
    counts : callable
        (folder of the set, object) -> how many views there are of each kind.
    expected : dict of str to int
        How many the published set has.
    measure : callable
        (bench, folder of the set, object, folder of the lights or None) -> figures of the object, nested by name.
    columns : tuple of Column
    parts : int
        How many lights an object is rendered under, its own and others, or groups of them.
    lights : bool
        Its light files may lie in another folder.
    side : int, optional
        Pixels of the longer side that are read where none are asked for; None: all.
    about : str
        What is measured how, for the user; and what the published tables have that is left out.
    """

    name: str
    objects: tuple[str, ...]
    folder: Callable[[Path, str], Path]
    read: Callable[[Path, str, int | None], Capture]
    check: Callable[[Path, str, Path | None], object]
    counts: Callable[[Path, str], dict[str, int]]
    expected: dict[str, int]
    measure: Callable[[Bench, Path, str, Path | None], dict[str, Any]]
    columns: tuple[Column, ...]
    parts: int
    lights: bool
    side: int | None
    about: str


def _pictures(part: str, title: str) -> tuple[Column, ...]:
    return (
        Column(f"{part}.psnr", f"{title} PSNR"), Column(f"{part}.ssim", "SSIM", 4), Column(f"{part}.flip", "FLIP", 4),
        Column(f"{part}.lpips", "LPIPS", 4),
    )  # fmt: skip


def _hdr_pictures(part: str, title: str) -> tuple[Column, ...]:
    return (
        Column(f"{part}.psnr_h", f"{title} PSNR-H"), Column(f"{part}.psnr_l", "PSNR-L"),
        Column(f"{part}.ssim", "SSIM", 4), Column(f"{part}.flip", "FLIP", 4), Column(f"{part}.lpips", "LPIPS", 4),
    )  # fmt: skip


def _of(module: Any, columns: tuple[Column, ...], parts: int, lights: bool, about: str) -> Protocol:
    """The protocol of a module, which is named as it is but for underscores."""
    name = module.__name__.rpartition(".")[2].replace("_", "-")
    functions = module.folder, module.read, module.check, module.counts, module.COUNTS, module.measure
    return Protocol(name, module.OBJECTS, *functions, columns, parts, lights, getattr(module, "SIDE", None), about)


#: The table, by name.
PROTOCOLS: dict[str, Protocol] = {
    protocol.name: protocol
    for protocol in (
        _of(
            glossysynthetic,
            (*_pictures("views", "Views"), *_pictures("relit", "Relit")),
            4,
            True,
            "GlossySynthetic (NeRO), relit as GS-ROR measures: 16 views a light, each picture scaled by one factor a "
            "channel over the whole frame on white. Chamfer distance and normals are left out: the set has neither "
            "mesh nor normals",
        ),
        _of(
            tensoir,
            (
                *_pictures("views", "Views"),
                *_pictures("relit", "Relit"),
                Column("materials.albedo_psnr", "Albedo PSNR"),
                Column("shape.normal_degrees", "Normals MAE"),
            ),
            6,
            True,
            "TensoIR-Synthetic: relit with albedo scaled by the median ratio of each channel (20 views); albedo in a "
            "gamma of 2.2; pictures, albedo and normals over the whole frame, on white, normals on +Z",
        ),
        _of(
            stanford_orb,
            (
                *_hdr_pictures("relit", "Relit"),
                *_hdr_pictures("views", "Views"),
                Column("materials.albedo_psnr", "Albedo PSNR-L"),
                Column("shape.normal_distance", "Normals 1 - cos", 4),
                Column("shape.depth_mse", "Depth MSE", 5),
            ),
            2,
            False,
            "Stanford-ORB at 512 pixels, inside of the eroded masks; relit pictures scaled by one factor a channel, "
            "others not. Chamfer distance is left out: it needs the benchmark's own sampling of the meshes",
        ),
        _of(
            shiny_blender,
            (*_pictures("views", "Views"), Column("shape.normal_degrees", "Normals MAE")),
            1,
            False,
            "Shiny Blender (Ref-NeRF): views over the whole frame on white, normals weighted by coverage and alpha. "
            "Relit pictures are left out: the set has none, tables with them render their own",
        ),
    )
}
