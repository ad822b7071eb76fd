"""Find a Blender: the program, or a Python interpreter that has it as a module."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

from ..core.errors import DeviceError, UsageError

#: The folder that holds this package: the extension's source when it is a checkout.
CHECKOUT = Path(__file__).resolve().parents[2]
_REMEDY = "Name a blender program, or a Python that has the module bpy, with --blender or DRGS_BLENDER"


@dataclass(frozen=True, slots=True)
class Blender:
    """A way to run a script in Blender; ``origin`` says how it was found."""

    program: Path
    origin: str

    @property
    def is_module(self) -> bool:
        """Whether ``program`` is a Python that has Blender as a module."""
        return self.program.stem.lower().startswith(("python", "pypy"))

    def command(self, script: Path) -> list[str]:
        """Command that runs `script` without a window."""
        if self.is_module:
            return [str(self.program), "-P", str(script)]
        return [str(self.program), "--background", "-noaudio", "--python-exit-code", "70", "--python", str(script)]

    def version(self) -> str:
        """Version of this Blender, such as "5.0.1".

        Raises
        ------
        DeviceError
            When it does not start; with its last log line.
        """
        ask = ["-c", "import bpy; print('Blender', bpy.app.version_string)"] if self.is_module else ["--version"]
        try:
            result = subprocess.run(
                [self.program, *ask], capture_output=True, encoding="utf-8", errors="replace", timeout=120
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise DeviceError(f"Blender at {self.program}", f"does not start ({error})", _REMEDY) from error
        found = re.search(r"^Blender (\d+\.\d+\.\d+)", result.stdout, re.M)
        if result.returncode or not found:
            words = (result.stderr.strip() or result.stdout.strip() or "no output").splitlines()[-1]
            raise DeviceError(f"Blender at {self.program}", f"does not start ({words})", _REMEDY)
        return found[1]


def find_blender(explicit: str | None = None) -> Blender:
    """Find Blender: `explicit`, the variable DRGS_BLENDER, ``blender`` on the PATH, ``.venv-blender`` of a checkout.

    Raises
    ------
    UsageError
        `explicit` is not a program.
    DeviceError
        DRGS_BLENDER is not a program, or there is no Blender anywhere.
    """
    for given, origin, kind in (
        (explicit, "--blender", UsageError),
        (os.environ.get("DRGS_BLENDER"), "DRGS_BLENDER", DeviceError),
    ):
        if given:
            if not (program := shutil.which(given) or program_in(Path(given))):
                raise kind(f"{origin} {given}", "is not a program that can be run", _REMEDY)
            return Blender(Path(program), origin)
    if program := shutil.which("blender"):
        return Blender(Path(program), "PATH")
    if program := program_in(CHECKOUT / ".venv-blender"):
        return Blender(Path(program), "checkout")
    raise DeviceError("Blender", "was not found", _REMEDY)


def program_in(folder: Path) -> str | None:
    """The program in the folder of a virtual environment that has bpy, or of an unpacked Blender."""
    for name in ("blender", "blender.exe", "bin/python", "Scripts/python.exe"):
        if program := shutil.which(folder / name):
            return program
    return None


def extension_source() -> Path | None:
    """The extension's folder when this package lies in one (a checkout or an unpacked extension), else None."""
    return CHECKOUT if (CHECKOUT / "blender_manifest.toml").is_file() else None
