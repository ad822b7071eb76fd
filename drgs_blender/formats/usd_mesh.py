"""The mesh of an asset as USDZ: one file with a UsdPreviewSurface and its textures, written without USD's library.

OpenUSD, "Usdz File Format Specification": a zip whose files are not compressed and start at multiples of 64 bytes, the
first of them the stage.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np

from ..core.asset import Mesh
from ..core.asset.archive import replace_file
from ..core.version import __version__
from ..geometry.normals import VertexNormals
from .atlas import TexturedMaterial, UniformMaterial
from .mesh_groups import FaceGroup, ImageMaterial, corner_normals, face_groups, pictured_material

Array = np.ndarray

_ALIGNMENT = 64
_LOCAL_HEADER = 30
_PICTURES = "textures/"
#: The fixed date of entries, so that a file depends on what it holds alone.
_DATE = (1980, 1, 1, 0, 0, 0)
#: Numbers turned into text at once; bounds the memory.
_BLOCK = 1 << 16
_COAT_ROUGHNESS = "float inputs:clearcoatRoughness = 0.03"


def write_usd_mesh(path: Path, mesh: Mesh) -> None:
    """Write a USDZ with `mesh`, which is Z up, in metres; its materials as `mesh_groups` puts them, a subset each.

    Raises
    ------
    UsageError
        The mesh has no faces, or more than a texture has room for.
    WriteError
        The file cannot be written.
    """
    groups = face_groups(mesh, str(path))
    files = {"asset.usda": _stage(mesh, groups).encode()}
    for group in groups:
        for file, content in picture_files(group):
            files[f"{_PICTURES}{file}"] = content
    write_package(path, files)


def write_package(path: Path, files: dict[str, bytes]) -> None:
    """Write a USDZ of these files by name, the first the stage. Raises WriteError."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_STORED) as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name, _DATE)
            # An extra field fills up to the alignment; it has a head of 4 bytes.
            gap = -(data.tell() + _LOCAL_HEADER + len(name.encode()) + 4) % _ALIGNMENT
            entry.extra = b"\x86\x19" + gap.to_bytes(2, "little") + bytes(gap)
            archive.writestr(entry, content)
    replace_file(path, [data.getbuffer()])


def picture_files(group: FaceGroup) -> list[tuple[str, bytes]]:
    """Name and content of the pictures of a group."""
    m = group.material
    if isinstance(m, TexturedMaterial):
        baked = {"color": m.colour, "surface": m.surface, "emission": m.emission, "layers": m.layers}
        return [(f"{name}.png", data) for name, data in baked.items() if data is not None]
    if not isinstance(m, ImageMaterial):
        return []
    pictures = (m.colour_picture, m.surface_picture, m.normal_picture, m.emission_picture, m.coat_picture)
    return [(picture.name, picture.data) for picture in pictures if picture is not None]


def _stage(mesh: Mesh, groups: list[FaceGroup]) -> str:
    """The stage as text."""
    extent = np.stack([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)])
    if mesh.textures is None:
        normals, interpolation = VertexNormals(mesh.faces, len(mesh.vertices))(mesh.vertices), "vertex"
    else:
        normals, interpolation = corner_normals(mesh).reshape(-1, 3), "faceVarying"
    lines = [
        "#usda 1.0",
        f'(\n    defaultPrim = "Asset"\n    doc = "DR-GS {__version__}"\n    metersPerUnit = 1\n    upAxis = "Z"\n)',
        'def Xform "Asset" (\n    kind = "component"\n)\n{',
        'def Mesh "Mesh" (\n    prepend apiSchemas = ["MaterialBindingAPI"]\n)\n{',
        "uniform bool doubleSided = 1",
        'uniform token subdivisionScheme = "none"',
        f"float3[] extent = {_tuples(extent)}",
        f"int[] faceVertexCounts = [{', '.join(['3'] * len(mesh.faces))}]",
        f"int[] faceVertexIndices = [{', '.join(map(str, mesh.faces.ravel().tolist()))}]",
        f"point3f[] points = {_tuples(mesh.vertices)}",
        f'normal3f[] normals = {_tuples(normals)} (\n    interpolation = "{interpolation}"\n)',
    ]
    if any(group.uvs is not None for group in groups):
        uvs = np.zeros((len(mesh.faces), 3, 2))
        for group in groups:
            uvs[group.faces] = 0 if group.uvs is None else group.uvs * [1, -1] + [0, 1]  # v points up in USD
        lines.append(
            f'texCoord2f[] primvars:st = {_tuples(uvs.reshape(-1, 2))} (\n    interpolation = "faceVarying"\n)'
        )
    names = ["Material"] if len(groups) == 1 else [f"Material{k}" for k in range(len(groups))]
    if len(groups) == 1:
        lines.append("rel material:binding = </Asset/Material>")
    else:
        lines.append('uniform token subsetFamily:materialBind:familyType = "partition"')
        for name, group in zip(names, groups, strict=True):
            lines += _subset(name, group.faces)
    materials = [material_text(n, group.material, "/Asset") for n, group in zip(names, groups, strict=True)]
    return "\n".join([*lines, "}", *materials, "}"]) + "\n"


