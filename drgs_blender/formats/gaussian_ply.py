"""Gaussian splats in PLY files, of every trainer in use, to activated surfels.

One table says how to recognise each layout and how its raw values become physical ones. The table is in the order
that never confuses two layouts. Sources: the public training code of each project.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.asset import Surfels
from ..core.color import srgb_to_linear
from ..core.errors import AssetError
from .axes import FARTHEST, multiply_quaternions
from .files import SurfelFile
from .harmonics import SH_C0
from .ply import Header, Rows, read_ply
from .ply_columns import Columns, beside, extra_columns, sanitised, stack

Array = np.ndarray

#: A splat whose shortest axis is more than this part of the next one is not nearly a surfel.
FLAT = 0.3
#: Largest SH degree in use has 16 coefficients; more is damage.
SH_LIMIT = 64
#: Materials of files that have none.
ROUGHNESS, METALLIC = 0.5, 0.0
#: Noted of a file without materials.
CAPTURED_ALBEDO = (
    "albedo is the captured colour, with the light of the capture in it; `drgs import ... --remove-light` estimates "
    "it without that light, best with --env E.hdr"
)


def sigmoid(x: Array) -> Array:
    """Logistic function, without overflow."""
    return 0.5 * (1.0 + np.tanh(0.5 * x))


@dataclass(frozen=True, slots=True)
class Channel:
    """A material channel: properties it is read from and what turns raw values into [0, 1]."""

    properties: tuple[str, ...]
    activate: Callable[[Array], Array] = sigmoid


@dataclass(frozen=True, slots=True)
class Layout:
    """One row of the table.

    Attributes
    ----------
    name : str
        Program that writes it.
    has, lacks : tuple of str
        Properties that must and must not be there.
    albedo, roughness, metallic : Channel, optional
        None where the file has none.
    srgb : bool
        The albedo is sRGB-encoded after activation.
    known : str
        Other properties whose meaning is known, as a regular expression (kept in the extras, not "unknown").
    derived : tuple of str
        Properties that say again what others do.
    note : str
        Shown to the user.
    """

    name: str
    has: tuple[str, ...] = ()
    lacks: tuple[str, ...] = ()
    albedo: Channel | None = None
    roughness: Channel | None = None
    metallic: Channel | None = None
    srgb: bool = False
    known: str = r"(?!)"
    derived: tuple[str, ...] = ()
    note: str = ""

    def fits(self, names: set[str]) -> bool:
        """Whether a file with these properties has this layout."""
        return names.issuperset(self.has) and names.isdisjoint(self.lacks)


def unit_range(x: Array) -> Array:
    """Values that are activated already."""
    return np.clip(x, 0.0, 1.0)


def _three(prefix: str) -> tuple[str, ...]:
    return tuple(f"{prefix}{i}" for i in range(3))


#: What splats of our own have besides those of 3DGS.
OWN_ALBEDO, OWN_NUMBERS = ("albedo_r", "albedo_g", "albedo_b"), ("roughness", "metallic")
OWN_NORMAL = ("nx", "ny", "nz")

_BASE_COLOUR = _three("base_color_")
_PLAIN = Channel(_BASE_COLOUR)
_NARROWED = Channel(_BASE_COLOUR, lambda x: 0.77 * sigmoid(x) + 0.03)

#: Layouts in order of detection. GaussianMesh keeps its position relative to a face, see `_decode_face_positions`.
LAYOUTS: tuple[Layout, ...] = (
    Layout(
        "DR-GS",
        has=(*OWN_ALBEDO, *OWN_NUMBERS),
        albedo=Channel(OWN_ALBEDO, unit_range),
        roughness=Channel(OWN_NUMBERS[:1], unit_range),
        metallic=Channel(OWN_NUMBERS[1:], unit_range),
        derived=OWN_NORMAL,
        note="materials as they are, linear (docs/relightable-splats.md)",
    ),
    Layout(
        "Ref-Gaussian",
        has=("refl_strength",),
        albedo=Channel(_three("ori_color_")),
        roughness=Channel(("roughness",)),
        metallic=Channel(("refl_strength",)),
        srgb=True,
        known=r"ind_(dc|rest|asg)_\d+|n[xyz]2|metalness|diffuse_color_\d",
        note="albedo was trained in display space and is decoded from sRGB; refl_strength is the metallic",
    ),
    Layout(
        "Ref-Gaussian in IRGS",
        has=("ind_dc_0", "base_color_0"),
        albedo=_PLAIN,
        roughness=Channel(("roughness",)),
        metallic=Channel(("metallic",)),
        known=r"ind_(dc|rest)_\d+",
    ),
    Layout(
        "Relightable 3D Gaussian",
        has=("incidents_dc_0", "base_color_0"),
        albedo=_NARROWED,
        roughness=Channel(("roughness",), lambda x: 0.9 * sigmoid(x) + 0.09),
        known=r"(incidents|visibility)_(dc|rest)_\d+",
        note="has no metallic, 0 is used. A heap of splats at the origin is a file of Mani-GS: the same layout, but "
        "relative to triangles that it does not name, which cannot be recovered",
    ),
    Layout(
        "GS-ROR2",
        has=("albedo0",),
        albedo=Channel(_three("albedo")),
        roughness=Channel(("roughness",)),
        metallic=Channel(("metallic",)),
        known=r"(specular|diffuse)\d|n[xyz]2",
    ),
    Layout("GaussianMesh", has=("face_id", "ca", "cb", "cc"), known=r"c[abc]|v\d_?[xyz]|dis|v_index\d|radius|face_id"),
    Layout(
        "IRGS",
        has=("base_color_0", "scale_1"),
        lacks=("scale_2",),
        albedo=_NARROWED,
        roughness=Channel(("roughness",)),
        known="metallic",
        note="metallic is never trained there, 0 is used",
    ),
    Layout("2DGS", lacks=("scale_2",)),
    Layout("3DGS"),
)

_GEOMETRY = ("x", "y", "z", "opacity", "scale_0", "scale_1", "rot_0", "rot_1", "rot_2", "rot_3")
_REMEDY = "Export the point cloud again with the program that trained it"


def is_gaussian(header: Header) -> bool:
    """Whether a PLY header is that of Gaussian splats, complete or not; the reader names what is missing."""
    vertex = header.element("vertex")
    if vertex is None:
        return False
    if all(name in vertex for name in ("scale_0", "rot_0", "opacity")):
        return True
    return header.element("face") is None and any(n in vertex for n in ("scale_0", "rot_0", "opacity", "f_dc_0"))


def find_layout(names: set[str]) -> Layout:
    """The layout of a file whose vertices have the properties `names`."""
    return next(layout for layout in LAYOUTS if layout.fits(names))


def read_gaussian_ply(path: Path) -> SurfelFile:
    """Read Gaussian splats from the PLY file at `path`.

    Raises
    ------
    AssetError
        The file is damaged, lacks properties its layout needs, or is of a kind that cannot be decoded.
    """
    header, elements = read_ply(path)
    return decode_splats(header, elements.get("vertex"), str(path))


def decode_splats(header: Header, rows: Rows | None, subject: str, sh: Array | None = None) -> SurfelFile:
    """Turn the rows of the element ``vertex`` into activated surfels.

    `sh` (n, k, 3) stands for the columns of harmonics where a format stores them otherwise.
    """
    if rows is None or rows.lists:
        raise AssetError(subject, "has no element 'vertex' of plain numbers", _REMEDY)
    columns = rows.columns
    names = set(columns)
    if missing := [n for n in _GEOMETRY if n not in names]:
        raise AssetError(subject, f"is not a complete splat file: it lacks {', '.join(missing)}", _REMEDY)
    layout = find_layout(names)
    notes = [layout.note] if layout.note else []
    assumed: list[str] = []
    used = {*_GEOMETRY, *layout.derived}

    def take(wanted: tuple[str, ...]) -> Array:
        if missing := [n for n in wanted if n not in names]:
            raise AssetError(subject, f"looks like {layout.name} but lacks {', '.join(missing)}", _REMEDY)
        used.update(wanted)
        return stack(columns, wanted)

    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        centre = take(("x", "y", "z"))
        opacity = sigmoid(columns["opacity"].astype(np.float32))
        axes = np.exp(take(tuple(n for n in ("scale_0", "scale_1", "scale_2") if n in names)))
        rotation = take(("rot_0", "rot_1", "rot_2", "rot_3"))
        length = np.linalg.norm(rotation, axis=1, keepdims=True)
        rotation = rotation / length
        extras: dict[str, Array] = {}
        if layout.name == "GaussianMesh":
            centre, extras["barycentric"] = _decode_face_positions(columns, centre, notes)
        if sh is None:
            sh = _harmonics(columns, names, used, subject)
        material = {
            "albedo": _albedo(layout, take, sh, assumed),
            "roughness": _scalar(layout.roughness, take, ROUGHNESS, len(centre)),
            "metallic": _scalar(layout.metallic, take, METALLIC, len(centre)),
        }
    if layout.roughness is None:
        assumed.append(f"has no materials: roughness {ROUGHNESS:g} and metallic {METALLIC:g} are used")
    if axes.shape[1] == 3:
        extras["thickness"] = axes.min(axis=1)
        rotation, axes = _flatten(rotation, axes, assumed)
    notes += assumed
    finite = np.ones(len(centre), bool)
    for array in (centre, opacity, axes, rotation, *material.values(), *([] if sh is None else [sh])):
        good = np.isfinite(array)
        if not good.all():  # almost never; row by row takes many times as long
            finite &= good.reshape(len(centre), math.prod(array.shape[1:])).all(axis=1)
    near = np.abs(centre) <= FARTHEST
    if not near.all():
        finite &= near.all(axis=1)
    extras |= extra_columns(columns, names - used)
    keep: Array | slice = slice(None)
    if dropped := int(np.count_nonzero(~finite)):
        keep = finite
        far = f", or centres beyond {FARTHEST:g}" if (np.abs(centre[np.isfinite(centre)]) > FARTHEST).any() else ""
        notes.append(f"{dropped} of {len(finite)} splats dropped: NaN or infinite values{far}")
    unknown = sorted(n for n in names - used if not re.fullmatch(layout.known + r"|n[xyz]", n))
    if unknown:
        notes.append(f"{len(unknown)} unknown properties kept: {', '.join(unknown[:8])}{' ...' * (len(unknown) > 8)}")
    surfels = Surfels(
        centre[keep],
        axes[keep],
        rotation[keep],
        opacity[keep],
        **{name: array[keep] for name, array in material.items()},
        sh=None if sh is None else sh[keep],
        extras=sanitised({name: array[keep] for name, array in extras.items()}, notes),
    )
    return SurfelFile(surfels, layout.name, unknown, notes, assumed=assumed)


def _albedo(layout: Layout, take: Callable[[tuple[str, ...]], Array], sh: Array | None, notes: list[str]) -> Array:
    """Linear albedo: the trained one, else the captured colour of the file (display-referred sRGB)."""
    if layout.albedo is not None:
        albedo = layout.albedo.activate(take(layout.albedo.properties))
        return srgb_to_linear(albedo) if layout.srgb else albedo
    if sh is None:
        take(("f_dc_0", "f_dc_1", "f_dc_2"))  # names what is missing
        raise AssertionError("unreachable: without f_dc the line above raises")
    notes.append(CAPTURED_ALBEDO)
    return srgb_to_linear(np.clip(0.5 + SH_C0 * sh[:, 0], 0.0, 1.0))


def _scalar(channel: Channel | None, take: Callable[[tuple[str, ...]], Array], default: float, n: int) -> Array:
    if channel is None:
        return np.full(n, default, np.float32)
    return channel.activate(take(channel.properties)[:, 0])


def _harmonics(columns: Columns, names: set[str], used: set[str], subject: str) -> Array | None:
    """(n, k, 3) spherical harmonics from f_dc and the channel-major f_rest, or None without f_dc."""
    dc = ("f_dc_0", "f_dc_1", "f_dc_2")
    if not names.issuperset(dc):
        return None
    rest = sorted((n for n in names if re.fullmatch(r"f_rest_\d+", n)), key=lambda n: int(n[7:]))
    if len(rest) % 3 or rest != [f"f_rest_{i}" for i in range(len(rest))] or len(rest) > 3 * SH_LIMIT:
        raise AssetError(subject, f"has {len(rest)} f_rest properties, which is no whole number of colours", _REMEDY)
    used.update(dc, rest)
    per_channel = len(rest) // 3
    sh = np.empty((len(columns["x"]), 1 + per_channel, 3), np.float32)
    sh[:, 0] = stack(columns, dc)
    if rest:
        side = beside(columns, tuple(rest))
        for channel in range(3):
            names_of = slice(channel * per_channel, (channel + 1) * per_channel)
            sh[:, 1:, channel] = stack(columns, tuple(rest[names_of])) if side is None else side[:, names_of]
    return sh


def _flatten(rotation: Array, axes: Array, notes: list[str]) -> tuple[Array, Array]:
    """3D Gaussians to surfels: drop the shortest axis, which becomes the normal; the frame stays right-handed."""
    shortest = np.argmin(axes, axis=1)
    rows = np.arange(len(axes))
    kept = np.stack([axes[rows, (shortest + 1) % 3], axes[rows, (shortest + 2) % 3]], axis=1)
    # Rotations that carry X, Y, Z onto the axes (k + 1, k + 2, k) for the dropped axis k.
    turn = np.array([[0.5, 0.5, 0.5, 0.5], [0.5, -0.5, -0.5, -0.5], [1, 0, 0, 0]], np.float32)[shortest]
    with np.errstate(invalid="ignore"):
        thick = int(np.count_nonzero(axes[rows, shortest] > FLAT * kept.min(axis=1)))
    notes.append(
        f"3D Gaussians: the shortest axis became the normal; {thick} of {len(axes)} were far from flat "
        f"(shortest above {FLAT:g} of the next)"
    )
    if len(axes) and np.count_nonzero(shortest == 0) >= 0.999 * len(axes):
        notes.append("the shortest axis is scale_0 throughout, as SuGaR writes it")
    return multiply_quaternions(rotation, turn).astype(np.float32), kept


def _decode_face_positions(columns: Columns, centre: Array, notes: list[str]) -> tuple[Array, Array]:
    """GaussianMesh: softmax barycentric coordinates on a face, and an offset along its normal."""
    logits = stack(columns, ("ca", "cb", "cc"))
    weights = np.exp(logits - logits.max(axis=1, keepdims=True))
    weights /= weights.sum(axis=1, keepdims=True)
    corners = [next((c for c in _corner_names(k) if all(n in columns for n in c)), None) for k in (1, 2, 3)]
    if any(c is None for c in corners) or "dis" not in columns or "radius" not in columns:
        notes.append("lacks the corners of the faces: positions are taken as they are in the file")
        return centre, weights
    a, b, c = (stack(columns, names) for names in corners if names is not None)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    offset = 4.0 * columns["radius"] * (sigmoid(columns["dis"]) - 0.5)
    notes.append("positions decoded from the faces they hang on; face numbers and weights are in the extras")
    return weights[:, :1] * a + weights[:, 1:2] * b + weights[:, 2:] * c + offset[:, None] * normal, weights


def _corner_names(k: int) -> tuple[tuple[str, str, str], ...]:
    return (f"v{k}x", f"v{k}y", f"v{k}z"), (f"v{k}_x", f"v{k}_y", f"v{k}_z"), (f"v{k}_0", f"v{k}_1", f"v{k}_2")
