"""Materials one particle at a time: stress is the slope of the energy, turns with the matter, and yields."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drgs_blender.core.errors import UsageError
from drgs_blender.core.sim_materials import MATERIALS, MODELS, make_material
from drgs_blender.simulation import lanes
from drgs_blender.simulation.constitutive import respond
from drgs_blender.simulation.decompose import svd3
from drgs_blender.simulation.settings import parse_settings

SOLID = [name for name, m in MATERIALS.items() if m.model != "fluid"]


def stress(material, f, memory=0.0, affine=None, dt=1e-4):
    """(tau, F after flow, memory) of one particle with deformation gradient f."""
    own = (np.asarray(f, np.float64) - np.eye(3)).astype(np.float32).reshape(1, 9)
    stress, memories = np.zeros((1, 6), np.float32), np.float32([memory])
    gradient = np.zeros((1, 9), np.float32) if affine is None else np.asarray(affine, np.float32).reshape(1, 9)
    respond(0, np.uint8([MODELS[material.model]]), np.float32([material.row()]), own, stress, memories, gradient, dt)
    (tau,) = stress
    full = np.array([[tau[0], tau[3], tau[4]], [tau[3], tau[1], tau[5]], [tau[4], tau[5], tau[2]]], float)
    return full, own.reshape(3, 3).astype(float) + np.eye(3), float(memories[0])


def gradients(seed: int, size: float, n: int = 40) -> np.ndarray:
    f = np.eye(3) + size * np.random.default_rng(seed).normal(size=(n, 3, 3))
    return f[np.linalg.det(f) > 0.2]


def start(material) -> float:
    return 1.0 if material.model in ("snow", "fluid") else 0.0


@pytest.mark.parametrize("kind", ["any", "equal", "flat"])
def test_singular_values(kind):
    rng = np.random.default_rng(0)
    for _ in range(200):
        a = rng.normal(size=(3, 3))
        if kind != "any":
            turn, other = Rotation.random(2, random_state=rng).as_matrix()
            a = turn @ np.diag({"equal": [2.0, 2.0, 0.5], "flat": [1.0, 0.3, 0.0]}[kind]) @ other
        u, s, v = (np.array(part) for part in svd3((a - np.eye(3)).reshape(1, 9), 0))
        u, v = u.reshape(3, 3), v.reshape(3, 3)
        assert np.abs(u @ np.diag(s) @ v.T - a).max() < 1e-9
        assert np.sort(s) == pytest.approx(np.sort(np.linalg.svd(a)[1]), abs=1e-7)
        assert np.abs(v.T @ v - np.eye(3)).max() < 1e-12
        assert np.abs(u.T @ u - np.eye(3)).max() < 1e-6


@pytest.mark.parametrize("size", [0.0, 1e-8, 1e-4, 0.01, 0.05, 0.2, 3.0])
@pytest.mark.parametrize("name", [name for name in SOLID if name not in ("rubber", "cloth")])
def test_sixteen_particles_at_once_do_as_each_alone(name, size):
    """In single precision, with all digits of small strain; what is deformed too much is left to the other way."""
    material, rng = MATERIALS[name], np.random.default_rng(7)
    kind, row, dt = MODELS[material.model], np.float32(material.row()), np.float32(1e-4)
    f = (size * rng.normal(size=(lanes.LANES, 9))).astype(np.float32)
    memory = (start(material) + 1e-3 * rng.random(lanes.LANES)).astype(np.float32)
    tile = np.zeros((lanes.ROWS, lanes.LANES), np.float32)
    tile[lanes.H : lanes.H + 9], tile[lanes.STRAIN + lanes.MEMORY] = f.T, memory
    tile[lanes.MATTER : lanes.MATTER + len(row)] = row[:, None]
    lanes.respond_lanes(kind, tile.reshape(-1), dt)
    fine = tile[lanes.FINE] == 1
    assert fine.all() if size < 0.05 else size > 1 or fine.any()
    assert not (fine.all() and size > 1)
    flowed = f.copy()
    tau, still = np.zeros((lanes.LANES, 6), np.float32), np.zeros((lanes.LANES, 9), np.float32)
    for p in range(lanes.LANES):
        respond(p, np.full(lanes.LANES, kind, np.uint8), np.tile(row, (lanes.LANES, 1)), flowed, tau, memory, still, dt)
    eps = np.finfo(np.float32).eps
    # The other way takes logarithms of volumes near 1 of jelly, and loses digits of small strain there.
    lost = eps * material.youngs_modulus * (material.model == "elastic")
    stress = tile[lanes.MADE + lanes.TAU : lanes.MADE + lanes.MEMORY].T
    assert np.abs(stress - tau)[fine].max(initial=0) <= 50 * eps * np.abs(tau).max() + lost
    rows = tile[lanes.FLOWED : lanes.FLOWED + 9].T
    assert np.abs(rows - flowed)[fine].max(initial=0) <= 60 * eps * max(np.abs(f).max(), np.abs(flowed).max())
    assert (rows[fine] == f[fine]).all() or np.abs(flowed - f)[fine].max() > 0
    assert np.abs(tile[lanes.MADE + lanes.MEMORY] - memory)[fine].max(initial=0) < 10 * eps * (1 + size)


@pytest.mark.parametrize("name", ["water", "honey"])
def test_sixteen_particles_of_a_fluid_do_as_each_alone(name):
    material, rng = MATERIALS[name], np.random.default_rng(8)
    row, dt, size = np.float32(material.row()), np.float32(1e-3), lanes.LANES
    memory = np.linspace(0.3, 1.1, size, dtype=np.float32)
    gradient = rng.normal(size=(size, 9)).astype(np.float32)
    tile = np.zeros((lanes.ROWS, size), np.float32)
    tile[lanes.STRAIN + lanes.MEMORY], tile[lanes.MATTER : lanes.MATTER + len(row)] = memory, row[:, None]
    for k in range(9):
        tile[lanes.MOTION + 4 + 4 * (k % 3) + k // 3] = gradient[:, k]
    lanes.respond_lanes(MODELS["fluid"], tile.reshape(-1), dt)
    fine, tau = tile[lanes.FINE] == 1, np.zeros((size, 6), np.float32)
    assert fine.any() and not fine.all()
    for p in range(size):
        kinds, rows, still = np.full(size, MODELS["fluid"], np.uint8), np.tile(row, (size, 1)), np.zeros_like(gradient)
        respond(p, kinds, rows, still, tau, memory, gradient, dt)
    stress = tile[lanes.MADE + lanes.TAU : lanes.MADE + lanes.MEMORY].T
    assert np.abs(stress - tau)[fine].max() <= 1e-5 * np.abs(tau[fine]).max()
    assert np.abs(tile[lanes.MADE + lanes.MEMORY] - memory)[fine].max() < 1e-6


def energy_of(material, f: np.ndarray) -> float:
    first, mu = material.moduli()
    s = np.linalg.svd(f)[1]
    j, log = s.prod(), np.log(s)
    if material.model == "elastic":
        return 0.5 * mu * ((s**2).sum() - 3) - mu * np.log(j) + 0.5 * first * np.log(j) ** 2
    if material.model == "corotated":
        return mu * ((s - 1) ** 2).sum() + 0.5 * first * (j - 1) ** 2
    return mu * (log**2).sum() + 0.5 * first * log.sum() ** 2  # Hencky


@pytest.mark.parametrize("name", ["jelly", "rubber", "elastic", "metal"])
def test_stress_is_the_slope_of_the_energy(name):
    material = make_material(name, {"yield_stress": 1e12} if name == "metal" else None)
    for f in gradients(0, 0.2):
        f = f.astype(np.float32).astype(float)
        slope = np.zeros((3, 3))
        for i in range(3):
            for k in range(3):
                step = np.zeros((3, 3))
                step[i, k] = 1e-5
                slope[i, k] = (energy_of(material, f + step) - energy_of(material, f - step)) / 2e-5
        expected = slope @ f.T
        assert np.abs(stress(material, f)[0] - expected).max() < 2e-5 * max(
            np.abs(expected).max(), material.youngs_modulus
        )


@pytest.mark.parametrize("name", list(MATERIALS))
def test_stress_turns_with_the_matter(name):
    material = MATERIALS[name]
    turn = Rotation.from_rotvec([0.5, -1.1, 0.4]).as_matrix()
    velocity = np.random.default_rng(1).normal(size=(3, 3)) * 20
    for f in gradients(2, 0.1, 10):
        a, fa, ma = stress(material, f, start(material), velocity)
        b, fb, mb = stress(material, turn @ f, start(material), turn @ velocity @ turn.T)
        assert np.abs(turn @ a @ turn.T - b).max() < 3e-4 * max(np.abs(a).max(), 1.0)
        if material.model != "fluid":
            assert np.abs(turn @ fa - fb).max() < 1e-5
        assert ma == pytest.approx(mb, abs=1e-5)


@pytest.mark.parametrize("name", SOLID)
def test_matter_at_rest_has_no_stress_and_small_strain_is_hookes(name):
    material = MATERIALS[name]
    tau, f, _ = stress(material, np.eye(3), start(material))
    assert np.abs(tau).max() < 1e-6 * material.youngs_modulus
    assert np.abs(f - np.eye(3)).max() < 1e-6
    if name == "sand":
        return  # bears no tension
    strain = 1e-3 * np.array([[1.0, 0.4, 0.1], [0.4, -0.5, 0.2], [0.1, 0.2, 0.3]])
    first, mu = material.moduli()
    expected = 2 * mu * strain + first * np.trace(strain) * np.eye(3)
    assert (
        np.abs(stress(material, np.eye(3) + strain, start(material))[0] - expected).max()
        < 0.02 * np.abs(expected).max()
    )


@pytest.mark.parametrize("name", ["metal", "clay"])
def test_metal_flows_on_its_yield_surface(name):
    material = make_material(name, {"hardening": 0.0})
    for f in gradients(3, 0.3):
        tau, left, plastic = stress(material, f)
        deviator = tau - np.trace(tau) / 3 * np.eye(3)
        assert np.linalg.norm(deviator) <= math.sqrt(2 / 3) * material.yield_stress * (1 + 1e-3)
        assert plastic > 0
        assert np.linalg.det(left) == pytest.approx(np.linalg.det(f), rel=1e-4)  # volume is kept in flow


@pytest.mark.parametrize("steps", [1, 50])
def test_metal_squeezed_yields_at_its_yield_stress_and_hardens_by_its_modulus(steps):
    """Axial strain e at constant volume: below yield the stress is 3 mu e, above it Y + H x plastic strain."""
    material = make_material("metal", {"youngs_modulus": 1e7, "poisson": 0.3, "yield_stress": 1e5, "hardening": 2e6})
    mu = material.moduli()[1]

    def squeezed(strain: float) -> tuple[float, float]:
        f, plastic, part = np.eye(3), 0.0, np.diag(np.exp(strain / steps * np.array([-1, 0.5, 0.5])))
        for _ in range(steps):
            tau, f, plastic = stress(material, part @ f, plastic)
        return float(tau[1, 1] - tau[0, 0]), plastic

    limit = 1e5 / (3 * mu)
    bears, plastic = squeezed(0.95 * limit)
    assert bears == pytest.approx(0.95e5, rel=1e-3) and plastic == 0
    for strain in (2 * limit, 10 * limit):
        bears, plastic = squeezed(strain)
        assert plastic == pytest.approx((3 * mu * strain - 1e5) / (3 * mu + 2e6), rel=2e-3)
        assert bears == pytest.approx(1e5 + 2e6 * plastic, rel=2e-3)


def test_hardening_strengthens_and_viscosity_delays():
    shear = np.array([[1, 0.2, 0], [0, 1, 0], [0, 0, 1.0]])
    norms = {}
    for name, numbers in {
        "plain": {}, "hard": {"hardening": 1e6}, "slow": {"viscosity": 1e5}, "soft": {"hardening": -1e5},
    }.items():  # fmt: skip
        common = {"yield_stress": 4e4, "hardening": 0.0, "youngs_modulus": 1e6}
        tau = stress(make_material("metal", common | numbers), shear, 0.05)[0]
        norms[name] = np.linalg.norm(tau - np.trace(tau) / 3 * np.eye(3))
    assert norms["soft"] < norms["plain"] < norms["hard"]
    assert norms["plain"] < norms["slow"]


def test_sand_bears_shear_in_proportion_to_pressure_and_no_tension():
    material = make_material("sand", {"friction_angle": 30.0})
    sine = math.sin(math.radians(30))
    seen = 0
    for f in gradients(4, 0.02, 200):
        f = f * 0.985
        tau, left, _ = stress(material, f)
        pressure = -np.trace(tau) / 3
        shear = np.linalg.norm(tau + pressure * np.eye(3))
        assert pressure >= -1e-3 * material.youngs_modulus * 1e-3
        assert shear <= math.sqrt(2 / 3) * 6 * sine / (3 - sine) * pressure * 1.01 + 1e-3
        seen += shear > 0.9 * math.sqrt(2 / 3) * 6 * sine / (3 - sine) * pressure
    assert seen > 20
    tau, left, memory = stress(material, np.eye(3) * 1.05)
    assert np.abs(tau).max() == 0 and memory == pytest.approx(3 * math.log(1.05), rel=1e-4)
    assert np.abs(left - np.eye(3)).max() < 1e-6
    # Closing the gap again raises no pressure before it is closed.
    tau, _, memory = stress(material, np.eye(3) * 0.97, memory)
    assert np.abs(tau).max() == 0 and memory > 0


def test_snow_crushes_hardens_and_tears():
    snow = MATERIALS["snow"]
    _, elastic, plastic = stress(snow, np.eye(3) * 0.9, 1.0)
    assert np.allclose(np.diag(elastic), 1 - snow.compression, atol=1e-5)
    assert plastic < 1
    packed = stress(snow, np.eye(3) * 0.99, plastic)[0]
    fresh = stress(snow, np.eye(3) * 0.99, 1.0)[0]
    assert -np.trace(packed) > -1.5 * np.trace(fresh)
    _, elastic, torn = stress(snow, np.eye(3) * 1.1, 1.0)
    assert np.allclose(np.diag(elastic), 1 + snow.stretch, atol=1e-5) and torn > 1


def test_water_pushes_back_and_honey_resists_shear():
    water, honey = MATERIALS["water"], MATERIALS["honey"]
    squeezed, _, j = stress(water, np.eye(3), 1.0, -np.eye(3) * 10, 1e-3)
    assert j == pytest.approx(1 - 30e-3)
    assert -squeezed[0, 0] == pytest.approx(2e5 / 0.6 / 7 * (j**-7 - 1) * j, rel=1e-4)
    shear = np.array([[0, 4.0, 0], [0, 0, 0], [0, 0, 0]])
    assert stress(honey, np.eye(3), 1.0, shear)[0][0, 1] == pytest.approx(honey.viscosity * 4.0, rel=1e-4)
    assert stress(water, np.eye(3), 1.0, shear)[0][0, 1] == 0


@pytest.mark.parametrize("name", list(MATERIALS))
def test_wild_deformation_stays_finite(name):
    material = MATERIALS[name]
    rng = np.random.default_rng(5)
    for f in [*(rng.normal(size=(20, 3, 3)) * 3), np.zeros((3, 3)), np.diag([1, 1, 0.0]), np.diag([1, 1, -1.0])]:
        tau, left, memory = stress(material, f, start(material))
        assert np.isfinite(tau).all() and np.isfinite(left).all() and math.isfinite(memory)


#: An integer that no float holds.
LONG = 10**340


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ({"material": "jello"}, "there is no material 'jello'.*jelly"),
        ({"material": {"name": "jelly", "poisson": 0.5}}, "poisson: is 0.5.*0.49"),
        ({"material": {"name": "jelly", "youngs_modulus": 0}}, "youngs_modulus: is 0.*from 1 to"),
        ({"material": {"name": "jelly", "colour": 1}}, "colour: is not a setting"),
        ({"material": {"name": "jelly", "young": 1e5}}, "material, young: is now youngs_modulus. Write youngs_modulus"),
        ({"resolution": 3}, "resolution: is 3.*from 4 to 400"),
        ({"gravity": [0, 1]}, "gravity.*three numbers"),
        ({"gravity": [0, 1, "nan"]}, "gravity.*three numbers"),
        ({"domain": [[0, 0, 0], [1, 1, 0]]}, "two corners"),
        ({"pins": [{}]}, "pins 1: names no part"),
        ({"colliders": [{"friction": 1}]}, "colliders 1: names no mesh"),
        ({"walls": "soft"}, "walls.*separate"),
        ({"frames": 3}, "frames: is not a setting"),
        ({"first": 5, "last": 4}, "ends at frame 4"),
        ({"matrix_world": [[0] * 4] * 4}, "can be inverted"),
        ([], "not a JSON object"),
        ({"material": {"name": "jelly", "density": LONG}}, r"density: is 10+\.\.\."),
        ({"material": {"name": "jelly", "hardening": 1e300}}, r"hardening: is 1e\+300"),
        ({"fps": LONG}, r"fps: is 10+\.\.\.\. Give a number from 0.1 to 10000"),
        ({"floor": 1e300}, "floor: is 1e.*from -1e"),
        ({"gravity": [LONG, 0, 0]}, "gravity: is .*three numbers from -1e"),
        ({"gravity": [0, 0, 1e308]}, "gravity: is .*three numbers from -1e"),
        ({"gravity": ["1", 0, 0]}, "gravity: is .*three numbers"),
        ({"gravity": [True, 0, 0]}, "gravity: is .*three numbers"),
        ({"velocity": [1e300, 0, 0]}, "velocity: is .*three numbers"),
        ({"pins": [{"box": [[LONG, 0, 0], [1, 1, 1]]}]}, "pins 1, box: is .*two corners"),
        ({"domain": [[-1e300] * 3, [1e300] * 3]}, "domain: is .*two corners.*metres from -1e"),
        ({"fields": [{"kind": "wind", "frames": [[LONG] * 8]}]}, "fields 1, frames: is .*rows of 8 numbers"),
        ({"fields": [{"kind": "wind", "strength": 1e308}]}, "fields 1, strength: is 1e"),
        ({"matrix_world": [[1e200, 0, 0, 0], [0, 1e200, 0, 0], [0, 0, 1e200, 0], [0, 0, 0, 1]]}, "can be inverted"),
        ({"matrix_world": [[LONG, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, "matrix_world: is"),
        ({"matrix_world": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [5, 5, 5, 0]]}, "last row is 0 0 0 1"),
        ({"colliders": [{"mesh": "a\0b.obj"}]}, "colliders 1, mesh: is .*the path of a file"),
        ({"colliders": [{"mesh": "a\ud800.obj"}]}, "colliders 1, mesh: is .*the path of a file"),
        ({"motion": "\0"}, "motion: is .*the path of a file"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_settings_that_cannot_be_are_named(data, said):
    with pytest.raises(UsageError, match=said):
        parse_settings(data)


def test_extreme_stiffness_is_possible():
    assert make_material("jelly", {"youngs_modulus": 2e9}).wave_speed() == pytest.approx(1640, rel=0.01)
