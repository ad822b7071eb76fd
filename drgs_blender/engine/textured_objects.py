"""Objects whose assets have textures: their meshes as rays meet them, with what is painted and adjusted.

Where a channel is painted, faces have the values of their vertices in place of the image. Adjustments change factors
where these can say it, else a copy of the image; faces that a mask covers in part have values of their vertices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..core.arrays import keep
from ..core.asset.model import Asset
from ..core.asset.textures import ALBEDO, EXTENSIONS, METALLIC, NORMAL, ROUGHNESS, MeshTextures
from ..core.color import linear_to_srgb, srgb_to_linear
from ..core.errors import AssetError
from ..core.frame import Adjustment, Image, Layer, Material, ObjectState, SurfaceDetail, Texture
from ..core.material_adjustments import adjusted_number, recoloured
from ..core.texture_adjustments import adjusted_textures, painted_faces
from ..deform.face_frames import local_normals, posed_normals
from ..render.scene.trace_scene import TexturedObject, TraceObject

Array = np.ndarray

_CHANNEL = {ROUGHNESS: "g", METALLIC: "b", NORMAL: "rgb", ALBEDO: "rgb"}
#: Layers with values of vertices: albedo; roughness and metallic.
_COLOURS, _NUMBERS = "albedo", "roughness and metallic"
#: Texels that are recoloured at a time.
_TOGETHER = 1 << 20


@dataclass(slots=True)
class TexturedAsset:
    """The textures of an asset, decoded once they are needed.

    Attributes
    ----------
    faults : list of str
        Images that cannot be used; values of vertices stand for them.
    """

    asset: Asset
    key: str
    textures: MeshTextures = field(init=False)
    faults: list[str] = field(default_factory=list)
    _vertices: Array = field(init=False)
    _images: dict[tuple[object, ...], Image] = field(default_factory=dict)
    _local: Array | None = None

    def __post_init__(self) -> None:
        mesh = self.asset.mesh
        assert mesh.textures is not None
        given, self._vertices = mesh.textures, keep(mesh.vertices)
        # Copies of their own: what is mapped may change, so that nothing could be kept from frame to frame.
        normals = None if given.normals is None else keep(given.normals)
        self.textures = replace(given, uvs=keep(given.uvs), normals=normals)
        files, slots = given.files, given.slots.copy()
        for number in np.unique(slots[slots >= 0]):
            uses = slots == number
            try:
                pixels = _decoded(files[number][1], f"{self.key}, image {files[number][0]}")
            except AssetError as error:
                self.faults.append(f"{error}; the materials of its vertices are shown")
                slots[uses] = -1
                continue
            for coloured in {bool(slot == ALBEDO) for slot in np.nonzero(uses)[1]}:
                encoding = "srgb" if coloured else "linear"
                name = f"{self.key}, {files[number][0]}, {encoding}"
                self._images[int(number), coloured] = Image(name, pixels, encoding)  # type: ignore[arg-type]
        self.textures = replace(self.textures, slots=slots)

    def image(self, number: int, slot: int) -> Image:
        """An image as it is for a slot."""
        return self._images[number, slot == ALBEDO]

    def baked(self, number: int, slot: int, factors: Array, adjustment: Adjustment) -> Image:
        """An image times its factor, adjusted; made again when the adjustment has changed."""
        name = ("albedo", "roughness", "metallic")[slot]
        settings = (
            (adjustment.tint, adjustment.hue, adjustment.saturation, adjustment.value)
            if slot == ALBEDO
            else getattr(adjustment, name)
        )
        where = (number, name, tuple(factors.tolist()))
        key = (*where, settings)
        if key not in self._images:
            for stale in [k for k in self._images if k[:3] == where]:
                del self._images[stale]
            source = self.image(number, slot)
            made = _recoloured if slot == ALBEDO else _renumbered
            pixels = made(source.pixels, slot, factors, adjustment)
            pixels.flags.writeable = False
            self._images[key] = Image(f"{source.name}, {key[1:]}", pixels, source.encoding)
        return self._images[key]

    def normals(self, vertices: Array | None) -> Array | None:
        """(m, 3, 3) corner normals at rest, or carried along to (n, 3) `vertices`; object space. None: smooth ones."""
        rest, faces = self.textures.normals, self.asset.mesh.faces
        if rest is None or vertices is None:
            return rest
        if self._local is None:
            self._local = local_normals(self._vertices, faces, rest)
        return keep(posed_normals(vertices, faces, self._local))

    @property
    def vertices(self) -> Array:
        """(n, 3) float32 at rest, frozen."""
        return self._vertices


def textured_object(
    state: ObjectState, traced: TraceObject, textured: TexturedAsset, owner: int
) -> tuple[TexturedObject, list[Image], list[str]]:
    """The object's mesh with its textures, the images that it needs, and what is wrong, in words for the user.

    Parameters
    ----------
    state : ObjectState
    traced : TraceObject
        The same with materials at its vertices, painted and adjusted.
    textured : TexturedAsset
    owner : int
        Index of the object.
    """
    mesh, textures = textured.asset.mesh, textured.textures
    faults = [f"{state.name}: {fault}" for fault in textured.faults]
    painted = {name: getattr(state, name) for name in ("albedo", "roughness", "metallic")}
    shown = painted_faces(mesh, textures, painted)
    pending: Array = np.zeros((0, 4), bool)
    if shown is not None and state.adjustment is not None:
        shown, pending, parted = adjusted_textures(shown, mesh.faces, state.adjustment, state.adjustment.mask)
        if parted:
            faults.append(
                f"{state.name}: the mask of its adjustments covers {parted} textured faces in part; these show the "
                "materials of their vertices"
            )
    materials, index, used = _materials(shown, textured, pending, state)
    faces, uvs = mesh.faces, textures.uvs
    normals = state.corner_normals if state.corner_normals is not None else textured.normals(state.vertices)
    if traced.torn is not None:
        rows = ~traced.torn
        faces, uvs, index = faces[rows], uvs[rows], index[rows]
        normals = None if normals is None else normals[rows]
    item = TexturedObject(
        name=state.name,
        vertices=textured.vertices if state.vertices is None else state.vertices,
        faces=faces,
        matrices=np.asarray(state.matrix_world, np.float64)[None],
        pass_indices=np.array([state.pass_index], np.int32),
        corner_normals=normals,
        uvs=uvs,
        material_index=index,
        materials=materials,
        layers=_layers(traced, faces, materials),
        visibility=state.visibility,
        owner=owner,
        seen_only=traced.seen_only,
    )
    return item, used, faults


def stub(traced: TraceObject) -> TraceObject:
    """The object without faces, which are those of a `TexturedObject`."""
    nothing, numbers = np.empty((0, 3), np.float32), np.empty(0, np.float32)
    faces = np.empty((0, 3), np.int32)
    return replace(
        traced, vertices=nothing, faces=faces, albedo=nothing, roughness=numbers, metallic=numbers,
        corner_normals=None, torn=None,
    )  # fmt: skip


def _materials(
    textures: MeshTextures | None, textured: TexturedAsset, pending: Array, state: ObjectState
) -> tuple[list[Material], Array, list[Image]]:
    """Materials, the material of each face, and the images; the last material is that of vertices."""
    colour, number = Texture("", layer=_COLOURS), Texture("", layer=_NUMBERS)
    of_vertices = {
        ALBEDO: colour,
        ROUGHNESS: replace(number, channel="r"),
        METALLIC: replace(number, channel="g"),
    }
    materials: list[Material] = []
    images: dict[str, Image] = {}
    for k in range(0 if textures is None else len(textures.names)):
        assert textures is not None
        factors = textures.factors[k].copy()
        found: dict[int, Texture] = {}
        for slot in range(4):
            image_number = int(textures.slots[k, slot])
            own = slice(0, 3) if slot == ALBEDO else slice(slot + 2, slot + 3)
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
                channel=_CHANNEL[slot],  # type: ignore[arg-type]
                transform=textures.transforms[k, slot].astype(np.float64),
                extension=EXTENSIONS[textures.extensions[k, slot]],  # type: ignore[arg-type]
            )
        normal = found.get(NORMAL)
        details = [] if normal is None else [SurfaceDetail("tangent", normal, strength=float(factors[5]))]
        materials.append(_material(textures.names[k], factors, found, details, state))
    materials.append(_material("", np.ones(6), of_vertices, [], state))
    if textures is None:
        return materials, np.zeros(len(textured.textures.material), np.int32), []
    return materials, np.where(textures.material < 0, len(textures.names), textures.material), list(images.values())


def _material(
    name: str, factors: Array, found: dict[int, Texture], details: list[SurfaceDetail], state: ObjectState
) -> Material:
    red, green, blue, roughness, metallic = factors[:5].tolist()
    return Material(
        f"{state.name}, {name}" if name else state.name, (red, green, blue), roughness, metallic,
        base_colour_texture=found[ALBEDO], roughness_texture=found[ROUGHNESS], metallic_texture=found[METALLIC],
        details=details, pass_index=state.material_pass_index,
    )  # fmt: skip


def _layers(traced: TraceObject, faces: Array, materials: Sequence[Material]) -> list[Layer]:
    """Values of vertices at the corners of `faces`, as far as materials refer to them."""
    used = {t.layer for m in materials for t in (m.base_colour_texture, m.roughness_texture, m.metallic_texture) if t}
    layers = []
    if _COLOURS in used:
        values = np.ones((*faces.shape, 4), np.float32)
        values[..., :3] = traced.albedo[faces]
        layers.append(Layer(_COLOURS, values))
    if _NUMBERS in used:
        values = np.zeros((*faces.shape, 4), np.float32)
        values[..., 0], values[..., 1] = traced.roughness[faces], traced.metallic[faces]
        layers.append(Layer(_NUMBERS, values))
    for layer in layers:
        layer.values.flags.writeable = False
    return layers


def _decoded(data: Array, subject: str) -> Array:
    """(h, w, 4) uint8 pixels of an image file, frozen."""
    from ..formats.images import decode_image  # with Pillow, that most frames do without

    pixels = decode_image(data.tobytes(), subject)
    if pixels.dtype != np.uint8:
        raise AssetError(subject, f"has {pixels.dtype} pixels, where bytes are kept", "Make the asset again")
    whole = np.full((*pixels.shape[:2], 4), 255, np.uint8)
    whole[..., :3] = pixels[..., :3]
    whole.flags.writeable = False
    return whole


def _recoloured(pixels: Array, _: int, factors: Array, adjustment: Adjustment) -> Array:
    """An image of albedo in sRGB bytes, times a factor and adjusted."""
    decode, made = srgb_to_linear(np.arange(256) / 255), pixels.copy()
    flat, out = pixels.reshape(-1, 4), made.reshape(-1, 4)
    for first in range(0, len(flat), _TOGETHER):
        rows = slice(first, first + _TOGETHER)
        new = recoloured(decode[flat[rows, :3]] * factors, adjustment)
        out[rows, :3] = np.rint(linear_to_srgb(np.clip(new, 0, 1)) * 255)
    return made


def _renumbered(pixels: Array, slot: int, factors: Array, adjustment: Adjustment) -> Array:
    """An image whose channel of roughness or metallic is adjusted, times a factor."""
    name, channel = ("roughness", 1) if slot == ROUGHNESS else ("metallic", 2)
    values = adjusted_number(np.clip(np.arange(256) / np.float32(255) * factors[0], 0, 1), getattr(adjustment, name))
    made = pixels.copy()
    made[..., channel] = np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)[pixels[..., channel]]
    return made
