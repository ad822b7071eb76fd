"""Settings stored in the .blend: one property group per scene, view layer and object."""

from __future__ import annotations

import typing
from collections.abc import Callable

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, PointerProperty, StringProperty

from ..drgs_blender.core.frame import RenderSettings
from . import blend_paths, mesh_display
from .adjustment_settings import DrgsAdjustmentSettings
from .level_of_detail import LevelOfDetail
from .physics_settings import DrgsPhysicsSettings
from .property_limits import Limited, tag_changed
from .submit import DrgsSubmitSettings
from .view_layer_settings import DrgsViewLayerSettings

_DENOISERS = {
    "none": ("None", "Keep the noise"),
    "svgf": ("SVGF", "Variance-guided filter that keeps edges and material detail"),
    "oidn": ("OpenImageDenoise", "Intel's learned filter; smoothest with few samples"),
    "oidn-balanced": ("OpenImageDenoise, Balanced", "The same with a smaller network, in less than half the time"),
}
#: The denoisers that the engine knows, for the menu.
DENOISE_ITEMS = [(n, *_DENOISERS[n]) for n in typing.get_args(typing.get_type_hints(RenderSettings)["denoise"])]


def _sizes(*sizes: int) -> list[tuple[str, str, str]]:
    return [(str(size), f"{size} px", f"{size} pixels along the longer side") for size in sizes]


def _switch_overlay(settings: DrgsSceneSettings, context: bpy.types.Context) -> None:
    mesh_display.update_display(settings.id_data)