def _subset(material: str, faces: Array) -> list[str]:
    return [
        f'def GeomSubset "{material}" (\n    prepend apiSchemas = ["MaterialBindingAPI"]\n)\n{{',
        'uniform token elementType = "face"',
        'uniform token familyName = "materialBind"',
        f"int[] indices = [{', '.join(map(str, faces.tolist()))}]",
        f"rel material:binding = </Asset/{material}>",
        "}",
    ]


def material_text(
    name: str, material: UniformMaterial | TexturedMaterial, parent: str, pictures: str = _PICTURES
) -> str:
    """The material `name` below the prim at `parent` as text; `pictures` comes before the names of `picture_files`."""
    path = f"{parent}/{name}"
    surface = [
        'def Shader "Surface"\n{',
        'uniform token info:id = "UsdPreviewSurface"',
        "token outputs:surface",
    ]
    shaders: list[str] = []
    colour = f"color3f inputs:diffuseColor.connect = <{path}/Color.outputs:rgb>"
    numbers = [
        f"float inputs:roughness.connect = <{path}/Parameters.outputs:g>",
        f"float inputs:metallic.connect = <{path}/Parameters.outputs:b>",
    ]
    outputs = ["float outputs:g", "float outputs:b"]
    if isinstance(material, TexturedMaterial):
        surface += [colour, *numbers]
        of_colour = ["float3 outputs:rgb"]
        if material.translucent:
            surface.append(f"float inputs:opacity.connect = <{path}/Color.outputs:a>")
            of_colour.append("float outputs:a")
        shaders += _texture(path, "Color", "color.png", "sRGB", of_colour)
        shaders += _texture(path, "Parameters", "surface.png", "raw", outputs)
        if material.emission is not None:
            surface.append(f"color3f inputs:emissiveColor.connect = <{path}/Emission.outputs:rgb>")
            brightest = (*[material.strength] * 3, 1.0)
            shaders += _texture(path, "Emission", "emission.png", "sRGB", ["float3 outputs:rgb"], scale=brightest)
        if material.layers is not None:
            surface += [f"float inputs:clearcoat.connect = <{path}/Layers.outputs:r>", _COAT_ROUGHNESS]
            shaders += _texture(path, "Layers", "layers.png", "raw", ["float outputs:r"])
    else:
        own = pictured_material(material)
        picture = own.colour_picture
        if picture is None:
            surface.append(f"color3f inputs:diffuseColor = ({', '.join(f'{v:.9g}' for v in material.colour)})")
        else:
            surface.append(colour)
            of_colour = ["float3 outputs:rgb"] + ["float outputs:a"] * own.translucent
            more = of_colour, picture.extension, (*material.colour, own.opacity if own.translucent else 1.0)
            shaders += _texture(path, "Color", picture.name, "sRGB", *more)
        picture = own.surface_picture
        if picture is None:
            surface.append(f"float inputs:roughness = {material.roughness:.9g}")
            surface.append(f"float inputs:metallic = {material.metallic:.9g}")
        else:
            surface += numbers
            scale = (1.0, material.roughness, material.metallic, 1.0)
            shaders += _texture(path, "Parameters", picture.name, "raw", outputs, picture.extension, scale)
        if own.normal_picture is not None:
            picture, strength = own.normal_picture, own.normal_strength
            surface.append(f"normal3f inputs:normal.connect = <{path}/Normal.outputs:rgb>")
            bias = (-strength, -strength, -1.0, 0.0)
            scale = (2 * strength, 2 * strength, 2.0, 1.0)
            placed = picture.extension, scale, bias
            shaders += _texture(path, "Normal", picture.name, "raw", ["float3 outputs:rgb"], *placed)
        if own.emission_picture is not None:
            surface.append(f"color3f inputs:emissiveColor.connect = <{path}/Emission.outputs:rgb>")
            glows, brightest = own.emission_picture, (*own.emission, 1.0)
            outputs = ["float3 outputs:rgb"]
            shaders += _texture(path, "Emission", glows.name, "sRGB", outputs, glows.extension, brightest)
        elif max(material.emission) > 0:
            surface.append(f"color3f inputs:emissiveColor = ({', '.join(f'{v:.9g}' for v in material.emission)})")
        if own.translucent:
            surface.append(f"float inputs:opacity.connect = <{path}/Color.outputs:a>")
        elif material.opacity < 1:
            surface.append(f"float inputs:opacity = {material.opacity:.9g}")
        if own.coat_picture is not None:
            surface += [f"float inputs:clearcoat.connect = <{path}/Layers.outputs:r>", _COAT_ROUGHNESS]
            coat, scale = own.coat_picture, (own.coat, 1.0, 1.0, 1.0)
            shaders += _texture(path, "Layers", coat.name, "raw", ["float outputs:r"], coat.extension, scale)
        elif material.coat > 0:
            surface += [f"float inputs:clearcoat = {material.coat:.9g}", _COAT_ROUGHNESS]
    if shaders:
        shaders = [
            'def Shader "Coordinates"\n{',
            'uniform token info:id = "UsdPrimvarReader_float2"',
            'string inputs:varname = "st"',
            "float2 outputs:result",
            "}",
            *shaders,
        ]
    connection = f"token outputs:surface.connect = <{path}/Surface.outputs:surface>"
    text = "\n".join([f'def Material "{name}"\n{{', connection, *surface, "}", *shaders, "}"])
    return text.replace(f"@{_PICTURES}", f"@{pictures}")


