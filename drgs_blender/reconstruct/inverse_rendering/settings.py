"""Settings of inverse rendering: how light and materials of an object are separated."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

from ...core.errors import UsageError


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
        Drawn in each step, over all training views.
    cosine, ggx, light : int
        Directions that each strategy draws at a pixel, even numbers.
    shading_model : {"principled", "paper"}
        BRDF, "principled" (Blender's) or "paper".
    indirect : bool
        Light that other parts of the object send is what the photographs show of them; else it is black.
    shadows : bool
        Other parts of the object stand before the environment; without, every point sees all of it, as in the split-sum
        shading of other methods.
    environment : int
        Rows of the learned lat-long light at the end, a power of two.
    coarse_to_fine : bool
        Begin with a quarter of the rows and double them on a schedule.
    rate, light_rate : float
        First step sizes of materials and light (Adam), in logits and log radiance.
    coarse : int
        Also learn materials on this many nested grids of cells, which carry what many pixels agree on quickly.
    smoothness : float
        Weight of the differences of materials along edges, less where the photographs differ.
    light_smoothness : float
        Weight of the differences of log radiance between neighbours in the environment.
    grey_light_prior : float
        Weight that pulls the environment towards grey.
    binary_metallic_prior : float
        Weight that pulls metallic to 0 or 1.
    metal_albedo_prior : float
        Weight that pulls the colours of metals towards as bright as polished metals are.
    metal_smoothness : float
        How much more than other albedo that of metals is smoothed, in parts of `smoothness`: there, errors of normals
        leave blotches.
    unbiased : bool
        Compare two independent estimates of each pixel, so that their noise is not learned from.
    weight_by_prediction : bool
        Weigh differences by what is shown, once that is near the photographs; else by the photographs, which finds
        polished metal and the light in it too dark where the mesh is a little off.
    clipped_neighbour_weight : float
        Weight per channel of pixels next to clipped ones, once differences are weighed by what is shown. Small errors
        of normals let them mirror a neighbouring highlight; clipped pixels cannot contradict that, so the light would
        be found too dim.
    parametrisation : {"metallic", "specular", "dielectric"}
        "metallic" learns albedo and metallic; "specular" diffuse and specular colour, turned into the former at the
        end; "dielectric" albedo alone, metallic is 0.
    normals : bool
        Also learn an offset of each vertex normal, held by `normal_smoothness`.
    exposure : bool
        Also learn the brightness of every photograph.
    most_pixels : int
        Foreground pixels kept in memory, evenly over all views.
    seed : int
        Of all random numbers.
    """

    iterations: int = 2500
    seconds: float = 0.0
    pixels: int = 2048
    cosine: int = 16
    ggx: int = 8
    light: int = 8
    shading_model: Literal["principled", "paper"] = "principled"
    indirect: bool = True
    shadows: bool = True
    environment: int = 64
    coarse_to_fine: bool = True
    rate: float = 0.04
    light_rate: float = 0.4
    coarse: int = 3
    smoothness: float = 0.01
    light_smoothness: float = 0.001
    grey_light_prior: float = 0.0003
    binary_metallic_prior: float = 0.0
    metal_albedo_prior: float = 0.05
    metal_smoothness: float = 5.0
    unbiased: bool = True
    weight_by_prediction: bool = True
    clipped_neighbour_weight: float = 0.5
    parametrisation: Literal["metallic", "specular", "dielectric"] = "metallic"
    normals: bool = False
    normal_smoothness: float = 0.3
    exposure: bool = False
    most_pixels: int = 2_000_000
    seed: int = 0

    def check(self) -> None:
        """Raise UsageError on what cannot be used."""
        counts = (self.cosine, self.ggx, self.light)
        rows = self.environment
        wrong = {
            "iterations": self.iterations < 1,
            "pixels": self.pixels < 1,
            "most_pixels": self.most_pixels < 1,
            "cosine, ggx, light": min(counts) < 0 or sum(counts) == 0 or any(c % 2 for c in counts),
            "environment": not 8 <= rows <= 1024 or rows & (rows - 1) != 0,
            "shading_model": self.shading_model not in ("principled", "paper"),
            "parametrisation": self.parametrisation not in ("metallic", "specular", "dielectric"),
            "coarse": not 0 <= self.coarse <= 8,
        }
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, float) and not 0.0 <= value < float("inf"):
                wrong[field.name] = True
        bad = [name for name, is_wrong in wrong.items() if is_wrong]
        if bad:
            raise UsageError(
                "decoupling settings",
                f"{', '.join(bad)} cannot be used",
                "Numbers are positive, samples even, rows of the environment a power of two from 8 to 1024",
            )
