"""What is painted on the vertices of a mesh with textures, and adjustments, in terms of its textures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from .asset.model import Mesh
from .asset.textures import ALBEDO, FACTORS, NORMAL, SLOTS, MeshTextures, split, without
from .frame import Adjustment

Array = np.ndarray

_SLOT = {name: slot for slot, name in enumerate(SLOTS) if slot != NORMAL}
#: Those that an adjustment multiplies by a number alone.
#: Changes of the colour; the first two are factors.
COLOUR = ("tint", "value", "hue", "saturation", "brightness", "contrast")
_SCALED = ("emission", "opacity")
#: Difference from which a vertex is painted, or not at all or wholly under a mask.
_SAME = 1e-6


def painted_faces(mesh: Mesh, textures: MeshTextures, painted: Mapping[str, Array | None]) -> MeshTextures | None:
    """Textures with values of the vertices on faces with a painted corner; None where no face has an image left.

    Parameters
    ----------
    mesh : Mesh
        At rest, with its own materials.
    textures : MeshTextures
        Of this mesh.
    painted : mapping of str to (n, 3) or (n,) array or None
        Channels of the vertices; a vertex whose value differs from that of `mesh` is painted.
    """
    faces = np.zeros((len(mesh.faces), len(SLOTS)), bool)
    for name, slot in _SLOT.items():
        values = painted.get(name)
        if values is None:
            continue
        with np.errstate(invalid="ignore"):
            changed = np.abs(values - mesh.channel(name)) > _SAME
        changed = changed.any(axis=1) if changed.ndim == 2 else changed
        faces[:, slot] = changed[mesh.faces].any(axis=1)
    return without(textures, faces) if faces.any() else textures


def adjusted_textures(
    textures: MeshTextures, faces: Array, adjustment: Adjustment, mask: Array | None
) -> tuple[MeshTextures | None, Array, int]:
    """Textures under an adjustment.

    Parameters
    ----------
    textures : MeshTextures
    faces : (m, 3) array
        Of the mesh.
    adjustment : Adjustment
    mask : (n,) array, optional
        How much of it each vertex gets.

    Returns
    -------
    textures : MeshTextures or None
        With other factors where these say all of it, and values of the vertices on faces that the mask covers in part.
    pending : (k, 8) bool array
        Images of its materials that are still to be adjusted, times their factors.
    parted : int
        How many textured faces the mask covers in part.
    """
    changes = _changes(adjustment)
    whole = np.ones(len(faces), bool)
    parted = 0
    if mask is not None:
        share = np.clip(np.nan_to_num(mask), 0, 1)[faces]
        whole, none = (share >= 1 - _SAME).all(axis=1), (share <= _SAME).all(axis=1)
        partly = ~(whole | none) & (textures.material >= 0)
        parted = int(partly.sum()) if changes.any() else 0
        kept = without(textures, partly[:, None] & changes)
        if kept is None:
            return None, np.zeros((0, len(SLOTS)), bool), parted
        textures = kept
    textures, number = split(textures, whole.astype(np.int64))
    factors, pending = textures.factors.astype(np.float64), np.zeros((len(number), len(SLOTS)), bool)
    under, has = number > 0, textures.slots >= 0
    if changes[ALBEDO]:
        gain = np.array(adjustment.tint, np.float64) * adjustment.value
        linear = all(getattr(adjustment, name) == getattr(Adjustment(), name) for name in COLOUR[2:])
        plain = linear & (factors[:, :3] * gain <= 1).all(axis=1) & (gain >= 0).all()
        factors[under & plain, :3] *= gain
        pending[:, ALBEDO] = under & ~plain & has[:, ALBEDO]
    for name in ("roughness", "metallic"):
        gain, offset, low, high = getattr(adjustment, name)
        slot = _SLOT[name]
        if not changes[slot]:
            continue
        if offset == 0 and low <= 0 and high >= 1 and gain >= 0:
            factors[under, FACTORS[slot]] *= gain
        else:
            pending[:, slot] = under & has[:, slot]
    for name in _SCALED:
        columns = FACTORS[_SLOT[name]]
        factors[under, columns] *= getattr(adjustment, name)
    return replace(textures, factors=factors.astype(np.float32)), pending, parted


def edited_textures(
    mesh: Mesh, textures: MeshTextures, painted: Mapping[str, Array], adjustment: Adjustment | None
) -> tuple[MeshTextures | None, int]:
    """Textures of an edited mesh, with images as they are: what factors cannot say, is left to its vertices.

    Parameters
    ----------
    mesh : Mesh
        Before it is edited.
    textures : MeshTextures
        Its own.
    painted : mapping of str to array
    adjustment : Adjustment, optional

    Returns
    -------
    textures : MeshTextures or None
        None where no face has an image left.
    lost : int
        How many faces lost an image to the adjustment.
    """
    kept = painted_faces(mesh, textures, painted)
    if kept is None or adjustment is None:
        return kept, 0
    kept, pending, lost = adjusted_textures(kept, mesh.faces, adjustment, adjustment.mask)
    if kept is None or not pending.any():
        return kept, lost
    of_faces = np.append(pending, np.zeros((1, len(SLOTS)), bool), axis=0)[kept.material]
    return without(kept, of_faces), lost + int(of_faces.any(axis=1).sum())


def _changes(adjustment: Adjustment) -> Array:
    """(8,) bool: which slots an adjustment changes."""
    changes = np.zeros(len(SLOTS), bool)
    plain = Adjustment()
    changes[ALBEDO] = any(getattr(adjustment, name) != getattr(plain, name) for name in COLOUR)
    for name in ("roughness", "metallic", *_SCALED):
        changes[_SLOT[name]] = getattr(adjustment, name) != getattr(plain, name)
    return changes
