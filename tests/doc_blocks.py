"""Blocks of code in the pages of the documentation, which tests run as they are printed."""

from __future__ import annotations

import re


def blocks(page: str) -> list[tuple[str, str]]:
    """Language and text of each fenced block that names one, in the order of the page."""
    return re.findall(r"^```(\w+)\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
