"""Frames on disk: whole or absent, and what other programs see in them."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from drgs_blender.core.errors import AssetError, UsageError, WriteError
from drgs_blender.core.passes import BY_NAME, PASSES
from drgs_blender.render.film import frame_files
from drgs_blender.render.film.frame_files import read_frame, write_frame

ROOT = Path(__file__).resolve().parents[2]
BLENDER_PYTHON = ROOT / ".venv-blender" / "bin" / "python"


def some_passes(size: tuple[int, int] = (13, 17), names: tuple[str, ...] | None = None) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    chosen = names or tuple(p.name for p in PASSES)
    return {n: rng.normal(size=(*size, len(BY_NAME[n].channels))).astype(np.float32) * 100 for n in chosen}


def test_all_passes_and_metadata_come_back_bit_for_bit(tmp_path: Path) -> None:
    passes = some_passes()
    passes["Depth"][:] = 1e10
    passes["Combined"][0, 0, 0] = 3e38
    metadata = {"settings": "9f3a", "note": "ä = 1\nsecond line"}
    write_frame(tmp_path / "f_0001.exr", passes, metadata)
    again, text = read_frame(tmp_path / "f_0001.exr")
    assert text == metadata
    assert list(again) == [p.name for p in PASSES]
    for name, values in passes.items():
        assert np.array_equal(again[name], values), name
    assert os.listdir(tmp_path) == ["f_0001.exr"]


def test_passes_that_a_scene_names_are_layers_of_their_own_names(tmp_path: Path) -> None:
    rng, path = np.random.default_rng(2), tmp_path / "f.exr"
    widths = {"AOV colour tone": 4, "AOV value wetness": 1, "AOV value Depth": 1, "Combined_key.light": 3}
    passes = some_passes((4, 5), ("Combined", "Depth"))
    passes |= {name: rng.normal(size=(4, 5, width)).astype(np.float32) for name, width in widths.items()}
    write_frame(path, passes, {})
    with OpenEXR.File(str(path), separate_channels=True) as file:
        assert {"tone.A", "wetness.X", "Depth.Z", "Depth.X", "Combined_key.light.R"} <= set(file.channels())
    again, _ = read_frame(path)
    assert set(again) == set(passes) and all(np.array_equal(again[name], passes[name]) for name in passes)
    for wrong in ("AOV value Roughness", "AOV value ", "wetness"):
        with pytest.raises(UsageError):
            write_frame(path, some_passes((4, 5), ("Roughness",)) | {wrong: passes["AOV value wetness"]}, {})


def test_half_floats_only_for_colour(tmp_path: Path) -> None:
    passes = some_passes(names=("Combined", "Depth"))
    passes["Combined"][0, 0] = 1e9
    write_frame(tmp_path / "f.exr", passes, {}, half=True)
    again, _ = read_frame(tmp_path / "f.exr")
    assert np.array_equal(again["Depth"], passes["Depth"])
    assert again["Combined"][0, 0, 0] == 65504
    small = np.abs(passes["Combined"]) < 6e4
    assert np.abs(again["Combined"] / passes["Combined"] - 1)[small].max() <= 2.0**-11


def test_plain_openexr_sees_beauty_and_layers(tmp_path: Path) -> None:
    passes = some_passes()
    write_frame(tmp_path / "f.exr", passes, {"settings": "x"})
    with OpenEXR.File(str(tmp_path / "f.exr")) as file:
        assert np.array_equal(file.channels()["RGBA"].pixels, passes["Combined"])
        assert file.header()["drgs:settings"] == "x"
        assert np.array_equal(file.channels()["Depth.Z"].pixels, passes["Depth"][..., 0])


def test_permissions_follow_the_umask(tmp_path: Path) -> None:
    write_frame(tmp_path / "f.exr", some_passes((2, 2)), {})
    (tmp_path / "plain").touch()
    assert stat.S_IMODE((tmp_path / "f.exr").stat().st_mode) == stat.S_IMODE((tmp_path / "plain").stat().st_mode)


def test_every_truncation_and_most_flips_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "f.exr"
    write_frame(path, some_passes((8, 8), ("Combined", "Depth")), {"settings": "abc"})
    whole = path.read_bytes()
    before, _ = read_frame(path)
    for length in range(0, len(whole), max(1, len(whole) // 40)):
        path.write_bytes(whole[:length])
        with pytest.raises(AssetError):
            read_frame(path)
    rng = np.random.default_rng(0)
    for _ in range(150):
        data = bytearray(whole)
        data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        path.write_bytes(data)
        try:
            after, text = read_frame(path)
        except AssetError:
            continue
        # A flip that is let through hit bytes without meaning (padding, window centre): the frame is the same.
        assert text == {"settings": "abc"}
        assert all(np.array_equal(after[n], before[n]) for n in before)


def test_a_failure_leaves_the_old_frame_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "f.exr"
    old = some_passes((4, 4), ("Combined",))
    write_frame(path, old, {"run": "1"})

    def truncate(temporary: Path, *_: object) -> None:
        raise OSError("channel R reads back differently")

    monkeypatch.setattr(frame_files, "_verify", truncate)
    with pytest.raises(WriteError) as caught:
        write_frame(path, some_passes((5, 5), ("Combined",)), {"run": "2"})
    assert caught.value.exit_code == 73
    assert "f.exr" in str(caught.value)
    assert os.listdir(tmp_path) == ["f.exr"]
    assert np.array_equal(read_frame(path)[0]["Combined"], old["Combined"])


@pytest.mark.skipif(os.name == "nt", reason="an open file cannot be replaced there")
def test_writing_replaces_the_frame_and_never_changes_it(tmp_path: Path) -> None:
    """A player that has the old frame open reads the old frame to its end."""
    path = tmp_path / "f.exr"
    write_frame(path, some_passes((4, 4), ("Combined",)), {"run": "1"})
    before, number = path.read_bytes(), path.stat().st_ino
    with open(path, "rb") as old:
        write_frame(path, some_passes((5, 5), ("Combined",)), {"run": "2"})
        assert old.read() == before
    assert path.stat().st_ino != number
    assert read_frame(path)[1] == {"run": "2"}


def test_a_failed_rename_leaves_the_old_frame_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "f.exr"
    write_frame(path, some_passes((4, 4), ("Combined",)), {"run": "1"})
    before, tried = path.read_bytes(), []

    def refuse(source: Path, target: Path) -> None:
        tried.append((read_frame(source)[1], Path(source).parent, Path(target)))
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", refuse)
        with pytest.raises(WriteError, match="Permission denied"):
            write_frame(path, some_passes((5, 5), ("Combined",)), {"run": "2"})
    assert tried == [({"run": "2"}, tmp_path, path)], "a whole frame of the same folder is renamed"
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["f.exr"]


def test_disks_that_cannot_flush_a_folder_hold_frames_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some network file systems refuse it, after the frame has its name."""
    flush, refused = os.fsync, []

    def fsync(handle: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            refused.append(handle)
            raise OSError(22, "Invalid argument")
        flush(handle)

    monkeypatch.setattr(os, "fsync", fsync)
    write_frame(tmp_path / "f.exr", some_passes((2, 2)), {"run": "1"})
    assert refused and read_frame(tmp_path / "f.exr")[1] == {"run": "1"}


def test_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(WriteError):
        write_frame(tmp_path / "absent" / "f.exr", some_passes((2, 2)), {})
    assert os.listdir(tmp_path) == []


@pytest.mark.skipif(sys.platform == "win32", reason="folders have no write permission there")
def test_read_only_folder(tmp_path: Path) -> None:
    folder = tmp_path / "sealed"
    folder.mkdir()
    sealed = ["chattr", "+i", str(folder)]
    if os.geteuid() == 0:
        # Root ignores permissions; an immutable folder stops root as well, where the file system can have one.
        if shutil.which("chattr") is None or subprocess.run(sealed, capture_output=True).returncode != 0:
            pytest.skip("running as root on a file system without immutable folders")
    else:
        folder.chmod(0o555)
    try:
        with pytest.raises(WriteError) as caught:
            write_frame(folder / "f.exr", some_passes((2, 2)), {})
        assert caught.value.exit_code == 73
        assert os.listdir(folder) == []
    finally:
        if os.geteuid() == 0:
            subprocess.run(["chattr", "-i", str(folder)], check=True)
        else:
            folder.chmod(0o755)


def test_full_disk(tmp_path: Path) -> None:
    if not sys.platform.startswith("linux") or os.geteuid() != 0:
        pytest.skip("only root on Linux can mount a small disk")
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(disk)]
    if subprocess.run(mount, capture_output=True).returncode != 0:
        pytest.skip("mounting is not allowed here")
    try:
        small = some_passes((8, 8), ("Combined",))
        write_frame(disk / "small.exr", small, {})
        for name in ("small.exr", "large.exr"):
            with pytest.raises(WriteError) as caught:
                write_frame(disk / name, some_passes((200, 200)), {})
            assert caught.value.exit_code == 73
        assert os.listdir(disk) == ["small.exr"]
        assert np.array_equal(read_frame(disk / "small.exr")[0]["Combined"], small["Combined"])
    finally:
        subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.parametrize(
    "passes",
    [
        {},
        {"Combined": np.zeros((4, 4, 3), np.float32)},
        {"Nonsense": np.zeros((4, 4, 1), np.float32)},
        {"Combined": np.zeros((4, 4, 4), np.float32), "Depth": np.zeros((4, 5, 1), np.float32)},
        {"Depth": np.zeros((0, 4, 1), np.float32)},
    ],
)
def test_passes_that_make_no_picture(tmp_path: Path, passes: dict[str, np.ndarray]) -> None:
    with pytest.raises(UsageError):
        write_frame(tmp_path / "f.exr", passes, {})
    assert os.listdir(tmp_path) == []


