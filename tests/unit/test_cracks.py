"""What has broken of simulated matter stays broken: in caches, however they came about, and in what is read of them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import trimesh

from drgs_blender.core.asset.container import write_asset
from drgs_blender.core.asset.model import Asset, Mesh
from drgs_blender.core.errors import AssetError, Cancelled
from drgs_blender.core.particle_cache import ParticleCache, ParticleFrame
from drgs_blender.deform.attach import attach
from drgs_blender.deform.bonds import Bonds, Broken
from drgs_blender.simulation.bake import bake
from drgs_blender.simulation.coupled_bake import bake_coupled
from drgs_blender.simulation.coupled_job import prepare_coupled
from drgs_blender.simulation.coupled_settings import parse_coupled
from drgs_blender.simulation.job import prepare
from drgs_blender.simulation.settings import parse_settings

#: How far each end of the bar is pulled, by frame: apart, and back to where it was.
PULLED = np.array([0, 0.1, 0.2, 0.2, 0.1, 0.0, 0.0])
LAST = len(PULLED)
ENDS = [{"box": [[-1, -1, -1], [-0.12, 1, 1]]}, {"box": [[0.12, -1, -1], [1, 1, 1]]}]


def bar() -> Mesh:
    shape = trimesh.creation.box((0.5, 0.2, 0.2)).subdivide().subdivide()
    n = len(shape.vertices)
    return Mesh(shape.vertices, shape.faces, np.full((n, 3), 0.5), np.full(n, 0.5), np.zeros(n))


@pytest.fixture(scope="module")
def motion(tmp_path_factory) -> str:
    """The bar's vertices, pulled in two and pushed together again."""
    path = tmp_path_factory.mktemp("motion") / "pulled.npy"
    rest = bar().vertices.astype(np.float64)
    np.save(path, np.stack([rest + np.sign(rest[:, :1]) * [pulled, 0, 0] for pulled in PULLED]))
    return str(path)


def settings_of(motion: str, last: int = LAST, material="snow", **more) -> dict:
    given = {"material": material, "resolution": 8, "gravity": [0, 0, 0], "pins": ENDS, "motion": motion, "last": last}
    return given | more


def job_of(motion: str, last: int = LAST, **more):
    return prepare(bar(), parse_settings(settings_of(motion, last, **more)))


@pytest.fixture(scope="module")
def torn(tmp_path_factory, motion) -> Path:
    folder = tmp_path_factory.mktemp("torn")
    assert bake(job_of(motion), ParticleCache(folder)) == LAST - 1
    return folder


def content(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted([*folder.glob("frame_*"), folder / "rest.drgp"])}


def bonds_of(cache: ParticleCache) -> tuple[Bonds, float]:
    """Of the particles of a cache, and in cells how far apart they are where they break."""
    header = cache.header()
    bonds = Bonds(cache.rest().points, np.array(header.cells))
    return bonds, header.tear * abs(np.linalg.det(bonds.to_cells[:3, :3])) ** (1 / 3)


def flat(broken: Broken) -> np.ndarray:
    return np.concatenate([part.reshape(-1) for part in broken])


def as_before(folder: Path, version: int = 2) -> ParticleCache:
    """A cache as earlier versions left it."""
    cache = ParticleCache(folder)
    for number in (None, *cache.frames()):
        frame = cache.rest() if number is None else cache.read(number)
        kept = ParticleFrame(*(np.array(array) for array in (frame.points, frame.gradients, frame.vertices)))
        if number is None:
            cache.write_rest(kept)
        else:
            cache.write(number, kept)
    cache.describe(replace(cache.header(), version=version))
    return cache


def test_what_has_broken_stays_so_though_it_is_pushed_together(torn):
    cache = ParticleCache(torn)
    bonds, gap = bonds_of(cache)
    judged, kept = [], []
    for frame in cache.frames():
        read = cache.read(frame)
        judged.append(flat(bonds.broken(bonds.placed(read.points), gap)))
        kept.append(flat(bonds.unpacked(read.broken)))
    assert not kept[0].any() and judged[3].sum() > 20
    assert (judged[3] & ~judged[-1]).sum() > 20, "by where particles are, cracks would have closed"
    for before, after, now in zip(kept, kept[1:], judged[1:]):
        np.testing.assert_array_equal(after, before | now)
    size, particles = cache.path(2).stat().st_size, cache.header().points
    assert len(cache.read(2).broken) < 0.02 * size and particles > 400


