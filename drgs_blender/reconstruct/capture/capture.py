"""A capture: calibrated photographs of one object."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...core.arrays import Array
from ...core.frame import Camera

RGB = tuple[float, float, float]

#: What pictures with alpha are laid on, sRGB; the published figures are measured on white.
WHITE: RGB = (1.0, 1.0, 1.0)


@dataclass(slots=True)
class View:
    """One photograph.

    Attributes
    ----------
    name : str
        As in the capture, unique.
    camera : Camera
        Pinhole (lens distortion is taken out when a capture is read); Z up world, Blender's camera convention.
    colour : (height, width, 3) float32 array
        sRGB-encoded in 0..1 as photographed, top row first.
    mask : (height, width) float32 array, optional
        In 0..1, the object's coverage of the pixel; None without a mask.
    mask_band : float
        Pixels on either side of the mask's outline where it may be wrong and teaches surfels nothing (the unknown part
        of a trimap); 0: it is exact, as drawn ones are.
    test : bool
        Left out of training.
    normals : (height, width, 3) float32 array, optional
        Unit, world space, 0 where not known: what a model says of the pixels (`capture.normals`).
    above_white : (height, width, 3) float32 array, optional
        How much brighter than white linear Rec.709 values are; None: of a picture that clips, or nowhere.
    turn : (3, 3) float64 array, optional
        Rotation of world directions to those in which the light stands still (`turntable`); None: it does so in the
        world.
    linear : bool
        The picture's file holds linear floats (EXR, merged brackets): their scale says nothing.
    on_white : bool
        The mask is the picture's own alpha, and `colour` already lies on `WHITE`.
    """

    name: str
    camera: Camera
    colour: Array
    mask: Array | None = None
    test: bool = False
    normals: Array | None = None
    above_white: Array | None = None
    turn: Array | None = None
    linear: bool = False
    on_white: bool = False
    mask_band: float = 0.0

    def set_mask(self, mask: Array | None, band: float = 0.0) -> None:
        """Replace the mask, and the band that the last one had."""
        self.mask, self.mask_band = mask, band

    def laid_on(self, wanted: RGB, behind: RGB | None) -> Array:
        """The object on one colour.

        Parameters
        ----------
        wanted : tuple of float
            sRGB-encoded; colours are mixed as they are encoded.
        behind : tuple of float, optional
            What `colour` shows around the object, where that is one colour (`Capture.background`); None: surroundings
            that are cut away.

        Returns
        -------
        (height, width, 3) float32 array
            In 0..1; `colour` itself where there is no mask.
        """
        if self.mask is None:
            return self.colour
        behind = WHITE if self.on_white else behind
        mask, wanted_colour = self.mask[..., None], np.asarray(wanted, np.float32)
        if behind is None:
            return self.colour * mask + wanted_colour * (1 - mask)
        return np.clip(self.colour + (wanted_colour - np.asarray(behind, np.float32)) * (1 - mask), 0, 1)


@dataclass(slots=True)
class Capture:
    """Photographs of one object.

    Attributes
    ----------
    source : Path
        The file or folder that was read.
    views : list of View
        In the order of their names.
    background : tuple of float, optional
        sRGB of what `colour` shows outside of the mask where that is one colour; None: the real surroundings.
    points : (n, 3) float32 array, optional
        Sparse points on what was photographed (structure from motion).
    """

    source: Path
    views: list[View]
    background: RGB | None = None
    points: Array | None = None

    @property
    def name(self) -> str:
        """Name in reports: the folder, and the file where one was chosen."""
        path = self.source.resolve()
        return f"{path.parent.name}/{path.name}" if path.is_file() else path.name

    @property
    def turned(self) -> bool:
        """Whether the object was turned, and the light stood still with the camera."""
        return any(view.turn is not None for view in self.views)

    @property
    def training(self) -> list[View]:
        """Views that may be learned from."""
        return [view for view in self.views if not view.test]

    @property
    def testing(self) -> list[View]:
        """Views left out."""
        return [view for view in self.views if view.test]
