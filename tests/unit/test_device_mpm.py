"""The particle solver on a device, on Warp's device "cpu": the motion that the processor finds."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from simulation_cases import energy, lattice, momenta, solver_of

pytest.importorskip("warp", reason="warp-lang is not installed")


from cards import DEVICE
from test_simulate_bake import asset_file, content, job_of

from drgs_blender.cli.main import main
from drgs_blender.compute.warp.kernels import Launcher
from drgs_blender.core.errors import Cancelled, UsageError
from drgs_blender.core.particle_cache import ParticleCache
from drgs_blender.core.sim_materials import FLUID, MU
from drgs_blender.simulation.bake import bake
from drgs_blender.simulation.colliders import Collider
from drgs_blender.simulation.contact import Plane
from drgs_blender.simulation.fields import ForceField
from drgs_blender.simulation.gpu.grid import DeviceGrid
from drgs_blender.simulation.grid import Forces, HostGrid
from drgs_blender.simulation.settings import parse_settings
from drgs_blender.simulation.solver import Solver

EPS = float(np.finfo(np.float32).eps)
H = 0.05
FRAME = 1 / 24

_BOX = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
_FACES = [
    [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
    [1, 5, 7], [1, 7, 3],
]  # fmt: skip


@pytest.fixture(scope="module")
def launcher() -> Launcher:
    """Warp's processor with memory of its own, as a card has."""
    found = Launcher(DEVICE)
    found.apart = True
    return found


def body(
    material: str = "jelly", *, along: Any = (0, 0, 0), pinned: bool = False, markers: bool = False, **more: Any
) -> Solver:
    """A block that tumbles, is sheared, and stands a little above the floor."""
    points = np.add(lattice((0.3, 0.25, 0.25), H / 2), [0.012, 0.007, 0.05])
    velocity = np.cross([3.0, -2.0, 5.0], points - points.mean(axis=0)) + np.sin(9 * points[:, [1, 2, 0]]) + along
    more = {"gravity": (0.5, 0, -9.81), "low": (-1, -1, -1), "high": (1.5, 1.5, 1.5)} | more
    return solver_of(
        points, H, material, velocity=velocity, pinned=points[:, 0] < 0.06 if pinned else None,
        markers=points[::7] + 0.011 if markers else (), **more,
    )  # fmt: skip


def floor(contact: Any = "separate") -> Plane:
    return Plane((0, 0, 0.08), (0.1, 0, 1), contact, 0.4)


def slab(contact: Any = "separate", *, bends: bool = False, thickness: float = 0.045) -> Collider:
    """A box that comes up from below, turning or bending."""
    rest = _BOX * [0.6, 0.6, 0.2] + [-0.1, -0.1, -0.14]
    angle = 0.01
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    later = rest @ turn.T + [0, 0, 0.004]
    if bends:
        later = rest + [0, 0, 0.003] + np.sin(4 * rest[:, :1]) * [0, 0, 0.003]
    return Collider("slab", np.array(_FACES), np.stack([rest, later, later]), contact, 0.3, thickness)


def blown(solver: Solver, *field: ForceField, **forces: Any) -> Solver:
    """The same in fields of force."""
    b = solver.body
    return Solver(b, solver.domain, Forces(fields=field, **forces))


def moved(kind: str, **more: Any) -> ForceField:
    rows = ((0.1, 0.1, -0.2, 0.1, 0.2, 1.0, 9.0, 2.0), (0.2, 0.1, -0.1, 0.3, 0.2, 1.0, 12.0, 1.0))
    return ForceField(kind, rows, **more)


CASES: dict[str, Any] = {
    **{name: (lambda name=name: body(name)) for name in ("jelly", "cloth", "metal", "foam", "snow", "honey")},
    "sand": lambda: body("sand", planes=[floor()]),
    "pins": lambda: body(pinned=True),
    "markers": lambda: body("water", markers=True),
    **{f"floor {c}": (lambda c=c: body("clay", planes=[floor(c)])) for c in ("separate", "slip", "sticky")},
    **{f"slab {c}": (lambda c=c: body("sand", colliders=[slab(c)])) for c in ("separate", "slip", "sticky")},
    "slab that bends": lambda: body(colliders=[slab(bends=True)]),
    "all": lambda: body("metal", pinned=True, markers=True, planes=[floor()], colliders=[slab(), slab(bends=True)]),
    "force": lambda: blown(body(), moved("force", power=1.5, nearest=0.05, farthest=2.0)),
    "force from a line": lambda: blown(body(), moved("force", shape="line", falloff="tube", radial=1.2, inner=0.01)),
    "wind": lambda: blown(body(), moved("wind", shape="plane", side="above"), wind=(4.0, 1.0, 0.0), drag=3.0),
    "vortex": lambda: blown(body(), moved("vortex"), moved("vortex", shape="plane"), damping=2.0),
    "turbulence": lambda: blown(body(), moved("turbulence", size=0.1, falloff="cone", inner=5.0, radial=0.2)),
}


