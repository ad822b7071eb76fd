"""The table of simulation materials, and the columns of each particle that compiled code reads.

A row names a constitutive model (`simulation.models`) and its numbers in SI units; artists' presets are rows too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from .errors import UsageError
from .json_values import excerpt, is_number

Array = np.ndarray

#: Constitutive models, as compiled code numbers them.
ELASTIC, COROTATED, PLASTIC, SAND, SNOW, FLUID = range(6)
#: Of matter that flows: neighbours do not stay neighbours.
LOOSE = ("sand", "fluid")
MODELS = {
    "elastic": ELASTIC,
    "corotated": COROTATED,
    "plastic": PLASTIC,
    "sand": SAND,
    "snow": SNOW,
    "fluid": FLUID,
}
#: Columns of the array that compiled code reads: shear modulus (fluid: viscosity), Lame's first (fluid: bulk modulus),
#: and up to three numbers of the model.
MU, LAMBDA, FIRST, SECOND, THIRD = range(5)
COLUMNS = 5
#: Snow hardens at most by this factor, which bounds the time step.
MOST_HARDENING = 10.0


@dataclass(frozen=True, slots=True)
class Material:
    """Parameters of a material, in SI units.

    Attributes
    ----------
    model : str
        "elastic" (neo-Hookean), "corotated" (fixed corotated), "plastic" (Hencky strain, von Mises yield), "sand"
        (Drucker-Prager), "snow" (Stomakhin et al. 2013) or "fluid" (weakly compressible).
    youngs_modulus : float
        Young's modulus, Pa; of a fluid it gives with `poisson` the bulk modulus E / (3 (1 - 2 nu)).
    poisson : float
        Ratio in [0, 0.5).
    density : float
        kg / m^3.
    yield_stress : float
        Pa, plastic: deviatoric stress at which flow starts.
    hardening : float
        Plastic: Pa that the yield stress gains per unit of plastic strain (negative softens, down to a tenth); snow:
        the exponent xi.
    viscosity : float
        Pa s, fluid; of plastic flow it delays the return to the yield surface (foam).
    friction_angle : float
        Degrees, sand.
    cohesion : float
        Sand: volumetric strain that it bears before it comes apart.
    compression : float
        Snow: elastic strain at which it crushes.
    stretch : float
        Snow: elastic strain at which it tears.
    """

    name: str
    model: str
    about: str = ""
    youngs_modulus: float = 1e5
    poisson: float = 0.3
    density: float = 1000.0
    yield_stress: float = 0.0
    hardening: float = 0.0
    viscosity: float = 0.0
    friction_angle: float = 0.0
    cohesion: float = 0.0
    compression: float = 0.025
    stretch: float = 0.0075

    @property
    def keeps_shape(self) -> bool:
        """Whether neighbours stay neighbours, so that a surface can follow the deformation of what is near it."""
        return self.model not in LOOSE

    @property
    def gap(self) -> float:
        """Cells between neighbours on a surface from which nothing joins them; what flows is spread thin before."""
        return 1.0 if self.keeps_shape else 4.0

    @property
    def grain(self) -> float:
        """Disorder of the grains that it shows where it runs, see `frame.ObjectState`."""
        return 0.35 if self.model == "sand" else 0.0

    def moduli(self) -> tuple[float, float]:
        """Lame's parameters (lambda, mu), Pa."""
        mu = self.youngs_modulus / (2 * (1 + self.poisson))
        return self.youngs_modulus * self.poisson / ((1 + self.poisson) * (1 - 2 * self.poisson)), mu

    def wave_speed(self) -> float:
        """Speed of the fastest elastic wave, m/s."""
        first, mu = self.moduli()
        modulus = first + (2 / 3 if self.model == "fluid" else 2) * mu
        return float(np.sqrt(modulus * (MOST_HARDENING if self.model == "snow" else 1) / self.density))

    def courant(self) -> float:
        """The Courant number that is used where none is given.

        The limit was measured: steps are stable up to 1 / sqrt(0.7 + 0.9 nu / (1 - nu)), of blocks that tumble and hit
        the ground. What yields before it is strained much may go close to it; in what stretches waves grow faster.
        """
        if self.model in ("plastic", "sand"):
            return float(0.9 / np.sqrt(0.7 + 0.9 * self.poisson / (1 - self.poisson)))
        return 0.5

    def diffusivity(self) -> float:
        """Momentum diffusivity of what flows, m^2 / s: it bounds time steps as the wave speed does."""
        return 4 / 3 * self.viscosity / self.density if self.model == "fluid" else 0.0

    def row(self) -> list[float]:
        """The columns of compiled code."""
        first, mu = self.moduli()
        if self.model == "plastic":
            return [mu, first, self.yield_stress, self.hardening, self.viscosity]
        if self.model == "sand":
            sine = np.sin(np.radians(self.friction_angle))
            return [mu, first, float(np.sqrt(2 / 3) * 2 * sine / (3 - sine)), self.cohesion, 0.0]
        if self.model == "snow":
            return [mu, first, self.compression, self.stretch, self.hardening]
        if self.model == "fluid":
            return [self.viscosity, first + 2 / 3 * mu, 7.0, 0.0, 0.0]
        return [mu, first, 0.0, 0.0, 0.0]


