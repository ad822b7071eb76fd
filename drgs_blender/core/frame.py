"""The description of one frame: all that changes from frame to frame, in one message.

World space, Z up, metres. Pixel coordinates: x to the right, y **down**, (0, 0) is the top-left corner of the
full picture, pixel centres at +0.5. Picture arrays have row 0 at the top.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from .asset.part import Part
from .materials import Image, Material, ShaderAOV

Array = np.ndarray


@dataclass(slots=True)
class Camera:
    """A perspective, orthographic or panoramic camera.

    The ray through pixel position (px, py) has, in the camera's own frame (Blender's: looking down -Z, Y up), the
    direction ``((px - cx) / fx, -(py - cy) / fy, -1)`` from the camera centre; when orthographic it starts at
    ``((px - cx) / fx, -(py - cy) / fy, 0)`` and runs along -Z, so fx is in pixels per metre.

    Of a panoramic camera, ``x = (px - cx) / fx`` and ``y = -(py - cy) / fy`` are places on a curved picture, from which
    all rays start at the centre, and depth is the distance from there:

    - "equirectangular": longitude to the right and latitude upwards in radians;
    - "fisheye": the direction lies at ``lens[0] + lens[1] r + lens[2] r^2 + ...`` radians from -Z, with r the length
      of (x, y), on the side of (x, y); with the default lens equidistant, fx in pixels per radian;
    - "equisolid": at 2 asin(r / 2), fx in pixels per focal length.

    Attributes
    ----------
    matrix_world : (4, 4) float64 array
        Camera-to-world, rigid, Blender's convention; of an orthographic camera -Z may lean, its part along the axis
        still of length 1.
    width, height : int
        Full picture in pixels (after resolution %).
    fx, fy, cx, cy : float
        Pixels; fx != fy expresses pixel aspect.
    region : tuple of int, optional
        (x0, y0, x1, y1) in pixels, half-open: what is rendered (border); None is everything. Results are always of the
        region's size.
    panorama : {"", "equirectangular", "fisheye", "equisolid"}
        "" where the picture is flat.
    fov : float
        Radians, the full angle that a fisheye lens sees: the picture ends where the axis is half of it away.
    lens : tuple of float
        Of "fisheye", see above.
    """

    matrix_world: Array
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    orthographic: bool = False
    clip_start: float = 1e-3
    clip_end: float = 1e6
    region: tuple[int, int, int, int] | None = None
    panorama: Literal["", "equirectangular", "fisheye", "equisolid"] = ""
    fov: float = 6.283185307179586
    lens: tuple[float, float, float, float, float] = (0.0, 1.0, 0.0, 0.0, 0.0)

    @property
    def window(self) -> tuple[int, int, int, int]:
        """(x0, y0, x1, y1): the pixels to render."""
        return self.region or (0, 0, self.width, self.height)


@dataclass(slots=True)
class Visibility:
    """Camera visibility, ray visibility: which rays meet an object, as in Blender's Object > Visibility panel.

    ``diffuse`` and ``glossy`` are indirect rays from a diffuse or glossy scattering, ``shadow`` rays towards lights. A
    ``holdout`` cuts a hole into the picture; of a ``shadow_catcher`` only the shadows on it are seen.

    Light linking: bit i of ``lit_by`` says that a light whose ``receivers`` are i shines on the object, bit i of
    ``blocks`` that the object throws the shadow of a light whose ``blockers`` are i. A light whose numbers are -1
    shines on everything, and everything throws its shadow.
    """

    camera: bool = True
    diffuse: bool = True
    glossy: bool = True
    shadow: bool = True
    holdout: bool = False
    shadow_catcher: bool = False
    lit_by: int = 0
    blocks: int = 0


@dataclass(slots=True)
class Adjustment:
    """Changes to the look of an object, on top of its materials; of its surfels and its mesh alike.

    Attributes
    ----------
    tint : tuple of float
        Linear Rec.709 factors on the albedo, after all other changes of colour.
    hue : float
        Turns, added to the hue of the albedo (HSV, as Blender's node).
    saturation, value : float
        Factors on those of the albedo.
    roughness, metallic : tuple of float
        Gain, offset, lowest, highest: new = clip(gain * old + offset, lowest, highest).
    mask : (n,) float32 array, optional
        How much of it a vertex gets, in [0, 1]; None: all of it everywhere.
    emission, opacity : float
        Factors on those of the object; of the opacity at most 1.
    brightness, contrast : float
        Of the linear albedo after hue, saturation and value, as Blender's node: new = max(0, (1 + contrast) old +
        brightness - contrast / 2).
    """

    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    hue: float = 0.0
    saturation: float = 1.0
    value: float = 1.0
    roughness: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 1.0)
    metallic: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 1.0)
    mask: Array | None = None
    emission: float = 1.0
    opacity: float = 1.0
    brightness: float = 0.0
    contrast: float = 0.0


@dataclass(slots=True)
class Particles:
    """Particles that carry an object's surfels, **object space**: those of a simulation, or any points that deform.

    Attributes
    ----------
    rest : (s, 3) float32 array
        Metres, where they were when the surfels were as in the asset.
    points : (s, 3) float32 array
        Metres, now.
    gradients : (s, 3, 3) float32 array
        Deformation gradient of each since rest.
    all : bool
        Whether they carry all surfels; else only those that do not lie on the mesh, which moves with the particles, or
        that it smears.
    cells : (4, 4) float64 array, optional
        Brings places at rest to the lattice that the particles fill, of cells with sides of 1: by it is known which are
        neighbours, and so what has broken.
    surfels : bool
        Whether they carry surfels; else they say only what has broken.
    began : (n, 3) float32 array, optional
        Metres, vertices of the object's mesh when the particles were at rest; None: as in the asset.
    skin : bool
        Whether camera and rays meet a surface around them in place of mesh and surfels, as of fluids; needs ``cells``.
    broken : (bytes,) uint8 array, optional
        Which bonds between neighbours have broken until now, see `deform.bonds.Bonds.packed`; None: those that now are
        apart.
    """

    rest: Array
    points: Array
    gradients: Array
    all: bool = False
    cells: Array | None = None
    surfels: bool = True
    skin: bool = False
    began: Array | None = None
    broken: Array | None = None


@dataclass(slots=True)
class Inside:
    """Material of what was inside of matter, seen where it has broken.

    Attributes
    ----------
    base_colour : tuple of float, optional
        Linear Rec.709; None: the mean albedo of the object.
    roughness, metallic : float, optional
        In [0, 1]; None: the means of the object, of the roughness at least 0.5.
    """

    base_colour: tuple[float, float, float] | None = None
    roughness: float | None = None
    metallic: float | None = None


@dataclass(slots=True)
class ProxyMesh:
    """A mesh, or points, that carry the surfels of an asset without a mesh, **object space**.

    Attributes
    ----------
    rest : (v, 3) float32 array
        Metres, its vertices where they were when the surfels were as in the asset.
    vertices : (v, 3) float32 array
        Metres, now.
    faces : (m, 3) int32 array
        May be none; then points that lie in a plane do not say how space turns beside it.
    """

    rest: Array
    vertices: Array
    faces: Array


@dataclass(slots=True)
class ObjectState:
    """One DR-GS object in one frame.

    Attributes
    ----------
    name : str
        Object name, used in messages.
    asset : str
        Key of a loaded asset (see Session.load_asset).
    matrix_world : (4, 4) float64 array
        Object-to-world; may scale, shear or mirror.
    vertices : (n, 3) float32 array, optional
        **Object space**, the evaluated mesh; None is the asset's rest mesh.
    corner_normals : (m, 3, 3) float32 array, optional
        Unit, object space, one per face corner, or None for smooth angle-weighted vertex normals computed by the
        engine.
    albedo : (n, 3) array, optional
        Per-vertex overrides; None keeps the asset's.
    roughness, metallic : (n,) array, optional
        Per-vertex overrides; None keeps the asset's.
    opacity, specular, coat : (n,) array, optional
        Per-vertex overrides; None keeps the asset's.
    emission : (n, 3) array, optional
        Per-vertex overrides, linear Rec.709 radiance; None keeps the asset's.
    pass_index, material_pass_index : int
        Blender's object index pass, and that of its material.
    visibility : Visibility
        Which rays meet it.
    adjustment : Adjustment, optional
        Changes to the materials, after the overrides.
    tear : float
        Metres, object space: faces with an edge that is longer than in the asset by more than this, and more than three
        times as long, span a tear and are left out with their surfels; 0: none.
    grain : float
        How much surfels that are stretched are grains instead, see `deform.granular`; 0: not at all.
    captured_colours : bool
        Whether the camera sees it unlit, in the view-dependent colours of its capture, instead of its materials. Only
        surfels have them, see ``Surfels.sh``.
    aovs : list of ShaderAOV
        Without textures.
    light_group : str
        To which belongs what it emits; "": none.
    terminator_offset : float
        Blender's Shadow Terminator Geometry Offset, in [0, 1]; 0: off.
    part : Part, optional
        What an edited mesh has left of the asset; all arrays are then of its vertices and faces. None: all of it.
    particles : Particles, optional
        What carries the surfels; None: their faces do. Rays meet the mesh as ``vertices`` have it.
    proxy : ProxyMesh, optional
        What carries the surfels of an asset without a mesh, in place of particles.
    inside : Inside, optional
        Where the particles know of their lattice: pieces that have come apart are closed, by faces of this material
        inside; None: they are open shells.
    images : list of Image
        Bytes in place of images of the asset's textures, which have their names; colours where they are "srgb".
    """

    name: str
    asset: str
    matrix_world: Array = field(default_factory=lambda: np.eye(4))
    vertices: Array | None = None
    corner_normals: Array | None = None
    albedo: Array | None = None
    roughness: Array | None = None
    metallic: Array | None = None
    pass_index: int = 0
    material_pass_index: int = 0
    visibility: Visibility = field(default_factory=Visibility)
    adjustment: Adjustment | None = None
    tear: float = 0.0
    grain: float = 0.0
    captured_colours: bool = False
    aovs: list[ShaderAOV] = field(default_factory=list)
    light_group: str = ""
    terminator_offset: float = 0.0
    opacity: Array | None = None
    emission: Array | None = None
    specular: Array | None = None
    coat: Array | None = None
    part: Part | None = None
    particles: Particles | None = None
    proxy: ProxyMesh | None = None
    inside: Inside | None = None
    images: list[Image] = field(default_factory=list)


@dataclass(slots=True)
class Layer:
    """Values at the corners of a mesh's faces, to which textures refer.

    Attributes
    ----------
    name : str
        Unlike those of the mesh's other layers.
    values : (m, 3, 2) or (m, 3, 4) float32 array
        One per face corner: texture coordinates (u, v), or colour (linear Rec.709) and alpha, or any numbers.
    """

    name: str
    values: Array


@dataclass(slots=True)
class MeshState:
    """An ordinary mesh next to the DR-GS objects, in one frame: one shape with one or more instances.

    Attributes
    ----------
    name : str
        Object name, used in messages.
    vertices : (n, 3) float32 array
        Object space.
    faces : (m, 3) int32 array
    matrices : (k, 4, 4) float64 array
        Object-to-world, one per instance.
    pass_indices : (k,) int32 array
        Blender's object index pass of each instance.
    corner_normals : (m, 3, 3) float32 array, optional
        Unit, object space, or None: each vertex has one normal.
    uvs : (m, 3, 2) float32 array, optional
        One per face corner, or None without textures.
    layers : list of Layer
        Further texture coordinates, and values such as colour attributes.
    material_index : (m,) int32 array, optional
        Into ``materials``, or None: the first everywhere.
    materials : list of Material
        Never empty.
    visibility : Visibility
        Of all its instances.
    uv_map : (m, 3, 2) float32 array, optional
        What the pass UV shows, one per face corner; None: 0.
    receivers, blockers : int
        Light linking of what it emits, see `Visibility`.
    light_group : str
        To which belongs what it emits; "": none.
    terminator_offset : float
        Blender's Shadow Terminator Geometry Offset, in [0, 1]; 0: off.
    vertex_normals : (n, 3) float32 array, optional
        Unit, object space, without `corner_normals`; None: made of the faces, weighted by angle.
    """

    name: str
    vertices: Array
    faces: Array
    matrices: Array
    pass_indices: Array
    corner_normals: Array | None = None
    uvs: Array | None = None
    material_index: Array | None = None
    materials: list[Material] = field(default_factory=lambda: [Material("Default")])
    visibility: Visibility = field(default_factory=Visibility)
    layers: list[Layer] = field(default_factory=list)
    uv_map: Array | None = None
    receivers: int = -1
    blockers: int = -1
    light_group: str = ""
    terminator_offset: float = 0.0
    vertex_normals: Array | None = None


LightKind = Literal["point", "sun", "spot", "area"]


@dataclass(slots=True)
class Light:
    """One of Blender's lights. The quantities are those of Blender's panel; the engine turns them into radiance.

    Attributes
    ----------
    kind : {"point", "sun", "spot", "area"}
    matrix_world : (4, 4) float64 array
        The light shines along its -Z.
    colour : tuple of float
        Linear Rec.709.
    power : float
        Watts of radiant flux; of a sun watts per square metre at a surface that faces it. Exposure and temperature are
        already in power and colour.
    radius : float
        Metres, of point and spot lights.
    soft_falloff : bool
        Point and spot lights are disks that face the shading point (Blender's default), else spheres.
    angle : float
        Radians, apparent diameter of a sun.
    spot_size : float
        Radians, full cone angle.
    spot_blend : float
        In [0, 1].
    shape : {"square", "rectangle", "disk", "ellipse"}
        Of area lights.
    size_x, size_y : float
        Of area lights, metres before ``matrix_world`` scales them.
    spread : float
        Radians, of area lights; pi shines everywhere.
    normalize : bool
        Power is independent of the light's size (Blender 5's switch, on by default).
    camera, diffuse, glossy : bool
        Whether such rays see the light.
    cast_shadow : bool
        Whether objects between light and surface block it.
    receivers, blockers : int
        Light linking: on what it shines, and what throws its shadow, see `Visibility`.
    light_group : str
        To which it belongs; "": none.
    """

    name: str
    kind: LightKind
    matrix_world: Array
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)
    power: float = 10.0
    radius: float = 0.0
    soft_falloff: bool = True
    angle: float = 0.0
    spot_size: float = 0.785398
    spot_blend: float = 0.15
    shape: Literal["square", "rectangle", "disk", "ellipse"] = "square"
    size_x: float = 1.0
    size_y: float = 1.0
    spread: float = 3.1415927
    normalize: bool = True
    camera: bool = False
    diffuse: bool = True
    glossy: bool = True
    cast_shadow: bool = True
    receivers: int = -1
    blockers: int = -1
    light_group: str = ""


@dataclass(slots=True)
class World:
    """Distant light. Radiance from world direction d is ``image(rotation @ d) * colour * strength``.

    ``environment`` is (h, w, 3) float32 lat-long in Blender's mapping (see asset.Environment) or None for a constant
    colour. ``rotation`` is what a Mapping node does to the vector: Rotation Z of t degrees is rotation about +Z by
    +t. ``colour`` is linear Rec.709. ``light_group`` is the light group to which it belongs, "" none.
    """

    environment: Array | None = None
    rotation: Array = field(default_factory=lambda: np.eye(3))
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)
    strength: float = 1.0
    light_group: str = ""


@dataclass(slots=True)
class Mist:
    """Limits of the pass Mist.

    It is 0 nearer than ``start`` metres, 1 beyond ``start + depth``, in between the part of the way to the power of
    ``falloff``. The distance is from the camera, of an orthographic one from its plane.
    """

    start: float = 0.0
    depth: float = 100.0
    falloff: float = 1.0


@dataclass(slots=True)
class RenderSettings:
    """Settings of the renderer for a frame.

    Attributes
    ----------
    samples : int
        Per pixel, over all strategies; each point divides them by its material.
    strategy_samples : tuple of int, optional
        Samples per pixel drawn by the cosine, by GGX and by the environment and lights, instead of ``samples``. The
        paper has (16, 8, 8).
    bounces : int
        Indirect bounces.
    subpixel_samples : int
        Sub-pixel samples: anti-aliasing positions per pixel, which share its samples; 0 chooses by their number
        (`subpixel_count`), in a session as of "mesh" where the camera sees no surfels anyway. Where they are more than
        the samples, some have none: the mean is right, but noisier.
    camera_sees, rays_see : {"surfels", "mesh"}
        Representation of DR-GS objects for camera rays, and for shadow and indirect rays: their meshes, or the
        surfels, blended along each ray (slower; for thin things without a good mesh). With "surfels" and "mesh" light
        meets sheets of the surfels of objects that were reconstructed as thin (`engine.surfel_sheets`).
    denoise : {"none", "svgf", "oidn", "oidn-balanced"}
        The last is OIDN with a smaller network, in less than half the time.
    shading_model : {"principled", "paper"}
        Blender's Principled BSDF, or the paper's BRDF.
    film_transparent : bool
    seed : int
    threads : int
        0 is all cores.
    noise_threshold : float
        Above 0, sampling of a pixel stops once its estimated error (as Cycles defines it) is below; the samples above
        are then the most that a pixel gets.
    clamp_indirect : float
        Above 0, the limit of a single indirect sample, which loses energy.
    filter_glossy : float
        Above 0, surfaces that light meets behind a bounce of less density by the BSDF (sr^-1) are rougher, as by
        Cycles' setting: less noise of caustics, which are blurred.
    device : {"cpu", "cuda"}
        "cuda" has a graphics card do what it can, see docs/gpu.md; without one it is as "cpu", with a warning.
    filter_width : float
        Of the pixel filter in pixels as Cycles counts it, half the width of Blackman and Harris's window; 0 is
        a box of one pixel.
    """

    samples: int = 32
    strategy_samples: tuple[int, int, int] | None = None
    bounces: int = 1
    subpixel_samples: int = 0
    camera_sees: Literal["surfels", "mesh"] = "surfels"
    rays_see: Literal["mesh", "surfels"] = "mesh"
    denoise: Literal["none", "svgf", "oidn", "oidn-balanced"] = "none"
    shading_model: Literal["principled", "paper"] = "principled"
    film_transparent: bool = False
    seed: int = 0
    threads: int = 0
    noise_threshold: float = 0.0
    clamp_indirect: float = 0.0
    filter_glossy: float = 0.0
    device: Literal["cpu", "cuda"] = "cpu"
    filter_width: float = 0.0

    @property
    def sample_count(self) -> int:
        """Samples per pixel: ``samples``, or the sum of ``strategy_samples``."""
        return self.samples if self.strategy_samples is None else sum(self.strategy_samples)

    @property
    def subpixel_count(self) -> int:
        """``subpixel_samples``, or as many per pixel as let edges and textures keep up with the noise."""
        if self.subpixel_samples:
            return self.subpixel_samples
        # Another one costs surfels more than a mesh, and they come filtered.
        count = self.sample_count
        few, many = (count // 4, min(count // 8, 16)) if self.camera_sees == "surfels" else (count // 2, count // 4)
        return min(max(min(few, 8), many, 4), 64, max(count, 1))


@dataclass(slots=True)
class Pose:
    """Transform and vertices of one shape at another time.

    Attributes
    ----------
    name : str
        Of the object, used in messages.
    matrices : (k, 4, 4) float64 array
        Object-to-world, one per instance; an `ObjectState` has one.
    vertices : (n, 3) float32 array, optional
        Object space; None: as in the frame itself.
    particles : Particles, optional
        What carries the surfels of an object without a mesh then; None: as in the frame itself.
    proxy : ProxyMesh, optional
        The same.
    """

    name: str
    matrices: Array
    vertices: Array | None = None
    particles: Particles | None = None
    proxy: ProxyMesh | None = None


@dataclass(slots=True)
class MotionStep:
    """Camera and shapes at another time, for motion.

    ``objects`` and ``meshes`` are in the order of the frame's own; what is None has not moved.
    """

    camera: Camera
    objects: list[Pose | None]
    meshes: list[Pose | None] = field(default_factory=list)


@dataclass(slots=True)
class Frame:
    """Everything the engine needs, next to loaded assets, to render one picture.

    Attributes
    ----------
    noise_index : int
        Part of the seed of all random numbers. It is the scene's frame number only while *Animated Seed* is on.
    previous, next : MotionStep, optional
        One frame earlier and later, for the passes of motion; None: nothing moves.
    history : str
        Name of the sequence of pictures that this one continues. With the denoiser SVGF, what the engine rendered
        before under this name is mixed in; "" stands alone, as every final frame must.
    background : World, optional
        What the camera sees where it meets nothing, instead of ``world``, which still lights; None: the same.
    mist : Mist
        Limits of the pass Mist.
    """

    noise_index: int
    camera: Camera
    objects: list[ObjectState]
    world: World = field(default_factory=World)
    settings: RenderSettings = field(default_factory=RenderSettings)
    passes: tuple[str, ...] = ("Combined",)
    meshes: list[MeshState] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)
    images: list[Image] = field(default_factory=list)
    previous: MotionStep | None = None
    next: MotionStep | None = None
    history: str = ""
    background: World | None = None
    mist: Mist = field(default_factory=Mist)
