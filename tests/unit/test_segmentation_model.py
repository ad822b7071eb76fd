"""Masks by a segmentation model: a network of one layer that finds what is dark, in ONNX files made here."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_capture_masks import iou, run, scene, written

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
pytest.importorskip("cv2")

from drgs_blender.capture.masks.segmentation_model import SegmentationModel, find_model  # noqa: E402
from drgs_blender.capture.masks.stage import check_mode  # noqa: E402
from drgs_blender.core.errors import AssetError, UsageError  # noqa: E402


def write_model(path: Path, side: int | str = 96, channels: int = 3, gain: float = -40.0, shift: float = -41.0,
                sigmoid: bool = False) -> Path:  # fmt: skip
    """A model whose logit is ``gain * mean + shift`` of the prepared picture: 0 where its colours' mean is -1.03."""
    helper, floats = onnx.helper, onnx.TensorProto.FLOAT
    weights = onnx.numpy_helper.from_array(np.full((1, channels, 1, 1), gain / channels, np.float32), "w")
    bias = onnx.numpy_helper.from_array(np.array([shift], np.float32), "b")
    nodes = [helper.make_node("Conv", ["picture", "w", "b"], ["logit" if sigmoid else "mask"])]
    nodes += [helper.make_node("Sigmoid", ["logit"], ["mask"])] if sigmoid else []
    graph = helper.make_graph(
        nodes, "dark",
        [helper.make_tensor_value_info("picture", floats, [1, channels, side, side])],
        [helper.make_tensor_value_info("mask", floats, [1, 1, side, side])],
        [weights, bias],
    )  # fmt: skip
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8), str(path))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("sigmoid", [False, True])
def test_masks_of_a_model(tmp_path: Path, sigmoid: bool) -> None:
    views, true = scene()
    found, pictures = written(tmp_path, views, np.zeros((0, 3)))
    masked = run(tmp_path, str(write_model(tmp_path / "u2net-dark.onnx", sigmoid=sigmoid)), found, pictures)
    assert not any(fit.doubtful for fit in masked.fits) and (tmp_path / "sheet.png").is_file()
    scores = [iou(np.asarray(Image.open(pictures[v.name].mask)) > 127, mask) for v, mask in zip(views, true)]
    assert min(scores) > 0.9


@pytest.mark.slow
def test_a_mask_that_does_not_fit_becomes_the_others_hull(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    views, true = scene()
    views[4].pixels[:] = np.maximum(views[4].pixels, 120)  # here the model finds nothing
    found, pictures = written(tmp_path, views, np.zeros((0, 3)))
    run(tmp_path, str(write_model(tmp_path / "u2net-dark.onnx")), found, pictures)
    assert "finds no object in photo_4.png" in caplog.text and "replaced by these' hull: photo_4.png" in caplog.text
    assert iou(np.asarray(Image.open(pictures["photo_4.png"].mask)) > 127, true[4]) > 0.85


def test_a_model_that_sees_all_as_object_gives_no_masks(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    views, _ = scene()
    found, pictures = written(tmp_path, views, np.zeros((0, 3)))
    masked = run(tmp_path, str(write_model(tmp_path / "u2net.onnx", gain=1e-3, shift=-9.0)), found, pictures)
    assert "finds no object in" in caplog.text and masked.lines == ["masks: none could be made"]
    assert all(picture.mask is None for picture in pictures.values())


def test_models_are_prepared_as_their_names_say(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    pixels = np.full((40, 60, 3), 128, np.uint8)
    pixels[:, 30:] = 255
    found = {}
    for name in ("u2net", "isnet-general-use", "rmbg-1.4", "mine"):
        model = SegmentationModel(str(write_model(tmp_path / f"{name}.onnx", side="side", gain=-1.0, shift=0.0)))
        found[name] = model._size, model._preparation.deviation[0], model._preparation.mean[0]
    assert found == {
        "u2net": ((320, 320), 0.229, 0.485), "isnet-general-use": ((1024, 1024), 1.0, 0.485),
        "rmbg-1.4": ((1024, 1024), 1.0, 0.5), "mine": ((1024, 1024), 0.229, 0.485),
    }  # fmt: skip
    assert caplog.text.count("none of the models known by name") == 1 and "mine.onnx" in caplog.text
    mask = SegmentationModel(str(tmp_path / "u2net.onnx"))(pixels, "grey")
    assert mask.shape == (40, 60) and mask[:, :25].min() > 0.8 and mask[:, 35:].max() < 0.2


def test_models_are_found_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("U2NET_HOME", str(tmp_path))
    path = write_model(tmp_path / "isnet-general-use.onnx")
    assert find_model("isnet-general-use") == find_model("isnet-general-use.onnx") == find_model(str(path)) == path
    assert find_model("isnet") is None
    check_mode("isnet-general-use")
    check_mode("auto")
    with pytest.raises(UsageError, match="'autp': no file of that name, nor a model"):
        check_mode("autp")


@pytest.mark.parametrize("what", ["text", "grey", "nan"])
def test_files_that_are_no_such_models_are_refused(tmp_path: Path, what: str) -> None:
    path = tmp_path / "u2net.onnx"
    if what == "text":
        path.write_text("no model")
    else:
        write_model(path, channels=1 if what == "grey" else 3, gain=np.nan if what == "nan" else 1.0)
    reasons = {
        "text": "no model that ONNX Runtime reads",
        "grey": "takes picture",
        "nan": "gives NaN or infinity for x",
    }
    with pytest.raises(AssetError, match=reasons[what]):
        SegmentationModel(str(path))(np.full((8, 8, 3), 99, np.uint8), "x")
