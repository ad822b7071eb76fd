"""Meshes of DR-GS objects that are met with materials of their own: textures and optional channels.

Whatever the renderer does with ordinary meshes it then does with these objects: their images are looked up, they are
sampled as mesh lights, and rays stop at them by chance; specular level and coat are lobes, on surfels that are tied to
the mesh, too. Values of vertices are layers.

Where a channel is painted, faces have the values of their vertices in place of the image. Adjustments change factors
where these can say it, else a copy of the image; faces that a mask covers in part have values of their vertices.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..core.asset.model import MATERIAL_CHANNELS, Asset
from ..core.asset.textures import (
    ALBEDO,
    COAT,
    EMISSION,
    EXTENSIONS,
    FACTOR_COUNT,
    FACTORS,
    METALLIC,
    NORMAL,
    OPACITY,
    ROUGHNESS,
    SLOTS,
    SPECULAR,
    MeshTextures,
)
from ..core.frame import Layer, ObjectState
from ..core.materials import Image, Material, SurfaceDetail, Texture
from ..core.texture_adjustments import adjusted_textures, painted_faces
from ..render.scene.trace_scene import ObjectMesh, TraceObject
from .asset_textures import TexturedAsset

Array = np.ndarray

#: Layers with values of vertices: albedo; roughness, metallic and opacity; emission; one each of the lobes' channels.
_COLOURS, _NUMBERS, _LIGHT = "albedo", "roughness, metallic and opacity", "emission"
#: Channels of further lobes, and the field of a material that they are.
_LOBES = {SPECULAR: "specular_level", COAT: "coat"}
#: What is at the vertices, by slot.
_OF_VERTICES = {
    ALBEDO: Texture("", layer=_COLOURS),
    ROUGHNESS: Texture("", channel="r", layer=_NUMBERS),
    METALLIC: Texture("", channel="g", layer=_NUMBERS),
    OPACITY: Texture("", channel="b", layer=_NUMBERS),
    EMISSION: Texture("", layer=_LIGHT),
    **{slot: Texture("", channel="r", layer=SLOTS[slot]) for slot in _LOBES},
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

    None where it has neither textures nor `channels`, or where it is torn to nothing.

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
    mesh = asset.mesh
    if not len(mesh.faces) or (traced.torn is not None and traced.torn.all()):
        return None, [], []
    if textured is None and not channels:
        return None, [], []
    faults: list[str] = []
    shown: MeshTextures | None = None
    pending: Array = np.zeros((0, len(SLOTS)), bool)
    if textured is not None:
        faults += [f"{state.name}: {fault}" for fault in textured.faults]
        painted = {name: getattr(state, name) for name in MATERIAL_CHANNELS}
        shown = painted_faces(mesh, textured.textures, painted)
    if shown is not None and state.adjustment is not None:
        shown, pending, parted = adjusted_textures(shown, mesh.faces, state.adjustment, state.adjustment.mask)
        if parted:
            faults.append(
                f"{state.name}: the mask of its adjustments covers {parted} textured faces in part; these show the "
                "materials of their vertices"
            )
    dark, lit, used = _materials(shown, textured, pending, state, channels)
    last = len(dark) - 1  # that of vertices
    index = np.full(len(mesh.faces), last, np.int32)
    if shown is not None:
        index = np.where(shown.material < 0, last, shown.material).astype(np.int32)
    shines = _shining(mesh.faces, index, lit, channels)
    materials = dark
    if shines is not None:
        index += len(dark) * shines.astype(np.int32)
        materials = dark + lit
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
        seen_only=traced.seen_only and shines is None and not any(material.clear for material in materials),
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


def channels_of(mesh: ObjectMesh | None) -> frozenset[str]:
    """Names of the optional channels that an object's mesh has, of images or vertices."""
    found: set[str] = set()
    for m in () if mesh is None else mesh.materials:
        found |= {name for name, has in (("opacity", m.clear), ("emission", m.emission_texture is not None)) if has}
        found |= {SLOTS[slot] for slot, name in _LOBES.items() if name in m.textures}
    return frozenset(found)


