"""Clones of commits, each with an environment of its own that has this one's packages."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from report import ROOT

sys.path.insert(0, str(ROOT / "tools"))
from environments import blender, borrowing


class Checkout:
    """A clone of one commit, and what runs its programs.

    Parameters
    ----------
    commit : str
    folder : Path
        Made for it.

    Attributes
    ----------
    root : Path
        The clone; what lies beside this checkout is beside it.
    python : Path
        Interpreter that imports from it.
    environment : dict of str to str
        Variables, with a cache folder of its own.
    """

    def __init__(self, commit: str, folder: Path) -> None:
        self.root = folder / "checkout"
        folder.mkdir()
        subprocess.run(["git", "clone", "--quiet", "--shared", "--no-checkout", ROOT, self.root], check=True)
        subprocess.run(["git", "-C", self.root, "checkout", "--quiet", "--detach", commit], check=True)
        if (ROOT.parent / "shared").is_dir():
            (folder / "shared").symlink_to(ROOT.parent / "shared")
        (self.root / ".venv-blender").symlink_to(blender().parent.parent)
        self.python, _ = borrowing(folder / "environment", self.root)
        paths = os.pathsep.join(map(str, (self.root, self.root / "bench")))
        own = {"PYTHONPATH": paths, "DRGS_ENGINE": str(self.python), "DRGS_SHIPPED": "0"}
        self.environment = os.environ | own | {"DRGS_CACHE_DIR": str(folder / "kernels")}
