"""The one table of render passes (AOVs): the engine fills it, the EXR writer and Blender's view layer read it."""

from __future__ import annotations

from dataclasses import dataclass


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
    """

    name: str
    channels: str
    kind: str
    blender: str
    about: str
    exact: bool = False


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
    Pass("DiffDir", "RGB", "COLOR", "use_pass_diffuse_direct", "Direct diffuse light, colour included"),
    Pass("DiffInd", "RGB", "COLOR", "use_pass_diffuse_indirect", "Indirect diffuse light, colour included"),
    Pass("GlossDir", "RGB", "COLOR", "use_pass_glossy_direct", "Direct glossy light, colour included"),
    Pass("GlossInd", "RGB", "COLOR", "use_pass_glossy_indirect", "Indirect glossy light, colour included"),
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
    *("DiffDir", "DiffInd", "GlossDir", "GlossInd", "Emit", "Env", "Variance", "Previous Position"),
)

#: name -> Pass
BY_NAME: dict[str, Pass] = {p.name: p for p in PASSES}
