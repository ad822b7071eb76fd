"""Settings of a reconstruction: of reading the photographs, of the run, of its two stages."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Annotated, Any, Literal

from ..core.errors import UsageError
from .inverse_rendering.settings import Settings as Decoupling
from .optim.schedule import Schedule
from .ranges import Range, check


@dataclass(frozen=True, slots=True)
class Reading:
    """How photographs are read, see `readers.read_capture`, `masks.of_capture`, `normal_model` and `capture.pipeline`.

    Attributes
    ----------
    resolution : int, optional
        Pixels of the longer side, at most; None: all.
    test_every : int, optional
        Leave out every n-th view, where the capture does not say which; None: none.
    axes : {"opengl", "opencv", "opengl-inverse", "opencv-inverse"}
        Convention of the camera matrices; "opengl" is that of the layout.
    up : {"z", "y", "-z", "-y"}, optional
        Up axis of the capture's world; None: found.
    turntable : {"auto", "yes", "no"}
        Whether the object was turned and the light stood still with the camera; "auto": where the surroundings are the
        same in all pictures, with a warning.
    masks : str
        "given" uses masks that are there; "auto" makes them where there are none, of an object on a ground that shows
        texture; "auto-without-cameras" is "auto" where the photographs have no cameras, else "given"; an ONNX file, or
        its name, makes them by this segmentation model; "none" uses none, and the surroundings are learned, too.
    normals : str
        "none", or an ONNX file, a model of normals that the first part of learning follows
        (`schedule.normal_prior`). Nothing is downloaded.
    video_frames : int
        Without cameras: frames of a video that are used, about.
    poses : {"auto", "markers", "features"}
        Without cameras: found by a marker sheet or by features of the pictures; "auto": by the sheet, where most
        pictures show it.
    marker_length : float, optional
        Without cameras: side of the sheet's black squares as measured, mm; None: as printed in true size.
    camera_distance : float, optional
        Without cameras: metres from them to the object, typically, where no sheet gives the scale; None: 1, a guess.
    feature_resolution : int
        Without cameras: pixels of the longer side at which features and markers are sought.
    brackets : {"auto", "none", "2", "3", "4", "5", "6", "7", "8", "9"}
        Without cameras: exposure brackets that are merged; "auto": those that EXIF shows; a number: so many files that
        follow each other are one; "none" merges nothing.
    """

    resolution: Annotated[int | None, Range(8, 1 << 16)] = None
    test_every: Annotated[int | None, Range(2, 1_000_000)] = None
    axes: Literal["opengl", "opencv", "opengl-inverse", "opencv-inverse"] = "opengl"
    up: Literal["z", "y", "-z", "-y"] | None = None
    turntable: Literal["auto", "yes", "no"] = "auto"
    masks: str = "auto-without-cameras"
    normals: str = "none"
    video_frames: Annotated[int, Range(10, 400)] = 90
    poses: Literal["auto", "markers", "features"] = "auto"
    marker_length: Annotated[float | None, Range(0.001, 1e6)] = None
    camera_distance: Annotated[float | None, Range(0.001, 1e6)] = None
    feature_resolution: Annotated[int, Range(320, 8192)] = 1600
    brackets: Literal["auto", "none", "2", "3", "4", "5", "6", "7", "8", "9"] = "auto"


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of a reconstruction.

    Attributes
    ----------
    variant : {"p", "m"}
        "p" keeps the free surfels (driven by particles or mesh), "m" makes surfels on the mesh's faces.
    schedule : Schedule
        How surfels are learned.
    mesh_resolution : int, optional
        Most voxels along the mesh's longest side, none smaller than a pixel; None: 512 or as many as memory holds, and
        256 where surfels are made on its faces or time decides.
    minutes : float, optional
        The time budget of all stages together, once kernels are compiled; None: the steps decide.
    materials : bool
        Inverse rendering: materials apart from the light; else albedo is the photographed colour.
    decoupling : Settings
        How. Normals are learned too: a mesh of photographs has errors.
    fixed : tuple of str
        Parameters of surfels on faces that are not learned: "offset", "opacity" (the paper's ablation).
    device : {"cpu", "cuda"}
        "cpu", or "cuda" to learn on the first NVIDIA card; without one the CPU does.
    """

    variant: Literal["p", "m"] = "p"
    schedule: Schedule = field(default_factory=Schedule)
    mesh_resolution: Annotated[int | None, Range(16, 1024)] = None
    minutes: Annotated[float | None, Range(0.001, 1e6)] = None
    materials: bool = True
    decoupling: Decoupling = field(default_factory=lambda: Decoupling(normals=True))
    fixed: tuple[Literal["offset", "opacity"], ...] = ()
    device: Literal["cpu", "cuda"] = "cpu"

    def check(self) -> None:
        """Raise UsageError on what cannot be used."""
        check(self)
        self.schedule.check()
        self.decoupling.check()
        if self.minutes is not None and self.decoupling.seconds:
            problem = "is given beside minutes, of which it would be a part"
            raise UsageError("decoupling.seconds", problem, "Leave one of them out")

    def without_effect(self) -> list[str]:
        """Names of settings that are not the default and decide nothing, because of others."""
        default, schedule = Settings(), self.schedule
        changed = [f"decoupling.{name}" for name in _changed(self.decoupling, default.decoupling)]
        changed += [f"schedule.{name}" for name in _changed(schedule, default.schedule)]
        idle = {f"schedule.{name}" for name in ("patches_from", "patches_spread") if not schedule.patches}
        idle |= {"schedule.median"} if not schedule.consistency else set()
        idle |= {f"decoupling.{name}" for name in self._idle_of_materials()}
        return [name for name in changed if name in idle] + (["fixed"] if self.fixed and self.variant == "p" else [])

    def _idle_of_materials(self) -> set[str]:
        """Names of the settings of inverse rendering that decide nothing, changed or not."""
        s = self.decoupling
        if not self.materials:
            return {field.name for field in fields(s)}
        idle = {"joint", "domain"} if self.variant == "m" else set()
        if not s.unbiased:
            idle |= {"weight_by_prediction", "clipped_neighbour_weight"}
        if not s.weight_by_prediction:
            idle |= {"clipped_neighbour_weight"}
        if s.parametrisation != "metallic":
            idle |= {"binary_metallic_prior", "metal_albedo_prior", "metal_smoothness"}
        if not s.smoothness:
            idle |= {"metal_smoothness"}
        if not s.normals:
            idle |= {"normal_smoothness"}
        if not s.shadows:
            idle |= {"indirect"}
        return idle


def _changed(one: Any, other: Any) -> list[str]:
    return [field.name for field in fields(one) if getattr(one, field.name) != getattr(other, field.name)]
