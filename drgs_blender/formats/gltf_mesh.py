"""The mesh of an asset as an ordinary glTF object: metallic-roughness textures, baked where it has none of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..core.asset import Mesh
from ..geometry.normals import VertexNormals
from .atlas import TexturedMaterial, UniformMaterial
from .files import plain_name
from .glb import Glb
from .mesh_groups import (
    FaceGroup,
    ImageMaterial,
    Picture,
    corner_normals,
    face_groups,
    joined_corners,
    pictured_material,
)

_WRAP = {"repeat": 10497, "extend": 33071, "mirror": 33648}
#: Of all coats, see `core.asset.model.MATERIAL_CHANNELS`.
_COAT_ROUGHNESS = 0.03


def write_gltf_mesh(path: Path, mesh: Mesh) -> None:
    """Write a GLB with `mesh`, which is Y up; its materials as `mesh_groups` puts them, a primitive each.

    Raises
    ------
    UsageError
        The mesh has no faces, or more than a texture has room for.
    WriteError
        The file cannot be written.
    """
    glb = Glb()
    groups = face_groups(mesh, str(path))
    writer = _Materials(glb, plain_name(path.stem))
    if mesh.textures is None:
        writer.add(groups[0].material)
        primitives = [_primitive(glb, mesh, groups[0])]
    else:
        normals, primitives = corner_normals(mesh), []
        for group in groups:
            own = normals[group.faces]
            values, index = joined_corners(mesh.vertices[mesh.faces[group.faces]], own, group.uvs)
            names = zip(("POSITION", "NORMAL", "TEXCOORD_0"), values, strict=False)
            attributes = {name: glb.accessor(array, bounds=name == "POSITION") for name, array in names}
            primitives.append({"attributes": attributes, "indices": glb.accessor(index)})
            writer.add(group.material)
    for number, primitive in enumerate(primitives):
        primitive["material"] = number
    glb.json |= {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": plain_name(path.stem)}],
        "meshes": [{"primitives": primitives}],
        "materials": writer.materials,
    }
    glb.write(path)


def _primitive(glb: Glb, mesh: Mesh, group: FaceGroup) -> dict[str, Any]:
    """All of a mesh without textures."""
    normals = VertexNormals(mesh.faces, len(mesh.vertices))(mesh.vertices)
    if group.uvs is None:
        attributes = {
            "POSITION": glb.accessor(mesh.vertices, bounds=True),
            "NORMAL": glb.accessor(normals.astype(np.float32)),
        }
        return {"indices": glb.accessor(mesh.faces.astype(np.uint32).ravel()), "attributes": attributes}
    corners = mesh.faces.ravel()
    attributes = {
        "POSITION": glb.accessor(mesh.vertices[corners], bounds=True),
        "NORMAL": glb.accessor(normals[corners].astype(np.float32)),
        "TEXCOORD_0": glb.accessor(group.uvs.reshape(-1, 2)),
    }
    return {"attributes": attributes}


class _Materials:
    """Materials of a document, with images, samplers and textures that each are there once."""

    def __init__(self, glb: Glb, name: str) -> None:
        self.materials: list[dict[str, Any]] = []
        self._glb, self._name = glb, name
        self._images: dict[bytes, int] = {}
        self._textures: dict[tuple[int, str], int] = {}

    def add(self, material: UniformMaterial | TexturedMaterial) -> None:
        """Add one."""
        if isinstance(material, TexturedMaterial):
            colour, surface = (self._texture(data, "extend") for data in (material.colour, material.surface))
            pbr: dict[str, Any] = {"baseColorTexture": colour, "metallicRoughnessTexture": surface}
        else:
            pbr = {"baseColorFactor": [*material.colour, material.opacity]}
            pbr |= {"roughnessFactor": material.roughness, "metallicFactor": material.metallic}
        entry: dict[str, Any] = {"name": self._name, "pbrMetallicRoughness": pbr, "doubleSided": True}
        if isinstance(material, ImageMaterial):
            entry["name"] = material.name
            # Factors of glTF are 1 at most.
            pbr["baseColorFactor"] = [min(max(v, 0.0), 1.0) for v in pbr["baseColorFactor"]]
            pbr |= {k: min(max(pbr[k], 0.0), 1.0) for k in ("roughnessFactor", "metallicFactor")}
            if material.colour_picture is not None:
                pbr["baseColorTexture"] = self._of(material.colour_picture)
            if material.surface_picture is not None:
                pbr["metallicRoughnessTexture"] = self._of(material.surface_picture)
            if material.normal_picture is not None:
                entry["normalTexture"] = self._of(material.normal_picture) | {"scale": material.normal_strength}
        entry |= self._optional_channels(material)
        used = {*self._glb.json.get("extensionsUsed", ()), *entry.get("extensions", ())}
        if used:
            self._glb.json["extensionsUsed"] = sorted(used)
        self.materials.append(entry)

    def _optional_channels(self, material: UniformMaterial | TexturedMaterial) -> dict[str, Any]:
        """Opacity, emission, specular level and coat as glTF has them; nothing where they are neutral."""
        found: dict[str, Any] = {}
        extensions: dict[str, Any] = {}
        specular: dict[str, Any] = {}
        coat: dict[str, Any] = {}
        if isinstance(material, UniformMaterial):
            pictured = pictured_material(material)
            translucent = material.opacity < 1 or pictured.translucent
            radiance, level = max(material.emission), material.specular
            if radiance > 0:
                found["emissiveFactor"] = [value / max(radiance, 1.0) for value in material.emission]
                if pictured.emission_picture is not None:
                    found["emissiveTexture"] = self._of(pictured.emission_picture)
            if material.coat > 0:
                coat = {"clearcoatFactor": material.coat}
                if pictured.coat_picture is not None:
                    coat["clearcoatTexture"] = self._of(pictured.coat_picture)
            if level != 0.5 or pictured.specular_picture is not None:
                specular = {"specularFactor": min(2 * level, 1.0)}
                if pictured.specular_picture is not None:
                    specular["specularTexture"] = self._of(pictured.specular_picture)
        else:
            translucent, radiance, level = material.translucent, material.strength, material.level
            if material.emission is not None:
                texture = self._texture(material.emission, "extend")
                found |= {"emissiveFactor": [min(radiance, 1.0)] * 3, "emissiveTexture": texture}
            if material.layers is not None:
                texture = self._texture(material.layers, "extend")
                specular = {"specularFactor": min(2 * level, 1.0), "specularTexture": texture}
                coat = {"clearcoatFactor": 1.0, "clearcoatTexture": texture}
        if translucent:
            found["alphaMode"] = "BLEND"
        if radiance > 1:
            extensions["KHR_materials_emissive_strength"] = {"emissiveStrength": radiance}
        if level > 0.5:  # a factor of 1 is a level of 0.5; the colour goes beyond
            specular["specularColorFactor"] = [2 * level] * 3
        if specular:
            extensions["KHR_materials_specular"] = specular
        if coat:
            extensions["KHR_materials_clearcoat"] = coat | {"clearcoatRoughnessFactor": _COAT_ROUGHNESS}
        return found | ({"extensions": extensions} if extensions else {})

    def _of(self, picture: Picture) -> dict[str, int]:
        return self._texture(picture.data, picture.extension)

    def _texture(self, data: bytes, extension: str) -> dict[str, int]:
        """Reference to the texture of an image."""
        lists = self._glb.json
        if data not in self._images:
            self._images[data] = len(self._images)
            kind = "image/png" if data.startswith(b"\x89PNG") else "image/jpeg"
            lists.setdefault("images", []).append({"bufferView": self._glb.view(data), "mimeType": kind})
        key = self._images[data], extension
        if key not in self._textures:
            wrap = _WRAP[extension]
            sampler = {"magFilter": 9729, "minFilter": 9729, "wrapS": wrap, "wrapT": wrap}
            samplers = lists.setdefault("samplers", [])
            if sampler not in samplers:
                samplers.append(sampler)
            self._textures[key] = len(self._textures)
            lists.setdefault("textures", []).append({"sampler": samplers.index(sampler), "source": key[0]})
        return {"index": self._textures[key]}
