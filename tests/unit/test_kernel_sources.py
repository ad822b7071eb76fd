"""Sources of kernels that change, vanish or cannot be read while a process runs, and Numba of an untested version."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow  # each starts programs that load Numba

ROOT = Path(__file__).resolve().parents[2]
KERNEL = "from drgs_blender import helper\nfrom drgs_blender.compute.jit import njit\n"
KERNEL += "@njit\ndef f(x): return x + helper.K\n"
#: Calls the kernel of a module, once a file holds another text, or none, if that is asked for.
PROGRAM = """
import changing, os, pathlib, sys, time
name, text, *stamp = sys.argv[1:] or ("", "")
if name:
    path, before = pathlib.Path(name), os.stat(name)
    path.unlink()
    if text:
        path.write_text(text)
    if stamp:
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
print(changing.f(1.0))
"""


@pytest.fixture
def run(tmp_path):
    """Function that runs the program in a folder with a copy of the package; returns what it printed."""
    package = tmp_path / "drgs_blender"
    for part in ("compute", "core"):
        shutil.copytree(
            ROOT / "drgs_blender" / part, package / part, ignore=shutil.ignore_patterns("__pycache__", "*.zip")
        )
    shutil.copy(ROOT / "drgs_blender/__init__.py", package)
    (package / "helper.py").write_text("K = 1.0\n")
    (tmp_path / "changing.py").write_text(KERNEL)
    (tmp_path / "program.py").write_text(PROGRAM)

    def go(*arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
        environment = {"DRGS_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": str(tmp_path), "DRGS_SHIPPED": "0"}
        # Python itself takes a source of the same size and time for the same.
        environment["PYTHONDONTWRITEBYTECODE"] = "1"
        command = [sys.executable, tmp_path / "program.py", *arguments]
        return subprocess.run(
            command, env=os.environ | environment | variables, cwd=tmp_path, capture_output=True, text=True, check=True
        )

    return go


@pytest.mark.parametrize(
    ("name", "text"),
    [("changing.py", KERNEL.replace("x +", "x + 999.0 +")), ("drgs_blender/helper.py", "K = 1000.0\n")],
)
def test_code_is_not_kept_under_the_name_of_sources_that_changed_after_it_was_imported(run, name, text):
    """What runs is the code of before, what the name would say is that of now: of a kernel and of what it imports."""
    first = run(name, text)
    assert first.stdout.strip() == "2.0" and "changed after they were imported" in first.stderr
    assert run().stdout.strip() == "1001.0"


def test_a_source_that_changed_and_kept_its_size_and_time_is_noticed(run):
    """As files do that are unpacked or copied over others."""
    assert run("drgs_blender/helper.py", "K = 3.0\n", "keep the time").stdout.strip() == "2.0"
    assert run().stdout.strip() == "4.0"


@pytest.mark.parametrize(("name", "text"), [("changing.py", ""), ("drgs_blender/helper.py", "def (")])
def test_a_source_that_is_gone_or_half_written_stops_no_kernel(run, name, text):
    done = run(name, text)
    assert done.stdout.strip() == "2.0" and "sources cannot be read" in done.stderr


@pytest.mark.parametrize("damage", [b"", b"x", b"[" * 100_000, b"0" * 64 + b"\n{}", b"null"])
def test_a_damaged_index_of_sources_stops_no_start(run, tmp_path, damage):
    assert run().stdout.strip() == "2.0"
    (index,) = (tmp_path / "cache").glob("sources-*.json")
    whole = index.read_bytes()
    index.write_bytes(damage)
    assert run().stdout.strip() == "2.0"
    assert index.read_bytes() == whole


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can give a file away")
def test_a_kernel_of_another_user_in_a_folder_of_this_one_is_not_loaded(run, tmp_path):
    run()
    (kernel,) = (tmp_path / "cache").rglob("*.kernel")
    os.chown(kernel, 12345, 12345)
    assert run().stdout.strip() == "2.0"
    assert kernel.stat().st_uid == 0, "it was compiled again, and written"


UNTESTED = "import numba\nnumba.__version__ = '0.99.0'\n"


def test_with_a_numba_that_was_not_tested_kernels_are_numbas_own_and_follow_their_sources(run, tmp_path):
    program = tmp_path / "program.py"
    program.write_text(UNTESTED + PROGRAM)
    assert run().stdout.strip() == "2.0"
    kept = [path for path in (tmp_path / "cache").rglob("*.nb?") if "numba-" in str(path)]
    assert kept, "Numba keeps them in the folder of this user"
    (tmp_path / "drgs_blender/helper.py").write_text("K = 5.0\n")
    assert run().stdout.strip() == "6.0", "what is imported counts as well"


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="permissions are a thing of POSIX")
def test_with_a_numba_that_was_not_tested_an_open_folder_is_not_trusted(run, tmp_path):
    (tmp_path / "program.py").write_text(UNTESTED + PROGRAM)
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache").chmod(0o777)
    assert "others may write" in " ".join(run().stderr.split()).replace("other users", "others")
    assert not list((tmp_path / "cache").rglob("*.nb?"))
