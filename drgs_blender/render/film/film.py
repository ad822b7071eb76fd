"""The film: shading points and their light become the pixels of all passes.

A pixel is the plain mean of its ``subpixels`` sub-pixel samples drawn from the pixel filter by `camera`, premultiplied
by coverage. Passes that describe the surface are not premultiplied, so that the object has no dark rim in them:

- Depth, Position: mean of the samples on the surface nearest to the camera (those within `SAME_SURFACE` pixel widths
  of the nearest one), so that no value lies between two surfaces; 1e10 and 0 where the pixel is empty;
- Normal, Albedo, Roughness, Metallic: mean of all covered samples by weight;
- IndexOB, Object: of the nearest sample.

Combined is the light of `Pixels.components` + environment + emission, added in this order. The passes of light are
these components divided by the colours of the surfaces, as in Cycles (`core.passes.COLOURS`).

A holdout leaves black, and alpha 0 where the film is transparent. A shadow catcher is seen by its shadow alone, a black
veil as dense as the part of its light that the rest of the scene takes from it: 1 - (light in the scene) / (light among
catchers alone), both summed over the pixel first, so that the quotient is not one of noise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...compute.jit import njit
from ...compute.threads import ROWS, over_range
from ...core.frame import Camera, RenderSettings
from ...core.memory import sparse_zeros
from ...core.passes import COLOURS, without_colour
from ..camera import FX, FY, ORTHOGRAPHIC, SUBPIXELS, WIDTH, footprints, sample_ray
from ..gbuffer.gbuffer import GBuffer
from ..lights.environment import EnvironmentLight
from ..sampling import luminance
from ..shading_points import CATCHER, UNLIT, Radiance
from .catcher_film import CatcherFilm
from .guides import Guides
from .light_passes import LIGHT_PASSES, add_light, light_parts
from .object_numbers import ObjectNumbers, number_of
from .seen_world import SeenWorld
from .surface_film import mean_of_points

Array = np.ndarray

EMPTY_DEPTH = 1e10
#: Samples of one pixel within this many pixel widths of depth are of one surface (a slope of 83 degrees).
SAME_SURFACE = 8.0
_NUMBERS = {"IndexOB": "pass_index", "Object": "name"}
#: Coverage that is only the rounding of a sum.
_ROUNDING = np.float32(1e-4)


class Pixels(NamedTuple):
    """What points add up to, of all pixels of a window or of some of its rows; float32.

    Attributes
    ----------
    coverage, roughness, metallic : (h, w) array
        In [0, 1].
    object_row : (h, w) array
        Of the nearest sample's object, in `ObjectNumbers`.
    depth : (h, w) array
        Metres along the view axis; `EMPTY_DEPTH` where the pixel is empty.
    position : (h, w, 3) array
        World, m; 0 where the pixel is empty.
    normal : (h, w, 3) array
        Shading normal, unit, world; 0 where the pixel is empty.
    albedo : (h, w, 3) array
        Linear Rec.709, not premultiplied.
    components : (h, w, 4, 3) array
        In the order of `shading_points.Radiance.components`, premultiplied, linear Rec.709.
    variance : (h, w, 2) array
        Of the luminance of the premultiplied diffuse and glossy sums.
    emission : (h, w, 3) array
        Light that seen surfaces emit, premultiplied, linear Rec.709.
    catcher : (h, w, 3) array
        Sums by weight over the points of catchers: one, luminance, unshadowed luminance.
    """

    coverage: Array
    position: Array
    normal: Array
    albedo: Array
    roughness: Array
    metallic: Array
    object_row: Array
    depth: Array
    components: Array
    variance: Array
    emission: Array
    catcher: Array

    @classmethod
    def empty(cls, size: tuple[int, int]) -> Pixels:
        """Pixels (h, w) that nothing covers."""
        scalars = {"coverage": (), "roughness": (), "metallic": (), "object_row": (), "depth": ()}
        widths = scalars | {"components": (4, 3), "variance": (2,)}
        made = cls(*(sparse_zeros((*size, *widths.get(name, (3,)))) for name in cls._fields))
        made.depth[:] = EMPTY_DEPTH
        return made

    def rows(self, first: int, last: int) -> Pixels:
        """View of some rows, in the same memory."""
        return Pixels(*(array[first:last] for array in self))


class Film:
    """The picture while it is made, of the camera's window.

    Parameters
    ----------
    camera : Camera
    settings : RenderSettings
    parameters : array
        `camera.camera_parameters`.
    seen_world : SeenWorld, optional
        That of an earlier film of the same samples.

    Attributes
    ----------
    pixels : Pixels
    seen_world : SeenWorld
    unlit : (h, w) float32 array, optional
        The part of the coverage that is of unlit objects; None: there are none.
    transmitted : (h, w, 2, 3) float32 array, optional
        The part of the glossy components, direct and indirect, that surfaces let pass; None: none does.
    """

    def __init__(
        self, camera: Camera, settings: RenderSettings, parameters: Array, seen_world: SeenWorld | None = None
    ) -> None:
        x0, y0, x1, y1 = camera.window
        size = (y1 - y0, x1 - x0)
        self.transparent = settings.film_transparent
        self.origin = (x0, y0)
        self.parameters = parameters
        self.round = camera.panorama in ("fisheye", "equisolid")
        self.pixels = Pixels.empty(size)
        self.catchers = CatcherFilm(camera, settings, parameters)
        self._adds_world = seen_world is None and not self.transparent
        self.seen_world = seen_world or SeenWorld(size)
        self.unlit: Array | None = None
        self.transmitted: Array | None = None
        self._objects: ObjectNumbers | None = None

    def add(
        self, buffer: GBuffer, radiance: Radiance, objects: ObjectNumbers, environment: EnvironmentLight
    ) -> None:  # fmt: skip
        """Take the strip `buffer` with the light of its points.

        Parameters
        ----------
        buffer : GBuffer
        radiance : Radiance
        objects : ObjectNumbers
            The same for all strips.
        environment : EnvironmentLight
            Background, unless the film is transparent, or took over what is seen of it.
        """
        self._objects = objects
        x0, top = self.origin
        y0, y1 = buffer.rows
        rows = slice(y0 - top, y1 - top)
        points = buffer.points
        self.catchers.add(buffer, radiance)
        unlit = np.flatnonzero(points.flags & UNLIT)
        if len(unlit):
            row, column = np.divmod(points.pixel[unlit], int(self.parameters[WIDTH]))
            self.unlit = np.zeros_like(self.pixels.coverage) if self.unlit is None else self.unlit
            np.add.at(self.unlit, (row - top, column - x0), points.weight[unlit])
        if radiance.transmitted is not None:
            if self.transmitted is None:
                self.transmitted = np.zeros((*self.pixels.coverage.shape, 2, 3), np.float32)
            sums = self.transmitted[rows].reshape(y1 - y0, -1, 6)
            given = buffer.point_rows(x0, int(self.parameters[WIDTH])), radiance.transmitted.reshape(-1, 6)
            over_range(mean_of_points, y1 - y0, *given, sums, fewest=ROWS)
        unshadowed = np.zeros(len(points), np.float32) if radiance.unshadowed is None else radiance.unshadowed
        light = radiance.components, radiance.variance, unshadowed
        over_range(
            _develop, y1 - y0, buffer.point_rows(x0, int(self.parameters[WIDTH])), buffer.surfaces(), light,
            self.parameters, self.pixels.rows(y0 - top, y1 - top), fewest=ROWS)  # fmt: skip
        if self._adds_world and not environment.black:
            self.seen_world.add(buffer, environment, self.parameters, self.origin)

    def guides(self) -> Guides:
        """The denoiser's guides: what differs from surface to surface. Of unlit objects there is no light to guide."""
        known = self.pixels._asdict()
        if self.unlit is not None:
            lit = known["coverage"] - self.unlit
            known["coverage"] = np.where(lit > _ROUNDING, lit, np.float32(0.0))
        shared = {name: known[name] for name in Guides._fields if name in known}
        return Guides(**shared, object=self._number("name"), footprint=footprints(known["depth"], self.parameters))

    def _number(self, kind: str) -> Array:
        return number_of(self._objects, kind, self.pixels.object_row, self.pixels.depth == EMPTY_DEPTH)

    def passes(
        self,
        names: tuple[str, ...],
        colours: dict[str, Array],
        components: Array | None = None,
        vector: Array | None = None,
        previous: Array | None = None,
    ) -> dict[str, Array]:
        """Passes by name, (h, w, channels) float32.

        Parameters
        ----------
        names : tuple of str
        colours : dict of str to array
            DiffCol, GlossCol and TransCol (h, w, 3), where passes of light are wanted.
        components : (h, w, 4, 3) array, optional
            Denoised light; that of the film when None.
        vector, previous : array, optional
            The passes of motion; nothing moves when None.
        """
        seen = self.pixels
        light = seen.components if components is None else components
        parts = light_parts(light, seen.components, self.transmitted, colours)
        made = {
            name: without_colour(part, colours[COLOURS[name]])
            for name, part in zip(LIGHT_PASSES, parts)
            if name in names
        }
        shadow = self._shadow()
        made["Env"] = self.seen_environment()
        made["Emit"] = seen.emission
        made |= {"Position": seen.position, "Normal": seen.normal, "Albedo": seen.albedo, "Variance": seen.variance}
        made["Vector"] = np.zeros((*seen.coverage.shape, 4), np.float32) if vector is None else vector
        made["Previous Position"] = seen.position if previous is None else previous
        scalars = {"Depth": seen.depth, "Roughness": seen.roughness, "Metallic": seen.metallic}
        scalars["Coverage"] = seen.coverage
        scalars |= {name: self._number(kind) for name, kind in _NUMBERS.items() if name in names}
        made |= {name: values[..., None] for name, values in scalars.items()}
        if "Combined" in names:
            made["Combined"] = self._beauty(light, made["Env"], shadow)
        if "Noisy Image" in names:
            made["Noisy Image"] = self._beauty(seen.components, made["Env"], shadow)
        return {name: made[name] for name in names}

    def seen_environment(self) -> Array:
        """(h, w, 3) float32: light straight from the world, the pass Env."""
        return self.seen_world.behind(self._shadow())

    def _shadow(self) -> Array:
        """(h, w) float32 in [0, 1]: how dense the shadows on catchers are."""
        _, light, unshadowed = np.moveaxis(self.pixels.catcher, 2, 0)
        if not unshadowed.any():
            return np.zeros(light.shape, np.float32)
        return np.where(unshadowed > 0, np.clip(1 - light / np.where(unshadowed > 0, unshadowed, 1), 0, 1), 0)

    def _beauty(self, light: Array, environment: Array, shadow: Array) -> Array:
        opaque = self.pixels.coverage + self.pixels.catcher[:, :, 0] * shadow if self.transparent else np.float32(1.0)
        if self.transparent and self.round:
            over_range(_around, len(shadow), self.parameters, *self.origin, opaque, fewest=ROWS)
        return add_light(light, environment, self.pixels.emission, opaque)


