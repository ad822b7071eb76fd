"""Meshes of DR-GS objects that are met with materials of their own: textures, emission, opacity.

Whatever the renderer does with ordinary meshes it then does with these objects: their images are looked up, they are
sampled as mesh lights, and rays stop at them by chance. Values of vertices are layers.

Where a channel is painted, faces have the values of their vertices in place of the image. Adjustments change factors
where these can say it, else a copy of the image; faces that a mask covers in part have values of their vertices.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..core.asset.model import Asset
from ..core.asset.textures import ALBEDO, EXTENSIONS, METALLIC, NORMAL, ROUGHNESS, MeshTextures
from ..core.frame import Layer, ObjectState
from ..core.materials import Image, Material, SurfaceDetail, Texture
from ..core.texture_adjustments import adjusted_textures, painted_faces
from ..render.scene.trace_scene import ObjectMesh, TraceObject
from .asset_textures import TexturedAsset

Array = np.ndarray

_CHANNEL = {ROUGHNESS: "g", METALLIC: "b", NORMAL: "rgb", ALBEDO: "rgb"}
#: Layers with values of vertices: albedo; roughness, metallic and opacity; emission.
_COLOURS, _NUMBERS, _LIGHT = "albedo", "roughness, metallic and opacity", "emission"
#: What is at the vertices, by slot.
_OF_VERTICES = {
    ALBEDO: Texture("", layer=_COLOURS),
    ROUGHNESS: Texture("", channel="r", layer=_NUMBERS),
    METALLIC: Texture("", channel="g", layer=_NUMBERS),
}


def object_mesh(
    state: ObjectState,
    traced: TraceObject,
    asset: Asset,
    owner: int,
    channels: Mapping[str, Array],
    textured: TexturedAsset | None,
) -> tuple[ObjectMesh | None, list[Image], list[str]]:
    """The object's mesh with its materials, the images that it needs, and what is wrong, in words for the user.

    None where it has no textures and neither emits nor lets light pass, or where it is torn to nothing.

    Parameters
    ----------
    state : ObjectState
    traced : TraceObject
        The same with materials at its vertices, painted and adjusted.
    asset : Asset
    owner : int
        Index of the object.
    channels : mapping of str to array
        Of `optional_channels`, painted and adjusted.
    textured : TexturedAsset, optional
        None: textures are not met.
    """
    emission, opacity = channels.get("emission"), channels.get("opacity")
    mesh = asset.mesh
    if not len(mesh.faces) or (traced.torn is not None and traced.torn.all()):
        return None, [], []
    if textured is None and emission is None and opacity is None:
        return None, [], []
    faults: list[str] = []
    shown: MeshTextures | None = None
    pending: Array = np.zeros((0, 4), bool)
    if textured is not None:
        faults += [f"{state.name}: {fault}" for fault in textured.faults]
        painted = {name: getattr(state, name) for name in ("albedo", "roughness", "metallic")}
        shown = painted_faces(mesh, textured.textures, painted)
    if shown is not None and state.adjustment is not None:
        shown, pending, parted = adjusted_textures(shown, mesh.faces, state.adjustment, state.adjustment.mask)
        if parted:
            faults.append(
                f"{state.name}: the mask of its adjustments covers {parted} textured faces in part; these show the "
                "materials of their vertices"
            )
    materials, used = _materials(shown, textured, pending, state)
    last = len(materials) - 1  # that of vertices
    index = np.full(len(mesh.faces), last, np.int32)
    if shown is not None:
        index = np.where(shown.material < 0, last, shown.material).astype(np.int32)
    if opacity is not None:
        alpha = Texture("", channel="b", layer=_NUMBERS)
        materials = [replace(material, alpha_texture=alpha) for material in materials]
    if emission is not None:
        shines = (emission[mesh.faces] > 0).any(axis=(1, 2))
        if opacity is not None:
            shines &= opacity[mesh.faces].any(axis=1)  # what is not there need not be sampled
        light = Texture("", layer=_LIGHT)
        index += len(materials) * shines.astype(np.int32)
        materials += [replace(m, emission=(1.0, 1.0, 1.0), emission_texture=light) for m in materials]
    faces, uvs, normals = mesh.faces, None, state.corner_normals
    if textured is not None:
        uvs = textured.textures.uvs
        normals = textured.normals(state.vertices) if normals is None else normals
    if traced.torn is not None:
        rows = ~traced.torn
        faces, index = faces[rows], index[rows]
        uvs, normals = None if uvs is None else uvs[rows], None if normals is None else normals[rows]
    rest = mesh.vertices if textured is None else textured.vertices
    item = ObjectMesh(
        name=state.name,
        vertices=rest if state.vertices is None else state.vertices,
        faces=faces,
        matrices=np.asarray(state.matrix_world, np.float64)[None],
        pass_indices=np.array([state.pass_index], np.int32),
        corner_normals=normals,
        uvs=uvs,
        material_index=index,
        materials=materials,
        layers=_layers(traced, faces, materials, channels),
        visibility=state.visibility,
        owner=owner,
        # What emits or lets light pass is met by its mesh, also where rays meet the surfels of others.
        seen_only=traced.seen_only and emission is None and opacity is None,
    )
    return item, used, faults


def stub(traced: TraceObject) -> TraceObject:
    """The object without faces, which are those of an `ObjectMesh`."""
    nothing, numbers = np.empty((0, 3), np.float32), np.empty(0, np.float32)
    faces = np.empty((0, 3), np.int32)
    return replace(
        traced, vertices=nothing, faces=faces, albedo=nothing, roughness=numbers, metallic=numbers,
        corner_normals=None, torn=None,
    )  # fmt: skip


def _materials(
    textures: MeshTextures | None, textured: TexturedAsset | None, pending: Array, state: ObjectState
) -> tuple[list[Material], list[Image]]:
    """Materials and the images; the last material is that of vertices."""
    materials: list[Material] = []
    images: dict[str, Image] = {}
    for k in range(0 if textures is None else len(textures.names)):
        assert textures is not None and textured is not None
        factors = textures.factors[k].copy()
        found: dict[int, Texture] = {}
        for slot in range(4):
            image_number = int(textures.slots[k, slot])
            own = slice(0, 3) if slot == ALBEDO else slice(slot + 2, slot + 3)
            if image_number < 0:
                if slot in _OF_VERTICES:
                    found[slot], factors[own] = _OF_VERTICES[slot], 1.0
                continue
            if len(pending) and pending[k, slot]:
                assert state.adjustment is not None
                image = textured.baked(image_number, slot, factors[own], state.adjustment)
                factors[own] = 1.0
            else:
                image = textured.image(image_number, slot)
            images[image.name] = image
            found[slot] = Texture(
                image.name,
                channel=_CHANNEL[slot],  # type: ignore[arg-type]
                transform=textures.transforms[k, slot].astype(np.float64),
                extension=EXTENSIONS[textures.extensions[k, slot]],  # type: ignore[arg-type]
            )
        normal = found.get(NORMAL)
        details = [] if normal is None else [SurfaceDetail("tangent", normal, strength=float(factors[5]))]
        materials.append(_material(textures.names[k], factors, found, details, state))
    materials.append(_material("", np.ones(6), _OF_VERTICES, [], state))
    return materials, list(images.values())


def _material(
    name: str, factors: Array, found: dict[int, Texture], details: list[SurfaceDetail], state: ObjectState
) -> Material:
    red, green, blue, roughness, metallic = factors[:5].tolist()
    return Material(
        f"{state.name}, {name}" if name else state.name, (red, green, blue), roughness, metallic,
        base_colour_texture=found[ALBEDO], roughness_texture=found[ROUGHNESS], metallic_texture=found[METALLIC],
        details=details, pass_index=state.material_pass_index,
    )  # fmt: skip


def _layers(
    traced: TraceObject, faces: Array, materials: Sequence[Material], channels: Mapping[str, Array]
) -> list[Layer]:
    """Values of vertices at the corners of `faces`, as far as materials refer to them."""
    columns: dict[str, list[Array | None]] = {
        _COLOURS: [traced.albedo],
        _NUMBERS: [traced.roughness, traced.metallic, channels.get("opacity")],
        _LIGHT: [channels.get("emission")],
    }
    slots = ("base_colour_texture", "roughness_texture", "metallic_texture", "alpha_texture", "emission_texture")
    textures = [getattr(material, slot) for material in materials for slot in slots]
    used = {texture.layer for texture in textures if texture is not None}
    layers = []
    for name, given in columns.items():
        if name not in used:
            continue
        values = np.zeros((len(faces), 3, 4), np.float32)
        values[..., 3] = 1.0
        own = [part.reshape(len(part), -1) for part in given if part is not None]
        at_vertices = np.concatenate(own, axis=1)
        values[..., : at_vertices.shape[1]] = at_vertices[faces]
        values.flags.writeable = False
        layers.append(Layer(name, values))
    return layers
