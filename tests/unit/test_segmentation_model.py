"""Masks by a segmentation model: a network of one layer that finds what is dark, in ONNX files made here."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_capture_masks import iou, run, scene, written

pytest.importorskip("onnxruntime")
cv2 = pytest.importorskip("cv2")
pytest.importorskip("torch")

from drgs_blender.capture.masks.of_capture import mask_capture  # noqa: E402
from drgs_blender.capture.masks.segmentation_model import SegmentationModel, find_model  # noqa: E402
from drgs_blender.capture.masks.stage import check_mode  # noqa: E402
from drgs_blender.core.errors import AssetError, UsageError  # noqa: E402
from drgs_blender.reconstruct.capture.capture import Capture, View  # noqa: E402


def field(number: int, value: bytes | str | int) -> bytes:
    """A field of a protobuf message: a number, or text, bytes or a message with their length."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    data = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(data)) + data


def varint(value: int) -> bytes:
    head = b""
    while value > 127:
        head, value = head + bytes([value & 127 | 128]), value >> 7
    return head + bytes([value])


def write_model(path: Path, side: int | str = 96, channels: int = 3, gain: float = -40.0, shift: float = -41.0,
                sigmoid: bool = False, outputs: int = 1) -> Path:  # fmt: skip
    """A model whose logit is ``gain * mean + shift`` of the prepared picture: 0 where its colours' mean is -1.03.

    With as many `outputs` as channels it gives the picture as it is prepared instead. Written field by field as
    onnx.proto has them (ONNX 1.16): a convolution of 1 x 1, and a sigmoid.
    """

    def tensor(name: str, shape: tuple[int, ...], values: list[float]) -> bytes:
        dims = b"".join(field(1, n) for n in shape)
        return dims + field(2, 1) + field(8, name) + field(9, np.array(values, "<f4").tobytes())

    def picture(name: str, count: int) -> bytes:
        dims = [field(1, n) if isinstance(n, int) else field(2, n) for n in (1, count, side, side)]
        shape = b"".join(field(1, dim) for dim in dims)
        return field(1, name) + field(2, field(1, field(1, 1) + field(2, shape)))

    def node(kind: str, inputs: tuple[str, ...], output: str) -> bytes:
        return b"".join(field(1, name) for name in inputs) + field(2, output) + field(4, kind)

    nodes = [node("Conv", ("picture", "w", "b"), "logit" if sigmoid else "mask")]
    nodes += [node("Sigmoid", ("logit",), "mask")] if sigmoid else []
    graph = b"".join(field(1, one) for one in nodes) + field(2, "dark")
    weights = [gain / channels] * channels if outputs == 1 else list(np.eye(outputs, channels).ravel())
    graph += field(5, tensor("w", (outputs, channels, 1, 1), weights))
    graph += field(5, tensor("b", (outputs,), [shift] if outputs == 1 else [0.0] * outputs))
    graph += field(11, picture("picture", channels)) + field(12, picture("mask", outputs))
    path.write_bytes(field(1, 8) + field(7, graph) + field(8, field(1, "") + field(2, 13)))
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


def test_a_model_that_sees_nothing_gives_no_masks(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    views, _ = scene()
    found, pictures = written(tmp_path, views, np.zeros((0, 3)))
    masked = run(tmp_path, str(write_model(tmp_path / "u2net.onnx", gain=1e-3, shift=-9.0)), found, pictures)
    assert "finds no object in" in caplog.text and masked.lines == ["masks: none could be made"]
    assert all(picture.mask is None for picture in pictures.values())


@pytest.mark.parametrize("shift", [9.0, -9.0])
def test_pictures_that_are_all_object_or_without_any_have_no_noise(tmp_path: Path, shift: float) -> None:
    model = SegmentationModel(str(write_model(tmp_path / "u2net.onnx", gain=0.1, shift=shift)))
    pixels = np.random.default_rng(0).integers(0, 255, (30, 40, 3), np.uint8)
    assert (model(pixels, "picture") == (shift > 0)).all()


def test_models_are_prepared_as_their_names_say(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    pixels = np.full((40, 60, 3), 128, np.uint8)
    pixels[:, 30:] = 255
    found = {}
    for name in ("u2net", "isnet-general-use", "rmbg-1.4", "mine"):
        model = SegmentationModel(str(write_model(tmp_path / f"{name}.onnx", side="side", gain=-1.0, shift=0.0)))
        found[name] = model.size, model._preparation.deviation[0], model._preparation.mean[0]
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


@pytest.mark.slow
def test_a_capture_with_cameras_gets_masks_of_all_its_views(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    views, true = scene()
    capture = Capture(tmp_path, [
        View(view.name, view.pinhole(160), view.straightened(cv2, 160).pixels.astype(np.float32) / 255, None, k == 3)
        for k, view in enumerate(views)
    ], None, None)  # fmt: skip
    model = str(write_model(tmp_path / "u2net.onnx"))
    mask_capture(capture, model, tmp_path / "sheet.png", lambda *_: None, lambda: False)
    assert min(iou(view.mask > 0.5, mask) for view, mask in zip(capture.views, true, strict=True)) > 0.85
    before = [view.mask for view in capture.views]
    mask_capture(capture, model, tmp_path / "sheet.png", lambda *_: None, lambda: False)
    assert f"{model} is not used" in caplog.text and all(a is b.mask for a, b in zip(before, capture.views))


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
