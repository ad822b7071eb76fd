"""Compiled kernels on disk: what is damaged, foreign or of another version is compiled again; nothing stops work."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import disks
import numba
import numpy as np
import pytest

from drgs_blender.compute import folders, kernel_cache, manifest
from drgs_blender.compute.jit import cfunc, njit, plain

ROOT = Path(__file__).resolve().parents[2]


def _inner(x):
    return x * 2.0


inner = njit(_inner)


def _outer(x):
    return inner(x) + 1.0


def _sum(values):
    total = 0.0
    for i in numba.prange(len(values)):
        total += inner(values[i])
    return total


@pytest.fixture
def use_folder(monkeypatch):
    """Have this process keep kernels in another folder."""

    def use(folder: Path) -> folders.CacheFolder:
        monkeypatch.setenv("DRGS_CACHE_DIR", str(folder))
        folders.cache_folder.cache_clear()
        return folders.cache_folder()

    yield use
    folders.cache_folder.cache_clear()


@pytest.fixture
def folder(tmp_path, use_folder):
    """An empty folder of kernels."""
    return Path(use_folder(tmp_path / "kernels").path)


def kernels(folder: Path) -> list[Path]:
    return sorted(folder.rglob(f"*{kernel_cache.ENDING}"))


def test_what_was_compiled_is_found_by_the_next_process(folder, compiled):
    assert njit(_outer)(3.0) == 7.0
    assert compiled == ["_outer"] and len(kernels(folder)) == 1
    assert njit(_outer)(4.0) == 9.0
    assert compiled == ["_outer"]


def test_only_what_python_calls_is_kept(folder):
    assert njit(_sum, parallel=True)(np.arange(5.0)) == 20.0
    assert [path.name.partition("-")[0] for path in kernels(folder)] == ["_sum"]


def _make(factor: float):
    def scaled(x):
        return factor * x

    return scaled


def _plus_one(x):
    return x + 1.0


def _plus_two(x):
    return x + 2.0


_plus_two.__qualname__ = _plus_one.__qualname__


def _name(function=_inner, kind="kernel", options=None, target=("x86_64-linux", "x86-64-v3", "+avx2"), types="float64"):
    class Codegen:
        magic_tuple = staticmethod(lambda: target)

    cache = kernel_cache.KernelCache(function, kind, options)
    return cache.file_name((getattr(numba.types, types),), Codegen())


@pytest.mark.parametrize(
    "changed",
    [
        {"kind": "callback"},
        {"options": {"error_model": "python"}},
        {"target": ("aarch64-linux", "x86-64-v3", "+avx2")},
        {"target": ("x86_64-linux", "x86-64-v4", "+avx2")},
        {"target": ("x86_64-linux", "x86-64-v3", "+avx512f")},
        {"types": "float32"},
        {"function": _outer},
    ],
)
def test_what_code_depends_on_is_in_its_name(folder, changed):
    assert _name() == _name()
    assert _name(**changed) != _name()


def test_what_functions_of_one_name_do_is_in_their_names(folder):
    assert _name(_plus_one) != _name(_plus_two)
    assert _name(_make(2.0)) == _name(_make(2.0)) != _name(_make(3.0))


@pytest.mark.parametrize("where", ["closure", "numpy", "python", "numba", "llvmlite", "settings", "global"])
def test_what_surrounds_code_is_in_its_name(folder, monkeypatch, where):
    before = _name(_uses_global)
    if where == "closure":
        monkeypatch.setattr(kernel_cache.closure, "digest", lambda path: "0" * 16)
    elif where == "python":
        monkeypatch.setattr(sys.implementation, "cache_tag", "cpython-399")
    elif where == "settings":
        monkeypatch.setattr(numba.config, "BOUNDSCHECK", 1)
    elif where == "global":
        monkeypatch.setitem(globals(), "_FACTOR", 3.0)
    else:
        module = {"numpy": np, "numba": numba, "llvmlite": kernel_cache.llvmlite}[where]
        monkeypatch.setattr(module, "__version__", "99.0")
    assert _name(_uses_global) != before


_FACTOR = 2.0


def _uses_global(x):
    return _FACTOR * x


_LOADED = """
import sys
from drgs_blender.compute.jit import njit
@njit
def double(x): return 2 * x
@njit
def scramble(text): return hash(text)
print(double(4), scramble("drgs") == hash("drgs"), "numba.np.linalg" in sys.modules)
"""


@pytest.mark.slow
def test_numba_s_compiler_is_loaded_only_for_what_is_compiled(tmp_path):
    """It takes a third of a second."""
    program, said = tmp_path / "program.py", []
    program.write_text(_LOADED)
    environment = os.environ | {"DRGS_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(ROOT)}
    for _ in range(2):
        done = subprocess.run([sys.executable, program], env=environment, capture_output=True, text=True, check=True)
        said.append(done.stdout.split())
    assert said == [["8", "True", "True"], ["8", "True", "False"]]


_ENVIRONMENTS = """
import sys
import numpy as np
from drgs_blender.compute.jit import njit
@njit
def turned(a): return np.ascontiguousarray(a[::-1])
@njit
def backwards(a, n):
    if n < 0: raise ValueError("negative", n)
    return turned(a)
