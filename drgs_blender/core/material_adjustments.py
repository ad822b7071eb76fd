"""Edited materials: what is painted on vertices, and adjustments (tint, hue, roughness, ...) where a mask lets them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from .asset.model import MATERIAL_CHANNELS, OPTIONAL_CHANNELS, Asset, neutral_values
from .frame import Adjustment
from .texture_adjustments import edited_textures

Array = np.ndarray


def adjusted(materials: Mapping[str, Array], adjustment: Adjustment, mask: Array | None = None) -> dict[str, Array]:
    """Material channels after `adjustment`, each (n, 3) or (n,) float32 within its limits; those it can change.

    Parameters
    ----------
    materials : mapping of str to array
        "albedo" (n, 3) linear Rec.709, "roughness" (n,), "metallic" (n,); "emission" and "opacity" where they are.
    adjustment : Adjustment
    mask : (n,) array, optional
        In [0, 1] at the same places; replaces ``adjustment.mask``, which is of vertices.
    """
    made = {"albedo": recoloured(materials["albedo"], adjustment)}
    for name in ("roughness", "metallic"):
        made[name] = adjusted_number(materials[name], getattr(adjustment, name))
    share = None if mask is None else np.clip(np.nan_to_num(mask), 0, 1).astype(np.float32)
    for name, new in made.items():
        if share is not None:
            old = materials[name]
            new = old + (share[:, None] if old.ndim == 2 else share) * (new - old)
        made[name] = np.ascontiguousarray(np.clip(new, 0, 1), np.float32)
    for name in ("emission", "opacity"):
        if name in materials:
            made[name] = scaled(name, materials[name], getattr(adjustment, name), share)
    return made


def adjusted_number(values: Array, change: tuple[float, float, float, float]) -> Array:
    """Roughness or metallic after gain, offset, lowest and highest value."""
    gain, offset, low, high = change
    return np.clip(values * np.float32(gain) + np.float32(offset), low, max(low, high))


def scaled(name: str, values: Array, factor: float, mask: Array | None = None) -> Array:
    """(n,) or (n, 3) float32 `values` of a channel times `factor`, within the channel's limits; by a (n,) mask."""
    if factor == 1:
        return values
    factors = np.full(len(values), factor, np.float32)
    if mask is not None:
        factors = 1 + np.clip(np.nan_to_num(mask), 0, 1).astype(np.float32) * (factors - 1)
    new = values * (factors[:, None] if values.ndim == 2 else factors)
    return np.ascontiguousarray(np.clip(new, 0, MATERIAL_CHANNELS[name].limit), np.float32)


def recoloured(albedo: Array, adjustment: Adjustment) -> Array:
    """(n, 3) float32 albedo with another hue, saturation, value (HSV of linear values), brightness, contrast and tint.

    Not clipped at 1.
    """
    colour = np.asarray(albedo, np.float32)
    if (adjustment.hue, adjustment.saturation, adjustment.value) != (0.0, 1.0, 1.0):
        highest = colour.max(axis=1)
        chroma = highest - colour.min(axis=1)
        safe = np.where(chroma > 0, chroma, 1)
        red, green, blue = colour.T
        sector = np.where(
            highest == red,
            (green - blue) / safe,
            np.where(highest == green, 2 + (blue - red) / safe, 4 + (red - green) / safe),
        )
        sector = sector + np.float32(6 * adjustment.hue)
        saturation = np.clip(chroma / np.where(highest > 0, highest, 1) * np.float32(adjustment.saturation), 0, 1)
        value = highest * np.float32(adjustment.value)
        # A channel is the value less the share of it that its distance from the hue takes away.
        distance = np.mod(np.array([5, 3, 1], np.float32) + sector[:, None], 6)
        lost = np.clip(np.minimum(distance, 4 - distance), 0, 1)
        colour = value[:, None] * (1 - saturation[:, None] * lost)
    if (adjustment.brightness, adjustment.contrast) != (0.0, 0.0):
        gain, offset = 1 + adjustment.contrast, adjustment.brightness - adjustment.contrast / 2
        colour = np.maximum(colour * np.float32(gain) + np.float32(offset), 0)
    return np.asarray(colour * np.array(adjustment.tint, np.float32), np.float32)


def edited_asset(asset: Asset, painted: Mapping[str, Array], adjustment: Adjustment | None = None) -> Asset:
    """`asset` with other materials: `painted` per vertex (channels that are absent stay), then `adjustment`.

    Surfels follow the vertices whose value differs, as in `deform.mesh_driven`; shape, binding and light are kept, and
    so are captured colours. An optional channel that is neutral everywhere is left out; textures are kept as far as
    `edited_textures` can.
    """
    mesh, surfels = asset.mesh, asset.surfels
    names = [*mesh.channels, *(name for name in OPTIONAL_CHANNELS if name in painted and name not in mesh.channels)]
    if adjustment is not None and adjustment.opacity != 1 and "opacity" not in names:
        names.append("opacity")
    own: dict[str, Array] = {name: mesh.channel(name) for name in names}
    of_mesh = own | dict(painted)
    of_surfels = {name: followed(asset, name, of_mesh[name]) for name in names if MATERIAL_CHANNELS[name].surfels}
    if adjustment is not None:
        mask = adjustment.mask
        at_surfels = None
        if mask is not None and asset.binding is not None:
            at_surfels = np.einsum("nk,nk->n", asset.binding.barycentric, mask[mesh.faces[asset.binding.face]])
        of_mesh |= adjusted(of_mesh, adjustment, mask)
        of_surfels |= adjusted(of_surfels, adjustment, at_surfels)
    new_mesh, new_surfels = replace(mesh), replace(surfels)
    for part, values in ((new_mesh, of_mesh), (new_surfels, of_surfels)):
        for name in values:
            neutral = MATERIAL_CHANNELS[name].neutral
            unused = neutral is not None and not any(
                (v[name] != neutral).any() for v in (of_mesh, of_surfels) if name in v
            )
            setattr(part, name, None if unused else values[name])
    if mesh.textures is not None:
        new_mesh.textures, _ = edited_textures(mesh, mesh.textures, painted, adjustment)
    return replace(asset, mesh=new_mesh, surfels=new_surfels)


def followed(asset: Asset, name: str, painted: Array) -> Array:
    """A channel of the surfels after that of the vertices became `painted`, (n, 3) or (n,)."""
    own, rest = getattr(asset.surfels, name), asset.mesh.channel(name)
    if own is None:
        own = neutral_values(name, len(asset.surfels))
    changed = np.abs(painted - rest) > 1e-6
    changed = changed.any(axis=1) if changed.ndim == 2 else changed
    if asset.binding is None or not changed.any():
        return own
    corners = asset.mesh.faces[asset.binding.face]
    weights = np.maximum(asset.binding.barycentric, 0)
    share = np.where(changed[corners], weights, 0)
    total, new = weights.sum(axis=1), share.sum(axis=1)
    rows = np.flatnonzero(new > 0)
    mixed = np.einsum("nk,nk...->n...", share[rows], painted[corners[rows]])
    left, total = total[rows] - new[rows], total[rows]
    result = own.copy()
    result[rows] = (
        (left[:, None] * own[rows] + mixed) / total[:, None] if own.ndim == 2 else (left * own[rows] + mixed) / total
    )
    return result
