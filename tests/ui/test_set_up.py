"""Set Up Engine in a window, by clicks: the true packages from the package index, cancelled once and resumed.

Fetches some 175 MB, so it runs with ``DRGS_FAULTS=whole`` alone.
"""

from __future__ import annotations

import os

import pytest
import window


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> window.Seen:
    if os.environ.get("DRGS_FAULTS") != "whole":
        pytest.skip("fetches 175 MB; runs with DRGS_FAULTS=whole")
    return window.run("set_up_job.py", tmp_path_factory.mktemp("setup"), seconds=3600)


def test_nothing_fails(seen):
    assert "error" not in seen.result, seen.result["error"]
    assert "Traceback" not in seen.log, seen.log[-3000:]


def test_nothing_begins_without_a_click_and_access(seen):
    assert seen.result["before"] == "absent" and seen.result["online"]


def test_cancelled_it_goes_on_where_it_was(seen):
    assert seen.result["cancelled"] == ["partial", False]
    assert seen.result["after"] == "ready", seen.result["messages"]


def test_the_engine_answers(seen):
    assert seen.result["pid"] > 0


def test_photographs_are_offered_what_they_need_instead_of_a_file_browser(seen):
    assert not seen.result["photographs"]
