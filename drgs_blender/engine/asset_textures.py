"""Textures of a loaded asset: images, decoded once they are needed, and copies of them that are adjusted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import InitVar, dataclass, field, replace

import numpy as np

from ..core.arrays import keep
from ..core.asset.model import Asset
from ..core.asset.textures import ALBEDO, COLOURED, ROUGHNESS, MeshTextures
from ..core.color import linear_to_srgb, srgb_to_linear
from ..core.errors import AssetError
from ..core.frame import Adjustment
from ..core.material_adjustments import adjusted_number, recoloured
from ..core.materials import Image
from ..core.texture_adjustments import COLOUR
from ..deform.face_frames import local_normals, posed_normals

Array = np.ndarray
#: Pixels, as `decoded`, of an image file by its name and content; None where they are not known.
PixelsOf = Callable[[tuple[str, Array]], Array | None]

#: Texels that are recoloured at a time.
_TOGETHER = 1 << 20


@dataclass(slots=True)
class TexturedAsset:
    """The textures of an asset, decoded once they are needed.

    Attributes
    ----------
    known : callable, optional
        Gives pixels of image files that need not be decoded; None of others.
    faults : list of str
        Images that cannot be used; values of vertices stand for them.
    """

    asset: Asset
    key: str
    known: InitVar[PixelsOf | None] = None
    textures: MeshTextures = field(init=False)
    faults: list[str] = field(default_factory=list)
    _vertices: Array = field(init=False)
    _images: dict[tuple[object, ...], Image] = field(default_factory=dict)
    _local: Array | None = None

    def __post_init__(self, known: PixelsOf | None) -> None:
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
                pixels = None if known is None else known(files[number])
                if pixels is None:
                    pixels = decoded(files[number][1], f"{self.key}, image {files[number][0]}")
            except AssetError as error:
                self.faults.append(f"{str(error).rstrip('.')}; the materials of its vertices are shown")
                slots[uses] = -1
                continue
            for coloured in {int(slot) in COLOURED for slot in np.nonzero(uses)[1]}:
                encoding = "srgb" if coloured else "linear"
                name = f"{self.key}, {files[number][0]}, {encoding}"
                self._images[int(number), coloured] = Image(name, pixels, encoding)  # type: ignore[arg-type]
        self.textures = replace(self.textures, slots=slots)

    def pixels_of(self, file: tuple[str, Array]) -> Array | None:
        """(h, w, 4) uint8 pixels of an image file that it has decoded; None of another."""
        for number, (name, data) in enumerate(self.textures.files):
            if name == file[0] and data is file[1]:
                return next((i.pixels for key, i in self._images.items() if key[0] == number and len(key) == 2), None)
        return None

    def image(self, number: int, slot: int) -> Image:
        """An image as it is for a slot."""
        return self._images[number, slot in COLOURED]

    def baked(self, number: int, slot: int, factors: Array, adjustment: Adjustment) -> Image:
        """An image times its factor, adjusted; made again when the adjustment has changed."""
        name = ("albedo", "roughness", "metallic")[slot]
        settings = tuple(getattr(adjustment, part) for part in COLOUR) if slot == ALBEDO else getattr(adjustment, name)
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


def decoded(data: Array, subject: str) -> Array:
    """(h, w, 4) uint8 pixels of an image file, frozen."""
    from ..formats.images import decode_image  # with Pillow, that most frames do without

    pixels = decode_image(data.tobytes(), subject)
    if pixels.dtype != np.uint8:
        raise AssetError(subject, f"has {pixels.dtype} pixels, where bytes are kept", "Make the asset again")
    whole = np.full((*pixels.shape[:2], 4), 255, np.uint8)
    whole[..., : pixels.shape[2]] = pixels
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
