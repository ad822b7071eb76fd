"""Bakes: frames on disk that survive anything, and what is made of them."""

from __future__ import annotations

import json
import os
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import igl
import numpy as np
import pytest
import trimesh

from drgs_blender.cli.main import main
from drgs_blender.core import particle_cache
from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.model import Asset, Mesh
from drgs_blender.core.errors import AssetError, Cancelled, UsageError, WriteError
from drgs_blender.core.particle_cache import ParticleCache
from drgs_blender.deform.attach import attach
from drgs_blender.simulation import input_digest
from drgs_blender.simulation.bake import bake
from drgs_blender.simulation.job import prepare
from drgs_blender.simulation.settings import parse_settings

DROP = {"resolution": 8, "floor": 0.0, "material": {"name": "jelly", "youngs_modulus": 2e4}, "last": 6}


def block(levels: int = 2) -> Mesh:
    body = trimesh.creation.box((0.5, 0.4, 0.3))
    for _ in range(levels):
        body = body.subdivide()
    n = len(body.vertices)
    left = np.flatnonzero(body.vertices[:, 0] < -0.1).astype(np.int32)
    vertices = np.add(body.vertices, [0, 0, 0.2])
    return Mesh(vertices, body.faces, np.full((n, 3), 0.5), np.full(n, 0.5), np.zeros(n), {"left": left})