def _texture(
    material: str,
    name: str,
    file: str,
    space: str,
    outputs: list[str],
    extension: str = "extend",
    scale: tuple[float, ...] = (1.0,) * 4,
    bias: tuple[float, ...] = (0.0,) * 4,
) -> list[str]:
    """A texture of a material: values times `scale`, plus `bias`."""
    wrap = {"extend": "clamp"}.get(extension, extension)
    more = [("scale", scale, (1.0,) * 4), ("bias", bias, (0.0,) * 4)]
    return [
        f'def Shader "{name}"\n{{',
        'uniform token info:id = "UsdUVTexture"',
        f"asset inputs:file = @{_PICTURES}{file}@",
        f'token inputs:sourceColorSpace = "{space}"',
        f'token inputs:wrapS = "{wrap}"',
        f'token inputs:wrapT = "{wrap}"',
        *(
            f"float4 inputs:{n} = ({', '.join(f'{v:.9g}' for v in given)})"
            for n, given, plain in more
            if given != plain
        ),
        f"float2 inputs:st.connect = <{material}/Coordinates.outputs:result>",
        *outputs,
        "}",
    ]


def _tuples(rows: Array) -> str:
    """(n, c) numbers as text, float32 exactly."""
    one = f"({', '.join(['%.9g'] * rows.shape[1])})"
    parts = []
    for first in range(0, len(rows), _BLOCK):
        block = rows[first : first + _BLOCK]
        parts.append(", ".join([one] * len(block)) % tuple(block.ravel().tolist()))
    return f"[{', '.join(parts)}]"
