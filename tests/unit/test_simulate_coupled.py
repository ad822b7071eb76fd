"""Bodies that push each other: momentum, friction, bits, caches that belong together, and what is refused."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import igl
import numpy as np
import pytest
import trimesh
from coupled_cases import Slope, balls, mean_velocity, mesh_of, momentum
from scipy.spatial import cKDTree
from simulation_cases import aligned, lattice, masses, solver_of

from drgs_blender.cli.main import main
from drgs_blender.compute.threads import get_num_threads, use_threads
from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.model import Asset
from drgs_blender.core.errors import AssetError, Cancelled, UsageError
from drgs_blender.core.particle_cache import ParticleCache
from drgs_blender.deform.attach import attach
from drgs_blender.simulation.bake import bake
from drgs_blender.simulation.coupled import Coupled, Touch
from drgs_blender.simulation.coupled_bake import bake_coupled
from drgs_blender.simulation.coupled_job import prepare_coupled
from drgs_blender.simulation.coupled_settings import parse_coupled
from drgs_blender.simulation.job import prepare

FRAME = 1 / 24


def box(size: tuple[float, float, float], at: tuple[float, float, float], levels: int = 1):
    shape = trimesh.creation.box(size)
    for _ in range(levels):
        shape = shape.subdivide()
    shape.apply_translation(at)
    return mesh_of(shape)


#: A block of jelly above one of sand on a floor.
MESHES = [box((0.4, 0.3, 0.3), (0, 0, 0.36)), box((0.5, 0.5, 0.2), (0, 0, 0.1))]
SOFT = {"name": "jelly", "youngs_modulus": 2e4}
SCENE = {
    "resolution": 8, "floor": 0.0, "last": 5, "fps": 24,
    "bodies": [
        {"name": "top", "asset": "top.drgs", "material": SOFT, "velocity": [0, 0, -1]},
        {"name": "pile", "asset": "pile.drgs", "material": "sand"},
    ],
}  # fmt: skip


def job_of(folder: Path, **more):
    return prepare_coupled(MESHES, parse_coupled(SCENE | more, folder=folder, out=folder))


def caches_of(job):
    return [ParticleCache(body.out) for body in job.bodies]


def run(folder: Path, **more):
    options = {key: more.pop(key) for key in ("overwrite", "cancelled", "progress") if key in more}
    job = job_of(folder, **more)
    return bake_coupled(job, caches_of(job), **options)


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.glob("*/frame_*"))}


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    assert run(folder) == 4
    return folder


@pytest.mark.parametrize("contact", ["separate", "slip", "sticky"])
def test_impulses_are_equal_and_opposite(contact):
    coupled = balls(0.1, aside=0.2, contact=contact, youngs_modulus=1e5)
    before, turning = momentum(coupled)
    scale = sum(masses(body).sum() for body in coupled.bodies)  # at 1 m/s each
    for _ in range(8):
        coupled.advance(FRAME)
    after, turned = momentum(coupled)
    assert np.abs(mean_velocity(coupled.bodies[0]) - [1, 0, 0]).max() > 0.3, "they have met"
    assert np.linalg.norm(after - before) < 1e-6 * scale
    assert np.linalg.norm(turned - turning) < 1e-5 * scale


def test_equal_balls_exchange_velocities_and_do_not_overlap():
    coupled = balls(0.06)
    one, other = coupled.bodies
    closest = np.inf
    for _ in range(8):
        coupled.advance(FRAME / 2)
        closest = min(closest, float(cKDTree(one.points).query(other.points)[0].min()))
    assert -1 < mean_velocity(one)[0] < -0.8 and 0.8 < mean_velocity(other)[0] < 1
    assert closest > 0.4 * one.domain.spacing, "half a cell lies between particles of surfaces that touch"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("degrees", "friction", "contact"),
    [(20, 0.0, "separate"), (20, 0.2, "separate"), (30, 0.3, "separate"), (20, 0.5, "separate"), (20, 0.5, "slip")],
)
def test_a_block_slides_on_a_leaning_body_as_coulomb_says(degrees, friction, contact):
    slope, angle = Slope(degrees, 0.05, contact, friction), np.radians(degrees)
    for _ in range(8):
        slope.coupled.advance(FRAME)
    pull = np.sin(angle) - (friction if contact == "separate" else 0.0) * np.cos(angle)
    exact = 0.5 * slope.gravity * max(0.0, pull) * (8 * FRAME) ** 2
    assert slope.slid() == pytest.approx(exact, abs=0.003)
    assert abs(slope.lifted()) < 0.1 * 0.05, "it stays on it"


@pytest.mark.slow
@pytest.mark.parametrize(("contact", "hangs"), [("separate", False), ("slip", True), ("sticky", True)])
def test_what_slips_or_sticks_does_not_leave(contact, hangs):
    slope = Slope(20, 0.05, contact, up=True)
    for _ in range(4):
        slope.coupled.advance(FRAME)
    free = 0.5 * slope.gravity * np.cos(np.radians(20)) * (4 * FRAME) ** 2
    assert (abs(slope.lifted()) < 0.005) if hangs else slope.lifted() == pytest.approx(free, rel=0.05)
    assert (abs(slope.slid()) < 0.002) == (contact == "sticky")


def test_a_pinned_body_gives_way_to_nothing():
    h = 0.1
    domain = aligned((-0.5, -0.5, -0.5), (1, 1, 1.5), h)
    plate, block = lattice((0.6, 0.6, 0.2), h / 2), np.add(lattice((0.3, 0.3, 0.3), h / 2), [0.15, 0.15, 0.2])
    held = solver_of(plate, h, domain=domain, pinned=np.ones(len(plate), bool), gravity=(0, 0, -9.81))
    lying = solver_of(block, h, domain=domain, gravity=(0, 0, -9.81), damping=5)
    coupled = Coupled([held, lying])
    for _ in range(24):
        coupled.advance(FRAME)
    assert np.array_equal(held.points, plate)
    assert lying.points[:, 2].min() > 0.2 + h / 4 - 0.1 * h


def test_bits_do_not_depend_on_threads(tmp_path, whole):
    before = get_num_threads()
    for count in (1, 2, 3):
        use_threads(count)
        try:
            run(tmp_path / str(count))
        finally:
            use_threads(before)
        assert content(tmp_path / str(count)) == content(whole)


def test_bodies_push_each_other(whole, tmp_path):
    """Each is elsewhere than it is alone."""
    job = job_of(tmp_path)
    for i, (body, mesh) in enumerate(zip(job.bodies, MESHES, strict=True)):
        alone = ParticleCache(tmp_path / body.name)
        bake(prepare(mesh, job.jobs[i].settings), alone)
        together = ParticleCache(whole / body.name)
        assert np.abs(alone.read(5).vertices - together.read(5).vertices).max() > 0.02
    top, pile = (ParticleCache(whole / name) for name in ("top", "pile"))
    surface = np.array(top.read(5).vertices, np.float64), np.asarray(MESHES[0].faces)
    depth = -igl.signed_distance(np.array(pile.read(5).points, np.float64), *surface)[0].min()
    assert depth < 0.25 * 0.5 / 8, "no grain is in the jelly, by a quarter of a cell"


def test_a_coupled_bake_goes_on_with_the_same_bits(tmp_path, whole):
    assert run(tmp_path, last=3) == 2
    assert run(tmp_path, last=3) == 0
    assert run(tmp_path) == 2
    assert content(tmp_path) == content(whole)
    assert run(tmp_path, last=3) == 0, "a part of what is there"


def test_a_frame_that_is_cut_off_is_named_and_baked_anew(tmp_path, whole, caplog):
    run(tmp_path)
    path = ParticleCache(tmp_path / "pile").path(3)
    path.write_bytes(path.read_bytes()[:500])
    assert run(tmp_path) == 4
    assert "pile" in caplog.text and "frame 3" in caplog.text
    assert content(tmp_path) == content(whole)


def test_frames_outlive_their_state(tmp_path, whole, caplog):
    """A state that is damaged costs nothing where all is there, and is told where all begins again."""
    run(tmp_path)
    (tmp_path / "top" / "state.drgp").write_bytes(b"gone")
    kept = {path: path.read_bytes() for path in tmp_path.rglob("frame_*")}
    assert run(tmp_path) == 0 and kept == {path: path.read_bytes() for path in tmp_path.rglob("frame_*")}
    ParticleCache(tmp_path / "pile").path(5).unlink()
    assert run(tmp_path) == 4 and "its state is missing or damaged" in caplog.text
    assert content(tmp_path) == content(whole)


def test_headers_say_which_lattice_particles_fill_also_those_of_an_earlier_version(tmp_path, whole):
    """Without it nothing that is torn is closed; baking again, which computes nothing anew, brings it."""
    wanted = [ParticleCache(whole / name).header().cells for name in ("top", "pile")]
    assert None not in wanted
    run(tmp_path)
    for name in ("top", "pile"):
        cache = ParticleCache(tmp_path / name)
        cache.describe(replace(cache.header(), cells=None))
    assert run(tmp_path) == 0
    assert [ParticleCache(tmp_path / name).header().cells for name in ("top", "pile")] == wanted
    assert content(tmp_path) == content(whole)


def test_a_cancelled_coupled_bake_keeps_its_frames(tmp_path, whole):
    top = ParticleCache(tmp_path / "top")
    with pytest.raises(Cancelled):
        run(tmp_path, cancelled=lambda: len(top.frames()) >= 3)
    assert top.frames() == ParticleCache(tmp_path / "pile").frames() == [1, 2, 3]
    assert run(tmp_path) == 2
    assert content(tmp_path) == content(whole)


def write_assets(folder: Path) -> None:
    for name, mesh in zip(("top", "pile"), MESHES, strict=True):
        surfels, binding, _ = attach(mesh)
        write_asset(folder / f"{name}.drgs", Asset(surfels, mesh, binding))


@pytest.mark.slow
def test_kill_9_at_any_time_leaves_caches_that_go_on_with_the_same_bits(tmp_path, whole):
    write_assets(tmp_path)
    settings, out = tmp_path / "s.json", tmp_path / "bake"
    given = ["simulate", "--settings", str(settings), "--out", str(out)]
    command = [sys.executable, "-m", "drgs_blender.cli.main", *given]
    for wanted in (1, 2, 4):
        settings.write_text(json.dumps(SCENE | {"last": 1_000_000}))
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=os.environ | {"NUMBA_NUM_THREADS": "2"})
        until = time.monotonic() + 1800
        while len(ParticleCache(out / "pile").frames()) < wanted and time.monotonic() < until:
            assert process.poll() is None
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
        process.wait()
    settings.write_text(json.dumps(SCENE))
    assert main(given) == 0
    baked = content(out)
    for name, data in content(whole).items():
        assert baked[name] == data, name


def test_the_command_line_names_bodies_and_exports_them(tmp_path, whole, capsys):
    write_assets(tmp_path)
    (tmp_path / "s.json").write_text(json.dumps(SCENE))
    given = ["simulate", "--settings", str(tmp_path / "s.json"), "--out", str(tmp_path / "bake")]
    assert main([*given, "--export", str(tmp_path / "all.mdd")]) == 0
    said = capsys.readouterr().out
    assert "2 bodies" in said and "top, pile: frames 1 to 5, 4 of them computed now" in said
    assert content(tmp_path / "bake") == content(whole)
    assert (tmp_path / "top_all.mdd").exists() and (tmp_path / "pile_all.mdd").exists()
    assert main([*given, "--material", "sand"]) == 64
    assert "--material: is an option for one object" in capsys.readouterr().err
    assert main([*given, "--proxy", "hull.ply"]) == 64
    assert "--proxy: is an option for one object" in capsys.readouterr().err
    assert main(["simulate", str(tmp_path / "top.drgs"), *given[1:]]) == 64
    assert main(["simulate", "--out", str(tmp_path / "bake")]) == 64
    assert "ASSET: is not given" in capsys.readouterr().err


def test_a_missing_or_foreign_cache_is_named_and_nothing_is_lost(tmp_path):
    run(tmp_path, last=3)
    kept = content(tmp_path)
    for name in ("top", "pile"):
        aside = tmp_path / f"{name} aside"
        (tmp_path / name).rename(aside)
        with pytest.raises(UsageError, match=rf'body "{name}".* is missing.*belongs to.*Put the folder back'):
            run(tmp_path)
        shutil.copytree(tmp_path / ("pile" if name == "top" else "top"), tmp_path / name)
        with pytest.raises(UsageError, match=rf'body "{name}".* holds another simulation.*--overwrite'):
            run(tmp_path)
        shutil.rmtree(tmp_path / name)
        aside.rename(tmp_path / name)
    assert content(tmp_path) == kept
    with pytest.raises(UsageError, match=r'body "top".* holds another simulation'):
        run(tmp_path, contacts=[{"between": ["pile", "top"], "friction": 0.1}])
    assert run(tmp_path) == 2
    job = job_of(tmp_path)
    with pytest.raises(UsageError, match="holds another simulation"):
        bake(prepare(MESHES[0], job.jobs[0].settings), ParticleCache(tmp_path / "top"))
    shutil.rmtree(tmp_path / "pile")
    assert run(tmp_path, overwrite=True) == 4


def test_a_bake_that_ended_before_its_second_frame_begins_again(tmp_path, whole):
    run(tmp_path, last=2)
    for path in tmp_path.glob("*/frame_000002.drgp"):
        path.unlink()
    shutil.rmtree(tmp_path / "pile")
    (tmp_path / "top" / "state.drgp").unlink()
    assert run(tmp_path) == 4
    assert content(tmp_path) == content(whole)


def test_another_simulation_in_one_of_the_folders_ends_the_bake(tmp_path):
    other, taken = job_of(tmp_path, gravity=[0, 0, -1], last=2), []

    def meanwhile(frame, part):
        if frame == 3 and not taken:
            taken.append(bake(other.jobs[1], ParticleCache(tmp_path / "pile"), overwrite=True))

    with pytest.raises(UsageError, match=r"pile: was given to another simulation"):
        run(tmp_path, progress=meanwhile)


def test_rules_of_pairs():
    a, b = Touch("separate", 0.9), Touch("slip", 0.1)
    assert a.with_other(b) == Touch("slip", pytest.approx(0.3)) == b.with_other(a)
    assert Touch("sticky", 0).with_other(a).contact == "sticky"
    rules = {"contact": "slip", "contacts": [{"between": ["pile", "top"], "contact": "separate", "friction": 0.2}]}
    assert parse_coupled(SCENE | rules, out=Path("x")).touches == {(0, 1): Touch("separate", 0.2)}


def bodies(*changes: dict) -> dict:
    return SCENE | {"bodies": [body | change for body, change in zip(SCENE["bodies"], changes, strict=True)]}


@pytest.mark.parametrize(
    ("scene", "named"),
    [
        (SCENE | {"bodies": []}, r"bodies: is empty"),
        (SCENE | {"bodies": 3}, r"bodies: is 3"),
        (SCENE | {"bodies": SCENE["bodies"][:1] * 2}, r'body "top": is listed twice'),
        (bodies({}, {"name": "top"}), r'body "top": has the name of another'),
        (bodies({"out": "a"}, {"out": "./a"}), r'bodies "top" and "pile": have the same folder'),
        (bodies({"out": "a"}, {"out": "A"}), r'bodies "top" and "pile": have the same folder'),
        (bodies({}, {"name": "../pile"}), r'bodies 2 "../pile": has no folder.*another "name"'),
        (bodies({}, {"name": "a\0b"}), r"bodies 2: has the name 'a.x00b'"),
        (
            SCENE | {"contacts": [{"between": ["top", "pile"]}, {"between": ["pile", "top"]}]},
            r"contacts 2, between: names",
        ),
        (bodies({}, {"fps": 30}), r'bodies "top" and "pile": differ in fps, 24.* and 30'),
        (bodies({}, {"last": 9}), r'bodies "top" and "pile": differ in last, 5 and 9'),
        (bodies({"solver": "rigid"}, {}), r'"top": has the solver rigid.*Choose mpm, or .*collider'),
        (bodies({"velocity": [0, float("nan"), 0]}, {}), r'"top", velocity: is'),
        (bodies({"friction": -1}, {}), r'"top", friction: is -1'),
        (bodies({"asset": 3}, {}), r"bodies 1, asset: is 3"),
        (bodies({"wobble": 3}, {}), r"bodies 1, wobble: is not a setting"),
        (SCENE | {"contacts": [{"between": ["top", "cat"]}]}, r"contacts 1, between: is not two of .*top, pile"),
        (SCENE | {"contacts": [{"between": ["top", "top"]}]}, r"contacts 1, between: is not two"),
        (SCENE | {"contacts": [{"between": [["a"], "top"]}]}, r"contacts 1, between: is not two"),
    ],
)
def test_scenes_that_cannot_be_are_named(scene, named):
    with pytest.raises(UsageError, match=named):
        parse_coupled(scene, "s.json", Path("here"), Path("out"))


def prepared(meshes, **more):
    return prepare_coupled(meshes, parse_coupled(SCENE | more, out=Path("x")))


def test_bodies_that_cannot_be_simulated_together_are_named(caplog):
    inside = box((0.4, 0.3, 0.3), (0, 0, 0.2), 3)
    with pytest.raises(UsageError, match=r'body "pile": overlaps "top" at the start: \d+ of \d+'):
        prepared([inside, MESHES[1]], resolution=16)
    with pytest.raises(UsageError, match=r'body "top": is 1.6 cells long.*largest, "pile", from 8 to 40'):
        prepared([box((0.1, 0.1, 0.1), (0, 0, 0.3)), MESHES[1]])
    flat = mesh_of(trimesh.Trimesh([[0, 0, 1], [1, 0, 1], [0, 1, 1]], [[0, 1, 2]]))
    with pytest.raises(AssetError, match="top: has no interior"):
        prepared([flat, MESHES[1]])
    with pytest.raises(UsageError, match=r"body \"top\", pin 1, group 'feet': is not in the asset"):
        prepare_coupled(MESHES, parse_coupled(bodies({"pins": [{"group": "feet"}]}, {}), out=Path("x")))
    with pytest.raises(UsageError, match=r'body "top", domain: does not contain the body'):
        prepare_coupled(MESHES, parse_coupled(bodies({"domain": [[0, 0, 0], [1, 1, 1]]}, {}), out=Path("x")))
    caplog.clear()
    prepared([box((0.3, 0.3, 0.3), (0, 0, 0.36)), MESHES[1]], device="cuda")
    assert "device cuda: bodies that push each other are simulated on the CPU" in caplog.text
    assert 'body "top": is 4.8 cells long' in caplog.text


def test_the_body_that_overlaps_the_floor_is_named(caplog):
    """Of a few particles, and of more than can be."""
    prepare_coupled(MESHES, parse_coupled(bodies({}, {"floor": 0.01}), out=Path("x")))
    (told,) = (text for text in caplog.messages if "floor or wall" in text)
    assert 'overlaps body "pile" at the start' in told
    with pytest.raises(UsageError, match=r'body "top", floor or wall: overlaps body "top" at the start'):
        prepare_coupled(MESHES, parse_coupled(bodies({"floor": 0.5}, {}), out=Path("x")))


def test_errors_of_a_frame_name_the_body():
    job = prepare_coupled(MESHES, parse_coupled(bodies({}, {"floor": None}), out=Path("x")))
    job.solver.bodies[1].state.x[:, 2] -= 50
    with pytest.raises(UsageError, match=r'body "pile", frame 2: has \d+ particles outside the domain'):
        job.solver.advance(FRAME)


def test_drops_of_one_body_that_leave_the_domain_stop_none_and_are_told_once(tmp_path, caplog):
    """And it goes on with the same bits."""
    domain = {"domain": [[-0.5, -0.5, -0.1], [0.5, 0.5, 0.75]]}

    def wet(folder, last):
        scene = bodies(
            domain | {"material": "water", "velocity": [3, 0, 0], "spin": [0, 9, 0]}, domain | {"velocity": [0, 0, 0]}
        )
        job = prepare_coupled(MESHES, parse_coupled(scene | {"last": last}, out=folder))
        bake_coupled(job, caches_of(job))
        return job

    job = wet(tmp_path / "one", 7)
    lost = [solver.lost for solver in job.solver.bodies]
    assert 0 < lost[0] < len(job.jobs[0].filling.points) / 2 and not lost[1]
    told = [record.getMessage() for record in caplog.records if "left the domain" in record.getMessage()]
    assert len(told) == 1 and told[0].startswith(
        f'body "top": {lost[0]} of {len(job.jobs[0].filling.points)} particles'
    )
    for last in (3, 5, 7):
        wet(tmp_path / "parts", last)
    assert content(tmp_path / "parts") == content(tmp_path / "one")


def test_three_bodies_of_other_matter_keep_their_momentum():
    h = 0.1
    domain = aligned((-0.6, -0.6, -0.6), (2.2, 1, 1), h)
    made = []
    for i, (material, speed) in enumerate((("metal", 2.0), ("water", 0.0), ("sand", -2.0))):
        points = np.add(lattice((0.4, 0.4, 0.4), h / 2), [0.5 * i, 0, 0])
        numbers = {"youngs_modulus": 1e5} if material != "water" else {}
        made.append(solver_of(points, h, material, domain=domain, velocity=(speed, 0, 0), **numbers))
    coupled = Coupled(made, {(0, 2): Touch("sticky")})
    scale = 2 * sum(masses(body).sum() for body in made)
    before = momentum(coupled)[0]
    for _ in range(4):
        coupled.advance(FRAME)
    after = momentum(coupled)[0]
    assert abs(mean_velocity(made[1])[0]) > 0.05 or mean_velocity(made[0])[0] < 1.5, "they have met"
    assert np.linalg.norm(after - before) < 1e-6 * scale
    assert made[0].points[:, 0].mean() < made[1].points[:, 0].mean() < made[2].points[:, 0].mean()


def test_what_moves_one_body_is_part_of_what_all_depend_on(tmp_path):
    """Pins that move otherwise later: frames before stay, those after are another simulation."""
    group = np.flatnonzero(MESHES[0].vertices[:, 2] > 0.45).astype(np.int32)
    MESHES[0].groups["up"] = group
    rise = np.arange(6)[:, None, None] * np.array([0, 0, 0.02])

    def moving(last, far=0.0):
        np.save(tmp_path / "m.npy", (MESHES[0].vertices + rise + far * (np.arange(6) == 5)[:, None, None])[:last])
        scene = bodies({"pins": [{"group": "up"}], "motion": "m.npy", "velocity": [0, 0, 0]}, {}) | {"last": last}
        job = prepare_coupled(MESHES, parse_coupled(scene, folder=tmp_path, out=tmp_path / "bake"))
        return bake_coupled(job, caches_of(job))

    assert moving(3) == 2 and moving(6) == 3 and moving(6) == 0
    top = ParticleCache(tmp_path / "bake" / "top")
    lifted = top.read(6).vertices[group] - MESHES[0].vertices[group]
    assert np.abs(lifted - [0, 0, 0.1]).max() < 0.02
    with pytest.raises(UsageError, match=r'body "top".*holds another simulation'):
        moving(6, far=0.05)
