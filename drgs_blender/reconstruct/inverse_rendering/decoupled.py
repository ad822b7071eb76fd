"""What inverse rendering finds, and how far it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from ...core.arrays import Array
from ...core.asset.model import Mesh
from ..model.gaussians import Gaussians


@dataclass(slots=True)
class Decoupled:
    """Materials and light of a captured object.

    Attributes
    ----------
    albedo : (v, 3) float32 array
        In [0, 1], of the mesh's vertices; linear Rec.709.
    roughness, metallic : (v,) float32 array
        In [0, 1], of the mesh's vertices; linear Rec.709.
    environment : (h, 2 h, 3) float32 array
        Radiance in the mapping of `asset.Environment`, Z up, as it was around the first view where the object was
        turned (`View.turn`). What cannot be seen apart is its scale against that of the albedo.
    normals : (v, 3) float32 array or None
        Unit: smooth vertex normals, with what was learned on top; None: nothing was learned of the mesh.
    report : dict
        JSON-able: "views", "pixels", "iterations", "seconds", "psnr" (of the pixels of the last steps, dB in sRGB),
        "loss", "unseen_vertices", "exposures" (factors of the views, when learned).
    surfels : DecoupledSurfels, optional
        Where surfels have materials of their own; the arrays above are of the mesh then, carried over.
    """

    albedo: Array
    roughness: Array
    metallic: Array
    environment: Array
    normals: Array | None
    report: dict[str, Any] = field(default_factory=dict)
    surfels: DecoupledSurfels | None = None


@dataclass(slots=True)
class DecoupledSurfels:
    """Surfels with materials of their own.

    Attributes
    ----------
    gaussians : Gaussians
    albedo : (n, 3) float32 array
    roughness, metallic : (n,) float32 array
        As of `Decoupled`.
    normals : (n, 3) float32 array
        Unit shading normals.
    mesh : Mesh, optional
        Fused from them, where their shape was learned, too; its materials mean nothing.
    fusion : dict, optional
        Report of that, see `depth_fusion.fuse`.
    """

    gaussians: Gaussians
    albedo: Array
    roughness: Array
    metallic: Array
    normals: Array
    mesh: Mesh | None = None
    fusion: dict[str, Any] | None = None


@dataclass(slots=True)
class Progress:
    """Progress of a run: `part` of it is done, 0..1; `result` makes the present result."""

    iteration: int
    part: float
    loss: float
    psnr: float
    result: Callable[[], Decoupled]
