"""Kernels that a release brings: used as they are where they fit, compiled again where they are damaged or do not."""

from __future__ import annotations

import json
import os
import pickle
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numba
import pytest

from drgs_blender.cli import doctor
from drgs_blender.compute import folders, kernel_cache, prepare, shipped, targets
from drgs_blender.compute.jit import njit
from drgs_blender.core.errors import DeviceError

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "tools"))
import extension  # noqa: E402
import kernel_archive  # noqa: E402


def _twice(x):
    return 2.0 * x + 1.0


@pytest.fixture
def release(tmp_path, monkeypatch, compiled):
    """The archive of a release that brings one kernel, and a cache folder that lacks it."""
    monkeypatch.delenv("DRGS_SHIPPED", raising=False)

    def use(cache: Path) -> None:
        monkeypatch.setenv("DRGS_CACHE_DIR", str(cache))
        for known in (folders.cache_folder, shipped._archive, shipped._names):
            known.cache_clear()

    folder = tmp_path / "kernels"
    folder.mkdir()
    monkeypatch.setattr(shipped, "FOLDER", folder)
    use(tmp_path / "builder")
    assert njit(_twice)(1.0) == 3.0
    (kernel,) = (tmp_path / "builder").glob("*/*.kernel")
    path = folder / shipped.archive_name(targets.current())
    write(path, {kernel.name: kernel.read_bytes()})
    use(tmp_path / "cache")
    compiled.clear()
    yield path
    monkeypatch.undo()
    for known in (folders.cache_folder, shipped._archive, shipped._names):
        known.cache_clear()


def write(path: Path, entries: dict[str, bytes]) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in entries.items():
            archive.writestr(name, data)


