"""Build the Blender extension's zip and check what Blender's own validator lets through.

With it goes ``dist/index.json``: the folder, on any web server, is a repository for Preferences > Get Extensions.

    python tools/extension.py [--out dist/drgs-0.1.0.zip] [--kernels]

Pure standard library; the archive is the same bytes for the same sources.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

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
    if "wheels" in manifest:
        found.append("wheels are not used: the engine is an environment of its own")
    return found


def kernels(root: Path = ROOT) -> list[Path]:
    """The archives of compiled kernels and what belongs to them, sorted, relative to `root`.

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
    return [path.relative_to(root) for path in sorted((root / KERNELS).iterdir()) if path.suffix in {".zip", ".json"}]


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


def build(out: Path | None = None, root: Path = ROOT, with_kernels: bool = False) -> Path:
    """Check the manifest and write the zip atomically; returns its path. Raises ValueError naming every fault."""
    manifest = tomllib.loads((root / "blender_manifest.toml").read_text(encoding="utf-8"))
    if wrong := faults(manifest, project_version(root)):
        raise ValueError("blender_manifest.toml: " + "; ".join(wrong))
    out = out or root / "dist" / f"{manifest['id']}-{manifest['version']}.zip"
    names = [*members(root), *(kernels(root) if with_kernels else ())]
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = out.with_name(out.name + ".part")
    with zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in names:
            entry = zipfile.ZipInfo(name.as_posix(), date_time=(2025, 1, 1, 0, 0, 0))
            entry.external_attr = 0o644 << 16
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, (root / name).read_bytes())
    partial.replace(out)
    return out


def write_index(archive: Path, root: Path = ROOT) -> Path:
    """Write the index of a static repository that holds `archive`, beside it; returns its path.

    The same as ``blender --command extension server-generate`` makes.
    """
    manifest = tomllib.loads((root / "blender_manifest.toml").read_text(encoding="utf-8"))
    data = archive.read_bytes()
    entry = {key: manifest[key] for key in LISTED if key in manifest} | {
        "archive_url": f"./{archive.name}",
        "archive_size": len(data),
        "archive_hash": f"sha256:{hashlib.sha256(data).hexdigest()}",
    }
    path = archive.with_name("index.json")
    partial = path.with_name(path.name + ".part")
    partial.write_text(json.dumps({"version": "v1", "blocklist": [], "data": [entry]}, indent=2), encoding="utf-8")
    partial.replace(path)
    return path


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="the zip to write (default: dist/drgs-VERSION.zip)")
    parser.add_argument("--kernels", action="store_true", help="with the compiled kernels of tools/kernels.py build")
    options = parser.parse_args()
    try:
        out = options.out
        archive = build(out, with_kernels=options.kernels)
        print(archive)
        if out is None:  # another folder may have an index of its own
            print(write_index(archive))
    except (OSError, ValueError) as error:
        print(f"extension.py: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
