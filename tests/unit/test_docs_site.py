"""The site of the documentation: its Python reference is whole, and its links hold."""

from __future__ import annotations

import ast
import re
import sys
import types
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "tools"))

import api_reference  # noqa: E402


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    return api_reference.pages(ROOT)


@pytest.fixture
def docs(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """tools/docs.py, without the generator that it starts."""
    for name in ("sphinx", "sphinx.cmd", "sphinx.cmd.build", "sphinx.util", "sphinx.util.inventory"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    sys.modules["sphinx.cmd.build"].main = None  # type: ignore[attr-defined]
    sys.modules["sphinx.util.inventory"].InventoryFile = None  # type: ignore[attr-defined]
    import docs

    monkeypatch.delitem(sys.modules, "docs")
    return docs


def package(folder: Path, text: str) -> Path:
    """A package of one module with this source."""
    (folder / "some").mkdir()
    (folder / "some" / "__init__.py").write_text('"""A package."""\n')
    (folder / "some" / "part.py").write_text(text)
    return folder


def test_every_public_module_has_a_page(pages: dict[str, str]) -> None:
    sources = {p.relative_to(ROOT) for p in (ROOT / "drgs_blender").rglob("*.py") if p.name != "__main__.py"}
    modules = {".".join(p.with_suffix("").parts).removesuffix(".__init__") for p in sources}
    assert set(pages) == {m for m in modules if "._" not in m} and len(pages) > 300
    for name, text in pages.items():
        assert f"```{{py:module}} {name}\n" in text


def test_every_public_function_and_class_is_on_its_page(pages: dict[str, str]) -> None:
    for name, text in pages.items():
        path = ROOT.joinpath(*name.split("."))
        source = (path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text(encoding="utf-8")
        for node in ast.parse(source).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                directive = "py:class" if isinstance(node, ast.ClassDef) else "py:function"
                assert re.search(rf"^`+\{{{directive}\}} {node.name}\b", text, re.MULTILINE), f"{name}.{node.name}"


def test_a_package_lists_its_modules(pages: dict[str, str]) -> None:
    for name in pages:
        above, _, last = name.rpartition(".")
        assert not above or f"({name}.md) |" in pages[above], last


def test_a_docstring_is_read_with_types_and_without(tmp_path: Path) -> None:
    text = '''"""Things."""
class Thing:
    """One *thing* of a_b_c < d.

    Of ``the_first
    the_second``::

        x_1 = `y_1`
    """
def make(old, new: int = 3) -> Thing:
    """Make a `Thing`.

    Parameters
    ----------
    old : what there was before, in [0, 1]
    new : int
        What there will be.

    Raises
    ------
    ValueError
        Nothing fits.
    """
'''
    page = api_reference.pages(package(tmp_path, text), "some")["some.part"]
    assert "{py:function} make(old, new: int = 3) -> some.part.Thing" in page
    assert "Make a {py:obj}`Thing <some.part.Thing>`." in page
    assert r"- **old** : what there was before, in \[0, 1\]" in page
    assert "- **new** : int\\\n  What there will be." in page
    assert "- ValueError\\\n  Nothing fits." in page
    assert r"One *thing* of a\_b\_c \< d." in page
    assert "Of `the_first\nthe_second`:\n\n    x_1 = `y_1`\n" in page


def test_what_begins_with_an_underscore_has_no_place(tmp_path: Path) -> None:
    (package(tmp_path, '"""P."""\n\n\ndef _hidden(): ...\n') / "some" / "_own.py").write_text("")
    pages = api_reference.pages(tmp_path, "some")
    assert set(pages) == {"some", "some.part"} and "_hidden" not in "".join(pages.values())


def test_the_navigation_names_every_guide(docs: types.ModuleType) -> None:
    named = [page for group in docs.NAVIGATION.values() for page in group]
    assert {p.relative_to(ROOT).as_posix() for p in (ROOT / "docs").rglob("*.md")} <= set(named)
    assert len(named) == len(set(named)) and all((ROOT / page).is_file() for page in named)


def test_links_of_every_guide_are_there(docs: types.ModuleType) -> None:
    named = {"README.md", *(page for group in docs.NAVIGATION.values() for page in group)}
    broken = []
    for name in named:
        try:
            docs.Page(ROOT, name).linked(named)
        except docs.DocsError as error:
            broken.append(str(error))
    assert not broken, "\n".join(broken)


def test_a_link_to_nowhere_is_an_error_and_one_to_a_source_is_the_reference(
    docs: types.ModuleType, tmp_path: Path
) -> None:
    for path in ("docs", "drgs_blender/core"):
        (tmp_path / path).mkdir(parents=True)
    (tmp_path / "drgs_blender/core/frame.py").touch()
    (tmp_path / "Makefile").touch()
    page = docs.Page(tmp_path, "docs/a.md")
    (tmp_path / "docs/a.md").write_text("[f](../drgs_blender/core/frame.py) [m](../Makefile) [r](../README.md#x)")
    (tmp_path / "README.md").write_text("# A page: `x`\n\n## X\n")
    expected = "[f](../reference/python/drgs_blender.core.frame.md) [m](../Makefile) [r](../index.md#x)"
    assert page.linked({"docs/a.md"}) == expected and page.files == ["Makefile"]
    (tmp_path / "docs/a.md").write_text("[b](b.md)")
    with pytest.raises(docs.DocsError, match=r"a\.md: links to b\.md"):
        page.linked({"docs/a.md"})
    for link in ("../README.md#y", "#y"):
        (tmp_path / "docs/a.md").write_text(f"# A\n\n[b]({link})")
        with pytest.raises(docs.DocsError, match=f"links to {re.escape(link)}, which is not there"):
            page.linked({"docs/a.md"})


def test_anchors_are_those_of_github(docs: types.ModuleType) -> None:
    text = "# One: `two_2`, [three](a.md)\n```\n# none\n```\n## Cards of AMD, Intel & Apple\n"
    assert docs.anchors(text) == {"one-two_2-three", "cards-of-amd-intel--apple"}


@pytest.mark.parametrize(
    ("address", "fault"),
    (
        ("https://docs.blender.org/manual/en/latest/", ""),
        ("mailto:someone@blender.org", ""),
        ("http://blender.org", "not https"),
        ("https://example.org/x", "no site's address"),
        ("https://localhost/x", "no site's address"),
        ("https://", "no site's address"),
        ("https://github.com/<owner>/drgs", "placeholder"),
    ),
)
def test_a_link_out_of_the_site_is_whole(docs: types.ModuleType, address: str, fault: str, tmp_path: Path) -> None:
    assert fault in docs.fault_of(address) and bool(fault) == bool(docs.fault_of(address))
    (tmp_path / "a.md").write_text(f"[x]({address})")
    page = docs.Page(tmp_path, "a.md")
    if fault:
        with pytest.raises(docs.DocsError, match=fault):
            page.linked({"a.md"})
    else:
        assert page.linked({"a.md"}) == f"[x]({address})"
