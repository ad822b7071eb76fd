"""Splats in glTF packed as SPZ: the extension KHR_gaussian_splatting_compression_spz_2, a draft of Khronos.

https://github.com/KhronosGroup/glTF/pull/2531. A buffer view holds an SPZ file (of the library's release 2: versions 2
and 3); accessors without data say what is in it. It lies in SPZ's axes, in which X points right and Z back; those of
glTF point left and to the front (the draft: LUF), half a turn about Y.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ..core.errors import AssetError
from .axes import multiply_quaternions
from .gltf_document import Document
from .harmonics import rotate_harmonics
from .splats import Splats
from .spz import spz_splats
from .spz_writer import spz_parts

Array = np.ndarray

EXTENSION = "KHR_gaussian_splatting_compression_spz_2"
#: As a part of the draft still calls it.
_OLDER = "KHR_gaussian_splatting_compression_spz"
#: Versions that fit the extension; the first is read by everything that knows it.
VERSIONS = (2, 3)
#: Noted of files that lack what the base extension asks for, as Cesium's do; its viewer takes coordinates as they are
#: stored (GltfSpzLoader: UNSPECIFIED).
CESIUM = "of a draft as Cesium writes it: coordinates are taken as they are stored, not turned from the axes of SPZ"
_REMEDY = "Export it again, or without compression"


class Packed:
    """The packed splats of a file, each unpacked once.

    Parameters
    ----------
    document : Document

    Attributes
    ----------
    notes : list of str
        Assumptions, each once.
    """

    def __init__(self, document: Document) -> None:
        self._document = document
        self._known: dict[tuple[int, int], Splats] = {}
        self.notes: list[str] = []

    def splats(self, compressed: dict[str, Any], settings: dict[str, Any], count: int | None) -> Splats:
        """Splats of a primitive in the axes of glTF.

        Parameters
        ----------
        compressed : dict
            The extensions inside KHR_gaussian_splatting.
        settings : dict
            That extension.
        count : int, optional
            How many its accessors say there are.

        Raises
        ------
        AssetError
            They are packed otherwise, damaged, or not as many.
        DeviceError
            See `spz.read_spz`.
        """
        document = self._document
        name = next((name for name in (EXTENSION, _OLDER) if name in compressed), None)
        if name is None:
            known = f"only {EXTENSION} is read; export it without compression"
            raise AssetError(document.subject, f"has splats with {', '.join(compressed)}", known)
        index = document.index(document.get(compressed, name, dict, {}), "bufferView")
        data, place = document.view(index)
        if place in self._known:
            splats = self._known[place]
            document.reserve(max(splats.sh.nbytes, 1 << 14))
        else:
            splats, up = spz_splats(data.tobytes(), f"{document.subject}, SPZ of buffer view {index}")
            if up != "y":
                raise AssetError(document.subject, f"has SPZ in it whose up axis is {up}", _REMEDY)
            self._known[place] = splats
        if count is not None and count != len(splats):
            problem = f"says it has {count} splats, of which SPZ holds {len(splats)}"
            raise AssetError(document.subject, problem, _REMEDY)
        if "kernel" not in settings and "colorSpace" not in settings:
            if CESIUM not in self.notes:
                self.notes.append(CESIUM)
            return splats
        return turned(splats)


def turned(splats: Splats) -> Splats:
    """Splats after half a turn about Y: from the axes of SPZ to those of glTF, and back."""
    signs = np.array([-1, 1, -1], np.float32)
    rotation = multiply_quaternions(np.array([0, 0, 1, 0], np.float32), splats.rotation).astype(np.float32)
    harmonics = rotate_harmonics(splats.sh, np.diag(signs))
    return replace(splats, centre=splats.centre * signs, rotation=rotation, sh=harmonics)


def packed(splats: Splats, version: int, subject: str) -> tuple[bytes, Array]:
    """The SPZ of splats in the axes of glTF, and their centres (n, 3) as they come out of it.

    Raises what `spz_writer.write_spz` does.
    """
    data = b"".join(spz_parts(turned(splats), version, subject))
    centre = turned(spz_splats(data, subject)[0]).centre
    return data, centre
