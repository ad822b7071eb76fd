"""Small disks in memory, as tests fill and seal them (Linux, root)."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path


def mount(place: Path, options: str) -> bool:
    """Mount a disk with options such as ``size=16k``, or change those of the one that is there; whether that worked."""
    again = place.is_mount()
    place.mkdir(parents=True, exist_ok=True)
    command = ["mount", *([] if again else ["-t", "tmpfs"]), "-o", ("remount," if again else "") + options]
    return bool(shutil.which("mount")) and not subprocess.run([*command, "none", place], capture_output=True).returncode


def unmount(place: Path) -> None:
    """Take a disk away, whoever still looks at it."""
    if place.is_mount():
        subprocess.run(["umount", "-l", place], check=True)
