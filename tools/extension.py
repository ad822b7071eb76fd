"""Build the Blender extension's zip and check what Blender's own validator lets through.

With it goes ``dist/index.json``: the folder, on any web server, is a repository for Preferences > Get Extensions.

    python tools/extension.py [--out dist/drgs-0.1.0.zip] [--kernels]
    python tools/extension.py --platform linux-x64 --kernels     # or: all

Without a platform the zip has no packages: *Set Up Engine* fetches them. With one there is a zip for each Python that
Blender has had (`engine_wheels.SERIES`), which brings them as wheels; the index then has these alone, since the zip
without packages is for the same systems, and Blender takes any that fits. Pure standard library; the archives are the
same bytes for the same sources.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import sys
import tomllib
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import engine_wheels
from engine_wheels import Series
from kernel_archive import sources_digest

ROOT = Path(__file__).resolve().parent.parent
#: What the zip holds, relative to the root. Of folders, only the files with these endings.
CONTENTS = (
    "__init__.py",
    "blender_manifest.toml",
    "LICENSE",
    "README.md",
    "pyproject.toml",
    "addon",
    "operators",
    "drgs_blender",
)
SUFFIXES = {".py", ".typed", ".md", ".toml", ".json", ".js"}
#: What ``tools/kernels.py build`` makes; a source checkout has none.
KERNELS = Path("drgs_blender/compute/kernels")
MANIFEST = "blender_manifest.toml"
#: Blender's systems -> Python's, as in names of archives of kernels.
_SYSTEMS = {"linux": "linux", "windows": "win32", "macos": "darwin"}
REQUIRED = {
    "schema_version": str,
    "id": str,
    "version": str,
    "name": str,
    "tagline": str,
    "maintainer": str,
    "type": str,
    "license": list,
    "blender_version_min": str,
}
#: Tags and platforms that extensions.blender.org knows; another one is refused only after the upload.
TAGS = {
    *("3D View", "Add Curve", "Add Mesh", "Animation", "Bake", "Camera", "Compositing", "Development", "Game Engine"),
    *("Geometry Nodes", "Grease Pencil", "Import-Export", "Lighting", "Material", "Modeling", "Mesh", "Node", "Object"),
    *("Paint", "Pipeline", "Physics", "Render", "Rigging", "Scene", "Sculpt", "Sequencer", "System", "Text Editor"),
    *("Tracking", "User Interface", "UV"),
}
PLATFORMS = {"windows-x64", "windows-arm64", "macos-x64", "macos-arm64", "linux-x64"}
#: What Blender's index of a repository takes from a manifest.
LISTED = (
    *("schema_version", "id", "name", "tagline", "version", "type", "maintainer", "license", "blender_version_min"),
    *("blender_version_max", "website", "permissions", "tags", "platforms"),
)
PERMISSIONS = {"files", "network", "clipboard", "camera", "microphone"}


def project_version(root: Path = ROOT) -> str:
    """The version written in drgs_blender/core/version.py, read without importing it."""
    text = (root / "drgs_blender" / "core" / "version.py").read_text(encoding="utf-8")
    found = re.search(r'__version__ = "([^"]+)"', text)
    if found is None:
        raise ValueError("drgs_blender/core/version.py names no __version__; write one")
    return found[1]


def faults(manifest: dict[str, Any], version: str) -> list[str]:
    """Everything wrong with a manifest, one sentence each; empty when it is good."""
    found = [
        f"{key} is missing or not a {kind.__name__}"
        for key, kind in REQUIRED.items()
        if not isinstance(manifest.get(key), kind)
    ]
    if found:
        return found
    if manifest["version"] != version:
        found.append(f"version is {manifest['version']} but drgs_blender/core/version.py says {version}")
    if not manifest["id"].isidentifier():
        found.append(f"id {manifest['id']!r} is not a Python identifier")
    if len(manifest["tagline"]) > 64 or not manifest["tagline"][-1:].isalnum():
        found.append("tagline must have at most 64 characters and no punctuation at its end")
    if not all(re.fullmatch(r"SPDX:[\w.+-]+", licence) for licence in manifest["license"]):
        found.append("license must list SPDX identifiers such as SPDX:GPL-3.0-or-later")
    if not re.fullmatch(r"\d+\.\d+\.\d+", manifest["blender_version_min"]):
        found.append("blender_version_min must look like 4.2.0")
    found += [f"tag {tag!r} is not one of Blender's" for tag in sorted(set(manifest.get("tags", [])) - TAGS)]
    found += [f"platform {name!r} is unknown" for name in sorted(set(manifest.get("platforms", [])) - PLATFORMS)]
    for name, reason in manifest.get("permissions", {}).items():
        if name not in PERMISSIONS:
            found.append(f"permission {name!r} is unknown")
        if not isinstance(reason, str) or not 0 < len(reason) <= 64 or not reason[-1].isalnum():
            found.append(f"the reason of permission {name!r} must have 1 to 64 characters and no final punctuation")
    if {"paths", "paths_exclude_pattern"} <= set(manifest.get("build", {})):
        found.append("[build] may have paths or paths_exclude_pattern, not both")
    platforms = manifest.get("platforms", [])
    for wheel in manifest.get("wheels", []):
        if len(platforms) != 1 or not _fits(wheel, platforms[0]):
            found.append(f"wheel {wheel} is not of the platform {', '.join(platforms)} alone")
    return found


def _fits(wheel: str, platform: str) -> bool:
    """Whether a wheel is for a platform of Blender's, by its name."""
    tags = wheel.removesuffix(".whl").rpartition("-")[2].split(".")
    system, _, machine = platform.partition("-")
    begin = {"linux": "manylinux", "windows": "win_", "macos": "macosx_"}[system]
    ends = ("_amd64" if system == "windows" else "_x86_64",) if machine == "x64" else ("_arm64", "_universal2")
    return tags == ["any"] or all(tag.startswith(begin) and tag.endswith(ends) for tag in tags)