def job_of(data: dict | None = None, **more):
    return prepare(block(), parse_settings((data or DROP) | more))


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("frame_*"))}


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A bake that nothing disturbed."""
    folder = tmp_path_factory.mktemp("whole")
    assert bake(job_of(), ParticleCache(folder)) == 5
    return folder


def test_frames_can_be_read_in_any_order(whole):
    cache = ParticleCache(whole)
    assert cache.frames() == [1, 2, 3, 4, 5, 6]
    header = cache.header()
    assert header.first == 1 and header.fps == 24 and header.settings["resolution"] == 8
    rest = cache.rest()
    for frame in (4, 1, 6, 2):
        read = cache.read(frame)
        assert read.points.shape == (header.points, 3) and read.points.dtype == np.float32
        assert read.gradients.shape == (header.points, 3, 3) and read.gradients.dtype == np.float16
        assert read.vertices.shape == (header.vertices, 3) == block().vertices.shape
    assert np.array_equal(cache.read(1).points, rest.points)
    assert cache.read(6).points[:, 2].mean() < rest.points[:, 2].mean() - 0.03
    with pytest.raises(UsageError, match=r"frame 9: is not baked.*1 to 6"):
        cache.read(9)
    assert header.tear == pytest.approx(0.5 / 8), "a cell"
    size = cache.path(3).stat().st_size
    assert size < 31 * header.points + 12 * header.vertices + 1000


def test_between_frames_all_moves_straight(whole):
    cache = ParticleCache(whole)
    rest, before, after = cache.rest(), cache.read(3), cache.read(4)
    particles, vertices = cache.driving(3.25)
    for found, name in ((particles.points, "points"), (particles.gradients, "gradients"), (vertices, "vertices")):
        a, b = (np.asarray(getattr(frame, name), np.float32) for frame in (before, after))
        np.testing.assert_allclose(found, 0.75 * a + 0.25 * b, atol=1e-6)
    np.testing.assert_array_equal(particles.rest, rest.points)
    for outside, edge in ((-7.5, 1), (99.0, 6)):
        np.testing.assert_array_equal(cache.driving(outside)[0].points, cache.read(edge).points)


def test_what_flows_keeps_no_shape(whole):
    header = ParticleCache(whole).header()
    assert header.keeps_shape
    sand = job_of(material="sand", last=2).settings
    regions = job_of(regions=[{"group": "left", "material": "water"}], last=2).settings
    for settings in (sand, regions):
        kept = json.loads(json.dumps(particle_cache.asdict(settings)))
        assert not particle_cache.Header("", 1, 1, 1, 24.0, kept).keeps_shape
    assert not particle_cache.Header("", 1, 1, 1, 24.0).keeps_shape, "it is not known"


def test_a_bake_goes_on_with_the_same_bits(tmp_path, whole):
    cache = ParticleCache(tmp_path)
    assert bake(job_of(last=3), cache) == 2
    assert bake(job_of(last=3), cache) == 0
    assert bake(job_of(), cache) == 3
    assert content(tmp_path) == content(whole)


@pytest.mark.parametrize("solver", ["xpbd", "rigid"])
def test_other_solvers_fill_the_same_cache(tmp_path, solver):
    cache, other = ParticleCache(tmp_path / "a"), ParticleCache(tmp_path / "b")
    bake(job_of(solver=solver), cache)
    bake(job_of(solver=solver, last=3), other)
    bake(job_of(solver=solver), other)
    assert content(tmp_path / "a") == content(tmp_path / "b")
    assert cache.read(6).vertices[:, 2].min() > -0.02


def test_a_cancelled_bake_keeps_its_frames(tmp_path, whole):
    cache, job = ParticleCache(tmp_path), job_of()
    with pytest.raises(Cancelled):
        bake(job, cache, cancelled=lambda: len(cache.frames()) >= 3)
    assert cache.frames() == [1, 2, 3]
    bake(job_of(), cache)
    assert content(tmp_path) == content(whole)


def asset_file(tmp_path: Path) -> Path:
    mesh = block()
    surfels, binding, _ = attach(mesh)
    path = tmp_path / "block.drgs"
    write_asset(path, Asset(surfels, mesh, binding))
    return path


@pytest.mark.slow
def test_kill_9_leaves_a_cache_that_loads_and_goes_on_with_the_same_bits(tmp_path, whole):
    asset, folder = asset_file(tmp_path), tmp_path / "bake"
    (tmp_path / "s.json").write_text(json.dumps(DROP | {"last": 1_000_000}))
    command = [sys.executable, "-m", "drgs_blender.cli.main", "simulate", str(asset), "--settings",
               str(tmp_path / "s.json"), "--out", str(folder)]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=os.environ | {"NUMBA_NUM_THREADS": "2"})
    cache = ParticleCache(folder)
    until = time.monotonic() + 1800  # kernels may be compiled before, on a machine that has other work
    while len(cache.frames()) <= 3 and time.monotonic() < until:
        time.sleep(0.1)
        assert process.poll() is None
    process.send_signal(signal.SIGKILL)
    process.wait()
    seen = cache.frames()
    assert len(seen) > 3
    for frame in seen:
        cache.read(frame)
    (tmp_path / "s.json").write_text(json.dumps(DROP | {"last": 6}))
    assert main(["simulate", str(asset), "--settings", str(tmp_path / "s.json"), "--out", str(folder)]) == 0
    baked = content(folder)
    for name, data in content(whole).items():
        assert baked[name] == data, name


@pytest.mark.parametrize("damage", ["state", "state bytes", "frame missing"])
def test_a_cache_that_lost_something_is_baked_anew(tmp_path, whole, damage):
    cache = ParticleCache(tmp_path)
    bake(job_of(last=4), cache)
    if damage == "state":
        (tmp_path / "state.drgp").unlink()
    elif damage == "state bytes":
        data = bytearray((tmp_path / "state.drgp").read_bytes())
        data[len(data) // 2] ^= 1
        (tmp_path / "state.drgp").write_bytes(data)
    else:
        cache.path(2).unlink()
    assert bake(job_of(), cache) == 5
    assert content(tmp_path) == content(whole)


def test_other_settings_are_not_mixed_in(tmp_path):
    cache = ParticleCache(tmp_path)
    bake(job_of(last=3), cache)
    stiff = {"material": {"name": "jelly", "youngs_modulus": 4e4}, "last": 2}
    with pytest.raises(UsageError, match=r"holds another simulation.*overwrite"):
        bake(job_of(**stiff), cache)
    assert cache.frames() == [1, 2, 3]
    assert bake(job_of(**stiff), cache, overwrite=True) == 1
    assert cache.frames() == [1, 2]


def test_two_bakes_at_once_never_mix_their_frames(tmp_path):
    """Another process begins a bake of other settings in the folder; the first notices before its next frame."""
    cache, first, second = ParticleCache(tmp_path), job_of(), job_of(gravity=[0, 0, 1])
    taken = []

    def meanwhile(frame, part):
        if frame == 4 and not taken:
            taken.append(bake(second, ParticleCache(tmp_path), overwrite=True))

    with pytest.raises(UsageError, match=r"given to another simulation.*one at a time"):
        bake(first, cache, progress=meanwhile)
    assert taken == [5] and cache.header().digest == second.digest
    baked = content(tmp_path)
    bake(job_of(gravity=[0, 0, 1]), ParticleCache(tmp_path / "alone"))
    assert baked == content(tmp_path / "alone")
    assert bake(job_of(gravity=[0, 0, 1]), cache) == 0, "the state is that of the second, too"


def test_a_longer_bake_goes_on_also_where_things_move(tmp_path):
    """What moves later does not change the frames before: no bit of them depends on it."""
    wall = trimesh.creation.box((0.2, 0.6, 0.6))
    wall.apply_translation([0.42, 0, 0.3])
    wall.export(tmp_path / "wall.ply")
    steps = np.arange(6)
    wind = [[0, 0, 0, 1, 0, 0, 100.0 * (f == 5), 0] for f in steps]

    def moving(last, far=0.0):
        aside = 0.02 * steps[:last] + far * (steps[:last] == 5)
        np.save(tmp_path / "wall.npy", wall.vertices - aside[:, None, None] * [1, 0, 0])
        np.save(tmp_path / "body.npy", block().vertices + 0.1 * aside[:, None, None])
        data = {"pins": [{"group": "left"}], "motion": "body.npy", "last": last}
        data |= {"colliders": [{"mesh": "wall.ply", "vertices": "wall.npy"}]}
        data |= {"fields": [{"kind": "wind", "frames": wind[:last]}]}
        return prepare(block(), parse_settings(DROP | data, folder=tmp_path))

    cache, fresh = ParticleCache(tmp_path / "long"), ParticleCache(tmp_path / "fresh")
    assert bake(moving(3), cache) == 2
    assert bake(moving(6), cache) == 3
    assert bake(moving(6), fresh) == 5
    assert content(cache.folder) == content(fresh.folder)
    assert bake(moving(4), cache) == 0, "a part of what is there"
    assert bake(moving(6), cache) == 0
    with pytest.raises(UsageError, match="holds another simulation"):
        bake(moving(6, far=0.05), cache)
    mesh = block()
    mesh.groups["another"] = np.arange(3, dtype=np.int32)
    assert prepare(mesh, parse_settings(DROP)).digest == job_of().digest, "a group that plays no part"
    swapped = block()
    swapped.groups = {"left": mesh.groups["another"], "another": mesh.groups["left"]}
    pins = parse_settings(DROP | {"pins": [{"group": "left"}]})
    assert prepare(swapped, pins).digest != prepare(mesh, pins).digest


def test_the_digest_is_that_of_before_settings_were_renamed(monkeypatch):
    """A bake that began when Young's modulus was called `young` goes on, unless its solver now computes other bits."""
    monkeypatch.setattr(input_digest, "__version__", "0.1.0")
    mesh = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], np.ones((3, 3)), np.ones(3), np.ones(3))
    mesh.groups["left"] = np.arange(2, dtype=np.int32)
    metal = {"group": "left", "material": {"name": "metal", "youngs_modulus": 1e7}}
    settings = parse_settings({"material": {"name": "jelly", "youngs_modulus": 2e4}, "regions": [metal]})
    now = input_digest.digest_of(mesh, settings, [], None)
    monkeypatch.setattr(input_digest, "_ARITHMETIC", {})
    digest = input_digest.digest_of(mesh, settings, [], None)
    assert now != digest == "534207947bffd29dba4777418cae7a0d01096cdc89d0938f9dfc9bb2e5fa43ec"


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"domain": [[-1e5] * 3, [1e5] * 3]}, r"domain: of 2e\+05 x 2e\+05 x 2e\+05 m is too large.*smaller"),
        ({"pins": [{"group": "nobody"}]}, r"pin 1, group 'nobody': contains no particle"),
        ({"colliders": [{"mesh": "box.ply", "vertices": "few.npy"}]}, r"box.ply: has 2 vertices in its anim.*need 8"),
        ({"colliders": [{"mesh": "box.ply", "vertices": "text.npy"}]}, r"text.npy: is no .npy file(?!.*pickle)"),
        ({"colliders": [{"mesh": "box.ply", "vertices": "far.npy"}]}, r"far.npy: does not hold numbers from -1e\+09"),
        ({"motion": "folder"}, r"folder: is not a regular file"),
        ({"motion": "text.npy"}, r"text.npy: is no .npy file"),
        ({"motion": "few.npy"}, r"motion .*few.npy: has shape \(3, 2, 3\), expected \(frames, "),
        ({"motion": "none.npy"}, r"none.npy: cannot be read"),
    ],
)
def test_what_cannot_be_simulated_is_named_with_the_remedy(tmp_path, settings, named):
    trimesh.creation.box((9, 9, 1)).export(tmp_path / "box.ply")
    np.save(tmp_path / "few.npy", np.zeros((3, 2, 3)))
    np.save(tmp_path / "far.npy", np.full((3, 8, 3), 1e300))
    (tmp_path / "text.npy").write_text("hello")
    (tmp_path / "folder").mkdir()
    mesh = block()
    mesh.groups["nobody"] = np.empty(0, np.int32)
    with pytest.raises((UsageError, AssetError), match=named):
        prepare(mesh, parse_settings(DROP | settings, folder=tmp_path))