print(*backwards(np.arange(3), 0), "numba.np.arrayobj" in sys.modules)
try: backwards(np.arange(3), -7)
except ValueError as error: print(error.args)
"""


@pytest.mark.slow
def test_a_kernel_is_loaded_with_the_environments_that_it_uses_alone(tmp_path):
    """Others would bring modules of Numba; without one, a kernel could not say what is wrong."""
    program, said = tmp_path / "program.py", []
    program.write_text(_ENVIRONMENTS)
    environment = os.environ | {"DRGS_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(ROOT)}
    for _ in range(2):
        done = subprocess.run([sys.executable, program], env=environment, capture_output=True, text=True, check=True)
        said.append(done.stdout.splitlines())
    assert said == [[f"2 1 0 {compiled}", "('negative', -7)"] for compiled in (True, False)]


@pytest.mark.parametrize(("symbol", "times"), [("NRT_decref", 0), ("malloc", 0), ("function_of_nobody", 1)])
def test_what_a_kernel_calls_and_is_not_there_is_loaded_with_the_compiler(monkeypatch, symbol, times):
    target, calls = numba.core.registry.cpu_target.target_context, []
    monkeypatch.setattr(target, "refresh", lambda: calls.append(1))
    with pytest.raises(kernel_cache.DamagedError, match=symbol) if times else contextlib.nullcontext():
        kernel_cache._provide([symbol], target)
    assert len(calls) == times


def test_functions_of_kernels_can_be_called_from_python_before_and_after(folder, compiled):
    helper = njit(_inner)
    namespace = {"helper": helper}
    exec("def first(x): return helper(x) + 1.0\ndef second(x): return helper(x) - 1.0", namespace)
    first, second = (njit(namespace[name], cache=False) for name in ("first", "second"))
    assert first(2.0) == 5.0
    assert helper(2.0) == 4.0  # compiled a second time, as code that Python calls
    assert second(2.0) == 3.0
    assert helper(3.0) == 6.0
    assert compiled == ["first", "_inner", "second"]


def test_functions_out_of_the_cache_can_be_parts_of_kernels(folder):
    njit(_inner)(1.0)
    helper = njit(_inner)
    assert helper(2.0) == 4.0
    namespace = {"helper": helper}
    exec("def kernel(x): return helper(x) + 1.0", namespace)
    assert njit(namespace["kernel"], cache=False)(2.0) == 5.0
    assert helper(3.0) == 6.0


@pytest.mark.parametrize("met_before", [False, True])
def test_functions_out_of_the_cache_can_be_parts_of_callbacks(folder, monkeypatch, met_before):
    """As functions of surfels along rays are: kernels of the list, and parts of what Embree calls."""
    njit(_inner)(1.0)
    monkeypatch.setitem(globals(), "inner", njit(_inner))
    if met_before:
        assert inner(2.0) == 4.0
    for _ in range(2):  # compiled, and out of the cache
        called = cfunc(numba.float64(numba.float64))(_outer)
        assert called.ctypes(2.0) == 5.0
    assert called.cache_hits == 1
    assert inner(3.0) == 6.0


DAMAGES = {
    "empty": lambda data: b"",
    "cut": lambda data: data[: len(data) // 2],
    "longer": lambda data: data + b"\0",
    "one bit": lambda data: data[:-100] + bytes([data[-100] ^ 1]) + data[-99:],
    "no magic": lambda data: b"x" + data[1:],
    "other bytes": lambda data: os.urandom(len(data)),
    "a pickle": lambda data: kernel_cache.pack(b"cos\nsystem\n(S'touch owned'\ntR."),
    "a pickle of its own": lambda data: b"cos\nsystem\n(S'touch owned'\ntR.",
}


@pytest.mark.parametrize("damage", sorted(set(DAMAGES) - {"a pickle"}))
def test_damaged_files_are_compiled_anew_and_mended(folder, compiled, damage, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    njit(_outer)(3.0)
    (path,) = kernels(folder)
    whole = path.read_bytes()
    path.write_bytes(DAMAGES[damage](whole))
    assert njit(_outer)(3.0) == 7.0
    assert compiled == ["_outer", "_outer"]
    assert not (tmp_path / "owned").exists()
    assert njit(_outer)(3.0) == 7.0
    assert compiled == ["_outer", "_outer"]  # the file is whole again


def test_kernels_of_another_numba_are_left_alone(folder, compiled, monkeypatch):
    njit(_outer)(3.0)
    monkeypatch.setattr(numba, "__version__", "0.99.0")
    assert njit(_outer)(3.0) == 7.0
    assert compiled == ["_outer", "_outer"] and len(kernels(folder)) == 2
    monkeypatch.undo()


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="owners are a thing of POSIX")
@pytest.mark.parametrize("foreign", ["others may write", "another user"])
def test_a_folder_of_others_is_not_trusted(tmp_path, use_folder, compiled, foreign):
    mine = use_folder(tmp_path / "kernels").path
    njit(_outer)(3.0)
    if foreign == "another user":
        if os.geteuid() != 0:
            pytest.skip("only root can give a folder away")
        os.chown(mine, 12345, 12345)
    else:
        mine.chmod(0o777)
    again = use_folder(mine)
    assert again.path != mine and str(mine) in again.trouble
    assert njit(_outer)(3.0) == 7.0
    assert compiled == ["_outer", "_outer"]


def test_without_a_folder_kernels_are_kept_as_long_as_the_process_lives(tmp_path, use_folder, compiled):
    (tmp_path / "file").write_text("")
    folder = use_folder(tmp_path / "file" / "kernels")
    assert str(tmp_path / "file") in folder.trouble and folder.path.is_dir()
    assert njit(_outer)(3.0) == 7.0 and njit(_outer)(3.0) == 7.0
    assert compiled == ["_outer"]


def test_a_full_disk_is_named_and_the_kernel_runs(tmp_path, use_folder, compiled):
    disk = tmp_path / "disk"
    if not disks.mount(disk, "size=64k"):
        pytest.skip("no disk can be mounted: not root, or not Linux")
    try:
        folder = use_folder(disk / "kernels")
        assert not folder.trouble
        with contextlib.suppress(OSError), (disk / "ballast").open("wb", buffering=0) as ballast:
            while ballast.write(b"\0" * 1024) == 1024:
                pass
        assert njit(_sum, parallel=True)(np.arange(5.0)) == 20.0
        assert "space" in folder.trouble and str(disk) in folder.trouble
        assert not list(disk.rglob("*.tmp")) and not kernels(disk)
        assert njit(_sum, parallel=True)(np.arange(6.0)) == 30.0
        assert compiled == ["_sum", "_sum"]
    finally:
        disks.unmount(disk)


@pytest.mark.parametrize("years", [-30, 30])
def test_a_clock_that_jumped_harms_nothing(folder, compiled, use_folder, years):
    njit(_outer)(3.0)
    then = time.time() + years * 365 * 24 * 3600
    for path in (*kernels(folder), *folder.iterdir(), folder):
        os.utime(path, (then, then))
    use_folder(folder)
    assert njit(_outer)(3.0) == 7.0
    assert compiled == ["_outer"] * (2 if years < 0 else 1)  # what seems unused for years is removed


def test_what_is_used_is_not_removed(folder, compiled, use_folder):
    njit(_outer)(3.0)
    long_ago = time.time() - 29 * 24 * 3600
    os.utime(kernels(folder)[0].parent, (long_ago, long_ago))
    njit(_outer)(3.0)  # marks it
    assert time.time() - kernels(folder)[0].parent.stat().st_mtime < 3600


_PROGRAM = """
import numpy as np
from drgs_blender.geometry.normals import VertexNormals
print(VertexNormals(np.array([[0, 1, 2]], np.int32), 3)(np.eye(3, dtype=np.float32)).tolist())
"""


def start(cache: Path) -> subprocess.Popen:
    environment = os.environ | {"DRGS_CACHE_DIR": str(cache), "PYTHONPATH": str(ROOT)}
    return subprocess.Popen([sys.executable, "-c", _PROGRAM], env=environment, stdout=subprocess.PIPE, text=True)


@pytest.mark.slow
def test_two_processes_may_compile_at_once(tmp_path):
    answers = [process.communicate(timeout=300)[0] for process in [start(tmp_path), start(tmp_path)]]
    assert answers[0] == answers[1] != ""
    kept = kernels(tmp_path)
    assert len(kept) == 3 and not list(tmp_path.rglob("*.tmp"))
    assert start(tmp_path).communicate(timeout=300)[0] == answers[0]
    assert kernels(tmp_path) == kept


@pytest.mark.slow
def test_what_was_killed_goes_on_where_it_was(tmp_path):
    environment = os.environ | {"DRGS_CACHE_DIR": str(tmp_path), "DRGS_PREPARE": "1"}
    command = [sys.executable, "-m", "drgs_blender.compute.prepare", "import"]
    first = subprocess.Popen(command, env=environment, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 300
    while not kernels(tmp_path) and time.monotonic() < deadline:
        time.sleep(0.02)
    first.kill()
    first.wait()
    known = manifest.needed(["import"])
    kept = kernels(tmp_path)
    assert 0 < len(kept) < len(known)
    before = {path: path.stat().st_mtime_ns for path in kept}
    time.sleep(0.5)  # its workers end with it
    said = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=300, check=True)
    assert said.stdout.splitlines()[-1] == "The engine is ready"
    assert len(kernels(tmp_path)) == len(known)
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in before.items())
    again = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=300, check=True)
    assert again.stdout.splitlines() == ["The engine is ready"]


def test_every_kernel_of_the_list_exists_and_its_types_can_be_read():
    for kernel in manifest.needed(manifest.jobs()):
        assert manifest.dispatcher(kernel).py_func.__qualname__ == kernel.name
        assert kernel_cache.describe(manifest.signature(kernel)) == kernel.arguments


@pytest.mark.parametrize(
    "text", ["array(float32, 2", "nonsense", "drgs_blender.nothing:Tracer(int64)", "(int64", "int64 int64"]
)
def test_a_list_that_does_not_fit_is_passed_over(text):
    with pytest.raises(LookupError):
        manifest.signature(manifest.Kernel("drgs_blender.geometry.normals", "_sum", text, 0.0))


def test_arrays_that_are_read_only_share_a_kernel_with_others(folder, compiled):
    values = np.arange(4.0)
    values.flags.writeable = False
    assert np.shares_memory(plain(values), values) and plain(values).tolist() == values.tolist()
    kernel = njit(_sum, parallel=True)
    assert kernel(plain(values)) == kernel(np.arange(4.0)) == 12.0
    assert compiled == ["_sum"]


def test_callbacks_can_call_functions_that_were_kept(folder):
    """What C calls is compiled by Numba's own compiler, for which kept machine code is nothing to link."""
    njit(_inner)(1.0)
    global inner
    before, inner = inner, njit(_inner)
    try:
        assert inner(2.0) == 4.0
        assert cfunc(numba.types.float64(numba.types.float64))(_outer).ctypes(2.0) == 5.0
        assert numba.njit(_outer)(3.0) == 7.0
        assert inner(3.0) == 6.0
    finally:
        inner = before


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{}",
        "[]",
        '{"kernels": [["m", "f"]], "jobs": {"j": [0]}}',
        '{"kernels": [["m", "f", "int64", 1.0]], "jobs": {"j": [5]}}',
        "[" * 100_000,
    ],
)
def test_a_damaged_list_leaves_all_to_the_first_call(tmp_path, monkeypatch, caplog, text):
    path = tmp_path / "kernels.json"
    path.write_text(text)
    monkeypatch.setattr(manifest, "PATH", path)
    manifest.jobs.cache_clear()
    assert manifest.jobs() == {}
    manifest.jobs.cache_clear()
    assert "Install DR-GS again" in caplog.text


