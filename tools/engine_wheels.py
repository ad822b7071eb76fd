"""The wheels that the extension's zips bring: fetched at build time, checked, and made small.

    python tools/engine_wheels.py fetch [linux-x64 ...]  # into build/wheels; what is there is not fetched again
    python tools/engine_wheels.py lock                   # after a change of `VERSIONS`: writes engine_wheels.json

That file names every wheel with its digest, so a build takes the same bytes everywhere. NumPy is Blender's own. Pure
standard library.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import io
import json
import os
import re
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
LOCK = Path(__file__).with_name("engine_wheels.json")
CACHE = ROOT / "build" / "wheels"

#: Blender's platforms for which everything has wheels -> pip's names of them. Numba has left macOS on Intel with 0.63,
#: and embreex and libigl have none for Windows on ARM.
PLATFORMS = {
    "linux-x64": ("manylinux_2_28_x86_64", "manylinux_2_27_x86_64", "manylinux_2_24_x86_64", "manylinux2014_x86_64"),
    "windows-x64": ("win_amd64",),
    "macos-arm64": ("macosx_13_0_arm64", "macosx_12_0_arm64", "macosx_11_0_arm64"),
}


class Series(NamedTuple):
    """The Blenders of one Python.

    Attributes
    ----------
    python : as 3.11
    begin, end : the first version, and the first one that has another Python ("" for none yet)
    """

    python: str
    begin: str
    end: str

    @property
    def tag(self) -> str:
        """As in names of wheels: cp311."""
        return f"cp{self.python.replace('.', '')}"


SERIES = (Series("3.11", "4.2.0", "5.1.0"), Series("3.13", "5.1.0", ""))
#: What `dependencies` of pyproject.toml and their own imports need, and OIDN. scikit-image asks for networkx and
#: imageio, too, which nothing imports that is used of it (tests/blender/test_bundle.py).
VERSIONS = {
    "numba": "0.68.1",
    "llvmlite": "0.50.0",
    "embreex": "4.4.0.post1",
    "scipy": "1.17.1",
    "OpenEXR": "3.5.3",
    "trimesh": "5.2.0",
    "libigl": "2.6.3",
    "scikit-image": "0.26.0",
    "lazy-loader": "0.6",
    "packaging": "26.4",
    "pillow": "13.0.0",
    "tifffile": "2026.3.3",
    "tqdm": "4.70.1",
    "zstandard": "0.25.0",
    "pyoidn": "2.5.1.0",  # not in `dependencies`: the denoiser that artists expect
    "cffi": "2.1.1",
    "pycparser": "3.12",
}
#: The last one that takes the NumPy of Blender 4.2, which is 1.24.
OLDER = {("scipy", "3.11"): "1.15.3"}

#: Files of wheels that nothing reads when the engine runs.
_UNUSED = re.compile(
    r"(^|/)tests/|^(share|include|lib|lib64|bin)/|\.(a|lib|pdb|cmake)$"  # tests; what is for compilers
    r"|^skimage/data/(?!__init__)"  # example pictures
    r"|^embree-vars|^igl/\w+/|^zstandard/_cffi"  # parts of libigl that nothing here calls, what only PyPy loads
    # programs and cards of OIDN, and copies that stand for links
    r"|^pyoidn/.*(_device_(cuda|hip|sycl)|/bin/oidn|/(lib)?(ur_|umf|sycl)|/libtbb\w*\.so(\.\d+\.\d+)?$)"
)
#: Stays wherever it lies: licences ask for it.
_LICENCE = re.compile(r"(^|/)(licen[cs]e|copying|notice|third.party|authors)[^/]*$", re.IGNORECASE)
#: Bytes from which a file is packed by LZMA, which takes a third of libraries such as LLVM's off.
_LARGE = 1 << 16
_DATE = (2025, 1, 1, 0, 0, 0)


class WheelError(ValueError):
    """Why there is no set of wheels; the message is for whoever builds."""


def locked(platform: str, python: str) -> dict[str, str]:
    """File name -> SHA-256 of the wheels for a platform and a Python, as `tools/engine_wheels.json` has them.

    Raises
    ------
    WheelError
        There is no such set.
    """
    table = json.loads(LOCK.read_text(encoding="utf-8"))
    try:
        return {name: table["sha256"][name] for name in table["sets"][f"{platform} {python}"]}
    except KeyError as error:
        raise WheelError(
            f"tools/engine_wheels.json has no wheels for {platform} with Python {python} ({error})"
        ) from None


def missing(platform: str, python: str) -> list[str]:
    """Files of a set that are not in `CACHE`."""
    return [name for name in locked(platform, python) if not (CACHE / name).is_file()]


def fetch(platform: str, python: str) -> list[Path]:
    """Wheels of a set, as their authors made them, in `CACHE`; fetches those that are not there.

    Raises
    ------
    WheelError
        pip cannot get one, or a file is not that of the lock.
    """
    names = locked(platform, python)
    for name in missing(platform, python):
        print(f"fetches {name}", flush=True)
        distribution, version, *_, abi, tags = name.removesuffix(".whl").split("-")
        _download(f"{distribution}=={version}", python, () if tags == "any" else tags.split("."), (abi,))
    for name, digest in names.items():
        path = CACHE / name
        if not path.is_file():
            raise WheelError(f"{name} was not what pip fetched; is tools/engine_wheels.json of these versions?")
        if hashlib.sha256(path.read_bytes()).hexdigest() != digest:
            raise WheelError(f"{path} is not the file of tools/engine_wheels.json; delete it, and it is fetched again")
    return [CACHE / name for name in names]


def slim_all(wheels: Sequence[Path]) -> list[Path]:
    """`slim` of each, side by side, as LZMA leaves Python's lock alone; says each that is not there yet."""

    def packed(wheel: Path) -> Path:
        if (target := _slimmed(wheel)).is_file():
            return target
        began = time.monotonic()
        made = slim(wheel)
        size, seconds = made.stat().st_size / 1e6, time.monotonic() - began
        print(f"packed {wheel.name}, {size:.1f} MB, in {seconds:.0f} s", flush=True)
        return made

    if waiting := sum(not _slimmed(wheel).is_file() for wheel in wheels):
        print(f"packs {waiting} wheels, once; the largest take minutes", flush=True)
    largest = sorted(set(wheels), key=lambda wheel: -wheel.stat().st_size)  # first, so that nothing waits for it alone
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:  # some 300 MB each
        made = dict(zip(largest, pool.map(packed, largest), strict=True))
    return [made[wheel] for wheel in wheels]


