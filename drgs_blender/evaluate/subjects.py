"""Objects with known materials, from matte to mirror-like metal: what the ground truth shows.

An object lies in the unit sphere. Its materials are values at the vertices of a dense mesh, so that what Cycles renders
and what an asset holds are the same thing.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..build.make import mesh_with_materials, read_mesh_file
from ..core.errors import UsageError
from ..formats.files import Image, MaterialFile
from ..formats.images import load_image

Array = np.ndarray

#: Object -> file below the folder of example meshes, up axis and texture where it does not say, seed of materials.
MESHES: dict[str, tuple[str, str | None, str | None, int]] = {
    "spot": ("spot/spot_triangulated.obj", "y", "spot/spot_texture.png", 1),
    "cat": ("cat/egyptian_cat.glb", None, None, 2),
    "robot": ("robot/RobotExpressive.glb", None, None, 3),
    "helmet": ("helmet/FlightHelmet.gltf", None, None, 4),
}
THIN = "fern"
OBJECTS = (*MESHES, THIN)
#: Normal-incidence reflectances of polished metals, linear Rec.709.
GOLD, COPPER, SILVER = (1.0, 0.766, 0.336), (0.955, 0.638, 0.538), (0.972, 0.960, 0.915)
TRIANGLES = 60_000


def make_subject(name: str, meshes: Path) -> dict[str, Array]:
    """Arrays of an object.

    Parameters
    ----------
    name : str
        One of `OBJECTS`.
    meshes : Path
        Folder of the example meshes.

    Returns
    -------
    dict
        ``vertices`` (n, 3) and ``albedo`` (n, 3), ``roughness`` (n,), ``metallic`` (n,) float32; ``faces`` (m, 3)
        int32. Metres, Z up; albedo linear Rec.709.

    Raises
    ------
    UsageError
        There is no such object, or its file is not in the folder.
    """
    if name == THIN:
        data, seed = _fern(), 5
    elif name in MESHES:
        file, up, texture, seed = MESHES[name]
        if not (meshes / file).is_file():
            raise UsageError(f"object {name}", f"has no file {meshes / file}", "Name the folder of examples: --meshes")
        source = read_mesh_file(meshes / file, "default")  # the pose in which viewers show it
        if texture is not None:
            image = Image(load_image(meshes / texture), srgb=True)
            source.materials = [MaterialFile(name, (1.0, 1.0, 1.0), base_colour_image=image)]
            source.face_material = np.zeros(len(source.faces), np.int32)
        mesh, _ = mesh_with_materials(source, name, up=up, max_triangles=TRIANGLES)
        data = _divided(mesh.vertices, mesh.faces, mesh.albedo)
    else:
        raise UsageError(f"object {name}", "is not known", f"Choose from {', '.join(OBJECTS)}")
    vertices = np.asarray(data["vertices"], np.float64)
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    vertices = (vertices - middle) / np.linalg.norm(vertices - middle, axis=1).max()
    albedo, roughness, metallic = _materials(vertices, np.clip(data["albedo"], 0.04, 0.85), seed)
    return {
        "vertices": vertices.astype(np.float32),
        "faces": np.ascontiguousarray(data["faces"], np.int32),
        "albedo": albedo.astype(np.float32),
        "roughness": roughness.astype(np.float32),
        "metallic": metallic.astype(np.float32),
    }


def _divided(vertices: Array, faces: Array, albedo: Array) -> dict[str, Array]:
    """The mesh with enough vertices for the edges between its materials; each triangle in four as often as needed."""
    import trimesh

    while len(faces) < TRIANGLES / 4:
        vertices, faces, attributes = trimesh.remesh.subdivide(vertices, faces, vertex_attributes={"albedo": albedo})
        albedo = attributes["albedo"]
    return {"vertices": vertices, "faces": faces, "albedo": albedo}


def _step(low: float, high: float, x: Array) -> Array:
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def _waves(vertices: Array, seed: int, frequency: float) -> Callable[[], Array]:
    """A source of smooth patterns in [0, 1] over space: sums of plane waves."""
    rng = np.random.default_rng(seed)

    def pattern() -> Array:
        direction = rng.normal(size=(4, 3))
        direction *= frequency / np.linalg.norm(direction, axis=1, keepdims=True)
        phase = rng.uniform(0, 2 * np.pi, 4)
        return 0.5 + 0.5 * np.sin(vertices @ direction.T + phase).sum(axis=1) / 2.5

    return pattern


def _materials(vertices: Array, albedo: Array, seed: int) -> tuple[Array, Array, Array]:
    """(albedo, roughness, metallic): about a third is polished metal, the rest from satin to matte."""
    pattern = _waves(vertices, seed, 4.5)
    where, which, rough, polish = pattern(), pattern(), pattern(), pattern()
    metal = _step(0.62, 0.68, where)
    share = _step(0.45, 0.55, which)[:, None]
    colour = np.array(GOLD) * share + np.array(COPPER if seed % 2 else SILVER) * (1 - share)
    roughness = (0.25 + 0.65 * np.clip(rough, 0, 1)) * (1 - metal) + (0.06 + 0.24 * np.clip(polish, 0, 1)) * metal
    return albedo * (1 - metal[:, None]) + colour * metal[:, None], roughness, metal


def _fern() -> dict[str, Array]:
    """Fronds of thin leaflets, open surfaces without thickness."""
    rng = np.random.default_rng(7)
    vertices: list[Array] = []
    faces: list[Array] = []
    colours: list[Array] = []

    def blade(base: Array, tip: Array, side: Array, width: float, colour: Array, pieces: int = 4) -> None:
        """A pointed strip from base to tip, bent a little about its length."""
        start = len(vertices) * (2 * pieces + 2)
        t = np.linspace(0, 1, pieces + 1)
        middle = base + t[:, None] * (tip - base)
        half = (width * np.sqrt(np.maximum(np.sin(np.pi * (0.12 + 0.88 * t)), 0)))[:, None] * side
        vertices.append(np.concatenate([middle - half, middle + half]))
        colours.append(np.tile(colour, (2 * pieces + 2, 1)) * (0.7 + 0.5 * np.tile(t, 2)[:, None]))
        for k in range(pieces):
            a, b, c, d = start + k, start + k + 1, start + pieces + 1 + k, start + pieces + 2 + k
            faces.append(np.array([[a, b, c], [c, b, d]]))

    for frond in range(11):
        angle = 2 * np.pi * frond / 11 + rng.uniform(-0.2, 0.2)
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        across = np.array([-out[1], out[0], 0.0])
        rise, reach = rng.uniform(0.9, 1.5), rng.uniform(0.7, 1.0)
        t = np.linspace(0, 1, 19)
        spine = np.outer(reach * t**1.3, out) + np.outer(rise * (t - 0.55 * t**2.4), [0, 0, 1.0])
        green = np.array([0.10, 0.32, 0.06]) * rng.uniform(0.7, 1.4) + np.array([0.12, 0.02, 0.0]) * rng.uniform()
        for k in range(18):
            blade(spine[k], spine[k + 1], across, 0.012, np.array([0.2, 0.12, 0.05]), 1 + 3)
        for k in range(2, 18):
            length = 0.3 * np.sin(np.pi * (0.15 + 0.8 * t[k])) * rng.uniform(0.85, 1.1)
            along = spine[k + 1] - spine[k]
            along /= np.linalg.norm(along)
            for side in (-1.0, 1.0):
                tip = spine[k] + length * (side * across * 0.85 + along * 0.5 + np.array([0, 0, -0.15]))
                blade(spine[k], tip, along, 0.028, green)
    return {
        "vertices": np.concatenate(vertices),
        "faces": np.concatenate(faces),
        "albedo": np.clip(np.concatenate(colours), 0, 1),
    }