_ROWS = (
    Material("jelly", "elastic", "soft, springs back, wobbles", 1e5, 0.3, 1000),
    Material("rubber", "elastic", "firm, springs back, keeps its volume", 2e6, 0.45, 1100),
    Material("elastic", "corotated", "springs back; survives rough handling", 2e5, 0.3, 1000),
    Material("metal", "plastic", "stiff, dents and stays dented", 4e7, 0.3, 2700, yield_stress=1e6, hardening=1e6),
    Material("clay", "plastic", "plasticine: gives way and stays", 4e5, 0.35, 1600, yield_stress=2e4),
    Material("foam", "plastic", "gives way slowly, light", 1e5, 0.2, 200, yield_stress=8e2, viscosity=200.0),
    Material("sand", "sand", "runs and piles up", 1e6, 0.3, 1600, friction_angle=35.0),
    Material("snow", "snow", "packs, tears, crumbles", 1.4e5, 0.2, 400, hardening=10.0),
    Material("water", "fluid", "splashes", 2e5, 0.4, 1000),
    Material("honey", "fluid", "flows slowly", 2e5, 0.4, 1400, viscosity=300.0),
    Material("cloth", "corotated", "limp and light: sags and folds like a plush toy", 1e4, 0.1, 150),
)
#: Name -> material.
MATERIALS: dict[str, Material] = {row.name: row for row in _ROWS}

#: Setting -> (lowest, highest) value.
_RANGES = {
    "youngs_modulus": (1.0, 1e12),
    "poisson": (0.0, 0.495),
    "density": (1e-2, 1e5),
    "yield_stress": (0.0, 1e12),
    "hardening": (-1e12, 1e12),
    "viscosity": (0.0, 1e6),
    "friction_angle": (0.0, 89.0),
    "cohesion": (0.0, 1.0),
    "compression": (1e-5, 1.0),
    "stretch": (1e-5, 1.0),
}
_NUMBERS = tuple(f.name for f in fields(Material) if f.name not in ("name", "model", "about"))
#: Former name of a setting -> its name.
RENAMED = {"young": "youngs_modulus"}


def make_material(name: str, changes: Mapping[str, Any] | None = None, subject: str = "material") -> Material:
    """A row of the table with some of its numbers replaced.

    Raises
    ------
    UsageError
        An unknown name or setting, or a number that means nothing, saying what is possible.

    Examples
    --------
    >>> jelly = make_material("jelly", {"density": 900})
    >>> jelly.model, jelly.density
    ('elastic', 900.0)
    """
    if name not in MATERIALS:
        raise UsageError(subject, f"there is no material {name!r}", f"There are {', '.join(MATERIALS)}")
    checked: dict[str, float] = {}
    for key, value in (changes or {}).items():
        where = f"{subject}, {key}"
        if key in RENAMED:
            raise UsageError(where, f"is now {RENAMED[key]}", f"Write {RENAMED[key]}")
        if key not in _NUMBERS:
            raise UsageError(where, "is not a setting of a material", f"There are {', '.join(_NUMBERS)}")
        low, high = _RANGES[key]
        if not is_number(value, -np.inf, np.inf):
            raise UsageError(where, f"is {excerpt(value)}, not a number", "Give a number in SI units")
        if not is_number(value, low, high):
            hint = " Nothing is quite incompressible; 0.49 looks the same" if key == "poisson" and value > high else ""
            raise UsageError(where, f"is {excerpt(value)}", f"It must be from {low:g} to {high:g}.{hint}".rstrip("."))
        checked[key] = float(value)
    return replace(MATERIALS[name], **checked)  # type: ignore[arg-type]


@dataclass(slots=True)
class ParticleMaterials:
    """Material parameters of each particle, as arrays.

    Attributes
    ----------
    model : (n,) uint8 array
    parameters : (n, COLUMNS) float32 array
        See `Material.row`.
    density : (n,) float32 array
        kg / m^3.
    wave_speed : (n,) float32 array
        m/s.
    courant : (n,) float32 array
        See `Material.courant`.
    diffusivity : (n,) float32 array
        m^2 / s, of momentum.
    keeps_shape : (n,) bool array
    """

    model: Array
    parameters: Array
    density: Array
    wave_speed: Array
    courant: Array
    diffusivity: Array
    keeps_shape: Array


def particle_materials(materials: list[Material], which: Array) -> ParticleMaterials:
    """Parameters of particles; that of index i consists of ``materials[which[i]]``."""

    def pick(values: list[Any], kind: type) -> Array:
        return np.ascontiguousarray(np.array(values, kind)[which])

    return ParticleMaterials(
        pick([MODELS[m.model] for m in materials], np.uint8),
        pick([m.row() for m in materials], np.float32),
        pick([m.density for m in materials], np.float32),
        pick([m.wave_speed() for m in materials], np.float32),
        pick([m.courant() for m in materials], np.float32),
        pick([m.diffusivity() for m in materials], np.float32),
        pick([m.keeps_shape for m in materials], np.bool_),
    )
