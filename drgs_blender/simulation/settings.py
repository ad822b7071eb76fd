"""Settings of a simulation, as JSON: checked key by key before anything is computed."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..compute.warp.runtime import DEVICES
from ..core.errors import UsageError
from ..core.json_values import excerpt, is_number, number_array
from ..core.sim_materials import Material, make_material
from .contact import CONTACTS, Contact
from .fields import FALLOFFS, FAR, KINDS, MOVING, SHAPES, SIDES, ForceField

Array = np.ndarray
Vector = tuple[float, float, float]

SOLVERS = ("mpm", "xpbd", "rigid")
WALLS = ("open", *CONTACTS)
#: Largest component of velocities (m/s), of the spin (rad/s) and of gravity (m/s^2).
_FASTEST = 1e6


@dataclass(frozen=True, slots=True)
class Region:
    """Part of the body: the matter nearest to a vertex group, or in a box (world, metres), or both."""

    group: str | None = None
    box: tuple[Vector, Vector] | None = None


@dataclass(frozen=True, slots=True)
class Obstacle:
    """A collider: a mesh file, or vertices of its frames (k, n, 3) over it; see `colliders.Collider`."""

    mesh: str
    vertices: str | None = None
    contact: Contact = "separate"
    friction: float = 0.5
    thickness: float = 0.0


@dataclass(frozen=True, slots=True)
class Settings:
    """A simulation of one asset.

    Attributes
    ----------
    material : Material
        Of all matter that no region claims.
    regions : tuple of tuple of (Region, Material)
        Parts of other matter; the last one that fits counts.
    resolution : int
        Grid cells along the body's longest side; there are two particles a cell and axis.
    solver : str
        "mpm"; "xpbd" for a quick look at what an elastic body does; "rigid" for one that never bends.
    gravity : tuple of float
        m/s^2.
    wind : tuple of float
        m/s.
    drag : float
        1/s, how the wind pulls.
    damping : float
        1/s, slows everything.
    fields : tuple of ForceField
        Of force.
    velocity : tuple of float
        m/s, at the start.
    spin : tuple of float
        rad/s about the body's centre, at the start.
    pins : tuple of Region
        Parts that stay where they are, or move as the mesh does in `motion`.
    motion : str, optional
        .npy of (k, n, 3) vertices of the mesh in k frames, object space.
    floor : float, optional
        Height of a floor in the world, metres, or None; with its contact and friction.
    domain : tuple of tuple of float, optional
        Corners of the space that is simulated, world; None is chosen from the body and what is around it.
    walls : str
        Boundary condition at its sides; "open" makes leaving an error.
    first, last : int
        Frames.
    fps : float
        Frames per second.
    device : str
        Device of the computation, one of `DEVICES`; frames do not depend on it, but for last digits.
    matrix_world : tuple of tuple of float
        (4, 4) object to world.
    """

    material: Material = field(default_factory=lambda: make_material("jelly"))
    regions: tuple[tuple[Region, Material], ...] = ()
    resolution: int = 48
    solver: str = "mpm"
    gravity: Vector = (0.0, 0.0, -9.81)
    wind: Vector = (0.0, 0.0, 0.0)
    drag: float = 0.0
    damping: float = 0.0
    fields: tuple[ForceField, ...] = ()
    velocity: Vector = (0.0, 0.0, 0.0)
    spin: Vector = (0.0, 0.0, 0.0)
    pins: tuple[Region, ...] = ()
    motion: str | None = None
    colliders: tuple[Obstacle, ...] = ()
    floor: float | None = None
    floor_contact: Contact = "separate"
    floor_friction: float = 0.5
    domain: tuple[Vector, Vector] | None = None
    walls: str = "open"
    first: int = 1
    last: int = 48
    fps: float = 24.0
    courant: float | None = None
    jitter: float | None = None
    seed: int = 0
    device: str = "cpu"
    matrix_world: tuple[tuple[float, ...], ...] = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))


def parse_settings(data: Any, subject: str = "settings", folder: Path | None = None) -> Settings:
    """Settings of a JSON object, see `Settings` and docs/simulation.md."""
    reader = Reader(data, subject, folder or Path())
    given: dict[str, Any] = {}
    for key in reader.keys(KEYS):
        given[key] = KEYS[key](reader, key)
    settings = Settings(**given)
    if settings.last < settings.first:
        raise UsageError(subject, f"ends at frame {settings.last}, before its first, {settings.first}", "Change frames")
    return settings


class Reader:
    """Checked access to one JSON object."""

    def __init__(self, data: Any, subject: str, folder: Path) -> None:
        if not isinstance(data, Mapping):
            raise UsageError(subject, "is not a JSON object", "Write {...}")
        self.data, self.subject, self.folder = data, subject, folder

    def keys(self, known: Mapping[str, Any]) -> list[str]:
        for key in self.data:
            if key not in known:
                raise UsageError(f"{self.subject}, {key}", "is not a setting", f"There are {', '.join(known)}")
        return list(self.data)

    def fail(self, key: str, expected: str) -> UsageError:
        return UsageError(f"{self.subject}, {key}", f"is {excerpt(self.data[key])}", f"Give {expected}")

    def number(self, key: str, low: float = -FAR, high: float = FAR) -> float:
        value = self.data[key]
        if not is_number(value, low, high):
            raise self.fail(key, f"a number from {low:g} to {high:g}")
        return float(value)

    def integer(self, key: str, low: int, high: int) -> int:
        value = self.data[key]
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise self.fail(key, f"a whole number from {low} to {high}")
        return value

    def vector(self, key: str, limit: float = FAR) -> Vector:
        array = number_array(self.data[key], (3,), limit)
        if array is None:
            raise self.fail(key, f"three numbers from {-limit:g} to {limit:g}")
        return (float(array[0]), float(array[1]), float(array[2]))

    def box(self, key: str) -> tuple[Vector, Vector]:
        array = number_array(self.data[key], (2, 3), FAR)
        if array is None or (array[0] >= array[1]).any():
            expected = "two corners, [[x, y, z], [x, y, z]], the lower one first"
            raise self.fail(key, f"{expected}, in metres from {-FAR:g} to {FAR:g}")
        low, high = array.tolist()
        return tuple(low), tuple(high)

    def matrix(self, key: str) -> tuple[tuple[float, ...], ...]:
        array = number_array(self.data[key], (4, 4), FAR)
        if array is None or abs(np.linalg.det(array[:3, :3])) < 1e-12:
            raise self.fail(key, f"four rows of four numbers from {-FAR:g} to {FAR:g} that can be inverted")
        if not np.allclose(array[3], (0, 0, 0, 1)):
            raise self.fail(key, "a matrix whose last row is 0 0 0 1 (is it transposed?)")
        return tuple(tuple(row) for row in array.tolist())

    def choice(self, key: str, among: tuple[str, ...]) -> Any:
        if self.data[key] not in among:
            raise self.fail(key, f"one of {', '.join(among)}")
        return self.data[key]

    def text(self, key: str) -> str:
        if not isinstance(self.data[key], str) or not self.data[key]:
            raise self.fail(key, "a name")
        return self.data[key]

    def path(self, key: str) -> str:
        text = self.text(key)
        try:
            possible = b"\0" not in os.fsencode(text)
        except UnicodeEncodeError:  # half of a surrogate pair
            possible = False
        if not possible:
            raise self.fail(key, "the path of a file")
        return str(self.folder / text)

    def optional(self, key: str, read: Any) -> Any:
        return None if self.data[key] is None else read(key)

    def items(self, key: str) -> list[Reader]:
        value = self.data[key]
        if not isinstance(value, list):
            raise self.fail(key, "a list")
        return [Reader(item, f"{self.subject}, {key} {i + 1}", self.folder) for i, item in enumerate(value)]

    def material(self, key: str) -> Material:
        value = self.data[key]
        if isinstance(value, str):
            return make_material(value, None, f"{self.subject}, {key}")
        if not isinstance(value, Mapping) or not isinstance(value.get("name"), str):
            raise self.fail(key, 'a name, or an object such as {"name": "jelly", "youngs_modulus": 1e5}')
        changes = {k: v for k, v in value.items() if k != "name"}
        return make_material(value["name"], changes, f"{self.subject}, {key}")

    def region(self, known: tuple[str, ...] = ("group", "box")) -> Region:
        self.keys(dict.fromkeys(known))
        if "group" not in self.data and "box" not in self.data:
            raise UsageError(self.subject, "names no part of the body", "Give it a group or a box")
        group = self.text("group") if "group" in self.data else None
        return Region(group, self.box("box") if "box" in self.data else None)

    def region_of_matter(self) -> tuple[Region, Material]:
        region = self.region(("group", "box", "material"))
        if "material" not in self.data:
            raise UsageError(self.subject, "has no material", "Give it one")
        return region, self.material("material")

    def rows(self, key: str, columns: int) -> tuple[tuple[float, ...], ...]:
        array = number_array(self.data[key], (None, columns), FAR)
        if array is None:
            raise self.fail(key, f"rows of {columns} numbers from {-FAR:g} to {FAR:g}")
        return tuple(tuple(row) for row in array.tolist())

    def force_field(self) -> ForceField:
        distances = ("power", "nearest", "farthest", "radial", "inner", "outer", "size")
        table: dict[str, Any] = {name: lambda k: self.number(k, 0, FAR) for name in distances}
        choices = {"kind": KINDS, "shape": SHAPES, "falloff": FALLOFFS, "side": SIDES}
        table |= {name: lambda k, among=among: self.choice(k, tuple(among)) for name, among in choices.items()}
        table |= {"place": self.vector, "axis": self.vector, "strength": self.number, "flow": self.number}
        table["frames"] = lambda k: self.rows(k, MOVING)
        given = {key: table[key](key) for key in self.keys(table)}
        if "kind" not in given:
            raise UsageError(self.subject, "has no kind", f"There are {', '.join(KINDS)}")
        row = (*given.pop("place", (0.0,) * 3), *given.pop("axis", (0.0, 0.0, 1.0)))
        row += (given.pop("strength", 1.0), given.pop("flow", 0.0))
        return ForceField(**({"frames": (row,)} | given))

    def obstacle(self) -> Obstacle:
        table = {
            "mesh": self.path,
            "vertices": self.path,
            "contact": lambda k: self.choice(k, tuple(CONTACTS)),
            "friction": lambda k: self.number(k, 0, 1e6),
            "thickness": lambda k: self.number(k, -1e3, 1e3),
        }
        given = {key: table[key](key) for key in self.keys(table)}
        if "mesh" not in given:
            raise UsageError(self.subject, "names no mesh", "Give it one")
        return Obstacle(**given)


#: Name of a setting -> how it is read.
KEYS: dict[str, Any] = {
    "material": lambda r, k: r.material(k),
    "regions": lambda r, k: tuple(i.region_of_matter() for i in r.items(k)),
    "resolution": lambda r, k: r.integer(k, 4, 400),
    "solver": lambda r, k: r.choice(k, SOLVERS),
    "gravity": lambda r, k: r.vector(k, _FASTEST),
    "wind": lambda r, k: r.vector(k, _FASTEST),
    "drag": lambda r, k: r.number(k, 0, 1e4),
    "damping": lambda r, k: r.number(k, 0, 1e4),
    "fields": lambda r, k: tuple(i.force_field() for i in r.items(k)),
    "velocity": lambda r, k: r.vector(k, _FASTEST),
    "spin": lambda r, k: r.vector(k, _FASTEST),
    "pins": lambda r, k: tuple(i.region() for i in r.items(k)),
    "motion": lambda r, k: r.optional(k, r.path),
    "colliders": lambda r, k: tuple(i.obstacle() for i in r.items(k)),
    "floor": lambda r, k: r.optional(k, r.number),
    "floor_contact": lambda r, k: r.choice(k, tuple(CONTACTS)),
    "floor_friction": lambda r, k: r.number(k, 0, 1e6),
    "domain": lambda r, k: r.optional(k, r.box),
    "walls": lambda r, k: r.choice(k, WALLS),
    "first": lambda r, k: r.integer(k, -1_048_574, 1_048_574),
    "last": lambda r, k: r.integer(k, -1_048_574, 1_048_574),
    "fps": lambda r, k: r.number(k, 0.1, 10_000),
    "courant": lambda r, k: r.optional(k, lambda key: r.number(key, 0.01, 1.0)),
    "jitter": lambda r, k: r.optional(k, lambda key: r.number(key, 0, 1)),
    "seed": lambda r, k: r.integer(k, 0, 2**31 - 1),
    "device": lambda r, k: r.choice(k, tuple(DEVICES)),
    "matrix_world": lambda r, k: r.matrix(k),
}
