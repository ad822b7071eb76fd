"""Captured surfels, their mesh and their light made into one bound asset."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core.asset.model import SURFEL_CHANNELS, Asset, Mesh, Surfels
from ..core.errors import AssetError
from ..deform.binding import bind, project
from ..deform.face_frames import Faces
from ..formats.axes import scaled_surfels, surfels_to_z_up
from ..formats.files import MaterialsFile, MeshFile, SurfelFile, plain_name
from ..formats.gaussian_ply import LAYOUTS
from .make import mesh_with_materials, read_environment_of, read_mesh_file, scale_mesh
from .proxy import mesh_from_surfels
from .refine import TOLERANCE
from .transfer import surfels_to_vertices, vertices_to_surfels

Array = np.ndarray
log = logging.getLogger(__name__)

#: Part of the surfels that must lie in the box of the mesh, widened by a tenth of its diagonal.
OVERLAP = 0.5
#: Largest median distance between surfels and mesh, as part of the surfels' extent, and largest ratio of the extents.
APART = 0.1
RATIO = 8.0
#: Surfels whose distance to the mesh is measured.
SAMPLE = 2000
#: Where materials come from that only the surfels have, by whether their file knows any.
CAPTURED = "captured colour of the surfels, light included"
_SURFELS_OWN = {True: "of the surfels", False: CAPTURED}


def import_asset(
    surfels: str | Path | SurfelFile,
    mesh: str | Path | MeshFile | None = None,
    environment: str | Path | None = None,
    up: str | None = None,
    *,
    materials: str | Path | MaterialsFile | None = None,
    resolution: int = 192,
    max_triangles: int = 300_000,
    meshless: bool = False,
    scale: float = 1.0,
) -> Asset:
    """Read captured surfels and what belongs to them, and bind them.

    Parameters
    ----------
    surfels : str, Path or SurfelFile
        Path of surfels or splats, or a file already read.
    mesh : str, Path or MeshFile, optional
        Path of the mesh they were captured with; None builds a closed one around them.
    environment : str or Path, optional
        Path of the light of the capture.
    up : str, optional
        "z", "y", "-z" or "-y", the up axis of surfels and mesh; None is what the formats say, and Z where they say
        nothing.
    materials : str, Path or MaterialsFile, optional
        Materials of the mesh's vertices kept apart from it (NeRO's folder), or such a file already read.
    resolution : int
        Voxels along the longest side of a mesh that is built.
    max_triangles : int
        Budget for texture detail of a textured mesh.
    meshless : bool
        Build no mesh: the surfels follow their object's matrix, and light meets them alone.
    scale : float
        Factor on all lengths of surfels and mesh.

    Returns
    -------
    Asset
        What was converted, dropped and assumed is in ``provenance["report"]``. Materials that only the surfels have
        are carried to the mesh and the other way round; ``provenance["materials"]`` says which.
    """
    surfel_name = "surfels" if isinstance(surfels, SurfelFile) else str(surfels)
    file = surfels if isinstance(surfels, SurfelFile) else _read_surfels(surfels)
    report: dict[str, Any] = {"layout": file.layout, "surfel_notes": list(file.notes)}
    captured, report["not_finite"] = _finite(file.surfels, surfel_name, file.notes)
    if turned := up or file.up:
        captured = surfels_to_z_up(captured, turned)
    captured = scaled_surfels(captured, scale)

    surfels_known = any(layout.name == file.layout and layout.albedo is not None for layout in LAYOUTS)
    provenance: dict[str, Any] = {"surfels": plain_name(surfel_name), "report": report}
    if environment is not None:
        provenance["environment"] = plain_name(environment)
    if meshless:
        provenance["materials"] = _SURFELS_OWN[surfels_known]
        return Asset(captured, Mesh.empty(), None, read_environment_of(environment), provenance)

    if mesh is None:
        mesh_name, surface_known = "mesh built from the surfels", False
        surface, report["mesh"] = mesh_from_surfels(captured, surfel_name, resolution=resolution)
    else:
        mesh_name = "mesh" if isinstance(mesh, MeshFile) else str(mesh)
        mesh_file = _with_materials(read_mesh_file(mesh), materials, mesh_name)
        surface_known = _has_materials(mesh_file)
        surface, report["mesh"] = mesh_with_materials(
            mesh_file, mesh_name, up=up, max_triangles=max_triangles, tolerance=TOLERANCE
        )
        scale_mesh(surface, scale, mesh_name)
        check_overlap(captured, surface, surfel_name, mesh_name)

    binding, report["binding"] = bind(surface, captured)
    if surface_known and not surfels_known:
        vertices_to_surfels(surface, captured, binding)
        origin = "of the mesh, carried to the surfels"
    elif surface_known:
        vertices_to_surfels(surface, captured, binding, SURFEL_CHANNELS)  # files of surfels have none of these
        origin = "of the surfels and of the mesh, as they are"
    else:
        report["vertices_without_surfels"] = surfels_to_vertices(surface, captured, binding)
        origin = f"{_SURFELS_OWN[surfels_known]}, carried to the mesh"
    provenance |= {"mesh": plain_name(mesh_name), "materials": origin}
    log.info("imported %d surfels of %s: %s", len(captured), surfel_name, report)
    return Asset(captured, surface, binding, read_environment_of(environment), provenance)


def _read_surfels(path: str | Path) -> SurfelFile:
    from ..formats.registry import read_surfels

    return read_surfels(path)


def _with_materials(mesh: MeshFile, source: str | Path | MaterialsFile | None, name: str) -> MeshFile:
    """The mesh with materials from a file of their own in place of its own."""
    if source is None:
        return mesh
    if not isinstance(source, MaterialsFile):
        from ..formats.materials import read_nero_materials

        source = read_nero_materials(Path(source))
    if len(source.albedo) != len(mesh.vertices):
        raise AssetError(
            name,
            f"has {len(mesh.vertices)} vertices but its materials are of {len(source.albedo)}",
            "Choose the mesh that the materials were made with",
        )
    return replace(
        mesh,
        materials=[],
        face_material=None,
        vertex_colours=source.albedo,
        vertex_roughness=source.roughness,
        vertex_metallic=source.metallic,
    )


def _finite(surfels: Surfels, name: str, notes: Sequence[str]) -> tuple[Surfels, int]:
    """Surfels without those that have a number that is not finite, and how many those were."""
    if not len(surfels):
        why = "".join(f": {note}" for note in notes if "dropped" in note)
        raise AssetError(name, f"has no surfels{why}", "Export the capture again")
    good = np.ones(len(surfels), bool)
    names = [name for name in Surfels.__dataclass_fields__ if name not in ("sh", "extras")]
    names = [name for name in names if getattr(surfels, name) is not None]
    for channel in names:
        good &= np.isfinite(getattr(surfels, channel).reshape(len(surfels), -1)).all(axis=1)
    if not good.any():
        raise AssetError(name, f"has {len(surfels)} surfels, none with finite values", "Export the capture again")
    if good.all():
        return replace(surfels), 0
    kept = {channel: getattr(surfels, channel)[good] for channel in names}
    sh = None if surfels.sh is None else surfels.sh[good]
    extras = {key: values[good] for key, values in surfels.extras.items()}
    return Surfels(**kept, sh=sh, extras=extras), int((~good).sum())


def _has_materials(file: MeshFile) -> bool:
    """Whether a mesh file says what its surface is made of; bare vertex colours are the capture's radiance."""
    return bool(file.materials) or file.vertex_roughness is not None or file.vertex_metallic is not None