@pytest.mark.parametrize(
    "arguments", ["array(float32, x, C, True, True)", "array(float32, 1, Q, True, True)", "os:path(int64)"]
)
def test_types_that_are_none_are_passed_over(arguments):
    with pytest.raises(LookupError):
        manifest.signature(manifest.Kernel("m", "f", arguments, 0.0))


@pytest.mark.parametrize(
    ("variable", "value", "code"), [("DRGS_CPU_TARGET", "nonsense", 64), ("DRGS_CPU_TARGET", "apple-m1", 69)]
)
def test_preparing_says_what_is_wrong(tmp_path, variable, value, code):
    environment = os.environ | {variable: value, "DRGS_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "drgs_blender.compute.prepare", "import"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == code
    assert value in done.stderr and "Traceback" not in done.stderr and "ready" not in done.stdout


@pytest.mark.slow
def test_an_engine_is_not_called_ready_whose_kernels_cannot_be_kept(tmp_path):
    (tmp_path / "file").write_text("")
    environment = os.environ | {"DRGS_CACHE_DIR": str(tmp_path / "file"), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "drgs_blender.compute.prepare", "import"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 73
    assert str(tmp_path / "file") in done.stderr and "ready" not in done.stdout


def test_workers_compile_the_package_of_the_process_that_started_them(tmp_path):
    """Whatever lies in the working folder, as a checkout does where Blender was started from one."""
    package = tmp_path / "drgs_blender" / "compute"
    package.mkdir(parents=True)
    for path in (package.parent / "__init__.py", package / "__init__.py"):
        path.write_text("")
    (package / "worker.py").write_text("print('done')\n" * 100)
    environment = os.environ | {"DRGS_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(ROOT), "DRGS_SHIPPED": "0"}
    code = f"import sys\nsys.path[0] = {str(ROOT)!r}\nimport drgs_blender.compute.folders\n"
    code += "from drgs_blender.compute import prepare, manifest\n"
    code += "manifest.needed = lambda jobs: [k for k in manifest.jobs()['denoise'] if k.name == 'mix']\n"
    code += "raise SystemExit(prepare.main(['denoise']))\n"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert len(kernels(tmp_path / "cache")) == 1


@pytest.mark.slow
def test_processes_that_compile_at_once_share_the_work(tmp_path):
    """Each kernel is compiled once, by whichever comes first, and both end when all are there."""
    names = "{'mix', '_look_up', '_look_up_rows', '_number', '_spread', '_modulate'}"
    code = "from drgs_blender.compute import prepare, manifest\n"
    code += f"kernels = [k for ks in manifest.jobs().values() for k in ks if k.name in {names}]\n"
    code += "kernels = sorted(set(kernels), key=lambda k: k.name)\n"
    code += "manifest.needed = lambda jobs: kernels\n"
    code += "prepare.processes = lambda: 1\n"
    code += "raise SystemExit(prepare.main(['denoise']))\n"
    records = [tmp_path / "one", tmp_path / "two"]
    environment = os.environ | {"DRGS_CACHE_DIR": str(tmp_path / "cache"), "DRGS_SHIPPED": "0"}
    both = [
        subprocess.Popen([sys.executable, "-c", code], env=environment | {"DRGS_RECORD_KERNELS": str(record)})
        for record in records
    ]
    assert [process.wait(timeout=300) for process in both] == [0, 0]
    compiled = [json.loads(line) for record in records for line in record.read_text().splitlines()]
    compiled = [tuple(map(str, row[:3])) for row in compiled if row[3] > 0]
    assert len(compiled) == len(set(compiled)) == len(kernels(tmp_path / "cache")) >= 6


def test_a_claim_is_one_processes_until_it_ends(tmp_path):
    path = tmp_path / "folder" / ".kernel.lock.tmp"
    first = kernel_cache.Claim.of(path)
    assert first is not None
    assert kernel_cache.Claim.of(path) is None
    first.close()
    second = kernel_cache.Claim.of(path)
    assert second is not None
    second.close()
    (tmp_path / "file").touch()
    assert kernel_cache.Claim.of(tmp_path / "file" / "no folder") is not None  # nothing that would keep from compiling


def test_no_more_workers_than_processors_and_memory_allow(monkeypatch):
    from drgs_blender.compute import prepare

    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1, 2}, raising=False)
    assert 1 <= prepare.processes() <= 3
    monkeypatch.setattr(prepare, "_BYTES", 1 << 60)
    assert prepare.processes() == 1 or sys.platform != "linux"


def test_a_record_that_cannot_be_written_is_warned_of_once(folder, monkeypatch, caplog, tmp_path):
    monkeypatch.setenv("DRGS_RECORD_KERNELS", str(tmp_path / "nowhere" / "record"))
    cache = kernel_cache.KernelCache(_inner)
    for _ in range(2):
        cache._record((numba.types.float64,), 0.0)
    assert len(caplog.messages) == 1 and "DRGS_RECORD_KERNELS" in caplog.messages[0]
