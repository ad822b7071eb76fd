"""Files and names made to do harm, full disks, sizes beyond all measure: refused in words, nothing left behind."""

from __future__ import annotations

import os
import resource
import struct
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fuzz_files import obj, square
from splat_files import random_splats

from drgs_blender.build.proxy import mesh_from_surfels
from drgs_blender.cli.main import main
from drgs_blender.core.asset.archive import read_archive, replace_by, replace_file
from drgs_blender.core.errors import AssetError, WriteError
from drgs_blender.formats import gltf_document, subprocess_reader, usd_stage
from drgs_blender.formats.axes import scaled_surfels
from drgs_blender.formats.glb import Glb
from drgs_blender.formats.gltf_nodes import INSTANCES
from drgs_blender.formats.gltf_splats import write_gltf_splats
from drgs_blender.formats.registry import read_mesh, read_surfels
from drgs_blender.formats.splat_ply import write_splat_ply
from drgs_blender.formats.writers import WRITERS

pytestmark = pytest.mark.skipif(os.name == "nt", reason="pipes, links and names of other systems")

SPLATS = {f".{w.extensions[-1][1:]}": w.write for w in WRITERS if w.kind == "splats"}
MESHES = {w.extensions[0]: w.write for w in WRITERS if w.kind == "mesh"}


def placed(path: Path, count: int, instanced: bool) -> Path:
    """A GLB with a mesh of 300 triangles that so many nodes, or one with so many instances, place."""
    glb, random = Glb(), np.random.default_rng(1)
    position = glb.accessor(random.normal(size=(900, 3)).astype(np.float32), bounds=True)
    if instanced:
        places = {"TRANSLATION": glb.accessor(np.zeros((count, 3), np.float32))}
        nodes = [{"mesh": 0, "extensions": {INSTANCES: {"attributes": places}}}]
    else:
        nodes = [{"mesh": 0, "translation": [i, 0, 0]} for i in range(count)]
    glb.json |= {
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": [{"primitives": [{"attributes": {"POSITION": position}}]}],
    }
    glb.write(path)
    return path


@pytest.mark.parametrize("instanced", [False, True])
def test_meshes_are_not_placed_without_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, instanced: bool) -> None:
    monkeypatch.setattr(gltf_document, "_COPIES", 1 << 20)
    assert len(read_mesh(placed(tmp_path / "a.glb", 20, instanced)).faces) == 20 * 300
    with pytest.raises(AssetError, match=r"b\.glb: repeats its meshes .* Export the object once"):
        read_mesh(placed(tmp_path / "b.glb", 2000, instanced))


def test_splats_are_not_placed_without_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gltf_document, "_COPIES", 1 << 20)
    for count in (9, 2000):
        with monkeypatch.context() as patch:
            patch.setattr(Glb, "write", instances(Glb.write, count))
            write_gltf_splats(tmp_path / f"{count}.glb", random_splats(5))
    wanted = random_splats(5).centre + np.arange(9)[:, None, None] * [1, 0, 0]
    np.testing.assert_allclose(read_surfels(tmp_path / "9.glb").surfels.centre, wanted.reshape(-1, 3), atol=1e-5)
    with pytest.raises(AssetError, match=r"2000\.glb: repeats its meshes"):
        read_surfels(tmp_path / "2000.glb")


def instances(write: Callable[[Glb, Path], None], count: int) -> Callable[[Glb, Path], None]:
    """`Glb.write` of a file whose first node places its mesh `count` times, a metre apart."""

    def changed(glb: Glb, path: Path) -> None:
        along = np.arange(count, dtype=np.float32)[:, None] * np.float32([1, 0, 0])
        glb.json["nodes"][0]["extensions"] = {INSTANCES: {"attributes": {"TRANSLATION": glb.accessor(along)}}}
        write(glb, path)

    return changed