class DrgsSceneSettings(LevelOfDetail, bpy.types.PropertyGroup):
    """How DR-GS solves a frame; see drgs_blender.core.frame.RenderSettings."""

    samples: IntProperty(
        name="Samples",
        description="Light samples per pixel. Each surface divides them by its material: to lights, along reflections",
        min=1,
        soft_max=1024,
        max=65536,
        default=64,
    )
    use_strategy_samples: BoolProperty(
        name="Samples per Strategy", description="Choose the number of samples of each strategy", default=False
    )
    cosine_samples: IntProperty(
        name="Diffuse (Cosine)",
        description="Samples per pixel for matte reflection",
        min=1,
        soft_max=512,
        max=65536,
        default=16,
    )
    ggx_samples: IntProperty(
        name="Glossy (GGX)",
        description="Samples per pixel for highlights and mirrors",
        min=1,
        soft_max=256,
        max=65536,
        default=8,
    )
    environment_samples: IntProperty(
        name="Lights",
        description="Samples per pixel towards the World and lights; bright ones get more",
        min=1,
        soft_max=256,
        max=65536,
        default=8,
    )
    bounces: IntProperty(
        name="Bounces",
        description="Indirect bounces; 0 is direct light only. Cycles' default is 4, of Diffuse and of Glossy: for the "
        "same picture, give both the same number",
        min=0,
        soft_max=8,
        max=64,
        default=1,
    )
    device: EnumProperty(
        name="Device",
        description="Device that renders, simulates and reconstructs. Without a supported card the CPU is used, with a "
        "warning",
        items=[
            ("CPU", "CPU", "Use the CPU"),
            ("CUDA", "GPU (CUDA)", "An NVIDIA card; Set Up Engine fetches what it needs"),
        ],
        default="CPU",
    )
    use_noise_threshold: BoolProperty(
        name="Noise Threshold",
        description="Stop sampling a pixel once its noise is below the threshold; Samples are then the most it gets",
        default=False,
    )
    noise_threshold: FloatProperty(
        name="Noise Threshold",
        description="Estimated noise below which a pixel is done, as Cycles defines it. Lower is cleaner and slower",
        min=0.0001,
        soft_max=0.1,
        max=1.0,
        default=0.01,
        precision=4,
    )
    clamp_indirect: FloatProperty(
        name="Clamp Indirect",
        description="Limit the brightness of a single sample of indirect light. Takes away bright specks, and some "
        "light with them; 0 is off. Cycles' own, which is 10 by default, is not applied",
        min=0.0,
        soft_max=100.0,
        default=0.0,
        precision=1,
    )
    filter_glossy: FloatProperty(
        name="Filter Glossy",
        description="Make surfaces rougher that light meets behind rough ones: caustics, as of a metal on a wall, are "
        "blurred and less noisy, and lose some light. 0 is off. Cycles' own, which is 1 by default, is not applied",
        min=0.0,
        max=10.0,
        default=0.0,
        precision=2,
    )
    subpixel_samples: IntProperty(
        name="Sub-Pixel Samples",
        description="Positions per pixel among which samples are divided: edges and textures get smoother. 0 chooses: "
        "where surfels are visible to the camera a quarter of the samples, from 4 to 8, and of more than 64 an eighth, "
        "up to 16; of meshes alone half, up to 8, and of more than 32 a quarter, up to 64",
        min=0,
        soft_max=64,
        max=1024,
        default=0,
    )
    filter_width: FloatProperty(
        name="Filter Width",
        description="Of the pixel filter, Blackman-Harris as in Cycles. Wider is smoother; 0 is a box of one pixel",
        subtype="PIXEL",
        min=0.0,
        soft_max=3.0,
        max=10.0,
        default=1.5,
        step=10,
        precision=2,
    )
    camera_sees: EnumProperty(
        name="Camera Sees",
        description="Representation of DR-GS objects in the picture",
        items=(
            ("surfels", "Surfels", "The captured Gaussians, with their soft edges and fine detail"),
            ("mesh", "Mesh", "The triangle mesh that carries them"),
        ),
        default="surfels",
    )
    rays_see: EnumProperty(
        name="Rays See",
        description="Representation of DR-GS objects for shadows, reflections and indirect light",
        items=(
            ("mesh", "Mesh", "The mesh that carries the surfels; sheets of those that have none, or are thin; fast"),
            (
                "surfels",
                "Surfels",
                "The captured Gaussians themselves, for foliage, hair and fur; slower",
            ),
        ),
        default="mesh",
    )
    denoise: EnumProperty(
        name="Denoise",
        description="Filter that takes the noise out of the picture",
        items=DENOISE_ITEMS,
        default="svgf",
    )
    use_denoising_data: BoolProperty(
        name="Store Denoising Data",
        description="Keep the noise and have `drgs render` write every pass that `drgs denoise` needs to take it "
        "out of finished frames, each with the help of its neighbours. That command reads no files that Blender writes",
        default=False,
    )
    blur_steps: IntProperty(
        name="Blur Steps",
        description="Pictures at other times and other places of the lens whose mean has motion blur and depth of "
        "field; the samples are divided among them",
        min=2,
        soft_max=64,
        max=1024,
        default=16,
    )
    use_viewport_motion_blur: BoolProperty(
        name="Motion Blur in Viewports",
        description="Blur what keyframes move in rendered viewports, too, once nothing changes any more. Movement by "
        "constraints, drivers, armatures or simulations is blurred in final frames alone",
        default=True,
    )
    use_viewport_denoise: BoolProperty(
        name="Denoise Preview",
        description="Take the noise out of the coarse pictures that the viewport shows while something moves, with the "
        "help of those before",
        default=True,
    )
    overlay: EnumProperty(
        name="Viewport Display",
        description="How DR-GS objects are drawn in viewports that another engine or no engine renders",
        items=(
            ("OFF", "Mesh", "As the mesh that carries the splats"),
            ("SURFELS", "Splats", "As discs with their colour, without light and without the engine"),
            ("LIT", "Lit", "As DR-GS renders them, in front of and behind the scene's other objects"),
        ),
        default="OFF",
        options=set(),
        update=_switch_overlay,
    )
    background_scene: PointerProperty(
        type=bpy.types.Scene,
        name="Background Scene",
        description="The scene of another engine over whose picture this one is laid, and whose resolution and render "
        "region it has",
    )
    shading_model: EnumProperty(
        name="Shading Model",
        description="How surfaces reflect light",
        items=(
            ("principled", "Principled", "As Blender's Principled BSDF with GGX"),
            ("paper", "Cook-Torrance (Paper)", "The paper's BRDF, with which materials may have been reconstructed"),
        ),
        default="principled",
    )
    bake_world_size: EnumProperty(
        name="World Size",
        description="Width of the map that Cycles makes, in the background, of a World that is no colour or image",
        items=_sizes(512, 1024, 2048, 4096, 8192),
        default="2048",
    )
    bake_texture_size: EnumProperty(
        name="Texture Size",
        description="Side of the textures that Cycles makes, in the background, of what is no plain value or image in "
        "materials",
        items=_sizes(512, 1024, 2048, 4096, 8192),
        default="2048",
    )
    seed: IntProperty(
        name="Seed",
        description="Start value of the random numbers: the same seed gives the same noise. Compare two to see "
        "what is noise and what is detail",
        default=0,
        min=0,
    )
    use_animated_seed: BoolProperty(
        name="Animated Seed",
        description="Another noise pattern in every frame, so that noise does not stick to the picture",
        default=True,
        options=set(),
    )
    submit: PointerProperty(type=DrgsSubmitSettings, name="Farm", description="How frames are rendered on a farm")

    def to_settings(
        self, film_transparent: bool, threads: int, warn: Callable[[str], None] = lambda text: None
    ) -> RenderSettings:
        """The engine's settings; `warn` is called with a message for those out of range."""
        own = Limited(self, f'Scene "{self.id_data.name}"', warn)
        strategies = own.cosine_samples, own.ggx_samples, own.environment_samples
        return RenderSettings(
            samples=own.samples,
            strategy_samples=strategies if own.use_strategy_samples else None,
            bounces=own.bounces,
            subpixel_samples=own.subpixel_samples,
            camera_sees=own.camera_sees,
            rays_see=own.rays_see,
            denoise="none" if own.use_denoising_data else own.denoise,
            shading_model=own.shading_model,
            film_transparent=film_transparent,
            seed=own.seed,
            threads=threads,
            noise_threshold=own.noise_threshold if own.use_noise_threshold else 0.0,
            clamp_indirect=own.clamp_indirect,
            filter_glossy=own.filter_glossy,
            device=own.device.lower(),
            filter_width=own.filter_width,
        )


