"""The table of formats: content decides, damage is reported, the documentation is current."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from drgs_blender.core.errors import AssetError
from drgs_blender.formats.files import EnvironmentFile, MeshFile, SurfelFile
from drgs_blender.formats.registry import FORMATS, document, find_format, read, read_surfels

ROOT = Path(__file__).resolve().parents[2]
SHARED = Path(os.environ.get("DRGS_SHARED", ROOT.parent / "shared")) / "data"
MALFORMED = sorted((SHARED / "malformed").iterdir()) if (SHARED / "malformed").is_dir() else []


def test_documentation_is_current() -> None:
    assert (ROOT / "docs" / "formats.md").read_text(encoding="utf-8") == document(), (
        "docs/formats.md is out of date: write drgs_blender.formats.registry.document() to it"
    )


def test_content_decides_not_the_name(tmp_path: Path) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    path = tmp_path / "scene.exr"
    path.write_text(head + "end_header\n0 0 0\n")
    assert find_format(path).name == "PLY mesh"
    splat = "".join(f"property float {n}\n" for n in ("scale_0", "rot_0", "opacity"))
    path.write_text(head + splat + "end_header\n0 0 0 0 0 0\n")
    assert find_format(path).name == "Gaussian PLY"
    path.write_bytes(b"#?RADIANCE\n")
    assert find_format(path).name == "Radiance HDR"
    path.write_text('{"asset": {"version": "2.0"}}')
    assert find_format(path).name == "glTF 2.0"
    path.write_text("# exported\nv 0 0 0\nv 1 0 0\n")
    assert find_format(path).name == "Wavefront OBJ"


def test_what_is_not_understood_lists_what_is(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(bytes(range(256)))
    with pytest.raises(AssetError, match="of no known format") as caught:
        read(path)
    assert all(f.name in caught.value.remedy for f in FORMATS)
    path.write_bytes(b"")
    with pytest.raises(AssetError, match="is empty"):
        read(path)
    with pytest.raises(AssetError, match="cannot be read"):
        read(tmp_path / "none.ply")
    assert ".drgs" in caught.value.remedy
    with pytest.raises(AssetError, match="is a folder"):
        read(tmp_path)


@pytest.mark.skipif(os.name == "nt", reason="pipes are no files there")
def test_what_may_never_end_is_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.ply")
    (tmp_path / "zero.ply").symlink_to("/dev/zero")
    for path in (tmp_path / "pipe.ply", tmp_path / "zero.ply"):
        with pytest.raises(AssetError, match="is not a regular file"):
            read(path)
    with pytest.raises(AssetError, match="cannot be read"):
        read(tmp_path / ("n" * 300))


def test_the_wrong_kind_is_said(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(AssetError, match="is Wavefront OBJ, not surfels"):
        read_surfels(path)


@pytest.mark.skipif(not MALFORMED, reason=f"development data not found at {SHARED} (set DRGS_SHARED)")
@pytest.mark.parametrize("folder", MALFORMED, ids=lambda p: p.name)
def test_every_damaged_file_is_refused_or_read_sensibly(folder: Path) -> None:
    """Published collections of broken files: an AssetError that names the file, or valid arrays; nothing else."""
    files = [p for p in sorted(folder.rglob("*")) if p.is_file()]
    refused = 0
    for path in files:
        try:
            found = read(path)
        except AssetError as error:
            assert str(path) in str(error) or path.name in str(error)
            refused += 1
            continue
        if isinstance(found, MeshFile):
            assert np.isfinite(found.vertices).all()
            assert not len(found.faces) or 0 <= found.faces.min() <= found.faces.max() < len(found.vertices)
        elif isinstance(found, EnvironmentFile):
            assert np.isfinite(found.environment.radiance).all() and found.environment.radiance.min() >= 0
        else:
            assert isinstance(found, SurfelFile) and np.isfinite(found.surfels.centre).all()
    assert refused > 0