def manifest_text(text: str, platform: str, series: Series, names: Iterable[str]) -> str:
    """The manifest of a zip that brings wheels: for one platform, and the Blenders of one Python.

    Parameters
    ----------
    text : blender_manifest.toml
    names : files of the wheels, which the zip has in its folder ``wheels``
    """
    end = f'blender_version_max = "{series.end}"\n' * bool(series.end)
    listed = "".join(f'  "./wheels/{name}",\n' for name in sorted(names))
    text = re.sub(r"^blender_version_min = .*\n", f'blender_version_min = "{series.begin}"\n{end}', text, flags=re.M)
    return re.sub(r"^platforms = .*\n", f'platforms = ["{platform}"]\nwheels = [\n{listed}]\n', text, flags=re.M)


def kernels(root: Path = ROOT, platform: str | None = None) -> list[Path]:
    """The archives of compiled kernels and what belongs to them, sorted, relative to `root`.

    Those of other systems than that of `platform` are left out, where that is given.

    Raises
    ------
    ValueError
        When there are none, or they were made from other sources.
    """
    try:
        made_from = json.loads((root / KERNELS / "versions.json").read_text(encoding="utf-8"))["sources"]
    except (OSError, ValueError, KeyError):
        raise ValueError(f"{KERNELS} holds no kernels: run tools/kernels.py build") from None
    if made_from != sources_digest(root / "drgs_blender"):
        raise ValueError(f"{KERNELS} was made from other sources: run tools/kernels.py build")
    found = [path.relative_to(root) for path in sorted((root / KERNELS).iterdir()) if path.suffix in {".zip", ".json"}]
    system = "" if platform is None else _SYSTEMS[platform.partition("-")[0]]
    return [path for path in found if path.suffix == ".json" or path.name.startswith(system)]


def members(root: Path = ROOT) -> Iterator[Path]:
    """The files of the extension without compiled kernels, sorted, relative to `root`."""
    for name in CONTENTS:
        path = root / name
        if path.is_file():
            yield Path(name)
        elif path.is_dir():
            for file in sorted(path.rglob("*")):
                inside = file.relative_to(root)
                hidden = any(part.startswith(".") or part == "__pycache__" for part in inside.parts)
                if file.is_file() and file.suffix in SUFFIXES and not hidden and inside.parent != KERNELS:
                    yield inside