#: Solvers on a device, which must still be there when a test ends.
_there: list[tuple[Solver, DeviceGrid]] = []


def on(solver: Solver, launcher: Launcher) -> Solver:
    """The same on a device."""
    solver.grid = grid = DeviceGrid(solver.scene, launcher)
    _there.append((solver, grid))
    return solver


@pytest.fixture(autouse=True)
def _nothing_falls_back() -> Iterator[None]:
    _there.clear()
    yield
    assert all(solver.grid is grid for solver, grid in _there)


def pair(case: str, launcher: Launcher, seconds: float = 0.01) -> tuple[Solver, Solver]:
    """A solver here and one there, at the same state: that after a while."""
    here, there = CASES[case](), CASES[case]()
    here.advance(seconds)
    assert there.restore(0, here.arrays())
    here.frame = 0
    return here, on(there, launcher)


def pins_of(solver: Solver) -> np.ndarray | None:
    return solver.state.x[solver._pins] + [0.001, 0, 0.0005] if len(solver._pins) else None


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_step_is_the_processors_to_the_last_digits(launcher: Launcher, case: str) -> None:
    here, there = pair(case, launcher)
    before, targets, dt = here.state, pins_of(here), 0.9 / here.rate
    for solver in (here, there):
        steps = solver.steps
        solver.advance(dt, targets)
        assert solver.steps == steps + 1
    matter, s = here.body.matter, here.state
    # Sums in another order differ by some units in the last place of what is summed, and what is made of them follows:
    # gradients are differences of velocities over half a cell, strains are gradients times the step, and stresses are
    # strains times the stiffness, of gradients in single precision (1 + strain).
    v = 6 * EPS * np.abs(s.v).max()
    affine = 4 / H * v
    elastic = 4 * EPS * np.abs(s.elastic).max() + dt * affine
    viscosity = matter.parameters[matter.model == FLUID, MU].max(initial=0)
    tau = 2 * (matter.density * matter.wave_speed**2).max() * (elastic + EPS) + 4 * viscosity * affine
    bounds = {"x": dt * v, "v": v, "affine": affine, "elastic": elastic, "total": elastic, "tau": tau}
    bounds["memory"] = elastic + 2 * EPS
    assert set(s._fields) == set(bounds)
    for name, bound in bounds.items():
        found, expected, old = (getattr(state, name).astype(float) for state in (there.state, s, before))
        np.testing.assert_allclose(found, expected, rtol=0, atol=bound, err_msg=name)
        if name not in ("total", "memory"):
            assert np.abs(expected - old).max() > 30 * bound, name


@pytest.mark.slow
@pytest.mark.parametrize("ground", [
    {"planes": [Plane((0, 0, 0), (0, 0, 1))]},
    {"colliders": [Collider("box", np.array(_FACES), _BOX * [1.5, 1.5, 0.3] - [0.6, 0.6, 0.3])]},
])  # fmt: skip
def test_a_frame_in_which_a_body_falls_and_lands(launcher: Launcher, ground: dict[str, Any]) -> None:
    """Hundreds of steps, and particles that cross cells: motion agrees as long as nothing is chaotic."""
    here, there = (body(along=(0.3, 0, -4.0), youngs_modulus=4e5, **ground) for _ in range(2))
    rest = here.points.copy()
    on(there, launcher)
    for _ in range(2):
        for solver in (here, there):
            solver.advance(FRAME)
    assert here.steps == there.steps > 50
    assert np.linalg.norm(here.points - rest, axis=1).mean() > 2 * H
    assert np.abs(there.points - here.points).max() < 1e-3 * H
    moving = np.abs(momenta(here)[0]).max()
    for a, b in zip(momenta(here), momenta(there)):
        np.testing.assert_allclose(b, a, rtol=0, atol=1e-4 * moving)
    np.testing.assert_allclose(energy(there), energy(here), rtol=1e-3)
    assert min(energy(here)) > 0.1


def test_a_collider_that_moves_and_bends_through_a_frame(launcher: Launcher) -> None:
    """Its field is made again on the way, and is never a later one than the processor's."""
    rest = _BOX * [0.6, 0.6, 0.2] + [-0.1, -0.1, -0.16]
    bat = Collider("bat", np.array(_FACES), np.stack([rest, rest * [1, 1.2, 1] + [0.02, 0, 0.15]]))
    here, there = (body(colliders=[bat, slab(thickness=0.01)]) for _ in range(2))
    low = here.points[:, 2].min()
    on(there, launcher)
    for solver in (here, there):
        solver.advance(FRAME)
    assert here.points[:, 2].min() > low + H
    assert np.abs(there.points - here.points).max() < 1e-3 * H


