"""Build the site of the documentation into ``build/docs/html``; `make docs` runs it in ``.venv-docs``.

The sources are laid out in ``build/docs/source`` as in the repository, so that links between pages are the same on
GitHub and in the site. The reference of Blender's side is in ``build/docs/blender``, by tools/blender_reference.py.
Any warning ends the build.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import api_reference
import plots
from sphinx.cmd.build import main as sphinx
from sphinx.util.inventory import InventoryFile

ROOT = Path(__file__).resolve().parent.parent
BUILD = ROOT / "build" / "docs"
#: Pages in the order of the navigation; README.md is the start page. Every page of docs/ must be here.
NAVIGATION = {
    "Start": (
        "docs/film/README.md",
        "docs/user-guide.md",
        "docs/gallery.md",
        "docs/expectations.md",
        "docs/scripting.md",
        "docs/command-line.md",
        "examples/README.md",
        "docs/glossary.md",
        "CHANGELOG.md",
    ),
    "Tutorials": (
        *("docs/tutorials/dance.md", "docs/tutorials/relight.md", "docs/tutorials/simulate.md"),
        *("docs/tutorials/farm.md", "docs/tutorials/scripting.md"),
    ),
    "Guides": (
        *("docs/rendering.md", "docs/simulation.md", "docs/deformation.md", "docs/decoupling.md", "docs/capture.md"),
        *("docs/reconstruct-settings.md", "docs/published-sets.md"),
        *("docs/gpu.md", "docs/benchmarks.md", "docs/paper.md", "docs/paper-figures.md"),
    ),
    "Formats and farm": (
        *("docs/formats.md", "docs/relightable-splats.md", "docs/asset-format.md"),
        *("docs/farm/nodes.md", "docs/farm/slurm.md"),
        *("docs/farm/openjd.md", "docs/farm/flamenco.md"),
    ),
    "Internals": (
        *("docs/architecture.md", "docs/libraries.md", "docs/kernels.md", "docs/protocol.md"),
        "CONTRIBUTING.md",
    ),
}
#: The page beside whose tables plots are drawn, by tools/plots.py.
BENCHMARKS = "docs/benchmarks.md"
#: Folders, below the laid out sources, of the two references.
PYTHON, BLENDER = "reference/python", "reference/blender"
#: Part of its natural size in which a diagram is shown.
DIAGRAM_SCALE = 0.7


class DocsError(Exception):
    """The documentation cannot be built; the message says what is wrong where, and what to do."""


def lay_out(root: Path, source: Path, blender: Path) -> list[str]:
    """Lay out the sources of the site.

    Parameters
    ----------
    root : Path
        The repository.
    source : Path
        Folder to fill; what it holds is removed.
    blender : Path
        Folder with the pages of Blender's side.

    Returns
    -------
    list of str
        Modules of the Python reference.

    Raises
    ------
    DocsError
        A page that the navigation does not name, or no reference of Blender's side.
    """
    named = [page for group in NAVIGATION.values() for page in group]
    guides = {path.relative_to(root).as_posix() for path in (root / "docs").rglob("*.md")}
    if left_out := sorted(guides - set(named)):
        raise DocsError(f"{', '.join(left_out)}: not in the navigation. Add to NAVIGATION in tools/docs.py")
    if not (blender / "index.md").is_file():
        raise DocsError(f"{blender}: holds no index.md. Run tools/blender_reference.py in Blender's environment first")
    shutil.rmtree(source, ignore_errors=True)
    pages = [Page(root, name) for name in ("README.md", *named)]
    for page in pages:
        place = source / ("index.md" if page.name == "README.md" else page.name)
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(page.text({p.name for p in pages}), encoding="utf-8")
        for file in page.files:
            (source / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(root / file, source / file)
    with (source / "index.md").open("a", encoding="utf-8") as index:
        index.writelines(trees())
    shutil.copytree(blender, source / BLENDER)
    return api_reference.write(root, source / PYTHON)


def trees() -> Iterator[str]:
    """The navigation, as the start page holds it."""
    reference = (f"Operators and properties <{BLENDER}/index>", f"Python modules <{PYTHON}/{api_reference.PACKAGE}>")
    for title, entries in (NAVIGATION | {"Reference": (*reference, "All names <genindex>")}).items():
        if title == "Start":
            entries = ("Overview <self>", *entries)
        yield "\n".join(["", "```{toctree}", ":hidden:", f":caption: {title}", "", *entries, "```", ""])


def anchors(text: str) -> set[str]:
    """Names by which the headings of a page are linked to, as GitHub makes them."""
    headings = re.findall(
        r"^#+ (.+?)\s*$", re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE), re.MULTILINE
    )
    return {
        re.sub(r"[^\w -]", "", re.sub(r"\]\([^)]*\)", "", heading).lower()).replace(" ", "-") for heading in headings
    }


def fault_of(address: str) -> str:
    """What is wrong with a link out of the site, as far as that is known without the network; "" for nothing."""
    parts = urlsplit(address)
    host = parts.hostname or ""
    if parts.scheme == "mailto":
        return ""
    if parts.scheme != "https":
        return "which is not https"
    if not re.fullmatch(r"([a-z0-9-]+\.)+[a-z]{2,}", host) or re.search(r"(^|\.)(example|test|invalid)(\.|$)", host):
        return "which is no site's address"
    return "which has a placeholder" if re.search(r"[<>{}…]|\.\.\.|TODO|XXX|\s", address) else ""


class Page:
    """A page of the repository.

    Parameters
    ----------
    root : Path
        The repository.
    name : str
        Path of the page inside it.

    Attributes
    ----------
    files : list of str
        What the page shows or links to that is no page, once `linked` was called: to be copied beside it.
    """

    def __init__(self, root: Path, name: str) -> None:
        self.root, self.name = root, name
        self.files: list[str] = []

    def text(self, pages: set[str]) -> str:
        """The page as the site's generator takes it, with the links of a site of `pages`, diagrams and plots drawn."""
        text = self.linked(pages)
        if self.name == BENCHMARKS:
            try:
                text = plots.with_plots(text)
            except plots.PlotError as error:
                raise DocsError(f"{self.name}: {error}. Correct it, or PLOTS in tools/plots.py") from error
        return re.sub(r"^```mermaid\n(.*?)^```$", self._diagram, text, flags=re.DOTALL | re.MULTILINE)

    def linked(self, pages: set[str]) -> str:
        """The page with links as they are in the site; DocsError where one leads nowhere."""
        text = (self.root / self.name).read_text(encoding="utf-8")
        return re.sub(r"(\]\()([^)\s]+)(\))", lambda found: self._link(found, pages), text)

    def _link(self, found: re.Match[str], pages: set[str]) -> str:
        """A link as it is in the site: to a page, to a module's reference, or to a file that is copied."""
        path, mark, anchor = found[2].partition("#")
        if re.match(r"[a-z]+:", found[2]):
            if problem := fault_of(found[2]):
                raise DocsError(f"{self.name}: links to {found[2]}, {problem}. Correct the link")
            return found[0]
        here = self.root / self.name
        target = (here.parent / path).resolve() if path else here
        is_there = target.exists() and target.is_relative_to(self.root)
        if not is_there or (anchor and target.suffix == ".md" and anchor not in anchors(target.read_text("utf-8"))):
            raise DocsError(f"{self.name}: links to {found[2]}, which is not there. Correct the link")
        if not path:
            return found[0]
        inside = target.relative_to(self.root)
        name = inside.as_posix()
        up = "../" * (len(Path(self.name).parts) - 1)
        if name == "README.md":
            return f"{found[1]}{up}index.md{mark}{anchor}{found[3]}"
        if name in pages:
            return found[0]
        if inside.parts[0] == api_reference.PACKAGE and (target.suffix == ".py" or (target / "__init__.py").is_file()):
            module = ".".join(inside.with_suffix("").parts).removesuffix(".__init__")
            return f"{found[1]}{up}{PYTHON}/{module}.md{found[3]}"
        if target.is_dir():
            raise DocsError(f"{self.name}: links to the folder {name}, which the site lacks. Link to a file or page")
        self.files.append(name)
        return found[0]

    def _diagram(self, found: re.Match[str]) -> str:
        """A diagram of Mermaid as SVG, which needs no script and no network to be seen."""
        import mermaidx

        try:
            svg = mermaidx.render(found[1]).svg()
        except RuntimeError as error:
            raise DocsError(f"{self.name}: a Mermaid diagram cannot be drawn ({error}). Correct it") from error
        box = re.search(r'viewBox="[-\d.]+ [-\d.]+ ([\d.]+)', svg)
        if box is None:
            raise DocsError(f"{self.name}: a Mermaid diagram came out without a size. Simplify it")
        width = float(box[1]) * DIAGRAM_SCALE
        svg = svg.replace('width="100%"', f'width="{width:.0f}"', 1).replace("\n", " ")
        return f'```{{raw}} html\n<div class="diagram">{svg}</div>\n```'