def test_a_foreign_file_is_named_as_such(tmp_path: Path) -> None:
    with OpenEXR.File({}, {"R": np.zeros((2, 2), np.float32)}) as file:
        file.write(str(tmp_path / "other.exr"))
    with pytest.raises(AssetError, match="not written by DR-GS"):
        read_frame(tmp_path / "other.exr")


BLENDER_SCRIPT = """
import sys, numpy as np, bpy
image = bpy.data.images.load(sys.argv[1])
node = bpy.data.node_groups.new("n", "CompositorNodeTree").nodes.new("CompositorNodeImage")
node.image = image
print("SOCKETS", *[s.name.replace(" ", "_") for s in node.outputs if s.enabled])
scene = bpy.context.scene
scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 17, 13, 100
tree = node.id_data
tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
out = tree.nodes.new("NodeGroupOutput")
scene.compositing_node_group = tree
scene.render.use_compositing = True
scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
scene.collection.objects.link(scene.camera)
scene.render.engine = "CYCLES"
scene.cycles.samples = 1
scene.render.image_settings.file_format = "OPEN_EXR"
scene.render.image_settings.color_depth = "32"
for socket in ("Combined", "Normal"):
    tree.links.new(node.outputs[socket], out.inputs[0])
    scene.render.filepath = f"{sys.argv[2]}_{socket}.exr"
    bpy.ops.render.render(write_still=True)
"""


def test_blender_reads_beauty_and_passes(tmp_path: Path) -> None:
    if not BLENDER_PYTHON.exists():
        pytest.skip("Blender's Python is not installed in .venv-blender")
    passes = some_passes()
    write_frame(tmp_path / "f.exr", passes, {})
    script = tmp_path / "read.py"
    script.write_text(BLENDER_SCRIPT)
    command = [str(BLENDER_PYTHON), str(script), str(tmp_path / "f.exr"), str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    sockets = next(line for line in done.stdout.splitlines() if line.startswith("SOCKETS")).split()[1:]
    assert set(sockets) == {"Alpha"} | {p.name.replace(" ", "_") for p in PASSES}
    for name in ("Combined", "Normal"):
        with OpenEXR.File(str(tmp_path / f"out_{name}.exr"), separate_channels=True) as file:
            seen = np.stack([file.channels()[c].pixels for c in "RGB"], axis=-1)
        assert np.array_equal(seen, passes[name][..., :3]), name
