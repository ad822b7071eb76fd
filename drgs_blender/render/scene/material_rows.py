"""Materials of the general BSDF as flat arrays, a row per part; `bsdf.surface_parameters` reads them.

Kernels of scenes without such materials do not depend on the BSDF, so this imports none of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ...core.materials import Material, Part, Texture

Array = np.ndarray

#: Function of a texture, its subject and a material's index, to its row among textures.
AddTexture = Callable[[Texture, str, int], int]

#: Columns of a material's parameters, by name of its field, with the number of values; ``weight`` is of a part.
PARAMETERS = {
    "base_colour": 3, "roughness": 1, "metallic": 1, "ior": 1, "specular_level": 1, "specular_tint": 3, "anisotropy": 1,
    "anisotropy_rotation": 1, "coat": 1, "coat_roughness": 1, "coat_ior": 1, "coat_tint": 3, "sheen": 1,
    "sheen_roughness": 1, "sheen_tint": 3, "transmission": 1, "diffuse_roughness": 1, "weight": 3,
}  # fmt: skip
PARAMETER_COUNT = sum(PARAMETERS.values())
#: Kinds of materials.
KINDS = ("principled", "glass", "refraction", "glossy", "diffuse", "translucent", "sheen")
#: Columns of a row's integers: kind, whether it is thin-walled, Multiscatter GGX, whether the coat has the normal's
#: details, layer of the directions that highlights follow, whether the weight's texture is inverted, whether base
#: colour, roughness and metallic are those of the shading point; textures.
KIND, THIN, MULTISCATTER, COAT_DETAILS, ALONG, INVERTED, OF_POINT, TEXTURES = range(8)
_NAMES = tuple(PARAMETERS)
INTS = TEXTURES + len(_NAMES)
#: Largest values of parameters; 1 of what is not here.
_HIGHEST = {
    "base_colour": 1e3, "ior": 1e3, "specular_level": 1e3, "coat_ior": 1e3, "weight": 1e3, "anisotropy_rotation": 1e3,
}  # fmt: skip
_LOWEST = {"ior": 1e-5, "anisotropy": -1.0, "anisotropy_rotation": -1e3, "coat_ior": 1.0}
#: Most parts of a material.
MOST_PARTS = 8
#: By parameter: number of values, first column, largest and least value.
WIDTHS = tuple(PARAMETERS.values())
STARTS = tuple(sum(WIDTHS[:i]) for i in range(len(WIDTHS)))
HIGH = tuple(np.float32(_HIGHEST.get(name, 1.0)) for name in _NAMES)
LOW = tuple(np.float32(_LOWEST.get(name, 0.0)) for name in _NAMES)
#: Neutral values of a surface that has no row.
_NEUTRAL = Material("")


class MaterialRows(NamedTuple):
    """Materials of the general BSDF; valid with the table that they come from.

    Attributes
    ----------
    first, parts : (materials,) int32 array
        Rows of each material; none of one without further lobes.
    values : (rows, PARAMETER_COUNT) float32 array
        Parameters, in the order of `PARAMETERS`.
    ints : (rows, INTS) int32 array
        See above; textures are rows, or -1.
    neutral : (PARAMETER_COUNT,) float32 array
        Parameters of a surface without a row.
    """

    first: Array
    parts: Array
    values: Array
    ints: Array
    neutral: Array


def material_rows(
    materials: Sequence[Material],
    add_texture: AddTexture,
    layer_row: Callable[[int, str, bool], int | None],
    warnings: list[str],
) -> MaterialRows | None:
    """Rows of all materials that have more lobes than a diffuse and a glossy one; None where there is none.

    Parameters
    ----------
    materials : sequence of Material
    add_texture, layer_row : callable
        Of the table of materials.
    warnings : list of str
        Added to: values out of range and what is left out.
    """
    if not any(material.has_more_lobes for material in materials):
        return None
    first, count = np.zeros((2, len(materials)), np.int32)
    values: list[Array] = []
    ints: list[Array] = []
    for index, material in enumerate(materials):
        first[index] = len(values)
        if not material.has_more_lobes:
            continue
        parts = material.parts or [Part(material)]
        if len(parts) > MOST_PARTS:
            warnings.append(
                f"{material.name}: it mixes {len(parts)} surfaces; only the first {MOST_PARTS} are rendered"
            )
            parts = parts[:MOST_PARTS]
        for part in parts:
            values.append(_values(part, warnings))
            ints.append(_ints(part, index, add_texture, layer_row, warnings))
        count[index] = len(parts)
    return MaterialRows(first, count, np.array(values), np.array(ints), _values(Part(_NEUTRAL), []))


def _values(part: Part, warnings: list[str]) -> Array:
    material, found = part.material, np.zeros(PARAMETER_COUNT, np.float32)
    for i, (name, start, width) in enumerate(zip(_NAMES, STARTS, WIDTHS)):
        given = np.atleast_1d(np.asarray(part.weight if name == "weight" else getattr(material, name), np.float64))[:3]
        textured = _texture(part, name) is not None
        highest = max(float(HIGH[i]), 1e3) if textured else float(HIGH[i])
        kept = np.clip(np.where(np.isnan(given), 0.0, given), float(LOW[i]), highest)
        # Those of any material are checked where `material_at` gets them.
        if not np.array_equal(given, kept) and name not in ("base_colour", "roughness", "metallic"):
            warnings.append(f"{material.name}: {name.replace('_', ' ')} {given} is out of range, taken as {kept}")
        found[start : start + width] = kept
    return found


def _texture(part: Part, name: str) -> Texture | None:
    if name == "weight":
        return part.weight_texture
    if name in ("base_colour", "roughness", "metallic"):
        found: Texture | None = getattr(part.material, f"{name}_texture")
        return found
    return part.material.textures.get(name)


def _ints(
    part: Part,
    index: int,
    add_texture: AddTexture,
    layer_row: Callable[[int, str, bool], int | None],
    warnings: list[str],
) -> Array:
    material, found = part.material, np.full(INTS, -1, np.int32)
    found[KIND] = KINDS.index(material.kind) if material.kind in KINDS else 0
    if material.kind not in KINDS:
        warnings.append(f"{material.name}: kind {material.kind!r} of BSDF is unknown, taken as principled")
    found[THIN], found[MULTISCATTER], found[INVERTED] = material.thin_walled, material.multiscatter, part.inverted
    found[COAT_DETAILS], found[OF_POINT] = material.coat_details, material.of_point
    for i, name in enumerate(_NAMES):
        texture = _texture(part, name)
        if texture is not None:
            found[TEXTURES + i] = add_texture(texture, f"{material.name}, {name.replace('_', ' ')}", index)
    if material.anisotropy != 0.0:
        row = layer_row(index, material.tangent, True)
        if row is None and material.tangent:
            row = layer_row(index, material.tangent, False)
        if row is None and material.tangent:
            warnings.append(f"{material.name}: its mesh has no layer {material.tangent!r}; anisotropy has no direction")
        found[ALONG] = -1 if row is None else row
    return found
