"""Errors that reach a user."""

from __future__ import annotations

import pickle

import pytest

from drgs_blender.core.errors import ERROR_CLASSES, AssetError, UsageError


def test_what_is_wrong_with_a_file_comes_with_a_remedy_always():
    plain, own = AssetError("a.drgs", "has no end"), AssetError("a.drgs", "has no end", "Copy it again")
    assert str(plain).startswith("a.drgs: has no end. ")
    assert "again" in plain.remedy
    assert str(own) == "a.drgs: has no end. Copy it again."


def test_a_remedy_that_was_left_out_on_purpose_stays_out():
    assert str(AssetError("drgs make", "failed: the disk is full", "")) == "drgs make: failed: the disk is full."


def test_errors_cross_processes_whole():
    for kind in ERROR_CLASSES.values():
        error = kind("cube", "is flat", "Scale it")
        again = pickle.loads(pickle.dumps(error))
        assert (type(again), again.subject, again.problem, again.remedy) == (kind, "cube", "is flat", "Scale it")
    assert pickle.loads(pickle.dumps(UsageError("cube", "is flat"))).remedy == ""


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("a\x1b[31m\x07.drgs", r"a\x1b[31m\x07.drgs"),
        ("a\r\nDRGS_EXIT class=ok", r"a\r\nDRGS_EXIT class=ok"),
        ("a\x9b2J\u202egpj\u2028.drgs", r"a\x9b2J\u202egpj\u2028.drgs"),
        ("a\udcff.drgs", r"a\udcff.drgs"),
        ("Würfel \u3000立方体 \xa0é C:\\new.drgs", "Würfel \u3000立方体 \xa0é C:\\new.drgs"),
    ],
)
def test_a_terminal_shows_what_it_would_obey(name, said):
    error = UsageError(name, f"has key {name}", f"Rename {name}")
    assert str(error) == f"{said}: has key {said}. Rename {said}."
    assert (error.subject, str(pickle.loads(pickle.dumps(error)))) == (name, str(error)), "the text alone is escaped"
