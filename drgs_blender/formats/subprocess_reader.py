"""Read files in a subprocess with resource limits: libraries may hang or crash on damaged files, or exhaust memory.

The subprocess gets a file to read and one to write arrays to. Its exit code says how it ended, and the last line of its
stderr why. Processor time, memory and time by the clock are limited, in proportion to the file's size.
"""

from __future__ import annotations

import math
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from ..core import own_python
from ..core.asset.archive import first_reason
from ..core.asset.tensors import decode, encode
from ..core.errors import AssetError, DeviceError, WriteError

Array = np.ndarray

#: Exit codes: the file is refused (the reason is the last line of stderr), the library is not installed, the arrays
#: cannot be written (likewise).
REFUSED, NOT_INSTALLED, FULL = 65, 69, 73
#: Limit of processor time: seconds for starting the library, and bytes of the file per further second.
SECONDS, _PACE = 5.0, 1 << 20
#: Limit of time by the clock, in multiples of that of processor time: the machine may be busy, and waiting takes no
#: processor time.
PATIENCE = 20
#: Limit of memory (Linux): bytes for the library, and bytes per byte of the file.
_MEMORY, _RATIO = 8 << 30, 32
REMEDY = "Export it again, or restore it from a copy"


def write_arrays(source: str, target: str, kind: str, read: Callable[[str], Mapping[str, Array]]) -> None:
    """In the subprocess: write what `read` makes of `source` to `target`; exit with a code where that fails.

    Parameters
    ----------
    source, target : str
    kind : str
        Name of such files in errors.
    read : callable
    """
    try:
        arrays = read(source)
    except AssetError as error:
        sys.stderr.write(f"\n{error.problem}\n")
        sys.exit(REFUSED)
    except ImportError:
        sys.exit(NOT_INSTALLED)
    except Exception as error:  # what libraries raise of damaged files has no common type
        sys.stderr.write(f"\ncannot be read as {kind} ({first_reason(str(error) or type(error).__name__)})\n")
        sys.exit(REFUSED)
    try:
        with open(target, "wb") as file:
            file.writelines(encode(arrays))
    except OSError as error:
        sys.stderr.write(f"\n{error.strerror or error}\n")
        sys.exit(FULL)


def limit(most_bytes: int, most_seconds: int) -> None:
    """In the subprocess: set limits beyond which it fails, and write no core dump where it crashes.

    Memory is limited on Linux, processor time everywhere but on Windows.
    """
    if sys.platform == "win32":
        return
    import resource

    limits = {resource.RLIMIT_CPU: most_seconds, resource.RLIMIT_CORE: 0}
    if sys.platform.startswith("linux"):
        limits[resource.RLIMIT_AS] = most_bytes
    for kind, wanted in limits.items():
        now, most = resource.getrlimit(kind)
        known = [limit for limit in (now, most) if limit != resource.RLIM_INFINITY]
        resource.setrlimit(kind, (min([wanted, *known]), most))


def read_in_subprocess(
    path: Path,
    module: str,
    kind: str,
    missing_library: tuple[str, str],
    remedies: Mapping[str, str] | None = None,
    seconds: float = SECONDS,
    patience: float = PATIENCE,
) -> dict[str, Array]:
    """The arrays that ``module.main`` writes, in a subprocess with limits in proportion to the file.

    Parameters
    ----------
    path : Path
    module : str
        Dotted name; its `main` takes a source, a target and the two limits as text.
    kind : str
        Name of such files in errors.
    missing_library : tuple of str
        Problem and remedy where its library is not installed.
    remedies : mapping of str to str, optional
        Reason for which a file is refused -> what to do, where that is not `REMEDY`.
    seconds, patience : float
        Of processor time for a small file; how many times as long by the clock.

    Raises
    ------
    AssetError
        The file is damaged, or of a kind that is not read.
    DeviceError
        The library is not installed.
    WriteError
        There is no room for what is handed over.
    """
    subject, size = str(path), path.stat().st_size
    try:
        subject.encode()
    except UnicodeEncodeError as error:
        raise AssetError(subject, f"has a path that is no text, and {kind} takes no other", "Rename it") from error
    most = math.ceil(seconds + size / _PACE)
    slow = AssetError(subject, f"keeps {kind} busy for longer than such a file can take", REMEDY)
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "arrays"
        # The package as it is here, wherever that comes from.
        code = f"import sys; sys.path.insert(0, sys.argv[1]); from {module} import main; main(*sys.argv[2:])"
        arguments = Path(__file__).resolve().parents[2], path.absolute(), target, _MEMORY + _RATIO * size, most
        command = [*own_python.command(), "-c", code, *map(str, arguments)]
        try:
            done = subprocess.run(command, capture_output=True, timeout=patience * most, stdin=subprocess.DEVNULL)
        except subprocess.TimeoutExpired as error:
            raise slow from error
        except OSError as error:
            raise DeviceError(subject, f"cannot be read: Python does not start ({error})", "See drgs doctor") from error
        if done.returncode == -getattr(signal, "SIGXCPU", 0):  # Windows has no such signal
            raise slow
        if done.returncode == NOT_INSTALLED:
            raise DeviceError(subject, *missing_library)
        reason = (done.stderr.decode(errors="replace").strip().splitlines() or [""])[-1][:300]
        if done.returncode == FULL:
            problem = f"cannot hold what is in {subject} ({reason})"
            raise WriteError(folder, problem, "Free space there, or name another folder by the variable TMPDIR")
        if done.returncode:
            known = done.returncode == REFUSED and reason
            problem = reason if known else f"cannot be read: {kind} crashes on it"
            raise AssetError(subject, problem, (remedies or {}).get(reason, REMEDY))
        return decode(np.fromfile(target, np.uint8), subject)