def _shining(faces: Array, index: Array, lit: list[Material], channels: Mapping[str, Array]) -> Array | None:
    """(m,) bool: faces of a mesh that emit light, of materials `index` among `lit`; None where none can."""
    if all(material.emission_texture is None for material in lit):
        return None
    of_image = np.array([m.emission_texture is not None and bool(m.emission_texture.image) for m in lit])
    shines: Array = of_image[index]
    if "emission" in channels:
        shines |= (channels["emission"][faces] > 0).any(axis=(1, 2))
        dark = np.array([material.emission_texture is None for material in lit])
        shines &= ~dark[index]
    if "opacity" in channels:  # what is not there need not be sampled
        at_vertices = np.array([m.alpha_texture is not None and not m.alpha_texture.image for m in lit])
        shines &= ~at_vertices[index] | channels["opacity"][faces].any(axis=1)
    return shines


def _materials(
    textures: MeshTextures | None,
    textured: TexturedAsset | None,
    pending: Array,
    state: ObjectState,
    channels: Mapping[str, Array],
) -> tuple[list[Material], list[Material], list[Image]]:
    """Materials without their emission and with it, and the images; the last material is that of vertices."""
    rows: list[tuple[Material, Material]] = []
    images: dict[str, Image] = {}
    of_vertices = {k: t for k, t in _OF_VERTICES.items() if k < OPACITY or SLOTS[k] in channels}
    for k in range(0 if textures is None else len(textures.names)):
        assert textures is not None and textured is not None
        factors = textures.factors[k].copy()
        found: dict[int, Texture] = {}
        for slot in range(len(SLOTS)):
            image_number, own = int(textures.slots[k, slot]), FACTORS[slot]
            if image_number < 0:
                if slot in of_vertices:
                    found[slot], factors[own] = of_vertices[slot], 1.0
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
                channel=textures.channel(slot, image_number),  # type: ignore[arg-type]
                transform=textures.transforms[k, slot].astype(np.float64),
                extension=EXTENSIONS[textures.extensions[k, slot]],  # type: ignore[arg-type]
            )
        rows.append(_material(textures.names[k], factors, found, state))
    rows.append(_material("", np.ones(FACTOR_COUNT), of_vertices, state))
    return [dark for dark, _ in rows], [lit for _, lit in rows], list(images.values())


def _material(name: str, factors: Array, found: dict[int, Texture], state: ObjectState) -> tuple[Material, Material]:
    """A material without its emission, and with it where there is any."""
    of = [tuple(factors[own].tolist()) for own in FACTORS]
    normal = found.get(NORMAL)
    lobes = {field: found[slot] for slot, field in _LOBES.items() if slot in found}
    dark = Material(
        f"{state.name}, {name}" if name else state.name, of[ALBEDO], of[ROUGHNESS][0], of[METALLIC][0],
        base_colour_texture=found[ALBEDO], roughness_texture=found[ROUGHNESS], metallic_texture=found[METALLIC],
        alpha=of[OPACITY][0] if OPACITY in found else 1.0, alpha_texture=found.get(OPACITY),
        details=[] if normal is None else [SurfaceDetail("tangent", normal, strength=of[NORMAL][0])],
        pass_index=state.material_pass_index, textures=lobes, of_point=bool(lobes),
        **{field: of[slot][0] for slot, field in _LOBES.items() if slot in found},
    )  # fmt: skip
    if EMISSION not in found or not any(of[EMISSION]):
        return dark, dark
    return dark, replace(dark, emission=of[EMISSION], emission_texture=found[EMISSION])


def _layers(
    traced: TraceObject, faces: Array, materials: Sequence[Material], channels: Mapping[str, Array]
) -> list[Layer]:
    """Values of vertices at the corners of `faces`, as far as materials refer to them."""
    columns: dict[str, list[Array | None]] = {
        _COLOURS: [traced.albedo],
        _NUMBERS: [traced.roughness, traced.metallic, channels.get("opacity")],
        _LIGHT: [channels.get("emission")],
        **{SLOTS[slot]: [channels.get(SLOTS[slot])] for slot in _LOBES},
    }
    used = {texture.layer for material in materials for texture in material.all_textures() if not texture.image}
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
