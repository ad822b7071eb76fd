"""Passes of seen surfaces that pictures rarely ask for: colours of the lobes, Mist, UV, material index, shader AOVs.

They are those of Cycles. All but the material index, which is that of the nearest sample, are means over a pixel's
samples premultiplied by coverage: in a pixel half covered, UV is half of what the surface has, with a third channel
that says so, and Mist is 1 where nothing is. Colours are the directional albedos of the lobes of a kind,
for a viewer as flat to the surface as the camera: colour passes, by which light passes are divided
(`core.passes.COLOURS`); those of objects that are shown as captured, which emit alone, are 0. Shader AOVs are looked
up where the ray meets the surface; colours are cut at 0, and have as alpha the coverage of surfaces that give one.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...compute.jit import njit
from ...compute.threads import ELEMENTS, ROWS, over_range
from ...core.frame import Frame
from ...core.memory import sparse_zeros
from ...core.passes import AOV_VALUE, AOVS, COLOURS, pass_of
from ..camera import POSITION
from ..gbuffer.gbuffer import GBuffer
from ..integrator import brdf
from ..integrator.multiscatter import energy_tables, has_multiscatter, lobe_albedo, lobe_weights
from ..integrator.records import Settings
from ..sampling import ONE, ZERO, F
from ..scene.interaction import Geometry
from ..scene.material_rows import MaterialRows
from ..scene.shader_aovs import aov_at
from ..scene.trace_scene import TraceScene
from ..shading_points import CATCHER, UNLIT, ShadingPoints

Array = np.ndarray
PutColours = Callable[[ShadingPoints, Geometry, MaterialRows, tuple[Array, Array, Array]], None]

#: Name -> channels.
CHANNELS = {"DiffCol": 3, "GlossCol": 3, "TransCol": 3, "UV": 3, "Mist": 1, "IndexMA": 1}

_COLOURS = ("DiffCol", "GlossCol", "TransCol")


class SurfaceFilm:
    """These passes of the camera's window, as far as a frame needs them.

    Parameters
    ----------
    scene : TraceScene
    frame : Frame
    parameters : array
        `camera.camera_parameters`.
    put_colours : callable
        `lobe_colours.put_lobe_colours`; handed in, so that kernels of films depend on no lobe.
    """

    def __init__(self, scene: TraceScene, frame: Frame, parameters: Array, put_colours: PutColours) -> None:
        x0, y0, x1, y1 = frame.camera.window
        wanted = {*frame.passes, *(COLOURS[name] for name in frame.passes if name in COLOURS)}
        self._aovs = [name for name in frame.passes if name.startswith(AOVS)]
        widths = CHANNELS | {name: len(kind.channels) for name in self._aovs if (kind := pass_of(name))}
        self._scene, self._frame, self._parameters, self._origin = scene, frame, parameters, (x0, y0)
        self._put_colours = put_colours
        self.pixels = {
            name: sparse_zeros((y1 - y0, x1 - x0, channels)) for name, channels in widths.items() if name in wanted
        }
        self._uvs = scene.mesh_materials.uv_maps() if "UV" in self.pixels else None

    def add(self, buffer: GBuffer) -> None:
        """Take the samples of a strip."""
        if not self.pixels:
            return
        x0, top = self._origin
        y0, y1 = buffer.rows
        rows = buffer.point_rows(x0, self._frame.camera.width)
        values: dict[str, Array] = {}
        if not self.pixels.keys().isdisjoint(_COLOURS):
            values |= {name: v for name, v in zip(_COLOURS, self._colours(buffer)) if name in self.pixels}
        if self._uvs is not None:
            values["UV"] = self._places(buffer, self._uvs)
        if "Mist" in self.pixels:
            values["Mist"] = 1 - self._mist(buffer)
        values |= {name: self._aov(buffer, name) for name in self._aovs}
        for name in self.pixels.keys() & values.keys():
            over_range(mean_of_points, y1 - y0, rows, values[name], self.pixels[name][y0 - top : y1 - top], fewest=ROWS)
        if "IndexMA" in self.pixels:
            out = self.pixels["IndexMA"][y0 - top : y1 - top, :, 0]
            over_range(_nearest, y1 - y0, rows, self._material_index(buffer), out, fewest=ROWS)

    def passes(self) -> dict[str, Array]:
        """Name -> (h, w, channels) float32."""
        return {name: 1 - pixels if name == "Mist" else pixels for name, pixels in self.pixels.items()}

    def _colours(self, buffer: GBuffer) -> tuple[Array, Array, Array]:
        """(n, 3) float32 colour of diffuse, glossy and transmitting lobes at each point."""
        points = buffer.points
        diffuse, glossy, passed = (np.zeros((len(points), 3), np.float32) for _ in range(3))
        model = brdf.SHADING_MODELS[self._frame.settings.shading_model]
        geometry = self._scene.geometry
        settings = Settings(0, model, brdf.layer_table(), *energy_tables())
        given = points.arrays, geometry, settings, brdf.schlick_table()
        over_range(_lobe_colours, len(points), *given, diffuse, glossy, fewest=ELEMENTS)
        rows = self._scene.mesh_materials.table.rows
        if rows is not None and self._frame.settings.shading_model == "principled":
            self._put_colours(points, geometry, rows, (diffuse, glossy, passed))
        unlit = points.flags & UNLIT != 0  # they emit alone
        if unlit.any():
            diffuse[unlit] = glossy[unlit] = passed[unlit] = 0.0
        return diffuse, glossy, passed

    def _places(self, buffer: GBuffer, uvs: Array) -> Array:
        """(n, 3) float32: u, v and 1 at each point; 0 where there is no UV map."""
        out = np.zeros((len(buffer.face), 3), np.float32)
        own = buffer.face - self._scene.vertex_faces
        meshes = own >= 0
        if len(uvs):
            corners, (u, v) = uvs[own[meshes]], buffer.barycentric[meshes].T
            weights = np.stack([1 - u - v, u, v], axis=1)[:, :, None]
            out[meshes] = (weights * corners).sum(axis=1)
        return out

    def _aov(self, buffer: GBuffer, name: str) -> Array:
        """(n, 1 or 4) float32 of a shader AOV at each point."""
        scene, values = self._scene, np.zeros((len(buffer.face), 4), np.float32)
        source = scene.source[buffer.object_index]
        for i, item in enumerate(self._frame.objects):
            own = [aov.colour for aov in item.aovs if aov.name == name]
            if own:
                values[source == i] = *own[0], 1.0
        face = buffer.face - scene.vertex_faces
        meshes = np.flatnonzero((face >= 0) & (source >= len(self._frame.objects)))
        values[meshes] = aov_at(name, scene.mesh_materials, face[meshes], buffer.barycentric[meshes])
        if name.startswith(AOV_VALUE):
            return values[:, :1]
        return np.maximum(values, 0)

    def _mist(self, buffer: GBuffer) -> Array:
        """(n, 1) float32 mist of each point in [0, 1]."""
        mist, p = self._frame.mist, self._parameters
        if self._frame.camera.orthographic:
            far = np.abs(buffer.depth).astype(np.float64)
        else:
            far = np.linalg.norm(buffer.position - p[POSITION : POSITION + 3], axis=1)
        part = np.clip((far - mist.start) / mist.depth if mist.depth > 0 else 0 * far, 0, 1)
        return (part**mist.falloff)[:, None].astype(np.float32)

    def _material_index(self, buffer: GBuffer) -> Array:
        """(n,) float32 pass index of the material at each point."""
        scene, objects = self._scene, [item.material_pass_index for item in self._frame.objects]
        numbers = np.array([*scene.mesh_materials.pass_indices, 0, *objects], np.float32)
        row = scene.mesh_materials.of(buffer.face - scene.vertex_faces)
        source = scene.source[buffer.object_index]
        none = len(scene.mesh_materials.names)
        return numbers[np.where(row == none, np.where(source < len(objects), none + 1 + source, none), row)]


@njit
def _lobe_colours(first, last, points, geometry, settings, schlick, diffuse, glossy):  # type: ignore[no-untyped-def]
    """Directional albedo of both lobes at some points; diffuse is exactly what the integrator multiplies with.

    As in Cycles, glossy is that of the first microfacet's reflection, less what Multiscatter GGX does not make up for.
    """
    normal, geometric, view = points.normal, points.geometric_normal, points.viewer
    for i in range(first, last):
        vx, vy, vz = view[i, 0], view[i, 1], view[i, 2]
        mx, my, mz = brdf.glossy_normal(
            normal[i, 0], normal[i, 1], normal[i, 2], geometric[i, 0], geometric[i, 1], geometric[i, 2], vx, vy, vz
        )
        nv, rough, metal = mx * vx + my * vy + mz * vz, points.roughness[i], points.metallic[i]
        own = points.albedo[i, 0], points.albedo[i, 1], points.albedo[i, 2]
        multiscatter = len(points.face) > 0 and has_multiscatter(points.face[i], geometry)
        kd, metals, dielectric = lobe_weights(nv, rough, metal, own, multiscatter, settings)
        kept = lobe_albedo(nv, rough, settings) if multiscatter else ONE
        s = brdf.layer_albedo(rough, nv, schlick)
        for c in range(3):
            diffuse[i, c] = kd * own[c]
            cut = min(own[c], ONE)
            if settings.shading_model == brdf.PAPER:
                base = F(0.04) * (ONE - metal) + metal * cut
                glossy[i, c] = base + (ONE - base) * s
            else:
                layer = brdf.layer_albedo(rough, nv, settings.layers)
                glossy[i, c] = dielectric * kept * layer + metals[c] * kept * (cut + (ONE - cut) * s)


@njit
def mean_of_points(y0, y1, points, values, out):  # type: ignore[no-untyped-def]
    """Add the values of points to their pixels, by weight.

    Parameters
    ----------
    y0, y1 : int64
        Rows.
    points : PointRows
    values : (n, k) float32 array
    out : (h, w, k) float32 array
    """
    for y in range(y0, y1):
        for i in range(points.start[y], points.start[y + 1]):
            if points.flags[i] & CATCHER:
                continue
            x = points.pixel[i] % points.width - points.x0
            for c in range(values.shape[1]):
                out[y, x, c] += points.weight[i] * values[i, c]


@njit
def _nearest(y0, y1, points, values, out):  # type: ignore[no-untyped-def]
    """Give each pixel the value of its nearest point."""
    for y in range(y0, y1):
        before, depth = np.int32(-1), ZERO
        for i in range(points.start[y], points.start[y + 1]):
            if points.flags[i] & CATCHER or (points.pixel[i] == before and points.depth[i] >= depth):
                continue
            before, depth = points.pixel[i], points.depth[i]
            out[y, before % points.width - points.x0] = values[i]