def entry(path: Path) -> tuple[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        (name,) = archive.namelist()
        return name, archive.read(name)


def kept(folder: Path) -> list[Path]:
    return list(folder.glob("*/*.kernel"))


def test_a_process_that_has_compiled_nothing_looks_into_the_same_archive(release):
    """That of ``compute.prepare``, the last step of *Set Up Engine*, asks before anything has set Numba up."""
    code = "import pathlib, sys; from drgs_blender.compute import shipped; shipped.FOLDER = pathlib.Path(sys.argv[1]); "
    code += "print(shipped.brings_any())"
    done = subprocess.run([sys.executable, "-c", code, release.parent], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.strip() == "True", done.stderr


def test_a_shipped_kernel_is_not_compiled(release, compiled, tmp_path):
    assert njit(_twice)(2.0) == 5.0
    assert compiled == [] and kept(tmp_path / "cache") == []


def test_what_is_not_shipped_is_compiled_and_kept(release, compiled, tmp_path):
    assert njit(_twice)(3) == 7.0  # an integer: another kernel
    assert compiled == ["_twice"] and len(kept(tmp_path / "cache")) == 1


class Trap:
    """What it is unpickled to is a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def flipped(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]


@pytest.mark.parametrize(
    "damage",
    [
        pytest.param(lambda path, name, data: path.write_bytes(b""), id="an empty archive"),
        pytest.param(lambda path, name, data: path.write_bytes(path.read_bytes()[:-30]), id="a shortened archive"),
        pytest.param(lambda path, name, data: path.write_bytes(os.urandom(5000)), id="noise"),
        pytest.param(lambda path, name, data: path.write_bytes(flipped(path.read_bytes())), id="a bit of the archive"),
        pytest.param(lambda path, name, data: write(path, {name: data[:-100]}), id="a shortened entry"),
        pytest.param(lambda path, name, data: write(path, {name: data[:20]}), id="the head of an entry"),
        pytest.param(lambda path, name, data: write(path, {name: b""}), id="an empty entry"),
        pytest.param(lambda path, name, data: write(path, {name: flipped(data)}), id="a bit of an entry"),
        pytest.param(lambda path, name, data: write(path, {name: kernel_cache.pack(b"no pickle")}), id="other content"),
    ],
)
def test_damaged_kernels_are_compiled_and_told(release, compiled, tmp_path, caplog, damage):
    damage(release, *entry(release))
    assert njit(_twice)(2.0) == 5.0
    assert compiled == ["_twice"] and "damaged" in caplog.text
    compiled.clear()
    assert njit(_twice)(2.0) == 5.0  # the cache has it now
    assert compiled == [] and len(kept(tmp_path / "cache")) == 1


def test_nothing_is_unpickled_whose_digest_is_another(release, compiled, tmp_path):
    name, data = entry(release)
    trap = tmp_path / "sprung"
    content = pickle.dumps(Trap(trap))
    pickle.loads(content)
    assert trap.exists()
    trap.unlink()
    write(release, {name: data[: len(data) - len(kernel_cache._checked(data))] + content})
    assert njit(_twice)(2.0) == 5.0
    assert compiled == ["_twice"] and not trap.exists()


@pytest.mark.parametrize("what", ["numba", "llvmlite", "target"])
def test_kernels_of_other_versions_or_targets_are_left_alone(release, compiled, monkeypatch, what):
    if what == "target":
        release.rename(release.with_name(shipped.archive_name("x86-64-v9")))
    else:
        monkeypatch.setattr(getattr(kernel_cache, what), "__version__", "0.1")
    assert njit(_twice)(2.0) == 5.0
    assert compiled == ["_twice"]


# --- doctor ---


@pytest.mark.parametrize(
    ("stock", "line"),
    [
        ((99, 0, 0), "99 ready (99 shipped)"),
        (
            (90, 4, 5, ("simulate", "new")),
            "94 ready (90 shipped); 5 are compiled when first needed, for simulation, new",
        ),
        ((0, 0, 99), "0 ready (0 shipped); 99 are compiled when first needed"),
    ],
)
def test_doctor_counts_kernels(monkeypatch, tmp_path, stock, line):
    monkeypatch.setattr(prepare, "count_kernels", lambda: prepare.KernelCounts(*stock))
    monkeypatch.setattr(shipped, "FOLDER", tmp_path)
    assert doctor.kernels(None) == f"{targets.current()}, {line}"
    versions = {"numba": numba.__version__, "llvmlite": kernel_cache.llvmlite.__version__}
    (tmp_path / "versions.json").write_text(json.dumps(versions | {"sources": "x"}))
    assert doctor.kernels(None) == f"{targets.current()}, {line}"
    (tmp_path / "versions.json").write_text(json.dumps(versions | {"numba": "0.1"}))
    with pytest.raises(DeviceError, match=r"made with numba 0\.1 and .*pip install numba==0\.1 llvmlite=="):
        doctor.kernels(None)
    (tmp_path / "versions.json").write_text("{")
    assert doctor.kernels(None) == f"{targets.current()}, {line}"


# --- what a release holds ---


def test_the_zip_brings_only_kernels_made_from_its_own_sources(tmp_path):
    for name in extension.CONTENTS:
        if (ROOT / name).is_file():
            shutil.copy(ROOT / name, tmp_path / name)
    (tmp_path / "drgs_blender" / "compute" / "kernels").mkdir(parents=True)
    (tmp_path / "drgs_blender" / "core").mkdir()
    shutil.copy(ROOT / "drgs_blender" / "core" / "version.py", tmp_path / "drgs_blender" / "core")
    folder = tmp_path / extension.KERNELS
    with pytest.raises(ValueError, match="holds no kernels"):
        extension.build(tmp_path / "a.zip", tmp_path, with_kernels=True)
    digest = kernel_archive.sources_digest(tmp_path / "drgs_blender")
    kernel_archive._write(folder, [("linux-x86-64-v3.zip", b"PK")], {}, {"sources": digest})
    for wanted in (False, True):
        with zipfile.ZipFile(extension.build(tmp_path / "a.zip", tmp_path, with_kernels=wanted)) as archive:
            inside = {name for name in archive.namelist() if name.startswith(extension.KERNELS.as_posix())}
        assert {Path(name).name for name in inside} == ({"linux-x86-64-v3.zip", "versions.json"} if wanted else set())
    (tmp_path / "drgs_blender" / "other.py").write_text("")
    with pytest.raises(ValueError, match="other sources"):
        extension.build(tmp_path / "a.zip", tmp_path, with_kernels=True)


def test_archives_that_fit_something_else_go(tmp_path):
    kernel_archive._write(tmp_path, [("linux-a.zip", b"1")], {"sources-x.json": b"{}"}, {"numba": "1"})
    kernel_archive._write(tmp_path, [("linux-b.zip", b"2")], {}, {"numba": "1"})
    assert {p.name for p in tmp_path.iterdir()} == {"linux-a.zip", "linux-b.zip", "sources-x.json", "versions.json"}
    kernel_archive._write(tmp_path, [("linux-c.zip", b"3")], {}, {"numba": "2"})
    assert {p.name for p in tmp_path.iterdir()} == {"linux-c.zip", "versions.json"}


def test_a_target_of_another_architecture_cannot_be_built(tmp_path):
    with pytest.raises(kernel_archive.BuildError, match=r"no-such-target.*there are"):
        kernel_archive.build(["no-such-target"], [sys.executable], tmp_path)


# --- frames ---

_FRAME = """
import hashlib, sys
import numpy as np
from numba.core import event
from drgs_blender.core.asset.container import read_asset
from drgs_blender.engine.session import Session
from drgs_blender.core.frame import Camera, Frame, ObjectState, RenderSettings, World

class Count(event.Listener):
    names = []
    def on_start(self, event):
        self.names.append(event.data["dispatcher"].py_func.__name__)
    def on_end(self, event):
        pass

event.register("numba:compile", Count())
session = Session()
key = session.load_asset(sys.argv[1])
vertices = np.array(read_asset(sys.argv[1]).mesh.vertices, np.float32)
camera = Camera(np.array([[1, 0, 0, 0], [0, 0, -1, -3], [0, 1, 0, 0], [0, 0, 0, 1]], float), 24, 24, 30.0, 30.0, 12, 12)
world = World(np.random.default_rng(0).uniform(0, 1, (32, 64, 3)).astype(np.float32))
settings = RenderSettings(samples=6, subpixel_samples=1, camera_sees="mesh")
frame = Frame(1, camera, [ObjectState("cow", key, vertices=vertices)], world, settings)
passes = session.render(frame, lambda phase, part: None, lambda: False)
assert passes["Combined"][..., :3].std() > 0.01
digest = hashlib.sha256()
for name in sorted(passes):
    digest.update(name.encode() + passes[name].tobytes())
print(digest.hexdigest(), len(Count.names))
"""


def frame(asset: Path, target: str, cache: Path, source: Path | None = None) -> tuple[str, int]:
    """Digest of a frame's passes, and how many kernels were compiled for it; with the kernels of `source`, or none."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("DRGS_", "NUMBA_"))}
    environment |= {"DRGS_CPU_TARGET": target, "DRGS_CACHE_DIR": str(cache), "PYTHONPATH": str(source or ROOT)}
    environment |= {} if source else {"DRGS_SHIPPED": "0"}
    done = subprocess.run(
        [sys.executable, "-c", _FRAME, asset],
        env=environment, cwd=source or ROOT, capture_output=True, text=True, timeout=900,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    digest, count = done.stdout.split()
    return digest, int(count)


@pytest.fixture(scope="module")
def cow(tmp_path_factory) -> Path:
    """An asset, made here."""
    path = tmp_path_factory.mktemp("asset") / "cow.drgs"
    command = [sys.executable, "-m", "drgs_blender.cli.main", "make", ROOT / "examples/spot/spot_triangulated.obj"]
    subprocess.run([*command, "--out", path], check=True, cwd=ROOT, timeout=600)
    return path


@pytest.fixture(scope="module")
def compiled_frames(cow, tmp_path_factory) -> dict[str, str]:
    """Target -> digest of a frame whose kernels were compiled on the spot."""
    from llvmlite import binding

    fit = targets.usable(targets.machine_name(), targets.platform.system(), binding.get_host_cpu_features())
    found = {}
    for name in ("native", *(t.name for t in fit)):
        found[name], count = frame(cow, name, tmp_path_factory.mktemp(name))
        assert count > 3
    return found


@pytest.mark.slow
def test_frames_of_all_targets_are_the_same_bit_for_bit(compiled_frames):
    if len(compiled_frames) == 1:
        pytest.skip("this processor has no fixed target")
    assert len(set(compiled_frames.values())) == 1, compiled_frames


@pytest.mark.slow
def test_a_frame_of_shipped_kernels_is_that_of_kernels_compiled_on_the_spot(cow, compiled_frames, tmp_path):
    names = [name for name in compiled_frames if name != "native"]
    if not names:
        pytest.skip("this processor has no fixed target")
    source = tmp_path / "elsewhere"
    ignored = shutil.ignore_patterns("__pycache__", "kernels")
    shutil.copytree(ROOT / "drgs_blender", source / "drgs_blender", ignore=ignored)
    kernel_archive.build([names[0]], [sys.executable], source / extension.KERNELS, ["mesh"])
    digest, count = frame(cow, names[0], tmp_path / "cache", source)
    assert count == 0
    assert digest == compiled_frames[names[0]]


@pytest.mark.slow
@pytest.mark.skipif(targets.machine_name() != "x86_64", reason="instructions that no processor of this kind has yet")
def test_kernels_are_compiled_without_being_run(tmp_path):
    """For a processor with registers that this one lacks: had anything been run, the process would have died."""
    from llvmlite import binding

    if binding.get_host_cpu_features().get("egpr"):
        pytest.skip("this processor has them")
    environment = os.environ | {
        "NUMBA_CPU_NAME": "x86-64-v4", "NUMBA_CPU_FEATURES": "+egpr,+ndd,+nf", "DRGS_CACHE_DIR": str(tmp_path),
        "PYTHONPATH": str(ROOT),
    }  # fmt: skip
    command = [sys.executable, "-m", "drgs_blender.compute.prepare", "import"]
    done = subprocess.run(command, env=environment, cwd=ROOT, timeout=900, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert len(kept(tmp_path)) > 3