@njit
def _develop(y0, y1, points, surfaces, light, p, pixels):  # type: ignore[no-untyped-def]
    """Sum the points of each pixel of some rows; they are neighbours in the arrays.

    Parameters
    ----------
    points : PointRows
    surfaces : PointSurfaces
    light : tuple of array
        Components, variance and unshadowed luminance of `Radiance`.
    p : array
        `camera.camera_parameters`.
    pixels : Pixels
    """
    start, pixel, weight, flags, depth = points.start, points.pixel, points.weight, points.flags, points.depth
    position = points.position
    shone, spread, unshadowed = light
    per_depth = np.float32(0.0 if p[ORTHOGRAPHIC] != 0.0 else SAME_SURFACE / min(p[FX], p[FY]))
    fixed = np.float32(SAME_SURFACE / min(p[FX], p[FY]) if p[ORTHOGRAPHIC] != 0.0 else 0.0)
    zero = np.float32(0.0)
    for y in range(y0, y1):
        first = start[y]
        while first < start[y + 1]:
            last = first + 1
            while last < start[y + 1] and pixel[last] == pixel[first]:
                last += 1
            x = pixel[first] % points.width - points.x0
            nearest = -1
            for i in range(first, last):
                if flags[i] & CATCHER:
                    shine = zero
                    for c in range(4):
                        shine += luminance(shone[i, c, 0], shone[i, c, 1], shone[i, c, 2])
                    pixels.catcher[y, x, 0] += weight[i]
                    pixels.catcher[y, x, 1] += weight[i] * shine
                    pixels.catcher[y, x, 2] += weight[i] * unshadowed[i]
                elif nearest < 0 or depth[i] < depth[nearest]:
                    nearest = i
            if nearest < 0:
                first = last
                continue
            limit = depth[nearest] * (np.float32(1.0) + per_depth) + fixed
            total = surface = mean_depth = rough = metal = zero
            px = py = pz = nx = ny = nz = r = g = b = zero
            for i in range(first, last):
                if flags[i] & CATCHER:
                    continue
                w = weight[i]
                total += w
                for k in range(3):
                    if surfaces.emission[i, k] != zero:  # what is not written takes no memory
                        pixels.emission[y, x, k] += w * surfaces.emission[i, k]
                for c in range(4):
                    for k in range(3):
                        pixels.components[y, x, c, k] += w * shone[i, c, k]
                pixels.variance[y, x, 0] += w * w * spread[i, 0]
                pixels.variance[y, x, 1] += w * w * spread[i, 1]
                nx, ny, nz = (
                    nx + w * surfaces.normal[i, 0],
                    ny + w * surfaces.normal[i, 1],
                    nz + w * surfaces.normal[i, 2],
                )
                r, g, b = r + w * surfaces.albedo[i, 0], g + w * surfaces.albedo[i, 1], b + w * surfaces.albedo[i, 2]
                rough, metal = rough + w * surfaces.roughness[i], metal + w * surfaces.metallic[i]
                if depth[i] <= limit:
                    surface += w
                    # Differences to the nearest sample, so that float32 keeps small ones far from the origin.
                    mean_depth += w * (depth[i] - depth[nearest])
                    px += w * (position[i, 0] - position[nearest, 0])
                    py += w * (position[i, 1] - position[nearest, 1])
                    pz += w * (position[i, 2] - position[nearest, 2])
            pixels.coverage[y, x] = min(total, np.float32(1.0))
            pixels.depth[y, x] = depth[nearest] + mean_depth / surface
            pixels.position[y, x, 0] = position[nearest, 0] + px / surface
            pixels.position[y, x, 1] = position[nearest, 1] + py / surface
            pixels.position[y, x, 2] = position[nearest, 2] + pz / surface
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            if length > np.float32(1e-6) * total:
                nx, ny, nz = nx / length, ny / length, nz / length
            else:
                nx, ny, nz = surfaces.normal[nearest, 0], surfaces.normal[nearest, 1], surfaces.normal[nearest, 2]
            pixels.normal[y, x, 0], pixels.normal[y, x, 1], pixels.normal[y, x, 2] = nx, ny, nz
            inverse = np.float32(1.0) / total
            pixels.albedo[y, x, 0], pixels.albedo[y, x, 1] = r * inverse, g * inverse
            pixels.albedo[y, x, 2] = b * inverse
            pixels.roughness[y, x], pixels.metallic[y, x] = rough * inverse, metal * inverse
            pixels.object_row[y, x] = np.float32(surfaces.object_index[nearest])
            first = last


@njit
def _around(first, last, p, x0, y0, opaque):  # type: ignore[no-untyped-def]
    """Add the share of each pixel's samples that a fisheye lens does not see: it is black, as in Cycles."""
    width, subpixels = np.int64(p[WIDTH]), np.int64(p[SUBPIXELS])
    for y in range(first, last):
        for x in range(opaque.shape[1]):
            for k in range(subpixels):
                _, _, _, dx, dy, dz = sample_ray(p, (y0 + y) * width + x0 + x, k)
                if dx * dx + dy * dy + dz * dz == 0.0:
                    opaque[y, x] += np.float32(1.0 / subpixels)
