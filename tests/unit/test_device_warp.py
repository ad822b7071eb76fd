"""Whatever is wrong with Warp or the device is a warning by name, never a frame that fails; and Warp keeps quiet."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cards import DEVICE

from drgs_blender.compute.folders import cache_folder
from drgs_blender.compute.warp.kernels import Launcher, WarpKernel
from drgs_blender.compute.warp.runtime import VERSION, load_module, warp
from drgs_blender.core.errors import Cancelled, DeviceError
from drgs_blender.core.frame import RenderSettings
from drgs_blender.render.backend import CPU
from drgs_blender.render.gpu.select_backend import Backends

CUDA = RenderSettings(device="cuda")


@pytest.fixture(autouse=True)
def afresh() -> Iterator[None]:
    warp.cache_clear()
    yield
    warp.cache_clear()


@pytest.mark.parametrize("module, words", [
    (None, "cannot be imported"), (SimpleNamespace(__version__="1.5.0"), "version 1.5.0"),
    (SimpleNamespace(), "version unknown"),
])  # fmt: skip
def test_warp_that_is_not_the_right_one_is_a_warning(monkeypatch: pytest.MonkeyPatch, module: Any, words: str) -> None:
    monkeypatch.setitem(sys.modules, "warp", module)
    devices = Backends()
    assert devices.select("cuda") is CPU
    (warning,) = devices.warnings(CUDA)
    assert words in warning and "pip install" in warning and warning.endswith("Rendered on the CPU")


def test_the_version_is_that_of_the_packages() -> None:
    text = (Path(__file__).parents[2] / "pyproject.toml").read_text()
    assert f'"warp-lang>={VERSION[:-1]},' in text


def test_started_again_it_keeps_its_kernels_where_they_were() -> None:
    """Else all of them would be compiled a second time."""
    pytest.importorskip("warp", reason="warp-lang is not installed")
    first = warp().config.kernel_cache_dir
    warp.cache_clear()
    assert warp().config.kernel_cache_dir == first


@pytest.mark.slow
def test_warp_prints_nothing_where_programs_read(tmp_path: Path) -> None:
    pytest.importorskip("warp", reason="warp-lang is not installed")
    code = """
import numpy as np
from drgs_blender.compute.folders import cache_folder
from drgs_blender.compute.warp.kernels import Launcher, WarpKernel
def double(thread, stride, scratch, x, out):
    for i in range(thread, len(x), stride):
        out[0][i] = x[i] + x[i]
found = np.zeros(3, np.float32)
"""
    script = f"{code}Launcher('cpu').launch(WarpKernel(double, (), {{}}), 3, [np.ones(3, np.float32)], [found])\n"
    path = tmp_path / "silent.py"
    path.write_text(script + "assert (found == 2).all()\n")
    variables = os.environ | {"DRGS_CACHE_DIR": str(tmp_path)}
    for _ in range(2):
        done = subprocess.run([sys.executable, path], capture_output=True, text=True, env=variables, check=False)
        assert done.returncode == 0, done.stderr
        assert done.stdout == "" and "UserWarning" not in done.stderr


def test_whatever_warp_raises_is_the_devices_failure_but_a_stop_is_none() -> None:
    pytest.importorskip("warp", reason="warp-lang is not installed")
    launcher = Launcher(DEVICE)
    with pytest.raises(DeviceError, match="kernel build failed"), launcher.failures("light"):
        raise Exception("CUDA kernel build failed with error code 6\nlog")
    with pytest.raises(Cancelled), launcher.failures("light"):
        raise Cancelled


def _nothing(thread, stride, scratch, x, out):  # type: ignore[no-untyped-def]
    pass


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Path]:
    """An empty folder of kernels, in use."""
    monkeypatch.setenv("DRGS_CACHE_DIR", str(tmp_path))
    cache_folder.cache_clear()
    yield tmp_path
    cache_folder.cache_clear()


def test_a_folder_of_kernels_that_cannot_be_written_is_the_devices_failure(folder: Path) -> None:
    pytest.importorskip("warp", reason="warp-lang is not installed")
    launcher = Launcher(DEVICE)
    shutil.rmtree(folder / "warp", ignore_errors=True)
    (folder / "warp").write_bytes(b"")
    with pytest.raises(DeviceError, match="nothing"):
        launcher.launch(WarpKernel(_nothing, (), {}), 1, [np.ones(7, np.int8)], [np.zeros(1)])


def test_a_module_that_does_not_load_is_not_kept(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drgs_blender.compute.warp.runtime.warp", lambda: None)
    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            load_module("1 / 0")
    assert [path.suffix for path in (folder / "warp").iterdir() if path.is_file()] == [".py"]
