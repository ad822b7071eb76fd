"""Each picture that is left out of a capture has a cause; causes are grouped, with what to do."""

from __future__ import annotations

import numpy as np
import pytest

from drgs_blender.capture import left_out, libraries, soundness
from drgs_blender.capture.features import Photo
from drgs_blender.capture.left_out import Cause, Reason, as_report, grouped, lines, why_unregistered
from drgs_blender.capture.registration import Registration


@pytest.fixture(scope="module")
def matched(tmp_path_factory):
    """COLMAP's synthetic pictures a to f that all match each other, and g that matches none: database, matches."""
    pytest.importorskip("pycolmap", reason="structure from motion needs pycolmap")
    colmap = libraries.load("pycolmap")
    database = tmp_path_factory.mktemp("matched") / "database.db"
    options = colmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, 6, 300
    colmap.set_random_seed(0)
    with colmap.Database.open(str(database)) as data:
        truth = colmap.synthesize_dataset(options, data)
        stranger = colmap.Image()
        stranger.name, stranger.camera_id = "g.jpg", next(iter(truth.cameras))
        number = data.write_image(stranger)
        data.write_keypoints(number, np.random.default_rng(0).random((250, 2)).astype(np.float32))
    names = sorted(truth.image(number).name for number in truth.reg_image_ids())
    numbers = {truth.image(number).name: number for number in truth.reg_image_ids()}
    photos = [Photo(name, ("one",), None, (800, 600), f"IMG {name}") for name in [*names, "g.jpg", "absent.jpg"]]
    return colmap, database, soundness.read_matches(colmap, database), photos, names, numbers


def test_pictures_without_features_or_matches_say_so(matched):
    colmap, database, verified, photos, names, _ = matched
    found = why_unregistered(colmap, database, verified, photos, names)
    assert list(found) == ["g.jpg", "absent.jpg"]
    assert found["g.jpg"].reason is Reason.FEW_MATCHES
    assert found["absent.jpg"] == Cause(Reason.NO_TEXTURE, "0 features")


def test_pictures_that_match_but_have_no_camera_are_told_from_those_that_hardly_match(matched):
    colmap, database, verified, photos, names, numbers = matched
    last = numbers[names[-1]]

    def cause(most: int | None, kept: list[str]) -> Cause:
        pairs = [(a, b, pair[:most] if last in (a, b) else pair) for a, b, pair in verified]
        return why_unregistered(colmap, database, pairs, photos, kept)[names[-1]]

    assert cause(None, names[:-1]).reason is Reason.NO_POSE and "of them with IMG " in cause(None, names[:-1]).detail
    assert cause(5, names[:-1]).reason is Reason.FEW_MATCHES  # the same five features, or few more
    assert cause(None, []).reason is Reason.NO_POSE  # where nothing is registered


def test_pictures_that_match_none_but_others_left_out_are_apart(matched):
    colmap, database, verified, photos, names, numbers = matched
    pair = {numbers[name] for name in names[-2:]}
    apart = [(a, b, rows) for a, b, rows in verified if {a, b} == pair or not {a, b} & pair]
    found = why_unregistered(colmap, database, apart, photos, names[:-2])
    assert {found[name].reason for name in names[-2:]} == {Reason.APART}
    assert f"with IMG {names[-2]}" in found[names[-1]].detail


def test_lines_and_report_are_grouped_by_reason():
    causes = {f"{k:02d}.jpg": Cause(Reason.BLURRED, f"{k}%") for k in range(30)}
    causes |= {"x.heic": Cause(Reason.UNREADABLE, "no picture"), "m.jpg": Cause(Reason.DOUBTFUL_MASK, "16%")}
    assert [reason for reason in grouped(causes)] == [Reason.UNREADABLE, Reason.BLURRED, Reason.DOUBTFUL_MASK]
    unreadable, blurred, _ = lines(causes)
    assert unreadable == "1 cannot be read: x.heic (no picture). Copy or convert them again"
    assert blurred.startswith("30 blurred: 00.jpg (0%), ") and "19.jpg (19%), ...." in blurred and "20" not in blurred
    assert "Take them again" not in lines(causes, remedies=False)[1]
    report = as_report(causes)
    assert [group["left_out"] for group in report] == [True, True, False] and len(report[1]["pictures"]) == 30
    assert report[0]["pictures"] == {"x.heic": "no picture"}


def test_every_reason_says_what_to_do():
    assert all(reason.said and reason.remedy and not reason.remedy.endswith(".") for reason in Reason)
    assert len({reason.key for reason in Reason}) == len(Reason)


def test_a_file_of_which_nothing_is_known_has_a_cause_all_the_same():
    found = Registration({}, {}, {}, {}, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), "")
    found.unsound, found.unregistered = {"a.jpg": Cause(Reason.LOOSE)}, {"b.jpg": Cause(Reason.NO_POSE)}
    reasons = [left_out.cause_of(found, name).reason for name in ("a.jpg", "b.jpg", "c.jpg")]
    assert reasons == [Reason.LOOSE, Reason.NO_POSE, Reason.FEW_MATCHES]
