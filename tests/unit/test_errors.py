"""Errors that reach a user."""

from __future__ import annotations

import pickle

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
