"""STL, OFF, 3MF and COLLADA files, written by the book."""

from __future__ import annotations

import io
import struct
import zipfile

import numpy as np

Array = np.ndarray


def binary_stl(triangles: Array, header: bytes = b"", attribute: int = 0) -> bytes:
    """(m, 3, 3) corners."""
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *t.reshape(-1).tolist(), attribute) for t in triangles)
    return header.ljust(80, b"\0") + struct.pack("<I", len(triangles)) + body


def text_stl(triangles: Array, name: str = "part") -> bytes:
    """(m, 3, 3) corners."""
    lines = [f"solid {name}"]
    for triangle in triangles:
        lines += ["facet normal 0 0 0", "outer loop"]
        lines += [f"vertex {x!r} {y!r} {z!r}" for x, y, z in triangle.tolist()] + ["endloop", "endfacet"]
    return "\n".join([*lines, f"endsolid {name}", ""]).encode()


def off(vertices: Array, faces: Array) -> bytes:
    """Numbers as they are."""
    rows = [" ".join(map(repr, v)) for v in vertices.tolist()]
    rows += [" ".join(map(str, [len(f), *f])) for f in faces.tolist()]
    return "\n".join([f"OFF {len(vertices)} {len(faces)} 0", *rows]).encode()


def model(vertices: Array, faces: Array, number: int = 1) -> str:
    """An object of 3MF."""
    points = "".join(f'<vertex x="{x!r}" y="{y!r}" z="{z!r}"/>' for x, y, z in vertices.tolist())
    triangles = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in faces.tolist())
    inside = f"<mesh><vertices>{points}</vertices><triangles>{triangles}</triangles></mesh>"
    return f'<object id="{number}" type="model">{inside}</object>'


def threemf(objects: str, items: str = '<item objectid="1"/>', unit: str = "millimeter") -> bytes:
    """A package of one model."""
    data = io.BytesIO()
    space = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
    xml = f'<model unit="{unit}" xmlns="{space}"><resources>{objects}</resources><build>{items}</build></model>'
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("[Content_Types].xml", "<Types/>")
        archive.writestr("3D/3dmodel.model", f'<?xml version="1.0" encoding="UTF-8"?>{xml}')
    return data.getvalue()


def source(name: str, values: Array, names: str) -> str:
    """A source of COLLADA."""
    text = " ".join(map(repr, values.reshape(-1).tolist()))
    params = "".join(f'<param name="{n}" type="float"/>' for n in names)
    return (
        f'<source id="{name}"><float_array id="{name}-a" count="{values.size}">{text}</float_array><technique_common>'
        f'<accessor source="#{name}-a" count="{len(values)}" stride="{len(names)}">{params}</accessor>'
        "</technique_common></source>"
    )


def collada(
    vertices: Array,
    polygons: list[list[int]],
    *,
    uvs: Array | None = None,
    normals: Array | None = None,
    colours: Array | None = None,
    diffuse: str = "<color>0.2 0.4 0.6 1</color>",
    images: str = "",
    nodes: str = "",
    place: str = "",
    up: str = "Z_UP",
    metres: float = 1.0,
) -> bytes:
    """A scene with one mesh, as Blender writes it; uvs, normals and colours are of each corner in turn."""
    inputs, sources, columns = '<input semantic="VERTEX" source="#v" offset="0"/>', source("p", vertices, "XYZ"), 1
    for name, values, letters in (("NORMAL", normals, "XYZ"), ("TEXCOORD", uvs, "ST"), ("COLOR", colours, "RGB")):
        if values is not None:
            sources += source(name, values, letters)
            inputs += f'<input semantic="{name}" source="#{name}" offset="{columns}" set="0"/>'
            columns += 1
    flat = [vertex for polygon in polygons for vertex in polygon]
    indices = " ".join(str(i) for k, v in enumerate(flat) for i in [v] + [k] * (columns - 1))
    return f"""<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="u" meter="{metres!r}"/><up_axis>{up}</up_axis></asset>
<library_images>{images}</library_images>
<library_effects><effect id="e"><profile_COMMON>
{'<newparam sid="s"><surface type="2D"><init_from>i</init_from></surface></newparam>' if images else ""}
{'<newparam sid="t"><sampler2D><source>s</source></sampler2D></newparam>' if images else ""}
<technique sid="common"><lambert><diffuse>{diffuse}</diffuse></lambert></technique></profile_COMMON></effect>
</library_effects><library_materials><material id="m" name="Paint"><instance_effect url="#e"/></material>
</library_materials><library_geometries><geometry id="g"><mesh>{sources}
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<polylist material="m" count="{len(polygons)}">{inputs}<vcount>{" ".join(str(len(p)) for p in polygons)}</vcount>
<p>{indices}</p></polylist></mesh></geometry></library_geometries>
<library_nodes>{nodes}</library_nodes><library_visual_scenes><visual_scene id="scene"><node id="n">{place}
<instance_geometry url="#g"><bind_material><technique_common><instance_material symbol="m" target="#m"/>
</technique_common></bind_material></instance_geometry></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#scene"/></scene></COLLADA>""".encode()