def test_bits_are_those_of_every_bond():
    """Also of matter on both sides of a gap, whose cells touch though nothing joins them."""
    places = np.stack(np.meshgrid(*[np.arange(4.0)] * 3, indexing="ij"), -1).reshape(-1, 3)
    places = places[places[:, 0] != 2] + 0.5
    bonds = Bonds(places.astype(np.float32), np.eye(4))
    assert len(bonds.across) and len(bonds.across) < len(places) ** 2 / 4
    p, q = np.divmod(bonds.across, len(places))
    assert (np.sort(places[[p, q], 0], axis=0) == [[1.5], [3.5]]).all(), "from one side of the gap to the other"
    now = bonds.rest + 10.0 * (places[:, :1] > 3) * [1.0, 0, 0]
    broken = bonds.broken(now, 2.0)
    assert broken.across.all() and not broken.up.any()
    generator = np.random.default_rng(1)
    some = Broken(
        (bonds.neighbour[:, 1::2] >= 0) & (generator.random((len(places), 3)) < 0.5),
        generator.random(len(bonds.across)) < 0.5,
    )
    for given, found in zip(some, bonds.unpacked(bonds.packed(some))):
        np.testing.assert_array_equal(given, found)
    bits = bonds.packed(some)
    for wrong in (bits[:-1], np.concatenate([bits, bits[:1]]), bits.astype(np.int32), bits[None]):
        with pytest.raises(ValueError, match="bonds"):
            bonds.unpacked(wrong)


@pytest.mark.parametrize("stopped", range(2, LAST))
def test_a_bake_that_was_interrupted_has_the_same_bits(tmp_path, torn, motion, stopped):
    """Wherever it stopped, and with a state that is older than the frames, as after kill -9."""
    cache = ParticleCache(tmp_path)
    with pytest.raises(Cancelled):
        bake(job_of(motion), cache, cancelled=lambda: len(cache.frames()) >= stopped)
    state = (tmp_path / "state.drgp").read_bytes()
    if stopped + 1 < LAST:
        with pytest.raises(Cancelled):
            bake(job_of(motion), cache, cancelled=lambda: len(cache.frames()) >= stopped + 1)
        (tmp_path / "state.drgp").write_bytes(state)
    assert bake(job_of(motion), cache) == LAST - stopped
    assert content(tmp_path) == content(torn)


@pytest.mark.slow
def test_kill_9_at_any_time_loses_no_crack(tmp_path, torn, motion):
    mesh = bar()
    surfels, binding, _ = attach(mesh)
    write_asset(tmp_path / "bar.drgs", Asset(surfels, mesh, binding))
    (tmp_path / "s.json").write_text(json.dumps(settings_of(motion)))
    folder = tmp_path / "bake"
    cache = ParticleCache(folder)
    command = [sys.executable, "-m", "drgs_blender.cli.main", "simulate", str(tmp_path / "bar.drgs"), "--settings",
               str(tmp_path / "s.json"), "--out", str(folder)]  # fmt: skip
    until = time.monotonic() + 1800
    for frame in (2, 4, 6):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=os.environ | {"NUMBA_NUM_THREADS": "2"})
        while len(cache.frames()) < frame and process.poll() is None and time.monotonic() < until:
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
        process.wait()
        for there in cache.frames():
            assert cache.read(there).broken is not None
    subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
    kept, whole = ParticleCache(folder), ParticleCache(torn)
    for frame in whole.frames():
        np.testing.assert_array_equal(kept.read(frame).broken, whole.read(frame).broken)


@pytest.mark.parametrize("version", [1, 2])
def test_caches_of_earlier_versions_open_and_are_brought_up_to_date(tmp_path, torn, motion, version):
    bake(job_of(motion), ParticleCache(tmp_path))
    cache = as_before(tmp_path, version)
    particles, _ = cache.driving(4)
    assert particles.broken is None and cache.rest().broken is None
    assert bake(job_of(motion), cache) == 0, "nothing is simulated again"
    assert content(tmp_path) == content(torn) and cache.header() == ParticleCache(torn).header()


