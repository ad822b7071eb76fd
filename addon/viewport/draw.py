"""Pictures onto the screen: what is drawn where, in what colours, as one table of shaders."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from .view_transform import HIGH, LOW, SIZE

Array = np.ndarray
Rect = tuple[float, float, float, float]

#: Formats of the passes that are drawn.
KINDS = {"Combined": "RGBA16F", "Depth": "R32F"}

_QUAD = """
void main()
{
  uv = vec2(pos.x, mix(strip.x, strip.y, pos.y));
  gl_Position = vec4(mix(rect.xw, rect.zy, uv) * 2.0 - 1.0, 0.0, 1.0);
}
"""
#: Coarse pixels are smoothed; where a pixel of the picture is one of the screen, it is shown as it is.
_SMOOTH = """
void main()
{
  ivec2 size = ivec2(textureSize(image, 0).x, int(strip.w));
  vec2 place = uv * vec2(size) - 0.5;
  ivec2 low = ivec2(floor(place));
  vec2 share = place - vec2(low);
  ivec2 first = ivec2(0, int(strip.z));
  ivec2 a = clamp(low, ivec2(0), size - 1) - first, b = clamp(low + 1, ivec2(0), size - 1) - first;
  vec4 above = mix(texelFetch(image, a, 0), texelFetch(image, ivec2(b.x, a.y), 0), share.x);
  vec4 below = mix(texelFetch(image, ivec2(a.x, b.y), 0), texelFetch(image, b, 0), share.x);
  vec4 light = mix(above, below, share.y);
"""
_LINEAR = _SMOOTH + "  colour = light;\n}\n"
#: The buffer of what is drawn after Blender's objects encodes what it is given as sRGB.
_DECODE = """
vec3 decoded(vec3 colour)
{
  vec3 power = pow((max(colour, vec3(0.04045)) + 0.055) / 1.055, vec3(2.4));
  return mix(power, colour / 12.92, lessThanEqual(colour, vec3(0.04045)));
}
"""
#: The nearest of the depths around decides, so that no rim of the object is hidden by what it stands before.
_COMPOSITE = f"""{_DECODE}
vec3 shown(vec3 light)
{{
  const float last = {SIZE - 1}.0;
  vec3 place = (log2(max(light, vec3(0.0)) + exp2({LOW})) - {LOW}) / {HIGH - LOW};
  place = clamp(place, 0.0, 1.0) * last;
  ivec3 low = ivec3(min(place, vec3(last - 1.0)));
  vec3 share = place - vec3(low);
  vec3 sum = vec3(0.0);
  for (int corner = 0; corner < 8; corner++) {{
    ivec3 step = ivec3(corner & 1, (corner >> 1) & 1, corner >> 2);
    vec3 weight = mix(1.0 - share, share, vec3(step));
    ivec3 cell = low + step;
    sum += weight.x * weight.y * weight.z * texelFetch(table, ivec2(cell.x, cell.y + {SIZE} * cell.z), 0).rgb;
  }}
  return sum;
}}
{_SMOOTH}
  vec4 depths = vec4(
    texelFetch(depth, a, 0).r,
    texelFetch(depth, ivec2(b.x, a.y), 0).r,
    texelFetch(depth, ivec2(a.x, b.y), 0).r,
    texelFetch(depth, b, 0).r
  );
  float near = min(min(depths.x, depths.y), min(depths.z, depths.w));
  if (light.a <= 0.0 || near > 1e9) {{
    discard;
  }}
  float z = projection.x * -near + projection.y;
  float w = projection.z * -near + projection.w;
  gl_FragDepth = clamp(0.5 * z / w + 0.5, 0.0, 1.0);
  vec3 straight = light.rgb / light.a * grading.x;
  colour = vec4(decoded(pow(shown(straight), vec3(grading.y))) * light.a, light.a);
}}
"""
_DISC = """
void main()
{
  tint = albedo;
  gl_Position = transform * vec4(pos, 1.0);
  gl_PointSize = clamp(size * scale.x / (scale.y > 0.5 ? gl_Position.w : 1.0), 2.0, 64.0);
}
"""
_ROUND = """
void main()
{
  vec2 place = gl_PointCoord * 2.0 - 1.0;
  if (dot(place, place) > 1.0) {
    discard;
  }
  colour = vec4(tint, 1.0);
}
"""


@dataclass(frozen=True, slots=True)
class Mode:
    """One way of drawing: a shader, what it is given, and how it meets what is on the screen already."""

    inputs: tuple[tuple[str, str], ...]
    passed: tuple[tuple[str, str], ...]
    constants: tuple[tuple[str, str], ...]
    images: tuple[str, ...]
    vertex: str
    fragment: str
    depth_test: str = "NONE"
    own_depth: bool = False


#: Where the whole picture lies, and of a strip: where it begins and ends, the first row it has, those of the picture.
_PLACEMENT = (("VEC4", "rect"), ("VEC4", "strip"))
_SCREEN: dict[str, Any] = {"inputs": (("VEC2", "pos"),), "passed": (("VEC2", "uv"),), "vertex": _QUAD}
MODES = {
    "rendered": Mode(constants=_PLACEMENT, images=("image",), fragment=_LINEAR, **_SCREEN),
    "composited": Mode(
        constants=(*_PLACEMENT, ("VEC4", "projection"), ("VEC2", "grading")),
        images=("image", "depth", "table"),
        fragment=_COMPOSITE,
        depth_test="LESS_EQUAL",
        own_depth=True,
        **_SCREEN,
    ),
    "surfels": Mode(
        inputs=(("VEC3", "pos"), ("VEC3", "albedo"), ("FLOAT", "size")),
        passed=(("VEC3", "tint"),),
        constants=(("MAT4", "transform"), ("VEC2", "scale")),
        images=(),
        vertex=_DISC,
        fragment=_ROUND,
        depth_test="LESS_EQUAL",
    ),
}
_shaders: dict[str, gpu.types.GPUShader] = {}
_quads: dict[str, gpu.types.GPUBatch] = {}


def shader(name: str) -> gpu.types.GPUShader:
    """The compiled shader of a mode."""
    if name not in _shaders:
        mode = MODES[name]
        between = gpu.types.GPUStageInterfaceInfo(f"drgs_{name}")
        for kind, passed in mode.passed:
            between.smooth(kind, passed)
        info = gpu.types.GPUShaderCreateInfo()
        for i, (kind, given) in enumerate(mode.inputs):
            info.vertex_in(i, kind, given)
        info.vertex_out(between)
        for kind, constant in mode.constants:
            info.push_constant(kind, constant)
        for i, image in enumerate(mode.images):
            info.sampler(i, "FLOAT_2D", image)
        info.fragment_out(0, "VEC4", "colour")
        if mode.own_depth and hasattr(info, "depth_write"):  # before, writing gl_FragDepth was enough
            info.depth_write("ANY")
        info.vertex_source(mode.vertex)
        info.fragment_source(mode.fragment)
        _shaders[name] = gpu.shader.create_from_info(info)
    return _shaders[name]


class Strip(NamedTuple):
    """Rows of a picture on the graphics card, with a neighbouring row on either side to be smoothed with."""

    span: tuple[float, float, float, float]  # constant "strip" of the shaders
    textures: dict[str, gpu.types.GPUTexture]  # by pass


def strip(passes: Mapping[str, Array], top: int, bottom: int) -> Strip:
    """Hand the rows ``top .. bottom`` of passes, (h, w, c) float32 of one size, to the graphics card."""
    height = len(next(iter(passes.values())))
    first, last = max(top - 1, 0), min(bottom + 1, height)
    textures = {name: texture(pixels[first:last], KINDS[name]) for name, pixels in passes.items()}
    return Strip((top / height, bottom / height, float(first), float(height)), textures)


def texture(pixels: Array, kind: str = "RGBA16F") -> gpu.types.GPUTexture:
    """A texture of (h, w, c) float32, row 0 first."""
    height, width, channels = pixels.shape
    data = gpu.types.Buffer("FLOAT", (height, width, channels), np.ascontiguousarray(pixels, np.float32))
    return gpu.types.GPUTexture((width, height), format=kind, data=data)


def _draw(name: str, batch: gpu.types.GPUBatch, constants: dict[str, Any], images: dict[str, Any]) -> None:
    program, mode = shader(name), MODES[name]
    before = gpu.state.depth_test_get(), gpu.state.depth_mask_get(), gpu.state.blend_get()
    gpu.state.depth_test_set(mode.depth_test)
    gpu.state.depth_mask_set(mode.depth_test != "NONE")
    gpu.state.blend_set("ALPHA_PREMULT")
    program.bind()
    for constant, value in constants.items():
        program.uniform_float(constant, value)
    for image, found in images.items():
        program.uniform_sampler(image, found)
    batch.draw(program)
    gpu.state.depth_test_set(before[0])
    gpu.state.depth_mask_set(before[1])
    gpu.state.blend_set(before[2])


def _quad(name: str) -> gpu.types.GPUBatch:
    if name not in _quads:
        corners = {"pos": ((0, 0), (1, 0), (0, 1), (1, 1))}
        _quads[name] = batch_for_shader(shader(name), "TRI_STRIP", corners)
    return _quads[name]


def picture(strips: Iterable[Strip], rect: Rect) -> None:
    """Draw scene-linear premultiplied pixels into a rendered viewport, whose view transform Blender applies.

    Parameters
    ----------
    strips : with the pass Combined
    rect : (x0, y0, x1, y1) of the whole picture in the region, 0 to 1, y upwards
    """
    for s in strips:
        _draw("rendered", _quad("rendered"), {"rect": rect, "strip": s.span}, {"image": s.textures["Combined"]})


def composite(
    strips: Iterable[Strip],
    table: gpu.types.GPUTexture,
    rect: Rect,
    projection: Array,
    grading: tuple[float, float],
) -> None:
    """Draw scene-linear premultiplied pixels between the objects of a finished viewport.

    Parameters
    ----------
    strips : with the passes Combined and Depth, metres along the view axis
    table : `display.table`
    rect : as of `picture`
    projection : (4, 4) of the viewport
    grading : factor on the light, exponent on the display's colours
    """
    lines = (projection[2, 2], projection[2, 3], projection[3, 2], projection[3, 3])
    for s in strips:
        constants = {"rect": rect, "strip": s.span, "projection": lines, "grading": grading}
        images = {"image": s.textures["Combined"], "depth": s.textures["Depth"], "table": table}
        _draw("composited", _quad("composited"), constants, images)


def disc_batch(positions: Array, albedo: Array, sizes: Array) -> gpu.types.GPUBatch:
    """Discs at (n, 3) places with (n, 3) linear colours and (n,) diameters, in metres."""
    given = {"pos": positions, "albedo": albedo, "size": sizes}
    return batch_for_shader(shader("surfels"), "POINTS", given)


def discs(batch: gpu.types.GPUBatch, transform: Any, scale: float, perspective: bool) -> None:
    """Draw discs that face the viewer.

    Parameters
    ----------
    transform : from the places to the screen
    scale : pixels of a metre at depth 1, or anywhere in an orthographic view
    """
    gpu.state.program_point_size_set(True)
    _draw("surfels", batch, {"transform": transform, "scale": (scale, float(perspective))}, {})
    gpu.state.program_point_size_set(False)


def forget() -> None:
    """Give everything back."""
    _shaders.clear()
    _quads.clear()
