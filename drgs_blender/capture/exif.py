"""Metadata of photographs, EXIF's and EXR's: orientation, focal length, exposure, camera, time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from PIL import ExifTags
from PIL import Image as Pillow

from .gravity import Vector, up_of_maker_note

#: Diagonal of a full-frame sensor, mm: "35 mm equivalent" focal lengths mean the angle of view along it (CIPA DCG-001).
_FULL_FRAME = math.hypot(36.0, 24.0)
#: Focal-plane resolution units in mm; EXIF 2.3 table 8.
_UNITS = {2: 25.4, 3: 10.0, 4: 1.0}


@dataclass(frozen=True, slots=True)
class Metadata:
    """Metadata of one photograph.

    Attributes
    ----------
    orientation : int
        1 to 8, EXIF's; 1 without.
    focal : float, optional
        Focal length in parts of the picture's longer side; None where it is not known.
    camera : str
        Maker, model, lens and focal length; "" where nothing is known. Equal texts are one lens.
    exposure : float, optional
        Exposure value at ISO 100, stops: log2(N^2 / t) - log2(ISO / 100). Larger lets in less light.
    seconds, aperture, iso : float, optional
        What it is computed of, as far as it is known.
    taken : float, optional
        When, seconds; differences of one camera's pictures mean something, the value does not.
    up : tuple of float, optional
        Up as the phone measured it, in the frame of the upright picture: right, up, towards the camera.
    """

    orientation: int = 1
    focal: float | None = None
    camera: str = ""
    exposure: float | None = None
    seconds: float | None = None
    aperture: float | None = None
    iso: float | None = None
    taken: float | None = None
    up: Vector | None = None

    @property
    def stops(self) -> float | None:
        """The exposure value with an aperture of 1 and ISO 100 where these are not known; None without a time."""
        if self.seconds is None:
            return None
        return math.log2((self.aperture or 1.0) ** 2 / self.seconds) - math.log2((self.iso or 100.0) / 100)


def read_exif(image: Pillow.Image) -> Metadata:
    """The metadata of an open picture; damaged ones count as none."""
    try:
        base = image.getexif()
    except Exception:  # damaged metadata raise almost anything; the pixels are sound
        return Metadata()
    return metadata_of(base, image.size)


def metadata_of(base: Pillow.Exif, size: tuple[int, int]) -> Metadata:
    """The metadata in EXIF of a picture of so many pixels, width and height; damaged ones count as none."""
    try:
        details = base.get_ifd(ExifTags.IFD.Exif)
    except Exception:
        return Metadata()
    orientation = base.get(ExifTags.Base.Orientation, 1)
    focal = _focal(details, *size)
    names = [base.get(ExifTags.Base.Make), base.get(ExifTags.Base.Model), details.get(ExifTags.Base.LensModel)]
    words = [str(name).strip("\0 ") for name in names if name]
    millimetres = _number(details.get(ExifTags.Base.FocalLength))
    if words and millimetres:
        words.append(f"{millimetres:g} mm")
    speed = details.get(ExifTags.Base.ISOSpeedRatings)
    seconds, aperture, iso = (
        _number(details.get(ExifTags.Base.ExposureTime)),
        _number(details.get(ExifTags.Base.FNumber)),
        _number(speed[0] if isinstance(speed, tuple) and speed else speed),
    )
    when, part = details.get(ExifTags.Base.DateTimeOriginal), details.get(ExifTags.Base.SubsecTimeOriginal)
    return Metadata(
        orientation if orientation in range(1, 9) else 1,
        focal if focal is not None and 0.2 < focal < 50 else None,
        " ".join(words),
        _exposure(seconds, aperture, iso),
        seconds,
        aperture,
        iso,
        _time(when, part),
        up_of_maker_note(details.get(ExifTags.Base.MakerNote), orientation, str(details.get(ExifTags.Base.LensModel))),
    )


def read_exr_metadata(path: Path) -> Metadata:
    """The metadata of an EXR file by OpenEXR's standard attributes; damaged ones count as none."""
    import OpenEXR

    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            header = dict(file.parts[0].header)
    except Exception:  # the binding raises whatever the C++ library threw; who reads the pixels says what is wrong
        return Metadata()
    words = [str(header[key]) for key in ("cameraMake", "cameraModel", "lensModel") if header.get(key)]
    seconds, aperture, iso = (_number(header.get(key)) for key in ("expTime", "aperture", "isoSpeed"))
    taken = _time(header.get("capDate"), None)
    exposure = _exposure(seconds, aperture, iso)
    return Metadata(camera=" ".join(words), exposure=exposure, seconds=seconds, aperture=aperture, iso=iso, taken=taken)


def _time(text: Any, part: Any) -> float | None:
    """Seconds of "YYYY:MM:DD HH:MM:SS" and the digits of the fraction."""
    try:
        whole = datetime.strptime(str(text).strip("\0 "), "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return None
    digits = str(part or "").strip("\0 ")
    return (whole - datetime(1970, 1, 1)).total_seconds() + (float(f"0.{digits}") if digits.isdecimal() else 0.0)


def _number(value: Any) -> float | None:
    """A finite number above zero, else None."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def _focal(details: Any, width: int, height: int) -> float | None:
    """Focal length in parts of the longer side."""
    equivalent = _number(details.get(ExifTags.Base.FocalLengthIn35mmFilm))
    longer = max(width, height)
    if equivalent:
        return equivalent / _FULL_FRAME * math.hypot(width, height) / longer
    millimetres = _number(details.get(ExifTags.Base.FocalLength))
    density = _number(details.get(ExifTags.Base.FocalPlaneXResolution))
    unit = _UNITS.get(details.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))
    across = _number(details.get(ExifTags.Base.ExifImageWidth)) or longer
    if millimetres and density and unit:
        return millimetres * density / unit / max(across, _number(details.get(ExifTags.Base.ExifImageHeight)) or 0)
    return None


def _exposure(seconds: float | None, aperture: float | None, iso: float | None) -> float | None:
    """Exposure value at ISO 100."""
    if not (aperture and seconds and iso):
        return None
    return math.log2(aperture**2 / seconds) - math.log2(iso / 100)
