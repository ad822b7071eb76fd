"""The mesh of an asset as an ordinary glTF object: metallic-roughness textures, baked, so that any engine shows it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..core.asset import Mesh
from ..geometry.normals import VertexNormals
from .atlas import UniformMaterial, mesh_material
from .files import plain_name
from .glb import Glb


def write_gltf_mesh(path: Path, mesh: Mesh) -> None:
    """Write a GLB with `mesh`, which is Y up; its materials as `atlas` puts them.

    Raises
    ------
    UsageError
        The mesh has no faces, or more than a texture has room for.
    WriteError
        The file cannot be written.
    """
    glb = Glb()
    material = mesh_material(mesh, str(path))
    normals = VertexNormals(mesh.faces, len(mesh.vertices))(mesh.vertices)
    pbr: dict[str, Any] = {}
    if isinstance(material, UniformMaterial):
        pbr |= {"baseColorFactor": [*material.colour, 1.0]}
        pbr |= {"roughnessFactor": material.roughness, "metallicFactor": material.metallic}
        attributes = {
            "POSITION": glb.accessor(mesh.vertices, bounds=True),
            "NORMAL": glb.accessor(normals.astype(np.float32)),
        }
        primitive: dict[str, Any] = {"indices": glb.accessor(mesh.faces.astype(np.uint32).ravel())}
    else:
        views = [glb.view(picture) for picture in (material.colour, material.surface)]
        glb.json["images"] = [{"bufferView": view, "mimeType": "image/png"} for view in views]
        glb.json["samplers"] = [{"magFilter": 9729, "minFilter": 9729, "wrapS": 33071, "wrapT": 33071}]
        glb.json["textures"] = [{"sampler": 0, "source": i} for i in range(2)]
        pbr |= {"baseColorTexture": {"index": 0}, "metallicRoughnessTexture": {"index": 1}}
        corners = mesh.faces.ravel()
        attributes = {
            "POSITION": glb.accessor(mesh.vertices[corners], bounds=True),
            "NORMAL": glb.accessor(normals[corners].astype(np.float32)),
            "TEXCOORD_0": glb.accessor(material.uvs.reshape(-1, 2)),
        }
        primitive = {}
    primitive |= {"attributes": attributes, "material": 0}
    glb.json |= {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": plain_name(path.stem)}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"name": plain_name(path.stem), "pbrMetallicRoughness": pbr, "doubleSided": True}],
    }
    glb.write(path)
