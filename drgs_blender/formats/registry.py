"""Every foreign format in one table; files are recognised by their content.

``docs/formats.md`` is made from this table.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.asset import Environment
from ..core.errors import AssetError
from ..core.file_integrity import EXR
from ..core.file_types import READ, Kind
from .drafts import DRAFTS
from .environment import read_exr_environment, read_hdr_environment, read_picture_environment
from .files import EnvironmentFile, MaterialsFile, MeshFile, SurfelFile
from .gaussian_ply import LAYOUTS, is_gaussian, read_gaussian_ply
from .gltf import read_gltf
from .gltf_nodes import Pose
from .gltf_splats import has_splats, read_gltf_splats
from .ksplat import read_ksplat, sniff_ksplat
from .learned_light import LEGACY, ZIP, read_learned_light
from .materials import is_nero_folder, read_nero_materials
from .mesh import sanitise
from .obj import read_obj
from .packed_splats import is_compressed, read_compressed_ply, read_splat, sniff_splat
from .ply import HEADER_LIMIT, parse_header
from .ply_mesh import read_ply_mesh
from .scene_mesh import read_scene_mesh, sniff_3mf, sniff_collada
from .sog import read_sog, sniff_sog
from .sog_stream import read_streamed_sog, sniff_streamed_sog
from .spz import read_spz, sniff_spz
from .stl_off import read_off, read_stl, sniff_off, sniff_stl
from .tiff import MAGIC as TIFF
from .usd_splats import MESHES, read_usd_splats, sniff_usd
from .writers import WRITERS

AnyFile = SurfelFile | MeshFile | EnvironmentFile | MaterialsFile


@dataclass(frozen=True, slots=True)
class Format:
    """A format that can be read.

    Attributes
    ----------
    name : str
        Shown to users; the key of its `file_types.ReadType`.
    sniff : callable
        (first bytes, path) -> whether the file is of this format.
    read : callable
        path -> what comes out.
    note : str
        One line for the documentation.
    instead : str
        Advice where something else than `kind` is wanted of such a file.
    """

    name: str
    sniff: Callable[[bytes, Path], bool]
    read: Callable[[Path], AnyFile]
    note: str
    instead: str = ""

    @property
    def extensions(self) -> tuple[str, ...]:
        """Usual endings of file names."""
        return READ[self.name].extensions

    @property
    def kind(self) -> Kind:
        """Kind of the data that is read."""
        return READ[self.name].kind


def _ply(test: Callable[..., bool]) -> Callable[[bytes, Path], bool]:
    """A sniffer that looks at the header of PLY files."""

    def sniff(head: bytes, path: Path) -> bool:
        return head.startswith((b"ply\n", b"ply\r")) and test(parse_header(head, str(path)))

    return sniff


def _magic(*starts: bytes) -> Callable[[bytes, Path], bool]:
    return lambda head, path: head.startswith(starts)


def _sniff_gltf(head: bytes, path: Path) -> bool:
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    return head.startswith(b"glTF") or (
        text.startswith(b"{") and (b'"asset"' in head or path.suffix.lower() == ".gltf")
    )


def _sniff_obj(head: bytes, path: Path) -> bool:
    """Plain text most of whose first lines start with a keyword of OBJ."""
    if b"\0" in head[:4096]:
        return False
    lines = [line.split()[0] for line in head[:65536].split(b"\n")[:200] if line.split()]
    known = {b"v", b"vt", b"vn", b"f", b"o", b"g", b"s", b"l", b"usemtl", b"mtllib", b"#"}
    hits = sum(word in known or word.startswith(b"#") for word in lines)
    return any(w in (b"v", b"f", b"o", b"mtllib") for w in lines) and hits >= 0.8 * len(lines)


def _sniff_torch(head: bytes, path: Path) -> bool:
    return head.startswith(LEGACY) or (head.startswith(ZIP) and b"data.pkl" in head[:4096])


def _read_gltf(path: Path, pose: Pose = "rest") -> MeshFile:
    return sanitise(read_gltf(path, pose))


#: The table; the first format that recognises a file reads it.
FORMATS: tuple[Format, ...] = (
    Format(
        "Gaussian PLY",
        _ply(is_gaussian),
        read_gaussian_ply,
        f"{', '.join(dict.fromkeys(layout.name for layout in LAYOUTS))}; gsplat and SuGaR write 3DGS's",
    ),
    Format(
        "compressed PLY",
        _ply(is_compressed),
        read_compressed_ply,
        "PlayCanvas and SuperSplat, with harmonics; 3D splats, flattened",
    ),
    Format(
        "SPZ",
        sniff_spz,
        read_spz,
        "Niantic, versions 2 to 4; 3D splats, flattened; Y up, turned to Z up on import",
    ),
    Format(
        "SOG",
        sniff_sog,
        read_sog,
        "PlayCanvas, versions 1 and 2, zipped or meta.json beside its pictures; 3D splats, flattened",
    ),
    Format(
        "streamed SOG",
        sniff_streamed_sog,
        read_streamed_sog,
        "PlayCanvas, lod-meta.json with folders of SOG: the finest level of detail; 3D splats, flattened; not the "
        "environment beside it",
    ),
    Format(
        "glTF splats",
        lambda head, path: _sniff_gltf(head, path) and has_splats(head),
        read_gltf_splats,
        "KHR_gaussian_splatting, also packed as SPZ; 3D splats, flattened; Y up, turned to Z up on import",
    ),
    Format(
        "USD",
        sniff_usd,
        read_usd_splats,
        "ParticleField3DGaussianSplat, 3D splats, flattened; fields of Gaussian surflets; turned to Z up on import; a "
        ".usdz reads no file but itself; needs usd-core",
        MESHES,
    ),
    Format("splat", sniff_splat, read_splat, "32 bytes a splat; 3D splats, flattened"),
    Format(
        "ksplat",
        sniff_ksplat,
        read_ksplat,
        "GaussianSplats3D, all compression levels; 3D splats, flattened",
    ),
    Format(
        "PLY mesh",
        _ply(lambda header: header.element("vertex") is not None),
        lambda path: sanitise(read_ply_mesh(path)),
        "any encoding; polygons, strips, points; sRGB vertex colours or DR-GS's own linear channels",
    ),
    Format(
        "glTF 2.0",
        _sniff_gltf,
        _read_gltf,
        "metallic-roughness materials, with alpha, emission, specular and clearcoat; instances; skins in Blender's "
        "rest pose; turned to Z up; not Draco or meshopt",
    ),
    Format(
        "Wavefront OBJ",
        _sniff_obj,
        lambda path: sanitise(read_obj(path)),
        "with MTL (Kd, map_Kd, Ke, map_Ke, d, map_d, Ns, Pr, Pm, Pc)",
    ),
    Format(
        "3MF",
        sniff_3mf,
        lambda path: sanitise(read_scene_mesh(path)),
        "shapes alone, where they are placed; in metres; needs lxml (extra `meshes`)",
    ),
    Format(
        "COLLADA",
        sniff_collada,
        lambda path: sanitise(read_scene_mesh(path)),
        "with base colours, textures, vertex colours; in metres, turned to Z up; no skins; needs lxml and pycollada "
        "(extra `meshes`)",
    ),
    Format("OFF", sniff_off, lambda path: sanitise(read_off(path)), "as text; with vertex colours (COFF)"),
    Format(
        "STL",
        sniff_stl,
        lambda path: sanitise(read_stl(path)),
        "binary and text; corners at exactly the same place become one vertex; no colours",
    ),
    Format("Radiance HDR", _magic(b"#?"), read_hdr_environment, "RGBE and XYZE, old and new runs"),
    Format(
        "OpenEXR",
        _magic(EXR),
        read_exr_environment,
        "lat-long or cube map; any part or layer with RGB, or luminance",
    ),
    Format(
        "picture",
        lambda head, path: head.startswith((b"\x89PNG", b"\xff\xd8\xff", *TIFF)) or head[8:12] == b"WEBP",
        read_picture_environment,
        "PNG, JPEG, WebP, TIFF, 8 or 16 bits: display-referred, decoded from sRGB; TIFF with floats is linear",
    ),
    Format(
        "learned light",
        _sniff_torch,
        read_learned_light,
        "IRGS and Ref-Gaussian; needs torch",
    ),
    Format(
        "NeRO materials",
        lambda head, path: is_nero_folder(path) or (head.startswith(b"\x93NUMPY") and is_nero_folder(path.parent)),
        read_nero_materials,
        "folder with albedo.npy, metallic.npy, roughness.npy, one row a vertex",
    ),
)


_ASSET = "Render it by `drgs relight` or import it into Blender; `drgs convert` writes its mesh, splats or light"
#: What to do with a file of the one kind where the other is wanted.
_INSTEAD: dict[tuple[Kind, Kind | None], str] = {
    ("mesh", "surfels"): "`drgs make`, Make Asset in Blender, makes an asset of a mesh",
    ("surfels", "mesh"): "`drgs import`, Import in Blender, makes an asset of surfels or splats",
}


def find_format(path: Path, kind: Kind | None = None) -> Format:
    """The format of the file (or folder) at `path`, of the wanted `kind` where one is given.

    Raises
    ------
    AssetError
        The file cannot be read, or no format recognises it; lists what is understood.
    """
    head, folder = b"", False
    try:
        folder = path.is_dir()
        if not folder:
            if path.exists() and not path.is_file():  # a pipe or a device may never end
                raise AssetError(str(path), "is not a regular file", "Choose a file")
            with open(path, "rb") as file:
                head = file.read(HEADER_LIMIT)
    except OSError as error:
        raise AssetError(str(path), f"cannot be read ({error.strerror or error})", "Check the path") from error
    recognised = [f for f in FORMATS if f.sniff(head, path)]
    fitting = [f for f in recognised if kind in (None, f.kind)]
    if fitting:
        return fitting[0]
    wanted = [f for f in FORMATS if kind in (None, f.kind)]
    understood = "; ".join(f"{f.name} ({' '.join(f.extensions)})" for f in wanted)
    if kind is None:
        understood = f"DR-GS asset (.drgs); {understood}"
    instead = ""
    if recognised:
        found = f"is {recognised[0].name}, not {kind}"
        instead = recognised[0].instead or _INSTEAD.get((recognised[0].kind, kind), "")
    elif head.startswith(ZIP) and b"manifest.json" in head[:64]:
        found, instead = "is a DR-GS asset already", _ASSET
    else:
        found = "is a folder" if folder else "is of no known format" if head else "is empty"
    raise AssetError(str(path), found, f"{instead}. Understood: {understood}".removeprefix(". "))


def read(path: str | Path, *, kind: Kind | None = None) -> AnyFile:
    """Read any file; `kind` narrows down what it may be.

    Raises
    ------
    AssetError
        The file is not understood, or damaged.
    """
    path = Path(path)
    with np.errstate(all="ignore"):  # every reader deals with what is not finite; numpy need not say it, too
        return find_format(path, kind).read(path)


def read_surfels(path: str | Path) -> SurfelFile:
    """Read splats or surfels; axes as in the file. Raises AssetError."""
    result = read(path, kind="surfels")
    assert isinstance(result, SurfelFile)
    return result


def read_mesh(path: str | Path, pose: Pose = "rest") -> MeshFile:
    r"""Read a mesh with its materials; ``up_axis`` says whether it is known to be Z up. Raises AssetError.

    `pose` is that of skinned glTF: "rest" as Blender's importer rests it, "default" as viewers show the file.

    Examples
    --------
    Faces of more than three corners are divided:

    >>> text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4"
    >>> _ = Path("square.obj").write_text(text)
    >>> mesh = read_mesh("square.obj")
    >>> len(mesh.vertices), len(mesh.faces), mesh.up_axis
    (4, 2, 'unknown')
    """
    path = Path(path)
    if find_format(path, "mesh").read is _read_gltf:
        return _read_gltf(path, pose)
    result = read(path, kind="mesh")
    assert isinstance(result, MeshFile)
    return result


def read_environment(path: str | Path) -> Environment:
    """Read distant light as linear lat-long radiance in Blender's mapping. Raises AssetError."""
    return read_environment_file(path).environment