def _get_path(group: DrgsObjectSettings) -> str:
    return group.asset.filepath if group.asset else ""


def _set_path(group: DrgsObjectSettings, path: str) -> None:
    if group.asset:
        group.asset.filepath = path


class DrgsObjectSettings(bpy.types.PropertyGroup):
    """What makes a mesh object a DR-GS object.

    The file is held by a Volume datablock, because Blender's own path tools (make relative, report and find missing
    files, pack, link, append) know its path. It is never displayed.
    """

    asset: PointerProperty(type=bpy.types.Volume, name="Asset", description="The .drgs file of this object")
    path: StringProperty(
        name="Asset Path",
        description="The .drgs file; shared by all objects made from it",
        subtype="FILE_PATH",
        get=_get_path,
        set=_set_path,
        options=blend_paths.RELATIVE,
    )

    surfel_points: PointerProperty(
        type=bpy.types.Mesh,
        name="Surfels",
        description="Points of the surfels that are left; empty: all that the asset has",
    )
    points_of: PointerProperty(
        type=bpy.types.Object, name="Points Of", description="The DR-GS object whose surfels these points are"
    )
    adjustment: PointerProperty(
        type=DrgsAdjustmentSettings,
        name="Adjustments",
        description="Changes on top of the material attributes of the object",
    )
    show_captured: BoolProperty(
        name="Show as Captured",
        description="Before and after: render the object with the material of its asset, without what is painted, "
        "preset or adjusted. Nothing of that is lost",
        default=False,
        update=tag_changed,
    )
    captured_colours: BoolProperty(
        name="Captured Colours",
        description="Show the object without light, in the colours that its capture has from each side, as viewers of "
        "splats do. Materials and adjustments do not show meanwhile. With the view transform Standard the picture is "
        "that of those viewers",
        default=False,
        update=tag_changed,
    )
    physics: PointerProperty(
        type=DrgsPhysicsSettings, name="Physics", description="The simulation of the object and its material"
    )
    shown_as: StringProperty(
        name="Display As", description="How the mesh is displayed when it is not drawn as a box", options={"HIDDEN"}
    )

    @property
    def is_drgs(self) -> bool:
        """Whether the object is rendered by DR-GS."""
        return self.asset is not None


GROUPS = (
    (DrgsSceneSettings, bpy.types.Scene),
    (DrgsViewLayerSettings, bpy.types.ViewLayer),
    (DrgsObjectSettings, bpy.types.Object),
)


def register() -> None:
    bpy.utils.register_class(DrgsAdjustmentSettings)
    for group, owner in GROUPS:
        bpy.utils.register_class(group)
        owner.drgs = PointerProperty(type=group, name="DR-GS")


def unregister() -> None:
    for group, owner in reversed(GROUPS):
        del owner.drgs
        bpy.utils.unregister_class(group)
    bpy.utils.unregister_class(DrgsAdjustmentSettings)
