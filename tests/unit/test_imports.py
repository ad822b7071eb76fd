"""What may be imported where: the light part with numpy alone, relighting without torch."""

from __future__ import annotations

import gc
import subprocess
import sys
from pathlib import Path

import pytest

from drgs_blender.core.loading import many_imports

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "drgs_blender"
#: What runs inside Blender (a test of the ranks holds that the extension uses nothing else).
LIGHT = ("core", "ipc")

BLOCK = """
import sys
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.split('.')[0] in {blocked!r}:
            raise ImportError(name + ' is blocked by this test')
sys.meta_path.insert(0, Block())
"""


def run_blocked(blocked: set[str], program: str) -> subprocess.CompletedProcess:
    code = BLOCK.format(blocked=blocked) + program
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, cwd=ROOT)


def dotted(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def test_light_part_imports_with_numpy_alone():
    blocked = {"bpy", "torch", "numba", "embreex", "OpenEXR", "scipy", "trimesh", "igl", "PIL", "tqdm", "skimage"}
    paths = [path for name in LIGHT for path in sorted((PACKAGE / name).rglob("*.py"))]
    names = [dotted(path) for path in paths]
    result = run_blocked(blocked, "import importlib\n" + "".join(f"importlib.import_module({n!r})\n" for n in names))
    assert result.returncode == 0, result.stderr


def test_command_line_starts_without_heavy_imports():
    program = "from drgs_blender.cli.main import main\nsys.exit(main(['--version']))"
    result = run_blocked({"bpy", "torch", "numba", "embreex", "OpenEXR", "scipy", "trimesh", "igl"}, program)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("drgs ")


@pytest.mark.parametrize("module", ["drgs_blender.engine.session", "drgs_blender.render.pipeline"])
def test_relighting_imports_without_torch(module):
    result = run_blocked({"torch", "bpy", "skimage"}, f"import {module}")
    assert result.returncode == 0, result.stderr


#: What a first picture needs none of, and no other package imports for it.
LATER = (
    "torch", "trimesh", "PIL", "OpenEXR", "igl", "skimage", "tifffile", "warp", "scipy.sparse", "argparse", "asyncio",
    "drgs_blender.render.gpu.warp_backend", "drgs_blender.formats", "drgs_blender.build",
)  # fmt: skip


def test_an_engine_starts_with_nothing_that_it_needs_later():
    program = f"""
import sys
import drgs_blender.engine.server, drgs_blender.engine.jit_events, drgs_blender.engine.session
print(*set({LATER!r}) & set(sys.modules))
"""
    result = run_blocked(set(), program)
    assert (result.stdout.strip(), result.returncode) == ("", 0), result.stderr


def test_an_engine_collects_garbage_when_it_works():
    code = "import gc, runpy\nfrom drgs_blender.engine import server\nserver.main = lambda: print(gc.isenabled())\n"
    code += "runpy.run_module('drgs_blender.engine', run_name='__main__')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout == "True\n"


def test_garbage_is_collected_again_after_imports():
    try:
        with pytest.raises(ImportError), many_imports():
            assert not gc.isenabled()
            raise ImportError("a part is missing")
        assert gc.isenabled()
        assert gc.get_freeze_count()
    finally:
        gc.unfreeze()  # or the objects of all tests before would never be freed
