"""Settings of inverse rendering: how light and materials of an object are separated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from ...core.errors import UsageError
from ..ranges import Part, Range, Weight, check


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of `decouple`.

    Attributes
    ----------
    iterations : int
        Steps of the optimiser.
    seconds : float
        Stop after so much time of the wall clock, the schedule squeezed to fit; 0 is no limit.
    pixels : int
        Drawn in each step, over all training views; in the `joint` part from the one view of the step.
    cosine, ggx, light : int
        Directions that this strategy draws at a pixel.
    shading_model : {"principled", "paper"}
        BRDF, "principled" (Blender's) or "paper".
    indirect : bool
        Light that other parts of the object send is what the photographs show of them; else it is black.
    shadows : bool
        Other parts of the object stand before the environment; without, every point sees all of it, as in the split-sum
        shading of other methods.
    environment : int
        Rows of the learned lat-long light at the end.
    coarse_to_fine : bool
        Begin with a quarter of the rows and double them on a schedule.
    rate : float
        First step size of materials (Adam), in logits.
    light_rate : float
        First step size of the light, in log radiance.
    coarse : int
        Also learn materials on this many nested grids of cells, which carry what many pixels agree on quickly. Where
        edges are shorter than 1/200 of the mesh, on one more for each halving.
    brightness : float
        Mean of the linear colours that photographs of linear floats (EXR, merged brackets) are brought to, as their
        scale says nothing and weights of losses belong to one. Others count as they were exposed, but for those darker
        than a fifth of it. Larger: photographs count for more.
    smoothness : float
        Weight of the differences of materials along edges, less where the photographs differ; where edges are shorter
        than 1/200 of the mesh, as many times more, at most 8.
    light_smoothness : float
        Weight of the differences of log radiance between neighbours in the environment.
    grey_light_prior : float
        Weight that pulls the environment towards grey.
    binary_metallic_prior : float
        Weight that pulls metallic to 0 or 1.
    metal_albedo_prior : float
        Weight that pulls the brightest channel of the albedo of metals towards .95, that of polished metals;
        less below .5, not at all below .25, where metal is patina or dirt.
    metal_smoothness : float
        How much more than other albedo that of metals is smoothed, in parts of `smoothness`: there, errors of normals
        leave blotches.
    same_material : float
        Weight of the differences of materials between vertices that photographs show alike, up to about a quarter of
        the object apart. Three times as much between surfels that carry the materials from the first step on, as each
        is seen by fewer pixels.
    unbiased : bool
        Compare two independent estimates of each pixel, so that their noise is not learned from.
    weight_by_prediction : bool
        Divide differences by the rendered brightness, from .3 of the steps on; else by the photographed one, by which
        polished metal and the light it mirrors come out too dark where the mesh is a little off. Only with `unbiased`.
    clipped_neighbour_weight : float
        Weight, in each channel, of pixels next to clipped ones, once `weight_by_prediction` counts. Where normals are a
        little off they mirror the highlight next to them and are photographed darker than it. Clipped pixels set no
        upper bound, so nothing balances them and the light would be found too dim.
    parametrisation : {"metallic", "specular", "dielectric"}
        "metallic" learns albedo and metallic; "specular" diffuse and specular colour, turned into the former at the
        end; "dielectric" albedo alone, metallic is 0.
    normals : bool
        Also learn an offset for the normal of each vertex, or of each surfel where these carry the materials, kept
        smooth by `normal_smoothness`. Not learned in the `joint` part.
    normal_smoothness : float
        Weight of the squared differences of these offsets along edges, as `smoothness` more on finer meshes.
    domain : {"auto", "mesh", "surfels"}
        What materials and normals are learned on: the vertices of the mesh, or the surfels; "auto": the surfels of thin
        things, the mesh of others. Toys of many small parts may gain by surfels, what is smooth or polished does not.
    joint : float
        Last part of the steps in which the surfels are learned, too, with materials of their own (the paper's way), on
        the CPU; 0: they stay as they are, and materials are learned on the mesh, of thin things on the surfels; 1: from
        the first step on. Normals and views left out gain on some objects, relit pictures and albedo do not.
    exposure : bool
        Also learn the brightness of every photograph.
    most_pixels : int
        Foreground pixels kept in memory, evenly over all views.
    seed : int
        Of all random numbers.
    """

    iterations: Annotated[int, Range(1, 10_000_000)] = 2500
    seconds: Weight = 0.0
    pixels: Annotated[int, Range(1, 1 << 24)] = 2048
    cosine: Annotated[int, Range(0, 4096, "even")] = 16
    ggx: Annotated[int, Range(0, 4096, "even")] = 8
    light: Annotated[int, Range(0, 4096, "even")] = 8
    shading_model: Literal["principled", "paper"] = "principled"
    indirect: bool = True
    shadows: bool = True
    environment: Annotated[int, Range(8, 1024, "power of two")] = 64
    coarse_to_fine: bool = True
    rate: Weight = 0.04
    light_rate: Weight = 0.4
    coarse: Annotated[int, Range(0, 8)] = 3
    brightness: Annotated[float, Range(1e-3, 10.0)] = 0.12
    smoothness: Weight = 0.01
    light_smoothness: Weight = 0.001
    grey_light_prior: Weight = 0.0003
    binary_metallic_prior: Weight = 0.0
    metal_albedo_prior: Weight = 0.05
    metal_smoothness: Weight = 5.0
    same_material: Weight = 0.003
    unbiased: bool = True
    weight_by_prediction: bool = True
    clipped_neighbour_weight: Part = 0.5
    parametrisation: Literal["metallic", "specular", "dielectric"] = "metallic"
    normals: bool = False
    normal_smoothness: Weight = 0.3
    domain: Literal["auto", "mesh", "surfels"] = "auto"
    joint: Part = 0.0
    exposure: bool = False
    most_pixels: Annotated[int, Range(1, 1 << 31)] = 2_000_000
    seed: Annotated[int, Range(0, 2**31 - 1)] = 0

    def check(self, prefix: str = "decoupling.") -> None:
        """Raise UsageError on what cannot be used; `prefix` is put before names."""
        check(self, prefix)
        if not self.cosine + self.ggx + self.light:
            problem = "are 0: no direction would be drawn"
            raise UsageError(f"{prefix}cosine, {prefix}ggx and {prefix}light", problem, "Set one of them above 0")
