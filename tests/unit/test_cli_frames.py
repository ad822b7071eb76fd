"""Frames on disk: which may stay, and what decides that."""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_container import make_asset

from drgs_blender.cli import frame_store
from drgs_blender.cli.blender_process import Evaluated
from drgs_blender.cli.machine import Machine
from drgs_blender.cli.main import build_parser
from drgs_blender.cli.render import claim, layer_path, render
from drgs_blender.core.asset.container import digest_asset, write_asset
from drgs_blender.core.asset.model import Asset, Mesh
from drgs_blender.core.errors import AssetError, EngineError, UsageError
from drgs_blender.core.frame import Camera, Frame, ObjectState, RenderSettings, World
from drgs_blender.deform.attach import attach


def scene() -> Frame:
    """A frame with every kind of array."""
    rng = np.random.default_rng(0)
    state = ObjectState(
        "tile", "key", np.eye(4), *(rng.random(s, np.float32) for s in ((4, 3), (2, 3, 3), (4, 3), 4, 4))
    )
    camera = Camera(np.eye(4), 6, 4, 5.0, 5.0, 3.0, 2.0)
    return Frame(1, camera, [state], World(rng.random((4, 8, 3), np.float32)))


@pytest.fixture
def asset(tmp_path: Path) -> Path:
    """A tile."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    mesh = Mesh(vertices, [[0, 1, 2], [0, 2, 3]], np.full((4, 3), 0.5), np.full(4, 0.5), np.zeros(4))
    surfels, binding, _ = attach(mesh, density=4)
    write_asset(tmp_path / "tile.drgs", Asset(surfels, mesh, binding))
    return tmp_path / "tile.drgs"


def nudge(array: np.ndarray) -> None:
    """The smallest change of one number."""
    array.flat[1] = np.nextafter(array.flat[1], np.float32(2))


CHANGES = {
    "vertex": lambda f: nudge(f.objects[0].vertices),
    "normal": lambda f: nudge(f.objects[0].corner_normals),
    "albedo": lambda f: nudge(f.objects[0].albedo),
    "roughness": lambda f: nudge(f.objects[0].roughness),
    "metallic": lambda f: nudge(f.objects[0].metallic),
    "texel": lambda f: nudge(f.world.environment),
    "strength": lambda f: setattr(f.world, "strength", 1.1),
    "place": lambda f: nudge(f.objects[0].matrix_world),
    "camera": lambda f: setattr(f.camera, "fx", 5.1),
    "seed": lambda f: setattr(f.settings, "seed", 1),
    "passes": lambda f: setattr(f, "passes", ("Combined", "Depth")),
}


@pytest.mark.parametrize("change", CHANGES)
def test_whatever_decides_the_picture_decides_the_hash(asset, change):
    before, after = scene(), scene()
    CHANGES[change](after)
    first, second = (frame_store.settings_hash(f, {"key": asset}) for f in (before, after))
    assert first == frame_store.settings_hash(scene(), {"key": asset}) != second


def test_content_of_the_asset_counts_not_its_place(asset):
    first = frame_store.settings_hash(scene(), {"key": asset})
    moved = asset.rename(asset.with_name("moved.drgs"))
    assert frame_store.settings_hash(scene(), {"key": moved}) == first
    mesh = Mesh(np.eye(3), [[0, 1, 2]], np.full((3, 3), 0.5), np.full(3, 0.5), np.zeros(3))
    surfels, binding, _ = attach(mesh, density=4)
    write_asset(asset, Asset(surfels, mesh, binding))
    assert frame_store.settings_hash(scene(), {"key": asset}) != first


def test_threads_change_nothing(asset):
    threaded = replace(scene(), settings=RenderSettings(threads=7, device="cuda"))
    assert frame_store.settings_hash(threaded, {"key": asset}) == frame_store.settings_hash(scene(), {"key": asset})


def test_damaged_frames_are_looked_at_in_silence(tmp_path, capfd):
    frame = scene()
    path = tmp_path / "1.exr"
    noise = np.random.default_rng(0).random((4, 6, 4), np.float32)
    frame_store.save(path, {"Combined": noise}, frame, 1, "hash")
    whole = path.read_bytes()
    assert frame_store.is_complete(path, frame, "hash") and not frame_store.is_complete(path, frame, "other")
    for data in (whole[:-100], whole[:200], whole[:400] + bytes(60) + whole[460:], b"", b"\x76\x2f\x31\x01"):
        path.write_bytes(data)
        assert not frame_store.is_complete(path, frame, "hash")
    print("heard again")
    assert capfd.readouterr() == ("heard again\n", "")


def test_layers_never_share_a_file():
    files: dict[str, str] = {}
    for layer in ("Sky", "Ground", "Sky"):
        claim(files, layer_path(Path("0001.exr"), layer), layer)
    for first, second in (("a b", "a/b"), ("Key", "key")):
        claim(files, layer_path(Path("0002.exr"), first), first)
        with pytest.raises(UsageError, match=f"{first!r} and {second!r}"):
            claim(files, layer_path(Path("0002.exr"), second), second)


def test_clocks_of_other_nodes_make_no_frame_abandoned(tmp_path):
    """Neither one that is ahead, nor one that was set back while a frame is written."""
    ages = {"old": -1e4, "new": 0.0, "ahead": 1e9}
    for name, seconds in ages.items():
        path = tmp_path / f".a_0001.exr.{name}.tmp"
        path.touch()
        now = path.stat().st_mtime
        os.utime(path, (now + seconds, now + seconds))
    frame_store.remove_abandoned(str(tmp_path / "a_####.exr"))
    assert sorted(path.suffixes[-2] for path in tmp_path.iterdir()) == [".ahead", ".new"]


@pytest.mark.parametrize("size", [100, 0])
def test_asset_that_is_copied_over_in_place_gives_the_frame_back(tmp_path, size):
    """As `cp` and `scp` do it, which first cut the file off: it was whole when it was loaded, and will be again."""
    path = tmp_path / "a.drgs"
    write_asset(path, make_asset())
    machine = Machine()
    machine.assets["key"], machine._contents[path] = path, digest_asset(path)
    machine.check_assets()
    os.truncate(path, size)
    with pytest.raises(EngineError, match=r"a\.drgs: was rewritten"):
        machine.check_assets()


class CutOff(Machine):
    """A machine whose engine ends as it looks at mapped bytes that are gone, and refuses what is left of the asset."""

    def engine(self, memory_mb=None):
        return self

    def frames(self, blender, job, timeout):
        yield Evaluated(1, "", scene(), [], 0, lambda: iter(()))

    def render(self, *_):
        os.truncate(self.assets["key"], 100)
        raise AssetError("a.drgs", "is truncated")


def test_engine_that_refuses_what_is_being_copied_gives_the_frame_back(tmp_path):
    path, blend, machine = tmp_path / "a.drgs", tmp_path / "a.blend", CutOff()
    write_asset(path, make_asset())
    blend.touch()
    machine.assets["key"], machine._contents[path] = path, digest_asset(path)
    job = ["render", str(blend), "--frames=1", f"--out={tmp_path}/#.exr", "--blender", sys.executable]
    args = build_parser().parse_args(job, argparse.Namespace(quiet=True, progress=False))
    with pytest.raises(EngineError, match=r"a\.drgs: was rewritten"):
        render(args, machine)
    assert not list(tmp_path.glob("*.exr"))


def test_blender_that_refuses_what_is_being_copied_gives_the_frame_back(tmp_path, monkeypatch):
    path = tmp_path / "a.drgs"
    write_asset(path, make_asset())

    class Blender:
        running = True

        def __init__(self, *_):
            pass

        __enter__ = __exit__ = __init__

        def frames(self):
            os.truncate(path, 100)
            raise AssetError("a.drgs", "is truncated")
            yield

    monkeypatch.setattr("drgs_blender.cli.machine.BlenderProcess", Blender)
    machine = Machine()
    machine.assets["key"], machine._contents[path] = path, digest_asset(path)
    monkeypatch.setattr(machine, "_close_blender", lambda: None)  # which forgets the assets of another scene
    job = {"scene": str(tmp_path / "a.blend"), "frames": [1]}
    with pytest.raises(EngineError, match=r"a\.drgs: was rewritten"):
        list(machine.frames(None, job, 1.0))