def test_accessors_without_data_are_not_taken_without_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gltf_document, "_COPIES", 1 << 18)
    glb = Glb()
    glb._accessors.append({"componentType": 5126, "count": 9000, "type": "VEC3"})
    glb.json |= {"nodes": [{"mesh": 0}], "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}] * 9}]}
    glb.write(tmp_path / "a.glb")
    with pytest.raises(AssetError, match="repeats its meshes"):
        read_mesh(tmp_path / "a.glb")


def stage_of(path: Path) -> dict[str, np.ndarray]:
    """What a stage holds, read in this process and in whatever time it takes."""
    from pxr import Usd, UsdGeom

    return usd_stage.read_stage(str(path), Usd, UsdGeom)


def referring(name: str) -> bytes:
    return f'#usda 1.0\n(\n    defaultPrim = "S"\n)\ndef "S" (references = @{name}@) {{}}\n'.encode()


@pytest.fixture
def stages(tmp_path: Path) -> Callable[[str], dict]:
    """Packs layers into a package, and reads it in this process; a file with splats lies beside it."""
    pytest.importorskip("pxr")
    SPLATS[".usdc"](tmp_path / "outside.usda", random_splats(7))
    good = (tmp_path / "outside.usda").read_bytes()

    def read(name: str) -> dict:
        path = tmp_path / f"{abs(hash(name))}.usdz"  # USD keeps layers by their name
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("root.usda", referring(name.format(folder=tmp_path)))
            archive.writestr("inner.usda", good)
            archive.writestr("deep.usda", referring(str(tmp_path / "outside.usda")))
        return stage_of(path)

    return read


def test_a_package_reads_itself(stages: Callable[[str], dict]) -> None:
    assert len(stages("inner.usda")["0/centre"]) == 7


@pytest.mark.parametrize(
    "name", ["outside.usda", "{folder}/outside.usda", "deep.usda", '`"outside.usda"`', "/dev/zero"]
)
def test_a_package_reads_nothing_else(stages: Callable[[str], dict], name: str) -> None:
    with pytest.raises(AssetError, match=r"usdz: refers to .*, which is not in this package"):
        stages(name)


def test_stages_of_a_studio_refer_across_folders(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    (tmp_path / "shot").mkdir()
    (tmp_path / "assets").mkdir()
    SPLATS[".usdc"](tmp_path / "assets" / "a.usdc", random_splats(7))
    (tmp_path / "shot" / "s.usda").write_bytes(referring("../assets/a.usdc"))
    assert len(stage_of(tmp_path / "shot" / "s.usda")["0/centre"]) == 7


def test_splats_are_not_referred_to_without_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pxr")
    monkeypatch.setattr(usd_stage, "_SPLATS", 1 << 16)
    SPLATS[".usdc"](tmp_path / "a.usdc", random_splats(50))
    for count in (9, 900):
        prims = [f'def "S{i}" (references = @a.usdc@) {{}}\n' for i in range(count)]
        (tmp_path / f"{count}.usda").write_text("#usda 1.0\n" + "".join(prims))
    assert len(stage_of(tmp_path / "9.usda")) == 1 + 9 * 7
    with pytest.raises(AssetError, match="so often"):
        stage_of(tmp_path / "900.usda")


def test_what_a_full_disk_keeps_from_being_read_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pxr")
    SPLATS[".usdc"](tmp_path / "a.usda", random_splats(7))
    code = f"from {usd_stage.__name__} import main; main({str(tmp_path / 'a.usda')!r}, '/dev/full', {1 << 40}, 60)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == subprocess_reader.FULL and done.stderr.splitlines()[-1] == "No space left on device"
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: done_bytes(done))
    with pytest.raises(WriteError, match=r"cannot hold what is in .*a\.usda \(No space left .*TMPDIR"):
        read_surfels(tmp_path / "a.usda")


def done_bytes(done: subprocess.CompletedProcess[str]) -> subprocess.CompletedProcess[bytes]:
    return subprocess.CompletedProcess(done.args, done.returncode, b"", done.stderr.encode())


@pytest.mark.parametrize("suffix", SPLATS)
@pytest.mark.parametrize("value", [np.nan, np.inf, -3.4e38, 3.4e38, 1e30, 1e-45, 0])
def test_what_is_written_is_read(tmp_path: Path, suffix: str, value: float) -> None:
    """Any number in any place: the file is refused with the reason, or comes back whole."""
    if suffix == ".usdc":
        pytest.importorskip("pxr")
    path = tmp_path / f"a{suffix}"
    for name in ("centre", "scale", "rotation", "opacity", "sh"):
        splats = random_splats(20)
        changed = getattr(splats, name).copy()
        changed[3] = value
        try:
            SPLATS[suffix](path, replace(splats, **{name: changed}))
        except AssetError as error:
            assert "NaN, infinite" in str(error) or "8388 km" in str(error)
            assert not path.exists()
            continue
        if suffix == ".usdc":
            path = path.rename(tmp_path / f"{name}.usdc")  # USD keeps layers by their name
            assert all(np.isfinite(array).all() for array in stage_of(path).values())
        else:
            assert len(read_surfels(path).surfels) == 20, name
        path.unlink()
        path = tmp_path / f"a{suffix}"


def test_one_bright_splat_leaves_the_colours_of_others(tmp_path: Path) -> None:
    splats = random_splats(200, coefficients=1)
    splats.centre[0], splats.sh[0] = 9, 1e30
    SPLATS[".sog"](tmp_path / "a.sog", splats)
    back = read_surfels(tmp_path / "a.sog").surfels
    others = back.centre.max(axis=1) < 8
    assert others.sum() == 199 and back.sh is not None
    np.testing.assert_allclose(np.sort(back.sh[others, 0, 0]), np.sort(splats.sh[1:, 0, 0]), atol=0.02)


@pytest.mark.parametrize("suffix", MESHES)
@pytest.mark.parametrize(("name", "value"), [("vertices", np.nan), ("vertices", 1e30), ("albedo", np.nan)])
def test_meshes_that_no_reader_takes_are_not_written(tmp_path: Path, suffix: str, name: str, value: float) -> None:
    mesh = square()
    getattr(mesh, name)[3] = value
    with pytest.raises(AssetError, match=rf"a{suffix}: (has|measures|would hold)"):
        MESHES[suffix](tmp_path / f"a{suffix}", mesh)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("scale", ["1e-30", "1e30", "1e-44"])
def test_scales_beyond_measure_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], scale: str) -> None:
    (tmp_path / "m.obj").write_bytes(obj(square()))
    write_splat_ply(tmp_path / "s.ply", random_splats(20))
    mesh, splats = str(tmp_path / "m.obj"), str(tmp_path / "s.ply")
    commands = {
        "a.drgs": ["make", mesh, "--density", "20", "--out"],
        "b.glb": ["convert", mesh],
        "c.usdz": ["convert", mesh],
    }
    if scale != "1e-30":  # which 32-bit numbers hold for splats
        commands |= {"d.drgs": ["import", splats, "--no-mesh", "--out"], "e.ply": ["convert", splats]}
    for name, words in commands.items():
        assert main([*words, str(tmp_path / name), "--scale", scale]) == 64, name
        assert f"--scale {float(scale):g}: makes" in capsys.readouterr().err
        assert not (tmp_path / name).exists()