def read_environment_file(path: str | Path) -> EnvironmentFile:
    """As `read_environment`, with the notes of the reader. Raises AssetError."""
    result = read(path, kind="environment")
    assert isinstance(result, EnvironmentFile)
    return result


def read_materials(path: str | Path) -> MaterialsFile:
    """Read materials that come without a mesh. Raises AssetError."""
    result = read(path, kind="materials")
    assert isinstance(result, MaterialsFile)
    return result


def document() -> str:
    """The text of docs/formats.md."""
    lines = [
        "# Files that are read and written",
        "",
        "Made from the tables in `drgs_blender/formats/registry.py` and `writers.py`; a test holds them together.",
        "",
        "## Read",
        "",
        "Files are recognised by their content; the extensions are only what such files are usually called. Splats of",
        "three scales become surfels: the shortest axis is dropped and becomes the normal, and the report counts those",
        "that were far from flat. Where a file has no materials, the albedo is the captured colour decoded from sRGB,",
        "the roughness 0.5 and the metallic 0; `drgs import --remove-light` estimates the albedo instead, from the",
        "light of the capture, which it is given or estimates.",
        "",
        "| Format | Usual names | Becomes | Remarks |",
        "|---|---|---|---|",
        *(f"| {f.name} | {' '.join(f.extensions)} | {f.kind} | {f.note} |" for f in FORMATS),
        "",
        "## Written",
        "",
        "`drgs convert IN OUT` writes them, and Blender's File > Export. An asset is Z up. A surfel becomes a splat",
        "whose third axis, along the normal, is that of the splat it was read from, else a hundredth of the shorter of",
        "the others. Light baked into it is encoded as sRGB, without a view transform; what is brighter than white is",
        "white. Harmonics of a higher degree than 3, and properties that no other program knows, stay behind. Both",
        "read and write sequences, a file a frame, or all frames in one USD or Alembic file.",
        "",
        "| Format | Names | From | Up axis | Kept | Lost |",
        "|---|---|---|---|---|---|",
        *(
            f"| {w.name} | {' '.join(w.extensions)} | {w.kind} | {w.up.upper()}{'' if w.fixed else ', or --up'} "
            f"| {w.kept} | {w.lost} |"
            for w in WRITERS
        ),
        "",
        "## Drafts",
        "",
        *DRAFTS,
        "",
        "## Gaussian PLY layouts",
        "",
        "In the order of detection. Opacity and scales are activated everywhere (sigmoid, exp); properties that a",
        "surfel cannot hold are kept in its extras.",
        "",
        "| Layout | Recognised by | Albedo from | Roughness from | Metallic from | Remarks |",
        "|---|---|---|---|---|---|",
    ]
    for layout in LAYOUTS:
        signs = [*layout.has, *(f"no {name}" for name in layout.lacks)]
        channels = [c.properties[0] if c else "-" for c in (layout.albedo, layout.roughness, layout.metallic)]
        colour = channels[0] if layout.albedo else "f_dc_0 (captured colour)"
        row = (layout.name, ", ".join(signs) or "anything else", colour, *channels[1:], layout.note)
        lines.append(f"| {' | '.join(row)} |")
    return "\n".join(lines) + "\n"
