"""Every format that can be written, in one table. ``docs/formats.md`` is made from it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..core.errors import UsageError
from ..core.file_types import WRITTEN, Held
from .exr import write_exr_environment
from .gltf_mesh import write_gltf_mesh
from .gltf_splats import write_gltf_splats
from .sog_writer import write_sog
from .splat_ply import write_splat_ply
from .spz_writer import write_spz
from .usd_mesh import write_usd_mesh
from .usd_sequence import write_usd_sequence
from .usd_splats import write_usd_splats


@dataclass(frozen=True, slots=True)
class Writer:
    """A format that can be written.

    Attributes
    ----------
    name : str
        Shown to users; the key of its `file_types.WriteType`.
    write : callable
        (path, what goes in, options) -> None, where what goes in is `splats.Splats`, `asset.Mesh`,
        `asset.Environment` or numbered frames of `usd_sequence.MovingObject`; raises WriteError.
    kept, lost : str
        For the documentation.
    lost_channels : tuple of str
        Material channels of a mesh for which the format has no place.
    """

    name: str
    write: Callable[..., object]
    kept: str
    lost: str
    lost_channels: tuple[str, ...] = ()

    @property
    def extensions(self) -> tuple[str, ...]:
        """Names that choose it."""
        return WRITTEN[self.name].extensions

    @property
    def kind(self) -> Held:
        """Kind of the data that is written."""
        return WRITTEN[self.name].kind

    @property
    def up(self) -> str:
        """The up axis, a key of ``axes.UP_AXES``, that is written unless asked otherwise."""
        return WRITTEN[self.name].up

    @property
    def fixed(self) -> bool:
        """Whether no other up axis can be asked for."""
        return WRITTEN[self.name].fixed

    @property
    def options(self) -> tuple[str, ...]:
        """Options of `drgs convert` that `write` takes as keywords."""
        return WRITTEN[self.name].options

    def chosen(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """Keywords for `write` of the options that were `given`; None and False say nothing.

        Raises
        ------
        UsageError
            The format does not take one of them; names those that do.
        """
        chosen = {name: value for name, value in given.items() if value not in (None, False)}
        for name in chosen:
            if name not in self.options:
                able = either([w.name for w in WRITERS if name in w.options])
                option = f"--{name.replace('_', '-')}"
                raise UsageError(option, f"is no option of {self.name}", f"Leave it out, or write {able}")
        return chosen


#: What is lost in the pictures of `atlas`.
_TEXTURES = (
    "images of materials with painted faces, or with opacity, emission, specular or coat that vary; materials at "
    "vertices to 1/510 (base colour as sRGB), halfway between vertices as different as can be to 1/4"
)

#: What is lost of splats.
_MATERIALS = "materials, unless with `--materials` ([names](relightable-splats.md))"


def write_alembic(path: Path, *_: object) -> None:
    """Raise UsageError: Blender alone writes it."""
    raise UsageError(str(path), "is Alembic, which Blender writes", "Give a .blend as IN, or use File > Export there")


WRITERS: tuple[Writer, ...] = (
    Writer(
        "3DGS PLY",
        write_splat_ply,
        "centres, scales, rotations, opacities, colour with harmonics, as 32-bit numbers",
        f"{_MATERIALS}; opacity within 1e-6 of 0 and 1",
    ),
    Writer(
        "SPZ",
        write_spz,
        "centres to 1/8192 m within 2 km of the origin, scales to 3.2 %, rotations to 0.4 degrees (version 2: 1.8), "
        "opacities to 1/510, colours to 1/270",
        "materials; scales below 0.05 mm or above 380 m; harmonics outside -1 to 1, and all finer than 1/16 (first "
        "band) or 1/8; colours outside -0.44 to 1.44",
    ),
    Writer(
        "SOG",
        write_sog,
        "centres to 1/131070 of the range of log(1 + distance), opacities to 1/510, rotations to 1.1 degrees; "
        "scales, colours and harmonics as the 256 numbers that fit them best",
        "materials; the order of the splats; harmonics outside -100 to 100; where there are more than 65536, "
        "harmonics become those of a palette",
    ),
    Writer(
        "glTF splats",
        write_gltf_splats,
        "everything, as KHR_gaussian_splatting and 32-bit numbers; coloured points for viewers that do not know it; "
        "with `--compress` what SPZ keeps, for viewers that know [its extension](#drafts)",
        _MATERIALS,
    ),
    Writer(
        "USD splats",
        write_usd_splats,
        "everything, as ParticleField3DGaussianSplat and 32-bit numbers, or with `--kernel surflet` as flat as surfels "
        "are ([surflets](#drafts)); needs usd-core",
        _MATERIALS,
    ),
    Writer(
        "glTF mesh",
        write_gltf_mesh,
        "the mesh, posed or not, with images, UV map and normals where it has textures; other materials as "
        "metallic-roughness textures, a place in them for each triangle; opacity, emission, specular and coat, of "
        "images or vertices, by its alpha and KHR extensions",
        f"surfels; {_TEXTURES}; shared vertices, unless the mesh is of one material",
    ),
    Writer(
        "USD mesh",
        write_usd_mesh,
        "the mesh, posed or not, with images, UV map and normals where it has textures; other materials as the "
        "textures of a UsdPreviewSurface; opacity, emission and coat among them, of images or vertices; "
        "shared vertices",
        f"surfels; specular; {_TEXTURES}",
        ("specular",),
    ),
    Writer(
        "USD sequence",
        write_usd_sequence,
        "all frames in one stage, a time code each: objects with their transforms, meshes with points and normals, "
        "texture coordinates, materials as those of USD mesh (images beside the stage, or in a .usdz) and as "
        "attributes (primvars); with `--surfels` the surfels as those of USD splats; simulated particles as points; "
        "needs usd-core",
        "what USD mesh loses; faces and surfels that differ between frames; images follow no animated material",
    ),
    Writer(
        "Alembic sequence",
        write_alembic,
        "transforms, and the evaluated meshes of all frames, with UV maps, as Blender's own exporter writes them, and "
        "only where it was built with Alembic: *File > Export*, or a .blend as IN",
        "surfels, materials and their attributes; instances (of collections, Geometry Nodes)",
    ),
    Writer(
        "OpenEXR",
        write_exr_environment,
        "radiance as 32-bit numbers, lat-long in Blender's mapping",
        "nothing",
    ),
)


def find_writer(path: Path, kinds: Sequence[Held]) -> Writer:
    """The writer of the first of `kinds` that the extension of `path` can name.

    Raises
    ------
    UsageError
        There is none; lists the extensions of `kinds`.
    """
    suffix = path.suffix.lower()
    for kind in kinds:
        for writer in WRITERS:
            if writer.kind == kind and suffix in writer.extensions:
                return writer
    words = [WORDS[kind] for kind in kinds]
    what = f"as {suffix}" if suffix else "without an extension"
    raise UsageError(str(path), f"{either(words)} cannot be written {what}", f"Use {names_for(kinds)}")


#: The kinds of data in messages.
WORDS: dict[Held, str] = {
    "splats": "splats",
    "mesh": "meshes",
    "environment": "environments",
    "sequence": "sequences",
}


def names_for(kinds: Sequence[Held]) -> str:
    """The extensions for data of these kinds, as ".glb or .usdz for meshes, .exr for environments"."""
    found = []
    for kind in kinds:
        names = list(dict.fromkeys(e for w in WRITERS if w.kind == kind for e in w.extensions))
        found.append(either(names) + (f" for {WORDS[kind]}" if len(kinds) > 1 else ""))
    return ", ".join(found)


def either(words: Sequence[str]) -> str:
    """Words as "a, b or c"."""
    return " or ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
