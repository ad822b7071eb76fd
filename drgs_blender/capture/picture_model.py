"""Models of one picture in ONNX files that the user has. Nothing is downloaded.

Pictures are prepared as the program that published a model does it, which its file's name tells.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image as Pillow

from ..core.arrays import Array
from ..core.errors import AssetError
from . import libraries

logger = logging.getLogger(__name__)

#: Mean and deviation of the channels of ImageNet.
IMAGENET = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class Preparation(NamedTuple):
    """How a model wants its pictures: side, pixels, where its input leaves it open; mean and deviation of channels."""

    side: int
    mean: tuple[float, float, float]
    deviation: tuple[float, float, float]


class PictureModel:
    """A model that takes one picture.

    Parameters
    ----------
    path : Path
    known : mapping of str to Preparation
        Beginning of a file's name -> how pictures are prepared; the longest that fits counts, "" is for all others.
    kind : str
        Of the model, for messages: "segmentation".

    Attributes
    ----------
    path : Path
    size : tuple of int
        (width, height) of its pictures.

    Raises
    ------
    AssetError
        The file is no such model.
    DeviceError
        ONNX Runtime is not installed.
    """

    def __init__(self, path: Path, known: Mapping[str, Preparation], kind: str) -> None:
        self.path, self._kind = path, kind
        runtime: Any = libraries.load("onnxruntime")
        options = runtime.SessionOptions()
        options.log_severity_level = 4  # its errors arrive as exceptions
        try:
            self._session = runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # of ONNX Runtime's own kinds
            raise AssetError(str(path), f"is no model that ONNX Runtime reads ({_first_line(error)})",
                             "Export it again as ONNX") from error  # fmt: skip
        inputs = self._session.get_inputs()
        shape = inputs[0].shape if inputs else []
        if len(inputs) != 1 or len(shape) != 4 or shape[1] != 3 or inputs[0].type != "tensor(float)":
            raise AssetError(
                str(path), f"takes {', '.join(f'{one.name} {one.type} {one.shape}' for one in inputs)}",
                f"A {kind} model takes one picture: floats of the shape (1, 3, height, width)",
            )  # fmt: skip
        name = path.stem.lower()
        start = max((start for start in known if name.startswith(start)), key=len)
        self._input, self._preparation = inputs[0].name, known[start]
        sides = [side if isinstance(side, int) and side > 0 else self._preparation.side for side in shape[2:]]
        self.size = sides[1], sides[0]
        if not start:
            logger.warning(
                "%s: is none of the models known by name (%s): pictures are prepared by ImageNet's mean and deviation, "
                "%d x %d", path, ", ".join(filter(None, known)), *self.size,
            )  # fmt: skip

    def run(self, pixels: Array, subject: str, white: int = 255) -> list[Array]:
        """All that the model gives.

        Parameters
        ----------
        pixels : (h, w, 3) uint8 array
            sRGB; stretched to the model's size.
        subject : str
            For messages.
        white : int
            The value that becomes 1.

        Returns
        -------
        list of float32 array

        Raises
        ------
        AssetError
            It fails on the picture, or gives NaN or infinity.
        """
        small = Pillow.fromarray(pixels).resize(self.size, Pillow.Resampling.LANCZOS)
        values = np.asarray(small, np.float32) / white
        _, mean, deviation = self._preparation
        given = ((values - np.asarray(mean, np.float32)) / np.asarray(deviation, np.float32)).transpose(2, 0, 1)[None]
        try:
            found = [np.asarray(one, np.float32) for one in self._session.run(None, {self._input: given})]
        except Exception as error:
            raise AssetError(str(self.path), f"fails on {subject} ({_first_line(error)})",
                             f"Check that it is a {self._kind} model") from error  # fmt: skip
        if not all(np.isfinite(one).all() for one in found):
            raise AssetError(str(self.path), f"gives NaN or infinity for {subject}", "Use another model")
        return found


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
