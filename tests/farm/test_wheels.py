"""What a node without a network gets (docs/farm/nodes.md): wheels, installed where there is no checkout."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

from drgs_blender.cli.find_blender import CHECKOUT, find_blender

from .conftest import PROGRAM, WHOLE, same_pixels

SCRIPTS = "Scripts" if os.name == "nt" else "bin"
#: The page's `blender --command extension install-file`, for Blender as a module.
INSTALL = "import bpy; bpy.ops.extensions.package_install_files(filepath={archive!r}, repo='user_default', "
INSTALL += "enable_on_install=True); bpy.ops.wm.save_userpref()"


def run(*command: object, **options: object) -> str:
    """What a command that must succeed says."""
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, timeout=900, **options)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return done.stdout


def pip(*words: object, **options: object) -> str:
    return run(sys.executable, "-m", "pip", "--disable-pip-version-check", *words, **options)


def node(folder: Path, **variables: str) -> dict[str, str]:
    """Environment of a node: nothing of this checkout, and no place from which pip could fetch."""
    ours = ("DRGS_", "PIP_", "PYTHON")
    kept = {name: value for name, value in os.environ.items() if not name.startswith(ours)}
    return kept | {"PIP_CONFIG_FILE": os.devnull, "DRGS_CACHE_DIR": str(folder / "kernels")} | variables


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of what wheels are made of: setuptools writes into the folder, and takes what it wrote before."""
    folder = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(CHECKOUT / name, folder)
    ignore = shutil.ignore_patterns("__pycache__")
    shutil.copytree(CHECKOUT / "drgs_blender", folder / "drgs_blender", ignore=ignore)
    return folder


@pytest.mark.slow
def test_the_wheel_holds_the_whole_package_and_works_without_a_checkout(source, tmp_path):
    wheels = tmp_path / "wheels"
    pip("wheel", source, "--no-deps", "--wheel-dir", wheels)
    (wheel,) = wheels.iterdir()
    held = {name for name in zipfile.ZipFile(wheel).namelist() if name.startswith("drgs_blender/")}
    assert held == {p.relative_to(source).as_posix() for p in (source / "drgs_blender").rglob("*") if p.is_file()}

    place = tmp_path / "drgs"
    run(sys.executable, "-m", "venv", "--without-pip", place)
    python = shutil.which("python", path=str(place / SCRIPTS))
    environment = node(tmp_path)
    found = "--no-index", "--find-links", wheels
    pip("--python", python, "install", *found, "--no-deps", "drgs-blender", env=environment)
    packages = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip()
    # What the project needs is already here; the checkout, which is there as well by a .pth of its own, is not seen.
    (Path(packages) / "needed.pth").write_text(sysconfig.get_path("purelib"))
    program = shutil.which("drgs", path=str(place / SCRIPTS))
    seen = run(python, "-c", "import drgs_blender; print(drgs_blender.__file__)", cwd=tmp_path, env=environment)
    assert Path(seen.strip()).is_relative_to(place)
    assert "DR-GS can render here." in run(program, "doctor", cwd=tmp_path, env=environment)


@pytest.mark.skipif(not WHOLE, reason="fetches every wheel and compiles the kernels; DRGS_FAULTS=whole runs it")
def test_a_node_without_a_network_renders_what_the_checkout_does(source, folder, tmp_path):
    blender = find_blender()
    if not blender.is_module:
        pytest.skip("needs Blender as a module")
    wheels, place, archive = tmp_path / "wheels", tmp_path / "drgs", tmp_path / "drgs.zip"
    pip("wheel", source, "--wheel-dir", wheels)
    run(sys.executable, CHECKOUT / "tools/extension.py", "--out", archive)

    environment = node(tmp_path, BLENDER_USER_RESOURCES=str(tmp_path / "user"), DRGS_BLENDER=str(blender.program))
    (tmp_path / "user").mkdir()
    run(sys.executable, "-m", "venv", place)
    python = shutil.which("python", path=str(place / SCRIPTS))
    run(python, "-m", "pip", "install", "--no-index", "--find-links", wheels, "drgs-blender", env=environment)
    run(blender.program, "-c", INSTALL.format(archive=str(archive)), env=environment)
    program = shutil.which("drgs", path=str(place / SCRIPTS))
    assert "installed there" in run(program, "doctor", "--node", cwd=tmp_path, env=environment)
    words = ("render", folder / "relative.blend", "--frames", "2", "--samples", 4, "--out")
    run(program, *words, tmp_path / "node/####.exr", cwd=tmp_path, env=environment)
    run(*PROGRAM.split(), *words, tmp_path / "here/####.exr")
    assert same_pixels(tmp_path / "node/0002.exr", tmp_path / "here/0002.exr")