def test_momentum_is_kept_on_a_device(launcher: Launcher) -> None:
    """Of a body that tumbles in empty space, whatever the processor does."""
    solver = on(body(gravity=(0, 0, 0)), launcher)
    start = momenta(solver)
    while solver.steps < 300:
        solver.advance(FRAME)
    size = (solver.body.volume * solver.body.matter.density).sum() * np.linalg.norm(solver.state.v, axis=1).mean()
    for a, b in zip(start, momenta(solver)):
        assert np.abs(a - b).max() < 1e-5 * size


@pytest.mark.slow
def test_a_frame_has_the_same_bits_twice_and_goes_on_from_its_state(launcher: Launcher) -> None:
    once, twice, later = (on(CASES["all"](), launcher) for _ in range(3))
    once.advance(FRAME, pins_of(once))
    twice.advance(FRAME, pins_of(twice))
    later.restore(1, once.arrays())
    kept = {name: array.copy() for name, array in once.arrays().items()}
    for solver in (once, twice, later):
        solver.advance(FRAME)
    for name, array in once.arrays().items():
        np.testing.assert_array_equal(twice.arrays()[name], array, err_msg=name)
        np.testing.assert_array_equal(later.arrays()[name], array, err_msg=name)
        if name != "total":
            assert (array != kept[name]).any(), name


def test_where_particles_stand_in_memory_changes_last_digits_alone(launcher: Launcher) -> None:
    """They are sorted by cells, but never moved."""
    one, other = on(body(), launcher), on(body(), launcher)
    other.restore(0, {name: array[::-1] for name, array in other.arrays().items()})
    for solver in (one, other):
        solver.advance(FRAME)
    assert np.abs(other.points[::-1] - one.points).max() < 1e-4 * H


@pytest.mark.parametrize("sudden", [True, False])
def test_fast_matter_takes_the_processors_steps(launcher: Launcher, sudden: bool) -> None:
    """It must not move by more than half a cell a step, whatever its stiffness allows; also what bursts at once."""
    here, there = (body("cloth", along=(0 if sudden else 30.0, 0, 0), high=(4, 1.5, 1.5)) for _ in range(2))
    on(there, launcher)
    for solver in (here, there):
        solver.state.tau[:, 0] = -2e4 * sudden
        solver.advance(0.5 * FRAME)
    assert here.steps == there.steps > here.steps_of(0.5 * FRAME)
    assert np.abs(there.points - here.points).max() < 1e-3 * H


def test_what_goes_wrong_is_said_as_the_processor_says_it(launcher: Launcher) -> None:
    """And the state is that at the beginning of the frame."""
    wrong = {"outside the domain": {"along": (0, 0, -20.0)}, "ran away": {"along": (1e6, 0, 0)}, "became infinite": {}}
    for words, more in wrong.items():
        said = []
        for solver in (body(**more), on(body(**more), launcher)):
            solver.state.tau[5] = 0.0 if more else np.nan
            with pytest.raises(UsageError) as error:
                for _ in range(20):
                    before = solver.state.x.copy()
                    solver.advance(FRAME)
            said.append(str(error.value))
            np.testing.assert_array_equal(solver.state.x, before)
        assert words in said[0], said
        assert said[1].split(":")[0] == said[0].split(":")[0]
        assert words in said[1]


def test_drops_that_leave_the_domain_stay_as_on_the_processor(launcher: Launcher) -> None:
    drop = np.add(lattice((0.05, 0.05, 0.05), H / 2), [1.2, 0.1, 0.1])
    points = np.concatenate([lattice((0.3, 0.25, 0.25), H / 2), drop])
    velocity = np.where(points[:, :1] > 1, [15.0, 0, 0], np.sin(9 * points[:, [1, 2, 0]]))
    here, there = (
        solver_of(points, H, "water", velocity=velocity, markers=points[::5], low=(-1,) * 3, high=(1.5,) * 3)
        for _ in range(2)
    )
    on(there, launcher)
    for solver in (here, there):
        for _ in range(2):
            solver.advance(FRAME)
    assert here.lost == there.lost == len(drop)
    assert np.abs(here.points - there.points).max() < 1e-2 * H
    gone = there.points[:, 0] >= there.domain.high[0]
    before = there.points[gone].copy()
    there.advance(FRAME)
    np.testing.assert_array_equal(there.points[gone], before)


def test_a_caller_may_stop_within_a_frame(launcher: Launcher) -> None:
    solver = on(body(youngs_modulus=1e6), launcher)
    before, asked = solver.state.x.copy(), []

    def stop() -> bool:
        asked.append(True)
        return len(asked) > 2

    with pytest.raises(Cancelled):
        solver.advance(10 * FRAME, cancelled=stop)
    np.testing.assert_array_equal(solver.state.x, before)


