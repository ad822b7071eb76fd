"""Records of the integrator's kernels, besides points and batches of rays: the scene, the settings and the sampler."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..lights.environment import EnvMap
from ..lights.light_sampler import LightTables
from ..scene.interaction import Geometry

Array = np.ndarray


class Traits(NamedTuple):
    """Compile-time traits of a scene. A device's kernel is made for its truth values, without what they rule out.

    Attributes
    ----------
    extent : np.float32
        Metres: the largest absolute coordinate, the scale of rounding errors.
    environment : bool
        The environment shines.
    lights : bool
        Whether there are lights, or surfaces sampled as lights: one of them is sampled at every vertex of a path.
    emissive : bool
        Whether surfaces emit, for which rays are traced beyond a path's last vertex too.
    lights_differ : bool
        Whether diffuse and glossy rays see different lights.
    lobes_apart : bool
        The same of objects: cosine samples are of the diffuse lobe alone, GGX samples of the specular one.
    detailed : bool
        Whether surfaces have normal or bump maps.
    clear : bool
        Whether light may pass surfaces.
    multiscatter : bool
        Whether surfaces have Multiscatter GGX.
    """

    extent: np.float32
    environment: bool
    lights: bool
    emissive: bool
    lights_differ: bool
    lobes_apart: bool
    detailed: bool
    clear: bool
    multiscatter: bool


class Scene(NamedTuple):
    """Surfaces and lights for the integrator's kernels; valid until the next update.

    Attributes
    ----------
    tracer : MixedTracer
        How rays are cast; a device has its own.
    geometry : Geometry
    envmap : EnvMap
    lights : LightTables
    traits : Traits
    """

    tracer: Any
    geometry: Geometry
    envmap: EnvMap
    lights: LightTables
    traits: Traits


class Settings(NamedTuple):
    """Settings of the path tracer.

    Attributes
    ----------
    bounces : int
        Vertices of a path behind the shading point.
    shading_model : int
        One of ``brdf.SHADING_MODELS``.
    layers : (16, 16) float32 array
        ``brdf.layer_table()``.
    energy : (32, 32) float32 array
        ``multiscatter.energy_tables()``.
    mean_energy : (32,) float32 array
        Their second.
    clamp : np.float32
        Limit of the mean of an indirect sample's channels; 0: none.
    filter_glossy : np.float32
        Density of a bounce below which the surfaces behind it are rougher, sr^-1, see `path_regularisation`; 0: none.
    shift : int
        Of the masks of rays: 0, or ``ray_masks.WITHOUT``.
    """

    bounces: int
    shading_model: int
    layers: Array
    energy: Array
    mean_energy: Array
    clamp: np.float32 = np.float32(0.0)
    filter_glossy: np.float32 = np.float32(0.0)
    shift: int = 0


class Sampler(NamedTuple):
    """Sample sequence of a pixel, and its division among strategies.

    Attributes
    ----------
    seed : np.uint32
        Of job and frame.
    sequence : (n, 3) uint32 array
        Points of Sobol' with reversed bits, enough for all samples of a pixel.
    subpixels : int
        Places in a pixel among which its samples are divided.
    part, parts : int
        Which of how many equal parts of these samples are taken.
    auto : bool
        Samples are divided by what each surface reflects; else as given.
    cosine, ggx, light : np.float32
        Samples of a pixel by strategy as given; under `auto` only their sum counts.
    environment_share, lights_share : np.float32
        Parts of the light samples that go to environment and lights; 0 where these do not shine.
    most_light : np.float32
        Part of all samples that go to the light at most, under `auto`.
    """

    seed: np.uint32
    sequence: Array
    subpixels: int
    part: int
    parts: int
    auto: bool
    cosine: np.float32
    ggx: np.float32
    light: np.float32
    environment_share: np.float32
    lights_share: np.float32
    most_light: np.float32
