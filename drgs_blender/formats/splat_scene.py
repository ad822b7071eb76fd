"""Splats that hang on the nodes of a scene, as in glTF and USD: placed, joined, decoded."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ..core.color import linear_to_srgb
from .axes import FARTHEST
from .files import SurfelFile
from .gaussian_ply import SH_C0
from .harmonics import rotate_harmonics
from .packed_splats import decode_arrays, log_scale
from .splats import Splats, join_splats

Array = np.ndarray

#: Steepest part of the sRGB curve, at black.
_STEEPEST = 12.92


@dataclass(slots=True)
class Piece:
    """The splats of one node.

    Attributes
    ----------
    splats : Splats
        In the node's space; nothing in them is checked.
    matrix : (4, 4) array
        Node-to-scene.
    linear : bool
        The colours are linear, not sRGB-encoded.
    """

    splats: Splats
    matrix: Array
    linear: bool = False


def join_pieces(pieces: list[Piece], path: Path, layout: str, up: str) -> SurfelFile:
    """All splats of a scene as surfels. A node that flattens loses its splats, which is said."""
    with np.errstate(all="ignore"):
        transformed_pieces = [transformed(piece) for piece in pieces]
    whole = join_splats(transformed_pieces)
    scale = log_scale(whole.scale)
    materials = None if whole.materials is None else whole.materials.arrays()
    file = decode_arrays(whole.centre, scale, whole.rotation, whole.opacity, whole.sh, path, layout, materials)
    file.up = up
    if any(piece.linear for piece in pieces):
        file.notes.append("linear colours encoded as sRGB; where they depend on the direction, to first order")
    return file


def transformed(piece: Piece) -> Splats:
    """The splats of a node in the scene, their colours encoded."""
    own, matrix = piece.splats, piece.matrix
    sh = encoded(own.sh) if piece.linear else own.sh
    linear = matrix[:3, :3]
    if not len(own) or np.array_equal(matrix, np.eye(4)):
        return replace(own, sh=sh)
    if not (np.abs(matrix) <= FARTHEST).all() or not np.abs(np.linalg.det(linear)) > 0:
        return replace(own, centre=np.full_like(own.centre, np.nan), sh=sh)
    left, size, right = np.linalg.svd(linear)
    turn = left @ right
    centre = (own.centre @ linear.T + matrix[:3, 3]).astype(np.float32)
    usable = np.isfinite(own.rotation).all(axis=1) & (np.square(own.rotation).sum(axis=1) > 1e-30)
    usable &= np.isfinite(own.scale).all(axis=1)
    wxyz = np.where(usable[:, None], own.rotation, [1.0, 0.0, 0.0, 0.0])
    axes = Rotation.from_quat(wxyz[:, [1, 2, 3, 0]]).as_matrix()
    if size[0] - size[2] < 1e-5 * size[0]:  # the shape stays
        frame, scale = turn @ axes, own.scale * np.float32(size.mean())
    else:
        frame, scale, _ = np.linalg.svd(linear @ axes * np.where(usable[:, None], own.scale, 0)[:, None, :])
    frame[..., 2] *= np.sign(np.linalg.det(frame))[:, None]
    rotation = Rotation.from_matrix(frame).as_quat()[:, [3, 0, 1, 2]].astype(np.float32)
    rotation[~usable] = np.nan
    colours = rotate_harmonics(sh, turn)
    return replace(own, centre=centre, scale=scale.astype(np.float32), rotation=rotation, sh=colours)


def encoded(sh: Array) -> Array:
    """Harmonics of linear colour as those of sRGB: the mean exactly, the rest by the slope of the curve there."""
    colour = np.clip(0.5 + SH_C0 * sh[:, :1], 0.0, 1.0)
    slope = np.minimum(1.055 / 2.4 * np.maximum(colour, 0.0031308) ** (1 / 2.4 - 1), _STEEPEST)
    return np.concatenate([(linear_to_srgb(colour) - 0.5) / SH_C0, sh[:, 1:] * slope], axis=1).astype(np.float32)