def test_spz_does_not_blow_splats_up(tmp_path: Path) -> None:
    splats = random_splats(20)
    with pytest.raises(AssetError, match=r"all below the 4.5e-05 m of SPZ"):
        SPLATS[".spz"](tmp_path / "a.spz", replace(splats, scale=splats.scale * np.float32(1e-6)))


def test_meshes_are_built_around_surfels_of_any_size(tmp_path: Path) -> None:
    from test_cli_assets import splats

    surfels = read_surfels(splats(tmp_path / "a.ply")).surfels
    volume = {
        size: mesh_from_surfels(scaled_surfels(surfels, size), resolution=24, views=16)[1]["volume"] / size**3
        for size in (1.0, 1e-4, 1e7)
    }
    np.testing.assert_allclose(list(volume.values()), volume[1.0], rtol=0.05)


def test_names_that_are_no_text(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9")
    try:
        write_splat_ply(Path(name + ".ply"), random_splats(20))
    except WriteError:
        pytest.skip("this file system takes only text")
    assert main(["import", name + ".ply", "--no-mesh", "--out", name + ".drgs"]) == 0
    assert main(["inspect", name + ".drgs", "--json"]) == 0
    assert r"caf\\xe9.ply" in capsys.readouterr().out
    write_gltf_splats(Path(name + ".glb"), random_splats(5))
    assert rb"caf\\xe9" in Path(name + ".glb").read_bytes()
    Path(name + ".usda").write_text("#usda 1.0\n")
    assert main(["import", name + ".usda", "--no-mesh", "--out", name + ".drgs"]) == 65
    assert "is no text, and USD takes no other. Rename it" in capsys.readouterr().err


def test_a_pattern_without_frames_is_those_that_are_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for frame in (3, 4):
        write_splat_ply(tmp_path / f"s_{frame:04d}.ply", random_splats(5))
    pattern = str(tmp_path / "s_####.ply")
    assert main(["convert", pattern, str(tmp_path / "o_##.spz")]) == 0
    assert main(["import", pattern, "--no-mesh", "--out", str(tmp_path / "o_#.drgs")]) == 0
    assert {p.name for p in tmp_path.glob("o*")} == {"o_03.spz", "o_04.spz", "o_3.drgs", "o_4.drgs"}
    assert main(["convert", pattern, str(tmp_path / "o.spz")]) == 64
    assert "has no # for the frame's number" in capsys.readouterr().err
    assert main(["convert", str(tmp_path / "q_####.ply"), str(tmp_path / "q_##.spz")]) == 64
    (tmp_path / "one_#.ply").write_bytes((tmp_path / "s_0003.ply").read_bytes())  # a name, not a pattern
    assert main(["convert", str(tmp_path / "one_#.ply"), str(tmp_path / "one.spz")]) == 0


def test_splats_that_stay_splats_lack_no_materials(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_splat_ply(tmp_path / "s.ply", random_splats(5))
    assert main(["convert", str(tmp_path / "s.ply"), str(tmp_path / "o.spz")]) == 0
    assert "materials" not in capsys.readouterr().out
    assert main(["convert", str(tmp_path / "s.ply"), str(tmp_path / "o.spz"), "--colour", "albedo"]) == 0
    assert "has no materials" in capsys.readouterr().out


def test_meshes_of_usd_have_a_way_in(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    MESHES[".usdz"](tmp_path / "m.usdz", square())
    assert main(["make", str(tmp_path / "m.usdz"), "--out", str(tmp_path / "m.drgs")]) == 65
    assert "import it in Blender and export glTF (.glb), which is read" in capsys.readouterr().err


def test_a_directory_that_lies_about_sizes(tmp_path: Path) -> None:
    name, most = b"manifest.json", 0xFFFFFFFE
    shared = (1 << 11, 0, 0, 0x21, 0, most, most, len(name))
    local = struct.pack("<4s5H3I2H", b"PK\3\4", 20, *shared, 0) + name
    central = struct.pack("<4s6H3I5H2I", b"PK\1\2", 3 << 8 | 20, 20, *shared, 0, 0, 0, 0, 0, 0) + name
    end = struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 2, 2, 2 * len(central), len(local), 0)
    (tmp_path / "a.drgs").write_bytes(local + central + central + end)
    with pytest.raises(AssetError, match="larger than the file"):
        read_archive(tmp_path / "a.drgs")


def test_pipes_devices_and_circles(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_splat_ply(tmp_path / "s.ply", random_splats(5))
    os.mkfifo(tmp_path / "pipe.ply")
    os.mkfifo(tmp_path / "pipe.drgs")
    (tmp_path / "full.ply").symlink_to("/dev/full")
    (tmp_path / "circle.ply").symlink_to("circle.ply")
    (tmp_path / "folder.drgs").mkdir()
    for name in ("pipe.ply", "full.ply", "circle.ply"):
        assert main(["convert", str(tmp_path / "s.ply"), str(tmp_path / name)]) == 73, name
        assert (tmp_path / name).is_fifo() or (tmp_path / name).is_symlink()
    for name in ("pipe.ply", "pipe.drgs", "full.ply", "circle.ply", "folder.drgs"):
        assert main(["convert", str(tmp_path / name), str(tmp_path / "o.ply")]) == 65, name
    assert not (tmp_path / "o.ply").exists()


def test_links_are_followed(tmp_path: Path) -> None:
    write_splat_ply(tmp_path / "s.ply", random_splats(5))
    (tmp_path / "versions").mkdir()
    (tmp_path / "latest.ply").symlink_to("versions/v1.ply")
    assert main(["convert", str(tmp_path / "s.ply"), str(tmp_path / "latest.ply")]) == 0
    assert (tmp_path / "latest.ply").is_symlink()
    assert [p.name for p in (tmp_path / "versions").iterdir()] == ["v1.ply"]


def test_an_interrupted_write_leaves_the_old_file_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")

    def parts():
        yield b"half"
        raise KeyboardInterrupt

    def save(temporary: Path) -> None:
        temporary.write_bytes(b"half")
        raise KeyboardInterrupt

    for write in (lambda: replace_file(path, parts()), lambda: replace_by(path, save)):
        with pytest.raises(KeyboardInterrupt):
            write()
        assert [p.name for p in tmp_path.iterdir()] == ["a.bin"] and path.read_bytes() == b"old"


@pytest.mark.parametrize("suffix", [pytest.param(".usda", marks=pytest.mark.slow), ".usdc", ".exr"])
def test_libraries_need_no_other_disk_and_say_when_it_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    given = "Environment(np.random.default_rng(1).random((64, 128, 3), np.float32))"
    if suffix != ".exr":
        pytest.importorskip("pxr")
        given = "random_splats(300)"
        monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "no such folder"))
        SPLATS[".usdc"](tmp_path / f"a{suffix}", random_splats(5))
        (tmp_path / f"a{suffix}").unlink()
    code = f"""
import resource, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
import numpy as np
from pathlib import Path
from splat_files import random_splats
from drgs_blender.core.asset import Environment
from drgs_blender.core.errors import WriteError
from drgs_blender.formats.writers import WRITERS
writer = next(w for w in WRITERS if {suffix!r} in w.extensions)
given = {given}
resource.setrlimit(resource.RLIMIT_FSIZE, (8192, {resource.RLIM_INFINITY}))
try:
    writer.write(Path({str(tmp_path / f"b{suffix}")!r}), given)
except WriteError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-B", "-c", code], capture_output=True, text=True)
    assert "cannot be written (" in done.stdout and "File too large" in done.stdout, done
    assert len(done.stdout.splitlines()) == 1 and not any(tmp_path.iterdir())


def test_a_file_that_is_cut_off_after_it_was_read(tmp_path: Path) -> None:
    write_splat_ply(tmp_path / "a.ply", random_splats(5000))
    code = f"""
import os
from pathlib import Path
from drgs_blender.formats.ply import read_ply
_, elements = read_ply(Path({str(tmp_path / "a.ply")!r}))
os.truncate({str(tmp_path / "a.ply")!r}, 100)
print(float(elements["vertex"].columns["x"][-1]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr  # a mapped file would end the process by SIGBUS
    assert float(done.stdout) == random_splats(5000).centre[-1, 0]
