"""The one table of render passes (AOVs): the engine fills it, the EXR writer and Blender's view layer read it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .memory import filled_columns, sparse_zeros

Array = np.ndarray

#: Rows that are divided by a colour at a time.
_ROWS = 64


@dataclass(frozen=True, slots=True)
class Pass:
    """One render pass (AOV).

    Attributes
    ----------
    name : str
        Name in Frame.passes and layer name in EXR files (Blender's own name where Blender has the pass).
    channels : str
        Channel letters, as Blender's ``add_pass`` wants them.
    kind : str
        Blender's pass type: "COLOR", "VECTOR" or "VALUE".
    blender : str
        Property of ``ViewLayer`` that switches it on in Blender; "" where DR-GS has its own switch.
    about : str
        Tooltip.
    exact : bool
        Its numbers can be neither averaged nor rounded.
    colour : str
        Of a pass of light, the pass with the colour of its surfaces, by which it is divided; "" for others.
    """

    name: str
    channels: str
    kind: str
    blender: str
    about: str
    exact: bool = False
    colour: str = ""

    @property
    def layer(self) -> str:
        """Layer in EXR files, and name in Blender where that has no other: of a shader AOV its own name."""
        return self.name.removeprefix(AOV_COLOUR).removeprefix(AOV_VALUE)


#: Beginnings of the names of passes that a scene names: shader AOVs of either type, and the light of a light group.
AOVS = AOV_COLOUR, AOV_VALUE = "AOV colour ", "AOV value "
LIGHT_GROUP = "Combined_"


def _cryptomatte(of: str, index: int) -> Pass:
    name, about = f"Crypto{of.title()}{index:02}", f"Cryptomatte of {of}s: which a pixel shows, and how much of each"
    return Pass(name, "rgba", "COLOR", f"use_pass_cryptomatte_{of}", about, exact=True)


PASSES: tuple[Pass, ...] = (
    Pass("Combined", "RGBA", "COLOR", "use_pass_combined", "Beauty, premultiplied alpha"),
    Pass("Depth", "Z", "VALUE", "use_pass_z", "Distance along the view axis in metres, 1e10 where empty"),
    Pass("Position", "XYZ", "VECTOR", "use_pass_position", "World-space position in metres"),
    Pass(
        "Vector",
        "XYZW",
        "VECTOR",
        "use_pass_vector",
        "Motion in pixels: previous place less this one, this one less the next",
    ),
    Pass("Normal", "XYZ", "VECTOR", "use_pass_normal", "World-space shading normal"),
    Pass("Albedo", "RGB", "COLOR", "", "Base colour of the surface, linear"),
    Pass("Roughness", "X", "VALUE", "", "Perceptual roughness"),
    Pass("Metallic", "X", "VALUE", "", "Metallic"),
    Pass("Coverage", "X", "VALUE", "", "Part of the pixel that surfaces cover"),
    Pass("IndexOB", "X", "VALUE", "use_pass_object_index", "Pass index of the nearest object"),
    Pass("Object", "X", "VALUE", "", "Number of the nearest object, made of its name, by which denoisers tell objects"),
    Pass("IndexMA", "X", "VALUE", "use_pass_material_index", "Pass index of the nearest surface's material"),
    Pass("UV", "UVA", "VECTOR", "use_pass_uv", "Texture coordinates of meshes by their active UV map, and coverage"),
    Pass("Mist", "Z", "VALUE", "use_pass_mist", "Distance between the limits of the World's Mist Pass, 0 to 1"),
    *(
        Pass(f"{short}{name}", "RGB", "COLOR", f"use_pass_{lobe}_{part}", f"{about} of {lobe} light", colour=colour)
        for short, lobe in (("Diff", "diffuse"), ("Gloss", "glossy"), ("Trans", "transmission"))
        for name, part, about, colour in (
            ("Dir", "direct", "Direct part, without the surface's colour,", f"{short}Col"),
            ("Ind", "indirect", "Indirect part, without the surface's colour,", f"{short}Col"),
            ("Col", "color", "Colour of the surface, the factor", ""),
        )
    ),
    Pass("Emit", "RGB", "COLOR", "use_pass_emit", "Light that seen surfaces emit"),
    Pass("Env", "RGB", "COLOR", "use_pass_environment", "Light straight from the world"),
    Pass("Variance", "XY", "VECTOR", "", "Variance of the luminance of diffuse and glossy light in the pixel"),
    Pass("Previous Position", "XYZ", "VECTOR", "", "Where the surface was one frame earlier, world space, metres"),
    Pass("Noisy Image", "RGBA", "COLOR", "", "Beauty before denoising"),
    *(_cryptomatte(of, index) for of in ("object", "material") for index in range(3)),
)

#: What ``drgs denoise`` needs of every frame.
TEMPORAL: tuple[str, ...] = (
    *("Combined", "Depth", "Position", "Normal", "Albedo", "Roughness", "Metallic", "Coverage", "IndexOB"),
    *("DiffDir", "DiffInd", "DiffCol", "GlossDir", "GlossInd", "GlossCol", "Emit", "Env", "Variance"),
    *("Previous Position", "TransDir", "TransInd", "TransCol", "Object"),
)

#: name -> Pass
BY_NAME: dict[str, Pass] = {p.name: p for p in PASSES}


def pass_of(name: str) -> Pass | None:
    """The pass of a name in a frame: a row of the table, a shader AOV or a light group; None for others."""
    named = {
        AOV_COLOUR: ("RGBA", "COLOR", "Colour that materials give to AOV Output nodes, and coverage"),
        AOV_VALUE: ("X", "VALUE", "Number that materials give to AOV Output nodes"),
        LIGHT_GROUP: ("RGB", "COLOR", "Light of one light group, not denoised"),
    }
    for start, (channels, kind, about) in named.items():
        if name.startswith(start) and len(name) > len(start):
            return Pass(name, channels, kind, "", about)
    return BY_NAME.get(name)


#: Light pass -> colour pass of its surfaces. As in Cycles, (direct + indirect) colour, of all lobes, + Emit + Env
#: is Combined.
COLOURS: dict[str, str] = {p.name: p.colour for p in PASSES if p.colour}


def with_colours(names: tuple[str, ...]) -> tuple[str, ...]:
    """`names` and the colours by which passes of light among them are divided."""
    return tuple(dict.fromkeys((*names, *(COLOURS[name] for name in names if name in COLOURS))))


def without_colour(light: Array, colour: Array) -> Array:
    """(h, w, 3) float32 `light` / `colour`; where a channel has none, the mean of the others, as in Cycles."""
    made = sparse_zeros(light.shape)
    for first in range(0, len(light), _ROWS):  # what is computed on the way takes more memory than the pass
        rows = slice(first, first + _ROWS)
        some = filled_columns(light[rows])  # the rest takes no memory
        out, lit, by = made[rows, some], light[rows, some], colour[rows, some]
        known = [by[..., c] != 0 for c in range(3)]  # by channel: NumPy is slow over axes of three
        for c, there in enumerate(known):
            np.divide(lit[..., c], by[..., c], out=out[..., c], where=there)
        grey = (out[..., 0] + out[..., 1] + out[..., 2]) / np.maximum(sum(map(np.float32, known)), 1)
        for c, there in enumerate(known):
            np.copyto(out[..., c], grey, where=~there)
    return made
