"""Noisy frames read from disk for the temporal denoiser, and the camera metadata that they need.

A frame file says in its metadata through which camera it was seen (``camera``), and through which its surfaces were one
frame earlier (``previous``). Where the latter is not the camera of the file before, there is a cut, and nothing leads
from one to the other.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...core.errors import AssetError
from ...core.frame import Camera, Frame, RenderSettings
from ...core.passes import COLOURS, TEMPORAL
from ..camera import camera_parameters, footprints
from ..film.frame_files import read_frame
from ..film.guides import Guides
from ..film.light_passes import COMPONENTS, add_light
from ..film.motion_vectors import Motion, motion
from .svgf_temporal import NoisyPicture

Array = np.ndarray

#: How far the numbers of two cameras may lie apart (metres, radians, pixels) that are the same one evaluated twice.
SAME_CAMERA = 1e-4
#: Passes of newer versions, which add to the others.
_LATER = ("TransDir", "TransInd", "TransCol", "Object")
_HOW = "Render it with `drgs render --denoise none --passes temporal`, or with Store Denoising Data of its scene on"


@dataclass(slots=True)
class NoisyFrame:
    """A frame file.

    Attributes
    ----------
    picture : NoisyPicture
        Its light and the denoiser's guides; its motion leads one frame back.
    passes : dict of str to array
        By name, those of the light excepted.
    metadata : dict of str to str
        Of the file.
    camera, previous : array
        Parameters of the cameras of this frame and of one frame earlier.
    window : tuple of int
        (width, height, x0, y0, x1, y1) of the full picture and of the part rendered.
    transmitted : (h, w, 2, 3) float32 array, optional
        Part of the glossy light that surfaces let pass; None: the file has no such passes.
    """

    picture: NoisyPicture
    passes: dict[str, Array]
    metadata: dict[str, str]
    camera: Array
    previous: Array
    window: tuple[int, ...]
    transmitted: Array | None = None

    def follows(self, other: NoisyFrame) -> bool:
        """Whether this frame's motion leads to `other`; not across a cut."""
        return self.window == other.window and np.allclose(self.previous, other.camera, rtol=1e-6, atol=SAME_CAMERA)

    def beauty(self, light: Array) -> Array:
        """Combined with (h, w, 4, 3) other `light`."""
        return add_light(light, self.passes["Env"], self.passes["Emit"], self.passes["Combined"][..., 3])


def camera_metadata(frame: Frame) -> dict[str, str]:
    """Metadata of a frame file: the cameras of this frame and the one before, the denoiser, the noise index."""
    said = {"camera": _camera_text(frame.camera), "denoise": frame.settings.denoise, "noise": str(frame.noise_index)}
    if frame.previous is not None:
        said["previous"] = _camera_text(frame.previous.camera)
    return said


def read_noisy(path: str | Path) -> NoisyFrame:
    """Read a frame for the denoiser.

    Raises
    ------
    AssetError: it cannot be read, lacks passes (which are named), or its light is denoised already.
    """
    passes, metadata = read_frame(path)
    missing = [name for name in TEMPORAL if name not in passes and name not in _LATER]
    if missing:
        raise AssetError(str(path), f"lacks the passes {', '.join(missing)}", _HOW)
    if metadata.get("denoise", "none") != "none":
        raise AssetError(str(path), f"is denoised already ({metadata['denoise']})", _HOW)
    try:
        now, window = _parameters(metadata["camera"])
        before, _ = _parameters(metadata["previous"]) if "previous" in metadata else (now, window)
    except (KeyError, ValueError, TypeError) as error:
        raise AssetError(str(path), "does not say through which camera it was seen", _HOW) from error
    position, coverage = passes["Position"], _one(passes, "Coverage")
    # Where all colours are 0, light is 0: of objects that are shown as captured, which take no part.
    colours = [passes[name].any(axis=2) for name in ("DiffCol", "GlossCol", "TransCol") if name in passes]
    guides = Guides(
        np.where(np.any(colours, axis=0), coverage, np.float32(0.0)),
        position,
        passes["Normal"],
        passes["Albedo"],
        _one(passes, "Roughness"),
        _one(passes, "Metallic"),
        _one(passes, "Object" if "Object" in passes else "IndexOB"),
        footprints(_one(passes, "Depth"), now),
    )
    components = np.stack([passes.pop(name) * passes[COLOURS[name]] for name in COMPONENTS], axis=2)
    transmitted = None
    if all(name in passes for name in _LATER[:3]):
        transmitted = np.stack([passes.pop(name) * passes[COLOURS[name]] for name in _LATER[:2]], axis=2)
        components[:, :, 2:] += transmitted
    moved: Motion = motion(position, passes.pop("Previous Position"), coverage, now, before)
    return NoisyFrame(
        NoisyPicture(components, passes.pop("Variance"), guides, moved),
        passes,
        metadata,
        now,
        before,
        window,
        transmitted,
    )


def _one(passes: dict[str, Array], name: str) -> Array:
    return np.ascontiguousarray(passes[name][..., 0])


def _camera_text(camera: Camera) -> str:
    numbers = [*np.asarray(camera.matrix_world, np.float64)[:3].ravel(), camera.fx, camera.fy, camera.cx, camera.cy]
    size = [camera.width, camera.height, *camera.window]
    text = [[float(x) for x in numbers], bool(camera.orthographic), [int(x) for x in size]]
    lens = [[camera.panorama, float(camera.fov), [float(x) for x in camera.lens]]] if camera.panorama else []
    return json.dumps(text + lens)


def _parameters(text: str) -> tuple[Array, tuple[int, ...]]:
    """`camera.camera_parameters` (what sampling adds to them left at its defaults), and the window."""
    numbers, orthographic, size, *lens = json.loads(text)
    matrix = np.eye(4)
    matrix[:3] = np.reshape(np.array(numbers[:12], np.float64), (3, 4))
    width, height, x0, y0, x1, y1 = size
    fx, fy, cx, cy = numbers[12:]
    camera = Camera(matrix, width, height, fx, fy, cx, cy, orthographic, region=(x0, y0, x1, y1))
    if lens:
        camera.panorama, camera.fov, camera.lens = lens[0]
    return camera_parameters(camera, RenderSettings(), 0), tuple(size)