# --- which device ----------------------------------------------------------------------------------------------------


def failing(launcher: Launcher, monkeypatch: pytest.MonkeyPatch, after: int) -> None:
    """Have the device fail after so many batches of steps."""
    step, calls = DeviceGrid.step, []

    def broken(grid: DeviceGrid, *arguments: Any) -> list[float]:
        calls.append(1)
        if len(calls) > after:
            with grid.launcher.failures("simulating"):
                raise RuntimeError("CUDA error 700: an illegal memory access was encountered\nlog")
        return step(grid, *arguments)

    monkeypatch.setattr(DeviceGrid, "step", broken)


def test_a_device_that_fails_within_a_frame_loses_nothing(
    launcher: Launcher, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """That frame and all later ones are the processor's, from the state that the device left."""
    solver, alike = on(body(youngs_modulus=1e6), launcher), on(body(youngs_modulus=1e6), launcher)
    for each in (solver, alike):
        each.advance(FRAME)
    failing(launcher, monkeypatch, after=1)
    alike.grid = HostGrid(alike.scene)
    for _ in range(2):
        for each in (solver, alike):
            each.advance(FRAME)
    (said,) = caplog.messages
    assert "illegal memory access" in said and said.endswith("Simulated on the CPU from frame 2 on")
    _there.clear()
    assert solver.steps == alike.steps
    for name, array in alike.arrays().items():
        np.testing.assert_array_equal(solver.arrays()[name], array, err_msg=name)


@pytest.fixture
def card(monkeypatch: pytest.MonkeyPatch) -> None:
    """Warp's processor is the card."""
    monkeypatch.setattr("drgs_blender.simulation.solver.name_of", lambda device: DEVICE)


@pytest.mark.slow
def test_a_bake_goes_on_with_the_same_bits_on_its_device(card: None, tmp_path: Path) -> None:
    whole, parts = ParticleCache(tmp_path / "whole"), ParticleCache(tmp_path / "parts")
    job = job_of(device="cuda")
    assert isinstance(job.solver, Solver) and isinstance(job.solver.grid, DeviceGrid)
    bake(job, whole)
    for last in (3, 6):
        bake(job_of(device="cuda", last=last), parts)
    assert content(parts.folder) == content(whole.folder)


def test_a_bake_goes_on_on_another_device(card: None, tmp_path: Path) -> None:
    """Frames are of one simulation wherever they are computed."""
    cache, here = ParticleCache(tmp_path / "both"), ParticleCache(tmp_path / "here")
    bake(job_of(device="cuda", last=3), cache)
    assert bake(job_of(device="cpu"), cache) == 3
    bake(job_of(), here)
    assert cache.header().digest == here.header().digest
    np.testing.assert_allclose(cache.read(6).points, here.read(6).points, atol=1e-4)


def test_a_bake_whose_device_fails_is_whole(
    card: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, launcher: Launcher, caplog: pytest.LogCaptureFixture
) -> None:
    failing(launcher, monkeypatch, after=3)
    cache, here = ParticleCache(tmp_path / "failed"), ParticleCache(tmp_path / "here")
    assert bake(job_of(device="cuda"), cache) == 5
    assert [m for m in caplog.messages if "Simulated on the CPU from frame" in m] == caplog.messages[:1]
    bake(job_of(), here)
    np.testing.assert_allclose(cache.read(6).points, here.read(6).points, atol=1e-4)


def test_without_a_card_the_processor_does_all_and_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr("drgs_blender.compute.warp.runtime.cuda_devices", list)
    found, expected = tmp_path / "found", tmp_path / "expected"
    asset = str(asset_file(tmp_path))
    options = ["--resolution", "8", "--frames", "3", "--floor", "0", "--youngs-modulus", "2e4"]
    assert main(["simulate", asset, "--out", str(found), "--device", "cuda", *options]) == 0
    said = capsys.readouterr().err
    assert "no NVIDIA card" in said and "Simulated on the CPU" in said
    assert main(["simulate", asset, "--out", str(expected), *options]) == 0
    assert content(found) == content(expected) and "CPU" not in capsys.readouterr().err


def test_only_particles_are_for_a_card(caplog: pytest.LogCaptureFixture) -> None:
    job_of(device="cuda", solver="rigid")
    assert "only the solver mpm" in caplog.text


def test_an_unknown_device_is_refused_by_name() -> None:
    with pytest.raises(UsageError, match=r"device.*tpu.*cpu, cuda"):
        parse_settings({"device": "tpu"})
    with pytest.raises(UsageError, match=r"tpu.*cpu, cuda"):
        Solver(body().body, body().domain, device="tpu")
