"""Sphinx's settings for the site that `make docs` builds; tools/docs.py lays out the sources."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tools"))
from extension import project_version  # noqa: E402

project = "DR-GS for Blender"
author = "The DR-GS for Blender authors"
copyright = "the DR-GS for Blender authors, GPL-3.0-or-later"
version = release = project_version(ROOT)
extensions = ["myst_parser"]
exclude_patterns: list[str] = []
# GitHub's anchors of headings, so that links to them work here and there.
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]
# Blocks of code without a language are commands and formulas, not Python.
highlight_language = "none"
# Quotes and dashes stay as they are typed: many are values and options.
smartquotes = False
# Names are written in full in the pages; what the reader sees is the last part.
add_module_names = False
python_use_unqualified_type_names = True
maximum_signature_line_length = 100
toc_object_entries_show_parents = "hide"

# `make docs ARGS=--links`: anchors that scripts make cannot be seen, and a site that is asked too often says so.
linkcheck_anchors = False
linkcheck_timeout, linkcheck_retries, linkcheck_workers = 20, 2, 2

html_theme = "furo"
html_title = f"{project} {release}"
html_static_path = [str(Path(__file__).parent / "static")]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
html_baseurl = os.environ.get("DRGS_DOCS_URL", "")


def exact(app: Sphinx, doctree: nodes.document) -> None:
    """Have a name in a signature mean what it says: Sphinx takes anything of the same last part otherwise."""
    for reference in doctree.findall(addnodes.pending_xref):
        reference.attributes.pop("refspecific", None)


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx; says that pages may be built side by side."""
    app.connect("doctree-read", exact)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
