"""Compile all kernels of `kernels.json` for fixed targets and put them into archives that a release brings.

A target of this machine's architecture needs no processor that has it: code is compiled and never run. Another
system or architecture needs a machine of its own, where the same command writes its archives beside these.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "drgs_blender"
FOLDER = PACKAGE / "compute" / "kernels"
VERSIONS = "versions.json"
_DATE = (2025, 1, 1, 0, 0, 0)
#: Asked of an interpreter.
_FACTS = """
import importlib.util, json, sys, numba, numpy, llvmlite
from drgs_blender.compute import closure
versions = {"numba": numba.__version__, "llvmlite": llvmlite.__version__}
name = f"{sys.implementation.cache_tag}-numpy{numpy.__version__.partition('.')[0]}"
print(json.dumps([name, closure.shipped_index(), importlib.util.find_spec("torch") is not None, versions]))
"""
#: The job whose kernels need PyTorch.
_RECONSTRUCT = "reconstruct"
#: What is still to be compiled, and what cannot be.
_NOT_COMPILED = """
import json, sys
from drgs_blender.compute import manifest, prepare
kernels = manifest.needed(sys.argv[1:])
gone = []
for kernel in kernels:
    try:
        manifest.dispatcher(kernel), manifest.signature(kernel)
    except LookupError as error:
        gone.append(str(error))
print(json.dumps([len(kernels), [f"{k.module}:{k.name}" for k in prepare.not_compiled(kernels)] + gone]))
"""


class BuildError(Exception):
    """Why there are no archives; the message is for whoever builds."""


def sources_digest(package: Path = PACKAGE) -> str:
    """Digest of the sources of which kernels are made."""
    total = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        total.update(path.relative_to(package).as_posix().encode() + b"\0" + path.read_bytes())
    return total.hexdigest()


def build(targets: Sequence[str], pythons: Sequence[str], out: Path = FOLDER, jobs: Sequence[str] = ()) -> list[Path]:
    """Compile and write archives.

    Parameters
    ----------
    targets : sequence of str
        Names of `drgs_blender.compute.targets.TARGETS`; none are all of this machine's architecture and system.
    pythons : sequence of str
        Interpreters that have the engine's packages; their kernels lie side by side in the archives.
    out : Path
        Folder of the archives and of `VERSIONS`.
    jobs : sequence of str
        Of `manifest.jobs`; none are all.

    Returns
    -------
    list of Path
        The archives.

    Raises
    ------
    BuildError
    """
    sys.path.insert(0, str(ROOT))
    from drgs_blender.compute import manifest, shipped
    from drgs_blender.compute.targets import here

    known = {target.name: target for target in here()}
    if wrong := set(targets) - set(known):
        raise BuildError(f"cannot be built here: {', '.join(sorted(wrong))}; there are {', '.join(known) or 'none'}")
    jobs = jobs or list(manifest.jobs())
    asked, versions = _facts(pythons)
    made, sources = [], {}
    with tempfile.TemporaryDirectory() as temporary:
        copy = Path(temporary) / "sources"  # what is edited meanwhile is no part of it
        shutil.copytree(PACKAGE, copy / PACKAGE.name, ignore=shutil.ignore_patterns("__pycache__", FOLDER.name))
        for name in targets or known:
            for python, (tag, index, has_torch) in asked.items():
                print(f"{name}, {tag}{'' if has_torch else ': no PyTorch, so nothing of reconstruction'}", flush=True)
                folder = Path(temporary) / name / tag
                target = {"NUMBA_CPU_NAME": known[name].cpu, "NUMBA_CPU_FEATURES": known[name].features}
                _compile(python, copy, folder, target, [j for j in jobs if has_torch or j != _RECONSTRUCT])
                sources[index] = next(folder.glob("sources-*.json")).read_bytes()
            made.append((shipped.archive_name(name), _pack(Path(temporary) / name)))
        digest = sources_digest(copy / PACKAGE.name)
    facts: dict[str, object] = {"pythons": sorted(tag for tag, *_ in asked.values()), **versions, "sources": digest}
    return _write(out, made, sources, facts)


def _facts(pythons: Sequence[str]) -> tuple[dict[str, tuple[str, str, bool]], dict[str, str]]:
    """Interpreter -> its name, that of its index of sources, whether it has PyTorch; and the versions of all."""
    asked, found = {}, {}
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    for python in (os.path.abspath(shutil.which(name) or name) for name in pythons):
        answer = subprocess.run([python, "-c", _FACTS], capture_output=True, text=True, timeout=300, env=environment)
        if answer.returncode:
            raise BuildError(f"{python} lacks the engine's packages: {answer.stderr.strip().splitlines()[-1]}")
        *names, found[python] = json.loads(answer.stdout)
        asked[python] = names[0], names[1], names[2]
    if len({json.dumps(versions) for versions in found.values()}) != 1:
        raise BuildError(f"the interpreters have different versions, a release brings one: {found}")
    return asked, next(iter(found.values()))


def _compile(python: str, source: Path, folder: Path, target: dict[str, str], jobs: Sequence[str]) -> None:
    """Fill a cache folder from the package in `source`, by as many workers as there are processors."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("DRGS_", "NUMBA_"))}
    environment |= target | {"DRGS_CACHE_DIR": str(folder), "PYTHONPATH": str(source)}
    command = [python, "-m", "drgs_blender.compute.prepare", *jobs]
    if subprocess.run(command, env=environment, cwd=source, timeout=3600).returncode:
        raise BuildError("compiling failed; its message is above")
    answer = subprocess.run(
        [python, "-c", _NOT_COMPILED, *jobs], env=environment, cwd=source, timeout=600, capture_output=True, text=True
    )
    if answer.returncode:
        raise BuildError(f"cannot be checked: {answer.stderr.strip()[-500:]}")
    _, lacking = json.loads(answer.stdout.splitlines()[-1])
    if lacking:
        raise BuildError(f"{python}: not compiled: {', '.join(lacking)}")


def _pack(folder: Path) -> bytes:
    """An archive of all kernels in a cache folder: in alphabetical order, without times."""
    path = folder / "archive.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for kernel in sorted(folder.glob("*/*/*.kernel"), key=lambda p: p.name):
            entry = zipfile.ZipInfo(kernel.name, _DATE)
            entry.external_attr, entry.compress_type = 0o644 << 16, zipfile.ZIP_DEFLATED
            archive.writestr(entry, kernel.read_bytes())
    return path.read_bytes()


def _write(out: Path, made: list[tuple[str, bytes]], sources: dict[str, bytes], facts: dict[str, object]) -> list[Path]:
    """Archives, the index of sources, and last what they fit; archives that fit something else go."""
    out.mkdir(parents=True, exist_ok=True)
    versions = out / VERSIONS
    if versions.is_file() and json.loads(versions.read_text(encoding="utf-8")) != facts:
        for old in (versions, *out.glob("*.zip"), *out.glob("sources-*.json")):
            old.unlink()
    for name, data in [*made, *sources.items(), (VERSIONS, (json.dumps(facts, indent=1) + "\n").encode())]:
        partial = out / f"{name}.part"
        partial.write_bytes(data)
        partial.replace(out / name)
    return [out / name for name, _ in made]
