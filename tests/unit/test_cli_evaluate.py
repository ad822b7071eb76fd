"""What ``drgs evaluate`` knows of an asset: the views left out, and the capture that was made of its photographs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from captures import make, write_nerf
from shapes import plain_mesh, sphere_mesh

from drgs_blender.cli.evaluate import capture_of, left_out_by
from drgs_blender.cli.main import main
from drgs_blender.core.asset.model import Asset
from drgs_blender.deform.attach import attach


@pytest.mark.parametrize(
    ("provenance", "expected"),
    [
        ({"settings": {"capture": {"test_every": 8}}}, 8),
        ({"settings": {"capture": {"test_every": None}}}, None),
        ({"settings": {"capture": {"test_every": 1}}}, None),
        ({"settings": "none"}, None),
        ({}, None),
    ],
)
def test_views_left_out_are_those_of_the_reconstruction(provenance: dict, expected: int | None) -> None:
    mesh = plain_mesh(*sphere_mesh(1))
    surfels, binding, _ = attach(mesh, density=5)
    assert left_out_by(Asset(surfels, mesh, binding, provenance=provenance)) == expected


def test_photographs_without_cameras_are_scored_by_the_capture_beside_the_asset(tmp_path: Path) -> None:
    plain = tmp_path / "photographs"
    plain.mkdir()
    asset = tmp_path / "statue.drgs"
    assert capture_of(plain, asset) == plain
    write_nerf(make(tmp_path / "statue.capture", 4))
    assert capture_of(plain, asset) == tmp_path / "statue.capture"
    write_nerf(make(tmp_path / "other", 4))
    assert capture_of(tmp_path / "other", asset) == tmp_path / "other"
    assert capture_of(tmp_path / "absent", asset) == tmp_path / "absent"


def test_inspect_counts_alpha_as_masks(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    write_nerf(make(tmp_path / "nerf", 4))
    assert main(["inspect", str(tmp_path / "nerf"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["masks"] == told["photographs"] > 0
    from PIL import Image

    for path in (tmp_path / "nerf").rglob("*.png"):
        with Image.open(path) as picture:
            pixels = np.asarray(picture.convert("RGB"))
        Image.fromarray(pixels).save(path)
    assert main(["inspect", str(tmp_path / "nerf"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["masks"] == 0