def check(modules: list[str], html: Path) -> None:
    """Raise DocsError where a module is in no page or a page holds what only the network gives."""
    inventory = InventoryFile.loads((html / "objects.inv").read_bytes(), uri="")
    there = set(inventory.data["py:module"])
    if missing := sorted(set(modules) - there):
        raise DocsError(f"{', '.join(missing)}: in no page of the reference. See tools/api_reference.py")
    for page in html.rglob("*.html"):
        fetched = re.findall(r'<(?:script|link|img)[^>]*(?:src|href)="(https?://[^"]+)"', page.read_text("utf-8"))
        if fetched:
            raise DocsError(f"{page}: fetches {fetched[0]}, so it needs the network. Bring it with the site")


def main(argv: list[str] | None = None) -> int:
    """Build the site; the return value is the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=BUILD, help="folder of source and html; default build/docs")
    parser.add_argument(
        "--links", action="store_true", help="ask, over the network, whether links out of the site hold"
    )
    args = parser.parse_args(argv)
    source, html = args.out / "source", args.out / "html"
    try:
        print("== pages and plots, reference of the Python modules", flush=True)
        modules = lay_out(ROOT, source, args.out / "blender")
        shutil.rmtree(html, ignore_errors=True)
        options = ["-W", "--keep-going", "-q", "-j", "auto", "-d", str(args.out / "doctrees")]
        options += ["-c", str(ROOT / "tools" / "site"), str(source)]
        print("== the site, by Sphinx: some minutes, and silent unless something is wrong", flush=True)
        if code := sphinx(["-E", "-b", "html", *options, str(html)]):
            return code
        check(modules, html)
        if args.links and (code := sphinx(["-b", "linkcheck", *options, str(args.out / "links")])):
            return code
    except DocsError as error:
        print(f"docs.py: {error}", file=sys.stderr)
        return 1
    print(html / "index.html")
    return 0


if __name__ == "__main__":
    sys.exit(main())
