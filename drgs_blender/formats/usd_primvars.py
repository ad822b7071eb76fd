"""Materials of splats in USD: primvars with the names that Houdini's points have, see docs/relightable-splats.md.

`orient` and `scale`: https://www.sidefx.com/docs/houdini/copy/instanceattrs.html. Houdini's own splats (Bake GSplat)
have GS_Alpha in place of Alpha, and the captured colour as Cd.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .splats import Splats, normals

Array = np.ndarray

#: Primvars that are read back, without their namespace: albedo, roughness and metallic.
ALBEDO, ROUGHNESS, METALLIC = "Cd", "rough", "metallic"
#: The linear light that colours are in, whatever the prim says of its harmonics.
LINEAR_SPACE = "lin_rec709_scene"


def primvar_values(prim: Any, splats: Splats) -> list[tuple[Any, Any]]:
    """The normals and materials of splats, one a particle, as attributes made on `prim` with what to set them to."""
    from pxr import Sdf, UsdGeom, Vt

    if splats.materials is None:
        return []
    types = Sdf.ValueTypeNames
    albedo, roughness, metallic = (np.ascontiguousarray(array) for array in splats.materials.arrays())
    # In memory the imaginary part of a quaternion comes first.
    orient = Vt.QuatfArray.FromNumpy(np.ascontiguousarray(splats.rotation[:, [1, 2, 3, 0]]))
    values = [
        (ALBEDO, types.Color3fArray, Vt.Vec3fArray.FromNumpy(albedo)),
        ("Alpha", types.FloatArray, Vt.FloatArray.FromNumpy(np.ascontiguousarray(splats.opacity))),
        ("scale", types.Float3Array, Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(splats.scale))),
        ("orient", types.QuatfArray, orient),
        ("N", types.Normal3fArray, Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(normals(splats.rotation)))),
        (ROUGHNESS, types.FloatArray, Vt.FloatArray.FromNumpy(roughness)),
        (METALLIC, types.FloatArray, Vt.FloatArray.FromNumpy(metallic)),
    ]
    primvars, found = UsdGeom.PrimvarsAPI(prim), []
    for name, kind, value in values:
        attribute = primvars.CreatePrimvar(name, kind, UsdGeom.Tokens.vertex).GetAttr()
        if kind == types.Color3fArray:
            attribute.SetColorSpace(LINEAR_SPACE)
        found.append((attribute, value))
    return found
