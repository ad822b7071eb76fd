"""Settings stored in the .blend: one property group per scene, view layer and object."""

from __future__ import annotations

import typing

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, PointerProperty, StringProperty

from ..drgs_blender.frame import RenderSettings, split_rays
from ..drgs_blender.passes import PASSES, Pass

_DENOISERS = {
    "none": ("None", "Keep the noise"),
    "svgf": ("SVGF", "Variance-guided filter that keeps edges and material detail"),
    "oidn": ("OpenImageDenoise", "Intel's learned filter; smoothest with few rays"),
}
#: The denoisers that the engine knows, for the menu.
DENOISE_ITEMS = [(n, *_DENOISERS[n]) for n in typing.get_args(typing.get_type_hints(RenderSettings)["denoise"])]


class DrgsSceneSettings(bpy.types.PropertyGroup):
    """How DR-GS solves a frame; see drgs_blender.frame.RenderSettings."""

    rays: IntProperty(
        name="Rays",
        description="Light samples a pixel, divided among the three strategies",
        min=3,
        soft_max=1024,
        default=32,
    )
    use_custom_split: BoolProperty(
        name="Custom Split", description="Choose the number of rays of each sampling strategy", default=False
    )
    cosine: IntProperty(
        name="Cosine", description="Rays a pixel drawn by the cosine of the angle", min=1, soft_max=512, default=16
    )
    ggx: IntProperty(
        name="GGX", description="Rays a pixel drawn by the shape of the highlight", min=1, soft_max=256, default=8
    )
    environment: IntProperty(
        name="Environment", description="Rays a pixel drawn towards bright light", min=1, soft_max=256, default=8
    )
    bounces: IntProperty(
        name="Bounces", description="Times that light is passed on between surfaces", min=0, soft_max=8, default=1
    )
    use_noise_threshold: BoolProperty(
        name="Noise Threshold",
        description="Stop sampling a pixel once its noise is below the threshold; Rays are then the most it gets",
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
        description="Limit the brightness of a single sample of passed-on light. Takes away bright specks, and some "
        "light with them; 0 is off",
        min=0.0,
        soft_max=100.0,
        default=0.0,
        precision=1,
    )
    aa: IntProperty(
        name="Anti-aliasing",
        description="Positions inside a pixel among which its rays are divided",
        min=1,
        soft_max=16,
        default=4,
    )
    primary: EnumProperty(
        name="Primary",
        description="What the camera sees",
        items=(
            ("surfels", "Surfels", "The captured Gaussians, with their soft edges and fine detail"),
            ("mesh", "Mesh", "The triangle mesh that carries them"),
        ),
        default="surfels",
    )
    denoise: EnumProperty(
        name="Denoise",
        description="Filter that takes the noise out of the picture",
        items=DENOISE_ITEMS,
        default="none",
    )
    look: EnumProperty(
        name="Look",
        description="Reflection model",
        items=(
            ("principled", "Principled", "As Blender's Principled BSDF with GGX"),
            ("paper", "Paper", "Cook-Torrance as the material was reconstructed with"),
        ),
        default="principled",
    )
    seed: IntProperty(name="Seed", description="Another number gives other noise", default=0, min=0)
    use_animated_seed: BoolProperty(
        name="Animated Seed", description="Other noise in every frame", default=True, options=set()
    )

    def to_settings(self, film_transparent: bool, threads: int) -> RenderSettings:
        """The engine's settings."""
        split = (self.cosine, self.ggx, self.environment) if self.use_custom_split else split_rays(self.rays)
        cosine, ggx, environment = split
        return RenderSettings(
            cosine=cosine,
            ggx=ggx,
            environment=environment,
            bounces=self.bounces,
            aa=self.aa,
            primary=self.primary,
            denoise=self.denoise,
            look=self.look,
            film_transparent=film_transparent,
            seed=self.seed,
            threads=threads,
            noise_threshold=self.noise_threshold if self.use_noise_threshold else 0.0,
            clamp_indirect=self.clamp_indirect,
        )


def switch_of(render_pass: Pass) -> str:
    """Property of `DrgsViewLayerSettings` that switches on a pass Blender does not know."""
    return "use_pass_" + render_pass.name.lower().replace(" ", "_")


class DrgsViewLayerSettings(bpy.types.PropertyGroup):
    """Passes that Blender's own view layer has no switch for."""

    __annotations__ = {  # Blender reads properties from here; they follow the one table
        switch_of(p): BoolProperty(name=p.name, description=p.about, default=False) for p in PASSES if not p.blender
    }


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
    for group, owner in GROUPS:
        bpy.utils.register_class(group)
        owner.drgs = PointerProperty(type=group, name="DR-GS")


def unregister() -> None:
    for group, owner in reversed(GROUPS):
        del owner.drgs
        bpy.utils.unregister_class(group)
