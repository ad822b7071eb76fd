"""The grid of the particle solver on a device of Warp, where particles stay for a whole frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ...compute.warp.kernels import Launcher
from ...compute.warp.runtime import warp
from ..contact import Field
from ..fields import COLUMNS
from ..grid import Grid, Limits, Scene
from ..particles import Particles
from .cells import BLOCKS, FIND_HOMES, INDEX, LIST, LOST, NUMBER, OCCUPIED, STARTS, around
from .steps import (
    CELL,
    DISTANCE,
    END_STEP,
    GATHER,
    LAYERS,
    LINEAR,
    MOST_DRIFT,
    MOST_SPEED,
    MOVE,
    ORIGIN,
    OUTSIDE,
    PACKET,
    PREPARE,
    SHAPE,
    SHIFT,
    SIZE,
    SLOTS,
    SOLVE,
    SPIN,
    STEP,
    SUMS,
    SURFACE,
    TOPS,
    VECTORS,
    VELOCITY,
)

Array = np.ndarray

#: Steps that are launched before the host asks how they went.
_STEPS = 32
#: Blocks with particles that the host reads at once.
_FEW = 4096


class DeviceGrid(Grid):
    """On a device.

    Parameters
    ----------
    scene : Scene
    launcher : Launcher
        Of the device.

    Raises
    ------
    DeviceError
        From all methods, when the device fails.
    """

    most = _STEPS
    launcher: Launcher

    def __init__(self, scene: Scene, launcher: Launcher) -> None:
        super().__init__(scene)
        self.launcher = launcher
        self._state: dict[str, Any] = {}
        self._blocks = 0
        self._launches: list[Callable[[], None]] = []
        self._fields: list[tuple[Field | None, list[Any]]] = [(None, [])] * len(scene.colliders)

    def enter(self, state: Particles, frame: int, seconds: float, pin_velocity: Array) -> None:
        self._frame, self._seconds = frame, seconds
        with self.launcher.failures("copying particles"):
            if not self._state:
                self._make_room(state)
            for name, array in state._asdict().items():
                self._state[name].assign(array)
            if len(pin_velocity):
                self._pin_velocity.assign(pin_velocity)

    def _make_room(self, state: Particles) -> None:
        """Arrays that are as large in every frame."""
        scene, there, zeros = self._scene, self.launcher.array, self.launcher.zeros
        n, pins, k = len(state.x), scene.pins, len(scene.colliders)
        pin = np.full(n, -1, np.int32)
        pin[pins] = np.arange(len(pins))
        own = scene.properties
        self._mass, self._volume, self._pin = there(own.mass), there(own.volume), there(pin)
        self._model, self._solid = there(own.model.astype(np.int32)), there(own.solid.astype(np.int32))
        self._parameters, self._planes = there(own.parameters), there(scene.planes)
        self._keys, self._order, self._home = zeros((2 * n,), "int64"), zeros((2 * n,), "int32"), zeros((n,), "int32")
        self._cell, self._packet = zeros((n, CELL), "int32"), zeros((n, PACKET))
        self._found = zeros((BLOCKS + n,), "int64")
        self._fastest, self._sizes = zeros((SLOTS,), "int32"), zeros((3,), "int64")
        self._pin_velocity = zeros((max(len(pins), 1), 3))
        # What changes from step to step, a row each, here and there.
        self._plan = {
            "clock": np.zeros(TOPS + _STEPS), "times": np.zeros((_STEPS, 6)),
            "rows": np.zeros((_STEPS, len(scene.fields), COLUMNS)), "shapes": np.zeros((k, SHAPE), np.int64),
            "turns": np.zeros((_STEPS, k, 3, 3)), "vectors": np.zeros((_STEPS, k, VECTORS, 3)),
            "contacts": np.zeros((k, SURFACE)),
        }  # fmt: skip
        self._there = {name: zeros(a.shape, a.dtype.name) for name, a in self._plan.items()}
        self._state = {name: zeros(a.shape, a.dtype.name) for name, a in state._asdict().items()}
        domain = scene.domain
        place = self._state["x"], tuple(domain.origin.tolist()), 1.0 / domain.spacing, *domain.blocks
        self._number = self.launcher.recorded(NUMBER, n, place, (self._keys, self._order, self._found))
        self._list = self.launcher.recorded(LIST, n, (n, self._keys, int(np.prod(domain.blocks))), (self._found,))

    def sort(self) -> int:
        domain, found, n = self._scene.domain, self._found, len(self._order) // 2
        with self.launcher.failures("sorting particles"):
            found[:BLOCKS].zero_()
            self._number()
            bits = int(np.prod(domain.blocks, dtype=np.int64)) * 64
            warp().utils.radix_sort_pairs(self._keys, self._order, n, end_bit=bits.bit_length())
            self._list()
            head = found[: BLOCKS + min(n, _FEW)].numpy()
            count = int(head[OCCUPIED])
            head = head if count <= _FEW else found[: BLOCKS + count].numpy()
            active = around(head[BLOCKS : BLOCKS + count], domain.blocks)
            if len(active) > self._blocks:
                self._take_blocks(len(active) * 5 // 4)
            self._numbers.assign(np.pad(active, (0, self._blocks - len(active))))
            self._sizes.assign(np.array([len(active), *domain.blocks[1:]], np.int64))
            self._index()
            self._house()
        return int(head[LOST])

    def _take_blocks(self, count: int) -> None:
        """Memory for a number of active blocks, and the launches that work on it."""
        zeros, recorded, n = self.launcher.zeros, self.launcher.recorded, len(self._order) // 2
        self._launches, self._blocks = [], count
        self._active, self._neighbour = zeros((count, 3), "int32"), zeros((count, 27), "int32")
        self._first, self._numbers = zeros((count, STARTS), "int32"), zeros((count,), "int64")
        self._nodes, self._sums = zeros((count * 64, 4)), zeros((LAYERS, count * 64, SUMS))
        known = n, self._keys, self._numbers, self._sizes
        self._index = recorded(INDEX, count * (27 + STARTS), known, (self._active, self._neighbour, self._first))
        self._house = recorded(FIND_HOMES, n, known, (self._home,))

    def _recorded(self) -> list[Callable[[], None]]:
        """The launches of a step, which are the same for all steps."""
        scene, s, there, launcher = self._scene, self._state, self._there, self.launcher
        n = len(s["x"])
        grid = tuple(scene.domain.origin.tolist()), scene.domain.spacing
        clock, times = time = there["clock"], there["times"]
        pins = self._pin_velocity, bool(len(scene.pins))
        particles, properties = (s["x"], s["v"], s["affine"], s["tau"]), (self._mass, self._volume, self._pin)
        given = self._cell, self._packet
        colliders = there["shapes"], there["turns"], there["vectors"], there["contacts"]
        obstacles = colliders, bool(scene.colliders), self._planes, bool(len(scene.planes)), pins[1]
        wind = tuple(map(float, scene.forces.wind))
        forces = scene.least, wind, there["rows"], bool(len(scene.fields))
        blocks = self._sizes, self._active, self._first, self._neighbour
        homes = self._order, self._home, self._active, self._neighbour
        matter = self._mass, self._model, self._parameters, self._solid, len(s["total"]) > 0
        return [
            launcher.recorded(PREPARE, n, (self._order, particles, properties, grid, time), given),
            launcher.recorded(GATHER, self._blocks * 64 * LAYERS, (blocks, given, pins, clock), (self._sums,)),
            launcher.recorded(
                SOLVE, self._blocks * 64, (blocks, self._sums, grid, time, obstacles, forces), (self._nodes,)
            ),
            launcher.recorded(
                MOVE, n, (homes, self._nodes, matter, (self._pin, *pins), grid, time), (*s.values(), self._fastest)
            ),
            launcher.recorded(END_STEP, 1, (scene.domain.spacing, times), (clock, self._fastest)),
        ]

    def step(self, times: Sequence[tuple[float, float]], limits: Limits) -> list[float]:
        scene, plan = self._scene, self._plan
        if any(moving.deforms for moving in scene.colliders):
            times = times[:1]  # its field may be another one in the next
        plan["clock"][:TOPS] = 0
        for column, value in ((MOST_DRIFT, limits.drift), (MOST_SPEED, limits.speed), (OUTSIDE, limits.outside)):
            plan["clock"][column] = value
        forces = scene.forces
        with self.launcher.failures("simulating"):
            for s, (done, dt) in enumerate(times):
                factors = 1 - np.exp(-dt * forces.drag), np.exp(-dt * forces.damping)
                plan["times"][s] = dt, *factors, *(dt * g for g in forces.gravity)
                part = (done + 0.5 * dt) / self._seconds
                plan["rows"][s] = scene.fields.at(self._frame, part)
                self._place_colliders(s, part)
            for name, array in self._plan.items():
                if array.size:
                    self._there[name].assign(array)
            self._launches = self._launches or self._recorded()
            for _ in times:
                for launch in self._launches:
                    launch()
            clock = self._there["clock"].numpy()
        tops: list[float] = clock[TOPS : TOPS + int(clock[STEP])].tolist()
        return tops

    def _place_colliders(self, s: int, part: float) -> None:
        """Where the colliders are in step s, at `part` of the frame."""
        plan, array = self._plan, self.launcher.array
        for c, moving in enumerate(self._scene.colliders):
            if s and moving.speed == 0.0:
                plan["turns"][s, c], plan["vectors"][s, c] = plan["turns"][s - 1, c], plan["vectors"][s - 1, c]
                continue
            field, motion = moving.at(part)
            if field is not self._fields[c][0]:
                arrays = [] if field is None else [array(a) for a in (field.distance, field.velocity) if a.size]
                self._fields[c] = field, arrays
            plan["shapes"][c] = 0
            if field is None:
                continue
            addresses = [a.ptr for a in self._fields[c][1]]
            plan["shapes"][c, SIZE : SIZE + 3] = field.distance.shape
            plan["shapes"][c, DISTANCE] = addresses[0]
            plan["shapes"][c, VELOCITY] = addresses[1] if len(addresses) > 1 else 0
            plan["contacts"][c] = field.spacing, *moving.collider.surface
            plan["turns"][s, c], shift, linear, spin = motion
            for row, vector in ((SHIFT, shift), (LINEAR, linear), (SPIN, spin), (ORIGIN, field.origin)):
                plan["vectors"][s, c, row] = vector

    def state(self) -> Particles:
        with self.launcher.failures("copying particles"):
            return Particles(**{name: np.array(array.numpy()) for name, array in self._state.items()})
