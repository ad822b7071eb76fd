"""The glossary names places that exist, and who searches the code for one of its words finds it there."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[2]
#: Words of the field that newcomers search for; each is a term of the glossary.
EXPECTED = (
    "MIS", "power heuristic", "next event estimation", "throughput", "Russian roulette", "pdf", "importance sampling",
    "environment map CDF", "light tree", "BSDF", "GGX", "Fresnel", "shading normal", "shadow terminator", "G-buffer",
    "AOV", "film", "pixel filter", "tone mapping", "view transform", "denoiser", "SVGF", "a-trous", "demodulation",
    "reprojection", "motion vector", "Cryptomatte", "BVH", "refit", "splat", "rasteriser", "tile", "alpha blending",
    "surfel", "densification", "TSDF", "marching cubes", "Adam", "SSIM", "P2G", "G2P", "constitutive model",
    "Young's modulus", "CFL", "XPBD", "rigid body", "GMLS", "skinning", "shape key", "ipc protocol", "shared memory",
    "handshake", "session", "progressive rendering", "render farm", "chunk", "kernel cache", "heartbeat",
    "transmittance", "lobe", "estimator", "history", "SDF collider",
)  # fmt: skip


class Row(NamedTuple):
    """A line of the glossary: its terms, and the paths and names that say where they are in the code."""

    terms: list[str]
    places: list[str]


def rows() -> list[Row]:
    text = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
    cells = [line.strip("|").split("|") for line in text.splitlines() if re.match(r"\| (?!Term )", line)]
    return [Row(re.split(r"[,;] ", row[0].strip()), re.findall(r"`([^`]+)`", row[3])) for row in cells]


ROWS = rows()


def files_of(row: Row) -> list[Path]:
    """The files and folders of a row; a name without folder lies beside the one before."""
    found: list[Path] = []
    for place in row.places:
        if "/" not in place and not place.endswith(".py"):
            continue
        root = ROOT if place.startswith(("addon/", "operators/")) else ROOT / "drgs_blender"
        found.append(root / place if "/" in place else found[-1].parent / place)
    return found


def sources_of(path: Path) -> list[str]:
    files = sorted(path.rglob("*.py")) if path.is_dir() else [path]
    return [file.read_text(encoding="utf-8") for file in files]


def words_of(text: str) -> str:
    """Lower-case words with single spaces between them: ``shading_model`` is "shading model", a-trous "a trous"."""
    return " ".join(re.findall(r"[a-z0-9']+", text.lower()))


def prose_of(source: str) -> str:
    """Docstrings, comments and names of attributes in them, without any code."""
    nodes = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    docs = [ast.get_docstring(node) or "" for node in ast.walk(ast.parse(source)) if isinstance(node, nodes)]
    return "\n".join(docs + re.findall(r"#: ?(.*)", source))


@pytest.mark.parametrize("row", ROWS, ids=[row.terms[0] for row in ROWS])
def test_places_exist_and_have_the_words(row: Row) -> None:
    files = files_of(row)
    assert files, "a row names at least one place"
    for file in files:
        assert file.exists(), file
    sources = [source for file in files for source in sources_of(file)]
    for name in row.places:
        if re.fullmatch(r"\w+", name):
            assert any(re.search(rf"\b{name}\b", source) for source in sources), name
    prose = words_of("\n".join(map(prose_of, sources)))
    for term in row.terms:
        assert re.search(rf"\b{re.escape(words_of(term))}", prose), f"no docstring of {row.places} has {term}"


def test_words_of_the_field_are_terms() -> None:
    terms = {words_of(term) for row in ROWS for term in row.terms}
    missing = [word for word in EXPECTED if words_of(word) not in terms]
    assert not missing
