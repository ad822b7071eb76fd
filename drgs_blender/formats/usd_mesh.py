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
from .atlas import TexturedMaterial, UniformMaterial, mesh_material

Array = np.ndarray

_ALIGNMENT = 64
_LOCAL_HEADER = 30
#: The fixed date of entries, so that a file depends on what it holds alone.
_DATE = (1980, 1, 1, 0, 0, 0)
#: Numbers turned into text at once; bounds the memory.
_BLOCK = 1 << 16


def write_usd_mesh(path: Path, mesh: Mesh) -> None:
    """Write a USDZ with `mesh`, which is Z up, in metres; its materials as `atlas` puts them.

    Raises
    ------
    UsageError
        The mesh has no faces, or more than a texture has room for.
    WriteError
        The file cannot be written.
    """
    material = mesh_material(mesh, str(path))
    files = {"asset.usda": _stage(mesh, material).encode()}
    if isinstance(material, TexturedMaterial):
        files |= {"textures/color.png": material.colour, "textures/surface.png": material.surface}
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_STORED) as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name, _DATE)
            # An extra field fills up to the alignment; it has a head of 4 bytes.
            gap = -(data.tell() + _LOCAL_HEADER + len(name) + 4) % _ALIGNMENT
            entry.extra = b"\x86\x19" + gap.to_bytes(2, "little") + bytes(gap)
            archive.writestr(entry, content)
    replace_file(path, [data.getbuffer()])


def _stage(mesh: Mesh, material: UniformMaterial | TexturedMaterial) -> str:
    """The stage as text."""
    normals = VertexNormals(mesh.faces, len(mesh.vertices))(mesh.vertices)
    extent = np.stack([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)])
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
        f'normal3f[] normals = {_tuples(normals)} (\n    interpolation = "vertex"\n)',
    ]
    if isinstance(material, TexturedMaterial):
        uvs = material.uvs.reshape(-1, 2) * [1, -1] + [0, 1]  # v points up in USD
        lines.append(f'texCoord2f[] primvars:st = {_tuples(uvs)} (\n    interpolation = "faceVarying"\n)')
    lines += ["rel material:binding = </Asset/Material>", "}", *_material(material), "}"]
    return "\n".join(lines) + "\n"


def _material(material: UniformMaterial | TexturedMaterial) -> list[str]:
    surface = [
        'def Shader "Surface"\n{',
        'uniform token info:id = "UsdPreviewSurface"',
        "token outputs:surface",
    ]
    shaders: list[str] = []
    if isinstance(material, UniformMaterial):
        surface += [
            f"color3f inputs:diffuseColor = ({', '.join(f'{v:.9g}' for v in material.colour)})",
            f"float inputs:roughness = {material.roughness:.9g}",
            f"float inputs:metallic = {material.metallic:.9g}",
        ]
    else:
        surface += [
            "color3f inputs:diffuseColor.connect = </Asset/Material/Color.outputs:rgb>",
            "float inputs:roughness.connect = </Asset/Material/Parameters.outputs:g>",
            "float inputs:metallic.connect = </Asset/Material/Parameters.outputs:b>",
        ]
        shaders = [
            'def Shader "Coordinates"\n{',
            'uniform token info:id = "UsdPrimvarReader_float2"',
            'string inputs:varname = "st"',
            "float2 outputs:result",
            "}",
            *_texture("Color", "textures/color.png", "sRGB", ["float3 outputs:rgb"]),
            *_texture("Parameters", "textures/surface.png", "raw", ["float outputs:g", "float outputs:b"]),
        ]
    connection = "token outputs:surface.connect = </Asset/Material/Surface.outputs:surface>"
    return ['def Material "Material"\n{', connection, *surface, "}", *shaders, "}"]


def _texture(name: str, file: str, space: str, outputs: list[str]) -> list[str]:
    return [
        f'def Shader "{name}"\n{{',
        'uniform token info:id = "UsdUVTexture"',
        f"asset inputs:file = @{file}@",
        f'token inputs:sourceColorSpace = "{space}"',
        'token inputs:wrapS = "clamp"',
        'token inputs:wrapT = "clamp"',
        "float2 inputs:st.connect = </Asset/Material/Coordinates.outputs:result>",
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