def check_overlap(surfels: Surfels, mesh: Mesh, surfel_name: str, mesh_name: str) -> None:
    """Raise AssetError when most surfels lie away from the mesh, or the two are of different units."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    margin = 0.1 * np.linalg.norm(high - low)
    inside = ((surfels.centre >= low - margin) & (surfels.centre <= high + margin)).all(axis=1).mean()
    step = -(-len(surfels) // SAMPLE)
    distance = float(np.median(project(mesh, Faces.of(mesh.vertices, mesh.faces), surfels.centre[::step])[2]))
    # Without the outermost points: captures have floaters, meshes have splinters.
    extents = [
        float(np.linalg.norm(np.subtract(*np.quantile(points, (0.98, 0.02), axis=0))))
        for points in (surfels.centre, mesh.vertices)
    ]
    foreign = max(extents) > RATIO * min(extents)
    if inside < OVERLAP or distance > APART * extents[0] or foreign:
        box = lambda points: " x ".join(f"{v:.4g}" for v in np.ptp(points, axis=0))  # noqa: E731
        at = lambda points: ", ".join(f"{v:.4g}" for v in points.mean(axis=0))  # noqa: E731
        raise AssetError(
            f"{surfel_name} and {mesh_name}",
            f"do not {'fit' if inside >= OVERLAP else 'overlap'}: {100 * inside:.0f} % of the surfels are in the box "
            f"of the mesh, at a median distance of {distance:.4g}; the surfels measure "
            f"{box(surfels.centre)} around ({at(surfels.centre)}), the mesh {box(mesh.vertices)} around "
            f"({at(mesh.vertices)})",
            "Choose the mesh of this capture, in the same units and with the same up axis",
        )