def build(
    out: Path | None = None,
    root: Path = ROOT,
    with_kernels: bool = False,
    bundle: tuple[str, Series] | None = None,
) -> Path:
    """Check the manifest and write the zip atomically; returns its path.

    Parameters
    ----------
    bundle : platform and Blenders whose packages the zip brings as wheels, which are fetched where they are not here

    Raises
    ------
    ValueError
        Naming every fault.
    """
    text = (root / MANIFEST).read_text(encoding="utf-8")
    packages = [] if bundle is None else engine_wheels.slim_all(engine_wheels.fetch(bundle[0], bundle[1].python))
    if bundle is not None:
        text = manifest_text(text, *bundle, (path.name for path in packages))
    manifest = tomllib.loads(text)
    if wrong := faults(manifest, project_version(root)):
        raise ValueError(f"{MANIFEST}: " + "; ".join(wrong))
    part = "" if bundle is None else f"-{bundle[0]}-blender-{bundle[1].begin.removesuffix('.0')}"
    out = out or root / "dist" / f"{manifest['id']}-{manifest['version']}{part}.zip"
    names = [*members(root), *(kernels(root, bundle and bundle[0]) if with_kernels else ())]
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = out.with_name(out.name + ".part")
    with zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in names:
            entry = zipfile.ZipInfo(name.as_posix(), date_time=(2025, 1, 1, 0, 0, 0))
            entry.external_attr = 0o644 << 16
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, text if name.name == MANIFEST else (root / name).read_bytes())
        for path in packages:
            archive.write(path, f"wheels/{path.name}", zipfile.ZIP_STORED)
    partial.replace(out)
    return out


def write_index(archives: Sequence[Path]) -> Path:
    """Write the index of a static repository that holds `archives`, beside them; returns its path.

    The same as ``blender --command extension server-generate`` makes.
    """
    entries = []
    for path in archives:
        with zipfile.ZipFile(path) as archive:
            manifest = tomllib.loads(archive.read(MANIFEST).decode("utf-8"))
        data = path.read_bytes()
        entry = {key: manifest[key] for key in LISTED if key in manifest} | {
            "archive_url": f"./{path.name}",
            "archive_size": len(data),
            "archive_hash": f"sha256:{hashlib.sha256(data).hexdigest()}",
        }
        if names := manifest.get("wheels"):
            entry["python_versions"] = sorted({_python(name) for name in names} - {"3"}) or ["3"]
        entries.append(entry)
    path = archives[0].with_name("index.json")
    partial = path.with_name(path.name + ".part")
    partial.write_text(json.dumps({"version": "v1", "blocklist": [], "data": entries}, indent=2), encoding="utf-8")
    partial.replace(path)
    return path


def _python(wheel: str) -> str:
    """The Python of a wheel as an index has it: "3.11", or "3" for all."""
    tag, abi = wheel.split("-")[-3:-1]
    found = re.fullmatch(r"cp(\d)(\d+)", tag)
    return f"{found[1]}.{found[2]}" if found and not abi.startswith("abi") else "3"


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="the zip to write (default: dist/drgs-VERSION.zip)")
    parser.add_argument("--kernels", action="store_true", help="with the compiled kernels of tools/kernels.py build")
    parser.add_argument(
        "--platform",
        action="append",
        choices=("all", *engine_wheels.PLATFORMS),
        default=[],
        help="with the engine's packages for a platform, in a zip for each Python of Blender's (repeatable)",
    )
    options = parser.parse_args()
    platforms = list(engine_wheels.PLATFORMS) if "all" in options.platform else options.platform
    bundles: list[tuple[str, Series] | None] = [(name, series) for name in platforms for series in engine_wheels.SERIES]
    if options.out is not None and bundles:
        parser.error("--out names one zip, and --platform makes several: leave it out")
    try:
        archives = []
        for bundle in bundles or [None]:
            archives.append(build(options.out, with_kernels=options.kernels, bundle=bundle))
            print(f"{archives[-1]}, {archives[-1].stat().st_size / 1e6:.1f} MB", flush=True)
        if options.out is None:  # another folder may have an index of its own
            print(write_index(archives))
    except (OSError, ValueError) as error:
        print(f"extension.py: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