def test_an_earlier_cache_goes_on_from_what_had_broken(tmp_path, torn, motion, caplog):
    bake(job_of(motion, 4), ParticleCache(tmp_path))
    assert bake(job_of(motion), as_before(tmp_path)) == LAST - 4
    assert content(tmp_path) == content(torn)
    cache = as_before(tmp_path)
    data = bytearray(cache.path(1).read_bytes())
    data[len(data) // 2] ^= 4
    cache.path(1).write_bytes(data)
    assert bake(job_of(motion), cache) == LAST - 1 and "damaged; begins again" in caplog.text
    assert content(tmp_path) == content(torn)


def test_between_frames_what_breaks_is_broken(torn):
    """So that a crack opens from nothing; whatever was read before."""
    cache = ParticleCache(torn)
    for at in (6.5, 2.25, 7.0, -3.0, 1.0, 3.999, 2.0, 99.0):
        wanted = cache.read(int(np.clip(np.ceil(at), 1, LAST))).broken
        particles, _ = cache.driving(at)
        np.testing.assert_array_equal(particles.broken, wanted)
        assert particles.broken.base is None, "not of a file that another bake may remove"


def test_frames_whose_bits_are_damaged_are_named(tmp_path, torn, motion, caplog):
    cache = ParticleCache(tmp_path)
    bake(job_of(motion), cache)
    whole = cache.read(5)
    loaded = [np.array(a) for a in (whole.points, whole.gradients, whole.vertices)]
    for broken, told in (
        (whole.broken[:-9], "does not say of"),
        (np.append(whole.broken, 0).astype(np.uint8), r"has \d+ bytes of what has broken, \d+ at rest"),
        (whole.broken.astype(np.int16), "does not say of"),
        (None, r"has 0 bytes of what has broken, \d+ at rest"),
    ):
        given = None if broken is None else np.array(broken)
        cache.write(5, ParticleFrame(*loaded, given))
        with pytest.raises(AssetError, match=rf"frame_000005.*{told}.*Bake again"):
            cache.driving(4.5)
        cache.driving(4.0)
    cache.path(5).write_bytes(cache.path(4).read_bytes()[:-600])
    with pytest.raises(AssetError, match=r"frame_000005.*Bake again"):
        cache.driving(5)
    assert bake(job_of(motion), cache) == LAST - 1 and "frame 5 is missing or damaged" in caplog.text
    assert content(tmp_path) == content(torn)


def test_the_frame_from_which_a_bake_goes_on_is_read(tmp_path, torn, motion, caplog):
    """One flipped bit of what had broken would be in all frames after it."""
    cache = ParticleCache(tmp_path)
    bake(job_of(motion, 4), cache)
    data = bytearray(cache.path(4).read_bytes())
    data[-500] ^= 1
    cache.path(4).write_bytes(data)
    assert bake(job_of(motion), cache) == LAST - 1 and "frame 4 is missing or damaged" in caplog.text
    assert content(tmp_path) == content(torn)


@pytest.mark.parametrize(
    "given", [{"material": "sand"}, {"material": "water"}, {"solver": "rigid", "material": "jelly"}]
)
def test_what_cannot_break_keeps_nothing(tmp_path, motion, given):
    cache = ParticleCache(tmp_path)
    bake(job_of(motion, 2, **given), cache)
    assert cache.read(2).broken is None and cache.driving(1.5)[0].broken is None


def test_bodies_of_several_materials_keep_what_has_broken_where_none_flows(tmp_path, motion):
    for material, keeps in (("clay", True), ("sand", False)):
        cache = ParticleCache(tmp_path / material)
        bake(job_of(motion, 3, regions=[ENDS[0] | {"material": material}]), cache)
        assert cache.header().breaks == keeps
        assert all((cache.read(frame).broken is not None) == keeps for frame in cache.frames())


def test_coupled_bodies_each_know_what_has_broken(tmp_path, torn, motion):
    scene = {
        "bodies": [
            {"name": "bar", "asset": "a.drgs"} | settings_of(motion),
            {"name": "heap", "asset": "b.drgs", "material": "sand", "gravity": [0, 0, 0]},
        ]
    }
    last = scene["bodies"][0].pop("last")
    resolution = scene["bodies"][0].pop("resolution")
    far = bar()
    far.vertices[:] = far.vertices + np.float32([0, 1, 0])

    def run(folder, last):
        parsed = parse_coupled(scene | {"last": last, "resolution": resolution}, folder=folder, out=folder)
        job = prepare_coupled([bar(), far], parsed)
        return bake_coupled(job, [ParticleCache(body.out) for body in job.bodies])

    assert run(tmp_path / "whole", last) == LAST - 1
    cache, heap = ParticleCache(tmp_path / "whole/bar"), ParticleCache(tmp_path / "whole/heap")
    bonds, gap = bonds_of(cache)
    kept = [flat(bonds.unpacked(cache.read(frame).broken)) for frame in cache.frames()]
    assert heap.read(LAST).broken is None and kept[-1].sum() > 20
    assert all((before <= after).all() for before, after in pairwise(kept))
    assert flat(bonds.broken(bonds.placed(cache.read(LAST).points), gap)).sum() < kept[-1].sum()
    for last in (3, 5, LAST):
        run(tmp_path / "parts", last)
    assert content(tmp_path / "parts/bar") == content(tmp_path / "whole/bar")
    old = as_before(tmp_path / "parts/bar")
    assert run(tmp_path / "parts", LAST) == 0 and old.read(LAST).broken is not None
    assert content(tmp_path / "parts/bar") == content(tmp_path / "whole/bar")