def test_a_mesh_without_an_inside_is_named_by_its_file(tmp_path, capsys):
    mesh = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], np.ones((3, 3)), np.ones(3), np.ones(3))
    surfels, binding, _ = attach(mesh)
    write_asset(tmp_path / "leaf.drgs", Asset(surfels, mesh, binding))
    assert main(["simulate", str(tmp_path / "leaf.drgs"), "--out", str(tmp_path / "c")]) == 65
    assert "leaf.drgs: has no interior at a particle spacing" in capsys.readouterr().err


def test_damaged_frames_are_named(tmp_path):
    cache = ParticleCache(tmp_path)
    bake(job_of(last=2), cache)
    data = bytearray(cache.path(2).read_bytes())
    data[len(data) // 2] ^= 4
    cache.path(2).write_bytes(data)
    with pytest.raises(AssetError, match=r"frame_000002.*Bake again"):
        cache.read(2)
    cache.path(2).write_bytes(data[:100])
    with pytest.raises(AssetError, match=r"frame_000002.*Bake again"):
        cache.read(2)
    (tmp_path / "cache.json").write_text('{"no": 1}')
    with pytest.raises(AssetError, match=r"cache\.json.*Remove this file, and bake again"):
        cache.header()


def test_a_full_disk_leaves_what_was_baked(tmp_path, monkeypatch):
    cache, job = ParticleCache(tmp_path), job_of()
    written = []
    real = os.fsync

    def full(descriptor):
        written.append(1)
        if len(written) > 12:
            raise OSError(28, "No space left on device")
        real(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(WriteError, match="No space left"):
        bake(job, cache)
    monkeypatch.undo()
    assert len(cache.frames()) >= 2
    assert not list(tmp_path.glob(".*.tmp"))
    assert bake(job_of(), cache) > 0
    assert cache.frames() == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize("material", ["sand", "jelly"])
def test_the_surface_lies_on_what_it_falls_on(tmp_path, material):
    """Matter sinks into a ball and the floor beside it by parts of a cell; its surface does not."""
    ball = trimesh.creation.icosphere(4, 0.25)
    ball.apply_translation([0.1, 0, -0.21])
    ball.export(tmp_path / "ball.ply")
    collider = {"mesh": str(tmp_path / "ball.ply"), "friction": 0.0}
    job = job_of(material={"name": material, "youngs_modulus": 2e4}, colliders=[collider], gravity=[0, 0, -30])
    sunk, rests = 0.0, 0
    for _ in range(8):
        job.solver.advance(1 / 24)
        raw, vertices = job._surface(), job.now().vertices
        outside = [igl.signed_distance(v, ball.vertices, ball.faces)[0] for v in (raw, vertices.astype(float))]
        sunk = min(sunk, raw[:, 2].min(), outside[0].min())
        assert vertices[:, 2].min() > 0 and outside[1].min() > 0
        far = (raw[:, 2] > 0.02) & (outside[0] > 0.02)
        np.testing.assert_allclose(vertices[far], raw[far], atol=1e-6)
        rests += int(np.count_nonzero(outside[1] < 0.002))
    assert sunk < -0.002 and rests > 4, "there was something to lift"


def test_vertex_groups_pin_and_differ(tmp_path):
    regions = [{"group": "left", "material": {"name": "rubber", "youngs_modulus": 3e5, "density": 500}}]
    job = job_of(pins=[{"group": "left"}], regions=regions, floor=None, last=3)
    left = job.filling.points[:, 0] < -0.12
    density = job.solver.body.matter.density
    assert (density[left] == 500).all() and (density[~left & (job.filling.points[:, 0] > -0.03)] == 1000).all()
    for _ in range(4):
        job.solver.advance(1 / 24)
    moved = np.abs(job.solver.points - job.filling.points).max(axis=1)
    assert moved[left].max() < 1e-9 and moved[job.filling.points[:, 0] > 0.15].min() > 1e-3
    assert job.grain == 0 < job_of(material="sand").grain, "grains are what runs"
    assert job_of(material="sand", regions=regions).grain == 0 and job_of(material="sand").tear > job.tear
    with pytest.raises(UsageError, match=r"group 'right'.*There are left"):
        job_of(pins=[{"group": "right"}])
    with pytest.raises(UsageError, match="domain: does not contain the body"):
        job_of(domain=[[0, 0, 0], [1, 1, 1]])


def test_pins_follow_the_animated_mesh(tmp_path):
    mesh = block()
    path = np.stack([np.add(mesh.vertices, [0.02 * f, 0, 0]) for f in range(5)])
    np.save(tmp_path / "motion.npy", path)
    job = job_of(pins=[{"group": "left"}], gravity=[0, 0, 0], motion=str(tmp_path / "motion.npy"), last=5, floor=None)
    bake(job, ParticleCache(tmp_path / "c"))
    left = job.filling.points[:, 0] < -0.12
    assert np.abs((job.solver.points - job.filling.points)[left] - [0.08, 0, 0]).max() < 1e-5


def test_an_object_that_is_placed_moves_in_its_own_space(tmp_path):
    """Turned on its side, moved and half as large: gravity in the world is along its own axis."""
    turn = 0.5 * np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, [3, 2, 1]
    job = job_of(matrix_world=matrix.tolist(), floor=None, last=3)
    assert job.tear == pytest.approx(0.5 / 8), "object space"
    before = job.rest()
    assert np.abs(before.vertices - block().vertices).max() < 1e-6
    job.solver.advance(0.1)
    now = job.now()
    n = job.solver.steps
    fall = -9.81 * 0.1**2 * (n + 1) / (2 * n)
    assert np.abs(now.vertices - before.vertices - np.linalg.inv(turn) @ [0, 0, fall]).max() < 1e-4
    assert np.abs(now.gradients - np.eye(3)).max() < 1e-3


@pytest.mark.parametrize("suffix", [".pc2", ".mdd"])
def test_exports_hold_every_vertex(tmp_path, whole, suffix):
    asset = asset_file(tmp_path)
    (tmp_path / "s.json").write_text(json.dumps(DROP))
    out = tmp_path / f"block{suffix}"
    poses = tmp_path / "v/####.npy"
    code = main(["simulate", str(asset), "--settings", str(tmp_path / "s.json"), "--out", str(tmp_path / "c"),
                 "--export", str(out), "--vertices", str(poses)])  # fmt: skip
    assert code == 0
    data = out.read_bytes()
    n = len(block().vertices)
    if suffix == ".pc2":
        assert struct.unpack("<12s2i2fi", data[:32]) == (b"POINTCACHE2\0", 1, n, 1.0, 1.0, 6)
        moving = np.frombuffer(data[32:], "<f4").reshape(6, n, 3)
    else:
        assert struct.unpack(">2i", data[:8]) == (6, n)
        assert np.frombuffer(data[8:32], ">f4") == pytest.approx(np.arange(6) / 24)
        moving = np.frombuffer(data[32:], ">f4").reshape(6, n, 3)
    cache = ParticleCache(whole)
    for frame in range(1, 7):
        assert np.array_equal(moving[frame - 1], cache.read(frame).vertices)
        assert np.array_equal(np.load(tmp_path / f"v/{frame:04d}.npy"), cache.read(frame).vertices)


@pytest.mark.parametrize("suffix", [".usda", ".usdc"])
def test_mesh_and_particles_are_exported_as_usd(tmp_path, suffix):
    usd = pytest.importorskip("pxr.Usd", reason="usd-core is an optional package")
    from pxr import UsdGeom

    asset, path, out = asset_file(tmp_path), tmp_path / f"block{suffix}", tmp_path / "c"
    matrix = np.diag([2.0, 2, 2, 1])
    matrix[:3, 3] = 1, 2, 3
    (tmp_path / "s.json").write_text(json.dumps(DROP | {"matrix_world": matrix.tolist(), "last": 4}))
    command = ["simulate", str(asset), "--settings", str(tmp_path / "s.json"), "--out", str(out), "--fps", "25"]
    assert main([*command, "--export", str(path)]) == 0
    cache, name = ParticleCache(out), asset.stem
    stage = usd.Stage.Open(str(path))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (1, 4, 25)
    shape, points = (UsdGeom.PointBased(stage.GetPrimAtPath(f"/root/{name}/{of}")) for of in (name, "particles"))
    assert shape.GetPrim().HasAPI("MaterialBindingAPI")
    for frame in (4, 2):
        assert np.array_equal(np.array(shape.GetPointsAttr().Get(frame)), cache.read(frame).vertices)
        assert np.array_equal(np.array(points.GetPointsAttr().Get(frame)), cache.read(frame).points)
    placed = UsdGeom.XformCache(3).GetLocalToWorldTransform(shape.GetPrim()).Transform((1.0, 1.0, 1.0))
    assert tuple(placed) == (3, 4, 5)


def test_options_of_the_command_win_over_the_file(tmp_path, capsys):
    asset = asset_file(tmp_path)
    (tmp_path / "s.json").write_text(json.dumps(DROP | {"material": "sand"}))
    command = ["simulate", str(asset), "--settings", str(tmp_path / "s.json"), "--out", str(tmp_path / "c")]
    code = main(
        [
            *command,
            "--material",
            "rubber",
            "--youngs-modulus",
            "5e4",
            "--gravity",
            "-1,0,-2",
            "--pin",
            "left",
            "--frames",
            "2",
        ]
    )
    assert code == 0
    assert "particles (winding number)" in capsys.readouterr().out
    settings = ParticleCache(tmp_path / "c").header().settings
    assert settings["material"]["name"] == "rubber" and settings["material"]["youngs_modulus"] == 5e4
    assert settings["gravity"] == [-1, 0, -2] and settings["last"] == 2 and settings["pins"][0]["group"] == "left"
    assert main([*command, "--poisson", "0.6"]) == 64
    assert "poisson: is 0.6" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "options", "named"),
    [
        ('{"material": 5}', ["--youngs-modulus", "1e5"], "material: is 5. Give a name"),
        ('{"material": null}', ["--youngs-modulus", "1e5"], "material: is null. Give a name"),
        ('{"material": ["a"]}', ["--youngs-modulus", "1e5"], 'material: is ["a"]. Give a name'),
        ('{"first": "a"}', ["--frames", "1"], 'first: is "a". Give a whole number'),
        ('{"first": null}', ["--frames", "1"], "first: is null. Give a whole number"),
        ('{"pins": 5}', ["--pin", "g"], "pins: is 5. Give a list"),
        ('{"pins": null}', ["--pin", "g"], "pins: is null. Give a list"),
        ('{"pins": "g"}', ["--pin", "g"], 'pins: is "g". Give a list'),
        ('{"pins": {"group": "g"}}', ["--pin", "g"], "Give a list"),
        ('{"colliders": "a.obj"}', ["--collider", "b.obj"], "Give a list"),
        ("{}", ["--velocity", "1e300,0,0"], "velocity: is [1e+300, 0.0, 0.0]. Give three numbers"),
        ("\ufeff[]", [], "is not a JSON object"),
        (json.dumps(DROP).encode("utf-16"), [], "s.json: is UTF-16 text. Save it as UTF-8"),
    ],
)
def test_settings_and_options_that_do_not_fit_are_named(tmp_path, capsys, text, options, named):
    (tmp_path / "s.json").write_bytes(text if isinstance(text, bytes) else text.encode())
    command = ["simulate", "cube.drgs", "--out", str(tmp_path / "c"), "--settings", str(tmp_path / "s.json")]
    assert main([*command, "--resolution", "6", *options]) == 64
    assert named in capsys.readouterr().err


@pytest.mark.skipif(os.name == "nt", reason="pipes are no files there")
@pytest.mark.parametrize("kind", ["fifo", "device"])
def test_settings_are_read_of_regular_files_alone(tmp_path, capsys, kind):
    path = tmp_path / "s.json"
    if kind == "fifo":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    assert main(["simulate", "cube.drgs", "--out", str(tmp_path / "c"), "--settings", str(path)]) == 64
    assert "s.json: is not a regular file" in capsys.readouterr().err


def test_a_frame_that_goes_away_while_it_is_read_is_not_baked(tmp_path, monkeypatch):
    """Another bake that starts over removes frames; Blender, which follows it, waits for the new ones."""
    cache, read = ParticleCache(tmp_path), particle_cache._read
    cache.path(4).write_bytes(b"a frame")

    def late(path):
        path.unlink()
        return read(path)

    monkeypatch.setattr(particle_cache, "_read", late)
    with pytest.raises(UsageError, match="frame 4: is not baked"):
        cache.read(4)