def slim(wheel: Path) -> Path:
    """A wheel without what is never read, packed more tightly, under the same name; kept beside `wheel`.

    Its metadata and licences stay, its RECORD lists what is left. Blender unpacks it as it does any other.
    """
    target = _slimmed(wheel)
    if target.is_file():
        return target
    target.parent.mkdir(exist_ok=True)
    partial = target.with_suffix(".part")
    with zipfile.ZipFile(wheel) as old, zipfile.ZipFile(partial, "w") as new:
        for name in sorted(i.filename for i in old.infolist() if not i.is_dir() and not _is_unused(i.filename)):
            data = old.read(name)
            if re.fullmatch(r"[^/]+\.dist-info/RECORD", name):
                data = _without_unused(data)
            entry = zipfile.ZipInfo(name, _DATE)
            entry.external_attr = old.getinfo(name).external_attr or 0o644 << 16
            entry.compress_type = zipfile.ZIP_LZMA if len(data) >= _LARGE else zipfile.ZIP_DEFLATED
            new.writestr(entry, data, compresslevel=9)
    partial.replace(target)
    return target


def _slimmed(wheel: Path) -> Path:
    rules = hashlib.sha256(f"{_LARGE} {_UNUSED.pattern} {_LICENCE.pattern}".encode()).hexdigest()[:8]
    return wheel.parent / f"slim-{rules}" / wheel.name


def is_ready(platform: str, python: str) -> bool:
    """Whether a zip can be built without a network, in a moment."""
    return all((CACHE / name).is_file() and _slimmed(CACHE / name).is_file() for name in locked(platform, python))


def _is_unused(name: str) -> bool:
    return _UNUSED.search(name) is not None and _LICENCE.search(name) is None


def _without_unused(record: bytes) -> bytes:
    rows = csv.reader(io.StringIO(record.decode("utf-8"), newline=""))
    out = io.StringIO(newline="")
    csv.writer(out, lineterminator="\n").writerows(row for row in rows if row and not _is_unused(row[0]))
    return out.getvalue().encode()


def _download(requirement: str, python: str, platforms: Iterable[str], abis: Sequence[str]) -> list[Path]:
    """What pip fetches for one requirement, moved to `CACHE`."""
    CACHE.mkdir(parents=True, exist_ok=True)
    options = [f"--platform={name}" for name in platforms] + [f"--abi={abi}" for abi in abis]
    with tempfile.TemporaryDirectory(dir=CACHE) as folder:
        done = subprocess.run(
            [sys.executable, "-m", "pip", "download", "--no-deps", "--only-binary=:all:", "--no-input", "-d", folder,
             f"--python-version={python}", "--implementation=cp", *options, requirement],
            capture_output=True, text=True,
        )  # fmt: skip
        if done.returncode:
            reason = next((t for t in reversed(done.stderr.splitlines()) if "ERROR" in t), "pip gives no reason")
            raise WheelError(f"{requirement} for Python {python}: {reason}")
        return [path.replace(CACHE / path.name) for path in sorted(Path(folder).glob("*.whl"))]


def lock() -> None:
    """Fetch what `VERSIONS` names for all platforms and Pythons, and write its names and digests."""
    sets: dict[str, list[str]] = {}
    digests: dict[str, str] = {}
    for series in SERIES:
        for platform, tags in PLATFORMS.items():
            found: list[Path] = []
            for name, version in VERSIONS.items():
                wanted = f"{name}=={OLDER.get((name, series.python), version)}"
                print(platform, series.python, wanted, flush=True)
                found += _download(wanted, series.python, tags, (series.tag, "abi3", "none"))
            sets[f"{platform} {series.python}"] = sorted(path.name for path in found)
            digests |= {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in found}
    text = json.dumps({"sets": sets, "sha256": dict(sorted(digests.items()))}, indent=1)
    LOCK.write_text(text + "\n", encoding="utf-8")


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("action", choices=("fetch", "lock"))
    parser.add_argument("platforms", nargs="*", metavar="PLATFORM", help=f"of {', '.join(PLATFORMS)} (default: all)")
    options = parser.parse_args()
    try:
        if options.action == "lock":
            lock()
        for platform in options.platforms or PLATFORMS:
            for series in SERIES:
                total = sum(path.stat().st_size for path in fetch(platform, series.python))
                print(f"{platform}, Python {series.python}: {total / 1e6:.0f} MB in {CACHE}")
    except (OSError, WheelError) as error:
        print(f"engine_wheels.py: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
