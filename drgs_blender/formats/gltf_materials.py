"""Materials and textures of glTF files."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ..core.errors import AssetError
from .files import Image, MaterialFile
from .gltf_document import Document
from .images import decode_image

Array = np.ndarray

#: Extensions that are read, where they are named here.
_READ = (
    "KHR_materials_emissive_strength", "KHR_materials_specular", "KHR_materials_clearcoat", "KHR_materials_ior",
)  # fmt: skip
#: What the loss of others does that is seen most.
_LOST = {"KHR_materials_transmission": ": its glass is opaque"}
_WRAP = {33071: "clamp", 33648: "mirror", 10497: "repeat"}


class GltfMaterials:
    """The materials of a document, converted when a primitive uses them; images are decoded once."""

    def __init__(self, document: Document, notes: list[str]) -> None:
        self.document, self.notes = document, notes
        self.used: list[MaterialFile] = []
        self._known: dict[int | None, tuple[int, int]] = {}
        self._pixels: dict[int, Array | None] = {}
        self._files: dict[int, bytes] = {}

    def use(self, index: int | None) -> tuple[int, int]:
        """(number in `used`, UV set) of the glTF material `index`; None is glTF's default material."""
        if index not in self._known:
            self.used.append(MaterialFile("default", (1.0, 1.0, 1.0), 1.0, 1.0))
            self._known[index] = len(self.used) - 1, 0
            if index is not None:
                self._known[index] = len(self.used) - 1, self._convert(index)
        return self._known[index]

    def _convert(self, index: int) -> int:
        """Fill the newest material from the glTF material `index`; return the UV set of its textures."""
        document, get = self.document, self.document.get
        entry = document.item("materials", index)
        material = self.used[-1]
        material.name = str(entry.get("name") or f"material {index}")
        extensions = get(entry, "extensions", dict, {})
        if "KHR_materials_pbrSpecularGlossiness" in extensions and "pbrMetallicRoughness" not in entry:
            return self._specular_glossiness(material, get(extensions, "KHR_materials_pbrSpecularGlossiness", dict))
        pbr = get(entry, "pbrMetallicRoughness", dict, {})
        colour = document.numbers(pbr, "baseColorFactor", (1.0, 1.0, 1.0, 1.0))
        material.base_colour = _rgb(colour)
        material.metallic = float(document.numbers(pbr, "metallicFactor", (1.0,))[0])
        material.roughness = float(document.numbers(pbr, "roughnessFactor", (1.0,))[0])
        material.base_colour_image, colour_set = self._texture(pbr, "baseColorTexture", srgb=True)
        material.metallic_roughness_image, other_set = self._texture(pbr, "metallicRoughnessTexture", srgb=False)
        if material.base_colour_image and material.metallic_roughness_image and colour_set != other_set:
            self.notes.append(f"{material.name}: textures on two UV maps; the one of the base colour is used for both")
        self._alpha(entry, material, float(colour[3]))
        first = colour_set if material.base_colour_image else other_set
        uv_set = self._normal_map(entry, material, self._layers(entry, extensions, material, first))
        for name in extensions:
            if name.startswith("KHR_materials_") and name not in _READ:
                self.notes.append(f"{material.name}: {name} ignored{_LOST.get(name, '')}")
        return uv_set

    def _layers(self, entry: dict[str, Any], extensions: dict[str, Any], material: MaterialFile, uv_set: int) -> int:
        """Read emission, specular level and coat; return the UV set of all textures, as `_normal_map` does."""
        document, get = self.document, self.document.get
        glow = get(extensions, "KHR_materials_emissive_strength", dict, {})
        strength = float(document.numbers(glow, "emissiveStrength", (1.0,))[0])
        radiance = strength * document.numbers(entry, "emissiveFactor", (0.0, 0.0, 0.0)).astype(np.float64)
        usable = np.isfinite(radiance).all() and (radiance >= 0).all()
        if not usable:
            self.notes.append(f"{material.name}: emission ignored: its factor or strength is negative or no number")
        specular = get(extensions, "KHR_materials_specular", dict, {})
        coat = get(extensions, "KHR_materials_clearcoat", dict, {})
        factors = (
            document.numbers(specular, "specularFactor", (1.0,)),
            document.numbers(coat, "clearcoatFactor", (0.0,)),
        )
        level, weight = (float(np.clip(np.nan_to_num(factor[0]), 0, 1)) for factor in factors)
        tint = np.nan_to_num(document.numbers(specular, "specularColorFactor", (1.0, 1.0, 1.0)).astype(np.float64))
        # A level of 0.5 is the 4 % that glTF's dielectrics reflect.
        whole = 0.5 * level * tint.mean() * self._of_ior(get(extensions, "KHR_materials_ior", dict, {}), material.name)
        if whole > 1:
            self.notes.append(f"{material.name}: reflects more than a specular level of 1, which is used")
        material.specular, material.coat = float(np.clip(whole, 0, 1)), weight
        if np.ptp(tint) > 1e-3 or "specularColorTexture" in specular:
            self.notes.append(f"{material.name}: colour of KHR_materials_specular ignored, its mean is used")
        roughness = float(document.numbers(coat, "clearcoatRoughnessFactor", (0.0,))[0])
        odd = abs(roughness - 0.03) > 0.03 or "clearcoatRoughnessTexture" in coat or "clearcoatNormalTexture" in coat
        if weight > 0 and odd:
            self.notes.append(
                f"{material.name}: roughness and normals of KHR_materials_clearcoat ignored: coats are smooth"
            )
        if usable and radiance.any():
            material.emission = _rgb(radiance)
        wanted = (
            ("emission", entry, "emissiveTexture", usable and radiance.any()),
            ("specular", specular, "specularTexture", level > 0),
            ("coat", coat, "clearcoatTexture", weight > 0),
        )
        for name, place, key, used in wanted:
            image, own_set = self._texture(place, key, srgb=name == "emission") if used else (None, 0)
            if image is None:
                continue
            others = (material.base_colour_image, material.metallic_roughness_image, material.emission_image)
            if own_set != uv_set and any(other is not None for other in others):
                self.notes.append(f"{material.name}: {key} ignored: its UV map is not that of the other textures")
                continue
            uv_set = own_set
            setattr(material, f"{name}_image", image.alpha if name == "specular" else image)
        return uv_set

    def _of_ior(self, entry: dict[str, Any], name: str) -> float:
        """Specular level of an IOR over that of 1.5: the same light at normal incidence."""
        ior = float(self.document.numbers(entry, "ior", (1.5,))[0])
        if ior == 1.5 or not (np.isfinite(ior) and ior >= 1):
            return 1.0
        self.notes.append(f"{name}: IOR {ior:g} becomes a specular level")
        return ((ior - 1) / (ior + 1) / 0.2) ** 2

    def _alpha(self, entry: dict[str, Any], material: MaterialFile, factor: float) -> None:
        """Read the alpha of the base colour, cut at the cutoff where the material says so."""
        mode = self.document.get(entry, "alphaMode", str, "OPAQUE")
        if mode not in ("MASK", "BLEND"):
            return
        alpha = None if material.base_colour_image is None else material.base_colour_image.alpha
        factor = float(np.clip(factor, 0, 1)) if np.isfinite(factor) else 1.0
        material.cut_out = mode == "MASK"
        if material.cut_out:
            cutoff = float(self.document.numbers(entry, "alphaCutoff", (0.5,))[0])
            if alpha is not None:
                alpha = replace(alpha, pixels=(alpha.pixels * factor >= cutoff).astype(np.float32))
            factor = float(factor >= cutoff) if alpha is None else 1.0
        material.alpha, material.alpha_image = factor, alpha

    def _normal_map(self, entry: dict[str, Any], material: MaterialFile, uv_set: int) -> int:
        """Read the normal map; return the UV set of all textures, that of the others (`uv_set`) where there are any.

        A map that has another UV set than those is left out, with a note.
        """
        image, own_set = self._texture(entry, "normalTexture", srgb=False)
        if image is None:
            return uv_set
        others = (material.base_colour_image, material.metallic_roughness_image, material.emission_image)
        if own_set != uv_set and any(other is not None for other in others):
            self.notes.append(f"{material.name}: normal map ignored: its UV map is not that of the other textures")
            return uv_set
        info = self.document.get(entry, "normalTexture", dict, {})
        material.normal_image = image
        material.normal_strength = float(self.document.numbers(info, "scale", (1.0,))[0])
        return own_set

    def _specular_glossiness(self, material: MaterialFile, pbr: dict[str, Any]) -> int:
        """Approximate a specular-glossiness material: what is specular beyond a dielectric's 4 % is metal."""
        diffuse = self.document.numbers(pbr, "diffuseFactor", (1.0, 1.0, 1.0, 1.0))[:3]
        specular = self.document.numbers(pbr, "specularFactor", (1.0, 1.0, 1.0))
        material.roughness = 1.0 - float(self.document.numbers(pbr, "glossinessFactor", (1.0,))[0])
        material.base_colour_image, uv_set = self._texture(pbr, "diffuseTexture", srgb=True)
        textured = material.base_colour_image is not None or "specularGlossinessTexture" in pbr
        brightest = float(specular.max())
        excess = max(brightest - 0.04, 0.0)
        metallic = 0.0 if textured else excess / max(excess + float(diffuse.max()), 1e-6)
        material.metallic = metallic
        material.base_colour = _rgb(np.clip((1 - metallic) * diffuse + metallic * specular, 0, 1))
        self.notes.append(f"{material.name}: specular-glossiness converted approximately to metallic-roughness")
        return uv_set

    def _texture(self, entry: dict[str, Any], key: str, srgb: bool) -> tuple[Image | None, int]:
        """(image, UV set) of a texture reference; (None, 0) without one."""
        document = self.document
        info = document.get(entry, key, dict)
        if info is None:
            return None, 0
        texture = document.item("textures", document.index(info, "index"))
        extensions = document.get(texture, "extensions", dict, {})
        source = document.index(document.get(extensions, "EXT_texture_webp", dict, texture), "source")
        uv_set = document.index(info, "texCoord") or 0
        if source is None:
            self.notes.append(f"texture of {key} in a format that is not read (KTX2?) ignored")
            return None, uv_set
        pixels = self._image(source)
        if pixels is None:
            return None, uv_set
        sampler_index = document.index(texture, "sampler")
        sampler = {} if sampler_index is None else document.item("samplers", sampler_index)
        wrap = [_WRAP.get(document.index(sampler, k) or 10497, "repeat") for k in ("wrapS", "wrapT")]
        moved = document.get(document.get(info, "extensions", dict, {}), "KHR_texture_transform", dict)
        transform = np.eye(2, 3)
        if moved is not None:
            replaced = document.index(moved, "texCoord")
            uv_set = uv_set if replaced is None else replaced
            transform = uv_transform(
                document.numbers(moved, "offset", (0.0, 0.0)),
                float(document.numbers(moved, "rotation", (0.0,))[0]),
                document.numbers(moved, "scale", (1.0, 1.0)),
            )
        return Image(pixels, srgb, transform, (wrap[0], wrap[1]), self._files[source]), uv_set

    def _image(self, index: int) -> Array | None:
        """Pixels of an image; None, with a note, where it cannot be had: a mesh without it is still a mesh."""
        if index not in self._pixels:
            try:
                self._files[index], name = self.document.image(index)
                self._pixels[index] = decode_image(self._files[index], name)
            except AssetError as error:
                self._pixels[index] = None
                self.notes.append(f"texture left out: {error}")
        return self._pixels[index]


def uv_transform(offset: Array, rotation: float, scale: Array) -> Array:
    """KHR_texture_transform as (2, 3) matrix on coordinates whose v points **up** (glTF's own points down)."""
    c, s = np.cos(rotation), np.sin(rotation)
    return np.array(
        [
            [c * scale[0], -s * scale[1], offset[0] + s * scale[1]],
            [s * scale[0], c * scale[1], 1.0 - offset[1] - c * scale[1]],
        ]
    )


def _rgb(colour: Array) -> tuple[float, float, float]:
    return float(colour[0]), float(colour[1]), float(colour[2])
